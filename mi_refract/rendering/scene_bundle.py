"""A scene as one bundle, its XML and every file that it names, for a machine that does not have them.

There the files lie below a folder as they lie here below the root, so that `../x` means the same. Names that would lead
elsewhere are replaced where the scene is loaded; in XML that the parser opens itself they cannot be.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import tempfile
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mi_refract.plugins import scene_limits, scene_parser

MEBIBYTE = 2**20
LIMIT = 256  # MiB
_KEPT = 2  # bundles and scenes that a process keeps


@dataclass(frozen=True)
class SceneBundle:
    """`scene` and the keys of `files` are absolute paths of the machine that made it; `digest` is of all the rest.

    `moved`: of the names in the scene those that do not lead to a file of the bundle by themselves, and their paths.
    `folders`: as the scene writes them, which must be there for a `..` that follows.
    """

    digest: str
    scene: str
    files: dict[str, bytes]
    folders: tuple[str, ...]
    moved: dict[str, str]


def pack(scene: Path, defines: Mapping[str, str], limit: int = LIMIT) -> SceneBundle:
    """The bundle of a scene in the present variant. `limit`: MiB of all files.

    ValueError, one line, for a scene that is larger, or that reaches XML in a way that only works here.
    """
    parsed = scene_parser.parse(scene, defines)
    others = parsed.files()
    paths = dict.fromkeys(map(_absolute, (*parsed.xml, *others.values())))
    _check_size(scene, list(paths), limit)
    files = {path: Path(path).read_bytes() for path in paths}
    parent = Path(_absolute(scene)).parent
    named = {name: _absolute(path) for name, path in others.items()}
    moved = {
        name: path
        for name, path in named.items()
        if os.path.normpath(parent / name) != path or Path(name).is_absolute()
    }
    contents = [[path, hashlib.sha256(content).hexdigest()] for path, content in sorted(files.items())]
    digest = hashlib.sha256(json.dumps([_absolute(scene), contents, moved]).encode()).hexdigest()
    named_folders = {file.parent for file in (*parsed.xml, *others.values())} | set(parsed.searched)
    folders = tuple(sorted(os.path.join(Path.cwd(), each) for each in named_folders))  # noqa: PTH118
    bundle = SceneBundle(digest, _absolute(scene), files, folders, moved)
    _check_places(bundle, [_absolute(path) for path in parsed.xml], defines)
    return bundle


def _absolute(path: Path) -> str:
    """Without `..`; ValueError where that is another file, because a folder on the way is a symbolic link."""
    normal = os.path.abspath(path)  # noqa: PTH100 (`Path.absolute` leaves "..")
    if not Path(normal).exists() or not os.path.samefile(path, normal):  # noqa: PTH121
        raise ValueError(
            f"{path}: is {normal} only by a symbolic link; expected with a cluster a name without '..' after it"
        )
    return normal


def _check_size(scene: Path, paths: list[str], limit: int) -> None:
    sizes = {path: Path(path).stat().st_size for path in paths}
    if (size := sum(sizes.values())) > limit * MEBIBYTE:
        largest = max(paths, key=sizes.__getitem__)
        told = f"{size / MEBIBYTE:.1f} MiB of files, the largest {largest} ({sizes[largest] / MEBIBYTE:.1f} MiB)"
        more = f"--bundle-limit {-(-size // MEBIBYTE)}, if all workers have the memory"
        raise ValueError(f"{scene}: {told}; expected with a cluster: {limit} MiB, or {more}")


def _search_folders(scene: Path) -> list[Path]:
    with scene_parser.folders(scene.parent) as inside:
        return [Path(str(folder)) for folder in inside]


def _check_places(bundle: SceneBundle, xml: list[str], defines: Mapping[str, str]) -> None:
    """ValueError where Mitsuba's parser would not find in the bundle what it opens itself."""
    texts = {path: bundle.files[path] for path in xml}
    with tempfile.TemporaryDirectory(prefix="mi_refract-") as folder:
        _write(Path(folder), texts | dict.fromkeys(bundle.files.keys() - texts.keys(), b""), bundle.folders)
        scene = _below(folder, bundle.scene)
        walk = scene_limits.check_files(scene, _search_folders(scene), defines)
        ways = {
            "included": walk.xml,
            "opened by <spectrum>": walk.opened.values(),
            "the folder of a <path>": walk.searched,
        }
        for how, paths in ways.items():
            for path in paths:
                if path.exists() and not Path(os.path.normpath(path)).is_relative_to(folder):
                    raise ValueError(f"{path}: {how}, {_ONLY_HERE}")


_ONLY_HERE = (
    "by an absolute name or from the working folder; expected with a cluster a name relative to the scene's folder"
)


def _below(root: str | Path, path: str) -> Path:
    return Path(f"{root}{path}")


def _write(root: Path, files: Mapping[str, bytes], folders: Iterable[str]) -> None:
    for name in folders:
        os.makedirs(_below(root, name), exist_ok=True)  # noqa: PTH103 (`Path.mkdir` fails at "..")
    for name, content in files.items():
        path = _below(root, name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


# Where it is rendered -------------------------------------------------------------------------------------------------

_unpacked: OrderedDict[str, Path] = OrderedDict()
_loaded: OrderedDict[tuple[str, ...], Any] = OrderedDict()


def load(bundle: SceneBundle, variant: str, defines: Mapping[str, str], folder: str) -> tuple[Any, str]:
    """The scene, loaded in the present variant, and the folder that stands for the root; both are kept for a next time.

    `folder`: where to unpack. Errors: those of `load_scene`, with the paths of the machine that made the bundle.
    """
    from .scene_files import load_scene

    root = unpack(bundle, folder)
    key = (bundle.digest, variant, json.dumps(dict(defines), sort_keys=True))
    if key not in _loaded:
        moved = {name: str(_below(root, path)) for name, path in bundle.moved.items()}
        with original_paths(str(root)):
            _keep(_loaded, key, load_scene(_below(root, bundle.scene), defines, moved=moved))
    return _loaded[key], str(root)


def unpack(bundle: SceneBundle, folder: str) -> Path:
    """Write the files of a bundle below `folder`, once in a process: the folder that stands for the root."""
    root = _unpacked.get(bundle.digest)
    if root is None or not root.is_dir():
        root = Path(tempfile.mkdtemp(prefix="scene-", dir=folder))
        _write(root, bundle.files, bundle.folders)
        _keep(_unpacked, bundle.digest, root)
    return root


def _keep(kept: OrderedDict[Any, Any], key: Any, value: Any) -> None:
    kept[key] = value
    while len(kept) > _KEPT:
        _, old = kept.popitem(last=False)
        if isinstance(old, Path):
            shutil.rmtree(old, ignore_errors=True)


@contextlib.contextmanager
def original_paths(root: str) -> Iterator[None]:
    """Within, errors name files as the machine that made the bundle does."""
    try:
        yield
    except Exception as error:
        error.args = tuple(each.replace(root, "") if isinstance(each, str) else each for each in error.args)
        raise

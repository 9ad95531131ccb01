"""A scene as one bundle, its XML and every file that it names, for a machine that does not have them.

There the files lie below a folder as they lie here below the root, so that `../x` means the same, and plugins get their
paths. Mitsuba's parser opens XML and spectra itself: what it made of them there is compared with what it made here.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import tempfile
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from html import unescape
from pathlib import Path

from mi_refract.numerics import Scene
from mi_refract.plugins import scene_parser
from mi_refract.plugins.scene_parser import ParsedScene

from .scene_files import load_parsed, parse_scene

MEBIBYTE = 2**20
LIMIT = 256  # MiB
_KEPT = 2  # bundles and scenes that a process keeps
_ELEMENT = re.compile(r"""<(\w++)((?:[^"'>]++|"[^"]*+"|'[^']*+')*+)>""")
_ATTRIBUTE = re.compile(r"""([\w:.-]++)\s*+=\s*+("[^"]*+"|'[^']*+')""")


@dataclass(frozen=True)
class SceneBundle:
    """`scene` and the keys of `files` are absolute paths of the machine that made it; `digest` is of all the rest.

    `text`: `ParsedScene.digest`. `folders`: as the scene writes them, which must be there for a `..` that
    follows. `moved`: of the names in the scene those that do not lead to a file of the bundle by themselves, and their
    paths. `defines`: values of `<default>`s.
    """

    digest: str
    scene: str
    text: str
    files: dict[str, bytes]
    folders: tuple[str, ...]
    moved: dict[str, str]
    defines: dict[str, str]


def pack(parsed: ParsedScene, defines: Mapping[str, str], limit: int = LIMIT) -> SceneBundle:
    """The bundle of a scene that was parsed with these `defines`. `limit`: MiB of all files; ValueError for more."""
    named, spectra = parsed.files(), _spectra(parsed, defines)
    paths = {_absolute(path) for path in (parsed.path, *parsed.xml, *spectra, *named.values())}
    sizes = {path: Path(path).stat().st_size for path in sorted(paths)}
    if (size := sum(sizes.values())) > limit * MEBIBYTE:  # before they are in memory
        largest = max(sizes, key=sizes.__getitem__)
        listed = f"{size / MEBIBYTE:.1f} MiB of files, the largest {largest} ({sizes[largest] / MEBIBYTE:.1f} MiB)"
        more = f"--bundle-limit {-(-size // MEBIBYTE)}, if all workers have the memory"
        raise ValueError(f"{parsed.path}: {listed}; the limit for a cluster is {limit} MiB; raise it by {more}")
    scene, text = _absolute(parsed.path), parsed.digest
    files = {path: Path(path).read_bytes() for path in sizes}
    contents = [[path, hashlib.sha256(content).hexdigest()] for path, content in files.items()]
    where = {name: _absolute(path) for name, path in named.items()}
    own = Path(scene).parent
    moved = {n: p for n, p in where.items() if os.path.normpath(own / n) != p or Path(n).is_absolute()}
    digest = hashlib.sha256(json.dumps([scene, text, contents, moved, sorted(defines.items())]).encode()).hexdigest()
    folders = {path.parent for path in (*parsed.xml, *spectra, *named.values())} | set(parsed.folders)
    written = tuple(sorted(os.path.join(Path.cwd(), path) for path in folders))  # noqa: PTH118 (keeps "..")
    return SceneBundle(digest, scene, text, files, written, moved, dict(defines))


def _spectra(parsed: ParsedScene, defines: Mapping[str, str]) -> list[Path]:
    """The files that `<spectrum>` elements name: Mitsuba reads them as it parses, and does not say which."""
    texts = (re.sub("<!--.*?-->", "", path.read_text("utf-8", "replace"), flags=re.DOTALL) for path in parsed.xml)
    elements = [(name, dict(_ATTRIBUTE.findall(rest))) for text in texts for name, rest in _ELEMENT.findall(text)]
    values = dict(defines)
    for found in (found for element, found in elements if element == "default" and "name" in found):
        values.setdefault(found["name"][1:-1], unescape(found.get("value", '""')[1:-1]))  # the first one counts
    files = []
    with scene_parser.folders(*parsed.folders) as places:
        for quoted in {found["filename"] for x, found in elements if x == "spectrum" and "filename" in found}:
            name = unescape(quoted[1:-1])
            for parameter in sorted(values, key=len, reverse=True):
                name = name.replace(f"${parameter}", values[parameter])
            files += [file for file in [Path(str(places.resolve(name)))] if file.is_file()]
    return files


def _absolute(path: Path) -> str:
    """Without `..`; ValueError where that is another file, because a folder on the way is a symbolic link."""
    normal = os.path.abspath(path)  # noqa: PTH100 (`Path.absolute` leaves "..")
    if not Path(normal).exists() or not os.path.samefile(path, normal):  # noqa: PTH121
        raise ValueError(f"{path}: '..' after a symbolic link; for a cluster, use a name without '..'")
    return normal


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
_loaded: OrderedDict[tuple[str, str], Scene] = OrderedDict()


def load(bundle: SceneBundle, variant: str, folder: str) -> tuple[Scene, str]:
    """The scene, loaded in the present variant, and the folder that stands for the root; both are kept for a next time.

    `folder`: where to unpack. Errors: those of `load_scene`, with the paths of the machine that made the bundle.
    """
    root, key = unpack(bundle, folder), (bundle.digest, variant)
    if key not in _loaded:
        moved = {name: str(_below(root, path)) for name, path in bundle.moved.items()}
        with original_paths(str(root)):
            parsed = parse_scene(_below(root, bundle.scene), bundle.defines)
            if parsed.digest != bundle.text:
                expected = "XML and spectra that are named relative to the scene's folder"
                raise ValueError(f"{bundle.scene}: Mitsuba reads another scene on this worker; expected {expected}")
            _loaded[key] = load_parsed(parsed, moved=moved)
        if len(_loaded) > _KEPT:
            _loaded.popitem(last=False)
    return _loaded[key], str(root)


def unpack(bundle: SceneBundle, folder: str) -> Path:
    """Write the files of a bundle below `folder`, once in a process: the folder that stands for the root."""
    root = _unpacked.get(bundle.digest)
    if root is None or not root.is_dir():
        root = Path(tempfile.mkdtemp(prefix="scene-", dir=folder))
        _write(root, bundle.files, bundle.folders)
        _unpacked[bundle.digest] = root  # only when it is complete
        if len(_unpacked) > _KEPT:
            shutil.rmtree(_unpacked.popitem(last=False)[1], ignore_errors=True)
    return root


@contextlib.contextmanager
def original_paths(root: str) -> Iterator[None]:
    """Within, errors name files as the machine that made the bundle does."""
    try:
        yield
    except Exception as error:
        error.args = tuple(text.replace(root, "") if isinstance(text, str) else text for text in error.args)
        raise

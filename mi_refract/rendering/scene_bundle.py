"""A scene as one bundle, what Mitsuba's parser made of its XML and every file that it names, for another machine.

There the files lie in a folder of their own, and plugins get their paths.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
import tempfile
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from mi_refract.media import file_in
from mi_refract.numerics import Scene
from mi_refract.plugins.scene_parser import Node, ParsedScene, restore

from .scene_files import load_parsed

MEBIBYTE = 2**20
LIMIT = 256  # MiB
_KEPT = 2  # bundles and scenes that a process keeps


@dataclass(frozen=True)
class SceneBundle:
    """`scene`: its path on the machine that made the bundle; `nodes`: those of `ParsedScene`, values of `<default>`s,
    included files and spectra in place; `files`: by their names in the scene; `digest`: of all of it.
    """

    scene: str
    nodes: list[Node]
    files: dict[str, bytes]
    digest: str


def pack(parsed: ParsedScene, limit: int = LIMIT) -> SceneBundle:
    """The bundle of a scene. `limit`: MiB of all files; ValueError for more."""
    named = parsed.files()
    sizes = {path: path.stat().st_size for path in named.values()}
    if (size := sum(sizes.values())) > limit * MEBIBYTE:  # before they are in memory
        largest = max(sizes, key=sizes.__getitem__)
        listed = f"{size / MEBIBYTE:.1f} MiB of files, the largest {largest} ({sizes[largest] / MEBIBYTE:.1f} MiB)"
        more = f"--bundle-limit {-(-size // MEBIBYTE)}, if all workers have the memory"
        raise ValueError(f"{parsed.path}: {listed}; the limit for a cluster is {limit} MiB; raise it by {more}")
    files = {name: path.read_bytes() for name, path in named.items()}
    contents = [(name, hashlib.sha256(content).hexdigest()) for name, content in files.items()]
    digest = hashlib.sha256(json.dumps([str(parsed.path), parsed.nodes, contents]).encode()).hexdigest()
    return SceneBundle(str(parsed.path), parsed.nodes, files, digest)


# Where it is rendered -------------------------------------------------------------------------------------------------

_unpacked: OrderedDict[str, Path] = OrderedDict()
_loaded: OrderedDict[tuple[str, str], Scene] = OrderedDict()


def load(bundle: SceneBundle, variant: str, folder: str) -> tuple[Scene, dict[str, str]]:
    """The scene, loaded in the present variant, and `unpack`'s answer; both are kept for a next time.

    `folder`: where to unpack. Errors: those of `load_scene`, with the names of the machine that made the bundle.
    """
    moved, key = unpack(bundle, folder), (bundle.digest, variant)
    if key not in _loaded:
        with original_names(moved):
            _loaded[key] = load_parsed(restore(Path(bundle.scene), bundle.nodes), moved=moved)
        if len(_loaded) > _KEPT:
            _loaded.popitem(last=False)
    return _loaded[key], moved


def unpack(bundle: SceneBundle, folder: str) -> dict[str, str]:
    """Write the files of a bundle below `folder`, once in a process: where they are, by their names in the scene."""
    root = _unpacked.get(bundle.digest)
    if new := root is None or not root.is_dir():
        root = Path(tempfile.mkdtemp(prefix="scene-", dir=folder))
    assert root is not None
    moved = {name: root / str(i) / Path(file_in(name) or name).name for i, name in enumerate(bundle.files)}
    if new:
        for name, path in moved.items():
            path.parent.mkdir()
            path.write_bytes(bundle.files[name])
        _unpacked[bundle.digest] = root  # only when it is complete
        if len(_unpacked) > _KEPT:
            shutil.rmtree(_unpacked.popitem(last=False)[1], ignore_errors=True)
    return {name: str(path) for name, path in moved.items()}


@contextlib.contextmanager
def original_names(moved: Mapping[str, str]) -> Iterator[None]:
    """Within, errors name files as the scene does."""
    try:
        yield
    except Exception as error:
        for name, path in moved.items():
            error.args = tuple(text.replace(path, name) if isinstance(text, str) else text for text in error.args)
        raise

"""A scene as one bundle for another machine: the parsed XML, and the contents of every file that it names.

The other machine writes the files to a separate folder, and passes their new paths to plugins.
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
_KEPT = 2  # number of bundles and of scenes that a process keeps


@dataclass(frozen=True)
class SceneBundle:
    """A scene and its files.

    `scene`: path of the scene on the machine that made the bundle. `nodes`: of `ParsedScene`, with the values of
    `<default>`s, included files and spectra inserted. `files`: contents, by their names in the scene. `digest`: SHA-256
    of all these.
    """

    scene: str
    nodes: list[Node]
    files: dict[str, bytes]
    digest: str


def pack(parsed: ParsedScene, limit: int = LIMIT) -> SceneBundle:
    """Return the bundle of a scene. `limit`: MiB of all files; ValueError for more."""
    named = parsed.files()
    sizes = {path: path.stat().st_size for path in named.values()}
    size = sum(sizes.values())
    if size > limit * MEBIBYTE:  # checked before files are read
        largest = max(sizes, key=sizes.__getitem__)
        listed = f"{size / MEBIBYTE:.1f} MiB of files, the largest {largest} ({sizes[largest] / MEBIBYTE:.1f} MiB)"
        more = f"--bundle-limit {-(-size // MEBIBYTE)}, if all workers have the memory"
        raise ValueError(f"{parsed.path}: {listed}; the limit for a cluster is {limit} MiB; raise it by {more}")
    files = {name: path.read_bytes() for name, path in named.items()}
    contents = [(name, hashlib.sha256(content).hexdigest()) for name, content in files.items()]
    digest = hashlib.sha256(json.dumps([str(parsed.path), parsed.nodes, contents]).encode()).hexdigest()
    return SceneBundle(str(parsed.path), parsed.nodes, files, digest)


# On the machine that renders it ---------------------------------------------------------------------------------------

_unpacked: OrderedDict[str, Path] = OrderedDict()
_loaded: OrderedDict[tuple[str, str], Scene] = OrderedDict()


def load(bundle: SceneBundle, variant: str, folder: str) -> tuple[Scene, dict[str, str]]:
    """Return the scene, loaded in the present variant, and the result of `unpack`; both are kept for later calls.

    `folder`: as in `unpack`. Errors: those of `load_scene`, with the file names of the machine that made the bundle.
    """
    moved, key = unpack(bundle, folder), (bundle.digest, variant)
    if key not in _loaded:
        with original_names(moved):
            _loaded[key] = load_parsed(restore(Path(bundle.scene), bundle.nodes), moved=moved)
        if len(_loaded) > _KEPT:
            _loaded.popitem(last=False)
    return _loaded[key], moved


def unpack(bundle: SceneBundle, folder: str) -> dict[str, str]:
    """Write the files of a bundle below `folder`, once per process; return their paths, by their names in the scene."""
    root = _unpacked.get(bundle.digest)
    is_new = root is None or not root.is_dir()
    if is_new:
        root = Path(tempfile.mkdtemp(prefix="scene-", dir=folder))
    assert root is not None
    moved = {name: root / str(i) / Path(file_in(name) or name).name for i, name in enumerate(bundle.files)}
    if is_new:
        for name, path in moved.items():
            path.parent.mkdir()
            path.write_bytes(bundle.files[name])
        _unpacked[bundle.digest] = root  # only if it is complete
        if len(_unpacked) > _KEPT:
            shutil.rmtree(_unpacked.popitem(last=False)[1], ignore_errors=True)
    return {name: str(path) for name, path in moved.items()}


@contextlib.contextmanager
def original_names(moved: Mapping[str, str]) -> Iterator[None]:
    """Within this context, replace paths of `unpack` in errors by the names in the scene."""
    try:
        yield
    except Exception as error:
        for name, path in moved.items():
            error.args = tuple(text.replace(path, name) if isinstance(text, str) else text for text in error.args)
        raise

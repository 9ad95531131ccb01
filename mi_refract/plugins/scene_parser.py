"""Mitsuba scene files, parsed, with their limits and their plugins checked before anything in them runs.

A scene is code: Mitsuba looks for `plugins/NAME.so` in the folder of the scene, in a `<path>`, and in the working
folder before it takes its own plugin of that name. Here its own come first, and a name that is neither its own nor ours
is an error, unless it is allowed by name.
"""

from __future__ import annotations

import contextlib
import glob
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mi_refract.formulas import FORMULAS
from mi_refract.io import image_file

from .refract import PLUGIN
from .refract_path import INTEGRATOR
from .scene_limits import DENSEST, DEPTH, FEW_VALUES, LOBES, VALUES, check_files, refuse_special, resolved

OURS = (PLUGIN, *(f"{PLUGIN}_{name}" for name in FORMULAS), INTEGRATOR)
# Registered by Mitsuba's own Python modules, or known to its parser.
PYTHON = ("direct_projective", "flat_sensor", "prb", "prb_basic", "prb_projective", "prbvolpath", "volprim_rf_basic")
BUILT_IN = ("scene",)  # its "rgb" and "spectrum" as a type end the process
NEEDED = {"bitmap": "filename", "blendbsdf": "weight"}  # without it Mitsuba reads memory that is not there
_untyped: Any = mi  # its stubs have no types for file resolvers


def own_folder() -> Path:
    """Mitsuba's own folder, which holds its folder `plugins`."""
    return Path(mi.__file__).parent


def known_plugins() -> frozenset[str]:
    """The names of Mitsuba's plugins and of ours."""
    files = {path.stem for path in (own_folder() / "plugins").iterdir()}
    return frozenset({*files, *PYTHON, *BUILT_IN, *OURS})


@contextlib.contextmanager
def folders(*first: Path) -> Iterator[Any]:
    """Within, Mitsuba looks for files in `first`, then where it did before. It yields Mitsuba's list, to be changed."""
    before = _untyped.file_resolver()
    inside = _untyped.FileResolver(before)
    for folder in reversed(first):
        inside.prepend(str(folder))
    _untyped.set_file_resolver(inside)
    try:
        yield inside
    finally:
        _untyped.set_file_resolver(before)


def parse(path: Path, config: Any, defines: Mapping[str, str]) -> Any:
    """What Mitsuba's parser makes of a scene file, references resolved; nothing of it runs. Call it within `folders`.

    `config`: an `mi.parser.ParserConfig`. ValueError for a scene beyond the limits, or that names pipes or devices;
    whatever Mitsuba raises where it cannot parse the file.
    """
    check_files(path, map(Path, map(str, _untyped.file_resolver())), defines)
    state = mi.parser.parse_file(config, str(path), **defines)
    seen = mi.parser.ParserState(state)  # a copy: to look at a parameter marks it as used
    nodes, by_id = list(seen.nodes), dict(seen.id_to_index)
    children = [_children(node.props, by_id) for node in nodes]
    _check_nesting(path, [node.type.name for node in nodes], children)
    places = [Path(str(folder)) for folder in _untyped.file_resolver()]
    for node in nodes:
        for value in _texts(node.props):
            refuse_special(resolved(value, places))
    mi.parser.transform_all(config, state)
    return state


@dataclass(frozen=True)
class SceneFiles:
    """The files that a scene consists of: `xml`, its own first, and the others by their names in it."""

    xml: tuple[Path, ...]
    others: dict[str, Path]


def files_of(path: Path, defines: Mapping[str, str], allowed: Collection[str] = ()) -> SceneFiles:
    """The files that a scene names and that are there, in the present variant; and those of `allowed` plugins.

    Errors: those of `parse`.
    """
    config = mi.parser.ParserConfig(str(mi.variant()))
    with folders(path.parent) as inside:
        walk = check_files(path, map(Path, map(str, inside)), defines)
        state = parse(path, config, defines)
        places = [path.parent, *(Path(str(folder)) for folder in inside)]
        named = {name: resolved(name, places) for node in state.nodes for name in _texts(node.props)}
    code = {
        f"plugins/{file.name}": file
        for place in reversed(places)  # Mitsuba takes the first that it finds
        for name in allowed
        for file in (place / "plugins").glob(f"{glob.escape(name)}.*")
    }
    others = {name: file for name, file in (walk.opened | named | code).items() if name and file.is_file()}
    return SceneFiles(tuple(dict.fromkeys(walk.xml)), dict(sorted(others.items())))


def _texts(props: Any) -> Iterator[str]:
    """The values of a plugin's parameters that are strings."""
    for name in props.keys():  # noqa: SIM118 (no dict)
        if isinstance(value := props[name], str):
            yield value


def load(
    path: Path, defines: Mapping[str, str], allowed: Collection[str] = (), moved: Mapping[str, str] | None = None
) -> Any:
    """Load a scene file in the present variant, so that the same seed gives the same image.

    `defines` replace its `<default>`s; `allowed`: names of plugins beside Mitsuba's and ours, which are found where
    Mitsuba looks, in the folder of the scene among others; `moved`: where files are now, by their names in the scene.
    Errors: those of `parse`, and ValueError for other plugins.
    """
    config = mi.parser.ParserConfig(str(mi.variant()))
    # Mitsuba orders merged meshes by address, and what it loads in parallel by thread. Emitters are in the same order,
    # so that the same seed would give different images.
    config.parallel = config.merge_equivalent = config.merge_meshes = False
    with folders(path.parent) as inside:
        state = parse(path, config, defines)
        check_plugins(path, (node.props.plugin_name() for node in state.nodes), allowed)
        _check_needed(path, (node.props for node in state.nodes))
        _move(state, moved or {})
        inside.prepend(str(own_folder()))  # before every <path>
        places = [path.parent, *(Path(str(folder)) for folder in inside)]
        for check, plugins in ((check_faces, ("ply",)), (_check_image, ("bitmap", "envmap"))):
            for file in {node.props["filename"] for node in state.nodes if _names_file(node.props, plugins)}:
                check(resolved(file, places))
        return mi.parser.instantiate(config, state)


def _move(state: Any, moved: Mapping[str, str]) -> None:
    """Put new names of files where a scene has old ones."""
    for node in state.nodes if moved else ():
        for name in node.props.keys():  # noqa: SIM118 (no dict)
            if isinstance(value := node.props[name], str) and value in moved:
                node.props[name] = moved[value]


def _names_file(props: Any, plugins: Collection[str]) -> bool:
    return props.plugin_name() in plugins and isinstance(props.get("filename", None), str)


def _check_image(path: Path) -> None:
    """ValueError for an image whose header is damaged or asks for too much memory: Mitsuba believes it."""
    if path.is_file():
        image_file.check_header(path, min(VALUES, FEW_VALUES + DENSEST * path.stat().st_size))


def check_faces(path: Path) -> None:
    """ValueError for a PLY file with a face that names a vertex which the file does not have.

    Mitsuba writes the normals of such vertices somewhere into memory. Other errors are left to the loading itself.
    """
    try:
        mesh = mi.load_dict({"type": "ply", "filename": str(path.absolute()), "face_normals": True})
    except RuntimeError:
        return
    faces, count = np.array(mesh.faces_buffer()), mesh.vertex_count()
    if faces.size and faces.max() >= count:
        raise ValueError(f"{path}: vertex {faces.max()} of a face; expected 0 to {count - 1}, the vertices of the file")


def check_plugins(path: Path, names: Any, allowed: Collection[str]) -> None:
    """ValueError for a plugin that is neither Mitsuba's nor ours nor in `allowed`."""
    if unknown := sorted({*names} - known_plugins() - {*allowed}):
        accepted = f"those; to load native code shipped with a scene, pass --allow-plugins {unknown[0]}"
        raise ValueError(f"{path}: plugin {unknown[0]!r}: neither Mitsuba's nor mi_refract's; expected {accepted}")


def _check_needed(path: Path, every: Iterable[Any]) -> None:
    for props in every:
        name = NEEDED.get(plugin := props.plugin_name())
        if name and name not in props:
            raise ValueError(f"{path}: plugin {plugin!r} without {name!r}; expected one with it")


def _children(props: Any, by_id: Mapping[str, int]) -> list[int]:
    """The nodes inside a node and those that it refers to."""
    found = []
    for name in props.keys():  # noqa: SIM118 (no dict)
        value = props[name]
        kind = type(value).__name__  # Mitsuba does not export the classes
        if kind == "ResolvedReference":
            found.append(value.index())
        elif kind == "Reference" and value.id() in by_id:
            found.append(by_id[value.id()])
    return found


def _check_nesting(path: Path, kinds: list[str], children: list[list[int]]) -> None:
    """ValueError where nodes refer to each other in a circle, too deeply, or make a BSDF of too many lobes."""
    depth: dict[int, int] = {}
    lobes: dict[int, int] = {}
    for i in _children_first(path, children):
        depth[i] = 1 + max((depth[child] for child in children[i]), default=0)
        lobes[i] = 1 + 2 * sum(lobes[child] for child in children[i]) if kinds[i] == "BSDF" else 0
        if depth[i] > DEPTH or lobes[i] > LOBES:
            what = f"up to {DEPTH}, and {LOBES} lobes of a BSDF"
            raise ValueError(f"{path}: plugins nested {depth[i]} deep, of {lobes[i]} lobes; expected {what}")


def _children_first(path: Path, children: list[list[int]]) -> Iterator[int]:
    """The numbers of all nodes, each after its children. It does not call itself: chains may be long."""
    begun, done = set[int](), set[int]()
    for root in range(len(children)):
        stack = [root]
        while stack:
            node = stack[-1]
            if node in done or node in begun:
                stack.pop()
                if node not in done:
                    done.add(node)
                    yield node
                continue
            begun.add(node)
            for child in children[node]:
                if child in begun and child not in done:
                    raise ValueError(f"{path}: circular reference between plugins")
                stack.append(child)

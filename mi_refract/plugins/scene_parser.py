"""Mitsuba scene files, parsed once by Mitsuba. Their plugins are checked before any of them runs.

A scene can read any file, need any amount of memory, and crash the process: trust it like a program. Only one thing is
ensured, by the state of Mitsuba's own parser: a scene runs no code but Mitsuba's and ours. Mitsuba looks for
`plugins/NAME.so` in the folder of the scene, in folders of `<path>`, and in the working folder before it loads its own
plugin of that name. Here its own plugins come first, and a plugin that is neither Mitsuba's nor ours is an error unless
the user allows it by name.
"""

from __future__ import annotations

import contextlib
import errno
import glob
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any, TypeAlias

import mitsuba as mi
import mitsuba.mitsuba_ext
import numpy as np

from mi_refract import media
from mi_refract.formulas import FORMULAS
from mi_refract.io import image_file, safe_files
from mi_refract.numerics import Properties, Scene, mitsuba_mesh

from .index_parameter import PLUGIN
from .refract_path import INTEGRATOR

ParserState: TypeAlias = Any  # an `mi.parser.ParserState`
Node: TypeAlias = tuple[Any, ...]  # a node of a state: type, plugin, id, and parameters (name, type, numbers or text)
OURS = (PLUGIN, *(f"{PLUGIN}_{name}" for name in FORMULAS), INTEGRATOR)
# Plugins that Mitsuba's Python modules register, and those that its parser knows.
PYTHON = ("direct_projective", "flat_sensor", "prb", "prb_basic", "prb_projective", "prbvolpath", "volprim_rf_basic")
BUILT_IN = ("scene",)  # not "rgb" and "spectrum": as the type of a plugin they crash the process
NEEDED = {"bitmap": "filename", "blendbsdf": "weight"}  # parameters without which Mitsuba reads invalid memory
TAKEN = ("config", "filename")  # parameters of mi.parser.parse_file, which cannot be names of defines
DEPTH = 32  # of nested plugins: Mitsuba instantiates them by recursion
LOBES = 2**16  # of a BSDF if every BSDF in it were two-sided: each of two references to a BSDF doubles them
VALUES = 2**29  # of an image that a scene reads: 16384 × 8192 × 4
# An image has at most FEW_VALUES values, and DENSEST more for each byte of its file: deflate packs up to 1032 bytes
# into one byte. A header with more is corrupt.
FEW_VALUES, DENSEST = 2**24, 1032
_untyped: Any = mi  # its stubs have no types for file resolvers
_parsed: Any = mitsuba.mitsuba_ext  # types that do not depend on the variant


def own_folder() -> Path:
    """Return the folder of Mitsuba, which contains its folder `plugins`."""
    return Path(mi.__file__).parent


def known_plugins() -> frozenset[str]:
    """Return the names of Mitsuba's plugins and of ours."""
    files = {path.stem for path in (own_folder() / "plugins").iterdir()}
    return frozenset({*files, *PYTHON, *BUILT_IN, *OURS})


@contextlib.contextmanager
def folders(*first: Path) -> Iterator[Any]:
    """Return a context in which Mitsuba looks for files in `first` before other folders; it yields the resolver."""
    before = _untyped.file_resolver()
    resolver = _untyped.FileResolver(before)
    for folder in reversed(first):
        resolver.prepend(str(folder))
    _untyped.set_file_resolver(resolver)
    try:
        yield resolver
    finally:
        _untyped.set_file_resolver(before)


@dataclass(frozen=True)
class ParsedScene:
    """A scene file that Mitsuba's parser has read. No plugin of it has run."""

    path: Path
    config: Any  # the `mi.parser.ParserConfig` that it was parsed with
    state: ParserState  # references resolved
    nodes: list[Node]  # all nodes of the state, with included files, values of parameters and spectra from files
    folders: tuple[Path, ...] = ()  # where Mitsuba looks for files of the scene; folders of <path> elements come first
    # Files that the plugins name: name in the scene → path. They need not exist.
    named: dict[str, Path] = field(default_factory=dict)

    def files(self, allowed: Collection[str] = ()) -> dict[str, Path]:
        """Return the files that the plugins read, and the code of `allowed` plugins: name in the scene → path."""
        code = {f"plugins/{file.name}": file for name in allowed for file in self._code(name)}
        return {name: file for name, file in sorted((self.named | code).items()) if name and file.is_file()}

    def _code(self, name: str) -> list[Path]:
        """Return the code files of a plugin that ships with the scene; Mitsuba loads the last one of each file name."""
        plugin_folders = [folder / "plugins" for folder in (Path(), *reversed(self.folders))]  # Path(): working folder
        return [file for folder in plugin_folders for file in folder.glob(f"{glob.escape(name)}.*")]

    def load(self, allowed: Collection[str] = (), moved: Mapping[str, str] | None = None) -> Scene:
        """Return the scene, in the variant that it was parsed for. Call it once: Mitsuba moves data out of the state.

        `allowed`: names of plugins that may run in addition to Mitsuba's and ours. `moved`: new paths of files, by
        their names in the scene. ValueError for other plugins, and for files and parameters that would crash the
        process; RuntimeError from Mitsuba if it cannot create a plugin.
        """
        path, nodes = self.path, self.state.nodes
        # If the variant has not registered a Python plugin of Mitsuba, Mitsuba looks for a file of that name.
        known = known_plugins() - {name for name in PYTHON if self._code(name)}
        if unknown := sorted({node.props.plugin_name() for node in nodes} - known - {*allowed}):
            expected = f"those; to load native code shipped with a scene, pass --allow-plugins {unknown[0]}"
            raise ValueError(f"{path}: plugin {unknown[0]!r}: neither Mitsuba's nor mi_refract's; expected {expected}")
        images, meshes = set[str](), set[str]()
        copied = mi.parser.ParserState(self.state)  # a copy, as reading a parameter marks it as used
        for node, copy in zip(nodes, copied.nodes, strict=True):
            props, plugin = node.props, node.props.plugin_name()
            if (required := NEEDED.get(plugin)) and required not in props:
                raise ValueError(f"{path}: plugin {plugin!r} lacks its parameter {required!r}")
            for name, value in _texts(copy.props):
                if (file := media.file_in(value)) and moved and value in moved:
                    props[name] = value.replace(file, moved[value])
                if name != "filename":  # the only parameter of Mitsuba's plugins that names a file
                    continue
                if moved and value in moved:
                    props[name] = value = moved[value]
                if plugin in ("ply", "bitmap", "envmap"):
                    (meshes if plugin == "ply" else images).add(value)
        with folders(own_folder(), *self.folders):  # Mitsuba's own folder before every <path>
            for file in meshes:
                check_faces(self.named.get(file, Path(file)))
            for image in (self.named.get(file, Path(file)) for file in images):
                if image.is_file():  # Mitsuba would allocate whatever memory a corrupt header says
                    image_file.check_header(image, min(VALUES, FEW_VALUES + DENSEST * image.stat().st_size))
            return mi.parser.instantiate(self.config, self.state)


def parse(path: Path, defines: Mapping[str, str] | None = None, variant: str = "") -> ParsedScene:
    """Parse a scene file.

    `defines`: values that replace those of `<default>` elements. `variant`: of Mitsuba; by default the current one.
    ValueError for names in TAKEN, circular references, plugins nested too deeply, and a pipe or a device instead of the
    scene or of a file that a plugin names; Mitsuba hangs if one is included or read as a spectrum. OSError for a file
    that cannot be read. Errors from Mitsuba if it cannot parse the file.
    """
    if taken := [name for name in TAKEN if name in (defines or {})]:
        raise ValueError(f"define {taken[0]!r}: reserved by Mitsuba's parser; expected any name except {TAKEN}")
    config = _config(variant)
    require_file(path)
    with folders(path.parent) as resolver:
        state = mi.parser.parse_file(config, str(path), **defines or {})
        copied = mi.parser.ParserState(state)  # a copy, as reading a parameter marks it as used
        _check_nesting(path, copied)
        texts = {value for node in copied.nodes for _, value in _texts(node.props)}
        files = {text: _file(str(resolver.resolve(media.file_in(text) or text))) for text in sorted(texts)}
        for file in files.values():
            require_file(file)
        mi.parser.transform_all(config, state)
        searched = tuple(dict.fromkeys(Path(str(folder)) for folder in resolver))
        nodes = _nodes(mi.parser.ParserState(state))  # a copy, as above
        return ParsedScene(path, config, state, nodes, searched, files)


def restore(path: Path, nodes: Sequence[Node]) -> ParsedScene:
    """Return the scene of these `ParsedScene.nodes`, for the current variant. `path`: for messages."""
    config, state = _config(""), mi.parser.ParserState()
    for kind, plugin, identifier, parameters in nodes:
        node = mi.parser.SceneNode()
        node.type, node.props = getattr(mi.ObjectType, kind), _parsed.Properties(plugin)
        node.props.set_id(identifier)
        for name, value_type, value in parameters:
            node.props[name] = _CONVERSIONS[value_type][1](value) if value_type in _CONVERSIONS else value
        state.nodes.append(node)
    state.files = [str(path)]
    return ParsedScene(path, config, state, list(nodes))


def _config(variant: str) -> Any:
    """Return the `mi.parser.ParserConfig` of a variant; "": of the current one."""
    config = mi.parser.ParserConfig(variant or str(mi.variant()))
    # Mitsuba orders merged meshes by address, and shapes loaded in parallel by thread. Emitters follow that order, so
    # one seed would give different images.
    config.parallel = config.merge_equivalent = config.merge_meshes = False
    return config


def _nodes(state: ParserState) -> list[Node]:
    """Return the nodes of a state as plain values."""
    nodes = []
    for node in state.nodes:
        props, parameters = node.props, []
        for name in props.keys():  # noqa: SIM118 (no dict)
            value_type, value = props.type(name).name, props[name]
            plain = _CONVERSIONS[value_type][0](value) if value_type in _CONVERSIONS else value
            parameters.append((name, value_type, plain))
        nodes.append((node.type.name, props.plugin_name(), props.id(), parameters))
    return nodes


def _spectrum(knots: Any) -> Any:
    wavelengths, values = knots
    return _parsed.Spectrum(wavelengths, values) if wavelengths else _parsed.Spectrum(*values)


def _transform(matrices: Any) -> Any:
    transform = _untyped.ScalarAffineTransform4d()  # given a matrix, the constructor would compute another inverse
    transform.matrix, transform.inverse_transpose = matrices
    return transform


# Types of parameters that are not numbers or texts: conversion to plain values, and back.
_CONVERSIONS: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {
    "ResolvedReference": (lambda reference: reference.index(), _parsed.Properties.ResolvedReference),
    "Spectrum": (lambda x: (list(x.wavelengths), list(x.values)), _spectrum),
    "Transform": (lambda x: (np.array(x.matrix).tolist(), np.array(x.inverse_transpose).tolist()), _transform),
    "Color": (list, lambda values: _untyped.ScalarColor3d(values)),
    "Vector": (list, lambda values: _untyped.ScalarVector3d(values)),
}


def require_file(path: Path) -> None:
    """ValueError for a pipe or a device, which may never end. A path that does not exist is no error."""
    with contextlib.suppress(OSError):
        if not path.exists() or path.is_dir():
            return
    with safe_files.opened(path, sys.maxsize):
        pass


def _file(name: str) -> Path:
    """Return the path of a name; the working folder if the text is too long for a file name."""
    try:
        Path(name).exists()
    except OSError as error:
        return Path() if error.errno == errno.ENAMETOOLONG else Path(name)
    return Path(name)


def _texts(props: Properties) -> list[tuple[str, str]]:
    """Return the parameters of a plugin that are strings, as (name, value)."""
    pairs = [(name, props[name]) for name in props.keys()]  # noqa: SIM118 (no dict)
    return [(name, value) for name, value in pairs if isinstance(value, str)]


def _check_nesting(path: Path, state: ParserState) -> None:
    """ValueError if references are circular or nested too deeply, or if a BSDF has too many lobes."""
    nodes, by_id = list(state.nodes), dict(state.id_to_index)
    children: dict[int, list[int]] = {}
    for i, node in enumerate(nodes):
        children[i] = []
        for value in [node.props[name] for name in node.props.keys()]:  # noqa: SIM118 (no dict)
            value_type = type(value).__name__  # Mitsuba does not export the classes
            if value_type == "ResolvedReference":
                children[i].append(value.index())
            elif value_type == "Reference" and value.id() in by_id:
                children[i].append(by_id[value.id()])
    depth: dict[int, int] = {}
    lobes: dict[int, int] = {}
    try:
        for i in TopologicalSorter(children).static_order():  # children first
            depth[i] = 1 + max((depth[child] for child in children[i]), default=0)
            lobes[i] = 1 + 2 * sum(lobes[child] for child in children[i]) if nodes[i].type.name == "BSDF" else 0
            if depth[i] > DEPTH or lobes[i] > LOBES:
                expected = f"up to {DEPTH} deep, and up to {LOBES} lobes of a BSDF"
                raise ValueError(f"{path}: plugins nested {depth[i]} deep, of {lobes[i]} lobes; expected {expected}")
    except CycleError:
        raise ValueError(f"{path}: circular reference between plugins") from None


def check_faces(path: Path) -> None:
    """ValueError for a PLY file with a face whose vertex does not exist.

    Mitsuba would write the normal of such a vertex to invalid memory. Other errors are reported when the scene is
    loaded.
    """
    try:
        mesh = mi.load_dict({"type": "ply", "filename": str(path.absolute()), "face_normals": True})
    except RuntimeError:
        return
    vertices, faces = mitsuba_mesh.arrays(mesh)
    if faces.size and faces.max() >= len(vertices):
        expected = f"expected 0 to {len(vertices) - 1}, the vertices of the file"
        raise ValueError(f"{path}: vertex {faces.max()} of a face; {expected}")

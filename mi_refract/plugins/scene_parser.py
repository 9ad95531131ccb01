"""Mitsuba scene files, parsed once by Mitsuba, with their plugins checked before anything in them runs.

Trust a scene as you trust a program: it can read any file, need any amount of memory, and end the process. One thing is
ensured, by the state of Mitsuba's own parser: it runs no code but Mitsuba's and ours. Mitsuba looks for
`plugins/NAME.so` in the folder of the scene, in a `<path>`, and in the working folder before it takes its own plugin of
that name. Here its own come first, and a plugin that is neither Mitsuba's nor ours is an error unless it is allowed by
name.
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
Node: TypeAlias = tuple[Any, ...]  # of a state: type, plugin, id, and its parameters: name, type, numbers or text
OURS = (PLUGIN, *(f"{PLUGIN}_{name}" for name in FORMULAS), INTEGRATOR)
# Registered by Mitsuba's own Python modules, or known to its parser.
PYTHON = ("direct_projective", "flat_sensor", "prb", "prb_basic", "prb_projective", "prbvolpath", "volprim_rf_basic")
BUILT_IN = ("scene",)  # its "rgb" and "spectrum" as a type end the process
NEEDED = {"bitmap": "filename", "blendbsdf": "weight"}  # without it Mitsuba reads memory that is not there
DEPTH = 32  # of plugins within plugins: Mitsuba instantiates them by recursion
LOBES = 2**16  # of a BSDF if every BSDF in it were two-sided: each of two references to a BSDF doubles them
VALUES = 2**29  # of an image that a scene names: 16384 × 8192 × 4
# More values than these and DENSEST for each byte of the file are no picture: deflate packs up to 1032 bytes into one.
FEW_VALUES, DENSEST = 2**24, 1032
_untyped: Any = mi  # its stubs have no types for file resolvers
_parsed: Any = mitsuba.mitsuba_ext  # types that do not depend on the variant


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


@dataclass(frozen=True)
class ParsedScene:
    """A scene file that Mitsuba's parser has read. Nothing of it has run."""

    path: Path
    config: Any  # the `mi.parser.ParserConfig` that it was parsed with
    state: ParserState  # references resolved
    nodes: list[Node]  # all of the state: included files, values of parameters and spectra from files are in place
    folders: tuple[Path, ...] = ()  # where Mitsuba looks for its files, those of <path> elements first
    # The files that its plugins name, by their names in it; they need not exist.
    named: dict[str, Path] = field(default_factory=dict)

    def files(self, allowed: Collection[str] = ()) -> dict[str, Path]:
        """The files that its plugins read, by their names in it, and the code of `allowed` plugins."""
        code = {f"plugins/{file.name}": file for name in allowed for file in self._code(name)}
        return {name: file for name, file in sorted((self.named | code).items()) if name and file.is_file()}

    def _code(self, name: str) -> list[Path]:
        """The files of a plugin of the scene's own; of those of one name Mitsuba takes the last."""
        places = (place / "plugins" for place in (Path(), *reversed(self.folders)))  # at last in the working folder
        return [file for place in places for file in place.glob(f"{glob.escape(name)}.*")]

    def load(self, allowed: Collection[str] = (), moved: Mapping[str, str] | None = None) -> Scene:
        """The scene itself, in the variant that it was parsed for; once, as Mitsuba takes the state apart.

        `allowed`: names of plugins that may run beside Mitsuba's and ours. `moved`: where files are now, by their names
        in the scene. ValueError for other plugins, and for files and parameters that would end the process;
        RuntimeError of Mitsuba, where it cannot make a plugin.
        """
        path, nodes = self.path, self.state.nodes
        # Where a Python plugin of Mitsuba is not registered in the variant, it looks for a file of that name.
        known = known_plugins() - {name for name in PYTHON if self._code(name)}
        if unknown := sorted({node.props.plugin_name() for node in nodes} - known - {*allowed}):
            expected = f"those; to load native code shipped with a scene, pass --allow-plugins {unknown[0]}"
            raise ValueError(f"{path}: plugin {unknown[0]!r}: neither Mitsuba's nor mi_refract's; expected {expected}")
        images, meshes = set[str](), set[str]()
        seen = mi.parser.ParserState(self.state)  # a copy: reading a parameter marks it as used
        for props, read in ((node.props, copy.props) for node, copy in zip(nodes, seen.nodes, strict=True)):
            plugin = props.plugin_name()
            if (name := NEEDED.get(plugin)) and name not in props:
                raise ValueError(f"{path}: plugin {plugin!r} lacks its parameter {name!r}")
            for name, value in _texts(read):
                if (file := media.file_in(value)) and moved and value in moved:
                    props[name] = value.replace(file, moved[value])
                if name != "filename":  # the one parameter of Mitsuba's plugins that names a file
                    continue
                if moved and value in moved:
                    props[name] = value = moved[value]
                if plugin in ("ply", "bitmap", "envmap"):
                    (meshes if plugin == "ply" else images).add(value)
        with folders(own_folder(), *self.folders):  # Mitsuba's own folder before every <path>
            for file in meshes:
                check_faces(self.named.get(file, Path(file)))
            for image in (self.named.get(file, Path(file)) for file in images):
                if image.is_file():  # Mitsuba believes a header that is damaged, or asks for too much memory
                    image_file.check_header(image, min(VALUES, FEW_VALUES + DENSEST * image.stat().st_size))
            return mi.parser.instantiate(self.config, self.state)


def parse(path: Path, defines: Mapping[str, str] | None = None, variant: str = "") -> ParsedScene:
    """Parse a scene file.

    `defines`: values that replace those of `<default>` elements. `variant`: of Mitsuba; by default the present one.
    ValueError for circular references, plugins nested too deeply, and a pipe or a device in place of the scene or of a
    file that a plugin names; Mitsuba waits for one that is included or read as a spectrum. OSError for a file that
    cannot be read. Whatever Mitsuba raises where it cannot parse the file.
    """
    config = _config(variant)
    require_file(path)
    with folders(path.parent) as inside:
        state = mi.parser.parse_file(config, str(path), **defines or {})
        seen = mi.parser.ParserState(state)  # a copy: reading a parameter marks it as used
        _check_nesting(path, seen)
        names = {value for node in seen.nodes for _, value in _texts(node.props)}
        named = {name: _file(str(inside.resolve(media.file_in(name) or name))) for name in sorted(names)}
        for file in named.values():
            require_file(file)
        mi.parser.transform_all(config, state)
        places = tuple(dict.fromkeys(Path(str(x)) for x in inside))
        nodes = _nodes(mi.parser.ParserState(state))  # a copy, as above
        return ParsedScene(path, config, state, nodes, places, named)


def restore(path: Path, nodes: Sequence[Node]) -> ParsedScene:
    """The scene of these `ParsedScene.nodes`, for the present variant; `path` is for messages."""
    config, state = _config(""), mi.parser.ParserState()
    for kind, plugin, identifier, parameters in nodes:
        node = mi.parser.SceneNode()
        node.type, node.props = getattr(mi.ObjectType, kind), _parsed.Properties(plugin)
        node.props.set_id(identifier)
        for name, value_kind, value in parameters:
            node.props[name] = _CONVERSIONS[value_kind][1](value) if value_kind in _CONVERSIONS else value
        state.nodes.append(node)
    state.files = [str(path)]
    return ParsedScene(path, config, state, list(nodes))


def _config(variant: str) -> Any:
    """The `mi.parser.ParserConfig` of a variant; "": of the present one."""
    config = mi.parser.ParserConfig(variant or str(mi.variant()))
    # Mitsuba orders merged meshes by address, and what it loads in parallel by thread. Emitters are in the same order,
    # so the same seed would give different images.
    config.parallel = config.merge_equivalent = config.merge_meshes = False
    return config


def _nodes(state: ParserState) -> list[Node]:
    nodes = []
    for node in state.nodes:
        props, parameters = node.props, []
        for name in props.keys():  # noqa: SIM118 (no dict)
            kind, value = props.type(name).name, props[name]
            parameters.append((name, kind, _CONVERSIONS[kind][0](value) if kind in _CONVERSIONS else value))
        nodes.append((node.type.name, props.plugin_name(), props.id(), parameters))
    return nodes


def _spectrum(knots: Any) -> Any:
    wavelengths, values = knots
    return _parsed.Spectrum(wavelengths, values) if wavelengths else _parsed.Spectrum(*values)


def _transform(matrices: Any) -> Any:
    transform = _untyped.ScalarAffineTransform4d()  # whose constructor would compute the inverse by itself
    transform.matrix, transform.inverse_transpose = matrices
    return transform


# Parameters that are no numbers or texts, by their type: as such, and back.
_CONVERSIONS: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {
    "ResolvedReference": (lambda reference: reference.index(), _parsed.Properties.ResolvedReference),
    "Spectrum": (lambda x: (list(x.wavelengths), list(x.values)), _spectrum),
    "Transform": (lambda x: (np.array(x.matrix).tolist(), np.array(x.inverse_transpose).tolist()), _transform),
    "Color": (list, lambda values: _untyped.ScalarColor3d(values)),
    "Vector": (list, lambda values: _untyped.ScalarVector3d(values)),
}


def require_file(path: Path) -> None:
    """ValueError for a pipe or a device, which may never end. A path that does not exist passes."""
    with contextlib.suppress(OSError):
        if not path.exists() or path.is_dir():
            return
    with safe_files.opened(path, sys.maxsize):
        pass


def _file(name: str) -> Path:
    """The path; that of the working folder for a text that no file can have as its name."""
    try:
        Path(name).exists()
    except OSError as error:
        return Path() if error.errno == errno.ENAMETOOLONG else Path(name)
    return Path(name)


def _texts(props: Properties) -> list[tuple[str, str]]:
    """The parameters of a plugin that are strings."""
    pairs = [(name, props[name]) for name in props.keys()]  # noqa: SIM118 (no dict)
    return [(name, value) for name, value in pairs if isinstance(value, str)]


def _check_nesting(path: Path, state: ParserState) -> None:
    """ValueError where nodes refer to each other in a circle, too deeply, or make a BSDF of too many lobes."""
    nodes, by_id = list(state.nodes), dict(state.id_to_index)
    children: dict[int, list[int]] = {}
    for i, node in enumerate(nodes):
        values = [node.props[name] for name in node.props.keys()]  # noqa: SIM118 (no dict)
        kinds = [(type(value).__name__, value) for value in values]  # Mitsuba does not export the classes
        children[i] = [value.index() for kind, value in kinds if kind == "ResolvedReference"]
        children[i] += [by_id[x.id()] for kind, x in kinds if kind == "Reference" and x.id() in by_id]
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
    """ValueError for a PLY file with a face that names a vertex which the file does not have.

    Mitsuba writes the normals of such vertices somewhere into memory. Other errors are left to the loading itself.
    """
    try:
        mesh = mi.load_dict({"type": "ply", "filename": str(path.absolute()), "face_normals": True})
    except RuntimeError:
        return
    vertices, faces = mitsuba_mesh.arrays(mesh)
    if faces.size and faces.max() >= len(vertices):
        expected = f"expected 0 to {len(vertices) - 1}, the vertices of the file"
        raise ValueError(f"{path}: vertex {faces.max()} of a face; {expected}")

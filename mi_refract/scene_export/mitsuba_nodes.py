"""Reading of a parsed Mitsuba scene node by node. An unread parameter is an error, so that none is dropped silently."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_refract.io.errors import ExportError
from mi_refract.io.image_file import one_line
from mi_refract.plugins import scene_parser

from .plain_scene import Colour

Kind = TypeVar("Kind", int, float, str, bool)
ParserNode: TypeAlias = Any  # `mi.parser.SceneNode`
REFERENCE = "ResolvedReference"  # name of the class that refers to another node; Mitsuba does not export it


class Node:
    """A plugin of the parsed scene. Its parameters are read one by one; `finish` raises an error for unread ones."""

    def __init__(self, scene: SceneFile, node: ParserNode) -> None:
        """`node`: the node of Mitsuba's parser."""
        self.scene, self._node, self.props, self.type = scene, node, node.props, node.props.plugin_name()
        self.names = list(node.props.keys())
        self.unread = set(self.names)

    @property
    def kind(self) -> str:
        """The kind of plugin: Shape, BSDF, Emitter, …"""
        return str(self._node.type.name)

    def __str__(self) -> str:
        """The plugin's name and its id, for errors."""
        return f"{self.type} {self.props.id()}".strip()

    def take(self, name: str, default: object = None) -> Any:
        """Return a parameter as Mitsuba stores it, or a Node for a nested plugin."""
        self.unread.discard(name)
        value = self.props.get(name, default)
        return self.scene.node(value.index()) if type(value).__name__ == REFERENCE else value

    def ignore(self, *names: str) -> None:
        """Skip parameters that do not change the expected image."""
        self.unread.difference_update(names)

    def children(self) -> Iterator[Node]:
        """Yield the nested plugins that are not read yet, in the order of the file."""
        for name in [name for name in self.names if name in self.unread]:
            if type(self.props[name]).__name__ == REFERENCE:
                yield self.take(name)

    def finish(self) -> None:
        """Raise ValueError if a parameter was not read."""
        if self.unread:
            names = " and ".join(sorted(self.unread))
            verb, pronoun = ("is", "it") if len(self.unread) == 1 else ("are", "them")
            raise self.error(f"{names} {verb} not supported", f"a scene without {pronoun}")

    def error(self, what: str, expected: str) -> ExportError:
        """Return the error that names the file, the plugin, the fault and the expected content."""
        return ExportError(" ".join(f"{self.scene.path}: {self}: {what}; expected {expected}".split()))

    def value(self, kind: type[Kind], name: str, default: Kind | None = None) -> Kind:
        """Return a parameter of this type. ValueError if it is missing, of another type, or not finite."""
        value = self.take(name, default)
        if kind is float and type(value) is int:
            value = float(value)
        if type(value) is not kind or (isinstance(value, float) and not math.isfinite(value)):
            raise self.error(f"{name} = {value}", f"a value of type {kind.__name__}")
        return value

    def point(self, name: str, default: Sequence[float]) -> NDArray[np.float64]:
        """Return a parameter of three numbers, (3,). ValueError unless they are finite."""
        value = np.array(self.take(name, default), dtype=object)
        if value.shape != (3,) or not all(isinstance(x, (int, float)) and math.isfinite(x) for x in value):
            raise self.error(f"{name} = {value}", "three finite numbers")
        return value.astype(float)

    def colour(self, name: str, default: float | None) -> Colour:
        """Return a parameter as linear RGB. ValueError unless its three numbers are finite and at least 0."""
        value = self.take(name, default)
        if isinstance(value, Node):
            raise self.error(f"{name} is a {value.type}", "a colour")
        shown = value
        if type(value).__name__ == "Spectrum" and value.is_uniform():
            variant: Any = mi.scalar_rgb  # a lamp has light of equal energy, which is not white
            value = value.values[0] * np.array(variant.xyz_to_srgb([1.0] * 3) if self.kind == "Emitter" else 1.0)
        try:
            r, g, b = (float(x) for x in np.broadcast_to(np.array(value, float), 3))
        except (TypeError, ValueError):
            r = g = b = math.nan
        if not all(0 <= x < math.inf for x in (r, g, b)):
            raise self.error(f"{name} = {shown}", "an RGB colour of finite numbers, at least 0")
        return r, g, b

    def transform(self, name: str = "to_world") -> NDArray[np.float64]:
        """Return a transform, (4, 4). ValueError unless affine, with a positive determinant and a right inverse."""
        value = self.take(name)
        if value is not None and not hasattr(value, "matrix"):
            raise self.error(f"{name} = {value}", "a transform")
        matrix = np.eye(4) if value is None else np.array(value.matrix, float)
        affine = np.isfinite(matrix).all() and (matrix[3] == [0, 0, 0, 1]).all()
        if not affine or not np.linalg.det(matrix[:3, :3]) > 0:
            raise self.error(f"{name} mirrors or flattens", "an affine transform with a positive determinant")
        # Mitsuba transposes a rotation to invert it. Some of its shapes use the matrix, others the inverse.
        inverse = matrix[:3, :3].T if value is None else np.array(value.inverse_transpose)[:3, :3].T
        if not np.allclose(matrix[:3, :3] @ inverse, np.eye(3), atol=1e-5):  # an axis of six digits is exact enough
            raise self.error(f"{name} has a wrong inverse in Mitsuba", "rotations about axes of length 1")
        return matrix


class SceneFile:
    """A parsed scene file."""

    def __init__(self, path: Path, defines: Mapping[str, str]) -> None:
        """Parse the file, without running any plugin; `defines` replace its `<default>`s.

        ValueError, one line, if Mitsuba cannot parse it.
        """
        self.path = path
        try:
            self.parsed = scene_parser.parse(path, defines, "scalar_rgb")
        except OSError:
            raise
        except Exception as error:
            message = re.sub(r"\[\w+\.(cpp|h):\d+\] ", "", one_line(str(error)))
            raise ValueError(message if str(path) in message else f"{path}: {message}") from None

    def node(self, index: int) -> Node:
        """Return the node with this index; 0 is the scene."""
        return Node(self, self.parsed.state.nodes[index])

    def resolve(self, name: str) -> Path:
        """Return the path of a file that the scene names, where Mitsuba finds it."""
        return self.parsed.named[name]

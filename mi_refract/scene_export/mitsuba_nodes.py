"""A parsed Mitsuba scene, node by node. A parameter that was not read is an error, so that none is dropped silently."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from mi_refract.io.image_file import one_line
from mi_refract.plugins import scene_parser

from .plain_scene import Colour

Kind = TypeVar("Kind", int, float, str, bool)
ParserNode: TypeAlias = Any  # `mi.parser.SceneNode`
REFERENCE = "ResolvedReference"  # to another node; Mitsuba does not export the class


class Node:
    """A plugin of the parsed scene. Its parameters are taken one by one; `finish` raises for those that are left."""

    def __init__(self, scene: SceneFile, node: ParserNode) -> None:
        """`node`: of Mitsuba's parser."""
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
        """A parameter as Mitsuba holds it; a Node where it is a nested plugin."""
        self.unread.discard(name)
        value = self.props.get(name, default)
        return self.scene.node(value.index()) if type(value).__name__ == REFERENCE else value

    def ignore(self, *names: str) -> None:
        """Skip parameters that do not change the expected image."""
        self.unread.difference_update(names)

    def children(self) -> Iterator[Node]:
        """The nested plugins that are not taken yet, in the order of the file."""
        for name in [name for name in self.names if name in self.unread]:
            if type(self.props[name]).__name__ == REFERENCE:
                yield self.take(name)

    def finish(self) -> None:
        """ValueError where a parameter was not taken."""
        if self.unread:
            names, one = " and ".join(sorted(self.unread)), len(self.unread) == 1
            raise self.error(
                f"{names} {'is' if one else 'are'} not supported", f"a scene without {'it' if one else 'them'}"
            )

    def error(self, what: str, expected: str) -> ValueError:
        """The error that names the file and the plugin, what is wrong, and what was expected."""
        return ValueError(" ".join(f"{self.scene.path}: {self}: {what}; expected {expected}".split()))

    def value(self, kind: type[Kind], name: str, default: Kind | None = None) -> Kind:
        """A number, a text or a truth value. ValueError where it is of another type, missing, or not finite."""
        value = self.take(name, default)
        if kind is float and type(value) is int:
            value = float(value)
        if type(value) is not kind or (isinstance(value, float) and not math.isfinite(value)):
            raise self.error(f"{name} = {value}", f"one of type {kind.__name__}")
        return value

    def point(self, name: str, default: Sequence[float]) -> NDArray[np.float64]:
        """(3,). ValueError unless it is three finite numbers."""
        value = np.array(self.take(name, default), dtype=object)
        if value.shape != (3,) or not all(isinstance(x, (int, float)) and math.isfinite(x) for x in value):
            raise self.error(f"{name} = {value}", "three finite numbers")
        return value.astype(float)

    def colour(self, name: str, default: float | None) -> Colour:
        """Linear RGB. ValueError unless it is three finite numbers, each at least 0."""
        value = self.take(name, default)
        if isinstance(value, Node):
            raise self.error(f"{name} is a {value.type}", "a colour")
        uniform = re.fullmatch(r"Properties\.Spectrum\[uniform=([^\]]+)\]", str(value))
        try:
            r, g, b = (float(x) for x in np.broadcast_to(np.array(uniform[1] if uniform else value, float), 3))
        except (TypeError, ValueError):
            r = g = b = math.nan
        if not all(0 <= x < math.inf for x in (r, g, b)):
            raise self.error(f"{name} = {value}", "an RGB colour of finite numbers, at least 0")
        return r, g, b

    def transform(self, name: str = "to_world") -> NDArray[np.float64]:
        """(4, 4). ValueError unless it is affine, with a positive determinant."""
        value = self.take(name)
        if value is not None and not hasattr(value, "matrix"):
            raise self.error(f"{name} = {value}", "a transform")
        matrix = np.eye(4) if value is None else np.array(value.matrix, float)
        affine = np.isfinite(matrix).all() and (matrix[3] == [0, 0, 0, 1]).all()
        if not affine or not np.linalg.det(matrix[:3, :3]) > 0:
            raise self.error(f"{name} mirrors or flattens", "a transform that keeps left and right")
        return matrix


class SceneFile:
    """A parsed scene file."""

    def __init__(self, path: Path, defines: Mapping[str, str]) -> None:
        """Parse the file; `defines` replace its `<default>`s. Nothing in it runs.

        ValueError, one line, where Mitsuba cannot parse it.
        """
        self.path = path
        try:
            self.state = scene_parser.parse(path, defines, "scalar_rgb").state
        except OSError:
            raise
        except Exception as error:
            message = re.sub(r"\[\w+\.(cpp|h):\d+\] ", "", one_line(str(error)))
            raise ValueError(message if str(path) in message else f"{path}: {message}") from None

    def node(self, index: int) -> Node:
        """The node with this index; 0 is the scene."""
        return Node(self, self.state.nodes[index])

    def resolve(self, name: str) -> Path:
        """The path of a file that the scene names relative to its own folder. ValueError for a pipe or a device."""
        path = self.path.parent / name
        scene_parser.require_file(path)
        return path

"""A parsed Mitsuba scene, node by node. Every parameter is either read or refused: nothing is dropped in silence."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .images import one_line
from .plain_data import Colour


class Node:
    """A plugin of the parsed scene: its parameters, each to be taken; what is left at the end is refused."""

    def __init__(self, scene: Reader, node: Any) -> None:
        self.scene, self._node, self.props, self.type = scene, node, node.props, node.props.plugin_name()
        self.left = set(node.props.keys())

    @property
    def kind(self) -> str:
        """Shape, BSDF, Emitter, …"""
        return self._node.type.name

    def __str__(self) -> str:
        return f"{self.type} {self.props.id()}".strip()

    def take(self, name: str, default: Any = None) -> Any:
        self.left.discard(name)
        value = self.props.get(name, default)
        return self.scene.node(value.index()) if type(value).__name__ == "ResolvedReference" else value

    def ignore(self, *names: str) -> None:
        """Parameters without an effect on what is rendered in the end."""
        self.left.difference_update(names)

    def children(self) -> Iterator[Node]:
        """Its nested plugins without a meaning in their names, taken."""
        for name in sorted((name for name in self.left if re.fullmatch(r"_arg_\d+", name)), key=lambda x: int(x[5:])):
            yield self.take(name)

    def done(self) -> None:
        if self.left:
            raise self.refused(f"its {' and '.join(sorted(self.left))}", "a plain scene without")

    def refused(self, what: str, accepted: str) -> ValueError:
        return ValueError(f"{self.scene.path}: {self}: {what}; accepted: {accepted}")

    def colour(self, name: str, default: float | None) -> Colour:
        """Three finite numbers of at least 0."""
        value = self.take(name, default)
        if isinstance(value, Node):
            raise self.refused(f"{name} is a {value.type}", "a colour")
        uniform = re.fullmatch(r"Properties\.Spectrum\[uniform=([^\]]+)\]", str(value))
        try:
            r, g, b = (float(x) for x in np.broadcast_to(np.array(uniform[1] if uniform else value, float), 3))
        except (TypeError, ValueError):
            r = g = b = math.nan
        if not all(0 <= x < math.inf for x in (r, g, b)):
            raise self.refused(f"{name} = {value}", "an RGB colour of finite numbers, at least 0")
        return r, g, b

    def transform(self, name: str = "to_world") -> NDArray[np.float64]:
        """4 × 4, affine, of positive determinant."""
        value = self.take(name)
        matrix = np.eye(4) if value is None else np.array(value.matrix, float)
        affine = np.isfinite(matrix).all() and (matrix[3] == [0, 0, 0, 1]).all()
        if not affine or not np.linalg.det(matrix[:3, :3]) > 0:
            raise self.refused(f"{name} mirrors or flattens", "a transform that keeps left and right")
        return matrix


class Reader:
    """A parsed scene file."""

    def __init__(self, path: Path, defines: Mapping[str, str]) -> None:
        self.path, config = path, mi.parser.ParserConfig("scalar_rgb")
        config.merge_equivalent = config.merge_meshes = config.parallel = False
        try:
            self.state = mi.parser.parse_file(config, str(path), **defines)
            mi.parser.transform_all(config, self.state)
        except Exception as error:
            message = re.sub(r"\[\w+\.(cpp|h):\d+\] ", "", one_line(str(error)))
            raise ValueError(message if str(path) in message else f"{path}: {message}") from None

    def node(self, index: int) -> Node:
        return Node(self, self.state.nodes[index])

    def beside(self, name: str) -> Path:
        """A file named in the scene."""
        return self.path.parent / name

"""Nested media: the layers of `scenes/mirage.xml` and `scenes/fibre.xml`, and the exact path of a ray through them.

Every solid lies inside the one before it, so each boundary separates two absolute indices. The layers cannot be much
thinner: after each boundary Mitsuba moves a ray along the normal by OFFSET (1 + max |p|), and would skip thinner ones.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass

import numpy as np

from validation.run.context import SCENES

OFFSET = 1500 * 2.0**-24  # Mitsuba's RayEpsilon in float32


@dataclass(frozen=True)
class Layers:
    """Media 0 (outermost) to N: medium k has `indices[k]` and lies between the boundaries k − 1 and k.

    A boundary is the plane y = `boundaries[k]`, or, where `round`, the cylinder of that radius around the z axis.
    `axis`: the coordinate along which light travels, toward `end`, where paths are cut off. Lengths in scene units.
    """

    scene: str
    indices: tuple[float, ...]
    boundaries: tuple[float, ...]
    round: bool
    axis: int
    end: float

    def normal(self, p: np.ndarray) -> np.ndarray:
        """Of the boundary at `p`, outward."""
        return np.array([p[0], p[1], 0.0]) / math.hypot(p[0], p[1]) if self.round else np.array([0.0, 1.0, 0.0])

    def distance(self, p: np.ndarray, d: np.ndarray, boundary: int, inward: bool) -> float:
        """From `p` along `d` to a boundary, met from outside where `inward`; infinite where there is none."""
        if not 0 <= boundary < len(self.boundaries):
            return math.inf
        if not self.round:
            return (self.boundaries[boundary] - p[1]) / d[1] if inward == (d[1] < 0) else math.inf
        a, b = d[:2] @ d[:2], p[:2] @ d[:2]
        # b² − a c by Lagrange's identity: what is left is no difference of large terms.
        root2 = a * self.boundaries[boundary] ** 2 - (p[0] * d[1] - p[1] * d[0]) ** 2
        if root2 < 0 or (inward and b >= 0):
            return math.inf
        return float((-b - math.sqrt(root2)) / a if inward else (-b + math.sqrt(root2)) / a)


@dataclass(frozen=True)
class Path:
    """Straight segments from `starts` to `ends` (M × 3) in the media `media`, and their unit `directions`."""

    starts: np.ndarray
    ends: np.ndarray
    directions: np.ndarray
    media: tuple[int, ...]

    def segments(self) -> np.ndarray:
        """Starts, directions and ends, M × 3 × 3."""
        return np.stack([self.starts, self.directions, self.ends], 1)

    def cosines(self, layers: Layers) -> np.ndarray:
        """|d · n| of every segment, n the normal where it starts."""
        return np.abs([d @ layers.normal(p) for p, d in zip(self.starts, self.directions, strict=True)])

    def at(self, layers: Layers, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(segments, points) where the coordinate along the axis has the values `along`."""
        axis = layers.axis
        forward = math.copysign(1.0, self.directions[0, axis])
        segment = np.searchsorted(forward * self.ends[:-1, axis], forward * along)
        distance = (along - self.starts[segment, axis]) / self.directions[segment, axis]
        return segment, self.starts[segment] + distance[:, None] * self.directions[segment]


def exact_path(layers: Layers, p: np.ndarray, d: np.ndarray, medium: int, offset: float = OFFSET) -> Path:
    """The path of a ray that starts at `p` in `medium`, toward `d`: straight, and by Snell's law at each boundary.

    With P = n d the tangential part of P is conserved and P_n² changes by n'² − n² = (n' − n)(n' + n); where that
    would make it negative, P_n is reversed. In double precision: c = P_n/n is right to 2⁻⁵² n/P_n. Mitsuba's ray
    offset is part of the path, unless `offset` = 0.
    """
    p, momentum = np.array(p, float), np.array(d, float)
    momentum *= layers.indices[medium] / np.linalg.norm(momentum)
    starts, ends, media = [], [], []
    while True:
        direction = momentum / np.linalg.norm(momentum)
        inner, outer = (layers.distance(p, direction, medium - out, not out) for out in (0, 1))
        last = (layers.end - p[layers.axis]) / direction[layers.axis]
        length = min(inner, outer, last)
        starts.append(p)
        ends.append(p + length * direction)
        media.append(medium)
        if length == last:
            break
        p, beyond = ends[-1], medium + 1 if inner < outer else medium - 1
        normal = layers.normal(p)
        along = float(momentum @ normal)
        n, n_beyond = layers.indices[medium], layers.indices[beyond]
        square = along * along + (n_beyond - n) * (n_beyond + n)
        after = math.copysign(math.sqrt(square), along) if square >= 0 else -along
        momentum, medium = momentum + (after - along) * normal, beyond if square >= 0 else medium
        p = p + normal * math.copysign(offset * (1 + np.abs(p).max()), after)
    points = np.array(starts), np.array(ends)
    return Path(*points, (points[1] - points[0]) / np.linalg.norm(points[1] - points[0], axis=1)[:, None], tuple(media))


# The scenes ----------------------------------------------------------------------------------------------------

POOL = 100.0  # half the length of the warm air
STEP = 0.02  # by which a solid is smaller than the one around it, where no light passes


def _read(scene: str) -> Layers:
    """The layers that a scene file holds: BSDFs to_1, to_2, …, and boxes layer_i from the top, or cylinders shell_i."""
    root = ET.parse(SCENES / f"{scene}.xml").getroot()

    def values(path: str, name: str = "value") -> list[float]:
        """Of every element within those of the layers, by its path from the root."""
        named = [x for x in root.iterfind(path.partition("/")[0]) if (x.get("id") or "").startswith(prefixes)]
        return [float(y.attrib[name]) for x in named for y in x.iterfind(path.partition("/")[2])]

    prefixes = ("to_", "layer_", "shell_")
    indices = (values("bsdf/*[@name='ext_ior']")[0], *values("bsdf/*[@name='int_ior']"))
    if radii := values("shape/float[@name='radius']"):
        (first, *_) = root.iterfind("shape/point[@name='p1']")
        return Layers(scene, indices, tuple(radii), True, 2, round(1 - float(first.attrib["value"].split(",")[2]), 3))
    heights = zip(values("shape/*/translate", "y"), values("shape/*/scale", "y"), strict=True)
    return Layers(
        scene, indices, tuple(round(y + half, 4) for y, half in heights), False, 0, POOL - STEP * len(indices)
    )


LAYERS = {scene: _read(scene) for scene in ("mirage", "fibre")}
MIRAGE, FIBRE = LAYERS.values()

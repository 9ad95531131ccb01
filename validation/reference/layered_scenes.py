"""Nested media: the layers of `scenes/mirage.xml` and `scenes/fibre.xml`, and the exact path of a ray through them.

`python -m validation.reference.layered_scenes` writes the layers into both scene files, between two marker comments.
Every solid lies inside the one before it, so each boundary separates two absolute indices. The layers cannot be much
thinner: after each boundary Mitsuba moves a ray along the normal by OFFSET (1 + max |p|), and would skip thinner ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mi_refract.io.atomic import update_between
from validation.run.context import SCENES

OFFSET = 1500 * 2.0**-24  # Mitsuba's RayEpsilon in float32
MARKER = "layers"


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


# The mirage ----------------------------------------------------------------------------------------------------

AIR = 1.000277
POOL = 100.0  # half the length of the warm air
STEP = 0.02  # by which a solid is smaller than the one around it, where no light passes


def _mirage() -> Layers:
    """32 layers, each 1.11 ray offsets thick; the first step of the index 1e-7, the sum of all 5.2e-5."""
    drops = np.cumsum(1e-7 * 1.145 ** np.arange(32))
    thickness = round(OFFSET * (1 + POOL) / 0.9, 4)
    indices = (AIR, *(round(AIR - float(drop), 10) for drop in drops))
    boundaries = tuple(round(-thickness * j, 4) for j in range(len(drops)))
    return Layers("mirage", indices, boundaries, False, 0, POOL - STEP * (len(drops) + 1))


def _fibre() -> Layers:
    """16 shells of equal thickness, n² falling by (r/R)² from 1.53² on the axis to 1.4585² at R = 8; in air."""
    count, radius, core, clad = 16, 8.0, 1.53, 1.4585
    radii = radius * (1 - np.arange(count) / count)
    middle2 = (radii**2 + np.append(radii[1:], 0) ** 2) / 2 / radius**2
    indices = (AIR, *(round(math.sqrt(core**2 - (core**2 - clad**2) * float(x)), 6) for x in middle2))
    # Half the pitch of the smooth profile: light from a point at one end is gathered at the other.
    length = math.pi * radius / math.sqrt(1 - (clad / core) ** 2)
    return Layers("fibre", indices, tuple(round(float(r), 6) for r in radii), True, 2, -round(length / 2 - 1, 3))


MIRAGE, FIBRE = _mirage(), _fibre()
LAYERS = {layers.scene: layers for layers in (MIRAGE, FIBRE)}


def block(layers: Layers) -> str:
    """The XML of all media but the outermost, from the outside in."""
    shapes = _rods if layers.round else _boxes
    media = [_medium(k, *layers.indices[k - 1 : k + 1]) + shapes(layers, k) for k in range(1, len(layers.indices))]
    return "\n".join(media)


def _medium(k: int, ext: float, int_: float) -> str:
    return (
        f'    <bsdf type="$bsdf" id="to_{k}">\n'
        f'        <float name="int_ior" value="{int_!r}"/>\n'
        f'        <float name="ext_ior" value="{ext!r}"/>\n'
        "    </bsdf>\n"
    )


def _boxes(layers: Layers, k: int) -> str:
    """Down to below the road: the lower faces are never seen."""
    top, bottom = layers.boundaries[k - 1], layers.boundaries[-1] - 1 + STEP * k
    inset = STEP * (k - 1)
    scale = f'x="{POOL - inset:.2f}" y="{(top - bottom) / 2:.5f}" z="{6 - inset:.2f}"'
    moves = [f"<scale {scale}/>", f'<translate y="{(top + bottom) / 2:.5f}"/>']
    return _shape("cube", f"layer_{k}", k, _transform(*moves))


def _rods(layers: Layers, k: int) -> str:
    """A cylinder with both its ends."""
    radius, half = layers.boundaries[k - 1], 1 - layers.end - STEP * (k - 1)
    lines = [f'<point name="p{i}" value="0, 0, {z:.3f}"/>' for i, z in enumerate((-half, half))]
    lines.append(f'<float name="radius" value="{radius}"/>')
    parts = [_shape("cylinder", f"shell_{k}", k, "".join(f"        {line}\n" for line in lines))]
    for name, turn in (("near", 0), ("far", 180)):
        moves = [f'<scale value="{radius}"/>', f'<translate z="{half:.3f}"/>', f'<rotate y="1" angle="{turn}"/>']
        parts.append(_shape("disk", f"{name}_{k}", k, _transform(*moves)))
    return "".join(parts)


def _transform(*moves: str) -> str:
    lines = "".join(f"            {move}\n" for move in moves)
    return f'        <transform name="to_world">\n{lines}        </transform>\n'


def _shape(kind: str, name: str, k: int, text: str) -> str:
    return f'    <shape type="{kind}" id="{name}">\n{text}        <ref id="to_{k}"/>\n    </shape>\n'


if __name__ == "__main__":
    for layers in LAYERS.values():
        update_between(SCENES / f"{layers.scene}.xml", MARKER, block(layers))

"""A ray through centred spherical surfaces in 80 decimals, and how errors on the way move its crossing of the axis.

The lens is what the given floats say, exactly. A trace in floating point differs from it by rounding alone: its points
slide along the ray and are off by an ulp, its directions turn, its surfaces are bent a little otherwise. Each of these
is put into the exact trace, alone and very small, and the way that the crossing moves is its weight in the bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, localcontext

import numpy as np

DIGITS, TINY = 80, Decimal("1e-40")  # what is of second order is lost in the digits that do not count
KINDS = "turn", "slide", "height", "depth", "bend"


@dataclass(frozen=True)
class Lens:
    """Spherical surfaces around the axis: `curvatures` (M), `thicknesses` between them (M − 1), the first vertex at 0.

    A curvature is positive where the centre lies toward +z, as everywhere in lens design. None of them is 0.
    """

    curvatures: tuple[float, ...]
    thicknesses: tuple[float, ...]

    @property
    def vertices(self) -> list[float]:
        """Places of the surfaces on the axis."""
        return [sum(self.thicknesses[:i]) for i in range(len(self.curvatures))]


ACHROMAT = Lens((0.02154, -0.02322, -0.00199), (6.0, 2.5))  # of `scenes/planar/achromat.toml`
START = -20.0  # where its rays begin


@dataclass(frozen=True)
class Meeting:
    """A ray that meets a surface: its height y, the sine of the ray before it and of the normal, all of them signed."""

    y: float
    sine: float
    normal: float


@dataclass(frozen=True)
class Crossing:
    """Where a ray crosses the axis, from the first vertex; what it met; |∂crossing/∂error| by kind and surface."""

    place: Decimal
    meetings: tuple[Meeting, ...]
    moves: dict[str, tuple[float, ...]]


def crossing(lens: Lens, indices: Sequence[float], height: float, start: float) -> Crossing:
    """The crossing of a ray from z = `start` along the axis at `height`; `indices`: before each surface, and last."""
    with localcontext() as context:
        context.prec = DIGITS
        place, meetings = _traced(lens, indices, height, start)
        moves = {
            kind: tuple(
                float(abs(_traced(lens, indices, height, start, (kind, i))[0] - place) / TINY)
                for i in range(len(lens.curvatures))
            )
            for kind in KINDS
        }
        return Crossing(place, tuple(Meeting(*map(float, each)) for each in meetings), moves)


@dataclass(frozen=True)
class Rounding:
    """How far a way to trace may round, in u. `sine`, `normal`: of a direction, times these of the ray and the normal.

    `turn`: of a direction, whatever it is. `bend`: of each curvature, relative. `height`: of a height, relative.
    `depth`: of a place along the axis, over the farthest one; where points are computed from the `centres` of the
    spheres, over radius and centre.
    """

    sine: float
    normal: float
    turn: float
    bend: Sequence[float]
    height: float = 2.0
    depth: float = 2.0
    centres: bool = False


def bound(lens: Lens, exact: Crossing, rounding: Rounding, u: float) -> float:
    """The bound of a crossing: each error at its worst, times how far it moves the crossing, and the last formula.

    A distance to a sphere is off by 8u of what it is computed from, up to the radius.
    """
    total = 4.0 * abs(float(exact.place))
    for i, (met, curvature) in enumerate(zip(exact.meetings, lens.curvatures, strict=True)):
        reach, radius = max(-START, *lens.vertices), 1 / abs(curvature)
        worst = {
            "turn": rounding.turn + rounding.sine * abs(met.sine) + rounding.normal * abs(met.normal),
            "slide": 8 * max(radius, reach),
            "height": rounding.height * abs(met.y),
            "depth": rounding.depth * (radius + abs(lens.vertices[i] + 1 / curvature) if rounding.centres else reach),
            "bend": rounding.bend[i],
        }
        total += sum(exact.moves[kind][i] * size for kind, size in worst.items())
    return total * u


def on_axis(rays: np.ndarray) -> np.ndarray:
    """z where rays [z, y, dz, dy] (N, 4) cross the axis."""
    z, y, dz, dy = rays.T
    return np.asarray(z - y * dz / dy)


def _traced(
    lens: Lens, indices: Sequence[float], height: float, start: float, error: tuple[str, int] = ("", 0)
) -> tuple[Decimal, list[tuple[Decimal, Decimal, Decimal]]]:
    """The crossing, and at each surface y, the ray's sine and the normal's; with TINY of one error at one surface."""
    y, z, dy, dz = Decimal(height), Decimal(start), Decimal(0), Decimal(1)
    vertex, meetings = Decimal(0), []
    for i, curvature in enumerate(lens.curvatures):
        off = {kind: TINY if (kind, i) == error else Decimal(0) for kind in KINDS}
        radius = 1 / (Decimal(curvature) * (1 + off["bend"]))
        centre = vertex + radius
        # |(y, z) + t d − centre| = |radius|, at the vertex's side of the sphere.
        along = (centre - z) * dz - y * dy
        beside = y * dy * (-2) * (z - centre) * dz + y * y * dz * dz + (z - centre) ** 2 * dy * dy
        half = (radius * radius - beside).sqrt()
        t = along - half.copy_sign(radius) + off["slide"]
        y, z = y + t * dy + off["height"], z + t * dz + off["depth"]
        ny, nz = y / radius, (z - centre) / radius  # toward −z, of length 1
        meetings.append((y, dy, ny))
        k = Decimal(indices[i]) / Decimal(indices[i + 1])
        cosine = -(dy * ny + dz * nz)
        turned = k * cosine - (1 - k * k * (1 - cosine * cosine)).sqrt()
        dy, dz = k * dy + turned * ny, k * dz + turned * nz
        dy, dz = dy + off["turn"] * dz, dz - off["turn"] * dy
        if i < len(lens.thicknesses):
            vertex += Decimal(lens.thicknesses[i])
    return z - y * dz / dy, meetings

"""A ray through centred spherical surfaces in 80 decimals, and the effect of errors on its crossing of the axis.

The floats of the lens are taken as exact. A trace in floating point differs by rounding errors only: points slide along
the ray and err by an ulp, directions rotate, curvatures change. Each of these errors is added to the exact trace, alone
and very small; the shift of the crossing is the error's weight in the bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, localcontext

import numpy as np

DIGITS, TINY = 80, Decimal("1e-40")  # second-order effects of TINY are below the last digits
KINDS = "turn", "slide", "height", "depth", "bend"


@dataclass(frozen=True)
class Lens:
    """Spherical surfaces around the axis: `curvatures` (M), `thicknesses` between them (M − 1), the first vertex at 0.

    A curvature is positive if the centre lies toward +z, as usual in lens design. No curvature is 0.
    """

    curvatures: tuple[float, ...]
    thicknesses: tuple[float, ...]

    @property
    def vertices(self) -> list[float]:
        """The positions of the surfaces on the axis."""
        return [sum(self.thicknesses[:i]) for i in range(len(self.curvatures))]


ACHROMAT = Lens((0.02154, -0.02322, -0.00199), (6.0, 2.5))  # of `scenes/planar/achromat.toml`
START = -20.0  # z of the rays' origins


@dataclass(frozen=True)
class Meeting:
    """A hit of the ray on a surface: height y, sines of the ray before the surface and of the normal, all signed."""

    y: float
    sine: float
    normal: float


@dataclass(frozen=True)
class Crossing:
    """Where a ray crosses the axis, from the first vertex; its hits; |∂crossing/∂error| by kind and surface."""

    place: Decimal
    meetings: tuple[Meeting, ...]
    moves: dict[str, tuple[float, ...]]


def crossing(lens: Lens, indices: Sequence[float], height: float, start: float) -> Crossing:
    """Return the crossing of a ray from z = `start` along the axis at `height`.

    `indices`: of the medium before each surface, and of the last medium.
    """
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
        return Crossing(place, tuple(Meeting(*map(float, values)) for values in meetings), moves)


@dataclass(frozen=True)
class Rounding:
    """Rounding errors of a tracer, in u.

    The error of a direction is `turn`, plus `sine` and `normal` times the sines of the ray and the normal. `bend`:
    relative errors of the curvatures. `height`: relative error of a height. `depth`: error of a position along the
    axis, over the farthest one; if points are computed from the `centres` of the spheres, over radius plus centre.
    """

    sine: float
    normal: float
    turn: float
    bend: Sequence[float]
    height: float = 2.0
    depth: float = 2.0
    centres: bool = False


def bound(lens: Lens, exact: Crossing, rounding: Rounding, u: float) -> float:
    """Return the bound on a crossing's error: the sum of each worst error times its effect, and of the last formula.

    The error of a distance to a sphere is 8u of the numbers that it is computed from, up to the radius.
    """
    total = 4.0 * abs(float(exact.place))
    for i, (hit, curvature) in enumerate(zip(exact.meetings, lens.curvatures, strict=True)):
        reach, radius = max(-START, *lens.vertices), 1 / abs(curvature)
        worst = {
            "turn": rounding.turn + rounding.sine * abs(hit.sine) + rounding.normal * abs(hit.normal),
            "slide": 8 * max(radius, reach),
            "height": rounding.height * abs(hit.y),
            "depth": rounding.depth * (radius + abs(lens.vertices[i] + 1 / curvature) if rounding.centres else reach),
            "bend": rounding.bend[i],
        }
        total += sum(exact.moves[kind][i] * size for kind, size in worst.items())
    return total * u


def on_axis(rays: np.ndarray) -> np.ndarray:
    """Return z where rays [z, y, dz, dy] (N, 4) cross the axis; infinite or NaN for a ray that does not."""
    z, y, dz, dy = rays.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(z - y * dz / dy)


def _traced(
    lens: Lens, indices: Sequence[float], height: float, start: float, error: tuple[str, int] = ("", 0)
) -> tuple[Decimal, list[tuple[Decimal, Decimal, Decimal]]]:
    """Return the crossing, and y and the sines of ray and normal at each surface, with one error of size TINY."""
    y, z, dy, dz = Decimal(height), Decimal(start), Decimal(0), Decimal(1)
    vertex, meetings = Decimal(0), []
    for i, curvature in enumerate(lens.curvatures):
        errors = {kind: TINY if (kind, i) == error else Decimal(0) for kind in KINDS}
        radius = 1 / (Decimal(curvature) * (1 + errors["bend"]))
        centre = vertex + radius
        # |(y, z) + t d − centre| = |radius|, on the vertex's side of the sphere.
        middle = (centre - z) * dz - y * dy
        distance2 = y * dy * (-2) * (z - centre) * dz + y * y * dz * dz + (z - centre) ** 2 * dy * dy
        half = (radius * radius - distance2).sqrt()
        t = middle - half.copy_sign(radius) + errors["slide"]
        y, z = y + t * dy + errors["height"], z + t * dz + errors["depth"]
        ny, nz = y / radius, (z - centre) / radius  # toward −z, of length 1
        meetings.append((y, dy, ny))
        k = Decimal(indices[i]) / Decimal(indices[i + 1])
        cosine = -(dy * ny + dz * nz)
        factor = k * cosine - (1 - k * k * (1 - cosine * cosine)).sqrt()
        dy, dz = k * dy + factor * ny, k * dz + factor * nz
        dy, dz = dy + errors["turn"] * dz, dz - errors["turn"] * dy
        if i < len(lens.thicknesses):
            vertex += Decimal(lens.thicknesses[i])
    return z - y * dz / dy, meetings

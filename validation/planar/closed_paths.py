"""Planar, closed answers: paths whose end is known in closed form.

In a box, mirror images unfold a path of total reflections into a straight line; the corners are whole numbers, but no
side is along an axis. An ellipse of eccentricity 1/n focuses rays along its axis into its far focus; rays leave the
glass unrefracted through a circle around that focus. A ball refracts rays from a point at distance R/n from its centre
as if they came from n R. A prism of apex A deviates rays by i + asin(n sin(A − asin(sin i/n))) − A, a drop by
π + 2 asin b − 4 asin(b/n) for its first rainbow.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mi_refract.planar import Event, Paths, Segments, shapes
from mi_refract.planar.curves import Curve
from mi_refract.report.row import Row
from validation import limits
from validation.reference import closed_forms as closed
from validation.reference.planar_retrace import Array, Retraced
from validation.run import seeds
from validation.run.array_settings import Setting, running
from validation.run.context import Context
from validation.run.metrics import ERROR_OVER_BOUND
from validation.study import Study, Task, about

from . import against_retrace
from .against_retrace import Case, budgets, by_setting, judge, unit

TERMS = against_retrace.TERMS | {
    "error": "largest deviation from the closed answer: the distance of a line from the point that it should meet, "
    "over the distance to that point; or |d − exact| of a direction",
    "error / u": "the same in units of roundoff",
    "box": "total internal reflections in a box of index 1.5, by their number; exact paths from mirror images",
}
NAME = "planar_closed"
SEED = 2032
REFLECTIONS = (20, 200, 2000)
INDEX, FOCAL_LENGTH = 1.5, 9.0


@dataclass(frozen=True)
class Closed:
    """A case whose paths end in unit `directions` (N × 2), or on lines through `point`.

    `reach`: largest distance of the point from the last boundary; errors are divided by it.
    """

    case: Case
    directions: Array | None = None
    point: tuple[float, float] = (0.0, 0.0)
    reach: float = 1.0

    def error(self, paths: Paths) -> Array:
        """Return |d − exact| (N), or the distance of the last line from the point, over `reach`."""
        d = unit(paths.directions)
        if self.directions is not None:
            return np.asarray(np.hypot(*(d - self.directions).T))
        to = np.array(self.point) - self.case.exact.last(paths.points).astype(np.longdouble)
        return np.asarray(np.abs(d[:, 0] * to[:, 1] - d[:, 1] * to[:, 0]) / self.reach)

    @property
    def bound(self) -> Array:
        """The bound of that error, in units of u."""
        point, direction = map(self.case.exact.last, self.case.bounds)
        return direction if self.directions is not None else point / self.reach + direction


def tasks(context: Context) -> list[Task]:
    """Return one task per backend and precision."""
    return by_setting(context, NAME, "planar, closed", "every answer", _setting_rows)


def _setting_rows(context: Context, setting: Setting) -> list[Row]:
    rays = 8 if setting.is_scalar else 500
    return _box_rows(context, setting) + [row(setting, name, make(rays)) for name, make in CLOSED.items()]


def _box_rows(context: Context, setting: Setting) -> list[Row]:
    counts = REFLECTIONS[:2] if context.profile.quick else REFLECTIONS
    return [row(setting, f"box, {count}", box(count, 4 if setting.is_scalar else 16)) for count in counts]


def drawn_rows(context: Context) -> list[Row]:
    """Return the rows of boxes: only their rays are random."""
    return [row for setting in running(context) for row in _box_rows(context, setting)]


def row(setting: Setting, name: str, answer: Closed | Case) -> Row:
    """Return the row of a case against its exact paths, and of `Closed` against the closed answer."""
    case = answer if isinstance(answer, Case) else answer.case
    paths, bounds = case.trace(setting), budgets(setting)
    values = judge(paths, case, setting.roundoff)
    if isinstance(answer, Closed):
        errors = np.nan_to_num(answer.error(paths).astype(float), nan=np.inf) / setting.roundoff
        values |= {"error": float(errors.max() * setting.roundoff), "error / u": float(errors.max())}
        values[ERROR_OVER_BOUND] = max(values[ERROR_OVER_BOUND], float((errors / answer.bound).max()))
        bounds |= {"error / u": limits.SPOT} if name == "ellipse lens" else {}
    replay = {"rays": len(case.origins), "seed": seeds.current(SEED)}
    return Row(NAME, "trace", name, setting.label, values, bounds, replay=replay)


# The box -------------------------------------------------------------------------------------------------------

SIDES = np.array([[6.0, 8.0], [-4.0, 3.0]])  # perpendicular, 10 and 5 long


@seeds.cached
def box(count: int, rays: int) -> Case:
    """Return rays with `count` total internal reflections; origins and directions are exact in float32."""
    corners = np.array([[0, 0], SIDES[0], SIDES.sum(0), SIDES[1]])
    segments = Segments(corners, np.roll(corners, -1, 0), np.full(4, INDEX), np.ones(4))
    rng = np.random.default_rng(seeds.current(SEED))
    # Angles of incidence of 43 to 47° at all four walls, above the critical angle of 41.8°.
    angle = math.atan2(8, 6) + np.deg2rad(45 + rng.uniform(-2, 2, rays) + 90 * rng.integers(0, 4, rays))
    origins = (rng.uniform(0.1, 0.9, (rays, 2)) @ SIDES).astype(np.float32).astype(float)
    directions = np.stack([np.cos(angle), np.sin(angle)], 1).astype(np.float32).astype(float)
    known = unfold(origins, directions, count)
    return Case("box", segments, origins, directions, count, np.zeros(rays, int), known)


def unfold(origins: Array, directions: Array, count: int) -> Retraced:
    """Return the paths by mirror images, in longdouble. In coordinates along SIDES the walls are at whole numbers."""
    size2 = (SIDES**2).sum(1)
    x, v = (np.asarray(a, np.longdouble) @ SIDES.T / size2 for a in (origins, directions))
    # The times at which each ray's line meets the walls of either pair; then all in order.
    walls = np.where(v > 0, 1, 0)[:, None] + np.sign(v)[:, None] * np.arange(count)[None, :, None]
    times = ((walls - x[:, None]) / v[:, None]).reshape(len(x), -1)
    order = np.argsort(times, axis=1)[:, :count]
    axis, wall = order % 2, np.take_along_axis(walls.reshape(len(x), -1), order, 1)
    straight = x[:, None] + v[:, None] * np.take_along_axis(times, order, 1)[..., None]
    folded = np.abs((straight + 1) % 2 - 1)
    flips = np.stack([np.cumsum(axis == i, axis=1) % 2 for i in (0, 1)], 2)
    legs = np.concatenate([v[:, None], v[:, None] * (1 - 2 * flips)], 1) @ SIDES
    # Ids of walls: 0 and 2 along the first side, 1 and 3 along the second; whole numbers fold to 0 and 1.
    hits = np.where(axis == 1, np.where(wall % 2 == 0, 0, 2), np.where(wall % 2 == 0, 3, 1)).astype(np.int32)
    outward = SIDES[axis] / np.sqrt(size2)[axis][..., None] * np.where(wall % 2 == 0, 1, -1)[..., None]
    events = np.full((len(x), count + 1), Event.REFLECTED, np.uint8)
    events[:, -1] = Event.MAX_DEPTH
    return Retraced(
        np.concatenate([np.asarray(origins, np.longdouble)[:, None], folded @ SIDES], 1),
        hits,
        events,
        np.full((len(x), count + 1), np.longdouble(INDEX)),
        legs / np.hypot(legs[..., :1], legs[..., 1:]),
        outward.astype(np.longdouble),
        np.zeros(hits.shape, np.longdouble),
    )


# Lenses and prisms ---------------------------------------------------------------------------------------------


def _case(curve: Curve, index: float, origins: Array, directions: Array, depth: int, reflect: int = 0) -> Case:
    """Return rays to trace through a body of an index in air."""
    return Case("", curve.between(index, 1.0), origins, directions, depth, np.full(len(origins), reflect))


def _along_x(height: Array) -> tuple[Array, Array]:
    return np.stack([np.full(len(height), -10.0), height], 1), np.tile([1.0, 0.0], (len(height), 1))


def _unit_at(angle: Array) -> Array:
    return np.stack([np.cos(angle), np.sin(angle)], 1)


def ellipse_lens(rays: int) -> Closed:
    """Return an elliptic lens of index 3/2, focal length 9 and aperture 3, with rays along its axis."""
    curve = shapes.ellipse_lens(INDEX, FOCAL_LENGTH, thickness=4.0, radius=3.0)
    height = 2.9 * np.linspace(-1, 1, 2 * (rays // 2))
    return Closed(_case(curve, INDEX, *_along_x(height), depth=2), reach=FOCAL_LENGTH)


def ball(rays: int) -> Closed:
    """Return an aplanatic ball of radius 1 with rays to the right from a point 1/n left of its centre.

    The virtual image is n left of the centre.
    """
    angle = np.deg2rad(np.linspace(-50, 50, 2 * (rays // 2)))
    origins = np.tile([-1 / INDEX, 0.0], (len(angle), 1))
    case = _case(shapes.circle(1.0), INDEX, origins, _unit_at(angle), depth=1)
    return Closed(case, point=(-INDEX, 0.0), reach=1 + INDEX)


def rainbow(rays: int) -> Closed:
    """Return a drop of index 4/3 with rays that are reflected once inside."""
    n, b = 4 / 3, 0.98 * np.linspace(-1, 1, 2 * (rays // 2))
    case = _case(shapes.circle(1.0), n, *_along_x(b), depth=3, reflect=2)
    return Closed(case, _unit_at(-closed.deflection(np.arcsin(b.astype(np.longdouble)), n, 1)))


def prism(rays: int) -> Closed:
    """Return a prism of apex 60° with incidence from 32° (nearly total reflection inside) to 85°.

    The minimum of deviation is at 48.6°.
    """
    curve, apex = shapes.prism(60.0, 2.0), closed.HALF_TURN / 3
    i = np.deg2rad(np.linspace(32, 85, rays)).astype(np.longdouble)
    directions = _unit_at(i - apex / 2).astype(float)
    # Through a point on the left side, high enough that all rays leave through the right side.
    origins = 0.75 * curve.vertices[2] + 0.25 * curve.vertices[0] - directions
    exact = _unit_at(i - apex / 2 - closed.deviation(i, apex, INDEX))
    return Closed(_case(curve, INDEX, origins, directions, depth=2), exact)


CLOSED: dict[str, Callable[[int], Closed]] = {
    name: functools.cache(make)
    for name, make in (("ellipse lens", ellipse_lens), ("aplanatic ball", ball), ("rainbow", rainbow), ("prism", prism))
}


STUDY = Study(NAME, "Planar, closed answers", about(__doc__), TERMS, tasks, again=drawn_rows)

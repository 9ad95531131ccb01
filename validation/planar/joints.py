"""Planar, joints and symmetry: rays aimed at joints, vertices, tangents and critical angles.

Random rays practically never come within rounding of such points; rays of symmetric constructions often do. Each ray is
aimed exactly at a point, or 1, 10 or 100 ulps of its direction beside it, and retraced in extended precision. If
rounding decides, either path is right: a path must be that of a ray whose position and direction differ from the given
ray by a few roundings, boundary by boundary, with errors within the rounding bound of `planar`. Of two segments that
share a vertex within rounding, either is right. Other paths are wrong.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from mi_refract.planar import Paths, Segments, Tracer, shapes
from mi_refract.planar.curves import Curve, affine, unit
from mi_refract.report.row import Row
from validation import limits
from validation.reference.planar_retrace import Array, Retraced, retrace
from validation.run.array_settings import Setting
from validation.run.context import Context
from validation.run.metrics import ERROR_OVER_BOUND, WRONG_PATH, WRONG_PATH_FAR
from validation.study import Study, Task, about

from .against_retrace import Case, at_shared_vertex, by_setting
from .against_retrace import unit as of_length_1
from .rounding import ROUNDINGS, growth

TERMS = {
    ERROR_OVER_BOUND: "largest error of any point or last direction, divided by its bound on rounding errors",
    WRONG_PATH: "rays that take another path than in extended precision",
    WRONG_PATH_FAR: "wrong paths that no ray within rounding errors takes",
    "joints": "rays to joints of arcs in circles, ellipses and bends, from inside (up to 4 reflections) and outside",
    "vertices": "rays to corners of polygons and lenses",
    "tangents": "rays that touch a circle, at joints and between them, and rays along a side",
    "critical angles": "rays at the critical angle at sides, at sides between arcs, and at the joints of a circle",
}
NAME = "planar_joints"
ULPS = (0, 1, -1, 10, -10, 100, -100)
TURNS = (0.0, 20.0, 33.3)  # rotations of each figure in degrees: with and without exact coordinates
# Displacements and rotations of a ray, in roundings of its position and direction: each of four boundaries adds some.
BESIDE = (0.0, 0.25, -0.25, 1.0, -1.0, 4.0, -4.0, 16.0, -16.0)
SCALAR_SHARE = 100  # scalar arrays trace one ray in this many
INDEX = 1.25  # the sine of the critical angle is 4/5


def tasks(context: Context) -> list[Task]:
    """Return one task per backend and precision."""
    aims = (TURNS[1:2], ULPS[:3]) if context.profile.quick else (TURNS, ULPS)
    return by_setting(context, NAME, "planar, joints", "every aim", lambda _, s: [row(name, s, *aims) for name in AIMS])


def row(name: str, setting: Setting, turns: tuple[float, ...] = TURNS, ulps: tuple[int, ...] = ULPS) -> Row:
    """Return the row of all figures of a kind, rotated by `turns` degrees, with rays `ulps` beside their aim."""
    ratios, changed = [], 0
    for aimed in (aimed for turn in turns for aimed in AIMS[name](turn)):
        stride = SCALAR_SHARE if setting.is_scalar else 1
        origins: Array = aimed.origins[::stride].astype(setting.precision)
        d: Array = aimed.directions[::stride].astype(setting.precision)
        ulp = np.eye(2, dtype=setting.precision)[np.abs(d).argmin(1)] * np.spacing(np.abs(d).max(1))[:, None]
        directions = np.concatenate([d + steps * ulp for steps in ulps])
        rays = np.tile(origins, (len(ulps), 1)).astype(float), directions.astype(float)
        tracer = Tracer(aimed.segments, backend=setting.backend, precision=setting.name)
        paths = tracer(*rays, aimed.max_depth, reflect=aimed.reflect)
        of_aim = nearest(paths, aimed, rays, setting.roundoff)
        ratios.append(of_aim.min(0))
        changed += int(np.isinf(of_aim[0]).sum())
    ratio = np.concatenate(ratios)
    finite = ratio[np.isfinite(ratio)]
    values = {WRONG_PATH: float(changed), WRONG_PATH_FAR: float(len(ratio) - len(finite))}
    values[ERROR_OVER_BOUND] = float(finite.max(initial=0))
    budgets = {WRONG_PATH_FAR: 0.0, ERROR_OVER_BOUND: limits.GROWN}
    return Row(NAME, "trace", name, setting.label, values, budgets, replay={"rays": len(ratio)})


def nearest(paths: Paths, aimed: Case, rays: tuple[Array, Array], u: float) -> Array:
    """Return the largest error over its bound, K × N: against the ray itself and, if that exceeds 1, rays beside it."""
    p, d = (x.astype(np.longdouble) for x in rays)
    d = of_length_1(d)
    across = np.stack([-d[:, 1], d[:, 0]], 1)
    unit = ROUNDINGS * u * np.stack([np.abs(p).max(1), np.ones(len(p))])[..., None]  # of a position, of a direction
    ratios = np.full((2 * len(BESIDE) ** 2, len(p)), np.inf)
    for k, (grazing, shift, turn) in enumerate(itertools.product((False, True), BESIDE, BESIDE)):
        remaining = np.flatnonzero(ratios[:k].min(0, initial=np.inf) > 1)
        if not len(remaining):
            break
        step = unit[:, remaining] * across[remaining]
        moved = p[remaining] + shift * step[0], d[remaining] + turn * step[1]
        exact = retrace(aimed.segments, *moved, aimed.max_depth, reflect=aimed.reflect | grazing)
        # The bound is that of one rounding of the ray: a ray beside it may differ by more roundings.
        excess = 1 + max(abs(shift), abs(turn))
        ratios[k, remaining] = _ratios(paths, remaining, exact, aimed.segments, u, grazing) / excess
    return ratios


def _ratios(paths: Paths, chosen: Array, exact: Retraced, segments: Segments, u: float, grazing: bool) -> Array:
    """Return the largest error of each chosen path over its bound (N); infinite for another path.

    `grazing`: the first boundary reflects, which is only right for a ray along it: there R = 1.
    """
    with np.errstate(all="ignore"):  # a ray along a boundary has no bound
        points, directions = (u * np.nan_to_num(x, nan=np.inf) for x in growth(exact, segments))
    hits, last = paths.hits[chosen], paths.directions[chosen]
    distance = np.hypot(*(paths.points[chosen] - exact.points).transpose(2, 0, 1)).astype(float)
    ratio = np.where(np.isnan(exact.points[..., 0]), 0, np.nan_to_num(distance / points, nan=np.inf)).max(1)
    chord = np.hypot(*(of_length_1(last) - exact.directions).T).astype(float)
    same = (hits == exact.hits) | at_shared_vertex(hits, exact, segments, points[:, 1:])
    # Rays are not aimed at anything beyond the last boundary: the last event may differ.
    same = same.all(1) & (paths.events[chosen] == exact.events)[:, : hits.shape[1]].all(1)
    cos = np.abs((exact.legs[:, 0] * exact.normals[:, 0]).sum(1))
    same &= (cos <= directions[:, 0]) | (not grazing)
    return np.where(same, np.maximum(ratio, chord / exact.last(directions)), np.inf)


# Aims ----------------------------------------------------------------------------------------------------------


def _case(curve: Curve, origins: Array, directions: Array, depth: int, reflect: int = 0) -> Case:
    """Return rays aimed exactly at points of a body in air."""
    return Case("", curve.between(INDEX, 1.0), origins, directions, depth, np.array(reflect))


def _to_vertices(curves: Sequence[Curve], reflections: int, turn: float) -> Iterator[Case]:
    """Yield rays from points near an outline to each vertex: from inside, with and without reflections, and outside."""
    for curve in (curve.mapped(affine(turn)) for curve in curves):
        middle = curve.vertices.mean(0)
        offsets = curve.outline(5) - middle
        for scale, depth, reflect in ((0.75, reflections, 2**reflections - 1), (0.75, 2, 0), (1.5, 3, 0)):
            origins = np.repeat(middle + scale * offsets, len(curve.vertices), axis=0)
            yield _case(curve, origins, np.tile(curve.vertices, (len(offsets), 1)) - origins, depth, reflect)


def _tangents(turn: float) -> Iterator[Case]:
    points, tangents = (np.array([unit(turn + x + degrees) for degrees in range(0, 360, 30)]) for x in (0, 90))
    tangents, points = np.concatenate([tangents, -tangents]), np.tile(points, (2, 1))
    yield _case(shapes.circle(1.0).mapped(affine(turn)), points - 2 * tangents, tangents, 1)
    curve = shapes.rectangle(2.0, 1.0).mapped(affine(turn))
    sides = np.concatenate([curve.end - curve.start, curve.start - curve.end])
    yield _case(curve, np.concatenate([curve.start, curve.end]) - sides, sides, 1)


def _critical(turn: float) -> Iterator[Case]:
    corners, rotation, heights = [(-1, -1), (1, -1), (1, 1), (-1, 1)], affine(turn), np.linspace(-0.5, 0.75, 11)
    for curve in (shapes.polygon(corners), shapes.polygon(corners, [0, 0, 30, 0])):
        for side in (1.0, -1.0):  # of the normal
            origins = np.stack([np.full(11, 0.25), side * heights], 1) @ rotation.T
            yield _case(curve.mapped(rotation), origins, np.tile([0.6, -0.8 * side], (11, 1)) @ rotation.T, 1)
    circle = shapes.circle(1.0).mapped(rotation)
    directions = np.array([(x * 0.6 - y * s * 0.8, y * 0.6 + x * s * 0.8) for x, y in circle.vertices for s in (1, -1)])
    yield _case(circle, np.repeat(circle.vertices, 2, 0) - 0.5 * directions, directions, 1)


BEND = shapes.polygon([(-3, -1), (0, -1), (1, 0), (0, 1), (-3, 1)], [0, 90, 90, 0, 0])
JOINED = shapes.circle(1.0), shapes.ellipse(1.0, 0.5), BEND
POINTED = shapes.rectangle(2.0, 1.0), shapes.prism(60.0, 1.0), shapes.lens((0.5, -0.5), 0.75, radius=0.5)
AIMS: dict[str, Callable[[float], Iterator[Case]]] = {
    "joints": functools.partial(_to_vertices, JOINED, 4),
    "vertices": functools.partial(_to_vertices, POINTED, 2),
    "tangents": _tangents,
    "critical angles": _critical,
}
STUDY = Study(NAME, "Planar, joints and symmetry", about(__doc__), TERMS, tasks)

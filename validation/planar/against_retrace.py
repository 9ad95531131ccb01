"""Planar: `planar.trace` against an independent retrace, on every scene file.

The retrace computes each path again in extended precision, by other formulas (implicit curves and momenta). A ray whose
path meets other boundaries, or ends in another way, takes a "wrong path". For the other rays every point and the last
direction are compared, and their errors are divided by a bound on rounding errors. Each boundary adds a few roundings
of the largest coordinate so far and of the angle, the rotation of a facet by its rounded ends, and 1/cos behind the
boundary, all propagated to first order (`validation/planar/rounding.py`). The rays are those of the file, in each of
its colours, and random ones near them; the profile `quick` has at most 100 of the file's, in the first colour.
`clutter` means random scenes of bodies of every kind, nested and rotated. The last rows compare the formulas by name.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract.formulas import FORMULAS
from mi_refract.planar import Paths, Segments, Tracer, shapes
from mi_refract.planar.curves import Curve, affine
from mi_refract.planar.scene_file import load
from mi_refract.report.row import Row
from validation import limits
from validation.reference.planar_retrace import Array, Retraced, retrace
from validation.run import seeds
from validation.run.array_settings import Setting, running, settings
from validation.run.context import SCENES, Context
from validation.run.metrics import ERROR_OVER_BOUND, WRONG_PATH, WRONG_PATH_FAR
from validation.study import Study, Task, about

from .rounding import growth, undecided

DIFFERENCE, BOUNDARIES = "difference", "boundaries"
NEAREST, ITS_BOUND = "error nearest its bound", "that bound"
TERMS = {
    DIFFERENCE: "largest distance of a point from the retrace, over the extent of the scene, or |d − exact|",
    ERROR_OVER_BOUND: "largest error of any point or last direction, divided by its bound on rounding errors",
    NEAREST: "the error of the point (over the extent) or direction with the largest ratio of error to bound",
    ITS_BOUND: "the bound of that point or direction",
    WRONG_PATH: "rays that meet other boundaries than they should, or end in another way",
    WRONG_PATH_FAR: "wrong paths that rounding cannot explain: up to the first boundary that differs, their distance "
    "from every vertex exceeds their bound, they touch no curve, and they are not at the critical angle",
    BOUNDARIES: "largest number of boundaries on a path",
}
NAME = "planar"
FOLDER = SCENES / "planar"
SEED = 2031
RAYS = {"quick": 100, "standard": 250, "full": 2000}  # number of random rays around the file's own
SCALAR_RAYS = 2
SIDE, DEPTH = 3, 30  # clutter: bodies in a row, boundaries on a path
CLUTTER = {"standard": (12, 100), "full": (100, 500)}  # number of scenes, and rays in each
SCALAR_CLUTTER = (2, 5)
SPREAD = 1e-2  # of random rays: shifts in units of the extent, rotations in radians
GROWN = {ERROR_OVER_BOUND: limits.GROWN, WRONG_PATH_FAR: 0.0}
TRACE = "trace"  # subject of the rows of `planar.trace` with the default formula
SHOWN = "lens"  # the scene in which formulas are compared


@dataclass(frozen=True)
class Case:
    """Rays to trace through `segments`. `known`: their exact paths, instead of the independent retrace."""

    name: str
    segments: Segments
    origins: Array
    directions: Array
    max_depth: int
    reflect: Array
    known: Retraced | None = None

    @functools.cached_property
    def exact(self) -> Retraced:
        """The exact paths: known, or by the independent retrace."""
        rays = self.segments, self.origins, self.directions, self.max_depth
        return self.known or retrace(*rays, reflect=self.reflect)

    @functools.cached_property
    def bounds(self) -> tuple[Array, Array]:
        """The bounds on errors of points and directions, in units of u."""
        return growth(self.exact, self.segments)

    @property
    def extent(self) -> float:
        """The diagonal of the segments' bounding box."""
        return _extent(self.segments)

    def trace(self, setting: Setting, formula: str | None = None) -> Paths:
        """Return the paths by `planar.trace` in a setting, with the default formula or another one."""
        tracer = Tracer(self.segments, formula=formula, precision=setting.name, backend=setting.backend)
        return tracer(self.origins, self.directions, self.max_depth, reflect=self.reflect)


def _extent(segments: Segments) -> float:
    return float(np.hypot(*np.ptp(np.concatenate([segments.start, segments.end]), axis=0)))


def tasks(context: Context) -> list[Task]:
    """Return one task per backend and precision."""
    return by_setting(context, NAME, "planar", "every scene", setting_rows)


def by_setting(
    context: Context,
    name: str,
    title: str,
    every: str,
    rows: Callable[[Context, Setting], list[Row]],
    timed: bool = False,
) -> list[Task]:
    """Return a task per backend and precision: `rows`, or one row of case `every` with the reason why it cannot run."""

    def run(setting: Setting) -> list[Row]:
        absent = setting.vector is None
        return [Row(name, TRACE, every, setting.label, reason=setting.reason)] if absent else rows(context, setting)

    return [Task(f"{title}: {s.label}", functools.partial(run, s), timed=timed) for s in settings(context)]


def setting_rows(context: Context, setting: Setting) -> list[Row]:
    """Return the rows of every scene in a setting, for every colour or three wavelengths of a file.

    Scalar arrays have one colour.
    """
    rays = SCALAR_RAYS if setting.is_scalar else RAYS[context.profile.name]
    if context.profile.quick:
        return [row([case_of(FOLDER / f"{SHOWN}.toml", rays)], setting)]
    rows = []
    for path in sorted(FOLDER.glob("*.toml")):
        light = load(path).light
        count = len(light)
        colours = {0, count // 2, count - 1} if light.wavelengths else range(count)
        rows.append(row([case_of(path, rays, j) for j in ([None] if setting.is_scalar else sorted(colours))], setting))
    rows.append(row(clutter(*(SCALAR_CLUTTER if setting.is_scalar else CLUTTER[context.profile.name])), setting))
    if setting.precision is np.float32:
        rows += [row([case_of(FOLDER / f"{SHOWN}.toml", rays)], setting, formula) for formula in FORMULAS]
    return rows


def drawn_rows(context: Context) -> list[Row]:
    """Return the rows of every scene file and of a third of the random scenes."""
    rows, (scenes, rays) = [], CLUTTER["standard"]
    for setting in running(context):
        count, random = (SCALAR_RAYS, SCALAR_CLUTTER) if setting.is_scalar else (RAYS["quick"], (scenes // 3, rays))
        rows += [row([case_of(path, count)], setting) for path in sorted(FOLDER.glob("*.toml"))]
        rows.append(row(clutter(*random), setting))
    return rows


def row(cases: list[Case], setting: Setting, formula: str | None = None) -> Row:
    """Return the row of a scene's cases in a setting: sums of the counts, and the worst of the other metrics.

    NaN is kept: it means that all rays of a case took a wrong path.
    """
    name, counts = cases[0].name, (WRONG_PATH, WRONG_PATH_FAR)
    parts = [judge(case.trace(setting, formula), case, setting.roundoff) for case in cases]
    values = {key: float((sum if key in counts else np.max)([part[key] for part in parts])) for key in parts[0]}
    nearest = max(parts, key=lambda part: part[ERROR_OVER_BOUND])
    values |= {key: nearest[key] for key in (NEAREST, ITS_BOUND)}
    replay = {"scene": name, "cases": len(cases), "rays": sum(len(case.origins) for case in cases)}
    # In clutter errors may grow beyond any fixed bound: only their own bound counts.
    bounds = GROWN if name == "clutter" else budgets(setting)
    replay["seed"] = seeds.current(SEED)
    return Row(NAME, formula or TRACE, name, setting.label, values, bounds, replay=replay)


def budgets(setting: Setting) -> dict[str, float]:
    """Return the budgets: bounds on rounding errors, and in float64 also equality with the retrace."""
    exact = {DIFFERENCE: limits.PLANAR_EQUAL, WRONG_PATH: 0.0} if setting.precision is np.float64 else {}
    return GROWN | exact


@seeds.cached
def case_of(path: Path, count: int, colour: int | None = None) -> Case:
    """Return the rays of a scene file in one colour, refracted wherever possible, and `count` random rays around them.

    If the file has branches, the rays are also reflected once. Without a `colour`, the first colour is used with at
    most `count` of the file's rays.
    """
    scene, rng = load(path), np.random.default_rng(seeds.current(SEED))
    segments, total = scene.segments[colour or 0], len(scene.origins)
    own = np.linspace(0, total - 1, min(count, total) if colour is None else total).round().astype(int)
    centres = rng.integers(0, total, count)
    shift, angle = SPREAD * _extent(segments) * rng.uniform(-1, 1, (count, 2)), SPREAD * rng.uniform(-1, 1, count)
    x, y = scene.directions[centres].T
    rotated = np.stack([x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)], 1)
    rays = np.concatenate(
        [np.hstack([scene.origins, scene.directions])[own], np.hstack([scene.origins[centres] + shift, rotated])]
    )
    masks = [0] + [1 << j for j in range(min(2, scene.max_depth))] * bool(scene.branches)
    origins, directions = np.hsplit(np.tile(rays, (len(masks), 1)), 2)
    return Case(path.stem, segments, origins, directions, scene.max_depth, np.repeat(masks, len(rays)))


# Random scenes -------------------------------------------------------------------------------------------------


@seeds.cached
def clutter(scenes: int, rays: int) -> list[Case]:
    """Return random scenes of bodies of every kind, nested and rotated, and rays through them.

    The bodies form a square grid of spacing 1 in air; about half of them contain another body. A third of the rays may
    be reflected at some of their first three boundaries.
    """
    cases = []
    for rng in (np.random.default_rng((seeds.current(SEED), number)) for number in range(scenes)):
        parts: list[tuple[Curve, float, float]] = []
        for position in np.ndindex(SIDE, SIDE):
            size, n, inner = rng.uniform(0.2, 0.45), *rng.uniform(1.1, 2.5, 2)
            rotation = affine(rng.uniform(0, 360))
            parts.append((_outline(rng, size).mapped(rotation, position), n, 1.0))
            if rng.random() < 0.5:
                # Every outline contains a circle of a tenth of its size around its origin.
                parts.append((shapes.circle(0.1 * size).mapped(rotation, position), inner, n))
        names = ("start", "end", "control", "weight")
        start, end, control, weight = (np.concatenate([getattr(c, name) for c, _, _ in parts]) for name in names)
        left, right = (np.concatenate([np.full(len(part[0]), part[side]) for part in parts]) for side in (1, 2))
        angle = rng.uniform(0, 2 * np.pi, rays)
        directions = np.stack([np.cos(angle), np.sin(angle)], 1)
        origins = rng.uniform(-0.3, SIDE - 0.7, (rays, 2)) - 5 * directions
        reflect = rng.integers(0, 8, rays) * (rng.random(rays) < 1 / 3)
        cases.append(
            Case("clutter", Segments(start, end, left, right, control, weight), origins, directions, DEPTH, reflect)
        )
    return cases


def _outline(rng: np.random.Generator, size: float) -> Curve:
    makers = (
        lambda: shapes.circle(size),
        lambda: shapes.ellipse(size, size * rng.uniform(0.3, 1)),
        lambda: shapes.circle(size).faceted(int(rng.integers(5, 40))),
        lambda: shapes.prism(rng.uniform(30, 100), 1.2 * size),
        lambda: shapes.lens((1 / size, -1 / size), 0.5 * size, conic=(-2.0, 0.0), vertex=-size / 4, radius=size / 2),
    )
    return makers[rng.integers(len(makers))]()


# Judged --------------------------------------------------------------------------------------------------------


def judge(paths: Paths, case: Case, u: float, offset: float = 0.0) -> dict[str, float]:
    """Return the metrics of paths against the retrace. u: the roundoff, `offset`: as in `growth`.

    Errors are NaN if all rays took a wrong path.
    """
    exact = case.exact
    points, directions = (u * x for x in (growth(exact, case.segments, offset) if offset else case.bounds))
    distance = np.hypot(*(paths.points - exact.points).transpose(2, 0, 1)).astype(float)
    # A missing point counts as infinitely far: only points that the retrace does not have may be NaN.
    distance = np.where(np.isnan(exact.points[..., 0]), 0, np.nan_to_num(distance, nan=np.inf))
    chord = np.nan_to_num(np.hypot(*(unit(paths.directions) - exact.directions).T).astype(float), nan=np.inf)
    ends = exact.last(directions)
    ratios = np.column_stack([distance / points, chord / ends])
    ratio = np.nanmax(ratios, axis=1)
    same = paths.hits == exact.hits
    # At a shared vertex either of two segments is right, if the rest of the path agrees.
    touching = 2.0**-50 * np.abs([case.segments.start, case.segments.end]).max()
    same |= at_shared_vertex(paths.hits, exact, case.segments, touching) & (ratio <= 1)[:, None]
    wrong = ~same.all(1) | (paths.events != exact.events).any(1)
    near = undecided(exact, paths, case.segments, points, directions)
    values = dict.fromkeys([ERROR_OVER_BOUND, NEAREST, ITS_BOUND, DIFFERENCE], float("nan"))
    if not wrong.all():
        pairs = (distance, chord), (points, ends)
        errors, bounds = (np.column_stack([x / case.extent, y])[~wrong] for x, y in pairs)
        at = np.unravel_index(np.nanargmax(errors / bounds), errors.shape)
        values |= {NEAREST: float(errors[at]), ITS_BOUND: float(bounds[at])}
        values |= {ERROR_OVER_BOUND: float(ratio[~wrong].max()), DIFFERENCE: float(errors.max())}
    values |= {WRONG_PATH: float(wrong.sum()), WRONG_PATH_FAR: float((wrong & ~near).sum())}
    return values | {BOUNDARIES: float(exact.met.max())}


def at_shared_vertex(hits: Array, exact: Retraced, segments: Segments, near: Any) -> Array:
    """Return where (N × D) an exact path passes within `near` of a vertex shared by its segment and that of `hits`."""
    ours, theirs = ([np.asarray(x)[ids] for x in (segments.start, segments.end)] for ids in (hits, exact.hits))
    shared = np.zeros(hits.shape, bool)
    for vertex, own in itertools.product(theirs, ours):
        shared |= (vertex == own).all(2) & (np.hypot(*(exact.points[:, 1:] - vertex).transpose(2, 0, 1)) <= near)
    return shared & (hits >= 0) & (exact.hits >= 0)


def unit(d: Any) -> Array:
    """Return directions (N × 2) in extended precision, normalised."""
    d = np.asarray(d, np.longdouble)
    return np.asarray(d / np.hypot(*d.T)[:, None])


STUDY = Study(NAME, "Planar", about(__doc__), TERMS, tasks, again=drawn_rows)

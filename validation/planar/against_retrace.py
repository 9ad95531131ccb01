"""Planar: `planar.trace` against an independent retrace, on every scene file.

The retrace follows each path again in extended precision, by other formulas (implicit curves and momenta). A ray whose
path meets other boundaries, or ends in another way, takes a "wrong path". For the others every point and the last
direction are compared, and their errors divided by a bound on rounding: at each boundary a few roundings of the largest
coordinate so far and of the angle, the turn of a facet by its rounded ends, and 1/cos behind the boundary, all carried
on to first order (`validation/planar/error_growth.py`). Rays are those of the file, in each of its colours, and random
ones near them; the profile `quick` takes at most 100 of the file's, in the first colour.
`clutter` are random scenes of bodies of every kind, nested and turned. At the end the formulas are compared by name.
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
from mi_refract.planar import Paths, Segments, trace
from mi_refract.planar.scene_file import PlanarScene, load
from mi_refract.report.row import Row
from validation import limits
from validation.reference.planar_retrace import Array, Retraced, retrace
from validation.run import seeds
from validation.run.array_settings import Setting, settings
from validation.run.context import SCENES, Context
from validation.run.metrics import ERROR_OVER_BOUND, WRONG_PATH, WRONG_PATH_FAR
from validation.study import Study, Task, about

from . import random_scenes
from .error_growth import growth
from .rounding_ambiguity import undecided

DIFFERENCE, BOUNDARIES = "difference", "boundaries"
NEAREST, ITS_BOUND = "error nearest its bound", "that bound"
TERMS = {
    DIFFERENCE: "largest distance of a point from the retrace, over the extent of the scene, and |d − exact|",
    ERROR_OVER_BOUND: "largest error of any point or last direction over its bound on rounding errors",
    NEAREST: "the error, of a point over the extent or of a direction, that comes nearest to its bound",
    ITS_BOUND: "the bound of that very point or direction: the ratio of the two is the largest of any",
    WRONG_PATH: "rays that meet other boundaries than they should, or end another way",
    WRONG_PATH_FAR: "those of them that rounding cannot explain: they pass every vertex of their boundaries at more "
    "than their bound, touch no curve, and are not at the critical angle",
    BOUNDARIES: "largest number that a ray meets",
}
NAME = "planar"
FOLDER = SCENES / "planar"
SEED = 2031
RAYS = {"quick": 100, "standard": 250, "full": 2000}  # scattered around the file's own
SCALAR_RAYS = 2
CLUTTER = {"standard": (12, 100), "full": (100, 500)}  # scenes, and rays in each
SPREAD = 1e-2  # of the extent, and in radians
GROWN = {ERROR_OVER_BOUND: limits.GROWN, WRONG_PATH_FAR: 0.0}
TRACE = "trace"  # the subject of its rows: `planar.trace` with the default formula
SHOWN = "lens"  # the scene of the formulas


@dataclass(frozen=True)
class Case:
    """Rays to follow through `segments`. `exact`: their paths; `extent`: the diagonal around the segments."""

    name: str
    segments: Segments
    origins: Array
    directions: Array
    max_depth: int
    reflect: Array

    @functools.cached_property
    def exact(self) -> Retraced:
        """The paths by the independent retrace."""
        return retrace(self.segments, self.origins, self.directions, self.max_depth, reflect=self.reflect)

    @functools.cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Of the errors of points and directions, over u."""
        return growth(self.exact, self.segments)

    @property
    def extent(self) -> float:
        """The diagonal around the segments."""
        return _extent(self.segments)

    def trace(self, setting: Setting, formula: str | None = None) -> Paths:
        """The paths by `planar.trace` in a setting, by the default formula or another one."""
        return trace(
            self.segments,
            self.origins,
            self.directions,
            self.max_depth,
            reflect=self.reflect,
            formula=formula,
            precision=np.dtype(setting.precision).name,
            backend=setting.backend,
        )


def tasks(context: Context) -> list[Task]:
    """One task per backend and precision."""
    return by_setting(context, NAME, "planar", "every scene", setting_rows)


def by_setting(
    context: Context,
    name: str,
    title: str,
    every: str,
    rows: Callable[[Context, Setting], list[Row]],
    timed: bool = False,
) -> list[Task]:
    """A task per backend and precision: `rows`, or one row, of the case `every`, that says why it cannot run."""

    def run(setting: Setting) -> list[Row]:
        absent = setting.vector is None
        return [Row(name, TRACE, every, setting.label, reason=setting.reason)] if absent else rows(context, setting)

    return [Task(f"{title}: {s.label}", functools.partial(run, s), timed=timed) for s in settings(context)]


def setting_rows(context: Context, setting: Setting) -> list[Row]:
    """Of every scene in a setting."""
    rays = SCALAR_RAYS if setting.is_scalar else RAYS[context.profile.name]
    if context.profile.quick:
        return [file_row(FOLDER / f"{SHOWN}.toml", setting, rays)]
    follow = file_row if setting.is_scalar else colours_row
    rows = [follow(path, setting, rays) for path in sorted(FOLDER.glob("*.toml"))]
    rows.append(clutter_row(setting, *((2, 5) if setting.is_scalar else CLUTTER[context.profile.name])))
    if setting.precision is np.float32:
        shown = case_of(FOLDER / f"{SHOWN}.toml", rays)
        rows += [row_of(shown, setting, formula) for formula in FORMULAS]
    return rows


def drawn_rows(context: Context) -> list[Row]:
    """Every scene and a third of the random ones, in every compiled setting."""
    rows, (scenes, rays) = [], CLUTTER["standard"]
    for setting in settings(context):
        if setting.vector is not None and not setting.is_scalar:
            rows += [file_row(path, setting, RAYS["quick"]) for path in sorted(FOLDER.glob("*.toml"))]
            rows.append(clutter_row(setting, scenes // 3, rays))
    return rows


def file_row(path: Path, setting: Setting, rays: int) -> Row:
    """At most `rays` rays of a file in its first colour, and as many scattered around them."""
    return row_of(case_of(path, rays), setting)


def colours_row(path: Path, setting: Setting, rays: int) -> Row:
    """Every ray of a file in every colour, or in three of its wavelengths, and `rays` scattered around them."""
    light = load(path).light
    colours = range(len(light)) if not light.wavelengths else sorted({0, len(light) // 2, len(light) - 1})
    cases = [case_of(path, rays, colour) for colour in colours]
    values = together([judge(case.trace(setting), case, setting.roundoff) for case in cases])
    replay = {
        "scene": path.name,
        "rays": sum(len(case.origins) for case in cases),
        "colours": len(cases),
        "seed": seeds.current(SEED),
    }
    return Row(NAME, TRACE, path.stem, setting.label, values, budgets(setting), replay=replay)


def together(parts: list[dict[str, float]]) -> dict[str, float]:
    """Sums of the counts, and the worst of the other metrics; NaN stays: no ray of a part kept to its path."""
    counts = (WRONG_PATH, WRONG_PATH_FAR)
    values = {name: float((sum if name in counts else np.max)([part[name] for part in parts])) for name in parts[0]}
    nearest = max(parts, key=lambda part: part[ERROR_OVER_BOUND])
    return values | {name: nearest[name] for name in (NEAREST, ITS_BOUND)}


def row_of(case: Case, setting: Setting, formula: str | None = None) -> Row:
    """A scene in a setting, by the default formula or another one."""
    values = judge(case.trace(setting, formula), case, setting.roundoff)
    replay = {"scene": f"{case.name}.toml", "rays": len(case.origins), "seed": seeds.current(SEED)}
    return Row(NAME, formula or TRACE, case.name, setting.label, values, budgets(setting), replay=replay)


def budgets(setting: Setting) -> dict[str, float]:
    """In float32 what rounding may have grown to, in float64 equality, too."""
    exact = {DIFFERENCE: limits.PLANAR_EQUAL, WRONG_PATH: 0.0} if setting.precision is np.float64 else {}
    return GROWN | exact


def clutter_row(setting: Setting, scenes: int, rays: int) -> Row:
    """Random scenes: sums of the counts, and the worst of the other metrics."""
    values = together([judge(case.trace(setting), case, setting.roundoff) for case in _clutter(scenes, rays)])
    replay = {"scenes": scenes, "rays": scenes * rays, "seed": seeds.current(SEED)}
    # Among so many bodies errors may grow beyond any fixed bound: their own one counts.
    return Row(NAME, TRACE, "clutter", setting.label, values, GROWN, replay=replay)


@seeds.cached
def _clutter(scenes: int, rays: int) -> list[Case]:
    rngs = [np.random.default_rng((seeds.current(SEED), number)) for number in range(scenes)]
    described = [(random_scenes.bodies(rng), *random_scenes.rays(rng, rays)) for rng in rngs]
    return [Case("clutter", s, o, d, random_scenes.DEPTH, reflect) for s, o, d, reflect in described]


@seeds.cached
def case_of(path: Path, rays: int, colour: int | None = None) -> Case:
    """A colour of a scene file: refracted wherever possible, and reflected once where the file has branches.

    None: the first colour with at most `rays` of the file's rays; else all of them. `rays` are scattered around them.
    """
    scene = load(path)
    origins, directions = rays_of(scene, rays, colour is not None)
    masks = [0] + [1 << j for j in range(min(2, scene.max_depth))] * bool(scene.branches)
    reflect = np.repeat(masks, len(origins))
    origins, directions = (np.tile(x, (len(masks), 1)) for x in (origins, directions))
    return Case(path.stem, scene.segments[colour or 0], origins, directions, scene.max_depth, reflect)


def rays_of(scene: PlanarScene, count: int, every: bool) -> tuple[Array, Array]:
    """All of the file's rays, or at most `count` of them, and `count` scattered around any of them."""
    rng, extent = np.random.default_rng(seeds.current(SEED)), _extent(scene.segments[0])
    most = len(scene.origins) if every else min(count, len(scene.origins))
    own = np.linspace(0, len(scene.origins) - 1, most).round().astype(int)
    chosen = rng.integers(0, len(scene.origins), count)
    shift, turn = SPREAD * extent * rng.uniform(-1, 1, (count, 2)), SPREAD * rng.uniform(-1, 1, count)
    x, y = scene.directions[chosen].T
    turned = np.stack([x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn)], 1)
    origins, directions = (
        np.concatenate(parts)
        for parts in ((scene.origins[own], scene.origins[chosen] + shift), (scene.directions[own], turned))
    )
    return origins, directions


def _extent(segments: Segments) -> float:
    """The diagonal around them."""
    return float(np.hypot(*np.ptp(np.concatenate([segments.start, segments.end]), axis=0)))


def judge(paths: Paths, case: Case, u: float, offset: float = 0.0) -> dict[str, float]:
    """What became of the rays, against the retrace; u: the roundoff, `offset`: as in `growth`.

    NaN where no ray kept to its boundaries.
    """
    exact = case.exact
    points, directions = (u * x for x in (growth(exact, case.segments, offset) if offset else case.bounds))
    off = np.hypot(*(paths.points - exact.points).transpose(2, 0, 1)).astype(float)
    # A point that is missing differs by infinity: only what the retrace does not have may be NaN.
    off = np.where(np.isnan(exact.points[..., 0]), 0, np.nan_to_num(off, nan=np.inf))
    turned = np.nan_to_num(np.hypot(*(unit(paths.directions) - exact.directions).T).astype(float), nan=np.inf)
    ends = exact.last(directions)
    ratio = np.maximum(np.nanmax(off / points, axis=1), turned / ends)
    same = paths.hits == exact.hits
    # Of two segments that share a vertex either is right there, if it does the same to the ray.
    touching = 2.0**-50 * np.abs([case.segments.start, case.segments.end]).max()
    same |= at_shared_vertex(paths.hits, exact, case.segments, touching) & (ratio <= 1)[:, None]
    wrong = ~same.all(1) | (paths.events != exact.events).any(1)
    near = undecided(exact, paths, case.segments, points, directions)
    worst = np.maximum(off.max(1) / case.extent, turned)
    return {
        ERROR_OVER_BOUND: _largest(ratio[~wrong]),
        **_nearest(*(x[~wrong] for x in (off / case.extent, points / case.extent, turned, ends))),
        DIFFERENCE: _largest(worst[~wrong]),
        WRONG_PATH: float(wrong.sum()),
        WRONG_PATH_FAR: float((wrong & ~near).sum()),
        BOUNDARIES: float(exact.met.max()),
    }


def at_shared_vertex(hits: Array, exact: Retraced, segments: Segments, near: Any) -> Array:
    """Where (N × D) an exact path passes, but for `near`, a vertex that its segment and that of `hits` share."""
    ours, theirs = ([np.asarray(x)[ids] for x in (segments.start, segments.end)] for ids in (hits, exact.hits))
    there = np.zeros(hits.shape, bool)
    for vertex, own in itertools.product(theirs, ours):
        there |= (vertex == own).all(2) & (np.hypot(*(exact.points[:, 1:] - vertex).transpose(2, 0, 1)) <= near)
    return there & (hits >= 0) & (exact.hits >= 0)


def _nearest(off: Array, points: Array, turned: Array, ends: Array) -> dict[str, float]:
    """The error nearest to its bound, and that bound: of points (N × D) or of last directions (N)."""
    errors, bounds = np.column_stack([off, turned]), np.column_stack([points, ends])
    if not len(errors):
        return {NEAREST: float("nan"), ITS_BOUND: float("nan")}
    at = np.unravel_index(np.nanargmax(errors / bounds), errors.shape)
    return {NEAREST: float(errors[at]), ITS_BOUND: float(bounds[at])}


def _largest(x: Array) -> float:
    return float(x.max()) if len(x) else float("nan")


def unit(d: Any) -> Array:
    """Directions (N × 2) in extended precision, of length 1."""
    d = np.asarray(d, np.longdouble)
    return d / np.hypot(*d.T)[:, None]


STUDY = Study(NAME, "Planar", about(__doc__), TERMS, tasks, again=drawn_rows)

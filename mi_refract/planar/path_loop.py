"""The loop behind `planar.trace`: from boundary to boundary, by Snell's law at each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.formulas import FORMULAS, fresnel, refract_2d

from .array_backend import Lanes, negated
from .intersect_segments import NOWHERE, Hit, Ray, Straight, cross
from .mesh_acceleration import BACK, Extrusion, SearchState

REFLECT_BITS = 32


class Event(IntEnum):
    """What became of a ray at a boundary, and how its path ended."""

    NONE = 0  # after the end
    REFRACTED = 1
    REFLECTED = 2
    ESCAPED = 3  # no boundary left to meet
    MAX_DEPTH = 4  # `max_depth` boundaries met, and another one ahead
    MEDIUM_MISMATCH = 5  # met a boundary whose near side is not the ray's medium


@dataclass
class PathState:
    """Of a lane: its ray, the index of its medium (NaN: unknown), its share of the power, boundaries met.

    `look`: how far it has been looked for the next one.
    """

    ray: Ray
    index: Any
    power: Any
    depth: Any
    look: SearchState
    active: Any


class Walker:
    """Rays between `boundaries` with media of index (left, right)."""

    def __init__(
        self, to: Lanes, boundaries: Straight, mesh: Extrusion | None, media: Any, formula: str | None
    ) -> None:
        self.to, self.boundaries, self.mesh, self.media = to, boundaries, mesh, to.table(_ratios(media))
        self.refract = _refraction(to, formula)

    def __call__(
        self, origins: Any, directions: Any, index: Any, mirrored: Any, max_depth: int, weights: bool
    ) -> dict[str, Any]:
        """The fields of `planar.Paths`, rows of depths; `index` and `mirrored` may be None."""
        to, count, legs = self.to, len(origins), max_depth + 1
        if self.mesh:
            self.mesh.expect(origins, directions)
        rays = [to.table(x) for x in (origins, directions)]
        others = [None if x is None else to.table(x) for x in (index, mirrored)]
        buffers = {
            "points": to.buffer(to.number, np.nan, (legs, count, 2)),
            "directions": to.buffer(to.number, np.nan, (1, count, 2)),
            "hits": to.buffer(to.signed, -1, (max_depth, count)),
            "events": to.buffer(to.byte, int(Event.NONE), (legs, count)),
        }
        if weights:
            buffers |= {name: to.buffer(to.number, np.nan, (legs, count)) for name in ("indices", "weights")}

        def work(lane: Any, scatter: Callable[..., None]) -> None:
            p, d = (to.gather(table, lane) for table in rays)
            index, bits = (None if table is None else to.gather(table, lane) for table in others)
            scatter("points", 0, p, True)
            walk = self._start(p, d, to.number(dr.nan) if index is None else index)
            scatter("directions", 0, _unit(self._follow(walk, bits, max_depth, scatter, weights).ray.d), True)

        return to.run(count, buffers, work)

    def _start(self, p: Any, d: Any, index: Any) -> PathState:
        to, d = self.to, _unit(d)
        p = self._entered(p, d)
        slack = 4 * to.roundoff * (dr.abs(p.x) + dr.abs(p.y))
        ray = Ray(p, d, to.index(NOWHERE), to.number(0.5), to.number(0.5), to.mask(False), slack)
        return PathState(ray, index, to.number(1), to.index(0), self._look(-BACK), to.mask(True))

    def _entered(self, p: Any, d: Any) -> Any:
        """The origin, or from outside the place where the ray enters a box around all boundaries, half as wide again.

        What is far away is rounded once, here, instead of in every difference from a vertex.
        """
        low, high = (self.to.vector(*corner) for corner in self.boundaries.box)
        inverse = dr.rcp(dr.select(d == 0, 1e-30, d))
        a, b = (low - p) * inverse, (high - p) * inverse
        enter, leave = dr.max(dr.minimum(a, b)), dr.min(dr.maximum(a, b))
        return dr.select((enter > 0) & (enter < leave), dr.fma(d, enter, p), p)

    def _follow(
        self, walk: PathState, mirrored: Any, max_depth: int, scatter: Callable[..., None], weights: bool
    ) -> PathState:
        def step(walk: PathState) -> tuple[PathState]:
            return (self._step(walk, mirrored, max_depth, scatter, weights),)

        return dr.while_loop((walk,), lambda walk: walk.active, step, label="planar")[0]

    def _step(
        self, walk: PathState, mirrored: Any, max_depth: int, scatter: Callable[..., None], weights: bool
    ) -> PathState:
        """One look for the next boundary, and off it if there it is."""
        hit, look, settled = self._nearest(walk.ray, walk.look, walk.active)
        active = walk.active & settled
        some = active & (hit.segment != NOWHERE)
        self._leg(scatter, walk, int(Event.ESCAPED), walk.index, active & negated(some), weights)
        rest = PathState(walk.ray, walk.index, walk.power, walk.depth, look, walk.active & negated(settled))

        def across(walk: PathState, hit: Hit, rest: PathState) -> PathState:
            return self._cross(walk, hit, mirrored, max_depth, scatter, weights)

        def on(walk: PathState, hit: Hit, rest: PathState) -> PathState:
            return rest

        # A branch, since all rays of a beam leave together.
        return dr.if_stmt((walk, hit, rest), some, across, on, label="boundary")

    def _leg(
        self, scatter: Callable[..., None], walk: PathState, event: Any, index: Any, active: Any, weights: bool
    ) -> None:
        """A leg and how it ends."""
        scatter("events", walk.depth, event, active)
        if weights:
            scatter("indices", walk.depth, index, active)
            scatter("weights", walk.depth, walk.power, active)

    def _cross(
        self, walk: PathState, hit: Hit, mirrored: Any, max_depth: int, scatter: Callable[..., None], weights: bool
    ) -> PathState:
        """Off the boundary that is met."""
        to, d, j = self.to, walk.ray.d, walk.depth
        left, right, to_right, to_left = to.gather(self.media, hit.segment)
        near, far = dr.select(hit.to_left, right, left), dr.select(hit.to_left, left, right)
        k = dr.select(hit.to_left, to_left, to_right)
        index = dr.select(dr.isnan(walk.index), near, walk.index)
        p, l = self.boundaries.place(hit)  # noqa: E741 (the document's name)
        b, through = self.refract(d, l, k)
        if mirrored is not None:
            forced = through & (j < REFLECT_BITS) & ((mirrored >> dr.minimum(j, REFLECT_BITS - 1)) & 1 == 1)
            b, through = dr.select(forced, _mirrored(d, l), b), through & negated(forced)
        event = dr.select(through, int(Event.REFRACTED), int(Event.REFLECTED))
        event = dr.select(near == index, event, int(Event.MEDIUM_MISMATCH))
        met = j < max_depth
        self._leg(scatter, walk, dr.select(met, event, int(Event.MAX_DEPTH)), index, True, weights)
        scatter("points", j + 1, p, met)
        scatter("hits", j, hit.segment, met)
        on = met & (near == index)
        ray = Ray(p, dr.select(on, b, d), hit.segment, hit.s, hit.r, hit.to_left == through, to.number(0))
        power = walk.power * _share(d, l, k, through) if weights else walk.power
        return PathState(ray, dr.select(through, far, index), power, j + 1, self._look(0), on)

    def _look(self, gone: float) -> SearchState:
        return SearchState(self.to.number(gone), self.to.index(NOWHERE))

    def _nearest(self, ray: Ray, look: SearchState, active: Any) -> tuple[Hit, SearchState, Any]:
        """The first boundary ahead, if it is certain after this look."""
        start = self.boundaries.start(ray)
        if self.mesh:
            return self.mesh.nearest(self.boundaries, ray, start, look, active)

        def test(i: Any, best: Hit) -> tuple[Any, Hit]:
            return i + 1, self.boundaries.nearer(best, ray, start, i)

        first = self.to.index(0), self.boundaries.none()
        more = lambda i, best: active & (i < self.boundaries.count)  # noqa: E731
        return dr.while_loop(first, more, test, label="boundaries")[1], look, self.to.mask(True)


def _ratios(media: Any) -> Any:
    """The indices on the left and on the right, and k from left to right and back, of the indices before rounding."""
    left, right = media.T
    return np.column_stack([left, right, left / right, right / left])


def _unit(v: Any) -> Any:
    return v * dr.rsqrt(dr.squared_norm(v))


def _mirrored(d: Any, l: Any) -> Any:  # noqa: E741
    c = 2 * cross(l, d)
    return type(d)(d.x + c * l.y, d.y - c * l.x)


def _share(d: Any, l: Any, k: Any, through: Any) -> Any:  # noqa: E741
    """Of the power, what goes the way that is taken."""
    cos_i = dr.minimum(dr.abs(cross(l, d)), 1)
    cos_t, transmitted = fresnel.refracted_cosine(cos_i, k)
    r, t = fresnel.powers(cos_i, cos_t, transmitted, k)
    return dr.select(through, t, r)


def _refraction(to: Lanes, formula: str | None) -> Callable[..., tuple[Any, Any]]:
    """(d, l, k) → (direction, transmitted): the core of document 004, or a formula by name, in the plane z = 0."""
    if formula is None:

        def planar(d: Any, l: Any, k: Any) -> tuple[Any, Any]:  # noqa: E741
            b, transmitted = refract_2d(d, l, k)
            return to.vector(*b), transmitted  # as long as `d`, to u

        return planar
    if formula not in FORMULAS:
        raise ValueError(f"formula = {formula!r}: unknown; accepted: {', '.join(FORMULAS)}")

    def spatial(d: Any, l: Any, k: Any) -> tuple[Any, Any]:  # noqa: E741
        zero = 0 * d.x
        b, transmitted = FORMULAS[formula].unchecked(to.vector3(d.x, d.y, zero), to.vector3(-l.y, l.x, zero), k)
        return _unit(to.vector(b.x, b.y)), transmitted

    return spatial

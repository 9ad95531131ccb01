"""The loop of `planar.trace`: find the next boundary, refract or reflect there by Snell's law, repeat."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.formulas import FORMULAS, fresnel, refract_2d
from mi_refract.numerics import Mask, Number

from .array_backend import ArrayBackend, Index, Scatter, Vector2, negated
from .intersect_segments import NOWHERE, Hit, LineSegments, Ray, cross
from .mesh_acceleration import BACK, MeshAcceleration, SearchState
from .segments import REFLECT_BITS, Array, Event

Refraction = Callable[[Vector2, Vector2, Number], tuple[Vector2, Mask]]  # (d, line, k) → direction, transmitted


@dataclass
class PathState:
    """State of a ray: where it is, the index of its medium (NaN: unknown), shares of the s and p waves, boundaries met.

    search: how far it has been searched for the next boundary.
    """

    ray: Ray
    index: Number
    power: Vector2
    depth: Index
    search: SearchState
    active: Mask


@dataclass(frozen=True)
class Run:
    """What all rays of a call have in common.

    mirrored: per ray, the bits of `reflect`; None for all 0. scatter: writes to the output buffers.
    """

    mirrored: Index | None
    max_depth: Index
    scatter: Scatter
    weights: bool


class PathLoop:
    """Follows rays through `boundaries`; `media`: M × 2, the index on the left and on the right of each."""

    def __init__(
        self,
        arrays: ArrayBackend,
        boundaries: LineSegments,
        mesh: MeshAcceleration | None,
        media: Array,
        formula: str | None,
    ) -> None:
        """`mesh`: what finds the next boundary; None: try all. `formula`: as for `planar.trace`."""
        self.arrays, self.boundaries, self.mesh = arrays, boundaries, mesh
        left, right = media.T
        # With k from left to right and from right to left: ratios in float64, before anything is rounded.
        self.media = arrays.table(np.column_stack([left, right, left / right, right / left]))
        self.refract = _refraction(arrays, formula)

    def __call__(
        self,
        origins: Array,
        directions: Array,
        index: Array | None,
        mirrored: np.ndarray | None,
        max_depth: int,
        weights: bool,
    ) -> dict[str, np.ndarray]:
        """The fields of `planar.Paths`, with the depth as their first axis.

        origins, directions: N × 2. index: N, of the medium in which rays start; None: unknown. mirrored: N, `reflect`.
        """
        arrays, count, legs = self.arrays, len(origins), max_depth + 1
        if self.mesh:
            self.mesh.expect(origins, directions)
        rays = [arrays.table(x) for x in (origins, directions)]
        others = [None if x is None else arrays.table(x) for x in (index, mirrored)]

        def work(lane: Index, scatter: Scatter) -> None:
            p, d = (arrays.gather(table, lane) for table in rays)
            index, bits = (None if table is None else arrays.gather(table, lane) for table in others)
            scatter("points", 0, p, True)
            state = self._start(p, d, arrays.number(dr.nan) if index is None else index)
            deepest = arrays.uniform(arrays.index, max_depth)
            run = Run(bits, deepest, scatter, weights)
            step = lambda state: (self._step(state, run),)  # noqa: E731
            (end,) = dr.while_loop((state,), lambda state: state.active, step, label="planar")
            scatter("directions", 0, _unit(end.ray.d), True)

        buffers = {
            "points": arrays.buffer(arrays.number, np.nan, (legs, count, 2)),
            "directions": arrays.buffer(arrays.number, np.nan, (1, count, 2)),
            "hits": arrays.buffer(arrays.signed, -1, (max_depth, count)),
            "events": arrays.buffer(arrays.byte, int(Event.NONE), (legs, count)),
        }
        if weights:
            buffers["indices"] = arrays.buffer(arrays.number, np.nan, (legs, count))
            buffers["polarised"] = arrays.buffer(arrays.number, np.nan, (legs, count, 2))
        return arrays.run(count, buffers, work)

    def _start(self, p: Vector2, d: Vector2, index: Number) -> PathState:
        arrays, d = self.arrays, _unit(d)
        p = self._box_entry(p, d)
        slack = 4 * arrays.roundoff * (dr.abs(p.x) + dr.abs(p.y))
        half = arrays.number(0.5)
        ray = Ray(p, d, arrays.index(NOWHERE), half, half, arrays.mask(False), slack)
        return PathState(ray, index, arrays.vector(1, 1), arrays.index(0), self._search(-BACK), arrays.mask(True))

    def _box_entry(self, p: Vector2, d: Vector2) -> Vector2:
        """The origin, or where a ray from outside enters the box around all boundaries.

        So a distant origin is rounded once, here, instead of in every difference from a vertex.
        """
        low, high = (self.arrays.uniform(self.arrays.vector, *corner) for corner in self.boundaries.box)
        inverse = dr.rcp(dr.select(d == 0, 1e-30, d))
        a, b = (low - p) * inverse, (high - p) * inverse
        enter, leave = dr.max(dr.minimum(a, b)), dr.min(dr.maximum(a, b))
        return dr.select((enter > 0) & (enter < leave), dr.fma(d, enter, p), p)

    def _step(self, state: PathState, run: Run) -> PathState:
        """Search once for the next boundary, and cross it if it is found."""
        hit, search, settled = self._nearest(state.ray, state.search, state.active)
        active = state.active & settled
        some = active & (hit.segment != NOWHERE)
        self._write_leg(run, state, int(Event.ESCAPED), state.index, active & negated(some))
        rest = PathState(state.ray, state.index, state.power, state.depth, search, state.active & negated(settled))

        across = lambda state, hit, rest: self._cross(state, hit, run)  # noqa: E731
        # A branch, not a select: neighbouring rays mostly find their boundaries in the same step.
        return dr.if_stmt((state, hit, rest), some, across, lambda state, hit, rest: rest, label="boundary")

    def _write_leg(self, run: Run, state: PathState, event: Any, index: Number, active: Mask) -> None:
        """Write a leg and the event at its end."""
        run.scatter("events", state.depth, event, active)
        if run.weights:
            run.scatter("indices", state.depth, index, active)
            run.scatter("polarised", state.depth, state.power, active)

    def _cross(self, state: PathState, hit: Hit, run: Run) -> PathState:
        """The state after the boundary that is met."""
        arrays, d, j = self.arrays, state.ray.d, state.depth
        left, right, to_right, to_left = arrays.gather(self.media, hit.segment)
        near, far = dr.select(hit.to_left, right, left), dr.select(hit.to_left, left, right)
        k = dr.select(hit.to_left, to_left, to_right)
        index = dr.select(dr.isnan(state.index), near, state.index)
        p, line = self.boundaries.place(hit)
        b, through = self.refract(d, line, k)
        if run.mirrored is not None:
            bit = (run.mirrored >> dr.minimum(j, REFLECT_BITS - 1)) & 1
            forced = through & (j < REFLECT_BITS) & (bit == 1)
            b, through = dr.select(forced, _mirrored(d, line), b), through & negated(forced)
        to_left = hit.to_left == through
        # Of a ray along the boundary rounding hides from which side it comes; that was decided by the boundary's ends.
        b = dr.select((cross(line, b) > 0) == to_left, b, _mirrored(b, line))
        event = dr.select(through, int(Event.REFRACTED), int(Event.REFLECTED))
        event = dr.select(near == index, event, int(Event.MEDIUM_MISMATCH))
        met = j < run.max_depth
        self._write_leg(run, state, dr.select(met, event, int(Event.MAX_DEPTH)), index, True)
        run.scatter("points", j + 1, p, met)
        run.scatter("hits", j, hit.segment, met)
        on = met & (near == index)
        ray = Ray(p, dr.select(on, b, d), hit.segment, hit.s, hit.r, to_left, arrays.number(0))
        power = state.power * _shares(d, line, k, through) if run.weights else state.power
        return PathState(ray, dr.select(through, far, index), power, j + 1, self._search(0), on)

    def _search(self, gone: float) -> SearchState:
        return SearchState(self.arrays.number(gone), self.arrays.index(NOWHERE))

    def _nearest(self, ray: Ray, search: SearchState, active: Mask) -> tuple[Hit, SearchState, Mask]:
        """The first boundary ahead, and whether that is settled or the search must go on."""
        start = self.boundaries.start(ray)
        if self.mesh:
            return self.mesh.nearest(self.boundaries, ray, start, search, active)

        def test(i: Index, best: Hit) -> tuple[Index, Hit]:
            return i + 1, self.boundaries.nearer(best, ray, start, i)

        first = self.arrays.index(0), self.boundaries.none()
        more = lambda i, best: active & (i < self.boundaries.count)  # noqa: E731
        return dr.while_loop(first, more, test, label="boundaries")[1], search, self.arrays.mask(True)


def _unit(v: Vector2) -> Vector2:
    return v * dr.rsqrt(dr.squared_norm(v))


def _mirrored(d: Vector2, line: Vector2) -> Vector2:
    c = 2 * cross(line, d)
    return type(d)(d.x + c * line.y, d.y - c * line.x)


def _shares(d: Vector2, line: Vector2, k: Number, through: Mask) -> Vector2:
    """The shares of the s and the p wave that go the way of the ray: Fresnel's T where it goes through, R otherwise.

    In a plane neither wave becomes the other, at any boundary.
    """
    cos_i = dr.minimum(dr.abs(cross(line, d)), 1)
    cos_t, transmitted = fresnel.refracted_cosine(cos_i, k)
    t_s, t_p, _ = fresnel.transmitted_powers(cos_i, cos_t, transmitted, k)
    r_s, r_p = fresnel.amplitudes(cos_i, k)
    return type(d)(
        dr.select(through, t_s, dr.squared_norm(r_s)),
        dr.select(through, t_p, dr.squared_norm(r_p)),
    )


def _refraction(arrays: ArrayBackend, formula: str | None) -> Refraction:
    """The planar formula of document 004, or one of FORMULAS in the plane z = 0. ValueError for an unknown name."""
    if formula is None:

        def planar(d: Vector2, line: Vector2, k: Number) -> tuple[Vector2, Mask]:
            b, transmitted = refract_2d(d, line, k)
            return arrays.vector(*b), transmitted  # of the length of `d`, to u

        return planar
    if formula not in FORMULAS:
        raise ValueError(f"formula = {formula!r}: unknown; expected {', '.join(FORMULAS)}")

    def spatial(d: Vector2, line: Vector2, k: Number) -> tuple[Vector2, Mask]:
        zero = 0 * d.x
        b, transmitted = FORMULAS[formula].unchecked(
            arrays.vector3(d.x, d.y, zero), arrays.vector3(-line.y, line.x, zero), k
        )
        return _unit(arrays.vector(b.x, b.y)), transmitted

    return spatial

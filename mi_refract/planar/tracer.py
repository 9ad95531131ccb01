"""Trace rays in two dimensions: refract or reflect each ray at every boundary that it meets.

Conventions:

- A ray meets a boundary at λ > 0. A ray that starts on a boundary does not meet it there: the ray starts on the side
  of the boundary that its direction points to.
- A ray that passes exactly through a vertex, or runs along a segment, is treated as if it were shifted to its own right
  by an infinitesimal distance. So it crosses exactly one of two segments that share a vertex; at a tip none or both.
- Segments of length zero are ignored. Where several segments share a vertex (a T-junction), a ray crosses those on
  its path one after the other. A vertex in the interior of another segment does not split that segment: two media then
  lie on one side of it, but it has one index there. A ray from the other medium ends there with MEDIUM_MISMATCH.
- A ray starts in the medium on the near side of the first boundary it meets, unless `n_start` says otherwise.

Source: document 004, with its slips corrected ("Errata of the documents" in the documentation).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from mi_refract.formulas import FORMULAS, fresnel, refract_2d
from mi_refract.numerics import Mask, Number

from .array_backend import ArrayBackend, Buffer, Index, Scatter, Vector2, choose_backend, negated
from .intersect import NOWHERE, ConicArcs, Hit, LineSegments, Ray, cross
from .mesh_acceleration import BACK, SHORTEST, MeshAcceleration, SearchState
from .segments import REFLECT_BITS, Event, Paths, Segments, check_range, finite_array

METHODS = "auto", "brute", "mesh"
BRUTE_FORCE_LIMIT = 48  # up to this number of segments, testing all of them is faster than a query of the mesh
LARGEST = {"float32": 1e15, "float64": 1e100}  # coordinate or index: products of two do not overflow


def trace(
    segments: Segments,
    origins: ArrayLike,
    directions: ArrayLike,
    max_depth: int,
    *,
    formula: str | None = None,
    precision: str = "float64",
    backend: str | None = None,
    method: str = "auto",
    reflect: ArrayLike = 0,
    n_start: ArrayLike | None = None,
    weights: bool = False,
) -> Paths:
    """Follow rays from `origins` along `directions` (N × 2, of any length) until they escape.

    max_depth: largest number of boundaries that a ray meets.
    formula: a key of FORMULAS that computes the directions; None: the planar formula of document 004.
    precision: "float64" or "float32"; the latter needs a compiled backend.
    backend: "llvm", "cuda" or "scalar"; None: LLVM where it runs, else scalar.
    method: "brute" tests every segment; "mesh" tests those that Mitsuba's ray tracing finds, at a cost that grows like
        log M. Both give the same paths; "auto" chooses the faster one.
    reflect: bit masks, one number or N. If bit j of a ray is set (j < 32), the ray is reflected at the j-th boundary it
        meets, counted from 0, even where it could be refracted.
    n_start: refractive index of the medium in which rays start, one number or N.
    weights: also compute `Paths.weights` and `Paths.indices`.

    ValueError for any other value, for non-finite origins or directions, and for directions of length 0.
    """
    tracer = Tracer(segments, formula=formula, precision=precision, backend=backend, method=method)
    return tracer(origins, directions, max_depth, reflect=reflect, n_start=n_start, weights=weights)


@dataclass
class PathState:
    """The state of a ray on its path.

    index: of the medium that it is in (NaN: unknown).
    power: its shares of the s and p waves.
    depth: number of boundaries met so far.
    search: progress of the search for the next boundary.
    """

    ray: Ray
    index: Number
    power: Vector2
    depth: Index
    search: SearchState
    active: Mask


class Tracer:
    """`trace` with the segments prepared once for many calls; arguments and errors as for `trace`."""

    def __init__(
        self,
        segments: Segments,
        *,
        formula: str | None = None,
        precision: str = "float64",
        backend: str | None = None,
        method: str = "auto",
    ) -> None:
        """Copy the segments to the backend and prepare the search for the next boundary."""
        self.arrays = arrays = choose_backend(backend, precision)
        largest = LARGEST[precision]
        for name in ("start", "end", "control", "n_left", "n_right"):
            check_range(f"segments.{name}", getattr(segments, name), largest)
        lowest_index = min(segments.n_left.min(), segments.n_right.min())
        if lowest_index < 1 / largest:
            raise ValueError(f"segments: index {lowest_index:g}; expected at least {1 / largest:g}")
        # If |middle| exceeds twice the extent of the boundaries, coordinates are taken relative to their middle: there
        # |x − middle| < |middle|/2, so the differences are exact, and float32 keeps all its digits for them.
        start, end, control = segments.start, segments.end, segments.control
        points = np.concatenate([start, end, control])
        low, high = points.min(axis=0), points.max(axis=0)
        middle = low / 2 + high / 2
        self.middle = middle = np.where(np.abs(middle) > 2 * (high - low).max(), middle, 0.0)
        if middle.any():
            start, end = start - middle, end - middle
            # A straight segment stays straight to the last bit.
            control = np.where(segments.turn[:, None] == 0, (start + end) / 2, control - middle)
            segments = replace(segments, start=start, end=end, control=control)
        self.boundaries = (ConicArcs if segments.turn.any() else LineSegments)(arrays, segments)
        lower, upper = self.boundaries.box
        size = float(np.subtract(upper, lower).max())
        if 0 < size < 1 / largest:
            raise ValueError(f"segments: their box is {size:g} wide; expected {1 / largest:g} or more")
        # For a more distant origin, the rounding of its coordinates would exceed the margin of the box.
        self.farthest_origin = min(largest, size / (12 * arrays.roundoff) or largest)
        self.mesh = _build_mesh(arrays, segments, method)
        left, right = segments.n_left, segments.n_right
        # The last two columns are k = n_before/n_after from left to right and from right to left, computed in float64
        # from the indices before they are rounded.
        self.media = arrays.table(np.column_stack([left, right, left / right, right / left]))
        if formula is not None and formula not in FORMULAS:
            raise ValueError(f"formula = {formula!r}: unknown; expected {', '.join(FORMULAS)}")
        self.formula = formula

    def __call__(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        max_depth: int,
        *,
        reflect: ArrayLike = 0,
        n_start: ArrayLike | None = None,
        weights: bool = False,
    ) -> Paths:
        """The paths of rays from `origins` along `directions` (N × 2)."""
        origins = finite_array("origins", origins, (*(np.shape(origins)[:1] or (0,)), 2))
        vectors = finite_array("directions", directions, origins.shape)
        with np.errstate(over="ignore", under="ignore"):
            length2 = np.einsum("ij,ij->i", vectors, vectors)
        # Scale the directions if their squares could leave float32's range.
        if not (length2.min(initial=1) > 1e-30 and length2.max(initial=1) < 1e30):
            size = np.abs(vectors).max(axis=1)
            if not size.all():
                raise ValueError(f"directions[{int(np.argmin(size))}] = (0, 0); expected a direction")
            vectors = np.ldexp(vectors, 1 - np.frexp(size)[1][:, None])
        count, arrays = len(origins), self.arrays
        if isinstance(max_depth, bool) or not isinstance(max_depth, int | np.integer) or max_depth < 1:
            raise ValueError(f"max_depth = {max_depth!r}; expected a whole number, 1 or more")
        if count * (max_depth + 1) >= 2**32:
            raise ValueError(f"{count} rays, max_depth = {max_depth}; expected a product below 2³²")
        indices = None if n_start is None else arrays.table(_per_ray("n_start", n_start, count, "iuf", float))
        no_reflections = np.ndim(reflect) == 0 and reflect == 0
        masks = None if no_reflections else arrays.table(_per_ray("reflect", reflect, count, "iu", np.uint32))
        relative_origins = origins - self.middle
        check_range("origins, relative to the segments", relative_origins, self.farthest_origin)
        if self.mesh:
            self.mesh.choose_query(relative_origins, vectors)
        origin_table, direction_table = arrays.table(relative_origins), arrays.table(vectors)

        def follow(lane: Index, scatter: Scatter) -> None:
            p, d = arrays.gather(origin_table, lane), arrays.gather(direction_table, lane)
            n = arrays.number(dr.nan) if indices is None else arrays.gather(indices, lane)
            reflect_bits = None if masks is None else arrays.gather(masks, lane)
            scatter("points", 0, p, True)
            state = self._start(p, d, n)
            depth_limit = arrays.uniform(arrays.index, max_depth)

            def step(state: PathState) -> tuple[PathState]:
                return (self._step(state, reflect_bits, depth_limit, scatter, weights),)

            (end,) = dr.while_loop((state,), lambda state: state.active, step, label="planar")
            scatter("directions", 0, _unit(end.ray.d), True)

        buffers: dict[str, Buffer] = {
            "points": (arrays.number, np.nan, (max_depth + 1, count, 2)),
            "directions": (arrays.number, np.nan, (1, count, 2)),
            "hits": (arrays.signed, -1, (max_depth, count)),
            "events": (arrays.byte, int(Event.NONE), (max_depth + 1, count)),
        }
        if weights:
            buffers["indices"] = arrays.number, np.nan, (max_depth + 1, count)
            buffers["polarised"] = arrays.number, np.nan, (max_depth + 1, count, 2)
        fields = arrays.run(count, buffers, follow)
        if self.middle.any():
            fields["points"] = (fields["points"] + self.middle).astype(fields["points"].dtype)
            fields["points"][0] = origins
        last_directions = fields.pop("directions")[0]
        return Paths(directions=last_directions, **{name: np.swapaxes(x, 0, 1) for name, x in fields.items()})

    def _start(self, p: Vector2, d: Vector2, index: Number) -> PathState:
        """The state of a ray at its start.

        A ray from outside the box around all boundaries starts where it enters the box. So a distant origin is rounded
        once, here, instead of in every difference from a vertex.
        """
        arrays, d = self.arrays, _unit(d)
        low, high = (arrays.uniform(arrays.vector, *corner) for corner in self.boundaries.box)
        inverse = dr.rcp(dr.select(d == 0, 1e-30, d))
        a, b = (low - p) * inverse, (high - p) * inverse
        enter, leave = dr.max(dr.minimum(a, b)), dr.min(dr.maximum(a, b))
        p = dr.select((enter > 0) & (enter < leave), dr.fma(d, enter, p), p)
        half, rounding = arrays.number(0.5), arrays.number(4 * arrays.roundoff)
        ray = Ray(p, d, arrays.index(NOWHERE), half, half, arrays.mask(False), rounding)
        return PathState(ray, index, arrays.vector(1, 1), arrays.index(0), self._new_search(-BACK), arrays.mask(True))

    def _new_search(self, distance: float) -> SearchState:
        return SearchState(self.arrays.number(distance), self.arrays.index(NOWHERE))

    def _step(
        self, state: PathState, reflect_bits: Index | None, depth_limit: Index, scatter: Scatter, weights: bool
    ) -> PathState:
        """Search once for the next boundary; cross it if the search finds it, or end the path if there is none."""
        boundaries, ray, start = self.boundaries, state.ray, self.boundaries.start(state.ray)

        def test(i: Index, best: Hit) -> tuple[Index, Hit]:
            return i + 1, boundaries.nearer(best, ray, start, i)

        def untested(i: Index, best: Hit) -> Mask:
            return state.active & (i < boundaries.count)

        if self.mesh:  # one query may not settle which boundary is the first: then the next step continues the search
            hit, search, settled = self.mesh.nearest(boundaries, ray, start, state.search, state.active)
        else:
            hit = dr.while_loop((self.arrays.index(0), boundaries.none()), untested, test, label="boundaries")[1]
            search, settled = state.search, self.arrays.mask(True)
        meets = state.active & settled & (hit.segment != NOWHERE)

        def write_leg(state: PathState, event: Any, index: Number, active: Mask) -> None:
            scatter("events", state.depth, event, active)
            if weights:
                scatter("indices", state.depth, index, active)
                scatter("polarised", state.depth, state.power, active)

        def cross_boundary(state: PathState, hit: Hit, otherwise: PathState) -> PathState:
            arrays, d, j = self.arrays, state.ray.d, state.depth
            left, right, to_right, to_left = arrays.gather(self.media, hit.segment)
            near, far = dr.select(hit.to_left, right, left), dr.select(hit.to_left, left, right)
            k = dr.select(hit.to_left, to_left, to_right)
            index = dr.select(dr.isnan(state.index), near, state.index)
            p, line = self.boundaries.place(hit)
            if self.formula is None:  # the planar one of document 004
                (b_x, b_y), through = refract_2d(d, line, k)
                b = arrays.vector(b_x, b_y)  # of the length of `d`, to u
            else:
                a, n = arrays.vector3(d.x, d.y, 0 * d.x), arrays.vector3(-line.y, line.x, 0 * d.x)
                b, through = FORMULAS[self.formula].unchecked(a, n, k)
                b = _unit(arrays.vector(b.x, b.y))
            # k ≤ 1 reflects nothing totally; rounding does, where k and the sine are nearly 1. There `d` is the
            # refracted direction, within the formula's error.
            passes = (k <= 1) & (cross(line, d) != 0) & negated(through)
            b, through = dr.select(passes, d, b), through | passes
            if reflect_bits is not None:
                bit = (reflect_bits >> dr.minimum(j, REFLECT_BITS - 1)) & 1
                forced = through & (j < REFLECT_BITS) & (bit == 1)
                b, through = dr.select(forced, _mirrored(d, line), b), through & negated(forced)
            to_left = hit.to_left == through
            # For a ray along the boundary, rounding may put `b` on the wrong side; the signs of the boundary's ends
            # decided which side is right.
            b = dr.select((cross(line, b) > 0) == to_left, b, _mirrored(b, line))
            event = dr.select(through, int(Event.REFRACTED), int(Event.REFLECTED))
            event = dr.select(near == index, event, int(Event.MEDIUM_MISMATCH))
            allowed = j < depth_limit
            write_leg(state, dr.select(allowed, event, int(Event.MAX_DEPTH)), index, True)
            scatter("points", j + 1, p, allowed)
            scatter("hits", j, hit.segment, allowed)
            active = allowed & (near == index)
            ray = Ray(p, dr.select(active, b, d), hit.segment, hit.s, hit.r, to_left, arrays.number(0))
            power = state.power * _power_shares(d, line, k, through) if weights else state.power
            return PathState(ray, dr.select(through, far, index), power, j + 1, self._new_search(0), active)

        def keep(state: PathState, hit: Hit, otherwise: PathState) -> PathState:
            return otherwise

        write_leg(state, int(Event.ESCAPED), state.index, state.active & settled & negated(meets))
        otherwise = replace(state, search=search, active=state.active & negated(settled))
        # A branch, not a select: neighbouring rays mostly find their boundaries in the same step.
        return dr.if_stmt((state, hit, otherwise), meets, cross_boundary, keep, label="boundary")


def _unit(v: Vector2) -> Vector2:
    return v * dr.rsqrt(dr.squared_norm(v))


def _mirrored(d: Vector2, line: Vector2) -> Vector2:
    c = 2 * cross(line, d)
    return type(d)(dr.fma(c, line.y, d.x), dr.fma(-c, line.x, d.y))


def _power_shares(d: Vector2, line: Vector2, k: Number, through: Mask) -> Vector2:
    """The shares of the s and p waves that the ray carries on: Fresnel's T where it is refracted, R otherwise."""
    cos_i = dr.minimum(dr.abs(cross(line, d)), 1)
    cos_t, transmitted = fresnel.refracted_cosine(cos_i, k)
    t_s, t_p, _ = fresnel.transmitted_powers(cos_i, cos_t, transmitted, k)
    r_s, r_p = map(dr.squared_norm, fresnel.amplitudes(cos_i, k))
    return type(d)(dr.select(through, t_s, r_s), dr.select(through, t_p, r_p))


def _per_ray(name: str, values: ArrayLike, count: int, kinds: str, dtype: DTypeLike) -> Any:
    """One value per ray, of type `dtype`. ValueError for another shape, kind of number (not in `kinds`) or range."""
    array = np.asarray(values)
    valid = array.dtype.kind in kinds and array.shape in ((), (count,))
    if dtype is np.uint32:
        expected = "a whole number, 0 or more and below 2³²"
        valid = valid and bool(((array >= 0) & (array < 2**32)).all())
    else:
        expected = "a number above 0"
        valid = valid and bool(((array > 0) & np.isfinite(array)).all())
    if not valid:
        raise ValueError(f"{name}; expected {expected}, or {count} of them")
    return np.ascontiguousarray(np.broadcast_to(array.astype(dtype), count))


def _build_mesh(arrays: ArrayBackend, segments: Segments, method: str) -> MeshAcceleration | None:
    """The mesh for `method`, or None to test all segments: if that is faster, requested, or the only way."""
    if method not in METHODS:
        raise ValueError(f"method = {method!r}; expected {', '.join(METHODS)}")
    if method == "brute" or (method == "auto" and len(segments) <= BRUTE_FORCE_LIMIT):
        return None
    length = np.hypot(*(segments.end - segments.start).T)
    if not length.any():  # all segments are ignored
        return None
    extent = np.ptp(np.concatenate([segments.start, segments.end]), axis=0).max()
    shortest = length[length > 0].min(initial=np.inf) / (extent / 2 or 1)
    if segments.turn.any():
        reason = "arcs"
    elif shortest < SHORTEST:
        reason = f"a segment of {shortest:.1e}"
    else:
        mesh = MeshAcceleration(arrays, segments)
        if not mesh.crowded:
            return mesh
        reason = "segments {} and {}".format(*mesh.crowded)
    if method == "mesh":
        limit = f"longer and farther apart than {SHORTEST:.1e} of half the extent"
        raise ValueError(f"method = 'mesh': {reason}; expected straight segments, {limit}")
    return None

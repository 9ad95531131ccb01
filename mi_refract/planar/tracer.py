"""The planar system: rays through boundaries in two dimensions, refracted or reflected at each.

Conventions:

- A boundary is met at λ > 0. A ray that starts on a boundary has not met it: it starts on the side to which it goes.
- A ray that passes exactly through a vertex, or runs along a segment, is treated as if it were shifted to its own right
  by an infinitesimal distance. So it crosses exactly one of two segments that share a vertex; at a tip none or both.
- A segment of length zero is no boundary. Where several segments share a vertex (a T-junction) a ray crosses those on
  its path one after the other. A vertex inside another segment is no junction: two media lie on one side of that
  segment, and a ray that comes from the other one of them ends there with MEDIUM_MISMATCH.
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
FEW = 48  # up to so many segments, trying all is faster than a query of the mesh
FARTHEST = {"float32": 1e15, "float64": 1e100}  # of coordinates and indices: products of two do not overflow


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

    max_depth: the most boundaries that a ray meets.
    formula: a key of FORMULAS that computes the directions; None: the planar formula of document 004.
    precision: "float64" or "float32"; the latter needs a compiled backend.
    backend: "llvm", "cuda" or "scalar"; None: LLVM where it runs, else scalar.
    method: "brute" tries every segment; "mesh" those that Mitsuba's ray tracing finds, at a cost that grows like log M.
        Both give the same paths; "auto" takes the faster one.
    reflect: bits, one number or N: a ray whose bit j is set is reflected at the j-th boundary it meets (from 0, below
        32) also where it could be refracted.
    n_start: refractive index of the medium in which rays start, one number or N.
    weights: also compute `Paths.weights` and `Paths.indices`.

    ValueError for any other value, and for origins or directions that are not finite or directions of length 0.
    """
    tracer = Tracer(segments, formula=formula, precision=precision, backend=backend, method=method)
    return tracer(origins, directions, max_depth, reflect=reflect, n_start=n_start, weights=weights)


@dataclass
class PathState:
    """A ray, the index of its medium (NaN: unknown), its shares of the s and p waves, the number of boundaries met.

    search: how far it has been searched for the next boundary.
    """

    ray: Ray
    index: Number
    power: Vector2
    depth: Index
    search: SearchState
    active: Mask


class Tracer:
    """`trace` for one set of segments that is set up once; arguments and errors as there."""

    def __init__(
        self,
        segments: Segments,
        *,
        formula: str | None = None,
        precision: str = "float64",
        backend: str | None = None,
        method: str = "auto",
    ) -> None:
        """Copy the segments to the backend and build what finds the next boundary."""
        self.arrays = arrays = choose_backend(backend, precision)
        self.farthest = FARTHEST[precision]
        for name in ("start", "end", "control", "n_left", "n_right"):
            check_range(f"segments.{name}", getattr(segments, name), self.farthest)
        if (least := min(segments.n_left.min(), segments.n_right.min())) < 1 / self.farthest:
            raise ValueError(f"segments: the index {least:g}; expected at least {1 / self.farthest:g}")
        # Seen from a new origin in the middle of boundaries whose |middle| exceeds twice their extent: there
        # |x − middle| < |middle|/2, so the differences are exact, and float32 keeps all its digits for them.
        start, end, control = segments.start, segments.end, segments.control
        low, high = (f([f(x, axis=0) for x in (start, end, control)], axis=0) for f in (np.min, np.max))
        middle = low / 2 + high / 2
        self.middle = middle = np.where(np.abs(middle) > 2 * (high - low).max(), middle, 0.0)
        if middle.any():
            start, end = start - middle, end - middle
            # A straight segment stays straight to the last bit.
            control = np.where(segments.turn[:, None] == 0, (start + end) / 2, control - middle)
            segments = replace(segments, start=start, end=end, control=control)
        self.boundaries = (ConicArcs if segments.turn.any() else LineSegments)(arrays, segments)
        size = float(np.subtract(*self.boundaries.box[::-1]).max())
        if 0 < size < 1 / self.farthest:
            raise ValueError(f"segments: within {size:g} of each other; expected {1 / self.farthest:g} or more")
        # Rounding of an origin that is farther away would be larger than the margin of the box.
        self.reach = min(self.farthest, size / (12 * arrays.roundoff) or self.farthest)
        self.mesh = _mesh(arrays, segments, method)
        left, right = segments.n_left, segments.n_right
        # With k from left to right and from right to left: ratios in float64, before anything is rounded.
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
        along = finite_array("directions", directions, origins.shape)
        with np.errstate(over="ignore", under="ignore"):
            length2 = np.einsum("ij,ij->i", along, along)
        # Squares could leave float32's range.
        if not (length2.min(initial=1) > 1e-30 and length2.max(initial=1) < 1e30):
            size = np.maximum(*np.abs(along).T)
            if not size.all():
                raise ValueError(f"directions[{int(np.argmin(size))}] = (0, 0); expected a direction")
            along = np.ldexp(along, 1 - np.frexp(size)[1][:, None])
        count, arrays = len(origins), self.arrays
        if isinstance(max_depth, bool) or not isinstance(max_depth, int | np.integer) or max_depth < 1:
            raise ValueError(f"max_depth = {max_depth!r}; expected a whole number, 1 or more")
        if count * (max_depth + 1) >= 2**32:
            raise ValueError(f"{count} rays, max_depth = {max_depth}; expected a product below 2³²")
        index = None if n_start is None else arrays.table(_each("n_start", n_start, count, "iuf", float))
        none = np.ndim(reflect) == 0 and reflect == 0
        mirrored = None if none else arrays.table(_each("reflect", reflect, count, "iu", np.uint32))
        places = origins - self.middle
        check_range("origins, relative to the segments", places, self.reach)
        if self.mesh:
            self.mesh.expect(places, along)
        rays = [arrays.table(x) for x in (places, along)]

        def work(lane: Index, scatter: Scatter) -> None:
            p, d = (arrays.gather(table, lane) for table in rays)
            n, bits = (None if table is None else arrays.gather(table, lane) for table in (index, mirrored))
            scatter("points", 0, p, True)
            state = self._start(p, d, arrays.number(dr.nan) if n is None else n)
            most = arrays.uniform(arrays.index, max_depth)

            def step(state: PathState) -> tuple[PathState]:
                return (self._step(state, bits, most, scatter, weights),)

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
        fields = arrays.run(count, buffers, work)
        if self.middle.any():
            fields["points"] = (fields["points"] + self.middle).astype(fields["points"].dtype)
            fields["points"][0] = origins
        last = fields.pop("directions")[0]
        return Paths(directions=last, **{name: np.swapaxes(x, 0, 1) for name, x in fields.items()})

    def _start(self, p: Vector2, d: Vector2, index: Number) -> PathState:
        """A ray from the outside starts where it enters the box around all boundaries.

        So a distant origin is rounded once, here, instead of in every difference from a vertex.
        """
        arrays, d = self.arrays, _unit(d)
        low, high = (arrays.uniform(arrays.vector, *corner) for corner in self.boundaries.box)
        inverse = dr.rcp(dr.select(d == 0, 1e-30, d))
        a, b = (low - p) * inverse, (high - p) * inverse
        enter, leave = dr.max(dr.minimum(a, b)), dr.min(dr.maximum(a, b))
        p = dr.select((enter > 0) & (enter < leave), dr.fma(d, enter, p), p)
        slack = 4 * arrays.roundoff * (dr.abs(p.x) + dr.abs(p.y))
        half = arrays.number(0.5)
        ray = Ray(p, d, arrays.index(NOWHERE), half, half, arrays.mask(False), slack)
        return PathState(ray, index, arrays.vector(1, 1), arrays.index(0), self._search(-BACK), arrays.mask(True))

    def _search(self, gone: float) -> SearchState:
        return SearchState(self.arrays.number(gone), self.arrays.index(NOWHERE))

    def _step(self, state: PathState, bits: Index | None, most: Index, scatter: Scatter, weights: bool) -> PathState:
        """Search once for the next boundary, and cross it if it is found, or end the path.

        bits: of `reflect`; most: the greatest depth.
        """
        boundaries, ray, start = self.boundaries, state.ray, self.boundaries.start(state.ray)

        def test(i: Index, best: Hit) -> tuple[Index, Hit]:
            return i + 1, boundaries.nearer(best, ray, start, i)

        def more(i: Index, best: Hit) -> Mask:
            return state.active & (i < boundaries.count)

        if self.mesh:  # the first boundary ahead may not be settled: then the search goes on
            hit, search, settled = self.mesh.nearest(boundaries, ray, start, state.search, state.active)
        else:
            hit = dr.while_loop((self.arrays.index(0), boundaries.none()), more, test, label="boundaries")[1]
            search, settled = state.search, self.arrays.mask(True)
        some = state.active & settled & (hit.segment != NOWHERE)

        def leg(state: PathState, event: Any, index: Number, active: Mask) -> None:
            scatter("events", state.depth, event, active)
            if weights:
                scatter("indices", state.depth, index, active)
                scatter("polarised", state.depth, state.power, active)

        def cross_it(state: PathState, hit: Hit, rest: PathState) -> PathState:
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
            if bits is not None:
                bit = (bits >> dr.minimum(j, REFLECT_BITS - 1)) & 1
                forced = through & (j < REFLECT_BITS) & (bit == 1)
                b, through = dr.select(forced, _mirrored(d, line), b), through & negated(forced)
            to_left = hit.to_left == through
            # Of a ray along the boundary rounding hides from which side it comes; its ends decided that.
            b = dr.select((cross(line, b) > 0) == to_left, b, _mirrored(b, line))
            event = dr.select(through, int(Event.REFRACTED), int(Event.REFLECTED))
            event = dr.select(near == index, event, int(Event.MEDIUM_MISMATCH))
            met = j < most
            leg(state, dr.select(met, event, int(Event.MAX_DEPTH)), index, True)
            scatter("points", j + 1, p, met)
            scatter("hits", j, hit.segment, met)
            on = met & (near == index)
            ray = Ray(p, dr.select(on, b, d), hit.segment, hit.s, hit.r, to_left, arrays.number(0))
            power = state.power * _shares(d, line, k, through) if weights else state.power
            return PathState(ray, dr.select(through, far, index), power, j + 1, self._search(0), on)

        leg(state, int(Event.ESCAPED), state.index, state.active & settled & negated(some))
        rest = replace(state, search=search, active=state.active & negated(settled))
        # A branch, not a select: neighbouring rays mostly find their boundaries in the same step.
        return dr.if_stmt((state, hit, rest), some, cross_it, lambda state, hit, rest: rest, label="boundary")


def _unit(v: Vector2) -> Vector2:
    return v * dr.rsqrt(dr.squared_norm(v))


def _mirrored(d: Vector2, line: Vector2) -> Vector2:
    c = 2 * cross(line, d)
    return type(d)(dr.fma(c, line.y, d.x), dr.fma(-c, line.x, d.y))


def _shares(d: Vector2, line: Vector2, k: Number, through: Mask) -> Vector2:
    """The shares of the s and the p wave that go the way of the ray: Fresnel's T where it goes through, R otherwise.

    In a plane neither wave becomes the other, at any boundary.
    """
    cos_i = dr.minimum(dr.abs(cross(line, d)), 1)
    cos_t, transmitted = fresnel.refracted_cosine(cos_i, k)
    t_s, t_p, _ = fresnel.transmitted_powers(cos_i, cos_t, transmitted, k)
    r_s, r_p = map(dr.squared_norm, fresnel.amplitudes(cos_i, k))
    return type(d)(dr.select(through, t_s, r_s), dr.select(through, t_p, r_p))


def _each(name: str, values: ArrayLike, count: int, kinds: str, kind: DTypeLike) -> Any:
    """One value per ray, of numpy type `kind`. ValueError for another shape, type or range."""
    array = np.asarray(values)
    whole = kind is np.uint32
    fits = array.dtype.kind in kinds and array.shape in ((), (count,))
    if not fits or not (((array >= 0) & (array < 2**32)) if whole else ((array > 0) & np.isfinite(array))).all():
        accepted = "a whole number, 0 or more and below 2³²" if whole else "a number above 0"
        raise ValueError(f"{name}; expected {accepted}, or {count} of them")
    return np.ascontiguousarray(np.broadcast_to(array.astype(kind), count))


def _mesh(arrays: ArrayBackend, segments: Segments, method: str) -> MeshAcceleration | None:
    """The mesh that finds the next boundary; None where all segments are tried: faster, asked for, or the only way."""
    if method not in METHODS:
        raise ValueError(f"method = {method!r}; expected {', '.join(METHODS)}")
    if method == "brute" or (method == "auto" and len(segments) <= FEW):
        return None
    length = np.hypot(*(segments.end - segments.start).T)
    if not length.any():  # no boundary at all
        return None
    extent = np.ptp(np.concatenate([segments.start, segments.end]), axis=0).max()
    shortest = length[length > 0].min(initial=np.inf) / (extent / 2 or 1)
    reason = "arcs" if segments.turn.any() else f"a segment of {shortest:.1e}" if shortest < SHORTEST else ""
    if not reason:
        mesh = MeshAcceleration(arrays, segments)
        if not mesh.crowded:
            return mesh
        reason = "segments {} and {}".format(*mesh.crowded)
    if method == "mesh":
        limit = f"longer and farther apart than {SHORTEST:.1e} of half the extent"
        raise ValueError(f"method = 'mesh': {reason}; expected straight segments, {limit}")
    return None

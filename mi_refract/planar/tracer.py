"""The planar system: rays through boundaries in two dimensions, refracted or reflected at each.

Conventions:

- A boundary is met at λ > 0. A ray that starts on a boundary has not met it: it starts on the side to which it goes.
- A ray that passes exactly through a vertex, or runs along a segment, is treated as if it were shifted to its own right
  by an infinitesimal distance. So it crosses exactly one of two segments that share a vertex; at a tip none or both.
- A segment of length zero is no boundary. Where several segments share a vertex (a T-junction) a ray crosses those on
  its path one after the other. A vertex inside another segment is no junction: two media lie on one side of that
  segment, and a ray that comes from the other one of them ends there with MEDIUM_MISMATCH.
- A ray starts in the medium on the near side of the first boundary it meets, unless `n_start` says otherwise.

Source: document 004, with its slips corrected (mi_refract/formulas/README.md, "Errata of the documents").
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from .array_backend import ArrayBackend, choose_backend
from .intersect_arcs import ConicArcs
from .intersect_segments import LineSegments
from .mesh_acceleration import SHORTEST, MeshAcceleration
from .path_loop import PathLoop
from .segments import Array, Paths, Segments, finite_array

METHODS = "auto", "brute", "mesh"
FARTHEST = {"float32": 1e15, "float64": 1e100}  # of coordinates and indices: products of two do not overflow
FEW = 48  # up to so many segments, trying all is faster than a query of the mesh


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
        for name in ("start", "end", "n_left", "n_right"):
            _check_range(f"segments.{name}", getattr(segments, name), self.farthest)
        segments, self.middle = _centred(segments)
        ends = segments.start, segments.end, segments.vertices
        boundaries = LineSegments(arrays, *ends)
        if segments.control is not None and segments.weight is not None:
            boundaries = ConicArcs(arrays, *ends, segments.control, segments.weight)
        mesh = _mesh(arrays, segments, method)
        self.loop = PathLoop(arrays, boundaries, mesh, np.column_stack([segments.n_left, segments.n_right]), formula)

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
        along = _scaled(finite_array("directions", directions, origins.shape))
        count = len(origins)
        if isinstance(max_depth, bool) or not isinstance(max_depth, int | np.integer) or max_depth < 1:
            raise ValueError(f"max_depth = {max_depth!r}; expected a whole number, 1 or more")
        if count * (max_depth + 1) >= 2**32:
            raise ValueError(f"{count} rays, max_depth = {max_depth}; expected a product below 2³²")
        index = None if n_start is None else _each("n_start", n_start, count, "iuf", float)
        none = np.ndim(reflect) == 0 and reflect == 0
        mirrored = None if none else _each("reflect", reflect, count, "iu", np.uint32)
        _check_range("origins", origins, self.farthest)
        fields = self.loop(origins - self.middle, along, index, mirrored, max_depth, weights)
        if self.middle.any():
            fields["points"] = (fields["points"] + self.middle).astype(fields["points"].dtype)
            fields["points"][0] = origins
        last = fields.pop("directions")[0]
        return Paths(directions=last, **{name: np.swapaxes(x, 0, 1) for name, x in fields.items()})


def _scaled(directions: Array) -> Array:
    """The directions, scaled by powers of 2 where squares could leave float32's range. ValueError for (0, 0)."""
    with np.errstate(over="ignore", under="ignore"):
        length2 = np.einsum("ij,ij->i", directions, directions)
    if length2.min(initial=1) > 1e-30 and length2.max(initial=1) < 1e30:
        return directions
    size = np.maximum(*np.abs(directions).T)
    if not size.all():
        raise ValueError(f"directions[{int(np.argmin(size))}] = (0, 0); expected a direction")
    return np.asarray(np.ldexp(directions, 1 - np.frexp(size)[1][:, None]))


def _check_range(name: str, values: Array, largest: float) -> None:
    """ValueError for numbers of which a product of two would overflow."""
    if values.size and not (values.max() <= largest and values.min() >= -largest):
        raise ValueError(f"{name}: a number beyond ±{largest:g}")


def _centred(segments: Segments) -> tuple[Segments, Array]:
    """The segments as seen from a new origin, and that: 0, or per axis the middle of boundaries that are far from 0.

    Far is where |middle| exceeds twice the extent. Then |x − middle| < |middle|/2: the differences are exact, and
    float32 keeps all its digits for them.
    """
    places = [segments.start, segments.end] + ([] if segments.control is None else [segments.control])
    low, high = (f([f(x, axis=0) for x in places], axis=0) for f in (np.min, np.max))
    middle = low / 2 + high / 2
    middle = np.where(np.abs(middle) > 2 * (high - low).max(), middle, 0.0)
    if not middle.any():
        return segments, middle
    start, end, control = segments.start - middle, segments.end - middle, segments.control
    if control is not None:  # a straight segment stays straight to the last bit
        straight = (control == (segments.start + segments.end) / 2).all(1)[:, None]
        control = np.where(straight, (start + end) / 2, control - middle)
    return replace(segments, start=start, end=end, control=control), middle


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
    reason = "arcs" if segments.curved else f"a segment of {shortest:.1e}" if shortest < SHORTEST else ""
    if not reason:
        mesh = MeshAcceleration(arrays, segments.start, segments.end, segments.vertices)
        if not mesh.crowded:
            return mesh
        reason = "segments {} and {}".format(*mesh.crowded)
    if method == "mesh":
        limit = f"longer and farther apart than {SHORTEST:.1e} of half the extent"
        raise ValueError(f"method = 'mesh': {reason}; expected straight segments, {limit}")
    return None

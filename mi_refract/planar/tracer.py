"""The planar system: rays against boundaries in two dimensions, refracted or totally reflected at each.

A boundary is a directed segment with the index of the medium on its left and on its right (seen along it), straight
or an arc of a conic. `trace` follows rays through them; conventions:

- A boundary is met at λ > 0. A ray that starts on one has not met it: it starts on the side to which it goes.
- A ray passes a vertex, and runs along a segment, as though it were displaced to its own right by less than
  anything. So one through a vertex that two segments share crosses exactly one of them, or none or both at a tip.
- A segment of length zero is no boundary. Where several segments share a vertex (a T-junction) a ray crosses those
  on its path, one after the other. A vertex inside another segment is no junction: one side of that segment has
  two media then, and a ray that finds another medium than its own ends there as MEDIUM_MISMATCH.
- The medium in which a ray starts is that on the near side of the first boundary it meets, unless it is told.

Source: document 004, with its slips corrected (README, Errata).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .array_backend import Lanes, lanes
from .intersect_segments import Arcs, Straight
from .mesh_acceleration import SHORTEST, Extrusion
from .path_loop import Event, Walker

__all__ = ["Event", "Paths", "Segments", "Tracer", "trace"]

Array = NDArray[np.float64]
METHODS = "auto", "brute", "mesh"
FARTHEST = {"float32": 1e15, "float64": 1e100}  # of coordinates, and indices: products of two are numbers
FEW = 48  # segments that are tried sooner than a query takes

SHAPES: dict[str, tuple[int, ...]] = {
    "start": (2,),
    "end": (2,),
    "n_left": (),
    "n_right": (),
    "control": (2,),
    "weight": (),
}


def _numbers(name: str, values: Any, shape: tuple[int, ...]) -> Array:
    """As float64 of that shape, finite; ValueError otherwise."""
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: accepted: numbers of shape {shape}") from None
    if array.shape != shape:
        raise ValueError(f"{name}: shape {array.shape}; accepted: {shape}")
    if array.size and not (np.isfinite(array.min()) and np.isfinite(array.max())):
        place = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{name}{list(place)} = {array[place]}: accepted: finite numbers")
    return array


@dataclass(frozen=True)
class Segments:
    """M directed boundaries from `start` to `end` (M × 2), between media of index `n_left` and `n_right` (M).

    `control` (M × 2) and `weight` (M): arcs of conics, as the rational quadratic Bézier curves
    ((1−t)² start + 2w t(1−t) control + t² end) / ((1−t)² + 2w t(1−t) + t²), each turning by less than 180°; the
    controls lie where the end tangents meet; w < 1, 1, > 1: ellipse, parabola, hyperbola. Straight where None.
    ValueError for shapes that do not fit, what is not finite, an index ≤ 0, a weight ≤ 0, or two segments with the
    same two ends.
    """

    start: Array
    end: Array
    n_left: Array
    n_right: Array
    control: Array | None = None
    weight: Array | None = None

    def __post_init__(self) -> None:
        if len(self.start) == 0:
            raise ValueError("segments: none; accepted: at least one")
        for name, shape in SHAPES.items():
            values = getattr(self, name)
            if values is None and name in ("control", "weight"):
                continue
            values = _numbers(f"segments.{name}", values, (len(self.start), *shape))
            object.__setattr__(self, name, values)
        if (self.control is None) != (self.weight is None):
            raise ValueError("segments: control and weight: accepted: both or neither")
        for name in ("n_left", "n_right", "weight"):
            values = getattr(self, name)
            if values is not None and not (values > 0).all():
                i = int(np.argmin(values > 0))
                raise ValueError(f"segments.{name}[{i}] = {values[i]}: accepted: more than 0")
        self._distinct()

    def __len__(self) -> int:
        return len(self.start)

    @property
    def curved(self) -> bool:
        return self.control is not None

    @functools.cached_property
    def vertices(self) -> NDArray[np.uint32]:
        """M × 2 numbers, equal for equal ends; of no meaning otherwise."""
        places = np.concatenate([self.start, self.end]) + 0.0  # −0 is 0
        _, numbers = np.unique(places.view(complex).ravel(), return_inverse=True)
        return numbers.reshape(2, -1).T.astype(np.uint32)

    def _distinct(self) -> None:
        """Two that coincide have no first one of them."""
        ends = np.sort(self.vertices, axis=1).astype(np.uint64)
        bulge = np.zeros((len(self), 3))
        if self.control is not None and self.weight is not None:
            bulge = np.column_stack([self.control, self.weight]) + 0.0
        key = np.column_stack([ends[:, 0] << np.uint64(32) | ends[:, 1], bulge.view(np.uint64)])
        order = np.lexsort(key.T)
        same = (np.diff(key[order].astype(np.int64), axis=0) == 0).all(1) & (ends[order[1:], 0] != ends[order[1:], 1])
        if same.any():
            i, j = sorted(order[int(np.argmax(same)) :][:2].tolist())
            raise ValueError(f"segments {i} and {j} coincide; accepted: one, with the media on either side of both")


@dataclass(frozen=True)
class Paths:
    """N paths of at most D boundaries. Leg j goes from point j to point j + 1, the last one on along `directions`.

    `points` N × (D+1) × 2: the origin and the places where boundaries are met, then NaN. `directions` N × 2: after
    the last of them. `hits` N × D: the segment met, then −1. `events` N × (D+1): of each boundary, then the end's,
    then NONE. Where weights were asked for, N × (D+1): `indices` of the medium of each leg, NaN after the end and where
    it is not known; `weights`, the share of the power that a leg carries, by Fresnel's equations for unpolarised light.
    """

    points: Array
    directions: Array
    hits: NDArray[np.int32]
    events: NDArray[np.uint8]
    indices: Array | None = None
    weights: Array | None = None


def trace(
    segments: Segments,
    origins: Any,
    directions: Any,
    max_depth: int,
    *,
    formula: str | None = None,
    precision: str = "float64",
    backend: str | None = None,
    method: str = "auto",
    reflect: Any = 0,
    n_start: Any = None,
    weights: bool = False,
) -> Paths:
    """Follow rays from `origins` along `directions` (N × 2) until they escape or have met `max_depth` boundaries.

    `formula`: a key of FORMULAS for the direction; None: that of document 004. `precision`: "float64" or "float32".
    `backend`: "llvm", "cuda" or "scalar"; None for the best on this machine. `reflect`: bits, one number or N; where
    bit j is set the ray is reflected at the j-th boundary it meets (from 0, below 32), though it might be refracted.
    `method`: "brute" tries every segment, "mesh" those that Mitsuba's ray tracing finds (see `extrusion`), at a cost
    that grows like log M; both give the same paths, and "auto" chooses. `n_start`: index of the medium in which rays
    start (N or one). `weights`: fill `Paths.weights` and `Paths.indices`.
    ValueError for what is none of these, and for origins or directions that are not finite, or no direction.
    """
    tracer = Tracer(segments, formula=formula, precision=precision, backend=backend, method=method)
    return tracer(origins, directions, max_depth, reflect=reflect, n_start=n_start, weights=weights)


class Tracer:
    """`trace` for one set of segments, set up once; arguments and errors as there."""

    def __init__(
        self,
        segments: Segments,
        *,
        formula: str | None = None,
        precision: str = "float64",
        backend: str | None = None,
        method: str = "auto",
    ) -> None:
        self.lanes = to = lanes(backend, precision)
        self.farthest = FARTHEST[precision]
        for name in ("start", "end", "n_left", "n_right"):
            _in_range(f"segments.{name}", getattr(segments, name), self.farthest)
        self.middle = _middle(segments)
        segments = _moved(segments, -self.middle)
        ends = segments.start, segments.end, segments.vertices
        shapes = (segments.control, segments.weight) if segments.curved else None
        boundaries = Arcs(to, *ends, *shapes) if shapes else Straight(to, *ends)
        mesh = _mesh(to, segments, method)
        self.walker = Walker(to, boundaries, mesh, np.column_stack([segments.n_left, segments.n_right]), formula)

    def __call__(
        self,
        origins: Any,
        directions: Any,
        max_depth: int,
        *,
        reflect: Any = 0,
        n_start: Any = None,
        weights: bool = False,
    ) -> Paths:
        origins = _numbers("origins", origins, (len(origins), 2) if np.ndim(origins) else (0, 2))
        directions = _numbers("directions", directions, origins.shape)
        directions = _in_reach(directions)
        if isinstance(max_depth, bool) or not isinstance(max_depth, int | np.integer) or max_depth < 1:
            raise ValueError(f"max_depth = {max_depth!r}: accepted: a whole number, 1 or more")
        index = None if n_start is None else _each("n_start", n_start, len(origins), "iuf", float)
        none = np.ndim(reflect) == 0 and reflect == 0
        mirrored = None if none else _each("reflect", reflect, len(origins), "iu", np.uint32)
        if len(origins) * (max_depth + 1) >= 2**32:
            raise ValueError(f"{len(origins)} rays, max_depth = {max_depth}: accepted: a product below 2³²")
        _in_range("origins", origins, self.farthest)
        moved = self.middle.any()
        places = origins - self.middle if moved else origins
        found = self.walker(places, directions, index, mirrored, max_depth, weights)
        if moved:
            found["points"] = (found["points"] + self.middle).astype(found["points"].dtype)
            found["points"][0] = origins
        found["directions"] = found["directions"][0]
        return Paths(**{name: x if name == "directions" else np.swapaxes(x, 0, 1) for name, x in found.items()})


def _in_reach(directions: Array) -> Array:
    """The directions, scaled exactly where squares may be out of float32's range. ValueError for (0, 0)."""
    with np.errstate(over="ignore", under="ignore"):
        length2 = np.einsum("ij,ij->i", directions, directions)
    if length2.min(initial=1) > 1e-30 and length2.max(initial=1) < 1e30:
        return directions
    size = np.maximum(*np.abs(directions).T)
    if not size.all():
        raise ValueError(f"directions[{int(np.argmin(size))}] = (0, 0): accepted: a direction")
    return np.ldexp(directions, 1 - np.frexp(size)[1][:, None])


def _in_range(name: str, values: Array, largest: float) -> None:
    """ValueError for numbers of which products of two would overflow."""
    if values.size and not (values.max() <= largest and values.min() >= -largest):
        raise ValueError(f"{name}: a number beyond ±{largest:g}; accepted: up to that")


def _middle(segments: Segments) -> Array:
    """What coordinates are counted from: 0, or of boundaries that are far from there for their size, their middle.

    |x − middle| < middle/2 there: those differences are exact, and float32 has all its digits for them.
    """
    places = [segments.start, segments.end] + ([] if segments.control is None else [segments.control])
    low, high = (f([f(x, axis=0) for x in places], axis=0) for f in (np.min, np.max))
    middle = low / 2 + high / 2
    return np.where(np.abs(middle) > 2 * (high - low).max(), middle, 0.0)


def _moved(segments: Segments, by: Array) -> Segments:
    if not by.any():
        return segments
    start, end, control = segments.start + by, segments.end + by, segments.control
    if control is not None:  # what is straight stays so to the last bit
        straight = (control == (segments.start + segments.end) / 2).all(1)[:, None]
        control = np.where(straight, (start + end) / 2, control + by)
    return replace(segments, start=start, end=end, control=control)


def _each(name: str, values: Any, count: int, kinds: str, kind: Any) -> Any:
    """One value per ray."""
    array = np.asarray(values)
    whole = kind is np.uint32
    fits = array.dtype.kind in kinds and array.shape in ((), (count,))
    if not fits or not (((array >= 0) & (array < 2**32)) if whole else ((array > 0) & np.isfinite(array))).all():
        accepted = "a whole number, 0 or more and below 2³²" if whole else "a number above 0"
        raise ValueError(f"{name}: accepted: {accepted}, or {count} of them")
    return np.ascontiguousarray(np.broadcast_to(array.astype(kind), count))


def _mesh(to: Lanes, segments: Segments, method: str) -> Extrusion | None:
    """What finds candidates, where it can and is faster or asked for."""
    if method not in METHODS:
        raise ValueError(f"method = {method!r}; accepted: {', '.join(METHODS)}")
    if method == "brute" or (method == "auto" and len(segments) <= FEW):
        return None
    length = np.hypot(*(segments.end - segments.start).T)
    if not length.any():  # no boundary at all
        return None
    extent = np.ptp(np.concatenate([segments.start, segments.end]), axis=0).max()
    shortest = length[length > 0].min(initial=np.inf) / (extent / 2 or 1)
    reason = "arcs" if segments.curved else f"a segment of {shortest:.1e}" if shortest < SHORTEST else ""
    if not reason:
        mesh = Extrusion(to, segments.start, segments.end, segments.vertices)
        if not mesh.crowded:
            return mesh
        reason = "segments {} and {}".format(*mesh.crowded)
    if method == "mesh":
        limit = f"longer and farther apart than {SHORTEST:.1e} of half the extent"
        raise ValueError(f"method = 'mesh': {reason}; accepted: straight segments, {limit}")
    return None

"""Find the first boundary ahead with Mitsuba's ray tracing, in time that grows like log M. Straight segments only.

The mesh holds one triangle for each segment and each vertex, perpendicular to the plane z = 0. A triangle cuts that
plane in a line, here called a stroke: along a segment, extended by MARGIN at either end, or across a vertex,
2 MARGIN long. Lengths are in units of half the scene's extent.

Mitsuba traces in float32. So its ray, whose start is moved off its own segment by OFFSET, lies up to ε < MARGIN beside
the exact ray. But a ray that crosses a segment within ε of some place crosses the stroke of that segment, of its
neighbour, or of a vertex between them. So the strokes on the ray, in order, list every segment that must be tested, and
`LineSegments` decides exactly. In a wedge, where neighbours are within 4 MARGIN of each other, the order of
strokes is not reliable: there all segments at the vertex are tested.

Precondition: no segment is shorter than SHORTEST, and no two segments without a common vertex are closer than SHORTEST.
The tracer checks the first part; `crowded` checks the second at the middle and the quarters of each segment. Where two
segments are closer elsewhere, a ray may miss a thin layer, or meet its two sides in the wrong order and end with
MEDIUM_MISMATCH.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.backend import activate
from mi_refract.numerics import Mask, Number, mitsuba_mesh

from .array_backend import ArrayBackend, Index, Scatter, Table, Vector2, Vertices, negated
from .intersect import NOWHERE, Hit, LineSegments, Ray, Start
from .segments import Array, Segments

MARGIN = 2.0**-19
OFFSET = 2.0**-21
SHORTEST = 2 * MARGIN
STEP = 2.0**-22  # the search goes on this far behind a stroke
# A ray that does not start on a segment is traced from BACK behind its start, as the start may be within ε of a
# boundary. Such a boundary is found down to grazing angles of ε/BACK.
BACK = 2.0**-6
# Rays are coherent if the median difference of neighbours in origin and direction is below this. For other rays
# Embree's single-ray query takes half the time of its packet query.
COHERENT = 2.0**-5
SAMPLE = 4096  # number of rays whose coherence is measured


@dataclass
class SearchState:
    """The distance up to which a ray has been searched, and the nearest segment found beyond it, or NOWHERE."""

    searched: Number
    candidate: Index


class MeshAcceleration:
    """The strokes of M straight segments, and for each stroke a list of neighbouring segments.

    crowded: numbers of two segments that share no vertex and are closer than SHORTEST; None if no such pair was found.
    """

    def __init__(self, arrays: ArrayBackend, segments: Segments) -> None:
        """Build the mesh and the lists of neighbours, and search for segments that are too close."""
        import mitsuba

        self.arrays, self.coherent = arrays, True
        variant = "scalar_rgb" if arrays.name == "scalar" else f"{arrays.name}_ad_rgb"
        self.mi: Any = getattr(mitsuba, variant)
        ends, vertices = np.concatenate([segments.start, segments.end]), segments.vertices
        low, high = ends.min(axis=0), ends.max(axis=0)
        centre, self.half = (low + high) / 2, float((high - low).max() / 2)
        self.centre, self.scale = arrays.uniform(arrays.vector, *centre), arrays.uniform(arrays.number, 1 / self.half)
        a, b = (segments.start - centre) / self.half, (segments.end - centre) / self.half
        self.scene = _stroke_scene(variant, a, b, vertices)
        self.crowded = self._find_crowded(a, b, vertices)
        self.wedges = arrays.table(_wedge_shares(a, b, vertices))
        first, neighbours = _neighbour_lists(vertices)
        self.first, self.neighbours = arrays.table(first), arrays.table(neighbours)

    def choose_query(self, origins: Array, directions: Array) -> None:
        """Choose Embree's query, for coherent rays or for single ones, from the order of these rays (N × 2 each)."""
        places, directions = origins[:SAMPLE] / self.half, directions[:SAMPLE]
        directions = directions / np.abs(directions).max(axis=1, keepdims=True)
        steps = np.abs(np.diff(places, axis=0)).sum(1) + np.abs(np.diff(directions, axis=0)).sum(1)
        self.coherent = len(origins) < 2 or float(np.median(steps)) < COHERENT

    def nearest(
        self, boundaries: LineSegments, ray: Ray, start: Start, search: SearchState, active: Mask
    ) -> tuple[Hit, SearchState, Mask]:
        """Query the mesh once for the next stroke.

        Returns the first boundary found so far, the state to continue the search from, and whether the search is over:
        no other boundary can come first.
        """
        # From the ray's start, moved off its own segment, to the side that the ray leaves to.
        x, y = (self.mi.Float(e) for e in start.vectors[1] - start.vectors[0])
        size = dr.select(ray.left, OFFSET, -OFFSET) * dr.rsqrt(dr.fma(x, x, y * y))
        q, number = (ray.p - self.centre) * self.scale, self.arrays.number
        q = dr.select(ray.own != NOWHERE, type(q)(q.x - number(y * size), q.y + number(x * size)), q)
        hit, t, stroke = self._next_stroke(dr.fma(ray.d, search.searched, q), ray.d, active)
        own = active & (ray.own != NOWHERE)
        starts_in_wedge = own & self._in_wedge(ray.own, ray, own)

        def test_segments(best: Hit, stroke: Index, hit: Mask, starts_in_wedge: Mask, candidate: Index) -> Hit:
            best = boundaries.nearer(best, ray, start, stroke, hit & (stroke < boundaries.count))
            # In a wedge all neighbours are tested: the ray may meet their strokes in any order, and its start may lie
            # beyond one of them, or beyond the stroke of the vertex between.
            hits_in_wedge = hit & self._in_wedge(best.segment, best, hit)
            strokes = dr.select(starts_in_wedge, ray.own, NOWHERE), dr.select(hits_in_wedge, stroke, NOWHERE)
            return self._nearest_neighbour(best, boundaries, ray, start, candidate, strokes)

        # A branch, not a select: neighbouring rays mostly agree.
        candidate = dr.select(active, search.candidate, NOWHERE)
        state = boundaries.none(), stroke, hit, starts_in_wedge, candidate
        needed = hit | starts_in_wedge | (candidate != NOWHERE)
        best = dr.if_stmt(state, needed, test_segments, lambda best, *_: best, label="stroke")
        searched = search.searched + t
        settled = negated(hit) | (best.distance * self.scale <= searched + MARGIN)
        return best, SearchState(searched + STEP, best.segment), settled

    def _in_wedge(self, segment: Index, at: Hit | Ray, active: Mask) -> Mask:
        """Whether a place on a segment is in a wedge at either end; true where there is no segment."""
        exists = active & (segment != NOWHERE)
        near_a, near_b = self.arrays.gather(self.wedges, segment, exists)
        return negated(exists) | (at.r < near_a) | (at.s < near_b)

    def _find_crowded(self, a: Array, b: Array, vertices: Vertices) -> tuple[int, int] | None:
        """Two segments that share no vertex, one less than SHORTEST from the middle or a quarter of the other.

        A ray toward a segment, from that distance, then meets the stroke of another segment first.
        """
        arrays, e = self.arrays, b - a
        normals = np.column_stack([-e[:, 1], e[:, 0]]) / np.maximum(np.linalg.norm(e, axis=1, keepdims=True), 1e-300)
        for share, d in itertools.product((0.25, 0.5, 0.75), (normals, -normals)):
            places, directions = arrays.table(a + share * e + SHORTEST * d), arrays.table(-d)

            def query(lane: Index, scatter: Scatter, places: Table = places, directions: Table = directions) -> None:
                place, direction = arrays.gather(places, lane), arrays.gather(directions, lane)
                hit, t, stroke = self._next_stroke(place, direction, arrays.mask(True))
                scatter("nearby", 0, stroke, hit & (t < SHORTEST + OFFSET))

            strokes = arrays.run(len(a), {"nearby": (arrays.index, NOWHERE, (1, len(a)))}, query)["nearby"][0]
            near = np.flatnonzero(strokes < len(a))
            neighbours = strokes[near]
            apart = (vertices[near, :, None] != vertices[neighbours][:, None]).all((1, 2))
            if apart.any():
                return int(near[apart][0]), int(neighbours[apart][0])
        return None

    def _next_stroke(self, q: Vector2, d: Vector2, active: Mask) -> tuple[Mask, Number, Index]:
        """Whether there is a stroke ahead of a ray, its distance, and its number."""
        mi, number = self.mi, self.mi.Float
        ray = mi.Ray3f(mi.Point3f(number(q.x), number(q.y), 0), mi.Vector3f(number(d.x), number(d.y), 0))
        pi = self.scene.ray_intersect_preliminary(ray, self.coherent, active)
        return active & pi.is_valid(), self.arrays.number(pi.t), self.arrays.index(pi.prim_index)

    def _nearest_neighbour(
        self,
        best: Hit,
        boundaries: LineSegments,
        ray: Ray,
        start: Start,
        candidate: Index,
        strokes: tuple[Index, Index],
    ) -> Hit:
        """The nearest of `best`, the segment `candidate`, and all neighbours of two strokes; each may be NOWHERE."""
        first_stroke, last_stroke = strokes
        gather = self.arrays.gather

        def test(i: Index, stroke: Index, best: Hit, active: Mask) -> tuple[Index, Index, Hit, Mask]:
            listed = active & (i > 0) & (stroke != NOWHERE)
            neighbour = gather(self.neighbours, gather(self.first, stroke, listed) + i - 1, listed)
            segment = dr.select(i == 0, candidate, dr.select(listed, neighbour, NOWHERE))
            end = segment == NOWHERE
            best = boundaries.nearer(best, ray, start, segment, active & negated(end))
            more = active & (negated(end) | ((stroke != last_stroke) & (last_stroke != NOWHERE)))
            return dr.select(end, 1, i + 1), dr.select(end, last_stroke, stroke), best, more

        stroke = dr.select(first_stroke == NOWHERE, last_stroke, first_stroke)
        needed = (candidate != NOWHERE) | (stroke != NOWHERE)
        state = dr.select(candidate == NOWHERE, self.arrays.index(1), 0), stroke, best, needed
        return dr.while_loop(state, lambda i, stroke, best, active: active, test, label="neighbours")[2]


def _stroke_scene(variant_name: str, a: Array, b: Array, vertices: Vertices) -> Any:
    """A Mitsuba scene of a triangle per stroke, first of the segments from `a` to `b` (M × 2), then of the vertices."""
    import mitsuba as mi

    e = b - a
    length = np.linalg.norm(e, axis=1, keepdims=True)
    e = np.divide(e, length, out=np.zeros_like(e), where=length > 0)
    # The stroke of a vertex lies across the principal axis of the segments there: along it they have their own strokes.
    number = vertices.ravel()
    xx, xy, yy = (np.bincount(number, np.repeat(e[:, i] * e[:, j], 2)) for i, j in ((0, 0), (0, 1), (1, 1)))
    angle = np.arctan2(2 * xy, xx - yy) / 2
    across = MARGIN * np.column_stack([-np.sin(angle), np.cos(angle)])
    place = np.empty((len(across), 2))
    place[number] = np.stack([a, b], 1).reshape(-1, 2)
    starts = np.concatenate([a - MARGIN * e, place - across])
    ends = np.concatenate([b + MARGIN * e, place + across])
    if mi.variant() is None:
        activate()
    variant: Any = getattr(mi, variant_name)
    middle = (starts + ends) / 2
    corners = (middle, -1), (2 * starts - middle, 1), (2 * ends - middle, 1)
    places = np.concatenate([np.insert(corner, 2, z, axis=1) for corner, z in corners])
    mesh = mitsuba_mesh.make(variant, places, np.arange(len(places)).reshape(3, -1).T)
    # mi.load_dict would build the scene for the variant that is set now.
    config = mi.parser.ParserConfig(variant_name)
    state = mi.parser.parse_dict(config, {"type": "scene", "strokes": mesh})
    mi.parser.transform_all(config, state)
    return mi.parser.instantiate(config, state)


def _wedge_shares(a: Array, b: Array, vertices: Vertices) -> Array:
    """M × 2: the share of each segment, from either end, that is within 4 MARGIN of the next segment at that vertex."""
    directions = np.stack([b - a, a - b], 1).reshape(-1, 2)
    angle, number = np.arctan2(directions[:, 1], directions[:, 0]), vertices.ravel()
    order = np.lexsort([angle, number])
    begin = np.searchsorted(number[order], number[order])
    end = np.searchsorted(number[order], number[order], side="right")
    after = np.arange(1, len(order) + 1)
    after = np.where(after < end, after, begin)
    # The angle to the next segment at the same vertex; π if there is no other.
    turn = (angle[order[after]] - angle[order]) % (2 * np.pi)
    turn[end - begin == 1] = np.pi
    least = np.full(len(order), np.pi)
    np.minimum.at(least, order, turn)
    np.minimum.at(least, order[after], turn)
    with np.errstate(divide="ignore"):
        reach = 4 * MARGIN / np.sin(np.minimum(least, np.pi / 2))
        return np.asarray(reach.reshape(-1, 2) / np.linalg.norm(b - a, axis=1, keepdims=True))


def _neighbour_lists(vertices: Vertices) -> tuple[Any, Any]:
    """(first, neighbours): the neighbours of stroke i are neighbours[first[i]] to the one before the next NOWHERE.

    The neighbours of a stroke are all segments at its vertex, or at its two vertices, except its own segment.
    """
    order = np.argsort(vertices.ravel(), kind="stable")
    degree = np.bincount(vertices.ravel())
    count = len(degree)
    begin = np.cumsum(degree) - degree
    segments = np.arange(len(vertices))
    strokes = np.concatenate([segments, segments, len(vertices) + np.arange(count)])
    stroke_vertices = np.concatenate([*vertices.T, np.arange(count)])
    sizes = degree[stroke_vertices]
    within = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    strokes, listed = np.repeat(strokes, sizes), order[np.repeat(begin[stroke_vertices], sizes) + within] // 2
    others = np.flatnonzero(strokes != listed)
    others = others[np.argsort(strokes[others], kind="stable")]
    strokes, listed = strokes[others], listed[others]
    # A NOWHERE ends each list.
    neighbours = np.full(len(listed) + len(vertices) + count, NOWHERE)
    neighbours[np.arange(len(listed)) + strokes] = listed
    lengths = np.bincount(strokes, minlength=len(vertices) + count) + 1
    return np.cumsum(lengths) - lengths, neighbours

"""Finds the first boundary ahead with Mitsuba's own ray tracing, in time that grows like log M. Straight segments only.

The mesh holds one triangle for each segment and each vertex, perpendicular to the plane z = 0. A triangle cuts that
plane in a line, here called a stroke: along a segment, longer than it by MARGIN at either end, or across a vertex,
2 MARGIN long. Lengths are in units of half the scene's extent.

Mitsuba traces in float32. So its ray, whose start is moved off its own segment by OFFSET, lies up to ε < MARGIN beside
the given ray. But a ray that crosses a segment within ε of some place crosses the stroke of that segment, of its
neighbour, or of a vertex between them. So the strokes met, in order, name every segment that must be tried, and
`LineSegments` decides exactly. In a wedge, where neighbours are within 4 MARGIN of each other, the order of
strokes is not reliable: there all segments at the vertex are tried.

Precondition: no segment is shorter than SHORTEST, and no two that share no vertex are closer than SHORTEST. The first
is checked by the tracer, the second at the middle and the quarters of each segment (`crowded`). Where it fails
elsewhere, a ray may miss a thin layer there, or meet its two sides in the wrong order and end with MEDIUM_MISMATCH.
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
STEP = 2.0**-22  # beyond a stroke that was no hit
# A ray that starts on no segment is traced from BACK behind its start: that may be within ε of a boundary, which is
# seen down to grazing angles of ε/BACK.
BACK = 2.0**-6
# Rays are coherent where their median step in place and direction is less: for others Embree's single-ray query takes
# half the time of its query for packets.
COHERENT = 2.0**-5
SAMPLE = 4096  # rays by which that is judged


@dataclass
class SearchState:
    """How far along a ray has been searched, and the nearest segment that was found beyond that, or NOWHERE."""

    gone: Number
    held: Index


class MeshAcceleration:
    """Strokes of M straight segments, and the segments that each one names.

    crowded: two segments that share no vertex and are too close to each other; None where none were seen.
    """

    def __init__(self, arrays: ArrayBackend, segments: Segments) -> None:
        """Build the mesh and the lists of neighbours, and look for segments that are too close."""
        import mitsuba

        self.arrays, self.coherent = arrays, True
        variant = "scalar_rgb" if arrays.name == "scalar" else f"{arrays.name}_ad_rgb"
        self.mi: Any = getattr(mitsuba, variant)
        both, vertices = (segments.start, segments.end), segments.vertices
        low, high = (f(np.concatenate(both), axis=0) for f in (np.min, np.max))
        centre, self.half = (low + high) / 2, float((high - low).max() / 2)
        self.centre, self.scale = arrays.uniform(arrays.vector, *centre), arrays.uniform(arrays.number, 1 / self.half)
        a, b = ((x - centre) / self.half for x in both)
        self.scene = _strokes(variant, a, b, vertices)
        self.crowded = self._crowded(a, b, vertices)
        self.wedges = arrays.table(_wedge_shares(a, b, vertices))
        first, around = _around(vertices)
        self.first, self.around = arrays.table(first), arrays.table(around)

    def expect(self, origins: Array, directions: Array) -> None:
        """Choose between Embree's queries for coherent rays and for single ones, by the order of these rays (N × 2)."""
        places, turns = origins[:SAMPLE] / self.half, directions[:SAMPLE]
        turns = turns / np.abs(turns).max(axis=1, keepdims=True)
        steps = (np.abs(np.diff(x, axis=0)).sum(1) for x in (places, turns))
        self.coherent = len(origins) < 2 or float(np.median(sum(steps))) < COHERENT

    def nearest(
        self, boundaries: LineSegments, ray: Ray, start: Start, search: SearchState, active: Mask
    ) -> tuple[Hit, SearchState, Mask]:
        """The first boundary found so far, from where to search on, and whether no other can come before it."""
        # From the ray's start, moved off its own segment, to the side to which the ray goes.
        x, y = (self.mi.Float(e) for e in start.ways[1] - start.ways[0])
        size = dr.select(ray.left, OFFSET, -OFFSET) * dr.rsqrt(dr.fma(x, x, y * y))
        q, number = (ray.p - self.centre) * self.scale, self.arrays.number
        q = dr.select(ray.own != NOWHERE, type(q)(q.x - number(y * size), q.y + number(x * size)), q)
        hit, t, stroke = self._stroke(dr.fma(ray.d, search.gone, q), ray.d, active)
        own = active & (ray.own != NOWHERE)
        corner = own & self._near_end(ray.own, ray, own)

        def tried(best: Hit, stroke: Index, hit: Mask, corner: Mask, held: Index) -> Hit:
            best = boundaries.nearer(best, ray, start, stroke, hit & (stroke < boundaries.count))
            # In a wedge all neighbours are tried: their strokes may be met in any order, and the start may lie beyond
            # one of them, or beyond the stroke of the vertex between.
            vague = hit & self._near_end(best.segment, best, hit)
            lists = dr.select(vague, stroke, NOWHERE), dr.select(corner, ray.own, NOWHERE)
            return self._also(best, boundaries, ray, start, held, lists)

        # A branch, not a select: neighbouring rays mostly agree.
        held = dr.select(active, search.held, NOWHERE)
        state = boundaries.none(), stroke, hit, corner, held
        best = dr.if_stmt(state, hit | corner | (held != NOWHERE), tried, lambda best, *_: best, label="stroke")
        gone = search.gone + t
        settled = negated(hit) | (best.distance * self.scale <= gone + MARGIN)
        return best, SearchState(gone + STEP, best.segment), settled

    def _near_end(self, segment: Index, at: Hit | Ray, active: Mask) -> Mask:
        """Whether a place on a segment is in a wedge at either end; true where there is no segment."""
        some = active & (segment != NOWHERE)
        near_a, near_b = self.arrays.gather(self.wedges, segment, some)
        return negated(some) | (at.r < near_a) | (at.s < near_b)

    def _crowded(self, a: Array, b: Array, vertices: Vertices) -> tuple[int, int] | None:
        """Two segments that share no vertex, one less than SHORTEST from the middle or a quarter of the other."""
        arrays, e = self.arrays, b - a
        across = np.column_stack([-e[:, 1], e[:, 0]]) / np.maximum(np.linalg.norm(e, axis=1, keepdims=True), 1e-300)
        for share, d in itertools.product((0.25, 0.5, 0.75), (across, -across)):
            places, directions = arrays.table(a + share * e + OFFSET * d), arrays.table(d)

            def work(lane: Index, scatter: Scatter, places: Table = places, directions: Table = directions) -> None:
                q, way = arrays.gather(places, lane), arrays.gather(directions, lane)
                hit, t, stroke = self._stroke(q, way, arrays.mask(True))
                scatter("nearby", 0, stroke, hit & (t < SHORTEST))

            stroke = arrays.run(len(a), {"nearby": (arrays.index, NOWHERE, (1, len(a)))}, work)["nearby"][0]
            seen = np.flatnonzero(stroke < len(a))
            other = stroke[seen]
            apart = (vertices[seen, :, None] != vertices[other][:, None]).all((1, 2))
            if apart.any():
                return int(seen[apart][0]), int(other[apart][0])
        return None

    def _stroke(self, q: Vector2, d: Vector2, active: Mask) -> tuple[Mask, Number, Index]:
        """Whether a stroke is ahead of a ray, its distance, and its number."""
        mi, number = self.mi, self.mi.Float
        ray = mi.Ray3f(mi.Point3f(number(q.x), number(q.y), 0), mi.Vector3f(number(d.x), number(d.y), 0))
        seen = self.scene.ray_intersect_preliminary(ray, self.coherent, active)
        return active & seen.is_valid(), self.arrays.number(seen.t), self.arrays.index(seen.prim_index)

    def _also(
        self, best: Hit, boundaries: LineSegments, ray: Ray, start: Start, held: Index, strokes: tuple[Index, Index]
    ) -> Hit:
        """The nearest of `best`, the segment `held`, and all segments that two strokes name; NOWHERE for none."""
        later, sooner = strokes
        gather = self.arrays.gather

        def test(i: Index, stroke: Index, best: Hit, going: Mask) -> tuple[Index, Index, Hit, Mask]:
            listed = going & (i > 0) & (stroke != NOWHERE)
            named = gather(self.around, gather(self.first, stroke, listed) + i - 1, listed)
            segment = dr.select(i == 0, held, dr.select(listed, named, NOWHERE))
            end = segment == NOWHERE
            best = boundaries.nearer(best, ray, start, segment, going & negated(end))
            more = going & (negated(end) | ((stroke != later) & (later != NOWHERE)))
            return dr.select(end, 1, i + 1), dr.select(end, later, stroke), best, more

        stroke = dr.select(sooner == NOWHERE, later, sooner)
        some = (held != NOWHERE) | (stroke != NOWHERE)
        state = dr.select(held == NOWHERE, self.arrays.index(1), 0), stroke, best, some
        return dr.while_loop(state, lambda i, stroke, best, going: going, test, label="also")[2]


def _strokes(of: str, a: Array, b: Array, vertices: Vertices) -> Any:
    """A scene of the Mitsuba variant `of`: one triangle per stroke, which cuts the plane z = 0 along it.

    First the strokes of the segments from `a` to `b` (M × 2), then those of the vertices.
    """
    import mitsuba as mi

    e = b - a
    length = np.linalg.norm(e, axis=1, keepdims=True)
    e = np.divide(e, length, out=np.zeros_like(e), where=length > 0)
    # Across the principal axis of the segments at a vertex: along it they have strokes of their own.
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
    variant: Any = getattr(mi, of)
    middle = (starts + ends) / 2
    corners = (middle, -1), (2 * starts - middle, 1), (2 * ends - middle, 1)
    places = np.concatenate([np.insert(corner, 2, z, axis=1) for corner, z in corners])
    mesh = mitsuba_mesh.make(variant, places, np.arange(len(places)).reshape(3, -1).T)
    # mi.load_dict would build for the variant that is set now.
    config = mi.parser.ParserConfig(of)
    state = mi.parser.parse_dict(config, {"type": "scene", "strokes": mesh})
    mi.parser.transform_all(config, state)
    return mi.parser.instantiate(config, state)


def _wedge_shares(a: Array, b: Array, vertices: Vertices) -> Array:
    """M × 2: the share of each segment, from either end, where the next one at that vertex is within 4 MARGIN."""
    ways = np.stack([b - a, a - b], 1).reshape(-1, 2)
    angle, number = np.arctan2(ways[:, 1], ways[:, 0]), vertices.ravel()
    order = np.lexsort([angle, number])
    begin = np.searchsorted(number[order], number[order])
    end = np.searchsorted(number[order], number[order], side="right")
    after = np.arange(1, len(order) + 1)
    after = np.where(after < end, after, begin)
    # The angle to the next segment at the same vertex; half a turn where there is no other.
    turn = (angle[order[after]] - angle[order]) % (2 * np.pi)
    turn[end - begin == 1] = np.pi
    least = np.full(len(order), np.pi)
    np.minimum.at(least, order, turn)
    np.minimum.at(least, order[after], turn)
    with np.errstate(divide="ignore"):
        reach = 4 * MARGIN / np.sin(np.minimum(least, np.pi / 2))
        return np.asarray(reach.reshape(-1, 2) / np.linalg.norm(b - a, axis=1, keepdims=True))


def _around(vertices: Vertices) -> tuple[Any, Any]:
    """(first, around): stroke i names the segments in `around` from first[i] to the next NOWHERE, but not its own."""
    order = np.argsort(vertices.ravel(), kind="stable")
    degree = np.bincount(vertices.ravel())
    count = len(degree)
    begin = np.cumsum(degree) - degree
    # A stroke names all segments at its vertex, or at its two vertices.
    segments = np.arange(len(vertices))
    strokes = np.concatenate([segments, segments, len(vertices) + np.arange(count)])
    of = np.concatenate([*vertices.T, np.arange(count)])
    sizes = degree[of]
    within = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    strokes, named = np.repeat(strokes, sizes), order[np.repeat(begin[of], sizes) + within] // 2
    others = np.flatnonzero(strokes != named)
    others = others[np.argsort(strokes[others], kind="stable")]
    strokes, named = strokes[others], named[others]
    # A NOWHERE ends each list.
    around = np.full(len(named) + len(vertices) + count, NOWHERE)
    around[np.arange(len(named)) + strokes] = named
    lengths = np.bincount(strokes, minlength=len(vertices) + count) + 1
    return np.cumsum(lengths) - lengths, around

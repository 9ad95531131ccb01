"""Candidates for the first boundary ahead, from Mitsuba's own ray tracing: boundaries as a mesh seen from above.

Of each segment and of each vertex the mesh holds a triangle upright on the plane, which cuts the plane in a stroke:
the segment, longer by MARGIN at either end, and across each vertex a stroke of 2 MARGIN. Mitsuba works in float32, so
its ray, with the start moved off its segment by OFFSET, is up to ε < MARGIN from the one that is meant. But a ray that
crosses a segment within ε of a place crosses that segment's stroke, its neighbour's, or that of a vertex between:
so the strokes met, in their order, name every segment that `crossings` must try; what it says is exact. In a wedge,
where neighbours are within 4 MARGIN of one another (`_narrow`), that order means nothing: all of a vertex are tried.
Lengths here are in units of half the scene's extent.

Precondition: no segment is shorter than SHORTEST, and none nearer to another that shares no vertex with it. The first
is sure, the second is seen at each segment's middle and quarters (`crowded`); where it is broken elsewhere a ray may
miss a film there, or meet its two sides in the wrong order, and be contradicted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.backend import activate

from .array_backend import Lanes, negated
from .intersect_segments import NOWHERE, Hit, Ray, Start, Straight

MARGIN = 2.0**-19
OFFSET = 2.0**-21
SHORTEST = 2 * MARGIN
STEP = 2.0**-22  # past a stroke that was no hit
BACK = 2.0**-6  # behind a start in the open, which may be within ε of a boundary, down to grazing angles of ε/BACK
BESIDE = 2.0**-5  # from ray to ray, in place and direction; where it is more, looking ray by ray takes half the time
SAMPLE = 4096  # rays


@dataclass
class SearchState:
    """How far along a ray it has been looked, and the nearest segment `held` that was found beyond, or NOWHERE."""

    gone: Any
    held: Any


class Extrusion:
    """Strokes of M straight segments (`start`, `end`, M × 2, and `vertices`), and which segments each of them names."""

    def __init__(self, lanes: Lanes, start: Any, end: Any, vertices: Any) -> None:
        import mitsuba

        self.lanes, self.coherent = lanes, True
        variant = "scalar_rgb" if lanes.backend == "scalar" else f"{lanes.backend}_ad_rgb"
        self.mi: Any = getattr(mitsuba, variant)
        low, high = (f(np.concatenate([start, end]), axis=0) for f in (np.min, np.max))
        self.centre, self.half = (low + high) / 2, float((high - low).max() / 2)
        a, b = ((x - self.centre) / self.half for x in (start, end))
        starts, ends = _strokes(a, b, vertices)
        self.scene = _upright(variant, starts, ends)
        self.crowded = self._crowded(a, b, vertices)
        self.narrow = lanes.table(_narrow(a, b, vertices))
        first, around = _around(vertices, len(starts) - len(a))
        self.first, self.around = lanes.table(first), lanes.table(around)

    def expect(self, origins: Any, directions: Any) -> None:
        """Rays in this order (N × 2): one beside the other, or each anywhere, for which Embree has two ways to look."""
        places, turns = origins[:SAMPLE] / self.half, directions[:SAMPLE]
        turns = turns / np.abs(turns).max(axis=1, keepdims=True)
        steps = (np.abs(np.diff(x, axis=0)).sum(1) for x in (places, turns))
        self.coherent = len(origins) < 2 or float(np.median(sum(steps))) < BESIDE

    def nearest(
        self, boundaries: Straight, ray: Ray, start: Start, look: SearchState, active: Any
    ) -> tuple[Hit, SearchState, Any]:
        """The first boundary ahead, from where to look on for what might come before it, and whether nothing does."""
        found, t, stroke = self._stroke(dr.fma(ray.d, look.gone, self._aside(ray, start)), ray.d, active)
        own = active & (ray.own != NOWHERE)
        corner = own & self._near_end(ray.own, ray, own)

        def tried(best: Hit, stroke: Any, found: Any, corner: Any, held: Any) -> Hit:
            best = boundaries.nearer(best, ray, start, stroke, found & (stroke < boundaries.count))
            # Where neighbours are within MARGIN they are tried by hand: they may be met in any order, and the start may
            # lie beyond one, or beyond the stroke of the vertex between.
            vague = found & self._near_end(best.segment, best, found)
            lists = dr.select(vague, stroke, NOWHERE), dr.select(corner, ray.own, NOWHERE)
            return self._also(best, boundaries, ray, start, held, lists)

        # A branch, since all rays of a beam leave together.
        held = dr.select(active, look.held, NOWHERE)
        given = boundaries.none(), stroke, found, corner, held
        best = dr.if_stmt(given, found | corner | (held != NOWHERE), tried, lambda best, *_: best, label="stroke")
        gone = look.gone + t
        settled = negated(found) | (best.distance * (1 / self.half) <= gone + MARGIN)
        return best, SearchState(gone + STEP, best.segment), settled

    def _near_end(self, segment: Any, at: Hit | Ray, active: Any) -> Any:
        """Whether a place on a segment is where the next one at either end is near; true of no segment."""
        some = active & (segment != NOWHERE)
        near_a, near_b = self.lanes.gather(self.narrow, segment, some)
        return negated(some) | (at.r < near_a) | (at.s < near_b)

    def _crowded(self, a: Any, b: Any, vertices: Any) -> tuple[int, int] | None:
        """A segment and one that shares no vertex with it, less than SHORTEST from its middle or a quarter of it."""
        e = b - a
        across = np.column_stack([-e[:, 1], e[:, 0]]) / np.maximum(np.linalg.norm(e, axis=1, keepdims=True), 1e-300)
        for share in (0.25, 0.5, 0.75):
            for d in (across, -across):
                stroke = self._within(a + share * e + OFFSET * d, d)
                seen = np.flatnonzero(stroke < len(a))
                other = stroke[seen]
                apart = (vertices[seen, :, None] != vertices[other][:, None]).all((1, 2))
                if apart.any():
                    return int(seen[apart][0]), int(other[apart][0])
        return None

    def _within(self, q: Any, d: Any) -> Any:
        """The stroke that a ray meets within SHORTEST, NOWHERE for none: of N rays as numpy arrays, N × 2."""
        to, nearby = self.lanes, {"nearby": self.lanes.buffer(self.lanes.index, NOWHERE, (1, len(q)))}
        places, directions = to.table(q), to.table(d)

        def work(lane: Any, scatter: Any) -> None:
            found, t, stroke = self._stroke(to.gather(places, lane), to.gather(directions, lane), to.mask(True))
            scatter("nearby", 0, stroke, found & (t < SHORTEST))

        return to.run(len(q), nearby, work)["nearby"][0]

    def _aside(self, ray: Ray, start: Start) -> Any:
        """Where to look from: the ray's start, moved off the segment that it is on, to the side to which it goes."""
        q = (ray.p - self.lanes.vector(*self.centre.tolist())) * (1 / self.half)
        a, b = start.ways
        x, y = (self.mi.Float(e) for e in b - a)
        size = dr.select(ray.left, OFFSET, -OFFSET) * dr.rsqrt(dr.fma(x, x, y * y))
        number = self.lanes.number
        return dr.select(ray.own != NOWHERE, type(q)(q.x - number(y * size), q.y + number(x * size)), q)

    def _stroke(self, q: Any, d: Any, active: Any) -> tuple[Any, Any, Any]:
        """Whether a stroke is ahead, how far, and its number."""
        mi, number = self.mi, self.mi.Float
        ray = mi.Ray3f(mi.Point3f(number(q.x), number(q.y), 0), mi.Vector3f(number(d.x), number(d.y), 0))
        seen = self.scene.ray_intersect_preliminary(ray, self.coherent, active)
        return active & seen.is_valid(), self.lanes.number(seen.t), self.lanes.index(seen.prim_index)

    def _also(self, best: Hit, boundaries: Straight, ray: Ray, start: Start, held: Any, strokes: Any) -> Hit:
        """`best`, or what comes before it: the segment `held`, and those that two strokes name; NOWHERE for none."""
        later, sooner = strokes
        gather = self.lanes.gather

        def test(i: Any, stroke: Any, best: Hit, going: Any) -> tuple[Any, Any, Hit, Any]:
            listed = going & (i > 0) & (stroke != NOWHERE)
            named = gather(self.around, gather(self.first, stroke, listed) + i - 1, listed)
            segment = dr.select(i == 0, held, dr.select(listed, named, NOWHERE))
            end = segment == NOWHERE
            best = boundaries.nearer(best, ray, start, segment, going & negated(end))
            more = going & (negated(end) | ((stroke != later) & (later != NOWHERE)))
            return dr.select(end, 1, i + 1), dr.select(end, later, stroke), best, more

        stroke = dr.select(sooner == NOWHERE, later, sooner)
        some = (held != NOWHERE) | (stroke != NOWHERE)
        state = dr.select(held == NOWHERE, self.lanes.index(1), 0), stroke, best, some
        return dr.while_loop(state, lambda i, stroke, best, going: going, test, label="also")[2]


def _strokes(a: Any, b: Any, vertices: Any) -> tuple[Any, Any]:
    """Both ends of every stroke: of the segments from `a` to `b`, then of the vertices."""
    e = b - a
    length = np.linalg.norm(e, axis=1, keepdims=True)
    e = np.divide(e, length, out=np.zeros_like(e), where=length > 0)
    # Across the principal axis of the directions that leave a vertex, which are strokes themselves.
    number = vertices.ravel()
    xx, xy, yy = (np.bincount(number, np.repeat(e[:, i] * e[:, j], 2)) for i, j in ((0, 0), (0, 1), (1, 1)))
    angle = np.arctan2(2 * xy, xx - yy) / 2
    across = MARGIN * np.column_stack([-np.sin(angle), np.cos(angle)])
    place = np.empty((len(across), 2))
    place[number] = np.stack([a, b], 1).reshape(-1, 2)
    return np.concatenate([a - MARGIN * e, place - across]), np.concatenate([b + MARGIN * e, place + across])


def _narrow(a: Any, b: Any, vertices: Any) -> Any:
    """The share of each segment, from either end, where the next one at that vertex is within 4 MARGIN; M × 2."""
    ways = np.stack([b - a, a - b], 1).reshape(-1, 2)
    angle, number = np.arctan2(ways[:, 1], ways[:, 0]), vertices.ravel()
    order = np.lexsort([angle, number])
    begin = np.searchsorted(number[order], number[order])
    end = np.searchsorted(number[order], number[order], side="right")
    after = np.arange(1, len(order) + 1)
    after = np.where(after < end, after, begin)
    # The angle to the next way out of the same vertex; a full turn where there is no other.
    turn = (angle[order[after]] - angle[order]) % (2 * np.pi)
    turn[end - begin == 1] = np.pi
    least = np.full(len(order), np.pi)
    np.minimum.at(least, order, turn)
    np.minimum.at(least, order[after], turn)
    with np.errstate(divide="ignore"):
        reach = 4 * MARGIN / np.sin(np.minimum(least, np.pi / 2))
        return reach.reshape(-1, 2) / np.linalg.norm(b - a, axis=1, keepdims=True)


def _upright(of: str, a: Any, b: Any) -> Any:
    """A scene of the variant `of`: one triangle per stroke, which cuts the plane z = 0 from `a` to `b`."""
    import mitsuba as mi

    if mi.variant() is None:
        activate()
    variant: Any = getattr(mi, of)
    count, middle, below, above = len(a), (a + b) / 2, -np.ones(len(a)), np.ones(len(a))
    corners = (middle, below), (2 * a - middle, above), (2 * b - middle, above)
    mesh = variant.Mesh("strokes", 3 * count, count)
    parameters = mi.traverse(mesh)
    places = np.concatenate([np.column_stack(corner) for corner in corners])
    faces = np.arange(3 * count, dtype=np.uint32).reshape(3, count).T
    for name, values in (("vertex_positions", places.astype(np.float32)), ("faces", faces)):
        parameters[name] = type(parameters[name])(values.ravel())
    parameters.update()
    # mi.load_dict would build for the present variant.
    config = mi.parser.ParserConfig(of)
    state = mi.parser.parse_dict(config, {"type": "scene", "strokes": mesh})
    mi.parser.transform_all(config, state)
    return mi.parser.instantiate(config, state)


def _around(vertices: Any, count: int) -> tuple[Any, Any]:
    """For stroke i the segments it names: `around` from first[i] to the next NOWHERE; of a segment, not itself.

    `count`: of the strokes of vertices.
    """
    order = np.argsort(vertices.ravel(), kind="stable")
    degree = np.bincount(vertices.ravel(), minlength=count)
    begin = np.cumsum(degree) - degree
    # Every stroke's list is that of its vertex or of its two.
    segments = np.arange(len(vertices))
    strokes = np.concatenate([segments, segments, len(vertices) + np.arange(count)])
    of = np.concatenate([*vertices.T, np.arange(count)])
    sizes = degree[of]
    within = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    strokes, named = np.repeat(strokes, sizes), order[np.repeat(begin[of], sizes) + within] // 2
    others = np.flatnonzero(strokes != named)
    others = others[np.argsort(strokes[others], kind="stable")]
    strokes, named = strokes[others], named[others]
    # With room for a NOWHERE after each.
    around = np.full(len(named) + len(vertices) + count, NOWHERE)
    around[np.arange(len(named)) + strokes] = named
    lengths = np.bincount(strokes, minlength=len(vertices) + count) + 1
    return np.cumsum(lengths) - lengths, around

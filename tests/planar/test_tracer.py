"""The planar tracer on every backend and precision: crossings, vertices, starts, media, arcs, and bad input."""

import dataclasses
import math

import drjit as dr
import numpy as np
import pytest
from support.planar_scenes import SQUARE, ball, polygon, star, story, together

from mi_refract.backend import Backend
from mi_refract.formulas import FORMULAS
from mi_refract.planar import Event, Segments, array_backend, trace

REFRACTED, REFLECTED, ESCAPED = Event.REFRACTED, Event.REFLECTED, Event.ESCAPED
MISMATCH, MAX_DEPTH = Event.MEDIUM_MISMATCH, Event.MAX_DEPTH


def test_a_slab_shifts_a_ray_by_snells_law(follow, setting):
    angle, n, width = 0.7, 1.5, 2.0
    slab = polygon([(0, -50), (width, -50), (width, 50), (0, 50)], n)
    d = np.array([math.cos(angle), math.sin(angle)])
    paths = follow(slab, -3 * d, d)
    assert story(paths) == ([3, 1], [REFRACTED, REFRACTED, ESCAPED])
    exact = [-3 * d, (0, 0), (width, width * math.tan(math.asin(math.sin(angle) / n)))]
    assert paths.points[0, :3] == pytest.approx(np.array(exact), abs=16 * setting.roundoff)
    assert paths.directions[0] == pytest.approx(d, abs=8 * setting.roundoff)
    assert paths.indices[0, :3].tolist() == [1, 1.5, 1]
    assert np.isnan(paths.points[0, 3:]).all()


def test_total_reflection_in_a_light_guide_loses_no_power(follow):
    paths = follow(polygon([(0, 0), (60, 0), (60, 1), (0, 1)]), (-1, 0.5), (1, 0.5), max_depth=100)
    hits, events = story(paths)
    assert hits[0] == 3 and events.count(REFLECTED) >= 10
    # At the end face, the path may be trapped by reflections in the corner: check the guide before it.
    guided = paths.weights[0, 1 : events.index(REFLECTED) + 10]
    assert (guided == guided[0]).all()


def test_rays_along_a_boundary_between_equal_media_pass_it(follow, setting):
    """Rounding takes the sine of some of them beyond 1."""
    rng = np.random.default_rng(0)
    for turn in rng.uniform(0, 2 * np.pi, 10):
        along, across = np.array([(math.cos(turn), math.sin(turn)), (-math.sin(turn), math.cos(turn))])
        line = Segments([-50 * along], [50 * along], [1.5], [1.5])
        angle = rng.uniform(0.5, 1, (200, 1)) * math.sqrt(setting.roundoff)
        d = np.cos(angle) * along + np.sin(angle) * across
        paths = follow(line, rng.uniform(-10, 10, (200, 1)) * along - 20 * d, d)
        assert (paths.events[:, :2] == [REFRACTED, ESCAPED]).all()
        assert paths.weights[:, 1] == pytest.approx(1, abs=4 * setting.roundoff)
        assert paths.directions == pytest.approx(d, abs=4 * math.sqrt(setting.roundoff))


def test_all_formulas_give_the_same_paths(follow, setting):
    o, d = np.array([(-1, y) for y in (0.21, 0.43, 0.77)]), np.array([(1, 0.3), (1, -0.2), (1, 0.1)])
    planar = follow(polygon(SQUARE), o, d)
    for name, formula in FORMULAS.items():
        paths = follow(polygon(SQUARE), o, d, formula=name)
        assert (paths.hits == planar.hits).all(), name
        bound = 40 * formula.budget.chord(setting.roundoff, 1.5, 0.5)
        assert np.nanmax(np.abs(paths.points - planar.points)) <= bound, name


@pytest.mark.parametrize("method", ["brute", "mesh"])
def test_scenes_of_the_same_kind_share_their_kernels(vectorised, method):
    def kernels(corners, radius, rays, depth):
        angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)
        segments = polygon(radius * np.column_stack([np.cos(angle), np.sin(angle)]))
        origins = np.column_stack([np.full(rays, -3 * radius), np.linspace(-0.4, 0.5, rays) * radius])
        options = {"precision": vectorised.name, "backend": vectorised.backend, "method": method}
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            trace(segments, origins, np.broadcast_to([1.0, 0.0], (rays, 2)), depth, **options)
            return {entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])}

    first = kernels(8, 1, 40, 4)
    assert first
    assert all(kernels(*other) == first for other in ((9, 2.5, 40, 4), (30, 0.3, 70, 9), (5, 40, 50, 2)))


# Vertices ------------------------------------------------------------------------------------------------------


def test_a_ray_through_a_shared_vertex_crosses_one_segment(follow):
    """The boundary is a zigzag from far left to far right with air above and glass below."""
    rng = np.random.default_rng(7)
    x = np.concatenate([[-100], np.sort(rng.uniform(-1, 1, 20)), [100]])
    places = np.column_stack([x, np.concatenate([[0], rng.uniform(-0.01, 0.01, 20), [0]])])
    boundary = Segments(places[:-1], places[1:], np.ones(21), np.full(21, 1.5))
    vertices = boundary.end[rng.integers(0, 20, 300)]
    origins = vertices + np.column_stack([rng.uniform(-2, 2, 300), rng.uniform(1, 2, 300)])
    paths = follow(boundary, origins, vertices - origins, max_depth=4)
    assert (paths.events[:, 0] == REFRACTED).all() and (paths.hits[:, 1:] == -1).all()
    assert (paths.indices[:, 1] == np.float32(1.5)).all()


def test_rays_enter_and_leave_a_closed_outline_equally_often(follow):
    """Rays aimed at the tips and notches of a star end outside in air, or are trapped inside."""
    figure, rng = star(60), np.random.default_rng(3)
    origins = rng.normal(size=(200, 2)) * 0.3 + [3, 0]
    paths = follow(figure, origins, figure.start[rng.integers(0, 60, 200)] - origins, max_depth=40)
    assert not (paths.events == MISMATCH).any()
    last = (paths.events != Event.NONE).sum(1) - 1
    escaped = (paths.events[np.arange(200), last] == ESCAPED) & (last > 0)
    assert (paths.indices[np.arange(200), last][escaped] == 1).all() and escaped.sum() > 100


TIP, UNIT = polygon([(0, 0), (1, 0.5), (0, 1)]), polygon(SQUARE)
TURNED = Segments(UNIT.start, UNIT.end, [1.5, 1, 1.5, 1.5], [1, 1.5, 1, 1])  # its right side has the wrong direction
INNER = polygon([(0.25, 0.25), (0.75, 0.25), (0.75, 0.75), (0.25, 0.75)], 1.33, outside=1.5)
# A vertex inside a segment: index 1.5 below, 1.0 above on the left, and 1.3 above on the right, where the horizontal
# segment has 1.0.
WHOLE = Segments([(-9, 0), (0, 0)], [(9, 0), (0, 9)], np.ones(2), [1.5, 1.3])
# Three media about (0, 0): 1.5 below, 1.0 above on the left, 1.3 above on the right.
JUNCTION = Segments(np.zeros((3, 2)), [(-9, 0), (9, 0), (0, 9)], [1.5, 1.3, 1.0], [1.0, 1.5, 1.3])
STORIES = {  # segments, origin, direction, options; expected hits, events, indices of the media
    "up along a tip: displaced to the right, it misses": (TIP, (1, -1), (0, 1), {}, [], [ESCAPED], None),
    "down along a tip: it enters": (TIP, (1, 2), (0, -1), {}, [1, 0], [REFRACTED, REFRACTED, ESCAPED], None),
    "along a side on its right": (UNIT, (-1, 0), (1, 0), {}, [], [ESCAPED], None),
    "along a side on its left": (UNIT, (2, 0), (-1, 0), {}, [1, 3], [REFRACTED, REFRACTED, ESCAPED], None),
    "media within media": (
        *(together(UNIT, INNER), (-1, 0.5), (1, 0.01), {}, [3, 7, 5, 1], [*[REFRACTED] * 4, ESCAPED]),
        [1, 1.5, 1.33, 1.5, 1],
    ),
    "the first boundary gives the medium": (UNIT, (0.5, 0.5), (1, 0), {}, [1], [REFRACTED, ESCAPED], [1.5, 1]),
    "or n_start": (UNIT, (0.5, 0.5), (1, 0), {"n_start": 1.5}, [1], [REFRACTED, ESCAPED], [1.5, 1]),
    "n_start contradicts the first boundary": (UNIT, (0.5, 0.5), (1, 0), {"n_start": 1.25}, [1], [MISMATCH], [1.25]),
    "no boundary, no medium": (UNIT, (2, 2), (1, 0), {}, [], [ESCAPED], [math.nan]),
    "a side with the wrong direction": (TURNED, (-1, 0.5), (1, 0), {}, [3, 1], [REFRACTED, MISMATCH], [1, 1.5]),
    "a junction from straight above": (JUNCTION, (0, 2), (0, -1), {}, [0], [REFRACTED, ESCAPED], [1, 1.5]),
    "a vertex in a segment": (WHOLE, (3, 1), (-0.1, -1), {"n_start": 1.3}, [0], [MISMATCH], [1.3]),
    "a vertex in a segment, other side": (WHOLE, (-3, 1), (0.1, -1), {}, [0], [REFRACTED, ESCAPED], [1, 1.5]),
    "max_depth": (UNIT, (-1, 0.5), (1, 0), {"max_depth": 1}, [3], [REFRACTED, MAX_DEPTH], [1, 1.5]),
    "max_depth and nothing ahead": (
        *(UNIT, (-1, 0.5), (1, 0), {"max_depth": 2}, [3, 1], [REFRACTED, REFRACTED, ESCAPED]),
        [1, 1.5, 1],
    ),
    **{
        f"only segments of length zero, {method}": (
            *(together(*[polygon([(0.5, 0.5)])] * 60), (0, 0), (1, 1), {"method": method}, [], [ESCAPED]),
            [math.nan],
        )
        for method in ("auto", "brute", "mesh")
    },
}


@pytest.mark.parametrize("case", STORIES)
def test_a_ray_through_vertices_and_media(follow, setting, case):
    segments, origin, direction, options, hits, events, indices = STORIES[case]
    paths = follow(segments, origin, direction, **options)
    assert story(paths) == (hits, events)
    if indices:
        rounded = np.array(indices, setting.name)
        assert np.array_equal(paths.indices[0, : len(indices)], rounded, equal_nan=True)
    if 0 in direction and (segments is UNIT or segments is TURNED):  # the ray is perpendicular to the sides
        across = direction.index(0)
        places = paths.points[0, : len(hits) + 1]
        assert (places[:, across] == origin[across]).all() and np.isin(places[1:, 1 - across], (0, 1)).all()
        assert paths.directions[0].tolist() == list(direction)
    if events[-1] == MISMATCH:  # the path ends with the direction that it arrived with
        assert paths.directions[0] == pytest.approx(np.array(direction) / math.hypot(*direction), abs=1e-7)
        assert np.isfinite(paths.points[0, len(hits)]).all() and not np.isfinite(paths.points[0, len(hits) + 1 :]).any()


def test_segments_of_length_zero_are_ignored(follow):
    dots = polygon([(0.5, 0.5)], n=9.0)
    o, d = np.array([(-1, 0.25), (0.5, -1), (-1, -0.5), (-1, 0.5)]), np.array([(1, 0.1), (0, 1), (1, 1), (1, 0)])
    plain, dotted = (follow(segments, o, d) for segments in (UNIT, together(UNIT, dots)))
    for expected, values in zip(dataclasses.astuple(plain), dataclasses.astuple(dotted), strict=True):
        assert np.array_equal(values, expected, equal_nan=True)


def test_a_ray_does_not_meet_the_segment_that_it_starts_on(follow):
    square = polygon([(0, 0), (0.9, 0.1), (1, 1.1), (0.2, 0.8)])
    share = np.repeat([0.1, 1 / 3, 0.7], 4)[:, None]
    a, e = np.tile(square.start, (3, 1)), np.tile(square.end - square.start, (3, 1))
    inward = np.column_stack([-e[:, 1], e[:, 0]])
    within, outward = (follow(square, a + share * e, direction) for direction in (inward, -inward))
    assert (within.hits[:, 0] != np.tile(np.arange(4), 3)).all() and (within.indices[:, 0] == 1.5).all()
    assert (outward.events[:, 0] == ESCAPED).all()


@pytest.mark.parametrize("weight", [None, 0.5, 1.0, 2.0])
def test_a_ray_does_not_meet_the_boundary_that_it_starts_on_at_the_coordinate_origin(follow, weight):
    """There only the ends of the boundary are rounded; each boundary goes exactly through (0, 0)."""
    ends, angle = np.random.default_rng(1).integers(-127, 128, (2, 20, 2)) / 128, np.linspace(-1, 1, 21)
    for a, b in ends.swapaxes(0, 1):
        if weight is None:
            a /= 3  # a rounded number
            boundary, along = Segments([-a], [a], [1.5], [1.0]), np.array([-a[1], a[0]]) / np.hypot(*a)
            turned = np.column_stack([np.cos(angle), np.sin(angle)])
            directions = turned @ np.array([along, (-along[1], along[0])])
            directions = np.concatenate([directions, -directions])
        else:  # no other place of the arc is on a line along a + b
            boundary = Segments([a], [b], [1.5], [1.0], [-(a + b) / (2 * weight)], [weight])
            directions = np.array([a + b, -a - b])
        assert (follow(boundary, np.zeros_like(directions), directions).events[:, 0] == ESCAPED).all()


def test_a_ray_meets_a_long_level_boundary_that_it_starts_close_to(follow):
    ground = Segments([(-1000, 0)], [(1000, 0)], [1.0], [1.5])
    assert story(follow(ground, (0, 1e-5), (0.5, -1)))[1] == [REFRACTED, ESCAPED]


def test_a_ray_through_a_junction_crosses_its_boundaries_in_order(follow):
    angle = np.linspace(0, 2 * np.pi, 41)[:-1] + 0.05
    origins = 2 * np.column_stack([np.cos(angle), np.sin(angle)])
    paths = follow(JUNCTION, origins, -origins, max_depth=8)
    assert not (paths.events == MISMATCH).any()
    assert (paths.events == ESCAPED).any(axis=1).all()


def test_reflect_bits_choose_the_boundaries_that_reflect(follow):
    paths = follow(UNIT, [(-1, 0.5)] * 4, [(1, 0)] * 4, max_depth=6, reflect=[0, 1, 2, 6])
    stories = [story(paths, i) for i in range(4)]
    assert stories == [
        ([3, 1], [REFRACTED, REFRACTED, ESCAPED]),
        ([3], [REFLECTED, ESCAPED]),
        ([3, 1, 3], [REFRACTED, REFLECTED, REFRACTED, ESCAPED]),
        ([3, 1, 3, 1], [REFRACTED, REFLECTED, REFLECTED, REFRACTED, ESCAPED]),
    ]
    r = 0.2**2
    powers = [(1 - r) ** 2, r, r * (1 - r) ** 2, r**2 * (1 - r) ** 2]
    assert [paths.weights[i, len(stories[i][0])] for i in range(4)] == pytest.approx(powers, rel=1e-6)


def test_a_ray_along_a_side_stays_on_its_side(follow):
    """Rounding may hide the sign of its cosine: then its medium would be inside and its direction outside."""
    square = np.array(SQUARE, float) - 0.5
    for turn in np.radians(np.arange(0, 90, 1.1)):
        c, s = math.cos(turn), math.sin(turn)
        figure = polygon(square @ np.array([(c, s), (-s, c)]), 1.25)
        along = figure.end - figure.start
        along = np.concatenate([along, -along])
        paths = follow(figure, np.concatenate([figure.start, figure.end]) - along, along, max_depth=1, n_start=1.0)
        refracted = paths.events[:, 0] == REFRACTED
        side, d = (figure.end - figure.start)[paths.hits[refracted, 0]], paths.directions[refracted]
        assert (side[:, 0] * d[:, 1] - side[:, 1] * d[:, 0] > 0).all()


# Arcs ----------------------------------------------------------------------------------------------------------


def arcs_of_circle(turn, count=4):
    """A circle of glass made of arcs, the first of which starts at the angle `turn`."""
    half = math.pi / count
    angle = turn + 2 * half * np.arange(count)
    start, control = (np.column_stack([np.cos(x), np.sin(x)]) for x in (angle, angle + half))
    media, weight = (np.full(count, 1.5), np.ones(count)), np.full(count, math.cos(half))
    return Segments(start, np.roll(start, -1, axis=0), *media, control / math.cos(half), weight)


def test_a_ball_turns_a_ray_by_twice_the_difference_of_its_angles(follow, setting):
    height = np.array([-0.95, -0.5, -0.1, 0.0, 0.3, 0.8])
    paths = follow(ball(), np.column_stack([-3 + 0 * height, height]), np.tile([1.0, 0.0], (6, 1)))
    assert (paths.events[:, :3] == [REFRACTED, REFRACTED, ESCAPED]).all()
    turned = np.arctan2(paths.directions[:, 1], paths.directions[:, 0])
    assert turned == pytest.approx(-2 * (np.arcsin(height) - np.arcsin(height / 1.5)), abs=40 * setting.roundoff)
    assert np.hypot(*paths.points[:, 1:3].T) == pytest.approx(1, abs=4 * setting.roundoff)


@pytest.mark.parametrize("grazing", [0.5, 1e-2, 1e-3])
def test_each_reflection_inside_a_ball_turns_a_ray_by_the_same_angle(follow, setting, grazing):
    """Chords of angle 2 α, many of them within one arc; no reflection is skipped, and no ray leaks at the joints."""
    count = 500
    start = np.array([math.cos(0.3), math.sin(0.3)]) * math.cos(grazing)
    paths = follow(ball(), start, (-math.sin(0.3), math.cos(0.3)), max_depth=count)
    assert story(paths)[1] == [REFLECTED] * count + [MAX_DEPTH]
    assert paths.weights == pytest.approx(1, abs=4 * count * setting.roundoff)
    angle = np.unwrap(np.arctan2(*paths.points[0, 1:, ::-1].T))
    # The error of a chord is u of the place over the grazing angle; the error of the angle grows with their number.
    bound = 60 * count**0.5 * setting.roundoff / grazing
    assert np.diff(angle.astype(float)) == pytest.approx(2 * grazing, abs=bound)


def test_rays_that_miss_the_chord_of_an_arc_meet_the_arc(follow):
    """A ray at height 0.99 crosses the ball's top arc twice, but not its chord."""
    paths = follow(arcs_of_circle(-math.pi / 4), (-3, 0.99), (1, 0), formula="promoted")
    assert story(paths)[0][0] == 1
    assert paths.points[0, 1] == pytest.approx([-math.sqrt(1 - 0.99**2), 0.99], abs=1e-6)


def test_arcs_that_meet_in_a_tip_are_crossed_in_order(follow):
    """Rays aimed at the rim of a lens of two arcs enter before they leave, whichever arc is listed first."""
    for order in ([0, 1], [1, 0]):
        start, end = np.array([(0.0, 1.0), (0.0, -1.0)]), np.array([(0.0, -1.0), (0.0, 1.0)])
        control, weight = np.array([(-0.5, 0.0), (0.5, 0.0)]), np.full(2, 0.8)
        lens = Segments(start[order], end[order], np.full(2, 1.5), np.ones(2), control[order], weight)
        angle = np.linspace(0, 2 * np.pi, 61)[:-1] + 0.01
        origins = np.array([0, 1]) + 3 * np.column_stack([np.cos(angle), np.sin(angle)])
        paths = follow(lens, origins, [0, 1] - origins, max_depth=8)
        assert not (paths.events == MISMATCH).any()
        met = (paths.hits[:, 0] >= 0) & (origins[:, 1] > 1)
        assert met.any() and (paths.indices[met, 0] == 1).all()


@pytest.mark.parametrize("unit", [1, 1e9, 1e-9])
@pytest.mark.parametrize("inside", [False, True])
@pytest.mark.parametrize("swapped", [False, True])
def test_a_ray_through_the_contact_of_two_balls_crosses_them_in_order(follow, inside, swapped, unit):
    """The arcs have the same direction there: their curvatures decide, whichever ball is listed first.

    Rotations test this with rounded coordinates.
    """
    one, other = ball(), ball(1.3)
    x, size, around = (0.5, 0.5, 1.5) if inside else (2.0, 1.0, 1.0)
    places = {name: size * getattr(other, name) + np.array([x, 0]) for name in ("start", "end", "control")}
    other = dataclasses.replace(other, **places, n_right=np.full(4, around))
    both = together(other, one) if swapped else together(one, other)
    indices = [1, 1.5, 1.3, 1.5, 1] if inside else [1, 1.5, 1.0, 1.3, 1]
    for turn in np.linspace(0, 6, 21):
        d = np.array([math.cos(turn), math.sin(turn)])
        rotation = np.array([d, (-d[1], d[0])])
        places = {name: unit * getattr(both, name) @ rotation for name in ("start", "end", "control")}
        paths = follow(dataclasses.replace(both, **places), [-3 * unit * d, 5 * unit * d], [d, -d])
        for i, expected in enumerate([indices, indices[::-1]]):
            assert story(paths, i)[1] == [REFRACTED] * 4 + [ESCAPED]
            assert paths.indices[i, :5] == pytest.approx(expected)


@pytest.mark.parametrize("count", [3, 4, 8])
def test_rays_from_joint_to_joint_of_a_circle_stay_on_it(follow, setting, count):
    """A ray that starts within 1e-14 of a joint meets the right arc at the right place."""
    for turn in np.radians([0, 20, 33.3, 71]):
        circle = arcs_of_circle(turn, count)
        chord = np.radians(np.array([15, 40, 60, 75, 110, 160, 179]))
        joint = np.repeat(np.arange(count), len(chord))
        angle = turn + 2 * math.pi / count * joint - np.tile(chord, count)
        origins = 0.9 * np.column_stack([np.cos(angle), np.sin(angle)]) + 0.1 * circle.start[joint]
        # The bits request reflection where it would not be total.
        paths = follow(circle, origins, circle.start[joint] - origins, max_depth=4, reflect=0xFFFF)
        assert (paths.events == [REFLECTED] * 4 + [MAX_DEPTH]).all()
        exact = angle[:, None] + np.tile(chord, count)[:, None] * np.arange(1, 5)
        off = np.arctan2(paths.points[:, 1:, 1], paths.points[:, 1:, 0]) - exact
        off = np.abs((off + math.pi) % (2 * math.pi) - math.pi)
        # A direction has an error of 8u and turns those behind it by twice that: 8u (1 + 3 + 5 + 7), and the angle by
        # twice this sum; plus 64u for angles up to 6π in double precision.
        assert (off <= 320 * setting.roundoff / np.sin(np.tile(chord, count) / 2)[:, None]).all()


def test_straight_segments_give_the_same_hits_among_arcs(follow):
    """Bit for bit, for rays at vertices and random rays; in the second figure the first segment is an arc."""
    rng, plain = np.random.default_rng(5), star(30)
    mixed = dataclasses.replace(plain, control=(plain.start + plain.end) / 2, weight=np.ones(30))
    mixed.control[0] += 1e-3 * (plain.end[0] - plain.start[0])[::-1] * [-1, 1]
    origins, vertices = rng.normal(size=(100, 2)), plain.start[rng.integers(0, 30, 50)]
    directions = np.concatenate([rng.normal(size=(50, 2)), vertices - origins[50:]])
    lines, arcs = (follow(segments, origins, directions) for segments in (plain, mixed))
    without_arc = (lines.hits != 0).all(1) & (arcs.hits != 0).all(1)
    assert without_arc.sum() > len(without_arc) / 2
    for name in ("hits", "events", "points", "directions"):
        expected, values = getattr(lines, name)[without_arc], getattr(arcs, name)[without_arc]
        assert np.array_equal(values, expected, equal_nan=True), name


@pytest.mark.parametrize(("control", "weight"), [((0.5, 0.0), 2.0), ((0.3, 0.0), 1.0)])
def test_a_straight_segment_may_have_any_control_point_on_it(follow, setting, control, weight):
    piece = Segments([(0, 0)], [(1, 0)], [1.5], [1.0], [control], [weight])
    assert follow(piece, (0.2, 1), (0, -1)).points[0, 1] == pytest.approx([0.2, 0], abs=4 * setting.roundoff)


# Input ---------------------------------------------------------------------------------------------------------


GOOD = {"start": [(0.0, 0.0)], "end": [(1.0, 0.0)], "n_left": [1.5], "n_right": [1.0]}
TWICE = {"start": [(0, 0), (1, 0)], "end": [(1, 0), (0, 0)], "n_left": [1.5, 1.5], "n_right": [1, 1]}
BAD_SEGMENTS = [
    ({"n_left": [0.0]}, "n_left[0] = 0.0; expected more than 0"),
    ({"n_right": [math.nan]}, "n_right[0] = nan; expected finite"),
    ({"end": [(1.0, math.inf)]}, "end[0, 1] = inf; expected finite"),
    ({"end": [(1.0, 0.0), (2.0, 0.0)]}, "end: shape (2, 2); expected (1, 2)"),
    ({"start": "here"}, "start: expected numbers"),
    ({"start": [], "end": [], "n_left": [], "n_right": []}, "none; expected at least one"),
    ({"control": [(0.0, 1.0)]}, "control and weight; expected both or neither"),
    ({"control": [(0.0, 1.0)], "weight": [-1.0]}, "weight[0] = -1.0; expected more than 0"),
    (TWICE, "segments 0 and 1 coincide"),
    (TWICE | {"control": [(0.0, 0.5), (-0.0, 0.5)], "weight": [0.9, 0.9]}, "segments 0 and 1 coincide"),
    (TWICE | {"control": [(0.5, 0.0), (0.3, 0.0)], "weight": [1.0, 2.0]}, "segments 0 and 1 coincide"),
]
BAD_ARGUMENTS = [
    ({"max_depth": 0}, "max_depth = 0; expected a whole number, 1 or more"),
    ({"max_depth": 2.5}, "max_depth = 2.5; expected"),
    ({"max_depth": True}, "max_depth = True; expected a whole number, 1 or more"),
    ({"max_depth": 2**32}, "1 rays, max_depth = 4294967296; expected a product below 2³²"),
    ({"origins": [(0.0, math.nan)]}, "origins[0, 1] = nan; expected finite"),
    ({"origins": [(0.0, 1e101)]}, "origins, relative to the segments: 1e+101; expected up to ±1.1259e+15"),
    ({"end": [(1e-300, 0.0)]}, "segments: their box is 1.5e-300 wide; expected 1e-100 or more"),
    ({"control": [(0.5, 1e101)], "weight": [1.0]}, "segments.control: 1e+101; expected up to ±1e+100"),
    ({"directions": [(0.0, 0.0)]}, "directions[0] = (0, 0); expected a direction"),
    ({"directions": [(0.0, 1.0)] * 2}, "directions: shape (2, 2); expected (1, 2)"),
    ({"formula": "sellmeier"}, "formula = 'sellmeier': unknown; expected wedge"),
    ({"precision": "float16"}, "precision = 'float16'; expected float32, float64"),
    ({"backend": "metal"}, "backend = 'metal'; expected scalar, llvm, cuda"),
    ({"method": "bvh"}, "method = 'bvh'; expected auto, brute, mesh"),
    *(({"reflect": bad}, "reflect; expected a whole number, 0 or more and below 2³²") for bad in (-1, 0.5, 2**32)),
    *(({"n_start": bad}, "n_start; expected a number above 0") for bad in (math.inf, math.nan, "air", 0)),
]


@pytest.mark.parametrize(("change", "message"), BAD_SEGMENTS + BAD_ARGUMENTS)
def test_errors_name_the_bad_input_in_one_line(change, message):
    arguments = {"origins": [(0.5, 1.0)], "directions": [(0.0, -1.0)], "max_depth": 2}
    names = GOOD.keys() | {"control", "weight"}
    with pytest.raises(ValueError) as error:
        segments = Segments(**GOOD | {key: x for key, x in change.items() if key in names})
        trace(segments, **arguments | {key: x for key, x in change.items() if key not in names})
    assert message in str(error.value) and "\n" not in str(error.value)


def test_arcs_may_share_their_ends():
    for control, weight in (([(0.5, 0.5), (0.5, -0.5)], [0.9, 0.9]), ([(0.5, 0.5)] * 2, [0.8, 0.9])):
        assert len(Segments(**TWICE, control=control, weight=weight)) == 2


def test_segments_do_not_change_with_the_arrays_that_they_were_made_from():
    arrays = {key: np.array(x) for key, x in (GOOD | {"control": [(0.5, 0.25)], "weight": [0.5]}).items()}
    segments = Segments(**arrays)
    kept = {key: x.copy() for key, x in vars(segments).items() if key in arrays}
    for x in arrays.values():
        x += 1.0
    assert all(np.array_equal(getattr(segments, key), x) for key, x in kept.items())


def test_float32_has_its_own_range(needs_variant):
    needs_variant("llvm_ad_rgb")
    bad = [({"end": [(1e16, 0.0)]}, -1.0, r"segments.end: 1e\+16; expected up to ±1e\+15")]
    bad += [({"n_left": [1e-20]}, -1.0, "segments: index 1e-20; expected at least 1e-15")]
    bad += [({"end": [(1e-20, 0.0)]}, -1.0, "segments: their box is 1.5e-20 wide; expected 1e-15 or more")]
    # From there, rounding would let rays start behind the boundaries.
    beyond = r"origins, relative to the segments: \S+; expected up to ±2.09715e\+06"
    bad += [({}, -1e8, beyond), ({"start": [(0.0, 1e9)], "end": [(1.0, 1e9)]}, 0.0, beyond)]
    for change, y, message in bad:
        with pytest.raises(ValueError, match=message):
            trace(Segments(**GOOD | change), [(0.5, y)], [(0.0, 1.0)], 2, precision="float32", backend="llvm")


@pytest.mark.parametrize(("backend", "llvm"), [("scalar", True), ("scalar", False), (None, False)])
def test_the_scalar_backend_rejects_float32(monkeypatch, backend, llvm):
    """Scalar arrays compute in double, whether the backend is requested or chosen because LLVM cannot run here."""
    usable = {"scalar": True, "llvm": llvm, "cuda": False}
    monkeypatch.setattr(array_backend, "detect", lambda: {name: Backend(name, u, "why") for name, u in usable.items()})
    with pytest.raises(ValueError) as error:
        trace(UNIT, [(0, 0)], [(0, 1)], 1, backend=backend, precision="float32")
    message = "precision = 'float32': scalar arrays compute in double; expected float64, or a compiled backend (llvm, "
    assert str(error.value) == f"{message}cuda){'' if llvm else '; llvm cannot run here: why'}"


@pytest.mark.parametrize("length", [1e-300, 1e-30, 1e30, 1e300])
def test_a_direction_may_have_any_length(follow, length):
    assert story(follow(UNIT, (-1, 0.5), (length, 0.1 * length))) == story(follow(UNIT, (-1, 0.5), (1, 0.1)))


def test_a_scene_may_be_small(follow, setting):
    size = 1e-15 if setting.name == "float32" else 1e-60
    triangle, origin = np.array([(0, 0), (1, 0), (0.3, 1)]), np.array([-1, 0.1])
    plain, small = (follow(polygon(triangle * s), origin * s, (1, 0.17)) for s in (1, size))
    assert story(small) == story(plain)
    assert small.points[0, :3] / size == pytest.approx(plain.points[0, :3], abs=16 * setting.roundoff)


@pytest.mark.parametrize("shape", [polygon([(0, 0), (1, 0), (0.25, 1)]), ball()], ids=["triangle", "ball"])
def test_a_scene_may_be_far_from_0(follow, setting, shape):
    """At 2²⁰ the steps of float32 are 0.125. Only differences of coordinates matter, and they are exact."""

    def path(x):
        moved = {name: getattr(shape, name) + x for name in ("start", "end", "control")}
        return follow(dataclasses.replace(shape, **moved), np.array([-2, 0.125]) + x, (1, 0.17))

    plain, far = path(0.0), path(2.0**20)
    assert story(far) == story(plain)
    assert far.directions == pytest.approx(plain.directions, abs=16 * setting.roundoff)


def test_no_rays_give_no_paths(follow):
    assert follow(UNIT, np.zeros((0, 2)), np.zeros((0, 2)), max_depth=3).points.shape == (0, 4, 2)

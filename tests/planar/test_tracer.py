"""The planar system: what a crossing, a vertex, a start and a medium mean, on every backend and precision."""

import dataclasses
import math

import numpy as np
import pytest
from support.planar_scenes import SQUARE, ball, polygon, star, story, together

from mi_refract.formulas import FORMULAS
from mi_refract.planar import Event, Segments

REFRACTED, REFLECTED, ESCAPED = Event.REFRACTED, Event.REFLECTED, Event.ESCAPED


def test_a_slab_shifts_a_ray_as_snells_law_says(follow, setting):
    angle, n, width = 0.7, 1.5, 2.0
    slab = polygon([(0, -50), (width, -50), (width, 50), (0, 50)], n)
    d = np.array([math.cos(angle), math.sin(angle)])
    paths = follow(slab, -3 * d, d)
    assert story(paths) == ([3, 1], [REFRACTED, REFRACTED, ESCAPED])
    inside = math.asin(math.sin(angle) / n)
    exact = [-3 * d, (0, 0), (width, width * math.tan(inside))]
    assert paths.points[0, :3] == pytest.approx(np.array(exact), abs=16 * setting.roundoff)
    assert paths.directions[0] == pytest.approx(d, abs=8 * setting.roundoff)
    assert paths.indices[0, :3].tolist() == [1, 1.5, 1]
    assert np.isnan(paths.points[0, 3:]).all()


def test_beyond_the_critical_angle_rays_are_reflected_and_nothing_is_lost(follow, setting):
    paths = follow(polygon([(0, 0), (60, 0), (60, 1), (0, 1)]), (-1, 0.5), (1, 0.5), max_depth=100)
    hits, events = story(paths)
    assert events.count(REFLECTED) >= 10
    # The last face may end the path by reflection on and on in the corner's prism; what counts is the guide.
    guided = np.array(paths.weights[0, 1 : events.index(REFLECTED) + 10])
    assert (guided == guided[0]).all()
    assert hits[0] == 3


def test_the_formulas_agree(follow, setting):
    o, d = np.array([(-1, y) for y in (0.21, 0.43, 0.77)]), np.array([(1, 0.3), (1, -0.2), (1, 0.1)])
    plain = follow(polygon(SQUARE), o, d)
    for name, formula in FORMULAS.items():
        other = follow(polygon(SQUARE), o, d, formula=name)
        assert (other.hits == plain.hits).all(), name
        bound = 40 * formula.budget.chord(setting.roundoff, 1.5, 0.5)
        assert np.nanmax(np.abs(other.points - plain.points)) <= bound, name


# Vertices ------------------------------------------------------------------------------------------------------


def zigzag(rng, count=20):
    """A boundary from far left to far right, air above, glass below."""
    x = np.concatenate([[-100], np.sort(rng.uniform(-1, 1, count)), [100]])
    points = np.column_stack([x, np.concatenate([[0], rng.uniform(-0.01, 0.01, count), [0]])])
    return Segments(points[:-1], points[1:], np.ones(count + 1), np.full(count + 1, 1.5))


def test_a_ray_through_a_shared_vertex_crosses_once(follow):
    rng = np.random.default_rng(7)
    boundary = zigzag(rng)
    vertices = boundary.end[rng.integers(0, 20, 300)]
    origins = vertices + np.column_stack([rng.uniform(-2, 2, 300), rng.uniform(1, 2, 300)])
    paths = follow(boundary, origins, vertices - origins, max_depth=4)
    assert (paths.events[:, 0] == REFRACTED).all()
    assert (paths.hits[:, 1:] == -1).all()
    assert (paths.indices[:, 1] == np.float32(1.5)).all()


def test_a_closed_outline_is_left_as_often_as_it_is_entered(follow):
    """Rays at vertices of a star, tips and notches among them, end in the medium where they began, or within it."""
    figure, rng = star(60), np.random.default_rng(3)
    origins = rng.normal(size=(200, 2)) * 0.3 + [3, 0]
    paths = follow(figure, origins, figure.start[rng.integers(0, 60, 200)] - origins, max_depth=40)
    assert not (paths.events == Event.MEDIUM_MISMATCH).any()
    last = (paths.events != Event.NONE).sum(1) - 1
    ends = paths.events[np.arange(200), last]
    assert (paths.indices[np.arange(200), last][(ends == ESCAPED) & (last > 0)] == 1).all()
    assert ((ends == ESCAPED) & (last > 0)).sum() > 100


def test_a_ray_that_grazes_a_tip_passes_it_on_its_right(follow):
    """Up along x = 1 at the tip (1, 0.5): displaced to the right it misses the glass on its left, down it enters."""
    tip = polygon([(0, 0), (1, 0.5), (0, 1)])
    assert story(follow(tip, (1, -1), (0, 1))) == ([], [ESCAPED])
    hits, events = story(follow(tip, (1, 2), (0, -1)))
    assert (hits[0], events[0]) == (1, REFRACTED)


def test_a_ray_along_a_segment_is_on_the_right_of_itself(follow):
    square = polygon(SQUARE)
    assert story(follow(square, (-1, 0), (1, 0))) == ([], [ESCAPED])
    paths = follow(square, (2, 0), (-1, 0))
    assert story(paths) == ([1, 3], [REFRACTED, REFRACTED, ESCAPED])
    assert (paths.points[0, :3, 1] == 0).all()


def test_a_segment_of_length_zero_is_no_boundary(follow):
    square = polygon(SQUARE)
    dots = polygon([(0.5, 0.5)], n=9.0)
    o, d = np.array([(-1, 0.25), (0.5, -1), (-1, -0.5), (-1, 0.5)]), np.array([(1, 0.1), (0, 1), (1, 1), (1, 0)])
    plain, dotted = (follow(segments, o, d) for segments in (square, together(square, dots)))
    for one, other in zip(dataclasses.astuple(plain), dataclasses.astuple(dotted), strict=True):
        assert np.array_equal(one, other, equal_nan=True)


# Starts --------------------------------------------------------------------------------------------------------


def test_a_ray_that_starts_on_a_segment_has_not_met_it(follow):
    square = polygon([(0, 0), (0.9, 0.1), (1, 1.1), (0.2, 0.8)])
    for share in (0.1, 1 / 3, 0.7):
        for i in range(4):
            a, b = square.start[i], square.end[i]
            inward = np.array([a[1] - b[1], b[0] - a[0]])
            within = follow(square, a + share * (b - a), inward)
            assert i not in story(within)[0][:1]
            assert within.indices[0, 0] == 1.5
            assert story(follow(square, a + share * (b - a), -inward)) == ([], [ESCAPED])


def test_the_first_boundary_tells_the_medium_unless_it_is_told(follow):
    square = polygon(SQUARE)
    assert follow(square, (0.5, 0.5), (1, 0)).indices[0, :2].tolist() == [1.5, 1]
    assert follow(square, (0.5, 0.5), (1, 0), n_start=1.5).indices[0, :2].tolist() == [1.5, 1]
    told = follow(square, (0.5, 0.5), (1, 0), n_start=1.25)
    assert story(told) == ([1], [Event.MEDIUM_MISMATCH])
    assert told.points[0, 1].tolist() == [1, 0.5]
    nowhere = follow(square, (2, 2), (1, 0))
    assert story(nowhere) == ([], [ESCAPED])
    assert np.isnan(nowhere.indices[0, 0])


# Media ---------------------------------------------------------------------------------------------------------


def test_media_may_lie_within_media(follow):
    inner = polygon([(0.25, 0.25), (0.75, 0.25), (0.75, 0.75), (0.25, 0.75)], 1.33, outside=1.5)
    paths = follow(together(polygon(SQUARE), inner), (-1, 0.5), (1, 0.01))
    assert paths.indices[0, :5] == pytest.approx([1, 1.5, 1.33, 1.5, 1], rel=1e-7)


def junction():
    """Three media about (0, 0): 1.5 below, 1.0 above on the left, 1.3 above on the right."""
    ends = np.array([(-9.0, 0.0), (9.0, 0.0), (0.0, 9.0)])
    return Segments(np.zeros((3, 2)), ends, np.array([1.5, 1.3, 1.0]), np.array([1.0, 1.5, 1.3]))


def test_at_a_junction_boundaries_are_crossed_one_after_the_other(follow):
    angle = np.linspace(0, 2 * np.pi, 41)[:-1] + 0.05
    origins = 2 * np.column_stack([np.cos(angle), np.sin(angle)])
    paths = follow(junction(), origins, -origins, max_depth=8)
    assert not (paths.events == Event.MEDIUM_MISMATCH).any()
    assert (paths.events == ESCAPED).any(axis=1).all()
    # From straight above the upright boundary is passed on its right, which is the left of the image.
    hits, _ = story(follow(junction(), (0, 2), (0, -1)))
    assert hits == [0]


def test_a_vertex_inside_another_segment_is_no_junction(follow):
    """The boundary below is one segment with 1.0 above it, on the right, too: who comes from 1.3 is told."""
    whole = Segments(
        np.array([(-9.0, 0.0), (0.0, 0.0)]), np.array([(9.0, 0.0), (0.0, 9.0)]), np.ones(2), np.array([1.5, 1.3])
    )
    assert story(follow(whole, (3, 1), (-0.1, -1), n_start=1.3)) == ([0], [Event.MEDIUM_MISMATCH])
    assert story(follow(whole, (-3, 1), (0.1, -1))) == ([0], [REFRACTED, ESCAPED])


def test_a_segment_turned_round_is_a_medium_mismatch(follow):
    square = polygon(SQUARE)
    square.n_left[1], square.n_right[1] = 1.0, 1.5
    paths = follow(square, (-1, 0.5), (1, 0))
    assert story(paths) == ([3, 1], [REFRACTED, Event.MEDIUM_MISMATCH])
    assert paths.directions[0].tolist() == [1, 0]


# Ends ----------------------------------------------------------------------------------------------------------


def test_max_depth_ends_a_path_only_where_another_boundary_is_ahead(follow):
    square = polygon(SQUARE)
    assert story(follow(square, (-1, 0.5), (1, 0), max_depth=1)) == ([3], [REFRACTED, Event.MAX_DEPTH])
    assert story(follow(square, (-1, 0.5), (1, 0), max_depth=2)) == ([3, 1], [REFRACTED, REFRACTED, ESCAPED])


def test_bits_say_where_a_ray_is_reflected(follow):
    square = polygon(SQUARE)
    paths = follow(square, [(-1, 0.5)] * 4, [(1, 0)] * 4, max_depth=6, reflect=[0, 1, 2, 6])
    stories = [story(paths, i) for i in range(4)]
    assert stories[0] == ([3, 1], [REFRACTED, REFRACTED, ESCAPED])
    assert stories[1] == ([3], [REFLECTED, ESCAPED])
    assert stories[2] == ([3, 1, 3], [REFRACTED, REFLECTED, REFRACTED, ESCAPED])
    assert stories[3] == ([3, 1, 3, 1], [REFRACTED, REFLECTED, REFLECTED, REFRACTED, ESCAPED])
    r = 0.2**2
    powers = [(1 - r) ** 2, r, r * (1 - r) ** 2, r**2 * (1 - r) ** 2]
    assert [paths.weights[i, len(stories[i][0])] for i in range(4)] == pytest.approx(powers, rel=1e-6)


# Arcs ----------------------------------------------------------------------------------------------------------


def test_a_ball_turns_a_ray_by_twice_the_difference_of_angles(follow, setting):
    height = np.array([-0.95, -0.5, -0.1, 0.0, 0.3, 0.8])
    paths = follow(ball(), np.column_stack([-3 + 0 * height, height]), np.tile([1.0, 0.0], (6, 1)))
    assert (paths.events[:, :3] == [REFRACTED, REFRACTED, ESCAPED]).all()
    turned = np.arctan2(paths.directions[:, 1], paths.directions[:, 0])
    exact = -2 * (np.arcsin(height) - np.arcsin(height / 1.5))
    assert turned == pytest.approx(exact, abs=40 * setting.roundoff)
    assert np.hypot(*paths.points[:, 1:3].T) == pytest.approx(1, abs=4 * setting.roundoff)


@pytest.mark.parametrize("grazing", [0.5, 1e-2, 1e-3])
def test_inside_a_ball_a_ray_turns_by_the_same_angle_each_time(follow, setting, grazing):
    """Chords of angle 2 α, many of them within one arc; none is skipped, none leaks at the joints."""
    count = 500
    start = np.array([math.cos(0.3), math.sin(0.3)]) * math.cos(grazing)
    along = np.array([-math.sin(0.3), math.cos(0.3)])
    paths = follow(ball(), start, along, max_depth=count)
    assert story(paths)[1] == [REFLECTED] * count + [Event.MAX_DEPTH]
    angle = np.unwrap(np.arctan2(*paths.points[0, 1:, ::-1].T))
    steps = np.diff(angle.astype(float))
    # A chord's own error: u of the place over the grazing angle, and that of the angle adds up as the rays go on.
    assert steps == pytest.approx(2 * grazing, abs=60 * count**0.5 * setting.roundoff / grazing)


def test_an_arc_is_met_by_rays_that_miss_its_chord(follow):
    """A ray at height 0.99 over the ball's top arc crosses that arc twice and the chord never."""
    turned = ball()
    s = math.sqrt(0.5)
    corner = np.array([(s, -s), (s, s), (-s, s), (-s, -s)])
    control = np.array([(2 * s, 0), (0, 2 * s), (-2 * s, 0), (0, -2 * s)])
    turned = Segments(corner, np.roll(corner, -1, 0), turned.n_left, turned.n_right, control, turned.weight)
    paths = follow(turned, (-3, 0.99), (1, 0), formula="promoted")
    assert story(paths)[0][0] == 1
    assert paths.points[0, 1] == pytest.approx([-math.sqrt(1 - 0.99**2), 0.99], abs=1e-6)


def test_arcs_that_meet_in_a_tip_are_met_in_order(follow):
    """A lens of two arcs, rays at its rim: each enters before it leaves, whichever arc is listed first."""
    for order in ([0, 1], [1, 0]):
        start, end = np.array([(0.0, 1.0), (0.0, -1.0)]), np.array([(0.0, -1.0), (0.0, 1.0)])
        control, weight = np.array([(-0.5, 0.0), (0.5, 0.0)]), np.full(2, 0.8)
        lens = Segments(start[order], end[order], np.full(2, 1.5), np.ones(2), control[order], weight)
        angle = np.linspace(0, 2 * np.pi, 61)[:-1] + 0.01
        origins = np.array([0, 1]) + 3 * np.column_stack([np.cos(angle), np.sin(angle)])
        paths = follow(lens, origins, [0, 1] - origins, max_depth=8)
        assert not (paths.events == Event.MEDIUM_MISMATCH).any()
        met = (paths.hits[:, 0] >= 0) & (origins[:, 1] > 1)
        assert met.any()
        assert (paths.indices[met, 0] == 1).all()


def moved(segments, x, size, n_outside):
    shift = np.array([x, 0.0])
    start, end, control = (size * p + shift for p in (segments.start, segments.end, segments.control))
    return dataclasses.replace(segments, start=start, end=end, control=control, n_right=np.full(4, n_outside))


@pytest.mark.parametrize("inside", [False, True])
@pytest.mark.parametrize("swapped", [False, True])
def test_balls_that_touch_are_met_in_order_by_a_ray_through_that_point(follow, inside, swapped):
    """Their arcs have one direction there; which way each bends says which comes first, whichever is listed first.

    A figure that is turned is off by rounding, and still in order.
    """
    one = ball()
    other = moved(ball(1.3), 0.5, 0.5, 1.5) if inside else moved(ball(1.3), 2.0, 1.0, 1.0)
    parts = [other, one] if swapped else [one, other]
    names = [f.name for f in dataclasses.fields(Segments)]
    both = Segments(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
    indices = [1, 1.5, 1.3, 1.5, 1] if inside else [1, 1.5, 1.0, 1.3, 1]
    for turn in np.linspace(0, 6, 21):
        d = np.array([math.cos(turn), math.sin(turn)])
        rotation = np.array([d, (-d[1], d[0])])
        places = {name: getattr(both, name) @ rotation for name in ("start", "end", "control")}
        paths = follow(dataclasses.replace(both, **places), [-3 * d, 5 * d], [d, -d])
        for i, expected in enumerate([indices, indices[::-1]]):
            assert story(paths, i)[1] == [REFRACTED] * 4 + [ESCAPED]
            assert paths.indices[i, :5] == pytest.approx(expected)


def arcs_of_circle(turn, count=4, n=1.5, middle=(0.0, 0.0), radius=1.0):
    """Arcs of a circle, the first of which starts at the angle `turn`."""
    half = math.pi / count
    angle = turn + 2 * half * np.arange(count)
    start, control = (np.column_stack([np.cos(x), np.sin(x)]) for x in (angle, angle + half))
    start, control = middle + radius * start, middle + radius * control / math.cos(half)
    end = np.roll(start, -1, axis=0)
    return Segments(start, end, np.full(count, n), np.ones(count), control, np.full(count, math.cos(half)))


@pytest.mark.parametrize("count", [3, 4, 8])
def test_rays_from_joint_to_joint_of_a_circle_stay_on_it(follow, setting, count):
    """Within 1e-14 of a joint the next point was on the right arc at a wrong place, or on none."""
    for turn in np.radians([0, 20, 33.3, 71]):
        circle = arcs_of_circle(turn, count)
        chord = np.radians(np.array([15, 40, 60, 75, 110, 160, 179]))
        joint = np.repeat(np.arange(count), len(chord))
        angle = turn + 2 * math.pi / count * joint - np.tile(chord, count)
        origins = np.column_stack([np.cos(angle), np.sin(angle)])
        origins = 0.9 * origins + 0.1 * circle.start[joint]
        # Bits that ask for reflection where it would not be total.
        paths = follow(circle, origins, circle.start[joint] - origins, max_depth=4, reflect=0xFFFF)
        assert (paths.events == [REFLECTED] * 4 + [Event.MAX_DEPTH]).all()
        found = np.arctan2(paths.points[:, 1:, 1], paths.points[:, 1:, 0])
        exact = angle[:, None] + np.tile(chord, count)[:, None] * np.arange(1, 5)
        off = np.abs((found - exact + math.pi) % (2 * math.pi) - math.pi)
        # 8u of each direction, which turns those behind it by twice as much: 8u (1 + 3 + 5 + 7), and the angle by twice
        # that; and 64u for angles up to 6π in double precision.
        assert (off <= 320 * setting.roundoff / np.sin(np.tile(chord, count) / 2)[:, None]).all()


def among_arcs(figure):
    """The figure, the first segment of which is an arc."""
    arc = dataclasses.replace(figure, control=(figure.start + figure.end) / 2, weight=np.ones(len(figure)))
    arc.control[0] += 1e-3 * (figure.end[0] - figure.start[0])[::-1] * [-1, 1]
    return arc


def test_straight_segments_among_arcs_decide_as_alone_do(follow):
    """To the last bit: at vertices and anywhere."""
    rng = np.random.default_rng(5)
    origins, vertices = rng.normal(size=(100, 2)), star(30).start[rng.integers(0, 30, 50)]
    directions = np.concatenate([rng.normal(size=(50, 2)), vertices - origins[50:]])
    one, other = (follow(x, origins, directions) for x in (star(30), among_arcs(star(30))))
    same = (one.hits != 0).all(1) & (other.hits != 0).all(1)
    assert same.sum() > len(same) / 2
    for name in ("hits", "events", "points", "directions"):
        assert np.array_equal(getattr(one, name)[same], getattr(other, name)[same], equal_nan=True), name


@pytest.mark.parametrize(("control", "weight"), [((0.5, 0.0), 2.0), ((0.3, 0.0), 1.0)])
def test_a_straight_piece_may_run_along_itself_at_any_pace(follow, setting, control, weight):
    piece = Segments([(0, 0)], [(1, 0)], [1.5], [1.0], [control], [weight])
    assert follow(piece, (0.2, 1), (0, -1)).points[0, 1] == pytest.approx([0.2, 0], abs=4 * setting.roundoff)


def test_a_ray_along_a_side_goes_on_on_the_side_that_it_is_on(follow):
    """Rounding hides the sign of its cosine: such rays were within by their medium and outside by their direction."""
    square = np.array(SQUARE, float) - 0.5
    for turn in np.radians(np.arange(0, 90, 1.1)):
        c, s = math.cos(turn), math.sin(turn)
        figure = polygon(square @ np.array([(c, s), (-s, c)]), 1.25)
        along = figure.end - figure.start
        along = np.concatenate([along, -along])
        paths = follow(figure, np.concatenate([figure.start, figure.end]) - along, along, max_depth=1, n_start=1.0)
        met = paths.events[:, 0] == REFRACTED
        side = (figure.end - figure.start)[paths.hits[met, 0]]
        d = paths.directions[met]
        assert (side[:, 0] * d[:, 1] - side[:, 1] * d[:, 0] > 0).all()

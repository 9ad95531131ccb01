"""What images are made of: lines in the view, their density, arcs as polylines."""

from __future__ import annotations

import numpy as np
import pytest
from support.planar_scenes import SLAB, ball, beam, polygon, scene

from mi_refract.planar import figure_geometry
from mi_refract.planar.figure_geometry import Legs
from mi_refract.planar.path_tree import follow_scene

VIEW = (-2.0, 3.0, -1.0, 1.0)


def lines(start, end):
    start, end = np.atleast_2d(np.array(start, float)), np.atleast_2d(np.array(end, float))
    return Legs(start, end, np.ones(len(start)), np.zeros(len(start), int))


@pytest.mark.parametrize(
    "start, end, expected",
    [
        ((-1, 0), (1, 0.5), ((-1, 0), (1, 0.5))),
        ((-4, 0), (6, 0), ((-2, 0), (3, 0))),
        ((0, -3), (0, 0.5), ((0, -1), (0, 0.5))),
        ((-3, -2), (0, 1), ((-2, -1), (0, 1))),
        ((-4, 2), (6, 2), None),
        ((4, 0), (6, 0), None),
        ((-3, 0), (0, 3), None),
        ((0, 0), (np.nan, 0), None),
    ],
)
def test_lines_end_at_the_views_edge(start, end, expected):
    a, b, inside = figure_geometry.clip(np.array([start], float), np.array([end], float), VIEW)
    assert inside[0] == (expected is not None)
    if expected:
        np.testing.assert_allclose([a[0], b[0]], expected, atol=1e-15)


def test_every_leg_is_there_once():
    """In a slab: the ray to it, the way through, the ray out, and the same for what is reflected."""
    given = scene(polygon(SLAB, 1.5), [[-1.0, 0]], (1, 0), branches=1)
    legs = figure_geometry.legs(follow_scene(given), VIEW)
    ends = {tuple(np.round([*a, *b], 12) + 0.0) for a, b in zip(legs.start, legs.end, strict=True)}
    assert len(legs) == 6  # the two that come back lie on one another
    assert ends == {(-1, 0, 0, 0), (0, 0, 1, 0), (1, 0, 3, 0), (0, 0, -2, 0), (1, 0, 0, 0)}


def test_what_colours_share_is_there_once():
    given = scene((ball(1.5), ball(1.6)), beam(4, 0.5, x=-1.5), (1, 0), colours=("red", "blue"))
    legs = figure_geometry.legs(follow_scene(given), VIEW)
    numbers, counts = np.unique(legs.colour, return_counts=True)
    assert dict(zip(numbers.tolist(), counts.tolist(), strict=True)) == {figure_geometry.SHARED: 4, 0: 8, 1: 8}
    assert (legs.start[legs.colour == figure_geometry.SHARED, 0] == -1.5).all()
    one = figure_geometry.legs(follow_scene(scene(ball(1.5), beam(4, 0.5, x=-1.5), (1, 0))), VIEW)
    assert (one.colour == 0).all()


def test_the_default_view_holds_everything():
    given = scene(ball(1.5), beam(3, 0.5, x=-9), (1, 0))
    x0, x1, y0, y1 = figure_geometry.around(given, follow_scene(given))
    pad = 2 * figure_geometry.MARGIN
    np.testing.assert_allclose((x0, x1, y0, y1), (-1 - pad, 1 + pad, -1 - pad, 1 + pad))


def test_density_is_length():
    """Of lines anywhere: their length in pixels, up to the last pixel at either end; for each line alone."""
    rng = np.random.default_rng(3)
    for _ in range(200):
        start, end = (rng.uniform((-1.9, -0.9), (2.9, 0.9)) for _ in range(2))
        total = figure_geometry.density(lines(start, end), np.array([2.0]), VIEW, 500, 200).sum()
        assert total == pytest.approx(2 * 100 * np.hypot(*(end - start)), abs=2 * 2 * 2**0.5)


def test_density_is_where_the_line_is():
    pixels = figure_geometry.density(lines((-2, -1), (3, 1)), np.array([1.0]), VIEW, 50, 20)
    rows, columns = np.nonzero(pixels > 0.01)
    away = np.abs((columns + 0.5) * 20 / 50 - (rows + 0.5))
    assert away.max() < 1.01
    assert set(columns.tolist()) == set(range(50))
    upright = figure_geometry.density(lines((-1, -2), (1, 3)), np.array([1.0]), (-1, 1, -2, 3), 20, 50)
    np.testing.assert_allclose(upright, pixels.T, atol=1e-12)


def test_arcs_are_round_and_pieces_are_joined():
    (circle,) = figure_geometry.curves(ball(1.5), 9)
    assert circle.shape == (4 * 8 + 1, 2)
    np.testing.assert_allclose(np.hypot(*circle.T), 1, atol=1e-15)
    np.testing.assert_array_equal(circle[0], circle[-1])
    (square,) = figure_geometry.curves(polygon(SLAB, 1.5))
    np.testing.assert_array_equal(square, [*SLAB, SLAB[0]])

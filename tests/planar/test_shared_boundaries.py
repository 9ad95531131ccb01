"""Shapes that touch: one boundary where they share an edge, with the right media on its two sides."""

import pytest

from mi_refract.planar import shapes, shared_boundaries, trace
from mi_refract.planar.scene_file import load
from mi_refract.planar.scene_schema import Part

TWO = """
index = 1.1
[[shape]]
kind = "rectangle"
name = "left"
width = 2
height = 2
n = 1.5
at = [{x}, 0.1]
[[shape]]
kind = "rectangle"
width = 2
height = 2
n = 1.7
at = [{x} + 2, 0.1]
{more}
[[beam]]
kind = "parallel"
from = [-5, -0.7]
to = [-5, 0.8]
direction = 0
count = 5
"""


def two(tmp_path, x="0.3", second="2.3", more=""):
    path = tmp_path / "scene.toml"
    path.write_text(TWO.replace("{x} + 2", second).replace("{x}", x).replace("{more}", more))
    return load(path)


def indices(scene):
    """Of the legs of its paths."""
    found = trace(scene.segments[0], scene.origins, scene.directions, scene.max_depth, weights=True)
    return found.indices


def media(segments):
    return sorted(zip(segments.n_left.tolist(), segments.n_right.tolist(), strict=True))


def test_shapes_that_share_an_edge_are_cemented_there(tmp_path):
    for x, second in (("0.3", "2.3"), ("0.1", "2.1"), ("-0.7", "1.3"), ("0.3", "2.3000000000000003")):
        scene = two(tmp_path, x, second)
        assert media(scene.segments[0]) == [(1.5, 1.1)] * 3 + [(1.5, 1.7)] + [(1.7, 1.1)] * 3
        assert indices(scene)[:, :4].tolist() == [[1.1, 1.5, 1.7, 1.1]] * 5


def test_only_what_rounding_keeps_apart_is_made_one(tmp_path, monkeypatch):
    apart = two(tmp_path, "0.3", "2.300000001")
    assert media(apart.segments[0]) == [(1.5, 1.1)] * 4 + [(1.7, 1.1)] * 4
    assert indices(apart)[0, :5].tolist() == [1.1, 1.5, 1.1, 1.7, 1.1]
    monkeypatch.setattr(shared_boundaries, "NEAR", 0.0)
    assert len(two(tmp_path, "0.3", "2.3000000000000003").segments[0]) == 8


INNER = """
[[shape]]
kind = "polygon"
points = [[-0.7, -0.9], [1.3, -0.9], [1.3, 1.1]]
n = 1.3
within = "left"
"""


def test_a_shape_may_touch_what_it_lies_in_and_what_that_is_cemented_to(tmp_path):
    segments = two(tmp_path, more=INNER).segments[0]
    around = [(1.3, 1.1), (1.3, 1.5), (1.3, 1.7), (1.5, 1.1), (1.5, 1.1)]
    assert media(segments) == [*around, (1.7, 1.1), (1.7, 1.1), (1.7, 1.1)]
    with pytest.raises(ValueError, match=r"shape\[2\]: along shape\[0\] there is index 1.5; expected 1.1"):
        two(tmp_path, more=INNER.replace('within = "left"', ""))


def test_the_same_shape_twice_is_none(tmp_path):
    again = '[[shape]]\nkind = "rectangle"\nwidth = 2\nheight = 2\nn = 1.6\nat = [0.3, 0.1]\n'
    with pytest.raises(ValueError, match=r"shape\[2\]: along shape\[0\] there is index 1.5; expected 1.1"):
        two(tmp_path, more=again)


def test_curves_with_the_same_ends_are_not_the_same():
    moon, disc = shapes.polygon([(0, -1), (0, 1)], [90, -45]), shapes.polygon([(0, -1), (0, 1)], [45, 60])
    parts = [("moon", Part(moon, (1.5,), (1.0,))), ("disc", Part(disc, (1.6,), (1.0,)))]
    assert media(shared_boundaries.boundaries(parts)[0]) == [(1.5, 1.0), (1.5, 1.6), (1.6, 1.0)]


def test_a_repeated_corner_is_no_edge():
    closed = shapes.polygon([(0, 0), (1, 0), (1, 1), (0, 0)])
    assert len(shared_boundaries.boundaries([("", Part(closed, (1.5,), (1.0,)))])[0]) == 3


def test_a_boundary_runs_along_nothing(tmp_path):
    boundary = '[[shape]]\nkind = "boundary"\npoints = [[1.3, -0.9], [1.3, 1.1]]\nn_left = 1.5\nn_right = 1.7\n'
    with pytest.raises(ValueError, match=r"shape\[2\]: it runs along shape\[0\]"):
        two(tmp_path, more=boundary)

"""Images of planar scenes: read back pixel by pixel, and for what matplotlib was told to draw."""

from __future__ import annotations

import io
import itertools
import sys
from dataclasses import replace

import matplotlib
import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.image import AxesImage
from support.planar_scenes import SLAB, ball, beam, polygon, scene

from mi_refract.planar import Event
from mi_refract.planar import figure as drawing
from mi_refract.planar.light import Light
from mi_refract.planar.path_tree import follow_scene

VIEW = (-2.0, 2.0, -1.5, 1.5)
SLANTED = scene(polygon(SLAB, 1.5), [[-1.5, -0.6]], (1, 0.4), view=VIEW)
CROWD = scene(ball(1.4), beam(5000, 0.999), (1, 0), view=(-3, 4, -2.5, 2.5), branches=1)


@pytest.fixture
def drawn():
    """`drawn(scene)`: the figure."""

    def draw(given, dpi=100):
        return drawing.build_figure(given, follow_scene(given), dpi)

    with matplotlib.rc_context(drawing.STYLE):
        yield draw


def pixels_of(figure):
    buffer = io.BytesIO()
    figure.savefig(buffer, format="rgba", dpi="figure")
    width, height = figure.canvas.get_width_height()
    return np.frombuffer(buffer.getvalue(), np.uint8).reshape(height, width, 4)[::-1, :, :3] / 255.0


def rays_of(figure):
    """The collection of rays, which lies over that of the boundaries."""
    return max(figure.axes[0].findobj(LineCollection), key=lambda c: c.zorder)


def test_the_path_is_where_it_was_traced(drawn):
    figure = drawn(SLANTED)
    pixels, to_pixels = pixels_of(figure), figure.axes[0].transData
    paths = follow_scene(SLANTED)[0].paths
    tip = paths.points[0, 2] + 0.6 * paths.directions[0]
    corners = [*paths.points[0, :3], tip]
    across = np.array([-0.37, 0.93])
    for a, b in itertools.pairwise(corners):
        for t in (0.2, 0.5, 0.8):
            x, y = np.floor(to_pixels.transform(a + t * (b - a))).astype(int)
            patch = pixels[y - 1 : y + 2, x - 1 : x + 2].reshape(-1, 3)
            assert np.abs(patch - to_rgb(drawing.RAY)).max(axis=1).min() < 0.15
            x, y = np.floor(to_pixels.transform(a + t * (b - a) + 0.1 * across)).astype(int)
            assert (pixels[y, x] > 0.7).all()


def test_media_are_shaded_and_named(drawn):
    inner = replace(SLANTED.regions[0], outline=SLAB / 2, indices=(1.25,))
    figure = drawn(replace(SLANTED, regions=(*SLANTED.regions, inner)))
    pixels, to_pixels = pixels_of(figure), figure.axes[0].transData
    for place, tint in (((0.8, 1), drawing.DENSE), ((0.2, 1), None), ((-1.5, 1), (1, 1, 1))):
        x, y = np.floor(to_pixels.transform(place)).astype(int)
        if tint:
            np.testing.assert_allclose(pixels[y, x], tint, atol=1 / 128)
        else:
            assert (np.array(drawing.DENSE) < pixels[y, x]).all() and (pixels[y, x] < 1).all()
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert labels == ["n = 1", "n = 1.25", "n = 1.5"]


def test_of_many_media_a_few_are_named(drawn):
    layers = tuple(replace(SLANTED.regions[0], indices=(1 + i / 20, 1 + i / 25)) for i in range(1, 21))
    given = replace(
        SLANTED, regions=layers, index=(1.0, 1.0), light=Light(("red", "blue")), segments=SLANTED.segments * 2
    )
    labels = [text.get_text() for text in drawn(given).axes[0].get_legend().get_texts()]
    assert len(labels) == drawing.NAMED
    assert labels[0] == "n = 1"
    assert labels[-1] == "n = 1.8 – 2"


def test_opacity_is_the_root_of_the_power(drawn):
    given = replace(SLANTED, branches=1)
    weights = follow_scene(given)[0].paths.weights
    opacities = np.sort(rays_of(drawn(given)).get_colors()[:, 3])
    expected = np.sort([*weights[0, :3], weights[1, 1], *weights[2, 2:4]]) ** 0.5
    np.testing.assert_allclose(opacities, expected, rtol=1e-6)


def test_colours_part_at_the_first_boundary(drawn):
    given = replace(
        SLANTED,
        segments=(polygon(SLAB, 1.4), polygon(SLAB, 1.6)),
        light=Light(("red", "blue")),
        index=(1.0, 1.0),
        regions=(replace(SLANTED.regions[0], indices=(1.4, 1.6)),),
    )
    collection = rays_of(drawn(given))
    colours = {tuple(rgb) for rgb in collection.get_colors()[:, :3].tolist()}
    assert colours == {to_rgb(name) for name in ("red", "blue", drawing.WHITE)}
    assert len(collection.get_segments()) == 1 + 2 + 2


def test_a_colour_that_is_none(drawn):
    given = replace(SLANTED, light=Light(("ultraviolent",)))
    with pytest.raises(ValueError, match=r"test\.toml: colours: 'ultraviolent'; expected a colour"):
        drawn(given)


def test_a_crowd_is_a_density(drawn):
    """Its darkest pixels are on the caustic, whose cusp is the paraxial focus."""
    figure = drawn(CROWD, dpi=60)
    (image,) = figure.axes[0].findobj(AxesImage)
    figure.draw_without_rendering()  # would move what is not settled
    opacity = np.asarray(image.get_array())[..., 3] / 255
    box = figure.axes[0].get_window_extent()
    assert opacity.shape == (round(box.height), round(box.width))
    x0, x1, y0, y1 = image.get_extent()
    row, column = np.unravel_index(opacity.argmax(), opacity.shape)
    place = x0 + (column + 0.5) / opacity.shape[1] * (x1 - x0), y0 + (row + 0.5) / opacity.shape[0] * (y1 - y0)
    cusp = 1.4 / (2 * 0.4)
    assert place == pytest.approx((cusp, 0), abs=0.2)
    assert opacity[0, -1] < 0.2 < 0.9 < opacity.max() < 1


def test_a_crowd_is_the_right_way_up(drawn):
    figure = drawn(replace(CROWD, origins=CROWD.origins + np.array([0, 1.5])), dpi=60)
    y = figure.axes[0].transData.transform((-2.5, 1.5))[1], figure.axes[0].transData.transform((-2.5, -1.5))[1]
    x = figure.axes[0].transData.transform((-2.5, 0))[0]
    above, below = (pixels_of(figure)[int(row), int(x)] for row in y)
    assert above[1] < 0.8
    assert below.min() > 0.97  # one reflection inside reaches it


@pytest.mark.parametrize("event, mark", [(Event.MAX_DEPTH, "o"), (Event.MEDIUM_MISMATCH, "x")])
def test_paths_that_end_otherwise_are_marked(drawn, event, mark):
    square = polygon(np.array([(0, -1), (1, -1), (1, 1), (0, 1)], float), 1.5)
    wrong = replace(square, n_left=np.array([1.5, 1.4, 1.5, 1.5]))
    given = scene(wrong, [[-1.0, 0.1]], (1, 0), view=VIEW)
    given = given if event == Event.MEDIUM_MISMATCH else replace(given, segments=(square,), max_depth=1)
    panel = drawn(given).axes[0]
    marks = [line for line in panel.lines if line.get_marker() == mark]
    assert len(marks) == 1
    np.testing.assert_allclose(marks[0].get_xydata(), [[0 if event == Event.MAX_DEPTH else 1, 0.1]], atol=1e-12)
    note = drawing.MARKS[event][1].format(1)
    assert note in panel.get_xlabel().replace("\n", " ")
    clean = drawn(replace(given, segments=(square,), max_depth=5)).axes[0]
    assert {line.get_marker() for line in clean.lines} == {"+"}
    assert note not in clean.get_xlabel().replace("\n", " ")


@pytest.mark.parametrize("suffix, start", [(".svg", b"<?xml"), (".png", b"\x89PNG"), (".pdf", b"%PDF")])
def test_the_same_scene_gives_the_same_bytes(suffix, start):
    content = drawing.draw(SLANTED, follow_scene(SLANTED), suffix)
    assert content.startswith(start)
    assert drawing.draw(SLANTED, follow_scene(SLANTED), suffix) == content


def test_the_users_style_is_left_out():
    traced = follow_scene(SLANTED)
    plain = drawing.draw(SLANTED, traced, ".svg")
    with matplotlib.rc_context({"axes.facecolor": "black", "font.size": 30, "svg.hashsalt": "mine"}):
        assert drawing.draw(SLANTED, traced, ".svg") == plain
        assert matplotlib.rcParams["font.size"] == 30


def test_thousands_of_rays_are_a_small_file():
    traced = follow_scene(CROWD)
    content = drawing.draw(CROWD, traced, ".svg")
    assert drawing.draw(CROWD, traced, ".svg") == content
    assert len(content) < 2_000_000
    assert content.count(b"<image") == 1
    assert content.count(b"<path") < 500


@pytest.mark.parametrize("view", [(0, 1, 0, 100), (0, 1e-9, 0, 1e-9), (0, 1e6, 0, 1)])
def test_views_of_any_shape(view):
    given = replace(SLANTED, view=view)
    assert drawing.draw(given, follow_scene(given), ".png")


def test_without_matplotlib(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ValueError, match=r"pip install 'mi-refract\[plot\]'"):
        drawing.draw(SLANTED, follow_scene(SLANTED), ".svg")

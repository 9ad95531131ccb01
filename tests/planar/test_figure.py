"""Figures of planar scenes: the pixels, the objects that matplotlib draws, and the geometry behind them."""

from __future__ import annotations

import io
import itertools
from dataclasses import replace

import matplotlib
import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.image import AxesImage
from support.planar_scenes import SLAB, ball, beam, polygon, scene

from mi_refract.io.image_file import srgb_encode
from mi_refract.planar import Event, focal_points
from mi_refract.planar import figure as drawing
from mi_refract.planar.light import Light, linear_srgb, of_wavelengths
from mi_refract.planar.path_tree import follow_scene

VIEW = (-2.0, 2.0, -1.5, 1.5)
WIDE = (-2.0, 3.0, -1.0, 1.0)
GLASS = polygon(SLAB, 1.5)
SLANTED = scene(GLASS, [[-1.5, -0.6]], (1, 0.4), view=VIEW)
CROWD = scene(ball(1.4), beam(5000, 0.999), (1, 0), view=(-3, 4, -2.5, 2.5), branches=1)


@pytest.fixture
def drawn():
    """`drawn(scene)`: the figure of a scene."""

    def draw(scene, dpi=100):
        return drawing.build_figure(scene, follow_scene(scene), dpi)

    with matplotlib.rc_context(drawing.STYLE):
        yield draw


def pixels_of(figure):
    buffer = io.BytesIO()
    figure.savefig(buffer, format="rgba", dpi="figure")
    width, height = figure.canvas.get_width_height()
    return np.frombuffer(buffer.getvalue(), np.uint8).reshape(height, width, 4)[::-1, :, :3] / 255.0


def pixel(figure, place):
    return tuple(np.floor(figure.axes[0].transData.transform(place)).astype(int))


def rays_of(figure):
    """The collection of rays, which is drawn above that of the boundaries."""
    return max(figure.axes[0].findobj(LineCollection), key=lambda c: c.zorder)


def labels_of(figure):
    return [text.get_text() for text in figure.axes[0].get_legend().get_texts()]


def test_rays_are_drawn_where_they_were_traced_and_media_are_tinted_and_labelled(drawn):
    inner = replace(SLANTED.regions[0], outline=SLAB / 2, indices=(1.25,))
    nested = replace(SLANTED, regions=(*SLANTED.regions, inner))
    figure, paths = drawn(nested), follow_scene(nested)[0].paths
    pixels, across = pixels_of(figure), np.array([-0.37, 0.93])
    corners = [*paths.points[0, :3], paths.points[0, 2] + 0.6 * paths.directions[0]]
    for (a, b), t in itertools.product(itertools.pairwise(corners), (0.2, 0.5, 0.8)):
        x, y = pixel(figure, a + t * (b - a))
        patch = pixels[y - 1 : y + 2, x - 1 : x + 2].reshape(-1, 3)
        assert np.abs(patch - to_rgb(drawing.RAY)).max(axis=1).min() < 0.15
        x, y = pixel(figure, a + t * (b - a) + 0.1 * across)
        assert (pixels[y, x] > 0.7).all()
    dense, half, air = (pixels[pixel(figure, place)[::-1]] for place in ((0.8, 1), (0.2, 1), (-1.5, 1)))
    np.testing.assert_allclose([dense, air], [drawing.DENSE, (1, 1, 1)], atol=1 / 128)
    assert (np.array(drawing.DENSE) < half).all() and (half < 1).all()
    assert labels_of(figure) == ["n = 1", "n = 1.25", "n = 1.5"]


def test_the_legend_shows_a_few_of_many_media(drawn):
    layers = tuple(replace(SLANTED.regions[0], indices=(1 + i / 20, 1 + i / 25)) for i in range(1, 21))
    light = Light(("red", "blue"))
    labels = labels_of(drawn(replace(SLANTED, regions=layers, index=(1.0, 1.0), light=light, segments=(GLASS, GLASS))))
    assert len(labels) == drawing.LEGEND_SIZE
    assert (labels[0], labels[-1]) == ("n = 1", "n = 1.8 – 2")


def test_media_of_nearly_the_same_index_have_different_tints(drawn):
    media = tuple(replace(SLANTED.regions[0], indices=(n,)) for n in (1.45, 1.48))
    legend = drawn(replace(SLANTED, regions=media)).axes[0].get_legend()
    tints = [np.array(patch.get_facecolor()) for patch in legend.get_patches()]
    assert np.abs(tints[2] - tints[1]).max() > 0.1 < np.abs(tints[1] - tints[0]).max()


def test_opacity_is_the_square_root_of_the_power(drawn):
    branched = replace(SLANTED, branches=1)
    weights = follow_scene(branched)[0].paths.weights
    opacities = np.sort(rays_of(drawn(branched)).get_colors()[:, 3])
    np.testing.assert_allclose(opacities, np.sort([*weights[0, :3], weights[1, 1], *weights[2, 2:4]]) ** 0.5, rtol=1e-6)


def test_colours_separate_at_the_first_boundary_and_an_unknown_colour_is_an_error(drawn):
    segments, region = (polygon(SLAB, 1.4), polygon(SLAB, 1.6)), replace(SLANTED.regions[0], indices=(1.4, 1.6))
    coloured = replace(SLANTED, segments=segments, light=Light(("red", "blue")), index=(1.0, 1.0), regions=(region,))
    collection = rays_of(drawn(coloured))
    colours = {tuple(rgb) for rgb in collection.get_colors()[:, :3].tolist()}
    assert colours == {to_rgb(name) for name in ("red", "blue", drawing.WHITE)}
    assert len(collection.get_segments()) == 1 + 2 + 2
    with pytest.raises(ValueError, match=r"test\.toml: colours: 'ultraviolent'; expected a colour"):
        drawn(replace(SLANTED, light=Light(("ultraviolent",))))


def test_many_rays_are_drawn_as_a_density_the_right_way_up(drawn):
    """The darkest pixels are on the caustic, whose cusp is the paraxial focus."""
    figure = drawn(CROWD, dpi=60)
    (image,) = figure.axes[0].findobj(AxesImage)
    figure.draw_without_rendering()  # would move anything whose layout is not final
    opacity = np.asarray(image.get_array())[..., 3] / 255
    box = figure.axes[0].get_window_extent()
    assert opacity.shape == (round(box.height), round(box.width))
    x0, x1, y0, y1 = image.get_extent()
    row, column = np.unravel_index(opacity.argmax(), opacity.shape)
    place = x0 + (column + 0.5) / opacity.shape[1] * (x1 - x0), y0 + (row + 0.5) / opacity.shape[0] * (y1 - y0)
    assert place == pytest.approx((1.4 / (2 * 0.4), 0), abs=0.2)
    assert opacity[0, -1] < 0.2 < 0.9 < opacity.max() < 1
    figure = drawn(replace(CROWD, origins=CROWD.origins + np.array([0, 1.5])), dpi=60)
    above, below = (pixels_of(figure)[pixel(figure, (-2.5, y))[::-1]] for y in (1.5, -1.5))
    assert above[1] < 0.8 and below.min() > 0.97  # light reflected once inside reaches the upper place


@pytest.mark.parametrize("event, mark", [(Event.MAX_DEPTH, "o"), (Event.MEDIUM_MISMATCH, "x")])
def test_paths_that_do_not_escape_are_marked(drawn, event, mark):
    square = polygon([(0, -1), (1, -1), (1, 1), (0, 1)], 1.5)
    ending = scene(replace(square, n_left=np.array([1.5, 1.4, 1.5, 1.5])), [[-1.0, 0.1]], (1, 0), view=VIEW)
    ending = ending if event == Event.MEDIUM_MISMATCH else replace(ending, segments=(square,), max_depth=1)
    panel = drawn(ending).axes[0]
    (line,) = [line for line in panel.lines if line.get_marker() == mark]
    np.testing.assert_allclose(line.get_xydata(), [[0 if event == Event.MAX_DEPTH else 1, 0.1]], atol=1e-12)
    note = {
        Event.MAX_DEPTH: "○ 1 stopped after `max_depth` boundaries",
        Event.MEDIUM_MISMATCH: "× shape[0] overlap, share part of an edge",
    }[event]
    assert note in panel.get_xlabel().replace("\n", " ")
    clean = drawn(replace(ending, segments=(square,), max_depth=5)).axes[0]
    assert {line.get_marker() for line in clean.lines} == {"+"}
    assert note not in clean.get_xlabel().replace("\n", " ")


@pytest.mark.parametrize("suffix, start", [(".svg", b"<?xml"), (".png", b"\x89PNG"), (".pdf", b"%PDF")])
def test_the_same_scene_gives_the_same_bytes_for_any_user_style(suffix, start):
    content = drawing.draw(SLANTED, follow_scene(SLANTED), suffix)
    assert content.startswith(start)
    with matplotlib.rc_context({"axes.facecolor": "black", "font.size": 30, "svg.hashsalt": "mine"}):
        assert drawing.draw(SLANTED, follow_scene(SLANTED), suffix) == content
        assert matplotlib.rcParams["font.size"] == 30


def test_thousands_of_rays_make_a_small_file():
    content = drawing.draw(CROWD, follow_scene(CROWD), ".svg")
    assert len(content) < 2_000_000
    assert content.count(b"<image") == 1 and content.count(b"<path") < 500


@pytest.mark.parametrize("view", [(0, 1, 0, 100), (0, 1e-9, 0, 1e-9), (0, 1e6, 0, 1)])
def test_views_of_any_shape(view):
    viewed = replace(SLANTED, view=view)
    assert drawing.draw(viewed, follow_scene(viewed), ".png")


# Geometry ------------------------------------------------------------------------------------------------------


def test_lines_are_clipped_to_the_view():
    lines = np.array([[-4, 0, 6, 0], [0, -3, 0, 0.5], [-3, -2, 0, 1], [-4, 2, 6, 2], [-3, 0, 0, 3], [0, 0, np.nan, 0]])
    a, b, inside = drawing.clip(lines[:, :2], lines[:, 2:], WIDE)
    assert inside.tolist() == [True, True, True, False, False, False]
    expected = [[-2, 0, 3, 0], [0, -1, 0, 0.5], [-2, -1, 0, 1]]
    np.testing.assert_allclose(np.hstack([a, b])[:3], expected, atol=1e-15)


def test_legs_contain_no_duplicates():
    """Every path has a leg before, inside and behind a slab; paths share their common legs, colours the first leg."""
    legs = drawing.legs(follow_scene(scene(GLASS, [[-1.0, 0]], (1, 0), branches=1)), WIDE)
    ends = {tuple(np.round([*a, *b], 12) + 0.0) for a, b in zip(legs.start, legs.end, strict=True)}
    assert len(legs.start) == 6  # the two reflected paths lie on one another outside
    assert ends == {(-1, 0, 0, 0), (0, 0, 1, 0), (1, 0, 3, 0), (0, 0, -2, 0), (1, 0, 0, 0)}
    coloured = scene((ball(1.5), ball(1.6)), beam(4, 0.5, x=-1.5), (1, 0), colours=("red", "blue"))
    legs = drawing.legs(follow_scene(coloured), WIDE)
    numbers, counts = np.unique(legs.colour, return_counts=True)
    assert dict(zip(numbers.tolist(), counts.tolist(), strict=True)) == {drawing.SHARED: 4, 0: 8, 1: 8}
    assert (legs.start[legs.colour == drawing.SHARED, 0] == -1.5).all()


def test_the_default_view_contains_all_boundaries():
    ball_scene = scene(ball(1.5), beam(3, 0.5, x=-9), (1, 0))
    far = 1 + 2 * drawing.MARGIN
    view = drawing.around(ball_scene, follow_scene(ball_scene), np.empty((0, 2)))
    np.testing.assert_allclose(view, (-far, far, -far, far))


@pytest.mark.parametrize(("n", "focus"), [(1.5, 1.5), (1.1, 5.5), (1.01, None), (2.5, None)])
def test_a_near_focus_is_marked_and_inside_the_view(drawn, n, focus):
    """The focus of rays near the axis of a ball is n/(2 (n − 1)) from its centre, inside the ball for n > 2."""
    panel = drawn(scene(ball(n), beam(9, 0.01), (1, 0))).axes[0]
    marks = [line.get_xydata() for line in panel.lines if line.get_marker() == "D"]
    assert ("◇ focus" in panel.get_xlabel()) is bool(marks) is (focus is not None)
    assert panel.get_xlim()[1] == pytest.approx(
        max(focus or 1, 1) + drawing.MARGIN * max((focus or 1) + 1, 2), rel=1e-3
    )
    if focus:
        np.testing.assert_allclose(marks, [[[focus, 0]]], atol=1e-3)


def test_rays_that_do_not_converge_have_no_focus():
    """A fan from the centre of a ball, and rays that are parallel or cross in many places behind a slab."""
    fan = np.array([(1, y) for y in np.linspace(-0.3, 0.3, 9)])
    crossing = np.array([(1, y) for y in (0.2, -0.1, 0.3, -0.3)])
    scenes = (ball(1.5), np.zeros((9, 2)), fan), (GLASS, beam(5, 1.0), (1, 0)), (GLASS, beam(4, 1.0), crossing)
    for unfocused in (scene(*parts) for parts in scenes):
        assert not len(focal_points.foci(unfocused, follow_scene(unfocused)))


@pytest.mark.parametrize("wavelengths", [[640.0, 660.0], [450.0, 460.0], [450.0, 550.0, 610.0]])
def test_legs_that_all_wavelengths_share_have_the_colour_of_their_sum(drawn, wavelengths):
    light = of_wavelengths(wavelengths)
    glasses = tuple(ball(1.5 - 0.01 * i) for i in range(len(light)))
    figure = drawn(scene(glasses, beam(20, 0.3), (1, 0), light=light, view=(-3, 3, -2, 2)))
    (image,) = figure.axes[0].findobj(AxesImage)
    pixels = np.asarray(image.get_array())
    before = pixels[:, : pixels.shape[1] // 4]
    red, green, blue = before[before[..., 3] > 0][0, :3] / 255
    expected = np.clip(linear_srgb(light).sum(0), 0, None)
    assert srgb_encode(expected / expected.max()) == pytest.approx([red, green, blue], abs=1 / 255)


def test_density_is_the_length_of_the_line_in_each_pixel():
    """The sum over the pixels is the line's length, up to a pixel at either end."""

    def density(start, end, *view):
        line = drawing.Legs(np.array([start], float), np.array([end], float), np.array([4.0]), np.zeros(1, int))
        return drawing.density(line, *view) / 2

    rng = np.random.default_rng(3)
    for _ in range(200):
        start, end = (rng.uniform((-1.9, -0.9), (2.9, 0.9)) for _ in range(2))
        total = density(start, end, WIDE, 500, 200).sum()
        assert total == pytest.approx(100 * np.hypot(*(end - start)), abs=2 * 2**0.5)
    pixels = density((-2, -1), (3, 1), WIDE, 50, 20)
    rows, columns = np.nonzero(pixels > 0.01)
    assert np.abs((columns + 0.5) * 20 / 50 - (rows + 0.5)).max() < 1.01
    assert set(columns.tolist()) == set(range(50))
    np.testing.assert_allclose(density((-1, -2), (1, 3), (-1, 1, -2, 3), 20, 50), pixels.T, atol=1e-12)


def test_boundaries_become_joined_polylines_on_their_arcs():
    (circle,) = drawing.curves(ball(1.5), 9)
    assert circle.shape == (4 * 8 + 1, 2)
    np.testing.assert_allclose(np.hypot(*circle.T), 1, atol=1e-15)
    np.testing.assert_array_equal(circle[0], circle[-1])
    (square,) = drawing.curves(GLASS)
    np.testing.assert_array_equal(square, [*SLAB, SLAB[0]])

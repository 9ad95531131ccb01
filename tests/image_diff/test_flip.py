"""`flip`: changes that a person sees are different, and changes that nobody sees are equal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr
from support.diff_images import DIFFERENT, EQUAL, INCONCLUSIVE, SINGLE, SMOOTH, of, save

from mi_refract.image_diff.flip import encoding, flip, local_error, one_way_change, patch_error, windows
from mi_refract.image_diff.methods import compare
from mi_refract.io import image_file

GRAY, SIZE = 76, 512
Y, X = np.mgrid[:SIZE, :SIZE]


def shown(codes):
    """An image of 8-bit codes, H × W or H × W × 3."""
    codes = np.asarray(codes, np.float32)
    return of(np.round(codes if codes.ndim == 3 else np.dstack([codes] * 3)) / 255, stored="uint8")


def with_square(x, y, side, colour, codes=None):
    codes = np.full((SIZE, SIZE, 3), GRAY, float) if codes is None else codes.copy()
    codes[y : y + side, x : x + side] = colour
    return codes


def edge(position, angle=0.1, samples=8, size=64):
    """A black half-plane on white, with `samples`² samples a pixel."""
    offsets = (np.arange(samples) + 0.5) / samples
    x, y = (indices[..., None] + offsets - size / 2 for indices in (X[:size, :size], Y[:size, :size]))
    distance = x[..., None, :] * np.cos(angle) + y[..., None] * np.sin(angle)
    return 255.0 * (distance > position).mean((-1, -2))


def line(code):
    codes = np.zeros((SIZE, SIZE))
    codes[:, 256] = code
    return codes


PLAIN = np.full((SIZE, SIZE), GRAY)
CUBE = with_square(200, 100, 20, (128, 128, 128))
ROW = np.where((Y // 12 == 20) & (X // 12 % 4 == 0), 200, GRAY)
HIGHLIGHT = 90 + 150 * np.exp(-((X - 300) ** 2 + (Y - 90) ** 2) / (2 * 5.0**2))
VISIBLE = {
    "a cube turned from gray to yellow": (CUBE, with_square(200, 100, 20, (200, 180, 20))),
    "a highlight is gone": (HIGHLIGHT, np.full((SIZE, SIZE), 90)),
    "a row of cubes moved by three pixels": (ROW, np.roll(ROW, 3, 1)),
    "a line of one pixel is gone": (line(255), line(0)),
    "an edge moved by two pixels": (edge(0), edge(2)),
    "a cube is 16 codes brighter": (CUBE, with_square(200, 100, 20, (144, 144, 144))),
    "half of the image is 10 codes brighter": (np.full((SIZE, SIZE), GRAY), GRAY + 10 * (X > 255)),
    "a cube of 4 pixels is gone": (with_square(200, 100, 4, 255), with_square(200, 100, 0, 0)),
    "a dot of 3 pixels": (PLAIN, with_square(200, 100, 3, GRAY + 32)),
    "a dot of 5 pixels": (PLAIN, with_square(200, 100, 5, GRAY - 16)),
    "a blue dot of 3 pixels": (PLAIN, with_square(200, 100, 3, (GRAY, GRAY, GRAY + 64))),
    "a facet": (CUBE, with_square(204, 104, 6, (141, 141, 141), CUBE)),
}
CLOSE = {
    "one code": (np.full((SIZE, SIZE), GRAY), np.full((SIZE, SIZE), GRAY + 1)),
    "an edge without antialiasing": (edge(0), edge(0, samples=1)),
    "another antialiasing": (edge(0), edge(0, samples=2)),
    "an edge moved by half a pixel": (edge(0), edge(0.5)),
    "a fainter dot of 3 pixels": (PLAIN, with_square(200, 100, 3, GRAY + 31)),
    "a fainter blue dot of 3 pixels": (PLAIN, with_square(200, 100, 3, (GRAY, GRAY, GRAY + 62))),
    "a blurred edge moved by half a pixel": (255 * ndtr(X - 256.25), 255 * ndtr(X - 255.75)),
    "a faint edge blurred otherwise": (30 * ndtr((X - 256) / 2), 30 * ndtr((X - 256) / 3)),
    "a square of noise": tuple(
        GRAY + np.where((abs(X - 99) < 9) & (abs(Y - 77) < 9), np.random.default_rng(i).normal(0, 30, X.shape), 0)
        for i in range(2)
    ),
    "codes at random off by one": (HIGHLIGHT, HIGHLIGHT + np.random.default_rng(1).integers(-1, 2, (SIZE, SIZE))),
}


@pytest.mark.parametrize("name", [*VISIBLE, *CLOSE])
def test_visible_changes_are_different_and_invisible_ones_equal(name):
    one, two = map(shown, (VISIBLE | CLOSE)[name])
    verdict = DIFFERENT if name in VISIBLE else EQUAL
    assert [compare("flip", *sides).verdict for sides in ((one, two), (two, one))] == [verdict] * 2


def test_one_code_more_everywhere_is_well_below_the_bounds():
    for gray in (0, 1, 10, 20, 40, 80, 160, 254):
        result = flip(*(shown(np.full((128, 128), code)) for code in (gray, gray + 1)))
        assert result.verdict is EQUAL
        assert all(metric.value < 0.7 * metric.bound for metric in result.metrics[:2]), gray


def test_the_error_of_a_change_is_independent_of_its_position_and_surroundings():
    plain = np.full((128, 128, 3), GRAY, float)
    errors = {}
    for place in [(x, y) for x in (0, 1, 3, 60, 61, 122) for y in (0, 4, 67, 122)]:
        errors[place] = flip(shown(plain), shown(with_square(*place, 6, 120, plain))).metrics[0].value
    inside = [value for place, value in errors.items() if {*place} <= {60, 61, 67}]
    assert max(inside) == pytest.approx(min(inside), rel=1e-3)
    assert min(errors.values()) > 0.9 * inside[0]  # at the border its halo is clipped
    for size in (64, 256, 512):
        part = slice(256 - size // 2, 256 + size // 2)
        one, two = (shown(codes[part, part]) for codes in VISIBLE_LINES)
        assert flip(one, two).metrics[0].value == pytest.approx(0.65, abs=0.02)


VISIBLE_LINES = VISIBLE["a line of one pixel is gone"]


def test_sizes_and_weights_of_windows():
    for ppd, side in ((67, 8), (33.5, 4), (134, 16), (1000, 120)):
        (height, width, weight), (_, wider, more), *_ = windows(5000, 5000, ppd)
        assert (height, width, wider) == (side, side, 2 * side)
        assert weight == pytest.approx(1, rel=0.02) and more == pytest.approx(2**0.5 * weight, rel=0.02)
    assert [h for h, _, _ in windows(9999, 9999, 67)] == [8, 16, 32, 64, 129, 257, 515]
    assert [(h, w) for h, w, _ in windows(5, 20, 67)] == [(5, 8), (5, 16), (5, 20)]
    assert list(windows(1, 1, 67)) == [(1, 1, 1.0)]
    assert next(windows(50, 50, 1.0))[2] == pytest.approx((1 / 0.12) ** 0.5)  # a pixel of one degree


def test_twice_the_size_at_twice_the_pixels_per_degree_has_the_same_error():
    one, two = VISIBLE["a cube turned from gray to yellow"]
    small, large = ([np.kron(codes[50:178, 150:278], np.ones((k, k, 1))) for codes in (one, two)] for k in (1, 2))
    values = [flip(*map(shown, x), ppd=ppd).metrics[0].value for x, ppd in ((small, 67), (large, 134), (large, 67))]
    assert values[1] == pytest.approx(values[0], rel=0.03)
    assert values[2] > 1.2 * values[0]


def test_the_worst_window_is_found_and_named():
    error = np.zeros((100, 90), np.float32)
    error[30:38, 50:58] = 0.8
    worst, around = local_error(error, 67)
    assert (worst.x, worst.y, worst.width, worst.height) == (50, 30, 8, 8)
    assert worst.value == worst.error == pytest.approx(0.8) == around.max()
    assert around.shape == error.shape and around[33, 53] == around.max() and around[0, 0] < 0.1
    assert patch_error(error, 67).value == 0
    result = compare("flip", *map(shown, VISIBLE["a cube is 16 codes brighter"]))
    assert "at least 0.2" in result.reason and "in 16 × 16 pixels from x = 20" in result.reason
    result = compare("flip", *map(shown, VISIBLE["a dot of 5 pixels"]))
    assert result.reason.endswith("; at least 16 codes brighter or darker in 5 × 5 pixels from x = 200, y = 100")


def test_local_and_patch_errors_agree_with_their_definitions():
    error = np.random.default_rng(3).random((41, 29)).astype(np.float32)
    worst, _ = local_error(error, 40)
    value, *window = max(
        (weight * error[y : y + h, x : x + w].mean(), x, y, w, h)
        for h, w, weight in windows(41, 29, 40)
        for y in range(42 - h)
        for x in range(30 - w)
    )
    assert worst.value == pytest.approx(value, rel=1e-5)
    assert [worst.x, worst.y, worst.width, worst.height] == window
    side = 10  # 0.24 degrees
    smallest = {(x, y): error[y : y + side, x : x + side].min() for y in range(42 - side) for x in range(30 - side)}
    patch = patch_error(error, 40)
    assert patch.value == pytest.approx(max(smallest.values())) == smallest[patch.x, patch.y]


def test_one_way_change_agrees_with_its_definition():
    rng = np.random.default_rng(5)
    one, two = (rng.integers(0, 256, (17, 14, 3)).astype(np.float32) for _ in range(2))
    two[3:9, 4:11] = one[3:9, 4:11] + rng.uniform(8, 30, (6, 7, 3))
    luma = (two - one) @ np.float32([0.299, 0.587, 0.114])
    for ppd, sides in ((67, range(3, 9)), (20, range(3, 4)), (100, range(5, 13))):
        scale = max(1, ppd / 67)
        value = max(
            (sign * kind[y : y + side, x : x + side]).min() * (side / scale - 1) / 2
            for kind in (luma, *np.moveaxis((two - one) / 2, -1, 0))
            for sign in (1, -1)
            for side in sides
            for y in range(18 - side)
            for x in range(15 - side)
        )
        assert one_way_change(one, two, ppd).value == pytest.approx(value, rel=1e-5)


def test_a_blurred_edge_that_moves_by_half_a_pixel_is_within_the_bound():
    """For all widths of the blur; the bound is reached if it is (side − 1)/2 pixels, in squares of every side."""
    steps = np.arange(64.0)[None]
    for width in (0.3, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 5.0):
        for place in (31.5, 31.75, 32.0):
            one, two = (np.repeat(255 * ndtr((steps - place - x) / width), 9, 0)[..., None] for x in (0.25, -0.25))
            value = one_way_change(one, two, 67.0).value
            assert value < 30.9
            if width in (1.0, 1.5, 2.0, 2.5, 3.0, 3.5) and place == (32.0 if 2 * width % 2 == 0 else 31.5):
                assert value > 30.8


def test_images_smaller_than_a_window():
    for shape in ((1, 1), (1, 64), (64, 1), (3, 5), (8, 8), (17, 9)):
        black, nearly, white = (shown(np.full(shape, code)) for code in (0, 254, 255))
        assert compare("flip", white, white).metrics[0].value == 0
        assert compare("flip", white, nearly).verdict is EQUAL
        result = compare("flip", white, black)
        assert result.verdict is DIFFERENT and result.maps["local"].shape == result.maps["flip"].shape == shape


def test_the_bounds_are_options():
    one, two = (shown(codes[80:144, 180:244]) for codes in (CUBE, with_square(200, 100, 20, (133, 133, 133))))
    result = flip(one, two)
    assert result.verdict is EQUAL
    for name, metric in zip(("local", "patch", "one_way", "largest"), result.metrics, strict=False):
        assert flip(one, two, **{name: 1.1 * metric.value}).verdict is EQUAL
        assert flip(one, two, **{name: 0.9 * metric.value}).verdict is DIFFERENT
    one, two = (shown(codes[192:320, 192:320]) for codes in VISIBLE_LINES)
    assert compare("flip", one, two, local=3.0).verdict is INCONCLUSIVE  # black would pass, too


def test_the_mean_and_the_share_are_those_of_the_pixels_inside_the_mask():
    codes, mask = np.full((48, 48), 100.0), np.zeros((48, 48), bool)
    one, mask[:8], codes[3] = shown(codes), True, 140
    two = shown(codes)
    error = flip(one, two).maps["flip"][mask]
    expected = {"mean": float(error.mean()), "percentile_99": float(np.percentile(error, 99))}
    sides = [replace(image, mask=mask) for image in (one, two)]
    assert [metric.value for metric in flip(*sides).metrics[-2:]] == pytest.approx([*expected.values()])
    for name, value in expected.items():
        assert compare("flip", *sides, **{name: 1.1 * value}).verdict is EQUAL
        assert flip(*sides, **{name: 0.9 * value}).verdict is DIFFERENT


# Encodings of files ----------------------------------------------------------------------------------------------


def test_integers_without_a_colour_space_are_srgb(tmp_path):
    for names, stored, space, expected in (
        ("png jpg bmp gif webp tif tga sgi ppm", "uint8", None, "sRGB"),
        ("png tif", "uint16", None, "sRGB"),
        ("tif pfm hdr", "float", None, "linear"),
        ("exr", "half", None, "linear"),
        ("png tga", "uint8", "lin_rec709_scene", "linear"),
        ("png", "uint8", "g22_rec709_scene", "sRGB"),
        ("tif exr", "float", "srgb_rec709_scene", "sRGB"),
    ):
        for path in (tmp_path / f"a.{name}" for name in names.split()):
            save(path, SMOOTH[:8, :8], stored, {"oiio:ColorSpace": (space,)} if space else {})
            assert encoding(image_file.read(path)) == expected, (path, stored, space)
    for array, expected in ((SMOOTH, "linear"), (SMOOTH.astype(int), "linear"), (SMOOTH.astype(">u2"), "sRGB")):
        assert encoding(image_file.named("reference", array)) == expected


@pytest.mark.parametrize("kind", ["uint8", "uint16"])
def test_arrays_of_codes_are_those_of_a_png(kind, tmp_path):
    """In every bit, so that all methods agree; 47 of 255 codes in 3 × 3 pixels are different on a display."""
    all_codes = np.arange(2**16).astype(kind).reshape(256, 256, 1)
    read = image_file.read(save(tmp_path / "a.png", all_codes, kind)).pixels
    np.testing.assert_array_equal(image_file.named("array", all_codes).pixels, read)
    codes = np.full((2, 64, 64, 3), 128, kind)
    codes[1, 30:33, 30:33] = 175
    codes *= np.iinfo(kind).max // 255
    arrays = [image_file.named("array", x) for x in codes]
    files = [image_file.read(save(tmp_path / f"{i}.png", x, kind)) for i, x in enumerate(codes)]
    for sides in (arrays, files, (arrays[0], files[1]), (files[0], arrays[1])):
        assert compare("flip", *sides).metrics == compare("flip", *files).metrics
        assert compare("flip", *sides).verdict is DIFFERENT
    assert all(compare(method, arrays[0], files[0]).verdict is EQUAL for method in SINGLE)


def test_hdr_and_ldr():
    lines = np.repeat((np.indices((40, 48))[1] // 4 % 2)[..., None], 3, 2) * 0.8 + 0.1
    for hdr in ("yes", "no"):
        assert compare("flip", of(lines), of(lines), hdr=hdr).metrics[0].value == 0
        for other in (np.roll(lines, 1, 1), lines * 1.5):
            assert compare("flip", of(lines), of(other), hdr=hdr).verdict is DIFFERENT
    bright, other = of(50 * (1 + SMOOTH)), of(75 * (1 + SMOOTH))  # too bright for a display
    assert compare("flip", bright, other, hdr="yes").verdict is DIFFERENT
    coded = [replace(image, metadata={"oiio:ColorSpace": "srgb_rec709_scene"}) for image in (bright, other)]
    for sides, hdr in (((bright, other), "no"), (coded, "auto")):
        assert [metric.value for metric in compare("flip", *sides, hdr=hdr).metrics[:4]] == [0] * 4
    for light in (1e-3, 0.25, 1.0, 1e4):  # images of uniform brightness
        one = np.full((16, 16, 3), light)
        for gain in (1.2, 2):
            assert compare("flip", of(one), of(gain * one)).verdict is DIFFERENT
        assert compare("flip", of(one), of(1.01 * one)).verdict is EQUAL


def test_a_room_beside_the_sun_is_seen_and_rounding_errors_beside_black_are_not():
    room = 20 * (0.5 + SMOOTH)
    for change, verdict in ((3, DIFFERENT), (1 + 1e-6, EQUAL)):
        one, two = room.copy(), change * room
        one[3:6, 3:6] = two[3:6, 3:6] = 1.6e9
        assert compare("flip", of(one), of(two)).verdict is verdict
    one = np.zeros_like(SMOOTH)
    two = 20 * SMOOTH
    one[3:6, 3:6] = two[3:6, 3:6] = 1.6e9
    assert compare("flip", of(one), of(two)).verdict is EQUAL


# Black ---------------------------------------------------------------------------------------------------------


def test_images_in_which_black_is_not_detected_are_inconclusive():
    dark = np.full((64, 64), 8.0)
    assert compare("flip", shown(dark), shown(dark - 1)).verdict is INCONCLUSIVE
    stars = np.zeros((128, 128))
    stars[::16, ::16] = 255  # single pixels in the rows that the other methods compare with black first
    moved = stars.copy()
    moved[32, 32] = 254
    assert compare("flip", shown(stars), shown(moved)).verdict is INCONCLUSIVE
    stars[40:60, 40:60] = 255
    moved[40:60, 40:60] = 255
    assert compare("flip", shown(stars), shown(moved)).verdict is EQUAL


# Other channels ------------------------------------------------------------------------------------------------


def test_channels_that_flip_cannot_compare():
    four = of(np.dstack([SMOOTH, SMOOTH[..., :1]]))
    assert compare("flip", four, four).reason.endswith("; by flip A: identical")
    xyz = of(SMOOTH, ("X", "Y", "Z"))
    with pytest.raises(ValueError, match="FLIP needs R, G, B, or a single channel"):
        compare("flip", xyz, xyz)
    gray = of(np.dstack([SMOOTH[..., :1], np.ones((40, 48, 1))]), ("Y", "A"))
    darker = replace(gray, pixels=gray.pixels * [0.3, 1])
    assert [compare("flip", gray, other).verdict for other in (gray, darker)] == [EQUAL, DIFFERENT]
    for name in "ZA":  # values so dark that black would pass
        one, two = (of(np.dstack([SMOOTH, k * SMOOTH[..., :1]]), (*"RGB", name)) for k in (0.004, 0.002))
        assert [compare("flip", one, other).verdict for other in (one, two)] == [EQUAL, INCONCLUSIVE]


@pytest.mark.parametrize(
    "change, by_flip, by_tolerance",
    [
        (lambda other: 1 - other, DIFFERENT, DIFFERENT),
        (lambda other: 0 * other, DIFFERENT, DIFFERENT),
        (lambda other: other + 0.01, EQUAL, DIFFERENT),
        (lambda other: other + 0.003, EQUAL, EQUAL),
        (lambda other: other + np.where(other > 0.899, 9.0, 0.0), DIFFERENT, DIFFERENT),
        (lambda other: other + np.where(other > 0.899, 0.9, 0.0), DIFFERENT, DIFFERENT),
    ],
)
@pytest.mark.parametrize("names", [("R", "G", "B", "A"), ("Z", "B", "G", "R")])
def test_changes_of_alpha_and_depth_are_compared_by_flip_and_tolerance(change, by_flip, by_tolerance, names):
    other = SMOOTH[..., :1]
    index, verdict = (3, by_flip) if "A" in names else (0, by_tolerance)
    sides = (other, change(other))
    one, two = (of(np.insert(SMOOTH, [index], values, axis=2), names) for values in sides)
    result = compare("flip", one, two)
    assert (result.verdict, result.metrics[0].value) == (verdict, 0)
    method = "flip" if "A" in names and max(map(np.max, sides)) <= 1 else "tolerance"
    assert f"; by {method} {names[index]}: " in result.reason
    assert compare("flip", two, one).verdict is verdict


def test_antialiasing_of_alpha_is_equal_and_a_hole_is_different():
    alpha = [edge(0) / 255, edge(0, samples=1) / 255, np.clip(edge(0) / 255, 0, 0.5)]
    one, other, hole = (of(np.dstack([np.full((64, 64, 3), 0.5), x]), stored="uint8") for x in alpha)
    assert compare("flip", one, other).verdict is EQUAL
    result = compare("flip", one, hole)
    assert result.verdict is DIFFERENT and "flip of A" in result.maps
    assert next(metric.name for metric in result.metrics if not metric.holds).endswith(", in A")

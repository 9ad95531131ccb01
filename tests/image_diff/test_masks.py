"""Masks: pixels that do not count, by an image or by rectangles, in every method."""

from __future__ import annotations

import numpy as np
import pytest
from support.diff_images import image, samples

from mi_refract.image_diff import file_pair, methods
from mi_refract.image_diff import folders as diff
from mi_refract.image_diff.settings import Entry, Settings
from mi_refract.io import image_file

SIZE = (32, 48, 3)


def settings(**values):
    return Settings(rules=(Entry("*", values),))


@pytest.fixture
def pair(tmp_path):
    """Two images that differ in the rectangle x = 4 … 19, y = 10 … 21 only, and a mask that is black there."""
    image(tmp_path / "old/a.exr")
    pixels = image(tmp_path / "new/a.exr")
    pixels[10:22, 4:20] *= 3
    image_file.write_exr(tmp_path / "new/a.exr", pixels)
    mask = np.ones(SIZE)
    mask[10:22, 4:20] = 0
    image_file.write_exr(tmp_path / "old/a_mask.exr", mask)
    return tmp_path / "old/a.exr", tmp_path / "new/a.exr"


@pytest.mark.parametrize("method", [name for name, method in methods.METHODS.items() if not method.takes_renders])
@pytest.mark.parametrize(
    "left_out",
    [{"mask": "{stem}_mask.exr"}, {"ignore": ((4, 10, 16, 12),)}, {"ignore": ((0, 10, 10, 12), (10, 0, 10, 22))}],
)
def test_what_is_left_out_does_not_count(pair, method, left_out):
    assert diff.diff(*pair, settings(method=method)).exit_code == 1
    assert diff.diff(*pair, settings(method=method, **left_out)).exit_code == 0
    assert diff.diff(*pair, settings(method=method, ignore=((4, 10, 4, 12),))).exit_code == 1


def test_welch(tmp_path):
    old, new = (samples(tmp_path / name, first=first) for name, first in (("old", 0), ("new", 100)))
    for path in new.iterdir():
        pixels = image_file.read(path).pixels.copy()
        pixels[16:, :16] *= 2
        image_file.write_exr(path, pixels)
    assert diff.diff(old, new, renders=True).exit_code == 1
    assert diff.diff(old, new, settings(ignore=((0, 16, 16, 16),)), renders=True).exit_code == 0


def test_shares_are_of_the_pixels_that_count(pair):
    """192 of 1536 pixels differ: 12.5 %; of the 16 that count half do."""
    only = np.zeros(SIZE)
    only[10:12, 0:8] = 1
    image_file.write_exr(pair[0].parent / "a_mask.exr", only)
    how = {"method": "tolerance", "fail_percent": 20.0}
    assert diff.diff(*pair, settings(**how)).exit_code == 0
    (found,) = diff.diff(*pair, settings(**how, mask="{stem}_mask.exr")).results
    assert "50 % of the pixels (8 of 16)" in found.reason
    assert found.warnings == ("the mask leaves out 99% of the pixels",)


def test_nan_that_is_left_out(pair):
    pixels = image_file.read(pair[1]).pixels.copy()
    pixels[10, 5] = np.nan
    image_file.write_exr(pair[1], pixels)
    assert diff.diff(*pair, settings(method="exact", ignore=((4, 10, 16, 12),))).exit_code == 0


def test_a_data_window_that_does_not_begin_at_zero(pair):
    one = image_file.Image(pair[0], np.ones(SIZE), ("R", "G", "B"), origin=(100, 50))
    assert not file_pair.mask_of(one, None, [(104, 60, 4, 2)])[10:12, 4:8].any()
    assert file_pair.mask_of(one, None, [(104, 60, 4, 2)]).sum() == 32 * 48 - 8


BAD = {
    "size": ({"mask": "small.exr"}, "small.exr: 7 × 8; expected a mask of 48 × 32"),
    "missing": ({"mask": "none.exr"}, "none.exr: No such file"),
    "nan": ({"mask": "nan.exr"}, "values that are not finite"),
    "nothing left": ({"ignore": ((0, 0, 48, 32),)}, "leaves no pixel"),
    "outside": ({"ignore": ((48, 0, 5, 5),)}, "a rectangle that overlaps"),
}


@pytest.mark.parametrize(("values", "message"), BAD.values(), ids=BAD)
def test_bad_masks(pair, values, message):
    image(pair[0].parent / "small.exr", shape=(8, 7, 3))
    image(pair[0].parent / "nan.exr", value=np.nan)
    results = diff.diff(*pair, settings(**values))
    assert results.exit_code == 2
    assert message in results.results[0].error
    assert "\n" not in results.results[0].error


def test_a_mask_is_shown(pair):
    (found,) = diff.diff(*pair, settings(method="exact", ignore=((0, 0, 2, 2),)), maps=True).results
    assert found.comparison.maps["left out"].sum() == 4


@pytest.mark.parametrize("template", ["{stem}_mask.exr", "{root}/masks/{stem}.exr"])
def test_a_mask_among_the_references_is_no_image(pair, template):
    old, new = (path.parent for path in pair)
    if "root" in template:
        (old / "masks").mkdir()
        (old / "a_mask.exr").rename(old / "masks/a.exr")
    results = diff.diff(old, new, settings(method="exact", mask=template))
    assert ([each.name for each in results.results], results.exit_code) == (["a.exr"], 0)


def test_channels_that_are_left_out_are_said(pair):
    chosen = settings(method="exact", channels=(("R", "R"),), ignore=((4, 10, 16, 12),))
    (found,) = diff.diff(*pair, chosen).results
    assert found.reason.endswith("; not compared: G, B")


@pytest.mark.parametrize("shape", [(1, 1, 3), (32, 1, 3), (1, 48, 3), (8, 8, 3)])
def test_a_new_image_of_another_size_is_not_spread_over_the_mask(pair, shape):
    image(pair[0], value=None, gain=0.0)  # black all over, as the new one
    image(pair[1], shape=shape, gain=0.0)
    (found,) = diff.diff(*pair, settings(method="exact", ignore=((0, 0, 2, 2),))).results
    assert found.status == "error"
    assert f"size {shape[1]} × {shape[0]}; expected 48 × 32" in found.error


@pytest.mark.parametrize("rectangle", [(0, -10, 48, 5), (-9, 0, 4, 32), (-50, -50, 10, 10), (0, 32, 9, 9)])
def test_a_rectangle_outside_the_image_holds_none_of_its_pixels(pair, rectangle):
    with pytest.raises(ValueError, match="expected a rectangle that overlaps"):
        file_pair.mask_of(image_file.read(pair[0]), None, [rectangle])

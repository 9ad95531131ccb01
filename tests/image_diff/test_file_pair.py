"""Comparison of two files with every method: several parts and MIP levels, and masks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from support.diff_images import SINGLE, samples
from support.diff_images import image as smooth

from mi_refract.image_diff import accept, file_pair, folders, settings
from mi_refract.image_diff.settings import Settings, from_words
from mi_refract.io import image_file
from mi_refract.io.image_file import read, read_parts, write_exr

RNG = np.random.default_rng(4)
SMALL = [RNG.random((8, 8, 3), np.float32) for _ in range(3)]
PYRAMID = [RNG.random((side, side, 3), np.float32) for side in (8, 4, 2, 1)]


def compared(one, two, **how):
    (result,) = folders.diff(one, two, Settings.for_all(**how), maps=True).results
    return result


# Parts and MIP levels ---------------------------------------------------------------------------------------------


def parts(path, images):
    specs = [oiio.ImageSpec(p.shape[1], p.shape[0], p.shape[2], "float") for p in images]
    for number, spec in enumerate(specs):
        spec.attribute("oiio:subimagename", str(number))
    output = oiio.ImageOutput.create(str(path))
    for number, (spec, pixels) in enumerate(zip(specs, images, strict=True)):
        first = tuple(specs) if path.suffix == ".exr" else spec
        assert output.open(str(path), spec, "AppendSubimage") if number else output.open(str(path), first)
        assert output.write_image(pixels)
    assert output.close()
    return path


def levels(path, images):
    output = oiio.ImageOutput.create(str(path))
    for number, pixels in enumerate(images):
        spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], "float")
        spec.tile_width = spec.tile_height = 16
        spec.attribute("openexr:levelmode", 1)
        spec.attribute("textureformat", "Plain Texture")
        # OpenImageIO reads tiled subimages of a TIFF as levels if the header says that it is a texture.
        append = "AppendMIPLevel" if path.suffix == ".exr" else "AppendSubimage"
        assert output.open(str(path), spec, *([append] if number else [])), output.geterror()
        assert output.write_image(pixels), output.geterror()
    assert output.close()
    return path


def with_change(images, number, by=0.5):
    return [pixels + by if i == number else pixels for i, pixels in enumerate(images)]


@pytest.mark.parametrize("name", ["a.exr", "a.tif"])
def test_all_parts_and_levels_are_read_within_one_limit(tmp_path, name):
    path, size = parts(tmp_path / name, SMALL), 8 * 8 * 3
    images = read_parts(path, 3 * size)
    assert [image.place for image in images] == ["part 0", "part 1", "part 2"]
    assert all(np.array_equal(image.pixels, pixels) for image, pixels in zip(images, SMALL, strict=True))
    with pytest.raises(ValueError, match=r"8 × 8 × 3 values beside 384 .*; expected up to 575 values \(max-values\)"):
        read_parts(path, 3 * size - 1)
    assert len(read_parts(path, size, first_only=True)) == 1
    images = read_parts(levels(path, PYRAMID))
    assert [(image.place, image.part) for image in images] == [(f"MIP level {i}", (0, i)) for i in range(4)]
    assert all(np.array_equal(image.pixels, pixels) for image, pixels in zip(images, PYRAMID, strict=True))
    (first,) = read_parts(path, first_only=True)
    assert (first.place, first.part) == ("MIP level 0", (0, 0))
    with pytest.raises(ValueError, match=r"several parts or MIP levels in one file; expected one image"):
        read(path)
    smooth(tmp_path / "a.exr")
    (only,) = read_parts(tmp_path / "a.exr")
    assert (only.place, only.part, read(tmp_path / "a.exr").place) == ("", (0, 0), "")


@pytest.mark.parametrize("method", SINGLE)
@pytest.mark.parametrize("write, images, place", [(parts, SMALL, "part 2"), (levels, PYRAMID, "MIP level 2")])
def test_a_changed_part_or_level_is_different_and_named(tmp_path, method, write, images, place):
    one = write(tmp_path / "a.exr", images)
    assert compared(one, write(tmp_path / "b.exr", images), method=method).status == "equal"
    result = compared(one, write(tmp_path / "c.exr", with_change(images, 2)), method=method)
    assert result.status == "different" and result.reason.startswith(f"{place}: ")
    assert result.reason.endswith(f"; different: 1 of {len(images)} parts and MIP levels")
    assert [image.pixels.shape for image in result.images.values()] == [images[2].shape] * 2


@pytest.mark.parametrize("number, words", [(2, "part 2 is missing"), (1, "part 1 is missing, and 1 more")])
def test_a_missing_or_added_part_is_a_difference(tmp_path, number, words):
    one, two = parts(tmp_path / "a.exr", SMALL), parts(tmp_path / "b.exr", SMALL[:number])
    result = compared(one, two)
    assert (result.status, result.reason.partition(";")[0]) == ("different", words)
    assert compared(two, one).reason.startswith(words.replace("is missing", "was added"))


def test_a_warning_names_the_first_part_and_counts_the_others(tmp_path):
    words = ["fail=.001", "fail_percent=60", "fail_relative=0", "warn=1e-6", "warn_relative=0", "warn_percent=0"]
    flags = from_words("tolerance", words).values
    one = parts(tmp_path / "a.exr", SMALL)
    changed = [np.where(pixels > 0.9, pixels + 0.01, pixels) for pixels in SMALL]
    result = compared(one, parts(tmp_path / "b.exr", [SMALL[0], changed[1], SMALL[2]]), **flags)
    assert result.status == "equal"
    assert result.warning.startswith("part 1: ") and result.warning.endswith("> warn_percent = 0)")
    result = compared(one, parts(tmp_path / "c.exr", changed), **flags)
    assert result.warning.startswith("part 0: ") and result.warning.endswith(", and in 2 more parts and MIP levels")
    assert compared(one, parts(tmp_path / "d.exr", [changed[0], SMALL[1] + 1, SMALL[2]]), **flags).warning == ""


def test_an_error_names_the_part(tmp_path):
    one, two = (parts(tmp_path / f"{x}.exr", [SMALL[0], SMALL[1][..., : 3 - x]]) for x in (0, 1))
    assert compared(one, two).status == "different"  # a channel is missing
    other = parts(tmp_path / "other.tif", [SMALL[0], SMALL[1][:4]])
    result = compared(parts(tmp_path / "one.tif", SMALL[:2]), other)
    assert result.status == "error"
    assert "size 8 × 4; expected 8 × 8" in result.error and result.error.endswith("(part 1)")


@pytest.mark.parametrize("how", [{"mask": "m.exr"}, {"ignore": ((0, 0, 2, 2),)}, {"variance": "v.exr"}], ids=str)
def test_masks_and_variances_need_single_images(tmp_path, how):
    for name in ("m", "v"):
        write_exr(tmp_path / f"{name}.exr", np.ones((8, 8, 3)))
    result = compared(parts(tmp_path / "a.exr", SMALL), parts(tmp_path / "b.exr", SMALL), **how)
    assert (result.status, result.error) == (
        "error",
        f"{tmp_path / 'a.exr'}: several parts or MIP levels; for masks and `variance` expected a single image",
    )


def test_a_file_of_several_parts_can_be_accepted(tmp_path):
    old, new = (tmp_path / side for side in ("old", "new"))
    for side, images in ((old, SMALL), (new, with_change(SMALL, 2))):
        side.mkdir()
        parts(side / "a.exr", images)
    accept.Acceptance(list(accept.changes(folders.diff(old, new, to_accept=True)))).run()
    assert folders.diff(old, new).exit_code == 0
    parts(new / "a.exr", with_change(SMALL, 2, np.nan))
    with pytest.raises(ValueError, match="values that are not finite"):
        list(accept.changes(folders.diff(old, new, to_accept=True)))


# Masks ------------------------------------------------------------------------------------------------------------

SIZE = (32, 48, 3)
WHOLE = ((4, 10, 16, 12),)  # x = 4 … 19, y = 10 … 21


@pytest.fixture
def sides(tmp_path):
    """Two images that differ only in the rectangle WHOLE, and a mask that is black there."""
    smooth(tmp_path / "old/a.exr")
    pixels, mask = smooth(tmp_path / "new/a.exr"), np.ones(SIZE)
    pixels[10:22, 4:20] *= 3
    mask[10:22, 4:20] = 0
    write_exr(tmp_path / "new/a.exr", pixels)
    write_exr(tmp_path / "old/a_mask.exr", mask)
    return tmp_path / "old/a.exr", tmp_path / "new/a.exr"


@pytest.mark.parametrize("method", SINGLE)
def test_masked_pixels_are_not_compared(sides, method):
    assert compared(*sides, method=method).status == "different"
    assert compared(*sides, method=method, ignore=((4, 10, 4, 12),)).status == "different"
    for left_out in ({"mask": "{stem}_mask.exr"}, {"ignore": WHOLE}, {"ignore": ((0, 10, 10, 12), (10, 0, 10, 22))}):
        assert compared(*sides, method=method, **left_out).status == "equal"


def test_renders_are_masked(tmp_path, monkeypatch):
    old, new = (samples(tmp_path / name, first=first) for name, first in (("old", 0), ("new", 100)))
    for path in new.iterdir():
        pixels = read(path).pixels.copy()
        pixels[16:, :16] *= 2
        write_exr(path, pixels)
    assert folders.diff(old, new, renders=True).exit_code == 1
    assert folders.diff(old, new, Settings.for_all(ignore=((0, 16, 16, 16),)), renders=True).exit_code == 0
    mask = np.ones(SIZE)
    mask[16:, :16] = 0
    write_exr(tmp_path / "old_mask.exr", mask)  # beside the folder of the reference, which its fields are of
    for above in (Path(), Path("old")):
        results = folders.diff(old, new, replace(Settings.for_all(mask="{stem}_mask.exr"), above=above), renders=True)
        assert (results.exit_code, [result.error for result in results.results]) == (0, [""])
    monkeypatch.chdir(old)
    assert folders.diff(Path(), new, Settings.for_all(mask="{stem}_mask.exr"), renders=True).exit_code == 0


def test_renders_may_be_the_same_where_a_mask_leaves_no_noise(tmp_path):
    rng, sides = np.random.default_rng(1), (tmp_path / "old", tmp_path / "new")
    for folder in sides:
        folder.mkdir()
        for number in range(3):
            pixels = np.full(SIZE, 0.5)
            pixels[:, :24] *= rng.gamma(4, 1 / 4, (32, 24, 1))
            pixels[16, 36] *= 3 if (folder.name, number) == ("new", 2) else 1  # a firefly
            write_exr(folder / f"{number}.exr", pixels)
    (result,) = folders.diff(*sides, Settings.for_all(ignore=((0, 0, 24, 32),)), renders=True).results
    assert result.status == "inconclusive"


def test_shares_refer_to_the_compared_pixels_and_the_mask_is_a_map(sides):
    """192 of 1536 pixels differ, 12.5 %, and 8 of the 16 pixels inside the mask."""
    mask = np.zeros(SIZE)
    mask[10:12, 0:8] = 1
    write_exr(sides[0].parent / "a_mask.exr", mask)
    how = {"method": "tolerance", "fail_percent": 20.0}
    assert compared(*sides, **how).status == "equal"
    result = compared(*sides, **how, mask="{stem}_mask.exr")
    assert "50 % of the pixels (8 of 16)" in result.reason
    assert result.warnings == ("the mask leaves out 99% of the pixels",)
    assert result.comparison.maps["left out"].sum() == 1520


def test_a_pixel_is_compared_where_a_colour_of_the_mask_is_at_least_a_half(tmp_path):
    """Alpha is not a colour."""
    colours = np.zeros((1, 6, 4), np.float32)
    colours[0, :, 0], colours[0, 4, 1], colours[0, :, 3] = (0, 0.49, 0.5, 1, 0, 0), 0.5, 1
    write_exr(tmp_path / "mask.exr", colours, tuple("RGBA"))
    one = image_file.Image(tmp_path / "a.exr", colours, tuple("RGBA"))
    assert file_pair.mask_of(one, tmp_path / "mask.exr", ()).tolist() == [[False, False, True, True, True, False]]
    assert "where a colour of it is at least 0.5, alpha not counted" in settings.key_tables()


def test_masked_nan_and_unselected_channels_are_ignored(sides):
    pixels = read(sides[1]).pixels.copy()
    pixels[10, 5] = np.nan
    write_exr(sides[1], pixels)
    assert compared(*sides, method="exact", ignore=WHOLE).status == "equal"
    result = compared(*sides, method="exact", channels=["R"], ignore=WHOLE)
    assert result.reason.endswith("; not compared: G, B")


def test_rectangles_are_relative_to_the_data_window(sides):
    one = image_file.Image(sides[0], np.ones(SIZE), ("R", "G", "B"), origin=(100, 50))
    mask = file_pair.mask_of(one, None, [(104, 60, 4, 2)])
    assert not mask[10:12, 4:8].any() and mask.sum() == 32 * 48 - 8


def crop(path, pixels, x, y):
    """Write a part, from (x, y) on, of a frame of 64 × 64 pixels."""
    spec = oiio.ImageSpec(*pixels.shape[1::-1], 3, "float")
    spec.x, spec.y, spec.full_width, spec.full_height = x, y, 64, 64
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec) and output.write_image(pixels.astype(np.float32)) and output.close()


def test_masks_and_variances_of_another_part_of_the_frame_are_refused(sides):
    """A mask without a frame of its own, such as a PNG file, belongs to the part that the image shows."""
    old, _ = sides
    mask = old.parent / "a_mask.exr"
    pixels = read(mask).pixels
    for path in sides:
        crop(path, read(path).pixels, 8, 4)
    assert compared(*sides, mask="{stem}_mask.exr").status == "equal"
    crop(mask, pixels, 8, 4)
    assert compared(*sides, mask="{stem}_mask.exr").status == "equal"
    for x, y in ((0, 0), (8, 5)):
        crop(mask, pixels, x, y)
        for how in ({"mask": "{stem}_mask.exr"}, {"variance": "{stem}_mask.exr", "spp": 4}):
            error = compared(*sides, **how).error
            assert error == f"{mask}: data window from x = {x}, y = {y}; expected that of {old}: from x = 8, y = 4"


BAD = {
    "size": ({"mask": "small.exr"}, "small.exr: 7 × 8; expected a mask of 48 × 32"),
    "missing": ({"mask": "none.exr"}, "none.exr: no such file; expected a mask"),
    "nan": ({"mask": "nan.exr"}, "values that are not finite"),
    "nothing left": ({"ignore": ((0, 0, 48, 32),)}, "leaves no pixel"),
    **{
        f"outside {rectangle}": ({"ignore": (rectangle,)}, "expected a rectangle that overlaps")
        for rectangle in ((48, 0, 5, 5), (0, -10, 48, 5), (-9, 0, 4, 32), (-50, -50, 10, 10), (0, 32, 9, 9))
    },
}


@pytest.mark.parametrize(("values", "message"), BAD.values(), ids=BAD)
def test_invalid_masks_are_errors(sides, values, message):
    smooth(sides[0].parent / "small.exr", shape=(8, 7, 3))
    smooth(sides[0].parent / "nan.exr", value=np.nan)
    result = compared(*sides, **values)
    assert result.status == "error" and message in result.error and "\n" not in result.error


@pytest.mark.parametrize("template", ["{stem}_mask.exr", "{root}/masks/{stem}.exr"])
def test_a_mask_in_the_folder_of_references_is_not_compared(sides, template):
    old, new = (path.parent for path in sides)
    if "root" in template:
        (old / "masks").mkdir()
        (old / "a_mask.exr").rename(old / "masks/a.exr")
    results = folders.diff(old, new, Settings.for_all(method="exact", mask=template))
    assert ([result.name for result in results.results], results.exit_code) == (["a.exr"], 0)
    of_parent = Settings.for_all(method="exact", mask=template.replace("{root}", "{root}/{dir}"))
    results = folders.diff(old, new, replace(of_parent, above=Path("old")))
    assert ([result.name for result in results.results], results.exit_code) == (["a.exr"], 0)


@pytest.mark.parametrize("shape", [(1, 1, 3), (32, 1, 3), (1, 48, 3), (8, 8, 3)])
def test_a_new_image_of_another_size_is_an_error_with_a_mask(sides, shape):
    smooth(sides[0], gain=0.0)  # black, as the new one
    smooth(sides[1], shape=shape, gain=0.0)
    result = compared(*sides, method="exact", ignore=((0, 0, 2, 2),))
    assert result.status == "error"
    assert f"size {shape[1]} × {shape[0]}; expected 48 × 32" in result.error

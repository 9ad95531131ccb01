"""Files of several parts or MIP levels: each is compared, and the verdict says which of them it is about."""

from __future__ import annotations

import numpy as np
import OpenImageIO as oiio
import pytest
from support.diff_images import image as smooth

from mi_refract.image_diff import accept, folders
from mi_refract.image_diff.methods import METHODS
from mi_refract.image_diff.settings import Entry, Settings, from_words
from mi_refract.io import image_file
from mi_refract.io.image_file import read, read_parts

RNG = np.random.default_rng(4)
SMALL = [RNG.random((8, 8, 3), np.float32) for _ in range(3)]
PYRAMID = [RNG.random((side, side, 3), np.float32) for side in (8, 4, 2, 1)]
SINGLE = [name for name, method in METHODS.items() if not method.takes_renders]


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
        # OpenImageIO reads tiled subimages of a TIFF as levels where the header speaks of a texture.
        append = "AppendMIPLevel" if path.suffix == ".exr" else "AppendSubimage"
        assert output.open(str(path), spec, *([append] if number else [])), output.geterror()
        assert output.write_image(pixels), output.geterror()
    assert output.close()
    return path


def with_change(images, number, by=0.5):
    return [pixels + by if i == number else pixels for i, pixels in enumerate(images)]


def compared(one, two, how=Entry("", {})):  # noqa: B008
    (result,) = folders.diff(one, two, Settings((how,)), maps=True).results
    return result


@pytest.mark.parametrize("name", ["a.exr", "a.tif"])
def test_every_part_and_level_is_read(tmp_path, name):
    found = read_parts(parts(tmp_path / name, SMALL))
    assert [image.place for image in found] == ["part 0", "part 1", "part 2"]
    assert all(np.array_equal(image.pixels, pixels) for image, pixels in zip(found, SMALL, strict=True))
    found = read_parts(levels(tmp_path / name, PYRAMID))
    assert [image.place for image in found] == [f"MIP level {i}" for i in range(4)]
    assert [image.part for image in found] == [(0, i) for i in range(4)]
    assert all(np.array_equal(image.pixels, pixels) for image, pixels in zip(found, PYRAMID, strict=True))
    (first,) = read_parts(tmp_path / name, first_only=True)
    assert (first.place, first.part) == ("MIP level 0", (0, 0))
    with pytest.raises(ValueError, match=r"several parts or MIP levels in one file; expected one image"):
        read(tmp_path / name)


def test_the_limit_holds_for_all_together(tmp_path):
    path = parts(tmp_path / "a.exr", SMALL)
    size = 8 * 8 * 3
    assert len(read_parts(path, 3 * size)) == 3
    with pytest.raises(ValueError, match=r"8 × 8 × 3 values beside 384 .*; expected up to 575 values \(max-values\)"):
        read_parts(path, 3 * size - 1)
    assert len(read_parts(path, size, first_only=True)) == 1


@pytest.mark.parametrize("method", SINGLE)
@pytest.mark.parametrize("write, images, place", [(parts, SMALL, "part 2"), (levels, PYRAMID, "MIP level 2")])
def test_a_change_in_any_of_them_is_different_and_placed(tmp_path, method, write, images, place):
    one = write(tmp_path / "a.exr", images)
    same = compared(one, write(tmp_path / "b.exr", images), Entry("", {"method": method}))
    assert str(same.status) == "equal"
    found = compared(one, write(tmp_path / "c.exr", with_change(images, 2)), Entry("", {"method": method}))
    assert str(found.status) == "different"
    assert found.reason.startswith(f"{place}: ")
    assert found.reason.endswith(f"; different: 1 of {len(images)} parts and MIP levels")
    assert [image.pixels.shape for image in found.images.values()] == [images[2].shape] * 2


@pytest.mark.parametrize("number, words", [(2, "part 2 is missing"), (1, "part 1 is missing, and 1 more")])
def test_a_part_that_one_side_lacks_is_a_difference(tmp_path, number, words):
    one, two = parts(tmp_path / "a.exr", SMALL), parts(tmp_path / "b.exr", SMALL[:number])
    found = compared(one, two)
    assert (str(found.status), found.reason.partition(";")[0]) == ("different", words)
    assert compared(two, one).reason.startswith(words.replace("is missing", "was added"))


def test_a_warning_names_its_place_and_the_others_are_counted(tmp_path):
    words = ["fail=.001", "fail_percent=60", "fail_relative=0", "warn=1e-6", "warn_relative=0", "warn_percent=0"]
    flags = from_words("tolerance", words)
    one = parts(tmp_path / "a.exr", SMALL)
    some = [np.where(each > 0.9, each + 0.01, each) for each in SMALL]
    found = compared(one, parts(tmp_path / "b.exr", [SMALL[0], some[1], SMALL[2]]), flags)
    assert str(found.status) == "equal"
    assert found.warning.startswith("part 1: ") and found.warning.endswith("> warn_percent = 0)")
    found = compared(one, parts(tmp_path / "c.exr", some), flags)
    assert found.warning.startswith("part 0: ")
    assert found.warning.endswith(", and in 2 more parts and MIP levels")
    assert compared(one, parts(tmp_path / "d.exr", [some[0], SMALL[1] + 1, SMALL[2]]), flags).warning == ""


def test_what_cannot_be_compared_is_named_with_its_place(tmp_path):
    one, two = (parts(tmp_path / f"{x}.exr", [SMALL[0], SMALL[1][..., : 3 - x]]) for x in (0, 1))
    assert str(compared(one, two).status) == "different"  # a channel is missing
    other = parts(tmp_path / "other.tif", [SMALL[0], SMALL[1][:4]])
    found = compared(parts(tmp_path / "one.tif", SMALL[:2]), other)
    assert str(found.status) == "error"
    assert "size 8 × 4; expected 8 × 8" in found.error and found.error.endswith("(part 1)")


def test_a_file_of_several_parts_can_be_accepted(tmp_path):
    old, new = (tmp_path / side for side in ("old", "new"))
    for side, images in ((old, SMALL), (new, with_change(SMALL, 2))):
        side.mkdir()
        parts(side / "a.exr", images)
    accept.accept(list(accept.changes(folders.diff(old, new, to_accept=True))))
    assert folders.diff(old, new).exit_code == 0
    parts(new / "a.exr", with_change(SMALL, 2, np.nan))
    with pytest.raises(ValueError, match="values that are not finite"):
        list(accept.changes(folders.diff(old, new, to_accept=True)))


def test_a_file_of_one_image_has_no_place(tmp_path):
    smooth(tmp_path / "a.exr")
    (only,) = read_parts(tmp_path / "a.exr")
    assert (only.place, only.part) == ("", (0, 0))
    assert image_file.read(tmp_path / "a.exr").place == ""

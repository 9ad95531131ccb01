"""Images in files of any format: what is read, and that every bad file is one line."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import struct
import subprocess

import numpy as np
import OpenImageIO as oiio
import pytest
from support.diff_images import cut

from mi_refract.io import image_file
from mi_refract.io.image_file import read, write_exr

PIXELS = np.random.default_rng(1).random((48, 40, 3)).astype(np.float32)


def save(path, pixels, kind="float", **attributes):
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    for name, value in attributes.items():
        setattr(spec, name, value)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec), output.geterror()
    assert output.write_image(pixels)
    assert output.close()
    return path


@pytest.mark.parametrize(
    "name, kind, error",
    [("a.exr", "float", 0), ("a.tif", "float", 0), ("a.png", "uint8", 1 / 509), ("a.hdr", "float", 0.01)],
)
def test_formats(tmp_path, name, kind, error):
    image = read(save(tmp_path / name, PIXELS, kind))
    assert image.pixels.dtype == np.float32
    assert image.channels == ("R", "G", "B")
    np.testing.assert_allclose(image.pixels, PIXELS, atol=error, rtol=0)
    assert image_file.count_values(tmp_path / name) == PIXELS.size


def test_channels_window_and_header(tmp_path):
    image = read(save(tmp_path / "a.exr", PIXELS, x=-3, y=5, channelnames=("B", "Z", "a.X")))
    assert image.origin == (-3, 5)
    assert sorted(image.channels) == ["B", "Z", "a.X"]
    np.testing.assert_array_equal(image.select(("B", "Z", "a.X")), PIXELS)
    with pytest.raises(ValueError, match=r"a\.exr: no channel 'R'; expected .*Z"):
        image.select(["R"])
    write_exr(tmp_path / "b.exr", PIXELS, metadata={"mi_refract:spp": 7})
    assert read(tmp_path / "b.exr").metadata["mi_refract:spp"] == 7


def test_colour_under_a_transparent_alpha_is_kept(tmp_path):
    pixels = np.dstack([PIXELS, np.zeros((48, 40))]).astype(np.float32)
    path = tmp_path / "a.png"
    spec = oiio.ImageSpec(40, 48, 4, "uint8")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    assert output.write_image(pixels)
    assert output.close()
    np.testing.assert_allclose(read(path).pixels, pixels, atol=1 / 509)


def test_numbers_that_float32_does_not_hold_stay_apart(tmp_path):
    wide = np.array([[[1.0]], [[1 + 2.0**-40]]])
    values = read(save(tmp_path / "a.tif", wide, "double")).pixels
    assert values.dtype == np.float64
    np.testing.assert_array_equal(values, wide)


def test_the_numbers_that_idiff_compares(tmp_path):
    """float32, and colours multiplied by alpha."""
    path = save(tmp_path / "a.tif", np.full((2, 2, 3), 1 + 2.0**-40), "double")
    (image,) = image_file.read_parts(path, as_idiff=True)
    assert image.pixels.dtype == np.float32 and (image.pixels == 1).all()
    spec = oiio.ImageSpec(1, 1, 4, "float")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec) and output.write_image(np.float32([[[1, 1, 1, 0.5]]])) and output.close()
    assert image_file.read_parts(path, as_idiff=True)[0].pixels[0, 0, 0] == 0.5
    assert read(path).pixels[0, 0, 0] == 1


def test_what_openimageio_reads_wrongly_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"a\.tif: one row of 64-bit numbers in a TIFF file; expected several rows"):
        read(save(tmp_path / "a.tif", np.ones((1, 4, 3)), "double"))
    assert read(save(tmp_path / "b.tif", np.ones((1, 4, 3), np.float32), "float")).pixels.shape == (1, 4, 3)


def multipart(path):
    spec = oiio.ImageSpec(40, 48, 3, "float")
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), [spec, spec])
    assert output.write_image(PIXELS)
    assert output.open(str(path), spec, "AppendSubimage")
    assert output.write_image(PIXELS)
    assert output.close()


def deep(path):
    spec = oiio.ImageSpec(2, 2, 1, "float")
    spec.channelnames = ("Z",)
    spec.deep = True
    data = oiio.DeepData()
    data.init(4, 1, ["float"], ["Z"])
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    assert output.write_deep_image(data)
    assert output.close()


def window(path, x, y):
    """An EXR whose header says another data window."""
    data = bytearray(save(path, PIXELS).read_bytes())
    begin = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    data[begin : begin + 16] = struct.pack("<4i", 0, 0, x, y)
    path.write_bytes(data)


BAD = {
    "empty.exr": lambda path: path.write_bytes(b""),
    "empty.png": lambda path: path.write_bytes(b""),
    "text.exr": lambda path: path.write_text("<scene/>"),
    "text.png": lambda path: path.write_text("<scene/>"),
    "noise.hdr": lambda path: path.write_bytes(bytes(range(256)) * 9),
    "wrong.exr": lambda path: save(path.with_suffix(".png"), PIXELS, "uint8").rename(path),
    "wrong.png": lambda path: save(path.with_suffix(".exr"), PIXELS).rename(path),
    "parts.exr": multipart,
    "deep.exr": deep,
    "zero.exr": lambda path: window(path, -1, -1),
    "huge.exr": lambda path: window(path, 2**30, 2**30),
    "big.exr": lambda path: window(path, 2**16, 2**16),
    "black.null": lambda path: path.write_text("read as black, whatever it holds"),
    "pipe.exr": os.mkfifo,
    "header.tif": lambda path: path.write_bytes(b"II*\0\x08\0\0\0"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_one_line_that_names_them(tmp_path, name):
    path = tmp_path / name
    BAD[name](path)
    with pytest.raises(ValueError) as error:
        read(path)
    assert str(error.value).startswith(f"{path}: ")
    assert str(error.value).count(str(tmp_path)) == 1
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["a.exr", "a.png", "a.tif", "a.gif", "a.jp2", "a.jxl", "jp2 as.png", "gif as.exr"])
def test_the_size_is_asked_of_the_header(tmp_path, name):
    """Of a file that ends after its header: what is read of the rest would be an error of its own."""
    side = 592  # more than 1 MiB, in which OpenImageIO counts
    path = tmp_path / f"a.{name[:3]}" if " " in name else tmp_path / name
    save(path, np.zeros((side, side, 3), np.uint8), "uint8")
    path = path.rename(tmp_path / name)
    cut(path, -1 if name == "a.tif" else 0.9)
    with pytest.raises(ValueError, match=r"\(max-values\)$|not a|Not a") as error:
        read(path, side * side)
    assert ("max-values" in str(error.value)) is (" " not in name)
    assert error.value.args[0].count(str(tmp_path)) == 1
    with pytest.raises(ValueError, match=r"corrupt|holds an image of format"):
        read(path)


def test_as_many_values_as_are_allowed_are_read(tmp_path):
    """Of the widest numbers, 2 MiB: OpenImageIO counts bytes."""
    pixels = np.zeros((300, 300, 3))
    path = save(tmp_path / "a.tif", pixels, "double")
    assert read(path, pixels.size).pixels.shape == pixels.shape
    with pytest.raises(ValueError, match=r"a\.tif: 300 × 300 × 3 values; expected up to 269999 values"):
        read(path, pixels.size - 1)


def test_a_limit_of_openimageio_is_left_as_it_was(tmp_path):
    before = oiio.get_int_attribute("limits:imagesize_MB")
    read(save(tmp_path / "a.exr", PIXELS))
    with pytest.raises(ValueError, match="corrupt"):
        BAD["text.exr"](tmp_path / "a.exr")
        read(tmp_path / "a.exr")
    assert oiio.get_int_attribute("limits:imagesize_MB") == before


@pytest.mark.parametrize("name, kind", [("a.exr", "float"), ("a.png", "uint8"), ("a.hdr", "float"), ("a.tif", "float")])
@pytest.mark.parametrize("keep", [0, 6, 0.3, 0.7, 0.97])
def test_truncated_files(tmp_path, name, kind, keep):
    path = save(tmp_path / name, PIXELS, kind)
    cut(path, keep)
    with pytest.raises(ValueError, match=f"{name}: corrupt") as error:
        read(path)
    assert "\n" not in str(error.value)


def test_a_name_that_is_no_utf8(tmp_path):
    save(tmp_path / "a.exr", PIXELS).rename(path := tmp_path / "a\udcff.exr")
    with pytest.raises(ValueError, match="expected a name in UTF-8"):
        read(path)


def test_what_the_system_does_not_give(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.exr"):
        read(tmp_path / "none.exr")
    with pytest.raises(OSError, match=str(tmp_path)):
        read(tmp_path)
    path = save(tmp_path / "a.exr", PIXELS)
    path.chmod(0)
    if os.access(path, os.R_OK):
        pytest.skip("this user may read everything")
    with pytest.raises(PermissionError, match=r"a\.exr"):
        read(path)


# Git LFS ----------------------------------------------------------------------------------------------------------

POINTER = """version https://git-lfs.github.com/spec/v1
oid sha256:4d7a214614ab2935c943f9e0ff69d22eadbb8f32b1258daaa5e2ca24d17e2393
size 12345
"""


def command_in(error):
    return re.fullmatch(r".*: a Git LFS pointer, not the image; `(.*)` brings it", str(error.value))[1]


@pytest.mark.parametrize("name", ["a.exr", "a.png", "in a folder/a[1],*.tif"])
def test_a_pointer_of_git_lfs_is_named_with_the_command_that_brings_the_image(tmp_path, name):
    path = tmp_path / "repository" / name
    path.parent.mkdir(parents=True)
    path.write_text(POINTER)
    with pytest.raises(ValueError, match=r"^/.*: a Git LFS pointer") as outside:
        read(path)
    assert shlex.split(command_in(outside))[3].startswith("--include=/")
    (tmp_path / "repository" / ".git").mkdir()
    with pytest.raises(ValueError, match=r"^[^\n]*$") as inside:
        read(path)
    pattern = {"in a folder/a[1],*.tif": "in a folder/a?1???.tif"}.get(name, name)
    assert shlex.split(command_in(inside)) == ["git", "lfs", "pull", f"--include={pattern}"]


@pytest.mark.skipif(shutil.which("git-lfs") is None, reason="no git-lfs (apt-get install git-lfs)")
def test_that_command_brings_it(tmp_path):
    """A repository with two images, and a clone of it that did not ask for them."""
    home = {"HOME": str(tmp_path), "GIT_CONFIG_NOSYSTEM": "1", "GIT_LFS_SKIP_SMUDGE": "1"}
    home |= {f"GIT_{role}_{what}": "a@b" for role in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")}

    def git(folder, *words):
        subprocess.run(["git", *words], cwd=folder, env=os.environ | home, check=True, capture_output=True, timeout=60)

    origin, clone = tmp_path / "origin", tmp_path / "clone"
    git(tmp_path, "init", str(origin))
    (origin / "ref").mkdir()
    save(origin / "ref" / "a[1].exr", PIXELS)
    save(origin / "b.exr", PIXELS)
    for words in (["install"], ["track", "*.exr"]):
        git(origin, "lfs", *words)
    git(origin, "add", ".")
    git(origin, "commit", "-m", "images")
    git(tmp_path, "clone", origin.as_uri(), str(clone))
    with pytest.raises(ValueError, match="Git LFS pointer") as error:
        read(clone / "ref" / "a[1].exr")
    git(clone, *shlex.split(command_in(error))[1:])
    assert np.array_equal(read(clone / "ref" / "a[1].exr").pixels, PIXELS)
    with pytest.raises(ValueError, match="Git LFS pointer"):
        read(clone / "b.exr")

"""Images in files: EXR round trips, other formats, errors of bad files; and arithmetic on pixels."""

from __future__ import annotations

import os
import resource
import struct
import sys

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image as PillowImage
from PIL import ImageCms
from support.diff_images import cut, exr_of_integers, save, tiff

from mi_refract.io import image_file
from mi_refract.io.image_file import (
    any_channel,
    block_area,
    block_mean,
    block_sum,
    read,
    read_exr,
    srgb_decode,
    srgb_encode,
    write_exr,
)

SRGB_PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
PIXELS = np.random.default_rng(1).random((48, 40, 3)).astype(np.float32)
UNASSOCIATED = {"oiio:UnassociatedAlpha": (1,)}  # colours are not multiplied by alpha
# Values that conversion to half floats, clamping or a colour transform would change.
HARD = np.array([[[0.1, -2.5, 1e20], [np.inf, 1e-30, 3]], [[1, np.nan, 65505], [4, 5, 6]], [[7, 8, 9], [0, -0.0, 1]]])


# Writing EXR files ----------------------------------------------------------------------------------------------------


def test_written_exr_files_are_read_back_unchanged(tmp_path):
    metadata = {"mi_refract:scene": "a b/ü.xml", "mi_refract:spp": 7, "mi_refract:seconds": 0.25, "Software": "us"}
    write_exr(tmp_path / "a.exr", HARD, metadata=metadata | {"mi_refract:seed": 2**32 - 1})
    pixels, header = read_exr(tmp_path / "a.exr")
    assert pixels.dtype == np.float32 and header["channels"] == ("R", "G", "B")
    np.testing.assert_array_equal(pixels, HARD.astype(np.float32))
    assert {name: header[name] for name in metadata} == metadata and header["mi_refract:seed"] == str(2**32 - 1)
    names = ("S0.R", "A", "B", "G", "R")
    write_exr(tmp_path / "a.exr", np.arange(30.0).reshape(3, 2, 5), names)
    image = read(tmp_path / "a.exr")
    assert sorted(image.channels) == sorted(names) and [path.name for path in tmp_path.iterdir()] == ["a.exr"]
    np.testing.assert_array_equal(image.select(names), np.arange(30.0).reshape(3, 2, 5))
    with pytest.raises(ValueError, match=r"a\.exr: no channel 'Z'; expected .*S0\.R"):
        image.select(["Z"])


@pytest.mark.parametrize(
    ("name", "options", "error", "message"),
    [("a.exr", {"channels": names, "pixels": np.zeros(shape)}, ValueError, r"a\.exr: .*expected")
     for shape, names in (((2, 2), "RGB"), ((2, 2, 4), "RGB"), ((0, 2, 3), "RGB"), ((2, 2, 3), "RGR"))]
    + [("a.exr", {"metadata": {"x": value}}, ValueError, "expected str, int, float") for value in (None, [1], {}, b"x")]
    + [("a.png", {}, ValueError, "a.png"), ("folder.exr", {}, IsADirectoryError, "folder.exr"),
       ("none/a.exr", {}, NotADirectoryError, "none/a.exr"), ("file/a.exr", {}, NotADirectoryError, "file/a.exr")],
)  # fmt: skip
def test_invalid_images_and_paths_are_not_written(tmp_path, name, options, error, message):
    (tmp_path / "folder.exr").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(error, match=message):
        write_exr(tmp_path / name, **{"pixels": HARD} | options)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.exr"]


@pytest.mark.parametrize("side", [4, 400], ids=["within a buffer", "beyond it"])
def test_a_full_disk_keeps_the_old_file(tmp_path, side):
    """A limit on the size of files replaces a full disk."""
    path, limits = tmp_path / "a.exr", resource.getrlimit(resource.RLIMIT_FSIZE)
    path.write_text("old")
    resource.setrlimit(resource.RLIMIT_FSIZE, (200, limits[1]))
    try:
        with pytest.raises(OSError, match=r"^[^\n]*a\.exr: cannot be written: [^\n]+$"):
            write_exr(path, np.random.default_rng(1).random((side, side, 3)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


# Files of any format --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, kind, error",
    [("a.exr", "float", 0), ("a.tif", "float", 0), ("a.png", "uint8", 1 / 509), ("a.hdr", "float", 0.01)],
)
def test_formats(tmp_path, name, kind, error):
    image = read(save(tmp_path / name, PIXELS, kind))
    assert image.pixels.dtype == np.float32 and image.channels == ("R", "G", "B")
    np.testing.assert_allclose(image.pixels, PIXELS, atol=error, rtol=0)
    assert image_file.count_values(tmp_path / name) == PIXELS.size


def test_windows_unassociated_alpha_and_wide_numbers_are_kept(tmp_path):
    """Colours are not multiplied by alpha."""
    assert read(save(tmp_path / "a.exr", PIXELS, x=-3, y=5)).origin == (-3, 5)
    pixels = np.dstack([PIXELS, np.zeros((48, 40))]).astype(np.float32)
    save(tmp_path / "a.png", pixels, "uint8", UNASSOCIATED)
    np.testing.assert_allclose(read(tmp_path / "a.png").pixels, pixels, atol=1 / 509)
    ids = np.uint32([[[2**24, 5]], [[2**24 + 1, 2**32 - 1]]])
    np.testing.assert_array_equal(read(exr_of_integers(tmp_path / "a.exr", ids, ["id1", "id2"])).pixels, ids)
    np.testing.assert_array_equal(read(tiff(tmp_path / "a.tif", ids)).pixels, ids / (2**32 - 1))
    wide = np.array([[[1.0]], [[1 + 2.0**-40]]])
    path = save(tmp_path / "a.tif", wide, "double")
    np.testing.assert_array_equal(read(path).pixels, wide)
    save(path, np.float32([[[1, 1, 1, 0.5]]]), attributes=UNASSOCIATED)
    assert read(path).pixels[0, 0, 0] == 1


def multipart(path):
    spec = oiio.ImageSpec(40, 48, 3, "float")
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), [spec, spec]) and output.write_image(PIXELS)
    assert output.open(str(path), spec, "AppendSubimage") and output.write_image(PIXELS) and output.close()


def deep(path):
    spec = oiio.ImageSpec(2, 2, 1, "float")
    spec.channelnames, spec.deep = ("Z",), True
    data = oiio.DeepData()
    data.init(4, 1, ["float"], ["Z"])
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec) and output.write_deep_image(data) and output.close()


def window(path, x, y):
    """Write an EXR whose header has another data window."""
    data = bytearray(save(path, PIXELS).read_bytes())
    start = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    data[start : start + 16] = struct.pack("<4i", 0, 0, x, y)
    path.write_bytes(data)


def rip_map(path):
    """Write an EXR of 2 × 2 pixels with its four levels, without compression."""
    box, zeros = struct.pack("<4i", 0, 0, 1, 1), bytes(8)
    attributes = {
        "channels chlist": b"Y\0" + struct.pack("<4i", 2, 0, 1, 1) + b"\0",
        "compression compression": b"\0",
        "dataWindow box2i": box,
        "displayWindow box2i": box,
        "lineOrder lineOrder": b"\0",
        "pixelAspectRatio float": struct.pack("<f", 1),
        "screenWindowCenter v2f": zeros,
        "screenWindowWidth float": struct.pack("<f", 1),
        "tiles tiledesc": struct.pack("<IIB", 16, 16, 2),
    }
    data = struct.pack("<4sI", b"\x76\x2f\x31\x01", 2 | 0x200)
    for name, value in attributes.items():
        data += name.replace(" ", "\0").encode() + b"\0" + struct.pack("<I", len(value)) + value
    data += b"\0"
    tiles = [struct.pack("<4iI", 0, 0, x, y, size := 16 >> (x + y)) + bytes(size) for y in (0, 1) for x in (0, 1)]
    starts = [len(data) + 32 + sum(map(len, tiles[:i])) for i in range(4)]
    path.write_bytes(data + struct.pack("<4Q", *starts) + b"".join(tiles))


POINTER = f"version https://git-lfs.github.com/spec/v1\noid sha256:{64 * '4'}\nsize 12345\n"
BAD = {
    "empty.exr": lambda path: path.write_bytes(b""),
    "empty.png": lambda path: path.write_bytes(b""),
    "text.exr": lambda path: path.write_text("<scene/>"),
    "text.png": lambda path: path.write_text("<scene/>"),
    "pointer.tif": lambda path: path.write_text(POINTER),
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
    "one row.tif": lambda path: save(path, np.ones((1, 4, 3)), "double"),  # OpenImageIO reads uninitialised memory
    "24 bits.tif": lambda path: tiff(path, np.zeros((1, 6, 1), np.uint8), {256: (4, [2]), 258: (3, [24])}),
    "cmyk.psd": lambda path: path.write_bytes(struct.pack(">4sH6xHIIHH14x", b"8BPS", 1, 4, 1, 1, 8, 4) + bytes(4)),
    "a\udcff.exr": lambda path: save(path.with_name("a.exr"), PIXELS).rename(path),
}
BAD |= {
    f"truncated {keep}.{ending}": lambda path, keep=keep, kind=kind: cut(save(path, PIXELS, kind), keep)
    for ending, kind in (("exr", "float"), ("png", "uint8"), ("hdr", "float"), ("tif", "float"))
    for keep in (0, 6, 0.3, 0.7, 0.97)
}
BAD |= {f"truncated {keep}.exr": lambda path, keep=keep: cut(save(path, PIXELS), keep) for keep in (4, 60, -40, -1)}


@pytest.mark.parametrize("name", BAD)
def test_errors_of_bad_files_are_one_line_with_the_path(tmp_path, name):
    path = tmp_path / name
    BAD[name](path)
    before = oiio.get_int_attribute("limits:imagesize_MB")
    for reader in (read, read_exr) if path.suffix == ".exr" and name != "pipe.exr" else (read,):
        with pytest.raises(ValueError) as error:
            reader(path)
        text = str(error.value)
        assert text.startswith(f"{path}: ") and text.count(str(tmp_path)) == 1 and "\n" not in text
        assert not name.startswith("truncated") or "corrupt" in text or "not an EXR file" in text
        assert ("run `git lfs pull` to fetch it" in text) is (name == "pointer.tif")
    assert oiio.get_int_attribute("limits:imagesize_MB") == before


def test_a_rip_map_is_refused(tmp_path):
    rip_map(tmp_path / "a.exr")
    with pytest.raises(ValueError, match=r"a\.exr: a RIP map, of which OpenImageIO reads some levels only; expected"):
        image_file.read_parts(tmp_path / "a.exr")


@pytest.mark.parametrize("name", ["a.exr", "a.png", "a.tif", "a.gif", "a.jp2", "a.jxl", "jp2 as.png", "gif as.exr"])
def test_the_size_is_checked_in_the_header(tmp_path, name):
    """In a truncated file, so that reading pixels would be another error."""
    side = 592  # more than 1 MiB, the unit of OpenImageIO's limit
    path = tmp_path / f"a.{name[:3]}" if " " in name else tmp_path / name
    save(path, np.zeros((side, side, 3), np.uint8), "uint8")
    path = path.rename(tmp_path / name)
    cut(path, -1 if name == "a.tif" else 0.9)
    with pytest.raises(ValueError, match=r"\(max-values\)$|not a|Not a") as error:
        read(path, side * side)
    assert ("max-values" in str(error.value)) is (" " not in name)
    with pytest.raises(ValueError, match=r"corrupt|holds an image of format"):
        read(path)


def test_images_with_exactly_the_allowed_number_of_values_are_read(tmp_path):
    """Also with the widest numbers, because OpenImageIO's limit is in bytes."""
    pixels = np.zeros((300, 300, 3))
    path = save(tmp_path / "a.tif", pixels, "double")
    assert read(path, pixels.size).pixels.shape == pixels.shape
    with pytest.raises(ValueError, match=r"a\.tif: 300 × 300 × 3 values; expected up to 269999 values"):
        read(path, pixels.size - 1)


def test_reading_pages_takes_linear_time(tmp_path):
    """Measured by the number of Python's opcodes."""
    spec, steps = oiio.ImageSpec(1, 1, 1, "uint8"), 0

    def count(frame, event, _):
        nonlocal steps
        if frame.f_code.co_filename != image_file.__file__:
            return None
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        steps += event == "opcode"
        return count

    counts = []
    for pages in (100, 100, 200):  # some versions of Python do not count all opcodes of the first run
        output = oiio.ImageOutput.create("a.tif")
        for number in range(pages):
            assert output.open(str(tmp_path / "a.tif"), spec, "AppendSubimage" if number else "Create")
            assert output.write_image(np.zeros((1, 1, 1), np.uint8))
        output.close()
        before, steps = sys.gettrace(), 0
        sys.settrace(count)
        images = image_file.read_parts(tmp_path / "a.tif")
        sys.settrace(before)
        assert len(images) == pages
        counts.append(steps)
    assert counts[1] < counts[2] < 2.1 * counts[1]


def test_missing_files_and_folders_are_os_errors(tmp_path):
    for reader in (read, read_exr):
        with pytest.raises(FileNotFoundError, match=r"none\.exr"):
            reader(tmp_path / "none.exr")
        with pytest.raises(OSError, match=str(tmp_path)):
            reader(tmp_path)


@pytest.mark.parametrize(("icc", "name"), [(SRGB_PROFILE, "ICCProfile"), (b"no profile", image_file.PNG_PROFILE)])
def test_a_profile_is_read_once_also_if_openimageio_drops_it(tmp_path, icc, name):
    PillowImage.new("RGB", (2, 2)).save(tmp_path / "a.png", icc_profile=icc)
    metadata = read(tmp_path / "a.png").metadata
    assert [key for key in metadata if key in ("ICCProfile", image_file.PNG_PROFILE)] == [name]


# Pixels ---------------------------------------------------------------------------------------------------------------


def test_the_srgb_curve():
    linear = np.array([0.0, 0.001, 0.0031308, 0.214, 0.5, 1.0])
    assert srgb_encode(linear) == pytest.approx([0.0, 0.01292, 0.04045, 0.5, 0.735357, 1.0], abs=1e-4)
    assert srgb_decode(srgb_encode(linear)) == pytest.approx(linear, rel=1e-6)


def test_blocks_at_the_edges_may_be_smaller():
    pixels = np.random.default_rng(3).random((2, 7, 5, 3))
    sums, means = block_sum(pixels, 4), block_mean(pixels[0], 4)
    assert sums.shape == (2, 2, 2, 3)
    assert sums[1, 1, 0] == pytest.approx(pixels[1, 4:, :4].sum((0, 1)))
    assert means[1, 1] == pytest.approx(pixels[0, 4:, 4:].mean((0, 1)))
    assert block_area(7, 5, 4)[..., 0].tolist() == [[16, 4], [12, 3]]
    assert block_mean(pixels[0].astype(np.float32), 4).dtype == np.float32


@pytest.mark.parametrize("channels", [0, 1, 2, 3, 4, 8, 9, 40])
@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_any_channel_agrees_with_numpy(channels, share):
    flags = np.random.default_rng(channels).random((6, 7, channels)) < share
    assert np.array_equal(any_channel(flags), flags.any(-1))
    assert any_channel(flags[0]).shape == (7,)

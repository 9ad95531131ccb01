"""Comparison of metadata: the documented table, cell by cell, with two files of the same codes."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image as Pillow
from PIL import ImageCms
from PIL.TiffImagePlugin import IFDRational
from support.diff_images import SINGLE, exr_of_integers, save
from support.diff_images import tiff as write_tiff
from support.readme import DOCS

from mi_refract.image_diff import comparison, folders, metadata
from mi_refract.image_diff.settings import Settings
from mi_refract.io import image_file

PAGE = (DOCS / "reference/image-metadata.md").read_text("utf-8")
CODES = np.random.default_rng(1).integers(0, 256, (8, 8, 3), np.uint8)
GRAY, FOUR = CODES[..., :1], np.dstack([CODES, CODES[..., :1]])
IDS = np.full((8, 8, 1), 2**24, np.uint32)
ICC = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
OTHER_ICC = ICC[:64] + b"\0\0\0\1" + ICC[68:]  # another rendering intent
WHITE, D65 = (0.3, 0.3), (0.3127, 0.329)
ENDINGS = {"JPEG": "jpg", "TIFF": "tif"}


# Writing files with the same codes and different metadata -------------------------------------------------------------


def exr(path, *parts):
    specs = []
    for attributes in parts:
        spec = oiio.ImageSpec(8, 8, 3, "float")
        for name, value in attributes.items():
            if hasattr(spec, name):
                setattr(spec, name, value)
            elif name != "add":
                spec.attribute(name, *([f"float[{len(value)}]"] if isinstance(value, tuple) else []), value)
        specs.append(spec)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), tuple(specs)), output.geterror()
    for number, spec in enumerate(specs):
        assert not number or output.open(str(path), spec, "AppendSubimage")
        assert output.write_image(CODES.astype(np.float32) + np.float32(parts[number].get("add", 0)))
    assert output.close()


def png(path, *chunks):
    Pillow.fromarray(CODES).save(path)
    data = path.read_bytes()
    added = [struct.pack(">I", len(x)) + kind + x + struct.pack(">I", zlib.crc32(kind + x)) for kind, x in chunks]
    path.write_bytes(data[:33] + b"".join(added) + data[33:])


def tiff(path, tags, pixels=CODES):
    write_tiff(path, pixels, tags)


def bmp(path, mode):
    Pillow.fromarray(GRAY[..., 0]).convert("1").convert(mode).save(path)


def jpeg(path, **options):
    Pillow.fromarray(CODES).convert(options.pop("mode", "RGB")).save(path, options.pop("format", "JPEG"), **options)


def hdr(path, *lines):
    size = [line for line in lines if "Y" in line[:2]] or ["-Y 8 +X 8"]
    lines = ["#?RADIANCE", *(line for line in lines if line not in size), "FORMAT=32-bit_rle_rgbe", "", *size, ""]
    path.write_bytes("\n".join(lines).encode() + bytes(range(64)) * 4)


def frames(path, add):
    first, second = (Pillow.fromarray(CODES + np.uint8(x)) for x in (0, add))
    first.save(path, save_all=True, append_images=[second])


def integers(path, pixels):
    exr_of_integers(path, pixels, ["id"])


def per_100000(*values):
    return b"".join(struct.pack(">I", round(1e5 * value)) for value in values)


def exif(tag, value, inner=False):
    tags = Pillow.Exif()
    (tags.get_ifd(0x8769) if inner else tags)[tag] = value
    return tags.tobytes()


# By row and column of the table: a function, and its arguments for each of the two files.
CASES = {
    ("transfer curve", "EXR"): (exr, [{}], [{"oiio:ColorSpace": "srgb_rec709_scene"}]),
    ("transfer curve", "PNG"): (png, [(b"sRGB", b"\0")], [(b"gAMA", per_100000(1))]),
    ("transfer curve", "TIFF"): (tiff, [{}], [{301: (3, [1] * 256)}]),
    ("transfer curve", "JPEG"): (jpeg, {"exif": exif(0xA001, 1, True)}, {"exif": exif(0xA001, 65535, True)}),
    ("transfer curve", "HDR"): (hdr, [], ["GAMMA=2.2"]),
    ("primaries", "EXR"): (exr, [{}], [{"chromaticities": (0.7, 0.3, 0.2, 0.7, 0.1, 0.05, *WHITE)}]),
    ("primaries", "PNG"): (png, [], [(b"cHRM", per_100000(*WHITE, 0.7, 0.3, 0.2, 0.7, 0.1, 0.05))]),
    ("primaries", "TIFF"): (tiff, [{}], [{318: (12, WHITE)}]),
    ("primaries", "HDR"): (hdr, [], ["PRIMARIES=.7 .3 .1 .8 .1 .1 .3 .3"]),
    ("ICC profile", "PNG"): (png, *([(b"iCCP", b"a\0\0" + zlib.compress(icc))] for icc in (ICC, OTHER_ICC))),
    ("ICC profile", "TIFF"): (tiff, *([{34675: (7, icc)}] for icc in (ICC, OTHER_ICC))),
    ("ICC profile", "JPEG"): (jpeg, *({"icc_profile": icc} for icc in (ICC, OTHER_ICC))),
    ("exposure, luminance of white", "EXR"): (exr, [{"whiteLuminance": 80.0}], [{"whiteLuminance": 100.0}]),
    ("exposure, luminance of white", "PNG"): (png, [], [(b"cLLI", bytes(8))]),
    ("exposure, luminance of white", "TIFF"): (tiff, [{}], [{341: (3, [99] * 3)}]),
    ("exposure, luminance of white", "HDR"): (hdr, ["EXPOSURE=2"], ["EXPOSURE=2", "EXPOSURE=3"]),
    ("colour correction", "HDR"): (hdr, [], ["COLORCORR=1 2 1"]),
    ("pixel aspect ratio", "EXR"): (exr, [{}], [{"PixelAspectRatio": 2.0}]),
    ("pixel aspect ratio", "PNG"): (png, [], [(b"pHYs", struct.pack(">IIB", 100, 200, 0))]),
    ("pixel aspect ratio", "TIFF"): (tiff, [{}], [{282: (12, [1]), 283: (12, [2])}]),
    ("pixel aspect ratio", "JPEG"): (jpeg, {}, {"dpi": (100, 200)}),
    ("pixel aspect ratio", "HDR"): (hdr, [], ["PIXASPECT=2"]),
    ("orientation", "PNG"): (png, [], [(b"eXIf", exif(0x112, 3).removeprefix(b"Exif\0\0"))]),
    ("orientation", "TIFF"): (tiff, [{}], [{274: (3, [3])}]),
    ("orientation", "JPEG"): (jpeg, {}, {"exif": exif(0x112, 3)}),
    ("orientation", "HDR"): (hdr, [], ["+Y 8 +X 8"]),
    ("data window", "EXR"): (exr, [{}], [{"x": 1}]),
    ("data window", "PNG"): (png, [], [(b"oFFs", struct.pack(">iiB", 1, 0, 0))]),
    ("data window", "TIFF"): (tiff, [{}], [{282: (12, [1]), 283: (12, [1]), 286: (12, [1]), 287: (12, [0])}]),
    ("display window", "EXR"): (exr, [{}], [{"full_width": 9}]),
    ("display window", "TIFF"): (tiff, [{}], [{33300: (4, [9]), 33301: (4, [8])}]),
    ("alpha is associated or not", "TIFF"): (tiff, *([{338: (3, [kind])}, FOUR] for kind in (1, 2))),
    ("white is 0, up to 8 bits", "TIFF"): (tiff, *([{262: (3, [kind])}, GRAY] for kind in (0, 1))),
    ("white is 0, more bits", "TIFF"): (tiff, *([{262: (3, [kind])}, np.uint16(GRAY)] for kind in (0, 1))),
    ("CMYK", "TIFF"): (tiff, *([{262: (3, [5])}, FOUR],) * 2),
    ("CMYK", "JPEG"): (jpeg, *({"mode": "CMYK"},) * 2),
    ("CIE L\\*a\\*b\\*", "TIFF"): (tiff, *([{262: (3, [8])}],) * 2),
    ("integers of 32 bits", "EXR"): (integers, [IDS], [IDS + 1]),
    ("integers of 32 bits", "TIFF"): (tiff, [{}, IDS], [{}, IDS + 1]),
    ("name of a part", "EXR"): (exr, *([{"oiio:subimagename": name} for name in names] for names in ("ab", "ba"))),
    ("name of a part", "TIFF"): (tiff, *([{285: (2, name)}] for name in (b"a\0", b"b\0"))),
    ("view, left or right", "EXR"): (exr, *([{"oiio:subimagename": x, "view": x} for x in y] for y in ("ab", "ba"))),
    ("environment map", "EXR"): (exr, [{}], [{"envmap": "latlong", "textureformat": "LatLong Environment"}]),
    ("second image", "EXR"): (exr, *([{"oiio:subimagename": y, "add": x * (y == "b")} for y in "ab"] for x in (0, 1))),
    ("second image", "PNG"): (frames, [0], [1]),
    ("second image", "TIFF"): (frames, [0], [1]),
    ("second image", "JPEG"): (jpeg, *(
        {"format": "MPO", "save_all": True, "append_images": [Pillow.fromarray(CODES + np.uint8(x))]} for x in (0, 1)
    )),
    ("second image", "GIF"): (frames, [0], [1]),
    ("what is not known here", "EXR"): (exr, [{"a:b": 1}], [{"a:b": 2}]),
    ("what is not known here", "PNG"): (png, [], [(b"prVt", b"a")]),
    ("what is not known here", "TIFF"): (tiff, [{}], [{65000: (4, [1])}]),
    ("what is not known here", "HDR"): (hdr, [], ["PURPOSE=a"]),
    ("software, time, compression", "EXR"): (exr, [{"Software": "a", "compression": "none"}], [{"Software": "b"}]),
    ("software, time, compression", "PNG"): (png, [], [(b"tEXt", b"Software\0a"), (b"tIME", b"\7\xea" + 5 * b"\1")]),
    ("software, time, compression", "TIFF"): (tiff, [{}], [{305: (2, b"a\0"), 306: (2, b"2026:01:01 00:00:00\0")}]),
    ("software, time, compression", "JPEG"): (jpeg, {}, {"exif": exif(305, "a")}),
    ("software, time, compression", "HDR"): (hdr, [], ["SOFTWARE=a", "CAPDATE=2026:01:01 00:00:00"]),
}  # fmt: skip


def table():
    """The word of each cell of the documented table."""
    text = PAGE.partition("<!-- begin: metadata -->\n")[2].partition("<!-- end: metadata -->")[0]
    (_, *names), _, *rows = (line.strip("| ").split(" | ") for line in text.splitlines())
    return {(row, name): word for row, *words in rows for name, word in zip(names, words, strict=True) if word != "–"}


def test_the_documented_table_is_tested_and_ignored_names_are_listed():
    assert table().keys() == CASES.keys()
    assert f"```\n{metadata.WITHOUT_MEANING.strip()}\n```" in PAGE


@pytest.mark.parametrize(("row", "name"), CASES, ids=map(" ".join, CASES))
def test_the_documented_table_is_right(tmp_path, row, name):
    write, *arguments = CASES[row, name]
    paths = [tmp_path / f"{side}.{ENDINGS.get(name, name.lower())}" for side in "ab"]
    for path, of_side in zip(paths, arguments, strict=True):
        write(path, **of_side) if isinstance(of_side, dict) else write(path, *of_side)
    word = table()[row, name]
    for method in ["exact"] if word == "in the numbers" else SINGLE:
        (result,) = folders.diff(*paths, Settings.for_all(method=method)).results
        expected = {"refused": "error", "ignored": "equal"}.get(word, "different")
        assert (result.status, "different metadata: " in result.reason) == (expected, word == "compared"), result.reason


@pytest.mark.parametrize("icc", [b"A" * 200, ICC[:-1], ICC[:16] + b"GRAY" + ICC[20:]])
def test_profiles_that_openimageio_drops_are_compared(tmp_path, icc):
    chunk = b"iCCP", b"a\0\0" + zlib.compress(icc)
    for name, chunks, status in (("b.png", [], "different"), ("c.png", [chunk], "equal")):
        png(tmp_path / "a.png", chunk)
        png(tmp_path / name, *chunks)
        assert folders.diff(tmp_path / "a.png", tmp_path / name).results[0].status == status


def test_ignored_metadata_are_not_compared_and_the_others_are_named(tmp_path):
    paths = [tmp_path / "a.exr", tmp_path / "b.exr"]
    for path, view in zip(paths, ("left", "right"), strict=True):
        exr(path, {"view": view, "a:c": view, "a:b": view, "chromaticities": (0.7, 0.3, 0.2, 0.7, 0.1, 0.05, *D65)})
    for ignored, reason in (
        ((), "different metadata: a:b (left → right), and a:c, view; every value is the same"),
        (("a:*",), "different metadata: view (left → right); every value is the same"),
        (("a:?", "view"), "every value is the same"),
    ):
        (result,) = folders.diff(*paths, Settings.for_all(method="exact", ignore_metadata=ignored)).results
        assert (result.status, result.reason) == ("equal" if "view" in ignored else "different", reason)


@pytest.mark.parametrize("ending", ["bmp", "gif", "jpg", "ppm", "sgi", "tga", "tif", "webp"])
def test_equal_images_of_different_formats_are_equal(tmp_path, ending):
    """The same codes as in a PNG file."""
    paths = [tmp_path / "a.png", tmp_path / f"b.{ending}"]
    for path in paths:
        save(path, np.full((8, 8, 3), 255, np.uint8), "uint8")
    (result,) = folders.diff(*paths, Settings.for_all(method="exact")).results
    assert result.status == "equal", result.reason


SRGB = (*D65, 0.64, 0.33, 0.3, 0.6, 0.15, 0.06)
SAME = {  # metadata equivalent to none, or two equivalent ones
    "ImageMagick.png": (png, [(b"gAMA", per_100000(1 / 2.2)), (b"cHRM", per_100000(*SRGB))]),
    "CICP.png": (png, [(b"cICP", bytes([1, 13, 0, 1]))]),
    "texts.png": (png, [(b"tEXt", b"generated_by\0Mitsuba"), (b"zTXt", b"date:create\0\0" + zlib.compress(b"now"))]),
    "camera.jpg": (jpeg, {}, {"exif": exif(33434, IFDRational(1, 100), True)}),
    "Blender.exr": (exr, [{"Frame": "001", "Camera": "Camera", "BlenderMultiChannel": "Blender V2.55.1 and newer"}]),
    "pbrt.exr": (exr, *([{"renderTimeSeconds": time, "samplesPerPixel": 16}] for time in (1.5, 1.6))),
    "OpenImageIO.exr": (exr, [{"oiio:ColorSpace": "lin_rec709_scene", "chromaticities": (*SRGB[2:], *D65)}]),
    "palettes.bmp": (bmp, ["1"], ["L"]),
    "Photoshop.hdr": (hdr, ["# a=b", "GAMMA=1", "PRIMARIES=0 0 0 0 0 0 0 0"]),
    "stb.hdr": (hdr, ["EXPOSURE=          1.0000000000000"]),
    "Radiance.hdr": (hdr, ["pcomb -e 'ro=ri(1)'", "\tEXPOSURE=2", "COLORCORR= 1 1 1", "NCOMP=3"]),
    "exposure.hdr": (hdr, ["EXPOSURE=2"], ["EXPOSURE=2.0"]),
    "pfilt.hdr": (
        hdr,
        ["EXPOSURE=4", "COLORCORR=1 2 1", "EXPOSURE=.5", "COLORCORR=3 .5 1"],
        ["EXPOSURE=2", "COLORCORR=3 1 1"],
    ),
    "turned.hdr": (hdr, ["PIXASPECT=2", "PIXASPECT=.5", "EXPOSURE=1", "EXPOSURE=1"]),
    "ImageMagick.tif": (
        tiff,
        [{318: (5, [3127, 10000, 329, 1000]), 319: (5, [16, 25, 33, 100, 3, 10, 3, 5, 3, 20, 3, 50])}],
    ),
}


@pytest.mark.parametrize("name", SAME)
def test_usual_metadata_of_programs_are_no_difference(tmp_path, name):
    write, *arguments = SAME[name]
    if len(arguments) == 1:
        arguments.insert(0, [{}] if write in (exr, tiff) else [])
    paths = [tmp_path / f"{side}{name}" for side in "ab"]
    for path, of_side in zip(paths, arguments, strict=True):
        write(path, **of_side) if isinstance(of_side, dict) else write(path, *of_side)
    (result,) = folders.diff(*paths, Settings.for_all(method="exact")).results
    assert result.status == "equal", result.reason


READ_AS = {"A": "a missing alpha is read as 1", "Y": "gray is read as R = G = B"}


@pytest.mark.parametrize("method", ["auto", *SINGLE])
@pytest.mark.parametrize(
    ("one", "two", "assumed"),
    [
        ("RGB", "RGBA", "A"),
        ("L", "LA", "A"),
        ("L", "RGB", "Y"),
        ("LA", "RGB", "AY"),
        ("L", "RGBA", "AY"),
        ("P", "L", "Y"),
    ],
)
def test_gray_alpha_and_palette_files_of_the_same_pixels_are_equal(tmp_path, method, one, two, assumed):
    gray = Pillow.fromarray(GRAY[..., 0])
    for path, mode in ((tmp_path / "a.png", one), (tmp_path / "b.png", two)):
        (gray if "L" in one + two else Pillow.fromarray(CODES)).convert(mode).save(path)
    for sides in (("a.png", "b.png"), ("b.png", "a.png")):
        (result,) = folders.diff(*(tmp_path / name for name in sides), Settings.for_all(method=method)).results
        assert result.status == "equal", result.reason
        assert result.reason.endswith("; ".join(["", *(READ_AS[name] for name in assumed)]))
    for channel in (0, -1):  # another colour; with an alpha a hole
        pixels = np.asarray(Pillow.open(tmp_path / "b.png")).copy().reshape(8, 8, -1)
        pixels[:6, :6, channel] ^= 128
        Pillow.fromarray(pixels.squeeze()).save(tmp_path / "c.png")
        (result,) = folders.diff(tmp_path / "a.png", tmp_path / "c.png", Settings.for_all(method=method)).results
        assert result.status in ("different", "error") and "read as" not in result.reason


def test_pixel_aspect_ratios_are_equal_within_rounding(tmp_path):
    """4/3 with three decimals, and as whole pixels per metre; 12/11 and 59/54 of video are different."""
    metre = tmp_path / "metre.png"
    png(metre, (b"pHYs", struct.pack(">IIB", 2835, 3780, 1)))
    images = {0: image_file.read(metre)}
    Pillow.fromarray(CODES).save(tmp_path / "metre.bmp", dpi=(72, 96))
    images["bmp"] = image_file.read(tmp_path / "metre.bmp")
    for ratio in (4 / 3, 1.333, 12 / 11, 59 / 54):
        exr(tmp_path / f"{ratio}.exr", {"PixelAspectRatio": ratio})
        images[ratio] = image_file.read(tmp_path / f"{ratio}.exr")
    for one, two in ((4 / 3, 1.333), (4 / 3, 0), (0, 1.333), (0, "bmp")):
        comparison.aligned(images[one], images[two])
    with pytest.raises(ValueError, match="pixel aspect ratio"):
        comparison.aligned(images[12 / 11], images[59 / 54])

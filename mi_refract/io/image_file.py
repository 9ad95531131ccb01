"""Images: reading all formats of OpenImageIO, writing OpenEXR, and arithmetic on pixels.

Pixels are arrays of H × W × C float32, row 0 at the top. A file is written completely or not at all.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import image_headers, safe_files
from .errors import ImageError

Pixels = NDArray[np.floating[Any]]
FEW_CHANNELS = 8
Metadata = dict[str, Any]
ImageInput: TypeAlias = Any  # an `OpenImageIO.ImageInput`
ImageSpec: TypeAlias = Any  # an `OpenImageIO.ImageSpec`
SUFFIXES = (".exr",)
PNG_PROFILE = "png:iCCP"
TEXT = image_headers.TEXT  # prefix of the names of metadata that are texts of a PNG file
MAX_VALUES = 2**28  # width × height × channels of an image: 1 GiB as float32
# Types that are not read as float32. OpenImageIO rounds integers to float32 when it converts them to any other type.
WIDE = {"double": "double", "uint": "uint", "int": "int"}
EXACT = 2**53  # float64 represents all integers up to it
CONVERTED = ("CMYK", "YCbCrK", "CIELAB", "ICCLAB", "ITULAB", "LOGL", "LOGLUV")  # colour spaces converted to R, G, B
MOST_HEADERS = 2**28  # bytes of a file beside 8 for each value
OPTION = " (max-values)"  # for errors: the option that changes the limit
# Magic numbers of formats that OpenImageIO decodes when it opens a file: GIF, JPEG 2000, JPEG XL.
WHEN_OPENED = (b"GIF", b"\0\0\0\x0cjP  ", b"\xff\x4f\xff\x51", b"\0\0\0\x0cJXL ", b"\xff\x0a")
LFS_POINTER = b"version https://git-lfs.github.com/spec/v1\n"  # start of a file that Git LFS has not fetched yet
NO_DATE = {"DateTime": "1970:01:01 00:00:00"}  # for reproducible bytes: OpenImageIO would write the present date


def write_exr(
    path: str | os.PathLike[str],
    pixels: NDArray[np.floating[Any]],
    channels: Sequence[str] = ("R", "G", "B"),
    metadata: Mapping[str, str | int | float] | None = None,
) -> None:
    """Write H × W × C pixels as an OpenEXR file of float32, with one header attribute for each entry of `metadata`.

    Attributes may be str, int or float; floats are stored in float32, ints beyond 32 bits as text. An existing file is
    replaced; after an error it is unchanged. ValueError for a shape that does not fit `channels`, a name that does not
    end in .exr, or an attribute of another type; OSError for a folder that cannot be written or a full disk.
    """
    import OpenImageIO as oiio

    path = safe_files.writable(path, SUFFIXES)
    pixels = np.ascontiguousarray(pixels, dtype=np.float32)
    if pixels.ndim != 3 or pixels.size == 0 or pixels.shape[2] != len(channels):
        raise ValueError(f"{path}: pixels of shape {pixels.shape}; expected H × W × {len(channels)} {tuple(channels)}")
    if len(set(channels)) != len(channels):
        raise ValueError(f"{path}: channels {tuple(channels)}; expected distinct names")
    rows, columns, count = pixels.shape
    spec = oiio.ImageSpec(columns, rows, count, "float")
    spec.channelnames = tuple(channels)
    for name, value in (metadata or {}).items():
        if not isinstance(value, str | int | float):
            raise ValueError(f"{path}: attribute {name} = {value!r}; expected str, int, float")
        spec.attribute(name, str(value) if isinstance(value, int) and not -(2**31) <= value < 2**31 else value)
    try:
        with safe_files.replacing(path, suffix=".exr") as temporary:  # OpenImageIO chooses the format by the suffix
            if (output := oiio.ImageOutput.create(str(temporary))) is None:
                raise OSError(one_line(oiio.geterror()))
            done = output.open(str(temporary), spec) and output.write_image(pixels)
            message = output.geterror()
            if not (output.close() and done):
                raise OSError(one_line(message or output.geterror()) or "OpenImageIO gives no reason")
            # On a full disk `close` still returns True if the image is small enough for a buffer.
            source = oiio.ImageInput.open(str(temporary))
            if source is None or source.read_scanlines(0, 0, rows - 1, rows, 0, 0, count, "float") is None:
                (source or oiio).geterror()  # otherwise OpenImageIO prints it at the end of the process
                raise OSError("the last row of pixels is missing; is the disk full?")
            source.close()
    except OSError as error:
        raise OSError(f"{path}: cannot be written: {error.strerror or error}") from None


@dataclass(frozen=True)
class Image:
    """An image of a file.

    - `pixels`: H × W × C, float32, or float64 if the file has numbers that float32 cannot represent. Integers of a file
      are mapped to 0 … 1, except those of an EXR file. `channels`: C names.
    - `origin`: (x, y) of the first pixel of the data window. `display`: x, y, width and height of the display window;
      None if it is the data window.
    - `metadata`: the header, by OpenImageIO's names, with the additions of `image_headers.hidden_metadata`. `stored`:
      the type of the file's numbers in OpenImageIO's notation (uint8, half, float …); "" without a file.
    - `mask`: H × W, True for pixels that are compared; the others are 0. None: all pixels.
    - `part`: the numbers of the part and of the MIP level, from 0 on as in OpenImageIO. `place`: the same in words; ""
      in a file of one image.
    - `variances`: H × W by channel, of one sample per pixel, from another file.
    """

    path: Path
    pixels: NDArray[np.floating[Any]]
    channels: tuple[str, ...]
    origin: tuple[int, int] = (0, 0)
    metadata: Metadata = field(default_factory=dict)
    display: tuple[int, int, int, int] | None = None
    stored: str = ""
    mask: NDArray[np.bool_] | None = None
    part: tuple[int, int] = (0, 0)
    place: str = ""
    variances: Mapping[str, NDArray[np.floating[Any]]] = field(default_factory=dict)

    def select(self, channels: Sequence[str]) -> NDArray[np.floating[Any]]:
        """Return the pixels of these channels, H × W × len(channels). ValueError for a channel that does not exist."""
        if missing := [name for name in channels if name not in self.channels]:
            raise ValueError(f"{self.path}: no channel {missing[0]!r}; expected {', '.join(self.channels)}")
        return self.pixels[..., [self.channels.index(name) for name in channels]]


def read(path: str | os.PathLike[str], max_values: int = MAX_VALUES, digests: dict[Path, str] | None = None) -> Image:
    """Read a file with one image, in any format that OpenImageIO reads; the format is given by the suffix.

    `digests`: see `read_parts`. Errors: those of `read_parts`, and ValueError for several parts or MIP levels.
    """
    image = read_parts(path, max_values, digests, first_only=True)[0]
    if image.place:
        raise ImageError(f"{path}: several parts or MIP levels in one file; expected one image")
    return image


def read_parts(
    path: str | os.PathLike[str],
    max_values: int = MAX_VALUES,
    digests: dict[Path, str] | None = None,
    *,
    first_only: bool = False,
) -> list[Image]:
    """Read all images of a file, by part and MIP level, in any format that OpenImageIO reads, given by the suffix.

    `max_values`: largest width × height × channels of all images together; checked in each header before memory is
    allocated. `digests`: receives the SHA-256 of the decoded bytes, which are read from a private copy, so that the
    file cannot change in between. `first_only`: read only the first image; its `place` is set as otherwise. OSError if
    the file cannot be read; ValueError if it is empty, truncated, too large, of another format than its suffix, deep,
    or without pixels. Messages are one line that begins with the path.
    """
    path = Path(path)
    if digests is not None:
        with safe_files.temporary_folder() as folder:
            copy = folder / path.name
            digests[path] = safe_files.copy(path, copy, 8 * max_values + MOST_HEADERS)
            try:
                return [replace(image, path=path) for image in read_parts(copy, max_values, first_only=first_only)]
            except ImageError as error:
                raise ImageError(str(error).replace(str(copy), str(path))) from None
    source, kind = _checked_source(path, max_values)
    images: list[Image] = []
    values = 0
    try:
        hidden_metadata = image_headers.hidden_metadata(path)
        for part in _parts(source):
            images.append(_image(path, source, kind, part, (max_values, values), hidden_metadata))
            values += images[-1].pixels.size
            if part[1] and images[-1].pixels.shape == images[-2].pixels.shape:
                raise ImageError(f"{path}: a RIP map, of which OpenImageIO reads some levels only; expected MIP levels")
            if first_only:
                break
        if not images:
            raise ImageError(f"{path}: corrupt {kind} file: {_without_path(path, source.geterror()) or 'no image'}")
        several = images[-1].part[0] > 0 or (first_only and source.seek_subimage(1, 0))
        with_levels = {image.part[0] for image in images if image.part[1]}
        if first_only and source.seek_subimage(0, 1):
            with_levels.add(0)
        for i, image in enumerate(images):
            words = [f"part {image.part[0]}"] * several
            words += [f"MIP level {image.part[1]}"] * (image.part[0] in with_levels)
            images[i] = replace(image, place=", ".join(words))
        return images
    except MemoryError:
        raise ImageError(f"{path}: more pixels than fit in memory") from None
    finally:
        source.close()


def count_values(path: str | os.PathLike[str], max_values: int = MAX_VALUES) -> int:
    """Return width × height × channels of all images in a file, from their headers. Errors: those of `read_parts`."""
    source, _ = _checked_source(Path(path), max_values)
    try:
        specs = (source.spec() for _ in _parts(source))
        return sum(int(spec.width * spec.height * spec.nchannels) for spec in specs)
    finally:
        source.close()


def _checked_source(path: Path, max_values: int) -> tuple[ImageInput, str]:
    """Return OpenImageIO's reader of a file, and its kind for error messages. Errors: those of `read_parts`."""
    kind = path.suffix[1:].upper() or "image"
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise ImageError(f"{path}: expected a name in UTF-8") from None
    if path.exists() and not (path.is_file() or path.is_dir()):  # reading a pipe might never end
        raise ImageError(f"{path}: expected a regular file")
    with path.open("rb") as file:  # raises the system's error for a missing or forbidden file
        start = file.read(len(LFS_POINTER))
    if not start:
        raise ImageError(f"{path}: corrupt {kind} file: it is empty")
    if start == LFS_POINTER:
        raise ImageError(f"{path}: a Git LFS pointer, not the image; run `git lfs pull` to fetch it")
    # Other formats have at most 8 bytes a value; their headers are checked after opening.
    return _opened(path, kind, max_values, max_values * (1 if start.startswith(WHEN_OPENED) else 8)), kind


def check_header(path: str | os.PathLike[str], max_values: int) -> None:
    """Raise ValueError, in one line, unless the header is that of an image of up to `max_values`; read no pixels.

    Call this before a reader that allocates memory for the size in the header.
    """
    path = Path(path)
    image_headers.check_attributes(path)
    source = _opened(path, path.suffix[1:].upper() or "image", max_values, max_values * 8, option="")
    try:
        _check_size(path, source.spec(), max_values, option="")
    finally:
        source.close()


_opening = threading.Lock()  # OpenImageIO's limit of the size is global


def _opened(path: Path, kind: str, max_values: int, max_bytes: int, option: str = OPTION) -> ImageInput:
    """Return OpenImageIO's reader of the file, if its pixels need up to `max_bytes`. Some formats are decoded here."""
    import OpenImageIO as oiio

    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # otherwise colours under a transparent alpha are read as black
    with _opening:
        before = oiio.get_int_attribute("limits:imagesize_MB")
        oiio.attribute("limits:imagesize_MB", min(-(-max_bytes >> 20), 2**31 - 1))
        try:
            source = oiio.ImageInput.open(str(path), config)
        finally:
            oiio.attribute("limits:imagesize_MB", before)
    if source is None:
        message = _without_path(path, oiio.geterror())
        if "MB limit" in message:
            raise ImageError(f"{path}: {message}; expected up to {max_values} values{option}")
        raise ImageError(f"{path}: corrupt {kind} file: {message}")
    return source


def named(name: str, pixels: ArrayLike) -> Image:
    """Return an image of an array, H × W × C or H × W, with a name instead of a file.

    Three or four channels are called R, G, B (, A), others channel0, channel1 … uint8 and uint16 are sRGB codes, which
    are mapped to 0 … 1 as those of a PNG file; other integers are not scaled. ValueError for another shape, for values
    that are not numbers, and for integers beyond ±EXACT.
    """
    pixels = np.asarray(pixels)
    if pixels.ndim not in (2, 3) or not pixels.size or pixels.dtype.kind not in "fiu":
        raise ValueError(f"{name}: {pixels.dtype} {pixels.shape}; expected numbers, height × width × channels")
    if pixels.dtype.kind in "iu" and (largest := max(int(pixels.max()), -int(pixels.min()))) > EXACT:
        raise ValueError(f"{name}: {pixels.dtype} up to ±{largest}; expected integers up to 2⁵³")
    dtype, metadata = pixels.dtype, Metadata()
    pixels = pixels.reshape(*pixels.shape[:2], -1).astype(np.result_type(dtype, np.float32))
    if dtype.kind == "u" and dtype.itemsize <= 2:
        pixels *= np.float32(1 / np.iinfo(dtype).max)  # rounded as by OpenImageIO
        metadata["oiio:ColorSpace"] = "srgb_rec709_scene"
    count = pixels.shape[2]
    channels = tuple("RGBA"[:count]) if 3 <= count <= 4 else tuple(f"channel{i}" for i in range(count))
    return Image(Path(name), pixels, channels, metadata=metadata)


def _parts(source: ImageInput) -> Iterator[tuple[int, int]]:
    """Yield the number of each part and MIP level, after moving `source` there. Some formats are decoded here."""
    part = 0
    while source.seek_subimage(part, 0):
        level = 0
        while source.seek_subimage(part, level):
            yield part, level
            level += 1
        part += 1


def _check_size(path: Path, spec: ImageSpec, max_values: int, previous: int = 0, option: str = OPTION) -> None:
    """Raise ValueError for more than `max_values`, together with the `previous` values of the file's other images."""
    if spec.width * spec.height * spec.nchannels > max_values - previous:
        others = f" beside {previous} of other parts and MIP levels" if previous else ""
        size = f"{spec.width} × {spec.height} × {spec.nchannels} values{others}"
        raise ImageError(f"{path}: {size}; expected up to {max_values} values{option}")


def _image(
    path: Path, source: ImageInput, kind: str, part: tuple[int, int], values: tuple[int, int], hidden: Metadata
) -> Image:
    """Return the image at which `source` is. `values`: the allowed and the previous number; `hidden`: more metadata."""
    import OpenImageIO as oiio

    spec, format_name = source.spec(), source.format_name()
    # Suffixes by format: "openexr:exr,sxr;png:png;…".
    suffixes = dict(pair.split(":") for pair in oiio.get_string_attribute("extension_list").split(";") if pair)
    # The format "null" is always black.
    if path.suffix[1:].lower() not in suffixes.get(format_name, format_name).split(",") or format_name == "null":
        text = f"{path}: holds an image of format {format_name}"
        raise ImageError(f"{text}; expected the format that its file name indicates")
    if spec.deep:
        raise ImageError(f"{path}: expected an image without deep samples")
    if min(spec.width, spec.height, spec.nchannels) < 1 or spec.depth > 1:
        raise ImageError(f"{path}: {spec.width} × {spec.height} × {spec.depth} pixels; expected a plane with pixels")
    _check_size(path, spec, *values)
    metadata = {attribute.name: attribute.value for attribute in spec.extra_attribs} | hidden
    if "ICCProfile" in metadata:
        metadata.pop(PNG_PROFILE, None)  # kept if OpenImageIO drops the profile because of errors in it
    if (across := metadata.get("XResolution")) and (down := metadata.get("YResolution")):  # all that it reports of BMP
        metadata.setdefault("PixelAspectRatio", down / across)
    types = [str(channel_type) for channel_type in (spec.channelformats or [spec.format] * spec.nchannels)]
    if reason := _misread_reason(format_name, set(types), metadata, spec.height):
        raise ImageError(f"{path}: {reason}")
    runs = []  # consecutive channels that are read in the same type
    for read_as, channel_run in itertools.groupby(range(spec.nchannels), lambda i: WIDE.get(types[i], "float")):
        numbers = list(channel_run)
        pixels = source.read_image(*part, numbers[0], numbers[-1] + 1, read_as)
        if message := _without_path(path, source.geterror()) or ("" if pixels is not None else "no pixels"):
            raise ImageError(f"{path}: corrupt {kind} file: {message}")
        pixels = np.asarray(pixels).reshape(spec.height, spec.width, -1)
        if pixels.dtype.kind in "iu":  # integers of EXR files are identifiers and counts
            pixels = pixels.astype(float) if format_name == "openexr" else pixels / np.iinfo(pixels.dtype).max
        runs.append(pixels)
    pixels = runs[0] if len(runs) == 1 else np.concatenate(runs, -1)
    display = (spec.full_x, spec.full_y, spec.full_width, spec.full_height)
    channels, origin = tuple(spec.channelnames), (spec.x, spec.y)
    return Image(path, pixels, channels, origin, metadata, display, str(spec.format), part=part)


def _misread_reason(format_name: str, types: set[str], metadata: Metadata, rows: int) -> str:
    """Return why OpenImageIO would return other numbers than those of the file; "" if it would not."""
    if types & {"uint64", "int64"}:
        return "integers of 64 bits; expected up to 32"
    if format_name == "tiff" and "double" in types and rows == 1:  # OpenImageIO 2.4 to 3.2 reads uninitialised memory
        return "one row of 64-bit numbers in a TIFF file; expected several rows, or 32 bits"
    if format_name == "tiff" and metadata.get("oiio:BitsPerSample") == 24:  # read with the bytes in the wrong order
        return "numbers of 24 bits in a TIFF file; expected 16 or 32"
    if metadata.get("tiff:PhotometricInterpretation") == 0 and not types <= {"uint8"}:
        return "0 is white in a TIFF file of more than 8 bits; expected 0 as black"  # up to 8 bits are inverted
    space = metadata.get("tiff:ColorSpace", metadata.get("jpeg:ColorSpace"))
    return f"colours in {space}, which OpenImageIO converts with loss; expected R, G, B" if space in CONVERTED else ""


def _without_path(path: Path, message: str) -> str:
    """Return OpenImageIO's message on one line, without the path that some of its readers add."""
    return one_line(message.replace(f"EXR Error ({path}): ", "").replace(str(path), path.name))


def read_exr(path: str | os.PathLike[str], max_values: int = MAX_VALUES) -> tuple[NDArray[np.float32], Metadata]:
    """Read an EXR file: (pixels, metadata). Pixels are H × W × C float32; metadata is the header and "channels".

    `metadata["channels"]`: the C names in OpenImageIO's order: R, G, B, A first, then by name. OSError if the file
    cannot be read, ValueError if it is not a complete EXR image of up to `max_values`.
    """
    path = Path(path)
    with path.open("rb") as file:
        if file.read(4) != b"\x76\x2f\x31\x01":
            raise ImageError(f"{path}: not an EXR file")
    image = read(path, max_values)
    return image.pixels.astype(np.float32, copy=False), image.metadata | {"channels": image.channels}


def one_line(text: str) -> str:
    """Return the text with every run of white space, including line breaks, as one space."""
    return " ".join(text.split())


def versions() -> dict[str, str]:
    """Return the versions of mi_refract, mitsuba and drjit; "unknown" of one that is not installed."""
    from mi_refract import __version__

    return {"mi_refract": __version__} | {name: installed_version(name) for name in ("mitsuba", "drjit")}


def provenance() -> dict[str, str]:
    """Return header attributes: `Software`, and `mi_refract:version:NAME` for each of `versions`."""
    software = versions()
    header = {f"mi_refract:version:{name}": version for name, version in software.items()}
    return {"Software": f"mi_refract {software['mi_refract']}"} | header


def installed_version(distribution: str) -> str:
    """Return the installed version of a distribution; "unknown" if it runs without being installed."""
    import importlib.metadata  # imported late because it takes long

    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version(distribution)
    return "unknown"


# Arithmetic on pixels -------------------------------------------------------------------------------------------------

# Linear sRGB to CIE XYZ, as Mitsuba converts it.
TO_XYZ = np.array([[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]])


def srgb_encode(linear: Pixels) -> Pixels:
    """Return the sRGB code, 0 to 1, of linear light of at least 0, elementwise (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def srgb_decode(code: Pixels) -> Pixels:
    """Return the linear light of sRGB codes; the inverse of `srgb_encode` (IEC 61966-2-1)."""
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def any_channel(flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return `flags.any(-1)`, for few channels ten times as fast: NumPy is slow for many short reductions."""
    if 0 < flags.shape[-1] <= FEW_CHANNELS:
        return np.asarray(functools.reduce(np.logical_or, np.moveaxis(flags, -1, 0)))
    return np.asarray(np.any(flags, -1))


def block_sum(pixels: Pixels, side: int) -> Pixels:
    """Return sums over side × side blocks of pixels, … × H × W × C: … × ⌈H/side⌉ × ⌈W/side⌉ × C.

    Blocks at the right and lower edge may be smaller.
    """
    rows, columns = np.arange(0, pixels.shape[-3], side), np.arange(0, pixels.shape[-2], side)
    return np.asarray(np.add.reduceat(np.add.reduceat(pixels, rows, -3), columns, -2))


def block_area(height: int, width: int, side: int) -> Pixels:
    """Return the number of pixels in each block of `block_sum`, with a last axis of length 1."""
    rows, columns = (np.diff(np.arange(0, size, side), append=size) for size in (height, width))
    return np.outer(rows, columns)[..., None].astype(np.float64)


def block_mean(pixels: Pixels, side: int) -> Pixels:
    """Return means over the blocks of `block_sum`, in the precision of `pixels`."""
    with np.errstate(invalid="ignore"):
        sums = block_sum(pixels, side)
    return sums / block_area(pixels.shape[-3], pixels.shape[-2], side).astype(pixels.dtype)

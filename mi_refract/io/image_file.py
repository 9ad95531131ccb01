"""Images in files, by OpenImageIO: reads every format that it knows, writes OpenEXR.

Pixels are arrays of H × W × C float32, row 0 at the top. A file is written completely or not at all.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import atomic

Metadata = dict[str, Any]
SUFFIXES = (".exr",)
MAX_VALUES = 2**28  # width × height × channels of an image: 1 GiB as float32
# How files begin that OpenImageIO decodes when it opens them: GIF, JPEG 2000, JPEG XL.
WHEN_OPENED = (b"GIF", b"\0\0\0\x0cjP  ", b"\xff\x4f\xff\x51", b"\0\0\0\x0cJXL ", b"\xff\x0a")
NO_DATE = {"DateTime": "1970:01:01 00:00:00"}  # for the same bytes every day: without it OpenImageIO writes today's


def write_exr(
    path: str | os.PathLike[str],
    pixels: NDArray[np.floating[Any]],
    channels: Sequence[str] = ("R", "G", "B"),
    metadata: Mapping[str, str | int | float] | None = None,
) -> None:
    """Write H × W × C pixels as an OpenEXR file of float32, with one header attribute for each entry of `metadata`.

    Attributes may be str, int or float; floats are stored in float32, ints beyond 32 bits as text. An existing file is
    replaced. ValueError for a shape that does not fit `channels`, a name that does not end in .exr, or an attribute of
    another type; OSError for a folder that cannot be written or a full disk. The old file stays then.
    """
    path = atomic.writable(path, SUFFIXES)
    pixels = np.ascontiguousarray(pixels, dtype=np.float32)
    if pixels.ndim != 3 or pixels.size == 0 or pixels.shape[2] != len(channels):
        raise ValueError(f"{path}: pixels of shape {pixels.shape}; accepted: H × W × {len(channels)} {tuple(channels)}")
    if len(set(channels)) != len(channels):
        raise ValueError(f"{path}: channels {tuple(channels)}: accepted: distinct names")
    attributes = _attributes(path, metadata or {})
    try:
        with atomic.replacing(path, suffix=".exr") as temporary:  # OpenImageIO tells the format by the name
            _write(temporary, pixels, channels, attributes)
    except OSError as error:
        raise OSError(f"{path}: cannot be written: {error.strerror or error}") from None


def _write(path: Path, pixels: NDArray[np.float32], channels: Sequence[str], attributes: Metadata) -> None:
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], "float")
    spec.channelnames = tuple(channels)
    for name, value in attributes.items():
        spec.attribute(name, value)
    output = oiio.ImageOutput.create(str(path))
    if output is None:
        raise OSError(one_line(oiio.geterror()))
    done = output.open(str(path), spec) and output.write_image(pixels)
    message = output.geterror()
    if not (output.close() and done):
        raise OSError(one_line(message or output.geterror()) or "OpenImageIO gives no reason")
    # On a full disk `close` is True all the same when the image was small enough for a buffer.
    try:
        complete = read_exr(path, pixels.size)[0].shape == pixels.shape
    except ValueError:
        complete = False
    if not complete:
        raise OSError("what was written cannot be read; is the disk full?")


def _attributes(path: Path, metadata: Mapping[str, str | int | float]) -> Metadata:
    for name, value in metadata.items():
        if not isinstance(value, (str, int, float)):
            raise ValueError(f"{path}: attribute {name} = {value!r}: accepted: str, int, float")
    return {n: str(v) if isinstance(v, int) and not -(2**31) <= v < 2**31 else v for n, v in metadata.items()}


@dataclass(frozen=True)
class Image:
    """An image as a file holds it.

    `pixels`: H × W × C, float32, or float64 where the file holds numbers that float32 cannot; integers of a file are
    mapped to 0 … 1. `channels`: C names. `origin`: (x, y) where the data window begins. `metadata`: the header.
    `display`: x, y, width and height of the display window; None where it is the data window. `mask`: H × W, the
    pixels that count; None where all do. The others are 0. `variances`: H × W by channel, of one sample per
    pixel, where another file holds them.
    """

    path: Path
    pixels: NDArray[np.floating[Any]]
    channels: tuple[str, ...]
    origin: tuple[int, int] = (0, 0)
    metadata: Metadata = field(default_factory=dict)
    display: tuple[int, int, int, int] | None = None
    mask: NDArray[np.bool_] | None = None
    variances: Mapping[str, NDArray[np.floating[Any]]] = field(default_factory=dict)

    def select(self, channels: Sequence[str]) -> NDArray[np.floating[Any]]:
        """The pixels of these channels, in this order: H × W × len(channels). ValueError for a name not there."""
        if missing := [name for name in channels if name not in self.channels]:
            raise ValueError(f"{self.path}: no channel {missing[0]!r}; accepted: {', '.join(self.channels)}")
        return self.pixels[..., [self.channels.index(name) for name in channels]]


def read(path: str | os.PathLike[str], max_values: int = MAX_VALUES) -> Image:
    """Read a file that holds one image, of any format that OpenImageIO reads; the name's ending tells which.

    `max_values`: width × height × channels, at most; asked of the header, before memory is allocated. OSError for a
    file that cannot be read; ValueError for one that is empty, truncated, too large, of another format than its name
    says, of several parts, deep, or without pixels. Both are one line that begins with the path.
    """
    path = Path(path)
    kind = path.suffix[1:].upper() or "image"
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise ValueError(f"{path}: accepted: a name in UTF-8") from None
    if path.exists() and not (path.is_file() or path.is_dir()):  # reading a pipe might never end
        raise ValueError(f"{path}: accepted: a regular file")
    with path.open("rb") as file:  # the operating system's own words for what is missing or forbidden
        begin = file.read(8)
    if not begin:
        raise ValueError(f"{path}: corrupt {kind} file: it is empty")
    # Others hold 8 bytes a value or fewer, and are asked below.
    source = _opened(path, kind, max_values, max_values * (1 if begin.startswith(WHEN_OPENED) else 8))
    try:
        return _image(path, source, kind, max_values)
    except MemoryError:
        raise ValueError(f"{path}: more pixels than there is memory for; accepted: a smaller image") from None
    finally:
        source.close()


_opening = threading.Lock()  # OpenImageIO has one limit for all that it opens


def _opened(path: Path, kind: str, max_values: int, max_bytes: int) -> Any:
    """OpenImageIO's reader of the file, if its pixels take up to `max_bytes`. Some formats are decoded here."""
    import OpenImageIO as oiio

    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # else colours under a transparent alpha are read as black
    with _opening:
        before = oiio.get_int_attribute("limits:imagesize_MB")
        oiio.attribute("limits:imagesize_MB", min(-(-max_bytes >> 20), 2**31 - 1))
        try:
            source = oiio.ImageInput.open(str(path), config)
        finally:
            oiio.attribute("limits:imagesize_MB", before)
    if source is None:
        message = _without(path, oiio.geterror())
        if "MB limit" in message:
            raise ValueError(f"{path}: {message}; accepted: up to {max_values} values (max-values)")
        raise ValueError(f"{path}: corrupt {kind} file: {message}")
    return source


def named(name: str, pixels: Any) -> Image:
    """An image made of an array, H × W × C or H × W, with a name instead of a file.

    Channels are called R, G, B (, A) where there are three or four, else channel0, channel1 … Integers are kept as
    they are. ValueError for another shape, or for values that are not numbers.
    """
    pixels = np.asarray(pixels)
    if pixels.ndim not in (2, 3) or not pixels.size or pixels.dtype.kind not in "fiu":
        raise ValueError(f"{name}: {pixels.dtype} {pixels.shape}; accepted: numbers, height × width × channels")
    pixels = pixels.reshape(*pixels.shape[:2], -1).astype(np.result_type(pixels.dtype, np.float32))
    count = pixels.shape[2]
    channels = tuple("RGBA"[:count]) if 3 <= count <= 4 else tuple(f"channel{i}" for i in range(count))
    return Image(Path(name), pixels, channels)


def read_all(paths: Iterable[str | os.PathLike[str]]) -> list[Image]:
    """Read several images, two at a time, as decompression takes most of the time. Raises what `read` raises."""
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(read, paths))


def _image(path: Path, source: Any, kind: str, max_values: int) -> Image:
    spec = source.spec()
    found = source.format_name()
    if path.suffix[1:].lower() not in _endings(found) or found == "null":  # which is black, whatever the file holds
        raise ValueError(f"{path}: holds an image of format {found}; accepted: the format that the name says")
    if spec.deep:
        raise ValueError(f"{path}: accepted: an image without deep samples")
    if min(spec.width, spec.height, spec.nchannels) < 1 or spec.depth > 1:
        raise ValueError(f"{path}: {spec.width} × {spec.height} × {spec.depth} pixels; accepted: a plane with pixels")
    if spec.width * spec.height * spec.nchannels > max_values:
        size = f"{spec.width} × {spec.height} × {spec.nchannels} values"
        raise ValueError(f"{path}: {size}; accepted: up to {max_values} values (max-values)")
    formats = {str(each) for each in (spec.channelformats or [spec.format])}
    if formats & {"uint64", "int64"}:
        raise ValueError(f"{path}: integers of 64 bits; accepted: up to 32")
    wide = formats & {"double", "uint32", "int32", "uint", "int"}
    pixels = source.read_image("double" if wide else "float")
    if message := _without(path, source.geterror()) or ("" if pixels is not None else "no pixels"):
        raise ValueError(f"{path}: corrupt {kind} file: {message}")
    pixels = np.asarray(pixels).reshape(spec.height, spec.width, spec.nchannels)
    if source.seek_subimage(1, 0):
        raise ValueError(f"{path}: several parts in one file; accepted: one image")
    metadata = {attribute.name: attribute.value for attribute in spec.extra_attribs}
    display = (spec.full_x, spec.full_y, spec.full_width, spec.full_height)
    return Image(path, pixels, tuple(spec.channelnames), (spec.x, spec.y), metadata, display)


def _without(path: Path, message: str) -> str:
    """OpenImageIO's words on one line, without the path that some of its readers put into them."""
    return one_line(message.replace(f"EXR Error ({path}): ", "").replace(str(path), path.name))


def _endings(name: str) -> list[str]:
    """The file name endings of a format, in OpenImageIO's own list: "openexr:exr,sxr;png:png;…"."""
    import OpenImageIO as oiio

    formats = dict(each.split(":") for each in oiio.get_string_attribute("extension_list").split(";") if each)
    return formats.get(name, name).split(",")


def read_exr(path: str | os.PathLike[str], max_values: int = MAX_VALUES) -> tuple[NDArray[np.float32], Metadata]:
    """Read an EXR file: (pixels, metadata). Pixels are H × W × C float32; metadata is the header and "channels".

    `metadata["channels"]` holds the C names in OpenImageIO's order: R, G, B, A first, then by name.
    OSError for a file that cannot be read, ValueError for one that is not a complete EXR image of up to `max_values`.
    """
    path = Path(path)
    with path.open("rb") as file:
        if file.read(4) != b"\x76\x2f\x31\x01":
            raise ValueError(f"{path}: not an EXR file")
    image = read(path, max_values)
    return image.pixels.astype(np.float32, copy=False), image.metadata | {"channels": image.channels}


def one_line(text: str) -> str:
    """`text` with every run of white space, line breaks among them, as one space."""
    return " ".join(text.split())

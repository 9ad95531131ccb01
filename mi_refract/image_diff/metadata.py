"""Comparison of metadata: if they differ, the same pixel values can have different meanings.

All metadata are compared except those that are known not to change the meaning. The documentation lists them by format,
see "Metadata that are compared".
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from mi_refract.io.image_file import TEXT, Image

from .name_patterns import matches

SPACE, ALPHA = "oiio:ColorSpace", "oiio:UnassociatedAlpha"
CODED = ("uint8", "uint16")  # types that are sRGB codes if no colour space is named; others are linear
SPACES = {"srgb": "srgb_rec709_scene", "linear": "lin_rec709_scene"}
SPACES["rec709"] = ""  # OpenImageIO reports it for every PNM
SPACES["g22_rec709_scene"] = "srgb_rec709_scene"  # a gAMA of 45455, which PNG writers use for sRGB
REC709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06)
# Values with the same meaning as no metadata.
DEFAULTS = {
    "screenWindowCenter": ["(0.0, 0.0)"],
    "screenWindowWidth": ["1.0"],
    "Exif:ColorSpace": ["1"],
    "CICP": ["(1, 13, 0, 1)"],
    "oiio:Gamma": [str(float(np.float32(2.2)))],
    "chromaticities": [str(tuple(float(np.float32(x)) for x in (*REC709, 0.3127, 0.329)))],
    "hdr:EXPOSURE": ["1.0"],
    "hdr:GAMMA": ["1.0"],
    "hdr:COLORCORR": ["1.0 1.0 1.0"],
    "hdr:NCOMP": ["3.0"],
    # The primaries of Radiance, and those that Photoshop writes.
    "hdr:PRIMARIES": ["0.64 0.33 0.29 0.6 0.15 0.06 0.333 0.333", "0.0 0.0 0.0 0.0 0.0 0.0 0.0 0.0"],
    "tiff:318": ["0.3127 0.329"],
    "tiff:319": [" ".join(map(str, REC709))],
}
SHOWN = 60  # characters of a value in a message

# Patterns of names, which the documentation lists: author, date and render time, encoding of the numbers, duplicates
# by OpenImageIO, and properties that every method requires to be equal.
WITHOUT_MEANING = """
Artist Copyright Date DateTime DocumentName Exif:* File GPS:* HostComputer Hostname IPTC:* ImageDescription Make Memory
Model RenderTime Software Time cycles.* dc:* generatedBy hdr:CAPDATE hdr:GMT hdr:SOFTWARE mi_refract:* photoshop:*
thumbnail_* tiff:XMLPacket xmp:* xmpMM:*
BlenderMultiChannel Camera ExposureTime FNumber Frame FrameRange Lens Marker Note Scene Strip aux:* crs:* png:text:*
MSE estimatedVariance husk:* renderTimeSeconds samplesPerPixel vrayInfo/*
CompressionQuality FramesPerSecond bmp:bitsperpixel bmp:version compression gif:* jpeg:subsampling oiio:BitsPerSample
oiio:RowsPerChunk openexr:chunkCount openexr:dwaCompressionLevel openexr:levelmode openexr:lineOrder
openexr:roundingmode planarconfig png:iDOT pnm:bigendian pnm:binary targa:version tiff:BitsPerSample tiff:Compression
tiff:PlanarConfiguration tiff:Predictor tiff:RowsPerStrip tiff:zipquality
ICCProfile:* hdr:exposure name oiio:AverageColor oiio:ConstantColor oiio:LoopCount oiio:Movie oiio:SHA-1
oiio:subimages tiff:ColorSpace colorInteropID tiff:PageNumber tiff:PhotometricInterpretation tiff:UnassociatedAlpha
tiff:subfiletype Orientation PixelAspectRatio ResolutionUnit XResolution YResolution
"""
COMPARED = ("Exif:ColorSpace", "Exif:Gamma")  # exceptions from these patterns


def difference(images: Sequence[Image], ignored: Sequence[str] = ()) -> str:
    """Return the first difference between the metadata of the first image and another one, in one line; "" if none.

    `ignored`: patterns of names that are not compared. Images that were not read from a file are skipped.
    """
    metadata = [_compared_metadata(image, tuple(ignored)) for image in images if image.stored]
    for other in metadata[1:]:
        first = metadata[0]
        names = [name for name in sorted(first.keys() | other.keys()) if first.get(name) != other.get(name)]
        if ALPHA in names and None in (first.get(ALPHA), other.get(ALPHA)):  # one image has no alpha channel
            names.remove(ALPHA)
        if names:
            old, new = (values.get(names[0], "absent") for values in (first, other))
            more = f", and {', '.join(names[1:])}" if len(names) > 1 else ""
            return f"different metadata: {names[0]} ({old:.{SHOWN}} → {new:.{SHOWN}}){more}"
    return ""


def _compared_metadata(image: Image, ignored: tuple[str, ...]) -> dict[str, str]:
    """Return the metadata to compare, as text by name, without ignored ones and DEFAULTS."""
    space = str(image.metadata.get(SPACE, "")).lower()
    space = SPACES.get(space, space) or ("srgb_rec709_scene" if image.stored in CODED else "lin_rec709_scene")
    texts = {name.removeprefix(TEXT) for name in image.metadata if name.startswith(TEXT)}
    values = {name: _text(value) for name, value in image.metadata.items() if name not in texts} | {SPACE: space}
    if any(name.rpartition(".")[2] == "A" for name in image.channels):
        values.setdefault(ALPHA, "0")
    else:
        values.pop(ALPHA, None)
    return {n: x for n, x in values.items() if x not in DEFAULTS.get(n, ()) and not _is_ignored(n, ignored)}


def _text(value: Any) -> str:
    value = value.tobytes() if isinstance(value, np.ndarray) else value
    if not isinstance(value, bytes):
        return str(value)
    if value.isascii() and (text := value.decode("ascii")).isprintable():
        return text
    return f"{len(value)} bytes of SHA-256 {hashlib.sha256(value).hexdigest()}"


@functools.cache
def _is_ignored(name: str, patterns: tuple[str, ...]) -> bool:
    without_meaning = name not in COMPARED and any(matches(pattern, name) for pattern in WITHOUT_MEANING.split())
    return without_meaning or any(matches(pattern, name) for pattern in patterns)

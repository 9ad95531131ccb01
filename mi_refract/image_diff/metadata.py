"""What files say besides their numbers: where two say otherwise, the same numbers do not mean the same.

What is compared, in which format: "Metadata that are compared" in the documentation. What is not known to have no
meaning is compared.
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
CODED = ("uint8", "uint16")  # types of numbers that are sRGB codes where no colour space is named; others are linear
SPACES = {"srgb": "srgb_rec709_scene", "linear": "lin_rec709_scene", "rec709": ""}  # OpenImageIO says that of any PNM
SPACES["g22_rec709_scene"] = "srgb_rec709_scene"  # a gAMA of 45455, by which PNG writers mean sRGB
REC709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06)
# What says the same as nothing.
USUAL = {
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
    # Radiance's own, and what Photoshop writes.
    "hdr:PRIMARIES": ["0.64 0.33 0.29 0.6 0.15 0.06 0.333 0.333", "0.0 0.0 0.0 0.0 0.0 0.0 0.0 0.0"],
    "tiff:318": ["0.3127 0.329"],
    "tiff:319": [" ".join(map(str, REC709))],
}
SHOWN = 60  # characters of a value

# Patterns of names, which that page lists: by whom, when and how fast a file was made, how its numbers are packed,
# what OpenImageIO says twice, and what every method requires to be the same.
WITHOUT_MEANING = """
Artist Copyright Date DateTime DocumentName Exif:* File GPS:* HostComputer Hostname IPTC:* ImageDescription Make Memory
Model RenderTime Software Time cycles.* dc:* generatedBy hdr:CAPDATE hdr:GMT hdr:SOFTWARE mi_refract:* photoshop:*
thumbnail_* tiff:XMLPacket xmp:* xmpMM:*
BlenderMultiChannel Camera ExposureTime FNumber Frame FrameRange Lens Marker Note Scene Strip aux:* crs:* png:text:*
MSE estimatedVariance husk:* renderTimeSeconds samplesPerPixel vrayInfo/*
CompressionQuality FramesPerSecond bmp:version compression gif:* jpeg:subsampling oiio:BitsPerSample oiio:RowsPerChunk
openexr:chunkCount openexr:dwaCompressionLevel openexr:levelmode openexr:lineOrder openexr:roundingmode planarconfig
png:iDOT pnm:bigendian pnm:binary targa:version tiff:BitsPerSample tiff:Compression tiff:PlanarConfiguration
tiff:Predictor tiff:RowsPerStrip tiff:zipquality
ICCProfile:* hdr:exposure name oiio:AverageColor oiio:ConstantColor oiio:LoopCount oiio:Movie oiio:SHA-1
oiio:subimages tiff:ColorSpace colorInteropID tiff:PageNumber tiff:PhotometricInterpretation tiff:UnassociatedAlpha
tiff:subfiletype Orientation PixelAspectRatio ResolutionUnit XResolution YResolution
"""
COMPARED = ("Exif:ColorSpace", "Exif:Gamma")  # of those


def difference(images: Sequence[Image], ignored: Sequence[str] = ()) -> str:
    """What the files of some images say otherwise than that of the first, in one line; "" for nothing.

    `ignored`: patterns of names that do not count. Images that were not read from a file say nothing.
    """
    said = [_said(image, tuple(ignored)) for image in images if image.stored]
    for other in said[1:]:
        names = [name for name in sorted(said[0].keys() | other.keys()) if said[0].get(name) != other.get(name)]
        if ALPHA in names and None in (said[0].get(ALPHA), other.get(ALPHA)):  # one has no alpha of which it would be
            names.remove(ALPHA)
        if names:
            one, two = (side.get(names[0], "not there") for side in (said[0], other))
            more = f", and {', '.join(names[1:])}" if len(names) > 1 else ""
            return f"different metadata: {names[0]} ({one:.{SHOWN}} → {two:.{SHOWN}}){more}"
    return ""


def _said(image: Image, ignored: tuple[str, ...]) -> dict[str, str]:
    """What the file says, as text by name, without what says the same as nothing."""
    space = str(image.metadata.get(SPACE, "")).lower()
    space = SPACES.get(space, space) or ("srgb_rec709_scene" if image.stored in CODED else "lin_rec709_scene")
    texts = {name.removeprefix(TEXT) for name in image.metadata if name.startswith(TEXT)}
    said = {name: _text(value) for name, value in image.metadata.items() if name not in texts} | {SPACE: space}
    if any(name.rpartition(".")[2] == "A" for name in image.channels):
        said.setdefault(ALPHA, "0")
    return {
        name: text for name, text in said.items() if text not in USUAL.get(name, ()) and not _is_ignored(name, ignored)
    }


def _text(value: Any) -> str:
    value = value.tobytes() if isinstance(value, np.ndarray) else value
    if not isinstance(value, bytes):
        return str(value)
    if value.isascii() and (text := value.decode("ascii")).isprintable():
        return text
    return f"{len(value)} bytes of SHA-256 {hashlib.sha256(value).hexdigest()}"


@functools.cache
def _is_ignored(name: str, patterns: tuple[str, ...]) -> bool:
    known = name not in COMPARED and any(matches(pattern, name) for pattern in WITHOUT_MEANING.split())
    return known or any(matches(pattern, name) for pattern in patterns)

"""Small image files, good and bad, for tests of `mi-refract diff`."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from mi_refract.image_diff.comparison import Verdict
from mi_refract.image_diff.methods import METHODS
from mi_refract.io.image_file import Image, write_exr

SIZE = (32, 48, 3)
SMOOTH = np.dstack([np.linspace(0.1, 0.9, 48 * 40).reshape(40, 48) ** k for k in (1, 2, 3)]).astype(np.float32)
EQUAL, DIFFERENT, INCONCLUSIVE = Verdict.EQUAL, Verdict.DIFFERENT, Verdict.INCONCLUSIVE
SINGLE = [name for name, method in METHODS.items() if not method.takes_renders]


def of(pixels, channels=None, **rest):
    """Return an image in memory with channels R, G, B, or Y for one channel."""
    pixels = np.asarray(pixels, np.float32)
    names = ("Y",) if pixels.shape[-1] == 1 else tuple("RGBA"[: pixels.shape[-1]])
    return Image(Path("a.exr"), pixels, channels or names, **rest)


def metric(comparison, prefix):
    """Return the value of the first metric whose name begins with a prefix."""
    return next(metric.value for metric in comparison.metrics if metric.name.startswith(prefix))


def image(path, seed=0, *, gain=1.0, noise=0.0, shape=SIZE, value=None, channels=("R", "G", "B")):
    """Write a smooth image to `path` and return its pixels. `seed` only changes the noise; `noise`: σ over mean."""
    path.parent.mkdir(parents=True, exist_ok=True)
    x = np.linspace(0.2, 1.0, shape[1])[None, :, None] * np.ones(shape)
    pixels = gain * x * (1 + noise * np.random.default_rng(seed).standard_normal(shape))
    if value is not None:
        pixels[3, 5, 1] = value
    write_exr(path, pixels, channels)
    return pixels


def samples(folder, count=6, first=0, **options):
    """Write independent renders of that image to a folder; `first` is the first seed. Return the folder."""
    for i in range(count):
        image(folder / f"{i}.exr", first + i, **{"noise": 0.1, **options})
    return folder


def cut(path, keep):
    """Truncate a file to `keep` bytes; a negative number is removed from the end, a float is a share of the file."""
    data = path.read_bytes()
    path.write_bytes(data[: keep if isinstance(keep, int) else int(keep * len(data))])


def truncated(path):
    image(path)
    cut(path, 0.5)


BROKEN = {
    "truncated": truncated,
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("no image at all\n"),
    "one channel": lambda path: image(path, shape=(32, 48, 1), channels=("Y",), gain=0.9),
    "other size": lambda path: image(path, shape=(32, 47, 3)),
    "other channels": lambda path: image(path, channels=("X", "Y", "Z")),
    "link to nothing": lambda path: path.symlink_to("nowhere.exr"),
}


def tree(folder):
    """Return the contents of every file in a folder by its path."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def outcomes(results):
    """Return status and category of the results by name."""
    return {result.name: (str(result.status), str(result.category)) for result in results.results}


def save(path, pixels, kind="float", attributes=None, **fields):
    """Write an image with OpenImageIO; `attributes`: arguments of `ImageSpec.attribute` by name."""
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    for name, arguments in (attributes or {}).items():
        spec.attribute(name, *arguments)
    for name, value in fields.items():
        setattr(spec, name, value)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec), output.geterror()
    assert output.write_image(pixels) and output.close()
    return path


# Files that OpenImageIO cannot write ----------------------------------------------------------------------------------


TIFF_TYPES = {1: "B", 2: "B", 3: "H", 4: "I", 5: "I", 7: "B", 12: "d"}


def tiff(path, pixels, tags=None):
    """Write an uncompressed TIFF of H × W × C pixels of any type; `tags`: further or changed tags, (type, values)."""
    height, width, count = pixels.shape
    kind, data = {"u": 1, "i": 2, "f": 3}[pixels.dtype.kind], pixels.tobytes()
    entries = {256: (4, [width]), 257: (4, [height]), 258: (3, [8 * pixels.itemsize] * count), 259: (3, [1])}
    entries |= {262: (3, [2 if count > 2 else 1]), 273: (4, [0]), 277: (3, [count]), 278: (4, [height])}
    entries |= {279: (4, [len(data)]), 339: (3, [kind] * count)} | (tags or {})
    values = {tag: struct.pack(f"<{len(x)}{TIFF_TYPES[t]}", *x) for tag, (t, x) in entries.items()}
    end = 8 + 2 + 12 * len(entries) + 4  # of the directory
    values[273] = struct.pack("<I", end + sum(len(value) for value in values.values() if len(value) > 4))
    directory, long_values = struct.pack("<H", len(entries)), b""
    for tag in sorted(entries):
        field, numbers = entries[tag]
        if len(values[tag]) > 4:
            value = struct.pack("<I", end + len(long_values))
            long_values += values[tag]
        else:
            value = values[tag].ljust(4, b"\0")
        count = len(numbers) // 2 if field == 5 else len(numbers)  # a rational has two numbers
        directory += struct.pack("<HHI", tag, field, count) + value
    path.write_bytes(b"II*\0" + struct.pack("<I", 8) + directory + bytes(4) + long_values + data)
    return path


def exr_of_integers(path, pixels, channels):
    """Write an EXR of uint32, by changing the header of one of float32."""
    save(path, pixels.astype(np.uint32).view(np.float32), attributes={"compression": ("none",)}, channelnames=channels)
    data = path.read_bytes()
    for name in channels:
        entry = name.encode() + b"\0" + struct.pack("<i", 2)
        data = data.replace(entry, entry.replace(b"\2", b"\0"))
    path.write_bytes(data)
    return path

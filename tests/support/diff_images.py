"""Small images in files for the tests of `mi-refract diff`, good and bad."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from mi_refract.io.image_file import Image, write_exr

SIZE = (32, 48, 3)


# By flag of OpenImageIO's `idiff`: the option of `tolerance` that says the same, and idiff's default.
def of(pixels, channels=None, **rest):
    """An image in memory, of R, G, B, or of Y where there is one channel."""
    pixels = np.asarray(pixels, np.float32)
    names = ("Y",) if pixels.shape[-1] == 1 else tuple("RGBA"[: pixels.shape[-1]])
    return Image(Path("a.exr"), pixels, channels or names, **rest)


def metric(found, begin):
    """The value of the metric whose name begins so."""
    return next(each.value for each in found.metrics if each.name.startswith(begin))


def image(path, seed=0, *, gain=1.0, noise=0.0, shape=SIZE, value=None, channels=("R", "G", "B")):
    """An image written to `path`: the same smooth one for every seed, but for `noise` (σ over mean). Its pixels."""
    path.parent.mkdir(parents=True, exist_ok=True)
    x = np.linspace(0.2, 1.0, shape[1])[None, :, None] * np.ones(shape)
    pixels = gain * x * (1 + noise * np.random.default_rng(seed).standard_normal(shape))
    if value is not None:
        pixels[3, 5, 1] = value
    write_exr(path, pixels, channels)
    return pixels


def samples(folder, count=6, first=0, **how):
    """Independent renders of that image in a folder."""
    for i in range(count):
        image(folder / f"{i}.exr", first + i, **{"noise": 0.1, **how})
    return folder


def multipart(path):
    spec = oiio.ImageSpec(8, 8, 3, "float")
    output = oiio.ImageOutput.create(str(path))
    specs = []
    for name in ("one", "two"):
        part = oiio.ImageSpec(spec)
        part.attribute("oiio:subimagename", name)
        specs.append(part)
    assert output.open(str(path), tuple(specs)), output.geterror()
    for number, part in enumerate(specs):
        assert number == 0 or output.open(str(path), part, "AppendSubimage"), output.geterror()
        assert output.write_image(np.ones((8, 8, 3), np.float32))
    output.close()


def deep(path):
    spec = oiio.ImageSpec(4, 4, 2, "float")
    spec.channelnames = ("A", "Z")
    spec.deep = True
    data = oiio.DeepData()
    data.init(16, 2, oiio.TypeFloat, ("A", "Z"))
    for pixel in range(16):
        data.set_samples(pixel, 1)
        data.set_deep_value(pixel, 0, 0, 0.5)
        data.set_deep_value(pixel, 1, 0, 1.0)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec), output.geterror()
    assert output.write_deep_image(data), output.geterror()
    output.close()


def cut(path, keep):
    """Keep so many bytes of a file (negative: all but so many), or that share of them."""
    data = path.read_bytes()
    path.write_bytes(data[: keep if isinstance(keep, int) else int(keep * len(data))])


def truncated(path):
    image(path)
    cut(path, 0.5)


def zero_size(path):
    """A valid header whose data window holds no pixel (xMax = xMin − 1)."""
    image(path)
    data = bytearray(path.read_bytes())
    at = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    data[at : at + 16] = np.array([0, 0, -1, -1], "<i4").tobytes()
    path.write_bytes(data)


def gray(path):
    image(path, shape=(32, 48, 1), channels=("Y",))


BROKEN = {
    "truncated": truncated,
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("no image at all\n"),
    "png by content": lambda path: _png(path),
    "several parts": multipart,
    "deep": deep,
    "zero size": zero_size,
    "one channel": gray,
    "other size": lambda path: image(path, shape=(32, 47, 3)),
    "other channels": lambda path: image(path, channels=("X", "Y", "Z")),
    "link to nothing": lambda path: path.symlink_to("nowhere.exr"),
}


def _png(path):
    other = path.with_suffix(".png")
    buffer = oiio.ImageBuf(np.full(SIZE, 0.5, np.float32))
    assert buffer.write(str(other), "uint8"), buffer.geterror()
    other.replace(path)


def tree(folder):
    """Every file with what it holds."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def found(results):
    """Status and category by name."""
    return {result.name: (str(result.status), str(result.category)) for result in results.results}

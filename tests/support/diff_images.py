"""Small images in files for the tests of `mi-refract diff`, good and bad."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mi_refract.io.image_file import Image, write_exr

SIZE = (32, 48, 3)


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


def cut(path, keep):
    """Keep so many bytes of a file (negative: all but so many), or that share of them."""
    data = path.read_bytes()
    path.write_bytes(data[: keep if isinstance(keep, int) else int(keep * len(data))])


def truncated(path):
    image(path)
    cut(path, 0.5)


BROKEN = {
    "truncated": truncated,
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("no image at all\n"),
    "one channel": lambda path: image(path, shape=(32, 48, 1), channels=("Y",)),
    "other size": lambda path: image(path, shape=(32, 47, 3)),
    "other channels": lambda path: image(path, channels=("X", "Y", "Z")),
    "link to nothing": lambda path: path.symlink_to("nowhere.exr"),
}


def tree(folder):
    """Every file with what it holds."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def found(results):
    """Status and category by name."""
    return {result.name: (str(result.status), str(result.category)) for result in results.results}

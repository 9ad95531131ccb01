"""Defects that are planted in images to see which of them a comparison notices."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mi_refract.io import atomic, image_file
from mi_refract.io.pixels import Pixels, srgb_decode, srgb_encode

Renders = Pixels | list[Pixels]  # of one image, renders × H × W × C; a list where one of them is of another size


@dataclass(frozen=True)
class Defect:
    """`plant` puts the defect into an image, H × W × C; it may raise the error of a file that cannot be read.

    `once`: only the first of several renders is spoilt. `always_due`: every method must see it, however noisy the
    images are.
    """

    text: str
    plant: Callable[[Pixels], Pixels]
    once: bool = False
    always_due: bool = False

    def spoil(self, renders: Pixels) -> Renders:
        """The renders with the defect in each of them, or in the first. Errors: those of `plant`."""
        if not self.once:
            return np.stack([self.plant(image) for image in renders])
        return [self.plant(renders[0]), *renders[1:]]


def _pixel(value: Callable[[Pixels], float]) -> Callable[[Pixels], Pixels]:
    """A defect of the pixel in the centre, in all channels."""

    def plant(image: Pixels) -> Pixels:
        spoilt = image.copy()
        spoilt[image.shape[0] // 2, image.shape[1] // 2] = value(image)
        return spoilt

    return plant


def _blurred(image: Pixels) -> Pixels:
    from scipy.ndimage import uniform_filter

    blurred: Pixels = uniform_filter(image, (3, 3, 1), mode="nearest")
    return blurred


def _in_8_bits(image: Pixels) -> Pixels:
    """Through an 8-bit sRGB file: values above 1 (white) become 1."""
    return srgb_decode(np.round(255 * srgb_encode(np.clip(image, 0, 1))) / 255)


def through_a_file(image: Pixels, share: float = 1.0) -> Pixels:
    """The image written as EXR, cut to a share of the bytes, and read again. ValueError for what cannot be read."""
    channels = image_file.named("", image).channels
    with atomic.temporary_folder() as folder:
        path = folder / "image.exr"
        image_file.write_exr(path, image, channels)
        path.write_bytes((data := path.read_bytes())[: int(share * len(data))])
        return image_file.read(path).select(channels)


DEFECTS = {
    "gain": Defect("1 % brighter", lambda x: 1.01 * x),
    "shift": Defect("one pixel to the right", lambda x: np.roll(x, 1, axis=1)),
    "swapped channels": Defect("the first and the last", lambda x: x[..., ::-1]),
    "blur": Defect("mean of 3 × 3 pixels", _blurred),
    "8 bits": Defect("through an 8-bit sRGB file", _in_8_bits),
    "firefly": Defect("one pixel a thousand times as bright as the mean", _pixel(lambda x: 1e3 * x.mean())),
    "NaN": Defect("one pixel of one image", _pixel(lambda x: math.nan), once=True, always_due=True),
    "Inf": Defect("one pixel of one image", _pixel(lambda x: math.inf), once=True, always_due=True),
    "wrong size": Defect("one image lacks a column", lambda x: x[:, 1:], once=True, always_due=True),
    "truncated": Defect(
        "half of one image's file is missing", lambda x: through_a_file(x, 0.5), once=True, always_due=True
    ),
}

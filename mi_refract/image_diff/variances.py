"""What is known of the noise of single images: variances from files beside them, or from channels of their own.

A variance is that of one sample per pixel, as Mitsuba's test data and its `moment` integrator have it; that of the
image follows by dividing by the samples per pixel. Its degrees of freedom are the samples per pixel − 1, unless the
header says otherwise: where it was estimated from the spread between a few passes they are passes − 1. Samples are
independent, but pixels of a file of `mi-refract render` are not, under a filter wider than a box: the means of its
tiles vary (∫∫w)²/∫∫w² times as much as those of independent pixels, for weights w of at least 0 (2 radius)² at most.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mi_refract.io import image_file
from mi_refract.io.image_file import MAX_VALUES, Image
from mi_refract.io.pixels import Pixels

from .channels import ROUNDED, XYZ, matched, means, selected, spreads
from .pixel_statistics import RADIUS

# m2 − m² below 0 by its rounding, in half floats 2⁻¹¹ of m2 and twice that of m²: no error. In Mitsuba's test data
# 0.0022 is the most as X, Y, Z; as R, G, B 100 of its 111 files of colour are further below.
NEGATIVE = 4 * ROUNDED
SPP = "mi_refract:spp"  # of a header
FREEDOM = "mi_refract:variance_freedom"  # of a header
FILTER = "mi_refract:filter_radius"  # of a header, in pixels: then variances are those of filtered pixels
AREA = "mi_refract:filter_area"  # of a header, in pixels: (∫∫w)²/∫∫w² of the filter w


@dataclass(frozen=True)
class Estimate:
    """An image without channels of variance, and `variance`: H × W × C of one sample per pixel; NaN where unknown.

    `freedom`: degrees of freedom of these variances. `shared`: how many times as much the means of tiles vary as those
    of independent pixels, as pixels share samples; None where that is to be estimated.
    """

    image: Image
    variance: Pixels
    spp: int
    freedom: int
    shared: float | None

    @property
    def known(self) -> NDArray[np.bool_]:
        """Of every channel, whether its variance is known."""
        return np.asarray(np.isfinite(self.variance).all((0, 1)))


def has_variance(image: Image) -> bool:
    """Whether the variance of any of its channels is known."""
    return bool(image.variances or spreads(image.channels))


def same_noise(reference: Image, test: Image) -> bool:
    """Whether both hold variances in channels of their own, and are the same in every value of every channel."""
    if not spreads(reference.channels) or set(reference.channels) != set(test.channels):
        return False
    return np.array_equal(reference.pixels, test.select(reference.channels), equal_nan=True)


# Files --------------------------------------------------------------------------------------------------------------


def with_file(image: Image, path: Path, most: int = MAX_VALUES) -> Image:
    """The image with the variances that another file holds for its channels, by their names.

    A file of one channel is for an image of one, whatever the names. Where its header names degrees of freedom they go
    before those of the image's. OSError for a file that cannot be read; ValueError for one of another size, for one
    that has none of the channels, and for degrees of freedom that are none.
    """
    file = image_file.read(path, most)
    if file.pixels.shape[:2] != image.pixels.shape[:2]:
        (height, width), wrong = image.pixels.shape[:2], file.pixels.shape[:2]
        raise ValueError(f"{path}: {wrong[1]} × {wrong[0]}; expected a variance image of {width} × {height}")
    if FREEDOM in file.metadata:
        said = {FREEDOM: _freedom(file), **{name: file.metadata.get(name, "") for name in (FILTER, AREA)}}
        image = replace(image, metadata=image.metadata | said)
    if len(file.channels) == len(image.channels) == 1:
        return replace(image, variances={image.channels[0]: file.pixels[..., 0]})
    names = [name for name in file.channels if name in image.channels]
    if set(XYZ) <= set(file.channels) and not set(XYZ) & set(image.channels):
        names += XYZ
    if not names:
        has, needed = ", ".join(file.channels), ", ".join(image.channels)
        raise ValueError(f"{path}: variances of channels {has}; expected channels of {image.path}: {needed}")
    return replace(image, variances={name: file.select([name])[..., 0] for name in names})


# Estimates ----------------------------------------------------------------------------------------------------------


def estimates(reference: Image, test: Image, spp: tuple[int, int], allow_nonfinite: bool) -> tuple[Estimate, Estimate]:
    """Both sides with the same channels, as far as `matched` says. `spp`: of each side; 0: as its header says.

    ValueError for variances that are negative or not finite, and where the samples per pixel are not known.
    """
    one, two = matched(reference, test)
    return _estimate(one, "reference", spp[0], allow_nonfinite), _estimate(two, "test", spp[1], allow_nonfinite)


def untested(reference: Image, test: Image) -> list[Image]:
    """Both images with those channels alone whose variance neither side knows; none where there are none."""
    sides = matched(reference, test)
    known = {name for image in sides for name in (*image.variances, *spreads(image.channels))}
    unknown = [name for name in means(sides[0].channels) if name not in known]
    names = [name for name in unknown if not all(_is_alpha(image, name) for image in sides)]
    return [selected(image, {name: name for name in names}) for image in sides] if names else []


def _estimate(image: Image, side: str, spp: int, allow_nonfinite: bool) -> Estimate:
    names, pairs, spp = means(image.channels), spreads(image.channels), samples(image, side, spp)
    mean = image.select(names).astype(np.float64)
    variance = np.full(mean.shape, np.nan)
    for i, (name, m) in enumerate(zip(names, np.moveaxis(mean, -1, 0), strict=True)):
        if name in image.variances:
            v = np.asarray(image.variances[name], np.float64)
            size = np.square(image.pixels, dtype=np.float64).max(-1)
            for other in image.variances.values():
                size = np.maximum(size, np.abs(other))
            if (below := v < -NEGATIVE * size).any():
                hint = f"; of X, Y, Z that were written as colours, as Mitsuba's: channels = {list(XYZ)}"
                raise ValueError(
                    f"{image.path}: its variance of {name} is negative in {below.sum()} pixels, the first "
                    f"{_at(image, below)}; expected at least 0{hint if name in 'RGB' else ''}"
                )
        elif name in pairs:
            spread, moment = pairs[name]
            v = image.select([spread])[..., 0].astype(np.float64)
            if moment:  # E x² − (E x)², without bias
                with np.errstate(invalid="ignore", over="ignore"):
                    v = (v - m**2) * spp / (spp - 1)
        elif _is_alpha(image, name):
            v = m * (1 - m) * spp / (spp - 1)  # no variance of samples from 0 to 1 is larger: Bhatia and Davis (2000)
        else:
            continue
        unknown = ~np.isfinite(v)
        if (wrong := unknown & np.isfinite(m)).any() and not allow_nonfinite:
            raise ValueError(
                f"{image.path}: its variance of {name} is not finite {_at(image, wrong)}; expected finite values"
            )
        variance[..., i] = np.where(unknown, 0, np.maximum(v, 0))
    bare = replace(image, pixels=image.select(names), channels=tuple(names), variances={})
    freedom = spp - 1
    if FREEDOM in image.metadata and (image.variances or pairs):
        freedom = _freedom(image)
    return Estimate(bare, variance, spp, freedom, _shared(image, freedom < spp - 1))


def samples(image: Image, side: str, spp: int, least: int = 2) -> int:
    """The samples per pixel of an option, `spp`, or where that is 0 those of the header, which may hold anything.

    ValueError, which names the option of that `side`, for fewer than `least` and for what is no such number.
    """
    value = spp or image.metadata.get(SPP, "no samples per pixel")
    if (count := _whole(value)) < least:
        where = "samples per pixel:" if spp else "its header names"
        raise ValueError(f"{image.path}: {where} {value!r:.60}; expected `spp` or `spp_{side}`, {least} to 10¹⁵")
    return count


def _freedom(image: Image) -> int:
    """The degrees of freedom that the header names, which may hold anything."""
    value = image.metadata[FREEDOM]
    if (count := _whole(value)) < 1:
        raise ValueError(f"{image.path}: {FREEDOM} = {value!r:.60}; expected a whole number, 1 to 10¹⁵")
    return count


def _whole(value: object) -> int:
    """A whole number of up to 15 digits; −1 for anything else."""
    return int(float(str(value))) if re.fullmatch(r"[0-9]{1,15}(\.0)?", str(value)) else -1


def _shared(image: Image, of_passes: bool) -> float | None:
    """`Estimate.shared` as the header says; where it does not pixels may share samples, if passes were compared."""
    radius, area = (
        float(text) if re.fullmatch(r"[0-9]{1,6}(\.[0-9]{1,20})?", text) else None
        for text in (str(image.metadata.get(name, "")) for name in (FILTER, AREA))
    )
    if area is not None:
        return max(area, 1.0)
    if radius is None or RADIUS >= radius > 0.5:
        return None if of_passes or radius else 1.0
    return 1.0 if radius <= 0.5 else (2 * radius) ** 2


def _at(image: Image, flags: NDArray[np.bool_]) -> str:
    y, x = np.unravel_index(int(flags.argmax()), flags.shape)
    return f"at x = {x + image.origin[0]}, y = {y + image.origin[1]}"


def _is_alpha(image: Image, name: str) -> bool:
    """Whether it is an alpha whose samples were from 0 to 1."""
    if name.rpartition(".")[2] != "A":
        return False
    alpha = image.select([name])
    return bool((alpha >= 0).all() and (alpha <= 1 + ROUNDED).all())

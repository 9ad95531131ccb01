"""Channels of images: which are compared, which contain the variance of others, and estimates of the noise.

The films that Mitsuba writes are supported: colours (R, G, B, A; X, Y, Z; Y), outputs of the `aov` integrator, and
those of the `moment` integrator: X, Y, Z of each of its nested integrators ("nested.X") and their squares
("m2_nested.X"), beside the film's own colours. Variances are in such channels, or in files beside the images.

A variance is that of one sample per pixel, as in Mitsuba's test data and its `moment` integrator; divided by the
samples per pixel it is that of the image. Its degrees of freedom are samples per pixel − 1, unless the header gives
another number: a variance estimated from the spread between a few passes has passes − 1. Samples are independent.
Pixels of a file of `mi-refract render` are not, under a filter wider than a box: the means of its tiles vary
(∫∫w)²/∫∫w² times as much as those of independent pixels, which for weights w ≥ 0 is at most (2 radius)².
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mi_refract.io.image_file import TO_XYZ, Image, Pixels

from .comparison import require_window
from .pixel_statistics import RADIUS

RGB, XYZ = ("R", "G", "B"), ("X", "Y", "Z")
# Two films of half floats differ by at most this share by rounding, 2⁻¹¹ each, less than the margin of a comparison.
ROUNDED = 2.0**-10
SMALLEST = 2.0**-24  # the smallest half float, and the absolute error of half floats near 0
# A variance m2 − m² may be below 0 by rounding, in half floats by 2⁻¹¹ m2 + 2⁻¹⁰ m². In Mitsuba's test data it is at
# most 0.0022 below 0 as X, Y, Z; as R, G, B 100 of its 111 colour files are further below.
NEGATIVE = 4 * ROUNDED

# Names of the channel that belongs to a channel of means: squares of the samples (Mitsuba's `moment`), or variances.
SQUARES = "{}.m2"
VARIANCES = ("{}.variance", "{}.Variance", "variance.{}", "Variance.{}", "variance_{}")

# Keys of a header. FILTER: radius in pixels; the variances are of filtered pixels. AREA: (∫∫w)²/∫∫w² of the filter w.
SPP, FREEDOM = "mi_refract:spp", "mi_refract:variance_freedom"
FILTER, AREA = "mi_refract:filter_radius", "mi_refract:filter_area"

Names = tuple[tuple[str, str], ...]  # pairs of names in the reference and in the test image


def spreads(channels: Sequence[str]) -> dict[str, tuple[str, bool]]:
    """Return the channel of the variance (False) or of the second moment (True) of every channel that has one.

    `moment` puts "m2_" before the name of one integrator: the squares of "img.nested.X" are m2_img.nested.X,
    img.m2_nested.X or img.nested.m2_X.
    """
    existing, pairs = set(channels), dict[str, tuple[str, bool]]()
    for name in channels:
        parts = name.split(".")
        squares = [".".join([*parts[:i], f"m2_{parts[i]}", *parts[i + 1 :]]) for i in range(len(parts))]
        moments = [(spread, True) for spread in (*squares, SQUARES.format(name))]
        variances = [(form.format(name), False) for form in VARIANCES]
        if candidates := [pair for pair in (*moments, *variances) if pair[0] in existing]:
            pairs[name] = candidates[-1]
    return pairs


def means(channels: Sequence[str]) -> list[str]:
    """Return the channels that contain neither variances nor squares of others."""
    of_others = {spread for spread, _ in spreads(channels).values()}
    return [name for name in channels if name not in of_others]


def without_variances(image: Image, named: Collection[str] = ()) -> Image:
    """Return the image with the channels in `named`; if that is empty, without its NAME.variance of channels NAME."""
    removed = {VARIANCES[0].format(name) for name in image.channels}
    names = tuple(name for name in image.channels if (name in named if named else name not in removed))
    return image if names == image.channels else replace(image, pixels=image.select(names), channels=names)


def selected(image: Image, names: Mapping[str, str]) -> Image:
    """Return the image with these channels under new names, and with their variances. `names`: new names by old ones.

    If the image has R, G, B and not X, Y, Z, these are computed from R, G, B; Z without X or Y is a depth, and is not.
    The variances from a file are converted in the same way: they are assumed to be variances of X, Y, Z that were
    converted to R, G, B like a colour, as in Mitsuba's test data. (Variances of X, Y, Z do not follow from those of R,
    G, B, whose correlations are not known.)
    ValueError for a channel that does not exist.
    """
    if set(names) & {"X", "Y"} and not set(XYZ) & set(image.channels) and set(RGB) <= set(image.channels):
        converted = dict(image.variances)
        if set(RGB) <= set(converted):
            colour = np.stack([converted[name] for name in RGB], -1).astype(np.float64) @ TO_XYZ.T
            converted |= {name: colour[..., i] for i, name in enumerate(XYZ)}
        pixels = np.concatenate([image.pixels, image.select(RGB) @ TO_XYZ.T], -1)
        image = replace(image, pixels=pixels, channels=(*image.channels, *XYZ), variances=converted)
    pairs = spreads(image.channels)
    if missing := [name for name in names if name not in image.channels]:
        expected = ", ".join(means(image.channels))
        raise ValueError(f"{image.path}: no channel {missing[0]!r}; in `channels` expected {expected}")
    new_names = dict(names)
    for old, new in names.items():
        if old in pairs:
            spread, is_moment = pairs[old]
            new_names[spread] = f"m2_{new}" if is_moment else f"{new}.variance"
    variances = {new: image.variances[old] for old, new in names.items() if old in image.variances}
    pixels = image.select(list(new_names))
    return replace(image, pixels=pixels, channels=tuple(new_names.values()), variances=variances)


# Films of the moment integrator -------------------------------------------------------------------------------------


def matched(reference: Image, test: Image) -> tuple[Image, Image]:
    """Return both images with the same channels, as far as these follow from Mitsuba's layouts; variances may differ.

    The channels "nested.X", "nested.Y", "nested.Z" of `moment`, which have squares, replace the film's colours as X, Y,
    Z, if the colours repeat them, whatever the name of the nested integrator. So they can be compared with the colours
    of a film that has no moments.
    """
    images = reference, test
    layers = [moment_layer(image) for image in images]
    if all(layers) or (any(layers) and set(means(reference.channels)) != set(means(test.channels))):
        return _as_xyz(reference, layers[0]), _as_xyz(test, layers[1])
    if any(set(XYZ) <= set(image.variances) - set(image.channels) for image in images):
        return _as_xyz(reference), _as_xyz(test)
    return images


def moment_layer(image: Image) -> str:
    """Return the name before ".X" of the channels that have squares and repeat the film's colours; "" if none do."""
    pairs = spreads(image.channels)
    layers = [name[:-2] for name in image.channels if name.endswith(".X") and name in pairs]
    film = next((names for names in (RGB, XYZ, ("Y",)) if set(names) <= set(image.channels)), ())
    for layer in layers if film else []:
        nested = [f"{layer}.{name}" for name in XYZ]
        if set(nested) <= set(pairs) and _repeats(image.select(film), image.select(nested)):
            return layer
    return ""


def _repeats(film: Pixels, nested: Pixels) -> bool:
    """Return whether the film's colours equal X, Y, Z of `nested`, except for rounding and pixels finite in neither."""
    nested = nested[..., 1:2] if film.shape[-1] == 1 else nested
    nonfinite = ~np.isfinite(film).all(-1, keepdims=True) & ~np.isfinite(nested).all(-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        for matrix in (np.eye(film.shape[-1]), *([TO_XYZ] if film.shape[-1] == len(RGB) else [])):
            bound = ROUNDED * (np.abs(film) @ matrix.T + np.abs(nested)) + SMALLEST
            if (nonfinite | (np.abs(film @ matrix.T - nested) <= bound)).all():
                return True
    return False


def _as_xyz(image: Image, layer: str = "") -> Image:
    """Return the image with X, Y, Z in place of R, G, B: those of the layer, or without one computed from R, G, B."""
    names = means(image.channels)
    if layer:
        return selected(image, {name: name.removeprefix(f"{layer}.") for name in names if name not in (*RGB, *XYZ)})
    if not set(RGB) <= set(image.channels):
        return image
    return selected(image, {name: name for name in (*names, *XYZ) if name not in RGB})


# The noise ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Estimate:
    """An image without channels of variance, and its `variance`, H × W × C, of one sample per pixel; NaN if unknown.

    `freedom`: degrees of freedom of the variances. `shared`: the variance of the means of tiles relative to that for
    independent pixels, as pixels share samples; None if it has to be estimated.
    """

    image: Image
    variance: Pixels
    spp: int
    freedom: int
    shared: float | None

    @property
    def known(self) -> NDArray[np.bool_]:
        """Whether the variance is known, per channel."""
        return np.asarray(np.isfinite(self.variance).all((0, 1)))


def has_variance(image: Image) -> bool:
    """Return whether the variance of any of its channels is known."""
    return bool(image.variances or spreads(image.channels))


def with_file(image: Image, file: Image) -> Image:
    """Return the image with the variances of its channels from another file, by their names.

    If both have one channel, the names may differ. Degrees of freedom in the file's header replace those of the image's
    header. ValueError if the file has another size or shows another part of the frame, has none of the channels, or
    invalid degrees of freedom.
    """
    require_window(file, image, "variance image")
    if FREEDOM in file.metadata:
        header = {FREEDOM: _freedom(file), **{name: file.metadata.get(name, "") for name in (FILTER, AREA)}}
        image = replace(image, metadata=image.metadata | header)
    if len(file.channels) == len(image.channels) == 1:
        return replace(image, variances={image.channels[0]: file.pixels[..., 0]})
    names = [name for name in file.channels if name in image.channels]
    if set(XYZ) <= set(file.channels) and not set(XYZ) & set(image.channels):
        names += XYZ
    if not names:
        actual, expected = ", ".join(file.channels), ", ".join(image.channels)
        raise ValueError(f"{file.path}: variances of channels {actual}; expected channels of {image.path}: {expected}")
    return replace(image, variances={name: file.select([name])[..., 0] for name in names})


def estimates(reference: Image, test: Image, spp: tuple[int, int]) -> tuple[Estimate, Estimate]:
    """Return the estimates of both sides, with the channels of `matched`. `spp`: of each side; 0: from its header.

    ValueError for variances that are negative, or not finite at a finite mean, and if the samples per pixel are not
    known.
    """
    reference, test = matched(reference, test)
    return _estimate(reference, "reference", spp[0]), _estimate(test, "test", spp[1])


def untested(reference: Image, test: Image) -> list[Image]:
    """Return both images with only the channels whose variance neither side knows; empty if there are none."""
    sides = matched(reference, test)
    known = {name for image in sides for name in (*image.variances, *spreads(image.channels))}
    unknown = [name for name in means(sides[0].channels) if name not in known]
    names = [name for name in unknown if not all(_is_alpha(image, name) for image in sides)]
    return [selected(image, {name: name for name in names}) for image in sides] if names else []


def _estimate(image: Image, side: str, spp: int) -> Estimate:
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
                text = f"{image.path}: its variance of {name} is negative in {below.sum()} pixels, the first"
                raise ValueError(f"{text} {_first(image, below)}; expected at least 0{hint if name in 'RGB' else ''}")
        elif name in pairs:
            spread, is_moment = pairs[name]
            v = image.select([spread])[..., 0].astype(np.float64)
            if is_moment:  # E x² − (E x)², without bias
                with np.errstate(invalid="ignore", over="ignore"):
                    v = (v - m**2) * spp / (spp - 1)
        elif _is_alpha(image, name):
            v = m * (1 - m) * spp / (spp - 1)  # upper bound for samples from 0 to 1: Bhatia and Davis (2000)
        else:
            continue
        unknown = ~np.isfinite(v)
        if (wrong := unknown & np.isfinite(m)).any():
            text = f"{image.path}: its variance of {name} is not finite {_first(image, wrong)}"
            raise ValueError(f"{text}; expected finite values")
        variance[..., i] = np.where(unknown, 0, np.maximum(v, 0))
    freedom = spp - 1
    if FREEDOM in image.metadata and (image.variances or pairs):
        freedom = _freedom(image)
    image_of_means = replace(image, pixels=image.select(names), channels=tuple(names), variances={})
    return Estimate(image_of_means, variance, spp, freedom, _shared_factor(image, freedom < spp - 1))


def samples(image: Image, side: str, spp: int, least: int = 2) -> int:
    """Return the samples per pixel: the option `spp`, or if it is 0 those of the header.

    ValueError, which names the option of that `side`, for fewer than `least`, and if the header has no such number.
    """
    value = spp or image.metadata.get(SPP)
    count = _whole(value)
    if count < least:
        where = "" if spp else " in its header"
        text = "none" if value is None else f"{value!r:.60}"
        expected = f"expected `spp` or `spp_{side}`, {least} to 10¹⁵"
        raise ValueError(f"{image.path}: samples per pixel{where}: {text}; {expected}")
    return count


def _freedom(image: Image) -> int:
    """Return the degrees of freedom in the header. ValueError unless it is a whole number, at least 1."""
    value = image.metadata[FREEDOM]
    if (count := _whole(value)) < 1:
        raise ValueError(f"{image.path}: {FREEDOM} = {value!r:.60}; expected a whole number, 1 to 10¹⁵")
    return count


def _whole(value: object) -> int:
    """Return a whole number of up to 15 digits; −1 for anything else."""
    return int(float(str(value))) if re.fullmatch(r"[0-9]{1,15}(\.0)?", str(value)) else -1


def _shared_factor(image: Image, of_passes: bool) -> float | None:
    """Return `Estimate.shared` by the header; `of_passes`: a variance of passes, whose pixels may share samples."""
    radius, area = (
        float(text) if re.fullmatch(r"[0-9]{1,6}(\.[0-9]{1,20})?", text) else None
        for text in (str(image.metadata.get(name, "")) for name in (FILTER, AREA))
    )
    if area is not None:
        return max(area, 1.0)
    if radius is None or RADIUS >= radius > 0.5:
        return None if of_passes or radius else 1.0
    return 1.0 if radius <= 0.5 else (2 * radius) ** 2


def _first(image: Image, flags: NDArray[np.bool_]) -> str:
    y, x = np.unravel_index(int(flags.argmax()), flags.shape)
    return f"at x = {x + image.origin[0]}, y = {y + image.origin[1]}"


def _is_alpha(image: Image, name: str) -> bool:
    """Return whether the channel is an alpha with values from 0 to 1."""
    if name.rpartition(".")[2] != "A":
        return False
    alpha = image.select([name])
    return bool((alpha >= 0).all() and (alpha <= 1 + ROUNDED).all())

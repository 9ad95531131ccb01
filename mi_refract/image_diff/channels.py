"""The channels of images: which are compared, which hold the variance of others, and what is known of the noise.

Recognised are the films that Mitsuba writes: colours (R, G, B, A; X, Y, Z; Y), outputs of the `aov` integrator, and of
the `moment` integrator, which are X, Y, Z of every integrator that it holds ("nested.X") and their squares
("m2_nested.X"), beside the film's own colours. Variances are in such channels, or in files beside the images.

A variance is that of one sample per pixel, as Mitsuba's test data and its `moment` integrator have it; that of the
image follows by dividing by the samples per pixel. Its degrees of freedom are the samples per pixel − 1, unless the
header says otherwise: where it was estimated from the spread between a few passes they are passes − 1. Samples are
independent, but pixels of a file of `mi-refract render` are not, under a filter wider than a box: the means of its
tiles vary (∫∫w)²/∫∫w² times as much as those of independent pixels, for weights w of at least 0 (2 radius)² at most.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mi_refract.io.image_file import Image, Pixels

from .pixel_statistics import RADIUS

RGB, XYZ = ("R", "G", "B"), ("X", "Y", "Z")
# Linear sRGB to CIE XYZ, as Mitsuba converts it.
TO_XYZ = np.array([[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]])
# A film of half floats rounds by up to 2⁻¹¹ on either side; what that hides is less than a comparison's own margin.
ROUNDED = 2.0**-10
SMALLEST = 2.0**-24  # of half floats, and their absolute error near 0
# m2 − m² below 0 by its rounding, in half floats 2⁻¹¹ of m2 and twice that of m²: no error. In Mitsuba's test data
# 0.0022 is the most as X, Y, Z; as R, G, B 100 of its 111 files of colour are further below.
NEGATIVE = 4 * ROUNDED

# A second image beside the mean: of the squares of the samples (Mitsuba's `moment`), or of their variance.
SQUARES = "{}.m2"
VARIANCES = ("{}.variance", "{}.Variance", "variance.{}", "Variance.{}", "variance_{}")

# Of a header. With FILTER, a radius in pixels, variances are of filtered pixels. AREA: (∫∫w)²/∫∫w² of the filter w.
SPP, FREEDOM = "mi_refract:spp", "mi_refract:variance_freedom"
FILTER, AREA = "mi_refract:filter_radius", "mi_refract:filter_area"

Names = tuple[tuple[str, str], ...]  # of the reference and of the test


def spreads(channels: Sequence[str]) -> dict[str, tuple[str, bool]]:
    """The channel with the variance (False) or the second moment (True) of each channel that has one.

    `moment` puts "m2_" before the name of one integrator: of "img.nested.X" the squares are m2_img.nested.X,
    img.m2_nested.X or img.nested.m2_X.
    """
    there, pairs = set(channels), dict[str, tuple[str, bool]]()
    for name in channels:
        parts = name.split(".")
        squares = [".".join([*parts[:i], f"m2_{parts[i]}", *parts[i + 1 :]]) for i in range(len(parts))]
        moments = [(spread, True) for spread in (*squares, SQUARES.format(name))]
        variances = [(form.format(name), False) for form in VARIANCES]
        if spread_of := [pair for pair in (*moments, *variances) if pair[0] in there]:
            pairs[name] = spread_of[-1]
    return pairs


def means(channels: Sequence[str]) -> list[str]:
    """The channels that hold no variance of others."""
    others = {spread for spread, _ in spreads(channels).values()}
    return [name for name in channels if name not in others]


def without_variances(image: Image, named: Collection[str] = ()) -> Image:
    """The image without its channels NAME.variance of channels NAME, but for those that are `named`."""
    left_out = {VARIANCES[0].format(name) for name in image.channels} - set(named)
    kept = tuple(name for name in image.channels if name not in left_out)
    return image if kept == image.channels else replace(image, pixels=image.select(kept), channels=kept)


def selected(image: Image, names: Mapping[str, str]) -> Image:
    """These channels, each under its new name, with what is known of their variances. `names`: the new by the old.

    X, Y and Z of an image that has R, G, B instead are made of these. So are variances from a file: they are taken for
    variances of X, Y, Z that were converted to R, G, B like a colour, as in Mitsuba's test data. (Those of R, G and B
    would not do, as they do not say how the three correlate.) ValueError for a channel that is not there.
    """
    if set(names) & set(XYZ) and not set(XYZ) & set(image.channels) and set(RGB) <= set(image.channels):
        converted = dict(image.variances)
        if set(RGB) <= set(converted):
            colour = np.stack([converted[name] for name in RGB], -1).astype(np.float64) @ TO_XYZ.T
            converted |= {name: colour[..., i] for i, name in enumerate(XYZ)}
        pixels = np.concatenate([image.pixels, image.select(RGB) @ TO_XYZ.T], -1)
        image = replace(image, pixels=pixels, channels=(*image.channels, *XYZ), variances=converted)
    pairs = spreads(image.channels)
    missing = [name for name in names if name not in image.channels]
    if missing:
        known = ", ".join(means(image.channels))
        raise ValueError(f"{image.path}: no channel {missing[0]!r}; in `channels` expected {known}")
    kept = dict(names)
    for old, new in names.items():
        if old in pairs:
            spread, moment = pairs[old]
            kept[spread] = f"m2_{new}" if moment else f"{new}.variance"
    variances = {new: image.variances[old] for old, new in names.items() if old in image.variances}
    return replace(image, pixels=image.select(list(kept)), channels=tuple(kept.values()), variances=variances)


def chosen(images: Sequence[Image], names: Names, side: int) -> list[Image]:
    """Images with these channels only, under the reference's names; as they are where none are named.

    `side`: 0 for images of the reference, 1 for new ones.
    """
    return [selected(image, {pair[side]: pair[0] for pair in names}) if names else image for image in images]


# Films of the moment integrator -------------------------------------------------------------------------------------


def matched(reference: Image, test: Image) -> tuple[Image, Image]:
    """Both images with the same channels as far as Mitsuba's layouts say, apart from those of variance.

    What `moment` holds as "nested.X", "nested.Y", "nested.Z" with its squares takes the place of the film's colours, if
    these repeat it, as X, Y, Z; whatever the nested integrator is called. They are compared with the colours of a film
    that has no moments.
    """
    images = reference, test
    layers = [moment_layer(image) for image in images]
    if all(layers) or (any(layers) and set(means(reference.channels)) != set(means(test.channels))):
        one, two = (_as_xyz(x, layer) for x, layer in zip(images, layers, strict=True))
        return one, two
    if any(set(XYZ) <= set(image.variances) - set(image.channels) for image in images):
        return _as_xyz(reference), _as_xyz(test)
    return images


def moment_layer(image: Image) -> str:
    """The name before ".X" of the channels that have squares and repeat the film's own colours; "" where none do."""
    pairs = spreads(image.channels)
    layers = [name[:-2] for name in image.channels if name.endswith(".X") and name in pairs]
    film = next((names for names in (RGB, XYZ, ("Y",)) if set(names) <= set(image.channels)), ())
    for layer in layers if film else []:
        nested = [f"{layer}.{name}" for name in XYZ]
        if set(nested) <= set(pairs) and _repeats(image.select(film), image.select(nested)):
            return layer
    return ""


def _repeats(film: Pixels, nested: Pixels) -> bool:
    """Whether the film's colours, R, G, B or X, Y, Z or Y, are X, Y, Z of `nested` but for rounding, or NaN with it."""
    nested = nested[..., 1:2] if film.shape[-1] == 1 else nested
    broken = ~np.isfinite(film).all(-1, keepdims=True) & ~np.isfinite(nested).all(-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        for matrix in (np.eye(film.shape[-1]), *([TO_XYZ] if film.shape[-1] == len(RGB) else [])):
            most = ROUNDED * (np.abs(film) @ matrix.T + np.abs(nested)) + SMALLEST
            if (broken | (np.abs(film @ matrix.T - nested) <= most)).all():
                return True
    return False


def _as_xyz(image: Image, layer: str = "") -> Image:
    """The image with X, Y, Z in place of R, G, B: those of the layer, whose name goes, or else made of these."""
    names = means(image.channels)
    if layer:
        return selected(image, {name: name.removeprefix(f"{layer}.") for name in names if name not in (*RGB, *XYZ)})
    if not set(RGB) <= set(image.channels):
        return image
    return selected(image, {name: name for name in (*names, *XYZ) if name not in RGB})


# The noise ----------------------------------------------------------------------------------------------------------


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
        """Whether the variance of each channel is known."""
        return np.asarray(np.isfinite(self.variance).all((0, 1)))


def has_variance(image: Image) -> bool:
    """Whether the variance of any of its channels is known."""
    return bool(image.variances or spreads(image.channels))


def with_file(image: Image, file: Image) -> Image:
    """The image with the variances that another file holds for its channels, by their names.

    A file of one channel is for an image of one, whatever the names. Where its header names degrees of freedom they go
    before those of the image's. ValueError for a file of another size, for one that has none of the channels, and for
    degrees of freedom that are none.
    """
    if file.pixels.shape[:2] != image.pixels.shape[:2]:
        (height, width), wrong = image.pixels.shape[:2], file.pixels.shape[:2]
        raise ValueError(f"{file.path}: {wrong[1]} × {wrong[0]}; expected a variance image of {width} × {height}")
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
        raise ValueError(f"{file.path}: variances of channels {has}; expected channels of {image.path}: {needed}")
    return replace(image, variances={name: file.select([name])[..., 0] for name in names})


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

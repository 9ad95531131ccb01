"""The channels of images: which of both sides are compared, and which of them hold the variance of others.

Recognised are the films that Mitsuba writes: colours (R, G, B, A; X, Y, Z; Y), outputs of the `aov` integrator, and of
the `moment` integrator, which are X, Y, Z of every integrator that it holds ("nested.X") and their squares
("m2_nested.X"), beside the film's own colours.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from mi_refract.io.image_file import Image
from mi_refract.io.pixels import Pixels

RGB, XYZ = ("R", "G", "B"), ("X", "Y", "Z")
# Linear sRGB to CIE XYZ, as Mitsuba converts it.
TO_XYZ = np.array([[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]])
# A film of half floats rounds by up to 2⁻¹¹ on either side; what that hides is less than a comparison's own margin.
ROUNDED = 2.0**-10
SMALLEST = 2.0**-24  # of half floats, and their absolute error near 0

# A second image beside the mean: of the squares of the samples (Mitsuba's `moment`), or of their variance.
SQUARES = "{}.m2"
VARIANCES = ("{}.variance", "{}.Variance", "variance.{}", "Variance.{}", "variance_{}")

Names = tuple[tuple[str, str], ...]  # of the reference and of the test


def spreads(channels: Sequence[str]) -> dict[str, tuple[str, bool]]:
    """Of every channel that has one: the name of the channel of its variance (False) or second moment (True).

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
        accepted = ", ".join(means(image.channels))
        raise ValueError(f"{image.path}: no channel {missing[0]!r}; in `channels` expected {accepted}")
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
    """Both with the same channels as far as Mitsuba's layouts say, apart from those of variance.

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

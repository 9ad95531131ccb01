"""Whether a method could have told the test image from black: asked of each group of channels, and of each pixel.

Channels that belong together are blackened together: a bright alpha or depth says nothing of a dim colour.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_refract.io.image_file import Image
from mi_refract.io.pixels import Pixels, any_channel

Options = Mapping[str, Any]
PassesBlack = Callable[[Image, Options], bool]
AcceptsBlack = Callable[[Pixels, Options], NDArray[np.bool_]]

UNSEEN = 0.1  # share of the lit pixels that may differ so that black would be accepted there, too
CLOSER = 100.0  # where the test image is so many times closer to the reference than black is, it is no black
ROW_STEP = 16  # every so many rows show whether a method would see that an image is black
ALONE = {"A", "Z"}  # alpha and depth, of any layer


def groups(channels: Sequence[str]) -> dict[str, list[str]]:
    """Channels by what they are part of: the colours, and the alpha and the depth, of each layer."""
    found: dict[str, list[str]] = {}
    for name in channels:
        layer, dot, last = name.rpartition(".")
        alone = last in ALONE if not dot else last == "A"  # a layer's X, Y, Z are a vector
        found.setdefault(name if alone else layer + dot, []).append(name)
    return found


def blind_to(a: Image, b: Image, options: Options, passes: PassesBlack, accepts: AcceptsBlack | None) -> str:
    """What black would pass in, in place of the test image `b`; "" where a difference would have been seen.

    `passes`: whether a black image is equal to this one for the method with these options. `accepts`: in which pixels
    black is no failure; None for a method that does not judge pixels alone, nor channels in groups. Both images are
    finite and have the same channels in the same order.
    """
    parts = {", ".join(names): names for names in groups(a.channels).values()} if accepts else {"": list(a.channels)}
    for text, names in parts.items():
        one, two = (
            each if len(parts) == 1 else replace(each, pixels=each.select(names), channels=tuple(names))
            for each in (a, b)
        )
        if not one.pixels.any() or np.array_equal(one.pixels, two.pixels):
            continue
        of = f" in {text}," if len(parts) > 1 else ""
        # Where black would be seen in some of the rows, the others need not be asked, if pixels are judged alone.
        views = (one.pixels[::ROW_STEP], one.pixels) if accepts else (one.pixels,)
        if all(passes(replace(one, pixels=view), options) for view in views):
            return f"an all-black image would pass, too,{of}"
        share = _share(one.pixels, two.pixels, accepts(one.pixels, options)) if accepts else 0.0
        if share > UNSEEN:
            return f"black would pass, too,{of} in {share:.0%} of the pixels that are not black,"
    return ""


def _share(a: Pixels, b: Pixels, accepted: NDArray[np.bool_]) -> float:
    """Of the pixels of `a` that are not black: those where black is accepted, and `b` is not much closer than that."""
    y, x = np.nonzero(accepted)
    dim, other = a[y, x], b[y, x]
    far = any_channel(np.abs(dim - other) > np.abs(dim) / CLOSER) & any_channel(dim != 0)
    return float(far.sum() / max(any_channel(a != 0).sum(), 1))

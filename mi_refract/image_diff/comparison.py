"""What a comparison of images says, and the preconditions of every method.

What cannot be compared is an error, and a value that is not finite equals nothing.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mi_refract.io.image_file import Image
from mi_refract.io.pixels import Pixels

Maps = dict[str, Pixels]


class Verdict(enum.StrEnum):
    """The verdict of a method on two images."""

    EQUAL = "equal"
    DIFFERENT = "different"
    INCONCLUSIVE = "inconclusive"


@dataclass(frozen=True)
class Metric:
    """A number that a method measured; where it has a bound, `value <= bound` holds for equal images."""

    name: str
    value: float
    bound: float | None = None

    @property
    def holds(self) -> bool:
        """Whether the value is within the bound; True without a bound, False for NaN."""
        return self.bound is None or self.value <= self.bound


@dataclass(frozen=True)
class Comparison:
    """The result of a method.

    `minimum_detectable`: the smallest relative difference that the method would have seen; NaN where it is not known.
    `maps`: H × W or H × W × C arrays by name, of the images' size. `warning`: what an equal image is near to failing.
    `part`: of files of several images, which it is about: its number and that of its MIP level. `chosen`: why the
    method is this one, where that was left to `auto`.
    """

    method: str
    verdict: Verdict
    reason: str
    metrics: tuple[Metric, ...] = ()
    minimum_detectable: float = np.nan
    maps: Maps = field(default_factory=dict)
    warning: str = ""
    part: tuple[int, int] = (0, 0)
    chosen: str = ""

    @property
    def method_in_words(self) -> str:
        """The method, and why it is this one: "welch (the variance of both is known)"."""
        return f"{self.method} ({self.chosen})" if self.chosen else self.method


def verdict_of(metrics: Sequence[Metric]) -> Verdict:
    """EQUAL where every metric is within its bound, else DIFFERENT."""
    return Verdict.EQUAL if all(metric.holds for metric in metrics) else Verdict.DIFFERENT


def preconditions(reference: Image, test: Image, allow_nonfinite: bool = False) -> str | None:
    """Why the two differ before any method is applied: values that are not finite, counted and located; else None.

    With `allow_nonfinite` such a value is allowed where the other image has the same one: NaN, Inf or -Inf.
    ValueError where the images cannot be compared, as `aligned`.
    """
    a, b = aligned(reference, test)
    if np.isfinite(a).all() and np.isfinite(b).all():
        return None
    if not allow_nonfinite:
        # Both have the reference's order of channels here.
        two = replace(test, channels=reference.channels)
        found = [_located(image, values, ~np.isfinite(values)) for image, values in ((reference, a), (two, b))]
        return "; ".join(text for text in found if text)
    lone = ~(np.isfinite(a) & np.isfinite(b)) & ~_same(a, b)
    return f"not finite in one image only, or otherwise: {_located(reference, a, lone)}" if lone.any() else None


def aligned(reference: Image, test: Image) -> tuple[Pixels, Pixels]:
    """The pixels of both, with the channels in the reference's order.

    ValueError where they cannot be compared: another size, other names of channels, or a header that puts the same
    pixels elsewhere, in another shape, or turned.
    """
    for name, of in HEADER.items():
        if of(reference) != of(test):
            hint = "; or `channels`: those to compare" if name == "channels" else ""
            raise ValueError(f"{test.path}: {name} {of(test)}; expected {of(reference)}, as in {reference.path}{hint}")
    same_order = reference.channels == test.channels
    return reference.pixels, test.pixels if same_order else test.select(reference.channels)


def shared_channels(reference: Image, test: Image) -> tuple[Image, Image, str]:
    """Both images with the channels that both have, and what one has besides; "" where neither has more.

    Where each of them has channels that the other lacks nothing is said: these images cannot be compared.
    """
    added, missing = ([c for c in x.channels if c not in y.channels] for x, y in ((test, reference), (reference, test)))
    shared = [name for name in reference.channels if name in test.channels]
    if bool(added) == bool(missing) or not shared:
        return reference, test, ""
    text = f"channels added: {_values(test, added)}" if added else f"channels missing: {_values(reference, missing)}"
    one, two = (replace(x, pixels=x.select(shared), channels=tuple(shared)) for x in (reference, test))
    return one, two, text


def _values(image: Image, names: Sequence[str]) -> str:
    """The channels, and their value where it is one: an opaque alpha is 1."""
    pixels = image.select(names)
    first = float(pixels.flat[0])
    if not (pixels == first).all():
        return ", ".join(names)
    opaque = "opaque: " if first == 1 and all(name.rpartition(".")[2] == "A" for name in names) else ""
    return f"{', '.join(names)} ({opaque}{first:g} everywhere)"


def checked_pixels(method: str, reference: Image, test: Image, allow: bool) -> tuple[Pixels, Pixels, Comparison | None]:
    """The pixels of both, finite, and None; or, where the preconditions decide, the comparison that they lead to.

    `allow`: allowed values that are not finite become 0. ValueError as `preconditions`.
    """
    reason = preconditions(reference, test, allow)
    a, b = aligned(reference, test)
    if reason:
        return a, b, nonfinite_result(method, reason, a, b)
    if allow:
        a, b = np.where(np.isfinite(a), a, 0), np.where(np.isfinite(b), b, 0)
    return a, b, None


def counted(image: Image) -> int:
    """How many pixels count; all without a mask."""
    return image.pixels[..., 0].size if image.mask is None else int(image.mask.sum())


def not_compared(reference: Image) -> tuple[int, list[str]]:
    """How many values are not finite, and the channels that hold no other ones: there nothing was compared."""
    finite = np.isfinite(reference.pixels).reshape(-1, len(reference.channels))
    if finite.all():
        return 0, []
    seen = zip(reference.channels, finite.any(0), strict=True)
    return int(finite.size - finite.sum()), [name for name, any_value in seen if not any_value]


def nonfinite_result(method: str, reason: str, *pixels: Pixels) -> Comparison:
    """DIFFERENT, for images with values that are not finite; the map "nonfinite" marks them."""
    bad = sum((~np.isfinite(each) for each in pixels), np.zeros(pixels[0].shape, np.float32))
    metrics = (Metric("values that are not finite", float(bad.sum()), 0.0),)
    return Comparison(method, Verdict.DIFFERENT, reason, metrics, maps={"nonfinite": (bad > 0).astype(np.float32)})


def _same(a: Pixels, b: Pixels) -> NDArray[np.bool_]:
    same: NDArray[np.bool_] = (a == b) | (np.isnan(a) & np.isnan(b))
    return same


def _located(image: Image, values: Pixels, bad: NDArray[np.bool_]) -> str:
    if not bad.any():
        return ""
    y, x, c = np.unravel_index(int(bad.argmax()), bad.shape)
    kinds = {"NaN": np.isnan(values[bad]).sum(), "Inf": np.isinf(values[bad]).sum()}
    counts = ", ".join(f"{count} {kind}" for kind, count in kinds.items() if count) or f"{bad.sum()} finite"
    place = f"x = {x + image.origin[0]}, y = {y + image.origin[1]}, channel {image.channels[c]}"
    return f"{image.path}: {counts}, the first at {place}"


def _size(image: Image) -> str:
    return f"{image.pixels.shape[1]} × {image.pixels.shape[0]}"


def _channels(image: Image) -> str:
    return ", ".join(sorted(image.channels))


def _window(image: Image) -> str:
    return "from x = {}, y = {}".format(*image.origin)


def _display(image: Image) -> str:
    x, y, width, height = image.display or (*image.origin, *image.pixels.shape[1::-1])
    return f"{width} × {height} from x = {x}, y = {y}"


HEADER: dict[str, Callable[[Image], str]] = {
    "size": _size,
    "channels": _channels,
    "data window": _window,
    "display window": _display,
    "pixel aspect ratio": lambda image: str(image.metadata.get("PixelAspectRatio", 1.0)),
    "orientation": lambda image: str(image.metadata.get("Orientation", 1)),
}

"""What a comparison of images says, and the preconditions of every method.

What cannot be compared is an error, and a value that is not finite equals nothing.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mi_refract.io.image_file import Image, Pixels

Maps = dict[str, Pixels]
# 4/3 as 1.333, or as whole pixels per metre at 72 dpi: 2835, so that half of one on each axis is 1/2835.
ASPECT = 5e-4


class Range(NamedTuple):
    """The values of an option: whether one is among them, and all of them in words."""

    contains: Callable[[Any], bool]
    words: str


NONNEGATIVE = Range(lambda x: x >= 0, "a number of at least 0")


def one_of(*words: str) -> Range:
    """The range of these words."""
    return Range(words.__contains__, ", ".join(words))


class Verdict(enum.StrEnum):
    """The verdict of a method on two images; the worst first."""

    DIFFERENT = "different"
    INCONCLUSIVE = "inconclusive"
    EQUAL = "equal"


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
    def is_equal(self) -> bool:
        """Whether the images are equal."""
        return self.verdict is Verdict.EQUAL

    def but(self, verdict: Verdict, reason: str) -> Comparison:
        """The result with another verdict, and the reason for that before its own."""
        return replace(self, verdict=verdict, reason=f"{reason}; {self.reason}")

    @property
    def method_in_words(self) -> str:
        """The method, and why it is this one: "welch (the variance of both is known)"."""
        return f"{self.method} ({self.chosen})" if self.chosen else self.method


def verdict_of(metrics: Sequence[Metric]) -> Verdict:
    """EQUAL where every metric is within its bound, else DIFFERENT."""
    return Verdict.EQUAL if all(metric.holds for metric in metrics) else Verdict.DIFFERENT


def preconditions(reference: Image, test: Image, allow_nonfinite: bool = False) -> str:
    """Why the two differ before any method is applied: values that are not finite, counted and located; "" if not.

    With `allow_nonfinite` such a value is allowed where the other image has the same one: NaN, Inf or -Inf.
    ValueError where the images cannot be compared, as `aligned`.
    """
    a, b = aligned(reference, test)
    whole = np.isfinite(a), np.isfinite(b)
    if all(x.all() for x in whole):
        return ""
    if allow_nonfinite:
        lone = ~(whole[0] & whole[1]) & ~((a == b) | (np.isnan(a) & np.isnan(b)))
        return (
            f"not finite in one image only, or not the same value: {_located(reference, a, lone)}" if lone.any() else ""
        )
    two = replace(test, channels=reference.channels)
    texts = (_located(image, x, ~good) for image, x, good in zip((reference, two), (a, b), whole, strict=True))
    return "; ".join(filter(None, texts))


def aligned(reference: Image, test: Image) -> tuple[Pixels, Pixels]:
    """The pixels of both, with the channels in the reference's order.

    ValueError where they cannot be compared: another size, other names of channels, or a header that puts the same
    pixels elsewhere, in another shape, or turned.
    """
    for name, of in HEADER.items():
        if of(reference) != of(test) and not (name == "pixel aspect ratio" and _same_aspect(reference, test)):
            hint = "; or `channels`: those to compare" if name == "channels" else ""
            raise ValueError(f"{test.path}: {name} {of(test)}; expected {of(reference)}, as in {reference.path}{hint}")
    same_order = reference.channels == test.channels
    return reference.pixels, test.pixels if same_order else test.select(reference.channels)


def as_shown(image: Image, names: Collection[str]) -> Image:
    """The image with those of the channels `names` that need not be stored: an alpha of 1, R = G = B for a gray Y.

    Where a mask leaves pixels out, alpha is 0, as all channels are.
    """
    values = dict(zip(image.channels, np.moveaxis(image.pixels, -1, 0), strict=True))
    if values.keys() - {"A", *names} == {"Y"} and {*"RGB"} <= set(names) - values.keys():
        values = dict.fromkeys("RGB", values.pop("Y")) | values
    if "A" in names:
        ones = np.ones(image.pixels.shape[:2], image.pixels.dtype)
        values.setdefault("A", ones if image.mask is None else ones * image.mask)
    if values.keys() == set(image.channels):
        return image
    return replace(image, pixels=np.stack([*values.values()], -1), channels=tuple(values))


def identical_as_shown(reference: Image, test: Image) -> str:
    """How the channels that only one image has are read, if every pixel is identical then; else ""."""
    if not (lone := set(reference.channels) ^ set(test.channels)):
        return ""
    one, two = as_shown(reference, test.channels), as_shown(test, reference.channels)
    same = one.pixels.shape == two.pixels.shape and set(one.channels) == set(two.channels)
    if not same or not np.array_equal(one.pixels, two.select(one.channels), equal_nan=True):
        return ""
    readings = {"A": "a missing alpha is read as 1", "Y": "gray is read as R = G = B"}
    return "; ".join(words for name, words in readings.items() if name in lone)


def shared_channels(reference: Image, test: Image) -> tuple[Image, Image, str]:
    """Both images with the channels that both have, and what one has besides; "" where neither has more.

    Where each of them has channels that the other lacks nothing is said: these images cannot be compared.
    """
    shared = [name for name in reference.channels if name in test.channels]
    added, missing = ([c for c in image.channels if c not in shared] for image in (test, reference))
    if bool(added) == bool(missing) or not shared:
        return reference, test, ""
    word, image, names = ("added", test, added) if added else ("missing", reference, missing)
    pixels = image.select(names)
    first = float(pixels.flat[0])
    opaque = "opaque: " if first == 1 and all(name.rpartition(".")[2] == "A" for name in names) else ""
    value = f" ({opaque}{first:g} everywhere)" if (pixels == first).all() else ""
    return only(reference, shared), only(test, shared), f"channels {word}: {', '.join(names)}{value}"


def only(image: Image, names: Sequence[str]) -> Image:
    """The image with these channels only."""
    return replace(image, pixels=image.select(names), channels=tuple(names))


def finite(pixels: Pixels) -> Pixels:
    """The pixels with 0 for what is not finite."""
    return pixels if np.isfinite(pixels).all() else np.nan_to_num(pixels, posinf=0, neginf=0)


def counted(image: Image) -> int:
    """How many pixels count; all without a mask."""
    return image.pixels[..., 0].size if image.mask is None else int(image.mask.sum())


def passes_black(method: Callable[..., Comparison], views: Iterable[Image], options: Mapping[str, Any]) -> bool:
    """Whether a method with these options calls black different from none of these images."""
    black = ((image, replace(image, pixels=np.zeros_like(image.pixels))) for image in views)
    return all(method(*pair, **options).verdict is not Verdict.DIFFERENT for pair in black)


def nonfinite_result(method: str, reason: str, *pixels: Pixels) -> Comparison:
    """DIFFERENT, for images with values that are not finite; the map "nonfinite" marks them."""
    bad = sum((~np.isfinite(x) for x in pixels), np.zeros(pixels[0].shape, np.float32))
    metrics = (Metric("values that are not finite", float(bad.sum()), 0.0),)
    return Comparison(method, Verdict.DIFFERENT, reason, metrics, maps={"nonfinite": (bad > 0).astype(np.float32)})


def place(at: NDArray[np.bool_] | Pixels, image: Image) -> str:
    """The pixel and channel of the first largest value of `at`, H × W × C: "x = 3, y = 5, channel R"."""
    y, x, c = np.unravel_index(int(at.argmax()), at.shape)
    return f"x = {x + image.origin[0]}, y = {y + image.origin[1]}, channel {image.channels[c]}"


def _same_aspect(*images: Image) -> bool:
    ratios = [image.metadata.get("PixelAspectRatio", 1.0) for image in images]
    return all(isinstance(ratio, float | int) for ratio in ratios) and math.isclose(*ratios, rel_tol=ASPECT)


def _located(image: Image, values: Pixels, bad: NDArray[np.bool_]) -> str:
    if not bad.any():
        return ""
    kinds = {"NaN": np.isnan(values[bad]).sum(), "Inf": np.isinf(values[bad]).sum()}
    counts = ", ".join(f"{count} {kind}" for kind, count in kinds.items() if count) or f"{bad.sum()} finite"
    return f"{image.path}: {counts}, the first at {place(bad, image)}"


HEADER: dict[str, Callable[[Image], str]] = {  # what must be the same, in words
    "size": lambda image: f"{image.pixels.shape[1]} × {image.pixels.shape[0]}",
    "channels": lambda image: ", ".join(sorted(image.channels)),
    "data window": lambda image: "from x = {}, y = {}".format(*image.origin),
    "display window": lambda image: "{2} × {3} from x = {0}, y = {1}".format(
        *(image.display or (*image.origin, *image.pixels.shape[1::-1]))
    ),
    "pixel aspect ratio": lambda image: str(image.metadata.get("PixelAspectRatio", 1.0)),
    "orientation": lambda image: str(image.metadata.get("Orientation", 1)),
}

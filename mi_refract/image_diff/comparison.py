"""The result of comparing two images, and the preconditions of every method.

Images that cannot be compared are an error, and a value that is not finite equals nothing.
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
# Relative tolerance of pixel aspect ratios. They may be rounded to 1.333, or follow from whole pixels per metre, 2835
# at 72 dpi, where rounding both axes changes the ratio by up to 1/2835.
ASPECT = 5e-4


class Range(NamedTuple):
    """The allowed values of an option; `contains(value)`: whether a value is allowed; `words`: all of them in words."""

    contains: Callable[[Any], bool]
    words: str


NONNEGATIVE = Range(lambda x: x >= 0, "a number of at least 0")


def one_of(*words: str) -> Range:
    """Return the range of these words."""
    return Range(words.__contains__, ", ".join(words))


class Verdict(enum.StrEnum):
    """The verdict of a method on two images; the worst first."""

    DIFFERENT = "different"
    INCONCLUSIVE = "inconclusive"
    EQUAL = "equal"


@dataclass(frozen=True)
class Metric:
    """A number that a method measured; if it has a bound, `value <= bound` holds for equal images."""

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

    `minimum_detectable`: the smallest relative difference that the method would have detected; NaN if unknown. `maps`:
    arrays by name, H × W or H × W × C, of the images' size. `warning`: a bound for warnings that an equal image
    exceeds. `part`: for files of several images, the number of the compared part and of its MIP level. `chosen`: why
    `auto` chose the method.
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
        """Return the result with another verdict, and the reason for it before the present one."""
        return replace(self, verdict=verdict, reason=f"{reason}; {self.reason}")

    @property
    def method_in_words(self) -> str:
        """The method, and why `auto` chose it: "welch (the variance of both is known)"."""
        return f"{self.method} ({self.chosen})" if self.chosen else self.method


def verdict_of(metrics: Sequence[Metric]) -> Verdict:
    """Return EQUAL if every metric is within its bound, else DIFFERENT."""
    return Verdict.EQUAL if all(metric.holds for metric in metrics) else Verdict.DIFFERENT


def preconditions(reference: Image, test: Image, allow_nonfinite: bool = False) -> str:
    """Return why the images differ before any method is applied: the number and place of values that are not finite.

    "" if all are finite. With `allow_nonfinite` such a value is allowed if the other image has the same one there: NaN,
    Inf or -Inf. ValueError if the images cannot be compared, see `aligned`.
    """
    a, b = aligned(reference, test)
    finite_a, finite_b = np.isfinite(a), np.isfinite(b)
    if finite_a.all() and finite_b.all():
        return ""
    if allow_nonfinite:
        different = ~(finite_a & finite_b) & ~((a == b) | (np.isnan(a) & np.isnan(b)))
        if not different.any():
            return ""
        return f"not finite in one image only, or not the same value: {_located(reference, a, different)}"
    texts = _located(reference, a, ~finite_a), _located(replace(test, channels=reference.channels), b, ~finite_b)
    return "; ".join(filter(None, texts))


def aligned(reference: Image, test: Image) -> tuple[Pixels, Pixels]:
    """Return the pixels of both, with the channels in the reference's order.

    ValueError if they differ in size, in names of channels, or in the position, aspect ratio or orientation of pixels
    by their headers.
    """
    ratios = [image.metadata.get("PixelAspectRatio", 1.0) for image in (reference, test)]
    same_ratio = all(isinstance(x, float | int) for x in ratios) and math.isclose(*ratios, rel_tol=ASPECT)
    for name, text_of in HEADER.items():
        expected, actual = text_of(reference), text_of(test)
        if expected != actual and not (name == "pixel aspect ratio" and same_ratio):
            hint = "; or `channels`: those to compare" if name == "channels" else ""
            raise ValueError(f"{test.path}: {name} {actual}; expected {expected}, as in {reference.path}{hint}")
    same_order = reference.channels == test.channels
    return reference.pixels, test.pixels if same_order else test.select(reference.channels)


def as_shown(image: Image, names: Collection[str]) -> Image:
    """Return the image with those channels of `names` that files may omit: an alpha of 1, and R = G = B for a gray Y.

    In pixels that a mask excludes, alpha is 0 like all channels.
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
    """Return how omitted channels are read, if only one image has them and all pixels are identical then; else ""."""
    if not (unshared := set(reference.channels) ^ set(test.channels)):
        return ""
    one, two = as_shown(reference, test.channels), as_shown(test, reference.channels)
    comparable = one.pixels.shape == two.pixels.shape and set(one.channels) == set(two.channels)
    if not comparable or not np.array_equal(one.pixels, two.select(one.channels), equal_nan=True):
        return ""
    readings = {"A": "a missing alpha is read as 1", "Y": "gray is read as R = G = B"}
    return "; ".join(words for name, words in readings.items() if name in unshared)


def shared_channels(reference: Image, test: Image) -> tuple[Image, Image, str]:
    """Return both images with the channels that both have, and a text about those that only one has; "" if none.

    If each image has channels that the other lacks, both are returned unchanged with "": they cannot be compared.
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


def groups(names: Sequence[str]) -> dict[str, list[str]]:
    """Return groups of channels that are judged together: the colours of each layer; every other channel separately."""
    groups: dict[str, list[str]] = {}
    for name in names:
        layer, dot, last = name.rpartition(".")
        together = last in ("R", "G", "B", "X", "Y") or (last == "Z" and dot)  # a layer's X, Y, Z are a vector
        groups.setdefault(layer + dot if together else name, []).append(name)
    return groups


def only(image: Image, names: Sequence[str]) -> Image:
    """Return the image with these channels only."""
    return replace(image, pixels=image.select(names), channels=tuple(names))


def finite(pixels: Pixels) -> Pixels:
    """Return the pixels with 0 for values that are not finite."""
    return pixels if np.isfinite(pixels).all() else np.nan_to_num(pixels, posinf=0, neginf=0)


def counted(image: Image) -> int:
    """Return the number of pixels that are compared; all without a mask."""
    return image.pixels[..., 0].size if image.mask is None else int(image.mask.sum())


def passes_black(method: Callable[..., Comparison], views: Iterable[tuple[Image, Mapping[str, Any]]]) -> bool:
    """Return whether a method calls black different from none of these images, each with its options."""
    black = ((image, replace(image, pixels=np.zeros_like(image.pixels)), options) for image, options in views)
    return all(method(a, b, **options).verdict is not Verdict.DIFFERENT for a, b, options in black)


def nonfinite_result(method: str, reason: str, *pixels: Pixels) -> Comparison:
    """Return the verdict DIFFERENT for images with values that are not finite; the map "nonfinite" marks them."""
    count = sum((~np.isfinite(x) for x in pixels), np.zeros(pixels[0].shape, np.float32))
    metrics = (Metric("values that are not finite", float(count.sum()), 0.0),)
    return Comparison(method, Verdict.DIFFERENT, reason, metrics, maps={"nonfinite": (count > 0).astype(np.float32)})


def place(values: NDArray[np.bool_] | Pixels, image: Image) -> str:
    """Return the pixel and channel of the largest of the `values`, H × W × C: "x = 3, y = 5, channel R"."""
    y, x, c = np.unravel_index(int(values.argmax()), values.shape)
    return f"x = {x + image.origin[0]}, y = {y + image.origin[1]}, channel {image.channels[c]}"


def _located(image: Image, values: Pixels, marked: NDArray[np.bool_]) -> str:
    """Return the numbers of NaN and Inf among the marked values and the place of the first; "" if none is marked."""
    if not marked.any():
        return ""
    kinds = {"NaN": np.isnan(values[marked]).sum(), "Inf": np.isinf(values[marked]).sum()}
    counts = ", ".join(f"{count} {kind}" for kind, count in kinds.items() if count) or f"{marked.sum()} finite"
    return f"{image.path}: {counts}, the first at {place(marked, image)}"


def require_window(file: Image, image: Image, kind: str) -> None:
    """Raise ValueError unless a file, such as a mask, has the size of the image and shows the same part of the frame.

    `kind`: of the file, for the error. A file that is a whole frame, such as a PNG file, has no place of its own.
    """
    size, part = HEADER["size"], HEADER["data window"]
    if size(file) != size(image):
        raise ValueError(f"{file.path}: {size(file)}; expected a {kind} of {size(image)}")
    is_frame = file.origin == (0, 0) and file.display in (None, (0, 0, *file.pixels.shape[1::-1]))
    if file.origin != image.origin and not is_frame:
        raise ValueError(f"{file.path}: data window {part(file)}; expected that of {image.path}: {part(image)}")


HEADER: dict[str, Callable[[Image], str]] = {  # properties that must be equal, as text
    "size": lambda image: f"{image.pixels.shape[1]} × {image.pixels.shape[0]}",
    "channels": lambda image: ", ".join(sorted(image.channels)),
    "data window": lambda image: "from x = {}, y = {}".format(*image.origin),
    "display window": lambda image: "{2} × {3} from x = {0}, y = {1}".format(
        *(image.display or (*image.origin, *image.pixels.shape[1::-1]))
    ),
    "pixel aspect ratio": lambda image: str(image.metadata.get("PixelAspectRatio", 1.0)),
    "orientation": lambda image: str(image.metadata.get("Orientation", 1)),
}

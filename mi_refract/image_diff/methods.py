"""The table of methods, and `compare`, which applies one of them to two images.

A method that calls two images equal must have been able to see a difference. So `compare` tests whether it would also
have called the reference equal to black: for each group of channels that belong together, as a bright alpha or depth
says nothing of a dim colour, and in each pixel.
"""

from __future__ import annotations

import functools
import inspect
import typing
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from mi_refract.io.image_file import Image, Pixels, any_channel

from . import channels, flip, metadata, pixel_statistics, pixelwise, welch
from .comparison import (
    NONNEGATIVE,
    Comparison,
    Range,
    Verdict,
    aligned,
    as_shown,
    finite,
    identical_as_shown,
    nonfinite_result,
    only,
    passes_black,
    preconditions,
    shared_channels,
)

AUTO = "auto"
CHOSEN_BY_AUTO = ("welch", "tolerance")
NOT_FOR_NOISE = ("tolerance", "flip")  # methods that take noise for a difference
OTHER_NOISE = "these two look like the same image with other noise: --method welch with several renders decides"
DECIDING = {"hard_fail", "allow_failures"}  # options that say by how much a single pixel may differ
UNSEEN = 0.1  # share of the lit pixels that may differ so that black would be accepted there, too
CLOSER = 100.0  # where the test image is so many times closer to the reference than black is, it is no black
LOST = 0.5  # a pixel that changes by more than this share of the brighter one may as well be black
ROW_STEP = 16  # every so many rows show whether a method would see that an image is black

Side = Image | Sequence[Image]
Options = Mapping[str, Any]


@dataclass(frozen=True)
class Option:
    """A keyword argument of a method; without a `range` numbers are at least 0."""

    name: str
    type: type
    default: Any
    help: str
    range: Range = NONNEGATIVE

    def checked(self, method: str, value: Any) -> Any:
        """The value of the option; ValueError for one of another type or out of its range."""
        if isinstance(value, bool) or not isinstance(value, (int, float) if self.type is float else self.type):
            raise ValueError(f"{method}: {self.name} = {value!r}; expected a value of type {self.type.__name__}")
        if not self.range.contains(value):
            raise ValueError(f"{method}: {self.name} = {value!r}; expected {self.range.words}")
        return self.type(value)


@dataclass(frozen=True)
class Method:
    """A method of comparison.

    `function(reference, test, **options)` takes one image a side, of the same channels in the same order, with finite
    values; where `takes_renders`, a sequence of independent renders, as they are. `views(image, options)`: of an image
    those parts, the last the whole, that are compared with black; None where black never passes. `accepts(pixels,
    others, options)`: in which pixels the others pass; None where pixels are not judged alone, nor channels in groups.
    `looks_at(reference, test)`: groups of channels, of which it compares one at a time; None for all of them at once.
    Other channels are compared by `tolerance`.
    """

    function: Callable[..., Comparison]
    views: Callable[[Image, Options], Iterable[Image]] | None = None
    accepts: Callable[[Pixels, Pixels, Options], NDArray[np.bool_]] | None = None
    takes_renders: bool = False
    looks_at: Callable[[Image, Image], list[list[str]]] | None = None

    @property
    def summary(self) -> str:
        """The first line of the function's docstring."""
        return (self.function.__doc__ or "").partition("\n")[0]

    @functools.cached_property
    def options(self) -> dict[str, Option]:
        """The keyword arguments by name, without those of every method."""
        hints = typing.get_type_hints(self.function, include_extras=True)
        parameters = inspect.signature(self.function).parameters
        return {
            name: Option(name, typing.get_args(hint)[0], parameters[name].default, *hint.__metadata__)
            for name, hint in hints.items()
            if typing.get_origin(hint) is Annotated
        }


def _rows(image: Image, options: Options) -> tuple[Image, Image]:
    """Where black would be seen in some of the rows, the others need not be looked at: pixels are judged alone."""
    return replace(image, pixels=image.pixels[::ROW_STEP]), image


METHODS = {
    "exact": Method(pixelwise.exact),
    "tolerance": Method(pixelwise.tolerance, _rows, pixelwise.tolerance_accepts),
    "paired": Method(pixelwise.paired, _rows, pixelwise.paired_accepts),
    "welch": Method(welch.compare_renders, takes_renders=True),
    "flip": Method(flip.flip, flip.views, looks_at=flip.looks_at),
}


def options_of_auto() -> dict[str, Option]:
    """The options of the methods that "auto" chooses from; each is used where its method is chosen."""
    return {name: option for method in CHOSEN_BY_AUTO for name, option in METHODS[method].options.items()}


def choice(reference: Sequence[Image], test: Sequence[Image], *, spp: bool = False) -> tuple[str, str]:
    """The method that "auto" is for these images, and why it is that one; "" for `tolerance`, which needs no reason.

    It is `welch` where a side has several renders, or its variance is known. `spp`: whether an option says how many
    samples per pixel there are. A render of `mi-refract render` always holds its variance: beside an image of somebody
    else, of which nothing is known, it is compared as that is.
    """
    if max(len(reference), len(test)) > 1:
        return "welch", "several renders"
    known = [any(map(channels.has_variance, side)) for side in (reference, test)]
    if all(known):
        return "welch", "the variance of both is known"
    if any(known):
        (one,), (two,) = (reference, test) if known[0] else (test, reference)
        name, other = ("reference", "new image") if known[0] else ("new image", "reference")
        if not one.variances and channels.SPP in one.metadata and not spp and channels.SPP not in two.metadata:
            return "tolerance", f"the {other} has neither a variance nor samples per pixel"
        return "welch", f"the variance of the {name} is known"
    return "tolerance", ""


def compare(
    method: str,
    reference: Side,
    test: Side,
    *,
    allow_nonfinite: bool = False,
    ignore_metadata: Sequence[str] = (),
    named: Collection[str] = (),
    **options: Any,
) -> Comparison:
    """Compare two images, or two sequences of renders of one image, by a method of the table.

    "auto" is `welch` where it can be, else `tolerance`; options of the other one are accepted and not used. There one
    outrageous pixel is a difference, too, unless `hard_fail` or `allow_failures` say what a pixel may do. Channels
    NAME.variance are what `welch` reads of single images, and otherwise left out, but for those that are `named`.

    INCONCLUSIVE where a method calls the images equal but would call a black one equal, too, or one with some of its
    channels black, or passes many pixels that change by half; where channels whose variance `welch` does not know
    differ by more than `tolerance` allows; and where no value of a channel is finite. DIFFERENT where one of two images
    has channels besides, unless they are `identical_as_shown`, and where the files say that their numbers mean
    something else; `ignore_metadata`: patterns of names of metadata that do not count.

    ValueError for an unknown method or option, an option of another type or out of its range, several renders for a
    method that takes one, and images that cannot be compared.
    """
    if method != AUTO and method not in METHODS:
        raise ValueError(f"method {method!r}; expected {AUTO}, {', '.join(METHODS)}")
    known = options_of_auto() if method == AUTO else METHODS[method].options
    if unknown := options.keys() - known.keys():
        raise ValueError(f"{method} has no option {min(unknown)!r}; expected {', '.join(known) or 'none'}")
    options = {name: known[name].checked(method, value) for name, value in options.items()}
    sides = [[side] if isinstance(side, Image) else list(side) for side in (reference, test)]
    for image in (*sides[0], *sides[1]):
        if len(set(image.channels)) < len(image.channels):
            raise ValueError(f"{image.path}: channels {', '.join(image.channels)}; expected each name once")
    why = ""
    if by_auto := method == AUTO:
        method, why = choice(*sides, spp=any(options.get(name) for name in ("spp", "spp_reference", "spp_test")))
        options = {name: value for name, value in options.items() if name in METHODS[method].options}
    result = replace(_compare(method, sides, allow_nonfinite, named, options), chosen=why)
    changed = by_auto and method == "tolerance" and result.is_equal and result.metrics[0].value > 0
    if changed and not options.keys() & DECIDING:
        a, b = _finite_pair(*(channels.without_variances(side[0], named) for side in sides))
        if where := pixelwise.outrageous(a, b, options.get("fail", METHODS[method].options["fail"].default)):
            result = result.but(Verdict.DIFFERENT, f"one pixel is far too bright: {where}")
    if meant := metadata.difference([*sides[0], *sides[1]], ignore_metadata):
        return replace(result.but(Verdict.DIFFERENT, meant), warning="")
    return result


def _compare(
    method: str, sides: list[list[Image]], allow_nonfinite: bool, named: Collection[str], options: Options
) -> Comparison:
    chosen = METHODS[method]
    if not all(sides):
        raise ValueError(f"{method}: no image on one side; expected at least one")
    bare = [[channels.without_variances(image, named) for image in side] for side in sides]
    single = len(bare[0]) == len(bare[1]) == 1
    whole = sides if chosen.takes_renders else bare
    if single and (reading := identical_as_shown(one := whole[0][0], two := whole[1][0])):
        alike = [[as_shown(one, two.channels)], [as_shown(two, one.channels)]]
        result = _compare(method, alike, allow_nonfinite, named, options)
        return replace(result, reason=f"{result.reason}; {reading}")
    if chosen.takes_renders:
        result = chosen.function(*(whole if single else bare), allow_nonfinite=allow_nonfinite, **options)
        if single and result.is_equal and (untested := channels.untested(sides[0][0], sides[1][0])):
            by_tolerance = compare("tolerance", *untested, allow_nonfinite=allow_nonfinite)
            if not by_tolerance.is_equal:
                doubt = f"not tested, without variance: {', '.join(untested[0].channels)}: {by_tolerance.reason}"
                return result.but(Verdict.INCONCLUSIVE, doubt)
    elif not single:
        raise ValueError(f"{method}: {len(bare[0])} and {len(bare[1])} images; expected one per side")
    else:
        a, b, besides = shared_channels(bare[0][0], bare[1][0])
        if reason := preconditions(a, b, allow_nonfinite):
            result = nonfinite_result(method, reason, *aligned(a, b))
        else:
            a, b = _finite_pair(a, b)
            result = _of_finite(method, a, b, options)
            may_be_noise = method in NOT_FOR_NOISE and result.verdict is Verdict.DIFFERENT
            if may_be_noise and pixel_statistics.differ_like_noise(a.pixels, b.pixels):
                result = replace(result, reason=f"{result.reason}; {OTHER_NOISE}")
        if besides:
            reason = f"{besides}; the other channels: {result.reason}"
            return replace(result, verdict=Verdict.DIFFERENT, reason=reason, warning="")
    if not result.is_equal or (is_finite := np.isfinite(bare[0][0].pixels)).all():
        return result
    names = bare[0][0].channels
    if empty := [name for name, some in zip(names, is_finite.any((0, 1)), strict=True) if not some]:
        return result.but(Verdict.INCONCLUSIVE, f"no value is finite, and nothing was compared, in {', '.join(empty)}")
    count = int(is_finite.size - is_finite.sum())
    return replace(result, reason=f"{result.reason}; not compared: {count} of {is_finite.size} values, not finite")


def _finite_pair(reference: Image, test: Image) -> tuple[Image, Image]:
    """Both images with the channels in the reference's order, and 0 for what is not finite."""
    a, b = (finite(pixels) for pixels in aligned(reference, test))
    return replace(reference, pixels=a), replace(test, pixels=b, channels=reference.channels)


def _of_finite(method: str, a: Image, b: Image, options: Options) -> Comparison:
    """The result of a method, and of `tolerance` for the channels that the method does not look at.

    INCONCLUSIVE where black would pass. Both images are finite and have the same channels in the same order.
    """
    looks_at = METHODS[method].looks_at
    parts = looks_at(a, b) if looks_at else [list(a.channels)]
    others = [name for name in a.channels if not any(name in part for part in parts)]
    result: Comparison | None = None
    for by, names in [*((method, part) for part in parts), *([("tolerance", others)] if others else [])]:
        one, two = only(a, names), only(b, names)
        how = options if by == method else {}
        if result and np.array_equal(one.pixels, two.pixels):
            comparison = Comparison(by, Verdict.EQUAL, "identical")
        else:
            comparison = METHODS[by].function(one, two, **how)
        if comparison.is_equal and (doubt := blind_to(METHODS[by], one, two, how)):
            comparison = comparison.but(Verdict.INCONCLUSIVE, doubt)
        if result is None:
            result = comparison
            continue
        listed = ", ".join(names)
        bounded = (replace(x, name=f"{x.name}, in {listed}") for x in comparison.metrics if x.bound is not None)
        result = replace(
            result,
            verdict=min(result.verdict, comparison.verdict, key=[*Verdict].index),
            reason=f"{result.reason}; by {by} {listed}: {comparison.reason}",
            metrics=(*result.metrics, *bounded),
            maps=result.maps | {f"{name} of {listed}": x for name, x in comparison.maps.items() if name == by},
        )
    assert result is not None  # an image has channels
    return result


# Would black pass? -----------------------------------------------------------------------------------------------


def groups(names: Sequence[str]) -> dict[str, list[str]]:
    """Channels that are judged together: the colours of each layer; every other channel alone."""
    parts: dict[str, list[str]] = {}
    for name in names:
        layer, dot, last = name.rpartition(".")
        together = last in ("R", "G", "B", "X", "Y") or (last == "Z" and dot)  # a layer's X, Y, Z are a vector
        parts.setdefault(layer + dot if together else name, []).append(name)
    return parts


def blind_to(method: Method, a: Image, b: Image, options: Options) -> str:
    """What black would pass in, in place of the test image `b`; "" where a difference would have been seen.

    Of channels that are black in the reference: in place of that. Nothing is said of channels that are the same in both
    images. Both are finite and have the same channels in the same order.
    """
    if method.views is None:
        return ""
    options = {name: option.default for name, option in method.options.items()} | dict(options)
    parts = list(groups(a.channels).values()) if method.accepts else [list(a.channels)]
    for names in parts:
        one, two = only(a, names), only(b, names)
        if not one.pixels.any():
            one, two = two, one
        if np.array_equal(one.pixels, two.pixels):
            continue
        of = f" in {', '.join(names)}," if len(parts) > 1 else ""
        if passes_black(method.function, method.views(one, options), options):
            return f"an all-black image would pass, too,{of} with these options"
        if method.accepts is None:
            continue
        size, other, change = np.abs(one.pixels), np.abs(two.pixels), np.abs(two.pixels - one.pixels)
        lit = any_channel(size > 0)
        far = lit & any_channel(change > size / CLOSER)
        if far.sum() > UNSEEN * lit.sum():  # or else too few are unseen
            lost = change.max(-1) > LOST * np.maximum(size, other).max(-1)
            lost &= method.accepts(one.pixels, two.pixels, options)
            black = method.accepts(one.pixels, np.zeros_like(size), options)
            share = float((far & (black | lost)).sum() / lit.sum())
            if share > UNSEEN:
                where = f"in {share:.0%} of the pixels that are not black,"
                return f"black or a change by half would pass, too,{of} {where} with these options"
    return ""

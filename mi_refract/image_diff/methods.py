"""The table of methods, and `compare`, which applies one of them to two images.

A method that calls two images equal must have been able to detect a difference. So `compare` tests whether the method
would also have called a black image equal to the reference. It tests each group of channels that belong together,
because a bright alpha or depth says nothing about a dim colour, and it counts the pixels in which black would pass.
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
    groups,
    identical_as_shown,
    nonfinite_result,
    only,
    passes_black,
    preconditions,
    shared_channels,
)

AUTO = "auto"
CHOSEN_BY_AUTO = ("welch", "tolerance")
NOT_FOR_NOISE = ("tolerance", "flip")  # methods that report noise as a difference
OTHER_NOISE = "these two look like the same image with other noise: --method welch with several renders decides"
DECIDING = {"hard_fail", "allow_failures"}  # options that limit the difference of a single pixel
UNSEEN = 0.1  # share of the lit pixels that may differ and where the method would accept black, too
CLOSER = 100.0  # a pixel that is so many times closer to the reference than black is counts as not different
LOST = 0.5  # a pixel that changes by more than this share of the brighter one counts as black

Side = Image | Sequence[Image]
Options = Mapping[str, Any]


@dataclass(frozen=True)
class Option:
    """A keyword argument of a method; by default numbers are at least 0."""

    name: str
    type: type
    default: Any
    help: str
    range: Range = NONNEGATIVE

    def checked(self, method: str, value: Any) -> Any:
        """Return the value in the type of the option; ValueError for another type, and outside of the range."""
        if isinstance(value, bool) or not isinstance(value, (int, float) if self.type is float else self.type):
            raise ValueError(f"{method}: {self.name} = {value!r}; expected a value of type {self.type.__name__}")
        if not self.range.contains(value):
            raise ValueError(f"{method}: {self.name} = {value!r}; expected {self.range.words}")
        return self.type(value)


@dataclass(frozen=True)
class Method:
    """A method of comparison.

    - `function(reference, test, **options)`: takes one image a side, with the same channels in the same order and
      finite values. If `takes_renders`, it takes a sequence of independent renders a side, unchanged.
    - `views(image, options)`: yields the parts of an image that are compared with black and the options for that, the
      whole image last. If black is detected in a part, it is in the whole image. None: black never passes.
    - `accepts(pixels, others, options)`: returns the pixels in which `others` pass, H × W. None: pixels and groups of
      channels are not judged separately.
    - `looks_at(reference, test)`: returns groups of channels, each of which is compared separately. Channels in no
      group are compared by `tolerance`. None: all channels are compared at once.
    """

    function: Callable[..., Comparison]
    views: Callable[[Image, Options], Iterable[tuple[Image, Options]]] | None = None
    accepts: Callable[[Pixels, Pixels, Options], NDArray[np.bool_]] | None = None
    takes_renders: bool = False
    looks_at: Callable[[Image, Image], list[list[str]]] | None = None

    @property
    def summary(self) -> str:
        """The first line of the function's docstring."""
        return (self.function.__doc__ or "").partition("\n")[0]

    @functools.cached_property
    def options(self) -> dict[str, Option]:
        """The options by name, without those that all methods share."""
        hints = typing.get_type_hints(self.function, include_extras=True)
        parameters = inspect.signature(self.function).parameters
        return {
            name: Option(name, typing.get_args(hint)[0], parameters[name].default, *hint.__metadata__)
            for name, hint in hints.items()
            if typing.get_origin(hint) is Annotated
        }


METHODS = {
    "exact": Method(pixelwise.exact),
    "tolerance": Method(pixelwise.tolerance, pixelwise.tolerance_views, pixelwise.tolerance_accepts),
    # Whole images only: the share of pixels that may differ is one of all pixels.
    "paired": Method(pixelwise.paired, lambda image, options: [(image, options)], pixelwise.paired_accepts),
    "welch": Method(welch.compare_renders, takes_renders=True),
    "flip": Method(flip.flip, flip.views, looks_at=flip.looks_at),
}


def options_of_auto() -> dict[str, Option]:
    """Return the options of the methods that "auto" chooses from; each has an effect if its method is chosen."""
    return {name: option for method in CHOSEN_BY_AUTO for name, option in METHODS[method].options.items()}


def choice(reference: Sequence[Image], test: Sequence[Image], *, spp: bool = False) -> tuple[str, str]:
    """Return the method that "auto" chooses for these images, and the reason; "" for `tolerance` of ordinary images.

    It is `welch` if a side has several renders, or a known variance. `spp`: whether an option gives the samples per
    pixel. A render of `mi-refract render` always contains its variance; it is compared by `tolerance` with an image of
    another renderer, of which neither variance nor samples per pixel are known.
    """
    if max(len(reference), len(test)) > 1:
        return "welch", "several renders"
    known = [any(map(channels.has_variance, side)) for side in (reference, test)]
    if all(known):
        return "welch", "the variance of both is known"
    if any(known):
        (with_variance,), (without,) = (reference, test) if known[0] else (test, reference)
        name, other_name = ("reference", "new image") if known[0] else ("new image", "reference")
        is_own_render = not with_variance.variances and channels.SPP in with_variance.metadata
        if is_own_render and not spp and channels.SPP not in without.metadata:
            return "tolerance", f"the {other_name} has neither a variance nor samples per pixel"
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

    "auto" is `welch` if variances are known, see `choice`, else `tolerance`. Options of the other one are accepted;
    those of `tolerance` are also used for channels without variance beside others that have one. With "auto", one
    `outrageous` pixel makes images different by `tolerance`, unless `hard_fail` or `allow_failures` is set. `named`:
    the channels to compare; empty: all, except NAME.variance beside NAME. `welch` also reads the variances of single
    images from their other channels.

    The verdict is INCONCLUSIVE if a method calls the images equal but would also call a black image equal, or one with
    a group of channels black, or accepts many pixels that change by half; if channels whose variance `welch` does not
    know differ by more than `tolerance` allows; and if no value of a channel is finite. It is DIFFERENT if one image
    has channels that the other lacks, unless the two are `identical_as_shown`, and if metadata differ that change the
    meaning of the values; `ignore_metadata`: patterns of names of metadata that are not compared.

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
    chosen_because, by_auto = "", method == AUTO
    if by_auto:
        has_spp = any(options.get(name) for name in ("spp", "spp_reference", "spp_test"))
        method, chosen_because = choice(*sides, spp=has_spp)
    with np.errstate(all="warn", under="ignore"):  # NumPy's defaults: no error where a p-value underflows
        result = replace(_compare(method, sides, allow_nonfinite, named, options), chosen=chosen_because)
    some_pixels_differ = by_auto and method == "tolerance" and result.is_equal and result.metrics[0].value > 0
    if some_pixels_differ and not options.keys() & DECIDING:
        a, b = _finite_pair(*(channels.without_variances(side[0], named) for side in sides))
        if pixel := pixelwise.outrageous(a, b, options.get("fail", METHODS[method].options["fail"].default)):
            result = result.but(Verdict.DIFFERENT, f"one pixel is far too bright: {pixel}")
    if different_metadata := metadata.difference([*sides[0], *sides[1]], ignore_metadata):
        return replace(result.but(Verdict.DIFFERENT, different_metadata), warning="")
    return result


def _compare(
    method: str, sides: list[list[Image]], allow_nonfinite: bool, named: Collection[str], options: Options
) -> Comparison:
    """Return the result of a method. `options`: of the method, and of the one that compares the untested channels."""
    takes_renders, function = METHODS[method].takes_renders, METHODS[method].function
    all_options, options = options, {name: options[name] for name in options if name in METHODS[method].options}
    if not all(sides):
        raise ValueError(f"{method}: no image on one side; expected at least one")
    means = [[channels.without_variances(image, named) for image in side] for side in sides]
    single = len(sides[0]) == len(sides[1]) == 1
    compared = sides if takes_renders and single else means
    one, two = compared[0][0], compared[1][0]
    if single and (reading := identical_as_shown(one, two)):
        alike = [[as_shown(one, two.channels)], [as_shown(two, one.channels)]]
        result = _compare(method, alike, allow_nonfinite, named, all_options)
        return replace(result, reason=f"{result.reason}; {reading}")
    shared, unshared = _shared(compared, takes_renders and single)
    if unshared:
        result = _compare(method, shared, allow_nonfinite, named, all_options)
        reason = f"{unshared}; the other channels: {result.reason}"
        return replace(result, verdict=Verdict.DIFFERENT, reason=reason, warning="")
    if takes_renders:
        result = function(*compared, allow_nonfinite=allow_nonfinite, **options)
        if single and result.is_equal and (untested := channels.untested(one, two)):
            more: Options = {"allow_nonfinite": allow_nonfinite, "ignore_metadata": ["*"], **all_options}
            by_tolerance = compare(AUTO, *untested, **more)
            if not by_tolerance.is_equal:
                doubt = f"not tested, without variance: {', '.join(untested[0].channels)}: {by_tolerance.reason}"
                return result.but(Verdict.INCONCLUSIVE, doubt)
    elif not single:
        raise ValueError(f"{method}: {len(sides[0])} and {len(sides[1])} images; expected one per side")
    elif reason := preconditions(one, two, allow_nonfinite):
        result = nonfinite_result(method, reason, *aligned(one, two))
    else:
        result = _compare_by_steps(method, one, two, options)
        may_be_noise = method in NOT_FOR_NOISE and result.verdict is Verdict.DIFFERENT
        if may_be_noise and pixel_statistics.differ_like_noise(*(x.pixels for x in _finite_pair(one, two))):
            result = replace(result, reason=f"{result.reason}; {OTHER_NOISE}")
    is_finite = np.isfinite(means[0][0].pixels)
    if not result.is_equal or is_finite.all():
        return result
    by_channel = zip(means[0][0].channels, is_finite.any((0, 1)), strict=True)
    if nonfinite := [name for name, any_finite in by_channel if not any_finite]:
        reason = f"no value is finite, and nothing was compared, in {', '.join(nonfinite)}"
        return result.but(Verdict.INCONCLUSIVE, reason)
    count = int(is_finite.size - is_finite.sum())
    return replace(result, reason=f"{result.reason}; not compared: {count} of {is_finite.size} values, not finite")


def _shared(sides: list[list[Image]], with_variances: bool) -> tuple[list[list[Image]], str]:
    """Return the sides with the channels that both have, and a text about those that only one has; "" if none.

    `with_variances`: channels that contain variances are not compared, but belong to others. ValueError if a further
    image of a side lacks one of the channels.
    """
    one, two = sides[0][0], sides[1][0]
    if not with_variances:
        shared, _, unshared = shared_channels(one, two)
        return [[only(image, shared.channels) for image in side] for side in sides] if unshared else sides, unshared
    pair = channels.matched(one, two)
    shared, _, unshared = shared_channels(*(only(image, channels.means(image.channels)) for image in pair))
    names = {name: name for name in shared.channels}
    return [[channels.selected(image, names)] for image in pair] if unshared else sides, unshared


def _finite_pair(reference: Image, test: Image) -> tuple[Image, Image]:
    """Return both images with the channels in the reference's order, and 0 for values that are not finite.

    Both have the same values that are not finite. The mask then also excludes the pixels without a finite value, unless
    it would exclude all.
    """
    a, b = aligned(reference, test)
    is_finite, mask = np.isfinite(a), reference.mask
    if not is_finite.all():
        compared = any_channel(is_finite) if mask is None else any_channel(is_finite) & mask
        mask = compared if compared.any() else mask
    one, two = replace(reference, pixels=finite(a), mask=mask), replace(test, pixels=finite(b), mask=mask)
    return one, replace(two, channels=reference.channels)


def _compare_by_steps(method: str, a: Image, b: Image, options: Options) -> Comparison:
    """Return the result of a method, and of `tolerance` for the channels that the method does not compare.

    INCONCLUSIVE if black would pass. Both images have the same channels; values that are not finite are not compared.
    """
    looks_at = METHODS[method].looks_at
    groups_of_method = looks_at(*_finite_pair(a, b)) if looks_at else [list(a.channels)]
    others = [name for name in a.channels if not any(name in group for group in groups_of_method)]
    steps = [(method, group) for group in groups_of_method] + ([("tolerance", others)] if others else [])
    result: Comparison | None = None
    for by, names in steps:
        one, two = _finite_pair(only(a, names), only(b, names))
        options_of_step = options if by == method else {}
        if result and np.array_equal(one.pixels, two.pixels):
            comparison = Comparison(by, Verdict.EQUAL, "identical")
        else:
            comparison = METHODS[by].function(one, two, **options_of_step)
        if comparison.is_equal and (doubt := blind_to(METHODS[by], one, two, options_of_step)):
            comparison = comparison.but(Verdict.INCONCLUSIVE, doubt)
        if result is None:
            result = comparison
            continue
        listed = ", ".join(names)
        bounded = [replace(m, name=f"{m.name}, in {listed}") for m in comparison.metrics if m.bound is not None]
        maps = result.maps | {f"{name} of {listed}": x for name, x in comparison.maps.items() if name == by}
        verdict = min(result.verdict, comparison.verdict, key=[*Verdict].index)
        reason = f"{result.reason}; by {by} {listed}: {comparison.reason}"
        result = replace(result, verdict=verdict, reason=reason, metrics=(*result.metrics, *bounded), maps=maps)
    assert result is not None  # an image has channels
    return result


# Would black pass? -----------------------------------------------------------------------------------------------


def blind_to(method: Method, a: Image, b: Image, options: Options) -> str:
    """Return why the method could not have detected a difference: where it accepts black; "" if it could have.

    Black replaces the test image `b`, or the reference `a` in channels in which that is black. Channels that are
    identical in both images are skipped. Both images are finite and have the same channels in the same order.
    """
    if method.views is None:
        return ""
    options = {name: option.default for name, option in method.options.items()} | dict(options)
    separate = list(groups(a.channels).values()) if method.accepts else [list(a.channels)]
    for names in separate:
        one, two = only(a, names), only(b, names)
        if not one.pixels.any():
            one, two = two, one
        if np.array_equal(one.pixels, two.pixels):
            continue
        in_channels = f" in {', '.join(names)}," if len(separate) > 1 else ""
        if passes_black(method.function, method.views(one, options)):
            return f"an all-black image would pass, too,{in_channels} with these options"
        if method.accepts is None:
            continue
        size, other, change = np.abs(one.pixels), np.abs(two.pixels), np.abs(two.pixels - one.pixels)
        lit = any_channel(size > 0)
        changed = lit & any_channel(change > size / CLOSER)
        if changed.sum() > UNSEEN * lit.sum():
            lost = change.max(-1) > LOST * np.maximum(size, other).max(-1)
            lost &= method.accepts(one.pixels, two.pixels, options)
            accepts_black = method.accepts(one.pixels, np.zeros_like(size), options)
            share = float((changed & (accepts_black | lost)).sum() / lit.sum())
            if share > UNSEEN:
                where = f"in {share:.0%} of the pixels that are not black,"
                return f"black or a change by half would pass, too,{in_channels} {where} with these options"
    return ""

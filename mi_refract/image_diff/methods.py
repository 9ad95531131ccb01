"""The table of methods, and `compare`, which applies one of them to two images."""

from __future__ import annotations

import functools
import inspect
import typing
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from mi_refract.io.image_file import Image
from mi_refract.io.pixels import Pixels

from . import black, channels, flip, pixelwise, tolerance, variances, welch
from .comparison import Comparison, Verdict, aligned, not_compared, shared_channels

AUTO = "auto"
DECIDING = {"hard_fail", "allow_failures"}  # options that say by how much a single pixel may differ

Side = Image | Sequence[Image]


@dataclass(frozen=True)
class Option:
    """A keyword argument of a method."""

    name: str
    type: type
    default: Any
    help: str


@dataclass(frozen=True)
class Method:
    """A method of comparison.

    `function(reference, test, **options)` takes one image a side; where `takes_renders`, a sequence of independent
    renders. `passes_black(reference, options)`: whether these options would let an all-black test image pass; None
    where that is impossible. `accepts_black(pixels, options)`: in which pixels; None where they are not judged alone.
    """

    function: Callable[..., Comparison]
    passes_black: black.PassesBlack | None = None
    accepts_black: black.AcceptsBlack | None = None
    takes_renders: bool = False

    @property
    def summary(self) -> str:
        """The first line of the function's docstring."""
        return (self.function.__doc__ or "").partition("\n")[0]

    @functools.cached_property
    def options(self) -> dict[str, Option]:
        """The keyword arguments by name, without `allow_nonfinite`, which every method has."""
        hints = typing.get_type_hints(self.function, include_extras=True)
        given = inspect.signature(self.function).parameters
        return {
            name: Option(name, typing.get_args(hint)[0], given[name].default, hint.__metadata__[0])
            for name, hint in hints.items()
            if typing.get_origin(hint) is Annotated
        }

    def checked(self, method: str, name: str, value: Any) -> Any:
        """The value of an option; ValueError for an unknown name or a value of another type."""
        if name not in self.options:
            raise ValueError(f"{method} has no option {name!r}; expected {', '.join(self.options) or 'none'}")
        kind = self.options[name].type
        if isinstance(value, bool) or not isinstance(value, (int, float) if kind is float else kind):
            raise ValueError(f"{method}: {name} = {value!r}; expected a value of type {kind.__name__}")
        return kind(value)


METHODS = {
    "exact": Method(pixelwise.exact),
    "tolerance": Method(tolerance.tolerance, tolerance.tolerance_passes_black, tolerance.tolerance_accepts_black),
    "paired": Method(pixelwise.paired, pixelwise.paired_passes_black, pixelwise.paired_accepts_black),
    "welch": Method(welch.compare_renders, takes_renders=True),
    "flip": Method(flip.flip, flip.flip_passes_black),
}


def compare(
    method: str,
    reference: Side,
    test: Side,
    *,
    allow_nonfinite: bool = False,
    named: Collection[str] = (),
    **options: Any,
) -> Comparison:
    """Compare two images, or two sequences of renders of one image, by a method of the table.

    "auto" is `welch` where it can be, else `tolerance`; options of the other one are accepted and not used. There one
    outrageous pixel is a difference, too, unless `hard_fail` or `allow_failures` say what a pixel may do. Channels
    NAME.variance are what `welch` reads of single images, and otherwise left out, but for those that are `named`.

    INCONCLUSIVE where a method calls the images equal but would call a black one equal, too, or one with some of its
    channels black; where channels whose variance `welch` does not know differ by more than `tolerance` allows; and
    where no value of a channel is finite. DIFFERENT where one of two images has channels besides.

    ValueError for an unknown method or option, an option of another type or out of its range, several renders for a
    method that takes one, and images that cannot be compared.
    """
    sides = [[side] if isinstance(side, Image) else list(side) for side in (reference, test)]
    if method == AUTO:
        method, why = choice(*sides, spp=any(options.get(name) for name in ("spp", "spp_reference", "spp_test")))
        options = {name: value for name, value in options.items() if name in METHODS[method].options or _unknown(name)}
        found = replace(_compare(method, sides, allow_nonfinite, named, options), chosen=why)
        failing = found.verdict is Verdict.EQUAL and found.metrics[0].value > 0
        if method == "tolerance" and failing and not options.keys() & DECIDING:
            a, b = (channels.without_variances(side[0], named) for side in sides)
            one, two = (replace(a, pixels=_finite(x)) for x in aligned(a, b))
            if far := tolerance.outrageous(
                one, replace(two, path=b.path), options.get("fail", METHODS[method].options["fail"].default)
            ):
                return replace(
                    found, verdict=Verdict.DIFFERENT, reason=f"one pixel is outrageous: {far}; {found.reason}"
                )
        return found
    return _compare(method, sides, allow_nonfinite, named, options)


def _compare(
    method: str,
    sides: list[list[Image]],
    allow_nonfinite: bool,
    named: Collection[str],
    options: Mapping[str, Any],
) -> Comparison:
    if method not in METHODS:
        raise ValueError(f"method {method!r}; expected {AUTO}, {', '.join(METHODS)}")
    chosen = METHODS[method]
    checked = {name: chosen.checked(method, name, value) for name, value in options.items()}
    if not all(sides):
        raise ValueError(f"{method}: no image on one side; expected at least one")
    one, two = bare = [[channels.without_variances(image, named) for image in side] for side in sides]
    single = len(one) == len(two) == 1
    if chosen.takes_renders:
        one, two = sides if single else bare
        found = chosen.function(one, two, allow_nonfinite=allow_nonfinite, **checked)
    elif not single:
        raise ValueError(f"{method}: {len(one)} and {len(two)} images; expected one a side")
    else:
        a, b, other = shared_channels(one[0], two[0])
        found = chosen.function(a, b, allow_nonfinite=allow_nonfinite, **checked)
        if other:
            return replace(found, verdict=Verdict.DIFFERENT, reason=f"{other}; the others: {found.reason}", warning="")
    if found.verdict is not Verdict.EQUAL:
        return found
    doubt = _untested(one, two, allow_nonfinite) if chosen.takes_renders else _blind_to(chosen, one[0], two[0], checked)
    if doubt:
        return replace(found, verdict=Verdict.INCONCLUSIVE, reason=f"{doubt}; {found.reason}")
    return _of_the_finite(found, bare[0][0])


def _of_the_finite(found: Comparison, reference: Image) -> Comparison:
    """The comparison with what it left out; INCONCLUSIVE where that is all of a channel."""
    count, empty = not_compared(reference) if found.verdict is Verdict.EQUAL else (0, [])
    if not count:
        return found
    if empty:
        reason = f"no value is finite, and nothing was compared, in {', '.join(empty)}; {found.reason}"
        return replace(found, verdict=Verdict.INCONCLUSIVE, reason=reason)
    return replace(found, reason=f"{found.reason}; not compared: {count} of {reference.pixels.size} values, not finite")


def _blind_to(method: Method, reference: Image, test: Image, options: dict[str, Any]) -> str:
    """What the method could not have seen. "" where both images are the same, or the reference is black."""
    if method.passes_black is None:
        return ""
    a, b = (replace(reference, pixels=_finite(x)) for x in aligned(reference, test))
    values = {name: option.default for name, option in method.options.items()} | options
    text = black.blind_to(a, b, values, method.passes_black, method.accepts_black)
    return text and f"{text} with these options"


def _finite(pixels: Pixels) -> Pixels:
    """The pixels with 0 for what is not finite."""
    return pixels if np.isfinite(pixels).all() else np.nan_to_num(pixels, posinf=0, neginf=0)


def _untested(reference: Sequence[Image], test: Sequence[Image], allow_nonfinite: bool) -> str:
    """Which channels of single images whose variance is known have none themselves, and are not equal without."""
    sides = variances.untested(reference[0], test[0]) if len(reference) == len(test) == 1 else []
    if not sides:
        return ""
    found = compare("tolerance", *sides, allow_nonfinite=allow_nonfinite)
    names = ", ".join(sides[0].channels)
    return "" if found.verdict is Verdict.EQUAL else f"not tested, without variance: {names}: {found.reason}"


CHOSEN_BY_AUTO = ("welch", "tolerance")


def options_of_auto() -> dict[str, Option]:
    """The options of the methods that "auto" chooses from; each is used where its method is chosen."""
    return {name: option for method in CHOSEN_BY_AUTO for name, option in METHODS[method].options.items()}


def _unknown(name: str) -> bool:
    return name not in options_of_auto()


def automatic(reference: Side, test: Side) -> str:
    """The method for these images: welch where a side has several renders, or its variance is known; else tolerance."""
    return choice(*([side] if isinstance(side, Image) else side for side in (reference, test)))[0]


def choice(reference: Sequence[Image], test: Sequence[Image], *, spp: bool = False) -> tuple[str, str]:
    """The method for these images, and why it is that one; "" for the one that needs no reason.

    `spp`: whether an option says how many samples per pixel there are. A render of `mi-refract render` holds its
    variance unasked: beside an image of somebody else, of which nothing is known, it is compared as that is.
    """
    if max(len(reference), len(test)) > 1:
        return "welch", "several renders"
    known = [any(map(variances.has_variance, side)) for side in (reference, test)]
    if all(known):
        return "welch", "the variance of both is known"
    if any(known):
        (one,), (two,) = (reference, test) if known[0] else (test, reference)
        name, other = ("reference", "new image") if known[0] else ("new image", "reference")
        if not one.variances and variances.SPP in one.metadata and not spp and variances.SPP not in two.metadata:
            return "tolerance", f"of the {other} neither variance nor samples per pixel are known"
        return "welch", f"the variance of the {name} is known"
    return "tolerance", ""

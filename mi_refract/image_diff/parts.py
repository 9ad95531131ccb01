"""Files of several images: every part and MIP level is compared with the one of the same number.

The verdict is the worst of them, with the place of the image that it is about. A part or level that only one of the
files has is a difference.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from mi_refract.io import image_file
from mi_refract.io.image_file import Image

from . import idiff_flags, methods
from .comparison import Comparison, Verdict
from .settings import ComparisonSpec

WORST = (Verdict.DIFFERENT, Verdict.INCONCLUSIVE, Verdict.EQUAL)
Part = tuple[int, int]


def read(path: Path, how: ComparisonSpec) -> list[Image]:
    """Every image of a file; with flags of `idiff` in the numbers that it compares, and without -a the first alone.

    Raises what `image_file.read_parts` raises.
    """
    if how.idiff is None:
        return image_file.read_parts(path, how.max_values)
    first_only = not idiff_flags.parse(how.idiff).every
    return image_file.read_parts(path, how.max_values, first_only=first_only, as_idiff=True)


def compare(
    how: ComparisonSpec, reference: Sequence[Image], test: Sequence[Image]
) -> tuple[Comparison, tuple[Image, Image]]:
    """The comparison of two files that were read whole, and the two images that it is about.

    ValueError as `methods.compare`, with the place of the image.
    """
    one, two = ({image.part: image for image in side} for side in (reference, test))
    both = [part for part in one if part in two]
    places = {part: one[part].place or two[part].place for part in both}
    found = {part: _of_one(how, one[part], two[part], places[part]) for part in both}
    shown = min(both, key=lambda part: WORST.index(found[part].verdict))
    images = one[shown], two[shown]
    chosen = replace(found[shown], reason=_reason(found, places, shown), part=shown)
    if lone := [*(one.keys() - two.keys()), *(two.keys() - one.keys())]:
        reason = f"{_lone(min(lone), one | two, min(lone) in one, len(lone))}; {chosen.reason}"
        return replace(chosen, verdict=Verdict.DIFFERENT, reason=reason, warning=""), images
    return replace(chosen, warning=_warning(found, places)), images


def _of_one(how: ComparisonSpec, one: Image, two: Image, place: str) -> Comparison:
    try:
        named = [name for name, _ in how.channels]
        return methods.compare(how.method, [one], [two], named=named, **how.options)
    except ValueError as error:
        raise ValueError(f"{error} ({place})" if place else str(error)) from None


def _reason(found: Mapping[Part, Comparison], places: Mapping[Part, str], shown: Part) -> str:
    """That of the image which is shown, with its place where the file holds others, and how many share its verdict."""
    chosen = found[shown]
    if not places[shown]:
        return chosen.reason
    if len(found) == 1:
        return f"{chosen.reason}; of several images in the file only {places[shown]} is compared"
    alike = sum(each.verdict is chosen.verdict for each in found.values())
    return f"{places[shown]}: {chosen.reason}; {chosen.verdict}: {alike} of {len(found)} parts and MIP levels"


def _lone(part: Part, images: Mapping[Part, Image], missing: bool, count: int) -> str:
    more = f", and {count - 1} more" if count > 1 else ""
    return f"{images[part].place} {'is missing' if missing else 'was added'}{more}"


def _warning(found: Mapping[Part, Comparison], places: Mapping[Part, str]) -> str:
    """The first warning, with its place, and how many there are; none where an image is different."""
    given = [part for part in found if found[part].warning]
    if not given or any(each.verdict is Verdict.DIFFERENT for each in found.values()):
        return ""
    first = given[0]
    place = f"{places[first]}: " if places[first] else ""
    more = f", and in {len(given) - 1} more parts and MIP levels" if len(given) > 1 else ""
    return f"{place}{found[first].warning}{more}"

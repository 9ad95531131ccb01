"""The method `welch`: Welch's t-test between two sets of independent renders, or two images with known noise."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np

from mi_refract.io.image_file import Image, Pixels
from mi_refract.io.text import distinguishable

from .channels import SPP, Estimate, estimates, has_variance, samples, spreads
from .comparison import Comparison, Metric, Range, Verdict, aligned, finite, nonfinite_result, one_of, preconditions
from .pixel_statistics import Inflation, inflation, rarity_exponent, sums
from .tile_statistics import GROWTH, Evidence, OneSided, TileTests, from_renders, from_variances, with_silent_pixels

# A side with so many times the samples of the other has 16 · 11 rare events where the other has 11, see `OneSided.p`,
# so that their variance is known to 1/√(16 · 11), 8 %.
WELL_KNOWN = 16
COLOURS = ("R", "G", "B", "X", "Y", "Z")  # channels whose larger values are "brighter", not "higher"
IDENTICAL = Metric("values that differ", 0.0, 0.0)


def compare_renders(
    reference: Sequence[Image],
    test: Sequence[Image],
    *,
    allow_nonfinite: bool,
    tile: Annotated[int, "side of a tile in pixels", Range(lambda x: x >= 1, "a positive whole number")] = 16,
    family_error: Annotated[
        float,
        "probability that equal images are called different",
        Range(lambda x: 0 < x < 1, "more than 0, less than 1"),
    ] = 0.001,
    equivalence_margin: Annotated[float, "relative difference of a tile that counts as no difference"] = 0.001,
    resolution: Annotated[
        float,
        "relative difference of a tile that the noise must not hide, or the result is inconclusive",
        Range(lambda x: x > 0, "more than 0"),
    ] = 0.05,
    hidden: Annotated[
        float,
        "share of the tiles with light, of any one channel, whose noise may hide such a difference",
        Range(lambda x: 0 <= x <= 1, "0 to 1"),
    ] = 0.1,
    pixels: Annotated[
        str, "test single pixels as well: yes; no for renders that share a fixed grid of samples", one_of("yes", "no")
    ] = "yes",
    spp: Annotated[int, "samples per pixel of each image; 0: the number in its header"] = 0,
    spp_reference: Annotated[int, "samples per pixel of the reference, where the sides differ; 0: `spp`"] = 0,
    spp_test: Annotated[int, "samples per pixel of the new image, where the sides differ; 0: `spp`"] = 0,
) -> Comparison:
    """Independent renders: Welch's t-test on the means of tiles and channels.

    Each side has two or more renders, or one render whose variance is known (see module `channels`). With one render,
    pixels are assumed to be independent, as under a box filter. A wider filter does not change the means of tiles, and
    hides differences of pixels. If the variance is that of filtered pixels, the header gives the width of the filter,
    or `pixel_statistics.inflation` estimates how much pixels correlate. For single tiles, blocks of tiles and the whole
    image there are two tests: of their mean, and of whether their pixels differ by more than the noise explains.

    If the variance of only one side is known, the other side is assumed to have the same variance per sample (a z-test,
    for many samples). Then a renderer with more noise per sample is different, even if its mean is right.

    The side with fewer samples is never assumed to have less noise per sample than the other: it may have missed rare
    light. Each render counts as one sample, unless the samples per pixel of all renders are known.

    Maps, one value per tile. `t`: signed, per channel. `p`: p-value of no difference at all, per channel; uniformly
    distributed for equal images. `q`: p adjusted for the false discovery rate after Benjamini and Hochberg (1995),
    p₍ᵢ₎ N/i made monotonic, the smallest of the channels. `flags`: 1 heavy-tailed, 2 no noise.

    EQUAL, however noisy, if both images contain their variance and are identical in every value of every channel.
    INCONCLUSIVE if the only tiles that differ are unsuited to a t-test (their noise comes from a few pixels, or their
    pixels share more noise than those of the rest of the image, or they have no noise and differ by little or in a few
    pixels), or if the noise hides differences of `resolution`; then the reason gives the number of samples that would
    decide. If all renders of a side are identical, that side has no noise; the reason says so, because a renderer that
    ignores its seed looks the same. ValueError for fewer renders, for renders of which only some are identical, for two
    renders of a side by `mi-refract render` of one scene with one seed, and for images that cannot be compared.
    """
    single = len(reference) == len(test) == 1 and (has_variance(reference[0]) or has_variance(test[0]))
    one, two = reference[0], test[0]
    identical = single and bool(spreads(one.channels)) and set(one.channels) == set(two.channels)
    identical = identical and np.array_equal(one.pixels, two.select(one.channels), equal_nan=True)
    set_spp = spp_reference or spp, spp_test or spp
    if single:
        known = estimates(reference[0], test[0], set_spp)
        reference, test = [known[0].image], [known[1].image]
    for image in (*reference[1:], *test):
        if reason := preconditions(reference[0], image, allow_nonfinite):
            return nonfinite_result("welch", reason, reference[0].pixels, aligned(reference[0], image)[1])
    if identical:
        return Comparison("welch", Verdict.EQUAL, "identical in every value, variances included", (IDENTICAL,))

    tile = min(tile, max(reference[0].pixels.shape[:2]))
    channels: Sequence[str] = reference[0].channels
    unit = "samples per pixel"
    if single:
        channels, evidence = _evidence(*known, tile)
        counts = known[0].spp, known[1].spp
    else:
        counts, unit = _checked_counts(reference, test, set_spp)
        a, b = ([finite(aligned(reference[0], image)[1]) for image in side] for side in (reference, test))
        evidence = from_renders(a, b, tile, counts)
    levels = list(replace(evidence, pixels=evidence.pixels if pixels == "yes" else None).levels(equivalence_margin))
    first, second = (finite(side[0].select(channels)) for side in (reference, test))
    levels[0] = with_silent_pixels(levels[0], first, second, equivalence_margin, tile, evidence.odds)
    tests = TileTests(levels, family_error)

    verdict, reason = _verdict(tests, resolution, hidden)
    if tests.alarms or tests.differing.silent_far:
        reason = f"{_worst_difference(tests, reference[0], channels, tile)}; {reason}"
    elif verdict is Verdict.INCONCLUSIVE:
        reason += _deciding_samples(counts, unit, tests.quieter(resolution, hidden))
    if not single:
        for name, side in (("reference", reference), ("new image", test)):
            if _all_identical(side) and (side[0].pixels != side[0].pixels[0, 0]).any():
                same = f"all {len(side)} renders of the {name} are identical"
                reason += f"; {same}: no noise, or the seeds have no effect"
    finest, differing = levels[0], tests.differing
    share_name = f"share of the tiles whose noise hides a difference of {resolution:.2g}"
    metrics = (
        Metric("tests of tiles and channels that differ", differing.tiles, 0.0),
        Metric("tests of the pixels of tiles that differ", differing.pixels, 0.0),
        Metric("smallest p, adjusted for the number of tests", tests.smallest_p),
        Metric("family error", family_error),
        Metric("tiles and channels", finest.t.size),
        Metric("tiles without noise", int(finest.silent.sum())),
        Metric("tiles without noise that differ", differing.silent, 0.0),
        Metric("heavy-tailed tiles", int(finest.heavy.sum())),
        Metric("heavy-tailed tiles and blocks that differ", differing.doubtful, 0.0),
        Metric("minimum detectable difference in a tile", tests.minimum_detectable(), resolution),
        Metric(share_name, tests.hidden_share(resolution), hidden),
        Metric("minimum detectable difference of the whole image", tests.minimum_detectable(-1)),
    )
    from scipy import stats

    q = np.ones(finest.p.shape)
    if not finest.silent.all():
        q[~finest.silent] = stats.false_discovery_control(finest.p[~finest.silent])
    flags = (2 * finest.silent + finest.heavy).max(-1)
    height, width = reference[0].pixels.shape[:2]
    maps = {
        name: values.astype(np.float32).repeat(tile, 0)[:height].repeat(tile, 1)[:, :width]
        for name, values in {"t": finest.t, "p": finest.p, "q": q.min(-1), "flags": flags}.items()
    }
    return Comparison("welch", verdict, reason, metrics, tests.minimum_detectable(), maps)


# Estimates of both sides -----------------------------------------------------------------------------------------


def _checked_counts(
    reference: Sequence[Image], test: Sequence[Image], spp: tuple[int, int]
) -> tuple[tuple[int, int], str]:
    """Return the samples per pixel of all renders of each side, or else the number of renders, and the unit."""
    if min(len(reference), len(test)) < 2:
        raise ValueError(
            f"welch: {len(reference)} and {len(test)} renders; expected at least 2 per side, or one per side "
            "with its variance, in channels such as m2_R or R.variance, or in a file (`variance`)"
        )
    expected = "expected independent renders with different seeds"
    for side in (reference, test):  # the measured noise of renders that share samples would be too small
        if _all_identical(side):  # renders without noise may be the same
            continue
        drawn = dict[str, Image]()
        for image in side:
            if (key := _drawn(image)) and (other := drawn.setdefault(key, image)) is not image:
                raise ValueError(f"{image.path}: the scene and the seed of {other.path}; {expected}")
        if side[0].mask is not None and not side[0].mask.all():
            continue  # what it leaves of other renders may be the same
        for a, b in itertools.combinations(side, 2):
            if _identical(a, b) and (a.pixels != a.pixels[0, 0]).any():  # black ones may be the same
                raise ValueError(f"{b.path}: the same image as {a.path}; {expected}")
    sides = list(zip(("reference", "test"), spp, (reference, test), strict=True))
    if not all(count or SPP in image.metadata for _, count, side in sides for image in side):
        return (len(reference), len(test)), "renders"
    n1, n2 = (sum(samples(image, name, count, least=1) for image in side) for name, count, side in sides)
    return (n1, n2), "samples per pixel"


def _drawn(image: Image) -> str:
    """Return what the random numbers of an image by `mi-refract render` depend on, as text; "" for other images."""
    try:
        identity = json.loads(image.metadata["mi_refract:identity"])
        return json.dumps([identity[name] for name in ("scene", "defines", "seed")], sort_keys=True)
    except (KeyError, TypeError, ValueError, RecursionError):
        return ""


def _all_identical(side: Sequence[Image]) -> bool:
    return all(_identical(side[0], image) for image in side[1:])


def _identical(a: Image, b: Image) -> bool:
    some_rows = np.s_[::37]  # compared first, as they are enough for noisy images that differ
    return all(np.array_equal(a.pixels[rows], b.pixels[rows], equal_nan=True) for rows in (some_rows, np.s_[:]))


def _evidence(a: Estimate, b: Estimate, tile: int) -> tuple[list[str], Evidence]:
    """Return the channels whose variance at least one side knows, and the evidence of these channels.

    If only one side knows the variance s² of a sample, that side gets the variance of both means, s² (1/n₁ + 1/n₂), and
    the other side gets 0.
    """
    b = replace(b, variance=b.variance[..., [b.image.channels.index(name) for name in a.image.channels]])
    known = a.known | b.known
    if not known.any():
        raise ValueError(f"{b.image.path}: no variance for any channel of {a.image.path}; set `channels` or `variance`")
    names = [name for name, is_known in zip(a.image.channels, known, strict=True) if is_known]
    (m1, v1), (m2, v2) = ((finite(x.image.select(names)).astype(np.float64), x.variance[..., known]) for x in (a, b))
    only_one, only_two = ~b.known[known], ~a.known[known]
    w1 = np.where(only_two, 0, v1 * (1 / a.spp + only_one / b.spp))
    w2 = np.where(only_one, 0, v2 * (1 / b.spp + only_two / a.spp))
    # Where one side has the variance of both means, there is nothing to exchange: the counts are equal.
    n1, n2 = (np.where(only_one | only_two, 1, x.spp) for x in (a, b))

    one_known = bool((only_one | only_two).any())
    estimated = inflation(m2 - m1, w1 + w2, tile) if one_known or None in (a.shared, b.shared) else Inflation()
    correlated = [estimated if x.shared is None else Inflation(x.shared) for x in (a, b)]
    one, two = (
        replace(from_variances(m, w, x.freedom, tile, n), correlated=c)
        for m, w, x, n, c in zip((m1, m2), (w1, w2), (a, b), (n1, n2), correlated, strict=True)
    )

    def by_side(of_one: float, of_two: float, of_both: float) -> Pixels:
        """Return a value per channel, by which sides know its variance: the reference, the test image, or both."""
        return np.where(only_one, of_one, np.where(only_two, of_two, of_both))

    # Let all n samples of one side have the same value, of probability p, and not all m samples of the other side. For
    # odds = 1 + (n − 1)/m, pⁿ⁺ᵐ + odds pⁿ(1 − pᵐ) ≤ p, so its sum over all values is at most 1. `with_silent_pixels`
    # needs this, and proves it for the odds of 7.
    odds = by_side(1 + (a.spp - 1) / b.spp, 1 + (b.spp - 1) / a.spp, 7.0)
    exponent = by_side(rarity_exponent(a.spp, b.spp), rarity_exponent(b.spp, a.spp), 0.5)
    pixels = sums(m1, w1, m2, w2, tile, n1 / n2, exponent)
    one_sided = None
    if one_known:
        well_known = by_side(a.spp / b.spp, b.spp / a.spp, np.nan) >= WELL_KNOWN
        brighter = (m2 - m1) * by_side(1.0, -1.0, 0.0)
        one_sided = OneSided(brighter, exponent, well_known, max(estimated, *correlated))
    return names, Evidence(tile, one, two, pixels, one_sided, odds)


# Verdict and reason ----------------------------------------------------------------------------------------------


def _verdict(tests: TileTests, resolution: float, hidden: float) -> tuple[Verdict, str]:
    tiles, doubtful, pixels, silent_far, silent = tests.differing
    counts = {"of tiles": tiles, "of their pixels": pixels, "of tiles without noise": silent_far}
    if differing := ", ".join(f"{count} {name}" for name, count in counts.items() if count):
        return Verdict.DIFFERENT, f"{sum(counts.values())} of {tests.p.size} tests differ: {differing}"
    if silent or doubtful:
        doubtful_ones = f"{doubtful} heavy-tailed, or with other noise than their pixels or renders show"
        reason = f"only tiles that are unsuited to a t-test differ: {silent} without noise, {doubtful_ones}"
        return Verdict.INCONCLUSIVE, reason
    if tests.levels[0].silent.all():
        return Verdict.EQUAL, "no noise, and no tile differs beyond the margin"
    visible, share = tests.minimum_detectable(), tests.hidden_share(resolution)
    smallest = f"one of {_percent(visible)}"
    hidden_ones = f"one of {_percent(resolution)} in {_percent(share)} of the tiles"
    if not visible <= resolution or share > hidden:
        where = f"{smallest} in the median tile" + (f", and {hidden_ones}" if share else "")
        return Verdict.INCONCLUSIVE, f"no difference is seen, but noise hides {where}"
    where = "in a tile of median noise" + (f", and noise hides {hidden_ones}" if share else "")
    return Verdict.EQUAL, f"no difference; {smallest} would have been seen {where}"


def _percent(share: float) -> str:
    return f"{float(f'{100 * share:.2g}'):g} %"


def _worst_difference(tests: TileTests, image: Image, channels: Sequence[str], tile: int) -> str:
    """Return where the test image differs the most, and how: "1.8 % darker in R in the 16 × 16 pixels around …"."""
    kind, level_index, row, column, channel = tests.worst()
    level, side = tests.levels[level_index], tile * GROWTH**level_index
    (height, width), name = image.pixels.shape[:2], channels[channel]
    top, left = row * side, column * side
    rows, columns = min(side, height - top), min(side, width - left)
    x, y = image.origin[0] + left + columns // 2, image.origin[1] + top + rows // 2
    where = "the whole image" if level.t[..., 0].size == 1 else f"the {columns} × {rows} pixels around ({x}, {y})"
    old, change = (float(values[row, column, channel]) for values in (level.reference, level.difference))
    if kind == "pixels" or not change:
        return f"different pixels of {name} in {where}, with the same mean within the noise"
    up, down = ("brighter", "darker") if name.rpartition(".")[2] in COLOURS else ("higher", "lower")
    direction = up if change > 0 else down
    amount = f"{_percent(abs(change / old))} " if old > 0 else ""
    values = "{} instead of {}".format(*distinguishable(old + change, old))
    return f"{amount}{direction} in {name}, {values}, in {where}"


def _deciding_samples(counts: tuple[int, int], unit: str, quieter: float) -> str:
    """Return how many samples or renders would multiply the noise's variance by `quieter`; "" if no number would.

    `counts`: n₁ and n₂. The smaller is increased until 1/n₁ + 1/n₂ is `quieter` times its present value. If it would
    exceed the larger, both sides get the same number.
    """
    if not quieter > 0:
        return ""
    needed, larger = quieter * (1 / counts[0] + 1 / counts[1]), max(counts)
    rest = needed - 1 / larger  # 1/n of the smaller side
    count, side = 2 / needed, "a side"
    if counts[0] != counts[1] and rest * larger >= 1:
        count, side = 1 / rest, "of the new image" if counts[0] > counts[1] else "of the reference"
    factor = count / min(counts)
    times = f" ({float(f'{factor:.2g}'):,g} times as many)" if side != "a side" or counts[0] == counts[1] else ""
    return f"; about {float(f'{count:.1e}'):,.0f} {unit} {side}{times} would decide"

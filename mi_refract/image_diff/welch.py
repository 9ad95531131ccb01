"""The method `welch`: Welch's t-test between two sets of independent renders, or two images with known noise."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np

from mi_refract.io.image_file import Image, Pixels
from mi_refract.io.text import distinguishable

from .channels import SPP, Estimate, estimates, has_variance, samples, spreads
from .comparison import (
    Comparison,
    Metric,
    Range,
    Verdict,
    aligned,
    finite,
    nonfinite_result,
    one_of,
    preconditions,
)
from .pixel_statistics import Inflation, inflation, rarity_exponent, sums
from .tile_statistics import (
    GROWTH,
    Evidence,
    OneSided,
    TileTests,
    from_renders,
    from_variances,
    with_silent_pixels,
)

WELL_KNOWN = 16  # times as many samples: a variance of 11 of their rare events is known to 1/√(16 · 11), 8 %
COLOURS = ("R", "G", "B", "X", "Y", "Z")  # of which more is brighter
IDENTICAL = Metric("values that differ", 0.0, 0.0)


def compare_renders(
    reference: Sequence[Image],
    test: Sequence[Image],
    *,
    allow_nonfinite: bool = False,
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
        "share of the tiles, in any channel, whose noise may hide such a difference",
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

    It takes two or more renders a side, or one a side whose variance is known (module `channels`); then pixels are
    assumed to be independent, as under a box filter. A wider filter does not change the means of tiles, and hides
    differences of pixels. Where the variance is that of filtered pixels, the header says how wide the filter is, or
    `pixel_statistics.inflation` estimates it. The tests are of the mean of single tiles, of blocks of tiles and of the
    whole image, and of whether the pixels of each differ by more than their noise explains.

    Where the variance of one side alone is known, the other side is assumed to have the same variance per sample (a
    z-test, for many samples). A renderer with more noise per sample is then different, even if its mean is right.

    The side with fewer samples is never assumed to have less noise per sample than the other: it may have missed rare
    light. Each render counts as one sample, unless the samples per pixel of all of them are known.

    Maps, in every tile. `t`: signed, by channels. `p`: of no difference at all, by channels; uniform for equal images.
    `q`: p adjusted for the false discovery rate after Benjamini and Hochberg (1995), p₍ᵢ₎ N/i made monotonic, the
    smallest of the channels. `flags`: 1 heavy-tailed, 2 no noise.

    EQUAL, however noisy, where both hold their variance and are identical in every value of every channel.
    INCONCLUSIVE where the only tiles that differ are unsuited to a t-test (with the noise of a few pixels, or without
    noise, and by little or in a few pixels), and where the noise hides differences of `resolution`, with the number of
    samples that would show them. ValueError for fewer renders, the same render twice, images that cannot be compared.
    """
    single = len(reference) == len(test) == 1 and (has_variance(reference[0]) or has_variance(test[0]))
    one, two = reference[0], test[0]
    same = single and bool(spreads(one.channels)) and set(one.channels) == set(two.channels)
    same = same and np.array_equal(one.pixels, two.select(one.channels), equal_nan=True)
    set_spp = spp_reference or spp, spp_test or spp
    if single:
        known = estimates(reference[0], test[0], set_spp, allow_nonfinite)
        reference, test = [known[0].image], [known[1].image]
    for image in (*reference[1:], *test):
        if reason := preconditions(reference[0], image, allow_nonfinite):
            return nonfinite_result("welch", reason, reference[0].pixels, aligned(reference[0], image)[1])
    if same:
        return Comparison("welch", Verdict.EQUAL, "identical in every value, variances included", (IDENTICAL,))

    tile = min(tile, max(reference[0].pixels.shape[:2]))
    channels: Sequence[str] = reference[0].channels
    unit = "samples per pixel"
    if single:
        channels, evidence = _of_estimates(*known, tile)
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
        reason = f"{_worst(tests, reference[0], channels, tile)}; {reason}"
    elif verdict is Verdict.INCONCLUSIVE:
        reason += _deciding(counts, unit, tests.quieter(resolution, hidden))
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


# What is known of both sides -------------------------------------------------------------------------------------


def _checked_counts(
    reference: Sequence[Image], test: Sequence[Image], spp: tuple[int, int]
) -> tuple[tuple[int, int], str]:
    """The samples per pixel of all renders of each side, or their number, and which of both.

    ValueError for fewer than 2 a side, and for the same render twice: it would halve the noise that is seen.
    """
    if min(len(reference), len(test)) < 2:
        raise ValueError(
            f"welch: {len(reference)} and {len(test)} renders; expected at least 2 per side, or one per side "
            "with its variance, in channels such as m2_R or R.variance, or in a file (`variance`)"
        )
    for side in (reference, test):
        if all(_identical(side[0], image) for image in side):
            continue  # without noise
        for a, b in itertools.combinations(side, 2):
            if _identical(a, b) and (a.pixels != a.pixels[0, 0]).any():  # black ones may be the same
                raise ValueError(
                    f"{b.path}: the same image as {a.path}; expected independent renders with different seeds"
                )
    sides = list(zip(("reference", "test"), spp, (reference, test), strict=True))
    if not all(count or SPP in image.metadata for _, count, side in sides for image in side):
        return (len(reference), len(test)), "renders"
    n1, n2 = (sum(samples(image, name, count, least=1) for image in side) for name, count, side in sides)
    return (n1, n2), "samples per pixel"


def _identical(a: Image, b: Image) -> bool:
    few = np.s_[::37]  # rows: enough to tell noisy images apart, and quicker than all
    return np.array_equal(a.pixels[few], b.pixels[few]) and np.array_equal(a.pixels, b.pixels)


def _of_estimates(a: Estimate, b: Estimate, tile: int) -> tuple[list[str], Evidence]:
    """The channels whose variance one side knows at least, and what is known of them.

    Where one side alone knows the variance of a sample, that is all there is: it carries both means' variances,
    s² (1/n₁ + 1/n₂), and the other side has none.
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
    # A variance that carries both means' is as well known as the side that knows it does; the other one's is 0 there.
    n1, n2 = (np.where(only_one | only_two, 1, x.spp) for x in (a, b))

    alone = bool((only_one | only_two).any())
    estimated = inflation(m2 - m1, w1 + w2, tile) if alone or None in (a.shared, b.shared) else Inflation()
    correlated = [estimated if x.shared is None else Inflation(x.shared) for x in (a, b)]
    one, two = (
        replace(from_variances(m, w, x.freedom, tile, n), correlated=c)
        for m, w, x, n, c in zip((m1, m2), (w1, w2), (a, b), (n1, n2), correlated, strict=True)
    )

    def by_side(of_one: float, of_two: float, of_both: float) -> Pixels:
        """A value by channel: of those whose variance one side knows alone, and of the others."""
        return np.where(only_one, of_one, np.where(only_two, of_two, of_both))

    # Let all n samples have one value of probability p, and of m others not all. For odds = 1 + (n − 1)/m the sum of
    # pⁿ⁺ᵐ + odds pⁿ(1 − pᵐ) ≤ p over all values is at most 1, as that of 7 in `with_silent_pixels` is.
    odds = by_side(1 + (a.spp - 1) / b.spp, 1 + (b.spp - 1) / a.spp, 7.0)
    exponent = by_side(rarity_exponent(a.spp, b.spp), rarity_exponent(b.spp, a.spp), 0.5)
    pixels = sums(m1, w1, m2, w2, tile, n1 / n2, exponent)
    one_sided = None
    if alone:
        well_known = by_side(a.spp / b.spp, b.spp / a.spp, np.nan) >= WELL_KNOWN
        brighter = (m2 - m1) * by_side(1.0, -1.0, 0.0)
        one_sided = OneSided(brighter, exponent, well_known, max(estimated, *correlated))
    return names, Evidence(tile, one, two, pixels, one_sided, odds)


# What the tests say ----------------------------------------------------------------------------------------------


def _verdict(tests: TileTests, resolution: float, hidden: float) -> tuple[Verdict, str]:
    tiles, doubtful, pixels, silent_far, silent = tests.differing
    counts = {"of tiles": tiles, "of their pixels": pixels, "of tiles without noise": silent_far}
    if differing := ", ".join(f"{count} {name}" for name, count in counts.items() if count):
        return Verdict.DIFFERENT, f"{sum(counts.values())} of {tests.p.size} tests differ: {differing}"
    if silent or doubtful:
        where = f"{silent} without noise, {doubtful} heavy-tailed or of more noise than their pixels show"
        return Verdict.INCONCLUSIVE, f"only tiles that are unsuited to a t-test differ: {where}"
    if tests.levels[0].silent.all():
        return Verdict.EQUAL, "no noise, and no tile differs beyond the margin"
    visible, share = tests.minimum_detectable(), tests.hidden_share(resolution)
    one, in_some = f"one of {_percent(visible)}", f"one of {_percent(resolution)} in {_percent(share)} of the tiles"
    if not visible <= resolution or share > hidden:
        where = f"{one} in the median tile" + (f", and {in_some}" if share else "")
        return Verdict.INCONCLUSIVE, f"no difference is seen, but noise hides {where}"
    where = "in a tile of median noise" + (f", and noise hides {in_some}" if share else "")
    return Verdict.EQUAL, f"no difference; {one} would have been seen {where}"


def _percent(share: float) -> str:
    return f"{float(f'{100 * share:.2g}'):g} %"


def _worst(tests: TileTests, image: Image, channels: Sequence[str], tile: int) -> str:
    """Where the test image differs the most, and by how much: "1.8 % darker in R in the 16 × 16 pixels around …"."""
    kind, number, row, column, channel = tests.worst()
    level, side = tests.levels[number], tile * GROWTH**number
    (height, width), name = image.pixels.shape[:2], channels[channel]
    top, left = row * side, column * side
    rows, columns = min(side, height - top), min(side, width - left)
    x, y = image.origin[0] + left + columns // 2, image.origin[1] + top + rows // 2
    where = "the whole image" if level.t[..., 0].size == 1 else f"the {columns} × {rows} pixels around ({x}, {y})"
    one, change = (float(values[row, column, channel]) for values in (level.reference, level.difference))
    if kind == "pixels" or not change:
        return f"other pixels of {name} in {where}, the mean of which is the same within the noise"
    up, down = ("brighter", "darker") if name.rpartition(".")[2] in COLOURS else ("higher", "lower")
    share = f"{_percent(abs(change / one))} {up if change > 0 else down}" if one > 0 else up if change > 0 else down
    values = "{} instead of {}".format(*distinguishable(one + change, one))
    return f"{share} in {name}, {values}, in {where}"


def _deciding(counts: tuple[int, int], unit: str, quieter: float) -> str:
    """How many samples or renders divide the noise's variance by 1/`quieter`; "" where no number does.

    Of n₁ and n₂, `counts`, the smaller rises until 1/n₁ + 1/n₂ is `quieter` times what it was, up to the other's
    number; beyond that both rise.
    """
    if not quieter > 0:
        return ""
    needed, most = quieter * (1 / counts[0] + 1 / counts[1]), max(counts)
    count, whose = 2 / needed, "a side"
    if counts[0] != counts[1] and (rest := needed - 1 / most) * most >= 1:
        count, whose = 1 / rest, "of the new image" if counts[0] > counts[1] else "of the reference"
    more = count / min(counts)
    times = f" ({float(f'{more:.2g}'):,g} times as many)" if whose != "a side" or counts[0] == counts[1] else ""
    return f"; about {float(f'{count:.1e}'):,.0f} {unit} {whose}{times} would decide"

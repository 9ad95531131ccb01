"""The method `welch`: Welch's t-test between two sets of independent renders."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from mi_refract.io.image_file import Image
from mi_refract.io.pixels import Pixels, block_sum

from .comparison import Comparison, Maps, Metric, Verdict, aligned, nonfinite_result, preconditions
from .pixel_correlation import inflation
from .pixel_statistics import PixelSums, exponent, sums, sums_of_renders
from .tile_statistics import (
    CORRECTIONS,
    Inflation,
    Level,
    OneSided,
    Side,
    TileTests,
    from_renders,
    from_variances,
    levels,
    with_silent_pixels,
)
from .variances import SPP, Estimate, estimates, has_variance, same_noise, samples

SAMPLES = "samples per pixel"
SIDES = ("reference", "new image")
WELL_KNOWN = 16  # times as many samples: a variance of 11 of their rare events is known to 1/√(16 · 11), 8 %
IDENTICAL = Metric("values that differ", 0.0, 0.0)


def compare_renders(
    reference: Sequence[Image],
    test: Sequence[Image],
    *,
    allow_nonfinite: bool = False,
    tile: Annotated[int, "side of a tile in pixels"] = 16,
    family_error: Annotated[float, "probability that equal images are called different"] = 0.001,
    correction: Annotated[str, "for the number of tiles: sidak or holm"] = "sidak",
    equivalence_margin: Annotated[float, "relative difference of a tile that counts as none"] = 0.001,
    resolution: Annotated[float, "relative difference that must be visible in a tile, or it is inconclusive"] = 0.05,
    hidden: Annotated[float, "share of the tiles, in any channel, whose noise may hide that difference"] = 0.1,
    pixels: Annotated[str, "test them, too: yes, or no for renders that share a fixed grid of samples"] = "yes",
    spp: Annotated[int, "samples per pixel of each image; 0: as their headers say"] = 0,
    spp_reference: Annotated[int, "the reference's, where the sides differ; 0: `spp`"] = 0,
    spp_test: Annotated[int, "the new image's, where the sides differ; 0: `spp`"] = 0,
) -> Comparison:
    """Independent renders: Welch's t-test on the means of tiles and channels.

    Two or more renders a side, or one a side whose variance is known (module `variances`): then pixels are taken for
    independent, as under a box filter. A wider filter leaves the means of tiles as they are, and hides differences of
    pixels. Where the variance is that of filtered pixels, the header says how wide the filter is, or
    `pixel_correlation` estimates it. Tests the mean of single tiles, of blocks of them, and of the whole image; and
    whether their pixels scatter more than their noise explains.

    Where the variance of one side alone is known, that of a sample is taken to be the same on the other (a z-test, for
    many samples). A renderer that samples worse than the reference did is different, then, however right its mean is.

    A side with fewer samples than the other one is not taken to have less noise per sample than that one: it may have
    missed rare light. Renders count alike, unless all of them say their samples per pixel.

    EQUAL, however noisy, where both hold the variance themselves and are the same in every value of every channel.
    INCONCLUSIVE where only tiles differ of which a t-test knows little (with the noise of a few pixels, or without
    noise, and by little or in a few pixels), and where the noise hides differences of `resolution`, with the number of
    samples that would show them. ValueError for fewer renders, the same render twice, options out of range, images that
    cannot be compared.
    """
    _check(tile, family_error, correction, equivalence_margin, resolution, hidden)
    if pixels not in ("yes", "no"):
        raise ValueError(f"pixels = {pixels!r}; expected yes, no")
    known, whole = None, (reference[0], test[0])
    given = spp_reference or spp, spp_test or spp
    if len(reference) == len(test) == 1 and (has_variance(reference[0]) or has_variance(test[0])):
        known = estimates(reference[0], test[0], given, allow_nonfinite)
        reference, test = [known[0].image], [known[1].image]
    for image in (*reference[1:], *test):
        if reason := preconditions(reference[0], image, allow_nonfinite):
            return nonfinite_result("welch", reason, reference[0].pixels, aligned(reference[0], image)[1])
    if known and same_noise(*whole):
        return Comparison("welch", Verdict.EQUAL, "the same in every value, noise and all", (IDENTICAL,))
    tile = min(tile, max(reference[0].pixels.shape[:2]))
    sides = _of_estimates(*known, tile) if known else _of_renders(reference, test, tile, given)
    pixel_sums = sides.pixels if pixels == "yes" else None
    found = list(levels(sides.one, sides.two, equivalence_margin, pixel_sums, sides.shown))
    a, b = (_finite(side[0].select(sides.channels)) for side in (reference, test))
    found[0] = with_silent_pixels(found[0], a, b, equivalence_margin, tile, sides.odds)
    tests = TileTests(found, family_error, correction)
    verdict, reason = _verdict(tests, resolution, hidden, sides)
    maps = _maps(found[0], tile, reference[0].pixels.shape)
    return Comparison("welch", verdict, reason, _metrics(tests, resolution, hidden), tests.minimum_detectable(), maps)


def _check(tile: int, family_error: float, correction: str, margin: float, resolution: float, hidden: float) -> None:
    if tile < 1:
        raise ValueError(f"tile = {tile}; expected a positive whole number")
    if not 0 < family_error < 1:
        raise ValueError(f"family_error = {family_error}; expected more than 0, less than 1")
    if correction not in CORRECTIONS:
        raise ValueError(f"correction = {correction!r}; expected {', '.join(CORRECTIONS)}")
    if not margin >= 0:
        raise ValueError(f"equivalence_margin = {margin}; expected at least 0")
    if not resolution > 0:
        raise ValueError(f"resolution = {resolution}; expected more than 0")
    if not 0 <= hidden <= 1:
        raise ValueError(f"hidden = {hidden}; expected 0 to 1")


@dataclass(frozen=True)
class _Sides:
    """Both sides, the sums over their pixels, the channels that are tested, and the `odds` of `with_silent_pixels`.

    `counts`: the samples per pixel of both sides, or the renders: what `unit` says.
    """

    one: Side
    two: Side
    pixels: PixelSums
    channels: Sequence[str]
    counts: tuple[int, int]
    unit: str
    odds: Pixels | float = 7.0
    shown: OneSided | None = None

    def deciding(self, quieter: float) -> str:
        """How many samples or renders divide the noise's variance by 1/`quieter`; "" where no number does.

        More on the side with fewer, up to the other's number; beyond that as many on both.
        """
        if not quieter > 0:
            return ""
        needed, most = quieter * (1 / self.counts[0] + 1 / self.counts[1]), max(self.counts)
        rest = needed - 1 / most
        alone = rest * most >= 1 and self.counts[0] != self.counts[1]
        count, whose = (
            (1 / rest, f"of the {SIDES[self.counts[0] > self.counts[1]]}") if alone else (2 / needed, "a side")
        )
        return f"; about {float(f'{count:.1e}'):,.0f} {self.unit} {whose} would decide"


def _of_renders(reference: Sequence[Image], test: Sequence[Image], tile: int, given: tuple[int, int]) -> _Sides:
    if min(len(reference), len(test)) < 2:
        raise ValueError(
            f"welch: {len(reference)} and {len(test)} renders; expected at least 2 a side, or one a side with its "
            "variance, in channels as m2_R, R.variance or in a file (`variance`)"
        )
    for side in (reference, test):
        _distinct(side)
    a, b = ([_finite(aligned(reference[0], image)[1]) for image in side] for side in (reference, test))
    counts, unit = (len(reference), len(test)), "renders"
    named = list(zip(("reference", "test"), given, (reference, test), strict=True))
    if all(spp or SPP in each.metadata for _, spp, side in named for each in side):
        n1, n2 = (sum(samples(each, name, spp, least=1) for each in side) for name, spp, side in named)
        counts, unit = (n1, n2), SAMPLES
    one, two = (from_renders(x, tile, count) for x, count in zip((a, b), counts, strict=True))
    pixels = sums_of_renders(a, b, tile, counts[0] / counts[1])
    return _Sides(one, two, pixels, reference[0].channels, counts, unit)


def _of_estimates(a: Estimate, b: Estimate, tile: int) -> _Sides:
    """Where one side alone knows the variance of a sample, that is all there is: it carries both means' variances."""
    b = replace(b, variance=b.variance[..., [b.image.channels.index(name) for name in a.image.channels]])
    known = a.known | b.known
    if not known.any():
        raise ValueError(f"{b.image.path}: no variance of a channel of {a.image.path}; expected `channels`, `variance`")
    names = [name for name, each in zip(a.image.channels, known, strict=True) if each]
    (m1, v1), (m2, v2) = ((_finite(x.image.select(names)).astype(np.float64), x.variance[..., known]) for x in (a, b))
    only_one, only_two = ~b.known[known], ~a.known[known]
    w1 = np.where(only_two, 0, v1 * (1 / a.spp + only_one / b.spp))
    w2 = np.where(only_one, 0, v2 * (1 / b.spp + only_two / a.spp))
    # Let all n samples have one value of probability p, and of m others not all. For odds = 1 + (n − 1)/m the sum of
    # pⁿ⁺ᵐ + odds pⁿ(1 − pᵐ) ≤ p over all values is at most 1, as that of 7 in `with_silent_pixels` is.
    odds = np.where(only_one, 1 + (a.spp - 1) / b.spp, np.where(only_two, 1 + (b.spp - 1) / a.spp, 7.0))
    # A variance that carries both means' is as well known as the side that knows it does; the other one's is 0 there.
    n1, n2 = (np.where(only_one | only_two, 1, each.spp) for each in (a, b))
    one, two = from_variances(m1, w1, a.freedom, tile, n1), from_variances(m2, w2, b.freedom, tile, n2)
    alone = bool((only_one | only_two).any())
    found = inflation(m2 - m1, w1 + w2, tile) if alone or None in (a.shared, b.shared) else Inflation()
    one, two = (
        replace(side, correlated=found if each.shared is None else Inflation(each.shared))
        for side, each in ((one, a), (two, b))
    )
    rarer = np.where(only_one, exponent(a.spp, b.spp), np.where(only_two, exponent(b.spp, a.spp), 0.5))
    pixels = sums(m1, w1, m2, w2, tile, n1 / n2, rarer)
    shown = None
    if alone:
        brighter = (m2 - m1) * (1.0 * only_one - only_two)
        well_known = np.where(only_one, a.spp / b.spp, b.spp / a.spp) >= WELL_KNOWN
        total, squares = block_sum(brighter, tile), block_sum(np.square(brighter), tile)
        shown = OneSided(
            PixelSums(total[None], squares[None], rarer),
            tile,
            brighter,
            well_known,
            max(found, one.correlated, two.correlated),
        )
    return _Sides(one, two, pixels, names, (a.spp, b.spp), SAMPLES, odds, shown)


def _distinct(side: Sequence[Image]) -> None:
    """The same seed twice would halve the noise that is seen. Images without noise or without light may be the same."""
    if all(_identical(side[0], image) for image in side):
        return
    for a, b in itertools.combinations(side, 2):
        if _identical(a, b) and (a.pixels != a.pixels[0, 0]).any():
            raise ValueError(f"{b.path}: the same image as {a.path}; expected independent renders, of other seeds")


def _identical(a: Image, b: Image) -> bool:
    few = np.s_[::37]  # rows: enough to tell noisy images apart, and quicker than all
    return np.array_equal(a.pixels[few], b.pixels[few]) and np.array_equal(a.pixels, b.pixels)


def _finite(pixels: Pixels) -> Pixels:
    return pixels if np.isfinite(pixels).all() else np.where(np.isfinite(pixels), pixels, 0)


def _verdict(tests: TileTests, resolution: float, hidden: float, sides: _Sides) -> tuple[Verdict, str]:
    counts = {
        "tests of tiles and channels": tests.differing,
        "of their pixels": tests.pixels_differing,
        "of tiles without noise": tests.silent_far,
    }
    if found := ", ".join(f"{count} {name}" for name, count in counts.items() if count):
        return Verdict.DIFFERENT, f"{found} differ, of {tests.p.size} tests"
    if tests.silent_differing or tests.heavy_differing:
        where = f"{tests.silent_differing} tiles noise-free, {tests.heavy_differing} heavy-tailed"
        return Verdict.INCONCLUSIVE, f"differences only where a t-test knows little: {where}"
    visible, share = tests.minimum_detectable(), tests.hidden_share(resolution)
    if tests.levels[0].silent.all():
        return Verdict.EQUAL, "no noise, and no tile differs beyond the margin"
    if not visible <= resolution or share > hidden:
        where = f"one of {visible:.2g} in the median tile, and one of {resolution:.2g} in {share:.3g} of the tiles"
        more = sides.deciding(tests.quieter(resolution, hidden))
        return Verdict.INCONCLUSIVE, f"no difference is seen, but noise hides {where}{more}"
    where = f"in a tile of median noise, and noise hides one of {resolution:.2g} in {share:.3g} of the tiles"
    return Verdict.EQUAL, f"no difference; one of {visible:.2g} would have been seen {where}"


def _metrics(tests: TileTests, resolution: float, hidden: float) -> tuple[Metric, ...]:
    finest, share = tests.levels[0], tests.hidden_share(resolution)
    return (
        Metric("tests of tiles and channels that differ", tests.differing, 0.0),
        Metric("tests of the pixels of tiles that differ", tests.pixels_differing, 0.0),
        Metric("smallest p, adjusted for the number of tests", tests.smallest_p),
        Metric("family error", tests.family_error),
        Metric("tiles and channels", finest.t.size),
        Metric("tiles without noise", int(finest.silent.sum())),
        Metric("tiles without noise that differ", tests.silent_differing, 0.0),
        Metric("heavy-tailed tiles", int(finest.heavy.sum())),
        Metric("heavy-tailed tiles and blocks that differ", tests.heavy_differing, 0.0),
        Metric("minimum detectable difference in a tile", tests.minimum_detectable(), resolution),
        Metric(f"share of the tiles whose noise hides a difference of {resolution:.2g}", share, hidden),
        Metric("minimum detectable difference of the whole image", tests.minimum_detectable(-1)),
    )


def _maps(level: Level, tile: int, shape: tuple[int, ...]) -> Maps:
    """In every tile. `t`: signed, by channels. `p`: of no difference at all, by channels; uniform for equal images.

    `q`: p adjusted after Benjamini and Hochberg, the smallest of the channels. `flags`: 1 heavy-tailed, 2 no noise.
    """
    from scipy import stats

    q = np.ones(level.p.shape)
    if not level.silent.all():
        q[~level.silent] = stats.false_discovery_control(level.p[~level.silent])
    found = {"t": level.t, "p": level.p, "q": q.min(-1), "flags": (2 * level.silent + level.heavy).max(-1)}

    def spread(x: Pixels) -> Pixels:
        return x.astype(np.float32).repeat(tile, 0)[: shape[0]].repeat(tile, 1)[:, : shape[1]]

    return {name: spread(x) for name, x in found.items()}

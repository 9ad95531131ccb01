"""`welch` where the variance of one side alone is known, beside the z-test of Mitsuba's own tests of renders.

Renders are drawn: the mean of n samples that are exponentially distributed is gamma distributed with shape n.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import special

from mi_refract.image_diff.comparison import Verdict
from mi_refract.image_diff.methods import compare
from mi_refract.io.image_file import Image

SPP = {"spp_reference": 32000, "spp_test": 868}  # of Mitsuba's references, and of its tests at 48²
TRIALS = 200


def image(pixels, variance=None, channels=("R", "G", "B")):
    variances = {} if variance is None else dict(zip(channels, np.moveaxis(variance, -1, 0), strict=True))
    return Image(Path("a.exr"), np.asarray(pixels, np.float32), channels, variances=variances)


def drawn(rng, mean, spp):
    return rng.gamma(spp, mean / spp)


def reference(rng, mean):
    """A reference of so many samples, with their variance, which is known to 1 %."""
    pixels = drawn(rng, mean, SPP["spp_reference"])
    return image(pixels, np.square(mean) * (1 + 0.01 * rng.standard_normal(mean.shape)))


def glass_ball(ior, size=48, grid=6):
    """The mean image of a ball of glass before stripes; rays through its rim are bent most. Paraxial colours: grey.

    A ray at the distance b from the axis turns by 2 (asin b − asin(b/n)) on its way through; Fresnel's reflection is
    left out, as 0.5 % of the IOR changes it by 1e-3 only.
    """
    at = (np.arange(size * grid) + 0.5) / (size * grid) * 2.4 - 1.2
    x, y = np.meshgrid(at, at)
    b = np.minimum(np.hypot(x, y), 1.0)
    turn = np.where(np.hypot(x, y) < 1, 2 * (np.arcsin(b) - np.arcsin(b / ior)), 0)
    seen = np.stack([1 + 0.8 * np.sin(9 * (x - turn * x / np.maximum(b, 1e-9) + 0.3 * y) + c) for c in range(3)], -1)
    return seen.reshape(size, grid, size, grid, 3).mean((1, 3))


def mitsuba_accepts(test, reference):
    """The z-test of Mitsuba 3's test_renders.py, from its description.

    A two-sided test of every pixel, as if the reference were exact, at Šidák's level for 1 % over the pixels; 0.25 % of
    the values may fail; variances below 1e-4 are raised to that.
    """
    variance = np.maximum(np.stack([reference.variances[name] for name in reference.channels], -1), 1e-4)
    z = np.abs(test.pixels - reference.pixels.astype(float)) * np.sqrt(SPP["spp_test"] / variance)
    pixels = z.shape[0] * z.shape[1]
    passed = 2 * special.ndtr(-z) > 1 - (1 - 0.01) ** (1 / pixels)
    return passed.sum() / z.shape[-1] >= 0.9975 * pixels


GROSS = {
    "black": lambda x: np.zeros_like(x),
    "twice as bright": lambda x: 2 * x,
    "mirrored": lambda x: x[:, ::-1],
    "other way up": lambda x: x[::-1],
    "shifted by 4 pixels": lambda x: np.roll(x, 4, 1),
    "red and blue swapped": lambda x: x[..., ::-1],
    "a black quarter": lambda x: x * (np.arange(48) >= 12)[:, None, None],
}


@pytest.mark.parametrize("defect", GROSS.values(), ids=GROSS)
def test_both_see_gross_defects(defect):
    rng = np.random.default_rng(20)
    mean = glass_ball(1.5)
    known, wrong = reference(rng, mean), image(drawn(rng, np.maximum(defect(mean), 1e-9), SPP["spp_test"]))
    assert not mitsuba_accepts(wrong, known)
    assert compare("auto", known, wrong, **SPP).verdict is Verdict.DIFFERENT


@pytest.mark.parametrize("seed", range(30, 40))
def test_an_ior_that_is_half_a_percent_off_is_seen_where_the_z_test_of_pixels_is_blind(seed):
    rng = np.random.default_rng(seed)
    known = reference(rng, glass_ball(1.5))
    right, wrong = (image(drawn(rng, glass_ball(ior), SPP["spp_test"])) for ior in (1.5, 1.5 * 1.005))
    assert mitsuba_accepts(wrong, known)
    assert mitsuba_accepts(right, known)
    assert compare("auto", known, wrong, **SPP).verdict is Verdict.DIFFERENT
    assert compare("auto", known, right, **SPP).verdict is Verdict.EQUAL


@pytest.mark.parametrize("known_side", [0, 1])
@pytest.mark.parametrize("skewed", [False, True])
def test_false_alarms_are_as_rare_as_asked(known_side, skewed):
    """At a family error of 5 % at most 21 of 200: more have a probability of 5e-4 where 5 % is what comes up.

    `skewed`: one sample in a hundred finds light.
    """
    rng = np.random.default_rng(50 + 2 * known_side + skewed)
    mean = 0.2 + np.linspace(0, 1, 32)[None, :, None] * np.ones((32, 32, 3))
    spps = (1000, 300) if known_side == 0 else (300, 1000)
    share = 0.01 if skewed else 1.0

    def render(spp):
        found = rng.binomial(spp, share, mean.shape) if skewed else np.full(mean.shape, spp)
        return rng.gamma(np.maximum(found, 1e-9), mean / (spp * share))

    variance = np.square(mean) * (2 / share - 1)  # E x² = share · 2 (mean/share)²
    alarms = 0
    for _ in range(TRIALS):
        sides = [image(render(spp)) for spp in spps]
        sides[known_side] = image(sides[known_side].pixels, variance)
        found = compare("welch", *sides, spp_reference=spps[0], spp_test=spps[1], family_error=0.05)
        alarms += found.verdict is Verdict.DIFFERENT
    assert alarms <= 21


@pytest.mark.parametrize(("n", "m"), [(2, 2), (10, 3), (5, 1000)])
@pytest.mark.parametrize("known_side", [0, 1])
def test_one_known_variance_is_that_of_both_sides(n, m, known_side):
    """In one pixel t = d/√(v (1/n + 1/m)), with the n − 1 degrees of freedom of the side whose variance is known."""
    from scipy import stats

    v, sides = 0.08, [image([[[1.0]]], channels=("Y",)), image([[[1.5]]], channels=("Y",))]
    sides[known_side] = image(sides[known_side].pixels, np.full((1, 1, 1), v), ("Y",))
    spp = (n, m) if known_side == 0 else (m, n)
    found = compare("welch", *sides, spp_reference=spp[0], spp_test=spp[1], equivalence_margin=0.0)
    t = 0.5 / np.sqrt(v * (1 / n + 1 / m))
    again = compare("welch", *sides, spp=7, spp_reference=spp[0], spp_test=spp[1], equivalence_margin=0.0)
    assert again.maps["t"].item() == found.maps["t"].item()  # what is said of a side goes before what is said of both
    assert found.maps["t"].item() == pytest.approx(t, rel=1e-5)
    assert found.maps["p"].item() == pytest.approx(2 * stats.t.sf(t, n - 1), rel=1e-5)


def test_what_no_sample_of_the_reference_found_is_evidence_by_how_many_it_had():
    """All n samples have one value, one of m others does not: k such pixels by chance once in (1 + (n − 1)/m)ᵏ."""
    pixels = np.ones((16, 16, 1))
    known, wrong = image(pixels, np.zeros_like(pixels), ("Y",)), pixels.copy()
    for k, seen in ((1, False), (2, False), (3, True)):
        wrong.flat[:k] = 1.5
        found = compare("welch", known, image(wrong, channels=("Y",)), spp_reference=1001, spp_test=100)
        assert (found.verdict is Verdict.DIFFERENT) is seen  # 11⁻² > 0.001 > 11⁻³
        assert found.verdict is not Verdict.EQUAL


@pytest.mark.parametrize(
    ("lit", "verdict"),
    [(1, Verdict.INCONCLUSIVE), (8, Verdict.INCONCLUSIVE), (64, Verdict.DIFFERENT), (256, Verdict.DIFFERENT)],
)
def test_rare_events_are_no_evidence_against_a_side_that_does_not_know_its_noise(lit, verdict):
    """A tile of 5.5 σ where σ is a quarter of the mean: so are a few paths that find a lamp, but not 64 of them.

    The other side is brighter in `lit` pixels alone, by 5.5/`lit` σ of the tile each.
    """
    mean, variance = (np.full((16, 16, 1), x) for x in (1.0, 256 * 1000 * 0.25**2))
    far = mean.copy()
    far.flat[:: 256 // lit] += 1.375 * 256 / lit
    known, other = image(mean, variance, ("Y",)), image(far, channels=("Y",))
    found = compare("welch", known, other, spp_reference=10**9, spp_test=1000)
    assert found.verdict is verdict
    assert ("heavy-tailed" in found.reason) == (verdict is Verdict.INCONCLUSIVE)
    both = image(far, np.full_like(mean, 1e-9), ("Y",)), image(mean, variance, ("Y",))
    assert compare("welch", *both, spp_reference=10**9, spp_test=1000).verdict is Verdict.DIFFERENT

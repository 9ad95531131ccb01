"""The error of a render, estimated from its passes: right on average, and rarely too small when it ends a render."""

from __future__ import annotations

import importlib.util
import math
import sys

import numpy as np
import pytest
from scipy.stats import binom
from support.renders import leaf, tree_of

from mi_refract.rendering.end_conditions import RelativeError, relative_error, require_interval, worst_tile
from mi_refract.rendering.pass_plan import next_stop
from mi_refract.rendering.pass_sums import PassSums, PassTree

RNG = np.random.default_rng(17)
SIZE = (12, 12, 3)


def noisy(kind, truth, spp):
    """Return a pass of `spp` samples per pixel; the standard deviation of a sample is its mean, if not "rare"."""
    if kind == "normal":
        return RNG.normal(truth, truth * spp**-0.5)
    if kind == "exponential":
        return truth * RNG.gamma(spp, 1 / spp, SIZE)
    # One sample in 20 is bright, in all colours, as in caustics.
    return truth * RNG.binomial(spp, 0.05, SIZE[:2])[..., None] / (spp * 0.05)


def true_error(sums, truth):
    return math.sqrt(np.mean((sums.mean - truth) ** 2)) / truth.mean()


@pytest.mark.parametrize("kind", ["normal", "exponential", "rare"])
def test_the_estimated_error_is_right_on_average(kind):
    truth, squares = RNG.uniform(0.2, 2, SIZE), []
    for _ in range(60):
        sums = tree_of(noisy(kind, truth, 4) for _ in range(16)).sums()
        squares.append((relative_error(sums).value ** 2, true_error(sums, truth) ** 2))
    estimated, true = np.mean(squares, 0)
    # Both are means of 60 over at least 144 pixels: standard errors of 1.5 % for rare samples, with a kurtosis of 20.
    assert estimated == pytest.approx(true, rel=0.08)


@pytest.mark.parametrize(("passes", "at_most"), [(1, True), (2, False), (4, False)])
def test_the_estimate_for_stratified_samples_is_right_or_marked_as_a_bound(passes, at_most):
    """Samples in n strata have the variance σ² (1 − 1/n³) n/(n − 1), so their estimate is n² + n + 1 times too large.

    Both are means of 60 renders with 432 values each: standard errors of 1.3 %. A tolerance of 8 % fails once in 10⁹
    times.
    """
    n, truth, squares = 4, RNG.uniform(0.2, 2, SIZE), []
    for _ in range(60):
        tree = PassTree()
        for _ in range(passes):
            values = truth * (0.5 + (np.arange(n)[:, None, None, None] + RNG.random((n, *SIZE))) / n)
            tree.add(PassSums(n, 1, values.sum(0), np.zeros(SIZE), values.var(0) * n))
        error = relative_error(tree.sums())
        squares.append((error.value**2, true_error(tree.sums(), truth) ** 2))
        assert error.at_most == at_most
    estimated, true = np.mean(squares, 0)
    assert estimated == pytest.approx(true * (n * n + n + 1 if at_most else 1), rel=0.08)


MOST = int(binom.ppf(0.999, 500, 0.05))  # more renders of 500 are beyond a limit of 5 % once in 1000 tests


@pytest.mark.parametrize(
    ("kind", "bound", "reliable"),
    [(kind, "high", True) for kind in ("normal", "exponential", "rare")] + [("rare", "value", False)],
)
def test_a_render_ends_above_its_error_limit_with_at_most_5_percent(kind, bound, reliable):
    """The limit is exactly the error that 12 passes have on average, so an estimate ends a render by chance.

    If the estimate without its interval ends the render, more renders are above the limit, so this test can fail.
    """
    truth, above = np.ones(SIZE), 0
    limit = math.sqrt({"normal": 1, "exponential": 1, "rare": 19}[kind] / 48)
    for _ in range(500):
        tree = PassTree()
        while not tree.passes or not getattr(relative_error(tree.sums()), bound) <= limit:
            for _ in range(next_stop(tree.passes) - tree.passes):
                tree.add(leaf(noisy(kind, truth, 4)))
        above += true_error(tree.sums(), truth) > limit
    assert bool(above <= MOST) is reliable


# Student's t at 97.5 % for 1 to 3 degrees of freedom, from tables.
@pytest.mark.parametrize("contrasts, t", [([1.0, 3.0], 12.7062), ([4.0, 5.0, 6.0], 4.30265), ([1, 2, 3, 2], 3.18245)])
def test_the_interval_is_the_prediction_interval_of_one_more_contrast(contrasts, t):
    """It is s² ± t s_c √(1 + 1/m), converted to an error by √(s²/n) / mean."""
    sums = PassSums(100, len(contrasts) + 1, np.full(SIZE, 200.0), np.zeros(SIZE), contrasts=contrasts)
    squared, half = np.mean(contrasts), t * np.std(contrasts, ddof=1) * math.sqrt(1 + 1 / len(contrasts))
    error = relative_error(sums)
    expected = [math.sqrt(max(x, 0) / 100) / 2 for x in (squared, squared - half, squared + half)]
    assert [error.value, error.low, error.high] == pytest.approx(expected, rel=1e-3)  # t has six digits


def test_the_error_of_one_pass_or_a_black_image_and_the_interval_of_two_passes_are_unknown():
    assert math.isnan(relative_error(leaf(np.ones(SIZE))).value)
    assert math.isnan(relative_error(tree_of([np.zeros(SIZE)] * 9).sums()).value)
    two = relative_error(tree_of(noisy("normal", np.ones(SIZE), 4) for _ in range(2)).sums())
    assert two.value > 0 and math.isnan(two.high) and not two.high <= 1 and not RelativeError(math.nan).high <= 1


def test_there_is_no_interval_without_scipy(monkeypatch):
    nine = tree_of(noisy("normal", np.ones(SIZE), 4) for _ in range(9)).sums()
    require_interval()
    monkeypatch.setitem(sys.modules, "scipy.stats", None)
    assert relative_error(nine).value > 0 and math.isnan(relative_error(nine).high)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"pip install 'mi-refract\[diff\]'"):
        require_interval()


def test_non_finite_pixels_are_left_out():
    images = [noisy("normal", np.ones(SIZE), 4) for _ in range(32)]
    images[3][0, 0, 0], images[3][1, 1] = np.nan, np.inf
    sums = tree_of(images).sums()
    assert relative_error(sums).value == pytest.approx(1 / math.sqrt(128), rel=0.1)
    assert worst_tile(sums) == pytest.approx(1 / math.sqrt(128), rel=0.2)


@pytest.mark.parametrize(
    ("side", "truth", "noise", "expected"),
    [
        (192, 1.0, {(16, 16): 5, (32, 32): 1}, 1 / 4),  # of 144 tiles, one has the noise 5, three 1 and all others 0.1
        (64, 0.0, {}, 0.01 / 4),  # a dark tile counts as if it had 1 % of the mean
    ],
)
def test_the_worst_tile_leaves_out_one_percent_of_the_tiles(side, truth, noise, expected):
    image, deviation = np.ones((side, side, 1)), np.full((side, side, 1), 0.1 if noise else 1e-4)
    image[:16, :16] = truth
    for (height, width), value in reversed(noise.items()):
        deviation[:height, :width] = value
    sums = tree_of(RNG.normal(image, deviation) for _ in range(16)).sums()
    assert worst_tile(sums) == pytest.approx(expected, rel=0.1)


def test_black_tiles_are_left_out():
    """Of 1024 tiles only 8 have light."""
    image = np.zeros((512, 512, 1))
    image[:16, :128] = 1
    sums = tree_of(RNG.normal(image, 0.1 * image) for _ in range(16)).sums()
    assert worst_tile(sums) == pytest.approx(0.1 / 4, rel=0.1)

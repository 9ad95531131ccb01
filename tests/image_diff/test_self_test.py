"""The self-test plants the named defects, and fails if a method detects nothing or always alarms."""

import numpy as np
import pytest
from scipy import stats

from mi_refract.image_diff import methods, self_test
from mi_refract.image_diff.comparison import Comparison, Verdict
from mi_refract.image_diff.self_test import DEFECTS, through_a_file
from mi_refract.io import image_file
from mi_refract.io.image_file import srgb_encode

IMAGE = 0.2 + 0.8 * np.random.default_rng(5).random((32, 32, 3))
RAW = np.random.default_rng(3).gamma(0.5, 1.0, (6, 9, 3)).astype(np.float32)
PADDED = np.pad(RAW, ((1, 1), (1, 1), (0, 0)), mode="edge")


def renders(count, seed=1, spread=0.02):
    """Independent renders of one image, with noise of a skewed distribution."""
    shape = spread**-2
    return IMAGE * np.random.default_rng(seed).gamma(shape, 1 / shape, (count, *IMAGE.shape))


def examined(pixels, **how):
    return {row.subject: row for row in self_test.examine(pixels, "noise", **how)}


def failed(rows):
    return {name for name, row in rows.items() if row.verdict == "fail"}


# Defects -----------------------------------------------------------------------------------------------------------


def one_pixel(value):
    image = RAW.copy()
    image[3, 4] = value
    return image


EXPECTED = {
    "gain": 1.01 * RAW,
    "shift": np.concatenate([RAW[:, -1:], RAW[:, :-1]], 1),
    "swapped channels": np.stack([RAW[..., i] for i in (2, 1, 0)], -1),
    "blur": sum(PADDED[y : y + 6, x : x + 9] for y in range(3) for x in range(3)) / 9,
    "firefly": one_pixel(1e3 * RAW.mean()),
    "NaN": one_pixel(np.nan),
    "Inf": one_pixel(np.inf),
    "wrong size": RAW[:, 1:],
}


@pytest.mark.parametrize("name", EXPECTED)
def test_defects_are_planted_as_named(name):
    clean = np.stack([RAW, RAW + 1, RAW + 2])
    spoilt = DEFECTS[name].spoil(clean)
    np.testing.assert_allclose(spoilt[0], EXPECTED[name], rtol=1e-5, atol=1e-7)
    once = name in ("NaN", "Inf", "wrong size")  # planted in one of the renders; every method must see these
    assert (DEFECTS[name].always_due, np.array_equal(spoilt[2], clean[2])) == (once, once)
    np.testing.assert_array_equal(clean[0], RAW)


def test_8_bits_have_256_values_and_truncated_files_are_errors():
    codes = 255 * srgb_encode(DEFECTS["8 bits"].plant(RAW))
    np.testing.assert_allclose(codes, np.rint(codes), atol=2e-4)
    assert (np.abs(codes - 255 * srgb_encode(np.minimum(RAW, 1))) <= 0.501).all()
    assert (np.rint(codes)[RAW > 1] == 255).all() and (RAW > 1).any()
    np.testing.assert_array_equal(through_a_file(RAW), RAW)
    assert DEFECTS["truncated"].always_due
    with pytest.raises(ValueError):
        DEFECTS["truncated"].spoil(RAW[None])


# Detection ---------------------------------------------------------------------------------------------------------


def test_due_defects_are_seen_and_equal_pairs_cause_no_alarm():
    rows = examined(renders(12), trials=4, null_pairs=40)
    assert not failed(rows)
    for name, defect in DEFECTS.items():
        values = rows[name].values
        if name == "truncated":  # no method is applied to unreadable files
            assert values == {self_test.UNREADABLE: 1, "missed": 0} and rows[name].reason == "not read"
        elif defect.always_due:
            assert rows[name].replay["due"] == list(methods.METHODS)
            assert {values[method] for method in methods.METHODS} == {1}
        else:
            assert values["exact"] == 1
    gain = rows["gain"].values
    assert gain["size"] == pytest.approx(0.01, rel=1e-3) and gain["welch"] == 1
    assert gain[self_test.RATIO] > 1  # the noise of a tile is 0.02/√(256 × 6), so the defect is due
    assert rows["renders"].values["noise"] == pytest.approx(0.02, rel=0.1)
    nulls = [rows[f"null pairs, {method}"] for method in methods.METHODS]
    assert {row.values["false alarms"] for row in nulls} == {0}
    assert rows["null pairs, welch"].values["null pairs"] == 40
    assert {row.subject for row in nulls if row.reason == self_test.IDENTICAL} == {"null pairs, exact"}


def test_the_size_of_a_defect_is_that_in_the_tile_where_it_is_most_detectable():
    """Three tiles with noise, one without light, one without noise. The median noise is 0.2 of the mean."""
    mean = np.array([[[1.0], [2.0], [4.0], [0.0], [1.0]]])
    spread = np.array([[[0.1], [0.4], [3.2], [0.5], [0.0]]])  # the standard deviation of the two values of `clean`
    clean = np.stack([mean + spread / np.sqrt(2), mean - spread / np.sqrt(2)])
    changes = np.array([[[-0.05], [0.1], [0.72], [9.0], [9.0]]])
    tally = self_test.Tally(detectable=[0.01, 0.02, 0.04])
    sizes = self_test.sizes(np.stack([changes, changes]), clean, {"welch": tally, "exact": self_test.Tally()})
    # 5 % in the quietest tile, 5 % in the median one, 18 % in one four times as noisy.
    assert sizes["size"] == pytest.approx(0.05) and sizes[self_test.DETECTABLE] == 0.02
    assert sizes[self_test.RATIO] == pytest.approx(0.05 / 0.02)
    louder = self_test.sizes((changes * [[[1], [1], [2], [1], [1]]])[None], clean, {"welch": tally})
    assert (louder["size"], louder[self_test.RATIO]) == pytest.approx((0.36, 0.36 / (0.02 * 4)))
    unknown = self_test.sizes(changes[None], clean, {"welch": self_test.Tally()})
    assert np.isnan(unknown[self_test.RATIO]) and unknown["size"] == pytest.approx(0.05)
    equal, only_dark = np.stack([0.1 * mean] * 6), np.stack([mean, mean])
    only_dark[0, 0, 3] = 1e-4
    for pixels, method in ((clean[:1], "welch"), (clean, "exact"), (equal, "welch"), (only_dark, "welch")):
        assert self_test.sizes(changes[None], pixels, {method: tally}) == {}
    lit = np.array([[[2.0], [2.0], [0.0], [0.0]]])  # `noise` is that of the lit pixels
    assert self_test.noise(np.stack([lit * 0.9, lit * 1.1])) == pytest.approx(0.2 * np.sqrt(2) / 2)
    assert self_test.noise(np.zeros((3, 2, 2, 3))) == 0


def test_renders_are_read_with_the_same_order_of_channels(tmp_path):
    pixels = renders(2).astype(np.float32)
    image_file.write_exr(tmp_path / "0.exr", pixels[0], ("R", "G", "B"))
    image_file.write_exr(tmp_path / "1.exr", pixels[1][..., [2, 0, 1]], ("B", "R", "G"))
    images = self_test.read_images(tmp_path)
    assert images.shape == pixels.shape
    for image in pixels:  # one of the renders is equal, in the order of either file
        assert any(np.array_equal(x[..., order], image) for x in images for order in ([0, 1, 2], [1, 2, 0]))
    assert np.ptp(images.mean((1, 2)), axis=0).max() < 1e-3  # channels differ by 9e-3, renders by a few 1e-4


def test_null_pairs_of_single_images_differ_in_their_last_bits(monkeypatch):
    """So that a method that calls every changed bit a difference fails; with identical images it would not."""
    pixels = IMAGE.astype(np.float32)
    moved = self_test.last_bits(pixels, np.random.default_rng(1))
    steps = np.abs(moved.view(np.int32) - pixels.view(np.int32))
    assert (steps == 1).all() and 0.4 < (moved > pixels).mean() < 0.6
    real = methods.compare
    monkeypatch.setattr(methods, "compare", lambda m, *sides: real("exact" if m != "welch" else m, *sides))
    rows = self_test.false_alarms([], [(pixels[None], pixels[None])] * 3, "noise", "")
    assert failed({row.subject: row for row in rows}) == {f"null pairs, {x}" for x in ("tolerance", "paired", "flip")}


@pytest.mark.parametrize("method", methods.METHODS)
def test_a_method_that_always_says_equal_fails(method, monkeypatch):
    """It calls all images equal, even with NaN or other sizes, and reports a minimum detectable difference of 1e-4."""
    real = methods.compare
    blind = Comparison(method, Verdict.EQUAL, "", minimum_detectable=1e-4)
    monkeypatch.setattr(methods, "compare", lambda m, *sides: blind if m == method else real(m, *sides))
    rows = examined(renders(8), trials=2, null_pairs=2)
    always = {name for name, defect in DEFECTS.items() if defect.always_due and name != "truncated"}
    expected = {"exact": set(DEFECTS) - {"truncated"}, "welch": always | {"gain", "shift", "8 bits", "firefly"}}
    assert failed(rows) >= expected.get(method, always)
    assert rows["NaN"].values["missed"] == 2


def test_a_method_that_reports_no_detectable_difference_of_noise_must_see_all_defects(monkeypatch):
    real = methods.compare
    blind = Comparison("welch", Verdict.INCONCLUSIVE, "")
    monkeypatch.setattr(methods, "compare", lambda m, *sides: blind if m == "welch" else real(m, *sides))
    assert failed(examined(renders(8), trials=1, null_pairs=1)) == set(DEFECTS) - {"truncated"}
    without_noise = examined(np.stack([IMAGE] * 8), trials=1, null_pairs=1)
    assert failed(without_noise) == {name for name in DEFECTS if DEFECTS[name].always_due} - {"truncated"}


def test_methods_that_always_say_different_or_inconclusive_fail(monkeypatch):
    monkeypatch.setattr(methods, "compare", lambda m, *sides: Comparison(m, Verdict.DIFFERENT, ""))
    assert failed(examined(renders(8), trials=1, null_pairs=5)) == {f"null pairs, {m}" for m in methods.METHODS}
    monkeypatch.setattr(methods, "compare", lambda m, *sides: Comparison(m, Verdict.INCONCLUSIVE, ""))
    rows = examined(renders(8), trials=1, null_pairs=5)
    assert rows["null pairs, welch"].values["inconclusive"] == 1
    assert rows["gain"].values["exact"] == 0 and "gain" in failed(rows)


@pytest.mark.parametrize(("alarms", "pairs"), [(0, 640), (2, 640), (3, 640), (10, 10)])
def test_the_bound_of_the_rate_is_the_exact_binomial_one(alarms, pairs):
    bound = self_test.Tally(seen=alarms, trials=pairs).bound
    probability = stats.binom.cdf(alarms, pairs, bound)
    assert probability == pytest.approx(1 if alarms == pairs else 1 - self_test.CONFIDENCE)
    assert (bound <= self_test.FALSE_ALARMS) == (alarms <= 2)


def test_rows_and_methods_that_are_left_out():
    """A defect that changes nothing, files that cannot be read, and `welch` with fewer than two renders a side."""
    grey = np.repeat(renders(4)[:, :16, :16, :1], 3, axis=3)
    four, three = (examined(pixels, trials=1, null_pairs=2) for pixels in (grey, grey[:3]))
    assert four["swapped channels"].verdict == "not run" and "changes nothing" in four["swapped channels"].reason
    assert four["null pairs, welch"].values["null pairs"] == 2 and "noise" in four["renders"].values
    assert "null pairs, welch" not in three and three["renders"].verdict == "not run"
    # With three images there are at most three trials.
    assert examined(grey[:3])["gain"].replay["trials"] == 3
    # A black render leaves out its own trials only.
    with_black = np.concatenate([np.zeros_like(grey[:1]), grey])
    gain = examined(with_black, null_pairs=2)["gain"]
    assert gain.values["exact"] == 1 and 0 < gain.replay["trials"] < self_test.TRIALS
    several = {name for name, method in methods.METHODS.items() if method.takes_renders}

    def unreadable():
        raise ValueError("truncated")

    for count, applied in ((2, methods.METHODS.keys()), (1, methods.METHODS.keys() - several)):
        clean, other = renders(count), renders(count, seed=2)
        trials = [self_test.Trial(clean, other, plant) for plant in (lambda clean=clean: 2 * clean, unreadable)]
        row = self_test.detection("gain", True, trials, "", "")
        assert methods.METHODS.keys() & row.values.keys() == applied
        assert row.values["exact"] == 1 and row.values["missed"] == 0
        same = [self_test.Trial(clean, other, plant) for plant in (lambda clean=clean: clean, unreadable)]
        assert self_test.detection("gain", True, same, "", "").reason == "not read"

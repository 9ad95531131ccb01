"""The self-test sees planted defects, and fails where a method is blind or alarms at everything."""

import numpy as np
import pytest

from mi_refract.image_diff import methods, self_test
from mi_refract.image_diff.comparison import Comparison, Verdict
from mi_refract.image_diff.self_test import DEFECTS
from mi_refract.io import image_file

IMAGE = 0.2 + 0.8 * np.random.default_rng(5).random((32, 32, 3))


def renders(count, seed=1, spread=0.02):
    """Independent noisy renders of one image, of a skewed distribution."""
    shape = spread**-2
    return IMAGE * np.random.default_rng(seed).gamma(shape, 1 / shape, (count, *IMAGE.shape))


def by_subject(rows):
    return {row.subject: row for row in rows}


@pytest.fixture(scope="module")
def found():
    return by_subject(self_test.examine(renders(12), "noise", trials=4, null_pairs=40))


@pytest.mark.parametrize("name", DEFECTS)
def test_what_is_due_is_seen(found, name):
    row = found[name]
    assert row.verdict == "pass"
    if name == "truncated":  # no method is asked of what cannot be read
        assert row.values == {self_test.UNREADABLE: 1, "missed": 0} and row.reason == "not read"
        return
    assert row.values["exact"] == 1
    if DEFECTS[name].always_due:
        assert row.replay["due"] == list(methods.METHODS)
        assert {row.values[method] for method in methods.METHODS} == {1}


def test_the_size_of_a_defect_is_measured(found):
    assert found["gain"].values["size"] == pytest.approx(0.01, rel=1e-3)
    assert found["gain"].values[self_test.RATIO] > 1  # 0.02/√(256 × 6) a tile: due
    assert found["gain"].values["welch"] == 1
    assert found["renders"].values["noise"] == pytest.approx(0.02, rel=0.1)


def test_a_defect_is_as_large_as_in_the_tile_where_it_stands_out():
    """Three tiles with noise, one without light, one without noise. The median noise is 0.2 of the mean."""
    mean = np.array([[[1.0], [2.0], [4.0], [0.0], [1.0]]])
    spread = np.array([[[0.1], [0.4], [3.2], [0.5], [0.0]]])  # of two values: their deviation is √2 of it
    clean = np.stack([mean + spread / np.sqrt(2), mean - spread / np.sqrt(2)])
    changes = np.array([[[-0.05], [0.1], [0.72], [9.0], [9.0]]])
    tally = self_test.Tally(detectable=[0.01, 0.02, 0.04])
    found = self_test.sizes(np.stack([changes, changes]), clean, {"welch": tally, "exact": self_test.Tally()})
    # 5 % in the quietest tile, 5 % in the median one, 18 % in one four times as noisy.
    assert found["size"] == pytest.approx(0.05)
    assert found[self_test.RATIO] == pytest.approx(0.05 / 0.02)
    assert found[self_test.DETECTABLE] == 0.02
    louder = changes * [[[1], [1], [2], [1], [1]]]
    found = self_test.sizes(louder[None], clean, {"welch": tally})
    assert (found["size"], found[self_test.RATIO]) == pytest.approx((0.36, 0.36 / (0.02 * 4)))
    assert self_test.sizes(changes[None], clean[:1], {"welch": tally}) == {}
    assert self_test.sizes(changes[None], clean, {"welch": self_test.Tally()}) == {}
    assert self_test.sizes(changes[None], np.stack([mean, mean]), {"welch": tally}) == {}


def test_the_noise_is_that_of_the_lit_pixels():
    one, dark = np.full((1, 4, 1), 2.0), np.array([[[1.0], [1.0], [0.0], [0.0]]])
    found = self_test.noise(np.stack([one * dark * 0.9, one * dark * 1.1]))
    assert found == pytest.approx(0.2 * np.sqrt(2) / 2)
    assert self_test.noise(np.zeros((3, 2, 2, 3))) == 0


def test_renders_are_read_in_one_order_of_channels(tmp_path):
    pixels = renders(2).astype(np.float32)
    image_file.write_exr(tmp_path / "0.exr", pixels[0], ("R", "G", "B"))
    image_file.write_exr(tmp_path / "1.exr", pixels[1][..., [2, 0, 1]], ("B", "R", "G"))
    found = self_test.read_images(tmp_path)
    assert found.shape == pixels.shape
    for image in pixels:  # of all renders one is this, in the order of either file
        assert any(np.array_equal(each[..., order], image) for each in found for order in ([0, 1, 2], [1, 2, 0]))
    assert np.ptp(found.mean((1, 2)), axis=0).max() < 1e-3  # channels differ by 9e-3, renders by a few 1e-4
    image_file.write_exr(tmp_path / "1.exr", pixels[1], ("R", "G", "A"))
    with pytest.raises(ValueError, match="size or channels differ from those of"):
        self_test.read_images(tmp_path)


def test_equal_pairs_alarm_nowhere(found):
    rows = [found[f"null pairs, {method}"] for method in methods.METHODS]
    assert all(row.verdict == "pass" and row.values["false alarms"] == 0 for row in rows)
    assert found["null pairs, welch"].values["null pairs"] == 40
    assert {row.subject for row in rows if row.reason == self_test.IDENTICAL} == {"null pairs, exact"}


def test_single_images_are_equal_but_for_their_last_bits(monkeypatch):
    """A method that calls every changed bit a difference alarms; the same image twice would not show it."""
    pixels = IMAGE.astype(np.float32)
    moved = self_test.last_bits(pixels, np.random.default_rng(1))
    steps = np.abs(moved.view(np.int32) - pixels.view(np.int32))
    assert (steps == 1).all() and 0.4 < (moved > pixels).mean() < 0.6
    real = methods.compare
    monkeypatch.setattr(methods, "compare", lambda m, *sides: real("exact" if m != "welch" else m, *sides))
    rows = by_subject(self_test.false_alarms([], [(pixels[None], pixels[None])] * 3, "noise", ""))
    assert {name for name, row in rows.items() if row.verdict == "fail"} == {
        f"null pairs, {method}" for method in ("tolerance", "paired", "flip")
    }


def test_where_only_some_files_cannot_be_read_the_methods_are_asked_of_the_others():
    def unread():
        raise ValueError("truncated")

    clean, other = np.split(renders(8), 2)
    trials = [self_test.Trial(clean, other, lambda: 1.5 * clean), self_test.Trial(clean, other, unread)]
    row = self_test.detection("gain", True, trials, "noise", "")
    assert row.values["exact"] == row.values["welch"] == 1 and row.values["missed"] == 0


@pytest.mark.parametrize("method", methods.METHODS)
def test_a_blind_method_fails(method, monkeypatch):
    """It says of everything, NaN and other sizes included, that it is equal, and that it would have seen 1e-4."""
    real = methods.compare
    blind = Comparison(method, Verdict.EQUAL, "", minimum_detectable=1e-4)
    monkeypatch.setattr(methods, "compare", lambda m, *sides: blind if m == method else real(m, *sides))
    rows = by_subject(self_test.examine(renders(8), "noise", trials=2, null_pairs=2))
    failed = {name for name, row in rows.items() if row.verdict == "fail"}
    always = {name for name, defect in DEFECTS.items() if defect.always_due and name != "truncated"}
    expected = {"exact": set(DEFECTS) - {"truncated"}, "welch": always | {"gain", "shift", "8 bits", "firefly"}}
    assert failed >= expected.get(method, always)
    assert rows["NaN"].values["missed"] == 2


def test_a_method_that_cries_wolf_fails(monkeypatch):
    monkeypatch.setattr(methods, "compare", lambda m, *sides: Comparison(m, Verdict.DIFFERENT, ""))
    rows = self_test.examine(renders(8), "noise", trials=1, null_pairs=5)
    assert {row.subject for row in rows if row.verdict == "fail"} == {f"null pairs, {m}" for m in methods.METHODS}
    monkeypatch.setattr(methods, "compare", lambda m, *sides: Comparison(m, Verdict.INCONCLUSIVE, ""))
    rows = by_subject(self_test.examine(renders(8), "noise", trials=1, null_pairs=5))
    assert rows["null pairs, welch"].values["inconclusive"] == 1
    assert rows["gain"].values["exact"] == 0
    assert rows["gain"].verdict == "fail"


@pytest.mark.parametrize(("alarms", "pairs"), [(0, 640), (2, 640), (3, 640), (10, 10)])
def test_the_bound_is_where_so_few_alarms_have_the_probability_left(alarms, pairs):
    from scipy import stats

    bound = self_test.Tally(seen=alarms, trials=pairs).bound
    left = stats.binom.cdf(alarms, pairs, bound)
    assert left == pytest.approx(1 if alarms == pairs else 1 - self_test.CONFIDENCE)
    assert (bound <= self_test.FALSE_ALARMS) == (alarms <= 2)


def test_a_defect_that_changes_nothing_is_left_out():
    grey = np.repeat(renders(4)[..., :1], 3, axis=3)
    rows = by_subject(self_test.examine(grey, "grey", trials=1, null_pairs=1))
    assert rows["swapped channels"].verdict == "not run"
    assert "changes nothing" in rows["swapped channels"].reason


def test_four_renders_are_split_and_three_are_not(monkeypatch):
    monkeypatch.setattr(self_test, "DEFECTS", {})
    small = renders(4)[:, :16, :16]
    four, three = (by_subject(self_test.examine(some, "noise", null_pairs=2)) for some in (small, small[:3]))
    assert four["null pairs, welch"].values["null pairs"] == 2 and "noise" in four["renders"].values
    assert "null pairs, welch" not in three and three["renders"].verdict == "not run"


def test_a_method_that_takes_renders_is_asked_where_there_are_two_a_side():
    several = {name for name, method in methods.METHODS.items() if method.takes_renders}
    for count, asked in ((2, methods.METHODS.keys()), (1, methods.METHODS.keys() - several)):
        clean = renders(count)
        trial = self_test.Trial(clean, renders(count, seed=2), lambda clean=clean: 2 * clean)
        assert methods.METHODS.keys() & self_test.detection("gain", True, [trial], "", "").values.keys() == asked

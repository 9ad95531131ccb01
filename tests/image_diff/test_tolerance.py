"""`tolerance`: the counts of OpenImageIO, `idiff`'s order of bounds, and the words that name the bound that failed."""

from __future__ import annotations

import numpy as np
import OpenImageIO as oiio
import pytest
from support.diff_images import of as image

from mi_refract.image_diff.comparison import Verdict, passes_black
from mi_refract.image_diff.idiff_flags import parse
from mi_refract.image_diff.methods import compare
from mi_refract.image_diff.pixelwise import tolerance, tolerance_accepts_black

THRESHOLDS = (0.0, 1e-6, 1 / 255, 0.004, 0.01, 0.1, 1.0)
FACTORS = (1, 1, 1, 0.5, 2, 1 + 6e-8, 1 - 6e-8, 1 + 1e-6)
EQUAL, DIFFERENT, INCONCLUSIVE = Verdict.EQUAL, Verdict.DIFFERENT, Verdict.INCONCLUSIVE


def random_pair(rng):
    """Differences of exactly a threshold in float32 among them, also relative to the mean of both."""
    shape = *rng.integers(1, 9, 2), 3
    a = (rng.choice([1, -1, 100, 1e-3]) * rng.random(shape)).astype(np.float32)
    share = np.float32(rng.choice(THRESHOLDS[:-1])) * np.float32(rng.choice(FACTORS))
    if rng.random() < 0.3:
        return a, (a * (1 + share / 2) / (1 - share / 2)).astype(np.float32)  # by that share of the mean
    if rng.random() < 0.5:
        a[:] = 0
    return a, np.where(rng.random(shape) < 0.3, a + share, a).astype(np.float32)


def counts(a, b, options):
    """OpenImageIO's own: nfail, maxerror, meanerror, rms_error, nwarn."""
    names = ("fail", "warn", "fail_relative", "warn_relative")
    return oiio.ImageBufAlgo.compare(oiio.ImageBuf(a), oiio.ImageBuf(b), *(options[name] for name in names))


def expected(a, b, options):
    """The verdict and whether there is a warning, from OpenImageIO's counts, as `idiff` asks for them."""
    found = counts(a, b, options)
    single, pixels = np.float32, a[..., 0].size
    if found.nfail <= options["allow_failures"]:
        return EQUAL, False
    share = {each: float(single(options[f"{each}_percent"])) / 100 * pixels for each in ("fail", "warn")}
    if found.nfail > share["fail"] or found.maxerror > single(options["hard_fail"]):
        return DIFFERENT, False
    return EQUAL, bool(found.nwarn > share["warn"] or found.maxerror > single(options["hard_warn"]))


def test_random_images_and_thresholds():
    rng = np.random.default_rng(7)
    seen = {}
    for _ in range(2000):
        a, b = random_pair(rng)
        options = {name: float(rng.choice(THRESHOLDS)) for name in parse("").options}
        options |= {f"{x}_percent": float(rng.choice([0, 5, 12.5, 100 / 3, 50, 100])) for x in ("fail", "warn")}
        options |= {
            "allow_failures": int(rng.choice([0, 0, 1, 3])),
            "hard_fail": float(rng.choice([*THRESHOLDS, np.inf])),
        }
        if rng.random() < 0.4:  # what leads to a warning
            options |= {"fail": 1e-6, "fail_relative": 0.0, "fail_percent": 50.0, "hard_fail": 1.0}
        found = tolerance(image(a), image(b), **options)
        key = expected(a, b, options)
        assert (found.verdict, bool(found.warning)) == key, (a, b, options, found.reason)
        assert all(metric.holds for metric in found.metrics) is (found.verdict is EQUAL)
        own = counts(a, b, options)
        values = [own.nfail, own.maxerror, own.meanerror, own.rms_error, own.nwarn]
        np.testing.assert_allclose([metric.value for metric in found.metrics], values, rtol=1e-5, atol=1e-30)
        seen[key] = seen.get(key, 0) + 1
    assert min(seen[EQUAL, False], seen[EQUAL, True], seen[DIFFERENT, False]) > 40, seen


def test_the_ends_of_the_thresholds():
    """At a threshold nothing differs yet; ratios are of float32 means, percentages float32, as in `idiff`."""
    a, b = image(np.full((1, 5, 3), 1.5)), image(np.full((1, 5, 3), 0.5))
    assert tolerance(a, b, fail=1.0).verdict is EQUAL
    assert tolerance(a, b, fail=0.999, fail_relative=1.0).verdict is EQUAL
    assert tolerance(a, b, fail=0.999, fail_relative=0.999).verdict is DIFFERENT
    tiny = [image(np.full((1, 5, 3), x, np.float32)) for x in (1e-45, 0.0)]  # whose mean is 0 in float32
    assert tolerance(*tiny, fail=0.0, fail_relative=0.0).verdict is EQUAL
    one = np.full((1, 5, 3), 0.5, np.float32)
    one[0, 0] = 1
    # 1/5 is 20 %; the number next below it in float64 is 20 in float32.
    for percent, verdict in ((20.0, EQUAL), (np.nextafter(20.0, 0), EQUAL), (19.99, DIFFERENT)):
        found = tolerance(image(np.full((1, 5, 3), 0.5)), image(one), fail_percent=float(percent))
        assert found.verdict is verdict


SIX = np.full((20, 30, 3), 0.5, np.float32)  # of 600 pixels 6 differ, one by more
SIX[3, :6, 1] += 0.02
SIX[3, 4, 1] += 0.03
FLAT = np.full((20, 30, 3), 0.5, np.float32)


@pytest.mark.parametrize(
    "options, verdict, reason",
    [
        (
            {"fail": 0.01, "fail_percent": 0.5},
            DIFFERENT,
            "1 % of the pixels (6 of 600) differ by more than fail = 0.01 (> fail_percent = 0.5); "
            "largest difference 0.05 at x = 4, y = 3, channel G",
        ),
        (
            {"fail": 0.01, "fail_percent": 1, "hard_fail": 0.03},
            DIFFERENT,
            "largest difference 0.05 > hard_fail = 0.03 at x = 4, y = 3, channel G; "
            "1 % of the pixels (6 of 600) differ by more than fail = 0.01 (≤ fail_percent = 1)",
        ),
        (
            {"fail": 0.01, "allow_failures": 5, "hard_fail": 0.03},
            DIFFERENT,
            "1 % of the pixels (6 of 600) differ by more than fail = 0.01 (> fail_percent = 0, allow_failures = 5); "
            "largest difference 0.05 > hard_fail = 0.03 at x = 4, y = 3, channel G",
        ),
        (
            {"fail": 0.01, "fail_relative": 0.03, "allow_failures": 6, "hard_fail": 0.03},
            EQUAL,
            "1 % of the pixels (6 of 600) differ by more than fail = 0.01, fail_relative = 0.03 "
            "(≤ allow_failures = 6); largest difference 0.05 at x = 4, y = 3, channel G",
        ),
        (
            {"fail": 0.1, "hard_fail": 0.03},
            EQUAL,
            "no pixel of 600 differs by more than fail = 0.1; largest difference 0.05 at x = 4, y = 3, channel G",
        ),
    ],
)
def test_the_bound_that_failed_is_named_first(options, verdict, reason):
    options = {"fail_relative": 0.0, "fail_percent": 0.0} | options
    found = compare("tolerance", image(FLAT), image(SIX), **options)
    assert (found.verdict, found.reason, found.warning) == (verdict, reason, "")


def test_fewer_failures_than_are_allowed_are_said_so():
    found = compare("tolerance", image(FLAT), image(SIX), fail=0.01, allow_failures=300)
    assert found.verdict is EQUAL and "(≤ allow_failures = 300)" in found.reason


def test_a_warning_is_no_failure_and_names_its_bounds():
    options = {"fail": 0.01, "fail_percent": 1.0, "warn": 0.03, "hard_warn": 0.04}
    found = compare("tolerance", image(FLAT), image(SIX), **options)
    assert found.verdict is EQUAL
    assert found.warning == (
        "0.167 % of the pixels (1 of 600) differ by more than warn = 0.03 (> warn_percent = 0); "
        "largest difference 0.05 > hard_warn = 0.04"
    )
    quiet = {"warn_percent": 0.2, "hard_warn": 0.06}
    assert compare("tolerance", image(FLAT), image(SIX), **options | quiet).warning == ""
    different = compare("tolerance", image(FLAT), image(SIX), **options | {"fail_percent": 0.5})
    assert (different.verdict, different.warning) == (DIFFERENT, "")


def test_failures_that_are_allowed_would_let_black_pass():
    """A method that allows as many pixels as there are sees nothing."""
    bright = image(np.full((3, 3, 3), 0.5))
    other = image(np.full((3, 3, 3), 0.4))
    assert compare("tolerance", bright, other, allow_failures=8).verdict is DIFFERENT
    found = compare("tolerance", bright, other, allow_failures=9)
    assert found.verdict is INCONCLUSIVE
    assert found.reason.startswith("an all-black image would pass, too, with ")


def test_where_black_is_accepted_is_where_it_passes_alone():
    rng = np.random.default_rng(3)
    pixels = rng.choice([0.0, 0.003, 0.004, 0.05, 0.5], (8, 8, 3)).astype(np.float32)
    options = {**parse("-fail .004 -hardfail .001").options}
    accepted = tolerance_accepts_black(pixels, options)
    for y, x in np.ndindex(8, 8):
        assert accepted[y, x] == passes_black(tolerance, [image(pixels[y : y + 1, x : x + 1])], options)


@pytest.mark.parametrize(
    "options, verdict",
    [
        ({}, EQUAL),
        ({"fail": 0.005}, DIFFERENT),
        ({"fail": 0.005, "fail_relative": 0.5}, EQUAL),
        ({"fail": 0.005, "fail_relative": 0.001}, DIFFERENT),
        ({"fail": 0.005, "fail_percent": 0.051}, DIFFERENT),
        ({"fail": 0.005, "fail_percent": 0.053}, EQUAL),
        ({"fail": 0.005, "fail_percent": 0.053, "hard_fail": 0.005}, DIFFERENT),
        ({"hard_fail": 0.005}, EQUAL),  # does not count where no pixel fails
        ({"fail": 0.005, "hard_fail": 0.005, "allow_failures": 1}, EQUAL),
    ],
)
def test_the_thresholds_mean_what_they_mean_for_idiff(options, verdict):
    """One pixel of 1920, 0.052 %, is off by 0.01."""
    reference = np.full((40, 48, 3), 0.5)
    test = reference.copy()
    test[3, 5, 1] += 0.01
    options = {"fail": 0.02, "fail_relative": 0.0, "fail_percent": 0.0} | options
    assert compare("tolerance", image(reference), image(test), **options).verdict is verdict


@pytest.mark.parametrize("by, pixels, verdict", [(0.0039, 9, EQUAL), (0.0041, 1, EQUAL), (0.0041, 2, DIFFERENT)])
def test_the_defaults_allow_a_change_of_0_004_and_more_in_0_02_percent_of_the_pixels(by, pixels, verdict):
    """Of 6000 pixels 1 is 0.017 %, 2 are 0.033 %."""
    reference = np.full((60, 100, 3), 0.5)
    test = reference.copy()
    test[0, :pixels, 1] += by
    assert compare("tolerance", image(reference), image(test)).verdict is verdict


# One outrageous pixel ----------------------------------------------------------------------------------------------


def lit(size, dot=1000.0, at=(7, 9), width=1, channel=slice(None)):
    """A smooth image of mean 1 and its like with a firefly of `dot` times the mean."""
    plain = np.ones((size, size, 3)) + 0.5 * np.sin(np.arange(size) / 9)[:, None, None]
    spoilt = plain.copy()
    spoilt[at[0] : at[0] + width, at[1] : at[1] + width, channel] = dot
    return image(plain), image(spoilt)


@pytest.mark.parametrize("dot, channel", [(1000.0, slice(None)), (500.0, 1), (-500.0, 1)])
@pytest.mark.parametrize("size", [64, 71, 256, 1024])
def test_auto_sees_one_outrageous_pixel_at_any_size(size, dot, channel):
    """`tolerance` itself lets 0.02 % of the pixels be anything: from 71² on that is one."""
    plain, spoilt = lit(size, dot, channel=channel)
    for sides in ((plain, spoilt), (spoilt, plain)):
        assert compare("tolerance", *sides).verdict is (EQUAL if size > 64 else DIFFERENT)
        found = compare("auto", *sides)
        assert found.verdict is DIFFERENT
        assert size == 64 or "at x = 9, y = 7" in found.reason


@pytest.mark.parametrize("options", [{"hard_fail": 2000.0}, {"allow_failures": 1}])
def test_options_that_say_what_a_pixel_may_do_decide(options):
    assert compare("auto", *lit(128), **options).verdict is EQUAL


def test_what_a_small_change_makes_is_not_outrageous():
    """A highlight of one pixel that moves by two, the edge of a lamp, and white on a gray display."""
    white = np.full((128, 128, 3), 0.02)
    white[60, 60] = 1.0
    for sides in (
        (lit(128, at=(20, 20))[1], lit(128, at=(21, 22))[1]),
        (lit(256, width=3)[1], lit(256, width=3, at=(8, 9))[1]),
        (image(np.full((128, 128, 3), 0.02)), image(white)),
        (lit(128, 0.3)),
    ):
        assert compare("auto", *sides).verdict is EQUAL

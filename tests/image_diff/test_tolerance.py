"""`tolerance`: agreement with OpenImageIO's counts and `idiff`'s order of bounds, and reasons that name the bound."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from support.diff_images import DIFFERENT, EQUAL, INCONCLUSIVE
from support.diff_images import of as image

from mi_refract.image_diff.comparison import passes_black
from mi_refract.image_diff.methods import compare
from mi_refract.image_diff.pixelwise import tolerance, tolerance_accepts, tolerance_views
from mi_refract.io import image_file

THRESHOLDS = (0.0, 1e-6, 1 / 255, 0.004, 0.01, 0.1, 1.0)
FACTORS = (1, 1, 1, 0.5, 2, 1 + 6e-8, 1 - 6e-8, 1 + 1e-6)
IDIFF = {"fail": 1e-6, "fail_relative": 0.0, "fail_percent": 0.0, "hard_fail": np.inf, "allow_failures": 0}
IDIFF |= {"warn": 1e-6, "warn_relative": 0.0, "warn_percent": 0.0, "hard_warn": np.inf}  # idiff's own defaults


# Agreement with OpenImageIO ----------------------------------------------------------------------------------------


def random_pair(rng):
    """Two images. Some differences are exactly a threshold in float32, absolute or relative to the mean of both."""
    shape = *rng.integers(1, 9, 2), 3
    a = (rng.choice([1, -1, 100, 1e-3]) * rng.random(shape)).astype(np.float32)
    share = np.float32(rng.choice(THRESHOLDS[:-1])) * np.float32(rng.choice(FACTORS))
    if rng.random() < 0.3:
        return a, (a * (1 + share / 2) / (1 - share / 2)).astype(np.float32)  # by that share of the mean
    if rng.random() < 0.5:
        a[:] = 0
    return a, np.where(rng.random(shape) < 0.3, a + share, a).astype(np.float32)


def expected(counts, pixels, options):
    """The verdict and whether there is a warning, from OpenImageIO's counts, in the order of `idiff`."""
    single = np.float32
    if counts.nfail <= options["allow_failures"]:
        return EQUAL, False
    share = {x: float(single(options[f"{x}_percent"])) / 100 * pixels for x in ("fail", "warn")}
    if counts.nfail > share["fail"] or counts.maxerror > single(options["hard_fail"]):
        return DIFFERENT, False
    return EQUAL, bool(counts.nwarn > share["warn"] or counts.maxerror > single(options["hard_warn"]))


def test_verdicts_and_metrics_agree_with_openimageio_for_random_images():
    rng, outcomes = np.random.default_rng(7), {}
    for _ in range(2000):
        a, b = random_pair(rng)
        options = {name: float(rng.choice(THRESHOLDS)) for name in IDIFF}
        options |= {f"{x}_percent": float(rng.choice([0, 5, 12.5, 100 / 3, 50, 100])) for x in ("fail", "warn")}
        options["allow_failures"] = int(rng.choice([0, 0, 1, 3]))
        options["hard_fail"] = float(rng.choice([*THRESHOLDS, np.inf]))
        if rng.random() < 0.4:  # so that warnings occur
            options |= {"fail": 1e-6, "fail_relative": 0.0, "fail_percent": 50.0, "hard_fail": 1.0}
        result = tolerance(image(a), image(b), **options)
        names = ("fail", "warn", "fail_relative", "warn_relative")
        counts = oiio.ImageBufAlgo.compare(oiio.ImageBuf(a), oiio.ImageBuf(b), *(options[name] for name in names))
        outcome = expected(counts, a[..., 0].size, options)
        assert (result.verdict, bool(result.warning)) == outcome, (a, b, options, result.reason)
        assert all(metric.holds for metric in result.metrics) is (result.verdict is EQUAL)
        values = [counts.nfail, counts.maxerror, counts.meanerror, counts.rms_error, counts.nwarn]
        np.testing.assert_allclose([metric.value for metric in result.metrics], values, rtol=1e-5, atol=1e-30)
        outcomes[outcome] = outcomes.get(outcome, 0) + 1
    assert min(outcomes[EQUAL, False], outcomes[EQUAL, True], outcomes[DIFFERENT, False]) > 40, outcomes


@pytest.mark.parametrize(
    "options, code",
    [
        ({"fail": 0.01}, 2),
        ({"fail": 0.02}, 0),
        ({"fail": 0.02, "warn": 0.001}, 0),  # idiff tests for warnings only if a pixel fails
        ({"fail": 0.02, "hard_fail": 0.001}, 0),  # as for hardfail
        ({"fail": 0.001, "fail_percent": 10}, 1),
        ({"fail": 0.001, "fail_percent": 10, "warn": 0.02}, 0),
        ({"fail": 0.001, "fail_percent": 10, "warn": 0.001, "warn_percent": 10}, 0),
        ({"fail": 0.001, "fail_percent": 10, "warn": 0.001, "warn_relative": 0.1}, 0),
        ({"fail": 0.001, "fail_percent": 10, "warn": 0.02, "hard_warn": 0.01}, 1),
        ({"fail": 0.001, "fail_percent": 10, "hard_fail": 0.01}, 2),
        ({"fail": 0.001, "allow_failures": 2, "hard_fail": 0.01}, 0),
        ({"fail": 0.001, "allow_failures": 1, "hard_fail": 0.01}, 2),
        ({"fail": 0.001, "fail_relative": 0.1}, 0),
        ({}, 2),
    ],
)
def test_options_and_exit_codes_agree_with_idiff(options, code, tmp_path):
    """Two pixels of 25 differ by 0.015, one of them in two channels. Exit codes: 1 for a warning, 2 for a failure."""
    a = np.full((5, 5, 3), 0.5, np.float32)
    b = a.copy()
    b[1, 2, :2] += 0.015
    b[4, 4, 2] -= 0.015
    result = tolerance(image(a), image(b), **IDIFF | options)
    assert code == (2 if result.verdict is DIFFERENT else int(bool(result.warning)))
    if program := shutil.which("idiff", path=str(Path(sys.executable).parent)) or shutil.which("idiff"):
        files = [tmp_path / "a.exr", tmp_path / "b.exr"]
        for path, pixels in zip(files, (a, b), strict=True):
            image_file.write_exr(path, pixels)
        flags = [word for name, x in options.items() for word in (f"-{name.replace('_', '')}", str(x))]
        assert subprocess.run([program, *flags, *map(str, files)], capture_output=True, timeout=60).returncode == code


def test_values_exactly_at_the_thresholds_are_equal():
    """As in `idiff`, ratios are relative to float32 means, and percentages are float32."""
    a, b = image(np.full((1, 5, 3), 1.5)), image(np.full((1, 5, 3), 0.5))
    assert tolerance(a, b, fail=1.0).verdict is tolerance(a, b, fail=0.999, fail_relative=1.0).verdict is EQUAL
    tiny = [image(np.full((1, 5, 3), x, np.float32)) for x in (1e-45, 0.0)]  # their mean is 0 in float32
    assert tolerance(*tiny, fail=0.0, fail_relative=0.0).verdict is EQUAL
    one = b.pixels.copy()
    one[0, 0] = 1
    # 1/5 is 20 %; the next smaller number in float64 is 20 in float32.
    for percent, verdict in ((20.0, EQUAL), (np.nextafter(20.0, 0), EQUAL), (19.99, DIFFERENT)):
        assert tolerance(b, image(one), fail_percent=float(percent)).verdict is verdict


# Reasons and warnings ----------------------------------------------------------------------------------------------

FLAT = np.full((20, 30, 3), 0.5, np.float32)
SIX = FLAT.copy()  # 6 of 600 pixels differ, one of them by more
SIX[3, :6, 1] += 0.02
SIX[3, 4, 1] += 0.03
AT = "at x = 4, y = 3, channel G"
DIFFER, LARGE = "1 % of the pixels (6 of 600) differ by more than fail = 0.01", "largest difference 0.05"
HARD, FEW, OVER = {"hard_fail": 0.03}, {"fail_relative": 0.03, "allow_failures": 6}, f"{LARGE} > hard_fail = 0.03 {AT}"
WARNING = (
    "0.167 % of the pixels (1 of 600) differ by more than warn = 0.03 (> warn_percent = 0); "
    "largest difference 0.05 > hard_warn = 0.04"
)
WARN = {"fail_percent": 1.0, "warn": 0.03, "hard_warn": 0.04}


@pytest.mark.parametrize(
    "options, verdict, reason, warning",
    [
        ({"fail_percent": 0.5}, DIFFERENT, f"{DIFFER} (> fail_percent = 0.5); largest difference 0.05 {AT}", ""),
        (HARD | {"fail_percent": 1}, DIFFERENT, f"{OVER}; {DIFFER} (≤ fail_percent = 1)", ""),
        (HARD | {"allow_failures": 5}, DIFFERENT, f"{DIFFER} (> fail_percent = 0, allow_failures = 5); {OVER}", ""),
        (HARD | FEW, EQUAL, f"{DIFFER}, fail_relative = 0.03 (≤ allow_failures = 6); {LARGE} {AT}", ""),
        (HARD | {"fail": 0.1}, EQUAL, f"no pixel of 600 differs by more than fail = 0.1; {LARGE} {AT}", ""),
        ({"allow_failures": 300}, EQUAL, f"{DIFFER} (≤ allow_failures = 300); largest difference 0.05 {AT}", ""),
        (WARN, EQUAL, f"{DIFFER} (≤ fail_percent = 1); largest difference 0.05 {AT}", WARNING),
        (WARN | {"warn_percent": 0.2, "hard_warn": 0.06}, EQUAL, f"{DIFFER} (≤ fail_percent = 1); largest", ""),
        (WARN | {"fail_percent": 0.5}, DIFFERENT, f"{DIFFER} (> fail_percent = 0.5); largest", ""),
    ],
)
def test_the_exceeded_bound_is_named_first_and_warnings_do_not_fail(options, verdict, reason, warning):
    options = {"fail": 0.01, "fail_relative": 0.0, "fail_percent": 0.0} | options
    result = compare("tolerance", image(FLAT), image(SIX), **options)
    assert (result.verdict, result.reason[: len(reason)], result.warning) == (verdict, reason, warning)


def test_pixels_that_accept_black_are_those_that_pass_separately():
    """`tolerance` is inconclusive if it allows all pixels to fail."""
    rng = np.random.default_rng(3)
    pixels = rng.choice([0.0, 0.003, 0.004, 0.05, 0.5], (8, 8, 3)).astype(np.float32)
    options = IDIFF | {"fail": 0.004, "hard_fail": 0.001}
    accepted = tolerance_accepts(pixels, 0 * pixels, options)
    for y, x in np.ndindex(8, 8):
        assert accepted[y, x] == passes_black(tolerance, [(image(pixels[y : y + 1, x : x + 1]), options)])
    bright, other = (image(np.full((3, 3, 3), x)) for x in (0.5, 0.4))
    assert compare("tolerance", bright, other, allow_failures=8).verdict is DIFFERENT
    result = compare("tolerance", bright, other, allow_failures=9)
    assert result.verdict is INCONCLUSIVE
    assert result.reason.startswith("an all-black image would pass, too, with ")


def test_black_that_is_detected_in_some_rows_is_detected_in_the_whole_image():
    rng, detected = np.random.default_rng(4), 0
    for _ in range(1000):
        shape, values = (*rng.integers(1, 50, 2), 1), [0.001, 0.01, 1.0, 100.0, -1.0]
        pixels = np.where(rng.random(shape) < rng.choice([0.01, 0.1, 0.5, 1]), rng.choice(values, shape), 0)
        mask = rng.random(shape[:2]) < rng.choice([0.1, 0.9]) if rng.random() < 0.5 else None
        masked = image(pixels if mask is None else pixels * mask[..., None], mask=mask)
        options = IDIFF | {"fail": 0.004, "hard_fail": float(rng.choice([np.inf, 0.5, 10]))}
        options["fail_percent"] = float(rng.choice([0, 0.02, 1, 5, 50, 100]))
        options["allow_failures"] = int(rng.choice([0, 1, 5, 50]))
        rows, whole = tolerance_views(masked, options)
        passes = passes_black(tolerance, [whole])
        assert passes_black(tolerance, [rows, whole]) == passes
        detected += not passes_black(tolerance, [rows])
    assert detected > 100


@pytest.mark.parametrize("by, pixels, verdict", [(0.0039, 9, EQUAL), (0.0041, 1, EQUAL), (0.0041, 2, DIFFERENT)])
def test_the_default_bounds(by, pixels, verdict):
    """0.004, and more in 0.02 % of the pixels; of 6000 pixels 1 is 0.017 %, 2 are 0.033 %."""
    reference = np.full((60, 100, 3), 0.5)
    test = reference.copy()
    test[0, :pixels, 1] += by
    assert compare("tolerance", image(reference), image(test)).verdict is verdict


# One outrageous pixel ----------------------------------------------------------------------------------------------


def lit(size, dot=1000.0, at=(7, 9), width=1, channel=slice(None)):
    """A smooth image of mean 1, and the same image with a firefly of `dot` times the mean."""
    plain = np.ones((size, size, 3)) + 0.5 * np.sin(np.arange(size) / 9)[:, None, None]
    spoilt = plain.copy()
    spoilt[at[0] : at[0] + width, at[1] : at[1] + width, channel] = dot
    return image(plain), image(spoilt)


@pytest.mark.parametrize("dot, channel", [(1000.0, slice(None)), (500.0, 1), (-500.0, 1)])
@pytest.mark.parametrize("size", [64, 71, 512])
def test_auto_detects_one_outrageous_pixel_at_any_size(size, dot, channel):
    """`tolerance` alone allows any value in 0.02 % of the pixels, which is one pixel from 71² pixels on."""
    plain, spoilt = lit(size, dot, channel=channel)
    for sides in ((plain, spoilt), (spoilt, plain)):
        assert compare("tolerance", *sides).verdict is (EQUAL if size > 64 else DIFFERENT)
        result = compare("auto", *sides)
        assert result.verdict is DIFFERENT
        assert size == 64 or "at x = 9, y = 7" in result.reason


def test_bright_pixels_that_are_not_outrageous_are_equal():
    """A highlight that moves by two pixels, the edge of a lamp, white on a gray display, and pixels within options."""
    white = np.full((128, 128, 3), 0.02)
    white[60, 60] = 1.0
    for sides, options in (
        ((lit(128, at=(20, 20))[1], lit(128, at=(21, 22))[1]), {}),
        ((lit(256, width=3)[1], lit(256, width=3, at=(8, 9))[1]), {}),
        ((image(np.full((128, 128, 3), 0.02)), image(white)), {}),
        (lit(128, 0.3), {}),
        (lit(128), {"hard_fail": 2000.0}),
        (lit(128), {"allow_failures": 1}),
    ):
        assert compare("auto", *sides, **options).verdict is EQUAL


def test_an_outrageous_pixel_is_one_among_the_pixels_inside_the_mask():
    """A dot of 12 times the mean inside the mask, which is 1200 times that of all pixels."""
    plain, mask = np.zeros((1000, 1000, 3)), np.zeros((1000, 1000), bool)
    mask[:100, :100], plain[:100, :100] = True, 0.05
    for dot, verdict in ((0.6, EQUAL), (6.0, DIFFERENT)):
        spoilt = plain.copy()
        spoilt[50, 50] = dot
        assert compare("auto", *(image(x[:100, :100]) for x in (plain, spoilt))).verdict is verdict
        assert compare("auto", *(image(x, mask=mask) for x in (plain, spoilt))).verdict is verdict

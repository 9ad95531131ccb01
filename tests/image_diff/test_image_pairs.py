"""No method calls wrong images of hard structure equal in silence, and right ones are equal."""

from __future__ import annotations

import numpy as np
import pytest
from support.diff_images import of
from support.image_pairs import CHANGES, CLOSE, IDENTICAL, KNOWN, PICTURES, WRONG, image, sees

from mi_refract.image_diff.comparison import Verdict
from mi_refract.image_diff.methods import compare

EQUAL, DIFFERENT, INCONCLUSIVE = Verdict.EQUAL, Verdict.DIFFERENT, Verdict.INCONCLUSIVE
METHODS = ("exact", "tolerance", "flip", "welch", "auto")
# Black would pass there: all that is not the same is inconclusive.
BLIND = {(method, "dim id") for method in ("tolerance", "auto", "flip")} | {("flip", "single pixels")}
# Of a tile: of `welch` it is not due where the minimum detectable difference is larger.
SLIGHT = {"0.5 % brighter": 0.005, "a dead pixel": 1 / 256}
NOISY = ("normals", "1 × 1")  # of a mean near 0, or too few pixels: equal ones may be inconclusive


def seeded(*case):
    return np.random.default_rng([*"/".join(map(str, case)).encode()])


def sides(method, name, known, a, b):
    """Both as images; with noise of other seeds for `welch`."""
    if method != "welch":
        return image(a), image(b)
    rng = seeded(name, known)
    return tuple(make(x, rng) for make, x in zip(KNOWN[known], (a, b), strict=True))


def wrong(method, seed=0):
    """The changes that a method must see, each with both orders of the sides."""
    kinds = [*KNOWN] if method == "welch" else [""]
    for name, picture in PICTURES.items():
        for i, (change, by) in enumerate(CHANGES.items()):
            other = picture.with_change(by, seeded(seed, name, change))
            if other is None or not sees(method, name, change, picture.pixels, other.pixels):
                continue
            known = kinds[(i + seed) % len(kinds)]
            for mirrored, pair in enumerate(((picture, other), (other, picture))):
                yield f"{name}: {change}, {known} {mirrored}", change, sides(method, (seed, name, change), known, *pair)


@pytest.mark.parametrize("method", METHODS)
def test_what_is_wrong_is_not_equal(method):
    count, missed = 0, []
    for what, change, pair in wrong(method):
        count += 1
        result = compare(method, *pair)
        if result.verdict is EQUAL and not result.minimum_detectable > SLIGHT.get(change, np.inf):
            missed.append((what, result.reason))
    assert count >= 40 and not missed


@pytest.mark.parametrize("what", WRONG)
def test_what_was_made_to_deceive_is_not_equal(what):
    among, make = WRONG[what]
    for method in among:
        pair = make(seeded(what))
        assert all(compare(method, *pair).verdict is not EQUAL for pair in (pair, pair[::-1])), method


def right(method, seed=0):
    """Pairs that are the same to a method, with their options and the verdicts that they may have."""
    for name, picture in PICTURES.items():
        if method == "welch":
            for known in KNOWN:
                pair = sides(method, (seed, name, "right"), known, picture, picture)
                yield f"{name}: {known}", pair, {}, {EQUAL, INCONCLUSIVE} if name in NOISY else {EQUAL}
            continue
        for change, by in (IDENTICAL if method == "exact" else CLOSE).items():
            pixels = by(picture.pixels.copy(), seeded(seed, name, change))
            nan = np.isnan(pixels).any()
            turned = -1 if change.startswith("another order") else 1
            other = of(pixels[..., ::turned], picture.channels[::turned])
            same = np.array_equal(pixels, picture.pixels) or nan
            blind = (method, name) in BLIND and not same
            yield (
                f"{name}: {change}",
                (image(picture, pixels if nan else None), other),
                {"allow_nonfinite": nan},
                {INCONCLUSIVE} if blind else {EQUAL},
            )


@pytest.mark.parametrize("method", METHODS)
def test_what_is_right_is_equal(method):
    """A false alarm of `welch` has a probability of 0.1 % a pair."""
    results = [(what, compare(method, *pair, **how), allowed) for what, pair, how, allowed in right(method)]
    assert len(results) >= 40
    assert not [(what, result.reason) for what, result, allowed in results if result.verdict not in allowed]

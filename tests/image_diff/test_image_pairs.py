"""No method calls changed pictures equal, and all call pictures equal that are the same to them.

Every change is made to every picture; in pictures with other channels than colours, to those channels only. `sees`
excludes changes that a method does not detect by design.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from support.diff_images import EQUAL, INCONCLUSIVE, of

from mi_refract.image_diff.methods import compare

SHAPE = (32, 48)
TILE = 16
NOISE = 0.005  # the standard deviation of a pixel of a render over its mean
RENDERS = 4
Y, X = np.indices(SHAPE)
RAMP = np.dstack([0.1 + 0.8 * (X / 47) ** k for k in (1, 2, 3)])
GRAY = np.ones((*SHAPE, 3))
HUES = np.array([1.0, 0.6, 0.3])


@dataclass(frozen=True)
class Picture:
    """Pixels, H × W × C; `changed`: the channels that a change is made to; empty: all."""

    pixels: np.ndarray
    channels: tuple[str, ...] = ("R", "G", "B")
    changed: tuple[str, ...] = ()

    @property
    def changed_indices(self):
        """The indices of the channels that a change is made to."""
        return [self.channels.index(name) for name in self.changed or self.channels]

    def with_change(self, change, rng):
        """The picture with a change; None if it changes nothing."""
        pixels = self.pixels.copy()
        pixels[..., self.changed_indices] = change(pixels[..., self.changed_indices], rng)
        return None if np.array_equal(pixels, self.pixels, equal_nan=True) else replace(self, pixels=pixels)


def beside_colours(values, *names):
    return Picture(np.dstack([RAMP, values]), ("R", "G", "B", *names), names)


def where(flags, value=1.0):
    return Picture(np.where(flags[..., None], value * HUES, 0.0))


PICTURES = {
    "ramp": Picture(RAMP),
    "dim ramp": Picture(0.05 * RAMP + 0.02),
    "thin lines": where(X % 7 == 3),
    "one line": where(Y == 9),
    "single pixels": where((X % 8 == 3) & (Y % 8 == 5)),
    "border": where((X == 0) | (Y == 0) | (X == 47) | (Y == 31)),
    "one tile": where((X // TILE == 1) & (Y // TILE == 1)),
    "a lamp on black": where((X // 4 == 3) & (Y // 4 == 3), 1e3),
    "a lamp on gray": Picture(np.where(((X // 4 == 3) & (Y // 4 == 3))[..., None], 1e3 * HUES, 0.5 * HUES)),
    "one channel": Picture(RAMP * [0, 1, 0]),
    "large": Picture(1e6 * RAMP),
    "powers of two": Picture(2.0 ** ((X + Y) % 15 - 7)[..., None] * HUES),
    "negative": Picture(RAMP - [0.6, 0.5, 0.4]),
    "1 × 1": Picture(0.7 * HUES.reshape(1, 1, 3)),
    "1 × 48": Picture(RAMP[:1]),
    "48 × 1": Picture(RAMP[:1].transpose(1, 0, 2)),
    "high range": Picture(10.0 ** (5 * X / 47 - 2)[..., None] * HUES),
    "alpha": beside_colours(np.clip((X - Y) / 20, 0, 1), "A"),
    "depth": beside_colours(1.0 + X * Y, "Z"),
    "ambient occlusion": beside_colours(0.2 + 0.6 * Y / 31, "ao"),
    "dim id": beside_colours(0.0038 * ((X * 7 + Y * 3) % 5) / 4, "id"),
    "normals": beside_colours(np.dstack([np.sin(X / 9), np.cos(X / 9), np.cos(Y / 5)]), "n.X", "n.Y", "n.Z"),
}


def brightest(x):
    return np.unravel_index(int(np.abs(x).argmax()), x.shape)


def one_pixel(value):
    def change(x, rng):
        x[brightest(x)[:2]] *= value
        return x

    return change


def dead_tile(x, rng):
    y, c, _ = brightest(x)
    x[y // TILE * TILE :, c // TILE * TILE :][:TILE, :TILE] = 0
    return x


def one_channel(x, rng):
    x[..., brightest(x)[2]] = 0
    return x


CHANGES = {
    "black": lambda x, rng: 0 * x,
    "shuffled": lambda x, rng: rng.permutation(x.reshape(-1, x.shape[2])).reshape(x.shape),
    "swapped channels": lambda x, rng: x[..., ::-1],
    "shifted by a pixel": lambda x, rng: np.roll(x, 1, 1 if x.shape[1] > 1 else 0),
    "mirrored": lambda x, rng: x[::-1, ::-1],
    "0.5 % brighter": lambda x, rng: 1.005 * x,
    "twice as bright": lambda x, rng: 2 * x,
    "inverted": lambda x, rng: x.max() + x.min() - x,
    "negated": lambda x, rng: -x,
    "a dead tile": dead_tile,
    "a dead channel": one_channel,
    "a dead pixel": one_pixel(0),
    "a firefly": one_pixel(1e4),
    "gray instead of black": lambda x, rng: np.where(np.abs(x).max(-1, keepdims=True) > 0, x, 0.5),
}


# Changes that `flip` does not detect by its documentation: single pixels, most lines that move by a pixel, faint
# changes; and in structures a few pixels wide, changes of less than two thirds of white.
FAINT = ("0.5 % brighter", "a dead pixel", "a firefly", "shifted by a pixel")
SMALL, SEEN_OF_SMALL = ("one line", "border", "single pixels", "a lamp on black"), ("inverted", "gray instead of black")
MOVES = ("shuffled", "shifted by a pixel", "mirrored")


def sees(method, name, change, a, b):
    """Whether a method detects the change of a picture from pixels `a` to `b`, by its documentation."""
    if method == "flip":
        return change not in FAINT and (name not in SMALL or change in SEEN_OF_SMALL)
    if method == "paired":  # one pixel of 1536 may change
        return change not in ("a dead pixel", "a firefly")
    if method == "welch":  # it does not detect light that moves between fewer than some 30 pixels
        return name != "single pixels" or change not in MOVES
    beyond = np.abs(a - b) > np.maximum(0.004, 0.001 * (np.abs(a) + np.abs(b)) / 2)
    lost = np.abs(a - b).max(-1) > 0.5 * np.maximum(np.abs(a), np.abs(b)).max(-1)
    return method == "exact" or beyond.any() or lost.mean() > 0.1


# Changes that methods ignore -------------------------------------------------------------------------------------


def last_bits(x, rng):
    x = x.astype(np.float32)
    return np.where(x == 0, x, np.nextafter(x, np.where(rng.random(x.shape) < 0.5, -np.inf, np.inf).astype(np.float32)))


def same_nan(x, rng):
    x[0, 0] = np.nan if x[..., 0].size > 1 else x[0, 0]
    return x


IDENTICAL = {
    "the same": lambda x, rng: x,
    "another order of channels": lambda x, rng: x,
    "NaN in both": same_nan,
    "the other sign of zero": lambda x, rng: np.where(x == 0, -x, x),
}
CLOSE = {
    **IDENTICAL,
    "last bits": last_bits,
    "half floats": lambda x, rng: x.astype(np.float16).astype(np.float32) if np.abs(x).max() < 6e4 else x,
    "dust where it is black": lambda x, rng: np.where(x == 0, 1e-9 * np.abs(x).max(), x),
}
SAME_TO = {"exact": IDENTICAL, "paired": {name: by for name, by in CLOSE.items() if name != "half floats"}}


# With noise ------------------------------------------------------------------------------------------------------


def renders(picture, rng):
    """Independent renders, with noise in proportion to the light."""
    return [image(picture, picture.pixels * sample) for sample in _samples(picture, RENDERS, rng)]


def film(picture, rng):
    """The mean of samples, with their variance."""
    samples = picture.pixels * _samples(picture, 16, rng)
    names = (*picture.channels, *(f"{name}.variance" for name in picture.channels))
    return of(np.dstack([samples.mean(0), samples.var(0, ddof=1)]), names, metadata={"mi_refract:spp": 16})


def plain(picture, rng):
    """The mean of samples, without their variance."""
    mean = film(picture, rng)
    return image(picture, mean.pixels[..., : len(picture.channels)], metadata=mean.metadata)


def _samples(picture, count, rng):
    return 1 + NOISE * (rng.gamma(2.0, 1.0, (count, *picture.pixels.shape)) - 2) / np.sqrt(2)


def image(picture, pixels=None, **rest):
    return of(picture.pixels if pixels is None else pixels, picture.channels, **rest)


KNOWN = {  # how the noise of both sides is known
    "renders": (renders, renders),
    "both variances": (film, film),
    "the reference's": (film, plain),
    "the new image's": (plain, film),
}


# Pairs constructed to deceive ------------------------------------------------------------------------------------


def beside(values, other, *names):
    """Two images with the same colours and different other channels."""
    return tuple(image(beside_colours(x, *names)) for x in (values, other))


def claimed(rng, reference, test, part, variance):
    """Two films of given means, without noise where they are black, whose variance is `variance` in a part."""
    films = []
    for mean in (reference, test):
        noisy = mean * (1 + 0.001 * rng.standard_normal(mean.shape))
        variances = np.where(part, variance, 1e-4 * (mean > 0))
        films.append(of(np.dstack([noisy, variances]), ("Y", "Y.variance"), metadata={"mi_refract:spp": 64}))
    return tuple(films)


def lit(pixels=0):
    """Gray on the left, black on the right except for so many pixels."""
    values = np.where(X < 32, 0.5, 0.0)
    values.flat[np.flatnonzero(X >= 32)[::25][:pixels]] = 1
    return values[..., None]


def lamp(light):
    pixels = np.full((192, 192, 3), 0.5)
    pixels[40:46, 90:96] = light
    return of(pixels)


RIGHT = X[..., None] >= 32
LEFT_GRAY, ALL_GRAY = np.where(X < 32, 0.5, 0.0)[..., None], np.full((*SHAPE, 1), 0.5)
WIDE, DEAD = np.full((80, 48, 1), 0.5), np.full((80, 48, 1), 0.5)
DEAD[:TILE, 32:] = 0  # one tile of 15
WRONG = {
    "gray and green in the dark": (
        ("tolerance", "auto"),
        lambda rng: (of(0.0045 * GRAY), of([0.0005, 0.0045, 0.0005] * GRAY)),
    ),
    "a dim channel at random": (("tolerance", "auto", "flip"), lambda r: beside(*0.0035 * r.random((2, *SHAPE)), "id")),
    "a dim channel beside a bright one": (
        ("tolerance", "auto", "flip"),
        lambda rng: beside(
            np.dstack([RAMP[..., 0], 0.0035 * RAMP[..., 1]]), np.dstack([RAMP[..., 0] + 0.001, 0 * X]), "ao", "id"
        ),
    ),
    "a black mask beside a depth": (
        ("tolerance", "auto", "flip", "paired"),
        lambda rng: beside(np.dstack([1e6 + X, 0 * X]), np.dstack([1e6 + X, 1 + 0 * X]), "Z", "mask"),
    ),
    "a small lamp is dimmed": (("flip",), lambda rng: (lamp(1e3), lamp(10.0))),
    "a small lamp glows": (("flip",), lambda rng: (lamp(0.5), lamp(5e3))),
    **{
        f"{what}, variance {variance:g}": (("welch", "auto"), lambda rng, x=sides, v=variance: claimed(rng, *x, v))
        for variance in (0.0, 1.0, 1e2, 1e6)
        for what, sides in {
            "20 pixels are lit": (lit(), lit(20), RIGHT),
            "gray instead of black": (LEFT_GRAY, ALL_GRAY, RIGHT),
            "a dead tile": (WIDE, DEAD, DEAD == 0),
        }.items()
    },
}


# The tests ---------------------------------------------------------------------------------------------------------

METHODS = ("exact", "tolerance", "flip", "paired", "welch", "auto")
# Pairs where black would pass, so that pictures that are not identical are inconclusive.
BLIND = {(method, "dim id") for method in ("tolerance", "auto", "flip")} | {("flip", "single pixels")}
# Relative changes of a tile. `welch` need not detect them if its minimum detectable difference is larger.
SLIGHT = {"0.5 % brighter": 0.005, "a dead pixel": 1 / 256}
NOISY = ("normals", "1 × 1")  # a mean near 0, or too few pixels: equal pairs may be inconclusive


def seeded(*case):
    return np.random.default_rng([*"/".join(map(str, case)).encode()])


def sides(method, name, known, a, b):
    """Both pictures as images; for `welch` with noise of different seeds."""
    if method != "welch":
        return image(a), image(b)
    rng = seeded(name, known)
    return tuple(make(x, rng) for make, x in zip(KNOWN[known], (a, b), strict=True))


def wrong(method, seed=0):
    """The changes that a method must detect, each with both orders of the sides."""
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
def test_changed_pictures_are_not_equal(method):
    count, missed = 0, []
    for what, change, pair in wrong(method):
        count += 1
        result = compare(method, *pair)
        if result.verdict is EQUAL and not result.minimum_detectable > SLIGHT.get(change, np.inf):
            missed.append((what, result.reason))
    assert count >= 40 and not missed


@pytest.mark.parametrize("what", WRONG)
def test_pairs_constructed_to_deceive_are_not_equal(what):
    deceived, make = WRONG[what]
    for method in deceived:
        pair = make(seeded(what))
        assert all(compare(method, *pair).verdict is not EQUAL for pair in (pair, pair[::-1])), method


def right(method, seed=0):
    """Pairs that are the same to a method, with options and the allowed verdicts."""
    for name, picture in PICTURES.items():
        if method == "welch":
            for known in KNOWN:
                pair = sides(method, (seed, name, "right"), known, picture, picture)
                yield f"{name}: {known}", pair, {}, {EQUAL, INCONCLUSIVE} if name in NOISY else {EQUAL}
            continue
        for change, by in SAME_TO.get(method, CLOSE).items():
            pixels = by(picture.pixels.copy(), seeded(seed, name, change))
            nan = np.isnan(pixels).any()
            step = -1 if change.startswith("another order") else 1
            other = of(pixels[..., ::step], picture.channels[::step])
            same = np.array_equal(pixels, picture.pixels) or nan
            blind = (method, name) in BLIND and not same
            pair = image(picture, pixels if nan else None), other
            yield f"{name}: {change}", pair, {"allow_nonfinite": nan}, {INCONCLUSIVE} if blind else {EQUAL}


@pytest.mark.parametrize("method", METHODS)
def test_pairs_that_are_the_same_to_a_method_are_equal(method):
    """A false alarm of `welch` has a probability of 0.1 % per pair."""
    results = [(what, compare(method, *pair, **how), allowed) for what, pair, how, allowed in right(method)]
    assert len(results) >= 40
    assert not [(what, result.reason) for what, result, allowed in results if result.verdict not in allowed]

"""Self-test of the comparison: methods must detect defects planted in images, and must not report equal pairs.

A method for single images compares two renders with the same random numbers, one of them with a defect. A method for
several renders compares clean renders with defective ones of other seeds. A defect is detected ("seen") if the method
calls the images different or refuses to compare them; "inconclusive" counts as not seen. Each defect has one row with
the share of trials in which each method saw it. A file that cannot be read has no such share, because reading it fails
before any method is applied. The renders of an equal pair have other seeds for a method that takes several renders, and
other last bits for one that does not. `exact` detects those, so it compares an image with itself.

A row fails if a method misses a defect that it must see. Every method must see values that are not finite, another
size, and a file that cannot be read; `exact` must see any changed bit; and a method that models the noise must see
defects larger than the minimum detectable difference that it reports, and all defects if it reports no such difference
although the renders have noise.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from scipy import ndimage, stats

from mi_refract.io import image_file, safe_files
from mi_refract.io.image_file import Pixels, block_mean, srgb_decode, srgb_encode
from mi_refract.report.row import Row

from . import methods
from .channels import without_variances
from .comparison import Verdict
from .file_pair import read_renders
from .methods import METHODS
from .tile_statistics import DARK, median_nonblack

STUDY = "self-test"
TILE = METHODS["welch"].options["tile"].default
TRIALS = 20  # per defect
NULL_PAIRS = 500
FALSE_ALARMS = 0.01  # largest share of equal pairs that may be called different
CONFIDENCE = 0.95  # one-sided, of the upper bound of that share
SEED = 2026
RENDERS = 4  # minimum for methods that take several renders: two a side
DETECTABLE, RATIO = "minimum detectable difference", "size / minimum detectable"
UNREADABLE = "unreadable"
IDENTICAL = "the pairs are identical bit for bit"
TERMS = {
    "size": "of a defect: relative change of a tile's mean, in the tile where it is largest compared with the noise",
    DETECTABLE: "smallest relative difference that `welch` would have seen in a tile, median over the trials",
    RATIO: "above 1 or NaN the defect must be seen; tiles noisier than the median one have a larger minimum",
    "missed": "trials in which a method missed a defect that it must see, see the introduction",
    UNREADABLE: "share of the trials whose file cannot be read, an error whatever the method",
    "bound": f"{CONFIDENCE:.0%} upper bound of a rate, exact binomial (Clopper and Pearson)",
    "noise": "standard deviation of a pixel over its mean, median over the image",
}


Renders: TypeAlias = Pixels | list[Pixels]  # of one image: renders × H × W × C; a list if one has another size


@dataclass(frozen=True)
class Defect:
    """A defect; `plant` returns an image, H × W × C, with it, or raises the error of a file that cannot be read.

    `always_due`: every method must see it, however noisy the images are; only the first of several renders has it.
    """

    text: str
    plant: Callable[[Pixels], Pixels]
    always_due: bool = False

    def spoil(self, renders: Pixels) -> Renders:
        """Return the renders with the defect in each of them, or if `always_due` in the first. Errors: of `plant`."""
        if not self.always_due:
            return np.stack([self.plant(image) for image in renders])
        return [self.plant(renders[0]), *renders[1:]]


def _with_centre(image: Pixels, value: float) -> Pixels:
    """Return the image with this value in all channels of the pixel in the centre."""
    spoilt = image.copy()
    spoilt[image.shape[0] // 2, image.shape[1] // 2] = value
    return spoilt


def through_a_file(image: Pixels, share: float = 1.0) -> Pixels:
    """Return the image after writing it as EXR, truncating the file to a share of its bytes, and reading it.

    ValueError if it cannot be read.
    """
    channels = image_file.named("", image).channels
    with safe_files.temporary_folder() as folder:
        path = folder / "image.exr"
        image_file.write_exr(path, image, channels)
        data = path.read_bytes()
        path.write_bytes(data[: int(share * len(data))])
        return image_file.read(path).select(channels)


DEFECTS = {
    "gain": Defect("1 % brighter", lambda x: 1.01 * x),
    "shift": Defect("one pixel to the right", lambda x: np.roll(x, 1, axis=1)),
    "swapped channels": Defect("the first and the last", lambda x: x[..., ::-1]),
    "blur": Defect("mean of 3 × 3 pixels", lambda x: ndimage.uniform_filter(x, (3, 3, 1), mode="nearest")),
    "8 bits": Defect(  # values above 1 (white) become 1
        "through an 8-bit sRGB file", lambda x: srgb_decode(np.round(255 * srgb_encode(np.clip(x, 0, 1))) / 255)
    ),
    "firefly": Defect("one pixel a thousand times as bright as the mean", lambda x: _with_centre(x, 1e3 * x.mean())),
    "NaN": Defect("one pixel of one image", lambda x: _with_centre(x, math.nan), always_due=True),
    "Inf": Defect("one pixel of one image", lambda x: _with_centre(x, math.inf), always_due=True),
    "wrong size": Defect("one image lacks a column", lambda x: x[:, 1:], always_due=True),
    "truncated": Defect("half of one image's file is missing", lambda x: through_a_file(x, 0.5), always_due=True),
}


@dataclass(frozen=True)
class Trial:
    """Renders, number × H × W × C: `clean` and `spoil()` have the same seeds, `other` are clean ones of other seeds.

    If `spoil` raises ValueError or OSError, nothing is compared. If `other` is empty, methods that take several renders
    are left out.
    """

    clean: Pixels
    other: Pixels
    spoil: Callable[[], Renders]


@dataclass
class Tally:
    """Counts of a method's verdicts over several pairs, and the minimum detectable differences that it reported."""

    seen: int = 0
    inconclusive: int = 0
    trials: int = 0
    detectable: list[float] = field(default_factory=list)

    @property
    def bound(self) -> float:
        """The exact one-sided upper bound of the rate, at CONFIDENCE, for independent trials."""
        test = stats.binomtest(self.seen, self.trials, alternative="less")
        return float(test.proportion_ci(CONFIDENCE, method="exact").high)

    def compare(self, method: str, reference: Renders, test: Renders) -> None:
        """Compare the first image of each side, or all if the method takes several. A refusal counts as seen."""
        sides = [[image_file.named(name, x) for x in side] for name, side in (("reference", reference), ("test", test))]
        self.trials += 1
        try:
            takes_renders = METHODS[method].takes_renders
            comparison = methods.compare(method, *(side if takes_renders else side[0] for side in sides))
        except (ValueError, OSError):
            self.seen += 1
            return
        self.seen += comparison.verdict is Verdict.DIFFERENT
        self.inconclusive += comparison.verdict is Verdict.INCONCLUSIVE
        if math.isfinite(comparison.minimum_detectable):
            self.detectable.append(comparison.minimum_detectable)


def detection(name: str, always_due: bool, trials: Sequence[Trial], case: str, setting: str) -> Row:
    """Return the row of a defect: the share of trials in which each method saw it.

    "missed" counts the trials in which a method missed the defect although it had to see it. Trials in which the defect
    changes nothing are left out.
    """
    several = 2 * len(trials[0].other) >= RENDERS
    tallies = {method: Tally() for method in METHODS if several or not METHODS[method].takes_renders}
    changes, clean_tiles, unreadable, unchanged = [], [], 0, 0
    replay: dict[str, Any] = {"trials": len(trials), "renders a side": len(trials[0].clean)}
    for trial in trials:
        try:
            spoilt = trial.spoil()
        except (ValueError, OSError):
            unreadable += 1
            continue
        if np.array_equal(spoilt[0], trial.clean[0]):
            unchanged += 1
            continue
        for method, tally in tallies.items():
            tally.compare(method, trial.other if METHODS[method].takes_renders else trial.clean, spoilt)
        if not always_due:
            clean_tiles.append([block_mean(image, TILE) for image in trial.clean])
            changes.append(np.mean([block_mean(image, TILE) for image in spoilt], 0) - np.mean(clean_tiles[-1], 0))
    replay["trials"] -= unchanged
    if unchanged == len(trials):
        return Row(STUDY, name, case, setting, reason="left out: it changes nothing in these images")
    if unreadable + unchanged == len(trials):
        values = {UNREADABLE: 1.0, "missed": 0.0}
        return Row(STUDY, name, case, setting, values, {"missed": 0.0}, reason="not read", replay=replay)
    size = sizes(np.array(changes), np.concatenate(clean_tiles), tallies) if clean_tiles else {}
    is_large = not size.get(RATIO, 0.0) <= 1  # also NaN
    due = [m for m in tallies if always_due or m == "exact" or (is_large and METHODS[m].takes_renders)]
    values = {method: tally.seen / tally.trials for method, tally in tallies.items()}
    values |= {"missed": float(sum(tallies[m].trials - tallies[m].seen for m in due)), **size}
    return Row(STUDY, name, case, setting, values, {"missed": 0.0}, replay=replay | {"due": due})


def sizes(changes: Pixels, clean: Pixels, tallies: dict[str, Tally]) -> dict[str, float]:
    """Return the size of a defect in the tile and channel where its change is largest relative to the noise.

    The minimum detectable difference is reported for the median tile; it grows with the noise of a tile. It is NaN if
    none was reported. The result is empty if no tile with light has noise.
    """
    several = [tally for method, tally in tallies.items() if METHODS[method].takes_renders]
    if not several or len(clean) < 2:
        return {}
    mean, deviation = np.abs(clean.mean(0)), clean.std(0, ddof=1)
    noisy = (mean > DARK * median_nonblack(mean)) & (np.ptp(clean, 0) > 0)
    if not noisy.any():
        return {}
    relative, noise = np.abs(changes.mean(0))[noisy] / mean[noisy], deviation[noisy] / mean[noisy]
    detectable = float(np.median([x for tally in several for x in tally.detectable] or np.nan))
    # A tile with less noise than the median one counts as that noisy: with few renders its noise may be low by chance.
    at_median_noise = relative / np.maximum(noise / np.median(noise), 1)
    largest = at_median_noise.argmax()
    ratio = float(at_median_noise[largest] / detectable)
    return {"size": float(relative[largest]), RATIO: ratio, DETECTABLE: detectable}


def false_alarms(
    pairs: Iterable[tuple[Pixels, Pixels]],
    repeats: Iterable[tuple[Pixels, Pixels]],
    case: str,
    setting: str,
    independent: bool = True,
) -> list[Row]:
    """Return a row for each method: how often it called equal pairs different.

    `pairs`: renders with different seeds on the two sides, for methods that take several renders. `repeats`: renders
    with the same seeds, for the others: `exact` compares these, the rest compare a test side with changed `last_bits`.
    `independent`: no render is in two pairs; then the upper bound of the rate must be at most FALSE_ALARMS, otherwise
    the rate itself.
    """
    tallies = {method: Tally() for method in METHODS}
    several = [method for method in METHODS if METHODS[method].takes_renders]
    for reference, test in pairs:
        for method in several:
            tallies[method].compare(method, reference, test)
    rng = np.random.default_rng(SEED)
    for reference, test in repeats:
        moved = last_bits(test, rng)
        for method in METHODS.keys() - several:
            tallies[method].compare(method, reference, test if method == "exact" else moved)
    rows = []
    for method, tally in tallies.items():
        if not tally.trials:
            continue
        values = {"false alarms": tally.seen / tally.trials, "null pairs": float(tally.trials)}
        values["inconclusive"] = tally.inconclusive / tally.trials
        budget = "false alarms"
        if independent and method in several:
            budget = "bound"
            values[budget] = tally.bound
        if tally.detectable and method in several:
            values[DETECTABLE] = float(np.median(tally.detectable))
        reason = IDENTICAL if method == "exact" else ""
        rows.append(Row(STUDY, f"null pairs, {method}", case, setting, values, {budget: FALSE_ALARMS}, reason=reason))
    return rows


def last_bits(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    """Return every value as one of its two neighbours in float32, at random, as another processor may round it."""
    towards = np.where(rng.random(pixels.shape) < 0.5, -np.inf, np.inf).astype(np.float32)
    return np.nextafter(pixels.astype(np.float32), towards)


# The user's images --------------------------------------------------------------------------------------------


def read_images(path: Path, max_values: int = image_file.MAX_VALUES) -> Pixels:
    """Return the renders in a folder, or the image in a file, number × H × W × C, without channels of variance.

    Errors: those of `image_file.read`, and ValueError for renders of different sizes or channels.
    """
    images = read_renders(path, max_values) if path.is_dir() else [image_file.read(path, max_values)]
    images = [without_variances(image) for image in images]
    first = images[0]
    for image in images[1:]:
        if image.pixels.shape[:2] != first.pixels.shape[:2] or set(image.channels) != set(first.channels):
            raise ValueError(f"{image.path}: size or channels differ from those of {first.path}")
    return np.stack([image.select(first.channels) for image in images])


def examine(renders: Pixels, case: str, trials: int = TRIALS, null_pairs: int = NULL_PAIRS) -> list[Row]:
    """Return the rows of every defect and of the null pairs, for renders of one image, number × H × W × C.

    RENDERS or more, with independent seeds, are split in halves at random, `trials` times for each defect. With fewer
    renders each is compared once, because further trials would repeat it. ValueError without a render, and for values
    that are not finite: a planted NaN could not be distinguished from them.
    """
    if not len(renders) or not np.isfinite(renders).all():
        raise ValueError(f"{case}: a self-test needs at least one render, with finite values only")
    rng, renders = np.random.default_rng(SEED), renders.astype(np.float32)  # the type in files
    half = len(renders) // 2 if len(renders) >= RENDERS else 0
    setting = f"{len(renders)} renders" if len(renders) > 1 else "1 render"

    def halves() -> tuple[Pixels, Pixels]:
        order = rng.permutation(len(renders))
        return renders[order[:half]], renders[order[half : 2 * half]]

    rows = []
    for name, defect in DEFECTS.items():
        splits = [halves() for _ in range(trials)] if half else [(image[None], renders[:0]) for image in renders]
        planted = [Trial(clean, other, functools.partial(defect.spoil, clean)) for clean, other in splits]
        rows.append(detection(name, defect.always_due, planted, case, setting))
    nulls = (halves() for _ in range(null_pairs if half else 0))
    repeats = ((renders[[i]], through_a_file(renders[i])[None]) for i in range(len(renders)))
    rows += false_alarms(nulls, repeats, case, setting, independent=False)
    if not half:
        why = f"welch needs {RENDERS} or more of one image, whose spread is their noise"
        return [*rows, Row(STUDY, "renders", case, setting, reason=why)]
    return [*rows, Row(STUDY, "renders", case, setting, {"noise": noise(renders)})]


def noise(renders: Pixels) -> float:
    """Return the standard deviation of a pixel over its mean, median over the lit part of the image."""
    mean, deviation = renders.mean(0), renders.std(0, ddof=1)
    lit = mean > 0
    return float(np.median(deviation[lit] / mean[lit])) if lit.any() else 0.0


def table(rows: Sequence[Row]) -> list[tuple[str, ...]]:
    """Return the shares of trials in which a defect was seen: a line for each defect, a column for each method."""
    lines: list[tuple[str, ...]] = [("seen", *METHODS, "size", "")]
    for row in rows:
        if row.subject in DEFECTS:
            size = f"{row.values['size']:.2%}" if "size" in row.values else ""
            cells = [f"{row.values[name]:.0%}" if name in row.values else "–" for name in METHODS]
            lines.append((row.subject, *cells, size, row.reason))
    return lines


def summary(rows: Sequence[Row]) -> list[str]:
    """Return lines about the renders and the equal pairs, and which rows failed."""
    others = {row.subject: row for row in rows if row.subject not in DEFECTS}
    figures = {name: ", ".join(f"{key} {x:.3g}" for key, x in row.values.items()) for name, row in others.items()}
    lines = [f"{name}: {figures[name] or row.reason}" for name, row in others.items()]
    broken = [f"{row.subject}: {', '.join(row.broken)}" for row in rows if row.verdict == "fail"]
    return [*lines, f"failed: {'; '.join(broken)}" if broken else "every defect that had to be seen was seen"]

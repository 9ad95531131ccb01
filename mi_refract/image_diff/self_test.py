"""Proof that a comparison can fail: defects planted in images, which must be seen, and equal pairs, which must not.

A method that takes single images is asked about two of the same random numbers, one of them spoilt; a method that
takes samples, about clean renders and spoilt ones of other seeds. Seen is what it calls different, or refuses to
compare; "inconclusive" is counted as not seen. A row per defect: the share of trials in which each method saw it.

Due, so that missing it fails the row: what is not finite, not of the same size, or not readable, for every method; a
change of any bit, for `exact`; and for a method that knows noise, a defect larger than what it prints as detectable.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mi_refract.io import image_file, srgb
from mi_refract.report.row import Row

from . import methods as compare
from .comparison import Verdict
from .folders import sample_images
from .methods import METHODS

Renders = np.ndarray | list[np.ndarray]  # of one image; a list where one of them is of another size

STUDY = "gate"
TILE = METHODS["welch"].options["tile"].default
TRIALS = 20  # per defect
NULL_PAIRS = 500
FALSE_ALARMS = 0.01  # at most this share of equal pairs
CONFIDENCE = 0.95  # of the bound on that share, one-sided
SEED = 2026
RENDERS = 4  # at least: two a side
OWN_RENDERS, OWN_SPP = 16, 16
TERMS = {
    "size": "of a defect: relative change of a tile's mean, there where it is largest compared with the noise",
    "detectable": "smallest relative difference that `welch` prints, median over the trials",
    "size / detectable": "detectable being what is printed, more in tiles noisier than the median one",
    "missed": "trials in which a method missed what was due: see the introduction",
    "bound": f"{CONFIDENCE:.0%} upper bound of a rate, exact binomial (Clopper and Pearson)",
    "noise": "standard deviation of a pixel over its mean, median over the image",
}


# Defects -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Defect:
    """`plant` spoils an image (height, width, channels); it may raise the error of a file that cannot be read.

    `once`: only the first of several renders is spoilt. `always_due`: no noise is an excuse for missing it.
    """

    text: str
    plant: Callable[[np.ndarray], np.ndarray]
    once: bool = False
    always_due: bool = False

    def spoil(self, renders: np.ndarray) -> Renders:
        if not self.once:
            return np.stack([self.plant(image) for image in renders])
        return [self.plant(renders[0]), *renders[1:]]


def _with_centre(value: Callable[[np.ndarray], float]) -> Callable[[np.ndarray], np.ndarray]:
    """All channels of one pixel replaced."""

    def plant(image: np.ndarray) -> np.ndarray:
        spoilt = image.copy()
        spoilt[image.shape[0] // 2, image.shape[1] // 2] = value(image)
        return spoilt

    return plant


def _blurred(image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
    return np.mean([padded[y : y + height, x : x + width] for y in range(3) for x in range(3)], 0)


def _in_8_bits(image: np.ndarray) -> np.ndarray:
    """Through an 8-bit sRGB file: white is 1, and what is brighter is cut."""
    return srgb.decoded(np.round(255 * srgb.encoded(image)) / 255)


def _truncated(image: np.ndarray) -> np.ndarray:
    """Through a file that lost its second half."""
    return _through_a_file(image, share=0.5)


def _through_a_file(image: np.ndarray, share: float = 1.0) -> np.ndarray:
    """Written, cut to a share of the bytes, and read again. ValueError for what cannot be read."""
    channels = image_file.named("", image).channels
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "image.exr"
        image_file.write_exr(path, image, channels)
        written = path.read_bytes()
        path.write_bytes(written[: int(share * len(written))])
        return image_file.read(path).select(channels)


DEFECTS = {
    "gain": Defect("1 % brighter", lambda x: 1.01 * x),
    "shift": Defect("one pixel to the right", lambda x: np.roll(x, 1, axis=1)),
    "swapped channels": Defect("the first and the last", lambda x: x[..., ::-1]),
    "blur": Defect("mean of 3 × 3 pixels", _blurred),
    "8 bits": Defect("through an 8-bit sRGB file", _in_8_bits),
    "firefly": Defect("one pixel a thousand times as bright as the mean", _with_centre(lambda x: 1e3 * x.mean())),
    "NaN": Defect("one pixel of one image", _with_centre(lambda x: math.nan), once=True, always_due=True),
    "Inf": Defect("one pixel of one image", _with_centre(lambda x: math.inf), once=True, always_due=True),
    "wrong size": Defect("one image lacks a column", lambda x: x[:, 1:], once=True, always_due=True),
    "truncated": Defect("half of one image's file is missing", _truncated, once=True, always_due=True),
}


# Asking --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Trial:
    """Renders (number, height, width, channels): `clean` and `spoil()` share seeds, `other` are clean of other seeds.

    `spoil` may raise ValueError or OSError: what cannot be read is not compared. An empty `other` leaves out the
    methods that take samples.
    """

    clean: np.ndarray
    other: np.ndarray
    spoil: Callable[[], Renders]


@dataclass
class Tally:
    """What a method said of pairs, and the smallest differences that it says it would have seen."""

    seen: int = 0
    inconclusive: int = 0
    trials: int = 0
    detectable: list[float] = field(default_factory=list)

    @property
    def rate(self) -> float:
        return self.seen / self.trials

    @property
    def bound(self) -> float:
        """The upper bound of the rate of which `seen` of independent `trials` are a sample."""
        from scipy import stats

        return float(stats.beta.ppf(CONFIDENCE, self.seen + 1, self.trials - self.seen)) if self.rate < 1 else 1.0

    def ask(self, method: str, reference: Renders, test: Renders) -> None:
        """Of the first image a side, or of all where the method takes samples. A refusal counts as seen."""
        sides = [[image_file.named(name, x) for x in side] for name, side in (("reference", reference), ("test", test))]
        whole = METHODS[method].samples
        self.trials += 1
        try:
            found = compare.compare(method, *(side if whole else side[0] for side in sides))
        except (ValueError, OSError):
            self.seen += 1
            return
        self.seen += found.verdict is Verdict.DIFFERENT
        self.inconclusive += found.verdict is Verdict.INCONCLUSIVE
        if math.isfinite(found.detectable):
            self.detectable.append(found.detectable)


def _asked(renders: np.ndarray) -> list[str]:
    """The methods that so many renders of other seeds can be given to."""
    return [name for name, method in METHODS.items() if not method.samples or 2 * len(renders) >= RENDERS]


# Rows ----------------------------------------------------------------------------------------------------------


def detection(name: str, always_due: bool, trials: Sequence[Trial], case: str, setting: str) -> Row:
    """The share of trials in which each method saw the defect; "missed" counts the trials in which it had to."""
    tallies = {method: Tally() for method in _asked(trials[0].other)}
    changes, cleans = [], []
    for trial in trials:
        try:
            spoilt = trial.spoil()
        except (ValueError, OSError):
            for tally in tallies.values():
                tally.seen, tally.trials = tally.seen + 1, tally.trials + 1
            continue
        if np.array_equal(spoilt[0], trial.clean[0]):
            return Row(STUDY, name, case, setting, reason="left out: it changes nothing in these images")
        for method, tally in tallies.items():
            tally.ask(method, trial.other if METHODS[method].samples else trial.clean, spoilt)
        if not always_due:
            cleans.append([_tiles(image) for image in trial.clean])
            changes.append(np.mean([_tiles(image) for image in spoilt], 0) - np.mean(cleans[-1], 0))
    sizes = _sizes(np.array(changes), np.concatenate(cleans), tallies) if cleans else {}
    large = sizes.get("size / detectable", 0.0) > 1
    due = [m for m in tallies if always_due or m == "exact" or (large and METHODS[m].samples)]
    values = {method: tally.rate for method, tally in tallies.items()}
    values |= {"missed": float(sum(tallies[m].trials - tallies[m].seen for m in due)), **sizes}
    replay = {"trials": len(trials), "renders a side": len(trials[0].clean), "due": due}
    return Row(STUDY, name, case, setting, values, {"missed": 0.0}, replay=replay)


def _sizes(changes: np.ndarray, clean: np.ndarray, tallies: dict[str, Tally]) -> dict[str, float]:
    """Of the tile and channel where the change is largest compared with what could be detected there.

    What is printed is a median over tiles; in a tile noisier than the median one it is so much more.
    """
    printed = [x for method, tally in tallies.items() if METHODS[method].samples for x in tally.detectable]
    if not printed or len(clean) < 2:
        return {}
    mean, deviation = clean.mean(0), clean.std(0, ddof=1)
    noisy = (mean != 0) & (deviation > 0)
    if not noisy.any():
        return {}
    relative, noise = np.abs(changes.mean(0))[noisy] / np.abs(mean[noisy]), deviation[noisy] / np.abs(mean[noisy])
    detectable = float(np.median(printed))
    # A tile that is quieter than the median one gets no credit: few renders make some look quiet by chance.
    share = relative / (detectable * np.maximum(noise / np.median(noise), 1))
    return {"size": float(relative[share.argmax()]), "size / detectable": float(share.max()), "detectable": detectable}


def _tiles(image: np.ndarray) -> np.ndarray:
    """Means of tiles, by channel."""
    rows, columns = (np.arange(0, n, TILE) for n in image.shape[:2])
    sums, count = (np.add.reduceat(np.add.reduceat(x, rows, 0), columns, 1) for x in (image, np.ones_like(image)))
    return sums / count


def false_alarms(
    pairs: Iterable[tuple[np.ndarray, np.ndarray]],
    repeats: Iterable[tuple[np.ndarray, np.ndarray]],
    case: str,
    setting: str,
    independent: bool = True,
) -> list[Row]:
    """A row per method: how often it called equal pairs different.

    `pairs` are renders of other seeds on either side, for methods that take samples; `repeats` are renders of the same
    seeds, for the others. `independent`: no render is in two pairs; only then the rate has a bound, and that is what
    must be below FALSE_ALARMS. Otherwise it is the rate.
    """
    tallies = {method: Tally() for method in METHODS}
    for samples, given in ((True, pairs), (False, repeats)):
        for reference, test in given:
            for method in METHODS:
                if METHODS[method].samples is samples:
                    tallies[method].ask(method, reference, test)
    return [_null_row(method, tally, case, setting, independent) for method, tally in tallies.items() if tally.trials]


def _null_row(method: str, tally: Tally, case: str, setting: str, independent: bool) -> Row:
    values = {"false alarms": tally.rate, "null pairs": float(tally.trials)}
    values["inconclusive"] = tally.inconclusive / tally.trials
    budget = "false alarms"
    if independent and METHODS[method].samples:
        budget = "bound"
        values[budget] = tally.bound
    if tally.detectable and METHODS[method].samples:
        values["detectable"] = float(np.median(tally.detectable))
    return Row(STUDY, f"null pairs, {method}", case, setting, values, {budget: FALSE_ALARMS})


# Given images ------------------------------------------------------------------------------------------------


def self_test(path: Path | None = None) -> int:
    """Prints what is seen in the renders of a folder, in one image, or in our own; 1 where anything due is missed."""
    if path is None:
        renders = _own_renders()
    elif path.suffix == ".xml":
        renders = _renders_of(path)
    else:
        images = sample_images(path) if path.is_dir() else [image_file.read(path)]
        renders = _stacked(images)
    rows = examine(renders, str(path or "a glass ball"))
    print(text(rows))
    return int(any(row.verdict == "fail" for row in rows))


def _renders_of(scene: Path) -> np.ndarray:
    from mi_refract import backend
    from mi_refract.rendering.scene_files import load_scene

    backend.activate(may_restart=True)
    import mitsuba as mi

    loaded = load_scene(scene)
    return np.stack([np.array(mi.render(loaded, spp=OWN_SPP, seed=seed)) for seed in range(OWN_RENDERS)])


def _stacked(images: list[image_file.Image]) -> np.ndarray:
    first = images[0]
    for image in images[1:]:
        if image.pixels.shape[:2] != first.pixels.shape[:2] or set(image.channels) != set(first.channels):
            raise ValueError(f"{image.path}: size or channels differ from those of {first.path}")
    return np.stack([image.select(first.channels) for image in images])


def _own_renders() -> np.ndarray:
    """A glass ball on a floor under a sky and a lamp."""
    from mi_refract import backend

    backend.activate(may_restart=True)
    import mitsuba as mi

    look = mi.ScalarTransform4f().look_at
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 16, "rr_depth": 16},
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": look([0, -5, 2.5], [0, 0, 0.8], [0, 0, 1]),
                "film": {
                    "type": "hdrfilm",
                    "width": 64,
                    "height": 64,
                    "rfilter": {"type": "box"},
                    "pixel_format": "rgb",
                },
            },
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.6, 0.8, 1.0]}},
            "lamp": {
                "type": "rectangle",
                "to_world": look([3, -2, 5], [0, 0, 0], [0, 0, 1]),
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [3.0, 2.5, 2.0]}},
            },
            "floor": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale(8),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "checkerboard"}},
            },
            "ball": {"type": "sphere", "center": [0, 0, 1], "bsdf": {"type": "refract"}},
        }
    )
    return np.stack([np.array(mi.render(scene, spp=OWN_SPP, seed=seed)) for seed in range(OWN_RENDERS)])


def examine(renders: np.ndarray, case: str, trials: int = TRIALS, null_pairs: int = NULL_PAIRS) -> list[Row]:
    """Every defect and the null pairs on given renders of one image (number, height, width, channels).

    Four or more of them, of independent seeds, are split in halves at random; fewer are asked of one by one. ValueError
    for renders that are not finite: what is planted in them could not be told from what was there.
    """
    if not len(renders) or not np.isfinite(renders).all():
        raise ValueError(f"{case}: accepted for a self-test: one or more renders, every value of them finite")
    rng, renders = np.random.default_rng(SEED), renders.astype(np.float32)  # as files hold them
    half = len(renders) // 2 if len(renders) >= RENDERS else 0
    setting = f"{len(renders)} renders" if len(renders) > 1 else "1 render"
    rows = []
    for name, defect in DEFECTS.items():
        planted = [_split(renders, half, defect, rng) for _ in range(trials)]
        rows.append(detection(name, defect.always_due, planted, case, setting))
    splits = (_halves(renders, half, rng) for _ in range(null_pairs if half else 0))
    repeats = ((renders[[i]], _through_a_file(renders[i])[None]) for i in range(len(renders)))
    rows += false_alarms(splits, repeats, case, setting, independent=False)
    if half:
        return [*rows, Row(STUDY, "renders", case, setting, {"noise": noise(renders)})]
    return [*rows, Row(STUDY, "renders", case, setting, reason="of fewer than four renders the noise is not known")]


def noise(renders: np.ndarray) -> float:
    """Standard deviation of a pixel over its mean, median over the lit part of the image."""
    mean, deviation = renders.mean(0), renders.std(0, ddof=1)
    lit = mean > 0
    return float(np.median(deviation[lit] / mean[lit])) if lit.any() else 0.0


def _split(renders: np.ndarray, half: int, defect: Defect, rng: np.random.Generator) -> Trial:
    if half:
        clean, other = _halves(renders, half, rng)
    else:
        clean, other = renders[[rng.integers(len(renders))]], renders[:0]
    return Trial(clean, other, lambda: defect.spoil(clean))


def _halves(renders: np.ndarray, half: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    order = rng.permutation(len(renders))
    return renders[order[:half]], renders[order[half : 2 * half]]


def text(rows: Sequence[Row]) -> str:
    """A table of what `examine` found: a line per defect, a column per method, and what did not hold."""
    methods = list(METHODS)
    lines = [f"{'seen':18}" + "".join(f"{name:>11}" for name in methods) + f"{'size':>11}"]
    for row in rows:
        if row.subject in DEFECTS:
            cells = [_share(row.values.get(name)) for name in methods]
            size = f"{row.values['size']:.2%}" if "size" in row.values else ""
            mark = "" if row.values else f"  {row.reason}"
            lines.append(f"{row.subject:18}" + "".join(f"{cell:>11}" for cell in cells) + f"{size:>11}{mark}")
        elif row.values:
            lines.append(f"{row.subject}: " + ", ".join(f"{name} {x:.3g}" for name, x in row.values.items()))
    failed = [f"{row.subject}: {', '.join(row.broken)}" for row in rows if row.verdict == "fail"]
    return "\n".join([*lines, f"not held: {'; '.join(failed)}" if failed else "every defect that was due was seen"])


def _share(rate: float | None) -> str:
    return "–" if rate is None else f"{rate:.0%}"

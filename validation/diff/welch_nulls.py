"""Pairs that differ by noise only: how often `welch` calls them different, and which planted differences it detects.

Light is normal, lognormal, Pareto-distributed, a base to which rare samples add 200 times as much (fireflies), or rare
samples alone (a lamp). The sides have equal numbers of samples, or one side has up to 1000 times as many. The noise is
known on both sides or on one, from samples, from passes with filters of up to 3 pixels, or from several renders, also
with a tile that is denoised. Pairs of renders of a scene have a ball of glass and a small lamp, whose light passes the
glass by chance.

`welch` claims false alarms in 0.1 % of pairs, and reports the difference of a tile that it detects with a probability
of 99 %. Such differences are planted, and differences that it detects with a probability of 50 %: too many of these
missed, or too many seen, would mean that the reported difference is too small or too large.
"""

from __future__ import annotations

import functools
import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.ndimage import gaussian_filter

from mi_refract.image_diff import tile_statistics
from mi_refract.image_diff.channels import AREA, FREEDOM, SPP
from mi_refract.image_diff.comparison import Comparison, Verdict
from mi_refract.image_diff.methods import METHODS, compare
from mi_refract.io.image_file import Image
from mi_refract.report.row import Row
from validation import limits
from validation.repeated import by_tasks
from validation.run.context import Context
from validation.run.render_methods import sensor
from validation.run.seeds import current
from validation.study import Study, Task, about

NAME = "welch_nulls"
SEED = 2036
TERMS = {
    "alarms": "pairs that are called different; the bound allows for 0.1 % of them",
    "undecided": "pairs that are called inconclusive",
    "missed": "undetected planted differences, of a size with a claimed probability of detection of 99 %; where pixels "
    "are independent and both sides have a variance, also those that are detected, but called inconclusive",
    "missed at half": "the same with a claimed probability of 50 %",
    "seen at half": "the rest of these, which are detected",
    "undecided differences": "planted differences (99 %) that are detected, but called inconclusive",
}
WELCH = METHODS["welch"].options
TILE, FAMILY_ERROR, MARGIN = (WELCH[name].default for name in ("tile", "family_error", "equivalence_margin"))
PASSES = 8
Array = NDArray[np.floating[Any]]
Rng = np.random.Generator
Side = Image | list[Image]
Draw = Callable[[Rng, int], tuple[Array, Array]]  # returns per pixel the mean of n samples x, and Σ(x − mean)²


def rare(rng: Rng, n: int, probability: float, base: float = 1.0) -> tuple[Array, Array]:
    """Draw normal noise of σ = base/2, where a sample has 200 more with `probability`.

    Samples with and without are drawn as two groups, by their means and by Σ(x − mean)², which is χ²-distributed.
    """
    hits = rng.binomial(n, probability, (64, 64, 1))
    groups = []
    for count, mean in ((hits, base + 200.0), (n - hits, base)):
        of_group = mean + base / 2 * rng.standard_normal(hits.shape) / np.sqrt(np.maximum(count, 1))
        groups.append((count, of_group, base**2 / 4 * 2 * rng.standard_gamma(np.maximum(count - 1, 0) / 2)))
    (k, a, one), (rest, b, two) = groups
    return (k * a + rest * b) / n, one + two + k * rest / n * np.square(a - b)


def drawn(rng: Rng, n: int, law: Callable[[Rng, tuple[int, ...]], Array]) -> tuple[Array, Array]:
    """Draw all samples one by one."""
    x = law(rng, (n, 32, 32, 1))
    mean = x.mean(0)
    return mean, np.square(np.subtract(x, mean, out=x), out=x).sum(0)


def lognormal(rng: Rng, shape: tuple[int, ...]) -> Array:
    """Draw lognormal samples with σ = 1.5."""
    return np.asarray(np.exp(1.5 * rng.standard_normal(shape, np.float32), dtype=np.float64))


LIGHT: dict[str, Draw] = {
    "normal": functools.partial(rare, probability=0.0),
    "lognormal": functools.partial(drawn, law=lognormal),
    "Pareto": functools.partial(drawn, law=lambda rng, shape: rng.pareto(2.2, shape)),
    **{f"fireflies {p:g}": functools.partial(rare, probability=p) for p in (1e-2, 3e-3, 1e-3, 1e-4, 1e-5)},
    "lamp 0.001": functools.partial(rare, probability=1e-3, base=0.0),
}


@dataclass(frozen=True)
class Form:
    """The information on the noise of both sides.

    `kind`: "samples" for films with the variance of their samples, "passes" for the variance between passes, "renders"
    for several renders, "unnamed" for renders without a number of samples. `deviation`: σ of a Gaussian filter in
    pixels. `known`: which sides have a variance. `denoised`: one tile has the value of one of its pixels, in at least
    four renders: fewer do not show that noise, see the documentation of `welch`.
    """

    kind: str
    deviation: float = 0.0
    known: tuple[bool, bool] = (True, True)
    denoised: bool = False

    def pair(self, draw: Draw, rng: Rng, *counts: int) -> list[Side]:
        """Draw both sides with these numbers of samples."""
        if self.kind == "unnamed":
            counts = tuple(np.clip(counts, 16, 256))
        if self.denoised:
            counts = tuple(np.maximum(counts, 16))
        if self.kind == "samples":
            return self.sides([draw(rng, n) for n in counts], counts)
        stacks = []
        for n in counts:
            count = {"passes": PASSES, "renders": min(n // 4, PASSES), "unnamed": n // 8}[self.kind]
            stack = np.stack([draw(rng, n // count)[0] for _ in range(count)])
            if self.deviation:
                stack = gaussian_filter(stack, (0, self.deviation, self.deviation, 0), mode="wrap")
            if self.denoised:
                stack[:, :TILE, :TILE] = stack[:, :1, :1]
            stacks.append(stack)
        return self.sides([(stack, 0.0) for stack in stacks], counts)

    def sides(self, drawn: Sequence[tuple[Array, Any]], counts: Sequence[int]) -> list[Side]:
        """Return both sides, from means and Σ(x − mean)² or from stacks of images. `counts`: samples of each side."""
        weights = gaussian_filter(np.eye(1, 101, 50)[0], self.deviation) if self.deviation else np.ones(1)
        area = float(1 / np.square(weights).sum() ** 2)  # (Σw)²/Σw² of the filter, along both axes
        sides: list[Side] = []
        for (x, squares), n, known in zip(drawn, counts, self.known, strict=True):
            if self.kind in ("renders", "unnamed"):  # real renders are never equal, so these differ a little
                header = {SPP: n // len(x)} if self.kind == "renders" else {}
                sides.append([image(render * (1 + 1e-6 * i), header) for i, render in enumerate(x)])
            elif self.kind == "samples":
                sides.append(image(x, {SPP: n}, squares / (n - 1) if known else None))
            else:  # as `mi-refract render` writes them
                spread = x.var(0, ddof=1) * n / len(x) if known else None
                sides.append(image(x.mean(0), {SPP: n, FREEDOM: len(x) - 1, AREA: area}, spread))
        return sides


def image(mean: Array, header: dict[str, Any], variance: Array | None = None) -> Image:
    """Return an image, with its variance if given."""
    names = tuple("RGB"[: mean.shape[-1]])
    if variance is not None:
        names, mean = (*names, *(f"{name}.variance" for name in names)), np.concatenate([mean, variance], -1)
    return Image(Path("drawn.exr"), mean.astype(np.float32), names, metadata=header)


FORMS = {
    "variances": Form("samples"),
    "variance of the reference": Form("samples", known=(True, False)),
    "variance of the new image": Form("samples", known=(False, True)),
    "passes": Form("passes"),
    "passes, filter of 0.5": Form("passes", 0.5),
    "passes, filter of 3": Form("passes", 3.0),
    "passes of one, filter of 1": Form("passes", 1.0, (True, False)),
    "renders": Form("renders"),
    "renders, filter of 2": Form("renders", 2.0),
    "renders, a tile denoised": Form("renders", denoised=True),
    "renders without samples": Form("unnamed"),
}
COUNTS = ((64, 64), (256, 64), (64, 1024), (1024, 16), (16, 4096), (8000, 8), (8, 8000))
# The light, counts and forms of the profile `quick`.
QUICK_LIGHT, QUICK_COUNTS, QUICK_FORMS = ("fireflies 0.001",), ((1024, 16), (16, 4096)), tuple(FORMS)[:4]
PAIRS = {"quick": 8, "standard": 6, "full": 60}  # per case
# Per case. In `quick` the fewest with which a bound at 50 % can break: all n are missed with a probability of 2⁻ⁿ.
PLANTED = {"quick": math.ceil(-math.log2(limits.NULL_ALARM)), "standard": 100, "full": 1000}
POWER = {
    "variances": ((64, 64), (4096, 64)),
    "variance of the reference": ((4096, 64), (64, 64)),
    "passes, filter of 3": ((1024, 256),),
    "renders": ((256, 256), (4096, 64)),
}


def generator(*case: str | int) -> Rng:
    """Return a random generator for one pair."""
    return np.random.default_rng([current(SEED), *(x if isinstance(x, int) else zlib.crc32(x.encode()) for x in case)])


def tasks(context: Context) -> list[Task]:
    """Return one task per light, one for the scene, and one for the power."""
    quick, pairs = context.profile.quick, PAIRS[context.profile.name]
    runs = {light: functools.partial(null_rows, light, quick, pairs) for light in (QUICK_LIGHT if quick else LIGHT)}
    runs |= {} if quick else {"scene": functools.partial(scene_rows, context, pairs)}
    runs["power"] = functools.partial(power_rows, PLANTED[context.profile.name])
    return [Task(f"{NAME}: {name}", run) for name, run in runs.items()]


def null_rows(light: str, quick: bool, pairs: int) -> list[Row]:
    """Return a row per form, over all counts."""
    counts = [(*pair, i) for pair in (QUICK_COUNTS if quick else COUNTS) for i in range(pairs)]
    rows = []
    for form in QUICK_FORMS if quick else FORMS:
        pairs_of_form = (FORMS[form].pair(LIGHT[light], generator(light, form, n, m, i), n, m) for n, m, i in counts)
        rows.append(null_row(form, light, [compare("welch", *pair) for pair in pairs_of_form]))
    return rows


def null_row(form: str, light: str, results: list[Comparison], setting: str = "") -> Row:
    """Return the row of equal pairs."""
    counts = {verdict: float(sum(x.verdict is verdict for x in results)) for verdict in Verdict}
    values = {"pairs": float(len(results)), "alarms": counts[Verdict.DIFFERENT]}
    values["undecided"] = counts[Verdict.INCONCLUSIVE]
    alarms = "; ".join(x.reason for x in results if x.verdict is Verdict.DIFFERENT)
    return Row(NAME, form, light, setting, values, {"alarms": at_most(len(results), FAMILY_ERROR)}, reason=alarms[:300])


def at_most(count: int, probability: float) -> float:
    """Return the number of events that chance exceeds with a probability of `limits.NULL_ALARM` only."""
    return float(stats.binom.ppf(1 - limits.NULL_ALARM, count, probability))


def scene_rows(context: Context, pairs: int) -> list[Row]:
    """Return rows of renders of a glass ball on a floor below a small lamp, which paths hit by chance only.

    The same passes are used as films with variances on both sides or on one, and as renders.
    """
    if context.scalar:
        return [Row(NAME, "every form", "scene", context.variant, reason="scalar variants would render for long")]
    import mitsuba as mi

    place = mi.ScalarTransform4f
    scene: Any = {
        "type": "scene",
        "integrator": {"type": "refract_path", "max_depth": 6},
        "sensor": sensor(32, 40, [0, 2, 6]),
        "floor": {"type": "rectangle", "to_world": place().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(5)},
        "ball": {"type": "sphere", "bsdf": {"type": "refract"}},
        "lamp": {"type": "sphere", "center": [1, 3, 0], "radius": 0.1, "e": {"type": "area", "radiance": 50.0}},
    }
    loaded: Any = mi.load_dict(scene)
    known = {"passes": (True, True), "reference": (True, False), "new image": (False, True)}
    forms = {name: Form("passes", known=sides) for name, sides in known.items()} | {"renders": Form("renders")}
    results: dict[str, list[Comparison]] = {name: [] for name in forms}
    seeds = iter(range(current(SEED), current(SEED) + 10_000))
    for counts in ((64, 64), (1024, 16), (16, 1024)) * pairs:
        stacks = [
            (np.array([mi.render(loaded, spp=n // PASSES, seed=next(seeds)) for _ in range(PASSES)], float), 0.0)
            for n in counts
        ]
        for name, form in forms.items():
            results[name].append(compare("welch", *form.sides(stacks, counts)))
    return [null_row(name, "lamp through glass", compared, context.variant) for name, compared in results.items()]


def power_rows(pairs: int) -> list[Row]:
    """Return rows of the power: one tile of each pair is brightened by the difference that `welch` claims to detect.

    The claimed difference is m + (t(1 − p/2) + t(1 − MISSED)) · error, with the margin m and the p of an alarm. With
    p = 2 MISSED it is m + 2 t(1 − MISSED) · error. Half of its excess over m is t(1 − MISSED) · error, the difference
    between what is detected with 99 % and with 50 %.
    """
    tests = 2 * (16 + 1)  # of the mean and of the pixels, in 16 tiles and in the image
    error_at_twice_missed = 1 - (1 - 2 * tile_statistics.MISSED) ** tests
    rows = []
    for form, n, m in [(form, n, m) for form, counts in POWER.items() for n, m in counts]:
        decided = all(FORMS[form].known) and not FORMS[form].deviation  # otherwise few values of a tile are independent
        values = {"pairs": float(pairs), "missed": 0.0, "missed at half": 0.0, "undecided differences": 0.0}
        for i in range(pairs):
            one, two = FORMS[form].pair(LIGHT["normal"], generator("power", form, n, m, i), n, m)
            least, twice = (
                compare("welch", one, two, family_error=error).minimum_detectable
                for error in (FAMILY_ERROR, error_at_twice_missed)
            )
            full, half = (compare("welch", one, brighter(two, x)) for x in (least, least - (twice - MARGIN) / 2))
            values["missed"] += not seen(full) or (decided and full.verdict is not Verdict.DIFFERENT)
            values["missed at half"] += not seen(half)
            values["undecided differences"] += seen(full) and full.verdict is Verdict.INCONCLUSIVE
        values["seen at half"] = pairs - values["missed at half"]
        bounds = {"missed": at_most(pairs, tile_statistics.MISSED)}
        bounds |= dict.fromkeys(("missed at half", "seen at half"), at_most(pairs, 0.5))
        rows.append(Row(NAME, form, f"power, {n} : {m}", "", values, bounds))
    return rows


def brighter(side: Any, by: float) -> Any:
    """Return a side with one tile brightened by this difference."""
    if isinstance(side, list):
        return [brighter(x, by) for x in side]
    pixels = side.pixels.copy()
    pixels[TILE : 2 * TILE, TILE : 2 * TILE, 0] += by
    return replace(side, pixels=pixels)


def seen(result: Comparison) -> bool:
    """Return whether any test of a difference is an alarm; images with planted NaN or infinity are not tested."""
    is_tested = math.isfinite(result.minimum_detectable)
    return is_tested and not all(metric.holds for metric in result.metrics if metric.bound == 0)


def summarise(rows: list[Row]) -> list[Row]:
    """Append a row of all pairs."""
    parts = [row.values for row in rows if row.study == NAME and "alarms" in row.values]
    if not parts:
        return rows
    values = {name: sum(x[name] for x in parts) for name in ("pairs", "alarms", "undecided")}
    bounds = {"alarms": at_most(int(values["pairs"]), FAMILY_ERROR)}
    return [*rows, Row(NAME, "every form", "every light", "", values, bounds)]


STUDY = Study(
    NAME, "Pairs that differ by noise only", about(__doc__), TERMS, tasks, summarise=summarise, again=by_tasks(tasks)
)

"""Pairs that differ by noise only, by `welch`: how often it calls them different, and what it sees beside them.

Light is normal, lognormal, of Pareto's law, or a base to which rare samples add 200 times as much (fireflies), or of
rare samples alone (a lamp). The sides have equal numbers of samples, or either side has up to 1000 times as many. Their
noise is known on both sides or on one, from samples, from passes under filters of up to 3 pixels, or from several
renders. Pairs of renders of a scene have a ball of glass and a small lamp, whose light comes through the glass by
chance.

`welch` states a false alarm in 0.1 % of pairs, and the difference of a tile that it sees with a probability of 99 %.
Such differences are planted, and those that it sees with 50 %.

`python -m validation diff --profile standard`
"""

from __future__ import annotations

import functools
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats
from scipy.ndimage import gaussian_filter

from mi_refract.image_diff import tile_statistics
from mi_refract.image_diff.comparison import Comparison, Verdict
from mi_refract.image_diff.methods import METHODS, compare
from mi_refract.io.image_file import Image
from mi_refract.report.row import Row
from validation import limits
from validation.repeated import by_tasks
from validation.run.context import Context
from validation.run.seeds import current
from validation.study import Study, Task, about

NAME = "welch_nulls"
SEED = 2036
TERMS = {
    "alarms": "pairs that are called different; the bound allows for 0.1 % of them",
    "undecided": "pairs that are called inconclusive",
    "missed": "planted differences that are not seen, of those that are said to be seen with a probability of 99 %",
    "missed at half": "the same with a probability of 50 %",
    "undecided differences": "planted ones of 99 % that are seen, but called inconclusive",
}
TILE, FAMILY_ERROR, MARGIN = (
    METHODS["welch"].options[x].default for x in ("tile", "family_error", "equivalence_margin")
)
PASSES = 8
Array = np.ndarray[Any, Any]
Rng = np.random.Generator
Draw = Callable[[Rng, int], tuple[Array, Array]]
Pair = tuple[Any, Any]


# Light ---------------------------------------------------------------------------------------------------------


def rare(probability: float, base: float = 1.0) -> Draw:
    """The mean of n samples of each pixel and Σ(x − mean)²: normal noise of σ = base/2, and `probability` of 200 more.

    Drawn by the samples with and without: their means, and Σ(x − mean)² of either, which is χ².
    """

    def draw(rng: Rng, n: int) -> tuple[Array, Array]:
        hits = rng.binomial(n, probability, (64, 64, 1))
        groups = []
        for count, mean in ((hits, base + 200.0), (n - hits, base)):
            found = mean + base / 2 * rng.standard_normal(hits.shape) / np.sqrt(np.maximum(count, 1))
            spread = base**2 / 4 * 2 * rng.standard_gamma(np.maximum(count - 1, 0) / 2)
            groups.append((count, found, spread))
        (k, a, one), (rest, b, two) = groups
        return (k * a + rest * b) / n, one + two + k * rest / n * np.square(a - b)

    return draw


def sampled(law: Callable[[Rng, tuple[int, ...]], Array]) -> Draw:
    """The same of samples that are drawn one by one."""

    def draw(rng: Rng, n: int) -> tuple[Array, Array]:
        x = law(rng, (n, 32, 32, 1))
        mean = x.mean(0)
        return mean, np.square(np.subtract(x, mean, out=x), out=x).sum(0)

    return draw


LIGHT: dict[str, Draw] = {
    "normal": rare(0.0),
    "lognormal": sampled(lambda rng, shape: np.exp(1.5 * rng.standard_normal(shape, np.float32), dtype=np.float64)),
    "Pareto": sampled(lambda rng, shape: rng.pareto(2.2, shape)),
    **{f"fireflies {p:g}": rare(p) for p in (1e-2, 3e-3, 1e-3, 1e-4, 1e-5)},
    "lamp 0.001": rare(1e-3, 0.0),
}


# What is known of it ---------------------------------------------------------------------------------------------


def image(mean: Array, variance: Array | None, **header: float) -> Image:
    """An image, with its variance where that is known."""
    names = tuple("RGB"[: mean.shape[-1]])
    names, pixels = (names, mean) if variance is None else (
        (*names, *(f"{name}.variance" for name in names)), np.concatenate([mean, variance], -1)
    )  # fmt: skip
    said = {f"mi_refract:{name}": value for name, value in header.items()}
    return Image(Path("drawn.exr"), pixels.astype(np.float32), names, metadata=said)


def film(draw: Draw, rng: Rng, n: int, known: bool = True) -> Image:
    """With the variance of its samples, as of a box filter."""
    mean, squares = draw(rng, n)
    return image(mean, squares / (n - 1) if known else None, spp=n)


def passes(stack: Array, n: int, area: float, known: bool = True) -> Image:
    """With the variance between passes, as `mi-refract render` writes it under a filter of that area."""
    spread = stack.var(0, ddof=1) * n / len(stack) if known else None
    return image(stack.mean(0), spread, spp=n, variance_freedom=len(stack) - 1, filter_area=area)


def filtered(draw: Draw, rng: Rng, n: int, count: int, deviation: float) -> tuple[Array, float]:
    """Images of n samples in all under a Gaussian filter, and its (Σw)²/Σw²."""
    stack = np.stack([draw(rng, n // count)[0] for _ in range(count)])
    if not deviation:
        return stack, 1.0
    weights = gaussian_filter(np.eye(1, 101, 50)[0], deviation)
    return gaussian_filter(stack, (0, deviation, deviation, 0), mode="wrap"), float(1 / np.square(weights).sum() ** 2)


def renders(draw: Draw, rng: Rng, n: int, deviation: float = 0.0, named: bool = True) -> list[Image]:
    """Renders of n samples in all; `named`: their headers say so. No two are the same, as no real ones are."""
    count = n // 8 if not named else min(n // 4, PASSES)
    stack, _ = filtered(draw, rng, n, count, deviation)
    return [image(x * (1 + 1e-6 * i), None, **({"spp": n // count} if named else {})) for i, x in enumerate(stack)]


def both(side: Callable[..., Any], *more: Any) -> Callable[[Draw, Rng, int, int], Pair]:
    """Sides of which the same is known."""
    return lambda draw, rng, n, m: (side(draw, rng, n, *more), side(draw, rng, m, *more))


def under(deviation: float, *known: bool) -> Callable[[Draw, Rng, int, int], Pair]:
    """Passes under a Gaussian filter; of which sides the variance is known."""

    def pair(draw: Draw, rng: Rng, *counts: int) -> Pair:
        drawn = [(*filtered(draw, rng, n, PASSES, deviation), n) for n in counts]
        one, two = (passes(x, n, area, each) for (x, area, n), each in zip(drawn, known, strict=True))
        return one, two

    return pair


COUNTS = ((64, 64), (256, 64), (64, 1024), (1024, 16), (16, 4096), (8000, 8), (8, 8000))
FORMS: dict[str, Callable[[Draw, Rng, int, int], Pair]] = {
    "variances": both(film),
    "variance of the reference": lambda draw, rng, n, m: (film(draw, rng, n), film(draw, rng, m, False)),
    "variance of the new image": lambda draw, rng, n, m: (film(draw, rng, n, False), film(draw, rng, m)),
    "passes": under(0.0, True, True),
    "passes, filter of 0.5": under(0.5, True, True),
    "passes, filter of 3": under(3.0, True, True),
    "passes of one, filter of 1": under(1.0, True, False),
    "renders": both(renders),
    "renders, filter of 2": both(renders, 2.0),
    "renders without samples": lambda draw, rng, n, m: both(renders, 0.0, False)(draw, rng, *np.clip((n, m), 16, 256)),
}
# Of all of these `quick` has some.
QUICK_LIGHT, QUICK_COUNTS, QUICK_FORMS = ("fireflies 0.001",), ((1024, 16), (16, 4096)), tuple(FORMS)[:4]
PAIRS, PLANTED = {"quick": 8, "standard": 6, "full": 60}, {"quick": 16, "standard": 100, "full": 1000}  # a case
POWER = {
    "variances": ((64, 64), (4096, 64)),
    "variance of the reference": ((4096, 64), (64, 64)),
    "passes, filter of 3": ((1024, 256),),
    "renders": ((256, 256), (4096, 64)),
}


# A scene ---------------------------------------------------------------------------------------------------------


def scene() -> dict[str, Any]:
    """A ball of glass on a floor below a small lamp, which paths through the ball meet by chance only."""
    import mitsuba as mi

    place = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 32, "height": 32, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    view = place().look_at([0, 2, 6], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene",
        "integrator": {"type": "refract_path", "max_depth": 6},
        "sensor": {"type": "perspective", "fov": 40, "to_world": view, "film": film, "s": {"type": "independent"}},
        "floor": {"type": "rectangle", "to_world": place().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(5)},
        "ball": {"type": "sphere", "bsdf": {"type": "refract"}},
        "lamp": {"type": "sphere", "center": [1, 3, 0], "radius": 0.1, "e": {"type": "area", "radiance": 50.0}},
    }


def scene_rows(context: Context, pairs: int) -> list[Row]:
    """The same passes as films with variances on both sides or on one, and as renders."""
    if context.scalar:
        return [Row(NAME, "every form", "scene", context.variant, reason="scalar variants would render for long")]
    import mitsuba as mi

    loaded: Any = mi.load_dict(scene())
    found: dict[str, list[Comparison]] = {}
    seeds = iter(range(current(SEED), current(SEED) + 10_000))
    for counts in ((64, 64), (1024, 16), (16, 1024)) * pairs:
        stacks = [
            np.array([mi.render(loaded, spp=n // PASSES, seed=next(seeds)) for _ in range(PASSES)], float)
            for n in counts
        ]
        for form, known in {"passes": (True, True), "reference": (True, False), "new image": (False, True)}.items():
            sides = (passes(x, n, 1.0, each) for x, n, each in zip(stacks, counts, known, strict=True))
            found.setdefault(form, []).append(compare("welch", *sides))
        several = ([image(x, None, spp=n // PASSES) for x in stack] for stack, n in zip(stacks, counts, strict=True))
        found.setdefault("renders", []).append(compare("welch", *several))
    return [null_row(form, "lamp through glass", each, context.variant) for form, each in found.items()]


# Judged ----------------------------------------------------------------------------------------------------------


def tasks(context: Context) -> list[Task]:
    """One per light, of the scene, and of the power."""
    quick, pairs = context.profile.quick, PAIRS[context.profile.name]
    lights, more = (QUICK_LIGHT, []) if quick else (LIGHT, [("scene", functools.partial(scene_rows, context, pairs))])
    power = functools.partial(power_rows, PLANTED[context.profile.name])
    return [
        Task(f"{NAME}: {name}", run)
        for name, run in [
            *((x, functools.partial(null_rows, x, quick, pairs)) for x in lights),
            *more,
            ("power", power),
        ]
    ]


def null_rows(light: str, quick: bool, pairs: int) -> list[Row]:
    """A row per form, over all counts."""
    return [
        null_row(form, light, [
            compare("welch", *FORMS[form](LIGHT[light], generator(light, form, n, m, i), n, m))
            for n, m in (QUICK_COUNTS if quick else COUNTS) for i in range(pairs)
        ])
        for form in (QUICK_FORMS if quick else FORMS)
    ]  # fmt: skip


def generator(*case: str | int) -> Rng:
    """Random numbers of its own for each pair."""
    return np.random.default_rng([current(SEED), *(x if isinstance(x, int) else zlib.crc32(x.encode()) for x in case)])


def null_row(form: str, light: str, found: list[Comparison], setting: str = "") -> Row:
    """Of pairs that are equal."""
    counts = {v: float(sum(x.verdict is v for x in found)) for v in Verdict}
    values = {
        "pairs": float(len(found)),
        "alarms": counts[Verdict.DIFFERENT],
        "undecided": counts[Verdict.INCONCLUSIVE],
    }
    alarms = "; ".join(x.reason for x in found if x.verdict is Verdict.DIFFERENT)
    return Row(NAME, form, light, setting, values, {"alarms": at_most(len(found), FAMILY_ERROR)}, reason=alarms[:300])


def at_most(count: int, probability: float) -> float:
    """More of so many events come up with a probability of `limits.NULL_ALARM` only."""
    return float(stats.binom.ppf(1 - limits.NULL_ALARM, count, probability))


def power_rows(pairs: int) -> list[Row]:
    """In each pair one tile of normal noise is made brighter by what the pair without that says."""
    rows = []
    for form, counts in POWER.items():
        for n, m in counts:
            missed, half, undecided = 0, 0, 0
            for i in range(pairs):
                one, two = FORMS[form](LIGHT["normal"], generator("power", form, n, m, i), n, m)
                said = compare("welch", one, two).minimum_detectable
                threshold = stats.norm.isf(tile_statistics.sidak(FAMILY_ERROR, 2 * (16 + 1)) / 2)
                reach = threshold / (threshold + stats.norm.isf(tile_statistics.MISSED))
                full, less = (compare("welch", one, brighter(two, x)) for x in (said, MARGIN + (said - MARGIN) * reach))
                missed, half = missed + (not seen(full)), half + (not seen(less))
                undecided += seen(full) and full.verdict is Verdict.INCONCLUSIVE
            values = {"pairs": float(pairs), "missed": float(missed), "missed at half": float(half)}
            bounds = {"missed": at_most(pairs, tile_statistics.MISSED), "missed at half": at_most(pairs, 0.5)}
            values["undecided differences"] = float(undecided)
            rows.append(Row(NAME, form, f"power, {n} : {m}", "", values, bounds))
    return rows


def brighter(side: Any, by: float) -> Any:
    """With one tile of the mean, which is 1, brighter by so much."""
    if isinstance(side, list):
        return [brighter(x, by) for x in side]
    pixels = side.pixels.copy()
    pixels[TILE : 2 * TILE, TILE : 2 * TILE, 0] += by
    return replace(side, pixels=pixels)


def seen(found: Comparison) -> bool:
    """Whether any test of a difference is an alarm."""
    return not all(metric.holds for metric in found.metrics if metric.bound == 0)


def summarise(rows: list[Row]) -> list[Row]:
    """With a row of all pairs."""
    mine = [row for row in rows if row.study == NAME and "alarms" in row.values]
    pairs, alarms, undecided = (sum(row.values[x] for row in mine) for x in ("pairs", "alarms", "undecided"))
    if not pairs:
        return rows
    values = {"pairs": pairs, "alarms": alarms, "undecided": undecided}
    return [*rows, Row(NAME, "every form", "every light", "", values, {"alarms": at_most(int(pairs), FAMILY_ERROR)})]


STUDY = Study(
    NAME, "Pairs that differ by noise only", about(__doc__), TERMS, tasks, summarise=summarise, again=by_tasks(tasks)
)

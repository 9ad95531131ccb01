"""The random numbers of split paths: are they uniform at every sample count, alone and in pairs, and stratified?

One sample is taken at random from each pixel. These samples are independent, so the counts of equal cells are
multinomial, and Pearson's chi-square test is valid for large counts, whatever the stratification. Pairs have numbers of
two keys: the numbers of one boundary must be independent of those of the next one. Numbers of 20 keys are pooled.

Light paths have numbers without stratification, four per key. All samples of these are counted.
"""

from __future__ import annotations

import functools
import itertools
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refract.plugins.sampling import KeyedMultijitter, seeds_of
from mi_refract.report.row import Row
from validation import limits
from validation.run.context import Context
from validation.run.render_methods import OURS
from validation.run.seeds import current

from .cases import Case, study

NAME, SEED = "random numbers", 2040
TERMS = {
    "alarms": "chi-square tests whose p-value is below the study's false-alarm rate over the number of its tests",
    "tests": "chi-square tests of this row",
    "least p": "smallest p-value, times the number of tests of this row; of the order of 1 for correct numbers",
    "not stratified": "pixels with a stratum that does not hold exactly one sample",
}
KEYS, SEEDS, LANES, CELLS = 20, 5, 2**16, 32
QUICK = (1, 4, 7, 16, 32, 64, 100, 256)
TESTS = 300 * SEEDS * 9  # in the whole study: counts × seeds × kinds of `histograms`
EDGE = 2.0**-20  # closer to an edge, a float32 may round to either side


def cases(context: Context) -> Iterator[Case]:
    """Yield one case per 30 sample counts from 1 to 300; in the profile `quick`, one of a few counts and one seed."""
    quick = context.profile.quick
    for counts in [QUICK] if quick else [range(first, first + 30) for first in range(1, 301, 30)]:
        work = functools.partial(rows, context.variant, counts, 1 if quick else SEEDS)
        yield Case(f"{counts[0]} to {counts[-1]}", context.variant, work)


def rows(variant: str, counts: Sequence[int], seeds: int, source: Any = KeyedMultijitter) -> list[Row]:
    """Return one row per kind of number; `source` generates them, as `KeyedMultijitter` does."""
    from scipy.stats import chi2

    p, unstratified = defaultdict[str, list[float]](list), Counter[str]()
    for count, seed in itertools.product(counts, range(seeds)):
        pooled: dict[str, Any] = {}
        for kind, histogram, broken in histograms(source, count, current(SEED) + seed):
            pooled[kind] = pooled.get(kind, 0) + histogram
            unstratified[kind] += broken
        for kind, observed in pooled.items():
            expected = observed.sum() / observed.size
            p[kind].append(float(chi2.sf(((observed - expected) ** 2).sum() / expected, observed.size - 1)))
    budgets, replay = {"alarms": 0.0, "not stratified": 0.0}, {"seed": current(SEED), "keys": KEYS}
    row, table = functools.partial(Row, NAME, OURS), list[Row]()
    for kind, tests in p.items():
        alarms = sum(not x >= limits.NUMBERS_ALARM / TESTS for x in tests)
        values = {"alarms": alarms, "tests": len(tests), "least p": min(tests) * len(tests)}
        numbers = {name: float(x) for name, x in (values | {"not stratified": unstratified[kind]}).items()}
        table.append(row(f"{kind}, {counts[0]} to {counts[-1]} samples", variant, numbers, budgets, replay=replay))
    return table


def histograms(make: Any, count: int, seed: int) -> Iterator[tuple[str, Any, int]]:
    """Yield, per key: a kind, the counts of cells of one sample per pixel, and the pixels that are not stratified."""
    pixels = max(LANES // count, 1)
    sampler = mi.load_dict({"type": "independent", "sample_count": count})
    sampler.seed(seed, pixels * count)
    seeds = seeds_of(mi, sampler)
    source, random = make(mi, seeds, pixels * count, count), np.random.default_rng(seed)
    before, light_before = [np.empty(0)] * 3, np.empty(0)
    pick = np.arange(pixels), np.zeros(pixels, int)
    for key in range(KEYS):
        if key % 2 == 0:
            pick = np.arange(pixels), random.integers(0, count, pixels)
        keys, vertex = (mi.UInt32(2 * key), mi.UInt32(2 * key + 1)), mi.UInt32(4 * key)
        dr.make_opaque(keys, vertex)  # the next key is new data, not a new kernel
        numbers = source.next_1d(sampler, keys[0]), source.next_2d(sampler, keys[1])
        dr.eval(numbers)
        z = np.array(numbers[0], float).reshape(pixels, count)
        x, y = np.array(numbers[1], float).reshape(2, pixels, count)
        now, torn_2d = [z[pick], x[pick], y[pick]], 0
        if key < 2:
            torn_2d = torn(count, x) + torn(count, y) + torn(source.rows, y, source.columns, x)
        yield "one", cells(now[0]), torn(count, z) if key < 2 else 0
        yield "two", cells(*now[1:]), torn_2d
        if key % 2:  # disjoint pairs: those that share a key are not independent
            pairs = {"one and one": (0, 0), "one and two": (0, 2), "two x and two x": (1, 1), "two y and two x": (2, 1)}
            for kind, (first, second) in pairs.items():
                yield kind, cells(before[first], now[second]), 0
        before = now
        light: Any = np.array(source.independent(vertex, 4), float)
        yield "light", cells(light[key % 4]), 0
        yield "light at one vertex", cells(light[0], light[1 + key % 3]), 0
        if key % 2:
            yield "light at two vertices", cells(light_before[0], light[0]), 0
        light_before = light


def cells(x: Any, y: Any = None) -> Any:
    """Return the count of each of 32² cells, of the interval or of the square."""
    cell = (x * CELLS**2).astype(int) if y is None else (x * CELLS).astype(int) * CELLS + (y * CELLS).astype(int)
    return np.bincount(cell, minlength=CELLS**2)


def torn(rows: int, y: Any, columns: int = 1, x: Any = 0.0) -> int:
    """Return the number of pixels (rows of `y`, `x`) whose `rows` × `columns` strata do not hold one sample each."""
    stratum = np.floor(y * rows) * columns + np.floor(x * columns)
    suspects = (np.sort(stratum, axis=1) != np.arange(rows * columns)).any(axis=1)
    at_edge = [(np.abs(a * n - np.round(a * n)) < EDGE * n) & (n > 1) for a, n in ((y, rows), (x + 0 * y, columns))]
    return int((suspects & ~(at_edge[0] | at_edge[1]).any(axis=1)).sum())


STUDY = study(NAME, "Random numbers of split paths", __doc__, TERMS, cases)

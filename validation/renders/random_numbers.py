"""The random numbers of split paths: uniform at every sample count, alone and in pairs, and stratified as promised.

One sample is taken at random from each pixel. These are independent, so the counts of equal cells are multinomial and
Pearson's chi-square holds exactly in the limit, whatever the stratification. Pairs are of two keys: what one boundary
draws says nothing of what the next one draws. Numbers of 20 keys are pooled.

`python -m validation renders`
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refract.plugins.sampling import KeyedMultijitter
from mi_refract.report.row import Row
from validation import limits
from validation.repeated import by_tasks
from validation.run.context import Context
from validation.run.seeds import current
from validation.study import Study, Task, about

NAME, SEED = "random numbers", 2040
TERMS = {
    "alarms": "chi-square tests whose p-value is below the study's false-alarm rate over the number of its tests",
    "tests": "chi-square tests of this row",
    "least p": "smallest p-value, times the number of tests of this row; of the order of 1 where nothing is wrong",
    "not stratified": "pixels in which a stratum holds no sample or two",
}
KEYS, SEEDS, LANES, CELLS = 20, 5, 2**16, 32
QUICK = (1, 4, 7, 16, 32, 64, 100, 256)
PARTS = [range(first, first + 30) for first in range(1, 301, 30)]
TESTS = 300 * SEEDS * 6  # of the whole study: the kinds are those of `histograms`
EDGE = 2.0**-20  # nearer to an edge a float32 may round to either side


def tasks(context: Context) -> list[Task]:
    """Counts from 1 to 300; in the profile `quick` a few, one seed."""
    if context.scalar:
        reason = "scalar variants draw the sampler's own numbers"
        return [Task(NAME, lambda: [Row(NAME, "refract_path", "every count", context.variant, reason=reason)])]
    quick = context.profile.quick
    parts: list[Sequence[int]] = [QUICK] if quick else [*PARTS]
    return [
        Task(f"{NAME}: {c[0]} to {c[-1]}", functools.partial(rows, context.variant, c, 1 if quick else SEEDS))
        for c in parts
    ]


def rows(variant: str, counts: Sequence[int], seeds: int, source: Any = KeyedMultijitter) -> list[Row]:
    """One row per kind of number; `source` makes them, as `KeyedMultijitter` does."""
    from scipy.stats import chi2

    p: dict[str, list[float]] = {}
    unstratified: dict[str, int] = {}
    for count in counts:
        for seed in range(seeds):
            pooled: dict[str, Any] = {}
            for kind, histogram, broken in histograms(source, count, current(SEED) + seed):
                pooled[kind] = pooled.get(kind, 0) + histogram
                unstratified[kind] = unstratified.get(kind, 0) + broken
            for kind, seen in pooled.items():
                expected = seen.sum() / seen.size
                p.setdefault(kind, []).append(float(chi2.sf(((seen - expected) ** 2).sum() / expected, seen.size - 1)))
    found = []
    for kind, each in p.items():
        values = {
            "alarms": float(sum(x < limits.NUMBERS_ALARM / TESTS for x in each)),
            "tests": float(len(each)),
            "least p": min(each) * len(each),
            "not stratified": float(unstratified[kind]),
        }
        case, replay = f"{kind}, {counts[0]} to {counts[-1]} samples", {"seed": current(SEED), "keys": KEYS}
        found.append(
            Row(NAME, "refract_path", case, variant, values, {"alarms": 0, "not stratified": 0}, replay=replay)
        )
    return found


def histograms(make: Any, count: int, seed: int) -> Iterator[tuple[str, Any, int]]:
    """Kind, occupied cells of one sample per pixel, pixels that are not stratified; once a key."""
    pixels = max(LANES // count, 1)
    sampler = mi.load_dict({"type": "independent", "sample_count": count})
    sampler.seed(seed, pixels * count)
    source, random = make(mi, sampler, count), np.random.default_rng(seed)
    before: Any = None
    pick: Any = None
    for key in range(KEYS):
        if key % 2 == 0:
            pick = np.arange(pixels), random.integers(0, count, pixels)
        keys = mi.UInt32(2 * key), mi.UInt32(2 * key + 1)
        dr.make_opaque(keys)  # the next key is new data, not a new kernel
        numbers = source.next_1d(sampler, keys[0]), source.next_2d(sampler, keys[1])
        dr.eval(numbers)
        z = np.array(numbers[0], float).reshape(pixels, count)
        x, y = np.array(numbers[1], float).reshape(2, pixels, count)
        yield "one", _cells(z[pick]), torn(count, z) if key < 2 else 0
        broken = torn(count, x) + torn(count, y) + torn(source.rows, y, source.columns, x) if key < 2 else 0
        yield "two", _cells(x[pick], y[pick]), broken
        if key % 2:  # disjoint pairs: those that share a key are not independent
            yield "one and one", _cells(before[0], z[pick]), 0
            yield "one and two", _cells(before[0], y[pick]), 0
            yield "two x and two x", _cells(before[1], x[pick]), 0
            yield "two y and two x", _cells(before[2], x[pick]), 0
        before = z[pick], x[pick], y[pick]


def _cells(x: Any, y: Any = 0.0) -> Any:
    """Numbers in each of 32² cells: of the interval or of the square."""
    cell = (x * CELLS**2).astype(int) if np.isscalar(y) else (x * CELLS).astype(int) * CELLS + (y * CELLS).astype(int)
    return np.bincount(cell, minlength=CELLS**2)


def torn(rows: int, y: Any, columns: int = 1, x: Any = 0.0) -> int:
    """Pixels, one a line, some of whose `rows` × `columns` strata do not hold one sample each."""
    stratum = np.floor(y * rows) * columns + np.floor(x * columns)
    suspects = (np.sort(stratum, axis=1) != np.arange(rows * columns)).any(axis=1)
    at_edge = [(np.abs(a * n - np.round(a * n)) < EDGE * n) & (n > 1) for a, n in ((y, rows), (x + 0 * y, columns))]
    return int((suspects & ~(at_edge[0] | at_edge[1]).any(axis=1)).sum())


STUDY = Study(NAME, "Random numbers of split paths", about(__doc__), TERMS, tasks, again=by_tasks(tasks))

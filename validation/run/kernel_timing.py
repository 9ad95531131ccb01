"""Kernel times of the formulas, which stream rays from memory, and the compile time of each kernel.

All subjects run once per round. Ratios are formed within a round; rows have the median over the rounds, with a
confidence interval of at least 95 % from order statistics. On a CPU the rows only have ratios: to a copy of the same
bytes, which is the lower limit set by memory, and to the plain formula. On a GPU they also have ns per ray.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any, TypeVar

import drjit as dr
import numpy as np

from mi_refract import regimes
from mi_refract.accuracy import Subject
from mi_refract.formulas import FORMULAS
from validation import limits
from validation.run.metrics import TIME_OVER_COPY, TIME_OVER_PLAIN

from .array_settings import PLAIN, Setting
from .context import Context

T = TypeVar("T")
COPY = "copy"
SEED = 2026
DIFFERENT = 1 << 16  # number of different rays; the rest of a stream repeats them
TERMS = {
    TIME_OVER_COPY: "median time of a streamed ray over that of copying its bytes; low, high: its 95 % interval",
    TIME_OVER_PLAIN: f"the same over the time of `{PLAIN}`",
    "operations": "Dr.Jit's count for the whole kernel",
    "compile ms": "time of code generation and compilation in Dr.Jit's record, with a new literal that no cache has",
}


def copy(a: Any, n: Any, k: Any) -> tuple[Any, Any]:
    """Read and write the bytes that a formula reads and writes, with almost no computation."""
    return a + n * k, k > 0


def measure(context: Context, setting: Setting) -> dict[str, dict[str, float]]:
    """Return values by subject of the setting, and of the copy, on generic rays."""
    subjects = {COPY: copy, **setting.subjects}
    count = context.profile.scalar_rays if setting.is_scalar else context.profile.streamed_rays
    rays = regimes.make("generic", min(count, DIFFERENT), setting.precision, SEED)[np.arange(count) % DIFFERENT]
    vector = setting.vector
    if setting.is_scalar:
        single = [(vector(a), vector(n), float(k)) for a, n, k in zip(rays.a, rays.n, rays.k, strict=True)]

        def clock(subject: Subject) -> float:
            start = time.perf_counter()
            for ray in single:
                subject(*ray)
            return time.perf_counter() - start
    else:
        streamed = vector(rays.a.T), vector(rays.n.T), dr.value_t(vector)(rays.k)
        dr.eval(streamed)

        def clock(subject: Subject) -> float:
            return float(sum(kernel["execution_time"] for kernel in kernels(lambda: subject(*streamed)))) / 1e3

    seconds = rounds(subjects, clock, context.profile.repeats)
    values: dict[str, dict[str, float]] = {}
    for name, subject in subjects.items():
        values[name] = ratio(TIME_OVER_COPY, seconds[name], seconds[COPY])
        values[name] |= ratio(TIME_OVER_PLAIN, seconds[name], seconds[PLAIN])
        if setting.backend == "cuda":
            values[name] |= interval("ns per ray", [s / count * 1e9 for s in seconds[name]])
        if not setting.is_scalar:
            values[name] |= _kernel(subject, streamed)
    return values


def goals(subject: str, setting: Setting) -> dict[str, float]:
    """Return goals for times: nine tenths of the copy's throughput for a documented formula, otherwise its own goal."""
    if setting.is_scalar or subject not in FORMULAS:
        return {}
    if (goal := FORMULAS[subject].time_goal) is None:
        return {TIME_OVER_COPY: limits.COPY_TIME}
    return {TIME_OVER_PLAIN: goal} if setting.label == "llvm float32" else {}


def rounds(subjects: dict[str, Any], clock: Callable[[Any], T], repeats: int) -> dict[str, list[T]]:
    """Return what `clock` returns, by subject. Every second round is in reverse order; the first is discarded."""
    results: dict[str, list[T]] = {name: [] for name in subjects}
    order = list(subjects)
    for _ in range(repeats + 1):
        for name in order:
            results[name].append(clock(subjects[name]))
        order.reverse()
    return {name: of_subject[1:] for name, of_subject in results.items()}


def ratio(metric: str, times: list[float], others: list[float]) -> dict[str, float]:
    """Return the median of times over others, round by round, and its interval."""
    return interval(metric, [t / o for t, o in zip(times, others, strict=True)])


def interval(metric: str, x: list[float]) -> dict[str, float]:
    """Return the median and order statistics around it: P(median outside) ≤ 2 P(Binomial(n, ½) < rank) ≤ 5 %.

    ValueError for fewer than six values: their extremes have less than 95 %.
    """
    from scipy.stats import binom

    rank = int(binom.ppf(0.025, len(x), 0.5))
    if rank == 0:
        raise ValueError(f"{metric}: {len(x)} values; expected at least 6 for an interval of 95 %")
    ordered = sorted(x)
    return {metric: statistics.median(x), f"{metric}, low": ordered[rank - 1], f"{metric}, high": ordered[-rank]}


def _kernel(subject: Subject, inputs: Any) -> dict[str, float]:
    """Return the operations of the kernel, and its compile time in ms: k is multiplied by a new literal."""
    a, n, k = inputs
    operations = max(kernel["operation_count"] for kernel in kernels(lambda: subject(a, n, k)))
    literal = 1 + float(np.random.default_rng().integers(1, 1 << 22)) * 2.0**-23
    launched = kernels(lambda: subject(a, n, k * type(k)(literal)))
    is_new = all(not kernel["cache_hit"] for kernel in launched)
    compiled = sum(kernel["codegen_time"] + kernel["backend_time"] for kernel in launched)
    return {"operations": float(operations), "compile ms": compiled if is_new else float("nan")}


def kernels(work: Callable[[], Any]) -> list[dict[str, Any]]:
    """Return Dr.Jit's record of the kernels that `work` launches."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.eval(work())
        dr.sync_thread()
        return [kernel for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT]

"""Kernel times of the formulas, which stream rays from memory, and the time to compile each kernel.

All subjects run once per round. A ratio is formed within a round; the median over the rounds is reported, with a
confidence interval of at least 95 % from order statistics. On a CPU only ratios are reported: to a copy of the same
bytes, which is the lower limit set by memory, and to the plain formula. On a GPU there are ns per ray, too.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from mi_refract import regimes
from mi_refract.accuracy import Subject
from mi_refract.formulas import FORMULAS
from validation import limits
from validation.run.metrics import TIME_OVER_COPY, TIME_OVER_PLAIN

from .array_settings import PLAIN, Setting
from .context import Context

COPY = "copy"
SEED = 2026
DIFFERENT = 1 << 16  # rays; the rest of a stream repeats them
TERMS = {
    TIME_OVER_COPY: "median time of a ray over that of copying its bytes, streaming; low, high: its 95 % interval",
    TIME_OVER_PLAIN: f"the same over the time of `{PLAIN}`",
    "operations": "Dr.Jit's count for the whole kernel",
    "compile ms": "code generation and compilation of the kernel, by Dr.Jit's record, with a literal no cache can know",
}


def copy(a: Any, n: Any, k: Any) -> tuple[Any, Any]:
    """Reads and writes the bytes that a formula reads and writes, with almost no computation."""
    return a + n * k, k > 0


def measure(context: Context, setting: Setting) -> dict[str, dict[str, float]]:
    """Values by subject of the setting, and of the copy, on generic rays."""
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
    found: dict[str, dict[str, float]] = {}
    for name, subject in subjects.items():
        found[name] = ratio(TIME_OVER_COPY, seconds[name], seconds[COPY])
        found[name] |= ratio(TIME_OVER_PLAIN, seconds[name], seconds[PLAIN])
        if setting.backend == "cuda":
            found[name] |= interval("ns per ray", [s / count * 1e9 for s in seconds[name]])
        if not setting.is_scalar:
            found[name] |= _kernel(subject, streamed)
    return found


def goals(subject: str, setting: Setting) -> dict[str, float]:
    """What times ought to be: nine tenths of the copy's throughput for a documented formula, else its own goal."""
    if setting.is_scalar or subject not in FORMULAS:
        return {}
    if (goal := FORMULAS[subject].time_goal) is None:
        return {TIME_OVER_COPY: limits.COPY_TIME}
    return {TIME_OVER_PLAIN: goal} if setting.label == "llvm float32" else {}


def rounds(subjects: dict[str, Any], clock: Callable[[Any], float], repeats: int) -> dict[str, list[float]]:
    """Seconds by subject, every second round in the reverse order; the first round is thrown away."""
    seconds: dict[str, list[float]] = {name: [] for name in subjects}
    order = list(subjects)
    for _ in range(repeats + 1):
        for name in order:
            seconds[name].append(clock(subjects[name]))
        order.reverse()
    return {name: times[1:] for name, times in seconds.items()}


def ratio(metric: str, times: list[float], others: list[float]) -> dict[str, float]:
    """The median of times over others, round by round, and its interval."""
    return interval(metric, [t / o for t, o in zip(times, others, strict=True)])


def interval(metric: str, x: list[float]) -> dict[str, float]:
    """The median and the order statistics around it: P(median outside) ≤ 2 P(Binomial(n, ½) < rank) ≤ 5 %."""
    from scipy.stats import binom

    rank = max(int(binom.ppf(0.025, len(x), 0.5)), 1)
    ordered = sorted(x)
    return {metric: statistics.median(x), f"{metric}, low": ordered[rank - 1], f"{metric}, high": ordered[-rank]}


def _kernel(subject: Subject, inputs: Any) -> dict[str, float]:
    """Operations of the kernel, and ms to compile it anew: k is multiplied by a literal that was never used before."""
    a, n, k = inputs
    operations = max(kernel["operation_count"] for kernel in kernels(lambda: subject(a, n, k)))
    literal = 1 + float(np.random.default_rng().integers(1, 1 << 22)) * 2.0**-23
    found = kernels(lambda: subject(a, n, k * type(k)(literal)))
    fresh = all(not kernel["cache_hit"] for kernel in found)
    compiled = sum(kernel["codegen_time"] + kernel["backend_time"] for kernel in found)
    return {"operations": float(operations), "compile ms": compiled if fresh else float("nan")}


def kernels(work: Callable[[], Any]) -> list[dict[str, Any]]:
    """Dr.Jit's record of the kernels that `work` launches."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.eval(work())
        dr.sync_thread()
        return [kernel for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT]

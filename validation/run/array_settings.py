"""The backends and precisions in which formulas are measured, and Mitsuba's own functions for comparison."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.accuracy import Subject
from mi_refract.formulas import AUTOMATIC, FORMULAS, Budget
from mi_refract.plugins import PLUGIN
from mi_refract.regimes import REGIMES

from .context import Context

BUILTIN = "mi.fresnel + mi.refract"
DOCUMENTED = tuple(name for name, formula in FORMULAS.items() if not formula.budget.at_the_limit)
RIGHT_PLUGINS = tuple(f"{PLUGIN}_{name}" for name in FORMULAS if name not in (*DOCUMENTED, AUTOMATIC))
PLAIN = "decomposed"  # the common form: its radicand cancels, as that of the built-in does


@dataclass(frozen=True)
class Setting:
    """A backend in a precision. `vector`: its 3-vector type; None if it cannot run, for `reason`.

    `mitsuba`: the variant whose functions take these arrays, if any.
    """

    backend: str
    precision: type
    vector: Any = None
    reason: str = ""
    mitsuba: str | None = None

    @classmethod
    def of(cls, backend: str, precision: str) -> Setting:
        """Return the setting of a backend that runs, in "float32" or "float64"."""
        name = {"float32": "Array3f", "float64": "Array3f64"}[precision]
        return cls(backend, np.dtype(precision).type, getattr(getattr(dr, backend), name))

    @property
    def name(self) -> str:
        """The precision: "float32" or "float64"."""
        return np.dtype(self.precision).name

    @property
    def label(self) -> str:
        """The label in rows, such as "llvm float32"."""
        return f"{self.backend} {self.name}"

    @property
    def roundoff(self) -> float:
        """u: 2⁻²⁴ or 2⁻⁵³."""
        return float(np.finfo(self.precision).eps) / 2

    @property
    def is_scalar(self) -> bool:
        """Whether every operation is a Python call."""
        return self.backend == "scalar"

    @functools.cached_property
    def flushes(self) -> bool:
        """Whether sums flush denormal numbers to 0, as in Dr.Jit's threads and in float32 on CUDA. This is tested."""
        if self.is_scalar:
            return False
        least = dr.value_t(self.vector)(np.full(1 << 16, np.finfo(self.precision).smallest_subnormal))
        return not np.array(least + least > 0).all()

    def no_budget(self, budget: Budget, regime: str) -> str:
        """Return why a formula has no budget in a regime; "" if it has one."""
        entry = REGIMES[regime]
        if entry.rests_on_denormals and self.flushes:
            return "no budget: this backend flushes denormal numbers to 0"
        return "" if entry.unit or budget.at_the_limit else "no budget: a and n are not unit"

    @property
    def subjects(self) -> dict[str, Subject]:
        """Every formula, and Mitsuba's functions if they exist in this precision."""
        formulas: dict[str, Subject] = dict(FORMULAS)
        return formulas | ({BUILTIN: functools.partial(builtin, variant=self.mitsuba)} if self.mitsuba else {})


def settings(context: Context) -> list[Setting]:
    """Return every backend and precision; `quick` has scalar arrays only if no compiled backend runs."""
    result = [] if context.profile.quick and not context.scalar else [Setting.of("scalar", "float64")]
    for backend in ("llvm", "cuda"):
        entry = context.backends[backend]
        for precision in (np.float32, np.float64):
            if not entry.usable:
                result.append(Setting(backend, precision, reason=entry.reason))
                continue
            variant, running = f"{backend}_ad_rgb", Setting.of(backend, np.dtype(precision).name)
            has_functions = precision is np.float32 and context.variants[variant] is None
            result.append(replace(running, mitsuba=variant) if has_functions else running)
    return result


def running(context: Context) -> list[Setting]:
    """Return the settings that run here."""
    return [setting for setting in settings(context) if setting.vector is not None]


def budget_of(subject: str) -> Budget:
    """Return the budget of a subject: its own, or that of the common form."""
    return FORMULAS[subject if subject in FORMULAS else PLAIN].budget


def builtin(a: Any, n: Any, k: Any, variant: str | None = None) -> tuple[Any, Any]:
    """Refract with Mitsuba's own functions, in the current variant or another one.

    The normal is oriented so that the functions need no reciprocal of k.
    """
    import mitsuba

    mi: Any = getattr(mitsuba, variant) if variant else mitsuba
    wi, n, k = mi.Vector3f(-a), mi.Vector3f(n), mi.Float(k)
    n = n * dr.sign(dr.dot(-wi, n))
    _, cos_t, _, eta_ti = mi.fresnel(dr.dot(wi, n), k)
    transmitted = cos_t != 0
    m = mi.Normal3f(n)
    return dr.select(transmitted, mi.refract(wi, m, cos_t, eta_ti), mi.reflect(wi, m)), transmitted

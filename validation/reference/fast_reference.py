"""A second exact answer, a thousand times faster than the certified one, to find the rays worth certifying.

It evaluates Snell's law for the exact inputs in unevaluated sums of floats (`numerics.float_expansions`), for float32
and float64, without the arithmetic of the formulas that it checks:

    b = k a + n (s √D − k c)/n²,   b = a − 2 c n/n² for total internal reflection
    c = n·a,   D = c² − (k² − 1)|n×a|²,   s = sign(c)

The error of D is 2⁻¹⁴⁰ of its terms, so that of √D is 2⁻⁷⁰ of their roots at the critical angle itself; all other
errors are 2⁻⁹⁰ k |a|.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from mi_refract import regimes
from mi_refract.accuracy import Subject, arrays
from mi_refract.formulas import Budget
from mi_refract.numerics import float_expansions
from mi_refract.regimes import Rays

# The screen's resolution of the radicand. Below it, and if a denormal component of float64 decides, it is doubtful.
RESOLUTION = 2.0**-140
_UNDERFLOW = 2.0**-900


class Screen:
    """The answers for `rays` as vectors of type `vector`, a Dr.Jit 3-vector of a vectorised backend.

    `relative_radicand`: D/(c² + |κ||n×a|²), within a factor of 2 of the oracle's. `cos_i`: |n·a|/|n||a|, and `cos_t`,
    with errors of a few u of float64. `doubtful`: whether transmission is unresolved.
    """

    def __init__(self, rays: Rays, vector: Any) -> None:
        """Solve the rays; subjects are evaluated in arrays of the 3-vector type `vector`."""
        self.rays, self.roundoff = rays, float(np.finfo(rays.k.dtype).eps) / 2
        self._inputs = arrays(rays, vector)
        dr.eval(self._inputs)
        wide: Any = dr.float64_array_t(vector)
        # Widened in numpy: Dr.Jit's threads flush denormal numbers to 0.
        a, n, k = (x.astype(np.float64) for x in (rays.a, rays.n, rays.k))
        self._a, wide_n, wide_k = arrays(Rays(a, n, k), wide)
        solved = _solve(self._a, wide_n, wide_k)
        self._high, self._low, self._transmitted, c, root, ratio, unresolved = solved
        length = dr.norm(self._a) * dr.norm(wide_n)
        dr.eval(solved, length)  # in one kernel
        tiny = ((np.abs((a, n)) < _UNDERFLOW) & (np.array((a, n)) != 0)).any(axis=(0, 2))
        self.relative_radicand, c = np.array(ratio), np.abs(np.array(c))
        lengths = np.array(length)
        self.cos_i, self.cos_t = c / lengths, np.array(root) / lengths
        self.doubtful = np.array(unresolved) | tiny & (c < _UNDERFLOW)

    def judge(self, subject: Subject) -> tuple[np.ndarray, np.ndarray]:
        """Return the chord error in u, infinite for NaN, and whether the decision differs, of every ray."""
        b, transmitted = subject(*self._inputs)
        error = dr.norm((type(self._a)(b) - self._high) - self._low) / dr.norm(self._a)
        error, wrong = dr.select(dr.isfinite(error), error, dr.inf), transmitted != self._transmitted
        dr.eval(error, wrong)  # in one kernel
        return np.array(error) / self.roundoff, np.array(wrong)

    def bound(self, budget: Budget) -> np.ndarray:
        """Return the bound on every ray's chord in u, as for exactly unit vectors."""
        k, transmitted = self.rays.k.astype(np.float64), np.array(self._transmitted)
        return np.asarray(budget.chord(self.roundoff, k, self.cos_t, transmitted, cos_i=self.cos_i) / self.roundoff)


def _solve(a: Any, n: Any, k: Any) -> tuple[Any, ...]:
    c, d, terms = regimes.radicand(a, n, k)
    transmitted = (d[0] >= 0) & (c[0] != 0)
    root = dr.sqrt(dr.select(d[0] > 0, d[0], 1))
    defect = float_expansions.distil([d[0], d[1], *float_expansions.negated(float_expansions.two_prod(root, root))], 2)
    positive = d[0] > 0
    roots = [dr.select(positive, root, 0), dr.select(positive, defect[0] / (2 * root), 0)]
    scale = dr.select(transmitted, k, 1)
    along = [dr.select(transmitted, dr.mulsign(r, c[0]), -c_i) for r, c_i in zip(roots, c[:2], strict=True)]
    difference = float_expansions.distil([*along, *float_expansions.negated(float_expansions.product(c, [scale]))], 2)
    factor = float_expansions.quotient(difference, float_expansions.dot(n, n))
    parts = [(*float_expansions.two_prod(scale, a[i]), *float_expansions.product(factor, [n[i]])) for i in range(3)]
    b = [float_expansions.distil(part, 2) for part in parts]
    unresolved = (c[0] != 0) & (dr.abs(d[0]) <= RESOLUTION * terms)
    high, low = (type(a)(*(x[i] for x in b)) for i in (0, 1))
    return high, low, transmitted, c[0], roots[0], d[0] / terms, unresolved

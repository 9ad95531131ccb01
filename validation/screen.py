"""A second exact answer, a thousand times faster than the certified one: it says which rays are worth certifying.

Snell's law for the exact inputs in unevaluated sums of floats (`expansions`), for float32 and float64 alike, with none
of the arithmetic of the formulas it judges:

    b = k a + n (s √D − k c)/n²,   b = a − 2 c n/n² under total internal reflection
    c = n·a,   D = c² − (k² − 1)|n×a|²,   s = sign(c)

D is right to 2⁻¹⁴⁰ of its terms, so √D to 2⁻⁷⁰ of theirs at the critical angle itself; all else to 2⁻⁹⁰ k |a|.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from mi_refract import expansions
from mi_refract.regimes import Rays

Subject = Callable[[Any, Any, Any], tuple[Any, Any]]

# Below 16u² of its terms the radicand's sign moves a direction by less than its root, 4u, and no budget asks for it.
NEGLIGIBLE = 16.0
# The screen's own resolution. Below it, and where a product underflows, its decision is a guess.
RESOLUTION = 2.0**-140
_UNDERFLOW = 2.0**-900


class Screen:
    """The answers for `rays` as vectors of type `vector`, a Dr.Jit 3-vector of a vectorised backend.

    `margin`: D/(c² + |κ||n×a|²), within a factor of 2 of `oracle.margin`; `doubtful`: transmission was not resolved.
    """

    def __init__(self, rays: Rays, vector: Any) -> None:
        self.rays, self.roundoff = rays, float(np.finfo(rays.k.dtype).eps) / 2
        self._inputs = vector(rays.a.T), vector(rays.n.T), dr.value_t(vector)(rays.k)
        dr.eval(self._inputs)
        wide = dr.float64_array_t(vector)
        self._a = wide(self._inputs[0])
        solved = _solve(self._a, wide(self._inputs[1]), dr.value_t(wide)(self._inputs[2]))
        self._high, self._low, self._transmitted, margin, doubtful = solved
        dr.eval(solved)
        self.margin, self.doubtful = np.array(margin), np.array(doubtful)

    def judge(self, subject: Subject) -> tuple[np.ndarray, np.ndarray]:
        """(chord error in u, infinite where it is NaN; whether the decision differs) of every ray."""
        b, transmitted = subject(*self._inputs)
        error = dr.norm((type(self._a)(b) - self._high) - self._low) / dr.norm(self._a)
        chord = np.array(dr.select(dr.isfinite(error), error, dr.inf)) / self.roundoff
        return chord, np.array(transmitted != self._transmitted)


def _solve(a: Any, n: Any, k: Any) -> tuple[Any, ...]:
    c, d, terms = expansions.radicand(a, n, k)
    transmitted = (d[0] >= 0) & (c[0] != 0)
    root = dr.sqrt(dr.select(d[0] > 0, d[0], 1))
    defect = expansions.distil([d[0], d[1], *expansions.negated(expansions.two_prod(root, root))], 2)
    positive = d[0] > 0
    roots = [dr.select(positive, root, 0), dr.select(positive, defect[0] / (2 * root), 0)]
    scale = dr.select(transmitted, k, 1)
    along = [dr.select(transmitted, dr.mulsign(r, c[0]), -c_i) for r, c_i in zip(roots, c[:2], strict=True)]
    difference = expansions.distil([*along, *expansions.negated(expansions.product(c, [scale]))], 2)
    factor = expansions.quotient(difference, expansions.dot(n, n))
    b = [expansions.distil([*expansions.two_prod(scale, a[i]), *expansions.product(factor, [n[i]])], 2) for i in range(3)]
    products = [(n[i], a[i], dr.abs(n[i] * a[i])) for i in range(3)]
    lost = [(x != 0) & (y != 0) & (p < _UNDERFLOW) for x, y, p in products]
    underflow = lost[0] | lost[1] | lost[2]
    doubtful = (c[0] != 0) & (dr.abs(d[0]) <= RESOLUTION * terms) | underflow & (dr.abs(c[0]) < _UNDERFLOW)
    return type(a)(*(x[0] for x in b)), type(a)(*(x[1] for x in b)), transmitted, d[0] / terms, doubtful

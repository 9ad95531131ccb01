"""The two forms at the rounding limit: `refract_promoted` and `refract_compensated`, `f(a, n, k) -> (b, transmitted)`.

Both solve, for `a` and `n` of any length, with w = n × a and κ = k² − 1,

    n × b = k w,   n·b = s √radicand,   radicand = (n·a)² − κ w²,   s = sign(n·a)

and the mirror direction as the same with k = 1 and −(n·a) in place of s √radicand. Near the critical angle the
two terms of the radicand cancel, and √ makes of an error ε one of √ε: so the radicand must be right to a few u²,
not to a few u. A literal normal along an axis, as in a local frame, leaves nothing to add up: w are the other two
components of `a`, and each component of b is one product, or the root.

Total internal reflection is decided for the exact inputs wherever |radicand| exceeds 100u² of its terms, (n·a)² and
κ w²: 4e-13 in float32. Nearer to the critical angle either answer may come out, and the root may be off by 2u.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from . import numerics
from .numerics import Double, component_of, quotient

Refracted = tuple[Any, Any]


def _axis(n: Any) -> tuple[int, int] | None:
    """(index, ±1) of a normal that is a Dr.Jit literal along an axis and has no derivative; else None."""
    if dr.grad_enabled(n) or not all(dr.is_jit_v(x) and x.state == dr.VarState.Literal for x in n):
        return None
    values = [x[0] for x in n]
    index = max(range(3), key=lambda i: abs(values[i]))
    return (index, int(values[index])) if sorted(map(abs, values)) == [0, 0, 1] else None


def _along_axis(a: Any, axis: tuple[int, int], scale: Any, along: Any) -> Any:
    """The b with n·b = `along` and the other components of `a` times `scale`, for a literal axis n."""
    index, sign = axis
    return type(a)(*((along if sign > 0 else -along) if i == index else a[i] * scale for i in range(3)))


def refract_promoted(a: Any, n: Any, k: Any, contrast: Any = None) -> Refracted:
    """The well-conditioned form above, one precision up and rounded once: b = k a + n (n·b − k n·a)/n².

    float32 is computed in float64. float64 has no wider type: there the form is `refract_compensated`'s, whose
    double-word steps are that wider type. `contrast`: κ where it is known better than k, for the radicand; `k`
    itself still scales the tangent. Source: this project. `a`, `n` of any length from 1e-18 to 1e18.
    Weak nowhere for k ≤ 1e6; slow where float64 is (consumer GPUs).
    """
    if dr.type_v(a) != dr.VarType.Float32:
        return refract_compensated(a, n, k, contrast)
    wide: Any = dr.float64_array_t(type(a))
    number = dr.value_t(wide)
    d, m, k2 = wide(a), wide(n), number(component_of(a, k))
    # k² has 48 bits: the difference is rounded at most once.
    kappa = k2 * k2 - 1 if contrast is None else number(contrast)
    # Products of components are exact and their sums rounded at 2⁻⁵³: error of the radicand ≤ 8·2⁻⁵³ of its terms.
    c, w = dr.dot(m, d), dr.cross(m, d)
    radicand = c * c - kappa * dr.dot(w, w)
    transmitted = (radicand >= 0) & (c != 0)
    along, scale = dr.select(transmitted, dr.mulsign(dr.safe_sqrt(radicand), c), -c), dr.select(transmitted, k2, 1)
    # κ = 0 leaves b = a to the last bit: √(c²) is |c| exactly, so the factor of n is 0. So it is for c = 0.
    # Else k a + n (…) cancels to k·2⁻⁵³ |a|, which is far below 2⁻²⁴ for k ≤ 1e6.
    return type(a)(d * scale + m * quotient(along - scale * c, dr.dot(m, m))), transmitted


def refract_compensated(a: Any, n: Any, k: Any, contrast: Any = None) -> Refracted:
    """The well-conditioned form above with error-free transforms, in the arrays' own precision.

    A plain evaluation b₀ (a few u off) is corrected by its exact defect in the two equations that define b, so the
    sum b₀ + δ is rounded once. `contrast`: κ where it is known better than k, for the radicand; `k` itself still
    scales the tangent. Source: this project.
    Precondition: no over- or underflow in the fourth power of a length times k², which for float32 and k ≤ 1e6 means
    lengths of 1e-5 to 1e5. Weak nowhere.
    """
    k, axis = component_of(a, k), _axis(n)
    kappa = Double.product(k, k) - 1 if contrast is None else _split(a, contrast)
    if axis:
        index, sign = axis
        c, w = Double(a[index] if sign > 0 else -a[index]), [Double(a[i]) for i in range(3) if i != index]
    else:
        c, w = numerics.dot(n, a), numerics.cross(n, a)
    radicand = numerics.difference(c * c, kappa * numerics.sum_of_squares(w))
    transmitted = (radicand.hi >= 0) & (c.hi != 0)
    root, scale = radicand.sqrt(), dr.select(transmitted, k, 1)
    if axis:
        along = dr.select(transmitted, dr.mulsign(root.rounded(), c.hi), -c.hi)
        return _along_axis(a, axis, scale, along), transmitted
    root = Double(dr.mulsign(root.hi, c.hi), dr.mulsign(root.lo, c.hi))
    b = _correct(type(a), n, [w_i * scale for w_i in w], numerics.select(transmitted, root, -c))
    exact = dr.select((kappa.hi == 0) | (c.hi == 0), a, b)
    # To the last bit where the answer is `a`, but with the derivative of b, which is not that of `a`.
    return (_attach(exact, b) if dr.grad_enabled(b) else exact), transmitted


# Dr.Jit's type stub says that it returns nothing.
_attach: Any = dr.replace_grad


def _correct(vector: type, n: Any, around: list[Double], along: Double) -> Any:
    """The b with n × b = `around` and n·b = `along`: b = (around × n + along n)/n², rounded once.

    |b₀ − b| ≤ 8u |b|, and δ from the exact defects is right to 8u of itself: b₀ + δ is b to 64u² before it is
    rounded, so the final error is that of rounding, u/2 ulp a component.
    """
    inverse = quotient(1, dr.dot(n, n))

    def solve(around: list[Any], along: Any) -> Any:
        return (dr.cross(vector(*around), n) + n * along) * inverse

    b = solve([x.hi for x in around], along.hi)
    missing = [
        numerics.defect(around[m], (n[i], b[j]), (-n[j], b[i])) for i, j, m in ((1, 2, 0), (2, 0, 1), (0, 1, 2))
    ]
    return b + solve(missing, numerics.defect(along, *zip(n, b, strict=True)))


def _split(a: Any, x: Any) -> Double:
    """A number of any precision as a pair in the precision of the components of `a`."""
    hi = component_of(a, x)
    if dr.is_array_v(x) and type(x) is type(hi):
        return Double(hi)
    wide: Any = dr.float64_array_t(dr.value_t(type(a)))
    return Double(hi, component_of(a, wide(x) - wide(hi)))

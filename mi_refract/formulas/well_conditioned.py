"""The two forms at the rounding limit: `refract_promoted` and `refract_compensated`, `f(a, n, k) -> (b, transmitted)`.

Both solve, for `a` and `n` of any length, with w = n × a and κ = k² − 1,

    n × b = k w,   n·b = s √radicand,   radicand = (n·a)² − κ w²,   s = sign(n·a)

For the mirror direction they solve the same with k = 1 and −(n·a) in place of s √radicand. Near the critical angle the
two terms of the radicand cancel, and √ turns an error ε into √ε. So the radicand must be accurate to a few u², not to a
few u. With a literal normal along an axis, as in a local frame, no sums are left: w are the other two components of
`a`, and each component of b is one product, or the root.

Let ρ be |radicand| over the larger of its terms, and ε its error over that term. For ρ > ε the decision about total
internal reflection is that of the exact inputs, and the error of the root is ε cosθ/(√ρ + √(ρ + ε)) ≤ √ε cosθ:

    compensated   ε ≤ 500u³ (the largest value in tests is 9u³): in float32 1e-19, and the error of the root is at
                  most 0.006u, however near the critical angle
    promoted      ε ≤ 10·2⁻⁵³ < 2⁻⁴⁹ in float32: the error of the root is 0.08u for ρ > 2⁻⁴⁴ and 0.6u at the critical
                  angle itself; in float64 it is the compensated form

So both are at the rounding limit for ρ > 2⁻⁴⁴, and the compensated form is there everywhere. This holds for an exact k;
a `contrast` that is wider than a pair is rounded to one, and then ε ≤ u². Only adversarial inputs have a smaller ρ: of
random inputs near the critical angle one in 10⁹. There the refracted ray is within 2⁻²² cosθ of the surface and carries
T ≈ 2 (k + 1/k) √ρ of the power, less than 2e-6 for k ≤ 2.5.
"""

from __future__ import annotations

import functools
import operator
from typing import Any, NamedTuple

import drjit as dr

from mi_refract.numerics import (
    DoubleWord,
    Mask,
    Number,
    TripleWord,
    Vector3,
    as_component,
    computed_in_float64,
    differentiated,
    error_free,
    ieee_divide,
    replace_grad,
    rounded_product,
    two_sum,
)

# (b, transmitted): directions with the length of `a`, and a mask.
Refracted = tuple[Vector3, Mask]


def _axis(n: Vector3) -> tuple[int, int] | None:
    """(index, ±1) of a normal along an axis, if it is known while a kernel is traced and has no derivative; else None.

    Literals and Python floats are known.
    """
    if dr.is_jit_v(n):
        if differentiated(n) or not all(x.state == dr.VarState.Literal for x in n):
            return None
        n = [x[0] for x in n]
    sizes = [abs(x) for x in n]
    return (sizes.index(1), int(n[sizes.index(1)])) if sorted(sizes) == [0, 0, 1] else None


def _along_axis(a: Vector3, axis: tuple[int, int], scale: Number, along: Number) -> Any:
    """The vector with n·b = `along` whose other components are those of `a` times `scale`, for a literal axis n."""
    index, sign = axis
    return type(a)(*((along if sign > 0 else -along) if i == index else a[i] * scale for i in range(3)))


def _root(x: Number) -> Any:
    """√x, 0 for x < 0, with a derivative that is finite at 0 and right for every x > 0.

    That of `dr.safe_sqrt` is 0 for x < 2⁻⁵², which is every radicand if the vectors are short.
    """
    return dr.select(x > 0, dr.sqrt(dr.select(x > 0, x, 1)), 0 * x) if differentiated(x) else dr.safe_sqrt(x)


class LocalCosines(NamedTuple):
    """Cosines of a ray at a boundary whose normal is an axis, times |a|, in float64."""

    sin2: Number  # |a|² sin²θ_i
    cos_i: Number  # |a| |cos θ_i|
    radicand: Number  # |a|² cos²θ_t; negative under total internal reflection
    cos_t: Number  # √|radicand|


@computed_in_float64
def local_cosines(x: Number, y: Number, z: Number, contrast: Number) -> LocalCosines:
    """The cosines of a float32 ray with these components, z along the normal. `contrast`: κ = k² − 1, in float64.

    The error of the radicand is at most 5·2⁻⁵³ of its larger term.
    """
    wide: Any = dr.float64_array_t(type(x))
    x, y, z = wide(x), wide(y), wide(z)
    sin2 = dr.fma(x, x, y * y)
    # z² is exact; κ (x² + y²) has an error of 1·2⁻⁵³ each for a square, the sum and the product.
    radicand = dr.fma(z, z, -contrast * sin2)
    # For a radicand below 0 the root is not used, and |x| takes fewer operations than max(x, 0).
    cos_t = _root(radicand) if differentiated(radicand) else dr.sqrt(dr.abs(radicand))
    return LocalCosines(sin2, dr.abs(z), radicand, cos_t)


@computed_in_float64
def refract_promoted(
    a: Vector3, n: Vector3, k: Number, contrast: Number = None, local: LocalCosines | None = None
) -> Refracted:
    """The well-conditioned form above in the next wider precision, rounded once: b = k a + n (n·b − k n·a)/n².

    float32 is computed in float64. float64 has no wider type, so for float64 this is `refract_compensated`, which
    computes in double words. `contrast`: κ for the radicand, if it is known more accurately than from k; `k` still
    scales the tangent. `local`: the `local_cosines`, if `n` is an axis and they are known already.
    Shapes: `a`, `n` (3,), `k` () to b (3,), transmitted (). `a`, `n` of any length from 1e-18 to 1e18.
    Source: this project.
    No weak inputs for k ≤ 2²⁰, unless denormal numbers are flushed to 0; slow where float64 is slow (consumer GPUs).
    """
    if dr.type_v(a) != dr.VarType.Float32:
        return refract_compensated(a, n, k, contrast)
    wide: Any = dr.float64_array_t(type(a))
    number = dr.value_t(wide)
    if axis := _axis(n):  # only the radicand and its root need float64
        index, sign = axis
        k, along = as_component(a, k), a[index] if sign > 0 else -a[index]
        if local is None:
            kappa = dr.fma(number(k), number(k), -1) if contrast is None else number(contrast)
            x, y = (a[i] for i in range(3) if i != index)
            local = local_cosines(x, y, along, kappa)
        transmitted = (local.radicand >= 0) & (along != 0)
        onward = dr.select(transmitted, dr.mulsign(as_component(a, local.cos_t), along), -along)
        return _along_axis(a, axis, dr.select(transmitted, k, 1), onward), transmitted
    d, m, k2 = wide(a), wide(n), number(as_component(a, k))
    # k² has 48 bits, so the difference is rounded at most once.
    kappa = dr.fma(k2, k2, -1) if contrast is None else number(contrast)
    # Products of components are exact in float64. The relative error of each w is 2⁻⁵³, that of c twice as much: at
    # grazing incidence the sum of its first two products is much larger than c, so the error of that sum is added back.
    (partial, lost), w = two_sum(m.x * d.x, m.y * d.y), dr.cross(m, d)
    c = dr.fma(m.z, d.z, partial) + lost
    # Errors in 2⁻⁵³: 4 of c²; of κ w² 2 from w, 3 from the squares and their sum, 1 from the product.
    radicand = dr.fma(c, c, -kappa * dr.dot(w, w))
    transmitted = (radicand >= 0) & (c != 0)
    along, scale = dr.select(transmitted, dr.mulsign(_root(radicand), c), -c), dr.select(transmitted, k2, 1)
    # For κ = 0, b = a bit for bit: √(c²) is |c| exactly, so the factor of n is 0. The same holds for c = 0.
    # Otherwise k a + n (…) cancels with an error of 5.5k·2⁻⁵³ |a|, which is 0.011u for k = 2²⁰ (LARGEST_RATIO).
    return type(a)(dr.fma(m, ieee_divide(dr.fma(-scale, c, along), dr.dot(m, m)), d * scale)), transmitted


def refract_compensated(a: Vector3, n: Vector3, k: Number, contrast: Number = None) -> Refracted:
    """The well-conditioned form above with error-free transforms, in the arrays' own precision.

    A plain evaluation b₀, with an error of a few u, is corrected by its exact defect in the two equations that define
    b, so the sum b₀ + δ is rounded once. `contrast`: κ for the radicand, if it is known more accurately than from k;
    `k` still scales the tangent. Shapes: `a`, `n` (3,), `k` () to b (3,), transmitted (). Source: this project.
    No weak inputs, unless denormal numbers are flushed to 0.
    Precondition in float32: lengths of 1e-3 to 1e3, so that no product of four over- or underflows
    (the entries of FORMULAS scale their input with `numerics.scale_to_unit`).
    """
    k, axis = as_component(a, k), _axis(n)
    kappa = DoubleWord.product(k, k) - 1 if contrast is None else DoubleWord(as_component(a, contrast))
    if contrast is not None and not (dr.is_array_v(contrast) and type(contrast) is type(kappa.hi)):
        # A contrast of wider precision becomes a pair in the precision of `a`.
        wide: Any = dr.float64_array_t(dr.value_t(type(a)))
        kappa = DoubleWord(kappa.hi, as_component(a, wide(contrast) - wide(kappa.hi)))
    if axis:
        index, sign = axis
        c, w = TripleWord(a[index] if sign > 0 else -a[index]), [TripleWord(a[i]) for i in range(3) if i != index]
    else:
        c, w = error_free.dot(n, a), error_free.cross(n, a)
    # c² − κ w². Its error ε over the larger term, in u³: 3/cosθ from c, none from κ for 1 ≤ k < 2²³, 6 from each w, at
    # most 100 each from the squares, their sums, the product with κ and the difference. That is 500 for cosθ > 0.1, and
    # 12/cosθ more at grazing incidence.
    w2 = functools.reduce(operator.add, (w_i.squared() for w_i in w))
    radicand = (c.squared() - w2.times(kappa)).double()
    transmitted = (radicand.hi >= 0) & (c.hi != 0)
    root, scale = radicand.sqrt(), dr.select(transmitted, k, 1)
    if axis:
        onward = dr.mulsign(root.rounded(), c.hi)
        # c² may have underflowed: for κ = 0 use c itself, but with the derivative of the root.
        exact = dr.select(kappa.hi == 0, c.hi, onward)
        along = dr.select(transmitted, replace_grad(exact, onward) if differentiated(onward) else exact, -c.hi)
        return _along_axis(a, axis, scale, along), transmitted
    root = DoubleWord(dr.mulsign(root.hi, c.hi), dr.mulsign(root.lo, c.hi))
    b = _correct(type(a), n, [w_i.pair * scale for w_i in w], error_free.select(transmitted, root, -c.pair))
    # Where the answer is `a`, return it bit for bit, but with the derivative of b, which is not that of `a`. For an
    # invalid `n`, b is NaN and stays NaN.
    exact = dr.select(((kappa.hi == 0) | (c.hi == 0)) & (b[0] == b[0]), a, b)
    return (replace_grad(exact, b) if differentiated(b) else exact), transmitted


def _correct(vector: type, n: Vector3, around: list[DoubleWord], along: DoubleWord) -> Any:
    """The b with n × b = `around` and n·b = `along`: b = (around × n + along n)/n², rounded once.

    |b₀ − b| ≤ 8u |b|, and the relative error of δ from the exact defects is 8u. So the error of b₀ + δ before rounding
    is 64u² |b|, and the final error is that of rounding, half an ulp per component.
    """
    inverse = ieee_divide(1, dr.dot(n, n))

    def solve(around: list[Any], along: Number) -> Any:
        return vector(*(rounded_product(x, inverse) for x in dr.fma(n, along, dr.cross(vector(*around), n))))

    b = solve([x.hi for x in around], along.hi)
    defects = [
        error_free.defect(around[m], (n[i], b[j]), (-n[j], b[i])) for i, j, m in ((1, 2, 0), (2, 0, 1), (0, 1, 2))
    ]
    return b + solve(defects, error_free.defect(along, *zip(n, b, strict=True)))

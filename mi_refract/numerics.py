"""Error-free transforms and double-word arithmetic on Dr.Jit arrays. No optics.

A *pair* `(hi, lo)` stands for the unevaluated sum hi + lo with |lo| ≤ u |hi|, u the roundoff of the working
precision (2⁻²⁴ in float32, 2⁻⁵³ in float64). All functions hold for any Dr.Jit float type, scalar, LLVM or CUDA,
as long as nothing over- or underflows. They need a true fused multiply-add: `dr.fma` is one on every backend.

Sources: Knuth, TAOCP 2, 4.2.2 (two_sum); Ogita, Rump, Oishi 2005 (dot); Kahan, in Jeannerod, Louvet, Muller
2013 (difference of products); Joldes, Muller, Popescu 2017 (double-word operations and their bounds).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

Pair = tuple[Any, Any]


def component_of(a: Any, k: Any) -> Any:
    """The number `k` in the precision and backend of the components of the vector `a`, rounded once."""
    component = dr.value_t(type(a))
    if not dr.is_array_v(k):
        k = float(k)
    if component is float and dr.type_v(a) == dr.VarType.Float32:
        return dr.scalar.Array1f(k)[0]
    return component(k)


def quotient(x: Any, y: Any) -> Any:
    """x / y by the rules of IEEE 754 on every backend; a Python float would raise where y is 0."""
    if isinstance(y, float) and y == 0:
        return x * dr.rcp(y)
    return x / y


# Dr.Jit's type stub says that it returns an object.
_reinterpret: Any = dr.reinterpret_array


def near_unit(v: Any) -> tuple[Any, Any]:
    """(v / p, p), p the power of two for which the largest component of v / p is in [1, 2). Exact.

    Where squares could over- or underflow, which is in float32 on Dr.Jit's arrays; every other type has the range
    for lengths of 1e-18 to 1e18 as it is, and p is the literal 1.
    """
    if dr.type_v(v) != dr.VarType.Float32 or not dr.is_jit_v(v):
        return v, 1
    number: Any = dr.value_t(type(v))
    bits, reinterpret = dr.uint32_array_t(number), _reinterpret
    x, y, z = (reinterpret(bits, dr.detach(v_i)) & 0x7FFFFFFF for v_i in v)  # ordered as |v_i| are
    exponent = dr.maximum(dr.maximum(x, y), z) & 0x7F800000
    # 127 is the bias: of 1 / p and of p one each.
    return v * reinterpret(number, (2 * 127 << 23) - exponent), reinterpret(number, exponent)


def two_sum(x: Any, y: Any) -> Pair:
    """s = fl(x + y) and e with s + e = x + y exactly, whatever the magnitudes."""
    s = x + y
    y_part = s - x
    return s, (x - (s - y_part)) + (y - y_part)


def fast_two_sum(x: Any, y: Any) -> Pair:
    """As `two_sum`, three operations instead of six. Precondition: |x| ≥ |y| or x = 0."""
    s = x + y
    return s, y - (s - x)


def two_prod(x: Any, y: Any) -> Pair:
    """p = fl(x y) and e with p + e = x y exactly."""
    p = x * y
    return p, dr.fma(x, y, -p)


@dataclass(frozen=True)
class Double:
    """A number of twice the working precision, as the unevaluated sum hi + lo, |lo| ≤ 8u |hi|.

    Supports what a formula needs: + − × with another `Double` or a plain number, negation and `sqrt`. Relative error
    for normalised operands, |lo| ≤ u |hi|: + − ≤ 3u² whatever cancels, × ≤ 5u², √ ≤ 16u²; for others + − ≤ 10u²,
    × ≤ 90u².
    """

    hi: Any
    lo: Any = 0

    @property
    def is_plain(self) -> bool:
        """Without a low part, known while a kernel is traced: operations leave out what it would add."""
        return isinstance(self.lo, int)

    @staticmethod
    def product(x: Any, y: Any) -> Double:
        """x y exactly, for plain numbers x, y."""
        return Double(*two_prod(x, y))

    @staticmethod
    def of(x: Any) -> Double:
        return x if isinstance(x, Double) else Double(x)

    def __add__(self, other: Any) -> Double:
        # AccurateDWPlusDW, also right where the high parts cancel.
        other = Double.of(other)
        s, s_lo = two_sum(self.hi, other.hi)
        if other.is_plain:
            return Double(*fast_two_sum(s, s_lo + self.lo))
        t, t_lo = two_sum(self.lo, other.lo)
        s, s_lo = fast_two_sum(s, s_lo + t)
        return Double(*fast_two_sum(s, s_lo + t_lo))

    def __neg__(self) -> Double:
        return Double(-self.hi, -self.lo)

    def __sub__(self, other: Any) -> Double:
        return self + -Double.of(other)

    def __mul__(self, other: Any) -> Double:
        # lo · lo and the last normalisation are left out: |lo| ≤ 3u |hi| for normalised factors.
        other = Double.of(other)
        p, e = two_prod(self.hi, other.hi)
        if not self.is_plain:
            e = dr.fma(self.lo, other.hi, e)
        return Double(p, e if other.is_plain else dr.fma(self.hi, other.lo, e))

    def rounded(self) -> Any:
        """The nearest plain number."""
        return self.hi + self.lo

    def sqrt(self) -> Double:
        """√x for x ≥ 0; a finite number that means nothing for x < 0, and a finite derivative everywhere.

        r = x·rsqrt(x) is a few u off, whatever rsqrt the backend has; the exact defect of r² corrects it to a few u².
        Neither a division nor a square root is left, which both take longer than all else here.
        """
        inverse = dr.rsqrt(dr.select(self.hi > 0, self.hi, 1))
        root = self.hi * inverse
        return Double(root, (dr.fma(-root, root, self.hi) + self.lo) * (0.5 * inverse))


def select(mask: Any, x: Double, y: Double) -> Double:
    return Double(dr.select(mask, x.hi, y.hi), dr.select(mask, x.lo, y.lo))


def difference(x: Double, y: Double) -> Double:
    """x − y with an error ≤ 8u² (|x| + |y|): what cancels is not regained, for half the operations of `-`."""
    s, s_lo = two_sum(x.hi, -y.hi)
    return Double(*fast_two_sum(s, s_lo + (x.lo - y.lo)))


def dot(x: Any, y: Any) -> Double:
    """x · y of two 3-vectors as a `Double`: error ≤ u² |x · y| + 10u³ Σ|xᵢ yᵢ|, and 0 exactly when the sum is 0."""
    p, e0 = two_prod(x[0], y[0])
    q, e1 = two_prod(x[1], y[1])
    r, e2 = two_prod(x[2], y[2])
    s, e3 = two_sum(p, q)
    s, e4 = two_sum(s, r)
    # The five errors are at most u each of a partial sum; their own sum is kept as a pair, because after a
    # cancellation of s they are all that is left.
    t, t0 = two_sum(e0, e1)
    t, t1 = two_sum(t, e2)
    v, v0 = two_sum(e3, e4)
    t, t2 = two_sum(t, v)
    s, f = two_sum(s, t)
    return Double(*fast_two_sum(s, f + ((t0 + t1) + (t2 + v0))))


def cross(x: Any, y: Any) -> list[Double]:
    """x × y of two 3-vectors as three `Double`s, each with relative error ≤ 5u²."""
    return [_exact_difference(x[i], y[j], x[j], y[i]) for i, j in ((1, 2), (2, 0), (0, 1))]


def _exact_difference(x: Any, y: Any, z: Any, w: Any) -> Double:
    """x y − z w, relative error ≤ 5u².

    Where p and q cancel, d is exact, and a multiple of the last place of e: `fast_two_sum` is exact. Elsewhere
    |d| ≥ max(|p|, |q|)/2, so |e| ≤ 3u |d|, and d_lo + e loses at most 4u² |d|.
    """
    p, p_lo = two_prod(x, y)
    q, q_lo = two_prod(z, w)
    d, d_lo = two_sum(p, -q)
    e, e_lo = two_sum(p_lo, -q_lo)
    s, s_lo = fast_two_sum(d, d_lo + e)
    return Double(s, s_lo + e_lo)


def square(x: Double) -> Double:
    """x², relative error ≤ 5u², and |lo| ≤ 3u hi. Precondition: |lo| ≤ u |hi|, as for the two below."""
    p, e = two_prod(x.hi, x.hi)
    return Double(p, e if x.is_plain else dr.fma(x.lo, dr.fma(2, x.hi, x.lo), e))


def sum_of_squares(x: list[Double]) -> Double:
    """Σ xᵢ² of two or three `Double`s, relative error ≤ 19u²: 5u² of the squares, 14u² of their low parts' sum."""
    squares = [square(x_i) for x_i in x]
    total, low = squares[0].hi, squares[0].lo
    for each in squares[1:]:
        total, e = two_sum(total, each.hi)
        low = low + (each.lo + e)
    return Double(*fast_two_sum(total, low))


def defect(target: Double, *products: Pair) -> Any:
    """target − Σ xᵢ yᵢ as a plain number: error ≤ u |result| + 4u² Σ|xᵢ yᵢ|, so small defects keep their digits."""
    rest, low = target.hi, target.lo
    for x, y in products[:-1]:
        p, e = two_prod(x, y)
        rest, f = two_sum(rest, -p)
        low = low + (f - e)
    x, y = products[-1]
    return dr.fma(-x, y, rest) + low

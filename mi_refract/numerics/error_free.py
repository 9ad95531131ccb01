"""Error-free transforms and double-word arithmetic on Dr.Jit arrays. No optics.

A *pair* `(hi, lo)` stands for the unevaluated sum hi + lo with |lo| ≤ u |hi|, u the roundoff of the working
precision (2⁻²⁴ in float32, 2⁻⁵³ in float64). All functions are valid for any Dr.Jit float type, scalar, LLVM or CUDA,
as long as nothing over- or underflows. They need a true fused multiply-add, which `dr.fma` is on every backend, and
products that are rounded before they are added, which `rounded_product` ensures.

Sources: Knuth, TAOCP 2, 4.2.2 (two_sum); Ogita, Rump, Oishi 2005 (dot); Kahan, in Jeannerod, Louvet, Muller
2013 (difference of products); Joldes, Muller, Popescu 2017 (double-word operations and their bounds).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr

from .drjit_arrays import Mask, Number, Vector3, ieee_quotients, rounded_product

Pair = tuple[Number, Number]


def two_sum(x: Number, y: Number) -> Pair:
    """s = fl(x + y) and e with s + e = x + y exactly, for any magnitudes."""
    s = x + y
    y_part = s - x
    return s, (x - (s - y_part)) + (y - y_part)


def fast_two_sum(x: Number, y: Number) -> Pair:
    """As `two_sum`, with three operations instead of six. Precondition: |x| ≥ |y| or x = 0."""
    s = x + y
    return s, y - (s - x)


def two_prod(x: Number, y: Number) -> Pair:
    """p = fl(x y) and e with p + e = x y exactly."""
    p = rounded_product(x, y)
    return p, dr.fma(x, y, -p)


@dataclass(frozen=True)
class DoubleWord:
    """A number of twice the working precision, as the unevaluated sum hi + lo, |lo| ≤ 8u |hi|.

    Operations: + − × with another `DoubleWord` or a plain number, negation and `sqrt`. Relative error for normalised
    operands, |lo| ≤ u |hi|: + − ≤ 3u² even if they cancel, × ≤ 5u², √ ≤ 16u²; for others + − ≤ 10u², × ≤ 90u².
    """

    hi: Number
    lo: Number = 0

    @property
    def is_plain(self) -> bool:
        """Whether the low part is known to be 0 while a kernel is traced; operations then omit it."""
        return isinstance(self.lo, int)

    @staticmethod
    def product(x: Number, y: Number) -> DoubleWord:
        """x y exactly, for plain numbers x, y."""
        return DoubleWord(*two_prod(x, y))

    @staticmethod
    def of(x: DoubleWord | Number) -> DoubleWord:
        """`x` itself, or a plain number without a low part."""
        return x if isinstance(x, DoubleWord) else DoubleWord(x)

    def __add__(self, other: DoubleWord | Number) -> DoubleWord:
        """AccurateDWPlusDW of Joldes, Muller, Popescu 2017; `other` may be a plain number."""
        # Accurate also if the high parts cancel.
        other = DoubleWord.of(other)
        s, s_lo = two_sum(self.hi, other.hi)
        if other.is_plain:
            return DoubleWord(*fast_two_sum(s, s_lo + self.lo))
        t, t_lo = two_sum(self.lo, other.lo)
        s, s_lo = fast_two_sum(s, s_lo + t)
        return DoubleWord(*fast_two_sum(s, s_lo + t_lo))

    def __neg__(self) -> DoubleWord:
        """−x, exactly."""
        return DoubleWord(-self.hi, -self.lo)

    def __sub__(self, other: DoubleWord | Number) -> DoubleWord:
        """x − y as x + (−y)."""
        return self + -DoubleWord.of(other)

    def __mul__(self, other: DoubleWord | Number) -> DoubleWord:
        """x y; `other` may be a plain number."""
        # lo · lo and the last normalisation are omitted: |lo| ≤ 3u |hi| for normalised factors.
        other = DoubleWord.of(other)
        p, e = two_prod(self.hi, other.hi)
        if not self.is_plain:
            e = dr.fma(self.lo, other.hi, e)
        return DoubleWord(p, e if other.is_plain else dr.fma(self.hi, other.lo, e))

    def rounded(self) -> Number:
        """The nearest plain number."""
        return self.hi + self.lo

    def sqrt(self) -> DoubleWord:
        """√x for x ≥ 0; a meaningless finite number for x < 0, and a finite derivative everywhere.

        The error of r = x·rsqrt(x) is a few u on every backend; the exact defect of r² corrects it to a few u². This
        avoids a division and a square root, which both take longer than all other operations here.
        """
        positive = dr.select(self.hi > 0, self.hi, 1)
        with ieee_quotients(self.hi):  # the reciprocal of a denormal number is infinite
            inverse = dr.rsqrt(positive) if dr.type_v(positive) == dr.VarType.Float32 else dr.rcp(dr.sqrt(positive))
        root = rounded_product(self.hi, inverse)
        return DoubleWord(root, (dr.fma(-root, root, self.hi) + self.lo) * (0.5 * inverse))


def select(mask: Mask, x: DoubleWord, y: DoubleWord) -> DoubleWord:
    """`x` where the mask is True, else `y`."""
    return DoubleWord(dr.select(mask, x.hi, y.hi), dr.select(mask, x.lo, y.lo))


@dataclass(frozen=True)
class TripleWord:
    """A number to third order in u: hi, plus the terms of `first`, each of order u, plus `second`, of order u².

    Sums and products keep every error of first order as a separate term and add those of second order plainly. As long
    as nothing has cancelled, |first| ≤ 5u |hi| and |second| ≤ 100u² |hi|, so the error of each operation is 100u³ of
    its larger operand. Terms of third order must not underflow.
    """

    hi: Number
    first: tuple[Number, ...] = ()
    second: Number = 0

    def __add__(self, other: TripleWord) -> TripleWord:
        """x + y; the error of the sum of the high parts becomes another term of first order."""
        s, e = two_sum(self.hi, other.hi)
        return TripleWord(s, (*self.first, *other.first, e), self.second + other.second)

    def __neg__(self) -> TripleWord:
        """−x, exactly."""
        return TripleWord(-self.hi, tuple(-x for x in self.first), -self.second)

    def __sub__(self, other: TripleWord) -> TripleWord:
        """x − y as x + (−y)."""
        return self + -other

    def collected(self) -> TripleWord:
        """The same number with one term of first order."""
        first, *rest = self.first
        second = self.second
        for x in rest:
            first, e = two_sum(first, x)
            second = second + e
        return TripleWord(self.hi, (first,), second)

    def times(self, x: DoubleWord) -> TripleWord:
        """The product with a double word."""
        y = self.collected()
        (p, e), (q, f) = two_prod(x.hi, y.hi), two_prod(x.hi, y.first[0])
        if x.is_plain:
            return TripleWord(p, (e, q), dr.fma(x.hi, y.second, f))
        r, g = two_prod(x.lo, y.hi)
        return TripleWord(p, (e, q, r), dr.fma(x.hi, y.second, dr.fma(x.lo, y.first[0], f + g)))

    def squared(self) -> TripleWord:
        """x² of a number with at most one term of first order."""
        p, e = two_prod(self.hi, self.hi)
        if not self.first:
            return TripleWord(p, (e,))
        twice, mid = self.hi + self.hi, self.first[0]
        q, f = two_prod(twice, mid)
        return TripleWord(p, (e, q), dr.fma(twice, self.second, dr.fma(mid, mid, f)))

    def double(self) -> DoubleWord:
        """The number rounded to a pair, accurate also if the terms of hi have cancelled."""
        # hi is a multiple of the last place of the first-order terms, or 0: `fast_two_sum` is exact.
        x = self.collected()
        hi, lo = fast_two_sum(x.hi, x.first[0])
        return DoubleWord(*fast_two_sum(hi, lo + x.second))

    @property
    def pair(self) -> DoubleWord:
        """The terms of order 0 and 1 as a pair, for a number with at most one term of first order."""
        return DoubleWord(self.hi, *self.first)


def dot(x: Vector3, y: Vector3) -> TripleWord:
    """x · y of two 3-vectors: error ≤ 3u³ Σ|xᵢ yᵢ|, and hi is 0 only if the sum is less than that."""
    p, e0 = two_prod(x[0], y[0])
    q, e1 = two_prod(x[1], y[1])
    r, e2 = two_prod(x[2], y[2])
    s, e3 = two_sum(p, q)
    s, e4 = two_sum(s, r)
    # Each of the five errors is at most u of a partial sum. Their sum is kept as a pair, because it is all that is left
    # if s cancels.
    t, t0 = two_sum(e0, e1)
    t, t1 = two_sum(t, e2)
    v, v0 = two_sum(e3, e4)
    t, t2 = two_sum(t, v)
    s, f = two_sum(s, t)
    mid, lo = two_sum(f, (t0 + t1) + (t2 + v0))
    hi, mid = fast_two_sum(s, mid)
    return TripleWord(hi, (mid,), lo)


def cross(x: Vector3, y: Vector3) -> list[TripleWord]:
    """x × y of two 3-vectors, each component with relative error ≤ 6u³: its four exact terms are d, d_lo, e, e_lo.

    If p and q cancel, d is exact, and a multiple of the last place of e; otherwise |d| ≥ max(|p|, |q|)/2, so that
    |d_lo + e| ≤ 4u |d|. In both cases `fast_two_sum` is exact.
    """
    components = []
    for i, j in ((1, 2), (2, 0), (0, 1)):
        (p, p_lo), (q, q_lo) = two_prod(x[i], y[j]), two_prod(x[j], y[i])
        d, d_lo = two_sum(p, -q)
        e, e_lo = two_sum(p_lo, -q_lo)
        mid, lo = two_sum(d_lo, e)
        hi, mid = fast_two_sum(d, mid)
        components.append(TripleWord(hi, (mid,), lo + e_lo))
    return components


def defect(target: DoubleWord, *products: Pair) -> Number:
    """target − Σ xᵢ yᵢ as a plain number: error ≤ u |result| + 4u² Σ|xᵢ yᵢ|, so small defects stay accurate."""
    rest, low = target.hi, target.lo
    for x, y in products[:-1]:
        p, e = two_prod(x, y)
        rest, f = two_sum(rest, -p)
        low = low + (f - e)
    x, y = products[-1]
    return dr.fma(-x, y, rest) + low

"""Numbers as unevaluated sums of floats, for the code that judges formulas, next to the exact oracle.

An *expansion* is a list of floats, largest first, whose exact sum is the number. Only the operators + − × / are
used, so the same code works on numpy arrays and Dr.Jit arrays, and only `two_sum` is shared with the compensated
formula. Nothing may over- or underflow. Sources: Dekker 1971 (two_prod without a fused multiply-add); Ogita, Rump,
Oishi 2005 (repeated VecSum).
"""

from __future__ import annotations

from collections.abc import Sequence

from .drjit_arrays import Number, Vector3, rounded_product
from .error_free import two_sum

FloatExpansion = list[Number]
# Splits the 53 bits of a float64 into two halves whose products are exact.
_SPLITTER = 2.0**27 + 1


def two_prod(x: Number, y: Number) -> tuple[Number, Number]:
    """p = fl(x y) and e with p + e = x y exactly. float64 only."""
    (x_hi, x_lo), (y_hi, y_lo) = _split(x), _split(y)
    p = rounded_product(x, y)
    return p, ((x_hi * y_hi - p) + x_hi * y_lo + x_lo * y_hi) + x_lo * y_lo


def _split(x: Number) -> tuple[Number, Number]:
    c = rounded_product(x, _SPLITTER)
    hi = c - (c - x)
    return hi, x - hi


def distil(terms: Sequence[Number], words: int = 3) -> FloatExpansion:
    """The sum of m `terms` in `words` floats: error ≤ (m u)^words Σ|terms|; exact if `words` floats can represent it.

    Every pass takes out the rounded sum and leaves its exact rounding errors.
    """
    sums, rest = [], list(terms)
    for _ in range(words):
        total, errors = rest[0], []
        for term in rest[1:]:
            total, error = two_sum(total, term)
            errors.append(error)
        sums.append(total)
        if not errors:
            break
        rest = errors
    # If the first sums cancelled, a later one becomes the leading term.
    for _ in sums:
        for j in reversed(range(len(sums) - 1)):
            sums[j], sums[j + 1] = two_sum(sums[j], sums[j + 1])
    return sums


def product(x: FloatExpansion, y: FloatExpansion, words: int = 3) -> FloatExpansion:
    """x y of two expansions: relative error ≤ 16 u^words."""
    terms: FloatExpansion = []
    for i, x_i in enumerate(x):
        for j, y_j in enumerate(y):
            if i + j < words:
                terms += two_prod(x_i, y_j)
    return distil(terms, words)


def negated(x: Sequence[Number]) -> FloatExpansion:
    """−x of an expansion."""
    return [-x_i for x_i in x]


def quotient(x: FloatExpansion, y: FloatExpansion, words: int = 2) -> FloatExpansion:
    """x / y of two expansions, by long division: relative error ≤ 16 u^words."""
    digits, rest = [], list(x)
    for _ in range(words):
        digit = rest[0] / y[0]
        digits.append(digit)
        rest = distil([*rest, *negated(product(y, [digit], words + 1))], words)
    return distil(digits, words)


def dot(x: Vector3, y: Vector3, words: int = 3) -> FloatExpansion:
    """x · y of two vectors of floats, exactly 0 if it is 0; computed with one more word, as words may cancel."""
    return distil([part for x_i, y_i in zip(x, y, strict=True) for part in two_prod(x_i, y_i)], words + 1)[:words]


def cross(x: Vector3, y: Vector3, words: int = 3) -> list[FloatExpansion]:
    """x × y of two 3-vectors of floats, each component as in `dot`."""
    return [dot((x[i], x[j]), (y[j], -y[i]), words) for i, j in ((1, 2), (2, 0), (0, 1))]

"""One pure Dr.Jit function per documented formula of refraction.

Every formula is `f(a, n, k) -> (b, transmitted)` in the conventions of the package docstring. The entries of FORMULAS
are total functions without branches on data: invalid input (a zero or non-finite vector, a ratio outside
2⁻²⁰ … 2²⁰) gives NaN and False. The functions of this module skip that check, for callers that have made it, such as
the plugin; NaN in `a` or `n` still gives NaN.

`a` and `n` are 3-vectors of any Dr.Jit backend and precision, `k` is a number or an array of that precision; a wider
`k` is rounded to it once. The documented formulas take unit `a` and `n`; an error of their lengths is an error of the
result. Shapes: `a`, `n` (3,), `k` () to b (3,), transmitted ().
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr

from mi_refract.numerics import Mask, Number, Vector3, as_component, ieee_divide

from .well_conditioned import Refracted


def _select_direction(a: Vector3, n: Vector3, c: Number, radicand: Number, b: Vector3) -> Refracted:
    """The transmitted direction `b`, or the mirror direction where the radicand is below 0.

    Callers compute roots with `dr.safe_sqrt`, √max(radicand, 0), which has a finite derivative at 0.
    """
    transmitted = (radicand >= 0) & (c != 0)
    return dr.select(transmitted, b, a - n * ieee_divide(2 * c, dr.dot(n, n))), transmitted


# Reflection ----------------------------------------------------------------------------------------------------


def wedge(n: Vector3, a: Vector3) -> Vector3:
    """The components of n ∧ a on the basis bivectors (yz, zx, xy); in three dimensions they equal those of n × a.

    Shapes (3,) and (3,) to (3,). Source: document 000.
    """
    return dr.cross(n, a)


def contract(n: Vector3, bivector: Vector3) -> Vector3:
    """n ⌋ B, the vector part of the geometric product n B. For B = n ∧ a it is n² a − n (n·a).

    Shapes (3,) and (3,) to (3,). Source: document 000.
    """
    return dr.cross(bivector, n)


def reflect(a: Vector3, n: Vector3) -> Vector3:
    """b = a − 2 n (n·a). Source: document 000, "Reflection". Unit `n`; shapes (3,) and (3,) to (3,)."""
    n = n if dr.is_array_v(n) else type(a)(n)  # a tuple times a number of N entries would be N entries, not a vector
    return a - n * (2 * dr.dot(n, a))


def reflect_sandwich(a: Vector3, n: Vector3) -> Vector3:
    """b = −n a n, with the geometric product n a = n·a + n∧a multiplied once more by n from the right.

    (n·a) n + (n∧a) n, and (n∧a) n = −n ⌋ (n∧a) because n anticommutes with a bivector that contains it.
    Source: document 000, boxed form of "Reflection". Unit `n`; shapes (3,) and (3,) to (3,).
    """
    n = n if dr.is_array_v(n) else type(a)(n)
    return contract(n, wedge(n, a)) - n * dr.dot(n, a)


# The documented formulas ---------------------------------------------------------------------------------------


def refract_wedge(a: Vector3, n: Vector3, k: Number) -> Refracted:
    """b = k n(n∧a) + s n √(a² + k² (n∧a)²),  s = sign(n·a).

    Source: document 000, boxed form of "Refraction" (there n·a < 0), made two-sided. Unit `n`.
    Weak near the critical angle, for k near 1 at grazing incidence and for k ≫ 1: the radicand cancels.
    """
    k = as_component(a, k)
    c, bivector = dr.dot(n, a), wedge(n, a)
    radicand = dr.dot(a, a) - k * k * dr.dot(bivector, bivector)  # (n∧a)² = −|n×a|²
    b = k * contract(n, bivector) + n * dr.mulsign(dr.safe_sqrt(radicand), c)
    return _select_direction(a, n, c, radicand, b)


def refract_wedge_contrast(a: Vector3, n: Vector3, k: Number) -> Refracted:
    """b = k n(n∧a) + s n √((n·a)² + (n∧a)² (k² − 1)),  s = sign(n·a).

    Source: document 000, last form of "Refraction", made two-sided. Unit `n`.
    Weak for k near 1, where k² − 1 loses digits, and near the critical angle, where two large terms cancel.
    """
    k = as_component(a, k)
    c, bivector = dr.dot(n, a), wedge(n, a)
    radicand = c * c - dr.dot(bivector, bivector) * (k * k - 1)
    b = k * contract(n, bivector) + n * dr.mulsign(dr.safe_sqrt(radicand), c)
    return _select_direction(a, n, c, radicand, b)


def refract_cross(a: Vector3, n: Vector3, k: Number) -> Refracted:
    """t = n × c + sgn(i·n) √(1 − ‖c‖²) n,  c = k (i × n).

    Source: document 001, eq. 6; its ‖c‖ (n × ĉ) is 0/0 at normal incidence, n × c is the same and safe.
    Unit `a`, `n`. Weak near the critical angle, for k near 1 at grazing incidence and for k ≫ 1.
    """
    k = as_component(a, k)
    cos, c = dr.dot(a, n), k * dr.cross(a, n)
    radicand = 1 - dr.dot(c, c)
    t = dr.cross(n, c) + n * dr.mulsign(dr.safe_sqrt(radicand), cos)
    return _select_direction(a, n, cos, radicand, t)


def refract_decomposed(a: Vector3, n: Vector3, k: Number) -> Refracted:
    """Split `a` along `n`, scale the tangent by k, restore the length.

    b = k a − n (k c + s √(1 − k²(1 − c²))),   c = n·a,  s = −sign(c)
    Source: document 002, eq. 1, made two-sided. Unit `a`, `n`.
    Weak near the critical angle, for k near 1 at grazing incidence and for k ≫ 1: the radicand cancels.
    """
    k = as_component(a, k)
    c = dr.dot(n, a)
    radicand = 1 - k * k * (1 - c * c)
    b = k * a - n * (k * c - dr.mulsign(dr.safe_sqrt(radicand), c))
    return _select_direction(a, n, c, radicand, b)


def refract_2d(
    i: Sequence[Number],
    l: Sequence[Number],  # noqa: E741 (the document's names)
    k: Number,
) -> tuple[list[Number], Mask]:
    """Refract a 2D direction `i` at a boundary with direction `l`, by a change of basis.

    B = [[−l_y, l_x], [l_x, l_y]] turns `l` into (0, 1); B is its own inverse. With i_B = B i,
    X = k |i_Bβ| / |i_B|,  b_B = |i| (sign(i_Bα) √(1 − X²), sign(i_Bβ) X); (−i_Bα, i_Bβ) where X > 1.
    Source: document 004, with X = k R/√(1 + R²) in place of the printed k R/(1 + R²), and R = i_Bβ/i_Bα, infinite
    along the boundary, multiplied out. `i`, `l`: two components each, `l` unit; `b` keeps the length of `i`.
    """
    along_n, along_l = dr.fma(l[0], i[1], -(l[1] * i[0])), dr.fma(l[0], i[0], l[1] * i[1])
    length = dr.sqrt(dr.fma(i[0], i[0], i[1] * i[1]))
    x = ieee_divide(k * dr.abs(along_l), length)
    scale = (l[0] * l[0] + l[1] * l[1]) * length * k
    valid = (scale > 0) & (scale < dr.inf)
    transmitted = valid & (x <= 1) & (along_n != 0)
    b_n = dr.select(transmitted, dr.mulsign(dr.safe_sqrt(dr.fma(-x, x, 1)) * length, along_n), -along_n)
    b_l = dr.select(transmitted, dr.mulsign(x * length, along_l), along_l)
    b = [dr.fma(l[0], b_l, -(l[1] * b_n)), dr.fma(l[0], b_n, l[1] * b_l)]
    return [dr.select(valid, b_j, dr.nan) for b_j in b], transmitted


def refract_rotated(a: Vector3, n: Vector3, k: Number) -> Refracted:
    """`refract_2d` lifted into the plane of incidence, spanned by n and t = (a − n (n·a)) / |a − n (n·a)|.

    There the boundary is (0, 1) and i = (−n·a, |a − n (n·a)|), because B turns n into −x. At normal incidence t
    is any unit vector, times 0. Source: document 004. Unit `n`.
    Weak near the critical angle: √(1 − X²) magnifies the rounding of X.
    """
    k = as_component(a, k)
    c = dr.dot(n, a)
    tangent = a - n * c
    sine = dr.norm(tangent)
    (b_n, b_t), transmitted = refract_2d((c, sine), (0, 1), k)
    # For a tangent of 0 its factor is the limit k, so that derivatives are right.
    factor = dr.select(sine > 0, ieee_divide(b_t, sine), dr.select(transmitted, k, 1))
    b = n * b_n + tangent * factor
    return _select_direction(a, n, c, dr.select(transmitted, 1, -1), b)

"""One pure Dr.Jit function per documented formula of refraction, and the FORMULAS table.

Every formula is `f(a, n, k) -> (b, transmitted)` in the conventions of the package docstring: `a` travels toward
the surface, `n` is a normal on either side, k = n_from / n_to, and `b` leaves the boundary with the length of `a`.
Where `transmitted` is False (total internal reflection, or a tangential ray) `b` is the mirror direction.

The entries of FORMULAS are total functions without branches on data: input that is not a refraction (a zero or
non-finite vector, a ratio that is not a positive finite number) gives NaN and False. The functions themselves leave
that check out (NaN still gives NaN), for callers that have made it, as the plugin has. `a` and `n` are 3-vectors of
any Dr.Jit backend and precision, `k` a number or an array of that precision; a wider `k` is rounded to it, once.
The documented formulas take unit `a` and `n`; what those are off by, the result is off by.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from . import numerics
from .numerics import Double, quotient

Refracted = tuple[Any, Any]


# Shared by all formulas ----------------------------------------------------------------------------------------


def _scalar(a: Any, k: Any) -> Any:
    """`k` in the precision and backend of the components of `a`: rounded once, the same for every formula."""
    component = dr.value_t(type(a))
    if component is float and dr.type_v(a) == dr.VarType.Float32:
        return dr.scalar.Array1f(k)[0]
    return component(k)


def _conclude(a: Any, n: Any, c: Any, radicand: Any, b: Any) -> Refracted:
    """Choose between the transmitted direction `b` and the mirror direction."""
    transmitted = (radicand >= 0) & (c != 0)
    return dr.select(transmitted, b, a - n * quotient(2 * c, dr.dot(n, n))), transmitted


def _root(radicand: Any) -> Any:
    """√max(radicand, 0), with a finite derivative at 0 (the mirror direction is chosen below 0)."""
    return dr.safe_sqrt(radicand)


# Reflection ----------------------------------------------------------------------------------------------------


def wedge(n: Any, a: Any) -> Any:
    """n ∧ a, as its components on the basis bivectors (yz, zx, xy); in three dimensions these are those of n × a."""
    return dr.cross(n, a)


def contract(n: Any, bivector: Any) -> Any:
    """n ⌋ B, the vector part of the geometric product n B. For B = n ∧ a it is n² a − n (n·a)."""
    return dr.cross(bivector, n)


def reflect(a: Any, n: Any) -> Any:
    """b = a − 2 n (n·a). Source: document 000, "Reflection". Unit `n`; shapes (3,) and (3,) to (3,)."""
    return a - n * (2 * dr.dot(n, a))


def reflect_sandwich(a: Any, n: Any) -> Any:
    """b = −n a n, with the geometric product n a = n·a + n∧a multiplied once more by n from the right.

    (n·a) n + (n∧a) n, and (n∧a) n = −n ⌋ (n∧a) because n anticommutes with a bivector that contains it.
    Source: document 000, boxed form of "Reflection". Unit `n`; shapes (3,) and (3,) to (3,).
    """
    return contract(n, wedge(n, a)) - n * dr.dot(n, a)


# The documented formulas ---------------------------------------------------------------------------------------


def refract_wedge(a: Any, n: Any, k: Any) -> Refracted:
    """b = k n(n∧a) + s n √(a² + k² (n∧a)²),  s = sign(n·a).

    Source: document 000, boxed form of "Refraction" (there n·a < 0), made two-sided. Unit `n`.
    Weak near the critical angle, for k near 1 at grazing incidence and for k ≫ 1: the radicand cancels.
    """
    k = _scalar(a, k)
    c, bivector = dr.dot(n, a), wedge(n, a)
    radicand = dr.dot(a, a) - k * k * dr.dot(bivector, bivector)  # (n∧a)² = −|n×a|²
    b = k * contract(n, bivector) + n * dr.mulsign(_root(radicand), c)
    return _conclude(a, n, c, radicand, b)


def refract_wedge_contrast(a: Any, n: Any, k: Any) -> Refracted:
    """b = k n(n∧a) + s n √((n·a)² + (n∧a)² (k² − 1)),  s = sign(n·a).

    Source: document 000, last form of "Refraction", made two-sided. Unit `n`.
    Weak where k² − 1 loses digits (k near 1) and where two large terms cancel near the critical angle.
    """
    k = _scalar(a, k)
    c, bivector = dr.dot(n, a), wedge(n, a)
    radicand = c * c - dr.dot(bivector, bivector) * (k * k - 1)
    b = k * contract(n, bivector) + n * dr.mulsign(_root(radicand), c)
    return _conclude(a, n, c, radicand, b)


def refract_cross(a: Any, n: Any, k: Any) -> Refracted:
    """t = n × c + sgn(i·n) √(1 − ‖c‖²) n,  c = k (i × n).

    Source: document 001, eq. 6; its ‖c‖ (n × ĉ) is 0/0 at normal incidence, n × c is the same and safe.
    Unit `a`, `n`. Weak near the critical angle, for k near 1 at grazing incidence and for k ≫ 1.
    """
    k = _scalar(a, k)
    cos, c = dr.dot(a, n), k * dr.cross(a, n)
    radicand = 1 - dr.dot(c, c)
    t = dr.cross(n, c) + n * dr.mulsign(_root(radicand), cos)
    return _conclude(a, n, cos, radicand, t)


def refract_decomposed(a: Any, n: Any, k: Any) -> Refracted:
    """Split `a` along `n`, scale the tangent by k, restore the length.

    b = k a − n (k c + s √(1 − k²(1 − c²))),   c = n·a,  s = −sign(c)
    Source: document 002, eq. 1, made two-sided. Unit `a`, `n`.
    Weak near the critical angle, for k near 1 at grazing incidence and for k ≫ 1: the radicand cancels.
    """
    k = _scalar(a, k)
    c = dr.dot(n, a)
    radicand = 1 - k * k * (1 - c * c)
    b = k * a - n * (k * c - dr.mulsign(_root(radicand), c))
    return _conclude(a, n, c, radicand, b)


def refract_2d(i: Any, l: Any, k: Any) -> tuple[list[Any], Any]:  # noqa: E741 (the document's names)
    """Refract a 2D direction `i` at a boundary with direction `l`, by a change of basis.

    B = [[−l_y, l_x], [l_x, l_y]] turns `l` into (0, 1); B is its own inverse. With i_B = B i,
    X = k |i_Bβ| / |i_B|,  b_B = |i| (sign(i_Bα) √(1 − X²), sign(i_Bβ) X); (−i_Bα, i_Bβ) where X > 1.
    Source: document 004, with X = k R/√(1 + R²) in place of the printed k R/(1 + R²), and R = i_Bβ/i_Bα, infinite
    along the boundary, multiplied out. `i`, `l`: two components each, `l` unit; `b` keeps the length of `i`.
    """
    along_n, along_l = l[0] * i[1] - l[1] * i[0], l[0] * i[0] + l[1] * i[1]
    length = dr.sqrt(i[0] * i[0] + i[1] * i[1])
    x = quotient(k * dr.abs(along_l), length)
    scale = (l[0] * l[0] + l[1] * l[1]) * length * k
    valid = (scale > 0) & (scale < dr.inf)
    transmitted = valid & (x <= 1) & (along_n != 0)
    b_n = dr.select(transmitted, dr.mulsign(_root(1 - x * x) * length, along_n), -along_n)
    b_l = dr.select(transmitted, dr.mulsign(x * length, along_l), along_l)
    b = [l[0] * b_l - l[1] * b_n, l[0] * b_n + l[1] * b_l]
    return [dr.select(valid, b_j, dr.nan) for b_j in b], transmitted


def refract_rotated(a: Any, n: Any, k: Any) -> Refracted:
    """`refract_2d` lifted into the plane of incidence, spanned by n and t = (a − n (n·a)) / |a − n (n·a)|.

    There the boundary is (0, 1) and i = (−n·a, |a − n (n·a)|), because B turns n into −x. At normal incidence t
    is any unit vector, times 0. Source: document 004. Unit `n`.
    Weak near the critical angle: √(1 − X²) magnifies the rounding of X.
    """
    k = _scalar(a, k)
    c = dr.dot(n, a)
    tangent = a - n * c
    sine = dr.norm(tangent)
    (b_n, b_t), transmitted = refract_2d((c, sine), (0, 1), k)
    b = n * b_n + tangent * dr.select(sine > 0, quotient(b_t, sine), 0)
    return _conclude(a, n, c, dr.select(transmitted, 1, -1), b)


# Ours: right everywhere ----------------------------------------------------------------------------------------
#
# Both solve, for `a` and `n` of any length, with w = n × a and κ = k² − 1,
#
#     n × b = k w,   n·b = s √radicand,   radicand = (n·a)² − κ w²,   s = sign(n·a)
#
# and the mirror direction as the same with k = 1 and −(n·a) in place of s √radicand. Near the critical angle the
# two terms of the radicand cancel, and √ makes of an error ε one of √ε: so the radicand must be right to a few u²,
# not to a few u. A literal normal along an axis, as in a local frame, leaves nothing to add up: w are the other two
# components of `a`, and each component of b is one product, or the root.


def _axis(n: Any) -> tuple[int, int] | None:
    """(index, ±1) of a normal that is a Dr.Jit literal along an axis, as known while a kernel is traced; else None."""
    if not all(dr.is_jit_v(x) and x.state == dr.VarState.Literal for x in n):
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
    Weak nowhere for k < 1e7; slow where float64 is (consumer GPUs).
    """
    if dr.type_v(a) != dr.VarType.Float32:
        return refract_compensated(a, n, k, contrast)
    wide: Any = dr.float64_array_t(type(a))
    number = dr.value_t(wide)
    d, m, k2 = wide(a), wide(n), number(_scalar(a, k))
    # k² has 48 bits: the difference is rounded at most once.
    kappa = k2 * k2 - 1 if contrast is None else number(contrast)
    # Products of components are exact and their sums rounded at 2⁻⁵³: error of the radicand ≤ 8·2⁻⁵³ of its terms.
    c, w = dr.dot(m, d), dr.cross(m, d)
    radicand = c * c - kappa * dr.dot(w, w)
    transmitted = (radicand >= 0) & (c != 0)
    along, scale = dr.select(transmitted, dr.mulsign(_root(radicand), c), -c), dr.select(transmitted, k2, 1)
    # κ = 0 leaves b = a to the last bit: √(c²) is |c| exactly, so the factor of n is 0. So it is for c = 0.
    # Else k a + n (…) cancels to k·2⁻⁵³ |a|, which is far below 2⁻²⁴ for k < 1e7.
    return type(a)(d * scale + m * quotient(along - scale * c, dr.dot(m, m))), transmitted


def refract_compensated(a: Any, n: Any, k: Any, contrast: Any = None) -> Refracted:
    """The well-conditioned form above with error-free transforms, in the arrays' own precision.

    A plain evaluation b₀ (a few u off) is corrected by its exact defect in the two equations that define b, so the
    sum b₀ + δ is rounded once. `contrast`: κ where it is known better than k, for the radicand; `k` itself still
    scales the tangent. Source: this project.
    Precondition: no over- or underflow in the fourth power of the lengths, 1e-8 to 1e8 in float32. Weak nowhere.
    """
    k, axis = _scalar(a, k), _axis(n)
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
    return dr.select((kappa.hi == 0) | (c.hi == 0), a, b), transmitted


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
    hi = _scalar(a, x)
    if dr.is_array_v(x) and type(x) is type(hi):
        return Double(hi)
    wide: Any = dr.float64_array_t(dr.value_t(type(a)))
    return Double(hi, _scalar(a, wide(x) - wide(hi)))


# The table -----------------------------------------------------------------------------------------------------


def _rounding(u: float, k: float) -> float:
    """The rounding of the exact answer, √3/2 u at most, and a twentieth more for what precedes it."""
    return 0.92 * u


def cancelling(growth: int) -> Callable[[float, float], float]:
    """A-priori bound of a form whose radicand cancels.

    The radicand is off by ≤ 12u K^growth, K = max(1, k): nine roundings and inputs that are unit only to u. Its
    root is then off by at most √ of that, and what is linear in the inputs by ≤ 8u K.
    """

    def bound(u: float, k: float) -> float:
        k = max(1.0, k)
        return 8 * u * k + (12 * u * k**growth) ** 0.5

    return bound


@dataclass(frozen=True)
class Formula:
    """A formula of refraction, `entry(a, n, k) -> (b, transmitted)`, with its source and its error budget.

    `budget(u, k)` bounds the chord error |b − exact| / |a| for roundoff u and ratios up to k. `exact_decision`:
    total internal reflection is decided for the exact inputs. `takes_contrast`: `contrast` is used, not ignored.
    """

    function: Callable[..., Refracted]
    source: str
    equation: str
    budget: Callable[[float, float], float]
    exact_decision: bool = False
    takes_contrast: bool = False

    def __call__(self, a: Any, n: Any, k: Any, contrast: Any = None) -> Refracted:
        """The formula as a total function: NaN and False for what is no refraction."""
        b, transmitted = self.unchecked(a, n, k, contrast)
        valid = (k > 0) & (k < dr.inf)
        for length2 in (dr.dot(a, a), dr.dot(n, n)):
            valid &= (length2 > 0) & (length2 < dr.inf)
        return dr.select(valid, b, dr.nan), valid & transmitted

    def unchecked(self, a: Any, n: Any, k: Any, contrast: Any = None) -> Refracted:
        """The formula alone. Precondition: `a`, `n` not zero, `k` positive and finite; NaN gives NaN and False."""
        if self.takes_contrast:
            return self.function(a, n, k, contrast)
        return self.function(a, n, k)


FORMULAS = {
    "wedge": Formula(
        refract_wedge, "000, boxed", "b = k n(n∧a) + s n √(a² + k²(n∧a)²)", budget=cancelling(1)
    ),
    "wedge_contrast": Formula(
        refract_wedge_contrast,
        "000, last form",
        "b = k n(n∧a) + s n √((n·a)² + (n∧a)²(k² − 1))",
        budget=cancelling(1),
    ),
    "cross": Formula(
        refract_cross, "001, eq. 6", "t = n×c + s √(1 − ‖c‖²) n, c = k (i×n)", budget=cancelling(1)
    ),
    "decomposed": Formula(
        refract_decomposed, "002, eq. 1", "b = k a − n (k c − s √(1 − k²(1 − c²))), c = n·a", budget=cancelling(2)
    ),
    "rotated": Formula(
        refract_rotated, "004", "b = B (s √(1 − X²), X), X = k R/√(1 + R²)", budget=cancelling(1)
    ),
    "compensated": Formula(
        refract_compensated,
        "this project",
        "b = (k w×n + s n √((n·a)² − κ w²))/n², w = n×a, κ = k² − 1; error-free transforms",
        budget=_rounding,
        exact_decision=True,
        takes_contrast=True,
    ),
    "promoted": Formula(
        refract_promoted,
        "this project",
        "the form of `compensated`, one precision up, rounded once",
        budget=_rounding,
        exact_decision=True,
        takes_contrast=True,
    ),
}


def automatic(backend: dr.JitBackend) -> str:
    """The key of the cheapest formula at the rounding limit in a local frame, where the normal is a literal axis.

    Compiled, `compensated` folds to less than the conversions of `promoted` cost, and needs no float64 on a GPU.
    On scalar arrays every operation is a call, and `promoted` has fewer.
    """
    return "promoted" if backend == dr.JitBackend.Invalid else "compensated"


def resolve(name: str, backend: dr.JitBackend) -> tuple[str, Formula]:
    """The key and entry behind `name`, a key of FORMULAS or "auto". ValueError otherwise."""
    key = automatic(backend) if name == "auto" else name
    if key not in FORMULAS:
        raise ValueError(f"formula = {name!r}: unknown; accepted: auto, {', '.join(FORMULAS)}")
    return key, FORMULAS[key]

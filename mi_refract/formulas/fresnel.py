"""Fresnel's equations for a boundary of two dielectrics; R and 1 − R are both accurate to a few roundings.

With the absolute cosines cᵢ, cₜ, the ratio k = n_from / n_to and the contrast κ = k² − 1, Snell's law turns every
difference in the amplitudes into a product, and both powers into sums of positive terms:

    d_s = k cᵢ + cₜ,   r_s = (k cᵢ − cₜ)/d_s = κ/d_s²
    d_p = cᵢ + k cₜ,   r_p = (cᵢ − k cₜ)/d_p = κ (k² sin²θᵢ − cᵢ²)/d_p²
    R : T = κ² (P² + Q²) : 2 k P (d_s² + d_p²),   R + T ∝ (d_s d_p)²,   P = cᵢ cₜ,  Q = sin θᵢ sin θₜ = k sin²θᵢ

So R keeps its relative accuracy as k → 1, and T keeps it at grazing incidence and near the critical angle. The length
of the incident vector cancels. Signs follow Verdet's convention, as in Mitsuba. Sources: Born and Wolf, Principles of
Optics, 1.5; R : T, from cos(θᵢ ± θₜ) = P ∓ Q and r_p/r_s = −(P − Q)/(P + Q): this project.

float32 is computed in float64 and rounded once; float64 is computed in double words. Arguments are Dr.Jit numbers of
one precision and any backend, or Python numbers, which are float64. NaN gives NaN. Precondition: k from 2⁻²⁰ to 2²⁰; in
float64 cosines above 1e-150, or 0.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from mi_refract.numerics import (
    DoubleWord,
    Mask,
    Number,
    Vector3,
    as_component,
    computed_in_float64,
    differentiated,
    ieee_divide,
    replace_grad,
    two_prod,
    two_sum,
)

from .well_conditioned import LocalCosines, local_cosines


def _is_single(x: Number) -> bool:
    return dr.type_v(x) == dr.VarType.Float32


def _wide(x: Number) -> Any:
    """`x` in float64."""
    wide: Any = dr.float64_array_t(type(x))
    return wide(x)


def _fma(x: Number, y: Number, z: Number) -> Any:
    return x * y + z if isinstance(x, DoubleWord) else dr.fma(x, y, z)


def _divide(x: Number, y: Number) -> Any:
    """x / y; a quotient of double words is rounded once to a plain number."""
    if not isinstance(x, DoubleWord):
        return ieee_divide(x, y)
    q = ieee_divide(x.hi, y.hi)
    return q + ieee_divide(dr.fma(-q, y.hi, x.hi) + dr.fma(-q, y.lo, x.lo), y.hi)


# Powers --------------------------------------------------------------------------------------------------------


@computed_in_float64
def powers(cos_i: Number, cos_t: Number, transmitted: Mask, k: Number, contrast: Number = None) -> tuple[Any, Any]:
    """(R, T) for unpolarised light, both between 0 and 1; (1, 0) where the ray is not transmitted.

    `cos_i`, `cos_t`: absolute cosines, and `transmitted`: a mask, as returned by a formula of refraction or
    `refracted_cosine`; numbers of one type, which is also that of R and T. `contrast`: κ, if it is known more
    accurately than from k. Relative error: 3.12u of R, 2u of T.
    """
    # The errors come from the rounding of cₜ and of the result: |∂ log R/∂ log cₜ| ≤ 2.12 and |∂ log T/∂ log cₜ| ≤ 1.
    # Therefore the denominator of R is the sum r + t (with the equal square, the 2.12 would be 4), and that of T is the
    # square (with the sum, the 1 would be 3, and T would depend on sin²θᵢ, which is inaccurate for a cosine near 1).
    lift = _wide if _is_single(cos_i) else DoubleWord
    number, c, ratio = type(cos_i), lift(cos_i), lift(k)
    kappa = ratio * ratio - 1 if contrast is None else lift(contrast)
    y = lift(dr.select(transmitted, cos_t, 0 * cos_t))  # NaN stays NaN
    wide: Any = dr.float64_array_t(number)
    # 1 where nothing is transmitted and y is 0: so R is 1 and T is 0 also for k = 1 and c = 0. The 1e-300 avoids 0/0 if
    # cos_t underflowed to 0. In float32 it vanishes: R ≤ 1e-300/16c⁴ at k = 1.
    mirror = dr.select(transmitted, wide(1e-300), wide(1))
    sin2 = _fma(-c, c, 1)
    if isinstance(c, DoubleWord):
        # The fourth powers of cosines below 1e-75 underflow in float64. For κ = 0 the cosines do not matter.
        c, y = (DoubleWord(dr.select((kappa.hi == 0) & (x.hi > 0), 1, x.hi), x.lo) for x in (c, y))
    p, q = c * y, ratio * sin2
    d_s, d_p = _fma(ratio, c, y), _fma(ratio, y, c)
    r = _fma(kappa * kappa, _fma(q, q, p * p), mirror)
    kp = ratio * p
    t = (kp + kp) * _fma(d_s, d_s, d_p * d_p)
    root = _fma(d_s, d_p, mirror)
    whole, square = r + t, root * root
    if isinstance(r, DoubleWord):
        powers = _with_slope(_divide(r, whole), _divide(t, square), r.hi, t.hi, whole.hi)
    else:
        # One division for both, as it takes as long as eight other operations. For cosines of 1e-38 the product is
        # 1e-302.
        inverse = ieee_divide(1, whole * square)
        powers = _with_slope((r * square) * inverse, (t * whole) * inverse, r, t, whole)
    return number(powers[0]), number(powers[1])


@computed_in_float64
def local_powers(a: Vector3, transmitted: Mask, k: Number, contrast: Number) -> tuple[Any, Any]:
    """(R, T) as in `powers`, of a float32 ray `a` (3,) that meets a boundary whose normal is the z axis.

    `transmitted`: a mask; `k`, `contrast`: numbers, which may be float64.
    """
    r, t = local_odds(local_cosines(a.x, a.y, a.z, _wide(contrast)), transmitted, k, contrast)
    return as_component(a, ieee_divide(r, r + t)), as_component(a, ieee_divide(t, r + t))


def local_odds(ray: LocalCosines, transmitted: Mask, k: Number, contrast: Number) -> tuple[Number, Number]:
    """R : T of a float32 ray that meets a boundary whose normal is an axis, in float64: R = r/(r + t).

    The length of the ray, from 1e-30 to 1e30, cancels. t = 0 where the ray is not `transmitted`, a mask as returned by
    a formula of refraction. The cosine of the refracted ray is not rounded to float32, so the relative error of R and T
    is 1.01u, plus ε/2ρ for an error ε of the radicand (see `well_conditioned`).
    """
    ratio, kappa = _wide(k), _wide(contrast)
    d_s, d_p = dr.fma(ratio, ray.cos_i, ray.cos_t), dr.fma(ratio, ray.cos_t, ray.cos_i)
    p, q = ray.cos_i * ray.cos_t, ratio * ray.sin2
    # For κ = 0 the ray is transmitted or tangential; without the 1, R : T of a tangential ray would be 0 : 0.
    mirror, power = (dr.select(transmitted, *x) for x in ((0 * p, 1), (2 * ratio * p, 0)))
    return dr.fma(kappa * kappa, dr.fma(q, q, p * p), mirror), power * dr.fma(d_s, d_s, d_p * d_p)


def _with_slope(reflected: Number, through: Number, r: Number, t: Number, whole: Number) -> tuple[Any, Any]:
    """R and T with the derivative dR = −dT = (T dr − R dt)/(r + t), which stays accurate as R → 1 and as T → 1.

    The derivative of the quotient, dr/w − R dw/w, cancels to dr/w · T near the critical angle.
    """
    if not differentiated(reflected):
        return reflected, through
    slope = (dr.detach(through) * r - dr.detach(reflected) * t) / dr.detach(whole)
    return replace_grad(reflected, slope), replace_grad(through, -slope)


# Cosines and amplitudes ----------------------------------------------------------------------------------------


@computed_in_float64
def refracted_cosine(cos_i: Number, k: Number, contrast: Number = None) -> tuple[Any, Any]:
    """(|cos θ_t|, transmitted): √|cos²θ_t|, cos²θ_t = k² cos²θ_i − κ, which is positive where the ray is transmitted.

    Under total internal reflection the cosine is imaginary; its modulus is returned. 0 ≤ cos_i ≤ 1. Both results are
    accurate to the last bit for the given cos_i and k (or κ), however near the critical angle.
    """
    radicand, _ = _differences(cos_i, k, contrast)
    return type(cos_i)(_root(radicand)), (radicand.hi >= 0) & (cos_i > 0)


@computed_in_float64
def amplitudes(cos_i: Number, k: Number, contrast: Number = None) -> tuple[Any, Any]:
    """Complex amplitudes (r_s, r_p) of the reflected wave, with the phase under total internal reflection.

    There cos_t = −i γ, γ = √(κ − k² cos²θ_i), and both have modulus 1:
    r_s = (k cos_i + i γ)² / κ,   r_p = (cos_i + i k γ)² / (cos_i² + k² γ²). A tangential ray has r_s = r_p = −1.
    0 ≤ cos_i ≤ 1; shapes: complex numbers of the type of `cos_i`.
    """
    radicand, brewster = _differences(cos_i, k, contrast)
    transmitted = (radicand.hi >= 0) & (cos_i > 0)
    c, y, k = _wide(cos_i), _root(radicand), _wide(k)
    kappa = dr.fma(k, k, -1) if contrast is None else _wide(contrast)
    # 1 where no wave is transmitted and the quotients below are not used: for a tangential ray they would divide by 0.
    d_s, d_p = (dr.select(transmitted, d, 1) for d in (dr.fma(k, c, y), dr.fma(k, y, c)))
    # Errors in float64: u of κ and of `brewster`, 4u of each d², 3u of the products and the quotient.
    r_s, r_p = kappa / (d_s * d_s), kappa * brewster / (d_p * d_p)
    is_float = isinstance(cos_i, float)
    number: Any = dr.scalar.Complex2f64 if is_float else dr.replace_shape_t(type(cos_i), (2, -1), "complex")
    (s_re, s_im), (p_re, p_im) = _phase(k * c, y), _phase(c, k * y)
    return (
        number(dr.select(transmitted, r_s, s_re), dr.select(transmitted, 0, s_im)),
        number(dr.select(transmitted, r_p, p_re), dr.select(transmitted, 0, p_im)),
    )


def mueller_reflection(cos_i: Number, k: Number, contrast: Number = None) -> list[list[Any]]:
    """Mueller matrix of the reflection in the plane of incidence (4 × 4 numbers), phase included.

    From |r_s|², |r_p|² and r_p r_s*, see `_mueller`. Arguments as for `amplitudes`.
    """
    r_s, r_p = amplitudes(cos_i, k, contrast)
    s2, p2 = dr.squared_norm(r_s), dr.squared_norm(r_p)
    return _mueller(s2, p2, r_p * dr.conj(r_s))


def mueller_transmission(cos_i: Number, cos_t: Number, transmitted: Mask, k: Number) -> list[list[Any]]:
    """Mueller matrix of the transmission in the plane of incidence (4 × 4 numbers); 0 where not transmitted.

    From the transmitted powers of both waves and their interference. Arguments as for `powers`.
    """
    t_s, t_p, interference = transmitted_powers(cos_i, cos_t, transmitted, k)
    return _mueller(t_s, t_p, (interference, 0))


@computed_in_float64
def transmitted_powers(cos_i: Number, cos_t: Number, transmitted: Mask, k: Number) -> tuple[Any, Any, Any]:
    """(T_s, T_p, √(T_s T_p)) of the transmitted waves; 0 where not transmitted. Arguments as for `powers`."""
    c, y, ratio, number = _wide(cos_i), _wide(cos_t), _wide(k), type(cos_i)
    d_s, d_p = (dr.select(transmitted, d, 1) for d in (dr.fma(ratio, c, y), dr.fma(ratio, y, c)))
    power = 4 * ratio * (c * y)
    pairs = (d_s, d_s), (d_p, d_p), (d_s, d_p)
    t_s, t_p, interference = (number(dr.select(transmitted, power / (x * y), 0 * power)) for x, y in pairs)
    return t_s, t_p, interference


def _differences(cos_i: Number, k: Number, contrast: Number) -> tuple[DoubleWord, Any]:
    """cos²θ_t = k² cos²θ_i − κ and k² sin²θ_i − cos²θ_i of exact arguments, each accurate to the last bit of float64.

    They cancel near the critical and Brewster's angle; the relative error of double words there is 5u²/|difference|.
    """
    if _is_single(cos_i):
        # Squares of float32 numbers are exact in float64, and an fma rounds once. Where the second difference cancels,
        # 1 − cos² (for k > 1: cos² > 1/2) or k² − cos² (for k < 1: within a factor of 2) is exact; where the first
        # difference cancels, κ is exact (k > 1).
        c2 = _wide(cos_i) * _wide(cos_i)
        k2 = _wide(k) * _wide(k) if contrast is None else _wide(contrast) + 1
        kappa = k2 - 1 if contrast is None else _wide(contrast)
        brewster = dr.select(k2 > 1, dr.fma(k2, 1 - c2, -c2), dr.fma(-k2, c2, k2 - c2))
        return DoubleWord(dr.fma(k2, c2, -kappa)), brewster
    c2 = two_prod(cos_i, cos_i)
    k2 = two_prod(k, k) if contrast is None else (contrast, 1)
    products = [part for x in c2 for y in k2 for part in two_prod(x, y)]
    radicand = _sum([1, -k2[0], -k2[1], *products] if contrast is None else [-contrast, *products])
    if differentiated(radicand.hi):
        # The derivative of 1 − k² sin²θ. That of the sum above, 2 k cos²θ − 2 k, has a relative error of u/sin²θ.
        slope = -(k * k if contrast is None else contrast + 1) * ((1 - cos_i) * (1 + cos_i))
        radicand = DoubleWord(replace_grad(radicand.hi, slope), dr.detach(radicand.lo))
    return radicand, _sum([*k2, -c2[0], -c2[1], *(-x for x in products)]).rounded()


def _sum(terms: list[Any]) -> DoubleWord:
    """Σ terms, with an error ≤ u² |sum| + O(u³) Σ|terms|. Source: Ogita, Rump, Oishi 2005, SumK with K = 3."""
    for _ in range(2):
        for i in range(1, len(terms)):
            terms[i], terms[i - 1] = two_sum(terms[i], terms[i - 1])
    return DoubleWord(terms[-1], sum(terms[:-1]))


def _root(radicand: DoubleWord) -> Any:
    """√|radicand|, rounded once, with a finite derivative at 0."""
    size = DoubleWord(dr.abs(radicand.hi), dr.mulsign(radicand.lo, radicand.hi))
    return dr.safe_sqrt(size.hi) if radicand.is_plain else size.sqrt().rounded()


def _mueller(s2: Number, p2: Number, interference: tuple[Number, Number]) -> list[list[Number]]:
    """The Mueller matrix from the powers of both waves and their interference a_p a_s*."""
    mean, half, re, im = 0.5 * (s2 + p2), 0.5 * (s2 - p2), interference[0], interference[1]
    return [[mean, half, 0, 0], [half, mean, 0, 0], [0, 0, re, -im], [0, 0, im, re]]


def _phase(x: Number, y: Number) -> tuple[Any, Any]:
    """Real and imaginary part of (x + i y)² / |x + i y|²; −1 for x = 0, also if y = 0."""
    length = dr.sqrt(dr.fma(x, x, y * y))
    x, y = dr.select(length > 0, ieee_divide(x, length), 0 * length), dr.select(length > 0, ieee_divide(y, length), 1)
    return (x - y) * (x + y), 2 * x * y

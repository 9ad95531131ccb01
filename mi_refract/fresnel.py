"""Fresnel's equations for a boundary of two dielectrics, without cancellation.

With the absolute cosines cos_i, cos_t, the ratio k = n_from / n_to and the contrast κ = k² − 1, Snell's law turns
the differences in the amplitudes into products:

    r_s = (k cos_i − cos_t) / (k cos_i + cos_t) = κ / (k cos_i + cos_t)²
    r_p = (cos_i − k cos_t) / (cos_i + k cos_t) = κ (k² sin²θ_i − cos²θ_i) / (cos_i + k cos_t)²
    T_s = 4 k cos_i cos_t / (k cos_i + cos_t)²,   T_p = 4 k cos_i cos_t / (cos_i + k cos_t)²

so R keeps its relative accuracy as k → 1 and 1 − R keeps it at grazing incidence and near the critical angle.
Signs follow Verdet's convention, as in Mitsuba. Sources: Born and Wolf, Principles of Optics, 1.5; the products:
this project. All arguments are Dr.Jit numbers of one precision and any backend; NaN in gives NaN out.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from .numerics import Double, quotient


def refracted_cosine(cos_i: Any, k: Any, contrast: Any = None) -> tuple[Any, Any]:
    """(|cos θ_t|, transmitted): √|cos²θ_i − κ sin²θ_i|, which is real where the ray is transmitted.

    Under total internal reflection the cosine is imaginary; its modulus is returned. The radicand is formed in
    double-word arithmetic, because √ magnifies what it has lost near the critical angle. 0 ≤ cos_i ≤ 1.
    """
    kappa = Double.product(k, k) - 1 if contrast is None else Double(contrast)
    cos2 = Double.product(cos_i, cos_i)
    radicand = cos2 - kappa * (-cos2 + 1)
    transmitted = (radicand.hi >= 0) & (cos_i > 0)
    return dr.safe_sqrt(dr.abs(radicand.hi)), transmitted


def contrast_of(k: Any) -> Any:
    """k² − 1 of an exact k: relative error ≤ 3u."""
    return (k - 1) * (k + 1)


def _parts(cos_i: Any, cos_t: Any, k: Any, contrast: Any) -> tuple[Any, Any, Any, Any]:
    """(r_s, r_p, 1/(k cos_i + cos_t), 1/(cos_i + k cos_t)) of a transmitted ray; `contrast` is κ.

    k² sin²θ_i − cos²θ_i is formed from the smaller pair of terms: for k > 1 it equals sin²θ_i − cos²θ_t, whose terms
    are at most 1/k². Factors are applied one by one: their squares would underflow for cosines below 1e-19.
    """
    inverse_s, inverse_p = quotient(1, dr.fma(k, cos_i, cos_t)), quotient(1, dr.fma(k, cos_t, cos_i))
    sin2 = (1 - cos_i) * (1 + cos_i)
    brewster = dr.select(k > 1, dr.fma(-cos_t, cos_t, sin2), dr.fma(k * k, sin2, -cos_i * cos_i))
    return contrast * inverse_s * inverse_s, (contrast * inverse_p) * (brewster * inverse_p), inverse_s, inverse_p


def reflectance(cos_i: Any, cos_t: Any, transmitted: Any, k: Any, contrast: Any = None) -> Any:
    """Unpolarised reflectance R = (r_s² + r_p²)/2; 1 where the ray is not transmitted. See `powers`."""
    return powers(cos_i, cos_t, transmitted, k, contrast)[0]


def transmittance(cos_i: Any, cos_t: Any, transmitted: Any, k: Any, contrast: Any = None) -> Any:
    """Unpolarised transmittance T = 1 − R, formed without that subtraction; 0 where not transmitted. See `powers`."""
    return powers(cos_i, cos_t, transmitted, k, contrast)[1]


def powers(cos_i: Any, cos_t: Any, transmitted: Any, k: Any, contrast: Any = None) -> tuple[Any, Any]:
    """(R, T) for unpolarised light, both between 0 and 1.

    `cos_i`, `cos_t` absolute cosines, `transmitted` a mask, as a formula of refraction or `refracted_cosine`
    gives them. `contrast`: κ where it is known better than k. Precondition: k from 1e-9 to 1e9.
    """
    kappa = contrast_of(k) if contrast is None else contrast
    r_s, r_p, inverse_s, inverse_p = _parts(cos_i, cos_t, k, kappa)
    r = 0.5 * dr.fma(r_s, r_s, r_p * r_p)
    t = 2 * k * ((cos_i * inverse_s) * (cos_t * inverse_s) + (cos_i * inverse_p) * (cos_t * inverse_p))
    valid = cos_i + cos_t >= 0  # NaN must not come out as a mirror
    # Near 1 rounding may exceed it by an ulp or two, and a probability must not.
    return (
        dr.select(transmitted, dr.select(r > 1, 1, r), dr.select(valid, 1, dr.nan)),
        dr.select(transmitted, dr.select(t > 1, 1, t), dr.select(valid, 0, dr.nan)),
    )


def amplitudes(cos_i: Any, k: Any, contrast: Any = None) -> tuple[Any, Any]:
    """Complex amplitudes (r_s, r_p) of the reflected wave, with the phase under total internal reflection.

    There cos_t = −i γ, γ = √(κ sin²θ_i − cos²θ_i), and both have modulus 1:
    r_s = (k cos_i + i γ)² / κ,   r_p = (cos_i + i k γ)² / (cos_i² + k² γ²). A tangential ray has r_s = r_p = −1.
    0 ≤ cos_i ≤ 1; shapes: complex numbers of the type of `cos_i`.
    """
    cos_t, transmitted = refracted_cosine(cos_i, k, contrast)
    kappa = contrast_of(k) if contrast is None else contrast
    r_s, _, _, inverse_p = _parts(cos_i, cos_t, k, kappa)
    # Near Brewster's angle k² sin² − cos² cancels: formed as 1·k² − (1 + k²) cos² in double-word arithmetic.
    k2 = Double.product(k, k)
    brewster = (k2 - (k2 + 1) * Double.product(cos_i, cos_i)).hi
    r_p = (kappa * inverse_p) * (brewster * inverse_p)
    phase_s, phase_p = _phase(k * cos_i, cos_t), _phase(cos_i, k * cos_t)
    return _complex(transmitted, r_s, phase_s), _complex(transmitted, r_p, phase_p)


def mueller_reflection(cos_i: Any, k: Any, contrast: Any = None) -> list[list[Any]]:
    """Mueller matrix of the reflection in the plane of incidence (4 × 4 numbers), phase included."""
    r_s, r_p = amplitudes(cos_i, k, contrast)
    s2, p2 = dr.squared_norm(r_s), dr.squared_norm(r_p)
    return _mueller(s2, p2, r_p * dr.conj(r_s))


def mueller_transmission(cos_i: Any, cos_t: Any, transmitted: Any, k: Any) -> list[list[Any]]:
    """Mueller matrix of the transmission in the plane of incidence (4 × 4 numbers); 0 where not transmitted."""
    s, p = quotient(1, dr.fma(k, cos_i, cos_t)), quotient(1, dr.fma(k, cos_t, cos_i))
    pairs = (s, s), (p, p), (s, p)
    t_s, t_p, cross = (dr.select(transmitted, 4 * k * ((cos_i * x) * (cos_t * y)), 0) for x, y in pairs)
    return _mueller(t_s, t_p, (cross, 0))


def _mueller(s2: Any, p2: Any, cross: Any) -> list[list[Any]]:
    """From the powers of both waves and their interference a_p a_s*."""
    mean, half, re, im = 0.5 * (s2 + p2), 0.5 * (s2 - p2), cross[0], cross[1]
    return [[mean, half, 0, 0], [half, mean, 0, 0], [0, 0, re, -im], [0, 0, im, re]]


def _phase(x: Any, y: Any) -> tuple[Any, Any]:
    """(x + i y)² / |x + i y|², real and imaginary part; −1 for x = 0, y = 0 included."""
    length = dr.sqrt(x * x + y * y)
    x, y = dr.select(length > 0, quotient(x, length), 0 * length), dr.select(length > 0, quotient(y, length), 1)
    return (x - y) * (x + y), 2 * x * y


def _complex(transmitted: Any, real: Any, phase: tuple[Any, Any]) -> Any:
    re, im = dr.select(transmitted, real, phase[0]), dr.select(transmitted, 0, phase[1])
    if isinstance(re, float):
        return dr.scalar.Complex2f64(re, im)
    complex_type: Any = dr.replace_shape_t(type(re), (2, -1), "complex")
    return complex_type(re, im)

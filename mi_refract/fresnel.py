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


def powers(cos_i: Any, cos_t: Any, k: Any, contrast: Any) -> tuple[Any, Any]:
    """Reflected powers (r_s², r_p²) of a transmitted ray; `contrast` is κ."""
    r_s = contrast / dr.square(dr.fma(k, cos_i, cos_t))
    sin2 = (1 - cos_i) * (1 + cos_i)
    r_p = contrast * dr.fma(k * k, sin2, -cos_i * cos_i) / dr.square(dr.fma(k, cos_t, cos_i))
    return dr.square(r_s), dr.square(r_p)


def reflectance(cos_i: Any, cos_t: Any, transmitted: Any, k: Any, contrast: Any = None) -> Any:
    """Unpolarised reflectance R = (r_s² + r_p²)/2; 1 where the ray is not transmitted.

    `cos_i`, `cos_t` absolute cosines, `transmitted` a mask, as a formula of refraction or `refracted_cosine`
    gives them. `contrast`: κ where it is known better than k.
    """
    kappa = contrast_of(k) if contrast is None else contrast
    r_s2, r_p2 = powers(cos_i, cos_t, k, kappa)
    certain = dr.select(cos_i + cos_t >= 0, 1, dr.nan)  # NaN must not come out as a mirror
    return dr.select(transmitted, 0.5 * (r_s2 + r_p2), certain)


def transmittances(cos_i: Any, cos_t: Any, k: Any) -> tuple[Any, Any, Any]:
    """Transmitted powers (T_s, T_p) and √(T_s T_p) of a transmitted ray, each without a subtraction."""
    s, p = dr.fma(k, cos_i, cos_t), dr.fma(k, cos_t, cos_i)
    product = 4 * k * cos_i * cos_t
    return product / dr.square(s), product / dr.square(p), product / (s * p)


def transmittance(cos_i: Any, cos_t: Any, transmitted: Any, k: Any) -> Any:
    """Unpolarised transmittance T = 1 − R, formed without that subtraction; 0 where the ray is not transmitted."""
    t_s, t_p, _ = transmittances(cos_i, cos_t, k)
    certain = dr.select(cos_i + cos_t >= 0, 0, dr.nan)
    return dr.select(transmitted, 0.5 * (t_s + t_p), certain)


def amplitudes(cos_i: Any, k: Any, contrast: Any = None) -> tuple[Any, Any]:
    """Complex amplitudes (r_s, r_p) of the reflected wave, with the phase under total internal reflection.

    There cos_t = −i γ, γ = √(κ sin²θ_i − cos²θ_i), and both have modulus 1:
    r_s = (k cos_i + i γ)² / κ,   r_p = (cos_i + i k γ)² / (cos_i² + k² γ²).
    0 ≤ cos_i ≤ 1; shapes: complex numbers of the type of `cos_i`.
    """
    cos_t, transmitted = refracted_cosine(cos_i, k, contrast)
    kappa = contrast_of(k) if contrast is None else contrast
    s, p = dr.fma(k, cos_i, cos_t), dr.fma(k, cos_t, cos_i)
    # Near Brewster's angle k² sin² − cos² cancels: formed as 1·k² − (1 + k²) cos² in double-word arithmetic.
    k2 = Double.product(k, k)
    brewster = (k2 - (k2 + 1) * Double.product(cos_i, cos_i)).hi
    r_s, r_p = quotient(kappa, s * s), quotient(kappa * brewster, p * p)
    phase_s, phase_p = _phase(k * cos_i, cos_t), _phase(cos_i, k * cos_t)
    return _complex(transmitted, r_s, phase_s), _complex(transmitted, r_p, phase_p)


def mueller_reflection(cos_i: Any, k: Any, contrast: Any = None) -> list[list[Any]]:
    """Mueller matrix of the reflection in the plane of incidence (4 × 4 numbers), phase included."""
    r_s, r_p = amplitudes(cos_i, k, contrast)
    s2, p2 = dr.squared_norm(r_s), dr.squared_norm(r_p)
    return _mueller(s2, p2, r_p * dr.conj(r_s))


def mueller_transmission(cos_i: Any, cos_t: Any, transmitted: Any, k: Any) -> list[list[Any]]:
    """Mueller matrix of the transmission in the plane of incidence (4 × 4 numbers); 0 where not transmitted."""
    t_s, t_p, cross = (dr.select(transmitted, t, 0) for t in transmittances(cos_i, cos_t, k))
    return _mueller(t_s, t_p, (cross, 0))


def _mueller(s2: Any, p2: Any, cross: Any) -> list[list[Any]]:
    """From the powers of both waves and their interference a_p a_s*."""
    mean, half, re, im = 0.5 * (s2 + p2), 0.5 * (s2 - p2), cross[0], cross[1]
    return [[mean, half, 0, 0], [half, mean, 0, 0], [0, 0, re, -im], [0, 0, im, re]]


def _phase(x: Any, y: Any) -> tuple[Any, Any]:
    """(x + i y)² / |x + i y|², real and imaginary part."""
    norm = x * x + y * y
    return quotient((x - y) * (x + y), norm), quotient(2 * x * y, norm)


def _complex(transmitted: Any, real: Any, phase: tuple[Any, Any]) -> Any:
    re, im = dr.select(transmitted, real, phase[0]), dr.select(transmitted, 0, phase[1])
    if isinstance(re, float):
        return dr.scalar.Complex2f64(re, im)
    complex_type: Any = dr.replace_shape_t(type(re), (2, -1), "complex")
    return complex_type(re, im)

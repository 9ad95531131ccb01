"""Closed forms of refraction by simple bodies, and of diffuse light on a plane boundary.

Angles are in radians; `index` is the index of the body divided by that outside. Sources: Born and Wolf, Principles of
Optics, 4.7.2 (prism); Descartes, Les Météores, 1637 (rainbow). The slab follows from plane trigonometry.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from flint import arb, ctx

HALF_TURN = np.arccos(np.longdouble(-1))
# Number of nodes for diffuse light. The integrand's branch point, at μ = √(1 − n²), is 0.02 from the interval for
# n = 1.0003: the relative error of Gauss's quadrature is then 1.248^−2m < 10⁻²¹.
GRADE = 112
BITS = 240


def refracted(incidence: Any, index: Any) -> Any:
    """Return r = asin(sin i / n)."""
    return np.arcsin(np.sin(incidence) / index)


def lateral_shift(incidence: Any, index: Any) -> Any:
    """Return the lateral shift of a ray by a plane-parallel slab, over its thickness: sin(i − r)/cos r."""
    within = refracted(incidence, index)
    return np.sin(incidence - within) / np.cos(within)


def deviation(incidence: Any, apex: Any, index: Any) -> Any:
    """Return the deviation of a ray in the principal section of a prism: i + asin(n sin(A − r)) − A."""
    return incidence + np.arcsin(index * np.sin(apex - refracted(incidence, index))) - apex


def least_deviated(apex: Any, index: Any) -> Any:
    """Return the incidence of minimum deviation, asin(n sin(A/2)); the deviation there is 2i − A."""
    return np.arcsin(index * np.sin(apex / 2))


def deflection(incidence: Any, index: Any, order: Any) -> Any:
    """Return the deflection of a ray through a ball with m inner reflections: mπ + 2i − 2(m + 1) r."""
    return order * HALF_TURN + 2 * incidence - 2 * (order + 1) * refracted(incidence, index)


def rainbow_incidence(index: Any, order: Any) -> Any:
    """Return the incidence at which the deflection is stationary: cos i = √((n² − 1)/((m + 1)² − 1))."""
    return np.arccos(np.sqrt((index - 1) * (index + 1) / (order * (order + 2))))


# Diffuse light ----------------------------------------------------------------------------------------------------


def hemispherical(index: float) -> dict[str, np.longdouble]:
    """Return R_e and R_i, the reflected shares of diffuse light from outside and from inside, for an index n > 1.

    Outside, R_e = ∫₀¹ R(x) 2x dx over the cosine x. With y = n cosθ_t = √(x² + κ), κ = n² − 1 and v = x + y, Snell's
    law reads y − x = κ/v. So x = (v² − κ)/2v, y = (v² + κ)/2v, 2x dx = (v − κ²/v³)/2 dv, and both amplitudes,

        r_s = (x − y)/(x + y) = −κ/v²,   r_p = (y − n² x)/(y + n² x) = −κ (v² − n² − 1)/((n² + 1) v² − κ²),

    are rational in v, from √κ (grazing) to n + 1 (normal). For s,

        ∫ r_s² 2x dx = κ/6 − κ²/4(n+1)² + κ⁴/12(n+1)⁶ = (n − 1)(3n + 1)/(3(n + 1)²) ,

    and for p partial fractions give logarithms. The mean of both: Walsh 1926 (Dept. Sci. Ind. Res., Illum. Res. Tech.
    Paper 2), Duntley 1942 (J. Opt. Soc. Am. 32, 61), Judd 1942 (J. Res. NBS 29, 329):

        R_e = 1/2 + (n−1)(3n+1)/(6(n+1)²) + n²(n²−1)²/(n²+1)³ ln((n−1)/(n+1))
              − 2n³(n²+2n−1)/((n²+1)(n⁴−1)) + 8n⁴(n⁴+1)/((n²+1)(n⁴−1)²) ln n

    T is the same in both directions and the étendue n² cosθ dΩ is conserved, so inside 1 − R_i = (1 − R_e)/n².
    """
    with ctx.workprec(BITS):
        n = arb(index)
        n2, n4 = n**2, n**4
        outside = (
            arb(1) / 2
            + (n - 1) * (3 * n + 1) / (6 * (n + 1) ** 2)
            + n2 * (n2 - 1) ** 2 / (n2 + 1) ** 3 * ((n - 1) / (n + 1)).log()
            - 2 * n**3 * (n2 + 2 * n - 1) / ((n2 + 1) * (n4 - 1))
            + 8 * n4 * (n4 + 1) / ((n2 + 1) * (n4 - 1) ** 2) * n.log()
        )
        inside = 1 - (1 - outside) / n2
        return {"outside": extended(outside), "inside": extended(inside)}


@functools.cache
def nodes(index: float, precision: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (cosθ outside, cosθ inside, weight) of Gauss–Legendre quadrature in μ with weights 2μ dμ.

    The cosines are rounded to `precision`; the weights, in extended precision, are those of the exact cosines.
    """
    rows = []
    with ctx.workprec(BITS):
        for i in range(GRADE):
            root, weight = arb.legendre_p_root(GRADE, i, weight=True)
            mu = (1 + root) / 2
            inside = (1 - (1 - mu * mu) / arb(index) ** 2).sqrt()
            rows.append((float(mu), float(inside), extended(weight * mu)))
    outside, inside, weight = zip(*rows, strict=True)
    return np.array(outside).astype(precision), np.array(inside).astype(precision), np.array(weight)


def extended(x: Any) -> np.longdouble:
    """Convert a number with more digits than a double to extended precision."""
    high = float(x)
    return np.longdouble(high) + np.longdouble(float(x - high))

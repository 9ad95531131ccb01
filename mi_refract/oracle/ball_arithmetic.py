"""Certified answers: Snell's law solved by ball arithmetic for the exact values of the inputs.

A float is a dyadic rational, so everything in the law except its square roots and a division is a polynomial that is
computed exactly; the signs of n·a and of the radicand are then certain, at the critical angle too. The roots and the
division follow in balls, whose radius is the certificate. No formula of this package is imported.

Writing A = |a|², N = |n|², c = n·a, s = sign(c), for a and n of any length:

    sin²θi = |n×a|² / AN                                    AN − c² = |n×a|²
    radicand D = c² − (k²−1)|n×a|²                          cos²θt = D / AN
    b/|a| = (k t + s√D n) / (N√A),   t = N a − c n          Snell: the tangent scales by k
    b/|a| = (t − c n) / (N√A)                               total internal reflection, D < 0

Arithmetic: F. Johansson, "Arb: efficient arbitrary-precision midpoint-radius interval arithmetic", 2017.
"""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from flint import arb, ctx
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Table = NDArray[np.void]  # with rows of type _ROW
Ball: TypeAlias = Any  # a `flint.arb`
Ray = tuple[float, float, float, float, float, float, float, float | None]  # a, n, k, contrast
Polynomials = tuple[Ball, ...]  # the polynomials of the law, see `_exact`

# The bits of the radicand of float64 inputs are between 2^±12600: twice n·a (2 × 4200) and k² (4200).
EXACT_BITS = 16384
# With 160 bits the radius of the direction is 1e-47; higher precisions are used only if a ball stays too wide.
PRECISIONS = (160, 320, 640)
MAX_RADIUS = 1e-30
# |x| ≤ 1 as a pair of doubles: |x − high| ≤ 2⁻⁵⁴, so |x − high − low| ≤ 2⁻¹⁰⁸. Two more bits for the radius.
PAIR_ERROR = 2.0**-106

CHUNK = 256  # rays between two steps of the progress bar
MANY = 100_000  # from this number of rays on a progress bar is shown: about two seconds

_UNKNOWN = complex(math.nan, math.nan)
_NO_FRESNEL = (math.nan,) * 4 + (_UNKNOWN,) * 2
_UNDECIDED = ((math.nan,) * 3,) * 2 + (math.nan,) * 4 + _NO_FRESNEL
# The columns of a table of answers: all fields of `Certified` except `undecided`.
_ROW = np.dtype(
    [(name, np.float64, 3) for name in ("direction", "direction_low")]
    + [(name, np.float64) for name in ("radius", "transmitted", "cos_i", "cos_t")]
    + [(f"{name}{part}", np.float64) for name in ("reflectance", "transmittance") for part in ("", "_low")]
    + [(f"amplitude_{wave}", np.complex128) for wave in "sp"]
)
_BLANK = np.array(_UNDECIDED, _ROW)


@dataclass(frozen=True)
class Certified:
    """The exact answer for each ray, as doubles, with a bound on their rounding error.

    Directions are unit, b/|a|. `x + x_low` is the value to about 106 bits, `x` alone the nearest double.
    `radius` bounds the error of every component of `direction + direction_low` and is at most 1e-30.
    `cos_i`, `cos_t` are |n·a|/|n||a| and |n·b|/|n||b|; `cos_t` is 0 where nothing is transmitted.
    Reflectance and transmittance are R and 1 − R of unpolarised light, each with a relative error of 2⁻¹⁰⁰ unless it
    underflows.
    Amplitudes follow Verdet, as in Mitsuba's `fresnel_polarized`: with η = 1/k,
        a_s = (cᵢ − ηcₜ)/(cᵢ + ηcₜ),  a_p = (ηcᵢ − cₜ)/(ηcᵢ + cₜ),
    and cₜ = −i√(k² sin²θi − 1) under total internal reflection. A tangential ray has R = 1, a_s = a_p = −1.

    For a ray with a or n zero or not finite, or k not finite and positive, all numbers are NaN and both masks False.
    """

    direction: np.ndarray  # (N, 3)
    direction_low: np.ndarray  # (N, 3)
    radius: np.ndarray  # (N,)
    transmitted: np.ndarray  # (N,) bool
    undecided: np.ndarray  # (N,) bool: no precision sufficed, all numbers are NaN; cannot occur for doubles
    cos_i: np.ndarray  # (N,)
    cos_t: np.ndarray  # (N,)
    reflectance: np.ndarray  # (N,); this and all below are NaN without `fresnel`
    reflectance_low: np.ndarray
    transmittance: np.ndarray
    transmittance_low: np.ndarray
    amplitude_s: np.ndarray  # (N,) complex, to 1e-16
    amplitude_p: np.ndarray

    def __len__(self) -> int:
        """The number of rays."""
        return len(self.radius)


def refract(
    a: ArrayLike,
    n: ArrayLike,
    k: ArrayLike,
    *,
    contrast: ArrayLike | None = None,
    fresnel: bool = True,
    progress: bool = True,
) -> Certified:
    """Solve Snell's law, sin θt = k sin θi in the plane of a and n, for exactly these numbers.

    a: (N, 3) float32 or float64, incident, toward the surface, any length. n: (N, 3), normal on either side,
    any length. k: number or (N,), n_from/n_to. contrast: number or (N,), k² − 1 if it is known more accurately than
    from k: then the problem is solved for k = √(1 + contrast). `fresnel=False` leaves the Fresnel terms NaN.
    `progress` shows a bar on a terminal's stderr for 100,000 rays or more.

    For D = 0 the ray is transmitted along the surface; for n·a = 0 it is tangential, not transmitted, and b = a.
    ValueError for a wrong shape or dtype, but not for any value.
    """
    a, n, k, contrast, valid = _checked(a, n, k, contrast)
    table = np.full(len(a), _BLANK)
    chunks: Iterable[int] = range(0, len(a), CHUNK)
    if progress and len(a) >= MANY and sys.stderr.isatty():
        with contextlib.suppress(ImportError):  # without rich there is no bar
            from rich.console import Console
            from rich.progress import track

            chunks = track(chunks, "oracle", console=Console(stderr=True), transient=True)
    for first in chunks:
        index = first + np.flatnonzero(valid[first : first + CHUNK])
        _fill(table, index, (_exact(*ray) for ray in _rays(a, n, k, contrast, index)), fresnel)
    return _certified(table, valid)


def _certified(table: Table, valid: NDArray[np.bool_]) -> Certified:
    columns = {name: table[name].copy() for name in _ROW.names or ()} | {"transmitted": table["transmitted"] == 1}
    return Certified(**columns, undecided=valid & np.isnan(table["radius"]))


def fresnel(cos_i: ArrayLike, k: ArrayLike, *, contrast: ArrayLike | None = None) -> Certified:
    """As `refract`, for rays given by their cosine alone, for exactly these numbers; directions are NaN.

    cos_i: (N,) float32 or float64. Rays whose cosine is outside 0 … 1 are invalid. Errors as for `refract`.
    """
    cos_i = _floats("cos_i", cos_i, ("N",))
    axis = np.tile([0.0, 0.0, 1.0], (len(cos_i), 1))
    _, _, k, contrast, valid = _checked(axis, axis, k, contrast)
    valid &= (cos_i >= 0) & (cos_i <= 1)
    table, index = np.full(len(cos_i), _BLANK), np.flatnonzero(valid)
    ratios = k[index].tolist(), [None] * len(index) if contrast is None else contrast[index].tolist()
    _fill(table, index, (_exact_of_cosine(*x) for x in zip(cos_i[index].tolist(), *ratios, strict=True)), True)
    table["direction"] = table["direction_low"] = math.nan
    return _certified(table, valid)


# Arguments ---------------------------------------------------------------------------------------------------------


def _checked(
    a: ArrayLike, n: ArrayLike, k: ArrayLike, contrast: ArrayLike | None
) -> tuple[Array, Array, Array, Array | None, NDArray[np.bool_]]:
    """The arguments as float64 arrays, which represent float32 exactly, and the mask of valid rays.

    ValueError for wrong shapes or dtypes.
    """
    a = _floats("a", a, ("N", 3))
    count = len(a)
    n, k = _floats("n", n, (count, 3)), np.broadcast_to(_floats("k", k, (), (count,)), (count,))
    valid = np.isfinite(a).all(axis=1) & np.isfinite(n).all(axis=1) & a.any(axis=1) & n.any(axis=1)
    valid &= np.isfinite(k) & (k > 0)
    if contrast is not None:
        contrast = np.broadcast_to(_floats("contrast", contrast, (), (count,)), (count,))
        valid &= np.isfinite(contrast) & (contrast > -1)
    return a, n, k, contrast, valid


def _floats(name: str, x: ArrayLike, *shapes: tuple[int | str, ...]) -> Array:
    """`x` as float64, exactly. ValueError unless it has one of `shapes`, where "N" is any length."""
    x = np.asarray(float(x) if isinstance(x, int) else x)

    def matches(shape: tuple[int | str, ...]) -> bool:
        return len(shape) == x.ndim and all(n in ("N", m) for n, m in zip(shape, x.shape, strict=True))

    if x.dtype not in (np.float32, np.float64) or not any(map(matches, shapes)):
        expected = " or ".join(f"({', '.join(map(str, s))})" if s else "a number" for s in shapes)
        raise ValueError(f"oracle: {name} is {x.dtype} {x.shape}; expected float32 or float64, {expected}")
    return x.astype(np.float64)


def _rays(a: Array, n: Array, k: Array, contrast: Array | None, index: NDArray[np.intp]) -> Iterator[Ray]:
    """The rays with these indices, as Python floats."""
    columns = [x.tolist() for x in (*a[index].T, *n[index].T, k[index])]
    return zip(*columns, [None] * len(index) if contrast is None else contrast[index].tolist(), strict=True)


# The law -----------------------------------------------------------------------------------------------------------


def _fill(table: Table, index: NDArray[np.intp], polynomials: Iterator[Polynomials], fresnel: bool) -> None:
    """Solve the rays of these polynomials, with increasing precision, and store them in their rows of the table."""
    with ctx.workprec(EXACT_BITS):
        pending = list(zip(index, polynomials, strict=True))
    for bits in PRECISIONS:
        if not pending:
            return
        with ctx.workprec(bits):
            solved = [_solve(exact, fresnel) for _, exact in pending]
        table[[i for i, _ in pending]] = np.array(solved, _ROW)
        pending = [p for p, row in zip(pending, solved, strict=True) if not row[2] <= MAX_RADIUS]
    table[[i for i, _ in pending]] = _BLANK


def _exact(ax: Ball, ay: Ball, az: Ball, nx: Ball, ny: Ball, nz: Ball, k: float, contrast: float | None) -> Polynomials:
    """The polynomials of the law, exact at EXACT_BITS: c, A, N, AN, c², |n×a|², k²−1, k², D, t, n."""
    ax, ay, az, nx, ny, nz = arb(ax), arb(ay), arb(az), arb(nx), arb(ny), arb(nz)
    if contrast is None:
        k2 = arb(k) * k
        e = k2 - 1
    else:
        e = arb(contrast)
        k2 = e + 1
    c = ax * nx + ay * ny + az * nz
    aa = ax * ax + ay * ay + az * az
    nn = nx * nx + ny * ny + nz * nz
    aann = aa * nn
    c2 = c * c
    s2 = aann - c2
    d = c2 - e * s2
    tx, ty, tz = nn * ax - c * nx, nn * ay - c * ny, nn * az - c * nz
    return c, aa, nn, aann, c2, s2, e, k2, d, tx, ty, tz, nx, ny, nz


def _exact_of_cosine(cos_i: float, k: float, contrast: float | None) -> Polynomials:
    """The polynomials for unit vectors with this cosine; those of the direction are 0."""
    c = arb(cos_i)
    e = arb(k) * k - 1 if contrast is None else arb(contrast)
    c2 = c * c
    s2 = 1 - c2
    return c, arb(1), arb(1), arb(1), c2, s2, e, e + 1, c2 - e * s2, *[arb(0)] * 6


def _solve(polynomials: Polynomials, fresnel: bool) -> tuple[Any, ...]:
    """The row of the table for one ray, at the working precision."""
    c, aa, nn, aann, _, _, _, k2, d, tx, ty, tz, nx, ny, nz = polynomials
    tangential, total = c == 0, d < 0
    # A comparison of balls is True only if it is certain. If none is True, the ball contains 0.
    if not (tangential or c > 0 or c < 0) or not (total or d >= 0):
        return _UNDECIDED
    scale = aa.rsqrt() / nn
    unit = aann.rsqrt()
    root = abs(d).sqrt()
    k = k2.sqrt()
    transmitted = not (tangential or total)
    if transmitted:
        along, across = (root if c > 0 else -root) * scale, k * scale
        cos_t = float(root * unit)
    else:
        along, across = -c * scale, scale
        cos_t = 0.0
    bx, by, bz = across * tx + along * nx, across * ty + along * ny, across * tz + along * nz
    x, y, z = float(bx), float(by), float(bz)
    # The radius of a sum is at least the sum of the radii.
    radius = float((bx + by + bz).rad()) + PAIR_ERROR
    low = float(bx - x), float(by - y), float(bz - z)
    cos_i = float(abs(c) * unit)
    terms = _fresnel(polynomials, k, root, tangential) if fresnel else _NO_FRESNEL
    return (x, y, z), low, radius, float(transmitted), cos_i, cos_t, *terms


def _fresnel(polynomials: Polynomials, k: Ball, root: Ball, tangential: bool) -> tuple[complex, ...]:
    """R and 1 − R as pairs, then a_s and a_p, with C = |c|, Q = √|D|.

    All differences that cancel are exact (k²C² − D = (k²−1)AN, C² − k²D = (k²−1)(|n×a|² − D)):

    a_s = (kC − Q)/(kC + Q) = (k²−1)AN / (kC + Q)²
    a_p = (C − kQ)/(C + kQ) = (k²−1)(|n×a|² − D) / (C + kQ)²
    1 − R = 2kCQ (1/(kC + Q)² + 1/(C + kQ)²)
    D ≤ 0: a_s = (kC + iQ)/(kC − iQ), a_p = (C + ikQ)/(C − ikQ)
    """
    if tangential:
        return 1.0, 0.0, 0.0, 0.0, -1 + 0j, -1 + 0j
    c, _, _, aann, c2, s2, e, k2, d, *_ = polynomials
    kcq2 = 2 * (k * abs(c) * root)
    if not d > 0:
        denominator_s, k2d = e * aann, k2 * d
        denominator_p = c2 - k2d
        s = complex(float(1 + 2 * d / denominator_s), float(kcq2 / denominator_s))
        p = complex(float((c2 + k2d) / denominator_p), float(kcq2 / denominator_p))
        return 1.0, 0.0, 0.0, 0.0, s, p
    c = abs(c)
    sum_s, sum_p = k * c + root, c + k * root
    weight_s, weight_p = 1 / (sum_s * sum_s), 1 / (sum_p * sum_p)
    a_s, a_p = e * aann * weight_s, e * (s2 - d) * weight_p
    reflectance = (a_s * a_s + a_p * a_p) * 0.5
    transmittance = kcq2 * (weight_s + weight_p)
    r, t = float(reflectance), float(transmittance)
    return r, float(reflectance - r), t, float(transmittance - t), complex(float(a_s)), complex(float(a_p))


def relative_radicand(a: ArrayLike, n: ArrayLike, k: ArrayLike) -> Array:
    """(N,) the distance of each ray from the critical angle: D / max(c², |k²−1| |n×a|²), from −1 to 1, rounded once.

    Exactly 0 at the critical angle, negative under total internal reflection; NaN if both terms are 0 or the ray is
    invalid. Arguments as for `refract`.
    """
    a, n, k, _, valid = _checked(a, n, k, None)
    index, ratio = np.flatnonzero(valid), np.full(len(a), math.nan)
    for i, ray in zip(index, _rays(a, n, k, None, index), strict=True):
        with ctx.workprec(EXACT_BITS):
            _, _, _, _, c2, s2, e, _, d, *_ = _exact(*ray)
            larger = max(c2, abs(e) * s2)
        with ctx.workprec(PRECISIONS[0]):
            ratio[i] = float(d / larger) if larger > 0 else math.nan
    return ratio

"""Named, replayable sets of rays over the whole domain: where formulas of refraction are at ease, and where not.

A regime builds its rays around given normals; `make` rounds them to the wanted precision and returns what was
rounded. The same name, count, precision and seed give the same rays. NaN and infinity are no refraction and no regime.
"""

from __future__ import annotations

import functools
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mi_refract.numerics import float_expansions

Array = NDArray[np.floating]
Triple = tuple[Array, Array, Array]
Index = NDArray[np.integer]


@dataclass(frozen=True)
class Rays:
    """`a`, `n`: (N, 3); `k`: (N,); all of one precision."""

    a: Array
    n: Array
    k: Array

    def __getitem__(self, index: Any) -> Rays:
        return Rays(self.a[index], self.n[index], self.k[index])

    def __len__(self) -> int:
        return len(self.k)

    def hexed(self, i: int) -> dict[str, Any]:
        """Ray `i`, to the last bit."""
        a, n = ([float(x).hex() for x in v[i]] for v in (self.a, self.n))
        return {"a": a, "n": n, "k": float(self.k[i]).hex()}

    @staticmethod
    def joined(parts: Sequence[Rays]) -> Rays:
        a, n, k = (np.concatenate([getattr(part, name) for part in parts]) for name in ("a", "n", "k"))
        return Rays(a, n, k)


@dataclass(frozen=True)
class Regime:
    """`build(rng, n)` gives (a, n, k) for unit normals `n` (N, 3), whose precision is the one wanted.

    `largest_k` bounds k; `text` defines the set; `unit`: `a` and `n` are unit up to the rounding of their components,
    as the documented formulas demand. `rests_on_denormals`: the answer is another one where those are taken for 0.
    """

    build: Callable[[Generator, Array], Triple]
    largest_k: float
    text: str
    unit: bool = True
    rests_on_denormals: bool = False


def _log_uniform(rng: Generator, low: float, high: float, count: int) -> Array:
    return np.exp(rng.uniform(np.log(low), np.log(high), count))


def _either(rng: Generator, count: int) -> Array:
    return rng.choice([-1.0, 1.0], count)


def normalised(v: Array) -> Array:
    """In extended precision: what is rounded from it is unit up to that rounding."""
    wide = v.astype(np.longdouble)
    return wide / np.sqrt((wide * wide).sum(1, keepdims=True))


# Angles and ratios ---------------------------------------------------------------------------------------------

Draw = Callable[[Generator, int, float], tuple[Array, Array]]  # (rng, count, eps) to (angle of incidence, k)


def _generic(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    return np.arccos(rng.uniform(0, 1, count)), 1.5 ** _either(rng, count)


def _near_normal(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    return _log_uniform(rng, 1e-12, 1e-2, count), rng.uniform(0.4, 2.5, count)


def _grazing(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    return np.pi / 2 - _log_uniform(rng, 1e-7, 1e-2, count), rng.uniform(0.4, 2.5, count)


def _critical(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    k = rng.uniform(1.05, 2.5, count)
    return np.arcsin(1 / k) + _log_uniform(rng, 1e-7, 1e-2, count) * _either(rng, count), k


def _nearly_matched(rng: Generator, count: int, eps: float) -> Array:
    return 1 + _log_uniform(rng, eps, 1e-2, count) * _either(rng, count)


def _matched(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    return np.arccos(rng.uniform(0, 1, count)), _nearly_matched(rng, count, eps)


def _matched_grazing(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    return np.pi / 2 - _log_uniform(rng, 1e-7, 1e-1, count), _nearly_matched(rng, count, eps)


def _brewster(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    k = rng.uniform(0.4, 2.5, count)
    return np.arctan(1 / k) + _log_uniform(rng, eps, 1e-2, count) * _either(rng, count), k


def _steep(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    k = _log_uniform(rng, 10, 1e6, count)
    return np.arcsin(np.minimum(1, rng.uniform(0, 1.2, count) / k)), k


def _dense(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    return np.arccos(rng.uniform(0, 1, count)), _log_uniform(rng, 1e-6, 1e-1, count)


def _mixed(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    """Each ray from one of the sets above."""
    draws = (_generic, _near_normal, _grazing, _critical, _matched, _matched_grazing, _brewster, _steep, _dense)
    angle, k = np.stack([draw(rng, count, eps) for draw in draws], axis=1)
    chosen = rng.integers(0, len(draws), count), np.arange(count)
    return angle[chosen], k[chosen]


def rays_at(draw: Draw, rng: Generator, n: Array) -> Triple:
    """Rays at the drawn angles from ±n, in a random plane of incidence."""
    angle, k = draw(rng, len(n), float(np.finfo(n.dtype).eps))
    wide = n.astype(np.float64)
    across = np.cross(wide, rng.normal(size=n.shape))
    side = np.cos(angle) * _either(rng, len(n)) / _length(wide)
    return normalised(side[:, None] * wide + (np.sin(angle) / _length(across))[:, None] * across), n, k


def _length(v: Array) -> Array:
    return np.sqrt((v * v).sum(1))


def _at(draw: Draw) -> Callable[[Generator, Array], Triple]:
    return functools.partial(rays_at, draw)


# Lengths and components ----------------------------------------------------------------------------------------


def _lengths(rng: Generator, n: Array) -> Triple:
    a, n, k = rays_at(_mixed, rng, n)
    of_a, of_n = (_log_uniform(rng, 1e-18, 1e18, len(n))[:, None] for _ in range(2))
    return a * of_a, n * of_n, k


def _off_unit(rng: Generator, n: Array) -> Triple:
    """What a change of frame leaves: every vector times a matrix, both rounded, in the precision's own arithmetic."""
    a, n, k = rays_at(_mixed, rng, n)
    turn = np.linalg.qr(rng.normal(size=(len(n), 3, 3)))[0].astype(n.dtype)
    return np.einsum("nij,nj->ni", turn, a.astype(n.dtype)), np.einsum("nij,nj->ni", turn, n), k


def _keep_some(rng: Generator, v: Array, most: int) -> Array:
    """Between 1 and `most` components of every vector, unit again; the others are zeros of either sign."""
    order = np.argsort(rng.random(v.shape), axis=1)
    kept = order < rng.integers(1, most + 1, len(v))[:, None]
    lone = kept.sum(1, keepdims=True) == 1
    zeros = np.copysign(0.0, rng.normal(size=v.shape))
    return np.where(kept, normalised(np.where(kept, np.where(lone, np.sign(v), v), 0)), zeros)


def _zeros(rng: Generator, n: Array) -> Triple:
    a, n, k = rays_at(_mixed, rng, _keep_some(rng, n, 2).astype(n.dtype))
    some = rng.random(len(n)) < 0.5
    a = np.where(some[:, None], _keep_some(rng, a, 2), a)
    return np.where((a * n).sum(1, keepdims=True) == 0, n, a), n, k


def _denormal(rng: Generator, n: Array) -> Triple:
    """The zeros of n, of a or of both become numbers below the smallest normal one, 2⁻¹²⁶ or 2⁻¹⁰²²."""
    a, n, k = _zeros(rng, n)
    which = rng.integers(1, 4, len(n))[:, None]
    a = np.where((a == 0) & (which & 1 > 0), _tiny(rng, n), a)
    return a, np.where((n == 0) & (which & 2 > 0), _tiny(rng, n), n), k


def _on_a_denormal(rng: Generator, n: Array) -> Triple:
    """n an axis, and a denormal number along it is all that keeps `a` from being tangential."""
    count, axis = len(n), rng.integers(0, 3, len(n))
    rows, a = np.arange(count), rng.normal(size=(count, 3))
    a[rows, axis] = 0
    a = normalised(a).astype(float)
    a[rows, axis] = _tiny(rng, n)[:, 0]
    normal = np.zeros((count, 3))
    normal[rows, axis] = _either(rng, count)
    return a, normal, _mixed(rng, count, float(np.finfo(n.dtype).eps))[1]


def _tiny(rng: Generator, like: Array) -> Array:
    """Denormal numbers of either sign."""
    limits = np.finfo(like.dtype)
    whole = np.exp2(rng.uniform(0, limits.nmant, like.shape)).round()
    return np.ldexp(whole, limits.minexp - limits.nmant) * rng.choice([-1.0, 1.0], like.shape)


# Facts that rounding does not spoil ----------------------------------------------------------------------------


def _tangential(rng: Generator, n: Array) -> Triple:
    """Half of them a = n × v in whole numbers, half (x, y, 0) and (−y, x, 0) in some order; times powers of two."""
    count, bits = len(n), np.finfo(n.dtype).nmant // 2 - 1
    whole, v = np.rint(rng.uniform(-(2**bits), 2**bits, (2, count, 3)))
    product = np.cross(whole, v)
    x, y = _rounded(normalised(rng.normal(size=(count, 2))), n.dtype).T
    turn, zero = rng.integers(0, 3, count), np.zeros(count)
    flat_a, flat_n = (_turned(np.stack(c, axis=1), turn) for c in ((x, y, zero), (-y, x, zero)))
    flat = (rng.random(count) < 0.5) | ~product.any(axis=1)
    a, n = np.where(flat[:, None], flat_a, product), np.where(flat[:, None], flat_n, whole)
    _, k = _mixed(rng, count, float(np.finfo(n.dtype).eps))
    return a * _power_of_two(rng, count), n * _power_of_two(rng, count), k


def _turned(v: Array, turn: Index) -> Array:
    """The components of every vector moved on cyclically by 0, 1 or 2."""
    return np.take_along_axis(v, (np.arange(3) - turn[:, None]) % 3, axis=1)


def _power_of_two(rng: Generator, count: int) -> Array:
    return np.exp2(rng.integers(-12, 13, count))[:, None]


@functools.cache
def _solutions() -> Array:
    """Whole (x, y, z) and dyadic k with k² (x² + y²) = x² + y² + z²: a = (x, y, z) on n = (0, 0, 1) is critical."""
    k = np.unique(np.concatenate([np.arange(2**m + 1, 2 ** (m + 2)) / 2**m for m in range(1, 7)]))
    x, y = (v.ravel()[1:] for v in np.meshgrid(np.arange(129), np.arange(129)))
    s = (x * x + y * y)[:, None]
    # k² has 12 bits after the point: s (k² − 1) is exact, and so is the root where it is whole.
    z = np.rint(np.sqrt(s * (k * k - 1)))
    i, j = np.nonzero((z * z == s * (k * k - 1)) & (z > 0))
    return np.stack([x[i], y[i], z[i, j], k[j]], axis=1)


def _exactly_critical(rng: Generator, n: Array) -> Triple:
    """Whole solutions, turned by the whole matrix of a quaternion, which multiplies all lengths by its own square."""
    count = len(n)
    x, y, z, k = _solutions()[rng.integers(0, len(_solutions()), count)].T
    small = rng.integers(-7, 8, (4, count)).astype(float)
    small[0][~small.any(axis=0)] = 1
    rotation = _rotation(*small)
    local = np.stack([x * _either(rng, count), y * _either(rng, count), z * _either(rng, count)], axis=1)
    a = np.einsum("ijn,nj->ni", rotation, local)
    return a * _power_of_two(rng, count), rotation[:, 2].T * _power_of_two(rng, count), k


def _rotation(w: Array, x: Array, y: Array, z: Array) -> Array:
    """(3, 3, N): the rotation of the quaternion times w² + x² + y² + z²."""
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    return np.array(
        [
            [ww + xx - yy - zz, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), ww - xx + yy - zz, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), ww - xx - yy + zz],
        ]
    )


# To the last bit -----------------------------------------------------------------------------------------------

_STEPS = 2


def _to_the_ulp(least: float, most: float, rng: Generator, n: Array) -> Triple:
    """Rays whose exact radicand is as near to 0 as one number among them can bring it, then up to two ulps aside.

    k − 1 is log-uniform in `least` … `most`. For a third of them that number is k, for the rest the component of `a`
    along the axis j that n is farthest from: it starts at 2u … 2⁻², and the smaller it is the finer are its ulps, down
    to a radicand of u² of its terms.
    """
    count, precision, eps = len(n), n.dtype, float(np.finfo(n.dtype).eps)
    wide, rows = n.astype(np.float64), np.arange(count)
    j = np.argmin(np.abs(wide), axis=1)
    k = _rounded(1 + _log_uniform(rng, least, most, count), precision)
    start = _log_uniform(rng, eps, 0.25, count) * _either(rng, count)
    a = _rounded(_on_the_cone(rng, wide, j, k, start), precision)
    by_k = (rng.random(count) < 1 / 3) | (np.abs(a[rows, j]) > 0.25)
    for _ in range(_STEPS):
        d, along = radicand(a, wide, k)
        # A step that would leave |a| = 1 by more than u/4 is left to k.
        step = d / along[rows, j]
        by_k |= np.abs(step) * (np.abs(a[rows, j]) + np.abs(step)) > eps / 8
        a[rows, j] -= np.where(by_k, 0, step)
        a, k = _rounded(a, precision), _rounded(k - np.where(by_k, d / along[:, 6], 0), precision)
    aside = rng.integers(-2, 3, count)
    a[rows, j] += np.where(by_k, 0, aside) * np.spacing(np.abs(a[rows, j]).astype(precision))
    return a, n, k + np.where(by_k, aside, 0) * np.spacing(k.astype(precision))


def _rounded(x: Array, precision: DTypeLike) -> Array:
    return x.astype(precision).astype(np.float64)


def _on_the_cone(rng: Generator, n: Array, j: Index, k: Array, start: Array) -> Array:
    """Unit a at the critical angle from ±n, whose component j is `start` as far as the cone reaches there."""
    rows, sine, cosine = np.arange(len(n)), 1 / k, np.sqrt((k - 1) * (k + 1)) / k * _either(rng, len(n))
    n = n / _length(n)[:, None]
    p = -n[rows, j][:, None] * n
    p[rows, j] += 1
    p /= _length(p)[:, None]
    cos_turn = np.clip((start - cosine * n[rows, j]) / (sine * p[rows, j]), -1, 1)
    sin_turn = np.sqrt(1 - cos_turn**2) * _either(rng, len(n))
    tangent = cos_turn[:, None] * p + sin_turn[:, None] * np.cross(n, p)
    return normalised(cosine[:, None] * n + sine[:, None] * tangent)


def radicand(a: Array, n: Array, k: Array) -> tuple[Array, Array]:
    """D = k² c² − κ |a|²|n|² of these very numbers (N,), and its derivatives in a, n and k (N, 7). float64."""
    c, d, _ = float_expansions.radicand(a.T, n.T, k)
    aa, nn, k2c, kappa = (a * a).sum(1), (n * n).sum(1), k * k * c[0], k * k - 1
    along_a = 2 * (k2c[:, None] * n - (kappa * nn)[:, None] * a)
    along_n = 2 * (k2c[:, None] * a - (kappa * aa)[:, None] * n)
    along = np.column_stack([along_a, along_n, -2 * k * (aa * nn - c[0] ** 2)])
    return d[0], np.where(along == 0, 1e-300, along)


# The table -----------------------------------------------------------------------------------------------------

REGIMES = {
    "generic": Regime(_at(_generic), 1.5, "cosine uniform, k = 1.5 or 1/1.5"),
    "near-normal": Regime(_at(_near_normal), 2.5, "1e-12 … 1e-2 rad from the normal, k in 0.4 … 2.5"),
    "grazing": Regime(_at(_grazing), 2.5, "1e-7 … 1e-2 rad from the surface, k in 0.4 … 2.5"),
    "critical": Regime(_at(_critical), 2.5, "1e-7 … 1e-2 rad from the critical angle, both sides, k in 1.05 … 2.5"),
    "critical, to the ulp": Regime(
        functools.partial(_to_the_ulp, 0.05, 1.5),
        2.51,
        "k in 1.05 … 2.5, the radicand of the rounded numbers as near to 0 as two ulps of one of them, both sides",
    ),
    "critical, any k, to the ulp": Regime(
        functools.partial(_to_the_ulp, 1e-6, 9.9e5), 1e6, "the same for k − 1 in 1e-6 … 1e6: grazing to near-normal"
    ),
    "matched": Regime(_at(_matched), 1.01, "|k − 1| from an ulp to 1e-2, cosine uniform"),
    "matched, grazing": Regime(
        _at(_matched_grazing), 1.01, "|k − 1| from an ulp to 1e-2, 1e-7 … 1e-1 rad from the surface"
    ),
    "Brewster": Regime(_at(_brewster), 2.5, "an ulp to 1e-2 rad from Brewster's angle, both sides, k in 0.4 … 2.5"),
    "k ≫ 1": Regime(_at(_steep), 1e6, "k in 10 … 1e6, k sin θ uniform in 0 … 1.2"),
    "k ≪ 1": Regime(_at(_dense), 0.1, "k in 1e-6 … 0.1, cosine uniform"),
    "axes, signed zeros": Regime(_zeros, 1e6, "n, and a of every other ray, with zeros of either sign; not tangential"),
    "denormal": Regime(_denormal, 1e6, "as before, the zeros of a, n or both replaced by denormal numbers"),
    "on a denormal": Regime(
        _on_a_denormal,
        1e6,
        "n an axis, n·a a denormal number: all that keeps a from being tangential",
        rests_on_denormals=True,
    ),
    "lengths": Regime(_lengths, 1e6, "|a| and |n| log-uniform in 1e-18 … 1e18, angles and ratios of all sets", False),
    "off unit": Regime(_off_unit, 1e6, "a and n turned by a matrix in their own precision, all angles and k", False),
    "tangential": Regime(_tangential, 1e6, "n·a = 0 exactly, lengths from 2⁻¹² up, ratios of all sets", False),
    "exactly critical": Regime(_exactly_critical, 4.0, "radicand exactly 0: whole a and n times powers of two", False),
}


def make(name: str, count: int, precision: DTypeLike, seed: int = 0, normal: ArrayLike | None = None) -> Rays:
    """`count` rays of a regime in `precision`, float32 or float64. KeyError: no such regime.

    `normal` takes the place of random normals, in the regimes that do not choose their own.
    """
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    n = normalised(rng.normal(size=(count, 3))) if normal is None else np.tile(np.asarray(normal, float), (count, 1))
    a, n, k = REGIMES[name].build(rng, n.astype(precision))
    return Rays(a.astype(precision), n.astype(precision), k.astype(precision))

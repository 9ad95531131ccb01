"""Chains of plane boundaries with closed answers: the layers of a mirage, and the walls of a light pipe.

Everything exact is in extended precision. With c = cos θ₀, s = sin θ₀ and κ_j = (n_0/n_j)² − 1, n sin θ is conserved:

    cos²θ_j = c² − κ_j s²;   the ray turns back at the first boundary whose far side has κ_j > c²/s²
    ∂(cos θ_e)/cos θ_e = Σ (n_i/n_e)² (cos θ_i / cos²θ_e) ε_i     ε_i: error of the direction in layer i, in radians
    ∂(cos θ_e)/cos θ_e = tan²θ_e Σ δ_i                             δ_i: relative error of the ratio at boundary i

A ray that turns leaves through the top with the cosine it came with: there e = 0, and the sums go down and up.

Ratios of rounded indices err together: their product is the ratio of the first index to the last. Neighbours in
float32 are n and n + mε, ε = 2⁻²³; their quotients are rounded to 1 ± mε, off by mε(n − 1), over the whole mirage by
3e-5 · 3e-4, less than u. So |Σ δ| ≤ 3u: the first index, the last, and all quotients; of a ray that turned, ≤ u.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from mi_refract.accuracy import Subject
from validation.run import seeds
from validation.run.array_settings import Setting

Array = NDArray[Any]

TOP = 1.0003  # the index of the coldest air, at the top
MIRAGE = 3e-5  # decrease of the index down to the road
SEED = 7  # of the rays in the light pipe
EXACT_RATIO = 2.0**-23  # 1 + this is the first float32 after 1
FEEDS = {
    "ratios": "each k rounded once; in float32, neighbours 3e-8 apart have k = 1, and the ray is not refracted",
    "reciprocals": "each k as 1/η of a rounded η = n_to/n_from; the same have k = 1 + 2⁻²³, four times too much",
    "indices": "each k as a quotient of rounded indices, as scenes give them",
    "contrasts": "each k rounded once, and with it k² − 1 from double precision",
}


@dataclass(frozen=True)
class Chain:
    """Boundaries 0 … count − 1, each met after the one before, as given to a formula.

    `normals` (rays or 1, count or 1, 3). `k` (2 count): n_from/n_to on the way down, then on the way up. `contrasts`:
    k² − 1 likewise, or None. `turns`: a mirrored ray goes back up; else it goes on, as between the walls of a pipe.
    """

    normals: Array
    k: Array
    contrasts: Array | None = None
    turns: bool = True

    @property
    def count(self) -> int:
        """How many layers there are."""
        return len(self.k) // 2


@dataclass(frozen=True)
class Carried:
    """Where the rays are in the end: `b` (N, 3), extended precision; `place` (N,) the boundary they would meet next,
    −1 above the top; `passed` (N,) how often they were transmitted."""

    b: Array
    place: Array
    passed: Array


def carry(subject: Subject, chain: Chain, a: Array, stop: Array, setting: Setting) -> Carried:
    """Rays `a` (N, 3) from the top to boundary `stop` (N,), or back out of the top, by one formula; one launch."""
    if dr.is_jit_v(setting.vector):
        return _compiled(subject, chain, a, stop, setting)
    normals: Array = np.asarray(chain.normals, setting.precision)
    k = chain.k.astype(setting.precision).tolist()
    contrasts = None if chain.contrasts is None else chain.contrasts.astype(np.float64).tolist()

    def boundary(mine: list[Any], place: int, way: int) -> tuple[Any, ...]:
        here = place if way > 0 else place + chain.count
        known = () if contrasts is None else (contrasts[here],)
        return mine[place if len(mine) > 1 else 0], k[here], *known

    found = []
    for i, ray in enumerate(a):
        mine = [setting.vector(n) for n in normals[i if len(normals) > 1 else 0]]
        start = (setting.vector(ray.astype(setting.precision)), 0, 1, 0, 2 * chain.count + 2)
        b, place, _, passed, _ = _follow(subject, functools.partial(boundary, mine), chain.turns, int(stop[i]), start)
        found.append(([*b], place, passed))
    b, place, passed = zip(*found, strict=True)
    return Carried(np.array(b, np.longdouble), np.array(place), np.array(passed))


def _follow(
    subject: Subject, boundary: Callable[..., tuple[Any, ...]], turns: Any, stop: Any, start: tuple[Any, ...]
) -> tuple[Any, ...]:
    """The loop both kinds of arrays share: (a, place, way ±1, passed, steps left) until the ray is out or at `stop`."""

    def inside(a: Any, place: Any, way: Any, passed: Any, left: Any) -> Any:
        return (place >= 0) & (place < stop) & (left > 0)

    def step(a: Any, place: Any, way: Any, passed: Any, left: Any) -> tuple[Any, ...]:
        b, transmitted = subject(a, *boundary(place, way))
        way = dr.select(turns, dr.select(transmitted, way, -way), way)
        return type(a)(b), place + way, way, passed + dr.select(transmitted, 1, 0), left - 1

    return dr.while_loop(start, inside, step)


def _compiled(subject: Subject, chain: Chain, a: Array, stop: Array, setting: Setting) -> Carried:
    """Everything that tells one chain from another is data, so that each formula is compiled once."""
    vector, number = setting.vector, dr.value_t(setting.vector)
    integer: Any = dr.int32_array_t(number)
    rows, columns, _ = chain.normals.shape
    normals, k = (number(x.astype(setting.precision).ravel()) for x in (chain.normals, chain.k))
    wide: Any = dr.float64_array_t(number)
    contrasts = None if chain.contrasts is None else wide(chain.contrasts.astype(np.float64))
    count, stride = dr.opaque(integer, chain.count), dr.opaque(integer, int(columns > 1))
    turns, limit = dr.opaque(dr.mask_t(integer), chain.turns), 2 * chain.count + 2
    start = (vector(a.astype(setting.precision).T), *(dr.opaque(integer, x, len(a)) for x in (0, 1, 0, limit)))
    # numpy's memory may be aligned or not, and be transposed: each is another kernel, unless it is copied first.
    rays = np.arange(len(a)) if rows > 1 else np.zeros(len(a))
    first, end = (integer(x.astype(np.int32)) + start[1] for x in (rays * columns, stop))
    dr.eval(start, first, end)

    def boundary(place: Any, way: Any) -> tuple[Any, ...]:
        here = dr.select(way > 0, place, place + count)
        known = () if contrasts is None else (dr.gather(wide, contrasts, here),)
        return dr.gather(vector, normals, first + stride * place), dr.gather(number, k, here), *known

    def detached(*given: Any) -> tuple[Any, ...]:
        # Mitsuba's functions return arrays that carry derivatives, and the state of the loop must keep its type.
        return dr.detach(subject(*given), preserve_type=False)

    b, place, _, passed, _ = _follow(detached, boundary, turns, end, start)
    dr.eval(b, place, passed)
    return Carried(np.array(b).T.astype(np.longdouble), np.array(place), np.array(passed))


# The mirage ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Layers:
    """Plane layers 0 … count whose index falls from one to the next; all arrays in extended precision.

    `index` (count + 1,); `kappa` (count + 1,): (n_0/n_j)² − 1; `steps` (count,): (n_j/n_(j+1))² − 1. `exact`: float32
    holds the ratios on the way down.
    """

    index: Array
    kappa: Array
    steps: Array
    exact: bool = False

    @property
    def count(self) -> int:
        """How many boundaries there are."""
        return len(self.steps)

    def chain(self, normal: Array, feed: str, precision: type) -> Chain:
        """The numbers that a formula is given for each boundary; `feed`: one of FEEDS."""
        index = self.index.astype(precision) if feed == "indices" else self.index
        k = np.concatenate([index[:-1] / index[1:], index[1:] / index[:-1]])
        if feed == "reciprocals":
            k = 1 / (1 / k).astype(precision)
        contrasts = np.concatenate([self.steps, -self.steps / (1 + self.steps)]) if feed == "contrasts" else None
        return Chain(normal.reshape(1, 1, 3), k, contrasts)

    def cosine(self, c2: Array, s2: Array, layer: Array) -> Array:
        """cos θ of rays with cos²θ₀ = c2 in `layer`; 0 where they do not arrive."""
        return np.asarray(np.sqrt(np.maximum(c2 - self.kappa[layer] * s2, 0)))

    def turning(self, c2: Array, s2: Array) -> Array:
        """The layer in which a ray turns; `count` where it passes through all of them."""
        return np.searchsorted(self.kappa[1:], c2 / s2, side="right")


@dataclass(frozen=True)
class Rays:
    """Rays into `layers`, each up to its boundary `stop`, and what must become of them.

    Arrays (N,), extended precision. `passes`: it gets there; else it turns in layer `last` and leaves by the top.
    `end`: its cosine where it ends. `sine2`: sin²θ₀; `cosines`: Σ (n_i/n_0)² cos θ_i over layers 0 … last.
    """

    layers: Layers
    normal: Array
    a: Array
    stop: Array
    passes: Array
    last: Array
    end: Array
    sine2: Array
    cosines: Array

    def fed(self, feed: str, precision: type) -> Fed:
        """The same rays, with the layers as given to a formula in `precision`; `feed`: one of FEEDS."""
        each = {"ratios": 1, "reciprocals": 2}.get(feed, 0)  # a reciprocal is rounded twice
        all_down = 3 if feed == "indices" else each * self.last * (not self.layers.exact)
        turned = 1 if feed == "indices" else each * self.last * (2 - self.layers.exact)
        # Down into layers 1 … last; turned, also the mirror direction in the last, and up into last − 1 … 0.
        outputs = np.where(self.passes, self.cosines, 2 * self.cosines) - np.sqrt(1 - self.sine2)
        squeeze = 1 + np.where(self.passes, self.layers.kappa[self.last], 0)
        condition = (outputs + np.where(self.passes, all_down, turned) * self.sine2) * squeeze / self.end**2
        height = 2 * (self.cosines + all_down * self.sine2) / (self.layers.steps[0] * self.sine2)
        return Fed(self, feed, self.layers.chain(self.normal, feed, precision), condition, height)


@dataclass(frozen=True)
class Fed:
    """`condition` (N,): of ln cos θ where a ray ends, the sums at the head of this module with every ε and every δ 1.
    `height` (N,): how many layers too high or too low it turns then. Both are to first order."""

    rays: Rays
    feed: str
    chain: Chain
    condition: Array
    height: Array


def enter(layers: Layers, degrees: Array, stop: Array, plane: Array, precision: type) -> Rays:
    """Rays at these angles to the normal plane[0], towards plane[1]; normal and rays rounded to `precision`."""
    normal, radians = plane[0].astype(precision), np.deg2rad(np.asarray(degrees, np.longdouble))[:, None]
    a = (np.cos(radians) * plane[0] + np.sin(radians) * plane[1]).astype(precision)
    c2, s2 = cosine(a, normal) ** 2, sine2(a, normal)
    turning = layers.turning(c2, s2)
    passes = turning >= stop
    last = np.where(passes, stop, turning)
    end = np.where(passes, layers.cosine(c2, s2, last), np.sqrt(c2))
    cosines, everywhere = np.zeros(len(a), np.longdouble), np.arange(layers.count + 1)
    for c in np.unique(c2):
        here = c2 == c
        weighted = layers.cosine(c, s2[here][0], everywhere) / (1 + layers.kappa)
        cosines[here] = np.cumsum(weighted)[last[here]]
    return Rays(layers, normal, a, stop, passes, last, end, s2, cosines)


def cosine(b: Array, normal: Array) -> Array:
    """|cos| of the angle between each b (N, 3) and the normal, whatever their lengths."""
    b, normal = b.astype(np.longdouble), normal.astype(np.longdouble)
    return np.asarray(np.abs(b @ normal) / np.sqrt((b * b).sum(1) * (normal @ normal)))


def sine2(b: Array, normal: Array) -> Array:
    """sin² of the same angle."""
    b, normal = b.astype(np.longdouble), normal.astype(np.longdouble)
    return np.asarray((np.cross(normal, b) ** 2).sum(1) / ((b * b).sum(1) * (normal @ normal)))


@functools.cache
def air(count: int) -> Layers:
    """n_j = TOP − j MIRAGE/count: the air above a hot road, 3e-8 a layer for a thousand of them."""
    j, top, step = np.arange(count + 1).astype(np.longdouble), np.longdouble(TOP), np.longdouble(MIRAGE) / count
    index = top - j * step
    return Layers(index, j * step * (2 * top - j * step) / index**2, step * (index[:-1] + index[1:]) / index[1:] ** 2)


def exact_ratios(count: int) -> Layers:
    """n_j/n_(j+1) = 1 + 2⁻²³, which float32 holds: nothing is lost before a formula begins."""
    growth = np.arange(count + 1) * np.log1p(np.longdouble(EXACT_RATIO))
    step = np.longdouble(EXACT_RATIO) * (2 + np.longdouble(EXACT_RATIO))
    return Layers(TOP * np.exp(-growth), np.expm1(2 * growth), np.full(count, step), exact=True)


# The light pipe ------------------------------------------------------------------------------------------------


def frame(precision: type) -> Array:
    """Three rows that are orthogonal exactly, as rounded to `precision`, and unit to half an ulp."""
    return np.longdouble(precision(1) / precision(3)) * np.array([[1, 2, 2], [2, 1, -2], [2, -2, 1]], np.longdouble)


@seeds.cached
def pipe(reflections: int, rays: int, index: float, precision: type) -> tuple[Array, Chain, Array]:
    """(a, chain, exact direction in the end) in a square pipe with the axes `frame`: walls ±0, ±1, length 2.

    Unfolded, the ray is straight and meets the walls of either pair at equal distances: each meeting changes the
    sign of one component, and nothing else.
    """
    rng, axes = np.random.default_rng(seeds.current(SEED)), frame(precision)
    across = rng.uniform(0.05, 0.6, (rays, 2)) * rng.choice([-1, 1], (rays, 2))
    local = np.column_stack([across, np.sqrt(1 - (across**2).sum(1))])
    a: Array = (local @ axes).astype(precision)
    components = a.astype(np.longdouble) @ axes[:2].T
    met = (np.arange(reflections) + 0.5)[None, :, None] / np.abs(components)[:, None, :]
    order = np.argsort(met.reshape(rays, -1), axis=1)[:, :reflections] % 2
    before = np.where(order == 1, np.cumsum(order == 1, axis=1), np.cumsum(order == 0, axis=1)) - 1
    outward = np.sign(np.take_along_axis(components, order, axis=1)) * (-1.0) ** before
    chain = Chain(outward[..., None] * axes[order], np.full(2 * reflections, index), turns=False)
    times = np.stack([(order == wall).sum(1) for wall in (0, 1)], axis=1)
    flipped = np.where(times % 2 == 1, 2 * components, 0) / (axes[:2] ** 2).sum(1)
    return a, chain, a - flipped @ axes[:2]

"""Chains of plane boundaries with closed-form answers: the layers of a mirage, and the walls of a light pipe.

Exact values are in extended precision. With c = cos θ₀, s = sin θ₀ and κ_j = (n_0/n_j)² − 1, n sin θ is conserved:

    cos²θ_j = c² − κ_j s²;   the ray turns back at the first boundary whose far side has κ_j > c²/s²
    ∂(cos θ_e)/cos θ_e = Σ (n_i/n_e)² (cos θ_i / cos²θ_e) ε_i     ε_i: error of the direction in layer i, in radians
    ∂(cos θ_e)/cos θ_e = tan²θ_e Σ δ_i                             δ_i: relative error of the ratio at boundary i

A ray that turns leaves through the top with the cosine with which it entered: e = 0, and the sums go down and up.

Errors of the ratios of rounded indices are correlated: the product of the ratios is the ratio of the first index to the
last. Neighbours in float32 are n and n + mε, ε = 2⁻²³; their quotient rounds to 1 ± mε, with an error of mε(n − 1).
Over the whole mirage this is 3e-5 · 3e-4, less than u. So |Σ δ| ≤ 3u: from the first index, the last, and all
quotients; for a ray that turns, ≤ u.
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
    "reciprocals": "each k as 1/η of a rounded η = n_to/n_from; the same neighbours have k − 1 = 2⁻²³, four times too "
    "large",
    "indices": "each k as a quotient of rounded indices, as in scene files",
    "contrasts": "each k rounded once, with k² − 1 from double precision",
}


@dataclass(frozen=True)
class Chain:
    """Boundaries 0 … count − 1 in the order in which a ray meets them, as a formula gets them.

    `normals` (rays or 1, count or 1, 3). `k` (2 count): n_from/n_to on the way down, then on the way up. `contrasts`:
    k² − 1 likewise, or None. `turns`: whether a reflected ray goes back up, or on to the next boundary, as in a pipe.
    """

    normals: Array
    k: Array
    contrasts: Array | None = None
    turns: bool = True

    @property
    def count(self) -> int:
        """The number of boundaries."""
        return len(self.k) // 2


@dataclass(frozen=True)
class Carried:
    """Rays after a chain: the direction `b` (N, 3) in extended precision, `place` and `passed` (N,).

    `place`: the next boundary, −1 above the top. `passed`: the number of transmissions.
    """

    b: Array
    place: Array
    passed: Array


def carry(subject: Subject, chain: Chain, a: Array, stop: Array, setting: Setting) -> Carried:
    """Trace rays `a` (N, 3) with one formula from the top to boundary `stop` (N,), or back out of the top.

    Compiled backends launch one kernel.
    """
    if dr.is_jit_v(setting.vector):
        return _compiled(subject, chain, a, stop, setting)
    normals: Array = np.asarray(chain.normals, setting.precision)
    k = chain.k.astype(setting.precision).tolist()
    contrasts = None if chain.contrasts is None else chain.contrasts.astype(np.float64).tolist()

    def boundary(ray_normals: list[Any], place: int, way: int) -> tuple[Any, ...]:
        index = place if way > 0 else place + chain.count
        contrast = () if contrasts is None else (contrasts[index],)
        return ray_normals[place if len(ray_normals) > 1 else 0], k[index], *contrast

    results = []
    for i, ray in enumerate(a):
        ray_normals = [setting.vector(n) for n in normals[i if len(normals) > 1 else 0]]
        start = (setting.vector(ray.astype(setting.precision)), 0, 1, 0, 2 * chain.count + 2)
        of_ray = functools.partial(boundary, ray_normals)
        b, place, _, passed, _ = _follow(subject, of_ray, chain.turns, int(stop[i]), start)
        results.append(([*b], place, passed))
    b, place, passed = zip(*results, strict=True)
    return Carried(np.array(b, np.longdouble), np.array(place), np.array(passed))


def _follow(
    subject: Subject, boundary: Callable[..., tuple[Any, ...]], turns: Any, stop: Any, start: tuple[Any, ...]
) -> tuple[Any, ...]:
    """Loop over boundaries until the ray is out of the chain or at `stop`, for scalar and compiled arrays.

    The state is (a, place, way ±1, passed, steps left).
    """

    def inside(a: Any, place: Any, way: Any, passed: Any, left: Any) -> Any:
        return (place >= 0) & (place < stop) & (left > 0)

    def step(a: Any, place: Any, way: Any, passed: Any, left: Any) -> tuple[Any, ...]:
        b, transmitted = subject(a, *boundary(place, way))
        way = dr.select(turns, dr.select(transmitted, way, -way), way)
        return type(a)(b), place + way, way, passed + dr.select(transmitted, 1, 0), left - 1

    return dr.while_loop(start, inside, step)


def _compiled(subject: Subject, chain: Chain, a: Array, stop: Array, setting: Setting) -> Carried:
    """As `carry`, on a compiled backend. Chains differ in data only, so each formula is compiled once."""
    vector, number = setting.vector, dr.value_t(setting.vector)
    integer: Any = dr.int32_array_t(number)
    rows, columns, _ = chain.normals.shape
    normals, k = (number(x.astype(setting.precision).ravel()) for x in (chain.normals, chain.k))
    wide: Any = dr.float64_array_t(number)
    contrasts = None if chain.contrasts is None else wide(chain.contrasts.astype(np.float64))
    count, stride = dr.opaque(integer, chain.count), dr.opaque(integer, int(columns > 1))
    turns, limit = dr.opaque(dr.mask_t(integer), chain.turns), 2 * chain.count + 2
    start = (vector(a.astype(setting.precision).T), *(dr.opaque(integer, x, len(a)) for x in (0, 1, 0, limit)))
    # Unaligned or transposed memory of numpy would be another kernel each: index arithmetic copies it.
    rays = np.arange(len(a)) if rows > 1 else np.zeros(len(a))
    first, end = (integer(x.astype(np.int32)) + start[1] for x in (rays * columns, stop))
    dr.eval(start, first, end)

    def boundary(place: Any, way: Any) -> tuple[Any, ...]:
        index = dr.select(way > 0, place, place + count)
        contrast = () if contrasts is None else (dr.gather(wide, contrasts, index),)
        return dr.gather(vector, normals, first + stride * place), dr.gather(number, k, index), *contrast

    def detached(*arguments: Any) -> tuple[Any, ...]:
        # Mitsuba's functions return arrays with derivatives; the loop's state must keep its type.
        return dr.detach(subject(*arguments), preserve_type=False)

    b, place, _, passed, _ = _follow(detached, boundary, turns, end, start)
    dr.eval(b, place, passed)
    return Carried(np.array(b).T.astype(np.longdouble), np.array(place), np.array(passed))


# The mirage ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Layers:
    """Plane layers 0 … count of decreasing index; all arrays in extended precision.

    `index` (count + 1,); `kappa` (count + 1,): (n_0/n_j)² − 1; `steps` (count,): (n_j/n_(j+1))² − 1. `exact`: the
    ratios on the way down are exact in float32.
    """

    index: Array
    kappa: Array
    steps: Array
    exact: bool = False

    @property
    def count(self) -> int:
        """The number of boundaries."""
        return len(self.steps)

    def chain(self, normal: Array, feed: str, precision: type) -> Chain:
        """Return the numbers that a formula gets at each boundary; `feed`: one of FEEDS."""
        index = self.index.astype(precision) if feed == "indices" else self.index
        k = np.concatenate([index[:-1] / index[1:], index[1:] / index[:-1]])
        if feed == "reciprocals":
            k = 1 / (1 / k).astype(precision)
        contrasts = np.concatenate([self.steps, -self.steps / (1 + self.steps)]) if feed == "contrasts" else None
        return Chain(normal.reshape(1, 1, 3), k, contrasts)

    def cosine(self, c2: Array, s2: Array, layer: Array) -> Array:
        """Return cos θ in `layer` of rays with cos²θ₀ = c2; 0 for rays that do not reach it."""
        return np.asarray(np.sqrt(np.maximum(c2 - self.kappa[layer] * s2, 0)))

    def turning(self, c2: Array, s2: Array) -> Array:
        """Return the layer in which a ray turns; `count` for rays that pass all layers."""
        return np.searchsorted(self.kappa[1:], c2 / s2, side="right")


@dataclass(frozen=True)
class Rays:
    """Rays that enter `layers`, each traced up to its boundary `stop`, and their exact answers.

    Arrays (N,) in extended precision. `passes`: the ray reaches `stop`; otherwise it turns in layer `last` and leaves
    through the top. `end`: its final cosine. `sine2`: sin²θ₀; `cosines`: Σ (n_i/n_0)² cos θ_i over layers 0 … last.
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
        """Return the rays with the layers as a formula in `precision` gets them; `feed`: one of FEEDS."""
        roundings = {"ratios": 1, "reciprocals": 2}.get(feed, 0)  # per boundary: a reciprocal is rounded twice
        all_down = 3 if feed == "indices" else roundings * self.last * (not self.layers.exact)
        turned = 1 if feed == "indices" else roundings * self.last * (2 - self.layers.exact)
        # Down into layers 1 … last; for rays that turn, also the reflection in the last, and up into last − 1 … 0.
        outputs = np.where(self.passes, self.cosines, 2 * self.cosines) - np.sqrt(1 - self.sine2)
        squeeze = 1 + np.where(self.passes, self.layers.kappa[self.last], 0)
        condition = (outputs + np.where(self.passes, all_down, turned) * self.sine2) * squeeze / self.end**2
        height = 2 * (self.cosines + all_down * self.sine2) / (self.layers.steps[0] * self.sine2)
        growth = 2.0 * roundings * (not self.layers.exact) / float(self.layers.steps[0])
        return Fed(self, feed, self.layers.chain(self.normal, feed, precision), condition, height, growth)


@dataclass(frozen=True)
class Fed:
    """Rays, their layers as a formula gets them, and conditions to first order.

    `condition` (N,): condition of ln cos θ at the end of a ray, the sums in this module's docstring with every ε and
    every δ 1. `height` (N,): the corresponding error of the turning layer, in layers; `growth`: by how much each layer
    beyond the exact one adds to it.
    """

    rays: Rays
    feed: str
    chain: Chain
    condition: Array
    height: Array
    growth: float


def enter(layers: Layers, degrees: Array, stop: Array, plane: Array, precision: type) -> Rays:
    """Return rays at these angles to the normal plane[0], towards plane[1]; rays and normal are in `precision`."""
    normal, radians = plane[0].astype(precision), np.deg2rad(np.asarray(degrees, np.longdouble))[:, None]
    a = (np.cos(radians) * plane[0] + np.sin(radians) * plane[1]).astype(precision)
    c2, s2 = cosine(a, normal) ** 2, sine2(a, normal)
    turning = layers.turning(c2, s2)
    passes = turning >= stop
    last = np.where(passes, stop, turning)
    end = np.where(passes, layers.cosine(c2, s2, last), np.sqrt(c2))
    cosines, everywhere = np.zeros(len(a), np.longdouble), np.arange(layers.count + 1)
    for c in np.unique(c2):
        same = c2 == c
        weighted = layers.cosine(c, s2[same][0], everywhere) / (1 + layers.kappa)
        cosines[same] = np.cumsum(weighted)[last[same]]
    return Rays(layers, normal, a, stop, passes, last, end, s2, cosines)


def cosine(b: Array, normal: Array) -> Array:
    """Return |cos| of the angle between each b (N, 3) and the normal, of any lengths."""
    b, normal = b.astype(np.longdouble), normal.astype(np.longdouble)
    return np.asarray(np.abs(b @ normal) / np.sqrt((b * b).sum(1) * (normal @ normal)))


def sine2(b: Array, normal: Array) -> Array:
    """Return sin² of the angle between each b (N, 3) and the normal, of any lengths."""
    b, normal = b.astype(np.longdouble), normal.astype(np.longdouble)
    return np.asarray((np.cross(normal, b) ** 2).sum(1) / ((b * b).sum(1) * (normal @ normal)))


@functools.cache
def air(count: int) -> Layers:
    """Return the air above a hot road: n_j = TOP − j MIRAGE/count, steps of 3e-8 for a thousand layers."""
    j, top, step = np.arange(count + 1).astype(np.longdouble), np.longdouble(TOP), np.longdouble(MIRAGE) / count
    index = top - j * step
    return Layers(index, j * step * (2 * top - j * step) / index**2, step * (index[:-1] + index[1:]) / index[1:] ** 2)


def exact_ratios(count: int) -> Layers:
    """Return layers with n_j/n_(j+1) = 1 + 2⁻²³, which is exact in float32: the inputs have no errors."""
    growth = np.arange(count + 1) * np.log1p(np.longdouble(EXACT_RATIO))
    step = np.longdouble(EXACT_RATIO) * (2 + np.longdouble(EXACT_RATIO))
    return Layers(TOP * np.exp(-growth), np.expm1(2 * growth), np.full(count, step), exact=True)


# The light pipe ------------------------------------------------------------------------------------------------


def frame(precision: type) -> Array:
    """Return three rows in `precision` that are exactly orthogonal, and unit up to half an ulp."""
    return np.longdouble(precision(1) / precision(3)) * np.array([[1, 2, 2], [2, 1, -2], [2, -2, 1]], np.longdouble)


@seeds.cached
def pipe(reflections: int, rays: int, index: float, precision: type) -> tuple[Array, Chain, Array]:
    """Return (a, chain, exact final direction) of rays in a square pipe whose axes are the rows of `frame`.

    The pipe is along axis 2. In the unfolded pipe the ray is straight and meets the walls of a pair at equal distances:
    each reflection only changes the sign of one component.
    """
    rng, axes = np.random.default_rng(seeds.current(SEED)), frame(precision)
    across = rng.uniform(0.05, 0.6, (rays, 2)) * rng.choice([-1, 1], (rays, 2))
    local = np.column_stack([across, np.sqrt(1 - (across**2).sum(1))])
    a: Array = (local @ axes).astype(precision)
    components = a.astype(np.longdouble) @ axes[:2].T
    distances = (np.arange(reflections) + 0.5)[None, :, None] / np.abs(components)[:, None, :]
    order = np.argsort(distances.reshape(rays, -1), axis=1)[:, :reflections] % 2
    earlier = np.where(order == 1, np.cumsum(order == 1, axis=1), np.cumsum(order == 0, axis=1)) - 1
    outward = np.sign(np.take_along_axis(components, order, axis=1)) * (-1.0) ** earlier
    chain = Chain(outward[..., None] * axes[order], np.full(2 * reflections, index), turns=False)
    times = np.stack([(order == wall).sum(1) for wall in (0, 1)], axis=1)
    flipped = np.where(times % 2 == 1, 2 * components, 0) / (axes[:2] ** 2).sum(1)
    return a, chain, a - flipped @ axes[:2]

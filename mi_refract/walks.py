"""The loop behind `planar.trace`: from boundary to boundary, by Snell's law at each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import drjit as dr
import numpy as np

from .crossings import NOWHERE, Hit, Ray, Straight, cross
from .formulas import FORMULAS, refract_2d
from .fresnel import powers, refracted_cosine
from .lanes import Lanes, negated
from .numerics import quotient

REFLECT_BITS = 32


class Event(IntEnum):
    """What became of a ray at a boundary, and how its path ended."""

    NONE = 0  # after the end
    REFRACTED = 1
    REFLECTED = 2
    ESCAPED = 3  # no boundary left to meet
    EXHAUSTED = 4  # `max_depth` boundaries met, and another one ahead
    CONTRADICTED = 5  # met a boundary whose near side is not the ray's medium


@dataclass
class Walk:
    """Of a lane: its ray, the index of its medium (NaN: unknown), its share of the power, boundaries met."""

    ray: Ray
    index: Any
    power: Any
    depth: Any
    active: Any


class Walker:
    """Rays between `boundaries` with media of index (left, right)."""

    def __init__(self, to: Lanes, boundaries: Straight, media: Any, formula: str | None) -> None:
        self.to, self.boundaries, self.media = to, boundaries, to.table(media)
        self.refract = _refraction(to, formula)

    def __call__(self, rays: Any, bits: Any, max_depth: int, weights: bool) -> dict[str, Any]:
        """What `planar.Paths` holds, depth × N or 2 × depth × N; `rays`: N × (origin, direction, index)."""
        to, count = self.to, len(rays)
        inputs = [to.table(column) for column in (*rays.T, bits)]
        legs = max_depth + 1
        self.buffers = {
            "place": to.buffer(to.number, np.nan, 2 * max_depth * count),
            "direction": to.buffer(to.number, np.nan, 2 * count),
            "hit": to.buffer(to.signed, -1, max_depth * count),
            "event": to.buffer(to.byte, int(Event.NONE), legs * count),
            "index": to.buffer(to.number, np.nan, legs * count),
        }
        if weights:
            self.buffers["power"] = to.buffer(to.number, np.nan, legs * count)

        def work(lane: Any, put: Callable[..., None]) -> None:
            x, y, dx, dy, index, mirrored = (to.take(table, lane) for table in inputs)
            walk = self._start(to.vector(x, y), to.vector(dx, dy), index)
            self._follow(walk, mirrored, max_depth, put, weights)

        to.run(count, self.buffers, work)
        shapes = {"place": (2, max_depth, count), "direction": (2, 1, count), "hit": (max_depth, count)}
        return {name: to.numpy(b).reshape(shapes.get(name, (legs, count))) for name, b in self.buffers.items()}

    def _start(self, p: Any, d: Any, index: Any) -> Walk:
        to = self.to
        slack = 4 * to.roundoff * (dr.abs(p.x) + dr.abs(p.y))
        ray = Ray(p, _unit(d), to.index(NOWHERE), to.number(0.5), to.number(0.5), to.mask(False), slack)
        return Walk(ray, index, to.number(1), to.index(0), to.mask(True))

    def _follow(self, walk: Walk, mirrored: Any, max_depth: int, put: Callable[..., None], weights: bool) -> None:
        def step(walk: Walk) -> tuple[Walk]:
            return (self._step(walk, mirrored, max_depth, put, weights),)

        (end,) = dr.while_loop((walk,), lambda walk: walk.active, step, label="planar")
        put("direction", 0, end.ray.d, True)

    def _step(self, walk: Walk, mirrored: Any, max_depth: int, put: Callable[..., None], weights: bool) -> Walk:
        """One leg: to the next boundary, and off it."""
        to, ray, j, active = self.to, walk.ray, walk.depth, walk.active
        hit = self.nearest(ray, active)
        some = active & (hit.segment != NOWHERE)
        media = to.take(self.media, hit.segment, some)
        near, far = dr.select(hit.to_left, media[1], media[0]), dr.select(hit.to_left, media[0], media[1])
        index = dr.select(some & dr.isnan(walk.index), near, walk.index)
        p, e = self.boundaries.place(hit)
        l = _unit(e)  # noqa: E741 (the document's name)
        d, transmitted = self.refract(ray.d, l, quotient(near, far))
        forced = (j < REFLECT_BITS) & ((mirrored >> dr.minimum(j, REFLECT_BITS - 1)) & 1 == 1)
        d = dr.select(forced & transmitted, _mirrored(ray.d, l), d)
        through = transmitted & negated(forced)

        event = dr.select(through, int(Event.REFRACTED), int(Event.REFLECTED))
        event = dr.select(near == index, event, int(Event.CONTRADICTED))
        event = dr.select(j < max_depth, event, int(Event.EXHAUSTED))
        event = dr.select(some, event, int(Event.ESCAPED))
        met = some & (j < max_depth)
        put("event", j, event, active)
        put("index", j, index, active)
        put("place", j, p, met)
        put("hit", j, hit.segment, met)
        power = walk.power
        if weights:
            put("power", j, power, active)
            power = power * _share(ray.d, l, quotient(near, far), through)
        on = met & (near == index)
        after = Ray(p, _unit(d), hit.segment, hit.s, hit.r, hit.to_left == through, to.number(0))
        index = dr.select(through, far, index)
        return Walk(dr.select(on, after, ray), index, power, j + 1, on)

    def nearest(self, ray: Ray, active: Any) -> Hit:
        """The first boundary ahead, of all."""
        start = self.boundaries.start(ray)

        def test(i: Any, best: Hit) -> tuple[Any, Hit]:
            return i + 1, self.boundaries.nearer(best, ray, start, i)

        first = self.to.index(0), self.boundaries.none()
        _, best = dr.while_loop(first, lambda i, best: active & (i < self.boundaries.count), test, label="boundaries")
        return best


def _unit(v: Any) -> Any:
    return v * quotient(1, dr.norm(v))


def _mirrored(d: Any, l: Any) -> Any:  # noqa: E741
    c = 2 * cross(l, d)
    return type(d)(d.x + c * l.y, d.y - c * l.x)


def _share(d: Any, l: Any, k: Any, through: Any) -> Any:  # noqa: E741
    """Of the power, what goes the way that is taken."""
    cos_i = dr.minimum(dr.abs(cross(l, d)), 1)
    cos_t, transmitted = refracted_cosine(cos_i, k)
    r, t = powers(cos_i, cos_t, transmitted, k)
    return dr.select(through, t, r)


def _refraction(to: Lanes, formula: str | None) -> Callable[..., tuple[Any, Any]]:
    """(d, l, k) → (direction, transmitted): the core of document 004, or a formula by name, in the plane z = 0."""
    if formula is None:

        def planar(d: Any, l: Any, k: Any) -> tuple[Any, Any]:  # noqa: E741
            b, transmitted = refract_2d(d, l, k)
            return to.vector(*b), transmitted

        return planar
    if formula not in FORMULAS:
        raise ValueError(f"formula = {formula!r}: unknown; accepted: {', '.join(FORMULAS)}")

    def spatial(d: Any, l: Any, k: Any) -> tuple[Any, Any]:  # noqa: E741
        zero = 0 * d.x
        b, transmitted = FORMULAS[formula].unchecked(to.vector3(d.x, d.y, zero), to.vector3(-l.y, l.x, zero), k)
        return to.vector(b.x, b.y), transmitted

    return spatial

"""Focal points, cardinal points and spot sizes of the rays that leave a planar scene."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .curves import unit
from .paraxial import LOST, Cardinal, axis
from .path_tree import Branches
from .paths import REFLECT_BITS, Event
from .scene_file import PlanarScene
from .segments import Array
from .tracer import trace

Point = tuple[float, float]
PARALLEL = 1e-9  # sine of the angle between two lines that count as parallel
SYMMETRIC = 1e-3  # sine of the angle by which two rays may differ from mirror images of each other
STEEPEST = math.radians(89)  # largest angle to the mean direction for which there is a spot


@dataclass(frozen=True)
class Plane:
    """A plane through `point`; `degrees`: the direction that is perpendicular to it, 0 along +x."""

    point: Point
    degrees: float = 0.0


def plane(text: str) -> Plane:
    """The plane that the option --plane names: X,Y or X,Y,DEGREES. ValueError for anything else."""
    try:
        x, y, degrees = map(float, f"{text},0".split(",")[: max(3, text.count(",") + 1)])
    except ValueError:
        x = y = degrees = math.nan
    if not all(map(math.isfinite, (x, y, degrees))):
        raise ValueError(f"--plane {text}; expected X,Y or X,Y,DEGREES, finite numbers")
    return Plane((x, y), degrees)


@dataclass(frozen=True)
class Spot:
    """Where the lines of rays meet a plane: their mean, their RMS distance from it, and from the first to the last."""

    centre: Point
    rms: float
    extent: float


@dataclass(frozen=True)
class Spread:
    """Focal points of rays that leave together. Lengths are in the scene's units; None where there is no such point.

    `focus`: the point of least RMS distance from all the rays' lines, `virtual` where it lies behind most of them.
    `spot`: where the rays' mean meets the plane across it in which their RMS distance from their centre, `rms`, is
    smallest; `largest` is the largest such distance. None where a ray is more than 89° off the mean direction.
    `marginal`: where the outermost pair of rays crosses whose paths are mirror images. `paraxial`: where rays of this
    beam would meet that are ever nearer to the axis between these; `cardinal`: the points of the system along it.
    `on_plane`: on a chosen plane; None where there is none, or a ray is more than 89° off its normal.
    """

    rays: int
    focus: Point | None
    virtual: bool
    spot: Point | None = None
    rms: float | None = None
    largest: float | None = None
    marginal: Point | None = None
    paraxial: Point | None = None
    cardinal: Cardinal | None = None
    on_plane: Spot | None = None


def spread(origins: Array, directions: Array) -> Spread:
    """The focus and spot of lines through `origins` along unit `directions` (N × 2, N ≥ 1)."""
    focus = closest_point(origins, directions)
    behind = focus is not None and bool(np.median(((focus - origins) * directions).sum(axis=1)) < 0)
    found = Spread(len(origins), _point(focus), behind)
    if len(origins) > 1 and (spot := _spot(origins, directions)):
        place, offsets = spot
        rms, largest = float(np.sqrt(np.mean(offsets**2))), float(np.abs(offsets).max())
        return replace(found, spot=_point(place), rms=rms, largest=largest)
    return found


def closest_point(origins: Array, directions: Array) -> Array | None:
    """The point of least squared distance from the lines: Σ nᵢ nᵢᵀ p = Σ nᵢ nᵢᵀ oᵢ, nᵢ across the i-th line.

    origins, directions: N × 2, unit directions. None where all are parallel.
    """
    centre = origins.mean(axis=0)
    across = _turned(directions)
    if np.linalg.svd(across, compute_uv=False)[-1] <= PARALLEL * math.sqrt(len(across)) or len(across) < 2:
        return None
    distances = ((origins - centre) * across).sum(axis=1)
    return centre + np.linalg.lstsq(across, distances, rcond=None)[0]


def crossing(origin: Array, direction: Array, other: Array, along: Array) -> Point | None:
    """Where two lines cross; None where they are parallel."""
    sine = _cross(direction, along)
    if abs(sine) <= PARALLEL:
        return None
    return _point(origin + direction * (_cross(other - origin, along) / sine))


def spot(origins: Array, directions: Array, plane: Plane) -> Spot | None:
    """Where lines through `origins` along unit `directions` (N × 2) meet a plane; None for one 89° off its normal."""
    normal = np.array(unit(plane.degrees))
    forward = directions @ normal
    if np.abs(forward).min() < math.cos(STEEPEST):
        return None
    places = origins + directions * ((plane.point - origins) @ normal / forward)[:, None]
    heights = (places - plane.point) @ _turned(normal)
    x, y = places.mean(axis=0).tolist()
    return Spot((x, y), float(heights.std()), float(np.ptp(heights)))


def _spot(origins: Array, directions: Array) -> tuple[Array, Array] | None:
    """The centre of the smallest RMS spot, and each ray's signed distance from it in the plane of the spot."""
    mean = directions.mean(axis=0)
    length = math.hypot(*mean)
    if length == 0 or (forward := directions @ mean / length).min() < math.cos(STEEPEST):
        return None
    axis, across = mean / length, _turned(mean / length)
    slopes = directions @ across / forward
    lean = slopes - slopes.mean()
    centre = origins.mean(axis=0)

    def heights() -> Array:
        arms = origins - centre
        return arms @ across - slopes * (arms @ axis)

    if np.ptp(slopes) > PARALLEL:
        for _ in range(2):  # again from near the spot, where differences lose no digits
            y = heights()
            # var(y + s slope) is least at s = −cov(y, slope)/var(slope)
            centre = centre + across * y.mean() - axis * (y @ lean / (lean @ lean))
    y = heights()
    return centre + across * y.mean(), y - y.mean()


# Of a scene ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Group:
    """Rays of one colour, beam and set of partial reflections (`reflect`, bits) that met a boundary and escaped."""

    colour: str
    beam: int
    reflect: int
    spread: Spread


def groups(scene: PlanarScene, traced: Sequence[Branches], plane: Plane | None = None) -> list[Group]:
    """The escaped rays, grouped by colour, beam and partial reflections, on whatever side of a shape they leave."""
    return [
        Group(scene.colours[colour], beam, reflect, _of_group(scene, colour, branches, np.flatnonzero(inside), plane))
        for colour, branches in enumerate(traced)
        for beam in range(int(scene.beams.max()) + 1)
        for reflect in np.unique(branches.reflect).tolist()
        if (inside := _members(scene, branches, beam, reflect)).any()
    ]


def _members(scene: PlanarScene, branches: Branches, beam: int, reflect: int) -> NDArray[np.bool_]:
    escaped = (branches.end == Event.ESCAPED) & (branches.last > 0)
    return escaped & (scene.beams[branches.rays] == beam) & (branches.reflect == reflect)


def _of_group(
    scene: PlanarScene, colour: int, branches: Branches, members: NDArray[np.intp], plane: Plane | None
) -> Spread:
    origins, directions = branches.tips[members], branches.paths.directions[members]
    directions = directions / np.hypot(*directions.T)[:, None]  # float32 is not unit to the last bit
    found = spread(origins, directions)
    if plane is not None:
        found = replace(found, on_plane=spot(origins, directions, plane))
    pairs = list(_pairs(scene, branches.rays[members], directions))
    if not pairs:
        return found
    i, j = pairs[0]
    outer = crossing(origins[i], directions[i], origins[j], directions[j])
    return replace(found, marginal=outer, **_along_axis(scene, colour, branches, *members[list(pairs[-1])]))


def _along_axis(scene: PlanarScene, colour: int, branches: Branches, one: int, other: int) -> dict[str, Any]:
    """The paraxial image and the cardinal points of the axis midway between two paths, if its events are theirs."""
    pair = branches.rays[[one, other]]
    origin, way = scene.origins[pair].mean(axis=0), scene.directions[pair].mean(axis=0)
    if not way.any():
        return {}
    reflect = int(branches.reflect[one])
    paths = trace(scene.segments[colour], [origin], [way], scene.max_depth, reflect=reflect, weights=True)
    along = axis(scene.segments[colour], paths, 0)
    if along is None or (paths.events[0] != branches.paths.events[one]).any():
        return {}
    d, (x, y) = scene.directions[pair[0]], scene.origins[pair[0]] - along.places[0]
    u = along.directions[0]
    slope = _cross(u, d) / (u @ d)
    slope = slope if abs(slope) > LOST else 0.0
    height = _cross(u, np.array([x, y])) - slope * (u @ [x, y])
    return {"paraxial": along.image(height, slope), "cardinal": along.cardinal()}


def _pairs(scene: PlanarScene, rays: NDArray[np.intp], directions: Array) -> Iterator[tuple[int, int]]:
    """Pairs of mirror images, from the outermost inward: equally far from the beam's ends, oppositely deflected."""
    beam = np.flatnonzero(scene.beams == scene.beams[rays[0]])
    known = {ray: i for i, ray in enumerate(rays.tolist())}
    deflection = _cross(scene.directions[rays], directions)
    for one, other in zip(beam[: len(beam) // 2].tolist(), beam[::-1].tolist(), strict=False):
        if one in known and other in known:
            i, j = known[one], known[other]
            if abs(deflection[i] + deflection[j]) < SYMMETRIC:
                yield i, j


def table(found: Sequence[Group]) -> str:
    """Tables in plain text, one line per group: focal points, and where there are any cardinal points and spots."""
    heads = "focus", "spot at", "rms", "largest", "marginal", "paraxial"
    parts = [_aligned(found, ("rays", *heads), _foci)]
    if any(group.spread.cardinal for group in found):
        lengths = "focal length", "back focal length", "front focal length"
        parts.append(_aligned(found, (*lengths, "front principal point", "back one"), _cardinal))
    if any(group.spread.on_plane for group in found):
        parts.append(_aligned(found, ("on the plane at", "rms", "extent"), _on_plane))
    return "\n".join(parts)


def _aligned(found: Sequence[Group], heads: Sequence[str], cells: Callable[[Spread], Sequence[str]]) -> str:
    lines = [("colour", "beam", "reflected at", *heads), *((*_names(group), *cells(group.spread)) for group in found)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    return "\n".join("  ".join(f"{c:{w}}" for c, w in zip(line, widths, strict=True)).rstrip() for line in lines)


def _names(group: Group) -> tuple[str, str, str]:
    bits = ", ".join(str(j) for j in range(REFLECT_BITS) if group.reflect >> j & 1)
    return group.colour or "–", str(group.beam), bits or "–"


def _foci(s: Spread) -> tuple[str, ...]:
    focus = _text(s.focus) + (" (virtual)" if s.virtual else "")
    return str(s.rays), focus, *map(_text, (s.spot, s.rms, s.largest, s.marginal, s.paraxial))


def _cardinal(s: Spread) -> tuple[str, ...]:
    c = s.cardinal
    if c is None or c.principal is None:
        return "infinite" if c else "–", *"––––"
    lengths = c.focal_length, c.back_focal_length, c.front_focal_length
    return *map(_text, lengths), *map(_text, c.principal)


def _on_plane(s: Spread) -> tuple[str, ...]:
    spot = s.on_plane
    return (_text(spot.centre), _text(spot.rms), _text(spot.extent)) if spot else ("–",) * 3


def _text(value: Point | float | None) -> str:
    if value is None:
        return "–"
    if isinstance(value, tuple):  # 0 up to roundoff is 0
        return ", ".join(_text(x if abs(x) > 1e-12 * max(map(abs, value)) else 0.0) for x in value)
    return f"{value:.6g}"


def _turned(v: Array) -> Array:
    return np.stack([-v[..., 1], v[..., 0]], axis=-1)


def _cross(a: Array, b: Array) -> Any:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _point(p: Array | None) -> Point | None:
    return None if p is None else (float(p[0]), float(p[1]))

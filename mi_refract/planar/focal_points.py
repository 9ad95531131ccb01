"""Focal points, cardinal points and spot sizes of the rays that leave a planar scene."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .curves import unit
from .paraxial import LOST, Cardinal, axis
from .path_tree import Branches
from .scene_file import PlanarScene
from .segments import REFLECT_BITS, Array, Event
from .tracer import trace

Point = tuple[float, float]
Cells = tuple[str, ...]
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
    result = Spread(len(origins), _point(focus), behind)
    if len(origins) > 1 and (spot := _spot(origins, directions)):
        place, offsets = spot
        rms, largest = float(np.sqrt(np.mean(offsets**2))), float(np.abs(offsets).max())
        return replace(result, spot=_point(place), rms=rms, largest=largest)
    return result


def closest_point(origins: Array, directions: Array) -> Array | None:
    """The point of least squared distance from the lines: Σ nᵢ nᵢᵀ p = Σ nᵢ nᵢᵀ oᵢ, nᵢ across the i-th line.

    origins, directions: N × 2, unit directions. None where all are parallel.
    """
    centre = origins.mean(axis=0)
    across = _turned(directions)
    if np.linalg.svd(across, compute_uv=False)[-1] <= PARALLEL * math.sqrt(len(across)) or len(across) < 2:
        return None
    distances = ((origins - centre) * across).sum(axis=1)
    return np.asarray(centre + np.linalg.lstsq(across, distances, rcond=None)[0])


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
    for last in (False, False, True):  # again from near the spot, where differences lose no digits
        arms = origins - centre
        y = arms @ across - slopes * (arms @ axis)
        if not last and np.ptp(slopes) > PARALLEL:
            # var(y + s slope) is least at s = −cov(y, slope)/var(slope)
            centre = centre + across * y.mean() - axis * (y @ lean / (lean @ lean))
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
    result = []
    for colour, branches in enumerate(traced):
        escaped = (branches.end == Event.ESCAPED) & (branches.last > 0)
        for beam in range(int(scene.beams.max()) + 1):
            for reflect in np.unique(branches.reflect).tolist():
                members = escaped & (scene.beams[branches.rays] == beam) & (branches.reflect == reflect)
                if members.any():
                    spread = _of_group(scene, colour, branches, np.flatnonzero(members), plane)
                    result.append(Group(scene.colours[colour], beam, reflect, spread))
    return result


def _of_group(
    scene: PlanarScene, colour: int, branches: Branches, members: NDArray[np.intp], plane: Plane | None
) -> Spread:
    origins, directions = branches.tips[members], branches.paths.directions[members]
    directions = directions / np.hypot(*directions.T)[:, None]  # float32 is not unit to the last bit
    result = spread(origins, directions)
    if plane is not None:
        result = replace(result, on_plane=spot(origins, directions, plane))
    pairs = list(_pairs(scene, branches.rays[members], directions))
    if not pairs:
        return result
    i, j = pairs[0]
    # Where the outermost pair crosses, if it does.
    sine, marginal = _cross(directions[i], directions[j]), None
    if abs(sine) > PARALLEL:
        marginal = _point(origins[i] + directions[i] * (_cross(origins[j] - origins[i], directions[j]) / sine))
    return replace(result, marginal=marginal, **_along_axis(scene, colour, branches, *members[list(pairs[-1])]))


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


def table(groups: Sequence[Group]) -> str:
    """Tables in plain text, one line per group: focal points, and where there are any cardinal points and spots."""
    names = []
    for group in groups:
        bits = ", ".join(str(j) for j in range(REFLECT_BITS) if group.reflect >> j & 1)
        names.append((group.colour or "–", str(group.beam), bits or "–"))
    spreads = [group.spread for group in groups]
    foci: list[Cells] = []
    cardinals: list[Cells] = []
    spots: list[Cells] = []
    for s in spreads:
        focus = _text(s.focus) + (" (virtual)" if s.virtual else "")
        foci.append((str(s.rays), focus, *_texts(s.spot, s.rms, s.largest, s.marginal, s.paraxial)))
        c, on_plane = s.cardinal, s.on_plane
        if c is None or c.principal is None:
            cardinals.append(("infinite" if c else "–", *"––––"))
        else:
            cardinals.append(_texts(c.focal_length, c.back_focal_length, c.front_focal_length, *c.principal))
        spots.append(_texts(on_plane.centre, on_plane.rms, on_plane.extent) if on_plane else ("–",) * 3)
    parts: list[tuple[Cells, list[Cells]]] = [
        (("rays", "focus", "spot at", "rms", "largest", "marginal", "paraxial"), foci)
    ]
    if any(s.cardinal for s in spreads):
        lengths = "focal length", "back focal length", "front focal length"
        parts.append(((*lengths, "front principal point", "back one"), cardinals))
    if any(s.on_plane for s in spreads):
        parts.append((("on the plane at", "rms", "extent"), spots))
    text = []
    for heads, rows in parts:
        lines = [("colour", "beam", "reflected at", *heads), *((*a, *b) for a, b in zip(names, rows, strict=True))]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        text += ["  ".join(f"{c:{w}}" for c, w in zip(line, widths, strict=True)).rstrip() for line in lines]
    return "\n".join(text)


def _texts(*values: Point | float | None) -> Cells:
    return tuple(map(_text, values))


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

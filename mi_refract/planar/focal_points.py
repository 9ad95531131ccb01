"""Focal points, cardinal points and spot sizes of the rays that leave a planar scene.

The paraxial limit along an axis is the 2 × 2 matrix of the boundaries that it meets. A ray near the axis is h to the
left of it and turned by φ. Over a length L, and at a boundary of curvature κ,

    h' = h + L φ,    φ' = φ        and        h' = h d'_n/d_n,    φ' = g φ − (1 − g) κ h/d_n,    g = n d_n/(n' d'_n)

where d and d' are the axis' directions before and behind, d_n is normal to the boundary, and g = −1 for a reflection.
At normal incidence that is the matrix of textbooks; of an oblique axis it gives the tangential focus (Coddington).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .curves import unit
from .path_tree import Branches
from .scene_file import PlanarScene
from .segments import REFLECT_BITS, Array, Event, Paths, Segments
from .tracer import trace

Point = tuple[float, float]
Cells = tuple[str, ...]
LOST = 2.0**-44  # share of its terms up to which a sum is 0 but for rounding, of some hundred roundings
GRAZING = 1e-6  # smallest cosine for which there is a limit
PARALLEL = 1e-9  # sine of the angle between two lines that count as parallel
SYMMETRIC = 1e-3  # sine of the angle by which two rays may differ from mirror images of each other
SHARP = 0.25
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
class Cardinal:
    """Cardinal points of a system. Lengths are in the scene's units, along the axis, negative against the ray.

    `afocal`: the focal length is infinite, and there are none of the others. `focal_length`: effective, from the back
    principal point to the back focus. `back_focal_length`: from the last boundary to the back focus, where rays
    parallel to the axis meet. `front_focal_length`: from the first boundary to the front focus, from which rays leave
    parallel to the axis. `principal`: the front and the back principal point, through which the principal planes go.
    """

    afocal: bool
    focal_length: float | None = None
    back_focal_length: float | None = None
    front_focal_length: float | None = None
    back_focus: Point | None = None
    front_focus: Point | None = None
    principal: tuple[Point, Point] | None = None


@dataclass(frozen=True)
class Spread:
    """Focal points of rays that leave together. Lengths are in the scene's units; None where there is no such point.

    `focus`: the point of least RMS distance from all the rays' lines, `virtual` where it lies behind most of them.
    `spot`: where the rays' mean meets the plane across it in which their RMS distance from their centre, `rms`, is
    smallest; `largest` is the largest such distance. None where a ray is more than 89° off the mean direction.
    `marginal`: where the outermost pair of rays crosses whose paths are mirror images. `paraxial`: where rays of this
    beam would meet that are ever nearer to the axis between these; `cardinal`: the points of the system along it.
    `aperture`: the numerical aperture behind, n sin θ of the outermost of these pairs to either side of the axis.
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
    aperture: float | None = None
    on_plane: Spot | None = None


def spread(origins: Array, directions: Array) -> Spread:
    """The focus and spot of lines through `origins` along unit `directions` (N × 2, N ≥ 1)."""
    focus = closest_point(origins, directions)
    behind = focus is not None and bool(np.median(((focus - origins) * directions).sum(axis=1)) < 0)
    result = Spread(len(origins), _point(focus), behind)
    mean = directions.mean(axis=0)
    length = math.hypot(*mean)
    if len(origins) < 2 or length == 0 or (forward := directions @ mean / length).min() < math.cos(STEEPEST):
        return result
    # The centre of the smallest RMS spot, and each ray's signed distance from it in the plane of the spot.
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
    place, offsets = centre + across * y.mean(), y - y.mean()
    rms, largest = float(np.sqrt(np.mean(offsets**2))), float(np.abs(offsets).max())
    return replace(result, spot=_point(place), rms=rms, largest=largest)


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


# The paraxial limit --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Axis:
    """A path along an axis: its boundaries' places (K × 2), its directions before, between and behind (K + 1 × 2).

    matrix: from the first boundary to behind the last. size: the same sums of the magnitudes of their terms.
    """

    places: Array
    directions: Array
    matrix: Array
    size: Array

    def cardinal(self) -> Cardinal:
        """The cardinal points."""
        (a, _), (c, d) = self.matrix
        if abs(c) <= LOST * self.size[1, 0]:
            return Cardinal(afocal=True)
        focal, back, front = float(-1 / c), float(-a / c), float(d / c)
        # |matrix| = n/n' for the media before and behind: what the focal length is to the front, over that to the back.
        before, behind = front + focal * np.linalg.det(self.matrix), back - focal
        back_focus, second = (_along(self.places[-1], self.directions[-1], way) for way in (back, behind))
        front_focus, first = (_along(self.places[0], self.directions[0], way) for way in (front, before))
        return Cardinal(False, focal, back, front, back_focus, front_focus, (first, second))

    def image(self, h: float, phi: float) -> Point | None:
        """Where rays (h, φ) at the first boundary, and multiples of it, meet; None where they leave parallel."""
        pencil = np.array([h, phi])
        height, turn = self.matrix @ pencil
        lost = abs(turn) <= LOST * (self.size @ np.abs(pencil))[1]
        return None if lost else _along(self.places[-1], self.directions[-1], -height / turn)


def _along(place: Array, direction: Array, way: float) -> Point:
    """A place on the axis; a coordinate that is 0 but for rounding is 0."""
    x, y = np.where(np.abs(point := place + way * direction) > LOST * (np.abs(place).max() + abs(way)), point, 0.0)
    return float(x), float(y)


def axis(segments: Segments, paths: Paths, i: int) -> Axis | None:
    """The i-th of some paths, with indices, as an axis; None for one that meets nothing, ends inside, or grazes."""
    hits = paths.hits[i, paths.hits[i] >= 0]
    if not len(hits) or paths.events[i, len(hits)] != Event.ESCAPED or paths.indices is None:
        return None
    points, n = paths.points[i, : len(hits) + 1], paths.indices[i]
    legs = np.concatenate([np.diff(points, axis=0), paths.directions[i : i + 1]])
    lengths = np.hypot(*legs.T)
    legs = legs / np.where(lengths > 0, lengths, 1)[:, None]
    matrix = size = np.eye(2)
    for j, hit in enumerate(hits):
        tangent, curvature = _tangent(segments, int(hit), points[j + 1])
        before, behind = (float(tangent[0] * d[1] - tangent[1] * d[0]) for d in (legs[j], legs[j + 1]))
        if min(abs(before), abs(behind)) < GRAZING:
            return None
        g = -1.0 if paths.events[i, j] == Event.REFLECTED else n[j] * before / (n[j + 1] * behind)
        boundary = np.array([[behind / before, 0], [(g - 1) * curvature / before, g]])
        way = np.array([[1, lengths[j] if j else 0], [0, 1]])
        matrix, size = boundary @ way @ matrix, np.abs(boundary) @ way @ size
    # A mirror turns left and right over: the image side is seen as though it were unfolded.
    unfolded = (-1) ** int((paths.events[i, : len(hits)] == Event.REFLECTED).sum())
    return Axis(points[1:], legs, unfolded * matrix, size)


def _tangent(segments: Segments, hit: int, place: Array) -> tuple[Array, float]:
    """The unit direction of a boundary at a place, and by how much it turns to the left in a unit of length."""
    a, c, b = segments.start[hit], segments.control[hit], segments.end[hit]
    w, turn = float(segments.weight[hit]), segments.turn[hit]
    if turn == 0:
        return (b - a) / math.hypot(*(b - a)), 0.0
    # Shares of a, c and b in the place: s², 2w s r and r², up to a factor; from the nearer end no digit is lost.
    of_a, of_b = np.linalg.solve(np.column_stack([a - c, b - c]), place - c)
    of_c = 1 - of_a - of_b
    s, r = (2 * w * of_a, of_c) if of_a >= of_b else (of_c, 2 * w * of_b)
    e = (c - a) * (w * s * s) + (b - a) * (s * r) + (b - c) * (w * r * r)
    length = math.hypot(*e)
    return e / length, float(w * turn * (s * s + 2 * w * s * r + r * r) ** 3 / (2 * length**3))


# Of a scene ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Group:
    """Rays of one colour, beam and set of partial reflections (`reflect`, bits) that met a boundary and escaped."""

    colour: str
    beam: int
    reflect: int
    spread: Spread


def foci(scene: PlanarScene, traced: Sequence[Branches]) -> Array:
    """Where rays that are refracted wherever possible come together (F × 2): real foci, by colour and beam.

    The RMS distance from their centre is there less than SHARP times what it is at their first boundary.
    """
    points = []
    for branches in traced:
        away = (branches.end == Event.ESCAPED) & (branches.last > 0) & (branches.reflect == 0)
        for beam in range(int(scene.beams.max()) + 1):
            own = away & (scene.beams[branches.rays] == beam)
            if own.any():
                origins, directions = branches.tips[own], branches.paths.directions[own]
                found = spread(origins, directions / np.hypot(*directions.T)[:, None])
                wide = math.hypot(*branches.paths.points[own, 1].std(axis=0))
                if found.focus and not found.virtual and found.rms is not None and found.rms < SHARP * wide:
                    points.append(found.focus)
    return np.array(points).reshape(-1, 2)


def groups(scene: PlanarScene, traced: Sequence[Branches], plane: Plane | None = None) -> list[Group]:
    """The escaped rays, grouped by colour, beam and partial reflections, on whatever side of a shape they leave."""
    result = []
    for colour, branches in enumerate(traced):
        escaped = (branches.end == Event.ESCAPED) & (branches.last > 0)
        for beam, reflect in itertools.product(range(int(scene.beams.max()) + 1), np.unique(branches.reflect).tolist()):
            own = np.flatnonzero(escaped & (scene.beams[branches.rays] == beam) & (branches.reflect == reflect))
            if own.size:
                spread = _of_rays(scene, colour, branches, own, plane)
                result.append(Group(scene.light.names[colour], beam, reflect, spread))
    return result


def _of_rays(scene: PlanarScene, colour: int, branches: Branches, own: NDArray[np.intp], plane: Plane | None) -> Spread:
    """The focal points of the paths `own`."""
    origins, directions = branches.tips[own], branches.paths.directions[own]
    directions = directions / np.hypot(*directions.T)[:, None]  # float32 is not unit to the last bit
    result = spread(origins, directions)
    if plane is not None:
        result = replace(result, on_plane=spot(origins, directions, plane))
    # Pairs of mirror images, from the outermost inward: equally far from the beam's ends, oppositely deflected.
    rays = branches.rays[own]
    beam = np.flatnonzero(scene.beams == scene.beams[rays[0]]).tolist()
    known = {ray: i for i, ray in enumerate(rays.tolist())}
    deflection = _cross(scene.directions[rays], directions)
    ends = zip(beam[: len(beam) // 2], beam[::-1], strict=False)
    pairs = [(known[a], known[b]) for a, b in ends if a in known and b in known]
    pairs = [(i, j) for i, j in pairs if abs(deflection[i] + deflection[j]) < SYMMETRIC]
    if not pairs:
        return result
    i, j = pairs[0]
    assert branches.paths.indices is not None
    n = float(branches.paths.indices[own[i], branches.last[own[i]]])
    result = replace(result, aperture=n * math.hypot(*(directions[i] - directions[j])) / 2)
    # Where the outermost pair crosses, if it does.
    sine = _cross(directions[i], directions[j])
    if abs(sine) > PARALLEL:
        marginal = _point(origins[i] + directions[i] * (_cross(origins[j] - origins[i], directions[j]) / sine))
        result = replace(result, marginal=marginal)
    # The axis midway between the innermost pair, if its events are theirs.
    one = own[pairs[-1][0]]
    pair = rays[list(pairs[-1])]
    origin, way = scene.origins[pair].mean(axis=0), scene.directions[pair].mean(axis=0)
    if not way.any():
        return result
    reflect = int(branches.reflect[one])
    paths = trace(scene.segments[colour], [origin], [way], scene.max_depth, reflect=reflect, weights=True)
    along = axis(scene.segments[colour], paths, 0)
    if along is None or (paths.events[0] != branches.paths.events[one]).any():
        return result
    d, apart, u = scene.directions[pair[0]], scene.origins[pair[0]] - along.places[0], along.directions[0]
    slope = _cross(u, d) / (u @ d)
    slope = slope if abs(slope) > LOST else 0.0
    height = _cross(u, apart) - slope * (u @ apart)
    return replace(result, paraxial=along.image(height, slope), cardinal=along.cardinal())


def table(groups: Sequence[Group]) -> str:
    """Tables in plain text, one line per group: focal points, and where there are any cardinal points and spots."""
    names = [("colour", "beam", "reflected at")]
    for group in groups:
        bits = ", ".join(str(j) for j in range(REFLECT_BITS) if group.reflect >> j & 1)
        names.append((group.colour or "–", str(group.beam), bits or "–"))
    foci: list[Cells] = [("rays", "focus", "spot at", "rms", "largest", "marginal", "paraxial", "NA")]
    lengths = "focal length", "back focal length", "front focal length"
    cardinals: list[Cells] = [(*lengths, "front principal point", "back principal point")]
    spots: list[Cells] = [("on the plane at", "rms", "extent")]
    for s in (group.spread for group in groups):
        focus = _text(s.focus) + (" (virtual)" if s.virtual else "")
        foci.append((str(s.rays), focus, *map(_text, (s.spot, s.rms, s.largest, s.marginal, s.paraxial, s.aperture))))
        c, on_plane = s.cardinal or Cardinal(False), s.on_plane
        points = c.focal_length, c.back_focal_length, c.front_focal_length, *(c.principal or (None, None))
        cardinals.append(("infinite" if c.afocal else _text(points[0]), *map(_text, points[1:])))
        spots.append(tuple(map(_text, (on_plane.centre, on_plane.rms, on_plane.extent) if on_plane else [None] * 3)))
    parts = [foci]
    parts += [cardinals] if any(group.spread.cardinal for group in groups) else []
    parts += [spots] if any(group.spread.on_plane for group in groups) else []
    text = []
    for rows in parts:
        lines = [(*a, *b) for a, b in zip(names, rows, strict=True)]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        cells = ["  ".join(f"{c:{w}}" for c, w in zip(line, widths, strict=True)).rstrip() for line in lines]
        text.append("\n".join(cells))
    return "\n\n".join(text)


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

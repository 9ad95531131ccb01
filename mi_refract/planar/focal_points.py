"""Focal points, cardinal points and spot sizes of the rays that leave a planar scene.

The paraxial limit along an axis is the product of one 2 × 2 matrix per boundary that the axis meets. A ray near the
axis is at a distance h to the left of it and turned by φ from it. Over a length L, and at a boundary of curvature κ,

    h' = h + L φ,    φ' = φ        and        h' = h d'_n/d_n,    φ' = g φ − (1 − g) κ h/d_n,    g = n d_n/(n' d'_n)

where d and d' are the axis' directions before and behind, d_n is normal to the boundary, and g = −1 for a reflection.
At normal incidence this is the matrix of textbooks; for an oblique axis it gives the tangential focus (Coddington).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_refract.io.text import parse_number

from .curves import unit
from .path_tree import Branches
from .scene_file import PlanarScene
from .segments import REFLECT_BITS, Array, Event, Paths, Segments
from .tracer import trace

Point = tuple[float, float]
Cells = tuple[str, ...]
ROUNDING = 2.0**-44  # a sum below this share of its terms counts as 0: the error of some hundred roundings
GRAZING = 1e-6  # smallest cosine between an axis and a boundary's normal for which there is a paraxial limit
SYMMETRIC = 1e-3  # sine of the angle by which two rays may differ from mirror images of each other
SHARP = 0.25  # largest RMS distance at a real focus, as a share of that at the first boundary
STEEPEST = math.radians(89)  # largest angle to the mean direction for which there is a spot


@dataclass(frozen=True)
class Plane:
    """A plane through `point`; `degrees`: the direction of its normal, 0 along +x."""

    point: Point
    degrees: float = 0.0


def plane(text: str) -> Plane:
    """The plane from the text of the option --plane: X,Y or X,Y,DEGREES. ValueError for anything else."""
    try:
        x, y, degrees = map(parse_number, f"{text},0".split(",")[: max(3, text.count(",") + 1)])
    except ValueError:
        x = y = degrees = math.nan
    if not all(map(math.isfinite, (x, y, degrees))):
        raise ValueError(f"--plane {text}; expected X,Y or X,Y,DEGREES, finite numbers")
    return Plane((x, y), degrees)


@dataclass(frozen=True)
class Spot:
    """Where rays meet a plane: the mean of the points, their RMS distance from it, and the size of the spot."""

    centre: Point
    rms: float
    extent: float


@dataclass(frozen=True)
class Cardinal:
    """Cardinal points of a system. Lengths are in the scene's units, along the axis, negative against the ray.

    `afocal`: the focal length is infinite, and the other fields are None. `focal_length`: effective, from the back
    principal point to the back focus. `back_focal_length`: from the last boundary to the back focus, where rays
    parallel to the axis meet. `front_focal_length`: from the first boundary to the front focus; rays from there leave
    parallel to the axis. `principal`: the front and the back principal point, where the principal planes cut the axis.
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
    """Focal points of a group of rays after their last boundary. Lengths are in the scene's units.

    A field is None where the point does not exist.
    `focus`: the point of least RMS distance from the lines of all rays, `virtual` where it lies behind most of them.
    `spot`: the centre of the smallest spot. Of all planes perpendicular to the mean direction, it lies in the one where
    the RMS distance `rms` of the rays from their centre is smallest; `largest` is the largest of these distances. None
    where a ray is more than 89° off the mean direction.
    `marginal`: the crossing of the outermost pair of rays whose paths are mirror images.
    `paraxial`: the limit of the crossings of such pairs as they approach the axis midway between them.
    `cardinal`: the cardinal points along that axis.
    `aperture`: the numerical aperture n sin θ behind the system, of the outermost pair on either side of the axis.
    `on_plane`: the spot on a given plane; None without a plane, or where a ray is more than 89° off its normal.
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
    virtual = focus is not None and bool(np.median(((focus - origins) * directions).sum(axis=1)) < 0)
    result = Spread(len(origins), _point(focus), virtual)
    mean = directions.mean(axis=0)
    length = math.hypot(*mean)
    if len(origins) < 2 or length == 0:
        return result
    forward = directions @ mean / length
    if forward.min() < math.cos(STEEPEST):
        return result
    # The centre of the smallest RMS spot, and each ray's signed distance from it in the plane of the spot.
    axis, across = mean / length, _turned(mean / length)
    slopes = directions @ across / forward
    relative_slopes = slopes - slopes.mean()
    centre = origins.mean(axis=0)
    for last in (False, False, True):  # repeated from near the spot, where differences lose no digits
        arms = origins - centre
        y = arms @ across - slopes * (arms @ axis)
        if not last and np.ptp(slopes) > _parallel(directions):
            # var(y + s slope) is least at s = −cov(y, slope)/var(slope)
            centre = centre + across * y.mean() - axis * (y @ relative_slopes / (relative_slopes @ relative_slopes))
    spot_centre, offsets = centre + across * y.mean(), y - y.mean()
    rms, largest = float(np.sqrt(np.mean(offsets**2))), float(np.abs(offsets).max())
    return replace(result, spot=_point(spot_centre), rms=rms, largest=largest)


def closest_point(origins: Array, directions: Array) -> Array | None:
    """The point of least squared distance from the lines: Σ nᵢ nᵢᵀ p = Σ nᵢ nᵢᵀ oᵢ, with nᵢ normal to the i-th line.

    origins, directions: N × 2, unit directions. None if all lines are parallel.
    """
    centre = origins.mean(axis=0)
    across = _turned(directions)
    if np.linalg.svd(across, compute_uv=False)[-1] <= _parallel(directions) * math.sqrt(len(across)) or len(across) < 2:
        return None
    distances = ((origins - centre) * across).sum(axis=1)
    return np.asarray(centre + np.linalg.lstsq(across, distances, rcond=None)[0])


def _parallel(directions: Array) -> float:
    """Sine of the angle between two lines that count as parallel: 1e-9, or 16 ε of their directions if that is more."""
    return max(1e-9, 16 * float(np.finfo(directions.dtype).eps))


def spot(origins: Array, directions: Array, plane: Plane) -> Spot | None:
    """Where lines through `origins` along unit `directions` (N × 2) meet a plane.

    None if a line is more than 89° off the plane's normal.
    """
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
    """The path of a ray along an axis.

    places: K × 2, where it meets its boundaries. directions: (K + 1) × 2, before, between and behind them.
    matrix: from the first boundary to behind the last. size: the same matrix with all terms replaced by their
    magnitudes, for estimates of rounding.
    """

    places: Array
    directions: Array
    matrix: Array
    size: Array

    def cardinal(self) -> Cardinal:
        """The cardinal points."""
        (a, _), (c, d) = self.matrix
        if abs(c) <= ROUNDING * self.size[1, 0]:
            return Cardinal(afocal=True)
        focal, back, front = float(-1 / c), float(-a / c), float(d / c)
        # det(matrix) = n/n' for the media before and behind, the ratio of the front focal length to the back one.
        front_principal, back_principal = front + focal * np.linalg.det(self.matrix), back - focal
        back_focus, second = (_along(self.places[-1], self.directions[-1], x) for x in (back, back_principal))
        front_focus, first = (_along(self.places[0], self.directions[0], x) for x in (front, front_principal))
        return Cardinal(False, focal, back, front, back_focus, front_focus, (first, second))

    def image(self, h: float, phi: float) -> Point | None:
        """Where the ray (h, φ) at the first boundary and its multiples meet; None if they leave parallel."""
        ray = np.array([h, phi])
        height, angle = self.matrix @ ray
        parallel = abs(angle) <= ROUNDING * (self.size @ np.abs(ray))[1]
        return None if parallel else _along(self.places[-1], self.directions[-1], -height / angle)


def _along(place: Array, direction: Array, distance: float) -> Point:
    """The point at a distance from a place along a direction; coordinates within rounding of 0 become 0."""
    point = place + distance * direction
    x, y = np.where(np.abs(point) > ROUNDING * (np.abs(place).max() + abs(distance)), point, 0.0)
    return float(x), float(y)


def axis(segments: Segments, paths: Paths, i: int) -> Axis | None:
    """The i-th path as an axis; None if it has no indices, meets nothing, does not escape, or grazes a boundary."""
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
        translation = np.array([[1, lengths[j] if j else 0], [0, 1]])
        matrix, size = boundary @ translation @ matrix, np.abs(boundary) @ translation @ size
    # A mirror exchanges left and right: undo that, as if the image side were unfolded.
    unfolded = (-1) ** int((paths.events[i, : len(hits)] == Event.REFLECTED).sum())
    return Axis(points[1:], legs, unfolded * matrix, size)


def _tangent(segments: Segments, hit: int, place: Array) -> tuple[Array, float]:
    """The unit tangent of a boundary at a place, and its curvature, positive where it turns left."""
    a, c, b = segments.start[hit], segments.control[hit], segments.end[hit]
    w, turn = float(segments.weight[hit]), segments.turn[hit]
    if turn == 0:
        return (b - a) / math.hypot(*(b - a)), 0.0
    # The barycentric weights of a, c and b are s², 2w s r and r², up to a factor. Computed from the nearer end, s and r
    # lose no digits.
    of_a, of_b = np.linalg.solve(np.column_stack([a - c, b - c]), place - c)
    of_c = 1 - of_a - of_b
    s, r = (2 * w * of_a, of_c) if of_a >= of_b else (of_c, 2 * w * of_b)
    e = (c - a) * (w * s * s) + (b - a) * (s * r) + (b - c) * (w * r * r)
    length = math.hypot(*e)
    return e / length, float(w * turn * (s * s + 2 * w * s * r + r * r) ** 3 / (2 * length**3))


# Scenes ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Group:
    """Escaped rays of one colour, beam and set of partial reflections (`reflect`, bits) that met a boundary."""

    colour: str
    beam: int
    reflect: int
    spread: Spread


def foci(scene: PlanarScene, traced: Sequence[Branches]) -> Array:
    """The real foci (F × 2), by colour and beam, of rays without partial reflections.

    A focus counts where the rays' RMS distance from their centre is less than SHARP times that at their first boundary.
    """
    points = []
    for branches in traced:
        escaped = (branches.end == Event.ESCAPED) & (branches.last > 0) & (branches.reflect == 0)
        for beam in range(int(scene.beams.max()) + 1):
            members = escaped & (scene.beams[branches.rays] == beam)
            if members.any():
                origins, directions = branches.tips[members], branches.paths.directions[members]
                result = spread(origins, directions / np.hypot(*directions.T)[:, None])
                first_rms = math.hypot(*branches.paths.points[members, 1].std(axis=0))
                if result.focus and not result.virtual and result.rms is not None and result.rms < SHARP * first_rms:
                    points.append(result.focus)
    return np.array(points).reshape(-1, 2)


def groups(scene: PlanarScene, traced: Sequence[Branches], plane: Plane | None = None) -> list[Group]:
    """The escaped rays, grouped by colour, beam and partial reflections; a group holds all directions of escape."""
    result = []
    for colour, branches in enumerate(traced):
        escaped = (branches.end == Event.ESCAPED) & (branches.last > 0)
        for beam, reflect in itertools.product(range(int(scene.beams.max()) + 1), np.unique(branches.reflect).tolist()):
            members = np.flatnonzero(escaped & (scene.beams[branches.rays] == beam) & (branches.reflect == reflect))
            if members.size:
                spread = _group_spread(scene, colour, branches, members, plane)
                result.append(Group(scene.light.names[colour], beam, reflect, spread))
    return result


def _group_spread(
    scene: PlanarScene, colour: int, branches: Branches, members: NDArray[np.intp], plane: Plane | None
) -> Spread:
    """The focal points of the paths with the numbers `members`."""
    origins, directions = branches.tips[members], branches.paths.directions[members]
    directions = directions / np.hypot(*directions.T)[:, None]  # in float32, they are of length 1 up to rounding only
    result = spread(origins, directions)
    if plane is not None:
        result = replace(result, on_plane=spot(origins, directions, plane))
    # Pairs of mirror images, from the outermost inward: equally far from the beam's ends, oppositely deflected.
    rays = branches.rays[members]
    beam = np.flatnonzero(scene.beams == scene.beams[rays[0]]).tolist()
    position = {ray: i for i, ray in enumerate(rays.tolist())}
    deflection = _cross(scene.directions[rays], directions)
    opposite_rays = zip(beam[: len(beam) // 2], beam[::-1], strict=False)
    pairs = [(position[a], position[b]) for a, b in opposite_rays if a in position and b in position]
    pairs = [(i, j) for i, j in pairs if abs(deflection[i] + deflection[j]) < SYMMETRIC]
    if not pairs:
        return result
    i, j = pairs[0]
    assert branches.paths.indices is not None
    n = float(branches.paths.indices[members[i], branches.last[members[i]]])
    result = replace(result, aperture=n * math.hypot(*(directions[i] - directions[j])) / 2)
    # Where the outermost pair crosses, if it does.
    sine = _cross(directions[i], directions[j])
    if abs(sine) > _parallel(directions):
        marginal = _point(origins[i] + directions[i] * (_cross(origins[j] - origins[i], directions[j]) / sine))
        result = replace(result, marginal=marginal)
    # The axis midway between the innermost pair, if it goes through the same events as the pair.
    path = members[pairs[-1][0]]
    pair = rays[list(pairs[-1])]
    origin, direction = scene.origins[pair].mean(axis=0), scene.directions[pair].mean(axis=0)
    if not direction.any():
        return result
    reflect = int(branches.reflect[path])
    paths = trace(scene.segments[colour], [origin], [direction], scene.max_depth, reflect=reflect, weights=True)
    middle = axis(scene.segments[colour], paths, 0)
    if middle is None or (paths.events[0] != branches.paths.events[path]).any():
        return result
    d, offset, u = scene.directions[pair[0]], scene.origins[pair[0]] - middle.places[0], middle.directions[0]
    slope = _cross(u, d) / (u @ d)
    slope = slope if abs(slope) > ROUNDING else 0.0
    height = _cross(u, offset) - slope * (u @ offset)
    return replace(result, paraxial=middle.image(height, slope), cardinal=middle.cardinal())


def table(groups: Sequence[Group]) -> str:
    """Tables in plain text with one line per group: focal points; cardinal points and spots on a plane if any exist."""
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
    tables = [foci]
    if any(group.spread.cardinal for group in groups):
        tables.append(cardinals)
    if any(group.spread.on_plane for group in groups):
        tables.append(spots)
    text = []
    for rows in tables:
        lines = [(*a, *b) for a, b in zip(names, rows, strict=True)]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        cells = ["  ".join(f"{c:{w}}" for c, w in zip(line, widths, strict=True)).rstrip() for line in lines]
        text.append("\n".join(cells))
    return "\n\n".join(text)


def _text(value: Point | float | None) -> str:
    if value is None:
        return "–"
    if isinstance(value, tuple):  # coordinates within rounding of 0 are shown as 0
        return ", ".join(_text(x if abs(x) > 1e-12 * max(map(abs, value)) else 0.0) for x in value)
    return f"{value:.6g}"


def _turned(v: Array) -> Array:
    return np.stack([-v[..., 1], v[..., 0]], axis=-1)


def _cross(a: Array, b: Array) -> Any:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _point(p: Array | None) -> Point | None:
    return None if p is None else (float(p[0]), float(p[1]))

"""Planar scenes as TOML files: the keys that a file may hold, and the boundaries and rays that it describes.

Each kind of `[[shape]]` and `[[beam]]` is a struct whose fields are the keys.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
from msgspec import Meta, Struct, field
from numpy.typing import NDArray

from mi_refract.io import safe_files
from mi_refract.io.text import printable
from mi_refract.io.typed_table import doc, key_list, parse_toml

from . import shapes
from .curves import Curve, affine, unit
from .light import LONGEST, MOST, SHORTEST, Light, of_wavelengths
from .segments import Array, Segments, check_range
from .shared_boundaries import Indices, Part, boundaries

# Largest values that a file may contain, checked before memory is allocated.
SIZE = 2**24  # bytes of the file
PIECES = 2**22  # pieces of all curves, once for each colour
RAYS = 2**24  # rays of all beams
MOST_BRANCHES = 8  # partial reflections on a path
FARTHEST = 1e100  # coordinate: products of two do not overflow

Positive = Annotated[float, Meta(gt=0)]
Text = Annotated[str, Meta(pattern=r"\S")]
Names = Annotated[list[Text], Meta(min_length=1)]
Point = tuple[float, float]
Points = Annotated[list[Point], Meta(min_length=1)]
Box = tuple[float, float, float, float]
Direction = float | Point
Count = Annotated[int, Meta(ge=1, le=1_000_000)]
Arcs = Annotated[list[float] | None, doc("degrees by which each piece turns left, as an arc; 0: straight")]
Index = Positive | Annotated[list[Positive], Meta(min_length=1)] | Annotated[str, Meta(min_length=1)]


# Shapes -----------------------------------------------------------------------------------------------------------


class Shape(Struct, forbid_unknown_fields=True, tag_field="kind"):
    """The keys that all shapes have."""

    scale: Annotated[float | Point, doc("first, stretch the shape by this factor, or by two along x and y")] = 1.0
    rotate: Annotated[float, doc("then, turn it counter-clockwise, in degrees")] = 0.0
    at: Annotated[Point, doc("then, move its origin to this point")] = (0.0, 0.0)
    facets: Annotated[Count | None, doc("number of chords that replace the arcs of a curve")] = None

    def __post_init__(self) -> None:
        """ValueError for a scale that is 0 or out of range."""
        if not all(1e-100 <= abs(factor) <= 1e100 for factor in np.ravel(self.scale)):
            raise ValueError(f"scale: {self.scale}; expected numbers of size 1e-100 to 1e100")


class Inside(Shape):
    """A shape that lies in a medium."""

    outside: Annotated[Index | None, doc("index around the shape; by default that of the scene")] = None
    within: Annotated[Text | None, doc("instead of `outside`: the name of an earlier shape around this one")] = None


class Solid(Inside, kw_only=True):
    """A closed curve around one medium."""

    n: Annotated[Index, doc('index inside: one for all colours, one for each, or a material such as "SCHOTT:N-BK7"')]
    name: Annotated[Text | None, doc("a name for `within` of later shapes")] = None


class Polygon(Solid, tag="polygon", kw_only=True):
    """A closed chain of straight pieces and arcs of circles."""

    points: Annotated[Points, doc("the corners")]
    arcs: Arcs = None


class Rectangle(Solid, tag="rectangle", kw_only=True):
    """A rectangle around its origin."""

    width: Annotated[Positive, doc("size along x")]
    height: Annotated[Positive, doc("size along y")]


class Prism(Solid, tag="prism", kw_only=True):
    """A triangle with two equal sides, its apex up, its centroid at the origin."""

    side: Annotated[Positive, doc("length of the two equal sides")]
    apex: Annotated[float, Meta(gt=0, lt=180), doc("the angle between the equal sides, in degrees")] = 60.0


class Circle(Solid, tag="circle", kw_only=True):
    """A circle around its origin."""

    radius: Annotated[Positive, doc("radius of the circle")]


class Ellipse(Solid, tag="ellipse", kw_only=True):
    """An ellipse around its origin."""

    radii: Annotated[tuple[Positive, Positive], doc("half axes along x and y")]


class Lens(Solid, tag="lens", kw_only=True):
    """Two conic surfaces z = c r² / (1 + √(1 − (1 + K) c² r²)) on the x axis, with a rim between them."""

    curvature: Annotated[Point | None, doc("c of front and back, positive if the centre lies toward +x")] = None
    R1: Annotated[float | None, doc("radius of curvature of the front, 1/c; 0: flat")] = None
    R2: Annotated[float | None, doc("radius of curvature of the back; R1 and R2 replace `curvature`")] = None
    conic: Annotated[Point, doc("conic constants K of front and back")] = (0.0, 0.0)
    thickness: Annotated[Positive, doc("thickness on the axis")]
    radius: Annotated[Positive | None, doc("half the aperture; by default, where the surfaces meet")] = None
    vertex: Annotated[float, doc("x of the point where the front meets the axis")] = 0.0

    def __post_init__(self) -> None:
        """ValueError unless the curvatures are given in exactly one way."""
        super().__post_init__()
        without_radii = self.curvature is not None
        if (self.R1 is None) != without_radii or (self.R2 is None) != without_radii:
            raise ValueError("curvature, R1, R2; expected either `curvature`, or both R1 and R2")


class EllipseLens(Solid, tag="ellipse_lens", kw_only=True):
    """Focuses rays along x into its origin: an ellipse of eccentricity outside/n (first colour), and a circle."""

    focal_length: Annotated[Positive, doc("distance from the front to the focus")]
    thickness: Annotated[Positive, doc("thickness on the axis")]
    radius: Annotated[Positive, doc("half the aperture")]


class Luneburg(Inside, tag="luneburg", kw_only=True):
    """A ball in concentric layers of index outside × √(2 − (r/radius)²)."""

    radius: Annotated[Positive, doc("radius of the outermost layer")]
    layers: Annotated[int, Meta(ge=1, le=10_000), doc("number of layers")]


class Boundary(Shape, tag="boundary", kw_only=True):
    """An open chain of straight pieces and arcs of circles between two media."""

    points: Annotated[Points, doc("the vertices")]
    arcs: Arcs = None
    n_left: Annotated[Index, doc("index on the left, seen along the boundary")]
    n_right: Annotated[Index, doc("index on the right")]


def _curves(shape: AnyShape, n: dict[str, Indices]) -> list[tuple[Curve, Indices, Indices]]:
    """Curves around the shape's origin, with the indices on their left and right; `n`: indices by key.

    A closed curve runs counter-clockwise: its inside is on the left. For most kinds, the keys of the kind are the
    arguments of the function of the same name in `shapes`.
    """
    outside, kind = n["outside"], type(shape).__struct_config__.tag
    arguments = {key: getattr(shape, key) for key in type(shape).__annotations__}
    match shape:
        case Boundary():
            return [(shapes.polyline(shape.points, shape.arcs), n["n_left"], n["n_right"])]
        case Luneburg():
            layers = shapes.luneburg(**arguments)
            media = [outside, *(tuple(x * ratio for x in outside) for _, ratio in layers)]
            return [(curve, media[j + 1], media[j]) for j, (curve, _) in enumerate(layers)]
        case Ellipse():
            arguments = {"rx": shape.radii[0], "ry": shape.radii[1]}
        case Lens():
            curvatures = [1 / r if r else 0.0 for r in (arguments.pop("R1"), arguments.pop("R2"))]
            arguments["curvature"] = shape.curvature or curvatures
        case EllipseLens():
            arguments["n"] = n["n"][0] / outside[0]
    return [(getattr(shapes, str(kind))(**arguments), n["n"], outside)]


AnyShape = Polygon | Rectangle | Prism | Circle | Ellipse | Lens | EllipseLens | Luneburg | Boundary
# The keys that kinds share: the title of their list, a struct that has them, and one whose keys are in other lists.
SHARED: tuple[tuple[str, type[Struct], type[Struct]], ...] = (
    ("Every [[shape]]", Shape, Struct),
    ("Every [[shape]] but `boundary`", Inside, Shape),
    ("Every [[shape]] but `boundary` and `luneburg`", Solid, Inside),
)

# Beams ------------------------------------------------------------------------------------------------------------


class Beam(Struct, forbid_unknown_fields=True, tag_field="kind"):
    """Rays that are described together."""


class Parallel(Beam, tag="parallel", kw_only=True):
    """Parallel rays from a line."""

    start: Annotated[Point, doc("start of the first ray")] = field(name="from")
    to: Annotated[Point, doc("start of the last ray")]
    direction: Annotated[Direction, doc("direction of all rays: degrees, or [x, y] that is not [0, 0]")]
    count: Annotated[Count, doc("number of rays; a single ray starts in the middle")]


class Fan(Beam, tag="fan", kw_only=True):
    """Rays from a point."""

    at: Annotated[Point, doc("start of all rays")]
    angles: Annotated[Point, doc("directions of the first and of the last ray, in degrees")]
    count: Annotated[Count, doc("number of rays; a single ray has the middle direction")]


class Rays(Beam, tag="rays", kw_only=True):
    """Rays one by one."""

    origins: Annotated[Points, doc("starts of the rays")]
    directions: Annotated[list[Direction], doc("a direction for each start, as for `parallel`")]

    def __post_init__(self) -> None:
        """ValueError for another number of directions than of origins."""
        if len(self.origins) != len(self.directions):
            raise ValueError(f"directions: {len(self.directions)} for {len(self.origins)} origins; expected one each")


AnyBeam = Parallel | Fan | Rays


def spaced(first: Array | float, last: Array | float, count: int) -> Array:
    """`count` evenly spaced values from the first to the last; a single one in the middle. Whole numbers stay exact."""
    if count == 1:
        return np.array([(first + last) / 2])
    steps = np.arange(count).reshape(-1, *[1] * np.ndim(first))
    return np.concatenate([(first + (last - first) * steps / (count - 1))[:-1], [last]])


def _unit_vector(key: str, value: Direction) -> tuple[float, float]:
    """The vector of length 1 for a direction in degrees or as [x, y]."""
    if isinstance(value, float):
        return unit(value)
    size = max(map(abs, value))  # divide by the larger component first: a square could be out of range
    if not size:
        raise ValueError(f"{key}: [0, 0]; expected degrees, or [x, y] that is not [0, 0]")
    x, y = value[0] / size, value[1] / size
    length = math.hypot(x, y)
    return x / length, y / length


# Scenes -----------------------------------------------------------------------------------------------------------

Nanometres = Annotated[float, Meta(ge=SHORTEST, le=LONGEST)]
Wavelengths = Annotated[int, Meta(ge=2, le=MOST)] | Annotated[list[Nanometres], Meta(min_length=1, max_length=MOST)]


class SceneTable(Struct, kw_only=True, forbid_unknown_fields=True):
    """A scene file."""

    title: Annotated[Text | None, doc("title of the figure; by default the file's name")] = None
    index: Annotated[Index, doc("index of the medium around all shapes; values as for `n` of a shape")] = 1.0
    colours: Annotated[Names | None, doc("names of colours that matplotlib knows")] = None
    wavelengths: Annotated[Wavelengths | None, doc("nm, or how many from 380 to 730; replace `colours`")] = None
    light: Annotated[Literal["flat", "D65"], doc("powers of the wavelengths: equal, or those of daylight")] = "flat"
    max_depth: Annotated[int, Meta(ge=1, le=100_000), doc("largest number of boundaries that a ray meets")] = 16
    branches: Annotated[int, Meta(ge=0, le=MOST_BRANCHES), doc("largest number of partial reflections on a path")] = 0
    view: Annotated[Box | None, doc("x0, x1, y0, y1 of the figure; by default it shows all shapes")] = None
    shape: Annotated[list[AnyShape], Meta(min_length=1), doc("[[shape]]: boundaries between media")]
    beam: Annotated[list[AnyBeam], Meta(min_length=1), doc("[[beam]]: rays to follow")]

    def __post_init__(self) -> None:
        """ValueError for an empty view."""
        if self.view and not (self.view[0] < self.view[1] and self.view[2] < self.view[3]):
            raise ValueError(f"view: {list(self.view)}; expected [x0, x1, y0, y1], x0 < x1, y0 < y1")


def reference() -> str:
    """All kinds and keys as text, for `mi-refract trace --keys`."""
    lists = [key_list("A scene:", SceneTable)]
    for title, kind, listed in SHARED:
        lists.append(key_list(f"{title}, beside its kind and the keys of that kind:", kind, listed))
    for table, kinds in (("[[shape]]", AnyShape), ("[[beam]]", AnyBeam)):
        for kind in get_args(kinds):
            summary = (kind.__doc__ or "").partition("\n")[0]
            lists.append(key_list(f'{table} kind = "{kind.__struct_config__.tag}": {summary}', kind, Solid))
    return "\n\n".join(lists)


@dataclass(frozen=True)
class Region:
    """A closed outline (K × 2, counter-clockwise, arcs as short chords) and the index inside, for drawing."""

    outline: Array
    indices: Indices


@dataclass(frozen=True)
class PlanarScene:
    """The content of a scene file, ready for `planar.trace` (once per colour) and for a figure.

    `light`: its colours, one without dispersion.
    `segments`: one `Segments` per colour, with the same geometry and other indices. `shape_names`: for each segment the
    name of its shape, as "shape[0] 'name'". `regions`: in drawing order, inner ones last.
    `index`: of the medium around everything, per colour. `origins`, `directions`: N × 2, directions of length 1;
    `beams`: N, the number of each ray's `[[beam]]`, from 0. `branches`: largest number of partial reflections on a
    path; 0: rays are refracted wherever possible. `view`: x0, x1, y0, y1; None: all shapes. `fans`: for each beam, the
    angles in degrees of the first and last ray if it is a fan, else None.
    """

    path: Path
    title: str
    light: Light
    segments: tuple[Segments, ...]
    shape_names: tuple[str, ...]
    regions: tuple[Region, ...]
    index: Indices
    origins: Array
    directions: Array
    beams: NDArray[np.intp]
    max_depth: int
    branches: int
    view: Box | None
    fans: tuple[tuple[float, float] | None, ...] = ()

    @property
    def file(self) -> str:
        """The file's name, with printable characters only."""
        return printable(self.path.name)

    @property
    def heading(self) -> str:
        """The title on one line, with printable characters only."""
        return printable(" ".join(self.title.split()))


def load(path: str | Path, wavelengths: Sequence[float] | int | None = None) -> PlanarScene:
    """Read a scene file. `wavelengths`: in nm, or their number; they replace those of the file.

    With other wavelengths than the file's, an index must be one number or a material.

    ValueError, one line that names file and key (shapes and beams count from 0), for an invalid scene; OSError for a
    file that cannot be read.
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder; expected a scene file")
    table = parse_toml(safe_files.read_bytes(path, SIZE), SceneTable, str(path))
    are_others = wavelengths not in (None, table.wavelengths)
    if wavelengths is None:
        wavelengths = table.wavelengths
    try:
        if wavelengths is not None and table.colours:
            raise ValueError("colours and wavelengths are both set; expected one of them")
        if wavelengths is None and table.light != "flat":
            raise ValueError(f"light: {table.light!r} without wavelengths; expected `wavelengths` that it weights")
        light = Light(tuple(table.colours or [""])) if wavelengths is None else of_wavelengths(wavelengths, table.light)
        indices = functools.partial(light.indices, find=path.parent.joinpath, only_one=are_others)
        index = indices(table.index, "index")
        parts = _parts(table.shape, index, indices)
        rays, (segments, shapes) = _rays(table.beam), boundaries(parts)
    except ValueError as error:
        raise ValueError(" ".join(f"{path}: {error}".split())) from None
    regions = tuple(Region(part.curve.outline(), part.left) for part in parts if part.curve.closed)
    fans = tuple(beam.angles if isinstance(beam, Fan) else None for beam in table.beam)
    limits = table.max_depth, table.branches, table.view
    return PlanarScene(path, table.title or path.stem, light, segments, shapes, regions, index, *rays, *limits, fans)


def _parts(tables: Sequence[AnyShape], ambient: Indices, indices: Callable[..., Indices]) -> list[Part]:
    """The curves of all shapes, stretched, turned and moved, with the media on their sides."""
    parts: list[Part] = []
    media: dict[str, Indices] = {}
    pieces = 0
    for j, shape in enumerate(tables):
        where = f"shape[{j}]"
        values = {key: getattr(shape, key, None) for key in ("n", "outside", "n_left", "n_right")}
        n = {key: indices(x, f"{where}.{key}") for key, x in values.items() if x is not None}
        if isinstance(shape, Inside) and shape.within is not None:
            if shape.outside is not None:
                raise ValueError(f"{where}.within: {shape.within!r}, but `outside` is set too; expected one of them")
            if shape.within not in media:
                known = ", ".join(map(repr, media)) or "none"
                raise ValueError(f"{where}.within: {shape.within!r}; expected the name of a shape above: {known}")
            n["outside"] = media[shape.within]
        n.setdefault("outside", ambient)
        if isinstance(shape, Solid) and shape.name:
            if shape.name in media:
                raise ValueError(f"{where}.name: {shape.name!r} is the name of another shape; expected a unique name")
            media[shape.name] = n["n"]
        curves = shape.layers if isinstance(shape, Luneburg) else 1
        pieces += curves * max(shape.facets or 4, len(getattr(shape, "points", ()))) * len(ambient)
        if pieces > PIECES:
            limit = f"at most {PIECES} pieces of curves in all shapes together, once for each colour"
            raise ValueError(f"{where}: {pieces} or more pieces; expected {limit}")
        first = len(parts)
        shape_name = f"{where} '{printable(shape.name)}'" if isinstance(shape, Solid) and shape.name else where
        try:
            with np.errstate(all="ignore"):
                for curve, left, right in _curves(shape, n):
                    chords = curve.faceted(shape.facets) if shape.facets else curve
                    matrix = affine(shape.rotate, shape.scale)
                    parts.append(Part(shape_name, chords.mapped(matrix, shape.at), left, right))
        except ValueError as error:
            raise ValueError(f"{where}.{error}") from None
        for part in parts[first:]:
            check_range(where, np.concatenate([part.curve.vertices, part.curve.control]), FARTHEST)
    return parts


def _rays(tables: Sequence[AnyBeam]) -> tuple[Array, Array, NDArray[np.intp]]:
    """Origins and directions of length 1 (N × 2), and the number of each ray's beam."""
    totals = list(itertools.accumulate(len(b.origins) if isinstance(b, Rays) else b.count for b in tables))
    for j, count in enumerate(totals):
        if count > RAYS:
            raise ValueError(f"beam[{j}].count: {count} rays in this beam and those before it; expected up to {RAYS}")
    rays = []
    for j, beam in enumerate(tables):
        try:
            with np.errstate(all="ignore"):
                match beam:
                    case Parallel():
                        origins = spaced(np.array(beam.start), np.array(beam.to), beam.count)
                        directions = np.broadcast_to(_unit_vector("direction", beam.direction), origins.shape)
                    case Fan():
                        origins, angles = np.broadcast_to(beam.at, (beam.count, 2)), spaced(*beam.angles, beam.count)
                        if not np.isfinite(angles).all():
                            raise ValueError(f"angles: {list(beam.angles)}; expected a finite difference")
                        directions = np.array([unit(angle) for angle in angles])
                    case Rays():
                        origins = np.array(beam.origins)
                        directions = np.array([_unit_vector("directions", value) for value in beam.directions])
        except ValueError as error:
            raise ValueError(f"beam[{j}].{error}") from None
        check_range(f"beam[{j}]", origins, FARTHEST)
        rays.append((origins, directions))
    beams = np.repeat(np.arange(len(rays)), np.diff(totals, prepend=0))
    return np.concatenate([o for o, _ in rays]), np.concatenate([d for _, d in rays]), beams

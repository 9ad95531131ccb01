"""Reads planar scenes from TOML files: shapes, their media, and the rays to follow."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_refract.io import regular_file
from mi_refract.io.toml_schema import read, shown

from .curves import affine
from .light import Light, of_names, of_wavelengths
from .scene_schema import BEAMS, SCENE, SHAPES, Part
from .scene_values import Indices, per_colour, read_kind
from .segments import Array, Segments
from .shared_boundaries import Named, boundaries

# Of what a file may ask for, checked before memory is allocated.
SIZE = 2**24  # bytes of the file
PIECES = 2**22  # of all curves, once for each colour
RAYS = 2**24  # of all beams


@dataclass(frozen=True)
class Region:
    """A closed outline (K × 2, counter-clockwise, arcs as short chords) and the index inside, for drawing."""

    outline: Array
    indices: tuple[float, ...]  # one per colour


@dataclass(frozen=True)
class PlanarScene:
    """The content of a scene file, ready for `planar.trace` (once per colour) and for a figure.

    `light`: its colours, one where there is no dispersion.
    `segments`: one per colour, the same geometry with other indices. `regions`: in drawing order, inner ones last.
    `index`: of the medium around everything, per colour. `origins`, `directions`: N × 2, directions of length 1;
    `beams`: N, the number of the `[[beam]]` (from 0) that a ray belongs to. `branches`: the most partial reflections
    on a path; 0: rays are refracted wherever possible. `view`: x0, x1, y0, y1; None: all shapes. `fans`: by beam, the
    angles in degrees of the first and of the last ray of a fan.
    """

    path: Path
    title: str
    light: Light
    segments: tuple[Segments, ...]
    regions: tuple[Region, ...]
    index: tuple[float, ...]
    origins: Array
    directions: Array
    beams: NDArray[np.intp]
    max_depth: int
    branches: int
    view: tuple[float, float, float, float] | None
    fans: tuple[tuple[float, float] | None, ...] = ()

    @property
    def colours(self) -> tuple[str, ...]:
        """Names of the colours; ("",) where there is no dispersion."""
        return self.light.names


def load(path: str | Path, wavelengths: Sequence[float] | int | None = None) -> PlanarScene:
    """Read a scene file. `wavelengths`: in place of those that it names, in nm, or how many.

    ValueError, one line that names file and key (shapes and beams count from 0), for anything that is no scene;
    OSError for a file that cannot be read.
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder; expected a scene file")
    content = regular_file.read_bytes(path, SIZE)
    try:
        return _scene(path, _parsed(content), wavelengths)
    except ValueError as error:
        raise ValueError(" ".join(f"{path}: {error}".split())) from None


def _parsed(content: bytes) -> dict[str, Any]:
    try:
        return tomllib.loads(content.decode())
    except UnicodeDecodeError as error:
        raise ValueError(f"byte {error.start} is not UTF-8; expected TOML") from None
    except RecursionError:
        raise ValueError("brackets nested too deeply; expected TOML") from None
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{error}; expected TOML") from None


def _light(values: dict[str, Any], wavelengths: Sequence[float] | int | None) -> Light:
    asked = values["wavelengths"] if wavelengths is None else wavelengths
    if asked is None:
        return of_names(values["colours"])
    if values["colours"]:
        raise ValueError("colours: beside wavelengths; expected one of them")
    return of_wavelengths(asked, values["light"])


def _scene(path: Path, table: dict[str, Any], wavelengths: Sequence[float] | int | None) -> PlanarScene:
    values = read(table, SCENE)
    light = _light(values, wavelengths)
    values = per_colour(values, SCENE, "", light)
    parts = _parts(values["shape"], values["index"], light)
    origins, directions, beams = _rays(values["beam"])
    regions = tuple(Region(part.curve.outline(), part.left) for _, part in parts if part.curve.closed)
    return PlanarScene(
        path,
        values["title"] or path.stem,
        light,
        boundaries(parts),
        regions,
        values["index"],
        origins,
        directions,
        beams,
        values["max_depth"],
        values["branches"],
        tuple(values["view"]) if values["view"] else None,
        tuple(tuple(table["angles"]) if table.get("kind") == "fan" else None for table in values["beam"]),
    )


FARTHEST = 1e100  # of all coordinates: products of two do not overflow


def _parts(tables: list[dict[str, Any]], ambient: Indices, light: Light) -> list[Named]:
    """The shapes' parts in their places."""
    parts: list[Named] = []
    media: dict[str, Indices] = {}
    pieces = 0
    for j, table in enumerate(tables):
        where = f"shape[{j}]"
        kind, values = read_kind(table, SHAPES, f"{where}.", light)
        values["outside"] = _outside(values, media, where) or ambient
        if values.get("name") in media:
            raise ValueError(f"{where}.name: {shown(values['name'])} is another shape's; expected a new one")
        if values.get("name"):
            media[values["name"]] = values["n"]
        each = max(values.get("facets") or 4, len(values.get("points", ())))
        pieces += values.get("layers", 1) * each * len(light)
        if pieces > PIECES:
            raise ValueError(f"{where}: {pieces} pieces and more; expected {PIECES}, colours times those of all shapes")
        try:
            with np.errstate(all="ignore"):
                placed = _placed(kind.build(values), values)
        except ValueError as error:
            raise ValueError(f"{where}.{error}") from None
        for part in placed:
            _check_range(where, part.curve.vertices, part.curve.control)
            parts.append((where, part))
    return parts


def _outside(values: dict[str, Any], media: dict[str, Indices], where: str) -> Indices | None:
    name = values.get("within")
    if name is None:
        return values.get("outside")
    if values["outside"]:
        raise ValueError(f"{where}.within: {shown(name)}, beside `outside`; expected one of them")
    if name not in media:
        known = ", ".join(map(shown, media)) or "none so far"
        raise ValueError(f"{where}.within: {shown(name)}; expected the name of a shape above: {known}")
    return media[name]


def _placed(parts: list[Part], values: dict[str, Any]) -> list[Part]:
    matrix, facets = affine(values["rotate"], values["scale"]), values.get("facets")
    placed = []
    for part in parts:
        curve = part.curve.faceted(facets) if facets else part.curve
        curve = curve.mapped(matrix, values["at"])
        placed.append(part._replace(curve=curve))
    return placed


def _check_range(where: str, *points: Array) -> None:
    if not all(np.abs(p).max() <= FARTHEST for p in points):
        raise ValueError(f"{where}: coordinates beyond {FARTHEST:g}")


def _rays(tables: list[dict[str, Any]]) -> tuple[Array, Array, NDArray[np.intp]]:
    rays: list[tuple[Array, Array]] = []
    count = 0
    for j, table in enumerate(tables):
        kind, values = read_kind(table, BEAMS, f"beam[{j}].", Light())
        count += values.get("count", 1)
        if count > RAYS:
            raise ValueError(f"beam[{j}].count: {count} rays with the beams before; expected up to {RAYS}")
        try:
            rays.append(kind.build(values))
        except ValueError as error:
            raise ValueError(f"beam[{j}].{error}") from None
        _check_range(f"beam[{j}]", rays[-1][0])
    beams = np.repeat(np.arange(len(rays)), [len(origins) for origins, _ in rays])
    return np.concatenate([o for o, _ in rays]), np.concatenate([d for _, d in rays]), beams

"""Planar scenes in TOML files: shapes, the media between them, and the rays to follow."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .planar import Array, Segments


@dataclass(frozen=True)
class Region:
    """A closed outline (K × 2, counter-clockwise, arcs sampled finely enough to look smooth) and the index inside."""

    outline: Array
    indices: tuple[float, ...]  # one per colour


@dataclass(frozen=True)
class PlanarScene:
    """What a scene file says, ready for `planar.trace` (once per colour) and for a picture.

    `colours`: one entry per wavelength, matplotlib's names of colours; ("",) where there is no dispersion.
    `segments`: one per colour, the same geometry with other indices. `regions`: in drawing order, inner ones later.
    `index`: of the medium around everything, per colour. `origins`, `directions`: N × 2, directions of length 1;
    `beams`: N, the number of the `[[beam]]` (from 0) that a ray belongs to. `branches`: the most partial reflections
    on a path; 0: refracted wherever possible. `view`: x0, x1, y0, y1; None: whatever holds the shapes.
    """

    path: Path
    title: str
    colours: tuple[str, ...]
    segments: tuple[Segments, ...]
    regions: tuple[Region, ...]
    index: tuple[float, ...]
    origins: Array
    directions: Array
    beams: NDArray[np.intp]
    max_depth: int
    branches: int
    view: tuple[float, float, float, float] | None


def load(path: str | Path) -> PlanarScene:
    """Read a scene file. ValueError, one line with file and key, for what it cannot be; OSError for no file."""
    raise NotImplementedError

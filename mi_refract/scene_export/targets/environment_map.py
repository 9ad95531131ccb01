"""An environment as the image another renderer looks it up in: by longitude and latitude of its own convention."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mi_refract.scene_export.plain_scene import Environment

Array = NDArray[np.float64]
Lookup = Callable[[Array, Array], Array]
# The other renderers take texels at their centres, which Mitsuba's rows are not. Between texels a map is linear, and so
# is the finer one between its own, except where a texel of the first lies within one of its cells.
FINER = 16


def radiance(environment: Environment, directions: Array) -> Array:
    """N × 3: what is seen in these directions of the scene, N × 3, of any length but 0."""
    x, y, z = np.moveaxis(directions @ environment.rotation, -1, 0)
    pixels = environment.pixels.astype(float)
    height, width = pixels.shape[:2]
    column = np.arctan2(x, -z) / (2 * np.pi) * width - 0.5
    row = np.arctan2(np.hypot(x, z), y) / np.pi * (height - 1)
    left, top = np.floor(column).astype(int), np.clip(np.floor(row).astype(int), 0, max(height - 2, 0))
    right, bottom = (left + 1) % width, np.minimum(top + 1, height - 1)
    a, b = (column - left)[..., None], (row - top)[..., None]
    upper = (1 - a) * pixels[top, left % width] + a * pixels[top, right]
    lower = (1 - a) * pixels[bottom, left % width] + a * pixels[bottom, right]
    return (1 - b) * upper + b * lower


def longitude_latitude(environment: Environment, direction: Lookup) -> NDArray[np.float32]:
    """H × W × 3. `direction(u, v)` is where the renderer's image holds (u, v) in [0, 1]², v from its top row down."""
    height = FINER * (environment.pixels.shape[0] - 1)
    width = FINER * environment.pixels.shape[1]
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    return radiance(environment, direction(u, v)).astype(np.float32)

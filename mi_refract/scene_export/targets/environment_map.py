"""An environment resampled into another renderer's convention of longitude and latitude."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..plain_scene import Environment

Array = NDArray[np.float64]
Lookup = Callable[[Array, Array], Array]  # (u, v) in [0, 1]², v from the top row down → directions (…, 3)
# Other renderers place texels at their centres, Mitsuba places its first and last row at the poles. Between its texels
# a map is linear. A finer map reproduces that, except in those of its cells that a texel of the first map divides.
FINER = 16


def radiance(environment: Environment, directions: Array) -> Array:
    """(…, 3): the radiance in these directions of the scene (…, 3), of any length but 0."""
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
    """(H, W, 3): the map for a renderer that shows its pixel at (u, v) in `direction(u, v)`."""
    height = FINER * (environment.pixels.shape[0] - 1)
    width = FINER * environment.pixels.shape[1]
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    return radiance(environment, direction(u, v)).astype(np.float32)

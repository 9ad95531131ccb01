"""The environment map of `scenes/balls.xml`: a dim sky with lamps a hundred times as bright.

`python -m validation.renders.lamp_environment` writes it to `scenes/lamps.exr`.
"""

from __future__ import annotations

import numpy as np

from mi_refract.io import image_file
from validation.run.context import SCENES

PATH = SCENES / "lamps.exr"
HEIGHT, WIDTH = 32, 64
LAMPS = 40
SEED = 2026


def pixels() -> np.ndarray:
    """Latitude and longitude, row 0 the zenith: float32 radiance, HEIGHT × WIDTH × 3."""
    rng = np.random.default_rng(SEED)
    height = np.cos(np.pi * (np.arange(HEIGHT) + 0.5) / HEIGHT)[:, None, None]  # 1 at the zenith
    sky = np.array([0.10, 0.13, 0.19]) + np.array([0.02, 0.05, 0.10]) * height
    found = np.repeat(sky, WIDTH, axis=1)
    # Evenly over the sphere; two texels wide at the equator, wider towards the poles.
    for z, column in zip(rng.uniform(-0.95, 0.95, LAMPS), rng.integers(0, WIDTH, LAMPS), strict=True):
        row = int(np.arccos(z) / np.pi * HEIGHT)
        columns = (column + np.arange(round(2 / np.sqrt(1 - z * z)))) % WIDTH
        rows = slice(row, min(row + 2, HEIGHT))
        found[rows, columns] = rng.uniform(4, 12) * (1 - rng.uniform(0, 0.6) * np.array([0, 0.5, 1]))
    return found.astype(np.float32)


if __name__ == "__main__":
    image_file.write_exr(PATH, pixels())

"""Light paths drawn over a rendered image: points are projected as the scene's camera projects them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract.io import image_file
from mi_refract.rendering import scene_files

from .context import SCENES

UPSCALE = 4  # pixels of the drawing per pixel of the render
WHITE, GREEN, CASING = (1.0, 1.0, 1.0), (0.3, 1.0, 0.1), (0.0, 0.0, 0.03)
MARK = 5  # half the size of a mark, in pixels of the drawing


class View:
    """A scene with one plugin, rendered once with seed 0. Perspective camera, square film."""

    def __init__(self, scene: str, plugin: str, parameters: Mapping[str, Any], size: int, spp: int) -> None:
        """Load the scene with the plugin and render it; `size`: pixels on a side."""
        import mitsuba as mi

        path = str(SCENES / f"{scene}.xml")
        self.scene = mi.load_file(path, **scene_files.REPRODUCIBLE, bsdf=plugin, res=size, **parameters)
        self.image = np.array(mi.render(self.scene, spp=spp, seed=0), dtype=np.float64)
        (fov,) = np.ravel(mi.traverse(self.scene.sensors()[0])["x_fov"])
        self.half = math.tan(math.radians(float(fov)) / 2)
        self.to_world = np.array(self.scene.sensors()[0].world_transform().matrix, float).reshape(4, 4)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Image coordinates of points (N × 3), from 0 to 1, y downward; NaN for points behind the camera."""
        x, y, z = np.linalg.inv(self.to_world[:3, :3]) @ (points - self.to_world[:3, 3]).T
        z = np.where(z > 0, z, np.nan)
        return 0.5 - 0.5 * np.stack([x, y], 1) / (self.half * z)[:, None]

    def ray(self, u: float, v: float) -> tuple[np.ndarray, np.ndarray]:
        """Origin and direction of the ray through a point of the image."""
        d = self.to_world[:3, :3] @ [(1 - 2 * u) * self.half, (1 - 2 * v) * self.half, 1.0]
        return self.to_world[:3, 3], d / np.linalg.norm(d)


def draw(view: View, paths: list[np.ndarray], ends: np.ndarray) -> np.ndarray:
    """The image, enlarged; the paths (points N × 3 each) in white between two squares, `ends` as green crosses."""
    import OpenImageIO as oiio

    enlarged = np.kron(view.image, np.ones((UPSCALE, UPSCALE, 1))).astype(np.float32)
    buffer, scale = oiio.ImageBuf(np.ascontiguousarray(enlarged)), enlarged.shape[0]

    def polyline(points: np.ndarray, colour: tuple[float, ...]) -> None:
        strokes = [*((x, y, CASING) for x in (-1, 0, 1) for y in (-1, 0, 1)), (0, 0, colour)]
        for x, y, ink in strokes:
            corners = (np.rint(points).astype(int) + np.array([x, y])).tolist()
            for (x1, y1), (x2, y2) in itertools.pairwise(corners):
                oiio.ImageBufAlgo.render_line(buffer, x1, y1, x2, y2, ink)

    square = MARK * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    for points in paths:
        seen = view.project(points) * scale
        seen = seen[np.isfinite(seen).all(1)]
        for stroke in (seen, seen[0] + square, seen[-1] + square):
            polyline(stroke, WHITE)
    for p in view.project(ends) * scale:
        polyline(p + 1.6 * MARK * np.array([[-1, -1], [1, 1], [0, 0], [-1, 1], [1, -1]]), GREEN)
    return np.asarray(buffer.get_pixels(oiio.FLOAT))


def save(folder: Path, name: str, image: np.ndarray, about: dict[str, Any]) -> str:
    """Write an EXR under `folder`; its path relative to that."""
    target = Path("images") / f"{name}.exr"
    (folder / target).parent.mkdir(parents=True, exist_ok=True)
    image_file.write_exr(folder / target, image.astype(np.float32), metadata=about)
    return str(target)

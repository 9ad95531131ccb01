"""The compared methods of rendering (an integrator and a BSDF each), the camera for timing, and Welch's test."""

from __future__ import annotations

import time
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.io import image_file
from mi_refract.plugins import PLUGIN
from mi_refract.rendering import scene_files
from validation import limits

from .metrics import DETECTABLE, DETECTABLE_IMAGE, SMALLEST_P, WELCH_ALARMS

DIELECTRIC = "dielectric"
OURS = "refract_path"


@dataclass(frozen=True)
class Method:
    """An integrator with its parameters other than the depth, and the BSDF of the glass."""

    name: str
    integrator: str
    bsdf: str
    parameters: dict[str, float | str] = field(default_factory=dict)

    def plugin(self, max_depth: int) -> dict[str, Any]:
        """Return the dictionary for `mi.load_dict`, without Russian roulette, as in the scene files."""
        return {"type": self.integrator, "max_depth": max_depth, "rr_depth": max_depth, **self.parameters}


BUILTIN = Method("path + dielectric", "path", DIELECTRIC)
METHODS = (
    BUILTIN,
    Method(f"path + {PLUGIN}", "path", PLUGIN),
    Method(OURS, OURS, PLUGIN),
    *(Method(f"{OURS}, split {n}", OURS, PLUGIN, {"split_depth": n}) for n in (1, 2, 3)),
)
FROM_LAMPS = Method(f"{OURS}, caustics from lamps", OURS, PLUGIN, {"caustics": "lamp"})


class Camera:
    """A loaded scene that renders images as numpy arrays and measures the time of each."""

    def __init__(self, scene: Any, integrator: Any = None) -> None:
        """`scene`: loaded by Mitsuba; `integrator`: replaces the scene's own."""
        self.scene, self.integrator = scene, integrator

    def __call__(self, spp: int, seed: int) -> tuple[np.ndarray, float]:
        """Render; return the image (height × width × 3) and the seconds."""
        import mitsuba as mi

        start = time.perf_counter()
        image = mi.render(self.scene, spp=spp, seed=seed, integrator=self.integrator)
        dr.eval(image)
        dr.sync_thread()
        seconds = time.perf_counter() - start
        return np.array(image, dtype=np.float64), seconds


@contextmanager
def under(variant: str) -> Iterator[None]:
    """Use another variant of Mitsuba within this context."""
    import mitsuba as mi

    before: Any = mi.variant()
    mi.set_variant(variant)
    try:
        yield
    finally:
        mi.set_variant(before)


def opened(path: Path, bsdf: str, resolution: int, **parameters: Any) -> Any:
    """Load a scene file with a glass; the same seed gives the same image."""
    import mitsuba as mi

    return mi.load_file(str(path), **scene_files.REPRODUCIBLE, bsdf=bsdf, res=resolution, **parameters)


def camera(path: Path, method: Method, resolution: int, **parameters: Any) -> Camera:
    """Return a camera of a scene file for a method, to the file's own depth unless `parameters` have one."""
    import mitsuba as mi

    defaults = {node.attrib["name"]: node.attrib["value"] for node in ET.parse(path).getroot().iter("default")}
    depth = int((defaults | parameters)["max_depth"])
    scene = opened(path, method.bsdf, resolution, **parameters)
    return Camera(scene, mi.load_dict(method.plugin(depth)))


def sensor(
    size: int, fov: float, origin: list[float], target: tuple[float, float, float] = (0, 0, 0)
) -> dict[str, Any]:
    """Return a perspective camera of `size`² independent pixels, for `mi.load_dict`."""
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    view = mi.ScalarTransform4f().look_at(origin, [*target], [0, 1, 0])
    return {"type": "perspective", "fov": fov, "to_world": view, "film": film, "sampler": {"type": "independent"}}


def welch_values(
    reference: np.ndarray, test: np.ndarray, tile: int, error: float = limits.WELCH_ERROR
) -> dict[str, float]:
    """Return the values of Welch's test of the tiles of two stacks of independent renders."""
    from mi_refract.image_diff import tile_statistics

    tiles = tile_statistics.compare_stacks(reference, test, tile, error, limits.WELCH_MARGIN)
    return {WELCH_ALARMS: float(tiles.alarms), SMALLEST_P: tiles.smallest_p, DETECTABLE: tiles.minimum_detectable()}


def welch_values_with_whole(reference: np.ndarray, test: np.ndarray, tile: int) -> dict[str, float]:
    """Return the same for the tiles and the whole image, with as many false alarms in both together."""
    error, sizes = limits.WELCH_ERROR / 2, (tile, max(reference.shape[1:3]))
    tiles, whole = (welch_values(reference, test, size, error) for size in sizes)
    values = {WELCH_ALARMS: tiles[WELCH_ALARMS] + whole[WELCH_ALARMS]}
    values |= {SMALLEST_P: min(tiles[SMALLEST_P], whole[SMALLEST_P])}
    return values | {DETECTABLE: tiles[DETECTABLE], DETECTABLE_IMAGE: whole[DETECTABLE]}


def save_image(folder: Path, name: str, image: np.ndarray, about: dict[str, Any]) -> str:
    """Write an EXR under `folder`, and return its path relative to the folder."""
    target = Path("images") / f"{name}.exr"
    (folder / target).parent.mkdir(parents=True, exist_ok=True)
    image_file.write_exr(folder / target, image.astype(np.float32), metadata=about)
    return str(target)

"""Scenes of glass balls side by side under a random sky, each ball with its own index."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import numpy as np

from validation.run.kernel_timing import kernels
from validation.run.render_methods import sensor

RESOLUTION = 32
SEED = 2026


class Balls:
    """A scene of `count` glass balls of different indices with one plugin.

    The default of `max_depth` is random and larger than any path, so that no cache has its kernels.
    """

    def __init__(
        self, plugin: str, count: int, integrator: str = "path", max_depth: int = 0, least: float = 1.3
    ) -> None:
        """Load the scene with an integrator and its depth. `least`: the smallest index, that of the first ball."""
        import mitsuba as mi

        side = int(np.ceil(np.sqrt(count)))
        sky = np.random.default_rng(SEED).random((8, 16, 3)).astype(np.float32)  # a constant sky would hide the indices
        fresh = int(np.random.default_rng().integers(1 << 20, 1 << 30))
        scene: dict[str, Any] = {
            "type": "scene",
            "integrator": {"type": integrator, "max_depth": max_depth or fresh},
            "sensor": sensor(RESOLUTION, 30, [0, 0, 4 * side]),
            "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky)},
        }
        for i in range(count):
            place = [2 * (i % side) - side + 1, 2 * (i // side) - side + 1, 0]
            glass = {"type": plugin, "int_ior": least + 0.5 * i / count, "ext_ior": 1.0}
            scene[f"ball{i:04}"] = {"type": "sphere", "radius": 0.9, "center": place, "bsdf": glass}
        self.scene = mi.load_dict(scene)
        self.params = mi.traverse(self.scene)
        self.eta = next(name for name in self.params.keys() if name.endswith(".eta"))  # noqa: SIM118

    def image(self, seed: int = 0) -> Any:
        """Render with 4 samples per pixel."""
        import mitsuba as mi

        return mi.render(self.scene, spp=4, seed=seed)

    def frozen(self) -> Callable[[Any, Any], Any]:
        """Return a frozen function (params, seed) → image: traced once, then replayed; its closure holds the scene."""
        import mitsuba as mi

        scene = self.scene

        @dr.freeze
        def image(params: Any, seed: Any) -> Any:
            return mi.render(scene, params, spp=4, seed=seed)

        return image

    def edit(self, eta: float) -> None:
        """Give the first ball another index."""
        self.params[self.eta] = eta
        self.params.update()


@contextmanager
def alone(plugin: str, count: int, **more: Any) -> Iterator[Balls]:
    """Yield balls, and free them afterwards."""
    gc.collect()
    balls = Balls(plugin, count, **more)
    yield balls
    balls.__dict__.clear()
    del balls
    gc.collect()


def compiled(work: Callable[[], Any]) -> float:
    """Return the number of kernels that no cache in memory had."""
    return float(sum(not entry["cache_hit"] for entry in kernels(work)))


def seconds_of(work: Callable[[], Any]) -> float:
    """Return the seconds until the result of `work` is evaluated."""
    start = time.perf_counter()
    dr.eval(work())
    dr.sync_thread()
    return time.perf_counter() - start


def size_of(balls: Balls) -> float:
    """Return the number of operations of a render's largest kernel."""
    return float(max(entry["operation_count"] for entry in kernels(balls.image)))

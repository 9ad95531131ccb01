"""One kernel serves every scene of a kind, wherever numpy put its tables in memory."""

import drjit as dr
import numpy as np
import pytest

from mi_refract.planar import Segments, trace


def polygon(corners, radius):
    angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    place = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    return Segments(place, np.roll(place, -1, axis=0), np.full(corners, 1.5), np.ones(corners))


def kernels(setting, method, corners, radius, rays, depth):
    """The kernels that follow rays through a polygon, by their hashes."""
    origins = np.column_stack([np.full(rays, -3 * radius), np.linspace(-0.4, 0.5, rays) * radius])
    options = {"precision": setting.name, "backend": setting.backend, "method": method}
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        trace(polygon(corners, radius), origins, np.broadcast_to([1.0, 0.0], (rays, 2)), depth, **options)
        return {entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])}


@pytest.mark.parametrize("method", ["brute", "mesh"])
def test_another_scene_of_that_kind_needs_no_other_kernel(vectorised, method):
    first = kernels(vectorised, method, 8, 1, 40, 4)
    assert first
    for scene in ((9, 2.5, 40, 4), (30, 0.3, 70, 9), (5, 40, 50, 2)):
        assert kernels(vectorised, method, *scene) == first

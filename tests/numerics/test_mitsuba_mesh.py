"""Meshes: what is read of them."""

import mitsuba as mi
import numpy as np
import pytest

from mi_refract.numerics import mitsuba_mesh

CORNERS, FACES = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(("tilt", "smooth"), [(None, False), (0.0, False), (1e-4, False), (0.01, True)])
def test_a_mesh_is_smooth_if_its_normals_are_not_those_of_its_faces(tilt, smooth, scalar_variant):
    normals = None if tilt is None else np.tile([tilt, 0, 1.0], (4, 1)) / np.hypot(tilt, 1)
    assert mitsuba_mesh.is_smooth(mitsuba_mesh.make(mi, CORNERS, FACES, normals)) == smooth

"""The triangles are closed, turned outward, and on the surface that they approximate."""

import itertools

import mitsuba as mi
import numpy as np
import pytest
from support.variants import switch

from mi_refract.scene_export import tessellation


def normals(triangles):
    vertices, faces = triangles
    a, b, c = vertices[faces].swapaxes(0, 1)
    return np.cross(b - a, c - a) / 2


def volume(triangles):
    vertices, faces = triangles
    return np.linalg.det(vertices[faces]).sum() / 6


@pytest.mark.parametrize("level", range(4))
def test_sphere(level):
    vertices, faces = tessellation.sphere(level)
    assert len(faces) == 20 * 4**level and len(vertices) == 10 * 4**level + 2
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1, rtol=4e-16)
    assert tessellation.is_closed(faces)
    assert (np.einsum("ij,ij->i", normals((vertices, faces)), vertices[faces].mean(1)) > 0).all()


def test_sphere_converges():
    missing = [4 / 3 * np.pi - volume(tessellation.sphere(level)) for level in range(5)]
    assert all(3 < coarse / fine < 4.2 for coarse, fine in itertools.pairwise(missing))


def test_cube():
    vertices, faces = tessellation.cube()
    assert len(vertices) == 8 and tessellation.is_closed(faces)
    assert volume((vertices, faces)) == 8
    assert np.abs(normals((vertices, faces))).sum() == 24


def test_disk_and_cylinder_fit():
    """A cylinder and two disks with its ends are a solid of the inscribed prism's volume."""
    rim = len(tessellation.disk(2)[0]) - 1
    area = rim / 2 * np.sin(2 * np.pi / rim)
    vertices, faces = tessellation.cylinder(2)
    top = tessellation.disk(2)[0] + [0, 0, 1]
    bottom = tessellation.disk(2)[0] * [1, -1, -1]
    parts = [vertices[faces], top[tessellation.disk(2)[1]], bottom[tessellation.disk(2)[1]]]
    solid = np.concatenate(parts).round(12)
    assert tessellation.is_closed(tessellation.welded(solid)[1])
    assert volume(tessellation.welded(solid)) == pytest.approx(area, rel=1e-10)
    assert np.einsum("ij,ij->", normals(tessellation.disk(2)), np.array([[0, 0, 1.0]])) == pytest.approx(area)


def test_closed_sees_a_defect():
    _, faces = tessellation.sphere(1)
    assert not tessellation.is_closed(faces[1:])
    assert not tessellation.is_closed(np.concatenate([faces[:1, ::-1], faces[1:]]))
    assert not tessellation.is_closed(np.concatenate([faces, faces[:1]]))


def colour_faults(scales, triangles, seed=3):
    """How many of 400 points of the two parts have another of the checkerboard's colours."""
    switch("scalar_rgb")
    texture = mi.load_dict(
        {
            "type": "checkerboard",
            "to_uv": mi.ScalarTransform4f().scale([*scales, 1]),
            "color0": {"type": "rgb", "value": 0.25},
            "color1": {"type": "rgb", "value": 0.75},
        }
    )
    rng, si, faults = np.random.default_rng(seed), mi.SurfaceInteraction3f(), 0
    for colour, (vertices, faces) in zip((0.25, 0.75), triangles, strict=True):
        for corners in vertices[rng.choice(faces, 200)]:
            x, y, z = rng.dirichlet((1, 1, 1)) @ corners
            assert z == 0
            si.uv = [(x + 1) / 2, (y + 1) / 2]
            faults += texture.eval(si)[0] != pytest.approx(colour)
    return faults


@pytest.mark.parametrize("scales", [(12, 12), (1, 1), (10, 5), (1.3, 0.7), (0.4, 3.14159)])
def test_checkerboard_has_mitsubas_colours(scales):
    parts = tessellation.checkerboard(*scales)
    kept = [part for part in parts if len(part[1])]
    assert sum(normals(part)[:, 2].sum() for part in kept) == pytest.approx(4)
    if len(kept) == 2:
        assert colour_faults(scales, parts) == 0
        assert colour_faults(scales, parts[::-1]) == 400
    np.testing.assert_array_less(0, np.concatenate([normals(part)[:, 2] for part in kept]))

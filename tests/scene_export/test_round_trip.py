"""What is exported, read as the renderers would read it, has Mitsuba's rays, surfaces, indices, lights and sky.

The film is not square, the camera's `up` is not at right angles to where it looks, and the sky's map has no symmetry.
"""

import re

import mitsuba as mi
import numpy as np
import pytest
from support.scene_readers import READERS

from mi_refract.io import image_file
from mi_refract.scene_export import from_mitsuba, write_files

pytestmark = pytest.mark.usefixtures("scalar_variant")

SINGLE = 2.0**-24
MAP = np.random.default_rng(8).random((5, 8, 3)).astype(np.float32)
PLAIN = '<emitter type="constant"><rgb name="radiance" value="0.5, 0.25, 1"/></emitter>'
TURNED = """<emitter type="envmap"><string name="filename" value="map.exr"/><float name="scale" value="0.5"/>
  <transform name="to_world"><rotate x="0.6" y="0.8" angle="70"/></transform></emitter>"""
PATCH = """<shape type="cube" id="patch"><transform name="to_world"><translate x="-7"/></transform>
  <bsdf type="diffuse"><rgb name="reflectance" value="0.1, 0.2, 0.3"/></bsdf></shape>"""
SCENE = """<scene version="3.0.0">
  <integrator type="path"><integer name="max_depth" value="7"/></integrator>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="3,-20,5" target="1,2,-1" up="0.3,0.2,1"/></transform>
    <float name="fov" value="40"/><string name="fov_axis" value="y"/>
    <film type="hdrfilm">
      <integer name="width" value="16"/><integer name="height" value="9"/><rfilter type="box"/>
    </film>
  </sensor>
  <shape type="sphere" id="ball">
    <bsdf type="dielectric"><float name="int_ior" value="1.8"/><float name="ext_ior" value="1.2"/></bsdf>
  </shape>
  <shape type="sphere" id="pearl"><point name="center" x="4" y="0" z="1"/>
    <bsdf type="dielectric"><float name="int_ior" value="1.1"/><float name="ext_ior" value="1.2"/></bsdf>
  </shape>
  <shape type="cube" id="lamp"><transform name="to_world"><translate z="6"/></transform>
    <emitter type="area"><rgb name="radiance" value="1, 2, 3"/></emitter></shape>
  %s
</scene>"""


@pytest.fixture(params=READERS)
def target(request):
    return request.param


@pytest.fixture
def both(target, tmp_path, monkeypatch):
    """`both(sky)`: the scene as Mitsuba loads it, the plain scene, and the export as the target's renderer reads it."""

    def call(sky):
        image_file.write_exr(tmp_path / "map.exr", MAP)
        path = tmp_path / "scene.xml"
        path.write_text(SCENE % (sky if target == "povray" else sky + PATCH))
        plain = from_mitsuba.load(path, level=1)
        write_files.write(plain, target, tmp_path / "export")
        original = mi.load_file(str(path), parallel=False, optimize=False)
        return original, plain, READERS[target](tmp_path / "export", monkeypatch)

    return call


def test_rays(both):
    """Mitsuba's are in float32: an error of a few roundoffs in each of its transforms."""
    original, _, found = both(PLAIN)
    assert found.size == (16, 9) and found.depth == 7
    sensor = original.sensors()[0]
    places = [(0, 0), (1, 0), (0, 1), (1, 1), *np.random.default_rng(3).random((12, 2))]
    for x, y in (np.clip(place, 1e-6, 1 - 1e-6) for place in places):
        ray, _ = sensor.sample_ray(0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5))
        origin, direction = found.ray(x, y)
        np.testing.assert_allclose(direction / np.linalg.norm(direction), ray.d, atol=64 * SINGLE)
        # Mitsuba's rays start at the near clip plane.
        assert np.linalg.norm(np.cross(np.subtract(ray.o, origin), ray.d)) < 64 * SINGLE * np.linalg.norm(origin)


def test_surfaces(both, target):
    """Triangles, counterclockwise from outside; the index inside over the one outside; colours."""
    original, plain, found = both(PLAIN)
    assert sorted(found.triangles) == sorted(mesh.name for mesh in plain.meshes)
    for mesh in plain.meshes:
        np.testing.assert_allclose(found.triangles[mesh.name], mesh.triangles(), atol=8 * SINGLE)
    for name in ("ball", "pearl"):
        (bsdf,) = (shape.bsdf() for shape in original.shapes() if shape.id() == name)
        centre = np.mean(found.triangles[name], axis=(0, 1))
        assert (np.linalg.det(np.subtract(found.triangles[name], centre)) > 0).all()
        assert found.indices[name] == pytest.approx(float(re.search(r"eta = ([\d.]+)", str(bsdf))[1]), rel=1e-5)
    assert found.indices.keys() == {"ball", "pearl"} and found.lights.keys() == {"lamp"}
    assert list(found.lights["lamp"]) == [1, 2, 3]
    assert {name: list(colour) for name, colour in found.colours.items()} == (
        {} if target == "povray" else {"patch": [0.1, 0.2, 0.3]}
    )


@pytest.mark.parametrize("sky", [PLAIN, TURNED], ids=["colour", "map"])
def test_sky(both, sky):
    """A map is resampled to cells of 1/16: where it bends by at most 2 per texel, linear cells err by 1/32 an axis."""
    original, _, found = both(sky)
    directions = np.random.default_rng(5).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = []
    for direction in directions:
        si = mi.SurfaceInteraction3f()
        si.wi = -mi.Vector3f(direction)
        expected.append(list(original.environment().eval(si)))
    scale = 1 if sky == PLAIN else 0.5 * np.ptp(MAP)
    np.testing.assert_allclose(found.sky(directions), expected, atol=1e-5 if sky == PLAIN else scale / 16)

"""glTF: what only it holds of a scene, how round its spheres are, and what it cannot hold."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from support.scene_readers import cone, glb, punctual

from mi_refract.scene_export import from_mitsuba, targets, tessellation
from mi_refract.scene_export.plain_scene import Camera, Diffuse, Glass, Light, Mesh, PlainScene

SCENES = Path(__file__).parents[2] / "scenes"
pytestmark = pytest.mark.usefixtures("scalar_variant")
SINGLE = 2.0**-24
SCENE = """<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="7"/></integrator>
  <sensor type="perspective"><float name="fov" value="40"/><film type="hdrfilm"><rfilter type="box"/></film></sensor>
  <shape type="sphere" id="ball"><float name="radius" value="2"/><bsdf type="refract">%s</bsdf></shape>%s</scene>"""
HOLLOW = '<shape type="sphere" id="hollow"><bsdf type="refract">%s</bsdf></shape>'
LAMP = '<emitter type="area"><rgb name="radiance" value="0.5, 1, 4"/></emitter>'


def ior(side, value):
    return f'<string name="{side}_ior" value="{value}"/>'


def colour(side, value, distance=8):
    return f'<rgb name="{side}_colour" value="{value}"/><float name="{side}_colour_distance" value="{distance}"/>'


@pytest.fixture
def export(tmp_path):
    """`export(parameters of the ball's glass, more shapes)`: the file that is read, and README.txt."""

    def write(ball, more="", level=1):
        (tmp_path / "scene.xml").write_text(SCENE % (ball, more))
        targets.write(from_mitsuba.load(tmp_path / "scene.xml", level=level), "gltf", tmp_path / "new")
        text = (tmp_path / "new" / "README.txt").read_text()
        return glb(tmp_path / "new" / "scene.glb"), " ".join(text.split())

    return write


def extensions(model, mesh):
    made = model.meshes[mesh][3]["extensions"].items()
    return {name.removeprefix("KHR_materials_"): value for name, value in made}


def angles(a, b):
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1))


@pytest.mark.parametrize("level", range(5))
def test_round_shapes_have_their_normals_and_the_error_of_facets_is_said(level, export):
    """A spherical triangle of equal sides and circumradius ρ has the middles of its sides at r, tan r = tan(ρ)/2.

    They are the corners of the middle one of its four, the largest. An icosahedron has tan ρ = 3 − √5. A cylinder of
    8 · 2^level sides is at most half a side off.
    """
    tube = f'<shape type="cylinder" id="tube"><boolean name="flip_normals" value="true"/>{LAMP}</shape>'
    model, said = export(ior("ext", 1), tube + f'<shape type="cube" id="box">{LAMP}</shape>', level)
    bounds = {"ball": np.arctan((3 - 5**0.5) / 2**level), "tube": np.pi / (8 << level)}
    inward = {"ball": lambda x: -x / 2, "tube": lambda x: x * [1, 1, 0]}
    for name, bound in bounds.items():
        places, normals, faces, _ = model.meshes[name]
        np.testing.assert_allclose(normals, -inward[name](places), atol=2 * SINGLE)
        a, b, c = places[faces].astype(float).swapaxes(0, 1)
        found = angles(np.cross(b - a, c - a)[:, None], normals[faces].astype(float)).max()
        assert found == pytest.approx(bound, abs=64 * SINGLE * 2**level)
    assert len(model.meshes["ball"][0]) == 10 * 4**level + 2  # shared
    words = re.search(r"largest angle between a facet's normal and that of the surface is ([\d.]+) degrees", said)
    assert float(words[1]) == pytest.approx(np.degrees(max(bounds.values())), abs=1e-4)
    places, normals, faces, _ = model.meshes["box"]  # 12 facets, each with corners of its own
    assert len(places) == 36 and sorted(set(map(tuple, np.abs(normals)))) == [(0, 0, 1), (0, 1, 0), (1, 0, 0)]
    a, b, c = places[faces].swapaxes(0, 1)
    assert (angles(np.cross(b - a, c - a)[:, None], normals[faces]) < 1e-6).all()


def test_dispersion_is_20_over_abbes_number_and_its_error_is_said(export):
    """KHR_materials_dispersion; its text gives diamond 2.42 and 55."""
    model, said = export(ior("int", "abbe(2.42, 55)") + ior("ext", 1))
    found = extensions(model, "ball")
    assert found["ior"] == {"ior": pytest.approx(2.42)} and found["dispersion"] == {
        "dispersion": pytest.approx(20 / 55)
    }
    assert "ball: int_ior = abbe(2.42, 55) becomes Abbe's number 55, " in said
    assert float(re.search(r"differs from the scene's by up to (\S+)\. ?$", said)[1]) < 1e-4  # of its constants


@pytest.mark.parametrize("glass", ["SCHOTT:N-SF11", "MATERIAL:water", "MATERIAL:diamond", "sellmeier(1.2, 9000)"])
def test_a_formula_becomes_abbes_number_with_its_largest_difference(glass, export):
    """n_F, n_d and n_C relative to the medium around are the scene's within the rounded constants of the formula."""
    from mi_refract import media

    model, said = export(ior("int", glass) + ior("ext", 1))
    found = extensions(model, "ball")
    n, v = found["ior"]["ior"], 20 / found["dispersion"]["dispersion"]

    def theirs(wavelength):
        return n + (n - 1) / v * (523655 / wavelength**2 - 1.5168)

    def ours(wavelength):
        return media.relative_index(media.parse(glass), media.parse(1.0), wavelength)

    f, d, c = (media.LINES[line] for line in "FdC")
    assert n == pytest.approx(ours(d), rel=1e-12)
    assert theirs(f) - theirs(c) == pytest.approx(ours(f) - ours(c), rel=2e-3)
    grid = np.arange(400.0, 701.0, 10.0)
    difference = np.abs(theirs(grid) - ours(grid)).max()
    assert float(re.search(r"by up to (\S+)\. ?$", said)[1]) == pytest.approx(difference, rel=0.05)


@pytest.mark.parametrize(
    "ball, hollow",
    [
        (colour("int", "0.42, 0.85, 0.5"), colour("ext", "0.42, 0.85, 0.5")),
        ('<rgb name="int_absorption" value="0.1, 0, 0.2"/>', '<rgb name="ext_absorption" value="0.1, 0, 0.2"/>'),
    ],
)
@pytest.mark.parametrize("index", ["1.5", "SCHOTT:N-BK7"])
def test_absorption_and_a_hollow(index, ball, hollow, export):
    """Colour to the power of t over distance, or 1 − colour over distance, as Blender has it.

    A hollow is a part of the mesh of the glass: it faces what is in it.
    """
    inside, outside = ior("int", index) + ior("ext", "air"), ior("int", "air") + ior("ext", index)
    model, _ = export(ball + inside, HOLLOW % (hollow + outside))
    places, normals, faces, _ = model.meshes["ball"]
    assert list(model.meshes) == ["ball"] and len(model.tree["materials"]) == 1
    found = extensions(model, "ball")
    keeps = np.array(found["volume"]["attenuationColor"]) ** (8 / found["volume"]["attenuationDistance"])
    expected = [0.42, 0.85, 0.5] if "colour" in ball else np.exp([-0.8, 0, -1.6])
    np.testing.assert_allclose(keeps, expected, rtol=1e-12)
    blenders = np.subtract(1, found["volume"]["attenuationColor"]) / found["volume"]["attenuationDistance"]
    np.testing.assert_allclose(blenders, -np.log(expected) / 8, rtol=5e-4, atol=1e-15)
    radii, outward = np.linalg.norm(places, axis=1), np.einsum("ij,ij->i", places, normals)
    assert {*radii.round(5)} == {1, 2} and (np.sign(outward) == np.where(radii > 1.5, 1, -1)).all()
    corners = places[faces].swapaxes(0, 1)
    areas = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    assert (np.einsum("ij,ij->i", areas, normals[faces[:, 0]]) > 0).all()
    volume, surface = np.linalg.det(places[faces]).sum() / 6, np.linalg.norm(areas, axis=1).sum() / 2
    assert found["volume"]["thicknessFactor"] == pytest.approx(4 * volume / surface, rel=1e-5)


def test_an_open_lamp_is_black_from_behind(export):
    """The back is less than a pixel behind the front, and more than float32 rounds. A closed lamp needs none."""
    shapes = f'<shape type="rectangle" id="lamp">{LAMP}</shape><shape type="cube" id="box">{LAMP}</shape>'
    model, _ = export(ior("ext", 1), shapes)
    assert set(model.meshes) == {"ball", "lamp", "lamp-back", "box"}
    front, back = model.meshes["lamp"], model.meshes["lamp-back"]
    assert front[3]["emissiveFactor"] == [0.125, 0.25, 1]
    assert extensions(model, "lamp")["emissive_strength"] == {"emissiveStrength": 4}
    assert back[3]["emissiveFactor"] == [0, 0, 0] and not (front[3]["doubleSided"] or back[3]["doubleSided"])
    assert (front[1] == [0, 0, 1]).all() and (back[1] == [0, 0, -1]).all()
    assert (front[0][:, 2] == 0).all() and (back[0][:, 2] > -1e-4).all() and (back[0][:, 2] < -100 * SINGLE).all()


@pytest.mark.parametrize("beam, cutoff", [(15, 20), (0, 90), (40, 40)])
def test_the_edge_of_a_spot_is_said(beam, cutoff, export):
    """The largest difference between the extension's sample and Mitsuba's ramp: 1 where the ramp is a step."""
    angles = f'<float name="cutoff_angle" value="{cutoff}"/><float name="beam_width" value="{beam}"/>'
    model, said = export(ior("ext", 1), f'<emitter type="spot" id="lamp">{angles}</emitter>')
    ((_, _, light),) = punctual(model.tree)
    words = re.search(r"lamp: from (\S+) to (\S+) degrees glTF leaves .* by up to (\S+) of the intensity", said)
    low, high, most = map(float, words.groups())
    inner, outer = np.degrees([light["spot"]["innerConeAngle"], light["spot"]["outerConeAngle"]])
    assert (low, high) == pytest.approx((inner, outer)) and inner < outer
    assert (low, high) == pytest.approx((beam, cutoff), rel=1.1e-3)
    angle = np.radians(np.linspace(inner, outer, 5000, endpoint=False))
    ramp = np.clip((np.radians(cutoff) - angle) / max(np.radians(cutoff - beam), 1e-9), 0, 1)
    assert most == pytest.approx(np.abs(ramp - cone(**light["spot"])(angle)).max(), abs=0.006)


def test_a_unit_sphere_whose_vertices_are_its_normals(export):
    """One view of the buffer for both; whoever reads the file checks that it says its stride."""
    model, _ = export(ior("ext", 1), f'<shape type="sphere" id="unit">{LAMP}</shape>')
    places, normals, *_ = model.meshes["unit"]
    assert (places == normals).all() and len({accessor["bufferView"] for accessor in model.tree["accessors"]}) < 6


def test_a_lamp_that_gives_no_light(export):
    """Its colour is not 0/0."""
    model, _ = export(ior("ext", 1), '<emitter type="point"><rgb name="intensity" value="0"/></emitter>')
    ((_, _, light),) = punctual(model.tree)
    assert light == {"name": "point", "type": "point", "intensity": 0}


PARTS = {
    "ball: int_ior = table(400: 1.5, 700: 1.6); expected an index that falls": ior("int", "table(400: 1.5, 700: 1.6)"),
    "int_ior = table(450: 1.6, 700: 1.5): no index at 400 nm; expected": ior("int", "table(450: 1.6, 700: 1.5)"),
    "ball: ext_colour: the medium around all glass absorbs; expected": colour("ext", "0.5, 0.5, 0.5"),
    "int_colour = (0.0, 0.5, 0.5) after int_colour_distance = 8.0; expected": colour("int", "0, 0.5, 0.5"),
    "int_colour_distance = 0.0; expected": colour("int", "1, 0.5, 0.5", 0),
    "int_colour_distance = None; expected": '<rgb name="int_colour" value="0.5, 0.5, 0.5"/>',
    "int_absorption = k.csv; expected an RGB colour": '<string name="int_absorption" value="k.csv"/>',
    "int_colour and int_colour_distance are not supported": '<float name="int_absorption" value="1"/>'
    + colour("int", "1, 1, 1"),
    "lamp: cutoff_angle = 91 degrees; expected at most 90": ior("ext", 1)
    + '</bsdf></shape><emitter type="spot" id="lamp"><float name="cutoff_angle" value="91"/></emitter>'
    '<shape type="cube"><bsdf type="refract">',
    "ball: index 1.2 in 1.3; expected a glass of at least that": ior("int", 1.2) + ior("ext", 1.3),
}


@pytest.mark.parametrize("said", PARTS)
def test_what_gltf_cannot_hold_is_refused(said, export, tmp_path):
    """In one line, with nothing written."""
    with pytest.raises(ValueError, match=rf"^[^\n]*{re.escape(said)}[^\n]*$"):
        export(PARTS[said])
    assert not (tmp_path / "new").exists()


BALL = tessellation.sphere(0)
PANE = tessellation.rectangle()
MESHES = {
    "pane: glass with an open surface; expected a closed one": [Mesh("pane", *PANE, Glass(1.5, 1.0))],
    "in: media of 1.5 and 1.7 touch; expected 1.0": [
        Mesh("out", 2 * BALL[0], BALL[1], Glass(1.5, 1.0)),
        Mesh("in", *BALL, Glass(1.7, 1.5)),
    ],
    "in: index 1.0 in 1.33; expected a glass of at least that": [Mesh("in", *BALL, Glass(1.0, 1.33))],
    "hollow: a hollow; expected the same glass around it": [
        Mesh("out", 2 * BALL[0], BALL[1], Glass(1.5, 1.0)),
        Mesh("hollow", BALL[0] + 9, BALL[1], Glass(1.0, 1.5)),
        Mesh("far", BALL[0] + 18, BALL[1], Glass(1.5, 1.0)),
    ],
    "grey: reflectance = (0.5, 1.5, 0.5); expected at most 1": [Mesh("grey", *PANE, Diffuse((0.5, 1.5, 0.5)))],
}


def plain(meshes):
    camera = Camera((0.0, 0.0, 9.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0, 8, 4)
    return PlainScene("a scene", tuple(meshes), (0.0, 0.0, 0.0), camera, 8)


@pytest.mark.parametrize("said", MESHES)
def test_a_mesh_that_gltf_cannot_hold_is_refused(said, tmp_path):
    with pytest.raises(ValueError, match=rf"^a scene: {re.escape(said)}[^\n]*$"):
        targets.write(plain(MESHES[said]), "gltf", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_triangles_without_an_area_are_left_out(tmp_path):
    """They have no normal. No sky: no map of it."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]], float)
    mesh = Mesh("lamp", vertices, np.array([[0, 1, 2], [0, 1, 3]]), Light((1.0, 1.0, 1.0)))
    none = Mesh("none", vertices, np.array([[0, 1, 3]]), Light((1.0, 1.0, 1.0)))
    targets.write(plain([mesh, none]), "gltf", tmp_path / "new")
    model = glb(tmp_path / "new" / "scene.glb")
    assert set(model.meshes) == {"lamp", "lamp-back"} and len(model.meshes["lamp"][2]) == 1
    assert not (tmp_path / "new" / "sky.exr").exists()


def test_neither_a_wide_floor_nor_a_far_lamp_hides_what_is_near(tmp_path):
    """Nothing is before the near plane, and a lamp's black back is behind it by its own size, not the scene's."""
    wide = Mesh("floor", 1e5 * PANE[0] - [0, 0, 2], PANE[1], Diffuse((0.5, 0.5, 0.5)))
    lamp = Mesh("lamp", PANE[0] + [0, 0, 5], PANE[1], Light((1.0, 1.0, 1.0)))
    targets.write(plain([wide, lamp]), "gltf", tmp_path / "new")
    model = glb(tmp_path / "new" / "scene.glb")
    assert 0 < model.tree["cameras"][0]["perspective"]["znear"] < 4
    assert np.abs(model.meshes["lamp-back"][0][:, 2] - model.meshes["lamp"][0][:, 2]).max() < 1e-3


def test_trimesh_that_is_missing(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ImportError, match=r"^glTF needs trimesh: pip install 'mi-refract\[gltf\]'$"):
        targets.write(plain([]), "gltf", tmp_path / "new")
    assert not (tmp_path / "new").exists()

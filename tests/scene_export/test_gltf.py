"""glTF: the content that only glTF exports, the facets of round shapes, and refused scenes."""

import re
import sys

import numpy as np
import pytest
from support.scene_readers import cone, glb, punctual

from mi_refract.io.errors import ExportError
from mi_refract.scene_export import from_mitsuba, targets, tessellation
from mi_refract.scene_export.plain_scene import Camera, Diffuse, Glass, Light, Mesh, PlainScene

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
    """`export(parameters of the ball's glass, more shapes)`: the model in scene.glb, and README.txt."""

    def write(ball, more="", level=1):
        (tmp_path / "scene.xml").write_text(SCENE % (ball, more))
        targets.write(from_mitsuba.load(tmp_path / "scene.xml", level=level), "gltf", tmp_path / "new")
        text = (tmp_path / "new" / "README.txt").read_text()
        return glb(tmp_path / "new" / "scene.glb"), " ".join(text.split())

    return write


def extensions(model, mesh):
    entries = model.meshes[mesh][3]["extensions"].items()
    return {name.removeprefix("KHR_materials_"): value for name, value in entries}


def angles(a, b):
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1))


@pytest.mark.parametrize("level", range(5))
def test_round_shapes_have_smooth_normals_and_readme_has_the_facets_error(level, export):
    """The bound for a sphere follows from tan r = tan(ρ)/2, and for a cylinder of 8 · 2^level sides it is half a side.

    An equilateral spherical triangle of circumradius ρ has the middles of its sides at radius r from its centre. They
    are the corners of the middle one of its four parts, which is the largest. An icosahedron has tan ρ = 3 − √5.
    """
    tube = f'<shape type="cylinder" id="tube"><boolean name="flip_normals" value="true"/>{LAMP}</shape>'
    model, text = export(ior("ext", 1), tube + f'<shape type="cube" id="box">{LAMP}</shape>', level)
    bounds = {"ball": np.arctan((3 - 5**0.5) / 2**level), "tube": np.pi / (8 << level)}
    inward = {"ball": lambda x: -x / 2, "tube": lambda x: x * [1, 1, 0]}
    for name, bound in bounds.items():
        vertices, normals, faces, _ = model.meshes[name]
        np.testing.assert_allclose(normals, -inward[name](vertices), atol=2 * SINGLE)
        a, b, c = vertices[faces].astype(float).swapaxes(0, 1)
        largest = angles(np.cross(b - a, c - a)[:, None], normals[faces].astype(float)).max()
        assert largest == pytest.approx(bound, abs=64 * SINGLE * 2**level)
    assert len(model.meshes["ball"][0]) == 10 * 4**level + 2  # faces share vertices
    match = re.search(r"largest angle between the normals of a facet and of the surface is ([\d.]+) degrees", text)
    assert float(match[1]) == pytest.approx(np.degrees(max(bounds.values())), abs=1e-4)
    vertices, normals, faces, _ = model.meshes["box"]  # 12 facets, each with its own vertices
    assert len(vertices) == 36 and sorted(set(map(tuple, np.abs(normals)))) == [(0, 0, 1), (0, 1, 0), (1, 0, 0)]
    a, b, c = vertices[faces].swapaxes(0, 1)
    assert (angles(np.cross(b - a, c - a)[:, None], normals[faces]) < 1e-6).all()


def test_dispersion_is_20_over_abbes_number_and_readme_has_its_error(export):
    """The specification of KHR_materials_dispersion lists diamond with index 2.42 and Abbe's number 55."""
    model, text = export(ior("int", "abbe(2.42, 55)") + ior("ext", 1))
    entries = extensions(model, "ball")
    assert entries["ior"] == {"ior": pytest.approx(2.42)}
    assert entries["dispersion"] == {"dispersion": pytest.approx(20 / 55)}
    assert "ball: int_ior = abbe(2.42, 55) becomes Abbe's number 55, " in text
    error = float(re.search(r"differs from the scene's by up to (\S+)\. ?$", text)[1])
    assert error < 1e-4  # the extension's constants are rounded


@pytest.mark.parametrize("glass", ["SCHOTT:N-SF11", "MATERIAL:water", "MATERIAL:diamond", "sellmeier(1.2, 9000)"])
def test_other_formulas_become_abbes_number_and_readme_has_the_difference(glass, export):
    """Relative n_F, n_d and n_C equal the scene's, up to the rounded constants of the extension."""
    from mi_refract import media

    model, text = export(ior("int", glass) + ior("ext", 1))
    entries = extensions(model, "ball")
    n, v = entries["ior"]["ior"], 20 / entries["dispersion"]["dispersion"]

    def exported(wavelength):
        return n + (n - 1) / v * (523655 / wavelength**2 - 1.5168)

    def expected(wavelength):
        return media.relative_index(media.parse(glass), media.parse(1.0), wavelength)

    f, d, c = (media.LINES[line] for line in "FdC")
    assert n == pytest.approx(expected(d), rel=1e-12)
    assert exported(f) - exported(c) == pytest.approx(expected(f) - expected(c), rel=2e-3)
    grid = np.arange(400.0, 701.0, 10.0)
    difference = np.abs(exported(grid) - expected(grid)).max()
    assert float(re.search(r"by up to (\S+)\. ?$", text)[1]) == pytest.approx(difference, rel=0.05)


@pytest.mark.parametrize(
    "ball, hollow",
    [
        (colour("int", "0.42, 0.85, 0.5"), colour("ext", "0.42, 0.85, 0.5")),
        ('<rgb name="int_absorption" value="0.1, 0, 0.2"/>', '<rgb name="ext_absorption" value="0.1, 0, 0.2"/>'),
    ],
)
@pytest.mark.parametrize("index", ["1.5", "SCHOTT:N-BK7"])
def test_absorption_and_a_hollow(index, ball, hollow, export):
    """Transmittance is colour^(t/distance); Blender's σ is (1 − colour)/distance.

    A hollow is part of the mesh of the glass; its normals point into the hollow.
    """
    inside, outside = ior("int", index) + ior("ext", "air"), ior("int", "air") + ior("ext", index)
    model, _ = export(ball + inside, HOLLOW % (hollow + outside))
    vertices, normals, faces, _ = model.meshes["ball"]
    assert list(model.meshes) == ["ball"] and len(model.tree["materials"]) == 1
    entry = extensions(model, "ball")["volume"]
    transmittance = np.array(entry["attenuationColor"]) ** (8 / entry["attenuationDistance"])
    expected = [0.42, 0.85, 0.5] if "colour" in ball else np.exp([-0.8, 0, -1.6])
    np.testing.assert_allclose(transmittance, expected, rtol=1e-12)
    blenders_sigma = np.subtract(1, entry["attenuationColor"]) / entry["attenuationDistance"]
    np.testing.assert_allclose(blenders_sigma, -np.log(expected) / 8, rtol=5e-4, atol=1e-15)
    radii, outward = np.linalg.norm(vertices, axis=1), np.einsum("ij,ij->i", vertices, normals)
    assert {*radii.round(5)} == {1, 2} and (np.sign(outward) == np.where(radii > 1.5, 1, -1)).all()
    corners = vertices[faces].swapaxes(0, 1)
    areas = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    assert (np.einsum("ij,ij->i", areas, normals[faces[:, 0]]) > 0).all()
    volume, surface = np.linalg.det(vertices[faces]).sum() / 6, np.linalg.norm(areas, axis=1).sum() / 2
    assert entry["thicknessFactor"] == pytest.approx(4 * volume / surface, rel=1e-5)


def test_an_open_or_inward_lamp_is_black_from_behind(export):
    """The back is less than a pixel behind the front, but more than roundoff of float32.

    A closed lamp has a back only if it faces inward.
    """
    shapes = f'<shape type="rectangle" id="lamp">{LAMP}</shape><shape type="cube" id="box">{LAMP}</shape>'
    shapes += f'<shape type="cube" id="room"><boolean name="flip_normals" value="true"/>{LAMP}</shape>'
    model, _ = export(ior("ext", 1), shapes)
    assert set(model.meshes) == {"ball", "lamp", "lamp-back", "box", "room", "room-back"}
    vertices, normals, _, material = model.meshes["room-back"]
    assert material["emissiveFactor"] == [0, 0, 0] and ((vertices * normals).sum(1) > 1 + 100 * SINGLE).all()
    front, back = model.meshes["lamp"], model.meshes["lamp-back"]
    assert front[3]["emissiveFactor"] == [0.125, 0.25, 1]
    assert extensions(model, "lamp")["emissive_strength"] == {"emissiveStrength": 4}
    assert back[3]["emissiveFactor"] == [0, 0, 0] and not (front[3]["doubleSided"] or back[3]["doubleSided"])
    assert (front[1] == [0, 0, 1]).all() and (back[1] == [0, 0, -1]).all()
    assert (front[0][:, 2] == 0).all() and (back[0][:, 2] > -1e-4).all() and (back[0][:, 2] < -100 * SINGLE).all()


@pytest.mark.parametrize("beam, cutoff", [(15, 20), (0, 90), (40, 40)])
def test_readme_has_the_difference_of_a_spots_edge(beam, cutoff, export):
    """The largest difference between the extension's sample code and Mitsuba's ramp, which is 1 for a step."""
    angles = f'<float name="cutoff_angle" value="{cutoff}"/><float name="beam_width" value="{beam}"/>'
    model, text = export(ior("ext", 1), f'<emitter type="spot" id="lamp">{angles}</emitter>')
    ((_, _, light),) = punctual(model.tree)
    match = re.search(r"lamp: from (\S+) to (\S+) degrees glTF leaves .* by up to (\S+) of the intensity", text)
    low, high, difference = map(float, match.groups())
    inner, outer = np.degrees([light["spot"]["innerConeAngle"], light["spot"]["outerConeAngle"]])
    assert (low, high) == pytest.approx((inner, outer)) and inner < outer
    assert (low, high) == pytest.approx((beam, cutoff), rel=1.1e-3)
    angle = np.radians(np.linspace(inner, outer, 5000, endpoint=False))
    ramp = np.clip((np.radians(cutoff) - angle) / max(np.radians(cutoff - beam), 1e-9), 0, 1)
    assert difference == pytest.approx(np.abs(ramp - cone(**light["spot"])(angle)).max(), abs=0.006)


def test_equal_vertices_and_normals_share_a_buffer_view(export):
    """As for a unit sphere. The reader of the file checks that the view has a stride."""
    model, _ = export(ior("ext", 1), f'<shape type="sphere" id="unit">{LAMP}</shape>')
    vertices, normals, *_ = model.meshes["unit"]
    assert (vertices == normals).all() and len({accessor["bufferView"] for accessor in model.tree["accessors"]}) < 6


def test_a_black_lamp(export):
    """Its colour is left out, not 0/0."""
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
    "ball: index 1.2 is below 1.3, that of the medium around all glass; expected at least that": ior("int", 1.2)
    + ior("ext", 1.3),
}


@pytest.mark.parametrize("message", PARTS)
def test_a_glass_or_lamp_that_gltf_cannot_hold_is_refused(message, export, tmp_path):
    """The error is one line, and nothing is written."""
    with pytest.raises(ExportError, match=rf"^[^\n]*{re.escape(message)}[^\n]*$"):
        export(PARTS[message])
    assert not (tmp_path / "new").exists()


BALL = tessellation.sphere(0)
PANE = tessellation.rectangle()
MESHES = {
    "pane: glass with an open surface; expected a closed one": [Mesh("pane", *PANE, Glass(1.5, 1.0))],
    "in: media of 1.5 and 1.7 touch; expected the medium around all glass, 1.0, on one side": [
        Mesh("out", 2 * BALL[0], BALL[1], Glass(1.5, 1.0)),
        Mesh("in", *BALL, Glass(1.7, 1.5)),
    ],
    "in: index 1.0 is below 1.33, that of the medium around all glass; expected at least that": [
        Mesh("in", *BALL, Glass(1.0, 1.33))
    ],
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


@pytest.mark.parametrize("message", MESHES)
def test_a_mesh_that_gltf_cannot_hold_is_refused(message, tmp_path):
    with pytest.raises(ExportError, match=rf"^a scene: {re.escape(message)}[^\n]*$"):
        targets.write(plain(MESHES[message]), "gltf", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_triangles_without_an_area_are_left_out(tmp_path):
    """They have no normal. Without a sky there is no sky.exr."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]], float)
    mesh = Mesh("lamp", vertices, np.array([[0, 1, 2], [0, 1, 3]]), Light((1.0, 1.0, 1.0)))
    degenerate = Mesh("degenerate", vertices, np.array([[0, 1, 3]]), Light((1.0, 1.0, 1.0)))
    targets.write(plain([mesh, degenerate]), "gltf", tmp_path / "new")
    model = glb(tmp_path / "new" / "scene.glb")
    assert set(model.meshes) == {"lamp", "lamp-back"} and len(model.meshes["lamp"][2]) == 1
    assert not (tmp_path / "new" / "sky.exr").exists()


def test_a_wide_floor_does_not_move_the_near_plane_or_a_lamps_back(tmp_path):
    """No surface is in front of the near plane; the offset of a lamp's back depends on the lamp, not on the scene."""
    floor = Mesh("floor", 1e5 * PANE[0] - [0, 0, 2], PANE[1], Diffuse((0.5, 0.5, 0.5)))
    lamp = Mesh("lamp", PANE[0] + [0, 0, 5], PANE[1], Light((1.0, 1.0, 1.0)))
    targets.write(plain([floor, lamp]), "gltf", tmp_path / "new")
    model = glb(tmp_path / "new" / "scene.glb")
    assert 0 < model.tree["cameras"][0]["perspective"]["znear"] < 4
    assert np.abs(model.meshes["lamp-back"][0][:, 2] - model.meshes["lamp"][0][:, 2]).max() < 1e-3


def test_the_camera_does_not_move_a_mesh_of_any_name(tmp_path):
    names = ("camera", "world", "lens")
    targets.write(plain(Mesh(name, *PANE, Diffuse((0.5, 0.5, 0.5))) for name in names), "gltf", tmp_path)
    nodes = {node["name"]: node for node in glb(tmp_path / "scene.glb").tree["nodes"]}
    assert not any({"matrix", "camera"} & nodes[name].keys() for name in names)


def test_missing_trimesh(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ImportError, match=r"^glTF needs trimesh: pip install 'mi-refract\[gltf\]'$"):
        targets.write(plain([]), "gltf", tmp_path / "new")
    assert not (tmp_path / "new").exists()

"""A plain scene equals the scene that Mitsuba loads from the file, and what it cannot hold is an error.

Rays are traced through the original and through the plain scene, loaded again by Mitsuba. They must hit the same
surface at the same distance and from the same side, of the same material; rays that hit nothing must see the same sky.
"""

import re
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_refract.io import image_file
from mi_refract.scene_export import from_mitsuba, meshes_from_shapes, write_files
from mi_refract.scene_export.mitsuba_nodes import SceneFile
from mi_refract.scene_export.plain_scene import Diffuse, Glass, Light

SCENES = Path(__file__).parents[2] / "scenes"
NAMES = sorted(path.stem for path in SCENES.glob("*.xml"))
PLANE = ["diamond", "lightpipe", "nested", "prism", "slab"]  # nothing in them is curved
# What no plain scene holds, and what is said of it.
NO_PLAIN_SCENE = {
    "diamond_fire": "MATERIAL:diamond; expected one number for all wavelengths",
    "dispersive_prism": r"sellmeier\(.*\); expected one number for all wavelengths",
    "green_bottle": "glass_air: int_colour and int_colour_distance are not supported; expected a scene without them",
    "spectrum_on_screen": r"sellmeier\(.*\); expected one number for all wavelengths",
    "rainbow_drop": "MATERIAL:water; expected one number for all wavelengths",
}


pytestmark = pytest.mark.usefixtures("scalar_variant")


TURN = '<transform name="radiance"><rotate x="1" angle="30"/></transform>'
SCENE = """<scene version="3.0.0">
  <default name="bsdf" value="refract"/>
  <integrator type="path"><integer name="max_depth" value="5"/></integrator>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0,1,-40" target="0,0,0" up="0,1,0"/></transform>
    <float name="fov" value="40"/>
    <film type="hdrfilm">
      <integer name="width" value="16"/><integer name="height" value="8"/><rfilter type="box"/>
    </film>
  </sensor>
  <emitter type="constant"><rgb name="radiance" value="0.5, 0.25, 1"/></emitter>
  <shape type="sphere" id="ball"><bsdf type="$bsdf"><string name="int_ior" value="water"/></bsdf></shape>
  <shape type="cube" id="box"><transform name="to_world"><translate x="3"/></transform></shape>
  <shape type="rectangle"><emitter type="area"><rgb name="radiance" value="2"/></emitter></shape>
</scene>"""


@pytest.fixture
def scene(tmp_path):
    """`scene(old, new, ...)`: the path of SCENE with these replacements."""

    def write(*replacements):
        text = SCENE
        for old, new in zip(replacements[::2], replacements[1::2], strict=True):
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / "scene.xml"
        path.write_text(text)
        return path

    return write


def test_what_is_read(scene):
    found = from_mitsuba.load(scene(), level=1)
    ball, box, lamp = found.meshes
    assert (ball.name, box.name, lamp.name) == ("ball", "box", "rectangle")
    assert ball.material == Glass(1.333, 1.000277) and len(ball.faces) == 80
    np.testing.assert_allclose(ball.vertices.mean(0), 0, atol=1e-12)
    assert box.material == Diffuse((0.5, 0.5, 0.5)) and box.vertices.min(0).tolist() == [2, -1, -1]
    assert lamp.material == Light((2, 2, 2))
    assert found.sky == (0.5, 0.25, 1) and found.max_depth == 5
    assert (found.camera.width, found.camera.height, found.camera.origin) == (16, 8, (0, 1, -40))
    assert found.name == "scene" and len(found.materials) == 3


def test_defines_replace_defaults(scene):
    assert from_mitsuba.load(scene('value="5"', 'value="$depth"'), depth="7").max_depth == 7
    assert from_mitsuba.load(scene('value="5"', 'value="$depth"'), depth="1").max_depth == 1
    for name in ("dielectric", "refract_promoted"):
        assert from_mitsuba.load(scene(), bsdf=name).meshes[0].material == Glass(1.333, 1.000277)


@pytest.mark.parametrize("axis", ["x", "y", "larger", "smaller", "diagonal"])
def test_field_of_view(scene, axis, tmp_path):
    path = scene('<float name="fov"', f'<string name="fov_axis" value="{axis}"/><float name="fov"')
    for corner in ((0, 0), (1, 0.25)):
        rays = [
            each.sensors()[0].sample_ray(0, 0.5, mi.Point2f(corner), mi.Point2f(0.5))[0].d
            for each in (original(path), again(from_mitsuba.load(path), tmp_path / f"plain{corner[0]}"))
        ]
        np.testing.assert_allclose(*rays, atol=1e-6)


# --- the same geometry, materials and sky ----------------------------------------------------------------


def again(found, folder):
    """The plain scene, loaded by Mitsuba."""
    write_files.write(found, "mitsuba", folder)
    return mi.load_file(str(folder / "scene.xml"), optimize=False, parallel=False, bsdf="dielectric")


def original(path, **defines):
    return mi.load_file(str(path), optimize=False, parallel=False, bsdf="dielectric", **defines)


def met(scene, ray):
    """Where a ray arrives; the side and the ratio of indices, a colour, or a radiance."""
    si = scene.ray_intersect(ray)
    if not si.is_valid():
        return [0, 0, 0, 0, *(scene.environment().eval(si) if scene.environment() else (0, 0, 0))]
    if si.emitter(scene) is not None:
        return [*si.p, 2, *si.emitter(scene).eval(si)]
    bsdf = si.bsdf()
    if mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta):
        eta = float(re.search(r"eta = ([\d.e-]+)", str(bsdf))[1])
        return [*si.p, np.sign(si.wi.z), eta, 0, 0]
    return [*si.p, 3, *bsdf.eval_diffuse_reflectance(si)]


def disagreements(one, other, count=1500, seed=9, tolerance=1e-3):
    """The share of rays that meet something else: into the image, and on from where the first of them arrive."""
    rng, wrong, seen = np.random.default_rng(seed), 0, 0
    for u, direction in zip(rng.random((count, 2)), rng.normal(size=(count, 3)), strict=True):
        ray, _ = one.sensors()[0].sample_ray(0, 0.5, mi.Point2f(u), mi.Point2f(0.5))
        there, _ = other.sensors()[0].sample_ray(0, 0.5, mi.Point2f(u), mi.Point2f(0.5))
        si = one.ray_intersect(ray)
        onward = si.spawn_ray(mi.Vector3f(direction / np.linalg.norm(direction))) if si.is_valid() else ray
        for a, b in ((ray, there), (onward, onward)):
            wrong += not np.allclose(met(one, a), met(other, b), rtol=tolerance, atol=tolerance)
            seen += 1
    return wrong / seen


@pytest.mark.parametrize("name", PLANE)
def test_plane_scenes_are_the_same(name, tmp_path):
    path = SCENES / f"{name}.xml"
    # Rays that graze a shape or an edge of a checkerboard may fall on either side of it.
    assert disagreements(original(path), again(from_mitsuba.load(path), tmp_path / "plain")) <= 0.004


@pytest.mark.parametrize("name", sorted(set(NAMES) - set(PLANE) - set(NO_PLAIN_SCENE) - {"glasses64", "mirage"}))
def test_curved_scenes_are_nearly_the_same(name, tmp_path):
    """Where the shapes are not grazed, and as near as the triangles are to the surface."""
    path = SCENES / f"{name}.xml"
    one, other = original(path), again(from_mitsuba.load(path, level=6), tmp_path / "plain")
    assert disagreements(one, other, tolerance=0.1) < 0.01
    for a, b in zip(one.shapes(), _united(other, one.shapes()), strict=True):
        extent = np.array(a.bbox().extents()).max()
        np.testing.assert_allclose(b, [list(a.bbox().min), list(a.bbox().max)], atol=2e-3 * extent)


@pytest.mark.parametrize("name", NO_PLAIN_SCENE)
def test_scenes_with_dispersion_or_absorption_are_refused(name):
    """Other renderers would show another image: an index at one wavelength, or clear glass."""
    with pytest.raises(ValueError, match=NO_PLAIN_SCENE[name]):
        from_mitsuba.load(SCENES / f"{name}.xml")


def _united(scene, shapes):
    """The bounding boxes of the plain meshes that came from each shape: both parts of a checkerboard."""
    boxes = {shape.id(): shape.bbox() for shape in scene.shapes()}
    for shape in shapes:
        box = boxes[shape.id()]
        if f"{shape.id()}_1" in boxes and f"{shape.id()}_1" not in [other.id() for other in shapes]:
            box.expand(boxes[f"{shape.id()}_1"])
        yield [list(box.min), list(box.max)]


@pytest.mark.parametrize("flip, side", [("", 1), ('<boolean name="flip_normals" value="true"/>', -1)])
def test_flipped_normals_stay_flipped(flip, side, scene, tmp_path):
    path = scene('<shape type="sphere" id="ball">', f'<shape type="cube" id="ball">{flip}')
    ray = mi.Ray3f([0.1, 0.2, -40], [0, 0, 1])
    for each in (original(path), again(from_mitsuba.load(path), tmp_path / "plain")):
        assert met(each, ray)[2:4] == [-1, side]


@pytest.mark.parametrize(
    "old, new",
    [
        ('<translate y="18"/>', '<translate y="18.2"/>'),
        ('angle="52"', 'angle="-52"'),
        ('name="fov" value="33"', 'name="fov" value="33.5"'),
        ('value="0.88, 0.82, 0.72"', 'value="0.45, 0.12, 0.14"'),
        ('<scale value="12"/>', '<scale x="12" y="13"/>'),
        ('value="0.70, 0.78, 0.90"', 'value="0.70, 0.79, 0.90"'),
        ('<string name="int_ior" value="bk7"/>', '<float name="int_ior" value="1.51"/>'),
        ('origin="-120, 150, 30" target="0, 0, 0"', 'origin="-120, 150, 30" target="-240, 300, 60"'),
    ],
)
def test_a_difference_is_seen(old, new, tmp_path):
    text = (SCENES / "prism.xml").read_text()
    assert old in text
    (tmp_path / "meshes").symlink_to(SCENES / "meshes")
    (tmp_path / "prism.xml").write_text(text.replace(old, new))
    other = again(from_mitsuba.load(tmp_path / "prism.xml"), tmp_path / "plain")
    assert disagreements(original(SCENES / "prism.xml"), other) > 0.004


CONSTANT = '<emitter type="constant"><rgb name="radiance" value="0.5, 0.25, 1"/></emitter>'
SKY = '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'


def test_the_smallest_map_and_image(scene, tmp_path):
    """A map of 2 × 2 pixels, black in part, as bright as it is; an image of one pixel."""
    pixels = np.array([[[0, 0.25, 0.5], [3, 4, 5]], [[6, 7, 8], [0, 0, 0]]], np.float32)
    image_file.write_exr(tmp_path / "sky.exr", pixels)
    film = '<integer name="width" value="16"/><integer name="height" value="8"/>'
    found = from_mitsuba.load(scene(CONSTANT, SKY, film, film.replace("16", "1").replace("8", "1")))
    np.testing.assert_array_equal(found.sky.pixels, pixels)
    assert (found.camera.width, found.camera.height) == (1, 1)


@pytest.mark.parametrize("content", [None, b"", b"no image", b"\x76\x2f\x31\x01\x02"])
def test_a_map_that_cannot_be_read_is_an_error_of_the_sky(content, scene, tmp_path):
    if content is not None:
        (tmp_path / "sky.exr").write_bytes(content)
    with pytest.raises(ValueError, match=r"scene\.xml: envmap.*sky\.exr.*; expected an OpenEXR file$"):
        from_mitsuba.load(scene(CONSTANT, SKY))


@pytest.mark.parametrize(
    ("text", "colour"),
    [
        ('<spectrum name="radiance" value="0.75"/>', (0.75, 0.75, 0.75)),
        ('<rgb name="radiance" value="0.75"/>', (0.75, 0.75, 0.75)),
        ('<float name="radiance" value="0"/>', (0, 0, 0)),
        ("", (1, 1, 1)),
    ],
)
def test_a_colour_of_one_number_is_grey(text, colour, scene):
    assert from_mitsuba.load(scene('<rgb name="radiance" value="0.5, 0.25, 1"/>', text), level=0).sky == colour


MAPS = {
    "one row": np.ones((1, 4, 3)),
    "one column": np.ones((4, 1, 3)),
    "grey": np.ones((4, 4, 1)),
    "alpha": np.ones((4, 4, 4)),
    "NaN": np.full((4, 4, 3), np.nan),
    "infinite": np.full((4, 4, 3), np.inf),
    "negative": np.full((4, 4, 3), -1e-3),
}


@pytest.mark.parametrize("case", MAPS)
def test_a_map_that_is_no_sky_is_refused(case, scene, tmp_path):
    pixels = MAPS[case].astype(np.float32)
    image_file.write_exr(tmp_path / "sky.exr", pixels, "RGBA"[: pixels.shape[2]])
    height, width, channels = pixels.shape
    with pytest.raises(ValueError, match=f"sky.exr: {width} × {height} × {channels}; expected finite RGB"):
        from_mitsuba.load(scene(CONSTANT, SKY))


def test_a_checkerboard_has_mitsubas_colours_where_none_are_given(scene):
    board = f'{AREA}{BOARD.replace("/>", "")}><transform name="to_uv"><scale value="0.5"/></transform></texture>'
    found = from_mitsuba.load(scene(LIGHT, board.replace("0.5", "1")), level=0)
    texture = mi.load_dict({"type": "checkerboard"})
    si, colours = mi.SurfaceInteraction3f(), []
    for u in (0.25, 0.75):
        si.uv = [u, 0.25]
        colours.append(texture.eval(si)[0])
    assert [mesh.material for mesh in found.meshes[2:]] == [
        Light((x, x, x)) for x in (pytest.approx(c) for c in colours)
    ]
    assert len(from_mitsuba.load(scene(LIGHT, board), level=0).meshes) == 3  # one cell: one colour


# --- what cannot be said ---------------------------------------------------------------------------------


@pytest.mark.parametrize("value", ['<string name="radiance" value="red"/>', TURN])
def test_what_is_no_colour_is_refused_in_one_line(scene, value):
    path = scene('<rgb name="radiance" value="0.5, 0.25, 1"/>', value)
    with pytest.raises(ValueError, match=r"constant: radiance = .*; expected an RGB colour of finite") as error:
        from_mitsuba.load(path)
    assert "\n" not in str(error.value)


BALL = 'type="sphere" id="ball">'
MOVED = '<transform name="to_world"><translate x="3"/></transform>'
AREA = '<shape type="rectangle"><emitter type="area">'
LIGHT = f'{AREA}<rgb name="radiance" value="2"/>'
BOARD = '<texture type="checkerboard" name="radiance"/>'
REFUSED = {
    "integrator": ('type="path"', 'type="ptracer"', "ptracer"),
    "endless": ('value="5"', 'value="-1"', "max_depth = -1"),
    "sensor": ('"perspective"', '"thinlens"', "thinlens"),
    "filter": ('"box"', '"gaussian"', "gaussian"),
    "crop": ("<rfilter", '<integer name="crop_width" value="4"/><rfilter', "crop_width"),
    "two skies": ("</scene>", '<emitter type="constant"/></scene>', "emitter too many"),
    "point light": ("</scene>", '<emitter type="point"/></scene>', "emitter too many"),
    "rough": ('type="$bsdf"', 'type="roughdielectric"', "roughdielectric"),
    "tinted": ("<string", '<float name="specular_transmittance" value="0.5"/><string', "specular_transmittance"),
    "index": ('"water"', '"nonsense"', "unknown material"),
    "shape": ('type="cube"', 'type="sdfgrid"', "sdfgrid"),
    "mirrored": ('<translate x="3"/>', '<scale x="-1"/>', "mirrors"),
    "flat": ('<translate x="3"/>', '<scale x="0"/>', "mirrors or flattens"),
    "one-sided": ('type="cube"', 'type="rectangle"', "one side of an open surface"),
    "texture": (LIGHT, f'{AREA}<texture type="bitmap" name="radiance"/>', "bitmap"),
    "round board": (LIGHT, f"{AREA.replace('rectangle', 'disk')}{BOARD}", "a checkerboard"),
    "medium": ("<bsdf", '<medium type="homogeneous" name="interior"/><bsdf', "a medium of a shape"),
    "reflecting lamp": ('<emitter type="area">', '<bsdf type="diffuse"/><emitter type="area">', "BSDF of a lamp"),
    "unknown parameter": ('<translate x="3"/>', '<nonsense x="3"/>', "nonsense"),
    "syntax": ("</scene>", "", "scene.xml"),
    "negative": ('"0.5, 0.25, 1"', '"0.5, -0.25, 1"', "at least 0"),
    "text for a number": ('<float name="fov" value="40"/>', '<string name="fov" value="40"/>', "fov = 40"),
    "no angle": ('<float name="fov" value="40"/>', "", "fov = None"),
    "flat angle": ('name="fov" value="40"', 'name="fov" value="180"', "fov = 180"),
    "no pixel": ('name="width" value="16"', 'name="width" value="0"', "0 × 8"),
    "no radius": (BALL, f'{BALL}<float name="radius" value="0"/>', "radius = 0"),
    "infinite": (BALL, f'{BALL}<float name="radius" value="inf"/>', "radius = inf"),
    "no point": (BALL, f'{BALL}<float name="center" value="1"/>', "center = 1"),
    "no transform": (MOVED, '<float name="to_world" value="1"/>', "to_world"),
    "cells": (
        LIGHT,
        f'{AREA}<texture type="checkerboard" name="radiance"><transform name="to_uv"><scale value="1e9"/></transform>'
        "</texture>",
        "8000000000000000000 triangles where",
    ),
    "pipe": (BALL, 'type="ply"><string name="filename" value="/dev/zero"/>', "/dev/zero: not a regular file"),
    "far away": ('<translate x="3"/>', '<scale value="1e31"/>', "coordinates beyond 1e+30"),
    "missing mesh": (BALL, 'type="ply"><string name="filename" value="no.ply"/>', "no.ply"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case, scene):
    old, new, word = REFUSED[case]
    with pytest.raises(ValueError, match=re.escape(word)) as caught:
        from_mitsuba.load(scene(old, new))
    message = str(caught.value)
    assert "\n" not in message and ("expected" in message or "scene.xml" in message)


def test_smooth_normals_are_refused(scene, tmp_path):
    (tmp_path / "prism.ply").write_bytes((SCENES / "meshes" / "prism.ply").read_bytes())
    ply = 'type="ply" id="ball"><string name="filename" value="prism.ply"/>'
    with pytest.raises(ValueError, match="smooth normals"):
        from_mitsuba.load(scene('type="sphere" id="ball">', ply))
    flat = f'{ply}<boolean name="face_normals" value="true"/>'
    assert len(from_mitsuba.load(scene('type="sphere" id="ball">', flat)).meshes[0].faces) == 8


def write_ply(path, last):
    corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_text(head + "".join("{} {} {}\n".format(*corner) for corner in corners) + f"3 0 1 {last}\n")


@pytest.mark.parametrize("last, smooth", [(3, False), (10**9, False), (2**32 - 1, False), (10**9, True)])
def test_a_face_without_its_vertices_is_refused(last, smooth, scene, tmp_path):
    shape = 'type="ply" id="ball"><string name="filename" value="m.ply"/><boolean name="face_normals" value="true"/>'
    path = scene('type="sphere" id="ball">', shape)
    write_ply(tmp_path / "m.ply", 2)
    assert len(from_mitsuba.load(path).meshes[0].faces) == 1
    write_ply(tmp_path / "m.ply", last)
    if smooth:  # Mitsuba writes a normal for each vertex of a face
        path.write_text(
            path.read_text().replace('name="face_normals" value="true"', 'name="face_normals" value="false"')
        )
    with pytest.raises(ValueError, match=r"^[^\n]*m\.ply[^\n]*expected [^\n]*$"):
        from_mitsuba.load(path)


def first_shape(path):
    scene = SceneFile(path, {})
    return next(child for child in scene.node(0).children() if child.kind == "Shape")


LAMP = '<emitter type="area"><rgb name="radiance" value="2"/></emitter>'
SCALED = (
    '<texture type="checkerboard" name="radiance"><transform name="to_uv"><scale x="{}" y="{}"/></transform></texture>'
)
BOARDS = {"board 2 × 3": (2, 3, 48), "board 1.3 × 0.4": (1.3, 0.4, 6), "board of one cell": (0.2, 0.2, 2)}


@pytest.mark.parametrize("name", [*meshes_from_shapes.SHAPES, *BOARDS])
def test_triangles_are_counted_before_they_are_made(name, tmp_path):
    """The count is the number that is made; a level or a scale that no machine could make is an error at once."""
    path = tmp_path / "scene.xml"
    if name in BOARDS:
        *scales, count = BOARDS[name]
        shape = f"{AREA}{SCALED.format(*scales)}</emitter></shape>"
    else:
        count = {"sphere": 320, "cylinder": 64, "disk": 32, "cube": 12, "rectangle": 2}[name]
        shape = f'<shape type="{name}">{LAMP}</shape>'
    path.write_text(f'<scene version="3.0.0">{shape}</scene>')
    made = sum(len(mesh.faces) for mesh in meshes_from_shapes.meshes_of_shape(first_shape(path), 2, count))
    assert made == count
    with pytest.raises(ValueError, match=f": {count} triangles where {count - 1} are left; expected "):
        next(meshes_from_shapes.meshes_of_shape(first_shape(path), 2, count - 1))
    if name in BOARDS:
        path.write_text(path.read_text().replace('scale x="', 'scale x="999999999', 1))
    if name not in ("cube", "rectangle"):
        with pytest.raises(ValueError, match="triangles where 16777216 are left"):
            next(meshes_from_shapes.meshes_of_shape(first_shape(path), 60))


@pytest.mark.parametrize("end", [(0, 0, 2), (0, 0, -2), (1, 0, -1e-9), (3, -1, 2)])
def test_a_cylinder_lies_around_its_axis_and_faces_outward(end, tmp_path):
    ends = '<point name="p0" x="1" y="2" z="3"/><point name="p1" x="{}" y="{}" z="{}"/>'.format(*np.add(end, (1, 2, 3)))
    path = tmp_path / "scene.xml"
    path.write_text(
        f'<scene version="3.0.0"><shape type="cylinder"><float name="radius" value="0.5"/>{ends}{LAMP}</shape></scene>'
    )
    (mesh,) = meshes_from_shapes.meshes_of_shape(first_shape(path), 2)
    axis, places = np.divide(end, np.linalg.norm(end)), mesh.vertices - (1, 2, 3)
    np.testing.assert_allclose(np.linalg.norm(np.cross(places, axis), axis=1), 0.5, rtol=1e-12)
    assert {round(float(x), 9) for x in places @ axis} == {0, round(float(np.linalg.norm(end)), 9)}
    a, b, c = (mesh.triangles() - (1, 2, 3)).swapaxes(0, 1)
    outward = a - (a @ axis)[:, None] * axis
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), outward) > 0).all()


def test_other_errors(scene):
    without = re.search("<sensor.*</sensor>", SCENE, re.DOTALL)[0]
    with pytest.raises(ValueError, match="no sensor"):
        from_mitsuba.load(scene(without, ""))
    with pytest.raises(ValueError, match="no integrator"):
        from_mitsuba.load(scene('<integrator type="path"><integer name="max_depth" value="5"/></integrator>', ""))
    with pytest.raises(FileNotFoundError):
        from_mitsuba.load("none.xml")
    with pytest.raises(ValueError, match=r"level = 9; expected a whole number from 0 to 8$"):
        from_mitsuba.load(scene(), level=9)
    with pytest.raises(ValueError, match="oops"):
        from_mitsuba.load(scene(), oops="1")


def test_children_may_have_names(scene):
    path = scene('<shape type="cube"', '<shape name="second" type="cube"', "<bsdf", '<bsdf name="glass"')
    assert [mesh.name for mesh in from_mitsuba.load(path, level=0).meshes] == ["ball", "box", "rectangle"]


def test_names_are_unique(scene):
    text = "".join(f'<shape type="sphere" id="{name}"><bsdf type="$bsdf"/></shape>' for name in ("a b", "A.b"))
    names = [mesh.name for mesh in from_mitsuba.load(scene("</scene>", f"{text}</scene>"), level=0).meshes]
    assert names[-2:] == ["a_b", "A_b_2"] and len({name.lower() for name in names}) == len(names)

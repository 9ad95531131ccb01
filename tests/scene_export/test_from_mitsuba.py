"""A plain scene equals the scene that Mitsuba loads from the file; unsupported content is an error.

Rays are traced through the original and through the plain scene, exported and loaded by Mitsuba. They must hit a
surface of the same material at the same place and on the same side; rays that hit nothing must see the same sky.
"""

import itertools
import re

import mitsuba as mi
import numpy as np
import OpenImageIO as oiio
import pytest

from mi_refract import SCENES
from mi_refract.io import image_file
from mi_refract.io.errors import ExportError
from mi_refract.rendering.scene_files import load_scene
from mi_refract.scene_export import from_mitsuba, meshes_from_shapes, targets, tessellation
from mi_refract.scene_export.mitsuba_nodes import SceneFile
from mi_refract.scene_export.plain_scene import Diffuse, DirectionalLamp, Glass, Light, PointLamp, SpotLamp

PLANE = ["diamond", "lightpipe", "nested", "prism", "slab"]  # scenes without curved surfaces
# Scenes that other targets than glTF, or all, refuse because their image would differ; and the message.
NO_PLAIN_SCENE = {
    "diamond_fire": "brilliant: int_ior = MATERIAL:diamond; expected one number for all wavelengths .* --to gltf$",
    "dispersive_prism": r"prism: int_ior = sellmeier\(.*\); expected one number for all wavelengths",
    "green_bottle": "bottle_outer: int_colour; expected .* no absorption",
    "spectrum_on_screen": "roughconductor: this BSDF is not supported",
    "rainbow_drop": "drop: int_ior = MATERIAL:water; expected one number for all wavelengths",
}
LEFT_OUT = {"glasses64", "mirage"}  # large scenes that test nothing new
pytestmark = pytest.mark.usefixtures("scalar_variant")

CONSTANT = '<emitter type="constant"><rgb name="radiance" value="0.5, 0.25, 1"/></emitter>'
SKY = '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
FILM = '<integer name="width" value="16"/><integer name="height" value="8"/>'
SCENE = f"""<scene version="3.0.0">
  <default name="bsdf" value="refract"/>
  <integrator type="path"><integer name="max_depth" value="5"/></integrator>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0,1,-40" target="0,0,0" up="0,1,0"/></transform>
    <float name="fov" value="40"/>
    <film type="hdrfilm">{FILM}<rfilter type="box"/></film>
  </sensor>
  {CONSTANT}
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
        (tmp_path / "scene.xml").write_text(text)
        return tmp_path / "scene.xml"

    return write


def test_load(scene):
    plain = from_mitsuba.load(scene(), level=1)
    ball, box, lamp = plain.meshes
    assert (ball.name, box.name, lamp.name) == ("ball", "box", "rectangle")
    assert ball.material == Glass(1.333, 1.000277) and len(ball.faces) == 80
    np.testing.assert_allclose(ball.vertices.mean(0), 0, atol=1e-12)
    assert box.material == Diffuse((0.5, 0.5, 0.5)) and box.vertices.min(0).tolist() == [2, -1, -1]
    assert lamp.material == Light((2, 2, 2)) and plain.sky == (0.5, 0.25, 1)
    assert (plain.name, plain.max_depth, len(plain.materials)) == ("scene", 5, 3)
    assert (plain.camera.width, plain.camera.height, plain.camera.origin) == (16, 8, (0, 1, -40))
    for name in ("dielectric", "refract_promoted"):
        assert from_mitsuba.load(scene(), defines={"bsdf": name}).meshes[0].material == Glass(1.333, 1.000277)
    clear = '<float name="int_absorption" value="0"/><rgb name="ext_colour" value="1"/>'
    clear += '<float name="ext_colour_distance" value="8"/>'
    assert from_mitsuba.load(scene("<string", f"{clear}<string")).meshes[0].material == Glass(1.333, 1.000277)
    level = from_mitsuba.load(scene('value="5"', 'value="$level"'), level=0, defines={"level": "1"})
    assert level.max_depth == 1
    path_with_names = scene('<shape type="cube"', '<shape name="second" type="cube"', "<bsdf", '<bsdf name="glass"')
    assert [mesh.name for mesh in from_mitsuba.load(path_with_names, level=0).meshes] == ["ball", "box", "rectangle"]
    text = "".join(f'<shape type="sphere" id="{name}"><bsdf type="$bsdf"/></shape>' for name in ("a b", "A.b"))
    names = [mesh.name for mesh in from_mitsuba.load(scene("</scene>", f"{text}</scene>"), level=0).meshes]
    assert names[-2:] == ["a_b", "A_b_2"]  # unique even ignoring case


LAMPS = {
    '<emitter type="point" id="a b"/>': PointLamp("a_b", (0, 0, 0), (1, 1, 1)),
    '<emitter type="point"><rgb name="intensity" value="1, 0, 2"/><point name="position" value="1, 2, 3"/></emitter>': (
        PointLamp("point", (1, 2, 3), (1, 0, 2))
    ),
    '<emitter type="point"><transform name="to_world"><scale value="2"/><translate x="4"/></transform></emitter>': (
        PointLamp("point", (4, 0, 0), (1, 1, 1))
    ),
    '<emitter type="spot"/>': SpotLamp("spot", (0, 0, 0), (1, 1, 1), (0, 0, 1), 15, 20),
    '<emitter type="spot"><float name="cutoff_angle" value="40"/><float name="beam_width" value="50"/>'
    '<transform name="to_world"><lookat origin="1, 2, 3" target="1, -5, 3" up="0, 0, 1"/></transform></emitter>': (
        SpotLamp("spot", (1, 2, 3), (1, 1, 1), (0, -1, 0), 40, 40)
    ),
    '<emitter type="directional" id="BALL"/>': DirectionalLamp("BALL_2", (0, 0, 1), (1, 1, 1)),
    '<emitter type="directional"><vector name="direction" x="0" y="3" z="-4"/>'
    '<rgb name="irradiance" value="1, 0, 2"/></emitter>': DirectionalLamp("directional", (0, 0.6, -0.8), (1, 0, 2)),
}


@pytest.mark.parametrize("text", LAMPS)
def test_lamps_without_size(text, scene):
    """With Mitsuba's defaults, beside a sky, with names that no mesh has."""
    plain = from_mitsuba.load(scene("</scene>", f"{text}</scene>"), level=0)
    assert plain.lamps == (LAMPS[text],) and plain.sky == (0.5, 0.25, 1) and len(plain.meshes) == 3


# --- the same geometry, materials and sky ----------------------------------------------------------------


def exported(plain, folder):
    """Export the plain scene and load it with Mitsuba."""
    targets.write(plain, "mitsuba", folder)
    return original(folder / "scene.xml")


def original(path):
    return mi.load_file(str(path), optimize=False, parallel=False, bsdf="dielectric")


@pytest.mark.parametrize("axis", ["x", "y", "larger", "smaller", "diagonal"])
def test_field_of_view(scene, axis, tmp_path):
    path = scene('<float name="fov"', f'<string name="fov_axis" value="{axis}"/><float name="fov"')
    both = original(path), exported(from_mitsuba.load(path), tmp_path / "plain")
    for corner in ((0, 0), (1, 0.25)):
        rays = [x.sensors()[0].sample_ray(0, 0.5, mi.Point2f(corner), mi.Point2f(0.5))[0].d for x in both]
        np.testing.assert_allclose(*rays, atol=1e-6)


@pytest.mark.parametrize("distance", [1e-3, 1e2, 1e5, 1e9])
def test_the_direction_of_a_camera_survives_float32(distance, scene):
    """Cycles and LuxCore compute it from points in float32."""
    origin = distance * np.array([0.61, -0.7, 0.37])
    camera = from_mitsuba.load(scene("0,1,-40", ", ".join(map(repr, origin.tolist()))), level=0).camera
    direction = np.subtract(camera.target, camera.origin, dtype=np.float32)
    np.testing.assert_allclose(direction / np.linalg.norm(direction), -origin / np.linalg.norm(origin), atol=2**-22)


def hit(scene, ray):
    """Return seven numbers of a ray's hit: the point, a code, and the index ratio, a colour or a radiance.

    The code is the side of glass, ±1; 2 for a light, 3 for a diffuse surface, 0 for the sky.
    """
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


def disagreements(scene, other, tolerance=1e-3, count=1500):
    """Return the share of rays with different hits: camera rays, and rays in random directions from their hits."""
    rng, different, total = np.random.default_rng(9), 0, 0
    for u, direction in zip(rng.random((count, 2)), rng.normal(size=(count, 3)), strict=True):
        ray, _ = scene.sensors()[0].sample_ray(0, 0.5, mi.Point2f(u), mi.Point2f(0.5))
        other_ray, _ = other.sensors()[0].sample_ray(0, 0.5, mi.Point2f(u), mi.Point2f(0.5))
        si = scene.ray_intersect(ray)
        second = si.spawn_ray(mi.Vector3f(direction / np.linalg.norm(direction))) if si.is_valid() else ray
        for a, b in ((ray, other_ray), (second, second)):
            different += not np.allclose(hit(scene, a), hit(other, b), rtol=tolerance, atol=tolerance)
            total += 1
    return different / total


@pytest.mark.parametrize("name", sorted({path.stem for path in SCENES.glob("*.xml")} - LEFT_OUT))
def test_package_scenes_are_equal_or_refused(name, tmp_path):
    """Up to rays that graze shapes or edges of a checkerboard, and up to the tessellation of curved surfaces."""
    path = SCENES / f"{name}.xml"
    if name in NO_PLAIN_SCENE:
        with pytest.raises(ExportError, match=NO_PLAIN_SCENE[name]):
            exported(from_mitsuba.load(path, level=0), tmp_path / "plain")
        return
    scene, plain = original(path), exported(from_mitsuba.load(path, level=6), tmp_path / "plain")
    assert disagreements(scene, plain, *([] if name in PLANE else [0.1])) <= (0.004 if name in PLANE else 0.01)
    boxes, names = {shape.id(): shape.bbox() for shape in plain.shapes()}, {shape.id() for shape in scene.shapes()}
    for shape in scene.shapes():
        box, expected, second = boxes[shape.id()], shape.bbox(), f"{shape.id()}_1"
        if second in boxes and second not in names:  # the second part of a checkerboard
            box.expand(boxes[second])
        tolerance = 2e-3 * np.array(expected.extents()).max()
        np.testing.assert_allclose(
            [list(box.min), list(box.max)], [list(expected.min), list(expected.max)], atol=tolerance
        )


@pytest.mark.parametrize("flip, side", [("", 1), ('<boolean name="flip_normals" value="true"/>', -1)])
def test_flipped_normals_stay_flipped(flip, side, scene, tmp_path):
    path = scene('<shape type="sphere" id="ball">', f'<shape type="cube" id="ball">{flip}')
    ray = mi.Ray3f([0.1, 0.2, -40], [0, 0, 1])
    for loaded in (original(path), exported(from_mitsuba.load(path), tmp_path / "plain")):
        assert hit(loaded, ray)[2:4] == [-1, side]


@pytest.mark.parametrize(
    "old, new",
    [
        ('<translate y="18"/>', '<translate y="18.2"/>'),
        ('name="fov" value="33"', 'name="fov" value="33.5"'),
        ('value="0.88, 0.82, 0.72"', 'value="0.45, 0.12, 0.14"'),
        ('value="0.70, 0.78, 0.90"', 'value="0.70, 0.79, 0.90"'),
        ('<float name="int_ior" value="1.5168"/>', '<float name="int_ior" value="1.52"/>'),
        ('origin="-120, 150, 30" target="0, 0, 0"', 'origin="-120, 150, 30" target="-240, 300, 60"'),
    ],
)
def test_disagreements_detect_a_difference(old, new, tmp_path):
    text = (SCENES / "prism.xml").read_text()
    assert old in text
    (tmp_path / "meshes").symlink_to(SCENES / "meshes")
    (tmp_path / "prism.xml").write_text(text.replace(old, new))
    other = exported(from_mitsuba.load(tmp_path / "prism.xml"), tmp_path / "plain")
    assert disagreements(original(SCENES / "prism.xml"), other) > 0.004


@pytest.mark.parametrize("value", ["0.75", "0.123456789"])
def test_a_uniform_spectrum_is_tinted_as_a_lamp_and_grey_as_a_reflectance(value, scene):
    """In RGB, light of equal energy at all wavelengths is (1.20, 0.95, 0.91); Mitsuba's own colours, to float32."""
    light, grey = (f'<spectrum name="{name}" value="{value}"/>' for name in ("radiance", "reflectance"))
    lights = '<rgb name="radiance" value="0.5, 0.25, 1"/>', light, '<rgb name="radiance" value="2"/>', light
    path = scene(*lights, 'type="cube" id="box">', f'type="cube" id="box"><bsdf type="diffuse">{grey}</bsdf>')
    plain, si, mitsuba_scene = from_mitsuba.load(path, level=0), mi.SurfaceInteraction3f(), original(path)
    si.wi = mi.Vector3f(0, 0, 1)
    _, box, lamp = plain.meshes
    (emitter,) = (shape.emitter() for shape in mitsuba_scene.shapes() if shape.is_emitter())
    (bsdf,) = (shape.bsdf() for shape in mitsuba_scene.shapes() if shape.id() == "box")
    expected = [mitsuba_scene.environment().eval(si), emitter.eval(si), bsdf.eval_diffuse_reflectance(si)]
    colours = [plain.sky, lamp.material.radiance, box.material.reflectance]
    np.testing.assert_allclose(colours, np.array(expected), rtol=1e-6)


@pytest.mark.parametrize("size", [1e-7, 1e-3, 1e3, 1e6, 1e12])
def test_clip_planes_hide_nothing_at_any_scale(size, scene, tmp_path):
    path = scene(
        *('origin="0,1,-40" target="0,0,0"', f'origin="0,0,{-4 * size!r}" target="0,0,0"'),
        *('id="ball">', f'id="ball"><float name="radius" value="{size!r}"/>'),
    )
    exported_scene = exported(from_mitsuba.load(path, level=1), tmp_path / "plain")
    ray, _ = exported_scene.sensors()[0].sample_ray(0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5))
    ball = exported_scene.ray_intersect(ray)
    assert ball.is_valid() and ball.p.z == pytest.approx(-size, rel=0.3)


def test_grey_colours_and_the_smallest_map_and_image(scene, tmp_path):
    """A map of 2 × 2 pixels, partly black; an image of one pixel."""
    for text, colour in (
        ('<rgb name="radiance" value="0.75"/>', (0.75, 0.75, 0.75)),
        ('<float name="radiance" value="0"/>', (0, 0, 0)),
        ("", (1, 1, 1)),
    ):
        assert from_mitsuba.load(scene('<rgb name="radiance" value="0.5, 0.25, 1"/>', text), level=0).sky == colour
    pixels = np.array([[[0, 0.25, 0.5], [3, 4, 5]], [[6, 7, 8], [0, 0, 0]]], np.float32)
    image_file.write_exr(tmp_path / "sky.exr", pixels)
    plain = from_mitsuba.load(scene(CONSTANT, SKY, FILM, FILM.replace("16", "1").replace("8", "1")))
    np.testing.assert_array_equal(plain.sky.pixels, pixels[[0, 1, 1]])
    assert (plain.camera.width, plain.camera.height) == (1, 1)


PRIMARIES = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)  # of ACES


@pytest.mark.parametrize("channels, primaries", [("RGB", ()), ("XYZ", ()), ("RGB", PRIMARIES)])
def test_the_sky_has_the_colours_that_mitsuba_reads(channels, primaries, scene, tmp_path):
    spec = oiio.ImageSpec(4, 3, 3, "float")
    spec.channelnames = tuple(channels)
    if primaries:
        spec.attribute("chromaticities", "float[8]", primaries)
    output = oiio.ImageOutput.create(str(tmp_path / "sky.exr"))
    pixels = np.random.default_rng(0).uniform(0.8, 1, (3, 4, 3)).astype(np.float32)
    if channels == "XYZ":
        pixels[0, 0] = image_file.TO_XYZ @ [1, 0, 0]  # Mitsuba's conversion gives −2e-7 for green
    assert output.open(str(tmp_path / "sky.exr"), spec) and output.write_image(pixels) and output.close()
    envmap = mi.load_dict({"type": "envmap", "filename": str(tmp_path / "sky.exr")})
    expected = np.array(mi.traverse(envmap)["data"])[:, 1:5]  # between columns that Mitsuba repeats
    made = from_mitsuba.load(scene(CONSTANT, SKY)).sky.pixels
    np.testing.assert_allclose(made, expected, rtol=1e-5, atol=1e-6)
    assert (made >= 0).all()


MAPS = {
    "4 × 1 pixels of R, G, B; expected at least 2 × 2": np.ones((1, 4, 3)),
    "1 × 4 pixels of R, G, B; expected at least 2 × 2": np.ones((4, 1, 3)),
    "4 × 4 pixels of R; expected": np.ones((4, 4, 1)),
    "4 × 4 pixels of R, G, B, A; expected": np.ones((4, 4, 4)),
    "2 × 2 pixels of R, G, B; expected .* finite": np.full((2, 2, 3), np.nan),
    "3 × 3 pixels of R, G, B; expected .* not negative": np.full((3, 3, 3), -1e-3),
    "5 × 5 pixels of R, G, B; expected .* finite": np.full((5, 5, 3), np.inf),
    "expected an OpenEXR file": b"no image",
    "; expected an OpenEXR file": None,
}


@pytest.mark.parametrize("message", MAPS)
def test_an_invalid_map_of_the_sky_is_refused(message, scene, tmp_path):
    content = MAPS[message]
    if isinstance(content, bytes):
        (tmp_path / "sky.exr").write_bytes(content)
    elif content is not None:
        image_file.write_exr(tmp_path / "sky.exr", content.astype(np.float32), "RGBA"[: content.shape[2]])
    with pytest.raises(ValueError, match=rf"^[^\n]*scene\.xml: envmap[^\n]*sky\.exr[^\n]*{message}[^\n]*$"):
        from_mitsuba.load(scene(CONSTANT, SKY))


# --- unsupported content ---------------------------------------------------------------------------------

BALL = 'type="sphere" id="ball">'
MOVED = '<transform name="to_world"><translate x="3"/></transform>'
AREA = '<shape type="rectangle"><emitter type="area">'
LIGHT = f'{AREA}<rgb name="radiance" value="2"/>'
LAMP = '<emitter type="area"><rgb name="radiance" value="2"/></emitter>'
BOARD = (
    '<texture type="checkerboard" name="radiance"><transform name="to_uv"><scale x="{}" y="{}"/></transform></texture>'
)
COLOUR = '<rgb name="radiance" value="0.5, 0.25, 1"/>'
TURN = '<transform name="radiance"><rotate x="1" angle="30"/></transform>'
POSITION, DIRECTION = '<point name="position" x="1" y="2" z="3"/>', '<vector name="direction" x="0" y="2" z="0"/>'
SHIFT = '<transform name="to_world"><translate x="1" y="2" z="3"/></transform>'


def lamps(text):
    return "</scene>", f"{text}</scene>"


REFUSED = {
    "ptracer": ('type="path"', 'type="ptracer"'),
    "max_depth = -1": ('value="5"', 'value="-1"'),
    "thinlens": ('"perspective"', '"thinlens"'),
    "gaussian": ('"box"', '"gaussian"'),
    "the filter gaussian, by default; expected": ('<rfilter type="box"/>', ""),
    "specfilm: a film": ('"hdrfilm"', '"specfilm"'),
    "no film": (re.search("<film.*</film>", SCENE)[0], ""),
    "crop_width": ("<rfilter", '<integer name="crop_width" value="4"/><rfilter'),
    "emitter too many": ("</scene>", '<emitter type="constant"/></scene>'),
    "projector": ("</scene>", '<emitter type="projector"/></scene>'),
    "texture is not supported": lamps('<emitter type="spot"><texture type="bitmap" name="texture"/></emitter>'),
    "position is not supported": lamps(f'<emitter type="point">{POSITION}{SHIFT}</emitter>'),
    "direction is not supported": lamps(f'<emitter type="directional">{DIRECTION}{SHIFT}</emitter>'),
    "direction = 0, 0, 0": lamps(f'<emitter type="directional">{DIRECTION.replace("2", "0")}</emitter>'),
    "spot: to_world is not a rotation": lamps(f'<emitter type="spot">{SHIFT.replace("translate", "scale")}</emitter>'),
    "cutoff_angle = 0.0, beam": lamps('<emitter type="spot"><float name="cutoff_angle" value="0"/></emitter>'),
    "beam_width = -1.0": lamps('<emitter type="spot"><float name="beam_width" value="-1"/></emitter>'),
    "point: intensity = ": lamps('<emitter type="point"><spectrum name="intensity" value="400:1, 700:2"/></emitter>'),
    "sampling_weight = 0": lamps('<emitter type="point"><float name="sampling_weight" value="0"/></emitter>'),
    "roughdielectric": ('type="$bsdf"', 'type="roughdielectric"'),
    "specular_transmittance": ("<string", '<float name="specular_transmittance" value="0.5"/><string'),
    "scene.xml: dielectric: int_ior = 'nonsense': unknown material": (
        '<bsdf type="$bsdf"><string name="int_ior" value="water"/>',
        '<bsdf type="dielectric"><string name="int_ior" value="nonsense"/>',
    ),
    "int_ior = SCHOTT:N-BK7; expected a name that Mitsuba knows": (
        '<bsdf type="$bsdf"><string name="int_ior" value="water"/>',
        '<bsdf type="dielectric"><string name="int_ior" value="SCHOTT:N-BK7"/>',
    ),
    "scene.xml: refract: int_ior is a checkerboard": (
        '<string name="int_ior" value="water"/>',
        '<texture type="checkerboard" name="int_ior"/>',
    ),
    "scene.xml: refract: table(600: 1.5, 700: 1.4)": ('"water"', '"table(600: 1.5, 700: 1.4)"'),
    "sdfgrid": ('type="cube"', 'type="sdfgrid"'),
    "mirrors": ('<translate x="3"/>', '<scale x="-1"/>'),
    "mirrors or flattens": ('<translate x="3"/>', '<scale x="0"/>'),
    "rotations about axes of length 1": ('<translate x="3"/>', '<rotate x="1" y="1" angle="45"/>'),
    "to_world deforms the sphere": (BALL, f'{BALL}<transform name="to_world"><scale x="2" y="1" z="1"/></transform>'),
    "to_world deforms the cylinder": (
        'type="cube" id="box"><transform name="to_world"><translate x="3"/></transform>',
        f'type="cylinder"><transform name="to_world"><scale x="2" y="1" z="3"/></transform>{LAMP}',
    ),
    "around the camera": ('<translate x="3"/>', '<scale value="99"/>'),
    "twosided: a dielectric; expected a BSDF that transmits nothing": (
        'id="box">',
        'id="box"><bsdf type="twosided"><bsdf type="dielectric"/></bsdf>',
    ),
    "diffuse: a reflectance of 2; expected at most 1": (
        'id="box">',
        'id="box"><bsdf type="diffuse"><rgb name="reflectance" value="0.5, 2, 0"/></bsdf>',
    ),
    "envmap: scale = -1.0": (CONSTANT, SKY.replace("/></", '/><float name="scale" value="-1"/></')),
    "one side of an open surface": ('type="cube"', 'type="rectangle"'),
    "bitmap": (LIGHT, f'{AREA}<texture type="bitmap" name="radiance"/>'),
    "a checkerboard": (LIGHT, f"{AREA.replace('rectangle', 'disk')}{BOARD.format(1, 1)}"),
    "a medium of a shape": ("<bsdf", '<medium type="homogeneous" name="interior"/><bsdf'),
    "BSDF of a lamp": ('<emitter type="area">', '<bsdf type="diffuse"/><emitter type="area">'),
    "nonsense": ('<translate x="3"/>', '<nonsense x="3"/>'),
    "scene.xml": ("</scene>", ""),
    "at least 0": ('"0.5, 0.25, 1"', '"0.5, -0.25, 1"'),
    "constant: radiance = red; expected an RGB colour": (COLOUR, '<string name="radiance" value="red"/>'),
    "; expected an RGB colour of finite": (COLOUR, TURN),
    "fov = 40": ('<float name="fov" value="40"/>', '<string name="fov" value="40"/>'),
    "fov = None": ('<float name="fov" value="40"/>', ""),
    "fov = 180": ('name="fov" value="40"', 'name="fov" value="180"'),
    "0 × 8": ('name="width" value="16"', 'name="width" value="0"'),
    "radius = 0": (BALL, f'{BALL}<float name="radius" value="0"/>'),
    "radius = inf": (BALL, f'{BALL}<float name="radius" value="inf"/>'),
    "center = 1": (BALL, f'{BALL}<float name="center" value="1"/>'),
    "to_world": (MOVED, '<float name="to_world" value="1"/>'),
    "8000000000000000000 triangles where": (LIGHT, f"{AREA}{BOARD.format(1e9, 1e9)}"),
    "/dev/zero: not a regular file": (BALL, 'type="ply"><string name="filename" value="/dev/zero"/>'),
    "coordinates beyond 1e+30": ('<translate x="3"/>', '<scale value="1e31"/>'),
    "no.ply": (BALL, 'type="ply"><string name="filename" value="no.ply"/>'),
    "no sensor": (re.search("<sensor.*</sensor>", SCENE, re.DOTALL)[0], ""),
    "no integrator": ('<integrator type="path"><integer name="max_depth" value="5"/></integrator>', ""),
}


@pytest.mark.parametrize("message", REFUSED)
def test_unsupported_content_is_refused(message, scene):
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        from_mitsuba.load(scene(*REFUSED[message]))
    text = str(caught.value)
    assert "\n" not in text and ("expected" in text or "scene.xml" in text)


def test_an_axis_of_six_digits_is_exact_enough_under_any_scale(scene):
    axis = '<scale x="1000" y="0.001"/><rotate x="0.267261" y="0.534522" z="0.801784" angle="37"/>'
    assert from_mitsuba.load(scene('<translate x="3"/>', axis)).meshes


def test_other_errors(scene):
    with pytest.raises(FileNotFoundError):
        from_mitsuba.load("none.xml")
    with pytest.raises(ValueError, match=r"level = 9; expected a whole number from 0 to 8$"):
        from_mitsuba.load(scene(), level=9)
    with pytest.raises(ValueError, match="oops"):
        from_mitsuba.load(scene(), defines={"oops": "1"})


def test_vertices_without_a_face_are_left_out(scene, tmp_path):
    vertices, faces = tessellation.cube()
    rows = [*vertices.tolist(), [1e6, 0, 0]]
    head = f"ply\nformat ascii 1.0\nelement vertex {len(rows)}\n" + "".join(f"property float {x}\n" for x in "xyz")
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    lines = [" ".join(map(str, row)) for row in rows] + [f"3 {a} {b} {c}" for a, b, c in faces]
    (tmp_path / "m.ply").write_text(head + "\n".join(lines) + "\n")
    ply = 'type="ply"><string name="filename" value="m.ply"/><boolean name="face_normals" value="true"/>'
    mesh = from_mitsuba.load(scene(BALL, ply)).meshes[0]
    assert np.array_equal(mesh.vertices[mesh.faces], vertices[faces])


def test_smooth_normals_are_refused(scene, tmp_path):
    (tmp_path / "prism.ply").write_bytes((SCENES / "meshes" / "prism.ply").read_bytes())
    ply = 'type="ply" id="ball"><string name="filename" value="prism.ply"/>'
    with pytest.raises(ValueError, match="smooth normals"):
        from_mitsuba.load(scene(BALL, ply))
    flat = f'{ply}<boolean name="face_normals" value="true"/>'
    assert len(from_mitsuba.load(scene(BALL, flat)).meshes[0].faces) == 8


@pytest.mark.parametrize("folder", ["more", "."])
def test_a_file_is_the_one_that_mitsuba_finds(folder, scene, tmp_path):
    """Mitsuba looks in the folders of `<path>` before that of the scene."""
    (tmp_path / "more").mkdir()
    for place, size in ((tmp_path / "more", 3), (tmp_path, 1)):
        lines = [f"v 0 0 {size}", f"v {size} 0 0", f"v 0 {size} 0", "f 1 2 3"]
        (place / "m.obj").write_text("\n".join(lines))
        image_file.write_exr(place / "sky.exr", np.full((2, 2, 3), size, np.float32))
        (place / "glass.csv").write_text(f"Wavelength (nm),n\n360,{size}\n830,{size}\n")
    mesh = 'type="obj"><string name="filename" value="m.obj"/><boolean name="face_normals" value="true"/>'
    path = scene(BALL, mesh, CONSTANT, f'<path value="{folder}"/>{SKY}', "water", "file:glass.csv")
    plain, found = from_mitsuba.load(path, level=0), load_scene(path).shapes()[0]
    assert plain.meshes[0].vertices.max() == found.bbox().max.x == plain.sky.pixels.max()
    assert plain.meshes[0].material.int_ior == pytest.approx(found.bbox().max.x)


@pytest.mark.parametrize(
    "order, flip, size, refused",
    [
        ((2, 1, 0), False, 99, ""),  # a room
        ((0, 1, 2), True, 99, ""),
        ((0, 1, 2), False, 9, ""),
        ((0, 1, 2), False, 99, "diffuse on the outside only, around the camera; expected"),
        ((2, 1, 0), False, 9, "diffuse on the inside only, seen from outside; expected"),
        ((0, 1, 2), True, 9, "diffuse on the inside only, seen from outside; expected"),
    ],
)
@pytest.mark.parametrize("split", [False, True])
def test_a_camera_sees_the_diffuse_side_of_a_closed_mesh(split, order, flip, size, refused, scene, tmp_path):
    """Of a cube whose vertices texture coordinates split, with a face between equal corners; of one on another."""
    vertices, faces = tessellation.cube()
    if not split:
        vertices, faces = np.concatenate([vertices, np.add(vertices, [0, 2, 0])]), np.concatenate([faces, faces + 8])
    lines = [f"v {x} {y} {z}" for x, y, z in size * vertices]
    if split:
        lines += ["vt 0 0", "vt 1 0", "vt 0 1", "f 1/1 1/2 2/3"]
    lines += [("f {}/1 {}/2 {}/3" if split else "f {} {} {}").format(*face) for face in faces[:, order] + 1]
    (tmp_path / "box.obj").write_text("\n".join(lines))
    options = f'<boolean name="face_normals" value="true"/><boolean name="flip_normals" value="{str(flip).lower()}"/>'
    obj = f'type="obj" id="box"><string name="filename" value="box.obj"/>{options}'
    path = scene('type="cube" id="box">' + MOVED, obj)
    if refused:
        with pytest.raises(ValueError, match=refused):
            from_mitsuba.load(path)
        path = scene('type="cube" id="box">' + MOVED, f'{obj}<bsdf type="twosided"><bsdf type="diffuse"/></bsdf>')
    box = from_mitsuba.load(path, level=0).meshes[1]
    assert box.vertices[:, 0].max() == size and len(box.vertices) == (8 if split else 16)


ALONE, ROOM = (1, 0, 1), (99, 0, -1)  # half the side of a cube, the x of its middle, 1 if it faces outward


@pytest.mark.parametrize(
    "first, second, refused",
    [
        (ALONE, (1, 3, 1), False),
        (ALONE, (1, 3, -1), True),
        (ALONE, (0.5, 1.5, -1), True),  # in contact
        (ALONE, (0.5, 0, -1), False),  # a cavity
        (ALONE, (0.25, 0.75, -1), False),  # a cavity in contact with the surface
        (ROOM, (1, 0, 1), False),
        (ROOM, (1, 0, -1), True),
        (ROOM, (9, 108, -1), False),  # the next room
    ],
)
def test_a_body_of_a_mesh_that_faces_inward_is_refused_if_the_camera_sees_it(first, second, refused, scene, tmp_path):
    vertices, faces = tessellation.cube()
    lines = []
    for i, (size, x, way) in enumerate((first, second)):
        lines += ["v {} {} {}".format(*place) for place in size * vertices + [x, 0, 0]]
        lines += ["f {} {} {}".format(*face) for face in faces[:, ::way] + 8 * i + 1]
    (tmp_path / "two.obj").write_text("\n".join(lines))
    obj = 'type="obj" id="box"><string name="filename" value="two.obj"/><boolean name="face_normals" value="true"/>'
    path = scene('type="cube" id="box">' + MOVED, obj)
    if refused:
        with pytest.raises(ValueError, match="diffuse on the inside only, seen from outside; expected"):
            from_mitsuba.load(path)
    else:
        assert len(from_mitsuba.load(path, level=0).meshes[1].faces) == 24


@pytest.mark.parametrize("last, smooth", [(3, False), (10**9, False), (2**32 - 1, False), (10**9, True)])
def test_a_face_with_a_missing_vertex_is_refused(last, smooth, scene, tmp_path):
    """Even for smooth meshes, for which Mitsuba writes a normal to each vertex of a face."""
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 "
    flat = '<boolean name="face_normals" value="true"/>'
    ply = 'type="ply" id="ball"><string name="filename" value="m.ply"/>'
    (tmp_path / "m.ply").write_text(f"{head}2\n")
    assert len(from_mitsuba.load(scene(BALL, ply + flat)).meshes[0].faces) == 1
    (tmp_path / "m.ply").write_text(f"{head}{last}\n")
    with pytest.raises(ValueError, match=r"^[^\n]*m\.ply[^\n]*expected [^\n]*$"):
        from_mitsuba.load(scene(BALL, ply + ("" if smooth else flat)))


# --- triangles -------------------------------------------------------------------------------------------

COUNTED = {f'type="{name}">{LAMP}': count for name, count in (("sphere", 320), ("cylinder", 64), ("disk", 32))}
COUNTED |= {f'type="{name}">{LAMP}': count for name, count in (("cube", 12), ("rectangle", 2))}
COUNTED |= {
    f'type="rectangle"><emitter type="area">{BOARD.format(x, y)}</emitter>': count
    for x, y, count in ((2, 3, 48), (1.3, 0.4, 6), (0.2, 0.2, 2))
}
PRISM = f'<string name="filename" value="{SCENES}/meshes/prism.ply"/><boolean name="face_normals" value="true"/>'
COUNTED[f'type="ply">{PRISM}{LAMP}'] = 8


def first_shape(path, text):
    path.write_text(f'<scene version="3.0.0"><shape {text}</shape></scene>')
    return next(child for child in SceneFile(path, {}).node(0).children() if child.kind == "Shape")


@pytest.mark.parametrize("text", COUNTED)
def test_number_of_triangles_is_checked_before_they_are_made(text, tmp_path):
    """The count is exact; a level or a scale beyond any machine's memory is an error at once. Files are read first."""
    path, count = tmp_path / "scene.xml", COUNTED[text]
    meshes = meshes_from_shapes.meshes_of_shape(first_shape(path, text), 2, count)
    assert sum(len(mesh.faces) for mesh in meshes) == count
    with pytest.raises(ValueError, match=f": {count} triangles where {count - 1} are left; expected "):
        next(meshes_from_shapes.meshes_of_shape(first_shape(path, text), 2, count - 1))
    if not text.startswith(('type="cube"', 'type="ply"')) and f'type="rectangle">{LAMP}' != text:
        huge = text.replace('scale x="', 'scale x="999999999')
        with pytest.raises(ValueError, match="triangles where 16777216 are left"):
            next(meshes_from_shapes.meshes_of_shape(first_shape(path, huge), 60))


@pytest.mark.parametrize("end", [(0, 0, 2), (0, 0, -2), (1, 0, -1e-9), (3, -1, 2)])
def test_a_cylinder_lies_around_its_axis_and_faces_outward(end, tmp_path):
    ends = '<point name="p0" x="1" y="2" z="3"/><point name="p1" x="{}" y="{}" z="{}"/>'.format(*np.add(end, (1, 2, 3)))
    text = f'type="cylinder"><float name="radius" value="0.5"/>{ends}{LAMP}'
    (mesh,) = meshes_from_shapes.meshes_of_shape(first_shape(tmp_path / "scene.xml", text), 2)
    axis, offsets = np.divide(end, np.linalg.norm(end)), mesh.vertices - (1, 2, 3)
    np.testing.assert_allclose(np.linalg.norm(np.cross(offsets, axis), axis=1), 0.5, rtol=1e-12)
    assert {round(float(x), 9) for x in offsets @ axis} == {0, round(float(np.linalg.norm(end)), 9)}
    a, b, c = (mesh.triangles() - (1, 2, 3)).swapaxes(0, 1)
    outward = a - (a @ axis)[:, None] * axis
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), outward) > 0).all()


def normals(triangles):
    vertices, faces = triangles
    a, b, c = vertices[faces].swapaxes(0, 1)
    return np.cross(b - a, c - a) / 2


def volume(triangles):
    return np.linalg.det(triangles[0][triangles[1]]).sum() / 6


def test_solids_are_closed_and_outward_with_vertices_on_the_surface():
    missing = []
    for level in range(5):
        vertices, faces = tessellation.sphere(level)
        assert len(faces) == 20 * 4**level and len(vertices) == 10 * 4**level + 2
        np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1, rtol=4e-16)
        assert tessellation.is_closed(faces)
        assert (np.einsum("ij,ij->i", normals((vertices, faces)), vertices[faces].mean(1)) > 0).all()
        missing.append(4 / 3 * np.pi - volume((vertices, faces)))
    assert all(3 < coarse / fine < 4.2 for coarse, fine in itertools.pairwise(missing))
    twice = [np.concatenate([faces, more]) for more in (faces[:1], faces[:, ::-1])]
    for defect in (faces[1:], np.concatenate([faces[:1, ::-1], faces[1:]]), *twice):
        assert not tessellation.is_closed(defect)
    cube = tessellation.cube()
    assert len(cube[0]) == 8 and tessellation.is_closed(cube[1])
    assert volume(cube) == 8 and np.abs(normals(cube)).sum() == 24
    # A cylinder and two disks form a solid with the volume of the inscribed prism.
    disk, order = tessellation.disk(2)
    area = (len(disk) - 1) / 2 * np.sin(2 * np.pi / (len(disk) - 1))
    vertices, faces = tessellation.cylinder(2)
    parts = [vertices[faces], np.add(disk, [0, 0, 1])[order], (disk * [1, -1, -1])[order]]
    solid = tessellation.welded(np.concatenate(parts).round(12))
    assert tessellation.is_closed(solid[1]) and volume(solid) == pytest.approx(area, rel=1e-10)
    assert normals((disk, order))[:, 2].sum() == pytest.approx(area)


@pytest.mark.parametrize("scales", [(12, 12), (1, 1), (10, 5), (1.3, 0.7), (0.4, 3.14159)])
def test_checkerboard_has_mitsubas_colours(scales):
    """At 200 points of each part, with Mitsuba's default colours."""
    parts = tessellation.checkerboard(*scales)
    up = np.concatenate([normals(part)[:, 2] for part in parts if len(part[1])])
    assert up.sum() == pytest.approx(4) and (up > 0).all()
    texture = mi.load_dict({"type": "checkerboard", "to_uv": mi.ScalarTransform4f().scale([*scales, 1])})
    rng, si = np.random.default_rng(3), mi.SurfaceInteraction3f()
    for colour, (vertices, faces) in zip((0.4, 0.2), parts, strict=True):
        for corners in vertices[rng.choice(faces, 200)] if len(faces) else ():
            x, y, z = rng.dirichlet((1, 1, 1)) @ corners
            si.uv = [(x + 1) / 2, (y + 1) / 2]
            assert z == 0 and texture.eval(si)[0] == pytest.approx(colour)


def test_default_colours_of_a_checkerboard(scene):
    board = BOARD.format(1, 1)
    named = board.replace('name="radiance"', 'id="board"'), f'{AREA}<ref id="board" name="radiance"/>'
    for lamp in (f"{AREA}{board}", "".join(named)):
        plain = from_mitsuba.load(scene(LIGHT, lamp), level=0)
        assert [mesh.material for mesh in plain.meshes[2:]] == [Light((0.4,) * 3), Light((0.2,) * 3)]
    assert len(from_mitsuba.load(scene(LIGHT, f"{AREA}{BOARD.format(0.5, 0.5)}"), level=0).meshes) == 3  # one cell

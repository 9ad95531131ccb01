"""Exports are written completely or not at all; read as the renderers would read them, they are the same scene.

The film is not square, the camera's `up` is not perpendicular to its direction, and the map of the sky is asymmetric.
"""

import dataclasses
import functools
import json
import os
import re
import runpy
import sys
import tracemalloc
import types
from pathlib import Path
from unittest import mock

import mitsuba as mi
import numpy as np
import pytest
from support import fake_bpy, fake_raysect
from support.readme import DOCS
from support.scene_readers import READERS

from mi_refract import SCENES
from mi_refract.image_diff import methods
from mi_refract.image_diff.comparison import Verdict
from mi_refract.io import image_file
from mi_refract.io.errors import ExportError
from mi_refract.scene_export import from_mitsuba, targets, tessellation
from mi_refract.scene_export.plain_scene import (
    Camera,
    Diffuse,
    DirectionalLamp,
    Environment,
    Glass,
    Light,
    Mesh,
    PlainScene,
    PointLamp,
    SpotLamp,
)

CAMERA = Camera((0.0, 0.0, 9.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0, 8, 4)
BALL = tessellation.sphere(0)
UP = (0.0, 0.0, 1.0)
GLASS, GREY, LAMP = Glass(1.5, 1.25), Diffuse((0.1, 0.2, 0.3)), Light((1.0, 2.0, 3.0))


def plain(*materials, sky=(0.5, 0.25, 1.0), depth=12):
    meshes = tuple(Mesh(f"ball_{i}", *BALL, material) for i, material in enumerate(materials))
    return PlainScene("a scene", meshes, sky, CAMERA, depth)


@pytest.fixture
def sky():
    """A rotated map without equal pixels or symmetry."""
    rotation = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], float)
    return Environment(np.random.default_rng(4).random((5, 8, 3)).astype(np.float32), rotation)


# --- the folder ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", targets.TARGETS)
def test_every_target_writes_its_folder(target, sky, tmp_path):
    """With a sky of one colour, with a map, and without any mesh."""
    scenes = [plain(GLASS, LAMP), plain(GLASS, LAMP, sky=sky), plain(sky=sky)]
    for i, scene in enumerate(scenes):
        paths = targets.write(scene, target, tmp_path / f"{i}")
        assert sorted(paths) == sorted((tmp_path / f"{i}").iterdir())
        assert i == 2 or all(map(os.path.getsize, paths))
        text = (tmp_path / f"{i}" / "README.txt").read_text()
        assert scene.name in text and all(len(line) <= 140 for line in text.splitlines())
        if (tmp_path / f"{i}" / "sky.exr").exists():  # a fixed date: the same scene gives the same bytes
            assert image_file.read(tmp_path / f"{i}" / "sky.exr").metadata["DateTime"] == "1970:01:01 00:00:00"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0", "1", "2"]
    page = (DOCS / "how-to/export-a-scene.md").read_text("utf-8")
    assert target in re.findall(r"^\| `(.*?)` \|", page, re.MULTILINE)


LAMPS = PointLamp("bulb", UP, UP), SpotLamp("bulb", UP, UP, UP, 20.0, 20.0), DirectionalLamp("bulb", UP, UP)
REFUSED = [(x, y) for x in LAMPS for y in targets.TARGETS if x.kind not in targets.HOLD_LAMPS.get(y, ())]


@pytest.mark.parametrize("lamp, target", REFUSED)
def test_a_target_refuses_lamps_that_it_does_not_hold(lamp, target, tmp_path):
    """They are not dropped silently: 4 targets hold no lamps without size, Cycles no spots."""
    assert len(REFUSED) == 4 * 3 + 1
    scene = dataclasses.replace(plain(GLASS), lamps=(lamp,))
    text = f"a scene: bulb: a {lamp.kind} lamp is not exported to {target}; expected area lamps, an environment, or"
    with pytest.raises(ExportError, match=rf"^{text} --to (cycles or )?mitsuba or obj\+json or gltf$"):
        targets.write(scene, target, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_existing_files_are_kept_and_an_empty_folder_is_used(tmp_path):
    for name in ("full", "there"):
        (tmp_path / name).mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    (tmp_path / "file").write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    cases = ("full", "already contains"), ("file", "not a folder"), ("none/below", "not a f"), ("file/below", "not a f")
    for name, words in cases:
        with pytest.raises(OSError, match=words):
            targets.write(plain(GLASS), "obj+json", tmp_path / name)
    with pytest.raises(ValueError, match=r"'blender': unknown; expected cycles, luxcore, .*, mitsuba, obj\+json"):
        targets.write(plain(GLASS), "blender", tmp_path / "new")
    assert sorted(tmp_path.rglob("*")) == before
    (tmp_path / "link").symlink_to(tmp_path / "there")
    targets.write(plain(GLASS), "radiance", tmp_path / "link")
    assert (tmp_path / "there" / "scene.rad").is_file() and (tmp_path / "link").is_symlink()


def test_a_failed_export_leaves_no_files(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(os, "access", lambda path, mode: False)
        with pytest.raises(PermissionError, match="not writable"):
            targets.write(plain(GLASS), "mitsuba", tmp_path / "new")
    written, write_bytes = [], Path.write_bytes

    def full(path, data):
        written.append(path)
        if len(written) == 3:
            raise OSError("No space left on device")
        return write_bytes(path, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space"):
        targets.write(plain(GLASS, LAMP), "mitsuba", tmp_path / "new")
    assert len(written) == 3 and not list(tmp_path.iterdir())


# --- exports as the renderers read them -------------------------------------------------------------------

SINGLE = 2.0**-24
MAP = np.random.default_rng(8).random((5, 8, 3)).astype(np.float32)
COLOUR = '<emitter type="constant"><rgb name="radiance" value="0.5, 0.25, 1"/></emitter>'
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


@pytest.mark.parametrize("target", READERS)
@pytest.mark.parametrize(
    ("sky", "pixels"),
    [(COLOUR, MAP), (TURNED, MAP), (TURNED, MAP[:2, :1].repeat(8, 1))],
    ids=["colour", "map", "zenith and horizon"],
)
def test_an_export_has_mitsubas_rays_surfaces_lights_sky(target, sky, pixels, tmp_path, monkeypatch, scalar_variant):
    """Mitsuba's rays are in float32: each of its transforms has an error of a few roundoffs.

    Triangles are counterclockwise from outside; an index is the index inside over that outside. A map of the sky is
    resampled to cells of 1/16: where its slope changes by at most 2 per texel, linear cells err by 1/32 per axis.
    """
    image_file.write_exr(tmp_path / "map.exr", pixels)
    path = tmp_path / "scene.xml"
    text = SCENE.replace('"1.1"', '"1.3"') if target == "gltf" else SCENE  # glTF has no index below 1
    path.write_text(text % (sky if target == "povray" else sky + PATCH))
    plain_scene = from_mitsuba.load(path, level=1)
    targets.write(plain_scene, target, tmp_path / "export")
    original = mi.load_file(str(path), parallel=False, optimize=False)
    export = READERS[target](tmp_path / "export", monkeypatch)

    assert export.size == (16, 9) and export.depth == 7
    points = [(0, 0), (1, 0), (0, 1), (1, 1), *np.random.default_rng(3).random((12, 2))]
    for x, y in (np.clip(point, 1e-6, 1 - 1e-6) for point in points):
        ray, _ = original.sensors()[0].sample_ray(0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5))
        origin, direction = export.ray(x, y)
        np.testing.assert_allclose(direction / np.linalg.norm(direction), ray.d, atol=64 * SINGLE)
        # Mitsuba's rays start at the near clip plane.
        assert np.linalg.norm(np.cross(np.subtract(ray.o, origin), ray.d)) < 64 * SINGLE * np.linalg.norm(origin)

    assert sorted(export.triangles) == sorted(mesh.name for mesh in plain_scene.meshes)
    for mesh in plain_scene.meshes:
        np.testing.assert_allclose(export.triangles[mesh.name], mesh.triangles(), atol=8 * SINGLE)
    for name in ("ball", "pearl"):
        (bsdf,) = (shape.bsdf() for shape in original.shapes() if shape.id() == name)
        centre = np.mean(export.triangles[name], axis=(0, 1))
        assert (np.linalg.det(np.subtract(export.triangles[name], centre)) > 0).all()
        assert export.indices[name] == pytest.approx(float(re.search(r"eta = ([\d.]+)", str(bsdf))[1]), rel=1e-5)
    assert export.indices.keys() == {"ball", "pearl"} and export.lights.keys() == {"lamp"}
    assert list(export.lights["lamp"]) == [1, 2, 3]
    colours = {name: list(colour) for name, colour in export.colours.items()}
    assert colours == ({} if target == "povray" else {"patch": [0.1, 0.2, 0.3]})

    directions = np.random.default_rng(5).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = []
    for direction in directions:
        si = mi.SurfaceInteraction3f()
        si.wi = -mi.Vector3f(direction)
        expected.append(list(original.environment().eval(si)))
    tolerance = 1e-5 if sky == COLOUR else 0.5 * np.ptp(MAP) / 16
    np.testing.assert_allclose(export.sky(directions), expected, atol=tolerance)


@pytest.mark.parametrize("target", READERS)
@pytest.mark.parametrize("fov", [0.2, 175.0])
def test_narrow_and_wide_fields_of_view(target, fov, tmp_path, monkeypatch):
    """Blender's `Camera.angle` is limited to 0.367 … 172.85 degrees."""
    scene = dataclasses.replace(plain(GLASS), camera=dataclasses.replace(CAMERA, fov_x_degrees=fov))
    targets.write(scene, target, tmp_path / "new")
    ray = READERS[target](tmp_path / "new", monkeypatch).ray
    left, right = (ray(x, 0.5)[1] for x in (0, 1))
    angle = np.arctan2(np.linalg.norm(np.cross(left, right)), np.dot(left, right))
    assert np.degrees(angle) == pytest.approx(fov, rel=1e-6)


EMITTERS = {
    "bulb": """<emitter type="point" id="bulb"><point name="position" x="3" y="2" z="1"/>
      <rgb name="intensity" value="3, 2, 0.5"/></emitter>""",
    "soft": """<emitter type="spot" id="soft">
      <transform name="to_world"><lookat origin="1,4,9" target="2,-1,0" up="0,0,1"/></transform>
      <float name="cutoff_angle" value="35"/><float name="beam_width" value="20"/></emitter>""",
    "sharp": """<emitter type="spot" id="sharp">
      <transform name="to_world"><lookat origin="-5,0,2" target="0,0,0" up="0,1,0"/></transform>
      <float name="cutoff_angle" value="50"/><float name="beam_width" value="90"/>
      <rgb name="intensity" value="0, 0, 0.25"/></emitter>""",
    "sun": """<emitter type="directional" id="sun"><vector name="direction" x="1" y="-2" z="-3"/>
      <rgb name="irradiance" value="0.5, 4, 2"/></emitter>""",
    "moon": """<emitter type="directional" id="moon">
      <transform name="to_world"><rotate x="1" angle="100"/></transform></emitter>""",
}


@pytest.mark.parametrize("target", targets.HOLD_LAMPS)
def test_lamps_without_size_give_mitsubas_irradiance(target, tmp_path, monkeypatch, scalar_variant):
    """At random points the direction and the irradiance are equal, except at the edge of a spot in glTF."""
    emitters = {name: text for name, text in EMITTERS.items() if text.split('"')[1] in targets.HOLD_LAMPS[target]}
    (tmp_path / "scene.xml").write_text(SCENE.replace('"1.1"', '"1.3"') % "".join([COLOUR, *emitters.values()]))
    targets.write(from_mitsuba.load(tmp_path / "scene.xml", level=0), target, tmp_path / "new")

    def mitsubas_lamps(path):
        """Return for each lamp a function of a point: the direction to the lamp, and the irradiance."""

        def irradiance(emitter, point):
            interaction = mi.Interaction3f(0, 0, mi.Color0f(), mi.Point3f(point))
            sample, weight = emitter.sample_direction(interaction, [0.5, 0.5])
            return np.array(sample.d), np.array(weight)

        loaded = mi.load_file(str(path), parallel=False, optimize=False).emitters()
        return {x.id(): functools.partial(irradiance, x) for x in loaded if x.id() in EMITTERS}

    expected = mitsubas_lamps(tmp_path / "scene.xml")
    if target == "mitsuba":
        lamps = mitsubas_lamps(tmp_path / "new" / "scene.xml")
    else:
        lamps = READERS[target](tmp_path / "new", monkeypatch).lamps
    assert lamps.keys() == expected.keys() == emitters.keys()
    edges = {"soft": ((1, -5, -9), 20, 35), "sharp": ((5, 0, -2), 49.95, 50)} if target == "gltf" else {}
    for name, lamp in lamps.items():
        axis, low, high = edges.get(name, ((0, 0, 1), 0, 0))
        for point in np.random.default_rng(6).normal(size=(300, 3)) * 4:
            (direction, light), (expected_direction, expected_light) = lamp(point), expected[name](point)
            np.testing.assert_allclose(direction, expected_direction, atol=64 * SINGLE)
            if not low < np.degrees(np.arccos(-direction @ axis / np.linalg.norm(axis))) < high:
                np.testing.assert_allclose(light, expected_light, rtol=1e-4, atol=1e-7)


def test_renders_of_an_export_are_equal_and_another_index_is_detected(tmp_path):
    """False alarms have the family error of `welch`, 0.001; the seeds are fixed."""

    def renders(path, first, **defines):
        scene = mi.load_file(str(path), optimize=False, parallel=False, **defines)
        seeds = range(first, first + 8)
        return [image_file.named(f"seed {seed}", np.array(mi.render(scene, spp=64, seed=seed))) for seed in seeds]

    path = tmp_path / "plain" / "scene.xml"
    targets.write(from_mitsuba.load(SCENES / "prism.xml", level=0, defines={"res": "32"}), "mitsuba", path.parent)
    first = renders(SCENES / "prism.xml", 0, res="32")
    assert methods.compare("welch", first, renders(path, 100), tile=16).verdict == Verdict.EQUAL
    text, material = path.read_text(), '<float name="int_ior" value="1.5168"/>'
    assert material in text
    path.write_text(text.replace(material, '<float name="int_ior" value="1.8"/>'))
    assert methods.compare("welch", first, renders(path, 100), tile=16).verdict == Verdict.DIFFERENT


def test_a_map_is_resampled_in_strips_up_to_a_size(monkeypatch):
    """16 times finer at once, a map of 1024 × 512 needed 31 GB."""
    axes, rng = targets.shared_files.OWN_AXES, np.random.default_rng(7)
    maps = [Environment(rng.random((*size, 3), np.float32), np.eye(3)) for size in ((33, 64), (2, 4000), (2, 20000))]
    tracemalloc.start()
    resampled = targets.shared_files.longitude_latitude(maps[0], axes)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert resampled.shape == (512, 1024, 3) and peak < 80e6
    monkeypatch.setattr(targets.shared_files, "STRIP", 2**30)
    assert (resampled == targets.shared_files.longitude_latitude(maps[0], axes)).all()
    sizes = [targets.shared_files.longitude_latitude(x, axes).shape[:2] for x in maps[1:]]
    assert sizes == [(4, 16000), (1, 20000)]


@pytest.mark.parametrize("target", ["povray", "gltf"])
def test_glass_with_inward_normals_is_exported_as_the_same_glass(target):
    vertices, faces = tessellation.sphere(1)
    outward = Mesh("ball", vertices, faces, Glass(1.5, 1.0))
    inward = Mesh("ball", vertices, faces[:, ::-1], Glass(1.0, 1.5))
    scenes = (PlainScene("ball", (mesh,), (1.0, 1.0, 1.0), CAMERA, 8) for mesh in (outward, inward))
    exports = [targets.TARGETS[target](scene) for scene in scenes]
    assert exports[0] == exports[1]


def test_povray(tmp_path):
    """Unsupported surfaces are refused; black surfaces; indices relative to the outermost medium."""
    pane = Mesh("pane", *tessellation.rectangle(), GLASS)
    (grey,) = plain(Diffuse((0.5, 0.0, 0.0))).meshes
    apart = Mesh("apart", BALL[0] - 9, BALL[1], Glass(1.5, 1.33))
    drop = Mesh("drop", BALL[0] + 9, BALL[1], Glass(1.33, 1.25))
    for mesh, message in (
        (pane, "pane: glass with an open"),
        (grey, "ball_0: a diffuse surface"),
        (apart, "apart: ext_ior = 1.33; expected 1.25, the index of the medium around it"),
    ):
        meshes = mesh, Mesh("ball", *BALL, GLASS), drop
        with pytest.raises(ExportError, match=message):
            targets.write(PlainScene("bad", meshes, (1.0, 1.0, 1.0), CAMERA, 8), "povray", tmp_path / "new")
    assert not list(tmp_path.iterdir())
    make = targets.TARGETS["povray"]
    text = make(plain(LAMP, Diffuse((0.0, 0.0, 0.0))))["scene.pov"].decode()
    front = "texture { pigment { rgb <%s> } finish { ambient 0 diffuse 0 emission 1 } }"
    assert text.count(front % "1.0, 2.0, 3.0") == text.count(front % "0.0, 0.0, 0.0") == 1
    assert text.count("interior_texture { pigment { rgb 0 } finish { ambient 0 diffuse 0 } }") == 2
    nested = Mesh("in", *BALL, Glass(1.2, 1.6)), Mesh("out", 2 * BALL[0], BALL[1], Glass(1.6, 1.25))
    text = make(PlainScene("nested", nested, (1.0, 1.0, 1.0), CAMERA, 300))["scene.pov"]
    assert [float(part.split()[0]) for part in text.split(b"interior { ior ")[1:]] == [1.2 / 1.25, 1.6 / 1.25]
    assert b"max_trace_level 256" in text


# --- the scripts of exports ----------------------------------------------------------------------------------


def write_export(target, folder, depth=12):
    targets.write(plain(GLASS, GREY, LAMP, depth=depth), target, folder)
    return folder


@pytest.mark.parametrize("target", ["cycles", "luxcore"])
def test_a_target_that_always_samples_lights_refuses_paths_of_one_segment(target, tmp_path):
    with pytest.raises(ExportError, match=f"^a scene: max_depth = 1; expected 2 or more, the least of {target}$"):
        write_export(target, tmp_path / "new", depth=1)
    write_export("radiance", tmp_path / "new", depth=1)


@pytest.mark.parametrize(("target", "farthest"), targets.FARTHEST.items())
def test_coordinates_beyond_the_ends_of_rays_are_refused(target, farthest, tmp_path):
    def scene(size, distance):
        camera = dataclasses.replace(CAMERA, origin=(0.0, 0.0, distance))
        ball = Mesh("ball", size / np.abs(BALL[0]).max() * BALL[0], BALL[1], GLASS)
        return dataclasses.replace(plain(), meshes=(ball,), camera=camera)

    targets.write(scene(0.9 * farthest, 0.9 * farthest), target, tmp_path / "near")
    for i, sizes in enumerate([(1.1 * farthest, 1), (1, 1.1 * farthest)]):
        with pytest.raises(ExportError, match=rf"a coordinate of 1\.1e\+\d+; expected up to 1e\+\d+ for {target}$"):
            targets.write(scene(*sizes), target, tmp_path / f"{i}")


@pytest.mark.parametrize(("target", "nearest"), targets.NEAREST.items())
def test_glass_thinner_than_the_least_distance_of_rays_is_refused(target, nearest, tmp_path):
    vertices, faces = tessellation.cube()
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]

    def scene(thickness, material=GLASS, faces=faces):
        plate = Mesh("plate", vertices * [1, 1, thickness / 2] @ turn, faces, material)
        return dataclasses.replace(plain(), meshes=(plate,))

    for i, accepted in enumerate([scene(1.1 * nearest), scene(0, LAMP), scene(0.1 * nearest, LAMP)]):
        targets.write(accepted, target, tmp_path / f"{i}")
    for order in (faces, faces[:, ::-1]):
        with pytest.raises(ExportError, match=rf"plate: glass of mean thickness .*; expected .* for {target}$"):
            targets.write(scene(0.9 * nearest, faces=order), target, tmp_path / "thin")


def test_luxcore_hides_nothing_near_the_camera_or_far_from_it(tmp_path):
    text = (write_export("luxcore", tmp_path / "new") / "scene.scn").read_text()
    assert 0 < float(re.search(r"cliphither = (\S+)", text)[1]) <= 1e-9
    assert float(re.search(r"clipyon = (\S+)", text)[1]) >= 1e30  # the largest coordinate of an export


@pytest.mark.parametrize("words, seeds", [((), [1]), (("--seeds", "4", "2", "--threads", "2"), [4, 2])])
def test_cycles_renders_each_seed_as_a_plain_path_tracer(words, seeds, tmp_path, monkeypatch, capsys):
    bpy = fake_bpy.run(write_export("cycles", tmp_path / "new"), monkeypatch, *words)
    files = [str(tmp_path / "new" / f"seed{seed}.exr") for seed in seeds]
    assert bpy.rendered == list(zip(seeds, files, strict=True)) and capsys.readouterr().out.split() == files
    bpy.ops.wm.read_factory_settings.assert_called_once_with(use_empty=True)
    render, cycles = bpy.context.scene.render, bpy.context.scene.cycles
    assert (render.engine, cycles.device, cycles.samples) == ("CYCLES", "CPU", 3)
    assert (render.resolution_x, render.resolution_y, render.resolution_percentage) == (8, 4, 100)
    assert ((render.threads_mode, render.threads) == ("FIXED", 2)) == bool(words)
    file = render.image_settings
    assert (file.file_format, file.color_mode, file.color_depth) == ("OPEN_EXR", "RGB", "32")
    assert (cycles.pixel_filter_type, cycles.filter_width) == ("BOX", 1)
    for biased in ("blur_glossy", "sample_clamp_direct", "sample_clamp_indirect", "light_sampling_threshold"):
        assert getattr(cycles, biased) == 0
    assert (cycles.caustics_reflective, cycles.caustics_refractive) == (True, True)
    assert (cycles.use_adaptive_sampling, cycles.use_denoising) == (False, False)
    assert (render.use_compositing, render.use_sequencer) == (False, False)
    assert cycles.min_light_bounces == cycles.max_bounces == 10
    lens = bpy.data.cameras.made["camera"]
    assert 0 < lens.clip_start <= 1e-6 and lens.clip_end >= 1e30
    deep = fake_bpy.run(write_export("cycles", tmp_path / "deep", depth=5000), monkeypatch).context.scene.cycles
    assert deep.max_bounces == deep.transmission_bounces == 1024  # Blender's limit


@pytest.mark.parametrize("words, seeds", [((), [1]), (("--seeds", "4", "0", "--threads", "3", "--spp", "9"), [4, 0])])
def test_luxcore_renders_each_seed_into_its_own_file(words, seeds, tmp_path, monkeypatch, capsys):
    """LuxCore takes a seed of 0 for 1, so it gets the next number."""
    folder, sessions, waits = write_export("luxcore", tmp_path / "new"), [], []

    class Properties(dict):
        def __init__(self, name):
            super().__init__(name=name)

        def Set(self, pair):
            self.update([pair])

    class Session:
        """A render that has finished when HasDone is called the third time."""

        def __init__(self, config):
            self.config, self.calls = config, []
            sessions.append(self)

        def __getattr__(self, name):
            def call():
                self.calls.append(name)
                return self.calls.count("HasDone") > 2 if name == "HasDone" else self

            return call

    lux = mock.MagicMock(Properties=Properties, Property=lambda key, value: (key, value), RenderSession=Session)
    lux.RenderConfig = lambda config, scene: config
    monkeypatch.setitem(sys.modules, "pyluxcore", lux)
    monkeypatch.setattr("time.sleep", waits.append)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["render.py", "--out", "out", *words])
    runpy.run_path(str(folder / "render.py"))["main"]()
    files = [str(tmp_path / "out" / f"seed{seed}.exr") for seed in seeds]
    assert capsys.readouterr().out.split() == files and 0 < max(waits) < 1
    for session, seed, file in zip(sessions, seeds, files, strict=True):
        expected = {"name": "scene.cfg", "renderengine.seed": seed + 1, "film.outputs.0.filename": file}
        expected |= {"batch.haltspp": 9, "native.threads.count": 3} if words else {"batch.haltspp": 256}
        assert session.config == expected
        waiting = ["HasDone", "UpdateStats"] * 2
        assert session.calls == ["Start", *waiting, "HasDone", "Stop", "GetFilm", "Save"]
    assert lux.Scene.return_value.Parse.call_args.args == ({"name": "scene.scn"},)


def test_raysect_has_equal_weights_bands_and_dispersion(tmp_path, monkeypatch):
    """The rows of a PFM image start at the lowest; lamps are black from behind."""
    folder = write_export("raysect", tmp_path / "new")
    _, script = fake_raysect.run(folder, monkeypatch)
    pixels = np.arange(2 * 3 * 3, dtype=np.float32).reshape(2, 3, 3)
    (tmp_path / "image.pfm").write_bytes(script["pfm"](pixels))
    assert (image_file.read(tmp_path / "image.pfm").pixels == pixels).all()
    assert script["Camera"]((2, 1))._generate_rays(0, 0) == [("ray", 1.0)]
    lamp, ray = script["Light"]("bright"), types.SimpleNamespace(new_spectrum=lambda: "black")
    emitted = [lamp.evaluate_surface("world", ray, "lamp", "place", exiting, "more") for exiting in (False, True)]
    assert emitted == ["bright", "black"]
    scene = json.loads((folder / "scene.json").read_text())
    for band, bins in ((None, 3), ([656.0, 656.5], 1)):
        camera = script["camera"]("world", scene, types.SimpleNamespace(spp=5, band=band), "pipeline")
        assert (camera.spectral_rays, camera.spectral_bins, camera.pixel_samples) == (1, bins, 5)
        assert [camera.min_wavelength, camera.max_wavelength] == (band or [400, 700])
    entry = {"int_ior": 1.5, "ext_ior": 1.25}
    assert script["glass"](entry) == ("glass", 1.5, 1, 1.25)
    assert script["glass"](entry | {"schott": "SF11"})[1] == "of SF11"


def test_raysect_does_not_scale_a_scene_of_size_0(tmp_path, monkeypatch):
    """A sky, seen from the origin."""
    camera = dataclasses.replace(CAMERA, origin=(0.0, 0.0, 0.0), target=(0.0, 0.0, -1.0))
    targets.write(dataclasses.replace(plain(), camera=camera), "raysect", tmp_path / "new")
    _, script = fake_raysect.run(tmp_path / "new", monkeypatch)
    scene = json.loads((tmp_path / "new" / "scene.json").read_text())
    place = script["camera"]("world", scene, types.SimpleNamespace(spp=1, band=None), "pipeline").transform[:3, 3]
    assert place.tolist() == [0, 0, 0]


@pytest.mark.parametrize("size", [1.0, 100.0])
def test_raysect_scales_the_largest_coordinate_to_a_half(size, tmp_path, monkeypatch):
    """The largest coordinate is the camera's or a mesh's: both are scaled."""
    mesh = Mesh("ball", size * BALL[0], BALL[1], GLASS)
    targets.write(PlainScene("scaled", (mesh,), (1.0, 1.0, 1.0), CAMERA, 8), "raysect", tmp_path / "new")
    fake, script = fake_raysect.run(tmp_path / "new", monkeypatch)
    scene = json.loads((tmp_path / "new" / "scene.json").read_text())
    script["build"](scene, tmp_path / "new")
    origin = script["camera"]("world", scene, types.SimpleNamespace(spp=1, band=None), "pipeline").transform[:3, 3]
    unit = 0.5 / max(9.0, np.abs(mesh.vertices).max())
    np.testing.assert_allclose(origin, np.multiply(unit, CAMERA.origin), rtol=4 * SINGLE)
    np.testing.assert_allclose(fake.meshes["ball"].triangles, unit * mesh.triangles(), rtol=4 * SINGLE)

"""Exports are written completely or not at all; where this can be checked here, they are the same scene."""

import json
import os
import re
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_refract.image_diff import methods
from mi_refract.image_diff.comparison import Verdict
from mi_refract.io import image_file
from mi_refract.scene_export import from_mitsuba, tessellation, write_files
from mi_refract.scene_export.plain_scene import Camera, Diffuse, Environment, Glass, Light, Mesh, PlainScene
from mi_refract.scene_export.targets import luxcore, povray, scene_json, shared_files

SCENES = Path(__file__).parents[2] / "scenes"
CAMERA = Camera((0.0, 0.0, 9.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0, 8, 4)
GLASS = Glass(1.5, 1.000277)


def meshes(*materials):
    return tuple(Mesh(f"ball_{i}", *tessellation.sphere(0), material) for i, material in enumerate(materials))


@pytest.fixture
def small():
    return PlainScene("small", meshes(GLASS, Light((1.0, 2.0, 3.0))), (0.5, 0.25, 1.0), CAMERA, 12)


@pytest.fixture
def sky():
    """A map with no two pixels alike and no symmetry, turned."""
    turned = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], float)
    return Environment(np.random.default_rng(4).random((5, 8, 3)).astype(np.float32), turned)


# --- the folder ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", write_files.TARGETS)
def test_every_target_writes_its_folder(target, small, sky, tmp_path):
    for i, scene in enumerate((small, PlainScene("turned", small.meshes, sky, CAMERA, 12))):
        written = write_files.write(scene, target, tmp_path / f"{i}")
        assert sorted(written) == sorted((tmp_path / f"{i}").iterdir()) and all(map(os.path.getsize, written))
        text = (tmp_path / f"{i}" / "README.txt").read_text()
        assert scene.name in text and all(len(line) <= 140 for line in text.splitlines())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0", "1"]


@pytest.mark.parametrize("target", write_files.TARGETS)
def test_a_scene_of_sky_only(target, sky, tmp_path):
    for i, shown in enumerate(((0.5, 0.25, 1.0), sky)):
        assert write_files.write(PlainScene("empty", (), shown, CAMERA, 12), target, tmp_path / f"{i}")


def test_an_empty_folder_is_taken(small, tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "there")
    write_files.write(small, "radiance", tmp_path / "link")
    assert (tmp_path / "there" / "scene.rad").is_file() and (tmp_path / "link").is_symlink()


def test_what_is_there_stays(small, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    (tmp_path / "file").write_text("mine")
    cases = [
        ("full", "holds files"),
        ("file", "not a folder"),
        ("none/below", "not a folder"),
        ("file/below", "not a f"),
    ]
    for name, words in cases:
        with pytest.raises(OSError, match=words):
            write_files.write(small, "obj+json", tmp_path / name)
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")) == ["file", "full", "full/mine.txt"]


def test_unwritable_folder(small, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(PermissionError, match="not writable"):
        write_files.write(small, "mitsuba", tmp_path / "new")


def test_nothing_stays_of_half_an_export(small, tmp_path, monkeypatch):
    written, write_bytes = [], Path.write_bytes

    def full(path, data):
        written.append(path)
        if len(written) == 3:
            raise OSError("No space left on device")
        return write_bytes(path, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space"):
        write_files.write(small, "mitsuba", tmp_path / "new")
    assert len(written) == 3 and not list(tmp_path.iterdir())


def test_unknown_target(small, tmp_path):
    with pytest.raises(
        ValueError,
        match=r"'blender': unknown; expected cycles, luxcore, radiance, raysect, povray, mitsuba, obj\+json",
    ):
        write_files.write(small, "blender", tmp_path / "new")


# --- Mitsuba ---------------------------------------------------------------------------------------------


def renders(scene, first, count=8, spp=64):
    seeds = range(first, first + count)
    return [image_file.named(f"seed {seed}", np.array(mi.render(scene, spp=spp, seed=seed))) for seed in seeds]


def renders_equal(name, level, folder):
    """Whether the plain scene does; the renders of the original, and the path of the plain one."""
    path, size = SCENES / f"{name}.xml", {"res": "32"}
    one = mi.load_file(str(path), optimize=False, parallel=False, **size)
    write_files.write(from_mitsuba.load(path, level=level, **size), "mitsuba", folder)
    first = renders(one, 0)
    return judged(first, folder / "scene.xml") == Verdict.EQUAL, first, folder / "scene.xml"


def judged(first, path):
    """False alarms: 0.001 by the family error of `welch`; the seeds are fixed."""
    other = mi.load_file(str(path), optimize=False, parallel=False)
    return methods.compare("welch", first, renders(other, 100), tile=16).verdict


def test_the_plain_scene_of_curved_shapes_renders_equal(tmp_path):
    assert renders_equal("sphere", 5, tmp_path / "plain")[0]


def test_the_plain_scene_renders_equal_and_another_index_would_be_seen(tmp_path):
    equal, first, path = renders_equal("prism", 0, tmp_path / "plain")
    assert equal
    text, material = path.read_text(), '<float name="int_ior" value="1.5046"/>'
    assert material in text
    path.write_text(text.replace(material, '<float name="int_ior" value="1.8"/>'))
    assert judged(first, path) == Verdict.DIFFERENT


# --- Radiance --------------------------------------------------------------------------------------------


def radiance_primitives(text):
    """{name: (modifier, type, real arguments)} of a scene file."""
    found = {}
    for line in text.splitlines():
        if words := line.split():
            modifier, kind, name, *rest = words
            strings = int(rest[0])
            found[name] = (modifier, kind, [float(x) for x in rest[3 + strings :]])
    return found


def test_radiance_surfaces(small, tmp_path):
    write_files.write(small, "radiance", tmp_path / "new")
    found = radiance_primitives((tmp_path / "new" / "scene.rad").read_text())
    glass, lamp = (found[f"material{i}"] for i in range(2))
    # The medium behind the normal is the first.
    assert glass == ("void", "interface", [1, 1, 1, 1.5, 1, 1, 1, 1.000277])
    assert lamp == ("void", "glow", [1, 2, 3, 0]) and found["sky"] == ("void", "glow", [0.5, 0.25, 1, 0])
    polygons = [(name, *found[name]) for name in found if found[name][1] == "polygon"]
    assert len(polygons) == 40 and {p[1] for p in polygons[:20]} == {"material0"}
    corners = np.array([p[3] for p in polygons[:20]]).reshape(-1, 3, 3)
    np.testing.assert_array_equal(corners, small.meshes[0].triangles())


def test_radiance_sky_is_read_as_it_is_meant(small, sky, tmp_path):
    """The table and the functions of the export, evaluated here as Radiance does, give what `environment` gives."""
    scene = PlainScene("turned", small.meshes, sky, CAMERA, 12)
    write_files.write(scene, "radiance", tmp_path / "new")
    lines = (tmp_path / "new" / "sky_g.dat").read_text().splitlines()
    table = np.array([line.split() for line in lines[3:]], float)
    assert [line.split() for line in lines[:3]] == [["2"], ["0", "4", "5"], ["0", "8", "9"]]
    code = (tmp_path / "new" / "sky.cal").read_text().replace(";", "")
    for direction in np.random.default_rng(1).normal(size=(50, 3)):
        direction /= np.linalg.norm(direction)
        names = dict(zip(("Dx", "Dy", "Dz"), direction, strict=True)) | {"PI": np.pi, "Acos": np.arccos}
        exec(code, names | {"atan2": np.arctan2, "floor": np.floor}, names)
        i, j = int(names["row"]), int(names["column"])
        a, b = names["row"] - i, names["column"] - j
        value = (1 - a) * ((1 - b) * table[i, j] + b * table[i, j + 1])
        value += a * ((1 - b) * table[i + 1, j] + b * table[i + 1, j + 1])
        assert value == pytest.approx(shared_files.radiance(sky, direction[None])[0, 1], abs=1e-6)


# --- LuxCore ---------------------------------------------------------------------------------------------


def test_luxcore_sees_the_whole_image_and_no_more(small):
    """The window is 2 wide and as much lower as the image is, 4 : 8, and lies one row, 2 / 8, deeper."""
    assert "scene.camera.screenwindow = -1.0 1.0 -0.75 0.25\n" in luxcore.files(small)["scene.scn"].decode()


# --- POV-Ray ---------------------------------------------------------------------------------------------


def test_povray_refuses_what_it_does_not_follow(small, tmp_path):
    pane, (ball,) = Mesh("pane", *tessellation.rectangle(), GLASS), meshes(Diffuse((0.5, 0.0, 0.0)))
    for mesh, words in ((pane, "pane: glass with an open"), (ball, "ball_0: a diffuse surface")):
        with pytest.raises(ValueError, match=words):
            write_files.write(PlainScene("bad", (mesh,), (1.0, 1.0, 1.0), CAMERA, 8), "povray", tmp_path / "new")
    assert not list(tmp_path.iterdir())


def test_povray_surfaces():
    """Glass is clear, a lamp emits from its front only, and a black surface nothing."""
    scene = PlainScene("lit", meshes(Light((1.0, 2.0, 3.0)), Diffuse((0.0, 0.0, 0.0))), (1.0, 1.0, 1.0), CAMERA, 8)
    text = povray.files(scene)["scene.pov"].decode()
    front = "texture { pigment { rgb <%s> } finish { ambient 0 diffuse 0 emission 1 } }"
    assert text.count(front % "1.0, 2.0, 3.0") == text.count(front % "0.0, 0.0, 0.0") == 1
    assert text.count("interior_texture { pigment { rgb 0 } finish { ambient 0 diffuse 0 } }") == 2


def test_povray_indices_are_relative_to_what_is_outside():
    inner, outer = Mesh("in", *tessellation.sphere(0), Glass(1.2, 1.6)), tessellation.sphere(0)
    scene = PlainScene(
        "two", (inner, Mesh("out", 2 * outer[0], outer[1], Glass(1.6, 1.25))), (1.0, 1.0, 1.0), CAMERA, 300
    )
    text = povray.files(scene)["scene.pov"].decode()
    assert [float(part.split()[0]) for part in text.split("interior { ior ")[1:]] == [1.2 / 1.25, 1.6 / 1.25]
    assert "max_trace_level 256" in text


# --- OBJ, JSON, PLY --------------------------------------------------------------------------------------


def test_obj_and_json_hold_everything(small, sky, tmp_path):
    scene = PlainScene("turned", small.meshes, sky, CAMERA, 12)
    write_files.write(scene, "obj+json", tmp_path / "new")
    lines = [line.split() for line in (tmp_path / "new" / "scene.obj").read_text().splitlines()]
    vertices = np.array([line[1:] for line in lines if line[0] == "v"], float)
    faces = np.array([line[1:] for line in lines if line[0] == "f"], int) - 1
    expected = np.concatenate([mesh.triangles() for mesh in scene.meshes])
    np.testing.assert_array_equal(vertices[faces], expected)
    document = json.loads((tmp_path / "new" / "scene.json").read_text())
    assert document["materials"]["material0"] == {"type": "glass", "int_ior": 1.5, "ext_ior": 1.000277}
    assert document["meshes"]["ball_1"] == {"object": "ball_1", "material": "material1"}
    assert document["camera"]["fov_x_degrees"] == 40 and document["max_depth"] == 12
    assert {line[1] for line in lines if line[0] == "usemtl"} == set(document["materials"])
    mtl = (tmp_path / "new" / "scene.mtl").read_text()
    assert all(f"newmtl {name}\n" in mtl for name in document["materials"])


def test_ply_is_read_by_mitsuba(small, tmp_path):
    write_files.write(small, "cycles", tmp_path / "new")
    mesh = mi.load_dict({"type": "ply", "filename": str(tmp_path / "new" / "ball_0.ply"), "face_normals": True})
    vertices = np.array(mesh.vertex_positions_buffer()).reshape(-1, 3)
    faces = np.array(mesh.faces_buffer()).reshape(-1, 3)
    np.testing.assert_array_equal(vertices[faces], small.meshes[0].triangles().astype(np.float32))


def test_the_map_has_no_date(small, sky, tmp_path):
    """So that the same scene gives the same bytes."""
    write_files.write(PlainScene("turned", small.meshes, sky, CAMERA, 12), "mitsuba", tmp_path / "new")
    assert image_file.read(tmp_path / "new" / "sky.exr").metadata["DateTime"] == "1970:01:01 00:00:00"


LOOKUPS = {
    "cycles": scene_json.cycles_direction_at,
    "luxcore": luxcore.direction_at,
    "povray": povray.direction_at,
    "own program": scene_json.own_direction_at,
}


@pytest.mark.parametrize("target", LOOKUPS)
def test_maps_are_looked_up_by_unit_directions(target, sky):
    """Every direction is somewhere on the map, and a resampled map shows in each what the sky shows there."""
    u, v = np.random.default_rng(6).random((2, 400))
    direction_at = LOOKUPS[target]
    directions = direction_at(u, v)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1)
    image = shared_files.longitude_latitude(sky, direction_at)
    height, width = image.shape[:2]
    nearest = image[(v * height).astype(int), (u * width).astype(int)]
    np.testing.assert_allclose(nearest, shared_files.radiance(sky, directions), atol=0.15)
    weights = np.sin(np.pi * (np.arange(height) + 0.5) / height)[:, None, None] * np.ones_like(image)
    sphere = np.random.default_rng(7).normal(size=(20000, 3))
    np.testing.assert_allclose(
        np.average(image, axis=(0, 1), weights=weights), shared_files.radiance(sky, sphere).mean(0), atol=0.01
    )


def test_scripts_for_other_pythons_are_complete(small, tmp_path):
    """They are copied out of the package, so they import nothing of it."""
    for target in ("cycles", "luxcore"):
        write_files.write(small, target, tmp_path / target)
        text = (tmp_path / target / "render.py").read_text()
        compile(text, "render.py", "exec")
        assert "mi_refract import" not in text and "from ." not in text


def test_the_readme_lists_every_target():
    readme = Path(write_files.__file__).with_name("README.md").read_text()
    assert set(write_files.TARGETS) <= set(re.findall(r"^\| `(.*?)` \|", readme, re.MULTILINE))

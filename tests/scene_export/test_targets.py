"""Exports are written completely or not at all; where this can be checked here, they are the same scene."""

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
@pytest.mark.parametrize("empty", [False, True])
def test_every_target_writes_its_folder(target, empty, small, sky, tmp_path):
    for i, shown in enumerate((small.sky, sky)):
        scene = PlainScene("a scene", () if empty else small.meshes, shown, CAMERA, 12)
        written = write_files.write(scene, target, tmp_path / f"{i}")
        assert sorted(written) == sorted((tmp_path / f"{i}").iterdir()) and (
            empty or all(map(os.path.getsize, written))
        )
        text = (tmp_path / f"{i}" / "README.txt").read_text()
        assert scene.name in text and all(len(line) <= 140 for line in text.splitlines())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0", "1"]


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
        ("full", "already contains files"),
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


# --- What the round trip of test_round_trip.py does not show -----------------------------------------------------


def renders(path, first, **defines):
    scene = mi.load_file(str(path), optimize=False, parallel=False, **defines)
    seeds = range(first, first + 8)
    return [image_file.named(f"seed {seed}", np.array(mi.render(scene, spp=64, seed=seed))) for seed in seeds]


def test_the_plain_scene_renders_equal_and_another_index_would_be_seen(tmp_path):
    """False alarms: 0.001 by the family error of `welch`; the seeds are fixed."""
    original, path = SCENES / "prism.xml", tmp_path / "plain" / "scene.xml"
    write_files.write(from_mitsuba.load(original, level=0, res="32"), "mitsuba", path.parent)
    first = renders(original, 0, res="32")
    assert methods.compare("welch", first, renders(path, 100), tile=16).verdict == Verdict.EQUAL
    text, material = path.read_text(), '<float name="int_ior" value="1.5046"/>'
    assert material in text
    path.write_text(text.replace(material, '<float name="int_ior" value="1.8"/>'))
    assert methods.compare("welch", first, renders(path, 100), tile=16).verdict == Verdict.DIFFERENT


def test_povray_refuses_what_it_does_not_follow(small, tmp_path):
    pane, (ball,) = Mesh("pane", *tessellation.rectangle(), GLASS), meshes(Diffuse((0.5, 0.0, 0.0)))
    for mesh, words in ((pane, "pane: glass with an open"), (ball, "ball_0: a diffuse surface")):
        with pytest.raises(ValueError, match=words):
            write_files.write(PlainScene("bad", (mesh,), (1.0, 1.0, 1.0), CAMERA, 8), "povray", tmp_path / "new")
    assert not list(tmp_path.iterdir())


def test_povray_surfaces_that_are_black():
    scene = PlainScene("lit", meshes(Light((1.0, 2.0, 3.0)), Diffuse((0.0, 0.0, 0.0))), (1.0, 1.0, 1.0), CAMERA, 8)
    text = write_files.TARGETS["povray"](scene)["scene.pov"].decode()
    front = "texture { pigment { rgb <%s> } finish { ambient 0 diffuse 0 emission 1 } }"
    assert text.count(front % "1.0, 2.0, 3.0") == text.count(front % "0.0, 0.0, 0.0") == 1
    assert text.count("interior_texture { pigment { rgb 0 } finish { ambient 0 diffuse 0 } }") == 2


def test_povray_indices_are_relative_to_what_is_outside():
    inner, (vertices, faces) = Mesh("in", *tessellation.sphere(0), Glass(1.2, 1.6)), tessellation.sphere(0)
    outer = Mesh("out", 2 * vertices, faces, Glass(1.6, 1.25))
    text = write_files.TARGETS["povray"](PlainScene("two", (inner, outer), (1.0, 1.0, 1.0), CAMERA, 300))["scene.pov"]
    assert [float(part.split()[0]) for part in text.split(b"interior { ior ")[1:]] == [1.2 / 1.25, 1.6 / 1.25]
    assert b"max_trace_level 256" in text


def test_the_map_has_no_date(small, sky, tmp_path):
    """So that the same scene gives the same bytes."""
    write_files.write(PlainScene("turned", small.meshes, sky, CAMERA, 12), "mitsuba", tmp_path / "new")
    assert image_file.read(tmp_path / "new" / "sky.exr").metadata["DateTime"] == "1970:01:01 00:00:00"


def test_the_readme_lists_every_target():
    readme = Path(write_files.__file__).with_name("README.md").read_text()
    assert set(write_files.TARGETS) <= set(re.findall(r"^\| `(.*?)` \|", readme, re.MULTILINE))

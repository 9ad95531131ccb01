"""What the scripts of exports ask of their renderers: each seed once, and a plain path tracer."""

import json
import runpy
import sys
import types
from unittest import mock

import numpy as np
import pytest
from support import fake_bpy, fake_raysect

from mi_refract.io import image_file
from mi_refract.scene_export import tessellation, write_files
from mi_refract.scene_export.plain_scene import Camera, Diffuse, Glass, Light, Mesh, PlainScene

CAMERA = Camera((0.0, 0.0, 9.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0, 8, 4)
MATERIALS = Glass(1.5, 1.25), Diffuse((0.1, 0.2, 0.3)), Light((1.0, 2.0, 3.0))


def written(target, folder, max_depth=12):
    meshes = tuple(Mesh(f"mesh_{i}", *tessellation.sphere(0), material) for i, material in enumerate(MATERIALS))
    write_files.write(PlainScene("small", meshes, (0.5, 0.25, 1.0), CAMERA, max_depth), target, folder)
    return folder


@pytest.mark.parametrize("words, seeds", [((), [1]), (("--seeds", "4", "2"), [4, 2])])
def test_cycles_renders_each_seed_into_a_file_of_its_own(words, seeds, tmp_path, monkeypatch, capsys):
    bpy = fake_bpy.run(written("cycles", tmp_path / "new"), monkeypatch, *words)
    files = [str(tmp_path / "new" / f"seed{seed}.exr") for seed in seeds]
    assert bpy.rendered == list(zip(seeds, files, strict=True))
    assert capsys.readouterr().out.split() == files
    bpy.ops.wm.read_factory_settings.assert_called_once_with(use_empty=True)


def test_cycles_is_a_plain_path_tracer(tmp_path, monkeypatch):
    bpy = fake_bpy.run(written("cycles", tmp_path / "new"), monkeypatch, "--threads", "2")
    render, cycles = bpy.context.scene.render, bpy.context.scene.cycles
    assert (render.engine, cycles.device, cycles.samples) == ("CYCLES", "CPU", 3)
    assert (render.resolution_x, render.resolution_y, render.resolution_percentage) == (8, 4, 100)
    assert (render.threads_mode, render.threads) == ("FIXED", 2)
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
    assert 0 < lens.clip_start <= 1e-3 and lens.clip_end >= 1e6


def test_cycles_has_a_limit_of_bounces(tmp_path, monkeypatch):
    bpy = fake_bpy.run(written("cycles", tmp_path / "new", max_depth=5000), monkeypatch)
    assert bpy.context.scene.cycles.max_bounces == bpy.context.scene.cycles.transmission_bounces == 1024
    assert bpy.context.scene.render.threads_mode != "FIXED"


class Session:
    """A render that has ended when it was asked three times."""

    def __init__(self, config):
        self.config, self.calls = config, []

    def HasDone(self):
        self.calls.append("HasDone")
        return self.calls.count("HasDone") > 2

    def __getattr__(self, name):
        return lambda: self.calls.append(name) or self

    def GetFilm(self):
        return types.SimpleNamespace(Save=lambda: self.calls.append("Save"))


@pytest.mark.parametrize(
    "words, seeds, threads",
    [((), [1], None), (("--seeds", "4", "2", "--threads", "3", "--spp", "9"), [4, 2], 3)],
)
def test_luxcore_renders_each_seed_into_a_file_of_its_own(words, seeds, threads, tmp_path, monkeypatch, capsys):
    folder, out = written("luxcore", tmp_path / "new"), tmp_path / "out"
    sessions, waits = [], []

    class Properties(dict):
        def __init__(self, name):
            super().__init__(name=name)

        def Set(self, pair):
            self.update([pair])

    lux = mock.MagicMock(Properties=Properties, Property=lambda key, value: (key, value))
    lux.RenderConfig = lambda config, scene: config
    lux.RenderSession = lambda config: sessions.append(Session(config)) or sessions[-1]
    monkeypatch.setitem(sys.modules, "pyluxcore", lux)
    monkeypatch.setattr("time.sleep", waits.append)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["render.py", "--out", "out", *words])
    runpy.run_path(str(folder / "render.py"))["main"]()
    files = [str(out / f"seed{seed}.exr") for seed in seeds]
    assert capsys.readouterr().out.split() == files
    for session, seed, file in zip(sessions, seeds, files, strict=True):
        assert session.config == {
            "name": "scene.cfg",
            "batch.haltspp": 9 if words else 256,
            "renderengine.seed": seed,
            "film.outputs.0.filename": file,
        } | ({"native.threads.count": threads} if threads else {})
        assert session.calls == ["Start", *["HasDone", "UpdateStats"] * 2, "HasDone", "Stop", "Save"]
    assert lux.Scene.return_value.Parse.call_args.args == ({"name": "scene.scn"},)
    assert 0 < max(waits) < 1


def test_raysect_writes_rows_from_the_lowest_and_weighs_no_ray(tmp_path, monkeypatch):
    _, script = fake_raysect.run(written("raysect", tmp_path / "new"), monkeypatch)
    pixels = np.arange(2 * 3 * 3, dtype=np.float32).reshape(2, 3, 3)
    (tmp_path / "image.pfm").write_bytes(script["pfm"](pixels))
    assert (image_file.read(tmp_path / "image.pfm").pixels == pixels).all()
    assert script["Camera"]((2, 1))._generate_rays(0, 0) == [("ray", 1.0)]


def test_raysect_lamps_are_black_from_behind(tmp_path, monkeypatch):
    _, script = fake_raysect.run(written("raysect", tmp_path / "new"), monkeypatch)
    lamp, ray = script["Light"]("bright"), types.SimpleNamespace(new_spectrum=lambda: "black")
    seen = [lamp.evaluate_surface("world", ray, "lamp", "place", exiting, "more") for exiting in (False, True)]
    assert seen == ["bright", "black"]


def test_raysect_takes_a_band_and_a_dispersion(tmp_path, monkeypatch):
    folder = written("raysect", tmp_path / "new")
    _, script = fake_raysect.run(folder, monkeypatch)
    plain = json.loads((folder / "scene.json").read_text())
    for band, bins in ((None, 3), ([656.0, 656.5], 1)):
        made = script["camera"]("world", plain, types.SimpleNamespace(spp=5, band=band), "pipeline")
        assert (made.spectral_rays, made.spectral_bins, made.pixel_samples) == (1, bins, 5)
        assert [made.min_wavelength, made.max_wavelength] == (band or [400, 700])
    entry = {"int_ior": 1.5, "ext_ior": 1.25}
    assert script["glass"](entry) == ("glass", 1.5, 1, 1.25)
    assert script["glass"](entry | {"schott": "SF11"})[1] == "of SF11"

"""`mi-refract render`: the image, its header, the remaining files, and exit codes."""

from __future__ import annotations

import os
import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.processes import assert_refused
from support.renders import GLASS

import mi_refract
from mi_refract import SCENES, backend
from mi_refract.io.image_file import installed_version, read_exr
from mi_refract.rendering.pass_plan import scalar_seed_of

# With a wider filter, the last bits depend on the order in which threads finish.
SCENE = GLASS.replace("</film>", '<rfilter type="box"/></film>')


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(SCENE)
    return path


@pytest.fixture
def render(scene, run):
    """`render("--spp", 2)`: exit code, stdout and stderr of rendering `scene` to out.exr in scalar_rgb."""

    def call(*options, scene=scene, output=None, variant="scalar_rgb"):
        words = ["--variant", variant] if variant else []
        return run("render", scene, "-o", output or scene.with_name("out.exr"), *words, *options)

    return call


def passes_by_mitsuba(scene, spp, seed=0, **parameters):
    """Return mean and variance of passes of one sample, of which a short render in a scalar variant consists."""
    loaded, threads = mi.load_file(str(scene), **parameters), dr.thread_count()
    dr.set_thread_count(1)
    seeds = [scalar_seed_of(seed, p, 8, 6) for p in range(spp)]
    passes = np.array([np.array(mi.render(loaded, spp=1, seed=x)) for x in seeds], np.float64)
    dr.set_thread_count(threads)
    return passes.mean(0).astype(np.float32), passes.var(0, ddof=1)


def test_image_equals_mitsubas_and_header_has_the_provenance(render, scene, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # set by CI and notebooks: colours, but no progress bar in a pipe
    code, out, err = render("--spp", 9, "--seed", 3, "-D", "bsdf=refract")
    assert (code, err) == (0, "") and "out.exr: scalar_rgb, 9 spp in 9 passes" in out
    pixels, header = read_exr(scene.with_name("out.exr"))
    mean, variance = passes_by_mitsuba(scene, 9, 3)
    np.testing.assert_array_equal(pixels[..., :3], mean)
    np.testing.assert_allclose(pixels[..., :2:-1], variance, rtol=1e-6)
    assert mean.std() > 0
    assert sorted(path.name for path in scene.parent.iterdir()) == ["out.exr", "scene.xml"]
    expected = {
        "variant": "scalar_rgb",
        "spp": 9,
        "seed": 3,
        "scene": str(scene),
        "defines": '{"bsdf": "refract"}',
        "formulas": "promoted (auto)",
        "missing": "none known",
        "version:mi_refract": mi_refract.__version__,
        "version:mitsuba": mi.__version__,
        "version:drjit": installed_version("drjit"),
    }
    assert {name: header[f"mi_refract:{name}"] for name in expected} == expected
    assert header["mi_refract:render_seconds"] > 0 and header["Software"] == f"mi_refract {mi_refract.__version__}"
    # In the order of OpenImageIO.
    assert header["channels"] == ("R", "G", "B", "B.variance", "G.variance", "R.variance")
    again = render("--spp", 9, "--seed", 3, "-D", "bsdf=refract")
    assert again == (0, out, f"{scene.with_name('out.exr')}: complete with 9 spp\n")
    assert render("--spp", 2, "-D", "bsdf=diffuse")[0] == 0  # a define swaps the plugin
    pixels, metadata = read_exr(scene.with_name("out.exr"))
    assert metadata["mi_refract:formulas"] == "none"
    np.testing.assert_array_equal(pixels[..., :3], passes_by_mitsuba(scene, 2, bsdf="diffuse")[0])
    assert not np.array_equal(pixels[..., :3], passes_by_mitsuba(scene, 2)[0])


@pytest.mark.parametrize("integrator", ["path", "refract_path", "ptracer"])
def test_missing_light_is_reported_on_stderr_and_in_the_header(render, scene, integrator):
    lamp = '<emitter type="point"><point name="position" value="0, 4, 0"/></emitter>'
    text = SCENE.replace('<emitter type="constant"/>', lamp).replace('"path"', f'"{integrator}"')
    scene.write_text(text)
    code, _, err = render("--spp", 2)
    missing = read_exr(scene.with_name("out.exr"))[1]["mi_refract:missing"]
    if integrator == "ptracer":
        assert (code, err, missing) == (0, "", "none known")
    else:
        assert (code, err) == (0, f"mi-refract: {scene}: missing {missing}\n")
        cast = "light of PointLight that delta lobes (glass, mirrors) cast on other surfaces is black"
        if integrator == "path":
            assert missing.startswith(f"L S+ D (S|D)* E: {cast}; expected ")
        else:
            assert missing.startswith(f"L S+ D (S|D)* S E: {cast} where it is seen through such lobes; expected ")


@pytest.mark.parametrize("usable", [True, False])
def test_default_variant_is_the_best(render, scene, monkeypatch, needs_variant, usable):
    if usable:
        needs_variant("llvm_ad_rgb")
    else:
        monkeypatch.setattr(backend, "llvm", lambda: backend.Backend("llvm", False, "made up"))
    code, _, err = render(variant=None)
    _, metadata = read_exr(scene.with_name("out.exr"))
    assert code == 0
    assert metadata["mi_refract:variant"] == ("llvm_ad_rgb" if usable else "scalar_rgb")
    note = "mi-refract: scalar_rgb is slow; only scalar_* variants run: made up\n"
    assert err == ("" if usable else note)


NO_FILM = SCENE.replace("<rfilter", '<integer name="crop_width" value="0"/><rfilter')
NO_SAMPLES = SCENE.replace('name="sample_count" value="4"', 'name="sample_count" value="0"')
BAD = {
    "no scene": ({"scene": "none.xml"}, (), "none.xml: no such scene file"),
    "no checkout": ({"scene": "sphere.xml"}, (), f"no such scene file; the package has {SCENES / 'sphere.xml'}"),
    "a name alone": ({"scene": "sphere"}, (), f"no such scene file; the package has {SCENES / 'sphere.xml'}"),
    "a folder": ({"scene": str(SCENES)}, (), f"{SCENES}: no such scene file"),
    "no variant": ({"variant": "llvm_rgb"}, (), "variant 'llvm_rgb': unknown; expected scalar_rgb"),
    "no folder": ({"output": "none/out.exr"}, (), "is not a folder"),
    "a device": ({"output": "device.exr"}, (), "device.exr: is a device; expected the name of a file"),
    "no EXR": ({"output": "out.png"}, (), "expected a file name that ends in .exr"),
    "define without a value": ({}, ("-D", "bsdf"), "-D bsdf; expected NAME=VALUE"),
    "define without a name": ({}, ("-D", "=dielectric"), "-D =dielectric; expected NAME=VALUE"),
    "define twice": ({}, ("-D", "bsdf=a", "-D", "bsdf=b"), "bsdf is given twice"),
    "define of nothing": ({}, ("-D", "bdsf=dielectric"), "bdsf"),
    "define of the parser": ({}, ("-D", "config=x"), "reserved by Mitsuba's parser"),
    "plugin of another kind": ({}, ("-D", "bsdf=../evil"), "plugin '../evil': neither Mitsuba's nor mi_refract's"),
    "no plugin": ({}, ("-D", "bsdf=nonesuch"), "nonesuch"),
    "no samples": ({}, ("--spp", "0"), "--spp"),
    "no number": ({}, ("--spp", "many"), "--spp"),
    "no seed": ({}, ("--seed", "-1"), "--seed"),
    "no option": ({}, ("--nonesuch",), "--nonesuch"),
    "no error": ({}, ("--until", ""), "--until ; expected more than 0 %"),
    "no error of tiles": ({}, ("--until-tile", ""), "--until-tile ; expected more than 0 %"),
    "no settings": ({}, ("--settings", "fast"), "--settings fast: 'fast'; expected auto, or sampler=…, integrator=…"),
    "a pilot of a scalar variant": ({}, ("--settings", "auto"), "auto: samples cannot be rendered one by one"),
    "no time": ({}, ("--time", ""), "--time ; expected a time of more than 0"),
    "malformed": (SCENE.replace("</shape>", ""), (), "mismatch"),
    "unknown parameter": (SCENE.replace("max_depth", "max_dept"), (), "max_dept"),
    "a BSDF": ('<bsdf version="3.0.0" type="dielectric"/>', (), "contains a BSDF; expected a <scene>"),
    "no sensor": ('<scene version="3.0.0"/>', (), "the scene has no sensor"),
    "no integrator": (re.sub("<integrator.*/integrator>", "", SCENE), (), "scene.xml: the scene has no integrator"),
    "a film without pixels": (NO_FILM, (), "scene.xml: a film of 0 × 6 pixels; expected 1 to"),
    "a scene without samples": (NO_SAMPLES, (), "the sampler's sample_count = 0; expected 1 or more, or --spp"),
    "empty": ("", (), "scene.xml"),
}


@pytest.mark.parametrize("changed, options, message", BAD.values(), ids=BAD)
def test_bad_input(render, scene, changed, options, message):
    """One line, exit code 2, and nothing is written."""
    if isinstance(changed, str):
        scene.write_text(changed)
        changed = {}
    paths = {key: scene.parent / value if key != "variant" else value for key, value in changed.items()}
    if "output" in paths and paths["output"].stem == "device":
        paths["output"].symlink_to("/dev/null")
    assert_refused(render(*options, **paths), message)
    assert [path for path in scene.parent.iterdir() if not path.is_symlink()] == [scene]


def test_settings_option_replaces_the_scenes_settings(render, scene):
    """The image equals that of the scene with another sampler; without the option it belongs to another render."""
    sampler = SCENE.replace('"independent"', '"stratified"')
    options = "--spp", 4, "--pass-spp", 4
    assert render(*options, "--settings", "sampler=stratified")[0] == 0
    pixels, header = read_exr(scene.with_name("out.exr"))
    assert header["mi_refract:settings"] == "sampler=stratified"
    assert render(*options)[2] == ""  # does not resume
    assert read_exr(scene.with_name("out.exr"))[1]["mi_refract:settings"] == "the scene's own"
    scene.write_text(sampler)
    assert render(*options)[0] == 0
    np.testing.assert_array_equal(read_exr(scene.with_name("out.exr"))[0], pixels)


def test_a_plugin_shipped_with_a_scene_needs_allow_plugins(render, scene):
    """If it is allowed, Mitsuba tries to load it and fails, because it is not native code."""
    scene.with_name("plugins").mkdir()
    (scene.parent / "plugins" / "evil.so").write_text("native code")
    message = "expected those; to load native code shipped with a scene, pass --allow-plugins evil"
    assert_refused(render("-D", "bsdf=evil"), message)
    allowed = render("-D", "bsdf=evil", "--allow-plugins", "other", "--allow-plugins", "evil")
    assert_refused(allowed, "Error while loading plugin", "plugins/evil.so")


def test_a_failed_render_keeps_the_old_image(render, scene):
    """A missing plugin, a render that is cut short, and a pipe in place of the scene."""
    output = scene.with_name("out.exr")
    output.write_text("old")
    assert render("-D", "bsdf=nonesuch")[0] == 2
    scene.write_text(SCENE.replace('value="5"/>', 'value="5"/><float name="timeout" value="0.01"/>'))
    code, _, err = render("--spp", 100000)
    assert code == 2 and "stopped before its last sample" in err.splitlines()[-1]
    scene.unlink()
    os.mkfifo(scene)
    code, _, err = render()
    assert (code, err) == (2, f"mi-refract: {scene}: not a regular file\n")
    assert output.read_text() == "old" and {*scene.parent.iterdir()} == {scene, output}

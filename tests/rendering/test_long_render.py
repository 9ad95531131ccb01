"""Renders in passes from end to end: their files, limits, resuming, and failures."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import random
import signal
import time
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from support.processes import python
from support.readme import DOCS, python_blocks
from support.renders import BALL, SCENES, SMALL, leaf, pixels, rendering, stopped_after

from mi_refract.cluster import on_worker
from mi_refract.image_diff.comparison import Verdict
from mi_refract.image_diff.methods import compare
from mi_refract.io.image_file import read, read_exr, write_exr
from mi_refract.rendering import checkpoint, long_render, render_pass, rendered_file
from mi_refract.rendering.end_conditions import Limits
from mi_refract.rendering.long_render import Job, render_to_exr, resume
from mi_refract.rendering.render_pass import PassRenderer

SCENE = SCENES / "nested.xml"
SKY = """<scene version="3.0.0"><integrator type="path"/><sensor type="perspective"><film type="hdrfilm">
<integer name="width" value="8"/><integer name="height" value="8"/></film></sensor>{}</scene>"""

LENS = '<float name="aperture_radius" value="0.1"/><float name="focus_distance" value="4"/>'

pytestmark = pytest.mark.usefixtures("scalar_variant")


def changed(tmp_path, *replacements):
    """Write the scene of the ball with some texts replaced, and return its path."""
    text = BALL.read_text()
    for old, new in replacements:
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "scene.xml").write_text(text)
    return tmp_path / "scene.xml"


def assert_same_as_fresh(output, scene=BALL, **limits):
    """Assert that an image has the bits of a render from the first pass on."""
    rendering(output.with_name("fresh.exr"), scene=scene, restart=True, **limits).run()
    np.testing.assert_array_equal(pixels(output), pixels(output.with_name("fresh.exr")))


# The image and its header -------------------------------------------------------------------------------------------


def test_the_header_in_the_documentations_example_renders_the_same_image_again(tmp_path, monkeypatch):
    (code,) = python_blocks(DOCS / "how-to/render-for-hours.md")
    monkeypatch.chdir(SCENES.parent)
    for old, new in {'"nested.exr"': f'r"{tmp_path}/a.exr"', "spp=256": "spp=2", '{"': '{"res": "8", "'}.items():
        assert old in code
        code = code.replace(old, new)
    exec(code, names := {})
    image, header = read_exr(tmp_path / "a.exr")
    inexact = ("mi_refract:render_seconds", "mi_refract:scene")  # float32 and UTF-8 in the file
    assert all(header[name] == value for name, value in names["header"].items() if name not in inexact)
    assert image.shape[:2] == (8, 8) and header["mi_refract:seed"] == json.loads(header["mi_refract:identity"])["seed"]
    spp, seed = header["mi_refract:spp"], header["mi_refract:seed"]
    defines = json.loads(header["mi_refract:defines"])
    render_to_exr(header["mi_refract:scene"], tmp_path / "b.exr", defines=defines, spp=spp, seed=seed)
    np.testing.assert_array_equal(image, pixels(tmp_path / "b.exr"))


def test_the_variance_of_many_passes_is_from_their_spread(tmp_path, llvm_variant):
    render = rendering(tmp_path / "a.exr", spp=60, pass_spp=4)
    header = render.run()
    image = read(tmp_path / "a.exr")
    passes = np.array([render.renderer.render(p, 4).mean for p in range(15)])
    np.testing.assert_allclose(image.select("RGB"), passes.mean(0), rtol=1e-7)
    variance = image.select([f"{name}.variance" for name in "RGB"])
    np.testing.assert_allclose(variance, 4 * passes.var(0, ddof=1), rtol=1e-6, atol=1e-12)
    assert (header["mi_refract:passes"], header["mi_refract:variance_freedom"]) == (15, 14)
    assert header["mi_refract:variance_from"] == "passes"


def test_the_variance_of_few_passes_is_from_their_samples(tmp_path, llvm_variant):
    header = rendering(tmp_path / "a.exr", spp=30, pass_spp=8).run()
    assert (header["mi_refract:passes"], header["mi_refract:variance_freedom"]) == (4, 29)
    assert header["mi_refract:variance_from"] == "samples: an upper bound where the sampler stratifies them"
    rendering(tmp_path / "b.exr", spp=2048, pass_spp=16).run()
    few, many = (read(tmp_path / name).select(["R.variance"]).mean() for name in ("a.exr", "b.exr"))
    # 64 pixels with 29 degrees of freedom each, and samples with a kurtosis of up to about 20: standard error 10 %.
    assert few == pytest.approx(many, rel=0.5)
    header = rendering(tmp_path / "one.exr", spp=1).run()
    assert read(tmp_path / "one.exr").channels == ("R", "G", "B") and header["mi_refract:variance_from"] == "nothing"


@pytest.mark.parametrize(("spp", "pass_spp"), [(64, 64), (16, 1)])
def test_equal_renders_with_a_wide_filter_compare_as_equal(tmp_path, llvm_variant, spp, pass_spp):
    """Neighbours share samples, also in files whose variance has as many degrees of freedom as samples.

    With a family error of 20 %, more than 6 of 10 pairs are different once in 1157 runs.
    """
    scene, images = changed(tmp_path, ('"box"', '"gaussian"')), []
    for seed in range(20):
        output = tmp_path / "a.exr"
        rendering(output, seed, scene, {"res": "64"}, spp=spp, pass_spp=pass_spp, restart=True).run()
        images.append(read(output))
    pairs = zip(images[::2], images[1::2], strict=True)
    verdicts = [compare("auto", a, b, family_error=0.2, resolution=9.0).verdict for a, b in pairs]
    assert verdicts.count(Verdict.DIFFERENT) <= 6


def test_non_finite_pixels_are_counted(tmp_path, llvm_variant, monkeypatch):
    render = rendering(tmp_path / "a.exr", spp=64, pass_spp=4)
    original = type(render.renderer).render

    def broken(self, number, spp):
        sums = original(self, number, spp)
        sums.total[2, 3] *= np.nan if number == 5 else 1
        return sums

    monkeypatch.setattr(type(render.renderer), "render", broken)
    assert render.run()["mi_refract:nonfinite_pixels"] == 1
    assert np.isnan(pixels(tmp_path / "a.exr")).any(-1).sum() == 1


# Limits ---------------------------------------------------------------------------------------------------------------

INVALID = [{"spp": 0}, {"spp": -1}, {"pass_spp": 0}, {"until": 0.0}, {"until": -0.1}, {"until": 1.01}]
INVALID += [{"until": float("nan")}, {"until_tile": 2.0}, {"seconds": 0.0}, {"seconds": float("inf")}]
INVALID += [{"seed": -1}, {"seed": 2**32}, {"defines": {"config": "x"}}]


@pytest.mark.parametrize("options", [*INVALID, None], ids=str)
def test_invalid_options_are_refused_before_the_rendering(tmp_path, monkeypatch, options):
    monkeypatch.setattr(mi, "render", lambda *arguments, **options: pytest.fail("rendered"))
    with pytest.raises((ValueError, NotADirectoryError), match="expected ") as error:
        rendering(tmp_path / ("a.exr" if options else "none/a.exr"), **options or {})
    assert "\n" not in str(error.value) and not list(tmp_path.iterdir())


def test_a_render_without_noise_ends_early_unless_it_is_black(tmp_path, llvm_variant):
    light, deterministic = '<emitter type="constant"/>', '><boolean name="deterministic" value="true"/></integrator>'
    for name, emitter in (("light", light), ("dark", "")):
        (tmp_path / f"{name}.xml").write_text(SKY.format(emitter))
    rgba = '"hdrfilm"><string name="pixel_format" value="rgba"/>'
    text = SKY.format(light).replace('"path"/>', f'"refract_path"{deterministic}').replace('"hdrfilm">', rgba)
    (tmp_path / "clear.xml").write_text(text)
    depth = '<string name="aovs" value="d:depth"/>'
    unlit = '<integrator type="path"><boolean name="hide_emitters" value="true"/></integrator>'
    text = SKY.format(light).replace('type="path"/>', f'type="aov">{depth}{by("path")}{unlit}</integrator>')
    (tmp_path / "dark aov.xml").write_text(text)
    ended = "no noise: the samples of every pixel agree"
    expected = {
        ("light", 64): (1, ended),
        ("light", 4): (16, ended),  # 4 samples are too few
        ("clear", 64): (1, ended),  # opacity is 0 in every pixel, and nothing is truncated
        ("dark", 64): (4, "256 spp"),  # there may be light that no sample has found
        ("dark aov", 64): (4, "256 spp"),  # in the image of a further integrator
        ("dark", 4): (64, "256 spp"),
    }
    for (name, pass_spp), (passes, reason) in expected.items():
        for spp in (256, 256, 512):
            render = resume(Job(tmp_path / f"{name}.xml"), tmp_path / "a.exr", Limits(spp=spp, pass_spp=pass_spp))
            header = render.run()
            if spp == 256 or reason == ended:  # a finished image without noise is not refined
                assert (header["mi_refract:passes"], render.ended_by) == (passes, reason)
        (tmp_path / "a.exr").unlink()
    render = resume(Job(tmp_path / "dark.xml"), tmp_path / "a.exr", Limits(until=0.1, pass_spp=1))
    stopped_after(render, 13)
    assert len(render.warnings) == 1 and "the image is still black" in render.warnings[0]


@pytest.mark.parametrize("sampler", ["stratified", "multijitter", "orthogonal"])
def test_a_sampler_without_jitter_renders_a_single_pass(tmp_path, llvm_variant, monkeypatch, sampler):
    """Its points are on one grid in all passes, so their spread lacks the error of the grid."""
    no_jitter = f'<sampler type="{sampler}"><boolean name="jitter" value="false"/>'
    output, scene = tmp_path / "a.exr", changed(tmp_path, ('<sampler type="$sampler">', no_jitter))
    more = [{"spp": 50, "pass_spp": 25}, {"seconds": 9.0}, {"until": 0.1}]
    for limits in more:
        with pytest.raises(ValueError, match=r"scene.xml: the sampler has no jitter, .*; expected jitter, or one pass"):
            rendering(output, scene=scene, **limits)
    assert rendering(output, scene=scene, spp=25, pass_spp=25).run()["mi_refract:passes"] == 1
    for limits in more:
        with pytest.raises(ValueError, match="no jitter"):
            rendering(output, scene=scene, **limits)
    assert rendering(output, scene=scene, spp=25, pass_spp=25).end() == "25 spp"
    with monkeypatch.context() as earlier:
        earlier.setattr(PassRenderer, "jitter", True)
        rendering(output, scene=scene, **more[0]).run()
    assert rendering(output, scene=scene, **more[0]).end() == "50 spp"


GLASS = '<bsdf type="refract"/>'
PANE = f'<shape type="cube"><transform name="to_world"><scale z="1e-7"/></transform>{GLASS}</shape>'
FLINT = '<shape type="sphere"><bsdf type="refract"><string name="int_ior" value="SCHOTT:N-SF11"/></bsdf></shape>'
DISPERSIVE = FLINT, "all light has the index of the d line; expected the integrator refract_path"
THIN = PANE, "expected a thicker shape, or one nearer to the origin"
INEXACT = f'<shape type="cylinder"><float name="radius" value="1e-3"/>{GLASS}</shape>', "err by up to"
AOV = '<integrator type="aov"><string name="aovs" value="d:depth"/>{}</integrator>'


def by(name):
    return f'<integrator type="{name}"/>'


@pytest.mark.parametrize(
    ("integrator", "wrong", "named"),
    [
        (by("path"), DISPERSIVE, True),
        (AOV.format(by("path")), DISPERSIVE, True),
        (by("refract_path"), DISPERSIVE, False),
        (AOV.format(by("refract_path")), DISPERSIVE, False),
        (AOV.format(""), DISPERSIVE, False),
        (by("depth"), DISPERSIVE, False),
        (by("refract_path"), THIN, True),
        (by("path"), THIN, False),
        (by("path"), INEXACT, True),
    ],
)
def test_what_is_rendered_wrong_is_named(tmp_path, llvm_spectral, integrator, wrong, named):
    shapes, words = wrong
    place = '<transform name="to_world"><lookat origin="0,0,9" target="0,0,0" up="0,1,0"/></transform>'
    text = SKY.format('<emitter type="constant"/>' + shapes).replace(by("path"), integrator)
    (tmp_path / "a.xml").write_text(text.replace("<film", place + "<film"))
    warnings = resume(Job(tmp_path / "a.xml"), tmp_path / "a.exr", Limits(spp=1)).warnings
    assert [text.startswith(f"{tmp_path}/a.xml: ") and words in text for text in warnings] == [True] * named


def test_a_pass_that_fails_leaves_no_render_behind(tmp_path, llvm_variant, monkeypatch):
    render = resume(Job(BALL, SMALL, settings="integrator=refract_path"), tmp_path / "a.exr", Limits(spp=4))
    integrator, seen = render.scene.integrator(), []

    def interrupted(*samples, **options):
        seen.append(integrator.rendering)
        raise KeyboardInterrupt

    monkeypatch.setattr(render_pass, "image_sums", interrupted)
    with pytest.raises(KeyboardInterrupt):
        render.renderer.render(0, 4)
    assert seen == [True] and not integrator.rendering and not integrator.loops


def biased(tmp_path, sampler, integrator, scene=BALL, defines=SMALL):
    """Return whether a render of 8 × 8 pixels warns of the bias of its sampler."""
    settings = f"sampler={sampler}" + (integrator and f",integrator={integrator}")
    warnings = resume(Job(scene, defines, settings=settings), tmp_path / "a.exr", Limits(spp=4)).warnings
    return any(f"{scene}: the sampler {sampler} biases the image" in text for text in warnings)


@pytest.mark.parametrize("sampler", ["stratified", "ldsampler"])
def test_a_sampler_that_biases_the_image_is_named(tmp_path, llvm_variant, sampler):
    assert biased(tmp_path, sampler, "path") and not biased(tmp_path, sampler, "refract_path")
    assert not any(biased(tmp_path, other, "path") for other in ("independent", "multijitter", "orthogonal"))
    lens = changed(tmp_path, ("perspective", "thinlens"), ('<float name="fov"', LENS + '<float name="fov"'))
    assert biased(tmp_path, sampler, "refract_path", lens)


@pytest.mark.parametrize(("around", "named"), [("aov", False), ("moment", False), ("moment, path", True)])
def test_a_biased_sampler_is_named_by_the_integrators_that_take_its_numbers(tmp_path, llvm_variant, around, named):
    plugin, _, other = around.partition(", ")
    inner = "".join(f'<integrator type="{name}"/>' for name in ("refract_path", other) if name)
    text = f'<integrator type="{plugin}"><string name="aovs" value="d:depth"/>{inner}</integrator>'
    if plugin == "moment":
        text = text.replace('<string name="aovs" value="d:depth"/>', "")
    (tmp_path / "sky.xml").write_text(SKY.format('<emitter type="constant"/>').replace(by("path"), text))
    assert biased(tmp_path, "ldsampler", "", tmp_path / "sky.xml", {}) == named


def test_scalar_variants_of_refract_path_take_the_samplers_numbers(tmp_path):
    assert biased(tmp_path, "ldsampler", "refract_path")


def test_a_render_ends_at_the_first_limit_that_it_reaches(tmp_path, llvm_variant):
    for _ in range(2):  # the second time from the finished image
        render = rendering(tmp_path / "a.exr", until=0.1, pass_spp=2)
        assert render.run()["mi_refract:passes"] in (8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256)  # only at a stop
        assert render.error().high <= 0.1 and "--until 10 %" in render.ended_by
    assert rendering(tmp_path / "b.exr", until=0.1, spp=8, pass_spp=2).run()["mi_refract:spp"] == 8
    render = rendering(tmp_path / "c.exr", until_tile=0.2, pass_spp=2)
    render.run()
    assert "--until-tile 20 %" in render.ended_by
    render, start = rendering(tmp_path / "d.exr", seconds=0.2, pass_spp=1), time.monotonic()
    header = render.run()
    assert time.monotonic() - start >= 0.2 and render.ended_by == "--time 0.2 s"
    assert_same_as_fresh(tmp_path / "d.exr", spp=header["mi_refract:spp"], pass_spp=1)
    timeout = '<integrator type="$integrator"><float name="timeout" value="0.01"/>'  # has no effect
    scene = changed(tmp_path, ('<integrator type="$integrator">', timeout))
    assert rendering(tmp_path / "e.exr", scene=scene, spp=8, pass_spp=4).run()["mi_refract:spp"] == 8


def test_passes_grow_by_no_more_than_the_error_needs(tmp_path, llvm_variant):
    """The final error is at least 2/3 of its limit, and a resumed render has the same bits."""
    limits, sizes = {"until": 0.02}, []
    options = {"defines": {"res": "64"}, "restart": True}
    rendering(tmp_path / "a.exr", **options, **limits).run(lambda render: sizes.append(render.plan.spp))
    render = rendering(tmp_path / "b.exr", **options, **limits)
    for passes in (8, 9, 13):  # after the passes of the first size, and between passes of other sizes
        stopped_after(render, passes)
        render = rendering(tmp_path / "b.exr", defines={"res": "64"}, **limits)
        assert render.progress.passes == passes
    render.run()
    np.testing.assert_array_equal(pixels(tmp_path / "a.exr"), pixels(tmp_path / "b.exr"))
    error = render.error()
    assert 2 / 3 * 0.02 < error.value < error.high <= 0.02
    assert sizes[0] < max(sizes) and sizes[-1] < max(sizes)
    # A checkpoint that is good enough for a larger error becomes the image.
    stopped_after(rendering(tmp_path / "c.exr", **options, **limits), 8)
    rendering(tmp_path / "c.exr", defines={"res": "64"}, until=0.2).run()
    assert read(tmp_path / "c.exr").metadata["mi_refract:passes"] == 8
    assert not checkpoint.path_of(tmp_path / "c.exr").exists()


def test_an_image_without_finite_pixels_is_an_error_of_until(tmp_path, llvm_variant):
    nan = '<emitter type="constant"><rgb name="radiance" value="nan"/></emitter>'
    (tmp_path / "a.xml").write_text(SKY.format(nan))
    for limits in ({"until": 0.1}, {"until_tile": 0.1, "pass_spp": 4}):
        render = resume(Job(tmp_path / "a.xml"), tmp_path / "a.exr", Limits(**limits), restart=True)
        with pytest.raises(ValueError, match=r"a\.exr: no pixel of the image is finite; --until cannot be evaluated"):
            render.run()
    header = resume(Job(tmp_path / "a.xml"), tmp_path / "a.exr", Limits(until=0.1, spp=40), restart=True).run()
    assert header["mi_refract:nonfinite_pixels"] == 64 and header["mi_refract:spp"] == 40


def test_a_resumed_render_estimates_its_error_only_at_stops(tmp_path, llvm_variant, monkeypatch):
    """After 9 passes the next stop is at 12: an estimate that is evaluated often is too small at some time."""
    rendering(tmp_path / "a.exr", spp=18, pass_spp=2).run()
    stops = set()

    def reached(limits, sums, channels):
        stops.add(sums.passes)
        return ""

    monkeypatch.setattr(long_render, "reached", reached)
    stopped_after(rendering(tmp_path / "a.exr", until=1e-3, pass_spp=2), 25)
    assert stops == {12, 16, 24}


# Resuming -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("passes", [1, 7, 8, 9, 20])
def test_a_checkpoint_resumes_with_the_same_bits(tmp_path, llvm_variant, passes):
    output = tmp_path / "a.exr"
    stopped_after(rendering(output, spp=90, pass_spp=4), passes)
    assert checkpoint.path_of(output).exists() and not output.exists()
    render = rendering(output, spp=90, pass_spp=4)
    assert render.progress.passes == passes
    render.run()
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]
    assert_same_as_fresh(output, spp=90, pass_spp=4)


def test_a_finished_image_of_the_same_render_is_refined(tmp_path, llvm_variant):
    output, pass_counts = tmp_path / "a.exr", []
    output.write_bytes(b"no EXR")
    assert rendering(output, spp=8).progress.done == 0
    rendering(output, spp=32, pass_spp=4).run()
    for other in ({"seed": 1}, {"spp": 16}, {"restart": True}):
        assert rendering(output, **{"spp": 64, "pass_spp": 4} | other).progress.done == 0
    render = rendering(output, spp=64, pass_spp=4)
    assert render.progress.done == 32
    header = render.run(lambda render: pass_counts.append(render.progress.passes))
    assert header["mi_refract:spp"] == 64 and pass_counts[0] == 9 and pass_counts[-1] == 16
    rendering(tmp_path / "b.exr", spp=64, pass_spp=4).run()
    # The same samples, but the sums of the first half were rounded to float32.
    np.testing.assert_allclose(pixels(output)[..., :3], pixels(tmp_path / "b.exr")[..., :3], rtol=3e-7)
    rendering(output, spp=12, pass_spp=4, restart=True).run()  # few passes: the variance of the file is kept
    variance = rendering(output, spp=16, pass_spp=4).progress.sums().variance
    np.testing.assert_allclose(variance, read(output).select([f"{name}.variance" for name in "RGB"]))
    scene = changed(tmp_path, ('value="independent"', 'value="stratified"'))  # this sampler rounds up
    assert rendering(output, scene=scene, spp=10).run()["mi_refract:spp"] == 16
    assert rendering(output, scene=scene, spp=10).progress.done == 16


def test_a_bound_of_the_variance_does_not_remain_in_a_refined_image(tmp_path, llvm_variant):
    """The samples of 4 passes are stratified; with 8 passes, the variance is from the spread between them."""
    how = {"scene": changed(tmp_path, ('value="independent"', 'value="stratified"')), "pass_spp": 16}

    def variance(name, passes):
        header = rendering(tmp_path / name, spp=16 * passes, **how).run()
        of_colours = read(tmp_path / name).select([f"{name}.variance" for name in "RGB"])
        return header["mi_refract:variance_from"], float(of_colours.mean(dtype=np.float64))

    (_, bound), refined, fresh = variance("a.exr", 4), variance("a.exr", 8), variance("b.exr", 8)
    assert refined == ("passes", pytest.approx(fresh[1], rel=1e-5)) and bound > 1.5 * fresh[1]


@pytest.mark.parametrize(("pass_spp", "variance"), [(8, "nothing"), (4, "passes")])
def test_an_image_without_a_variance_is_kept_and_refined(tmp_path, pass_spp, variance):
    """Scalar variants do not keep samples, so a single pass has no variance."""
    output = tmp_path / "a.exr"
    assert rendering(output, spp=8, pass_spp=pass_spp).run()["mi_refract:variance_from"] == variance
    assert rendering(output, spp=8, pass_spp=pass_spp).progress.done == 8
    rendering(output, spp=16, pass_spp=pass_spp).run()
    rendering(tmp_path / "b.exr", spp=16, pass_spp=pass_spp).run()
    np.testing.assert_allclose(pixels(output)[..., :3], pixels(tmp_path / "b.exr")[..., :3], rtol=3e-7)


@pytest.mark.parametrize(("rfilter", "spp", "kept"), [("lanczos", 1, 0), ("lanczos", 8, 8), ("box", 1, 1)])
def test_an_image_of_few_samples_under_a_wide_filter_is_not_refined(tmp_path, rfilter, spp, kept):
    """Σ w, which the file lacks, may be near 0: then one sample would leave a bright pixel in the refined image."""
    scene, output = changed(tmp_path, ('"box"', f'"{rfilter}"')), tmp_path / "a.exr"
    rendering(output, scene=scene, spp=spp).run()
    assert rendering(output, scene=scene, spp=spp).progress.done == spp
    assert rendering(output, scene=scene, spp=None, seconds=1.0).progress.done == kept
    render = rendering(output, scene=scene, spp=12)
    assert render.progress.done == kept
    render.run()
    if not kept:
        assert_same_as_fresh(output, scene, spp=12)


def test_an_image_of_another_size_is_not_refined(tmp_path):
    output = tmp_path / "a.exr"
    header = rendering(output, spp=8, pass_spp=4).run()
    image = read(output)
    write_exr(output, image.pixels[:4, :4], image.channels, header)
    assert rendering(output, spp=16, pass_spp=4).progress.done == 0


@pytest.mark.parametrize("spp", [6, 32, 40])
def test_the_same_command_again_renders_nothing_and_changes_nothing(tmp_path, llvm_variant, spp, monkeypatch):
    output = tmp_path / "a.exr"
    rendering(output, spp=spp, pass_spp=4).run()
    content, render = output.read_bytes(), rendering(output, spp=spp, pass_spp=4)
    monkeypatch.setattr(type(render.renderer), "render", lambda *arguments: pytest.fail("rendered"))
    render.run()
    assert output.read_bytes() == content


def test_a_last_pass_that_the_sampler_rounds_up_is_kept(tmp_path, llvm_variant):
    scene = changed(tmp_path, ('value="independent"', 'value="stratified"'))
    stopped_after(rendering(tmp_path / "a.exr", scene=scene, spp=6, pass_spp=4), 2)
    rendering(tmp_path / "a.exr", scene=scene, spp=6, pass_spp=4).run()
    assert_same_as_fresh(tmp_path / "a.exr", scene, spp=6, pass_spp=4)


def test_a_checkpoint_of_another_render_is_refused_with_the_difference(tmp_path, llvm_variant, monkeypatch):
    """Files that the scene names are part of the scene."""
    texture = '<bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename" value="a.ppm"/>'
    size = '<transform name="to_world"><scale value="1"/></transform>'
    textured = ("</scene>", f'<shape type="sphere">{texture}</texture></bsdf>{size}</shape></scene>')
    (tmp_path / "a.ppm").write_bytes(b"P6 1 1 255 123")
    scene = changed(tmp_path, textured)

    def assert_refused(message, **options):
        limits = {"spp": 64, "pass_spp": 4} | options
        with pytest.raises(ValueError, match=message) as error:
            rendering(tmp_path / "a.exr", scene=scene, **limits)
        assert "--restart" in str(error.value) and "\n" not in str(error.value)
        assert rendering(tmp_path / "a.exr", scene=scene, restart=True, **limits).progress.passes == 0

    stopped_after(rendering(tmp_path / "a.exr", scene=scene, spp=64, pass_spp=4), 3)
    assert_refused("seed was 0, is 1", seed=1)
    assert_refused("passes of 4 samples per pixel", pass_spp=8)
    assert_refused("already holds 12 samples per pixel; expected --spp 12 or more, or --restart", spp=8)
    for change in (("30.5", "30.6"), ('<scale value="1"/>', '<scale value="1.0000002"/>')):
        changed(tmp_path, textured, change)
        assert_refused("the scene has changed")
    changed(tmp_path, textured)
    (tmp_path / "a.ppm").write_bytes(b"P6 1 1 255 124")
    assert_refused("the scene has changed")
    (tmp_path / "a.ppm").write_bytes(b"P6 1 1 255 123")
    for module, name, value, message in (
        (long_render, "installed_version", "0", r"version of mitsuba was \S+, is 0"),
        (on_worker, "vector_width", "64", r"vector width was \d+, is 64"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(module, name, lambda *_, value=value: value)
            assert_refused(message)
    mi.set_variant("scalar_rgb")
    assert_refused("variant was llvm_ad_rgb, is scalar_rgb")


def forged(header=None, nodes=None, sums=lambda sums: sums):
    """Return a function that changes the content of a checkpoint, and gives it the digest of the changed content."""

    def change(content):
        line, old_sums = content[32:].split(b"\n", 1)
        new_header = json.loads(line) | (header or {})
        new_header["nodes"] |= nodes or {}
        content = json.dumps(new_header).encode() + b"\n" + sums(old_sums)
        return hashlib.sha256(content).digest() + content

    return change


KINDS = ["total", "between", "within"]


def test_sums_of_other_machines_are_checked(tmp_path, llvm_variant):
    render = rendering(tmp_path / "a.exr", spp=16, pass_spp=4)

    def other_machine(first, stop, last, offset, spp):
        sums = render.renderer.render(first, spp)
        yield 0, replace(sums, spp=2 * sums.spp), "other"

    with pytest.raises(ValueError, match=r"sums of 1 passes of 8 .* expected 1 of 4 over \(8, 8, 3\)"):
        render.run(passes=other_machine)


DAMAGE = {
    "truncated": lambda content: content[:-100],
    "longer": lambda content: content + b"x",
    "empty": lambda content: b"",
    "text": lambda content: b"hello",
    "another format": forged({"format": 99}),
    "no header": forged({"nodes": {}}),
    "sums without nodes": forged({"nodes": {}, "counts": []}),
    "another number of passes": forged({"counts": [2]}),
    "ten nodes in a level": forged({"counts": [10]}, {"level0": [40, 10, KINDS]}),
    "no samples": forged(nodes={"level0": [0, 3, KINDS]}),
    "negative samples": forged(nodes={"level0": [-64, 3, KINDS]}),
    "samples that passes do not have": forged(nodes={"level0": [13, 3, KINDS]}),
    "missing sums": forged(nodes={"base": [64, 8, KINDS]}),
    "base without samples": forged(nodes={"base": [0, 0, []]}),
    "more sums than memory": forged(nodes={"base": [2**60, 2**60, []]}),
    "sums of one pixel": forged(sums=lambda sums: sums[:24]),
    "sums of more pixels": forged(sums=lambda sums: sums + bytes(8)),
    "fractional passes": forged({"counts": [3.0]}, {"level0": [12.0, 3.0, KINDS]}),
}


def test_a_damaged_checkpoint_is_refused(tmp_path, llvm_variant):
    stopped_after(rendering(tmp_path / "a.exr", spp=64, pass_spp=4), 3)
    path = checkpoint.path_of(tmp_path / "a.exr")
    whole = path.read_bytes()

    def assert_refused():
        with pytest.raises(ValueError, match=r"^\S+a\.exr\.checkpoint: damaged checkpoint [^\n]*--restart[^\n]*$"):
            rendering(tmp_path / "a.exr", spp=64, pass_spp=4)

    for name, damage in DAMAGE.items():
        path.write_bytes(damage(whole))
        assert path.read_bytes() != whole, name
        assert_refused()
    path.write_bytes(forged()(whole))  # `forged` itself causes no error
    assert rendering(tmp_path / "a.exr", spp=64, pass_spp=4).progress.passes == 3
    path.unlink()
    os.mkfifo(path)
    assert_refused()


def test_every_flipped_bit_of_a_checkpoint_is_detected(tmp_path, llvm_variant):
    render = rendering(tmp_path / "a.exr", spp=64, pass_spp=4)
    stopped_after(render, 3)
    path, shape = render.checkpoints.path, (8, 8, 3)
    whole = path.read_bytes()
    assert checkpoint.read(path, render.progress.identity, shape).done == 12
    for bit in random.Random(0).sample(range(8 * len(whole)), 500):
        content = bytearray(whole)
        content[bit // 8] ^= 1 << bit % 8
        path.write_bytes(content)
        with pytest.raises(ValueError, match="damaged checkpoint"):
            checkpoint.read(path, render.progress.identity, shape)


# Failures -------------------------------------------------------------------------------------------------------------


def write_to_full_disk(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


FOURS = {"pass_spp": 4}
GROWING = {"defines": {"res": "64"}, "until": 1e-4, "spp": 100}  # passes of 8, then one of the 36 samples that are left


# The last pass is the only one, comes after others, is replaced by a full pass, by passes of another size, and is kept
# although its size is another than at the start.
@pytest.mark.parametrize(
    ("limits", "resumed", "kept"),
    [
        (FOURS | {"spp": 3}, FOURS | {"spp": 3}, 3),
        (FOURS | {"spp": 11}, FOURS | {"spp": 11}, 11),
        (FOURS | {"spp": 11}, FOURS | {"spp": 16}, 8),
        (FOURS | {"spp": 3}, {"spp": 3, "pass_spp": 2}, 0),
        (GROWING, GROWING, 100),
    ],
)
def test_the_last_pass_is_kept_if_no_image_can_be_written(tmp_path, llvm_variant, monkeypatch, limits, resumed, kept):
    output = tmp_path / "a.exr"
    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space"):
        patch.setattr(rendered_file, "write", write_to_full_disk)
        rendering(output, **limits).run()
    render = rendering(output, **resumed)
    assert render.progress.done == kept
    assert render.run()["mi_refract:spp"] == resumed["spp"]
    assert_same_as_fresh(output, **resumed)


def test_a_checkpoint_that_cannot_be_written_is_a_warning(tmp_path, llvm_variant, monkeypatch, capfd):
    render, write, exists = rendering(tmp_path / "a.exr", spp=32, pass_spp=4), checkpoint.write, []
    render.checkpoints.interval = 0.0
    monkeypatch.setattr(checkpoint, "write", write_to_full_disk)

    def watch(render):
        exists.append(render.checkpoints.path.exists())
        if render.progress.passes == 3:
            render.checkpoints.wait()
            render.give_up()
            (tmp_path / ".a.exr.lock").touch()
            monkeypatch.setattr(checkpoint, "write", write)

    render.run(watch)
    assert len(render.warnings) >= 2 and "No space left on device; will be tried again" in render.warnings[0]
    assert not any(exists[:3]) and any(exists) and (tmp_path / "a.exr").exists()
    assert "checkpoint not written: No space left" in capfd.readouterr().err


def test_a_checkpoint_is_written_once_for_the_same_passes(tmp_path, monkeypatch):
    progress, written = checkpoint.Progress({}), []
    monkeypatch.setattr(checkpoint, "write", lambda path, progress: written.append(progress.passes))
    writer = checkpoint.CheckpointWriter(tmp_path / "a.exr", progress, [])
    writer.active = True
    for _ in range(3):
        progress.add(0, leaf(np.ones((1, 1, 3))), "here", 1.0, rest=False)
        writer.write()
        writer.write()
    assert written == [1, 2, 3]


def test_a_second_render_into_the_same_file_is_refused(tmp_path, llvm_variant):
    first, second = (rendering(tmp_path / "a.exr", spp=16, pass_spp=4) for _ in range(2))
    message, errors = r"a\.exr: a render is already running in process \d+ .* file", []

    def watch(_):
        with pytest.raises(BlockingIOError, match=message) as error:
            second.run()
        errors.append(error)
        second.give_up()  # it must neither write a checkpoint nor remove the lock
        second.checkpoints.write()
        assert (tmp_path / ".a.exr.lock").exists() and not checkpoint.path_of(tmp_path / "a.exr").exists()

    first.run(watch)
    assert len(errors) == 5
    with pytest.raises(BlockingIOError, match="written by another render in the meantime"):
        second.run()


@pytest.mark.parametrize("took", [1, 8, 12, 19, 24, 40])
def test_checkpoints_are_25_s_or_one_pass_apart(tmp_path, llvm_variant, monkeypatch, took):
    """Only passes move the clock, each by `took` seconds."""
    clock, checkpoint_seconds = [0.0], [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(checkpoint, "write", lambda path, progress: checkpoint_seconds.append(progress.seconds))
    render = rendering(tmp_path / "a.exr", spp=max(12, 64 // took), pass_spp=1)
    render_pass = type(render.renderer).render

    def slow_pass(*arguments):
        clock[0] += took
        return render_pass(*arguments)

    monkeypatch.setattr(type(render.renderer), "render", slow_pass)
    render.run()
    intervals = np.diff(checkpoint_seconds)
    assert len(intervals) > 1 and intervals.max() <= max(25, took) and intervals.min() + took > 25


# Signals at random times ----------------------------------------------------------------------------------------------

# The shell makes a background job ignore SIGINT. Mitsuba would handle it, and return an image of the samples so far.
KILLED = """
import signal, sys
if sys.argv.pop(1) == "ignored":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
from mi_refract import cli
run = cli._run
def run_with_checkpoints(arguments):
    from mi_refract.rendering import checkpoint  # numpy's threads start here
    checkpoint.INTERVAL = 0.05
    return run(arguments)
cli._run = run_with_checkpoints
sys.argv[1:] = ["render", *sys.argv[1:]]
sys.exit(cli.main())
"""


def ended_by(number, output, spp, variant="llvm_ad_rgb", handler="default"):
    """Return exit code and stderr of a render that a signal ends after its first checkpoint."""
    path, words = checkpoint.path_of(output), ("-D", "res=32", "--pass-spp", "4", "--spp", spp, "--variant", variant)
    with python(KILLED, handler, BALL, "-o", output, *words) as process:
        try:
            deadline, before = time.monotonic() + 120, path.stat().st_mtime_ns if path.exists() else 0
            while process.poll() is None and time.monotonic() < deadline:
                if path.exists() and path.stat().st_mtime_ns != before:
                    break
                time.sleep(0.01)
            # At most one thread may receive the signal: in another one Mitsuba's own handler might run.
            status = [path.read_text() for path in Path(f"/proc/{process.pid}/task").glob("*/status")]
            blocked = [int(text.partition("SigBlk:")[2].split()[0], 16) for text in status]
            assert sum(not bits >> (signal.SIGINT - 1) & 1 for bits in blocked) <= 1
            time.sleep(random.uniform(0, 0.05))  # up to the time between two checkpoints
            process.send_signal(number)
            _, err = process.communicate(timeout=60)
            return process.returncode, err
        finally:
            process.kill()  # otherwise a failed test would wait forever


def test_a_render_that_sigkill_ends_resumes_with_the_same_bits(tmp_path, llvm_variant):
    output, limits = tmp_path / "a.exr", {"spp": 400, "pass_spp": 4}
    assert ended_by(signal.SIGKILL, output, 400)[0] == -signal.SIGKILL
    ended_by(signal.SIGKILL, output, 400)  # this render may finish before the signal
    if not output.exists():
        render = rendering(output, defines={"res": "32"}, **limits)
        assert render.progress.passes
        render.run()
    assert [path.name for path in tmp_path.iterdir() if not path.name.endswith(".part")] == ["a.exr"]
    assert_same_as_fresh(output, defines={"res": "32"}, **limits)


@pytest.mark.parametrize(
    ("number", "variant", "handler"),
    [(number, "llvm_ad_rgb", "default") for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
    + [(signal.SIGINT, "scalar_rgb", "ignored")],
    indirect=["variant"],
)
def test_a_signal_leaves_a_checkpoint(tmp_path, number, variant, handler):
    output, spp = tmp_path / "a.exr", 4800 if variant.startswith("llvm") else 100_000
    code, err = ended_by(number, output, spp, variant, handler)
    assert code == 128 + number, err
    assert "spp; run the same command again to resume" in err
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr.checkpoint"]
    assert rendering(output, defines={"res": "32"}, spp=spp, pass_spp=4).progress.passes > 0

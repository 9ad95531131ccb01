"""Renders in passes from end to end: the file, what ends them, what they resume from, and what may go wrong."""

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
from support.renders import BALL, SCENES, pixels, rendering

from mi_refract.cluster import on_worker
from mi_refract.image_diff.comparison import Verdict
from mi_refract.image_diff.methods import compare
from mi_refract.io.image_file import read, read_exr
from mi_refract.rendering import checkpoint, long_render, rendered_file
from mi_refract.rendering.end_conditions import Limits
from mi_refract.rendering.long_render import Job, render_to_exr, resume

SCENE = SCENES / "nested.xml"
SKY = """<scene version="3.0.0"><integrator type="path"/><sensor type="perspective"><film type="hdrfilm">
<integer name="width" value="8"/><integer name="height" value="8"/></film></sensor>{}</scene>"""

pytestmark = pytest.mark.usefixtures("scalar_variant")


class Stop(Exception):
    pass


def stopped_after(render, passes):
    def watch(render):
        if render.progress.passes == passes:
            raise Stop

    with pytest.raises(Stop):
        render.run(watch)


def changed(tmp_path, *replacements):
    """The scene of the ball with some texts replaced."""
    text = BALL.read_text()
    for old, new in replacements:
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "scene.xml").write_text(text)
    return tmp_path / "scene.xml"


def same_as_fresh(output, scene=BALL, **limits):
    """Whether an image has the bits of a render from the first pass on."""
    rendering(output.with_name("fresh.exr"), scene=scene, restart=True, **limits).run()
    np.testing.assert_array_equal(pixels(output), pixels(output.with_name("fresh.exr")))


# The image and its header -------------------------------------------------------------------------------------------


def test_the_header_of_the_pages_example_renders_the_same_image_again(tmp_path, monkeypatch):
    (code,) = python_blocks(DOCS / "how-to/render-for-hours.md")
    monkeypatch.chdir(SCENES.parent)
    for old, new in {'"nested.exr"': f'r"{tmp_path}/a.exr"', "spp=256": "spp=2", '{"': '{"res": "8", "'}.items():
        assert old in code
        code = code.replace(old, new)
    exec(code, names := {})
    image, header = read_exr(tmp_path / "a.exr")
    times = ("mi_refract:render_seconds", "mi_refract:scene")  # float32 and UTF-8 in the file
    assert all(header[name] == value for name, value in names["header"].items() if name not in times)
    assert image.shape[:2] == (8, 8) and header["mi_refract:seed"] == json.loads(header["mi_refract:identity"])["seed"]
    again = {"spp": header["mi_refract:spp"], "seed": header["mi_refract:seed"]}
    defines = json.loads(header["mi_refract:defines"])
    render_to_exr(header["mi_refract:scene"], tmp_path / "b.exr", defines=defines, **again)
    np.testing.assert_array_equal(image, pixels(tmp_path / "b.exr"))


def test_the_variance_is_that_of_the_passes(tmp_path, llvm):
    render = rendering(tmp_path / "a.exr", spp=60, pass_spp=4)
    header = render.run()
    image = read(tmp_path / "a.exr")
    passes = np.array([render.renderer.render(p, 4).mean for p in range(15)])
    np.testing.assert_allclose(image.select("RGB"), passes.mean(0), rtol=1e-7)
    found = image.select([f"{name}.variance" for name in "RGB"])
    np.testing.assert_allclose(found, 4 * passes.var(0, ddof=1), rtol=1e-6, atol=1e-12)
    assert (header["mi_refract:passes"], header["mi_refract:variance_freedom"]) == (15, 14)
    assert header["mi_refract:variance_from"] == "passes"


def test_few_passes_have_the_variance_of_their_samples(tmp_path, llvm):
    header = rendering(tmp_path / "a.exr", spp=30, pass_spp=8).run()
    assert (header["mi_refract:passes"], header["mi_refract:variance_freedom"]) == (4, 29)
    assert header["mi_refract:variance_from"] == "samples: an upper bound where the sampler stratifies them"
    rendering(tmp_path / "b.exr", spp=2048, pass_spp=16).run()
    few, many = (read(tmp_path / name).select(["R.variance"]).mean() for name in ("a.exr", "b.exr"))
    # 64 pixels of 29 degrees of freedom, of samples with kurtosis up to 20 or so: a standard error of about 10 %.
    assert few == pytest.approx(many, rel=0.5)
    header = rendering(tmp_path / "one.exr", spp=1).run()
    assert read(tmp_path / "one.exr").channels == ("R", "G", "B") and header["mi_refract:variance_from"] == "nothing"


@pytest.mark.parametrize(("spp", "pass_spp"), [(64, 64), (16, 1)])
def test_renders_under_a_wide_filter_are_equal_to_their_like(tmp_path, llvm, spp, pass_spp):
    """Neighbours share samples there, also in files whose variance has as many degrees of freedom as samples.

    At a family error of 20 % more than 6 of 10 pairs are different once in 1157 runs, where 20 % is what comes up.
    """
    scene, images = changed(tmp_path, ('"box"', '"gaussian"')), []
    for seed in range(20):
        output = tmp_path / "a.exr"
        rendering(output, seed, scene, {"res": "64"}, spp=spp, pass_spp=pass_spp, restart=True).run()
        images.append(read(output))
    pairs = zip(images[::2], images[1::2], strict=True)
    verdicts = [compare("auto", a, b, family_error=0.2, resolution=9.0).verdict for a, b in pairs]
    assert verdicts.count(Verdict.DIFFERENT) <= 6


def test_pixels_that_are_not_finite_are_counted(tmp_path, llvm, monkeypatch):
    render = rendering(tmp_path / "a.exr", spp=64, pass_spp=4)
    original = type(render.renderer).render

    def broken(self, number, spp):
        sums = original(self, number, spp)
        sums.total[2, 3] *= np.nan if number == 5 else 1
        return sums

    monkeypatch.setattr(type(render.renderer), "render", broken)
    assert render.run()["mi_refract:nonfinite_pixels"] == 1
    assert np.isnan(pixels(tmp_path / "a.exr")).any(-1).sum() == 1


# What ends it -------------------------------------------------------------------------------------------------------

WRONG = [{"spp": 0}, {"spp": -1}, {"pass_spp": 0}, {"until": 0.0}, {"until": -0.1}, {"until": 1.01}]
WRONG += [{"until": float("nan")}, {"until_tile": 2.0}, {"seconds": 0.0}, {"seconds": float("inf")}]


@pytest.mark.parametrize("wrong", [*WRONG, {"seed": -1}, {"seed": 2**32}, {"defines": {"config": "x"}}, None], ids=str)
def test_what_is_wrong_is_refused_before_the_rendering(tmp_path, monkeypatch, wrong):
    monkeypatch.setattr(mi, "render", lambda *arguments, **named: pytest.fail("rendered"))
    with pytest.raises((ValueError, NotADirectoryError), match="expected ") as error:
        rendering(tmp_path / ("a.exr" if wrong else "none/a.exr"), **wrong or {})
    assert "\n" not in str(error.value) and not list(tmp_path.iterdir())


def test_a_scene_without_noise_needs_one_pass_and_a_black_one_is_warned_of(tmp_path, llvm):
    for name, emitter in (("light", '<emitter type="constant"/>'), ("dark", "")):
        (tmp_path / f"{name}.xml").write_text(SKY.format(emitter))
    ended = "no noise: the samples of every pixel agree"
    expected = {
        ("light", 64): (1, ended),
        ("light", 4): (16, ended),  # 4 samples would say too little
        ("dark", 64): (4, "256 spp"),  # what no sample has met may be there
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


def test_it_ends_at_the_limit_that_is_reached_first(tmp_path, llvm):
    for _ in range(2):  # the second time from the finished image
        render = rendering(tmp_path / "a.exr", until=0.1, pass_spp=2)
        assert render.run()["mi_refract:passes"] in (8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256)  # only at a look
        assert render.error().high <= 0.1 and "--until 10 %" in render.ended_by
    assert rendering(tmp_path / "b.exr", until=0.1, spp=8, pass_spp=2).run()["mi_refract:spp"] == 8
    render = rendering(tmp_path / "c.exr", until_tile=0.2, pass_spp=2)
    render.run()
    assert "--until-tile 20 %" in render.ended_by
    render, start = rendering(tmp_path / "d.exr", seconds=0.2, pass_spp=1), time.monotonic()
    header = render.run()
    assert time.monotonic() - start >= 0.2 and render.ended_by == "--time 0.2 s"
    same_as_fresh(tmp_path / "d.exr", spp=header["mi_refract:spp"], pass_spp=1)
    timeout = '<integrator type="$integrator"><float name="timeout" value="0.01"/>'  # does not count
    scene = changed(tmp_path, ('<integrator type="$integrator">', timeout))
    assert rendering(tmp_path / "e.exr", scene=scene, spp=8, pass_spp=4).run()["mi_refract:spp"] == 8


def test_passes_grow_by_no_more_than_the_error_needs(tmp_path, llvm):
    """The error that is reached is at least 2/3 of the one asked for, and a resumed render has the same bits."""
    limits, sizes = {"until": 0.02}, []
    options = {"defines": {"res": "64"}, "restart": True}
    rendering(tmp_path / "a.exr", **options, **limits).run(lambda render: sizes.append(render.plan.spp))
    render = rendering(tmp_path / "b.exr", **options, **limits)
    for passes in (8, 9, 13):  # after the passes of one size, and among those of others
        stopped_after(render, passes)
        render = rendering(tmp_path / "b.exr", defines={"res": "64"}, **limits)
        assert render.progress.passes == passes
    render.run()
    np.testing.assert_array_equal(pixels(tmp_path / "a.exr"), pixels(tmp_path / "b.exr"))
    error = render.error()
    assert 2 / 3 * 0.02 < error.value < error.high <= 0.02
    assert sizes[0] < max(sizes) and sizes[-1] < max(sizes)
    # A checkpoint that is good enough for another error is the image.
    stopped_after(rendering(tmp_path / "c.exr", **options, **limits), 8)
    rendering(tmp_path / "c.exr", defines={"res": "64"}, until=0.2).run()
    assert read(tmp_path / "c.exr").metadata["mi_refract:passes"] == 8
    assert not checkpoint.path_of(tmp_path / "c.exr").exists()


def test_an_image_without_a_finite_pixel_ends_in_one_line(tmp_path, llvm):
    nan = '<emitter type="constant"><rgb name="radiance" value="nan"/></emitter>'
    (tmp_path / "a.xml").write_text(SKY.format(nan))
    for limits in ({"until": 0.1}, {"until_tile": 0.1, "pass_spp": 4}):
        render = resume(Job(tmp_path / "a.xml"), tmp_path / "a.exr", Limits(**limits), restart=True)
        with pytest.raises(ValueError, match=r"a\.exr: no pixel of the image is finite; --until cannot be evaluated"):
            render.run()
    header = resume(Job(tmp_path / "a.xml"), tmp_path / "a.exr", Limits(until=0.1, spp=40), restart=True).run()
    assert header["mi_refract:nonfinite_pixels"] == 64 and header["mi_refract:spp"] == 40


def test_looks_are_few_also_where_it_resumes(tmp_path, llvm, monkeypatch):
    """After 9 passes the next look is at 12: an estimate that is looked at often is too small at some time."""
    rendering(tmp_path / "a.exr", spp=18, pass_spp=2).run()
    looks = []
    monkeypatch.setattr(long_render, "reached", lambda limits, sums: looks.append(sums.passes) or "")
    stopped_after(rendering(tmp_path / "a.exr", until=1e-3, pass_spp=2), 25)
    assert sorted(set(looks)) == [12, 16, 24]


# What it resumes from -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("passes", [1, 7, 8, 9, 20])
def test_a_checkpoint_resumes_with_the_same_bits(tmp_path, llvm, passes):
    output = tmp_path / "a.exr"
    stopped_after(rendering(output, spp=90, pass_spp=4), passes)
    assert checkpoint.path_of(output).exists() and not output.exists()
    render = rendering(output, spp=90, pass_spp=4)
    assert render.progress.passes == passes
    render.run()
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]
    same_as_fresh(output, spp=90, pass_spp=4)


def test_a_finished_image_is_refined_if_it_is_of_the_same_render(tmp_path, llvm):
    output, seen = tmp_path / "a.exr", []
    output.write_bytes(b"no EXR")
    assert rendering(output, spp=8).progress.done == 0
    rendering(output, spp=32, pass_spp=4).run()
    for other in ({"seed": 1}, {"spp": 16}, {"restart": True}):
        assert rendering(output, **{"spp": 64, "pass_spp": 4} | other).progress.done == 0
    render = rendering(output, spp=64, pass_spp=4)
    assert render.progress.done == 32
    header = render.run(lambda render: seen.append(render.progress.passes))
    assert header["mi_refract:spp"] == 64 and seen[0] == 9 and seen[-1] == 16
    rendering(tmp_path / "b.exr", spp=64, pass_spp=4).run()
    # The same samples, but the first half by way of float32.
    np.testing.assert_allclose(pixels(output)[..., :3], pixels(tmp_path / "b.exr")[..., :3], rtol=3e-7)
    rendering(output, spp=12, pass_spp=4, restart=True).run()  # few passes: their variance stays what it is
    variance = rendering(output, spp=16, pass_spp=4).progress.sums().variance
    np.testing.assert_allclose(variance, read(output).select([f"{name}.variance" for name in "RGB"]))
    scene = changed(tmp_path, ('value="independent"', 'value="stratified"'))  # which rounds up
    assert rendering(output, scene=scene, spp=10).run()["mi_refract:spp"] == 16
    assert rendering(output, scene=scene, spp=10).progress.done == 16


@pytest.mark.parametrize("spp", [6, 32, 40])
def test_the_same_command_again_renders_nothing_and_changes_nothing(tmp_path, llvm, spp, monkeypatch):
    output = tmp_path / "a.exr"
    rendering(output, spp=spp, pass_spp=4).run()
    content, render = output.read_bytes(), rendering(output, spp=spp, pass_spp=4)
    monkeypatch.setattr(type(render.renderer), "render", lambda *arguments: pytest.fail("rendered"))
    render.run()
    assert output.read_bytes() == content


def test_a_last_pass_that_the_sampler_has_rounded_up_is_kept(tmp_path, llvm):
    scene = changed(tmp_path, ('value="independent"', 'value="stratified"'))
    stopped_after(rendering(tmp_path / "a.exr", scene=scene, spp=6, pass_spp=4), 2)
    rendering(tmp_path / "a.exr", scene=scene, spp=6, pass_spp=4).run()
    assert same_as_fresh(tmp_path / "a.exr", scene, spp=6, pass_spp=4) is None


def test_a_checkpoint_of_another_render_is_refused_by_name(tmp_path, llvm, monkeypatch):
    """A file that the scene names is part of it."""
    texture = '<bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename" value="a.ppm"/>'
    size = '<transform name="to_world"><scale value="1"/></transform>'
    more = ("</scene>", f'<shape type="sphere">{texture}</texture></bsdf>{size}</shape></scene>')
    (tmp_path / "a.ppm").write_bytes(b"P6 1 1 255 123")
    scene = changed(tmp_path, more)

    def refused(message, **other):
        limits = {"spp": 64, "pass_spp": 4} | other
        with pytest.raises(ValueError, match=message) as error:
            rendering(tmp_path / "a.exr", scene=scene, **limits)
        assert "--restart" in str(error.value) and "\n" not in str(error.value)
        assert rendering(tmp_path / "a.exr", scene=scene, restart=True, **limits).progress.passes == 0

    stopped_after(rendering(tmp_path / "a.exr", scene=scene, spp=64, pass_spp=4), 3)
    refused("seed was 0, is 1", seed=1)
    refused("passes of 4 samples per pixel", pass_spp=8)
    refused("already holds 12 samples per pixel; expected --spp 12 or more, or --restart", spp=8)
    for change in (("30.5", "30.6"), ('<scale value="1"/>', '<scale value="1.0000002"/>')):
        changed(tmp_path, more, change)
        refused("the scene has changed")
    changed(tmp_path, more)
    (tmp_path / "a.ppm").write_bytes(b"P6 1 1 255 124")
    refused("the scene has changed")
    (tmp_path / "a.ppm").write_bytes(b"P6 1 1 255 123")
    for place, name, value, message in (
        (long_render, "installed_version", "0", r"version of mitsuba was \S+, is 0"),
        (on_worker, "vector_width", "64", r"vector width was \d+, is 64"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(place, name, lambda *_, value=value: value)
            refused(message)
    mi.set_variant("scalar_rgb")
    refused("variant was llvm_ad_rgb, is scalar_rgb")


def forged(header=None, nodes=None, more=b""):
    """A change of a checkpoint's content, under the digest that it then has."""

    def change(content):
        line, rest = content[32:].split(b"\n", 1)
        found = json.loads(line) | (header or {})
        found["nodes"] |= nodes or {}
        content = json.dumps(found).encode() + b"\n" + (rest + more if more is not None else rest[:24])
        return hashlib.sha256(content).digest() + content

    return change


KINDS = ["total", "between", "within"]


def test_sums_from_elsewhere_are_checked(tmp_path, llvm):
    render = rendering(tmp_path / "a.exr", spp=16, pass_spp=4)

    def elsewhere(first, stop, last, offset, spp):
        sums = render.renderer.render(first, spp)
        yield 0, replace(sums, spp=2 * sums.spp), "there"

    with pytest.raises(ValueError, match=r"sums of 1 passes of 8 .* expected 1 of 4 over \(8, 8, 3\)"):
        render.run(passes=elsewhere)


DAMAGE = {
    "truncated": lambda content: content[:-100],
    "longer": lambda content: content + b"x",
    "empty": lambda content: b"",
    "text": lambda content: b"hello",
    "another format": forged({"format": 99}),
    "no header": forged({"nodes": {}}),
    "without its sums": forged({"nodes": {}, "counts": []}),
    "sums of another pass": forged({"counts": [2]}),
    "a level of ten": forged({"counts": [10]}, {"level0": [40, 10, KINDS]}),
    "no samples": forged(nodes={"level0": [0, 3, KINDS]}),
    "negative samples": forged(nodes={"level0": [-64, 3, KINDS]}),
    "samples that passes do not have": forged(nodes={"level0": [13, 3, KINDS]}),
    "sums that are missing": forged(nodes={"base": [64, 8, KINDS]}),
    "an older image of no samples": forged(nodes={"base": [0, 0, []]}),
    "more sums than a machine has memory": forged(nodes={"base": [2**60, 2**60, []]}),
    "sums of one pixel": forged(more=None),
    "sums of more pixels": forged(more=bytes(8)),
    "fractions of passes": forged({"counts": [3.0]}, {"level0": [12.0, 3.0, KINDS]}),
}


def test_a_damaged_checkpoint_is_refused(tmp_path, llvm):
    stopped_after(rendering(tmp_path / "a.exr", spp=64, pass_spp=4), 3)
    path = checkpoint.path_of(tmp_path / "a.exr")
    whole = path.read_bytes()

    def refused():
        with pytest.raises(ValueError, match=r"^\S+a\.exr\.checkpoint: damaged checkpoint [^\n]*--restart[^\n]*$"):
            rendering(tmp_path / "a.exr", spp=64, pass_spp=4)

    for name, damage in DAMAGE.items():
        path.write_bytes(damage(whole))
        assert path.read_bytes() != whole, name
        refused()
    path.write_bytes(forged()(whole))  # or the others would be refused for something else
    assert rendering(tmp_path / "a.exr", spp=64, pass_spp=4).progress.passes == 3
    path.unlink()
    os.mkfifo(path)
    refused()


def test_every_flipped_bit_of_a_checkpoint_is_noticed(tmp_path, llvm):
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


# What may go wrong ----------------------------------------------------------------------------------------------------


def full(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(("spp", "then"), [(3, 3), (11, 11), (11, 16)])  # the last pass alone, after others, replaced
def test_a_last_pass_is_kept_where_its_image_cannot_be_written(tmp_path, llvm, monkeypatch, spp, then):
    output = tmp_path / "a.exr"
    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space"):
        patch.setattr(rendered_file, "write", full)
        rendering(output, spp=spp, pass_spp=4).run()
    render = rendering(output, spp=then, pass_spp=4)
    assert render.progress.done == (spp if then == spp else 8)  # a whole pass takes the place of the last one
    render.run()
    same_as_fresh(output, spp=then, pass_spp=4)


def test_a_full_disk_at_a_checkpoint_is_a_warning(tmp_path, llvm, monkeypatch, capfd):
    render, write, written = rendering(tmp_path / "a.exr", spp=32, pass_spp=4), checkpoint.write, []
    render.checkpoints.interval = 0.0
    monkeypatch.setattr(checkpoint, "write", full)

    def watch(render):
        written.append(render.checkpoints.path.exists())
        if render.progress.passes == 3:
            render.checkpoints.wait()
            render.give_up()
            (tmp_path / ".a.exr.lock").touch()
            monkeypatch.setattr(checkpoint, "write", write)

    render.run(watch)
    assert len(render.warnings) >= 2 and "No space left on device; will be tried again" in render.warnings[0]
    assert not any(written[:3]) and any(written) and (tmp_path / "a.exr").exists()
    assert "checkpoint not written: No space left" in capfd.readouterr().err


def test_two_renders_into_one_file(tmp_path, llvm):
    first, second = (rendering(tmp_path / "a.exr", spp=16, pass_spp=4) for _ in range(2))
    message, refused = r"a\.exr: a render is already running in process \d+ .* file", []

    def watch(_):
        with pytest.raises(BlockingIOError, match=message) as error:
            second.run()
        refused.append(error)
        second.give_up()  # it must neither write a checkpoint nor remove the lock
        second.checkpoints.write()
        assert (tmp_path / ".a.exr.lock").exists() and not checkpoint.path_of(tmp_path / "a.exr").exists()

    first.run(watch)
    assert len(refused) == 5
    with pytest.raises(BlockingIOError, match="written by another render in the meantime"):
        second.run()


@pytest.mark.parametrize("took", [1, 8, 12, 19, 24, 40])
def test_a_kill_loses_25_s_or_one_pass(tmp_path, llvm, monkeypatch, took):
    """A clock that only passes move, each by as many seconds."""
    clock, kept = [0.0], [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(checkpoint, "write", lambda path, progress: kept.append(progress.seconds))
    render = rendering(tmp_path / "a.exr", spp=max(12, 64 // took), pass_spp=1)
    of_a_pass = type(render.renderer).render

    def passed(*arguments):
        clock[0] += took
        return of_a_pass(*arguments)

    monkeypatch.setattr(type(render.renderer), "render", passed)
    render.run()
    apart = np.diff(kept)
    assert len(apart) > 1 and apart.max() <= max(25, took) and apart.min() + took > 25


# Killed by a signal, at random times ----------------------------------------------------------------------------------

# What the shell ignores in a background job, Mitsuba does not: it would return an image of the samples so far.
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
    """The exit code and stderr of a render that a signal ends after its first checkpoint."""
    path, words = checkpoint.path_of(output), ("-D", "res=32", "--pass-spp", "4", "--spp", spp, "--variant", variant)
    with python(KILLED, handler, BALL, "-o", output, *words) as process:
        try:
            deadline, before = time.monotonic() + 120, path.stat().st_mtime_ns if path.exists() else 0
            while process.poll() is None and time.monotonic() < deadline:
                if path.exists() and path.stat().st_mtime_ns != before:
                    break
                time.sleep(0.01)
            # In which threads a signal is not blocked. Where there are several, Mitsuba's own handler may run in one.
            status = [path.read_text() for path in Path(f"/proc/{process.pid}/task").glob("*/status")]
            blocked = [int(text.partition("SigBlk:")[2].split()[0], 16) for text in status]
            assert sum(not bits >> (signal.SIGINT - 1) & 1 for bits in blocked) <= 1
            time.sleep(random.uniform(0, 0.05))  # the time between two checkpoints
            process.send_signal(number)
            _, err = process.communicate(timeout=60)
            return process.returncode, err
        finally:
            process.kill()  # or a failure would wait for it without end


def test_sigkill_at_random_times_leaves_a_checkpoint_and_the_same_bits(tmp_path, llvm):
    output, limits = tmp_path / "a.exr", {"spp": 400, "pass_spp": 4}
    assert ended_by(signal.SIGKILL, output, 400)[0] == -signal.SIGKILL
    ended_by(signal.SIGKILL, output, 400)  # or to its end
    if not output.exists():
        render = rendering(output, defines={"res": "32"}, **limits)
        assert render.progress.passes
        render.run()
    assert [path.name for path in tmp_path.iterdir() if not path.name.endswith(".part")] == ["a.exr"]
    same_as_fresh(output, defines={"res": "32"}, **limits)


@pytest.mark.parametrize(
    ("number", "variant", "handler"),
    [(number, "llvm_ad_rgb", "default") for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
    + [(signal.SIGINT, "scalar_rgb", "ignored")],
)
def test_a_signal_keeps_what_is_done(tmp_path, needs_variant, number, variant, handler):
    needs_variant(variant)
    mi.set_variant(variant)
    output, spp = tmp_path / "a.exr", 4800 if variant.startswith("llvm") else 100_000
    code, err = ended_by(number, output, spp, variant, handler)
    assert code == 128 + number, err
    assert "spp; run the same command again to resume" in err
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr.checkpoint"]
    assert rendering(output, defines={"res": "32"}, spp=spp, pass_spp=4).progress.passes > 0

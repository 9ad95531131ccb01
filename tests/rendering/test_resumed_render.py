"""Renders that go on: from checkpoints and finished images, with the same bits whatever happened; what goes wrong."""

from __future__ import annotations

import errno
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from support.renders import BALL, SCENES, pixels, rendering

from mi_refract.io.image_file import read
from mi_refract.rendering import checkpoint, identity, long_render, rendered_file
from mi_refract.rendering.long_render import Job, Limits, LongRender

ROOT, SCENE = SCENES.parent, SCENES / "nested.xml"
TIMES = ("mi_refract:render_seconds", "mi_refract:scene")


pytestmark = pytest.mark.usefixtures("scalar_variant")


# What it goes on from -------------------------------------------------------------------------------------------------


class Stop(Exception):
    pass


def stopped_after(render, passes):
    def watch(render):
        if render.progress.passes == passes:
            raise Stop

    with pytest.raises(Stop):
        render.run(watch)


@pytest.mark.parametrize("passes", [1, 7, 8, 9, 20])
def test_a_checkpoint_goes_on_with_the_same_bits(tmp_path, llvm, passes):
    output = tmp_path / "a.exr"
    stopped_after(rendering(output, spp=90, pass_spp=4), passes)
    assert checkpoint.path_of(output).exists() and not output.exists()
    render = rendering(output, spp=90, pass_spp=4)
    assert render.progress.passes == passes
    render.run()
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]
    rendering(tmp_path / "b.exr", spp=90, pass_spp=4).run()
    np.testing.assert_array_equal(pixels(output), pixels(tmp_path / "b.exr"))


def test_a_finished_image_goes_on(tmp_path, llvm):
    output = tmp_path / "a.exr"
    rendering(output, spp=32, pass_spp=4).run()
    render = rendering(output, spp=64, pass_spp=4)
    assert render.progress.done == 32
    seen = []
    header = render.run(lambda render: seen.append(render.progress.passes))
    assert header["mi_refract:spp"] == 64 and seen[0] == 9 and seen[-1] == 16
    rendering(tmp_path / "b.exr", spp=64, pass_spp=4).run()
    # The same samples, but the first half by way of float32.
    np.testing.assert_allclose(pixels(output)[..., :3], pixels(tmp_path / "b.exr")[..., :3], rtol=3e-7)


def test_a_finished_image_has_nothing_left(tmp_path, llvm, monkeypatch):
    output = tmp_path / "a.exr"
    rendering(output, spp=32, pass_spp=4).run()
    before = pixels(output)
    render = rendering(output, spp=32, pass_spp=4)
    monkeypatch.setattr(type(render.renderer), "render", lambda *arguments: pytest.fail("rendered"))
    render.run()
    np.testing.assert_array_equal(pixels(output), before)


@pytest.mark.parametrize("other", [{"seed": 1}, {"spp": 16}, {"restart": True}], ids=str)
def test_another_image_is_replaced(tmp_path, llvm, other):
    output = tmp_path / "a.exr"
    rendering(output, spp=32, pass_spp=4).run()
    assert rendering(output, **{"spp": 64, "pass_spp": 4} | other).progress.done == 0


@pytest.mark.parametrize("spp", [6, 40])
def test_the_same_command_again_changes_nothing(tmp_path, llvm, spp):
    output = tmp_path / "a.exr"
    rendering(output, spp=spp, pass_spp=4).run()
    content = output.read_bytes()
    for _ in range(2):
        rendering(output, spp=spp, pass_spp=4).run()
    assert output.read_bytes() == content


def test_the_variance_of_few_passes_stays_what_it_is(tmp_path, llvm):
    output = tmp_path / "a.exr"
    rendering(output, spp=12, pass_spp=4).run()
    before = rendering(output, spp=16, pass_spp=4).progress.sums()
    np.testing.assert_allclose(
        before.variance, np.stack([read(output).select([f"{n}.variance"])[..., 0] for n in "RGB"], -1)
    )


def test_an_error_that_is_reached_is_reached(tmp_path, llvm):
    output = tmp_path / "a.exr"
    first = rendering(output, until=0.2, pass_spp=2).run()
    again = rendering(output, until=0.2, pass_spp=2)
    assert again.run()["mi_refract:spp"] == first["mi_refract:spp"] and "--until" in again.ended_by


def test_looks_are_few_also_where_it_goes_on(tmp_path, llvm):
    """After 9 passes the next look is at 12: an estimate that is looked at often is too small at some time."""
    output = tmp_path / "a.exr"
    rendering(output, spp=18, pass_spp=2).run()
    render, looks = rendering(output, until=1e-3, pass_spp=2), []
    render._good_enough = lambda: looks.append(render.progress.passes)
    stopped_after(render, 25)
    assert looks == [12, 16, 24]


def test_a_last_pass_is_kept_where_its_image_cannot_be_written(tmp_path, llvm, monkeypatch):
    output, write = tmp_path / "a.exr", rendered_file.write
    for spp in (3, 11):  # alone, and after others
        monkeypatch.setattr(rendered_file, "write", lambda *a: (_ for _ in ()).throw(OSError(errno.ENOSPC, "full")))
        with pytest.raises(OSError, match="full"):
            rendering(output, spp=spp, pass_spp=4, restart=True).run()
        monkeypatch.setattr(rendered_file, "write", write)
        render = rendering(output, spp=spp, pass_spp=4)
        assert render.progress.done == spp
        with monkeypatch.context() as nothing:
            nothing.setattr(type(render.renderer), "render", None)
            render.run()
        rendering(tmp_path / "b.exr", spp=spp, pass_spp=4, restart=True).run()
        np.testing.assert_array_equal(pixels(output), pixels(tmp_path / "b.exr"))


def test_a_last_pass_gives_way_to_a_whole_one(tmp_path, llvm, monkeypatch):
    output, write = tmp_path / "a.exr", rendered_file.write
    monkeypatch.setattr(rendered_file, "write", lambda *a: (_ for _ in ()).throw(OSError(errno.ENOSPC, "full")))
    with pytest.raises(OSError, match="full"):
        rendering(output, spp=11, pass_spp=4).run()
    monkeypatch.setattr(rendered_file, "write", write)
    rendering(output, spp=16, pass_spp=4).run()
    rendering(tmp_path / "b.exr", spp=16, pass_spp=4).run()
    np.testing.assert_array_equal(pixels(output), pixels(tmp_path / "b.exr"))


def test_a_checkpoint_that_fails_at_a_signal_is_said(tmp_path, llvm, monkeypatch, capfd):
    render = rendering(tmp_path / "a.exr", spp=8, pass_spp=2)

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    def watch(render):
        if render.progress.passes == 3:
            monkeypatch.setattr(checkpoint, "write", full)
            render.give_up()
            monkeypatch.undo()

    render.run(watch)
    assert "mi-refract: " in (said := capfd.readouterr().err) and "no checkpoint: No space left" in said


def test_a_sampler_that_rounds_up_has_nothing_left(tmp_path, llvm):
    scene = tmp_path / "scene.xml"
    scene.write_text(BALL.read_text().replace('value="independent"', 'value="stratified"'))
    header = rendering(tmp_path / "a.exr", scene=scene, spp=10).run()
    assert header["mi_refract:spp"] == 16
    assert rendering(tmp_path / "a.exr", scene=scene, spp=10).progress.done == 16


def test_a_checkpoint_of_more_samples_is_refused(tmp_path, llvm):
    output = tmp_path / "a.exr"
    stopped_after(rendering(output, spp=64, pass_spp=4), 5)
    with pytest.raises(ValueError, match="holds 20 spp; expected at least so many, or --restart"):
        rendering(output, spp=16, pass_spp=4)


def test_who_does_not_render_writes_nothing(tmp_path, llvm):
    output = tmp_path / "a.exr"
    stopped_after(rendering(output, spp=64, pass_spp=4), 2)
    late = rendering(output, spp=64, pass_spp=4)
    stopped_after(rendering(output, spp=64, pass_spp=4), 5)
    content = checkpoint.path_of(output).read_bytes()
    late.give_up()
    late.keep()
    assert checkpoint.path_of(output).read_bytes() == content
    with pytest.raises(BlockingIOError, match="another render was there meanwhile"):
        late.run()


def test_a_black_image_is_warned_of(tmp_path, llvm):
    sky = '<scene version="3.0.0"><integrator type="path"/><sensor type="perspective"><film type="hdrfilm">'
    sky += '<integer name="width" value="8"/><integer name="height" value="8"/></film></sensor></scene>'
    (tmp_path / "dark.xml").write_text(sky)
    render = LongRender(Job(tmp_path / "dark.xml"), tmp_path / "a.exr", Limits(until=0.1, pass_spp=1))
    stopped_after(render, 9)
    assert "the image is still black" in render.warnings[0]


def test_the_time_of_an_integrator_is_none_of_ours(tmp_path, llvm):
    scene = tmp_path / "scene.xml"
    scene.write_text(
        BALL.read_text().replace(
            '<integrator type="$integrator">', '<integrator type="$integrator"><float name="timeout" value="0.01"/>'
        )
    )
    assert rendering(tmp_path / "a.exr", scene=scene, spp=8, pass_spp=4).run()["mi_refract:spp"] == 8


def test_a_picture_of_somebody_else_is_no_start(tmp_path, llvm):
    output = tmp_path / "a.exr"
    output.write_bytes(b"no EXR")
    assert rendering(output, spp=8).progress.done == 0
    assert rendered_file.read(output, ("R", "G", "B"), {}) is None


CHANGES = {
    "seed": ({"seed": 1}, "seed was 0, is 1"),
    "passes": ({"pass_spp": 8}, "passes of 4 samples per pixel"),
}


@pytest.mark.parametrize("other, said", CHANGES.values(), ids=CHANGES)
def test_a_checkpoint_of_another_render_is_refused_by_name(tmp_path, llvm, other, said):
    output = tmp_path / "a.exr"
    stopped_after(rendering(output, spp=64, pass_spp=4), 3)
    again = {"spp": 64, "pass_spp": 4} | other
    with pytest.raises(ValueError, match=said) as error:
        rendering(output, **again)
    assert "--restart" in str(error.value) and "\n" not in str(error.value)
    assert rendering(output, restart=True, **again).progress.passes == 0


def test_a_changed_scene_variant_or_version_is_refused_by_name(tmp_path, llvm, monkeypatch):
    scene, output = tmp_path / "scene.xml", tmp_path / "a.exr"
    scene.write_text(BALL.read_text())
    stopped_after(rendering(output, scene=scene, spp=64, pass_spp=4), 3)
    scene.write_text(BALL.read_text().replace("30.5", "30.6"))
    with pytest.raises(ValueError, match="the scene has changed"):
        rendering(output, scene=scene, spp=64)
    scene.write_text(BALL.read_text())
    with monkeypatch.context() as patch:
        patch.setattr(identity, "installed_version", lambda name: "0")
        with pytest.raises(ValueError, match=r"version of mitsuba was \S+, is 0"):
            rendering(output, scene=scene, spp=64)
    with monkeypatch.context() as patch:
        patch.setattr(identity.worker_facts, "vector_width", lambda: "64")
        with pytest.raises(ValueError, match=r"vector width was \d+, is 64"):
            rendering(output, scene=scene, spp=64)
    mi.set_variant("scalar_rgb")
    with pytest.raises(ValueError, match="variant was llvm_ad_rgb, is scalar_rgb"):
        rendering(output, scene=scene, spp=64)


def test_a_file_that_the_scene_names_is_part_of_it(tmp_path, llvm):
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    for path in (SCENE.parent / "meshes").iterdir():
        (meshes / path.name).write_bytes(path.read_bytes())
    (tmp_path / "scene.xml").write_text(SCENE.read_text())
    output = tmp_path / "a.exr"
    stopped_after(rendering(output, scene=tmp_path / "scene.xml", spp=64, pass_spp=4), 1)
    mesh = next(meshes.glob("tumbler_air.ply"))
    mesh.write_bytes(mesh.read_bytes().replace(b"comment", b"comment ", 1) + b"\n")
    with pytest.raises(ValueError, match="the scene has changed"):
        rendering(output, scene=tmp_path / "scene.xml", spp=64)


@pytest.mark.parametrize("damage", ["truncated", "flipped", "empty", "text", "another format"])
def test_a_damaged_checkpoint_is_refused(tmp_path, llvm, damage):
    output = tmp_path / "a.exr"
    stopped_after(rendering(output, spp=64, pass_spp=4), 3)
    path = checkpoint.path_of(output)
    content = path.read_bytes()
    damaged = {
        "truncated": content[:-100],
        "flipped": content[:1500] + bytes([content[1500] ^ 1]) + content[1501:],
        "empty": b"",
        "text": b"hello",
        "another format": content.replace(b'"format": %d' % checkpoint.FORMAT, b'"format": 99'),
    }
    path.write_bytes(damaged[damage])
    with pytest.raises(ValueError, match=r"a\.exr\.checkpoint: is no complete checkpoint .*--restart") as error:
        rendering(output, spp=64, pass_spp=4)
    assert "\n" not in str(error.value)


# What goes wrong ------------------------------------------------------------------------------------------------------


def test_two_renders_into_one_file(tmp_path, llvm):
    first, second = rendering(tmp_path / "a.exr", spp=16, pass_spp=4), rendering(tmp_path / "a.exr", spp=16, pass_spp=4)
    said = []

    def watch(_):
        with pytest.raises(BlockingIOError, match=r"a\.exr: a render is already running in process \d+ .* file"):
            second.run()
        said.append(True)

    first.run(watch)
    assert said


@pytest.mark.parametrize("took", [1, 8, 12, 19, 24, 40])
def test_a_kill_loses_25_s_or_one_pass(tmp_path, llvm, monkeypatch, took):
    """A clock that only passes move, each by as many seconds."""
    clock, kept = [0.0], [0.0]
    monkeypatch.setattr(long_render, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    monkeypatch.setattr(checkpoint, "write", lambda path, progress: kept.append(progress.seconds))
    render = rendering(tmp_path / "a.exr", spp=64, pass_spp=1)
    of_a_pass = type(render.renderer).render

    def passed(*arguments):
        clock[0] += took
        return of_a_pass(*arguments)

    monkeypatch.setattr(type(render.renderer), "render", passed)
    render.run()
    apart = np.diff(kept)
    assert len(apart) > 1 and apart.max() <= max(25, took) and apart.min() + took > 25


def test_a_full_disk_at_a_checkpoint_is_a_warning(tmp_path, llvm, monkeypatch):
    monkeypatch.setattr(long_render, "BETWEEN_CHECKPOINTS", 0.0)
    write, failures = checkpoint.write, []

    def full(path, progress):
        if len(failures) < 2:
            failures.append(path)
            raise OSError(errno.ENOSPC, "No space left on device")
        write(path, progress)

    monkeypatch.setattr(checkpoint, "write", full)
    render = rendering(tmp_path / "a.exr", spp=32, pass_spp=4)
    written = []
    render.run(lambda render: written.append(render.checkpoint.exists()))
    assert len(render.warnings) == 2 and "No space left on device; tried again" in render.warnings[0]
    assert any(written) and (tmp_path / "a.exr").exists()


def test_an_output_that_cannot_be_written_is_found_before(tmp_path, monkeypatch):
    monkeypatch.setattr(long_render, "load_scene", lambda *arguments: pytest.fail("loaded"))
    with pytest.raises(NotADirectoryError, match="expected"):
        rendering(tmp_path / "none" / "a.exr", spp=1)

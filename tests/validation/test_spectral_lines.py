"""A dispersive prism line by line: what is compared is what it says, and a wrong index is seen."""

from __future__ import annotations

import numpy as np
import pytest

from mi_refract import media
from mi_refract.image_diff.comparison import Verdict
from mi_refract.io import image_file
from mi_refract.media import LINES
from mi_refract.scene_export.plain_scene import Diffuse, Light
from validation.run.context import PROFILES, Context
from validation.suite import spectral_lines
from validation.suite.rendered_images import INCONCLUSIVE, Size
from validation.suite.renderers import environments

SMALL = Size(32, 64, 4, 0.3)
pytestmark = pytest.mark.usefixtures("llvm_variant")


@pytest.fixture
def context(tmp_path, monkeypatch):
    monkeypatch.setitem(spectral_lines.SIZES, "quick", SMALL)
    monkeypatch.setattr(environments, "absent", lambda system: "")
    return Context(PROFILES["quick"], tmp_path, "llvm_ad_rgb", {}, {spectral_lines.VARIANT: None})


def noisy(seed, size=32, noise=0.01, shift=0):
    """Four renders of a bright stripe."""
    rng = np.random.default_rng(seed)
    stripe = 0.1 + (np.abs(np.arange(size) - 9 - shift) < 3)
    pixels = stripe * (1 + noise * rng.normal(size=(4, size, size)))
    return [image_file.named(f"{seed} {i}", each[..., None].astype(np.float32)) for i, each in enumerate(pixels)]


def lines(monkeypatch, shifts=(0, 0, 0), noise=0.01):
    """`ours` has its stripe at the place of the line, `theirs` beside it."""
    place = dict(zip("CdF", (0, 4, 12), strict=True))
    beside = dict(zip("CdF", shifts, strict=True))
    monkeypatch.setattr(spectral_lines, "ours", lambda line, size: noisy(1, shift=place[line], noise=noise))
    found = lambda line, size: noisy(2, shift=place[line] + beside[line], noise=noise)  # noqa: E731
    monkeypatch.setattr(spectral_lines, "theirs", found)


def rows(context):
    return [row for task in spectral_lines.tasks(context) for row in task.run()]


def test_the_same_at_each_line_passes_and_a_mixture_is_seen(context, monkeypatch):
    lines(monkeypatch)
    assert [row.verdict for row in rows(context)] == ["pass"] * 5


def test_a_stripe_beside_its_place_fails(context, monkeypatch):
    lines(monkeypatch, shifts=(0, 0, 2))
    assert [row.verdict for row in rows(context)] == ["pass", "pass", "fail", "pass", "pass"]


def test_noise_that_could_hide_a_difference_is_no_pass(context, monkeypatch):
    lines(monkeypatch, noise=3.0)
    found = rows(context)[0]
    assert found.verdict == "fail" and INCONCLUSIVE in found.missed


def test_a_control_that_sees_nothing_fails(context, monkeypatch):
    """As if dispersion were left out."""
    lines(monkeypatch)
    monkeypatch.setattr(spectral_lines, "theirs", lambda line, size: noisy(2))
    monkeypatch.setattr(spectral_lines, "ours", lambda line, size: noisy(1))
    assert [row.verdict for row in rows(context)[3:]] == ["fail", "fail"]


def test_what_does_not_render_is_never_a_pass(context, monkeypatch):
    def raising(error):
        def draw(line, size):
            raise error

        return draw

    for error, verdict in ((environments.Unable("no word"), "not run"), (environments.Broken("exit code 1"), "fail")):
        lines(monkeypatch)
        monkeypatch.setattr(spectral_lines, "theirs", raising(error))
        assert rows(context)[0].verdict == verdict
    monkeypatch.setattr(environments, "absent", lambda system: "the command that brings it")
    assert {(row.verdict, row.reason) for row in rows(context)} == {("not run", "the command that brings it")}


# The scene -----------------------------------------------------------------------------------------------------


def test_the_scene_is_grey():
    plain = spectral_lines.plain(16)
    colours = [mesh.material.reflectance for mesh in plain.meshes if isinstance(mesh.material, Diffuse)]
    colours += [mesh.material.radiance for mesh in plain.meshes if isinstance(mesh.material, Light)]
    assert len(colours) == 3 and all(len(set(colour)) == 1 for colour in (*colours, plain.sky))


def test_the_glass_is_that_of_raysects_library():
    """Its indices as raysect 0.9 gave them."""
    printed = {"C": 1.775987679010179, "d": 1.7847198458559292, "F": 1.8064543854708786}
    for line, index in printed.items():
        assert float(media.index(spectral_lines.INDEX, LINES[line])) == pytest.approx(index, rel=1e-15)


def test_the_film_sees_what_shines_and_another_index_is_seen(needs_variant, monkeypatch):
    """The sky is seen as bright as it is, in each line; ours at one index against ours at another differ."""
    needs_variant(spectral_lines.VARIANT)
    spectral_lines.ours.cache_clear()
    one = {line: spectral_lines.ours(line, Size(32, 256, 1, 0.3)) for line in "CF"}
    sky = spectral_lines.plain(16).sky[0]
    for images in one.values():
        assert images[0].pixels[0, 0, 0] == pytest.approx(sky, rel=1e-3)
    found, _ = spectral_lines._compared(one["C"], one["F"], Size(32, 256, 1, 0.3))
    assert found.verdict is Verdict.DIFFERENT
    with pytest.raises(ValueError, match="expected 1"):
        spectral_lines.spectral("<scene/>", 500.0)

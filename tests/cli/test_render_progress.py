"""What `mi-refract render` shows meanwhile: lines without a terminal, a bar on one, previews, warnings."""

from __future__ import annotations

import io
import re
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from rich.console import Console

from mi_refract.cli import render_progress
from mi_refract.io.image_file import read
from mi_refract.rendering.end_conditions import Limits
from mi_refract.rendering.long_render import Job, resume

BALL = Path(__file__).parents[2] / "scenes" / "sphere.xml"


@pytest.fixture
def rendering(tmp_path, needs_variant):
    needs_variant("llvm_ad_rgb")
    mi.set_variant("llvm_ad_rgb")

    def make(**limits):
        return resume(Job(BALL, {"res": "8"}), tmp_path / "a.exr", Limits(**limits))

    return make


def run(render, preview=None, terminal=""):
    """What was printed on the console's terminal, of a kind."""
    text = io.StringIO()
    console = Console(file=text, force_terminal=bool(terminal), width=80, _environ={"TERM": terminal})
    with render_progress.shown(console, render, preview) as watch:
        render.run(watch)
    return text.getvalue()


def test_lines_where_there_is_no_terminal(rendering, monkeypatch, capsys):
    monkeypatch.setattr(render_progress, "BETWEEN_LINES", 0.0)
    monkeypatch.setattr(render_progress, "LOOK_COST", 0.0)
    assert run(rendering(spp=64, pass_spp=8)) == ""
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 9  # after every pass, and at the end
    number = r"[\d.e+-]+"
    error = rf"error {number} % \({number} to {number} %\)"
    form = rf"\S+a\.exr: pass 6 of 8, \d+ s left, {error}, {number} M samples/s, 48 spp"
    assert re.fullmatch(form, lines[5]), lines[5]


def test_few_lines(rendering, capsys):
    """One every 30 s, so that a log stays short: none for a render of a second."""
    run(rendering(spp=64, pass_spp=8))
    assert capsys.readouterr().err == ""


def test_a_bar_on_a_terminal(rendering, monkeypatch, capsys):
    monkeypatch.setattr(render_progress, "BETWEEN_LOOKS", 0.0)
    monkeypatch.setattr(render_progress, "LOOK_COST", 0.0)
    shown = run(rendering(until=0.2, pass_spp=4), terminal="xterm")
    for said in ("━", "passes", "s left", "error", "M samples/s"):
        assert said in shown
    assert capsys.readouterr().err == ""


def test_lines_on_a_terminal_that_cannot_move_its_cursor(rendering, monkeypatch, capsys):
    monkeypatch.setattr(render_progress, "BETWEEN_LINES", 0.0)
    monkeypatch.setattr(render_progress, "LOOK_COST", 0.0)
    run(rendering(spp=16, pass_spp=8), terminal="dumb")
    assert len(capsys.readouterr().err.splitlines()) == 3


def test_the_preview_is_the_image(rendering, tmp_path, monkeypatch):
    monkeypatch.setattr(render_progress, "BETWEEN_PREVIEWS", 0.0)
    render = rendering(spp=64, pass_spp=8)
    run(render, tmp_path / "a.png")
    linear = np.clip(render.image(), 0, 1)
    expected = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    # Half a step of 8 bits, and a little for the coding of sRGB.
    np.testing.assert_allclose(read(tmp_path / "a.png").pixels, expected, atol=0.51 / 255)


def test_a_preview_that_cannot_be_written_is_a_warning(rendering, tmp_path, capsys):
    run(rendering(spp=8), tmp_path / "none" / "a.png")
    err = capsys.readouterr().err
    assert "no preview" in err and err.startswith("mi-refract: ")
    assert (tmp_path / "a.exr").exists()

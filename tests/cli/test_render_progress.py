"""Quantities that `mi-refract render` parses, and its progress lines, bar and previews."""

from __future__ import annotations

import io
import re
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from rich.console import Console
from support.renders import rendering

from mi_refract.cli import render_progress
from mi_refract.cli.render_progress import parse_seconds, parse_share, shown_error
from mi_refract.io.image_file import read
from mi_refract.rendering.end_conditions import RelativeError


@pytest.mark.parametrize("text, value", [("1%", 0.01), ("0.01", 0.01), ("100%", 1.0), ("1e-3", 0.001), ("0.5%", 0.005)])
def test_shares(text, value):
    assert parse_share(text, "--until") == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    "text, value",
    [("90", 90), ("90s", 90), ("10m", 600), ("1h30m", 5400), ("2d", 172800), ("0.5h", 1800), ("1m1s", 61)],
)
def test_times(text, value):
    assert parse_seconds(text, "--time") == value


NO_SHARE = ["0", "1_0%", "0%", "-1%", "100.1%", "1.5", "nan", "inf", "%", "", "1 %%", "1", "0.5"]
NO_TIME = ["0", "0s", "-1", "1x", "", "m", "1m1h", "1e9", "nan", "inf", "10 m", "9" * 12]


@pytest.mark.parametrize(
    ("parse", "texts", "expected"),
    [(parse_share, NO_SHARE, "more than 0 %, up to 100 %"), (parse_seconds, NO_TIME, "a time of more than 0")],
)
def test_invalid_quantities_are_refused(parse, texts, expected):
    for text in texts:
        with pytest.raises(ValueError, match=rf"^--option .*; expected {expected}"):
            parse(text, "--option")


def test_shown_error_has_its_interval_if_known():
    assert shown_error(RelativeError(0.0042, 0.004, 0.0044)) == "0.42 % (0.4 to 0.44 %)"
    assert shown_error(RelativeError(0.0042)) == "0.42 %"
    assert shown_error(RelativeError(0.0042, at_most=True)) == "at most 0.42 %"
    assert shown_error(RelativeError(1.73, 1.7, 11.2)) == "170 % (170 to 1100 %)"


@pytest.fixture
def run(tmp_path, llvm_variant):
    """`run(spp=64)`: the render, and the output on a terminal of type `terminal`; "" is no terminal."""

    def make(preview=None, terminal="", **limits):
        render, text = rendering(tmp_path / "a.exr", restart=True, **limits), io.StringIO()
        console = Console(file=text, force_terminal=bool(terminal), width=80, _environ={"TERM": terminal})
        with render_progress.shown(console, render, preview) as watch:
            render.run(watch)
        return render, text.getvalue()

    return make


def test_progress_lines_or_a_bar(run, monkeypatch, capsys):
    run(spp=64, pass_spp=8)  # a line every 30 s: none for a render of a second
    assert capsys.readouterr().err == ""
    for name in ("BETWEEN_LINES", "BETWEEN_ESTIMATES", "ESTIMATE_COST"):
        monkeypatch.setattr(render_progress, name, 0.0)
    assert run(spp=64, pass_spp=8)[1] == ""
    lines = capsys.readouterr().err.splitlines()
    number = r"[\d.e+-]+"
    error = rf"error {number} % \({number} to {number} %\)"
    form = rf"\S+a\.exr: pass 6 of 8, \d+ s left, {error}, {number} M samples/s, 48 spp"
    assert len(lines) == 9 and re.fullmatch(form, lines[5]), lines  # after every pass, and at the end
    _, bar = run(until=0.2, pass_spp=4, terminal="xterm")
    assert all(text in bar for text in ("━", "passes", "s left", "error", "M samples/s"))
    assert capsys.readouterr().err == ""
    run(spp=16, pass_spp=8, terminal="dumb")  # it cannot move its cursor: lines
    assert len(capsys.readouterr().err.splitlines()) == 3


@pytest.mark.parametrize("seconds", [0.0, 1e9])
def test_preview_is_the_image_and_a_failure_is_a_warning(run, tmp_path, monkeypatch, capsys, seconds):
    monkeypatch.setattr(render_progress, "BETWEEN_PREVIEWS", seconds)
    render, _ = run(tmp_path / "a.png", spp=64, pass_spp=8)
    linear = np.clip(render.image(), 0, 1)
    expected = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    # Half a step of 8 bits, and a little for the sRGB encoding.
    np.testing.assert_allclose(read(tmp_path / "a.png").pixels, expected, atol=0.51 / 255)
    run(tmp_path / "none" / "a.png", spp=8)
    err = capsys.readouterr().err
    assert "no preview" in err and err.startswith("mi-refract: ") and (tmp_path / "a.exr").exists()


@pytest.mark.parametrize(
    ("names", "colours", "expected"),
    [
        (["Y", "n.X", "n.Y", "n.Z"], 1, [0.5, 0.5, 0.5]),
        ("RGBA", 3, [0.5, 0.2, 0.8]),
        ("XYZA", 3, mi.scalar_rgb.xyz_to_srgb([0.5, 0.2, 0.8])),
        (["S1", "S2", "S3", "S4"], 4, [0.5, 0.2, 0.8]),
    ],
)
def test_a_preview_shows_the_colours_only(tmp_path, names, colours, expected):
    image = np.tile([0.5, 0.2, 0.8, 1.0], (2, 3, 1))
    image[1, 2] = np.inf
    renderer = SimpleNamespace(colours=colours, channels=tuple(names))
    render_progress.write_preview(tmp_path / "a.png", SimpleNamespace(image=lambda: image, renderer=renderer))
    encoded = render_progress.srgb_encode(np.clip(np.array(expected), 0, 1))
    shown = read(tmp_path / "a.png").pixels
    np.testing.assert_allclose(shown[0, 0], encoded, atol=0.51 / 255)
    np.testing.assert_array_equal(shown[1, 2], 1)

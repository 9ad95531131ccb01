"""`mi-refract trace`: its options, the errors for bad input, and the remaining files."""

from __future__ import annotations

import json
import math
import sys

import numpy as np
import pytest
from support.processes import assert_refused

from mi_refract.planar import scene_file, tracer

BALL = """
title = "A glass ball"
branches = 0

[[shape]]
kind = "circle"
radius = 1.0
n = 1.5

[[beam]]
kind = "parallel"
from = [-3, -0.9]
to = [-3, 0.9]
direction = [1, 0]
count = 7
"""
FORMATS = {".svg": b"<?xml", ".png": b"\x89PNG", ".pdf": b"%PDF"}


@pytest.fixture
def ball(tmp_path):
    path = tmp_path / "ball.toml"
    path.write_text(BALL)
    return path


@pytest.fixture
def trace(ball, run):
    """`trace("--table")`: exit code, stdout and stderr of tracing `ball`, or another scene."""
    return lambda *options, scene=ball: run("trace", scene, *options)


def paths_of(result):
    code, out, err = result
    assert (code, err) == (0, "")
    return [path for colour in json.loads(out, parse_constant=pytest.fail)["colours"] for path in colour["paths"]]


@pytest.mark.parametrize("suffix", ["", ".png", ".pdf", ".SVG"])
def test_summary_line_and_figure(trace, ball, suffix):
    output = ball.with_name(f"image{suffix}")
    written = f"{output}: written\n" if suffix else ""
    assert trace(*(["-o", output] if suffix else [])) == (0, f"ball.toml: 7 rays, 14 hits, 7 escaped\n{written}", "")
    assert sorted(ball.parent.iterdir()) == sorted([ball, output] if suffix else [ball])
    assert not suffix or output.read_bytes().startswith(FORMATS[suffix.lower()])


def test_json_has_the_paths(trace, ball):
    scene = scene_file.load(ball)
    expected = tracer.trace(scene.segments[0], scene.origins, scene.directions, scene.max_depth, weights=True)
    paths = paths_of(trace("--json"))
    for name, values in (("points", expected.points[:, :3]), ("weights", expected.weights[:, :3])):
        np.testing.assert_array_equal([path[name] for path in paths], values)
    np.testing.assert_array_equal(directions(paths), expected.directions)
    assert [path["hits"] for path in paths] == expected.hits[:, :2].tolist()
    for path in paths:
        assert (path["events"], path["indices"]) == (["refracted", "refracted", "escaped"], [1.0, 1.5, 1.0])
        assert (path["beam"], path["reflect"], path["polarised"].keys()) == (0, 0, {"s", "p"})
    ball.write_text(BALL.replace("n = 1.5", "n = [1.5, 1.6]").replace("branches = 0", 'colours = ["red", "blue"]'))
    data = json.loads(trace("--json")[1])
    assert (data["title"], data["scene"]) == ("A glass ball", str(ball))
    assert [entry["colour"] for entry in data["colours"]] == ["red", "blue"] and data["counts"]["escaped"] == 14
    assert data["colours"][1]["paths"][0]["indices"] == [1.0, 1.6, 1.0]


def test_the_table(trace):
    code, out, err = trace("--table")
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert (lines[0], len(lines)) == ("ball.toml: 7 rays, 14 hits, 7 escaped", 6)
    assert lines[1].split()[-5:] == ["rms", "largest", "marginal", "paraxial", "NA"]
    assert lines[2].split()[-1] == "0.814889"  # sin 2(i − r)
    assert lines[5].split()[3:6] == ["1.5", "0.5", "-0.5"]
    assert "1.10445, 0" in lines[2]  # sin i / sin 2(i − r) for sin i = 0.9, sin r = 0.6
    spread = json.loads(trace("--table", "--json")[1])["foci"][0]["spread"]
    assert spread["marginal"][0] == pytest.approx(1.1044455683692647, abs=1e-12)
    assert spread["paraxial"] == pytest.approx([1.5, 0], abs=1e-14)
    assert spread["cardinal"]["focal_length"] == pytest.approx(1.5, rel=1e-14)
    assert spread["aperture"] == pytest.approx(math.sin(2 * (math.asin(0.9) - math.asin(0.6))), rel=1e-14)
    assert "foci" not in json.loads(trace("--json")[1])


def test_a_spot_on_a_plane(trace):
    code, out, err = trace("--plane", "-2,0")
    assert (code, err, len(out.splitlines())) == (0, "", 9)
    planes = "3,0", "3,5,180"
    spot, same = (json.loads(trace("--json", "--plane", x)[1])["foci"][0]["spread"]["on_plane"] for x in planes)
    assert spot.keys() == {"centre", "rms", "extent"}
    assert spot["centre"] == pytest.approx([3, 0], abs=1e-12)
    assert all(same[name] == pytest.approx(value, abs=1e-12) for name, value in spot.items())


def test_options_override_the_file(trace, ball):
    def reflected(*options):
        return {path["reflect"] for path in paths_of(trace("--json", *options))}

    assert (reflected(), reflected("--branches", 2)) == ({0}, {0, 1, 2, 6})
    ball.write_text(BALL.replace("branches = 0", "branches = 1"))
    assert (reflected(), reflected("--branches", 0)) == ({0, 1, 2}, {0})
    ball.write_text(BALL)
    assert trace("--rays", 101)[1] == "ball.toml: 101 rays, 202 hits, 101 escaped\n"
    assert trace("--max-depth", 1)[1] == "ball.toml: 7 rays, 7 hits, 7 stopped at max_depth\n"


@pytest.mark.parametrize(
    "first, second, where",
    [("", "", "shape[0] and shape[1]"), ('name = "crown"', 'name = "flint"', "shape[0] 'crown' and shape[1] 'flint'")],
)
def test_mismatched_shapes_are_named_with_exit_code_1(trace, ball, first, second, where):
    other = BALL.partition("[[shape]]")[2].partition("[[beam]]")[0].replace("1.5", "1.6")
    ball.write_text(BALL.replace("n = 1.5", f"n = 1.5\n{first}") + f"[[shape]]{other}at = [1.2, 0]\n{second}")
    code, out, err = trace()
    assert (code, out) == (1, "ball.toml: 7 rays, 14 hits, 7 stopped by a medium mismatch\n")
    fault = "overlap, share part of an edge, leave a gap, or are turned round"
    fault += ": 7 paths in index 1.5 met a boundary between 1.6 and 1"
    assert err.startswith(f"mi-refract: {ball}: {where} {fault}; expected ") and err.count("\n") == 1


def directions(paths):
    return np.array([path["direction"] for path in paths])


def test_formula_backend_and_precision(trace, needs_variant):
    needs_variant("llvm_ad_rgb")  # without LLVM scalar arrays are the default
    default = directions(paths_of(trace("--json")))
    for options in (("--formula", "promoted"), ("--backend", "scalar")):
        other = directions(paths_of(trace("--json", *options)))
        np.testing.assert_allclose(other, default, atol=1e-12)
        assert (other != default).any()
    single = directions(paths_of(trace("--json", "--precision", "float32")))
    np.testing.assert_array_equal(single, single.astype(np.float32))
    np.testing.assert_allclose(single, default, atol=1e-5)


BAD = {
    "no plane": (("--plane", "here"), "--plane here; expected X,Y or X,Y,DEGREES, finite numbers"),
    "empty plane": (("--plane", ""), "--plane ; expected X,Y"),
    "digits of a plane": (("--plane", "1_0,0"), "--plane 1_0,0; expected X,Y"),
    "empty wavelengths": (("--wavelengths", ""), "--wavelengths : expected wavelengths in nm"),
    "digits of wavelengths": (("--wavelengths", "4_86.1,58_7.6"), "4_86.1,58_7.6: expected wavelengths in nm"),
    "suffix": (("-o", "{}/image.gif"), "expected a file name that ends in .svg or .png or .pdf"),
    "no folder": (("-o", "{}/none/image.svg"), "is not a folder"),
    "folder": (("-o", "{}/folder.svg"), "is a folder"),
    "branches": (("--branches", "-1"), "--branches"),
    "more branches than in a file": (("--branches", "9"), "'--branches': Input should be less than or equal to 8"),
    "no rays": (("--rays", "0"), "--rays"),
    "no depth": (("--max-depth", "0"), "--max-depth"),
    "option": (("--nonesuch",), "--nonesuch"),
    "too much": (("--rays", "4000000"), "expected fewer rays"),
    "too deep": (("--max-depth", f"1{'0' * 30}"), "expected fewer rays"),
}


@pytest.mark.parametrize("options, message", BAD.values(), ids=BAD)
def test_bad_options(trace, ball, options, message):
    ball.with_name("folder.svg").mkdir()
    if "-o" not in options:
        options = (*options, "-o", str(ball.with_name("image.svg")))
    assert_refused(trace(*(option.format(ball.parent) for option in options)), message)
    assert {path.name for path in ball.parent.iterdir()} == {"ball.toml", "folder.svg"}


@pytest.mark.parametrize(
    "old, new, message",
    [("radius = 1.0", "radius = nan", "radius"), ("branches = 0", 'colours = ["ultraviolent"]', "ultraviolent")],
)
def test_a_bad_scene_leaves_the_old_image(trace, ball, old, new, message):
    output = ball.with_name("image.svg")
    output.write_text("old")
    ball.write_text(BALL.replace(old, new))
    assert_refused(trace("-o", output, "--json"), f"mi-refract: {ball}", message)
    assert output.read_text() == "old"


def test_missing_matplotlib(trace, ball, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert trace()[0] == 0
    message = "mi-refract: images need the extra `plot`: pip install 'mi-refract[plot]'\n"
    assert trace("-o", ball.with_name("image.svg")) == (2, "", message)


def test_keys_are_printed_without_a_scene(run):
    code, out, err = run("trace", "--keys")
    assert (code, err) == (0, "")
    assert out == scene_file.reference() + "\n"
    keys = "title", "wavelengths", "focal_length  distance from the front to the focus", "R1", "from", "scale"
    assert all(f"\n  {key} " in out or f"\n  {key}\n" in out for key in keys)
    assert '[[shape]] kind = "luneburg": ' in out and '[[beam]] kind = "fan": ' in out
    assert max(map(len, out.splitlines())) <= 80

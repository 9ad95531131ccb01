"""`mi-refract self-test`: of images, of renders, of scenes. A scene of others runs no code and ends no process."""

import os
from pathlib import Path

import numpy as np
import pytest
from support.diff_images import image, samples
from support.processes import assert_refused

from mi_refract import backend
from mi_refract.cli import diff as command
from mi_refract.image_diff import methods, self_test
from mi_refract.image_diff.comparison import Comparison, Verdict

SCENE = Path(command.__file__).parents[2] / "scenes" / "sphere.xml"


def test_renders_one_image_and_a_scene(run, tmp_path, monkeypatch):
    """Of few trials. The exit code is 1 where a defect is missed."""
    full = self_test.examine
    monkeypatch.setattr(self_test, "examine", lambda renders, case: full(renders, case, trials=2, null_pairs=4))
    monkeypatch.setattr(command, "SPP", 2)
    monkeypatch.setattr(backend, "activate", lambda *chosen: None)
    folder, scene = samples(tmp_path / "renders", 8, noise=0.001), tmp_path / "sphere.xml"
    scene.write_text(SCENE.read_text().replace('name="res" value="128"', 'name="res" value="24"'))
    for path, text in ((folder, "null pairs 4"), (folder / "0.exr", "null pairs 1"), (scene, "renders: noise ")):
        code, out, err = run("self-test", path)
        assert err == "" and code == int("failed: " in out) and text in out
        assert {"NaN", "blur"} <= {line.split()[0] for line in out.splitlines()}
    monkeypatch.setattr(methods, "compare", lambda m, *sides: Comparison(m, Verdict.EQUAL, ""))
    code, out, _ = run("self-test", folder / "0.exr")
    assert code == 1 and "failed: " in out


def test_bad_input_is_one_line(run, pair, tmp_path):
    image(tmp_path / "mixed" / "a.exr")
    image(tmp_path / "mixed" / "b.exr", shape=(8, 8, 3))
    image(tmp_path / "nan.exr", value=np.nan)
    for words, message in [
        (pair, "Got unexpected extra argument"),
        ([pair[0] / "equal.exr", "--method", "flip"], "No such option"),
        ([tmp_path / "none.exr"], "none.exr"),
        ([tmp_path / "none.xml"], "none.xml"),
        ([tmp_path / "mixed"], "size or channels differ from"),
        ([tmp_path / "nan.exr"], "with finite values only"),
        ([], "Missing argument 'REFERENCE'"),
        ([pair[0], "--allow-plugins", "evil"], "expected a scene SCENE.xml as REFERENCE"),
    ]:
        assert_refused(run("self-test", *words), message)


@pytest.mark.parametrize(
    "elements, options, message",
    [
        ('<bsdf type="evil"/>', (), "s.xml: plugin 'evil': neither Mitsuba's nor mi_refract's; expected those"),
        ('<bsdf type="evil"/>', ("other",), "plugin 'evil': neither Mitsuba's nor mi_refract's"),
        # Where it is allowed Mitsuba tries to load it, and says that it is no native code.
        ('<bsdf type="evil"/>', ("other", "evil"), "Error while loading plugin"),
        ('<bsdf type="../evil"/>', (), "s.xml: plugin '../evil': neither"),
        ("", (), "s.xml: not a regular file"),
    ],
    ids=["plugin", "another is allowed", "it is allowed", "plugin elsewhere", "pipe"],
)
def test_a_scene_of_others_runs_only_what_is_allowed(elements, options, message, run, tmp_path):
    (tmp_path / "plugins").mkdir()
    for path in (tmp_path / "plugins" / "evil.so", tmp_path / "evil.so"):
        path.write_text("native code")
    if elements:
        (tmp_path / "s.xml").write_text(f'<scene version="3.0.0">{elements}</scene>')
    else:
        os.mkfifo(tmp_path / "s.xml")
    assert_refused(run("self-test", tmp_path / "s.xml", *(f"--allow-plugins={name}" for name in options)), message)

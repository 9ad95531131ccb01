"""`mi-refract self-test`: of images, of renders, of scenes. A scene of others runs no code and ends no process."""

import os
from pathlib import Path

import numpy as np
import pytest
from support.diff_images import image, samples

from mi_refract import backend
from mi_refract.cli import self_test as command
from mi_refract.image_diff import methods, self_test
from mi_refract.image_diff.comparison import Comparison, Verdict


@pytest.fixture
def quick(monkeypatch):
    """A self-test of few trials."""
    full = self_test.examine
    monkeypatch.setattr(self_test, "examine", lambda renders, case: full(renders, case, trials=2, null_pairs=4))


def test_self_test_of_renders_and_of_one_image(run, tmp_path, quick, monkeypatch):
    folder = samples(tmp_path / "renders", 8, noise=0.001)
    for path, number in ((folder, "null pairs 4"), (folder / "0.exr", "null pairs 1")):
        code, out, err = run("self-test", path)
        assert err == "" and code == int("failed: " in out) and number in out
        assert {"NaN", "blur"} <= {line.split()[0] for line in out.splitlines()}
    monkeypatch.setattr(methods, "compare", lambda m, *sides: Comparison(m, Verdict.EQUAL, ""))
    code, out, _ = run("self-test", folder / "0.exr")
    assert code == 1 and "failed: " in out


def test_self_test_renders_a_scene(run, tmp_path, quick, monkeypatch):
    text = (Path(command.__file__).parents[2] / "scenes" / "sphere.xml").read_text()
    scene = tmp_path / "sphere.xml"
    scene.write_text(text.replace('name="res" value="128"', 'name="res" value="24"'))
    monkeypatch.setattr(command, "SPP", 2)
    monkeypatch.setattr(backend, "activate", lambda *chosen: None)
    code, out, err = run("self-test", scene)
    assert (code in (0, 1), err) == (True, "")
    assert "renders: noise " in out


def test_bad_self_tests(run, pair, tmp_path):
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
        code, out, err = run("self-test", *words)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert message in err


@pytest.mark.parametrize(
    "elements, says",
    [
        ('<bsdf type="evil"/>', "s.xml: plugin 'evil': neither Mitsuba's nor mi_refract's; expected those"),
        ('<bsdf type="../evil"/>', "s.xml: plugin '../evil': neither"),
        ("", "s.xml: not a regular file"),
    ],
    ids=["plugin", "plugin elsewhere", "pipe"],
)
def test_refused_in_one_line(elements, says, run, tmp_path):
    for path in (tmp_path / "plugins" / "evil.so", tmp_path / "evil.so"):
        path.parent.mkdir(exist_ok=True)
        path.write_text("native code")
    if elements:
        (tmp_path / "s.xml").write_text(f'<scene version="3.0.0">{elements}</scene>')
    else:
        os.mkfifo(tmp_path / "s.xml")
    code, out, err = run("self-test", tmp_path / "s.xml")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("mi-refract: ") and says in err


def test_a_plugin_of_the_scenes_own_runs_only_where_it_is_allowed(run, tmp_path):
    """Then Mitsuba tries to load it, and says that it is no native code."""
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "evil.so").write_text("native code")
    scene = tmp_path / "s.xml"
    scene.write_text('<scene version="3.0.0"><bsdf type="evil"/></scene>')
    code, _, err = run("self-test", scene, "--allow-plugins", "other")
    assert code == 2 and "plugin 'evil': neither Mitsuba's nor mi_refract's" in err
    code, _, err = run("self-test", scene, "--allow-plugins", "other", "--allow-plugins", "evil")
    assert (code, err.count("\n")) == (2, 1) and "Error while loading plugin" in err and "plugins/evil.so" in err

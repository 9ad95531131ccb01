"""`mi-refract self-test` of images, renders and scenes. A scene cannot run its own code."""

import os

import numpy as np
from support.diff_images import image, samples
from support.processes import assert_refused

from mi_refract import SCENES, backend
from mi_refract.cli import diff as command
from mi_refract.image_diff import methods, self_test
from mi_refract.image_diff.comparison import Comparison, Verdict

SCENE = SCENES / "sphere.xml"


def test_self_test_of_renders_an_image_and_a_scene(run, tmp_path, monkeypatch):
    """With few trials. The exit code is 1 if a defect is missed."""
    full = self_test.examine
    monkeypatch.setattr(self_test, "examine", lambda renders, case: full(renders, case, trials=2, null_pairs=4))
    monkeypatch.setattr(command, "SPP", 2)
    monkeypatch.setattr(backend, "activate", lambda *variant: None)
    folder, scene = samples(tmp_path / "renders", 8, noise=0.001), tmp_path / "sphere.xml"
    scene.write_text(SCENE.read_text().replace('name="res" value="128"', 'name="res" value="24"'))
    texts = {folder: "null pairs 4", folder / "0.exr": "renders: welch needs 4 or more", scene: "renders: noise "}
    for path, text in texts.items():
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
    scene, pipe, plugin = tmp_path / "s.xml", tmp_path / "pipe.xml", tmp_path / "plugins" / "evil.so"
    scene.write_text('<scene version="3.0.0"><bsdf type="evil"/></scene>')
    os.mkfifo(pipe)
    plugin.parent.mkdir()
    plugin.write_text("native code")
    for words, message in [
        (pair, "Got unexpected extra argument"),
        ([pair[0] / "equal.exr", "--method", "flip"], "No such option"),
        ([tmp_path / "none.exr"], "none.exr"),
        ([tmp_path / "none.xml"], "none.xml"),
        ([tmp_path / "mixed"], "size or channels differ from"),
        ([tmp_path / "nan.exr"], "with finite values only"),
        ([], "Missing argument 'REFERENCE'"),
        ([pair[0], "--allow-plugins", "evil"], "expected a scene SCENE.xml as REFERENCE"),
        ([pipe], "pipe.xml: not a regular file"),
        ([scene], "s.xml: plugin 'evil': neither Mitsuba's nor mi_refract's; expected those"),
        # If it is allowed, Mitsuba tries to load it and fails, because it is not native code.
        ([scene, "--allow-plugins", "other", "--allow-plugins", "evil"], "Error while loading plugin"),
    ]:
        assert_refused(run("self-test", *words), message)

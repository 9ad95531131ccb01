"""`mi-refract diff --self-test SCENE.xml`: a scene of others runs no code of its own, and ends no process."""

import os

import pytest


@pytest.mark.parametrize(
    "elements, says",
    [
        ('<bsdf type="evil"/>', "s.xml: plugin 'evil': neither Mitsuba's nor mi_refract's; expected those"),
        ('<bsdf type="../evil"/>', "s.xml: plugin '../evil': neither"),
        ('<bsdf type="twosided">' * 20000 + "</bsdf>" * 20000, "s.xml: elements nested more than 32 deep"),
        ("", "s.xml: not a regular file"),
    ],
    ids=["plugin", "plugin elsewhere", "deep", "pipe"],
)
def test_refused_in_one_line(elements, says, run, tmp_path):
    for path in (tmp_path / "plugins" / "evil.so", tmp_path / "evil.so"):
        path.parent.mkdir(exist_ok=True)
        path.write_text("native code")
    if elements:
        (tmp_path / "s.xml").write_text(f'<scene version="3.0.0">{elements}</scene>')
    else:
        os.mkfifo(tmp_path / "s.xml")
    code, out, err = run("diff", "--self-test", tmp_path / "s.xml")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("mi-refract: ") and says in err


def test_a_plugin_of_the_scenes_own_runs_only_where_it_is_allowed(run, tmp_path):
    """Then Mitsuba tries to load it, and says that it is no native code."""
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "evil.so").write_text("native code")
    scene = tmp_path / "s.xml"
    scene.write_text('<scene version="3.0.0"><bsdf type="evil"/></scene>')
    code, _, err = run("diff", "--self-test", scene, "--allow-plugins", "other")
    assert code == 2 and "plugin 'evil': neither Mitsuba's nor mi_refract's" in err
    code, _, err = run("diff", "--self-test", scene, "--allow-plugins", "other", "--allow-plugins", "evil")
    assert (code, err.count("\n")) == (2, 1) and "Error while loading plugin" in err and "plugins/evil.so" in err


def test_only_a_scene_brings_plugins(run, pair):
    for words in ((*pair,), ("--self-test",), ("--self-test", pair[0])):
        code, _, err = run("diff", *words, "--allow-plugins", "evil")
        assert (code, err.count("\n")) == (2, 1) and "expected with --self-test SCENE.xml" in err

"""`mi-refract diff --self-test SCENE.xml`: a scene of others runs no code of its own, and ends no process."""

import os

import pytest


@pytest.mark.parametrize(
    "elements, says",
    [
        ('<bsdf type="evil"/>', "s.xml: plugin 'evil': neither Mitsuba's nor mi_refract's; accepted: those"),
        ('<bsdf type="../evil"/>', "s.xml: plugin '../evil': neither"),
        ('<bsdf type="twosided">' * 20000 + "</bsdf>" * 20000, "s.xml: elements nested more than 32 deep"),
        ("", "s.xml: is a pipe or a device; accepted: a file"),
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

"""`mi-refract scene export`: what it prints, writes and refuses, and with which exit code."""

from pathlib import Path

import pytest

from mi_refract.cli import app

SCENES = Path(app.__file__).parents[2] / "scenes"


@pytest.fixture
def export(tmp_path, monkeypatch, run):
    """`export("prism", …)`: exit code, stdout, stderr of `mi-refract scene export …` in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return lambda *words: run("scene", "export", *words)


def test_names_paths_levels_and_defines(export, tmp_path):
    code, out, err = export("prism", "--to", "radiance")
    assert (code, err) == (0, "")
    assert out == "prism-radiance: 3 files, 1162 triangles; prism-radiance/README.txt says how to render them\n"
    assert export(SCENES / "prism.xml", "--to", "radiance", "-o", "other")[0] == 0
    assert (tmp_path / "other" / "scene.rad").read_bytes() == (tmp_path / "prism-radiance" / "scene.rad").read_bytes()
    code, out, _ = export("sphere", "--to", "mitsuba", "--level", 1, "-D", "res=17", "-D", "max_depth=9")
    assert code == 0 and "1650 triangles" in out
    text = (tmp_path / "sphere-mitsuba" / "scene.xml").read_text()
    assert '<integer name="width" value="17"/>' in text and 'name="max_depth" value="9"' in text
    assert "1590 triangles" in export("sphere", "--to", "mitsuba", "--level", 0, "-o", "zero")[1]  # not the default


@pytest.mark.parametrize(
    "words, says",
    [
        (["nowhere", "--to", "cycles"], "no such scene; expected a file, balls, "),
        (["prism", "--to", "blender"], "expected cycles, luxcore, radiance"),
        (["prism", "--to", "povray"], "a diffuse surface"),
        (["prism", "--to", "cycles", "-o", "no/where"], "not a folder"),
        (["prism", "--to", "cycles", "-o", "full"], "already contains files"),
        (["prism", "--to", "cycles", "-D", "nothing=1"], "nothing"),
        (["prism", "--to", "cycles", "--level", "20"], "expected a whole number from 0 to 8"),
        (["prism"], "--to"),
        (["full/scene.xml", "--to", "cycles"], "full/scene.xml"),
    ],
)
def test_refused_in_one_line(words, says, export, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "scene.xml").write_text("<scene version='3.0.0'><bsdf type='hair'/></scene")
    before = sorted(tmp_path.rglob("*"))
    code, out, err = export(*words)
    assert (code, out) == (2, "") and says in err
    assert err.startswith("mi-refract: ") and err.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before

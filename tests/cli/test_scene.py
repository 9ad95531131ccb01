"""`mi-refract scene list` and `export`: output, files and errors, in this checkout and from built packages."""

import os
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest
from support.processes import assert_refused

import mi_refract
from mi_refract.cli import app

SCENES = Path(app.__file__).parents[2] / "scenes"


@pytest.fixture
def export(tmp_path, monkeypatch, run):
    """`export("prism", …)`: exit code, stdout and stderr of `mi-refract scene export …`, run in an empty folder."""
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
    "words, message",
    [
        (["nowhere", "--to", "cycles"], "no such scene; expected a file, balls, "),
        (["prism", "--to", "blender"], "expected cycles, luxcore, radiance"),
        (["prism", "--to", "povray"], "a diffuse surface"),
        (["furnace", "--to", "gltf", "--level", "0"], "mantle_core: media of 1.5168 and 2.419 touch; expected"),
        (["rainbow_drop", "--to", "luxcore"], "drop: int_ior = MATERIAL:water; expected one number"),
        (["prism", "--to", "cycles", "-o", "no/where"], "not a folder"),
        (["prism", "--to", "cycles", "-o", "full"], "already contains files"),
        (["prism", "--to", "cycles", "-D", "nothing=1"], "nothing"),
        (["prism", "--to", "cycles", "-D", "config=1"], "define 'config': reserved by Mitsuba's parser; expected"),
        (["prism", "--to", "cycles", "--level", "20"], "expected a whole number from 0 to 8"),
        (["prism"], "--to"),
        (["full/scene.xml", "--to", "cycles"], "full/scene.xml"),
    ],
)
def test_errors_are_one_line(words, message, export, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "scene.xml").write_text("<scene version='3.0.0'><bsdf type='hair'/></scene")
    before = sorted(tmp_path.rglob("*"))
    assert_refused(export(*words), message)
    assert sorted(tmp_path.rglob("*")) == before


def test_scenes_are_listed_with_their_titles(run):
    code, out, err = run("scene", "list")
    lines = out.splitlines()
    assert (code, err, lines[0]) == (0, "", f"in {SCENES}:")
    names = {x.stem for x in SCENES.glob("*.xml")} | {f"planar/{x.name}" for x in SCENES.glob("planar/*.toml")}
    assert {line.split()[0] for line in lines[1:]} == names
    assert any(line.split(None, 1) == ["sphere", "A glass ball on a checkerboard"] for line in lines)
    assert all(len(line.split(None, 1)) == 2 for line in lines)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The wheel and the sdist built from this checkout."""
    build, folder = pytest.importorskip("hatchling.build"), tmp_path_factory.mktemp("dist")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(SCENES.parent)
        return {"wheel": folder / build.build_wheel(str(folder)), "sdist": folder / build.build_sdist(str(folder))}


@pytest.mark.parametrize("kind", ["wheel", "sdist"])
def test_the_installed_package_has_scenes_and_glasses_and_runs(kind, built, tmp_path):
    """It has all files of the package, and the scenes without their images."""
    pytest.importorskip("pip")
    root, target = SCENES.parent, tmp_path / "target"
    flags = ["--quiet", "--no-deps", "--no-index", "--no-build-isolation", "--no-compile"]
    pip = [sys.executable, "-m", "pip", "install", *flags, "--target", target, built[kind]]
    subprocess.run(pip, check=True, timeout=120)
    package = {str(x.relative_to(root)) for x in (root / "mi_refract").rglob("*.*") if "__pycache__" not in x.parts}
    scenes = {f"mi_refract/{x.relative_to(root)}" for kind in ("xml", "toml", "ply") for x in SCENES.rglob(f"*.{kind}")}
    assert {"mi_refract/py.typed", "mi_refract/media/glasses.json", "mi_refract/report/templates/diff.js"} <= package
    assert package | scenes <= {str(path.relative_to(target)) for path in target.rglob("*.*")}
    assert sum(path.stat().st_size for path in (target / "mi_refract" / "scenes").rglob("*.*")) < 300_000
    assert not {"tests", "validation", "scenes"} & {path.name for path in target.iterdir()}
    installed = {"cwd": tmp_path, "env": os.environ | {"PYTHONPATH": str(target)}}
    command = [target / "bin" / "mi-refract", "scene", "export", "sphere", "--to", "mitsuba", "--level", "0"]
    subprocess.run(command, check=True, **installed)
    assert (tmp_path / "sphere-mitsuba" / "scene.xml").is_file()
    code = "from importlib import metadata; import mi_refract as m; print(m.__file__, m.__version__); "
    code += "print(metadata.version('mi-refract'))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, **installed).stdout
    assert out.split() == [str(target / "mi_refract/__init__.py"), mi_refract.__version__, mi_refract.__version__]


def test_the_sdist_has_all_files(built):
    with tarfile.open(built["sdist"]) as sdist:
        names = {name.partition("/")[2] for name in sdist.getnames()}
    root, folders = SCENES.parent, ("mi_refract", "scenes", "tests", "validation", ".ci", ".github")
    files = {str(x.relative_to(root)) for folder in folders for x in (root / folder).rglob("*") if x.is_file()}
    assert {name for name in files if "__pycache__" not in name} <= names

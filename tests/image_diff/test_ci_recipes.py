"""The action for GitHub, and the README's recipes for GitHub, GitLab and CTest: run as they are printed."""

from __future__ import annotations

import json
import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.actions_runner import BASH, Job, read_yaml, run_action
from support.diff_images import image
from support.processes import ENVIRONMENT
from support.readme import blocks

from mi_refract import image_diff

ROOT = Path(__file__).parents[2]
ACTION = ROOT / ".github" / "actions" / "diff"
README = Path(image_diff.__file__).with_name("README.md")
FILES = ["diff.json", "junit.xml", "report.html"]

pytestmark = pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")

# Stands for an interpreter: what it installs is noted, and what it runs is this checkout.
PYTHON = """#!/bin/bash
case "$1 $2" in
  "-m venv") mkdir -p "$3/bin"; cp "$0" "$3/bin/python"; cp "{programs}/mi-refract" "$3/bin/" ;;
  "-m pip") printf '%s\\n' "${{@:3}}" >>"{programs}/installed" ;;
  *) exec "{python}" "$@" ;;
esac
"""


def program(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o755)


@pytest.fixture
def programs(tmp_path):
    """A folder for PATH: `python3` and `pip` that install nothing, and `mi-refract`."""
    folder = tmp_path / "programs"
    folder.mkdir()
    program(folder / "python3", PYTHON.format(programs=folder, python=sys.executable))
    program(folder / "pip", f'#!/bin/bash\nprintf "%s\\n" "$@" >>"{folder}/installed"\n')
    program(folder / "mi-refract", f'#!/bin/bash\nexec "{sys.executable}" -m mi_refract.cli "$@"\n')
    return folder


@pytest.fixture
def environment(programs):
    return ENVIRONMENT | {"PATH": f"{programs}:{os.environ['PATH']}"}


@pytest.fixture
def project(tmp_path):
    """A repository: references, and a program that renders an image that is equal, and one with another gain."""
    folder = tmp_path / "project"
    for name in ("equal.exr", "inner/other.exr"):
        image(folder / "references" / name)
    image(tmp_path / "equal.exr")
    set_gain(folder, 1.0)
    return folder


def set_gain(project: Path, gain: float) -> None:
    """What `render_all` will render."""
    rendered = project.parent / "rendered"
    for name, factor in (("equal.exr", 1.0), ("inner/other.exr", gain)):
        image(rendered / name, gain=factor)
    program(project / "render_all", f'#!/bin/bash\nmkdir -p "$1" && cp -r "{rendered}"/* "$1"\n')


@pytest.fixture
def act(project, environment, tmp_path):
    """`act(gain, references=…, test=…)`: the action in a job of that project, after rendering."""

    def run(gain: float = 1.0, **inputs: str) -> Job:
        set_gain(project, gain)
        subprocess.run(["./render_all", "new/"], cwd=project, check=True)
        temporary = tmp_path / "temporary"
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir()
        return run_action(
            ACTION, {"references": "references/", "test": "new/"} | inputs, project, temporary, **environment
        )

    return run


# GitHub -----------------------------------------------------------------------------------------------------------


def test_equal_images_pass_and_leave_a_report(act, programs):
    job = act()
    assert (job.code, job.annotations) == (0, [])
    assert job.outputs == {
        "exit-code": "0",
        "verdict": "equal",
        "report": "https://github.test/artifacts/mi-refract-diff",
    }
    assert job.artifacts == {"mi-refract-diff": FILES}
    assert "### mi-refract diff: 2 images: 2 equal" in job.summary
    assert f"[Report and new images]({job.outputs['report']})" in job.summary
    installed = (programs / "installed").read_text().split("\n")
    assert installed[-2].endswith("/.github/actions/diff/../../..[diff]")


def test_a_different_image_is_uploaded_annotated_and_then_fails_the_job(act, project):
    job = act(1.1)
    assert (job.code, job.outputs["verdict"]) == (1, "different")
    assert job.artifacts == {"mi-refract-diff": sorted([*FILES, "new/inner/other.exr"])}
    (line,) = job.annotations
    assert line.startswith("::error file=new/inner/other.exr,title=inner/other.exr%3A different::")
    assert "| different | inner&#47;other.exr |" in job.summary
    (folder,) = job.folder.glob("mi-refract-diff.*")
    assert (folder / "new/inner/other.exr").read_bytes() == (project / "new/inner/other.exr").read_bytes()


def test_new_images_of_an_artifact_are_accepted_as_the_readme_says(act, project, environment):
    (folder,) = act(1.1).folder.glob("mi-refract-diff.*")
    (command,) = re.findall(r"`(mi-refract accept .*?)`", README.read_text("utf-8").partition("## In CI")[2])
    words = command.replace("ARTIFACT", str(folder)).split()
    subprocess.run([*words, "--yes"], cwd=project, env=environment, check=True, capture_output=True)
    assert act(1.1).code == 0


def test_what_cannot_be_compared_is_an_error_with_a_report(act, project):
    (project / "references" / "equal.exr").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\n")
    job = act()
    assert (job.code, job.outputs["verdict"]) == (2, "error")
    assert job.artifacts["mi-refract-diff"] == sorted([*FILES, "new/equal.exr"])
    assert "a Git LFS pointer, not the image; run `git lfs pull`" in job.annotations[0]


def test_an_inconclusive_image_fails_the_job_unless_it_is_to_pass(act):
    blind = "--method=tolerance\n--set=fail=9\n"
    job = act(1.1, options=blind)
    assert (job.code, job.outputs["verdict"]) == (3, "inconclusive")
    job = act(1.1, options=f"{blind}--inconclusive=pass")
    assert (job.code, job.outputs["verdict"]) == (0, "equal")


@pytest.mark.parametrize(
    "inputs",
    [{"references": "none/"}, {"settings": "none.toml"}, {"options": "--nonesuch"}, {"options": "--methods"}],
    ids=["no references", "no settings", "unknown option", "an option that compares nothing"],
)
def test_where_nothing_was_compared_the_job_fails_and_says_so(act, inputs):
    job = act(**inputs)
    assert (job.code, job.outputs["verdict"], job.outputs["report"]) == (2, "error", "")
    assert job.annotations == ["::error title=mi-refract diff::nothing was compared; the log of this step says why"]
    assert "### mi-refract diff: nothing was compared" in job.summary


def test_settings_and_options_arrive(act, project):
    (project / "some.toml").write_text('[[image]]\nname = "inner/*"\nmethod = "tolerance"\nfail = 0.2\nreason = "r"\n')
    assert act(1.1, settings="some.toml").code == 0
    assert act(1.1, options="--method=tolerance\n\n--set=fail=0.2\n").code == 0


@pytest.mark.parametrize("name", ["references", "test", "settings", "options", "artifact"])
def test_no_input_is_a_command(act, project, name):
    """Nor an option, where a path is expected."""
    job = act(**{name: '"; touch planted; $(touch planted) `touch planted` #'})
    assert not list(project.rglob("planted"))
    assert (job.code == 0) is (name == "artifact")
    for word in ("--methods", "--version"):
        if name in ("references", "test", "settings"):
            job = act(**{name: word})
            assert job.code == 2
            assert re.search(f"mi-refract: {word}: no such", job.log, re.IGNORECASE)


def test_names_that_github_refuses_and_hostile_ones_are_left_out(tmp_path, capsys):
    files = runpy.run_path(str(ACTION / "new_images.py"))
    (tmp_path / "a.exr").write_text("a")
    names = ["b.exr", "in/c.exr", 'quoted".exr', "../../out.exr", "gone.exr"]
    paths = {name: str(tmp_path / "a.exr") for name in names} | {"gone.exr": str(tmp_path / "gone")}
    results = [{"name": name, "status": "different", "test": path} for name, path in paths.items()]
    results += [{"name": "equal.exr", "status": "equal", "test": paths["b.exr"]}]
    results += [{"name": "removed.exr", "status": "different", "test": None}]
    (tmp_path / "diff.json").write_text(json.dumps({"results": results}))
    files["main"](str(tmp_path / "diff.json"), str(tmp_path / "far" / "new"))
    new = tmp_path / "far" / "new"
    assert sorted(path.relative_to(tmp_path / "far") for path in (tmp_path / "far").rglob("*.exr")) == [
        Path("new/b.exr"),
        Path("new/in/c.exr"),
    ]
    assert new.is_dir()
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(": left out")[0] for line in lines] == [f"new_images.py: {name!r}" for name in names[2:]]


def test_the_action_is_one_that_a_runner_can_trust():
    """Other actions have a version, no expression stands in a script, and every step names its shell."""
    text = (ACTION / "action.yml").read_text("utf-8")
    action = read_yaml(text)
    for step in action["runs"]["steps"]:
        assert "${{" not in step.get("run", "")
        assert re.fullmatch(r"[\w-]+/[\w-]+@v\d+", step["uses"]) if "uses" in step else step["shell"] == "bash"
    expressions = set(re.findall(r"\$\{\{ (\w+)\.([\w-]+)", text))
    steps = {step.get("id") for step in action["runs"]["steps"]}
    for kind, name in expressions:
        assert name in {"inputs": action["inputs"], "steps": steps}[kind]
    assert {name for kind, name in expressions if kind == "inputs"} == set(action["inputs"])


def test_the_readme_names_every_input_and_output():
    section = README.read_text("utf-8").partition("## In CI")[2].partition("\n## ")[0]
    action = read_yaml((ACTION / "action.yml").read_text("utf-8"))
    assert not [name for name in (*action["inputs"], *action["outputs"]) if f"`{name}`" not in section]


def test_the_workflow_of_the_readme(act, project):
    steps = read_yaml(blocks(README, "yaml")[0])["jobs"]["images"]["steps"]
    assert [step for step in steps if "run" in step] == [{"run": "./render_all new/"}]
    last = steps[-1]
    assert re.fullmatch(r"OWNER/mi_refract/(.*)@\w+", last["uses"])[1] == str(ACTION.relative_to(ROOT))
    assert act(1.001, **last["with"]).code == 0
    assert act(1.1, **last["with"]).code == 1


def test_the_job_of_this_project_that_uses_the_action(environment, tmp_path):
    text = (ROOT / ".github" / "workflows" / "ci.yml").read_text("utf-8")
    prepare, use = read_yaml(text)["jobs"]["action"]["steps"][1:]
    assert ROOT / use["uses"] == ACTION
    (workspace := tmp_path / "workspace").mkdir()
    subprocess.run([*BASH, "-c", prepare["run"]], cwd=workspace, check=True)
    job = run_action(ACTION, use["with"], workspace, tmp_path, **environment)
    assert (job.code, job.outputs["verdict"]) == (0, "equal")


# GitLab -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("gain", "code"), [(1.0, 0), (1.1, 1), (np.nan, 1)])
def test_the_gitlab_job_of_the_readme(project, environment, programs, gain, code):
    job = read_yaml(blocks(README, "yaml")[1])["images"]
    set_gain(project, gain)
    done = subprocess.run(
        [*BASH, "-c", "\n".join(job["script"])],
        cwd=project,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert (done.returncode, done.stderr) == (code, "")
    assert (programs / "installed").read_text() == "install\nmi-refract[diff]\n"
    kept = [*job["artifacts"]["paths"], job["artifacts"]["reports"]["junit"]]
    assert job["artifacts"]["when"] == "always"
    assert all((project / path).exists() for path in kept)
    assert sorted(path.name for path in (project / "diff").iterdir()) == FILES
    assert job["allow_failure"]["exit_codes"] == ["3"]


# CTest ------------------------------------------------------------------------------------------------------------


@pytest.mark.skipif(shutil.which("ctest") is None, reason="no ctest (apt-get install cmake, or pip install cmake)")
@pytest.mark.parametrize(
    ("render", "failed"), [(1.0, []), (1.1, ["images"]), (None, ["render", "images"])], ids=["equal", "louder", "none"]
)
def test_the_ctest_of_the_readme(project, environment, tmp_path, render, failed):
    (text,) = blocks(README, "cmake")
    (project / "CMakeLists.txt").write_text(
        f"cmake_minimum_required(VERSION 3.18)\nproject(p NONE)\nenable_testing()\n{text}"
    )
    if render is None:
        program(project / "render_all", "#!/bin/bash\nexit 1\n")
    else:
        set_gain(project, render)
    build = tmp_path / "build"

    def call(*words: object) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*map(str, words)], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
        )

    assert call("cmake", "-S", project, "-B", build).returncode == 0
    done = call("ctest", "--test-dir", build, "--output-on-failure")
    assert re.findall(r"^\t *\d+ - (\w+) \(", done.stdout, re.MULTILINE) == failed, done.stdout
    assert done.returncode == (8 if failed else 0)
    assert ("images (Not Run)" in done.stdout) is (render is None)
    assert ("different  inner/other.exr" in done.stdout) is (render == 1.1)
    assert (build / "images.html").exists() is (render is not None)

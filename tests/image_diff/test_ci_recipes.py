"""The action for GitHub, and the documented recipes for GitHub, GitLab and CTest, run as they are printed."""

from __future__ import annotations

import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from support.diff_images import image
from support.processes import ENVIRONMENT, executable
from support.readme import DOCS, ROOT, blocks

ACTION = ROOT / ".github" / "actions" / "diff"
PAGE = DOCS / "how-to" / "compare-images-in-ci.md"
LIST = str((ACTION / "requirements.txt").relative_to(ROOT))
FILES = ["diff.json", "junit.xml", "report.html"]
BASH = ["bash", "--noprofile", "--norc", "-e", "-o", "pipefail"]  # `shell: bash` on a runner

pytestmark = pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")

# A replacement for the interpreter, which records what it should install, and runs this checkout.
PYTHON = """#!/bin/bash
case "$1 $2" in
  "-m venv") mkdir -p "$3/bin"; cp "$0" "$3/bin/python"; cp "{programs}/mi-refract" "$3/bin/" ;;
  "-m pip") printf '%s\\n' "${{@:3}}" >>"{programs}/installed" ;;
  *) exec "{python}" "$@" ;;
esac
"""


def read_yaml(text):
    """The document, with text for every scalar, as in GitHub's expressions."""
    return yaml.load(text, yaml.BaseLoader)


def expanded(text, values):
    """The text with each ${{ name }} replaced, by an empty text if it has no value, as on a runner."""
    return re.sub(r"\$\{\{ *([\w.-]+) *\}\}", lambda match: values.get(match[1], ""), text)


def call(words, folder, environment):
    run = subprocess.run([*map(str, words)], cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    return run.returncode, run.stdout, run.stderr


def run_action(inputs, workspace, temporary, environment):
    """Run the steps of the action in bash, as a runner does, without GitHub; uploads only list the files."""
    action = read_yaml((ACTION / "action.yml").read_text("utf-8"))
    assert inputs.keys() <= action["inputs"].keys()
    values = {f"inputs.{name}": inputs.get(name, spec.get("default", "")) for name, spec in action["inputs"].items()}
    files = {name: temporary / name.lower() for name in ("GITHUB_OUTPUT", "GITHUB_STEP_SUMMARY")}
    environment = environment | {name: str(path) for name, path in files.items()}
    environment |= {"GITHUB_ACTION_PATH": str(ACTION), "RUNNER_TEMP": str(temporary), "CI": "true"}
    job, script = SimpleNamespace(code=0, log="", artifacts={}), temporary / "step.sh"
    for step in action["runs"]["steps"]:
        files["GITHUB_OUTPUT"].write_text("")
        arguments = {name: expanded(text, values) for name, text in (step.get("env") or step.get("with") or {}).items()}
        if "uses" in step:
            root, name = Path(arguments["path"]), arguments["name"]
            job.artifacts[name] = sorted(str(path.relative_to(root)) for path in root.rglob("*") if path.is_file())
            outputs = {"artifact-url": f"https://github.test/artifacts/{name}"} if any(root.iterdir()) else {}
        else:
            script.write_text(step["run"])
            job.code, out, err = call([*BASH, script], workspace, environment | arguments)
            job.log += out + err
            outputs = dict(line.partition("=")[::2] for line in files["GITHUB_OUTPUT"].read_text().splitlines())
        values |= {f"steps.{step['id']}.outputs.{name}": value for name, value in outputs.items() if "id" in step}
        if job.code:
            break
    job.outputs = {name: expanded(spec["value"], values) for name, spec in action["outputs"].items()}
    job.summary = files["GITHUB_STEP_SUMMARY"].read_text("utf-8")
    job.annotations = [line for line in job.log.splitlines() if re.match("::(error|warning|notice) ", line)]
    (job.folder,) = temporary.glob("mi-refract-diff.*")
    return job


@pytest.fixture
def programs(tmp_path):
    """A folder for PATH: `python3` and `pip` that install nothing, and `mi-refract`."""
    folder = tmp_path / "programs"
    folder.mkdir()
    executable(folder / "python3", PYTHON.format(programs=folder, python=sys.executable))
    executable(folder / "pip", f'#!/bin/bash\nprintf "%s\\n" "$@" >>"{folder}/installed"\n')
    executable(folder / "mi-refract", f'#!/bin/bash\nexec "{sys.executable}" -m mi_refract.cli "$@"\n')
    return folder


@pytest.fixture
def environment(programs):
    return ENVIRONMENT | {"PATH": f"{programs}:{os.environ['PATH']}"}


@pytest.fixture
def project(tmp_path):
    """A repository with references, and a program that renders an equal image and one with another gain."""
    folder = tmp_path / "project"
    for name in ("ball.exr", "inner/other.exr"):
        image(folder / "references" / name)
    set_gain(folder, 1.0)
    return folder


def set_gain(project, gain):
    """Write the program `render_all`, which renders one image with this gain."""
    rendered = project.parent / "rendered"
    for name, factor in (("ball.exr", 1.0), ("inner/other.exr", gain)):
        image(rendered / name, gain=factor)
    executable(project / "render_all", f'#!/bin/bash\nmkdir -p "$1" && cp -r "{rendered}"/* "$1"\n')


@pytest.fixture
def act(project, environment, tmp_path):
    """`act(gain, references=…, test=…)`: render, and run the action in a job of that project."""

    def run(gain=1.0, **inputs):
        set_gain(project, gain)
        subprocess.run(["./render_all", "new/"], cwd=project, check=True)
        temporary = tmp_path / "temporary"
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir()
        return run_action({"references": "references/", "test": "new/"} | inputs, project, temporary, environment)

    return run


# GitHub -----------------------------------------------------------------------------------------------------------

BLIND = "--method=tolerance\n\n--set=fail=9\n"
NOTHING = "::error title=mi-refract diff::nothing was compared; the log of this step says why"


@pytest.mark.parametrize(
    ("gain", "inputs", "code", "verdict"),
    [
        (1.0, {}, 0, "equal"),
        (1.1, {}, 1, "different"),
        (1.1, {"options": BLIND}, 3, "inconclusive"),
        (1.1, {"options": f"{BLIND}--inconclusive=pass"}, 0, "equal"),
        (1.1, {"settings": "some.toml"}, 0, "equal"),
        (1.1, {"references": "none/"}, 2, "error"),
        (1.1, {"options": "--methods"}, 2, "error"),  # compares nothing
    ],
)
def test_the_action_returns_the_verdict_and_uploads_results(act, project, programs, gain, inputs, code, verdict):
    (project / "some.toml").write_text('[[image]]\nname = "inner/*"\nmethod = "tolerance"\nfail = 0.2\nreason = "r"\n')
    job = act(gain, **inputs)
    assert (job.code, job.outputs["exit-code"], job.outputs["verdict"]) == (code, str(code), verdict)
    if code == 2:
        assert (job.outputs["report"], job.annotations) == ("", [NOTHING])
        assert "### mi-refract diff: nothing was compared" in job.summary
        return
    equal = code == 0 and "options" not in inputs  # with options, the image is inconclusive
    assert job.artifacts == {"mi-refract-diff": FILES if equal else sorted([*FILES, "new/inner/other.exr"])}
    assert job.outputs["report"] == "https://github.test/artifacts/mi-refract-diff"
    assert "### mi-refract diff: 2 images: " in job.summary
    assert f"[Report and new images]({job.outputs['report']})" in job.summary
    assert len(job.annotations) == (not equal)
    if code == 1:
        assert job.annotations[0].startswith("::error file=new/inner/other.exr,title=inner/other.exr%3A different::")
        assert "| different | inner&#47;other.exr |" in job.summary
    words = (programs / "installed").read_text().split()
    assert words[-4:] == ["--no-deps", "-r", str(ACTION / "requirements.txt"), f"{ACTION}/../../.."]


def test_the_commands_of_the_documentation_create_and_accept_references(act, project, programs, environment):
    """And a reference that cannot be read is an error of the action."""
    install, make, accept = blocks(PAGE, "bash")
    shutil.rmtree(project / "references")
    assert call([*BASH, "-c", install + make], project, environment)[0] == 0
    *_, address, package = (programs / "installed").read_text().split()
    assert address.endswith(f"/{LIST}") and package == "mi-refract"
    folder = act(1.1).folder
    assert call([*accept.replace("ARTIFACT", str(folder)).split(), "--yes"], project, environment)[0] == 0
    accepted, new = ((project / side / "inner" / "other.exr").read_bytes() for side in ("references", "new"))
    assert accepted == new
    (project / "references" / "ball.exr").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\n")
    job = act(1.1)
    assert (job.code, job.outputs["verdict"]) == (2, "error")
    assert job.artifacts["mi-refract-diff"] == sorted([*FILES, "new/ball.exr"])
    assert "a Git LFS pointer, not the image; run `git lfs pull`" in job.annotations[0]


@pytest.mark.parametrize(("names", "code"), [(("references", "test", "settings", "options"), 2), (("artifact",), 0)])
def test_inputs_are_not_executed(act, project, names, code):
    job = act(**dict.fromkeys(names, '"; touch planted; $(touch planted) `touch planted` #'))
    assert (job.code, list(project.rglob("planted"))) == (code, [])


@pytest.mark.parametrize(
    ("name", "word"), [("references", "--methods"), ("test", "--version"), ("settings", "--methods")]
)
def test_paths_are_not_options(act, name, word):
    job = act(**{name: word})
    assert job.code == 2
    assert re.search(f"mi-refract: {word}: no such", job.log, re.IGNORECASE)


def test_invalid_and_hostile_names_are_not_uploaded(tmp_path, capsys):
    files, new = runpy.run_path(str(ACTION / "new_images.py")), tmp_path / "far" / "new"
    (tmp_path / "a.exr").write_text("a")
    names = ["b.exr", "in/c.exr", 'quoted".exr', "../../out.exr", "gone.exr"]
    paths = {name: str(tmp_path / "a.exr") for name in names} | {"gone.exr": str(tmp_path / "gone")}
    results = [{"name": name, "status": "different", "test": path} for name, path in paths.items()]
    results += [{"name": "ball.exr", "status": "equal", "test": paths["b.exr"]}]
    results += [{"name": "removed.exr", "status": "different", "test": None}]
    (tmp_path / "diff.json").write_text(json.dumps({"results": results}))
    files["main"](str(tmp_path / "diff.json"), str(new))
    assert sorted((tmp_path / "far").rglob("*.exr")) == [new / "b.exr", new / "in/c.exr"]
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(": left out")[0] for line in lines] == [f"new_images.py: {name!r}" for name in names[2:]]


def test_the_action_is_safe_and_its_inputs_and_outputs_are_documented():
    """Other actions are used with a version, scripts contain no expressions, and every step names its shell."""
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
    assert not [name for name in (*action["inputs"], *action["outputs"]) if f"`{name}`" not in PAGE.read_text("utf-8")]


def test_the_documented_workflow_and_the_job_of_this_project_work(act, environment, tmp_path):
    steps = read_yaml(blocks(PAGE, "yaml")[0])["jobs"]["images"]["steps"]
    assert [step for step in steps if "run" in step] == [{"run": "./render_all new/"}]
    last = steps[-1]
    source = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["urls"]["Source"]
    assert last["uses"] == f"{source.removeprefix('https://github.com/')}/{ACTION.relative_to(ROOT)}@main"
    assert act(1.001, **last["with"]).code == 0
    assert act(1.1, **last["with"]).code == 1
    text = (ROOT / ".github" / "workflows" / "ci.yml").read_text("utf-8")
    prepare, use = read_yaml(text)["jobs"]["action"]["steps"][1:]
    assert ROOT / use["uses"] == ACTION
    (workspace := tmp_path / "workspace").mkdir()
    subprocess.run([*BASH, "-c", prepare["run"]], cwd=workspace, check=True)
    job = run_action(use["with"], workspace, workspace, environment)
    assert (job.code, job.outputs["verdict"]) == (0, "equal")


# GitLab and CTest -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("gain", "code"), [(1.0, 0), (1.1, 1), (np.nan, 1)])
def test_the_documented_gitlab_job_works(project, environment, programs, gain, code):
    job = read_yaml(blocks(PAGE, "yaml")[1])["images"]
    set_gain(project, gain)
    returned, _, err = call([*BASH, "-c", "\n".join(job["script"])], project, environment)
    assert (returned, err) == (code, "")
    assert (programs / "installed").read_text().split()[-2].endswith(f"/{LIST}")
    artifacts = [*job["artifacts"]["paths"], job["artifacts"]["reports"]["junit"]]
    assert job["artifacts"]["when"] == "always"
    assert all((project / path).exists() for path in artifacts)
    assert sorted(path.name for path in (project / "diff").iterdir()) == FILES
    assert job["allow_failure"]["exit_codes"] == ["3"]


@pytest.mark.skipif(shutil.which("ctest") is None, reason="no ctest (apt-get install cmake, or pip install cmake)")
@pytest.mark.parametrize(
    ("render", "failed"), [(1.0, []), (1.1, ["images"]), (None, ["render", "images"])], ids=["equal", "louder", "none"]
)
def test_the_documented_ctest_works(project, environment, tmp_path, render, failed):
    (text,) = blocks(PAGE, "cmake")
    head = "cmake_minimum_required(VERSION 3.18)\nproject(p NONE)\nenable_testing()\n"
    (project / "CMakeLists.txt").write_text(head + text)
    if render is None:
        executable(project / "render_all", "#!/bin/bash\nexit 1\n")
    else:
        set_gain(project, render)
    build = tmp_path / "build"
    assert call(["cmake", "-S", project, "-B", build], tmp_path, environment)[0] == 0
    code, out, _ = call(["ctest", "--test-dir", build, "--output-on-failure"], tmp_path, environment)
    assert re.findall(r"^\t *\d+ - (\w+) \(", out, re.MULTILINE) == failed, out
    assert code == (8 if failed else 0)
    assert ("images (Not Run)" in out) is (render is None)
    assert ("different  inner/other.exr" in out) is (render == 1.1)
    assert (build / "images.html").exists() is (render is not None)

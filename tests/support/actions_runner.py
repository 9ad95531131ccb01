"""A composite action of GitHub's, run here: its steps in bash, as a runner does it, without GitHub."""

from __future__ import annotations

import os
import re
import subprocess
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

BASH = ["bash", "--noprofile", "--norc", "-e", "-o", "pipefail"]  # what `shell: bash` is on a runner


def read_yaml(text: str) -> Any:
    """The document; every scalar is a text, as GitHub's expressions see it."""
    return yaml.load(text, yaml.BaseLoader)


@dataclass
class Job:
    """What a job shows after the action has run."""

    code: int = 0
    log: str = ""
    outputs: dict[str, str] = field(default_factory=dict)
    summary: str = ""
    artifacts: dict[str, list[str]] = field(default_factory=dict)  # paths within, by name
    folder: Path = Path()

    @property
    def annotations(self) -> list[str]:
        """The lines of the log that GitHub shows beside the code."""
        return [line for line in self.log.splitlines() if re.match("::(error|warning|notice) ", line)]


def run_action(folder: Path, inputs: dict[str, str], workspace: Path, temporary: Path, **environment: str) -> Job:
    """Run the action in `folder` with these inputs, and no others; uploading lists the files.

    ValueError for an input that the action does not have, or one that is required and missing.
    """
    action = read_yaml((folder / "action.yml").read_text("utf-8"))
    declared = action["inputs"]
    if unknown := inputs.keys() - declared.keys():
        raise ValueError(f"inputs {sorted(unknown)}; expected {', '.join(declared)}")
    if missing := {name for name, each in declared.items() if each.get("required") == "true"} - inputs.keys():
        raise ValueError(f"inputs {sorted(missing)}: missing")
    values = {f"inputs.{name}": inputs.get(name, each.get("default", "")) for name, each in declared.items()}
    files = {name: temporary / name.lower() for name in ("GITHUB_OUTPUT", "GITHUB_STEP_SUMMARY")}
    base = os.environ | environment | {"GITHUB_ACTION_PATH": str(folder), "RUNNER_TEMP": str(temporary)}
    base |= {name: str(path) for name, path in files.items()} | {"GITHUB_WORKSPACE": str(workspace), "CI": "true"}
    job = Job(folder=temporary)
    for step in action["runs"]["steps"]:
        for path in files.values():
            path.touch()
        given = {name: expanded(text, values) for name, text in (step.get("env") or step.get("with") or {}).items()}
        if "uses" in step:
            written = _upload(job, given)
        else:
            written = _run(job, step, base | given, workspace, files["GITHUB_OUTPUT"])
        values |= {f"steps.{step['id']}.outputs.{name}": value for name, value in written.items() if "id" in step}
        if job.code:
            break
    job.outputs = {name: expanded(each["value"], values) for name, each in action["outputs"].items()}
    job.summary = files["GITHUB_STEP_SUMMARY"].read_text("utf-8")
    return job


def expanded(text: str, values: dict[str, str]) -> str:
    """The text with each ${{ name }} replaced; what has no value is empty, as on a runner."""
    return re.sub(r"\$\{\{ *([\w.-]+) *\}\}", lambda match: values.get(match[1], ""), text)


def _run(job: Job, step: dict[str, Any], environment: dict[str, str], workspace: Path, output: Path) -> dict[str, str]:
    script = job.folder / "step.sh"
    script.write_text(step["run"])
    output.write_text("")
    done = subprocess.run(
        [*BASH, str(script)], cwd=workspace, env=environment, capture_output=True, text=True, timeout=300
    )
    job.code, job.log = done.returncode, job.log + done.stdout + done.stderr
    return dict(line.partition("=")[::2] for line in output.read_text("utf-8").splitlines())


def _upload(job: Job, given: dict[str, str]) -> dict[str, str]:
    root = Path(given["path"])
    job.artifacts[given["name"]] = sorted(str(path.relative_to(root)) for path in root.rglob("*") if path.is_file())
    return {"artifact-url": f"https://github.test/artifacts/{given['name']}"} if any(root.iterdir()) else {}

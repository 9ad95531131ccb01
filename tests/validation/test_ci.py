"""CI fails if too few cases passed, without libLLVM, and after a failed installation."""

import os
import re
import runpy
import shutil
import subprocess
import tomllib

import pytest
import yaml
from support.processes import ROOT, executable

MINIMUM = runpy.run_path(str(ROOT / ".ci" / "minimum"))["main"]
REPORT = """<testsuites><testsuite><testcase name="a"/><testcase name="b"><properties/></testcase>
<testcase name="c"><skipped/></testcase><testcase name="d"><failure/></testcase><testcase name="e"><error/></testcase>
</testsuite></testsuites>"""


def test_only_passed_cases_count_and_unreadable_reports_fail(tmp_path, capsys):
    report = tmp_path / "report.xml"
    for text, least, code in (
        *((REPORT, least, code) for least, code in (("1", 0), ("2", 0), ("3", 1), ("many", 2))),
        *((text, "0", 2) for text in ("", "<testsuites>", "\x00")),
    ):
        report.write_text(text)
        assert MINIMUM([str(report), least]) == code
    assert MINIMUM([]) == MINIMUM([str(tmp_path / "none.xml"), "0"]) == 2
    assert "expected FILE.xml CASES" in capsys.readouterr().err


def test_ci_stops_at_the_first_failure_and_counts_every_run():
    text = (ROOT / ".ci" / "run").read_text()
    assert "set -eu" in text
    steps = [line for line in text.splitlines() if not line.startswith(("#", "[", "  #"))]
    assert not [line for line in steps if "||" in line or "|| true" in line]
    assert text.count(".ci/minimum") == text.count("--junitxml") + text.count("-m validation --out") + 1
    assert "MI_REFRACT_NEEDS_LLVM=1" in text
    assert "bash .ci/run" in (ROOT / ".github" / "workflows" / "ci.yml").read_text()


def test_the_address_of_the_repository_is_the_same_everywhere():
    urls = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["urls"]
    files = [ROOT / "CITATION.cff", *(x for x in (ROOT / ".github").glob("**/*.*") if x.suffix in (".md", ".yml"))]
    pattern = r"https://github\.com/mi[-_]refract/[\w-]+"
    assert {url for path in files for url in re.findall(pattern, path.read_text())} == {urls["Source"]}
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert (citation["repository-code"], citation["url"]) == (urls["Source"], urls["Documentation"])
    assert "version" not in citation  # it is in the package only


def test_issue_templates_have_names_descriptions_and_labels():
    for path in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("[!c]*.yml"):
        template = yaml.safe_load(path.read_text())
        assert {"name", "description", "body"} <= {*template} and all(
            x["attributes"]["label"] for x in template["body"]
        )


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
@pytest.mark.parametrize("apt", ["fails", "absent"])
def test_setup_fails_if_llvm_is_required_but_missing(apt, tmp_path):
    """Runs a copy of the script, so that no .venv is changed."""
    (tmp_path / ".ci").mkdir()
    shutil.copy(ROOT / ".ci" / "setup", tmp_path / ".ci" / "setup")
    stubs = {"ldconfig": "exit 0", "sudo": "exit 1", "timeout": 'shift; "$@"', "env": 'shift; "$@"'}
    stubs |= {"apt-get": "exit 100"} if apt == "fails" else {"id": "echo 1"}
    for name, body in stubs.items():
        executable(tmp_path / name, f"#!/bin/bash\n{body}\n")
    environment = {name: value for name, value in os.environ.items() if name != "DRJIT_LIBLLVM_PATH"}
    environment |= {"PATH": f"{tmp_path}:{os.environ['PATH']}", "MI_REFRACT_NEEDS_LLVM": "1"}
    command = ["bash", str(tmp_path / ".ci" / "setup"), "test"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=30)
    assert done.returncode == 1
    assert "apt-get install libllvm19" in done.stderr.splitlines()[-1]
    assert not (tmp_path / ".venv").exists()

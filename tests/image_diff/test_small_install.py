"""Comparison of images without Mitsuba: all commands and fixtures, with imports blocked and in a new environment."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib

import pytest
from packaging.requirements import Requirement
from support.diff_images import image, samples
from support.processes import ENVIRONMENT, ROOT

LIST = ROOT / ".github" / "actions" / "diff" / "requirements.txt"
ABSENT = ("mitsuba", "drjit", "matplotlib")
INSTALL = "MI_REFRACT_INSTALL"
MOST = 300e6  # bytes of the environment

# Uses every module of the package; its arguments are the modules that it may not import.
PROGRAM = """
import pkgutil, sys

ABSENT = sys.argv[1:]

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ABSENT:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Refuse())
import pytest
import mi_refract.image_diff
from mi_refract.cli.app import main

CALLS = {
    "diff --methods": 0,
    "diff --json-schema": 0,
    "diff old --check-settings": 0,
    "diff old new --report out.html --json out.json --junit out.xml --github": 1,
    "diff old new --method exact": 1,
    "diff old new --method paired": 1,
    "diff old new --method flip": 1,
    "diff one two --renders --report renders.html": 1,
    "self-test old/equal.exr": 0,
    "accept --from out.json --yes": 0,
    "accept old new --yes": 0,
    "diff old new": 0,
    "doctor": 2,
}
for words, code in CALLS.items():
    assert main(words.split()) == code, words
code = pytest.main(["-q", "-p", "no:cacheprovider", "--rootdir=.", "--mi-refract-report=tests.html", "test_images.py"])
assert code == 0, code
modules = {f"mi_refract.image_diff.{module.name}" for module in pkgutil.iter_modules(mi_refract.image_diff.__path__)}
assert not modules - set(sys.modules), modules - set(sys.modules)
assert not set(ABSENT) & set(sys.modules)
"""
TESTS = """
import numpy as np
import pytest

IMAGE = np.linspace(0.2, 1, 32 * 32 * 3).reshape(32, 32, 3)

def test_images(assert_image_equal, assert_image_unbiased):
    assert_image_equal("new/equal.exr", "old/equal.exr")
    with pytest.raises(pytest.fail.Exception, match="tolerance: different: "):
        assert_image_equal("one/0.exr", "two/0.exr")
    render = lambda seed: IMAGE * np.random.default_rng(seed).gamma(400, 1 / 400, IMAGE.shape)
    assert assert_image_unbiased(render, render).method == "welch"
"""


@pytest.fixture
def project(pair, tmp_path):
    """A folder with the images that PROGRAM compares."""
    for name, gain in (("one", 1.0), ("two", 1.1)):
        samples(tmp_path / name, 4, int(100 * gain), gain=gain, shape=(64, 64, 3))
    (tmp_path / "old" / "mi-refract.toml").write_text('[[image]]\nname = "skipped.exr"\nskip = true\nreason = "none"\n')
    for side in pair:
        image(side / "skipped.exr")
    (tmp_path / "conftest.py").write_text('pytest_plugins = ["mi_refract.pytest_plugin"]\n')
    (tmp_path / "test_images.py").write_text(TESTS)
    return tmp_path


def check(python, project, environment):
    environment = environment | {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    run = subprocess.run([python, "-c", PROGRAM, *ABSENT], cwd=project, env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout[-3000:] + run.stderr[-3000:]
    hint = "only commands that compare images work without it: pip install mi-refract"
    assert re.search(rf"module named '\w+'; {hint}$", run.stderr)


def test_every_command_and_fixture_works_without_mitsuba(project):
    check(sys.executable, project, ENVIRONMENT)


@pytest.mark.skipif(INSTALL not in os.environ, reason=f"needs the package index and half a minute: {INSTALL}=1 runs it")
def test_a_fresh_environment_with_the_requirements_is_small_and_works(project, tmp_path):
    fresh = tmp_path / "fresh"
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run([sys.executable, "-m", "venv", fresh], check=True)
    install = [fresh / "bin" / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*install, "--no-deps", "-r", LIST, ROOT], check=True, env=environment)
    assert sum(path.lstat().st_size for path in fresh.rglob("*")) < MOST
    subprocess.run([*install, "pytest"], check=True, env=environment)  # not in the requirements
    check(fresh / "bin" / "python", project, environment)


def test_the_requirements_are_those_of_the_extra_without_mitsuba():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = project["optional-dependencies"]
    requirements = [Requirement(text) for text in (*project["dependencies"], *extras["cli"], *extras["diff"])]
    lines = [line.partition("#")[0].strip() for line in LIST.read_text("utf-8").splitlines()]
    pinned = dict(re.fullmatch(r"([\w-]+)==([\d.]+)(?:; .*)?", line).groups() for line in lines if line)
    for requirement in requirements:
        if requirement.name not in (*ABSENT, "mi-refract"):
            assert requirement.specifier.contains(pinned[requirement.name]), requirement
    assert not set(pinned) & set(ABSENT)

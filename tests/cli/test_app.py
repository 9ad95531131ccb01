"""The command line itself: help, version, errors, exit codes, and what it does not import."""

from __future__ import annotations

import subprocess
import sys

import pytest
from support.processes import ENVIRONMENT, python

from mi_refract import cli
from mi_refract.cli import app


@pytest.mark.parametrize("arguments", [["nonesuch"], ["render"], ["doctor", "extra"]])
def test_bad_command(arguments, capfd):
    assert app.main(arguments) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert err.startswith("mi-refract: ")
    assert err.count("\n") == 1


def test_an_error_of_several_lines_is_printed_in_one(capfd, monkeypatch):
    def fails(*arguments, **options):
        raise ValueError("first\n  second\n")

    monkeypatch.setattr(app, "app", fails)
    assert app.main(["doctor"]) == 2
    assert capfd.readouterr() == ("", "mi-refract: first second\n")


def test_without_a_command_the_help_is_printed_and_with_version_the_version(capfd):
    assert app.main([]) == 2
    assert "doctor" in capfd.readouterr().out
    for main in (app.main, cli.main):
        assert main(["--version"]) == 0
        assert capfd.readouterr().out == f"{app.__version__}\n"


def test_without_the_extra():
    code = "import sys; sys.modules['typer'] = None; import mi_refract.cli.app"
    with python(code) as process:
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (2, "")
    assert err.splitlines()[-1] == "mi-refract needs the extra `cli`: pip install 'mi-refract[cli]'"


def test_diff_in_a_process_of_its_own(pair):
    """The exit code arrives, and no line of a log is wrapped."""
    command = [sys.executable, "-m", "mi_refract.cli", "diff", *map(str, pair)]
    done = subprocess.run(command, env=ENVIRONMENT | {"COLUMNS": "40"}, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stderr) == (1, "")
    assert len(done.stdout.splitlines()) == 4


HEAVY = ("mitsuba", "drjit", "numpy", "OpenImageIO", "matplotlib", "scipy")


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_help_and_version_wait_for_no_heavy_package(option):
    code = "import sys\nfrom mi_refract.cli import main\nmain(sys.argv[1:])\nprint([*sys.modules], file=sys.stderr)"
    with python(code, option) as process:
        out, err = process.communicate(timeout=60)
    assert out
    assert not [name for name in HEAVY if f"'{name}'" in err]


@pytest.mark.parametrize("name", app.COMMANDS)
def test_the_help_has_a_line_for_each_command_and_each_command_its_own(name, capfd):
    assert app.main(["--help"]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert [line.split(None, 1)[1] for line in lines if line.startswith(f"  {name} ")] == [app.COMMANDS[name].help]
    assert app.main([name, "--help"]) == 0
    assert capfd.readouterr().out.startswith(f"Usage: mi-refract {name} ")


# What a comparison of two images needs none of, but for its report, a terminal, or another method.
UNUSED = ("mitsuba", "drjit", "scipy", "matplotlib", "jinja2", "rich", "xml", "asyncio")


@pytest.mark.parametrize("options", [[], ["--method", "tolerance", "--set", "fail=0.5", "--json", "out.json"]])
def test_a_comparison_imports_what_it_needs(pair, tmp_path, options):
    code = "import sys\nfrom mi_refract.cli import main\nmain(sys.argv[1:])\nprint([*sys.modules], file=sys.stderr)"
    options = [str(tmp_path / word) if word == "out.json" else word for word in options]
    with python(code, "diff", *pair, *options) as process:
        out, err = process.communicate(timeout=60)
    assert "2 images: " in out
    assert "'OpenImageIO'" in err
    assert ("'msgspec'" in err) == bool(options)  # which reads settings
    assert not [name for name in UNUSED if f"'{name}'" in err]

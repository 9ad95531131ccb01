"""The command line itself: help, version, errors, exit codes, imports; and `mi-refract doctor`."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys

import mitsuba as mi
import pytest
import typer
from support.processes import ENVIRONMENT, python
from support.readme import PAGES, READMES, ROOT, blocks

import mi_refract
from mi_refract import backend, cli
from mi_refract.cli import app


@pytest.mark.parametrize("arguments", [["nonesuch"], ["render"], ["scene"], ["doctor", "extra"], ["several lines"]])
def test_an_error_is_one_line(arguments, capfd, monkeypatch):
    def fails(*arguments, **options):
        raise ValueError("first\n  second\n")

    if arguments == ["several lines"]:
        monkeypatch.setattr(app, "app", fails)
    assert app.main(arguments) == 2
    out, err = capfd.readouterr()
    assert out == "" and err.startswith("mi-refract: ") and err.count("\n") == 1
    assert arguments != ["several lines"] or err == "mi-refract: first second\n"
    assert arguments != ["nonesuch"] or err.endswith(f"'nonesuch'; expected {', '.join(app.COMMANDS)}\n")


def test_help_without_a_command_and_version(capfd):
    assert app.main([]) == 2
    assert "doctor" in capfd.readouterr().out
    for main in (app.main, cli.main):
        assert main(["--version"]) == 0
        assert capfd.readouterr().out == f"{app.__version__}\n"


def test_missing_extra_cli():
    with python("import sys; sys.modules['typer'] = None; import mi_refract.cli.app") as process:
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (2, "")
    assert err.splitlines()[-1] == "mi-refract needs the extra `cli`: pip install 'mi-refract[cli]'"


def test_diff_as_a_subprocess(pair):
    """The exit code is returned, and no line is wrapped."""
    command = [sys.executable, "-m", "mi_refract.cli", "diff", *map(str, pair)]
    done = subprocess.run(command, env=ENVIRONMENT | {"COLUMNS": "40"}, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stderr, len(done.stdout.splitlines())) == (1, "", 4)


@pytest.mark.parametrize("name", app.COMMANDS)
def test_help_lists_each_command_and_each_command_has_help(name, capfd):
    assert app.main(["--help"]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert [line.split(None, 1)[1] for line in lines if line.startswith(f"  {name} ")] == [app.COMMANDS[name][2]]
    assert app.main([name, "--help"]) == 0
    out = capfd.readouterr().out
    assert out.startswith(f"Usage: mi-refract {name} ")
    assert not re.search(r"^  \w+ .*\.\.\.$", out.partition("Commands:")[2], re.MULTILINE)  # no line is cut


def commands_of(command, name=""):
    """Return the names of a command and of all its subcommands."""
    names = [name]
    for subname in command.list_commands(None) if hasattr(command, "list_commands") else ():
        names += commands_of(command.get_command(None, subname), f"{name} {subname}".strip())
    return names


COMMANDS = commands_of(typer.main.get_command(app.app))


@pytest.fixture
def parsed(monkeypatch, capfd):
    """`parsed("mi-refract rays check a.csv")` checks the options and returns the command that would run."""
    called = []
    monkeypatch.setattr(typer.core.TyperCommand, "invoke", lambda self, context: called.append(context.command_path))

    def parse(line):
        called[:] = []
        program, *words = shlex.split(line, comments=True)
        assert (program, app.main(words)) == ("mi-refract", 0), (line, capfd.readouterr().err)
        return called[0] if called else line  # options such as `--keys` print and exit earlier

    return parse


@pytest.mark.parametrize("name", COMMANDS)
def test_examples_at_the_end_of_the_help_parse(name, capfd, parsed):
    assert app.main([*name.split(), "--help"]) == 0
    *_, head, examples = capfd.readouterr().out.partition("\n  Examples:\n")
    examples = [line.strip() for line in examples.splitlines()]
    assert head and len(examples) in (2, 3)
    called = [parsed(line) for line in examples]
    assert called[0].startswith(f"mi-refract {name}".strip())


@pytest.mark.parametrize("path", [*READMES, *PAGES], ids=lambda path: str(path.relative_to(ROOT)))
def test_command_lines_of_a_page_parse(path, parsed):
    lines = [line for block in blocks(path, "bash") for line in block.replace("\\\n", " ").splitlines()]
    for line in (line for line in lines if line.startswith("mi-refract ")):
        parsed(re.sub(r"[>|;&].*|\[[^]]*\]", "", line))


HEAVY = ("mitsuba", "drjit", "numpy", "OpenImageIO", "matplotlib", "scipy")
# Modules that a comparison of two images needs only for a report or another method.
UNUSED = ("mitsuba", "drjit", "scipy", "matplotlib", "jinja2", "xml", "asyncio")
SET = ("diff", "--method", "tolerance", "--set", "fail=0.5", "--json", "out.json")


@pytest.mark.parametrize(
    ("words", "unused"), [(("--help",), HEAVY), (("--version",), HEAVY), (("diff",), UNUSED), (SET, UNUSED)]
)
def test_a_command_does_not_import_unused_modules(pair, tmp_path, words, unused):
    code = "import sys\nfrom mi_refract.cli import main\nmain(sys.argv[1:])\nprint([*sys.modules], file=sys.stderr)"
    files = pair if words[0] == "diff" else ()
    with python(code, *(tmp_path / x if x == "out.json" else x for x in words), *files) as process:
        out, err = process.communicate(timeout=60)
    assert out and not [name for name in unused if f"'{name}'" in err]
    if files:
        assert "2 images: " in out and "'OpenImageIO'" in err


# Names that Windows lacks; Python's library and NumPy, imported on Linux, work without them.
WINDOWS = """
import os, select, signal, subprocess, sys
for name in ("fcntl", "grp", "pwd", "resource", "termios"):
    sys.modules[name] = None
for module, names in {
    os: "O_CLOEXEC O_DIRECTORY O_NOFOLLOW chown fchmod fork geteuid getpgrp getuid killpg mkfifo setsid",
    select: "epoll poll",
    signal: "SIGHUP pthread_kill pthread_sigmask sigpending sigtimedwait sigwait",
}.items():
    for name in names.split():
        vars(module).pop(name, None)
from mi_refract.cli import main
sys.exit(main())
"""
RENDER = ("render", ROOT / "scenes/sphere.xml", "-o", "out.exr", "-D", "res=8", "--spp", "1", "--variant", "scalar_rgb")


@pytest.mark.parametrize(
    ("words", "code", "error", "out"),
    [
        (("--help",), 0, "", "Commands:"),
        (("diff", "IMAGES", "--json", "out.json"), 1, "", "2 images: "),
        (RENDER, 0, "", "out.exr: scalar_rgb, 1 spp in 1 pass"),
        (("rays", "run", "--count", "5", "--", sys.executable, "-c", "exit(2)"), 2, "ended with status 2", ""),
        (("rays", "run", "--timeout", "0.2", "--", "sleep", "600"), 2, "did not finish within 0.2 s", ""),
    ],
    ids=lambda x: " ".join(map(str, x[:2])) if isinstance(x, tuple) else "",
)
def test_without_names_that_windows_lacks(pair, tmp_path, words, code, error, out):
    words = [y for x in words for y in (pair if x == "IMAGES" else [x])]
    command = [sys.executable, "-c", WINDOWS, *map(str, words)]
    done = subprocess.run(command, env=ENVIRONMENT, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    errors = [line for line in done.stderr.splitlines() if line.startswith("mi-refract: ")]  # without Dr.Jit's output
    assert (done.returncode, len(errors), "Traceback" in done.stderr) == (code, bool(error), False), done
    assert out in done.stdout and error in done.stderr


# doctor ---------------------------------------------------------------------------------------------------------------


def test_doctor(capfd, monkeypatch):
    assert app.main(["doctor"]) == 0
    out, _ = capfd.readouterr()
    assert all(variant in out for variant in mi.variants()) and mi.__version__ in out
    assert app.main(["doctor", "--json"]) == 0
    facts = json.loads(capfd.readouterr().out)
    assert facts["variants"] == backend.usable_variants()
    assert facts["libllvm"] == {library.path: library.defect or "works" for library in backend.libraries()}
    assert facts["versions"]["mi_refract"] == mi_refract.__version__
    assert out.rstrip().endswith(facts["advice"])
    monkeypatch.setattr(backend, "usable_variants", lambda: {"scalar_rgb": "made up"})
    assert app.main(["doctor"]) == 2
    assert capfd.readouterr().err == "mi-refract: no Mitsuba variant can run on this machine\n"


def test_doctor_without_llvm():
    environment = {backend.CHOICE: "/nonexistent", backend.OWN_CHOICE: ""}
    with python("import sys; from mi_refract.cli import main; sys.exit(main(['doctor']))", **environment) as process:
        out, err = process.communicate(timeout=120)
    assert process.returncode == 0 and "Traceback" not in err, err
    advice = out.splitlines()[-1]
    assert advice.startswith("the llvm_* variants are missing: DRJIT_LIBLLVM_PATH=/nonexistent: no such file")
    assert "apt-get install libllvm19" in advice or "LLVM 17" in advice

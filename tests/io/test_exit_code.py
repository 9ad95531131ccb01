"""Whatever happens in a command, only a verdict of its own is its exit code: the rest is 2, in one line."""

from __future__ import annotations

import io
import subprocess
import sys

import pytest
from support import processes
from support.diff_images import image

from mi_refract.io import errors

ENVIRONMENT = processes.ENVIRONMENT | {"PYTHONUNBUFFERED": ""}  # what a test prints waits, as it does for most users


def ended(body, capsys):
    code = errors.exit_code("it", body)
    return code, capsys.readouterr().err


@pytest.mark.parametrize("verdict", [0, 1, 3, None])
def test_a_verdict_is_the_exit_code(verdict, capsys):
    assert ended(lambda: verdict, capsys) == (verdict or 0, "")


def raises(error):
    def body():
        raise error

    return body


def deep():
    return deep()


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (raises(ValueError("size = 0;\n  expected 1 or more")), "it: size = 0; expected 1 or more"),
        (raises(OSError("folder: not writable")), "it: folder: not writable"),
        (raises(FileNotFoundError(2, "No such file or directory", "a.exr")), "it: a.exr: No such file or directory"),
        (raises(OSError(28, "No space left on device")), "it: No space left on device"),
        (raises(ModuleNotFoundError("No module named 'scipy'")), "it: No module named 'scipy'"),
        (raises(MemoryError()), "it: out of memory"),
        (deep, "it: internal error: RecursionError: maximum recursion depth exceeded"),
        (raises(KeyError("x")), "it: internal error: KeyError: 'x' (MI_REFRACT_TRACEBACK=1 shows where)"),
        (raises(ValueError()), "it: internal error: ValueError: "),
        (raises(SystemExit("a last word")), "it: a last word"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_anything_else_is_2_and_one_line(body, said, capsys):
    code, err = ended(body, capsys)
    assert code == 2
    assert err.startswith(said)
    assert len(err.splitlines()) == 1


def test_ctrl_c_and_the_codes_of_others_pass(capsys):
    assert ended(raises(KeyboardInterrupt()), capsys) == (130, "")
    assert ended(raises(SystemExit(3)), capsys) == (3, "")
    assert ended(raises(SystemExit()), capsys) == (0, "")


def test_the_traceback_is_printed_where_it_is_asked_for(capsys, monkeypatch):
    monkeypatch.setenv("MI_REFRACT_TRACEBACK", "1")
    code, err = ended(raises(KeyError("x")), capsys)
    assert code == 2
    assert err.startswith("Traceback")
    assert "raise error\nKeyError: 'x'\nit: internal error" in err


def test_what_a_terminal_cannot_print_is_escaped(monkeypatch):
    paper = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(paper, "ascii", errors="strict"))
    assert errors.exit_code("it", lambda: print("5 × \udcff")) == 0
    assert paper.getvalue() == b"5 \\xd7 \\udcff\n"


COMMAND = [sys.executable, "-m", "mi_refract.cli", "diff"]


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    paths = [folder / f"{name}.exr" for name in "abc"]
    for path, gain in zip(paths, (1.0, 1.0, 2.0), strict=True):
        image(path, gain=gain)
    return paths


# Which images, how the shell connects the command, its exit code, and what is left to read.
CASES = {
    "equal, stdout closed": ((0, 1), ">&-", 0, ""),
    "different, stdout closed": ((0, 2), ">&-", 1, ""),
    "different, all closed": ((0, 2), "<&- >&- 2>&-", 1, ""),
    "equal, nobody reads": ((0, 1), "| sleep 0", 2, "mi-refract: Broken pipe"),
    "equal, disk full": ((0, 1), ">/dev/full", 2, "mi-refract: No space left on device"),
    "misuse, disk full": ((0, 0), "--method nope 2>/dev/full", 2, ""),
}


@pytest.mark.parametrize("case", CASES)
def test_streams_that_are_closed_full_or_not_read(case, images):
    chosen, connected, code, said = CASES[case]
    words = [*COMMAND, *(str(images[i]) for i in chosen)]
    # The reader of the pipe has gone before the command prints.
    script = f'set -o pipefail; "$@" {connected}'
    done = subprocess.run(
        ["bash", "-c", script, "bash", *words], env=ENVIRONMENT, capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stderr.strip()) == (code, said)


def test_output_that_cannot_be_written_is_not_the_exit_code_of_an_error():
    code = "from mi_refract.io.errors import exit_code\nexit(exit_code('it', lambda: print('x') or int('y')))"
    script = f'"$0" -c "{code}" >/dev/full'
    done = subprocess.run(["bash", "-c", script, sys.executable], env=ENVIRONMENT, capture_output=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.startswith(b"it: invalid literal")


def test_no_file_takes_the_number_of_a_closed_stream():
    code = "import os, sys\nfrom mi_refract.io.errors import exit_code\n"
    code += "exit_code('it', lambda: os.write(int(sys.argv[1]), bytes([48 + os.open('/dev/null', os.O_RDONLY)])))"
    script = f'"$0" -c "{code}" 1 2>&- <&-'
    done = subprocess.run(["bash", "-c", script, sys.executable], env=ENVIRONMENT, capture_output=True, timeout=60)
    assert done.stdout == b"3"

"""What becomes of errors and of the text of others: one line, exit code 2, and nothing that steers a terminal."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import unicodedata
from pathlib import Path

import pytest
from support import processes
from support.diff_images import image
from support.hostile import BIDI, CONTROLS, NAME, shows_more_than_text

from mi_refract import cli
from mi_refract.io.errors import exit_code
from mi_refract.io.text import MARK, json_text, printable, printable_lines

ENVIRONMENT = processes.ENVIRONMENT | {"PYTHONUNBUFFERED": ""}  # what a test prints waits, as it does for most users


def raises(error):
    def body():
        raise error

    return body


def deep():
    return deep()


@pytest.mark.parametrize(
    ("body", "code", "said"),
    [(lambda verdict=verdict: verdict, verdict or 0, "") for verdict in (0, 1, 3, None)]
    + [(raises(error), code, "") for error, code in ((KeyboardInterrupt(), 130), (SystemExit(3), 3), (SystemExit(), 0))]
    + [
        (raises(ValueError("size = 0;\n  expected 1 or more")), 2, "it: size = 0; expected 1 or more"),
        (raises(OSError("folder: not writable")), 2, "it: folder: not writable"),
        (raises(FileNotFoundError(2, "No such file or directory", "a.exr")), 2, "it: a.exr: No such file or directory"),
        (raises(BrokenPipeError(32, "Broken pipe")), 2, "it: Broken pipe"),  # of a pipe of another program
        (raises(OSError(28, "No space left on device")), 2, "it: No space left on device"),
        (raises(ModuleNotFoundError("No module named 'scipy'")), 2, "it: No module named 'scipy'"),
        (raises(MemoryError()), 2, "it: out of memory"),
        (deep, 2, "it: internal error: RecursionError: maximum recursion depth exceeded"),
        (raises(KeyError("x")), 2, "it: internal error: KeyError: 'x' (MI_REFRACT_TRACEBACK=1 shows where)"),
        (raises(ValueError()), 2, "it: internal error: ValueError: "),
        (raises(SystemExit("a last word")), 2, "it: a last word"),
        (raises(ValueError(f"{NAME}; expected another name")), 2, "it: "),
    ],
)
def test_a_verdict_is_the_exit_code_and_anything_else_is_2_and_one_line(body, code, said, capsys):
    assert exit_code("it", body) == code
    err = capsys.readouterr().err
    assert err.startswith(said) and len(err.splitlines()) == bool(said) and not shows_more_than_text(err)


def test_the_traceback_is_printed_where_it_is_asked_for(capsys, monkeypatch):
    monkeypatch.setenv("MI_REFRACT_TRACEBACK", "1")
    assert exit_code("it", raises(KeyError("x"))) == 2
    err = capsys.readouterr().err
    assert err.startswith("Traceback") and "raise error\nKeyError: 'x'\nit: internal error" in err


def test_what_a_terminal_cannot_print_is_escaped(monkeypatch):
    paper = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(paper, "ascii", errors="strict"))
    assert exit_code("it", lambda: print("5 × \udcff")) == 0
    assert paper.getvalue() == b"5 \\xd7 \\udcff\n"


# Streams --------------------------------------------------------------------------------------------------------------

OWN = "from mi_refract.io.errors import exit_code\nexit(exit_code('it', lambda: {}))"
# No file takes the number of a closed stream; and what cannot be written is not the exit code of an error.
NUMBER = OWN.format("os.write(1, bytes([48 + os.open('/dev/null', os.O_RDONLY)])) and None")
INDEX = "it: internal error: IndexError: list index out of range (MI_REFRACT_TRACEBACK=1 shows where)"
SAID = OWN.format("print('x') or {}")
# What the command is, how the shell connects it, its exit code, and what is left to read.
CASES = {
    "equal, stdout closed": (SAID.format(0), ">&-", 0, "", ""),
    "different, stdout closed": (SAID.format(1), ">&-", 1, "", ""),
    "different, all closed": ("ac", "<&- >&- 2>&-", 1, "", ""),
    "equal, nobody reads": (SAID.format(0), "| sleep 0", 0, "", ""),
    "different, nobody reads": ("ac", "| sleep 0", 1, "", ""),
    "unbuffered, nobody reads": (SAID.format(1), "| sleep 0", 1, "", ""),
    "warned, nobody reads": (OWN.format("print('x', file=__import__('sys').stderr) or 3"), "2>&1 | sleep 0", 3, "", ""),
    "error, nobody reads": (OWN.format("print('x' * 2**20) or [][1]"), "| sleep 0", 2, "", INDEX),
    "equal, disk full": (SAID.format(0), ">/dev/full", 2, "", "it: stdout: No space left on device"),
    "different, disk full": ("ac", "--github >/dev/full", 2, "", "mi-refract: stdout: No space left on device"),
    "unbuffered, disk full": (SAID.format(0), ">/dev/full", 2, "", "it: stdout: No space left on device"),
    "misuse, disk full": ("aa", "--method nope 2>/dev/full", 2, "", ""),
    "much, disk full": (OWN.format("print('x' * 2**20)"), ">/dev/full", 2, "", "it: stdout: No space left on device"),
    "error, disk full": (SAID.format("[][1]"), ">/dev/full", 2, "", INDEX),
    "closed numbers": (f"import os\n{NUMBER}", "2>&- <&-", 0, "3", ""),
}


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    paths = {name: folder / f"{name}.exr" for name in "ac"}
    for path, gain in zip(paths.values(), (1.0, 2.0), strict=True):
        image(path, gain=gain)
    return paths


@pytest.mark.parametrize("case", CASES)
def test_streams_that_are_closed_full_or_not_read(case, images):
    chosen, connected, code, out, said = CASES[case]
    words = ["-c", chosen] if len(chosen) > 2 else ["-m", "mi_refract.cli", "diff", *(images[x] for x in chosen)]
    # The reader of the pipe has gone before the command prints.
    command = ["bash", "-c", f'set -o pipefail; "$@" {connected}', "bash", sys.executable, *map(str, words)]
    environment = ENVIRONMENT | {"PYTHONUNBUFFERED": "1"} if case.startswith("unbuffered") else ENVIRONMENT
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr.strip()) == (code, out, said)


# The text of others ---------------------------------------------------------------------------------------------------


def test_printable_keeps_text_and_nothing_else():
    evil, shown = "a\nb\x1b[31m\udcff\uffff\u2028\u202e<>&\x85", "a?b?[31m????<>&?"
    assert printable(evil) == shown.replace("?", MARK)
    text = "Σ × 10⁻³ — «glass» 日本 🙂 👩\u200d🚀 می\u200cخواهم a: b :: c # ## [x] #[y] C:\\x"
    assert (printable(text), printable(3)) == (text, "3")
    assert printable(printable(NAME)) == printable(NAME) and not shows_more_than_text(printable(NAME), "")


@pytest.mark.parametrize(
    "hidden", [BIDI, CONTROLS, "\udcff\ud800", "\u2028\u2029", "\ufeff\u200b\u2060\xad", "\U000e0041"]
)
def test_what_is_not_seen_is_marked(hidden):
    assert printable(hidden) == MARK * len(hidden)
    lines = printable_lines(f"a{hidden}\nb")
    assert lines.split("\n")[-1] == "b" and len(lines) == len(hidden) + 3


def test_every_control_and_every_format_character_but_the_joiners_and_signs_is_marked():
    """Of Unicode's category Cf those that are seen stay (signs of Arabic, Syriac, Kaithi, shorthand, hieroglyphs)."""
    kept = {c for c in map(chr, range(0x110000)) if unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp")}
    kept = {c for c in kept if printable(c) != MARK}
    assert {"\u200c", "\u200d"} < kept
    signs = {c for c in kept if ord(c) in range(0x110BD, 0x1BCA4) or 0x13430 <= ord(c) < 0x13440}
    assert {c for c in kept if ord(c) > 0x200D or ord(c) < 0x600} == signs


COMMANDS = ["##[error]x", "a ##[set-env name=X]b", "###[group]", "##vso[task.x]", "::error::x", " \t::stop-commands::x"]


@pytest.mark.parametrize("text", [*COMMANDS, "\xa0::x"])
def test_no_runner_takes_it_for_a_command(text):
    shown = printable(text)
    assert not shows_more_than_text(shown) and "##[" not in shown
    assert printable(shown) == shown and len(shown) == len(text)


@pytest.mark.parametrize("indent", [None, 2])
def test_json_holds_every_string_and_shows_none_of_it(indent):
    value = {NAME: [NAME, "###[x]", "a##", CONTROLS, {"b": "##vso[x]"}], "###": 1.5}
    text = json_text(value, indent)
    assert json.loads(text) == value
    assert text.isascii() and not shows_more_than_text(text) and "##" not in text
    with pytest.raises(ValueError):
        json_text([float("nan")])
    for path in Path(cli.__file__).parent.glob("*.py"):  # no command prints JSON by itself
        assert "json.dumps" not in path.read_text(), path

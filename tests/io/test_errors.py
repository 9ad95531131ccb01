"""Errors are one line with exit code 2, and text from other sources is sanitised."""

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

ENVIRONMENT = processes.ENVIRONMENT | {"PYTHONUNBUFFERED": ""}  # stdout is buffered, as usual


def raises(error):
    def body():
        raise error

    return body


def deep():
    return deep()


@pytest.mark.parametrize(
    ("body", "code", "message"),
    [(lambda verdict=verdict: verdict, verdict or 0, "") for verdict in (0, 1, 3, None)]
    + [(raises(error), code, "") for error, code in ((KeyboardInterrupt(), 130), (SystemExit(3), 3), (SystemExit(), 0))]
    + [
        (raises(ValueError("size = 0;\n  expected 1 or more")), 2, "it: size = 0; expected 1 or more"),
        (raises(OSError("folder: not writable")), 2, "it: folder: not writable"),
        (raises(FileNotFoundError(2, "No such file or directory", "a.exr")), 2, "it: a.exr: No such file or directory"),
        (raises(BrokenPipeError(32, "Broken pipe")), 2, "it: Broken pipe"),  # not of stdout
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
def test_exit_codes_and_one_line_per_error(body, code, message, capsys):
    assert exit_code("it", body) == code
    err = capsys.readouterr().err
    assert err.startswith(message) and len(err.splitlines()) == bool(message) and not shows_more_than_text(err)


def test_the_traceback_is_printed_on_request(capsys, monkeypatch):
    monkeypatch.setenv("MI_REFRACT_TRACEBACK", "1")
    assert exit_code("it", raises(KeyError("x"))) == 2
    err = capsys.readouterr().err
    assert err.startswith("Traceback") and "raise error\nKeyError: 'x'\nit: internal error" in err


@pytest.mark.parametrize(("errors", "expected"), [("strict", b"5 \\xd7 \\udcff\n"), ("replace", b"5 ? ?\n")])
def test_characters_that_stdout_cannot_encode_are_escaped_or_treated_as_the_user_has_set(monkeypatch, errors, expected):
    output = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(output, "ascii", errors=errors))
    assert exit_code("it", lambda: print("5 × \udcff")) == 0
    assert output.getvalue() == expected


# Streams --------------------------------------------------------------------------------------------------------------

OWN = "from mi_refract.io.errors import exit_code\nexit(exit_code('it', lambda: {}))"
# Prints the number of the first opened file, which must not be that of a closed stream.
NUMBER = OWN.format("os.write(1, bytes([48 + os.open('/dev/null', os.O_RDONLY)])) and None")
INDEX = "it: internal error: IndexError: list index out of range (MI_REFRACT_TRACEBACK=1 shows where)"
SAID = OWN.format("print('x') or {}")
# Each case: code or the names of images to compare, redirections of the shell, exit code, stdout, stderr.
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
def test_closed_full_and_unread_streams(case, images):
    chosen, redirections, code, out, err = CASES[case]
    words = ["-c", chosen] if len(chosen) > 2 else ["-m", "mi_refract.cli", "diff", *(images[x] for x in chosen)]
    # With a pipe, its reader ends before the command prints.
    command = ["bash", "-c", f'set -o pipefail; "$@" {redirections}', "bash", sys.executable, *map(str, words)]
    environment = ENVIRONMENT | {"PYTHONUNBUFFERED": "1"} if case.startswith("unbuffered") else ENVIRONMENT
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert (run.returncode, run.stdout, run.stderr.strip()) == (code, out, err)


# Text from other sources ----------------------------------------------------------------------------------------------


def test_printable_replaces_hidden_characters_and_keeps_text():
    evil, shown = "a\nb\x1b[31m\udcff\uffff\u2028\u202e<>&\x85", "a?b?[31m????<>&?"
    assert printable(evil) == shown.replace("?", MARK)
    assert printable_lines(f"a{BIDI}\nb") == f"a{MARK * len(BIDI)}\nb"
    text = "Σ × 10⁻³ — «glass» 日本 🙂 👩\u200d🚀 می\u200cخواهم a: b :: c # ## [x] #[y] C:\\x"
    assert (printable(text), printable(3)) == (text, "3")
    assert printable(printable(NAME)) == printable(NAME) and not shows_more_than_text(printable(NAME), "")


def test_all_control_and_format_characters_except_joiners_and_signs_are_replaced():
    """Visible characters of Unicode's category Cf are kept: signs of Arabic, Syriac, Kaithi, shorthand, hieroglyphs."""
    controls = {c for c in map(chr, range(0x110000)) if unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp")}
    unchanged = {c for c in controls if printable(c) != MARK}
    assert {"\u200c", "\u200d"} < unchanged
    signs = {c for c in unchanged if ord(c) in range(0x110BD, 0x1BCA4) or 0x13430 <= ord(c) < 0x13440}
    assert {c for c in unchanged if ord(c) > 0x200D or ord(c) < 0x600} == signs


COMMANDS = ["##[error]x", "a ##[set-env name=X]b", "###[group]", "##vso[task.x]", "::error::x", " \t::stop-commands::x"]


@pytest.mark.parametrize("text", [*COMMANDS, "\xa0::x"])
def test_commands_to_ci_runners_are_broken(text):
    sanitised = printable(text)
    assert not shows_more_than_text(sanitised) and "##[" not in sanitised
    assert printable(sanitised) == sanitised and len(sanitised) == len(text)


@pytest.mark.parametrize("indent", [None, 2])
def test_json_text_keeps_all_strings_and_is_safe_to_print(indent):
    value = {NAME: [NAME, "###[x]", "a##", CONTROLS, {"b": "##vso[x]"}], "###": 1.5}
    text = json_text(value, indent)
    assert json.loads(text) == value
    assert text.isascii() and not shows_more_than_text(text) and "##" not in text
    with pytest.raises(ValueError):
        json_text([float("nan")])
    for path in Path(cli.__file__).parent.glob("*.py"):  # all commands print JSON with `json_text`
        assert "json.dumps" not in path.read_text(), path

"""Names and messages of others stay text: they steer no terminal, no direction of writing and no CI runner."""

import json
import unicodedata
from pathlib import Path

import pytest
from support.hostile import BIDI, CONTROLS, NAME, shows_more_than_text

from mi_refract import cli
from mi_refract.io import errors
from mi_refract.io.sanitise import MARK, json_text, printable, printable_lines

EVIL = "a\nb\x1b[31m\udcff\uffff\u2028\u202e<>&\x85"


def test_printable_keeps_text_and_nothing_else():
    assert printable(EVIL) == "a\ufffdb\ufffd[31m\ufffd\ufffd\ufffd\ufffd<>&\ufffd"
    text = "Σ × 10⁻³ — «glass» 日本 🙂 👩\u200d🚀 می\u200cخواهم a: b :: c # ## [x] #[y] C:\\x"
    assert printable(text) == text
    assert printable(3) == "3"


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
    assert {c for c in kept if ord(c) > 0x200D or ord(c) < 0x600} == {
        c for c in kept if ord(c) in range(0x110BD, 0x1BCA4) or 0x13430 <= ord(c) < 0x13440
    }


@pytest.mark.parametrize(
    "text",
    [
        "##[error]x",
        "a ##[set-env name=X]b",
        "###[group]",
        "##vso[task.x]",
        "::error::x",
        " \t::stop-commands::x",
        "\xa0::x",
    ],
)
def test_no_runner_takes_it_for_a_command(text):
    shown = printable(text)
    assert not shows_more_than_text(shown) and "##[" not in shown
    assert printable(shown) == shown
    assert len(shown) == len(text)


def test_what_is_printed_twice_is_the_same():
    assert printable(printable(NAME)) == printable(NAME)
    assert not shows_more_than_text(printable(NAME), "")


def test_errors_are_printed_by_it(capsys):
    def fails():
        raise ValueError(f"{NAME}; expected another name")

    assert errors.exit_code("it", fails) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.endswith("; expected another name\n")
    assert not shows_more_than_text(said)


@pytest.mark.parametrize("indent", [None, 2])
def test_json_holds_every_string_and_shows_none_of_it(indent):
    value = {NAME: [NAME, "###[x]", "a##", CONTROLS, {"b": "##vso[x]"}], "###": 1.5}
    text = json_text(value, indent)
    assert json.loads(text) == value
    assert text.isascii() and not shows_more_than_text(text) and "##" not in text
    with pytest.raises(ValueError):
        json_text([float("nan")])


def test_no_command_prints_json_by_itself():
    for path in Path(cli.__file__).parent.glob("*.py"):
        assert "json.dumps" not in path.read_text(), path

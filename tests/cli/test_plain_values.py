"""Values of a command line are what Typer makes of them, with or without its validators."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.core import TyperCommand

from mi_refract.cli.app import PlainCommand


class Colour(enum.StrEnum):
    RED = "red"
    BLUE = "blue"


def stop(asked: bool) -> None:
    if asked:
        raise typer.Exit(7)


def command(
    first: Path,
    second: Annotated[Path | None, typer.Argument()] = None,
    more: Annotated[list[Path] | None, typer.Argument()] = None,
    text: str = "some",
    words: Annotated[list[str] | None, typer.Option("--word")] = None,
    count: Annotated[int, typer.Option(min=1)] = 3,
    share: float = 0.5,
    colour: Annotated[Colour | None, typer.Option()] = None,
    file: Annotated[Path | None, typer.Option("--file")] = None,
    flag: Annotated[bool, typer.Option("--flag")] = False,
    version: Annotated[bool, typer.Option("--version", is_eager=True, callback=stop)] = False,
) -> dict[str, object]:
    return locals()


LINES = {
    "the least": ["a.exr"],
    "paths": ["a.exr", "b.exr", "c.exr", "d.exr"],
    "a text that is a number": ["1", "--text", "2"],
    "lists": ["a", "--word", "x=1", "--word", "", "--word=--y"],
    "numbers": ["a", "--count", "12", "--share", "1e-3"],
    "a choice": ["a", "--colour", "blue"],
    "a file": ["a", "--file", "out.json", "--flag"],
    "after the options": ["--flag", "--", "-a", "--b"],
    "an empty text": ["", "--text", ""],
    "nothing": [],
    "an unknown option": ["a", "--nonesuch"],
    "no number": ["a", "--count", "many"],
    "too small a number": ["a", "--count", "0"],
    "no float": ["a", "--share", "x"],
    "no colour": ["a", "--colour", "green"],
    "no value": ["a", "--text"],
    "an eager option": ["--version"],
    "help": ["--help"],
}


def outcome(kind, words, capsys):
    """What the command returns, or the error that it ends with, and what it prints."""
    app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    app.command(cls=kind)(command)
    try:
        found = typer.main.get_command(app).main(words, "name", standalone_mode=False)
    except Exception as error:
        found = type(error).__name__, error.format_message()
    return found, capsys.readouterr()


@pytest.mark.parametrize("words", LINES.values(), ids=LINES)
def test_as_typer_reads_them(words, capsys):
    expected, found = (outcome(kind, words, capsys) for kind in (TyperCommand, PlainCommand))
    assert found == expected
    if isinstance(found[0], dict):
        assert list(map(type, found[0].values())) == list(map(type, expected[0].values()))

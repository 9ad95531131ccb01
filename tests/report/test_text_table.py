"""Tables: the same words as plain text and by rich."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from mi_refract.report.text_table import Group, Table, Text


def filled(*rows):
    table = Table(("verdict", "image"))
    for row in rows:
        table.add_row(*map(Text, row))
    return table


TABLES = {
    "rows": filled(("equal", "a.exr"), ("different", "b[1].exr")),
    "empty": filled(),
    "wide characters": filled(("ガラス", "球.exr"), ("é", "e\u0301")),
    "with lines below": Group((filled(("equal", "a.exr")), Text("… and 3 more", "dim"), Text("4 images: 4 equal"))),
    "markup of rich's": filled(("[bold]equal[/]", ":smile:")),
}


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
def test_plain_text_is_what_rich_prints_without_colours(table):
    stream = io.StringIO()
    Console(width=1000, file=stream, color_system=None).print(table, highlight=False)
    assert str(table).splitlines() == [line.rstrip() for line in stream.getvalue().splitlines()]


def test_a_style_is_seen_on_a_terminal_alone():
    stream = io.StringIO()
    text = Text("different", "bold red")
    Console(file=stream, force_terminal=True, color_system="standard").print(text)
    assert "\x1b[1;31mdifferent" in stream.getvalue()
    assert str(text) == "different"


def test_long_lines_stay_whole():
    assert len(str(filled(("x" * 20_000, "y"))).splitlines()) == 2

"""Tables as plain text, or by rich, which is imported only to show one in colour on a terminal.

Rich's console prints what has `__rich__`; for a log `str` says the same, with a line for each row however long.
"""

from __future__ import annotations

import unicodedata
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import RenderableType

GAP = 2  # spaces between columns


@dataclass(frozen=True)
class Text:
    """A text without line breaks, in one of rich's styles."""

    text: str
    style: str = ""

    def __str__(self) -> str:
        """As plain text."""
        return self.text

    def __rich__(self) -> RenderableType:
        """As rich shows it."""
        from rich.text import Text as RichText

        return RichText(self.text, style=self.style)


@dataclass(frozen=True)
class Table:
    """A line of names and a line for each row, in columns."""

    header: tuple[str, ...]
    rows: list[tuple[Text, ...]] = field(default_factory=list)

    def add_row(self, *cells: Text) -> None:
        """A cell for each column."""
        self.rows.append(cells)

    def __str__(self) -> str:
        """As plain text."""
        lines = [self.header, *(tuple(map(str, row)) for row in self.rows)]
        widths = [max(map(_width, column)) + GAP for column in zip(*lines, strict=True)]
        padded = ((cell + " " * (width - _width(cell)) for cell, width in zip(x, widths, strict=True)) for x in lines)
        return "\n".join("".join(line).rstrip() for line in padded)

    def __rich__(self) -> RenderableType:
        """As rich shows it."""
        from rich.table import Table as RichTable

        found = RichTable(*self.header, box=None, pad_edge=False)
        for row in self.rows:
            found.add_row(*(cell.__rich__() for cell in row))
        return found


@dataclass(frozen=True)
class Group:
    """One below the other."""

    parts: tuple[Table | Text, ...]

    def __str__(self) -> str:
        """As plain text."""
        return "\n".join(map(str, self.parts))

    def __rich__(self) -> RenderableType:
        """As rich shows it."""
        from rich.console import Group as RichGroup

        return RichGroup(*(part.__rich__() for part in self.parts))


Plain = Text | Table | Group


def _width(text: str) -> int:
    """The columns of a terminal that the text takes."""
    if text.isascii():
        return len(text)
    wide = sum(unicodedata.east_asian_width(character) in "WF" for character in text)
    return len(text) + wide - sum(unicodedata.combining(character) > 0 for character in text)

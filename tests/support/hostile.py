"""A hostile file name, and the search for its dangerous parts in outputs."""

from __future__ import annotations

import unicodedata

TURNING = ["LRE", "RLE", "PDF", "LRO", "RLO", "LRI", "RLI", "FSI", "PDI"]
# All characters with the property Bidi_Control.
BIDI = "\u061c\u200e\u200f" + "".join(filter(lambda c: unicodedata.bidirectional(c) in TURNING, map(chr, range(2**16))))
CONTROLS = "".join(map(chr, (*range(32), *range(0x7F, 0xA0))))
NAME = f"::error::\n::error::##[error]b##vso[task.x]\x1b[31m[red][/nothing]\udcff\uffff\u2028\u200b<script>&\"'`|{BIDI}"


def shows_more_than_text(form: str, allowed: str = "\n") -> list[str]:
    """Return the characters of `form` that control a terminal or the text direction, and lines with CI commands.

    A GitHub runner executes `##[` anywhere in a line, and `::` at the beginning of a line, after spaces.
    """
    characters = sorted({*form} & {*BIDI, *CONTROLS, "\u2028", "\u200b", "\uffff", "\udcff"} - {*allowed})
    lines = (x for x in form.split("\n") if "##[" in x or "##vso[" in x or x.lstrip()[:2] == "::")
    return [*characters, *lines]

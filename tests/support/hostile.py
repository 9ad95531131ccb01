"""Text as an enemy would name a file, and what no output of ours may hold of it."""

from __future__ import annotations

import unicodedata

TURNING = ["LRE", "RLE", "PDF", "LRO", "RLO", "LRI", "RLI", "FSI", "PDI"]
# All of Bidi_Control.
BIDI = "\u061c\u200e\u200f" + "".join(filter(lambda c: unicodedata.bidirectional(c) in TURNING, map(chr, range(2**16))))
CONTROLS = "".join(map(chr, (*range(32), *range(0x7F, 0xA0))))
NAME = f"::error::\n::error::##[error]b##vso[task.x]\x1b[31m[red][/nothing]\udcff\uffff\u2028\u200b<script>&\"'`|{BIDI}"


def shows_more_than_text(form: str, allowed: str = "\n") -> list[str]:
    """The characters of `form` that steer a terminal or the direction of writing, and the commands to a CI runner.

    A runner of GitHub carries out `##[` anywhere in a line, and `::` where the line begins, after spaces, with it.
    """
    found = sorted({*form} & {*BIDI, *CONTROLS, "\u2028", "\u200b", "\uffff", "\udcff"} - {*allowed})
    return found + [line for line in form.split("\n") if "##[" in line or "##vso[" in line or line.lstrip()[:2] == "::"]

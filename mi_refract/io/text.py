"""Text for users: sanitised text from other sources, and numbers in few digits.

`printable` sanitises names of files, channels and regimes, titles, reasons and messages of other programs for a
terminal, a log, HTML, XML, SVG or Markdown; each format then escapes its own markup. It replaces characters by U+FFFD.
`json_text` makes JSON that can be printed.
"""

from __future__ import annotations

import json
import math
import re

MARK = "\ufffd"

# Characters that XML 1.0 or UTF-8 cannot encode, that control a terminal, that change the direction of writing (all of
# Unicode's Bidi_Control), or that are invisible. U+200C and U+200D are kept: languages and emoji use them.
_HIDDEN = re.compile(
    "["
    "\x00-\x1f\x7f-\x9f"  # controls, including line ends, tabs and escapes
    "\xad\u034f\u061c\u115f\u1160\u17b4\u17b5\u180b-\u180f"
    "\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f"
    "\u3164\ufe00-\ufe0e\ufeff\uffa0\ufff0-\ufffb\ufffe\uffff"
    "\ud800-\udfff"  # surrogates: bytes of a file name that are not UTF-8
    "\U0001d173-\U0001d17a\U000e0000-\U000e0fff"
    "]"
)
# Commands that a runner of GitHub (also in the old form, anywhere in a line), Azure or TeamCity executes: `##[error]`,
# `##vso[…]`, and `::error::` at the start of a line.
_ANYWHERE = re.compile(r"##(?=\w*\[)")
_AT_THE_START = re.compile(r"^(\s*):(?=:)")


def printable(text: object) -> str:
    """Return the text on one line, with U+FFFD for each character that is invisible or has a side effect.

    Commands to the runner of a CI service are broken: one character of `##[error]` and of a leading `::` is replaced.
    Everything else, including markup, is unchanged. Applying the function twice changes nothing more.
    """
    visible = _HIDDEN.sub(MARK, str(text))
    return _AT_THE_START.sub(rf"\1{MARK}", _ANYWHERE.sub(f"#{MARK}", visible))


def printable_lines(text: object) -> str:
    """Return `printable` of each line of a text."""
    return "\n".join(map(printable, str(text).split("\n")))


def json_text(value: object, indent: int | None = None) -> str:
    """Return the value as JSON that is safe in a terminal or a log; parsing it gives all strings unchanged.

    ValueError for numbers that are not finite.
    """
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, indent=indent)
    return text.replace("##", "#\\u0023")  # `##` can only be in a string


def parse_number(text: str) -> float:
    """Return the number in a text. ValueError for anything else, also for `1_0`, which Python reads as 10."""
    if "_" in text:
        raise ValueError(f"{text}; expected a number")
    return float(text)


def compact(value: float, digits: int = 3) -> str:
    """Return `value` with at most `digits` significant digits, whole numbers below 10⁵ in full: 1.23e-7, 8056."""
    if not math.isfinite(value):
        return str(float(value))
    if value == int(value) and abs(value) < 1e5:
        return str(int(value))
    if abs(value) < 1e5 and abs(float(f"{value:.{digits}g}")) >= 1e3:
        return f"{value:.{max(digits - 4, 0)}f}"
    if 1e-2 <= abs(value) < 1e3:
        return f"{value:.{digits}g}"
    mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
    return f"{mantissa.rstrip('0').rstrip('.') if '.' in mantissa else mantissa}e{int(exponent)}"


def distinguishable(value: float, budget: float) -> tuple[str, str]:
    """Return both numbers as text, with enough digits to distinguish them if they differ."""
    for digits in range(3, 18):
        texts = compact(value, digits), compact(budget, digits)
        if texts[0] != texts[1] or value == budget:
            return texts
    return repr(value), repr(budget)


def beside_bound(value: float, bound: float) -> tuple[str, str]:
    """Return both numbers as text, distinguishable, the bound after ≤ or >, or after ≰ if the value is NaN."""
    text, limit = distinguishable(value, bound)
    return text, f"{'≤' if value <= bound else '>' if value > bound else '≰'} {limit}"

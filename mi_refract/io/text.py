"""Text for people: what somebody else wrote, made printable; numbers in few digits.

Names of files, channels and regimes, titles, reasons and messages of other programs pass through `printable` on their
way to a terminal, a log, HTML, XML, SVG or Markdown, each of which then escapes what is markup there. U+FFFD stands
where something was taken out. JSON that is printed is made by `json_text`.
"""

from __future__ import annotations

import json
import math
import re

MARK = "\ufffd"

# What XML 1.0 or UTF-8 cannot hold, what steers a terminal, what changes the direction of writing (all of Unicode's
# Bidi_Control), and what cannot be seen at all. U+200C and U+200D stay: languages and emoji are spelled with them.
_HIDDEN = re.compile(
    "["
    "\x00-\x1f\x7f-\x9f"  # controls: line ends, tabs and escapes among them
    "\xad\u034f\u061c\u115f\u1160\u17b4\u17b5\u180b-\u180f"
    "\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f"
    "\u3164\ufe00-\ufe0e\ufeff\uffa0\ufff0-\ufffb\ufffe\uffff"
    "\ud800-\udfff"  # surrogates: bytes of a file name that are no UTF-8
    "\U0001d173-\U0001d17a\U000e0000-\U000e0fff"
    "]"
)
# What a runner of GitHub (also in its old form, anywhere in a line), Azure or TeamCity would carry out: `##[error]`,
# `##vso[…]`, and `::error::` where a line begins with it.
_ANYWHERE = re.compile(r"##(?=\w*\[)")
_AT_THE_START = re.compile(r"^(\s*):(?=:)")


def printable(text: object) -> str:
    """The text on one line, without a character that is not shown, or that more than shows; U+FFFD stands for each.

    Commands to the runner of a CI service are broken up: of `##[error]` and of a leading `::` one character is
    replaced. Everything else, markup too, stays as it is. What is printable is left unchanged: it may pass twice.
    """
    shown = _HIDDEN.sub(MARK, str(text))
    return _AT_THE_START.sub(rf"\1{MARK}", _ANYWHERE.sub(f"#{MARK}", shown))


def printable_lines(text: object) -> str:
    """The same for a text of several lines, of which \\n is kept."""
    return "\n".join(map(printable, str(text).split("\n")))


def json_text(value: object, indent: int | None = None) -> str:
    """JSON of the value, for a terminal or a log: any string comes back unchanged from it, but is not shown as such.

    ValueError for numbers that are not finite.
    """
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, indent=indent)
    return text.replace("##", "#\\u0023")  # which only strings hold


def parse_number(text: str) -> float:
    """The number that a text says. ValueError for anything else, also for `1_0`, which Python reads as 10."""
    if "_" in text:
        raise ValueError(f"{text}; expected a number")
    return float(text)


def compact(value: float, digits: int = 3) -> str:
    """`value` in at most `digits` significant digits, whole numbers below 10⁵ in full: 1.23e-7, 8056."""
    if not math.isfinite(value):
        return str(float(value))
    if value == int(value) and abs(value) < 1e5:
        return str(int(value))
    if 1e3 <= abs(value) < 1e5:
        return f"{value:.{max(digits - 4, 0)}f}"
    if 1e-2 <= abs(value) < 1e3:
        return f"{value:.{digits}g}"
    mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
    return f"{mantissa.rstrip('0').rstrip('.') if '.' in mantissa else mantissa}e{int(exponent)}"


def distinguishable(value: float, budget: float) -> tuple[str, str]:
    """Both numbers as text, with as many digits as it takes to tell them apart when they differ."""
    for digits in range(3, 18):
        texts = compact(value, digits), compact(budget, digits)
        if texts[0] != texts[1] or value == budget:
            return texts
    return repr(value), repr(budget)


def beside_bound(value: float, bound: float) -> tuple[str, str]:
    """Both numbers as text, told apart, the bound with how the value compares: NaN is neither above nor below."""
    text, limit = distinguishable(value, bound)
    return text, f"{'≤' if value <= bound else '>' if value > bound else '≰'} {limit}"

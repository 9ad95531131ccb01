"""The flags of OpenImageIO's `idiff`, as a project has them, as options of the method `tolerance`.

`idiff`'s own defaults hold for flags that are not there: a difference of 1e-6 in one pixel fails. Checked against
`idiff` 2.4 and 3.2, which have the same flags and defaults.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

# By flag: the option of `tolerance`, and idiff's default.
THRESHOLDS: Mapping[str, tuple[str, float]] = {
    "-fail": ("fail", 1e-6),
    "-failrelative": ("fail_relative", 0.0),
    "-failpercent": ("fail_percent", 0.0),
    "-hardfail": ("hard_fail", math.inf),
    "-allowfailures": ("allow_failures", 0),
    "-warn": ("warn", 1e-6),
    "-warnrelative": ("warn_relative", 0.0),
    "-warnpercent": ("warn_percent", 0.0),
    "-hardwarn": ("hard_warn", math.inf),
}
EVERY = "-a"
QUIET = ("-q", "-v")  # how much idiff prints
IMAGE = {"-o": 1, "-od": 0, "-abs": 0, "-scale": 1}  # of its image of the difference, and how many words follow


@dataclass(frozen=True)
class Flags:
    """What the flags mean.

    `options`: all thresholds of `tolerance`. `every`: every part and MIP level is compared, not the first alone.
    `ignored`: those of the image of the difference, which is not written.
    """

    options: Mapping[str, Any]
    every: bool
    ignored: tuple[str, ...]


def parse(text: str) -> Flags:
    """The flags in a text, as a shell would divide it. Of one that is set twice the last counts, as with `idiff`.

    ValueError, one line that begins with the flag, for what `idiff` does not know or reads as 0, and for `-p`.
    """
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise ValueError(f"{text!r}: {error}; expected flags of idiff") from None
    options: dict[str, Any] = dict(THRESHOLDS.values())
    every, ignored = False, []
    while words:
        word = words.pop(0)
        flag = word[1:] if word.startswith("--") else word  # idiff takes both
        count = 1 if flag in THRESHOLDS else IMAGE.get(flag, 0)
        values, words = words[:count], words[count:]
        if len(values) < count:
            raise ValueError(f"{word}: no value follows; expected {word} VALUE")
        if flag in THRESHOLDS:
            option, default = THRESHOLDS[flag]
            options[option] = _number(word, values[0], whole=isinstance(default, int))
        elif flag in IMAGE:
            ignored.append(" ".join([word, *values]))
        elif flag == "-p":
            raise ValueError("-p: idiff's perceptual test; expected --method flip, which replaces it")
        elif not flag.startswith("-"):
            raise ValueError(f"{word}: not a flag; expected only flags, without the command idiff and the images")
        elif flag != EVERY and flag not in QUIET:
            raise ValueError(f"{word}: not a flag of idiff; expected {', '.join((*THRESHOLDS, EVERY, *QUIET, *IMAGE))}")
        every = every or flag == EVERY
    return Flags(options, every, tuple(ignored))


def _number(flag: str, text: str, whole: bool) -> float:
    """Stricter than idiff, which reads what is no number as 0, and a negative count as one that passes everything."""
    try:
        value = math.nan if "_" in text else float(text)
    except ValueError:
        value = math.nan
    if not value >= 0 or (whole and not value.is_integer()):
        raise ValueError(f"{flag} {text}; expected a {'whole ' * whole}number of at least 0")
    return int(value) if whole else value

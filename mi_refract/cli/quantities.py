"""Quantities of a command line, in the units that people write: 1%, 10m, 1h30m."""

from __future__ import annotations

import math
import re

from mi_refract.rendering.error_estimate import RelativeError

PLAIN = 0.1  # the largest share that is understood without a percent sign
_SECONDS = {"d": 86400.0, "h": 3600.0, "m": 60.0, "s": 1.0}


def parse_share(text: str, option: str) -> float:
    """`1%` or `0.01`, of 100 % at most. ValueError for anything else, also for `1` and `0.5`: is that 0.5 % or 50 %?"""
    number, percent = (text[:-1], True) if text.endswith("%") else (text, False)
    try:
        value = float(number) / (100 if percent else 1)
    except ValueError:
        value = 0.0
    if not 0 < value <= (1 if percent else PLAIN):
        raise ValueError(
            f"{option} {text}; expected more than 0 %, up to 100 %, such as 1% or 0.01 (up to {PLAIN} without %)"
        )
    return value


def parse_seconds(text: str, option: str) -> float:
    """`90`, `90s`, `10m`, `1h30m` or `2d` in seconds, more than 0. ValueError for anything else."""
    parts = re.fullmatch(
        r"(?=.)" + "".join(rf"(?:(\d{{1,9}}(?:\.\d{{1,9}})?){unit}{'?' if unit == 's' else ''})?" for unit in _SECONDS),
        text,
    )
    given = zip(parts.groups(), _SECONDS.values(), strict=True) if parts else ()
    seconds = sum(float(number) * unit for number, unit in given if number)
    if not seconds > 0:
        raise ValueError(f"{option} {text}; expected a time of more than 0, such as 90s, 10m or 1h30m")
    return seconds


def shown_error(error: RelativeError) -> str:
    """`0.42 % (0.40 to 0.44 %)`: an estimate and its interval, where there is one; or `at most 0.42 %`."""
    interval = f" ({100 * error.low:.2g} to {100 * error.high:.2g} %)" if math.isfinite(error.high) else ""
    return f"{'at most ' * error.at_most}{100 * error.value:.2g} %{interval}"

"""Quantities of a command line in the units that people write."""

from __future__ import annotations

import pytest

from mi_refract.cli.render_progress import parse_seconds, parse_share, shown_error
from mi_refract.rendering.end_conditions import RelativeError


@pytest.mark.parametrize("text, value", [("1%", 0.01), ("0.01", 0.01), ("100%", 1.0), ("1e-3", 0.001), ("0.5%", 0.005)])
def test_shares(text, value):
    assert parse_share(text, "--until") == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize("text", ["0", "0%", "-1%", "100.1%", "1.5", "nan", "inf", "%", "", "1 %%", "1", "0.5"])
def test_what_is_no_share(text):
    with pytest.raises(ValueError, match=r"^--until .*; expected more than 0 %, up to 100 %"):
        parse_share(text, "--until")


@pytest.mark.parametrize(
    "text, value",
    [("90", 90), ("90s", 90), ("10m", 600), ("1h30m", 5400), ("2d", 172800), ("0.5h", 1800), ("1m1s", 61)],
)
def test_times(text, value):
    assert parse_seconds(text, "--time") == value


@pytest.mark.parametrize("text", ["0", "0s", "-1", "1x", "", "m", "1m1h", "1e9", "nan", "inf", "10 m", "9" * 12])
def test_what_is_no_time(text):
    with pytest.raises(ValueError, match=r"^--time .*; expected a time of more than 0"):
        parse_seconds(text, "--time")


def test_an_error_has_its_interval_where_there_is_one():
    assert shown_error(RelativeError(0.0042, 0.004, 0.0044)) == "0.42 % (0.4 to 0.44 %)"
    assert shown_error(RelativeError(0.0042)) == "0.42 %"
    assert shown_error(RelativeError(0.0042, at_most=True)) == "at most 0.42 %"

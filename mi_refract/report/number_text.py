"""Numbers as short text, for pages, tables and messages."""

from __future__ import annotations

import math


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
    """Both as text, with as many digits as it takes to tell them apart when they differ."""
    for digits in range(3, 18):
        texts = compact(value, digits), compact(budget, digits)
        if texts[0] != texts[1] or value == budget:
            return texts
    return repr(value), repr(budget)


def beside_bound(value: float, bound: float) -> tuple[str, str]:
    """Both as text, told apart, the bound with how the value compares: NaN is neither above nor below."""
    text, limit = distinguishable(value, bound)
    return text, f"{'≤' if value <= bound else '>' if value > bound else '≰'} {limit}"

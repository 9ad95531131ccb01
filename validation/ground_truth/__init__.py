"""Is the plugin right with Mitsuba's own intersections, for bodies with known answers?

In: bodies with closed-form answers, CODE V's trace of a double Gauss, a rendered rainbow, a table of published and
closed-form numbers. Out: rows with each error divided by a bound on the sum of all rounding errors on the way.
"""

__all__ = ["rainbow", "standard_numbers", "traced_bodies"]

"""Is the plugin right through Mitsuba's own intersections, where the answer is known?

In: bodies with closed answers, CODE V's trace of a double Gauss, a rendered rainbow. Out: rows with each error over
the sum of what every rounding on the way may do.
"""

__all__ = ["rainbow", "traced_bodies"]

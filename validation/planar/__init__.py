"""Are the paths of `mi_refract.planar` right, and how long do they take?

In: planar scene files, and random scenes. Out: rows with distances from an independent retrace, from closed-form
answers and from Mitsuba's paths through extruded scenes, each divided by a bound on rounding errors; and times.
"""

__all__ = ["against_retrace", "closed_paths", "extruded_scenes", "joints", "times"]

"""Are the paths of `mi_refract.planar` right, and what do they cost?

In: planar scene files, and scenes by chance. Out: rows with distances from an independent retrace, from closed answers
and from Mitsuba's paths through the extruded scenes, over what rounding may have grown to; and times.
"""

__all__ = ["against_retrace", "closed_paths", "extruded_scenes", "times"]

"""Renders Mitsuba scene files into EXR files that say how they were made: the work of `mi-refract render`.

In: a scene file, values for its `<default>`s, samples per pixel, a seed; Mitsuba's present variant. Out: an EXR file
with the film's channels and, in its header, all that is needed to render it again.
"""

__all__ = ["scene_files"]

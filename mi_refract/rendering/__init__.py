"""Renders Mitsuba scene files in passes into EXR files that hold their own noise: the work of `mi-refract render`.

In: a scene file, values for its `<default>`s, what ends the render, a seed; Mitsuba's present variant. Out: an EXR file
with the film's channels, the variance of each, and in its header all that is needed to render it again; meanwhile a
checkpoint from which the same command goes on. The bits depend on none of: threads, order, interruptions,
workers that are alike.
"""

__all__ = [
    "checkpoint",
    "cluster_passes",
    "end_conditions",
    "long_render",
    "pass_plan",
    "pass_sums",
    "pilot",
    "render_pass",
    "render_settings",
    "scene_bundle",
    "scene_files",
]

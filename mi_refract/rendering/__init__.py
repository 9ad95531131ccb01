"""Rendering of Mitsuba scene files in passes into EXR files with per-channel variance, for `mi-refract render`.

Input: a scene file, values of its `<default>`s, limits of the render, a seed, and Mitsuba's present variant. Output: an
EXR file with the film's channels, the variance of each, and a header with everything that is needed to render it again;
until then a checkpoint, from which the same command resumes. The bits do not depend on the number of threads, the order
of passes, interruptions, or which of several equal workers renders a pass.
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

"""Code that all studies share: a run's context, timing, arrays and precisions, cameras, names of metrics, the headline.

In: the backends and variants of this machine. Out: profiles, settings, times and images for the rows of studies; and
the sentences of the report's first page, made from the rows.
"""

__all__ = [
    "array_settings",
    "bsdf_sampling",
    "command_line",
    "context",
    "glass_balls",
    "headline",
    "kernel_timing",
    "metrics",
    "render_methods",
]

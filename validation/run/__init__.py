"""What all studies share: the context of a run, timing, arrays and precisions, cameras, names of metrics, the headline.

In: what runs on this machine. Out: profiles, settings, times and images, of which the studies make rows; and the
sentences of the report's first page, made from the rows.
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

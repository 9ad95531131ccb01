"""What every study uses: the context of a run, timing, arrays and precisions, cameras, names of metrics.

In: what runs on this machine. Out: profiles, settings, times and images, of which the studies make rows.
"""

__all__ = [
    "array_settings",
    "bsdf_sampling",
    "command_line",
    "context",
    "kernel_timing",
    "metrics",
    "path_overlay",
    "render_methods",
]

"""Does `refract` render the same images as `dielectric`, as fast, and do unused features cost nothing?

In: the scenes of `scenes/`, with either plugin. Out: rows with differences, significance, times and kernel sizes, and
the images as EXR files.
"""

__all__ = [
    "against_dielectric",
    "colours",
    "gradients",
    "invisible_changes",
    "neighbours",
    "random_numbers",
    "rendering_passes",
    "samplers",
    "thin_panes",
    "unused_features",
]

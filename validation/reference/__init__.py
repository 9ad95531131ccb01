"""Reference answers that share no code with the package: closed forms, slower arithmetic, printed traces.

In: rays, scenes or parameters. Out: directions, paths and powers for comparison.
"""

__all__ = [
    "caustic_energy",
    "closed_forms",
    "exact_lens",
    "fast_reference",
    "optical_systems",
    "planar_retrace",
    "standard_numbers",
]

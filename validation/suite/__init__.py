"""How large are the errors of other renderers and libraries, ray by ray and in images of the same scenes?

In: rays and plain scenes for the programs of `renderers/`. Out: rows per system and check, and a matrix of them.
"""

__all__ = [
    "caustic_energies",
    "exports",
    "glasses",
    "lenses",
    "matrix",
    "per_ray",
    "rendered_images",
    "small_mistakes",
    "spectral_lines",
]

"""What do the errors of a formula come to, boundary after boundary, and in powers and derivatives?

In: formulas, Fresnel's equations, and scenes of many layers. Out: rows with each error beside the condition of its
problem, which is what rounded inputs alone may do.
"""

__all__ = ["derivatives", "energy", "layered_paths", "optical_chains"]

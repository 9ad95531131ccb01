"""How do the errors of a formula add up, boundary after boundary, and in powers and derivatives?

In: formulas, Fresnel's equations, and scenes of many layers. Out: rows with each error divided by the condition of its
problem, which is the error that rounded inputs alone may cause.
"""

__all__ = ["derivatives", "energy", "layered_paths", "optical_chains"]

"""How do a formula's errors add up over many boundaries, and in powers and derivatives?

In: formulas, Fresnel's equations, and scenes of many layers. Out: rows with each error divided by the condition of its
problem, the error that rounded inputs alone can cause.
"""

__all__ = ["derivatives", "energy", "layered_paths", "optical_chains"]

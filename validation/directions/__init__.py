"""How large is the error of each formula, ray by ray, and is it within the formula's a-priori bound?

In: the table of formulas, rays of every regime, certified answers of the oracle. Out: rows with errors, misclassified
total internal reflections, kernel times, and the worst rays.
"""

__all__ = ["bsdf_samples", "per_formula", "planted_defects", "search", "sweep"]

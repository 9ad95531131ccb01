"""How far is a formula off, ray by ray, and does it stay within its a-priori bound?

In: the table of formulas, rays of every regime, certified answers of the oracle. Out: rows with errors, misclassified
total internal reflections and kernel times, and the worst rays that were found.
"""

__all__ = ["bsdf_samples", "per_formula", "planted_defects", "search", "sweep", "worst_rays"]

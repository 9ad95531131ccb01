"""Study of the formulas, ray by ray."""

"""Study of formulas at work, boundary after boundary."""

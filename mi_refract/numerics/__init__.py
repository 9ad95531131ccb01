"""Error-free transforms and float expansions. No optics."""

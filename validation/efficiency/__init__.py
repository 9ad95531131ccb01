"""Study of error against run time in renders."""

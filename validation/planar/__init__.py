"""Study of the planar system."""

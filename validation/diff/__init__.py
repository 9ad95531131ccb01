"""Study of the image comparison."""

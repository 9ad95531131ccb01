"""Rows of measurements, and the files that show them."""

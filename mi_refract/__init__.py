"""The reference for refraction in rendering."""

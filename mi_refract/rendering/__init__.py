"""Render scene files into EXR files that say how they were made."""

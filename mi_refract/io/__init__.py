"""Files, processes and tables, for all other rooms. Nothing here knows about refraction or Mitsuba.

In: paths, pixels, commands, tables of TOML. Out: files that are complete or not there at all, images as arrays, the
output of other programs, checked values; errors are one line that says what, where, and what was expected.
"""

__all__ = ["errors", "image_file", "process_group", "reference_pack", "safe_files", "text", "typed_table"]

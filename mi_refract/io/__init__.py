"""Files, processes and tables, for all other packages. Independent of refraction and Mitsuba.

Input: paths, pixels, commands, TOML tables. Output: files that are complete or not written at all, images as arrays,
the output of other programs, checked values. Errors are one line: what is wrong, where, and what was expected.
"""

__all__ = ["errors", "image_file", "process_group", "reference_pack", "safe_files", "text", "typed_table"]

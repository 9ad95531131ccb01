"""Rows of measurements, and reports about them.

Input: `Row`s from a study or a self-test, and a `context` that all of them share. Output: `rows.json`, one offline HTML
page, and text for the terminal (`run_report`). Pages of other packages are made from the same parts: `documents` fills
a template of `templates/` and writes JUnit's XML, `embedded_images` puts EXR files on a page, `plots` makes SVG.
Nothing is measured or judged here.
"""

__all__ = ["documents", "embedded_images", "plots", "row", "run_report", "study_page"]

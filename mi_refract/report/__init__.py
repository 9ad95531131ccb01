"""Rows of measurements, and the files that show them.

In: `Row`s, made by a study or a self-test, and a `context` that all of them share. Out: `rows.json`, one offline
HTML page, and text for the terminal (`run_report`); the pages of other rooms are made from the same parts (`documents`
fills a template of `templates/` and writes JUnit's XML, `embedded_images` puts EXR files on a page, `plots` makes SVG).
Nothing is measured or judged here.
"""

__all__ = ["documents", "embedded_images", "plots", "row", "run_report", "study_page"]

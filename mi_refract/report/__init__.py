"""Rows of measurements, and the files that show them.

In: `Row`s, made by a study or a self-test, and a `context` that all of them share. Out: `rows.json`, one offline
HTML page, and text for the terminal (`run_report`); the pages of other rooms are made from the same parts (`html_page`
fills a template of `templates/`, `embedded_images` puts EXR files on a page, `plots` makes SVG, `number_text` writes
numbers, `junit` the XML of test results). Nothing is measured or judged here.
"""

__all__ = [
    "embedded_images",
    "html_page",
    "junit",
    "number_text",
    "plots",
    "row",
    "run_report",
    "study_page",
]

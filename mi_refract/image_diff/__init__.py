"""Compare images and folders of images.

In: image files (or arrays), what counts as equal (a method and its options), and `mi-refract.toml` for exceptions.
Out: a verdict for each image, with the numbers behind it; text, JSON, JUnit and one HTML page that show them; and
references replaced by the images that a person has accepted. What cannot be compared is an error, and a method that
could not have seen a difference says "inconclusive".
"""

__all__ = [
    "accept",
    "comparison",
    "file_pair",
    "folders",
    "html_report",
    "methods",
    "pairing",
    "pixelwise",
    "results",
    "results_file",
    "self_test",
    "settings",
    "text_reports",
    "tile_statistics",
]

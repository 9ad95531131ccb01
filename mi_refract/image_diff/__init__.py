"""Compare images and folders of images.

Input: image files or arrays, a method with its options, and `mi-refract.toml` with exceptions for single images.
Output: a verdict for each image with the measured numbers, as text, JSON, JUnit and one HTML page. `accept` replaces
references by new images. An image that cannot be compared is an error. A method that could not have detected a
difference returns "inconclusive".
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

"""Copies the new images that are not equal to their references:  new_images.py DIFF.json FOLDER

As they lie in FOLDER, `mi-refract accept REFERENCES FOLDER` makes them the references.
"""

import json
import shutil
import sys
from pathlib import Path

FORBIDDEN = set('":<>|*?\r\n')  # in names that actions/upload-artifact takes
NOT_EQUAL = ("error", "different", "inconclusive")


def wanted(results: dict) -> list[tuple[str, Path]]:
    """Name and file of the new images, or of the folders of renders, that are not equal."""
    found = [each for each in results["results"] if each["status"] in NOT_EQUAL and each["test"]]
    return [(each["name"], Path(each["test"])) for each in found]


def copy(name: str, file: Path, folder: Path) -> str:
    """Copy a new image, or a folder of renders, to its name in the folder; why it was left out, or ""."""
    if FORBIDDEN & set(name):
        return "GitHub takes no artifact with such a name"
    target = folder / name
    if not target.resolve().is_relative_to(folder.resolve()):
        return "its name leads out of the folder"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if file.is_dir() else shutil.copyfile)(file, target)
    except OSError as error:
        return str(error)
    return ""


def main(source: str, folder: str) -> None:
    """Copy them, and say on stderr what was left out."""
    for name, file in wanted(json.loads(Path(source).read_text("utf-8"))):
        if reason := copy(name, file, Path(folder)):
            print(f"new_images.py: {name!r}: left out of the artifact: {reason}", file=sys.stderr)


if __name__ == "__main__":
    main(*sys.argv[1:])

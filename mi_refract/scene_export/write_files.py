"""A plain scene in the files of other renderers: `write(plain, "radiance", folder)`."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from mi_refract.io import atomic

from .plain_scene import Plain
from .targets import cycles, luxcore, mitsuba, obj, povray, radiance
from .targets.shared_files import Files

TARGETS: dict[str, Callable[[Plain], Files]] = {
    "cycles": cycles.files,
    "luxcore": luxcore.files,
    "radiance": radiance.files,
    "povray": povray.files,
    "mitsuba": mitsuba.files,
    "obj+json": obj.files,
}


def write(plain: Plain, target: str, folder: str | os.PathLike[str]) -> list[Path]:
    """Write what the renderer needs into a new folder, or an empty one, complete or not at all; the files, sorted.

    ValueError for an unknown target, a scene that the renderer cannot say, a folder that holds something; OSError
    for one that cannot be written.
    """
    if target not in TARGETS:
        raise ValueError(f"target {target!r}: accepted: {', '.join(TARGETS)}")
    place = _free(folder)
    files = TARGETS[target](plain)
    with atomic.replacing(place) as temporary:
        temporary.mkdir()
        for name, content in files.items():
            (temporary / name).write_bytes(content)
    return [Path(folder) / name for name in sorted(files)]


def _free(folder: str | os.PathLike[str]) -> Path:
    """The folder without links in its path; an error unless it can be made or is empty."""
    place = Path(folder).resolve()
    if place.is_dir():
        if any(place.iterdir()):
            raise FileExistsError(f"{folder}: holds files already; accepted: a new folder or an empty one")
    elif place.exists():
        raise NotADirectoryError(f"{folder}: is no folder; accepted: a new folder or an empty one")
    if not place.parent.is_dir():
        raise NotADirectoryError(f"{folder}: {place.parent} is not a folder; accepted: a new folder in an existing one")
    if not os.access(place.parent, os.W_OK | os.X_OK):
        raise PermissionError(f"{folder}: {place.parent} is not writable; accepted: a writable folder")
    return place

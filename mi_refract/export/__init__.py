"""A plain scene in the files of other renderers: `write(plain, "radiance", folder)`."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Callable
from pathlib import Path

from ..plain_data import Plain
from . import cycles, luxcore, mitsuba, povray, radiance
from .common import Files

TARGETS: dict[str, Callable[[Plain], Files]] = {
    "povray": povray.files,
    "mitsuba": mitsuba.files,
    "radiance": radiance.files,
    "cycles": cycles.files,
    "luxcore": luxcore.files,
}


def write(plain: Plain, target: str, folder: str | os.PathLike[str]) -> list[Path]:
    """Write what the renderer needs into a new folder, or an empty one, complete or not at all; the files, sorted.

    ValueError for an unknown target, a scene that the renderer cannot say, a folder that holds something; OSError
    for one that cannot be written.
    """
    if target not in TARGETS:
        raise ValueError(f"target {target!r}: accepted: {', '.join(TARGETS)}")
    folder = Path(folder)
    _require_free(folder)
    files = TARGETS[target](plain)
    temporary = folder.with_name(f".{folder.name}.{uuid.uuid4().hex}.part")
    try:
        temporary.mkdir()
        for name, content in files.items():
            (temporary / name).write_bytes(content)
        temporary.replace(folder)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    return [folder / name for name in sorted(files)]


def _require_free(folder: Path) -> None:
    if folder.is_dir():
        if any(folder.iterdir()):
            raise FileExistsError(f"{folder}: holds files already; accepted: a new folder or an empty one")
    elif folder.exists() or folder.is_symlink():
        raise NotADirectoryError(f"{folder}: is no folder; accepted: a new folder or an empty one")
    parent = folder.absolute().parent
    if not parent.is_dir():
        raise NotADirectoryError(f"{folder}: {parent} is not a folder; accepted: a new folder in an existing one")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise PermissionError(f"{folder}: {parent} is not writable; accepted: a writable folder")

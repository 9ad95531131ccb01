"""The table of other renderers and libraries: one folder of systems/ for each, with its `mi-refract-renderer.toml`.

The file says how to install the system, how its functions are run, and how it behaved; README.md in
`mi_refract.ray_sets` explains its keys. A script that it names is in scripts/, a lock of its packages in locks/, and
what renders images, where that takes more than a command, in `image_renderers`. Programs under the GPL are run, never
imported nor redistributed.
"""

from __future__ import annotations

from pathlib import Path

from mi_refract.ray_sets import renderer_file

from .system import System, load

SYSTEMS_FOLDER = Path(__file__).parent / "systems"
SYSTEMS: dict[str, System] = {
    path.parent.name: load(path.parent) for path in sorted(SYSTEMS_FOLDER.glob(f"*/{renderer_file.NAME}"))
}


def join(folder: Path) -> System:
    """Take the renderer of a folder into the table. ValueError where one has its name; other errors as of `load`."""
    system = load(folder)
    if system.name in SYSTEMS:
        raise ValueError(f"{folder}: {system.name!r} is already the name of a renderer; rename the folder")
    SYSTEMS[system.name] = system
    return system

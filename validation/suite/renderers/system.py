"""The table of other renderers and libraries: each has a folder in systems/ with a `mi-refract-renderer.toml`.

The file says how to install the system, how to run its functions, and which errors were recorded; its keys are those of
`mi_refract.ray_sets.renderer_file`. Its scripts are in scripts/, the lock of its packages in locks/. If rendering
images takes more than a command, the code is in `image_renderers`. Programs under the GPL are run, never imported or
redistributed.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from mi_refract.io.typed_table import convert
from mi_refract.ray_sets import renderer_file
from mi_refract.ray_sets.renderer_file import ImagesCommand, RaysCommand, Text

SCRIPTS, LOCKS, SYSTEMS_FOLDER = (Path(__file__).parent / name for name in ("scripts", "locks", "systems"))


class Install(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [install], with one of pip, npm and apt."""

    megabytes: Annotated[int, Meta(ge=1, le=100_000)]  # on disk
    pip: tuple[Text, ...] = ()  # packages of PyPI, for an environment of their own; the lock has their dependencies
    python: str = ""  # the only Python version with wheels, such as "3.11"
    npm: tuple[Text, ...] = ()  # packages of npm, for a folder of their own with `node_modules`
    apt: tuple[Text, ...] = ()  # packages of the distribution, as PACKAGE=VERSION, with * for the distribution's part
    program: str = ""  # for apt: the program's name in PATH
    version: str = ""  # for apt: the version that the program prints
    small: bool = False  # runs in every profile, not only in `full`

    def __post_init__(self) -> None:
        """Raise ValueError unless exactly one of pip, npm and apt is given."""
        if sum(map(bool, (self.pip, self.npm, self.apt))) != 1:
            raise ValueError("expected one of pip, npm and apt")

    @property
    def source(self) -> str:
        """The command that installs the pinned version."""
        tool = "pip" if self.pip else "npm" if self.npm else "apt-get"
        return f"{tool} install {' '.join(self.pip or self.npm or self.apt)}"


@dataclass(frozen=True)
class System:
    """Another renderer or library. `install` is None if nothing must be installed.

    `folder`: where its commands run. `calls`: its functions of refraction. `images`: its command for images, if any.
    `lens`: its command that traces a lens.
    """

    name: str
    title: str
    licence: str = ""
    install: Install | None = None
    calls: tuple[RaysCommand, ...] = ()
    lens: tuple[str, ...] = ()
    images: ImagesCommand | None = None
    folder: Path = SYSTEMS_FOLDER

    @property
    def source(self) -> str:
        """The command that installs the system, or where it comes from."""
        if self.install:
            return self.install.source
        return "with this package" if SYSTEMS_FOLDER in (self.folder, self.folder.parent) else str(self.folder)


def load(folder: Path) -> System:
    """Return the system of a folder with a `mi-refract-renderer.toml`. Errors as of `renderer_file.load`."""
    file = renderer_file.load(folder)
    where = f"{folder / renderer_file.NAME}: install"
    install = None if file.install is None else convert(file.install, Install, where)
    name = folder.resolve().name
    return System(name, file.title, file.licence, install, file.rays, file.lens, file.images, folder)


SYSTEMS: dict[str, System] = {
    path.parent.name: load(path.parent) for path in sorted(SYSTEMS_FOLDER.glob(f"*/{renderer_file.NAME}"))
}


def join(folder: Path) -> System:
    """Put the renderer of a folder in front of the table. ValueError if its name is taken, or as of `load`."""
    system = load(folder)
    if system.name in SYSTEMS:
        raise ValueError(f"{folder}: {system.name!r} is already the name of a renderer; rename the folder")
    others = dict(SYSTEMS)
    SYSTEMS.clear()
    SYSTEMS.update({system.name: system} | others)
    return system

"""The table of other renderers and libraries: one folder of systems/ for each, with its `mi-refract-renderer.toml`.

The file says how to install the system, how its functions are run, and how it behaved; its keys are those of
`mi_refract.ray_sets.renderer_file`. A script that it names is in scripts/, a lock of its packages in locks/, and what
renders images, where that takes more than a command, in `image_renderers`. Programs under the GPL are run, never
imported nor redistributed.
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
    """The table [install]: one of pip, npm and apt."""

    megabytes: Annotated[int, Meta(ge=1, le=100_000)]  # on disk
    pip: tuple[Text, ...] = ()  # packages of PyPI, in an environment of their own; what they need is in the lock
    python: str = ""  # the one version of Python that there are wheels for, as "3.11"
    npm: tuple[Text, ...] = ()  # packages of npm, in a folder of their own with `node_modules`
    apt: tuple[Text, ...] = ()  # packages of the distribution, as PACKAGE=VERSION, with * for the distribution's part
    program: str = ""  # of apt: the program, found wherever it is in PATH
    version: str = ""  # of apt: what the program says of itself
    small: bool = False  # fit for every run

    def __post_init__(self) -> None:
        """ValueError for none of them, or several."""
        if sum(map(bool, (self.pip, self.npm, self.apt))) != 1:
            raise ValueError("expected one of pip, npm and apt")

    @property
    def source(self) -> str:
        """The command that installs it, in its pinned version."""
        tool = "pip" if self.pip else "npm" if self.npm else "apt-get"
        return f"{tool} install {' '.join(self.pip or self.npm or self.apt)}"


@dataclass(frozen=True)
class System:
    """Another renderer or library. `install` is None where nothing must be installed.

    `folder`: where its commands run. `calls`: its functions of refraction. `images`: how it renders, where a command
    does. `lens`: the command that traces a lens with it.
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
        """How to install it."""
        if self.install:
            return self.install.source
        return "with this package" if SYSTEMS_FOLDER in (self.folder, self.folder.parent) else str(self.folder)


def load(folder: Path) -> System:
    """The system of a folder with a `mi-refract-renderer.toml`. Errors as of `renderer_file.load`."""
    known = renderer_file.load(folder)
    where = f"{folder / renderer_file.NAME}: install"
    install = None if known.install is None else convert(known.install, Install, where)
    name = folder.resolve().name
    return System(name, known.title, known.licence, install, known.rays, known.lens, known.images, folder)


SYSTEMS: dict[str, System] = {
    path.parent.name: load(path.parent) for path in sorted(SYSTEMS_FOLDER.glob(f"*/{renderer_file.NAME}"))
}


def join(folder: Path) -> System:
    """Make the renderer of a folder the first of the table. ValueError where one has its name, or as of `load`."""
    system = load(folder)
    if system.name in SYSTEMS:
        raise ValueError(f"{folder}: {system.name!r} is already the name of a renderer; rename the folder")
    others = dict(SYSTEMS)
    SYSTEMS.clear()
    SYSTEMS.update({system.name: system} | others)
    return system

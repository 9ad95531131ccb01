"""What is known of another renderer: what it can do, how to install it, and how it behaved."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from mi_refract.io.typed_table import convert
from mi_refract.ray_sets import renderer_file
from mi_refract.ray_sets.renderer_file import ImagesCommand, RaysCommand, Text

SCRIPTS = Path(__file__).parent / "scripts"
LOCKS = Path(__file__).parent / "locks"

# The sets of rays of `validation.suite.per_ray`, by name.
RANDOM, APART, CRITICAL, GRAZING = "random", "random, apart", "near-critical", "grazing"
MATCHED, TOTAL, LARGE = "η ≈ 1", "total reflection", "k ≫ 1"


@dataclass(frozen=True)
class Pip:
    """A virtual environment of its own. What these packages need, as far as it is needed, is in the lock."""

    requirements: tuple[str, ...]
    python: str = ""  # the one version that there are wheels for, as "3.11"
    # The one of them that has no wheel: built from NAME.source.txt, by tools that are in the lock.
    built: str = field(default="", repr=False)  # its lock is in the mark of what is installed


@dataclass(frozen=True)
class Npm:
    """A folder of its own with `node_modules`."""

    packages: tuple[str, ...]


@dataclass(frozen=True)
class Apt:
    """A program of the whole machine, found wherever it is in PATH.

    `packages`: each as PACKAGE=VERSION, with * for the distribution's part. `version`: what the program says of itself.
    """

    program: str
    packages: tuple[str, ...]
    version: str = ""


@dataclass(frozen=True)
class System:
    """Another renderer or library. `needs` is None where nothing must be installed.

    `folder`: where its commands run. `small`: fit for every run. `calls`: its functions of refraction. `images`: how it
    renders, where a command does. `lens`: the command that traces a lens with it.
    """

    name: str
    title: str
    licence: str
    needs: Pip | Npm | Apt | None
    megabytes: int  # on disk
    small: bool = False
    calls: tuple[RaysCommand, ...] = ()
    lens: tuple[str, ...] = ()
    images: ImagesCommand | None = None
    folder: Path | None = None

    @property
    def source(self) -> str:
        """How to install it, in its pinned version."""
        match self.needs:
            case Pip(requirements=given):
                return f"pip install {' '.join(given)}"
            case Npm(packages=given):
                return f"npm install {' '.join(given)}"
            case Apt(packages=given):
                return f"apt-get install {' '.join(given)}"
        return "with this package" if self.folder is None or self.folder.parent.name == "systems" else str(self.folder)


class Install(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [install]: one of pip, npm and apt."""

    megabytes: Annotated[int, Meta(ge=1, le=100_000)]  # on disk
    pip: tuple[Text, ...] = ()  # packages of PyPI, in an environment of their own
    python: str = ""  # the one version of Python that they are for
    built: str = ""  # the one of them that has no wheel
    npm: tuple[Text, ...] = ()  # packages of npm, in a folder of their own
    apt: tuple[Text, ...] = ()  # packages of the distribution, as PACKAGE=VERSION
    program: str = ""  # of apt: the program that is found in PATH
    version: str = ""  # of apt: what the program says of itself
    small: bool = False  # fit for every run

    def __post_init__(self) -> None:
        """ValueError for none of them, or several."""
        if sum(map(bool, (self.pip, self.npm, self.apt))) != 1:
            raise ValueError("expected one of pip, npm and apt")

    @property
    def needs(self) -> Pip | Npm | Apt:
        """What is to be installed."""
        if self.npm:
            return Npm(self.npm)
        if self.apt:
            return Apt(self.program, self.apt, self.version)
        return Pip(self.pip, self.python, self.built)


def load(folder: Path) -> System:
    """The system of a folder with a `mi-refract-renderer.toml`. Errors as of `renderer_file.load`."""
    known = renderer_file.load(folder)
    where = f"{folder / renderer_file.NAME}: install"
    install = None if known.install is None else convert(known.install, Install, where)
    return System(
        folder.resolve().name,
        known.title,
        known.licence,
        install.needs if install else None,
        megabytes=install.megabytes if install else 0,
        small=install is None or install.small,
        calls=known.rays,
        lens=known.lens,
        images=known.images,
        folder=folder,
    )

"""What is known of another renderer: what it can do, how to install it, and how it behaved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

SCRIPTS = Path(__file__).parent / "scripts"
LOCKS = Path(__file__).parent / "locks"

# The sets of rays of `validation.suite.per_ray`, by name.
RANDOM, APART, CRITICAL, GRAZING = "random", "random, apart", "near-critical", "grazing"
MATCHED, TOTAL, LARGE = "η ≈ 1", "total reflection", "k ≫ 1"
RecordedError = Mapping[str, tuple[float, float]]  # worst angle in radians by set, from … to


def recorded_error(
    random: float | tuple, critical: float | tuple, grazing: float | tuple, matched: float | tuple
) -> RecordedError:
    """Worst angles in radians by set of rays, a number or a range (from, to); of random rays one for both sets."""
    sets = (RANDOM, APART, CRITICAL, GRAZING, MATCHED)
    figures = zip(sets, (random, random, critical, grazing, matched), strict=True)
    return {name: x if isinstance(x, tuple) else (x, x) for name, x in figures}


# What a function does with vectors that are not of unit length.
LENGTHS = {
    "": "",  # nobody looked
    "used": "takes vectors of any length as they are",
    "ray scaled": "scales the ray to unit length",
    "speed": "takes the index that a ray leaves from its speed 1/n, not from the medium",
}

# Everyone who writes down GLSL's formula in that precision.
RECORDED_F32 = recorded_error(3e-6, 6e-4, (1e-7, 3e-7), (5e-7, 1e-6))
RECORDED_F64 = recorded_error(9e-15, 1.9e-12, 2e-16, 1e-15)


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
class RefractFunction:
    """A function of refraction in one precision: `script` of scripts/ reads rays and writes answers, both as CSV.

    `told`: the signal of total internal reflection, one of `mi_refract.ray_sets.tir_signal.TIR`. `gives_up`: the
    cos²θ_t below which it treats a ray as totally reflected, by its documentation. `remark`: known
    differences. `lengths`: one of LENGTHS.
    """

    title: str
    precision: str  # "f32" or "f64"
    script: str
    recorded_error: RecordedError
    told: str
    arguments: tuple[str, ...] = ()
    gives_up: float = 0.0
    remark: str = ""
    lengths: str = ""


@dataclass(frozen=True)
class System:
    """Another renderer or library. `needs` is None where this package's own environment has it.

    `small`: fit for every run. A program under the GPL is run, never imported nor passed on.
    """

    name: str
    title: str
    licence: str
    needs: Pip | Npm | Apt | None
    megabytes: int  # on disk
    small: bool = False
    calls: tuple[RefractFunction, ...] = field(default=())
    draws: bool = False  # whether it renders images
    lens: str = ""  # the script of scripts/ that traces a lens with it

    @property
    def source(self) -> str:
        """What brings it, in its pinned version."""
        match self.needs:
            case Pip(requirements=given):
                return f"pip install {' '.join(given)}"
            case Npm(packages=given):
                return f"npm install {' '.join(given)}"
            case Apt(packages=given):
                return f"apt-get install {' '.join(given)}"
        return "with this package"

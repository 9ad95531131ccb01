"""The input of a study: the profile (the amount of measurements) and the context of a run."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace
from pathlib import Path

from mi_refract import backend
from mi_refract.report.row import Reason

SCENES = Path(__file__).parents[2] / "scenes"
QUICK_SCENES = ("diamond", "furnace", "mirage", "prism", "sphere")  # of the profile `quick`
# Scenes in which the built-in is no reference: images are shown, but need not agree.
NO_REFERENCE = {"mirage": "the built-in turns slanting edges into stairs here, so it is no reference: see Paths"}


@dataclass(frozen=True)
class Profile:
    """The amount of measurements, in rays, samples per pixel and renders; images have `resolution`² pixels.

    `name` is "quick", "standard" or "full": studies with other sizes have a table by that name.
    """

    name: str
    rays: int  # per regime, against the oracle
    scalar_rays: int  # the same on scalar arrays, which cost a Python call per operation
    streamed_rays: int  # per timing, large enough to stream from memory
    repeats: int  # timings per formula, in turn; rows have the median
    resolution: int
    spp: int  # of each of the `pairs` renders of a scene with either plugin
    pairs: int
    curve_spp: tuple[int, ...]  # error against run time
    every_formula: bool = False  # renders with every formula, not only the default one
    sweep_rays: int = 30_000  # per regime, screened
    certified: int = 32  # of these, per formula: the worst rays, and as many with misclassified TIR
    generations: int = 4  # of the search

    @property
    def quick(self) -> bool:
        """Whether studies should run in seconds: with fewer scenes and settings, not only fewer rays."""
        return self.name == "quick"


PROFILES = {
    "quick": Profile(
        "quick", 1000, 30, 1 << 21, 6, 96, 16, 8, (1, 4, 16), sweep_rays=10_000, certified=8, generations=2
    ),
    "standard": Profile("standard", 4000, 150, 1 << 21, 11, 128, 16, 8, (1, 4, 16)),
    "full": Profile("full", 100_000, 1000, 1 << 22, 21, 192, 32, 8, (1, 4, 16, 64), True, 10_000_000, 300, 1000),
}
# Profiles for machines with scalar variants only, on which a render takes a hundred times as long.
SCALAR_PROFILES = {
    "quick": Profile("quick", 1000, 100, 100, 6, 12, 4, 8, (1, 4)),
    "standard": Profile("standard", 4000, 150, 200, 9, 12, 4, 8, (1, 4)),
    "full": Profile("full", 100_000, 2000, 1000, 9, 32, 8, 12, (1, 4, 16), True),
}


def profiles(variant: str) -> dict[str, Profile]:
    """Return the profiles for a variant of Mitsuba, by name."""
    return SCALAR_PROFILES if variant.startswith("scalar") else PROFILES


@dataclass(frozen=True)
class Context:
    """One run: its profile, its output folder, the variant that renders, and what runs on this machine."""

    profile: Profile
    out: Path
    variant: str
    backends: dict[str, backend.Backend]
    variants: dict[str, str | None]  # every variant of the wheel: None, or the reason why it cannot run here

    @property
    def scalar(self) -> bool:
        """Whether only scalar variants run here."""
        return self.variant.startswith("scalar")

    @property
    def scenes(self) -> list[Path]:
        """The scene files that are rendered: all, or five in the profile `quick`."""
        paths = sorted(SCENES.glob("*.xml"))
        return [path for path in paths if path.stem in QUICK_SCENES] if self.profile.quick else paths

    @property
    def comparable(self) -> list[Path]:
        """The `scenes` that the built-in can render, too."""
        return [path for path in self.scenes if not beyond_builtin(path)]


def here(profile: str, out: Path, variant: str) -> Context:
    """Return the context of a run on this machine. If CUDA cannot run, the reason is a `Reason` with the remedy."""

    def reason(name: str, text: str) -> str:
        return Reason(text, "an NVIDIA GPU with its driver") if name.startswith("cuda") else text

    backends = {name: replace(entry, reason=reason(name, entry.reason)) for name, entry in backend.detect().items()}
    variants = {name: text and reason(name, text) for name, text in backend.usable_variants().items()}
    return Context(profiles(variant)[profile], out, variant, backends, variants)


def beyond_builtin(path: Path) -> bool:
    """Return whether a scene needs `refract_path`: it has dispersion or absorption, which `dielectric` lacks."""
    defaults = ET.parse(path).getroot().iter("default")
    return any((node.get("name"), node.get("value")) == ("integrator", "refract_path") for node in defaults)

"""What a study is given and what it returns: profiles, the context of a run, and tasks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mi_refract.backend import Backend
from mi_refract.report.row import Row

SCENES = Path(__file__).parents[2] / "scenes"
# Where the built-in is no reference: images are shown, and nothing is demanded of their agreement.
NO_REFERENCE = {"mirage": "the built-in turns slanting edges into stairs here, so it is no reference: see Paths"}


@dataclass(frozen=True)
class Profile:
    """How much is measured. Sizes in rays, samples per pixel and renders; one image is `resolution` squared."""

    name: str
    rays: int  # per regime, against the oracle
    scalar_rays: int  # the same on scalar arrays, which cost a Python call per operation
    streamed_rays: int  # per timing, large enough to stream from memory
    repeats: int  # timings per formula, in turn; the median counts
    resolution: int
    spp: int  # of each of the `pairs` renders of a scene with either plugin
    pairs: int
    curve_spp: tuple[int, ...]  # error against run time
    every_formula: bool  # renders with every formula, not only the default one
    sweep_rays: int = 30_000  # per regime, screened
    certified: int = 32  # of these, per formula: the worst, and as many misjudged ones
    generations: int = 4  # of the search


PROFILES = {
    "quick": Profile("quick", 4000, 150, 1 << 21, 11, 128, 16, 8, (1, 4, 16), False),
    "full": Profile("full", 100_000, 1000, 1 << 22, 21, 192, 32, 8, (1, 4, 16, 64), True, 10_000_000, 300, 1000),
}
# Where only scalar variants run, a render costs a hundred times as much.
SCALAR_PROFILES = {
    "quick": Profile("quick", 4000, 150, 200, 9, 12, 4, 8, (1, 4), False),
    "full": Profile("full", 100_000, 2000, 1000, 9, 32, 8, 12, (1, 4, 16), True),
}


@dataclass(frozen=True)
class Context:
    """One run: its profile, its output folder, the variant that renders, and what runs on this machine."""

    profile: Profile
    out: Path
    variant: str
    backends: dict[str, Backend]
    variants: dict[str, str | None]  # of the wheel: None, or why it cannot run here


@dataclass(frozen=True)
class Task:
    """A unit of work that is finished or not: interrupting a run keeps the rows of finished tasks."""

    name: str
    run: Callable[[], list[Row]]

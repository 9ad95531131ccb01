"""Mutants of our own code: a line is changed as by a slip, and a test must notice.

Of five packages, places where cosmic-ray would change the code are drawn with a seed, and each change is made in a
private copy of the source tree, where the tests that guard the package run until one fails. A mutant that all of them
pass has survived: a test is missing, or the change cannot be observed, which `explained_mutants.json` says in one line.
The unmutated copy must pass first.

`python -m validation.robustness.code_mutants COUNT [SEED]` prints each outcome, and at the end the counts as JSON.
"""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

from mi_refract.report.row import Row
from validation.limits import UNEXPLAINED
from validation.run.context import Context
from validation.study import Study, Task, about

from . import mutant_runs, mutants
from .mutant_runs import Job, Outcome
from .mutants import Mutant

COUNTS = {"quick": 3, "standard": 20, "full": 220}
ALL = "all packages"
# Tests by package; those named after a module come first.
GUARDS = {
    "plugins": ("plugins", "rendering/test_render_pass.py", "rendering/test_scene_files.py", "test_rooms.py"),
    "image_diff": ("image_diff", "cli/test_diff.py", "cli/test_diff_forms.py", "test_rooms.py"),
    "ray_sets": ("ray_sets", "cli/test_rays.py", "test_rooms.py"),
    "accuracy": ("accuracy", "ray_sets", "formulas", "validation/test_sweep.py", "test_rooms.py"),
    "scene_export": ("scene_export", "cli/test_scene.py", "test_rooms.py"),
}
LONGEST = 600.0  # seconds of a package's tests without a mutant
TERMS = {
    "mutants": "changes of a line, one at a time",
    "killed": "changes that a test noticed, or that never ended",
    "survived": "changes that all tests passed",
    "explained": "those of them that cannot be observed, each for a reason that is kept",
    "score": "killed or explained, of all",
    "unexplained": "neither killed nor explained, of all",
}


@dataclass(frozen=True)
class Found:
    """What became of a mutant; `reason` explains why it survived, "" where nothing does."""

    mutant: Mutant
    killed: bool
    said: str
    seconds: float
    reason: str

    @property
    def unexplained(self) -> bool:
        """Whether a test is missing."""
        return not self.killed and not self.reason


def explained() -> dict[tuple[str, ...], str]:
    """Reasons by the key of a mutant."""
    entries = json.loads(Path(__file__).with_name("explained_mutants.json").read_text("utf-8"))
    return {(e["file"], e["operator"], e["line"], e["becomes"]): e["reason"] for e in entries}


def guards(root: Path, mutant: Mutant) -> list[str]:
    """Test files of the mutant's package: its module's own first, then those that name the module."""
    stem = Path(mutant.path).stem
    paths = {path: path.read_text("utf-8") for path in _test_files(root, mutant.room)}
    ranked = sorted(paths, key=lambda path: (path.name != f"test_{stem}.py", stem not in paths[path], path))
    return [path.relative_to(root).as_posix() for path in ranked]


def _test_files(root: Path, room: str) -> list[Path]:
    folders = [root / "tests" / name for name in GUARDS[room]]
    return [path for found in folders for path in (sorted(found.rglob("test_*.py")) if found.is_dir() else [found])]


def examine(
    chosen: Sequence[Mutant], root: Path = mutant_runs.ROOT, told: Callable[[Found], None] = lambda found: None
) -> list[Found]:
    """What became of each; `told` hears of it at once. Errors: ValueError where tests fail without a mutant."""
    reasons, found = explained(), []
    workers = mutant_runs.workers(len(chosen))
    with mutant_runs.folder_of_copies() as name:
        times = _unmutated(sorted({mutant.room for mutant in chosen}), Path(name), workers, root)
        jobs = [Job(str(m), guards(root, m), 5 * times[m.room] + 60, m) for m in chosen]
        with closing(mutant_runs.run(jobs, Path(name), workers, root)) as outcomes:
            for outcome in outcomes:
                assert outcome.job.mutant
                reason = reasons.get(outcome.job.mutant.key, "") if outcome.passed else ""
                found.append(Found(outcome.job.mutant, not outcome.passed, outcome.said, outcome.seconds, reason))
                told(found[-1])
    return sorted(found, key=lambda each: chosen.index(each.mutant))


def _unmutated(rooms: Sequence[str], folder: Path, workers: int, root: Path) -> dict[str, float]:
    """Seconds that the tests of each package take as it is, by package."""
    jobs = [Job(room, [str(path.relative_to(root)) for path in _test_files(root, room)], LONGEST) for room in rooms]
    outcomes: list[Outcome] = list(mutant_runs.run(jobs, folder, workers, root))
    for outcome in outcomes:
        if not outcome.passed:
            raise ValueError(f"the tests of {outcome.job.name} fail without a mutant: {outcome.said}")
    return {outcome.job.name: outcome.seconds for outcome in outcomes}


def values(found: Sequence[Found]) -> dict[str, float]:
    """Counts and shares."""
    count, survived = len(found), sum(not each.killed for each in found)
    missed = sum(each.unexplained for each in found)
    share = missed / count if count else float("nan")
    counts = {"mutants": count, "killed": count - survived, "survived": survived, "explained": survived - missed}
    return {name: float(value) for name, value in counts.items()} | {"score": 1 - share, "unexplained": share}


def rows(found: Sequence[Found], seed: int) -> list[Row]:
    """A row per package, and one for all, which has the bound: a package may have three mutants."""
    made = []
    for room in (ALL, *mutants.ROOMS):
        here = [each for each in found if room in (ALL, each.mutant.room)]
        if not here:
            continue
        command = f"python -m validation.robustness.code_mutants {len(found)} {seed}"
        replay: dict[str, Any] = {"seed": seed, "command": command}
        if left := [str(each.mutant) for each in here if each.unexplained]:
            replay["survivors"] = left
        budgets = {"unexplained": UNEXPLAINED} if room == ALL else {}
        made.append(Row(STUDY.name, room, "mutated code", "", values(here), budgets=budgets, replay=replay))
    return made


def missing(root: Path = mutant_runs.ROOT) -> str:
    """Why there is nothing to measure with; "" where there is."""
    if not (root / "tests").is_dir():
        return "no folder of tests beside the package: run it in a checkout"
    absent = [name for name in ("cosmic_ray", "pytest") if find_spec(name) is None]
    return f"{' and '.join(absent)} not installed: pip install -e '.[dev]'" if absent else ""


def _rows(context: Context) -> list[Row]:
    if reason := missing():
        return [Row(STUDY.name, ALL, "mutated code", "", reason=reason)]
    return rows(examine(mutants.sample(mutant_runs.ROOT, COUNTS[context.profile.name], seed=0)), seed=0)


STUDY = Study(
    "code mutants",
    "Mutants of our own code",
    about(__doc__),
    TERMS,
    lambda context: [Task("code mutants", lambda: _rows(context), timed=True)],
)


def _tell(found: Found) -> None:
    outcome = "killed" if found.killed else "explained" if found.reason else "SURVIVED"
    print(f"{outcome} {found.seconds:.0f} s {found.mutant} [{found.reason or found.said}]", file=sys.stderr, flush=True)


def _terminated(*_: Any) -> NoReturn:
    """An exception, for which the tests that run are ended and their copies removed."""
    sys.exit(128 + signal.SIGTERM)


def main(arguments: Sequence[str]) -> int:
    """`COUNT [SEED]`; 1 where the bound is broken."""
    signal.signal(signal.SIGTERM, _terminated)
    count, seed = int(arguments[0]), int(arguments[1]) if arguments[1:] else 0
    if reason := missing():
        raise SystemExit(f"code mutants: {reason}")
    made = rows(examine(mutants.sample(mutant_runs.ROOT, count, seed), told=_tell), seed)
    print(json.dumps({row.subject: row.values | row.replay for row in made}, indent=1))
    return int(any(row.verdict == "fail" for row in made))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

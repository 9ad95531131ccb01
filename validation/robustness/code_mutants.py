"""Mutants of our own code: a line is changed as by a slip, and a test must notice.

Lines of five packages are drawn with a seed. Each gets one change that cosmic-ray would make there, in a private copy
of the source tree, where the tests that guard the package run until one fails. A mutant that all of them pass has
survived: a test is missing, or the change cannot be observed, which `explained_mutants.json` says in one line. The
unmutated copy must pass first.

`python -m validation.robustness.code_mutants COUNT [SEED]` prints each outcome, and at the end the counts as JSON.
"""

from __future__ import annotations

import ast
import hashlib
import json
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from itertools import zip_longest
from pathlib import Path
from typing import Any

from mi_refract.io import process_group
from mi_refract.io.errors import TooMuchOutputError
from mi_refract.report.row import Row
from validation.limits import UNEXPLAINED
from validation.run.context import Context
from validation.study import Study, Task, about

ROOT = Path(__file__).parents[2]
COPIED = ("mi_refract", "tests", "validation", "scenes", ".ci", ".github")  # and the files beside them
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
MEMORY = 24 << 20  # KiB of address space, of all processes together
# Without the tests that some machines skip: a browser takes more address space than a process may here.
PYTEST = (sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-m", "not skipif")
PASSED, FAILED = 0, 1  # pytest's exit codes; others above 1 are of pytest itself
TERMS = {
    "mutants": "changes of a line, one at a time",
    "killed": "changes that a test noticed, or that never ended",
    "survived": "changes that all tests passed",
    "explained": "those of them that cannot be observed, each for a reason that is kept",
    "score": "killed or explained, of all",
    "unexplained": "neither killed nor explained, of all",
}


@dataclass(frozen=True)
class Mutant:
    """`operator` of cosmic-ray, where it applies for the `occurrence`-th time in `path`; `line` becomes another one."""

    path: str  # from the root: "mi_refract/plugins/refract.py"
    operator: str
    occurrence: int
    number: int  # of the line
    line: str
    becomes: str

    @property
    def room(self) -> str:
        """The package that it is in."""
        return Path(self.path).parts[1]

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What stays the same when other lines come and go."""
        return self.path, self.operator, self.line, self.becomes

    def __str__(self) -> str:
        """Where it is, and what changes."""
        return f"{self.path}:{self.number}: {self.operator}: {self.line} → {self.becomes}"


@dataclass(frozen=True)
class Found:
    """What became of a mutant; `reason` explains why it survived, "" where nothing does."""

    mutant: Mutant
    killed: bool
    said: str
    seconds: float
    reason: str = ""

    @property
    def unexplained(self) -> bool:
        """Whether a test is missing."""
        return not self.killed and not self.reason


# The sample -----------------------------------------------------------------------------------------------------------


def sample(root: Path, count: int, seed: int) -> list[Mutant]:
    """A mutant of each of the first `count` lines that have one: a smaller sample begins a larger one.

    The order is that of a hash of the seed, the file and the text of the line: an edit changes what is drawn from the
    lines that it changes, and nothing else.
    """
    drawn = []
    for path in [path for room in GUARDS for path in sorted((root / "mi_refract" / room).rglob("*.py"))]:
        before: Counter[str] = Counter()
        name = path.relative_to(root).as_posix()
        for number, line in enumerate(path.read_text("utf-8").splitlines(), 1):
            before[line.strip()] += 1
            key = repr((seed, name, line.strip(), before[line.strip()]))
            drawn.append((hashlib.sha256(key.encode()).hexdigest(), name, number))
    found: list[Mutant] = []
    for digest, name, number in sorted(drawn):
        if len(found) == count:
            break
        places = [each for (line, *_), each in _places((root / name).read_text("utf-8")).items() if line == number]
        rng = random.Random(digest)
        rng.shuffle(places)
        chosen = (_mutant(root, name, *rng.choice(place)) for place in places)
        found += [mutant for mutant in chosen if mutant][:1]
    return found


def every(root: Path, name: str) -> list[Mutant]:
    """All mutants of a file."""
    places = _places((root / name).read_text("utf-8")).values()
    made = (_mutant(root, name, *each) for place in places for each in place)
    return [mutant for mutant in made if mutant]


@cache
def operators() -> dict[str, Any]:
    """Cosmic-ray's operators by name, but for those that take arguments and draw random numbers."""
    from cosmic_ray.operators.provider import OperatorProvider

    provider = OperatorProvider()
    return {name: provider[name]() for name in sorted(provider) if not provider[name].arguments()}


@cache
def _places(source: str) -> dict[tuple[int, int, str], list[tuple[str, int]]]:
    """Operators and occurrences by line, column and family: a binary operator has eleven replacements in one place."""
    from cosmic_ray.ast import ast_nodes, get_ast

    nodes: list[Any] = list(ast_nodes(get_ast(source)))
    found: dict[tuple[int, int, str], list[tuple[str, int]]] = {}
    for name, operator in operators().items():
        starts = (start for node in nodes for start, _ in operator.mutation_positions(node))
        for occurrence, start in enumerate(starts):
            found.setdefault((*start, name.partition("_")[0]), []).append((name, occurrence))
    return found


def _mutant(root: Path, name: str, operator: str, occurrence: int) -> Mutant | None:
    """The mutant; None where it does not compile, or cannot change what the module does."""
    source = (root / name).read_text("utf-8")
    changed = _mutated(source, operator, occurrence)
    try:
        if _behaviour(changed) == _behaviour(source):
            return None
    except SyntaxError:
        return None
    old, new = source.splitlines(), changed.splitlines()
    index = next(i for i, (a, b) in enumerate(zip_longest(old, new)) if a != b)
    becomes = plain(new[index])
    if operator == "RemoveDecorator":  # with the empty lines above it
        index, becomes = next(i for i in range(index, len(old)) if old[i].lstrip().startswith("@")), ""
    return Mutant(name, operator, occurrence, index + 1, plain(old[index]), becomes)


def _mutated(source: str, operator: str, occurrence: int) -> str:
    from cosmic_ray.mutating import mutate_code

    return str(mutate_code(source, operators()[operator], occurrence))


def plain(line: str) -> str:
    """As mutants name it."""
    return " ".join(line.split())


def _behaviour(source: str) -> str:
    """The module without annotations, `__all__` and what is imported for annotations."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        for name in {"annotation", "returns"} & {*node._fields}:
            setattr(node, name, None)
        if (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)) or (
            isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
        ):
            node.__dict__.clear()
    return ast.dump(tree)


# Tests ----------------------------------------------------------------------------------------------------------------


def guards(root: Path, mutant: Mutant) -> list[str]:
    """Test files of the mutant's package: its module's own first, then those that name the module."""
    stem = Path(mutant.path).stem
    paths = {path: (root / path).read_text("utf-8") for path in test_files(root, mutant.room)}
    return sorted(paths, key=lambda path: (Path(path).name != f"test_{stem}.py", stem not in paths[path], path))


def test_files(root: Path, room: str) -> list[str]:
    """Of a package."""
    places = [root / "tests" / name for name in GUARDS[room]]
    files = [path for place in places for path in (sorted(place.rglob("test_*.py")) if place.is_dir() else [place])]
    return [path.relative_to(root).as_posix() for path in files]


Tests = tuple[Sequence[str], float, Mutant | None]  # files, the seconds that they may take, what is mutated
_COPY = Path()  # of the tree, for the tests of this process


def _copy(root: Path, folder: str) -> None:
    global _COPY
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    _COPY = Path(tempfile.mkdtemp(dir=folder))
    for path in root.iterdir():
        if path.is_file():
            shutil.copy2(path, _COPY)
        elif path.name in COPIED:
            shutil.copytree(path, _COPY / path.name, ignore=shutil.ignore_patterns("__pycache__"))


def _test(tests: Tests) -> tuple[bool, str, float]:
    """Whether they passed, what was said last, and the seconds. ValueError where there was no test to run."""
    (files, timeout, mutant), began, temporary = tests, time.monotonic(), _COPY / "tmp"
    source = "" if mutant is None else (_COPY / mutant.path).read_text("utf-8")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    own = {"PYTHONPATH": str(_COPY), "TMPDIR": str(temporary), "PYTHONDONTWRITEBYTECODE": "1"}
    limit = f'ulimit -v {MEMORY // (os.cpu_count() or 1)} 2>/dev/null; exec "$@"'  # not every system limits it
    command = ["sh", "-c", limit, "sh", *PYTEST, f"--basetemp={_COPY / 'temporary'}", *files]
    try:
        if mutant:
            (_COPY / mutant.path).write_text(_mutated(source, mutant.operator, mutant.occurrence), "utf-8")
        ended = process_group.run(command, b"", timeout, cwd=_COPY, env=kept | own, keep_stderr=True)
    except (TimeoutError, TooMuchOutputError) as error:
        return False, str(error), time.monotonic() - began
    finally:
        if mutant:
            (_COPY / mutant.path).write_text(source, "utf-8")
    said = [line for line in ended.out.decode(errors="replace").splitlines() if line.strip()]
    if ended.status > FAILED and not mutant:
        raise ValueError(f"{ended.describe}: {' '.join(files)[:200]}")
    failed = [line for line in said if line.startswith(("FAILED ", "ERROR "))]
    return ended.status == PASSED, (failed or said or [""])[-1][:300], time.monotonic() - began


def examine(chosen: Sequence[Mutant], root: Path = ROOT) -> Iterator[Found]:
    """What became of each, as it is known. ValueError where tests fail without a mutant."""
    reasons = explained()
    workers = max(1, min(os.cpu_count() or 1, len(chosen)))
    spawned = multiprocessing.get_context("spawn")  # a fork would lack the threads of Dr.Jit
    with (
        tempfile.TemporaryDirectory(prefix="mutants-", ignore_cleanup_errors=True) as folder,
        spawned.Pool(workers, _copy, (root, folder)) as pool,  # ends its processes at the end, and they their tests
    ):
        rooms, times = sorted({mutant.room for mutant in chosen}), {}
        unmutated = pool.imap(_test, [(test_files(root, room), LONGEST, None) for room in rooms])
        for room, (passed, said, seconds) in zip(rooms, unmutated, strict=True):
            if not passed:
                raise ValueError(f"the tests of {room} fail without a mutant: {said}")
            times[room] = seconds
        work = [(guards(root, mutant), 5 * times[mutant.room] + 60, mutant) for mutant in chosen]
        for mutant, (passed, said, seconds) in zip(chosen, pool.imap(_test, work), strict=True):
            reason = reasons.get(mutant.key, "") if passed else ""
            yield Found(mutant, not passed, said, seconds, reason)


# Rows -----------------------------------------------------------------------------------------------------------------


def explained() -> dict[tuple[str, ...], str]:
    """Reasons by the key of a mutant."""
    entries = json.loads(Path(__file__).with_name("explained_mutants.json").read_text("utf-8"))
    return {(e["file"], e["operator"], e["line"], e["becomes"]): e["reason"] for e in entries}


def rows(found: Sequence[Found], seed: int) -> list[Row]:
    """A row per package, and one for all, which has the bound: a package may have three mutants."""
    made = []
    for room in (ALL, *GUARDS):
        here = [each for each in found if room in (ALL, each.mutant.room)]
        if not here:
            continue
        count, survived = len(here), sum(not each.killed for each in here)
        missed = [str(each.mutant) for each in here if each.unexplained]
        values = {"mutants": count, "killed": count - survived, "survived": survived}
        values |= {"explained": survived - len(missed)}
        shares = {"score": 1 - len(missed) / count, "unexplained": len(missed) / count}
        replay: dict[str, Any] = {"seed": seed, "command": f"python -m {MODULE} {len(found)} {seed}"}
        replay |= {"survivors": missed} if missed else {}
        budgets = {"unexplained": UNEXPLAINED} if room == ALL else {}
        row = Row(STUDY.name, room, "mutated code", "", values | shares, budgets=budgets, replay=replay)
        made.append(row)
    return made


def missing(root: Path = ROOT) -> str:
    """Why there is nothing to measure with; "" where there is."""
    if not (root / "tests").is_dir():
        return "no folder of tests beside the package: run it in a checkout"
    absent = [name for name in ("cosmic_ray", "pytest") if find_spec(name) is None]
    return f"{' and '.join(absent)} not installed: pip install -e '.[dev]'" if absent else ""


def _rows(context: Context) -> list[Row]:
    if reason := missing():
        return [Row(STUDY.name, ALL, "mutated code", "", reason=reason)]
    return rows(list(examine(sample(ROOT, COUNTS[context.profile.name], seed=0))), seed=0)


MODULE = "validation.robustness.code_mutants"
STUDY = Study(
    "code mutants",
    "Mutants of our own code",
    about(__doc__),
    TERMS,
    lambda context: [Task("code mutants", lambda: _rows(context), timed=True)],
)


def main(arguments: Sequence[str]) -> int:
    """`COUNT [SEED]`; 1 where the bound is broken."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # ends the tests, removes the copies
    count, seed = int(arguments[0]), int(arguments[1]) if arguments[1:] else 0
    if reason := missing():
        raise SystemExit(f"code mutants: {reason}")
    found = []
    for each in examine(sample(ROOT, count, seed)):
        found.append(each)
        outcome = "killed" if each.killed else "explained" if each.reason else "SURVIVED"
        print(f"{outcome} {each.seconds:.0f} s {each.mutant} [{each.reason or each.said}]", file=sys.stderr, flush=True)
    made = rows(found, seed)
    print(json.dumps({row.subject: row.values | row.replay for row in made}, indent=1))
    return int(any(row.verdict == "fail" for row in made))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

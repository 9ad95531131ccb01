"""Mutants of the package's code: a line gets a small mistake, which a test must detect.

Lines of all subpackages are drawn with a seed. Each line gets one change by cosmic-ray, in a private copy of the source
tree; the tests of its subpackage run there until one fails (`cosmic-ray.toml`). A mutant that passes all of them has
survived: a test is missing, or the change cannot be observed, for a reason in `explained_mutants.json`. A test that
kills a mutant must pass without the mutant.

`python -m validation.robustness.code_mutants COUNT [SEED]` prints each outcome, and at the end the counts as JSON.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import itertools
import json
import random
import re
import shutil
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import chdir
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer

from mi_refract.report.row import Row
from validation.limits import UNEXPLAINED
from validation.run import command_line
from validation.run.context import Context
from validation.study import Study, Task, about

ROOT = Path(__file__).parents[2]
CONFIG = Path(__file__).with_name("cosmic-ray.toml")
COPIED = ("mi_refract", "tests", "validation", "scenes", ".ci", ".github")  # and the files in the root folder
COUNTS = {"quick": 3, "standard": 20, "full": 220}
PART = 10  # mutants of a task: an interrupted run keeps the results of finished tasks
SEED = 0  # each release gets a new one
ALL = "all rooms"
COMMANDS = {"image_diff": "diff", "ray_sets": "rays", "scene_export": "scene", "rendering": "render", "planar": "trace"}
TERMS = {
    "mutants": "changes of a line, one at a time",
    "killed": "changes that a test detected, or that never ended",
    "survived": "changes that passed all tests",
    "explained": "survivors that cannot be observed, each for a recorded reason",
    "score": "share of mutants that are killed or explained",
    "unexplained": "share of mutants that are neither killed nor explained",
}


@dataclass(frozen=True)
class Mutant:
    """A change by an `operator` of cosmic-ray at its `occurrence` in `path`; `line` becomes another line."""

    path: str  # from the root: "mi_refract/plugins/refract.py"
    operator: str
    occurrence: int
    number: int  # of the line
    line: str
    becomes: str

    @property
    def room(self) -> str:
        """The subpackage, or the module, of the changed line."""
        return Path(self.path).parts[1].removesuffix(".py")

    @property
    def reason(self) -> str:
        """The reason why the change cannot be observed; "" without one. Line numbers do not matter."""
        entries = json.loads(Path(__file__).with_name("explained_mutants.json").read_text("utf-8"))
        key = {"file": self.path, "operator": self.operator, "line": self.line, "becomes": self.becomes}
        return next((entry["reason"] for entry in entries if entry.items() >= key.items()), "")

    def __str__(self) -> str:
        """The place, and the change."""
        return f"{self.path}:{self.number}: {self.operator}: {self.line} → {self.becomes}"


def sample(root: Path, count: int, seed: int) -> list[Mutant]:
    """Return a mutant of each of the first `count` lines that have one; a smaller sample begins a larger one.

    Lines are ordered by a hash of the seed, the file and the line's text: an edit only affects the lines it changes.
    """
    drawn = []
    for path in sorted((root / "mi_refract").rglob("*.py")):
        before: Counter[str] = Counter()
        name = path.relative_to(root).as_posix()
        for number, line in enumerate(path.read_text("utf-8").splitlines(), 1):
            before[line.strip()] += 1
            key = repr((seed, name, line.strip(), before[line.strip()]))
            drawn.append((hashlib.sha256(key.encode()).hexdigest(), name, number))

    def of_line(digest: str, name: str, number: int) -> Iterator[Mutant]:
        places = _places((root / name).read_text("utf-8")).get(number, [])
        kinds = sorted({operator.partition("_")[0] for operator, _ in places})
        rng = random.Random(digest)
        rng.shuffle(kinds)  # kinds first: a binary operator has eleven replacements, which would dominate
        candidates = (rng.choice([x for x in places if x[0].partition("_")[0] == kind]) for kind in kinds)
        yield from filter(None, (_mutant(root, name, number, *candidate) for candidate in candidates))

    lines = (next(of_line(*line), None) for line in sorted(drawn))
    return list(itertools.islice(filter(None, lines), count))


def every(root: Path, name: str) -> list[Mutant]:
    """Return all mutants of a file."""
    places = _places((root / name).read_text("utf-8"))
    mutants = (_mutant(root, name, number, *place) for number, of_line in places.items() for place in of_line)
    return [mutant for mutant in mutants if mutant]


@functools.cache
def _places(source: str) -> dict[int, list[tuple[str, int]]]:
    """Return operators and their occurrences by line number, without operators that take arguments."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.operators.provider import OperatorProvider

    nodes: list[Any] = list(ast_nodes(get_ast(source)))
    provider = OperatorProvider()
    places: dict[int, list[tuple[str, int]]] = {}
    for name in sorted(name for name in provider if not provider[name].arguments()):
        starts = (start for node in nodes for start, _ in provider[name]().mutation_positions(node))
        for occurrence, (number, _) in enumerate(starts):
            places.setdefault(number, []).append((name, occurrence))
    return places


def _mutant(root: Path, name: str, number: int, operator: str, occurrence: int) -> Mutant | None:
    """Return the mutant; None if it does not compile, or cannot change the module's behaviour."""
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.operators.provider import OperatorProvider

    source = (root / name).read_text("utf-8")
    changed = str(mutate_code(source, OperatorProvider()[operator](), occurrence))

    def behaviour(source: str) -> str:
        """Return the module without annotations, `__all__` and imports for annotations; "" if it does not compile."""
        try:
            tree = ast.parse(source)
        except SyntaxError:
            return ""
        for node in ast.walk(tree):
            for field in {"annotation", "returns"} & {*node._fields}:
                setattr(node, field, None)
            if (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)) or (
                isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
            ):
                node.__dict__.clear()
        return ast.dump(tree)

    if behaviour(changed) in (behaviour(source), ""):
        return None
    new = changed.splitlines() if operator != "RemoveDecorator" else [""] * number
    line, becomes = (" ".join(text[number - 1].split()) for text in (source.splitlines(), new))
    return Mutant(name, operator, occurrence, number, line, becomes)


def guards(root: Path, path: str) -> list[str]:
    """Return the tests of a file: those named after it, of its subpackage, of its command, and of the structure."""
    room, stem = Path(path).parts[1].removesuffix(".py"), Path(path).stem
    tests = root / "tests"
    places = [*sorted(tests.rglob(f"test_{stem}.py")), tests / room, tests / f"test_{room}.py"]
    places += [*sorted((tests / "cli").glob(f"test_{COMMANDS.get(room, room)}*.py")), tests / "test_rooms.py"]
    return list(dict.fromkeys(place.relative_to(root).as_posix() for place in places if place.exists()))


def examine(mutants: Iterable[Mutant], root: Path = ROOT) -> Iterator[tuple[Mutant, bool]]:
    """Yield each mutant and whether it was killed. ValueError if a test fails without a mutant, too."""
    from cosmic_ray.config import load_config
    from cosmic_ray.mutating import mutate_and_test
    from cosmic_ray.testing import TestOutcome, run_tests
    from cosmic_ray.work_item import MutationSpec, WorkerOutcome

    config, passed = load_config(str(CONFIG)), set()
    with tempfile.TemporaryDirectory(prefix="mutants-", ignore_cleanup_errors=True) as folder:
        copy, temporary = Path(folder, "tree"), Path(folder, "tmp")
        temporary.mkdir()
        others = {path.name for path in root.iterdir() if path.is_dir()} - set(COPIED)
        shutil.copytree(root, copy, ignore=lambda at, _: others if at == str(root) else {"__pycache__"})
        command = functools.partial(config.test_command.format, tree=copy, temporary=temporary, python=sys.executable)
        for mutant in mutants:
            tests, place = " ".join(guards(root, mutant.path)), ((mutant.number, 0), (mutant.number, 1))
            spec = MutationSpec(mutant.path, f"core/{mutant.operator}", mutant.occurrence, *place)
            with chdir(copy):
                result = mutate_and_test([spec], command(tests=tests), config.timeout)
                if result.worker_outcome is not WorkerOutcome.NORMAL:
                    raise ValueError(f"{mutant}: not tested: {(result.output or '')[-300:]}")
                if result.is_killed:
                    # Without a named test, tests hung or pytest did not start: then all must pass without the mutant.
                    test = re.search(r"^(?:FAILED|ERROR) ([^\s\[]+)", result.output or "", re.MULTILINE)
                    tests = test[1] if test else tests
                    if tests not in passed:
                        if run_tests(command(tests=tests), config.timeout)[0] is not TestOutcome.SURVIVED:
                            raise ValueError(f"{tests} fails without a mutant")
                        passed.add(tests)
            yield mutant, result.is_killed


def row_of(mutant: Mutant, killed: bool) -> Row:
    """Return the row of one mutant, for `summarise`."""
    values = {"killed": float(killed), "explained": float(not killed and bool(mutant.reason))}
    return Row(STUDY.name, mutant.room, str(mutant), "", values)


def summarise(rows: list[Row], seed: int = SEED) -> list[Row]:
    """Replace the rows of mutants by one per subpackage, and one for all.

    Only the row for all has a bound: a subpackage may have only a few mutants.
    """
    outcomes = [row for row in rows if row.study == STUDY.name and row.values]
    result = [row for row in rows if row not in outcomes]
    for room in dict.fromkeys([ALL, *sorted(row.subject for row in outcomes)] if outcomes else []):
        of_room = [row for row in outcomes if room in (ALL, row.subject)]
        count = len(of_room)
        killed, explained = (sum(row.values[metric] for row in of_room) for metric in ("killed", "explained"))
        missed = [row.case for row in of_room if not any(row.values.values())]
        values: dict[str, float] = {"mutants": count, "killed": killed, "survived": count - killed}
        values |= {"explained": explained, "score": 1 - len(missed) / count, "unexplained": len(missed) / count}
        replay: dict[str, Any] = {"seed": seed, "command": f"python -m {MODULE} {len(outcomes)} {seed}"}
        replay |= {"survivors": missed} if missed else {}
        budgets = {"unexplained": UNEXPLAINED} if room == ALL else {}
        result.append(Row(STUDY.name, room, "mutated code", "", values, budgets, replay=replay))
    return result


def missing(root: Path = ROOT) -> str:
    """Return why mutants cannot be tested here; "" if they can."""
    if not (root / "tests").is_dir():
        return "no folder of tests beside the package: run it in a checkout"
    absent = [name for name in ("cosmic_ray", "pytest") if find_spec(name) is None]
    return f"{' and '.join(absent)} not installed: pip install -e '.[dev]'" if absent else ""


def tasks(context: Context) -> list[Task]:
    """Return tasks of PART mutants each. They run alone: on a busy machine, a test may fail for lack of time."""
    if reason := missing():
        return [Task("code mutants", lambda: [Row(STUDY.name, ALL, "mutated code", "", reason=reason)])]
    count = COUNTS[context.profile.name]
    drawn = functools.cache(lambda: sample(ROOT, count, SEED))  # takes a minute; all parts of a run share it

    def measured(first: int) -> list[Row]:
        return [row_of(*outcome) for outcome in examine(drawn()[first : first + PART])]

    return [
        Task(f"code mutants: from {first + 1} of {count}", functools.partial(measured, first), timed=True)
        for first in range(0, count, PART)
    ]


MODULE = "validation.robustness.code_mutants"
STUDY = Study("code mutants", "Mutants of our own code", about(__doc__), TERMS, tasks, summarise=summarise)
app = command_line.application()


@app.command()
def main(
    count: Annotated[int, typer.Argument(min=1, help="Number of mutants.")],
    seed: Annotated[int, typer.Argument(min=0, help="Seed that selects the lines.")] = SEED,
) -> int:
    """Mutate lines of the package, and run its tests. Exit code 1: more mutants survive than allowed."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # removes the copy
    if reason := missing():
        raise ValueError(reason)
    outcomes = []
    for mutant, killed in examine(sample(ROOT, count, seed)):
        outcomes.append((mutant, killed))
        print(f"{'killed' if killed else mutant.reason or 'SURVIVED'}: {mutant}", file=sys.stderr, flush=True)
    results = summarise([row_of(*outcome) for outcome in outcomes], seed)
    print(json.dumps({row.subject: row.values | row.replay for row in results}, indent=1))
    return int(any(row.verdict == "fail" for row in results))


if __name__ == "__main__":
    sys.exit(command_line.exit_code(app, MODULE, sys.argv[1:]))

"""Mutants of our own code: a line is changed as by a slip, and a test must notice.

Lines of all rooms are drawn with a seed. Each gets one change that cosmic-ray would make there, in a private copy of
the source tree, where the tests of its room run until one fails (`cosmic-ray.toml`). A mutant that all of them pass has
survived: a test is missing, or the change cannot be observed, which `explained_mutants.json` says in one line. A test
that kills a mutant must pass without it.

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
from collections.abc import Iterable, Iterator, Sequence
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
COPIED = ("mi_refract", "tests", "validation", "scenes", ".ci", ".github")  # and the files beside them
COUNTS = {"quick": 3, "standard": 20, "full": 220}
SEED = 0  # a new one for each release
ALL = "all rooms"
COMMANDS = {"image_diff": "diff", "ray_sets": "rays", "scene_export": "scene", "rendering": "render", "planar": "trace"}
TERMS = {
    "mutants": "changes of a line, one at a time",
    "killed": "changes that a test noticed, or that never ended",
    "survived": "changes that all tests passed",
    "explained": "those of them that cannot be observed, each for a recorded reason",
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
        """The package, or the module, that it is in."""
        return Path(self.path).parts[1].removesuffix(".py")

    @property
    def reason(self) -> str:
        """Why it cannot be observed; "" where nothing says so. Numbers of lines do not matter."""
        entries = json.loads(Path(__file__).with_name("explained_mutants.json").read_text("utf-8"))
        key = {"file": self.path, "operator": self.operator, "line": self.line, "becomes": self.becomes}
        return next((entry["reason"] for entry in entries if entry.items() >= key.items()), "")

    def __str__(self) -> str:
        """Where it is, and what changes."""
        return f"{self.path}:{self.number}: {self.operator}: {self.line} → {self.becomes}"


def sample(root: Path, count: int, seed: int) -> list[Mutant]:
    """A mutant of each of the first `count` lines that have one: a smaller sample begins a larger one.

    The order is that of a hash of the seed, the file and the text of the line: an edit changes what is drawn from the
    lines that it changes, and nothing else.
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
        rng.shuffle(kinds)  # a binary operator has eleven replacements: the kind of change is drawn before the change
        chosen = (rng.choice([x for x in places if x[0].partition("_")[0] == kind]) for kind in kinds)
        yield from filter(None, (_mutant(root, name, number, *place) for place in chosen))

    lines = (next(of_line(*line), None) for line in sorted(drawn))
    return list(itertools.islice(filter(None, lines), count))


def every(root: Path, name: str) -> list[Mutant]:
    """All mutants of a file."""
    places = _places((root / name).read_text("utf-8"))
    mutants = (_mutant(root, name, number, *place) for number, here in places.items() for place in here)
    return [mutant for mutant in mutants if mutant]


@functools.cache
def _places(source: str) -> dict[int, list[tuple[str, int]]]:
    """Operators and occurrences by line; without the operators that take arguments."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.operators.provider import OperatorProvider

    nodes: list[Any] = list(ast_nodes(get_ast(source)))
    provider = OperatorProvider()
    found: dict[int, list[tuple[str, int]]] = {}
    for name in sorted(name for name in provider if not provider[name].arguments()):
        starts = (start for node in nodes for start, _ in provider[name]().mutation_positions(node))
        for occurrence, (number, _) in enumerate(starts):
            found.setdefault(number, []).append((name, occurrence))
    return found


def _mutant(root: Path, name: str, number: int, operator: str, occurrence: int) -> Mutant | None:
    """The mutant; None where it does not compile, or cannot change what the module does."""
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.operators.provider import OperatorProvider

    source = (root / name).read_text("utf-8")
    changed = str(mutate_code(source, OperatorProvider()[operator](), occurrence))

    def behaviour(source: str) -> str:
        """The module without annotations, `__all__` and imports for annotations; "" where it does not compile."""
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
    """The tests of a file: those named after it, then those of its room and of its command, then that of structure."""
    room, stem = Path(path).parts[1].removesuffix(".py"), Path(path).stem
    tests = root / "tests"
    places = [*sorted(tests.rglob(f"test_{stem}.py")), tests / room, tests / f"test_{room}.py"]
    places += [*sorted((tests / "cli").glob(f"test_{COMMANDS.get(room, room)}*.py")), tests / "test_rooms.py"]
    return list(dict.fromkeys(place.relative_to(root).as_posix() for place in places if place.exists()))


def examine(mutants: Iterable[Mutant], root: Path = ROOT) -> Iterator[tuple[Mutant, bool]]:
    """Whether each was killed. ValueError where a test that fails does so without a mutant, too."""
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
                    # Where no test is named, it hung, or pytest could not start: then all must pass without it.
                    test = re.search(r"^(?:FAILED|ERROR) ([^\s\[]+)", result.output or "", re.MULTILINE)
                    tests = test[1] if test else tests
                    if tests not in passed:
                        if run_tests(command(tests=tests), config.timeout)[0] is not TestOutcome.SURVIVED:
                            raise ValueError(f"{tests} fails without a mutant")
                        passed.add(tests)
            yield mutant, result.is_killed


def rows(found: Sequence[tuple[Mutant, bool]], seed: int) -> list[Row]:
    """A row per room, and one for all, which has the bound: a room may have three mutants."""
    made = []
    for room in dict.fromkeys([ALL, *sorted(mutant.room for mutant, _ in found)]):
        here = [(mutant, killed) for mutant, killed in found if room in (ALL, mutant.room)]
        survived = [mutant for mutant, killed in here if not killed]
        missed = [str(mutant) for mutant in survived if not mutant.reason]
        values: dict[str, float] = {"mutants": len(here), "killed": len(here) - len(survived)}
        values |= {"survived": len(survived), "explained": len(survived) - len(missed)}
        values |= {"score": 1 - len(missed) / len(here), "unexplained": len(missed) / len(here)}
        replay: dict[str, Any] = {"seed": seed, "command": f"python -m {MODULE} {len(found)} {seed}"}
        replay |= {"survivors": missed} if missed else {}
        budgets = {"unexplained": UNEXPLAINED} if room == ALL else {}
        made.append(Row(STUDY.name, room, "mutated code", "", values, budgets, replay=replay))
    return made


def missing(root: Path = ROOT) -> str:
    """Why there is nothing to measure with; "" where there is."""
    if not (root / "tests").is_dir():
        return "no folder of tests beside the package: run it in a checkout"
    absent = [name for name in ("cosmic_ray", "pytest") if find_spec(name) is None]
    return f"{' and '.join(absent)} not installed: pip install -e '.[dev]'" if absent else ""


def tasks(context: Context) -> list[Task]:
    """All mutants in one task, which runs alone."""

    def measured() -> list[Row]:
        if reason := missing():
            return [Row(STUDY.name, ALL, "mutated code", "", reason=reason)]
        return rows(list(examine(sample(ROOT, COUNTS[context.profile.name], SEED))), SEED)

    return [Task("code mutants", measured, timed=True)]


MODULE = "validation.robustness.code_mutants"
STUDY = Study("code mutants", "Mutants of our own code", about(__doc__), TERMS, tasks)
app = command_line.application()


@app.command()
def main(
    count: Annotated[int, typer.Argument(min=1, help="Number of mutants.")],
    seed: Annotated[int, typer.Argument(min=0, help="What chooses the lines.")] = SEED,
) -> int:
    """Mutate lines of the package, and run its tests; exit code 1 where more survive than may."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # removes the copy
    if reason := missing():
        raise ValueError(reason)
    found = []
    for mutant, killed in examine(sample(ROOT, count, seed)):
        found.append((mutant, killed))
        print(f"{'killed' if killed else mutant.reason or 'SURVIVED'}: {mutant}", file=sys.stderr, flush=True)
    made = rows(found, seed)
    print(json.dumps({row.subject: row.values | row.replay for row in made}, indent=1))
    return int(any(row.verdict == "fail" for row in made))


if __name__ == "__main__":
    sys.exit(command_line.exit_code(app, MODULE, sys.argv[1:]))

"""Runs tasks, saves the rows of each as soon as it is finished, and resumes after an interruption."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import mi_refract
from mi_refract.io.atomic import write_atomically
from mi_refract.report.row import Row
from validation.run.context import SCENES, Context
from validation.study import Task
from validation.suite.renderers import SYSTEMS, environments

Finished = tuple[list[Row], dict[str, Any]]  # of a task: its rows, and what it took


class Elsewhere(Protocol):
    """Other processes that run tasks."""

    def run(self, work: Sequence[tuple[int, str]], context: Context) -> Iterator[tuple[int, Finished]]:
        """Of every task (number, name) what it gave, in the order in which they end. A task's own errors pass."""
        ...


def run(
    tasks: list[Task], context: Context, elsewhere: Elsewhere | None = None
) -> tuple[list[Row], list[dict[str, Any]]]:
    """All rows, in the order of the tasks, and what each task took: its name, seconds, and seconds of all processors.

    `elsewhere` first runs those that are not timed. When it has ended the others run here, one after the other: what is
    timed is alone. Errors and KeyboardInterrupt pass, with the finished tasks kept.
    """
    store = context.out / "unfinished"
    store.mkdir(parents=True, exist_ok=True)
    fingerprint = _fingerprint(context)
    kept = [store / f"{hashlib.sha256((fingerprint + task.name).encode()).hexdigest()[:24]}.json" for task in tasks]
    found: dict[int, Finished] = {}
    with _progress(len(tasks)) as advance:
        if elsewhere and (work := [(i, t.name) for i, t in enumerate(tasks) if not t.timed and not _recall(kept[i])]):
            for i, finished in elsewhere.run(work, context):
                advance(tasks[i].name)
                found[i] = _keep(kept[i], finished)
        for i, task in enumerate(tasks):
            if i not in found:
                advance(task.name)
                found[i] = _recall(kept[i]) or _keep(kept[i], timed(task))
    order = [found[i] for i in range(len(tasks))]
    return [row for rows, _ in order for row in rows], [spent for _, spent in order]


def _keep(kept: Path, finished: Finished) -> Finished:
    rows, spent = finished
    write_atomically(kept, json.dumps({"spent": spent, "rows": [row.as_dict() for row in rows]}))
    return finished


def timed(task: Task) -> Finished:
    """Run a task; its rows and what it took."""
    start, processors = time.perf_counter(), sum(os.times()[:4])
    rows = task.run()
    seconds, cpu = time.perf_counter() - start, sum(os.times()[:4]) - processors
    return rows, {"task": task.name, "seconds": round(seconds, 2), "CPU seconds": round(cpu, 2)}


def forget(context: Context) -> None:
    """Drop the rows of single tasks: once the report is written, the next run starts anew."""
    shutil.rmtree(context.out / "unfinished", ignore_errors=True)


def describe(context: Context, seconds: float) -> dict[str, Any]:
    """What all rows share."""
    return {
        "profile": context.profile.name,
        "variant": context.variant,
        "libLLVM": context.backends["llvm"].library,
        "seconds": round(seconds, 1),
        "versions": {"mi_refract": mi_refract.__version__}
        | {name: version(name) for name in ("mitsuba", "drjit", "numpy", "OpenImageIO", "python-flint")},
        "machine": {"processor": _processor(), "system": platform.platform(), "python": platform.python_version()},
    }


def _processor() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{len(names)} × {names[0]}" if names else platform.machine()


def _recall(kept: Path) -> Finished | None:
    """The rows of a finished task and its time; None if there are none or they cannot be read."""
    try:
        record = json.loads(kept.read_text())
        return [Row.from_dict(data) for data in record["rows"]], dict(record["spent"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _fingerprint(context: Context) -> str:
    """Rows are taken up again only for the same sources, scenes, profile, variant, versions and other renderers."""
    about = (context.profile, context.variant, installed(), describe(context, 0))
    return hashlib.sha256((repr(about) + sources()).encode()).hexdigest()


def installed() -> list[str]:
    """The other renderers that are installed here."""
    return [name for name, system in SYSTEMS.items() if not environments.absent(system)]


def sources() -> str:
    """A digest of all that rows are made from: the package, the validation, scenes and tests."""
    digest = hashlib.sha256()
    ours, here = Path(mi_refract.__file__).parent, Path(__file__).parent
    sources = [ours.rglob("*.py"), here.rglob("*.py"), here.rglob("*.json"), here.rglob("*.j2"), SCENES.rglob("*")]
    sources.append(here.with_name("tests").rglob("*.py"))  # which mutants of our code must not pass
    for path in sorted(path for group in sources for path in group if path.is_file()):
        digest.update(path.read_bytes())
    return digest.hexdigest()


@contextmanager
def _progress(total: int) -> Iterator[Any]:
    """A bar on a terminal, a line per task elsewhere; `advance(name)` says what begins."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda name: console.print(name, highlight=False)
        return
    columns = BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}")
    with Progress(*columns, console=console, transient=True) as progress:
        bar, started = progress.add_task("", total=total), [0]

        def advance(name: str) -> None:
            progress.update(bar, completed=started[0], description=name)
            started[0] += 1

        yield advance

"""Runs tasks, saves the rows of each task when it finishes, and resumes after an interruption.

Tasks that measure no times may run on the workers of a Dask cluster. A task holds closures and cannot be sent. A worker
therefore builds the same list of tasks and runs the task of the given name. It must have the same sources, versions and
other renderers. It returns rows, and images as the contents of files.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import distributions, version
from pathlib import Path
from typing import Any

import mi_refract
from mi_refract.cluster import connection, on_worker
from mi_refract.cluster import workers as calls
from mi_refract.io.image_file import installed_version
from mi_refract.io.safe_files import write_atomically
from mi_refract.io.text import printable
from mi_refract.report.row import Row
from validation.run.context import SCENES, Context, here
from validation.suite.renderers import SYSTEMS, environments

from . import repeated
from .study import Study, Task

# Packages that rows depend on, in addition to those that a render depends on.
PACKAGES = ("numpy", "scipy", "OpenImageIO", "python-flint", "jinja2")
Finished = tuple[list[Row], dict[str, Any]]  # a task's rows; its name and times


def tasks(studies: Sequence[Study], context: Context) -> list[Task]:
    """Return all tasks of these studies, including repetitions with other seeds. ValueError if two have one name."""
    every = [task for study in studies for task in (*study.tasks(context), *repeated.tasks(study, context))]
    names = Counter(task.name for task in every)
    if duplicates := [name for name, count in names.items() if count > 1]:
        raise ValueError(f"two tasks have the name {duplicates[0]!r}; expected unique names")
    return every


def run(
    tasks: Sequence[Task], context: Context, workers: OnCluster | None = None
) -> tuple[list[Row], list[dict[str, Any]]]:
    """Return all rows in the order of the tasks, and each task's name, seconds and CPU seconds.

    `workers` first run the tasks that are not timed. The other tasks then run on this machine, one at a time, so that
    nothing disturbs a timing. Finished tasks stay saved if an error or KeyboardInterrupt is raised.
    """
    store = context.out / "unfinished"
    store.mkdir(parents=True, exist_ok=True)
    about = _state(context)
    files = [store / f"{_digest((about + task.name).encode())}.json" for task in tasks]
    # One record for all tasks: some write the same image. Runs of another state write to the same paths.
    images = store / f"images {_digest(about.encode())}.json"
    digests: dict[str, str] = _read(images)
    finished: dict[int, Finished] = {}

    def announce(task: Task) -> None:
        _log(f"task {len(finished) + 1} of {len(tasks)}: {task.name}")

    def save(number: int, result: Finished) -> None:
        rows, spent = result
        digests.update(_images(rows, context.out))
        write_atomically(images, json.dumps(digests))
        write_atomically(files[number], json.dumps({"spent": spent, "rows": [row.as_dict() for row in rows]}))
        finished[number] = result

    def saved(number: int) -> Finished | None:
        return _saved(files[number], context.out, digests)

    work = [(i, task.name) for i, task in enumerate(tasks) if not task.timed and not saved(i)]
    if workers and work:
        for i, result in workers.run(work, context):
            announce(tasks[i])
            save(i, result)
    for i, task in enumerate(tasks):
        if i not in finished:
            announce(task)
            save(i, saved(i) or timed(task))
    results = [finished[i] for i in range(len(tasks))]
    return [row for rows, _ in results for row in rows], [spent for _, spent in results]


def _log(text: str) -> None:
    print(printable(f"validation: {text}"), file=sys.stderr, flush=True)


def timed(task: Task) -> Finished:
    """Run a task and return its rows and times."""
    start, processors = time.perf_counter(), sum(os.times()[:4])
    rows = task.run()
    seconds, cpu = time.perf_counter() - start, sum(os.times()[:4]) - processors
    return rows, {"task": task.name, "seconds": round(seconds, 2), "CPU seconds": round(cpu, 2)}


def _saved(file: Path, folder: Path, digests: dict[str, str]) -> Finished | None:
    """Return the saved rows and times of a finished task; None without them, or if an image in `folder` has changed."""
    record = _read(file)
    try:
        rows, spent = [Row.from_dict(data) for data in record["rows"]], dict(record["spent"])
        return (rows, spent) if _images(rows, folder).items() <= digests.items() else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _images(rows: Sequence[Row], folder: Path) -> dict[str, str]:
    """Return the digests of the images of rows, by path."""
    return {path: _digest((folder / path).read_bytes()) for row in rows for path in row.images.values()}


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:24]


def _read(file: Path) -> Any:
    """Return the contents of a JSON file, or an empty dictionary if it cannot be read."""
    try:
        return json.loads(file.read_text())
    except (OSError, ValueError):
        return {}


def forget(context: Context) -> None:
    """Delete the saved rows of single tasks after the report is written, so that the next run starts over."""
    shutil.rmtree(context.out / "unfinished", ignore_errors=True)


# What rows depend on --------------------------------------------------------------------------------------------------


def describe(context: Context, seconds: float) -> dict[str, Any]:
    """Return what all rows share: profile, variant, run time, versions and machine."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    cores = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    processor = f"{len(cores)} × {cores[0]}" if cores else platform.machine()
    return {
        "profile": context.profile.name,
        "variant": context.variant,
        "libLLVM": context.backends["llvm"].library,
        "seconds": round(seconds, 1),
        "versions": {"mi_refract": mi_refract.__version__}
        | {name: version(name) for name in ("mitsuba", "drjit", "numpy", "OpenImageIO", "python-flint")},
        "machine": {"processor": processor, "system": platform.platform(), "python": platform.python_version()},
    }


def _state(context: Context) -> str:
    """Return what rows depend on, and whether they are "not run": saved rows of another state are not used."""
    packages = sorted(f"{package.name} {package.version}" for package in distributions())
    programs = [shutil.which(program) for program in environments.PROGRAMS]
    runs_here = context.backends, context.variants, packages, installed(), programs
    return repr((context.profile, *runs_here, describe(context, 0))) + sources()


def installed() -> list[str]:
    """Return the names of the other renderers that are installed on this machine."""
    return [name for name, system in SYSTEMS.items() if not environments.absent(system)]


def sources() -> str:
    """Return a digest of all files that rows depend on: the package, the validation, scenes and tests."""
    digest = hashlib.sha256()
    folder = Path(__file__).parent
    groups = [place.rglob("*") for place in (Path(mi_refract.__file__).parent, folder, SCENES)]
    groups.append(folder.with_name("tests").rglob("*"))  # they must detect the mutants of our code
    for path in sorted(path for group in groups for path in group if path.is_file()):
        if path.suffix != ".pyc":
            digest.update(path.read_bytes())
    return digest.hexdigest()


def facts(variant: str) -> dict[str, str]:
    """Return what the rows of this process depend on: `on_worker.facts`, packages, sources and other renderers."""
    versions = on_worker.facts(variant) | {name: installed_version(name) for name in PACKAGES}
    return versions | {"validation": sources()[:8], "other renderers": ", ".join(installed()) or "none"}


# On workers -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class OnCluster:
    """The workers of a scheduler, or single-threaded worker processes on this machine.

    A worker builds the list of tasks from `modules` (modules below `validation` whose STUDY is run), `profile` and
    `variant` (of Mitsuba).
    """

    modules: tuple[str, ...]
    profile: str
    variant: str
    target: connection.ClusterTarget = connection.LOCAL

    def run(self, work: Sequence[tuple[int, str]], context: Context) -> Iterator[tuple[int, Finished]]:
        """Run tasks, given as (number, name), and yield (number, result) as they finish.

        The first error of a task is raised. ConnectionError, one line, if no worker is accepted; stderr names refused
        workers.
        """
        with connection.connected(self.target.scheduler, self.target.workers) as client:
            workers = calls.Workers(client, self.variant, facts(self.variant), warn=_log, facts=__name__)
            workers.wait()
            results = calls.results(workers, OnCluster.on_worker, [(self, name) for _, name in work])
            for number, ((rows, spent), files), machine in results:
                for path, content in files.items():
                    (context.out / path).parent.mkdir(parents=True, exist_ok=True)
                    write_atomically(context.out / path, content)
                yield work[number][0], (rows, spent | {"machine": machine})

    def on_worker(self, name: str) -> tuple[Finished, dict[str, bytes]]:
        """Run the task of this name in a temporary folder of a worker; return its result and its files by path."""
        scratch = on_worker.scratch_folder()

        def run_task() -> tuple[Finished, dict[str, bytes]]:
            with tempfile.TemporaryDirectory(dir=scratch) as folder:
                studies = [import_module(f"validation.{module}").STUDY for module in self.modules]
                context = here(self.profile, Path(folder), self.variant)
                finished = timed(next(task for task in tasks(studies, context) if task.name == name))
                paths = [path for path in context.out.rglob("*") if path.is_file()]
                return finished, {str(path.relative_to(folder)): path.read_bytes() for path in paths}

        return on_worker.in_variant(self.variant, run_task)

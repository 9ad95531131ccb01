"""Runs tasks, saves the rows of each as soon as it is finished, and resumes after an interruption.

Tasks that time nothing may run on the workers of a Dask cluster. A task holds closures, so it is not sent: a worker
makes the same list of tasks and runs the one of that name. It must have the same sources, versions and other renderers.
Images come back as files; rows are kept as they come.
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
from importlib.metadata import version
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

# What rows depend on, beside what any render depends on.
PACKAGES = ("numpy", "scipy", "OpenImageIO", "python-flint", "jinja2")
Finished = tuple[list[Row], dict[str, Any]]  # of a task: its rows, and its name and times


def tasks(studies: Sequence[Study], context: Context) -> list[Task]:
    """All tasks of these studies, and those that repeat them with other seeds. ValueError where two have one name."""
    made = [task for study in studies for task in (*study.tasks(context), *repeated.tasks(study, context))]
    names = Counter(task.name for task in made)
    if twice := [name for name, count in names.items() if count > 1]:
        raise ValueError(f"two tasks are called {twice[0]!r}; expected different names, by which workers find them")
    return made


def run(
    tasks: Sequence[Task], context: Context, workers: OnCluster | None = None
) -> tuple[list[Row], list[dict[str, Any]]]:
    """All rows, in the order of the tasks; and of each task its name, seconds, and seconds of all processors.

    `workers` first run the tasks that are not timed; then the others run here, one after the other, so that what is
    timed runs alone. Errors and KeyboardInterrupt pass, with the finished tasks kept.
    """
    store = context.out / "unfinished"
    store.mkdir(parents=True, exist_ok=True)
    about = repr((context.profile, context.variant, installed(), describe(context, 0))) + sources()
    files = [store / f"{hashlib.sha256((about + task.name).encode()).hexdigest()[:24]}.json" for task in tasks]
    finished: dict[int, Finished] = {}

    def say(task: Task) -> None:
        _say(f"task {len(finished) + 1} of {len(tasks)}: {task.name}")

    def keep(number: int, result: Finished) -> None:
        rows, spent = result
        write_atomically(files[number], json.dumps({"spent": spent, "rows": [row.as_dict() for row in rows]}))
        finished[number] = result

    work = [(i, task.name) for i, task in enumerate(tasks) if not task.timed and not _recall(files[i])]
    if workers and work:
        for i, result in workers.run(work, context):
            say(tasks[i])
            keep(i, result)
    for i, task in enumerate(tasks):
        if i not in finished:
            say(task)
            keep(i, _recall(files[i]) or timed(task))
    order = [finished[i] for i in range(len(tasks))]
    return [row for rows, _ in order for row in rows], [spent for _, spent in order]


def _say(text: str) -> None:
    print(printable(f"validation: {text}"), file=sys.stderr, flush=True)


def timed(task: Task) -> Finished:
    """Run a task; its rows, and what it took."""
    start, processors = time.perf_counter(), sum(os.times()[:4])
    rows = task.run()
    seconds, cpu = time.perf_counter() - start, sum(os.times()[:4]) - processors
    return rows, {"task": task.name, "seconds": round(seconds, 2), "CPU seconds": round(cpu, 2)}


def _recall(file: Path) -> Finished | None:
    """The rows of a finished task and its time; None if there are none or they cannot be read."""
    try:
        record = json.loads(file.read_text())
        return [Row.from_dict(data) for data in record["rows"]], dict(record["spent"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def forget(context: Context) -> None:
    """Drop the rows of single tasks: once the report is written, the next run starts over."""
    shutil.rmtree(context.out / "unfinished", ignore_errors=True)


# What rows depend on --------------------------------------------------------------------------------------------------


def describe(context: Context, seconds: float) -> dict[str, Any]:
    """What all rows share."""
    names = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    cores = [line.partition(":")[2].strip() for line in names if line.startswith("model name")]
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


def installed() -> list[str]:
    """The other renderers that are installed here."""
    return [name for name, system in SYSTEMS.items() if not environments.absent(system)]


def sources() -> str:
    """A digest of all that rows are made from: the package, the validation, scenes and tests."""
    digest = hashlib.sha256()
    here = Path(__file__).parent
    groups = [Path(mi_refract.__file__).parent.rglob("*.py"), SCENES.rglob("*")]
    groups += [here.rglob(f"*.{kind}") for kind in ("py", "json", "toml", "j2")]
    groups.append(here.with_name("tests").rglob("*.py"))  # which mutants of our code must not pass
    for path in sorted(path for group in groups for path in group if path.is_file()):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def facts(variant: str) -> dict[str, str]:
    """What rows depend on, of this process, by name: `on_worker.facts` and the sources of the validation."""
    known = on_worker.facts(variant) | {name: installed_version(name) for name in PACKAGES}
    return known | {"validation": sources()[:8], "other renderers": ", ".join(installed()) or "none"}


# On workers -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class OnCluster:
    """Workers of a scheduler, or worker processes of one thread each on this machine.

    `modules`, names below `validation` of the modules whose STUDY is run, the profile and the variant of Mitsuba say
    what the list of tasks is made from.
    """

    modules: tuple[str, ...]
    profile: str
    variant: str
    target: connection.ClusterTarget = connection.LOCAL

    def run(self, work: Sequence[tuple[int, str]], context: Context) -> Iterator[tuple[int, Finished]]:
        """The result of every task (number, name), in the order in which they end. A task's own errors pass.

        ConnectionError, one line, where no worker may run tasks; workers that are refused are named on stderr.
        """
        from mi_refract.cluster.workers import Workers

        with connection.connected(self.target.scheduler, self.target.workers) as client:
            workers = Workers(client, self.variant, facts(self.variant), warn=_say, facts=__name__)
            workers.wait()
            results = calls.results(workers, OnCluster.on_worker, [(self, name) for _, name in work])
            for number, ((rows, spent), files), machine in results:
                for path, content in files.items():
                    (context.out / path).parent.mkdir(parents=True, exist_ok=True)
                    write_atomically(context.out / path, content)
                yield work[number][0], (rows, spent | {"machine": machine})

    def on_worker(self, name: str) -> tuple[Finished, dict[str, bytes]]:
        """The task of that name, run on a worker in a folder of its own, and its files by path. Its errors pass."""
        scratch = on_worker.scratch_folder()

        def run_task() -> tuple[Finished, dict[str, bytes]]:
            with tempfile.TemporaryDirectory(dir=scratch) as folder:
                studies = [import_module(f"validation.{module}").STUDY for module in self.modules]
                context = here(self.profile, Path(folder), self.variant)
                finished = timed(next(task for task in tasks(studies, context) if task.name == name))
                paths = [path for path in context.out.rglob("*") if path.is_file()]
                return finished, {str(path.relative_to(folder)): path.read_bytes() for path in paths}

        return on_worker.in_variant(self.variant, run_task)

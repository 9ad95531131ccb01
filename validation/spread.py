"""Tasks that time nothing, on the workers of a Dask cluster.

A task holds closures, so it is not sent: a worker makes the same list of tasks and runs the one of that name. It must
have the same sources, versions and other renderers. Images come back as files; rows are kept as they come.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from mi_refract.cluster import connection, on_worker, worker_facts
from mi_refract.cluster import spread as calls
from mi_refract.cluster.workers import Workers
from mi_refract.io.atomic import write_atomically
from mi_refract.io.provenance import installed_version
from mi_refract.io.sanitise import printable
from validation.run.context import Context, profiles

from . import repeated, runner
from .study import Study, Task

PACKAGES = (
    "numpy",
    "scipy",
    "OpenImageIO",
    "python-flint",
    "jinja2",
)  # that rows depend on, beside those of any render


@dataclass(frozen=True)
class Asked:
    """What a list of tasks is made from. `modules`: names below `validation`, each with a STUDY."""

    modules: tuple[str, ...]
    profile: str
    variant: str


@dataclass(frozen=True)
class Outcome:
    """What a worker sends back: `runner.Finished`, and the files of the task by path below the output folder."""

    finished: runner.Finished
    files: dict[str, bytes]


def tasks(studies: Sequence[Study], context: Context) -> list[Task]:
    """All tasks of these studies, and those that repeat them."""
    return [task for study in studies for task in (*study.tasks(context), *repeated.tasks(study, context))]


@dataclass(frozen=True)
class OnCluster:
    """A `runner.Elsewhere`: workers of a scheduler, or so many processes of one thread each on this machine."""

    asked: Asked
    target: connection.ClusterTarget

    def run(self, work: Sequence[tuple[int, str]], context: Context) -> Iterator[tuple[int, runner.Finished]]:
        """As `runner.Elsewhere.run`. ConnectionError, one line, where nobody is there who may run tasks.

        Workers that are refused are named on stderr. ValueError where two tasks have one name.
        """
        names = [name for _, name in work]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"two tasks are called {twice[0]!r}; expected a name for each, by which workers find it")
        with connection.connected(self.target.scheduler, self.target.workers) as client:
            expected = facts(self.asked.variant)
            workers = Workers(client, self.asked.variant, expected, warn=_say, facts=__name__)
            workers.wait()
            found = calls.results(workers, run_here, [(self.asked, name) for _, name in work])
            for number, outcome, machine in found:
                for path, content in outcome.files.items():
                    (context.out / path).parent.mkdir(parents=True, exist_ok=True)
                    write_atomically(context.out / path, content)
                rows, spent = outcome.finished
                yield work[number][0], (rows, spent | {"machine": machine})


def _say(text: str) -> None:
    print(printable(f"validation: {text}"), file=sys.stderr, flush=True)


# On a worker ----------------------------------------------------------------------------------------------------------


def facts(variant: str) -> dict[str, str]:
    """What rows depend on, of this process, by name: as `worker_facts.facts`, with the sources of the validation."""
    found = worker_facts.facts(variant) | {name: installed_version(name) for name in PACKAGES}
    found["validation"] = runner.sources()[:8]
    return found | {"other renderers": ", ".join(runner.installed()) or "none"}


def run_here(asked: Asked, name: str) -> Outcome:
    """The task of that name, in a folder of its own. Its errors pass."""
    threads, scratch = on_worker.threads(), on_worker.scratch_folder()
    return on_worker.one_at_a_time(lambda: _run(asked, name, threads, scratch))


def _run(asked: Asked, name: str, threads: int, scratch: str) -> Outcome:
    from mi_refract import backend

    if on_worker.variant() != asked.variant:
        backend.activate(asked.variant)
    on_worker.limit_threads(threads)
    chosen = profiles(asked.variant)[asked.profile]
    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        context = Context(chosen, Path(folder), asked.variant, backend.detect(), backend.usable_variants())
        studies = [import_module(f"validation.{module}").STUDY for module in asked.modules]
        finished = runner.timed(next(task for task in tasks(studies, context) if task.name == name))
        files = {str(path.relative_to(folder)): path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}
        return Outcome(finished, files)

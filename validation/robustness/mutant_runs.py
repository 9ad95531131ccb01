"""Runs tests on mutants, each in a private copy of the source tree and in a process of its own.

A process has a limit on its memory, and a time after which it counts as hanging. Whatever ends the caller's wait ends
the processes, too.
"""

from __future__ import annotations

import compileall
import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .mutants import Mutant, mutated

MEMORY = 24 << 30  # bytes of address space, of all processes together
COPIED = ("mi_refract", "tests", "validation", "scenes", ".ci", ".github")  # and the files beside them
ROOT = Path(__file__).parents[2]
NO_TESTS = 5  # pytest's exit code
STARTER = """
import resource, sys
memory = int(sys.argv[1])
try:
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
except (ValueError, OSError):  # not every system limits address space
    pass
import pytest
sys.exit(pytest.main(sys.argv[2:]))
"""
# Without the tests that some machines skip: a browser takes more address space than a process may here.
OPTIONS = ("-x", "-q", "-p", "no:cacheprovider", "-m", "not skipif")
_POLL = 0.05  # seconds


@dataclass(frozen=True)
class Job:
    """Tests to run, on a mutant or on what is not mutated, and the seconds that they may take."""

    name: str
    tests: Sequence[str]
    timeout: float
    mutant: Mutant | None = None


@dataclass(frozen=True)
class Outcome:
    """How a job ended: whether its tests passed, in how many seconds, and what was said last."""

    job: Job
    passed: bool
    seconds: float
    said: str


def folder_of_copies() -> Any:
    """A temporary folder for `run`, as a context."""
    return tempfile.TemporaryDirectory(prefix="mutants-", ignore_cleanup_errors=True)


def run(jobs: Sequence[Job], folder: Path, workers: int, root: Path = ROOT) -> Generator[Outcome, None, None]:
    """The outcomes, as they come; `folder` keeps the copies of `root` that the workers mutate, one each."""
    waiting = list(jobs)
    free = [_Worker(copy, MEMORY // workers) for copy in _copies(folder, workers, root)]
    busy: list[_Worker] = []
    try:
        while waiting or busy:
            while waiting and free:
                busy.append(free.pop(0).start(waiting.pop(0)))
            time.sleep(_POLL)
            for worker in list(busy):
                if outcome := worker.outcome():
                    busy.remove(worker)
                    free.append(worker)
                    yield outcome
    finally:
        for worker in busy:
            worker.end()


def _copies(folder: Path, count: int, root: Path) -> list[Path]:
    """So many copies of the tree; those that are there already are kept."""
    first = folder / "0"
    if not first.exists():
        first.mkdir()
        for path in root.iterdir():
            if path.is_file():
                shutil.copy2(path, first)
            elif path.name in COPIED:
                shutil.copytree(path, first / path.name, ignore=shutil.ignore_patterns("__pycache__"))
        compileall.compile_dir(first, quiet=1)
    copies = [folder / str(i) for i in range(count)]
    for path in copies[1:]:
        if not path.exists():
            shutil.copytree(first, path)
    return copies


class _Worker:
    """A copy of the tree, and the process that runs in it."""

    def __init__(self, copy: Path, memory: int) -> None:
        self.copy, self.memory = copy, memory
        self.writes = 0

    def start(self, job: Job) -> _Worker:
        """Mutate the copy and start the tests."""
        self.job, self.began = job, time.monotonic()
        self.source = job.mutant and (self.copy / job.mutant.path).read_text("utf-8")
        if job.mutant and self.source:
            self._write(mutated(self.source, job.mutant.operator, job.mutant.occurrence))
        place = f"--basetemp={self.copy / 'temporary'}"
        command = [sys.executable, "-c", STARTER, str(self.memory), *OPTIONS, place, *job.tests]
        with self._log.open("wb") as log:
            self.process = subprocess.Popen(
                command, cwd=self.copy, env=_environment(self.copy), stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                start_new_session=True,
            )  # fmt: skip
        return self

    def outcome(self) -> Outcome | None:
        """How the job ended; None while it runs. Errors: ValueError where there was no test to run."""
        seconds = time.monotonic() - self.began
        status = self.process.poll()
        if status is None and seconds < self.job.timeout:
            return None
        self.end()
        if status == NO_TESTS:
            raise ValueError(f"{self.job.name}: no tests: {', '.join(self.job.tests)}")
        said = f"no end within {self.job.timeout:.0f} s" if status is None else _last_words(self._log)
        return Outcome(self.job, status == 0, seconds, said)

    def end(self) -> None:
        """End the process and all that it started, and undo the mutation."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        if self.source:
            self._write(self.source)

    @property
    def _log(self) -> Path:
        return self.copy / "said.txt"

    def _write(self, source: str) -> None:
        """With a time of its own: Python takes compiled code for that of a file of the same size and second."""
        assert self.job.mutant
        path = self.copy / self.job.mutant.path
        path.write_text(source, "utf-8")
        self.writes += 1
        os.utime(path, (10**9 + self.writes,) * 2)


def _environment(copy: Path) -> Mapping[str, str]:
    """Modules come from the copy, temporary files go there, and options of a pytest around us do not apply."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    shutil.rmtree(copy / "tmp", ignore_errors=True)  # what the last tests left
    (copy / "tmp").mkdir(exist_ok=True)
    return kept | {"PYTHONPATH": str(copy), "TMPDIR": str(copy / "tmp")}


def _last_words(log: Path) -> str:
    """The line of pytest that names the failed test, else the last line."""
    lines = log.read_text("utf-8", errors="replace").splitlines()
    failed = [line for line in lines if line.startswith(("FAILED ", "ERROR "))]
    return (failed or [line for line in lines if line.strip()] or [""])[-1][:300]


def workers(most: int) -> int:
    """How many processes at a time: one per processor, and no more than there is to do."""
    return max(1, min(os.cpu_count() or 1, most))

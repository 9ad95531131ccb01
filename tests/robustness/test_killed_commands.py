"""Killed commands and full disks: what is left is old or new, never half, and the same command again ends well.

Each command runs once undisturbed. Then it gets a signal at random times within that time, each time where the last one
left off, and runs with a random limit on the size of files (`ulimit -f`), as on a full disk. After each of these every
file must be the old or the new one. The signal ends the command, SIGINT with exit code 130 and with nothing temporary
left; with the limit the exit code is 2 with one line. Or the command has its own exit code, where the signal was late
or the files fit. At last it runs to its end: with its exit code, and with nothing temporary left.
"""

from __future__ import annotations

import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import settings
from support.processes import ENVIRONMENT, ROOT

from mi_refract.io import errors, image_file

HANG = 60  # seconds
SIGNALS = (signal.SIGINT, signal.SIGKILL, signal.SIGINT, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
OLD = "<html>old</html>"
LIMITED = """
import os, resource, sys
size = int(sys.argv[1])
resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
os.execv(sys.executable, [sys.executable, *sys.argv[2:]])
"""
VALIDATION = """
import sys, time
from pathlib import Path
from types import SimpleNamespace
import numpy as np
from mi_refract.io import errors, image_file, safe_files
from mi_refract.report import run_report
from mi_refract.report.row import Row
from validation import runner
from validation.run.context import PROFILES, Context
from validation.study import Task

folder = Path(sys.argv[1])
folder.mkdir(exist_ok=True)
context = Context(PROFILES["quick"], folder, "scalar_rgb", {"llvm": SimpleNamespace(library=None)}, {})

def measured(i):
    time.sleep(0.1)
    image_file.write_exr(folder / f"{i}.exr", np.full((64, 64, 3), float(i)), metadata=image_file.NO_DATE)
    return [Row("a study", f"row {i}", "", "", {"x": float(i)})]

def body():
    with safe_files.held(folder / "validation.lock", "a validation"):
        rows, _ = runner.run([Task(f"task {i}", lambda i=i: measured(i)) for i in range(6)], context)
        run_report.write_json(folder / "rows.json", rows, {})
        run_report.write_junit(folder / "junit.xml", rows, {})
        run_report.write_html(folder / "report.html", rows, {}, folder)
        runner.forget(context)

sys.exit(errors.exit_code("validation", body))
"""


@dataclass(frozen=True)
class Command:
    """`words` for Python, FOLDER is the folder; `outputs`: its files, by glob."""

    words: tuple[str, ...]
    outputs: str
    code: int
    content: Callable[[Path], Any] = Path.read_bytes  # what must be the same in a file after every run


def image(path, seed):
    image_file.write_exr(path, np.random.default_rng(seed).random((64, 64, 3)), metadata=image_file.NO_DATE)


def prepare(folder):
    """Old outputs of the commands, and what they read: two folders of six images."""
    for side, first in (("old", 0), ("new", 100)):
        (folder / side).mkdir(parents=True)
        for i in range(6):
            image(folder / side / f"{i}.exr", first + i)
    (folder / "out.html").write_text(OLD)
    image(folder / "out.exr", 0)


def whole_page(path):
    """Which page it is: the old one, or a new one with an end, whose commands name the folder."""
    text = path.read_text()
    return text if text == OLD else "new" if text.rstrip().endswith("</html>") else "torn"


OURS = ("-m", "mi_refract.cli")
RENDER = ("render", str(ROOT / "scenes" / "sphere.xml"), "-o", "FOLDER/out.exr", "-D", "res=16", "--spp", "2")
DIFF = ("diff", "FOLDER/old", "FOLDER/new", "--report", "FOLDER/out.html")
COMMANDS = {
    "accept": Command((*OURS, "accept", "FOLDER/old", "FOLDER/new", "--yes"), "old/*", 0),
    "diff --report": Command((*OURS, *DIFF), "out.html", 1, whole_page),
    "validation": Command(("-c", VALIDATION, "FOLDER/report"), "report/*.*", 0),
    "render": Command(
        (*OURS, *RENDER, "--pass-spp", "1", "--restart"), "out.exr", 0,
        lambda path: image_file.read_exr(path)[0].tobytes(),
    ),
}  # fmt: skip


def ended(command, folder, kill=None, number=signal.SIGKILL, size=None):
    """Exit code (−9: by SIGKILL) and stderr of the command, with a signal after `kill` s."""
    words = [word.replace("FOLDER", str(folder)) for word in command.words]
    limit = resource.RLIM_INFINITY if size is None else size
    start = [sys.executable, *(("-c", LIMITED, str(limit)) if size is not None else ()), *words]
    with subprocess.Popen(
        start, env=ENVIRONMENT, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    ) as process:
        try:
            if kill is not None:
                time.sleep(kill)
                process.send_signal(number)
            _, said = process.communicate(timeout=HANG)
        finally:
            process.kill()
    return process.returncode, said.decode(errors="replace")


def temporary(folder):
    """What only a command that is still running may have there."""
    return {path for path in folder.rglob("*") if path.name.startswith(".") or path.name == "validation.lock"}


def state(command, folder):
    """The contents of its outputs, or why they cannot be read, by name."""
    contents = {}
    for path in set(folder.glob(command.outputs)) - temporary(folder):
        try:
            contents[path.name] = command.content(path)
        except (OSError, ValueError) as error:
            contents[path.name] = error
    return contents


def torn(contents, *known):
    """Names of the files that are in none of the known states."""
    return [name for name, content in contents.items() if not any(content == files.get(name) for files in known)]


def ends_well(command, folder, after, number):
    """The signal comes after so many seconds; it ends the command as it should, or comes too late."""
    before = temporary(folder)
    code, said = ended(command, folder, kill=after, number=number)
    if code == command.code:
        return True
    if number != signal.SIGINT:
        return code in (-number, 128 + number)  # a render that keeps what it has says 128 + number
    # Python itself was not there yet, or interrupted as it should be, and by no traceback of ours.
    ours = code == 130 or (code == -number and "mi_refract.cli.app" not in said)
    return "Fatal Python error: init" in said or (ours and temporary(folder) <= before)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_killed_command_leaves_whole_files_and_ends_well_when_started_again(name, tmp_path):
    command, rng = COMMANDS[name], random.Random(0)
    old, new = tmp_path / "undisturbed", tmp_path / "killed"
    for folder in (old, new):
        prepare(folder)
    before, start = state(command, old), time.perf_counter()
    assert ended(command, old)[0] == command.code
    took, after = time.perf_counter() - start, state(command, old)
    for i in range(max(4, settings.default.max_examples // 50)):
        if i % 2:
            code, said = ended(command, new, size=rng.choice((0, 100, 1000, rng.randrange(60_000))))
            lines = [line for line in said.splitlines() if not line.startswith("validation: task ")]  # the progress
            assert code == command.code or (code == errors.MISUSE and len(lines) == 1), said
        else:
            number, moment = SIGNALS[i // 2 % len(SIGNALS)], rng.uniform(0, took)
            assert ends_well(command, new, moment, number), (number, moment)
            for left in temporary(new):  # by SIGKILL, or by a signal before the first line of ours
                left.unlink() if left.is_file() else shutil.rmtree(left)
        assert not torn(state(command, new), before, after)
    if name == "accept":  # so that something is left to do
        first = next(path for path in new.glob(command.outputs) if path.name in before)
        first.write_bytes(before[first.name])
    assert ended(command, new)[0] == command.code
    assert state(command, new).keys() == after.keys() and not temporary(new)
    assert not torn(state(command, new), after)

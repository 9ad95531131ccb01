"""Killed commands and full disks: every file is old or new, never torn, and the same command then finishes.

Each command runs once undisturbed. Then it runs repeatedly in the same folder: with a signal at a random time within
the first run's duration, or with a random limit on the size of files (`ulimit -f`), as on a full disk. After each run,
every file must be the old or the new one. The signal ends the command; after SIGINT the exit code is 130 and no
temporary file remains. With the limit the exit code is 2, with one line. If the signal comes too late, or the files
fit, the command has its own exit code. The last run is undisturbed: it ends with the command's exit code, and no
temporary file remains.
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
    """A command. `words`: arguments of Python, with FOLDER for the folder; `outputs`: glob of its output files."""

    words: tuple[str, ...]
    outputs: str
    code: int
    content: Callable[[Path], Any] = Path.read_bytes  # the content of a file that is compared


def image(path, seed):
    image_file.write_exr(path, np.random.default_rng(seed).random((64, 64, 3)), metadata=image_file.NO_DATE)


def prepare(folder):
    """Write old outputs of the commands, and their inputs: two folders of six images."""
    for side, first in (("old", 0), ("new", 100)):
        (folder / side).mkdir(parents=True)
        for i in range(6):
            image(folder / side / f"{i}.exr", first + i)
    (folder / "out.html").write_text(OLD)
    image(folder / "out.exr", 0)


def page_state(path):
    """Return the text of the old page, or "new" for a complete new one (its text names the folder), or "torn"."""
    text = path.read_text()
    if text == OLD:
        return text
    return "new" if text.rstrip().endswith("</html>") else "torn"


OURS = ("-m", "mi_refract.cli")
RENDER = ("render", str(ROOT / "scenes" / "sphere.xml"), "-o", "FOLDER/out.exr", "-D", "res=16", "--spp", "2")
DIFF = ("diff", "FOLDER/old", "FOLDER/new", "--report", "FOLDER/out.html")
COMMANDS = {
    "accept": Command((*OURS, "accept", "FOLDER/old", "FOLDER/new", "--yes"), "old/*", 0),
    "diff --report": Command((*OURS, *DIFF), "out.html", 1, page_state),
    "validation": Command(("-c", VALIDATION, "FOLDER/report"), "report/*.*", 0),
    "render": Command(
        (*OURS, *RENDER, "--pass-spp", "1", "--restart"), "out.exr", 0,
        lambda path: image_file.read_exr(path)[0].tobytes(),
    ),
}  # fmt: skip


def run(command, folder, kill=None, number=signal.SIGKILL, size=None):
    """Run the command and return its exit code (−9: by SIGKILL) and stderr.

    `kill`: seconds until the signal `number`; `size`: limit on the size of files in bytes.
    """
    words = [word.replace("FOLDER", str(folder)) for word in command.words]
    limit = resource.RLIM_INFINITY if size is None else size
    start = [sys.executable, *(("-c", LIMITED, str(limit)) if size is not None else ()), *words]
    streams = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    with subprocess.Popen(start, env=ENVIRONMENT, **streams) as process:
        try:
            if kill is not None:
                time.sleep(kill)
                process.send_signal(number)
            _, err = process.communicate(timeout=HANG)
        finally:
            process.kill()
    return process.returncode, err.decode(errors="replace")


def temporary(folder):
    """Return the temporary files in a folder, which only a running command may have."""
    return {path for path in folder.rglob("*") if path.name.startswith(".") or path.name == "validation.lock"}


def state(command, folder):
    """Return the contents of the command's outputs by name; for an unreadable file, the error."""
    contents = {}
    for path in set(folder.glob(command.outputs)) - temporary(folder):
        try:
            contents[path.name] = command.content(path)
        except (OSError, ValueError) as error:
            contents[path.name] = error
    return contents


def torn(contents, *known):
    """Return the names of the files that have none of the known contents."""
    return [name for name, content in contents.items() if not any(content == files.get(name) for files in known)]


def ends_well(command, folder, after, number):
    """Send the signal after `after` seconds; return whether it ends the command correctly, or comes too late."""
    before = temporary(folder)
    code, err = run(command, folder, kill=after, number=number)
    if code == command.code:
        return True
    if number != signal.SIGINT:
        return code in (-number, 128 + number)  # 128 + number: the command handled the signal
    # Python was still starting, or the command was interrupted without a traceback of this package.
    interrupted = code == 130 or (code == -number and "mi_refract.cli.app" not in err)
    return "Fatal Python error: init" in err or (interrupted and temporary(folder) <= before)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_killed_command_leaves_whole_files_and_finishes_when_run_again(name, tmp_path):
    command, rng = COMMANDS[name], random.Random(0)
    old, new = tmp_path / "undisturbed", tmp_path / "killed"
    for folder in (old, new):
        prepare(folder)
    before, start = state(command, old), time.perf_counter()
    assert run(command, old)[0] == command.code
    duration, after = time.perf_counter() - start, state(command, old)
    for i in range(max(4, settings.default.max_examples // 50)):
        if i % 2:
            code, err = run(command, new, size=rng.choice((0, 100, 1000, rng.randrange(60_000))))
            lines = [line for line in err.splitlines() if not line.startswith("validation: task ")]  # no progress
            assert code == command.code or (code == errors.MISUSE and len(lines) == 1), err
        else:
            number, moment = SIGNALS[i // 2 % len(SIGNALS)], rng.uniform(0, duration)
            assert ends_well(command, new, moment, number), (number, moment)
            for path in temporary(new):  # left by SIGKILL, or by a signal before the first line of this package
                path.unlink() if path.is_file() else shutil.rmtree(path)
        assert not torn(state(command, new), before, after)
    if name == "accept":  # restore one old image: otherwise there is nothing to accept
        first = next(path for path in new.glob(command.outputs) if path.name in before)
        first.write_bytes(before[first.name])
    assert run(command, new)[0] == command.code
    assert state(command, new).keys() == after.keys() and not temporary(new)
    assert not torn(state(command, new), after)

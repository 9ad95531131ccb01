"""Killed commands and full disks: what is left is old or new, never half, and the same command again ends well.

Each command runs once undisturbed. Then it gets a signal (SIGKILL, SIGTERM, SIGHUP, or SIGINT as by Ctrl-C) at random
times within that time, each time where the last one left off, and runs with a random limit on the size of files
(`ulimit -f`), as on a full disk. After each of these every file must be the old or the new one. The signal ends the
command, SIGINT with exit code 130 and with nothing temporary left; with the limit the exit code is 2 with one line. Or
the command has its own exit code, where the signal was late or the files fit. At last it runs to its end: with its exit
code, and with nothing temporary left.

`python -m validation.robustness.killed_commands KILLS [COMMAND …]` prints the rows as JSON.
"""

from __future__ import annotations

import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from mi_refract.io import atomic, exit_code, image_file, lock
from mi_refract.report import run_report
from mi_refract.report.row import Row
from validation.run.context import PROFILES, SCENES, Context
from validation.study import Study, Task, about

HANG = 60  # seconds; the signal ends the process
SIGNALS = (signal.SIGINT, signal.SIGKILL, signal.SIGINT, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
OLD = "<html>old</html>"
KILLS = {"quick": 4, "standard": 20, "full": 100}
TERMS = {
    "kills": "runs that were killed, or met a full disk",
    "torn files": "files that were neither the old nor the new one",
    "wrong ends": "runs without an end, or with a wrong exit code; after Ctrl-C with something temporary left, on a "
    "full disk without a line or with several",
    "bad restarts": "1 where the last run did not end well, or left something temporary",
}
BUDGETS = dict.fromkeys(("torn files", "wrong ends", "bad restarts"), 0.0)


@dataclass(frozen=True)
class Command:
    """`prepare(folder)` makes its inputs anew, `run(folder)` is the command, with exit code `code`.

    `outputs`: its files, by glob in the folder. `content` is what must be the same in a file after every run.
    """

    prepare: Callable[[Path], Any]
    run: Callable[[Path], int]
    outputs: str
    code: int
    content: Callable[[Path], Any] = Path.read_bytes


def _image(path: Path, seed: int) -> None:
    image_file.write_exr(path, np.random.default_rng(seed).random((64, 64, 3)), metadata=image_file.NO_DATE)


def _images(folder: Path) -> None:
    for side, first in (("old", 0), ("new", 100)):
        (folder / side).mkdir()
        for i in range(6):
            _image(folder / side / f"{i}.exr", first + i)


def _command(*words: str | Path) -> int:
    """`mi-refract` with these words, in place of this process: what it does with signals is its program's."""
    os.execv(sys.executable, [sys.executable, "-m", "mi_refract.cli", *map(str, words)])


def _accept(folder: Path) -> int:
    return _command("accept", folder / "old", folder / "new", "--yes")


def _diff(folder: Path) -> int:
    return _command("diff", folder / "old", folder / "new", "--report", folder / "out.html")


def _old_page(folder: Path) -> None:
    _images(folder)
    (folder / "out.html").write_text(OLD)


def _validate(folder: Path) -> int:
    from validation import runner

    backends: Any = {"llvm": SimpleNamespace(library=None)}
    context = Context(PROFILES["quick"], folder, "scalar_rgb", backends, {})

    def measured(i: int) -> list[Row]:
        time.sleep(0.01)
        _image(folder / f"{i}.exr", i)
        with (folder / "calls.txt").open("a") as file:
            file.write(f"{i}\n")
        return [Row("a study", f"row {i}", "", "", {"x": float(i)})]

    def body() -> int:
        with lock.held(folder / "validation.lock", "a validation"):
            rows, _ = runner.run([Task(f"task {i}", lambda i=i: measured(i)) for i in range(6)], context)  # type: ignore[misc]
            run_report.write_json(folder / "rows.json", rows, {})
            run_report.write_junit(folder / "junit.xml", rows, {})
            run_report.write_html(folder / "report.html", rows, {}, folder)
            runner.forget(context)
        return 0

    return exit_code.exit_code("validation", body)


def _render(folder: Path) -> int:
    words = "render", SCENES / "sphere.xml", "-o", folder / "out.exr", "-D", "res=16"
    return _command(*words, "--spp", "2", "--pass-spp", "1", "--restart")


def _whole_page(path: Path) -> Any:
    """Which page it is: the old one, or a new one with an end, whose commands name the folder."""
    text = path.read_text()
    return text if text == OLD else "new" if text.rstrip().endswith("</html>") else "torn"


def _pixels(path: Path) -> Any:
    return image_file.read_exr(path)[0].tobytes()


COMMANDS = {
    "accept": Command(_images, _accept, "old/*", 0),
    "diff --report": Command(_old_page, _diff, "out.html", 1, _whole_page),
    "validation": Command(lambda folder: None, _validate, "*.*", 0),
    "render": Command(lambda folder: _image(folder / "out.exr", 0), _render, "out.exr", 0, _pixels),
}
GROWING = {"calls.txt", "validation.lock"}  # of the study itself; the lock, which a killed process leaves


def examine(command: Command, kills: int, seed: int) -> dict[str, float]:
    """Kill it, fill the disk, let it end; how often something was wrong."""
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory() as name:
        old, new = Path(name, "undisturbed"), Path(name, "killed")
        for folder in (old, new):
            folder.mkdir()
            # Not here: OpenImageIO would start threads, which the forked processes miss.
            _run(replace(command, run=lambda folder: command.prepare(folder) or 0), folder)
        before = _state(command, old)
        start = time.perf_counter()
        code, _ = _run(command, old)
        took = time.perf_counter() - start
        after = _state(command, old)
        torn = ends = 0
        for i in range(kills):
            if i % 2:
                code_then, said = _run(command, new, size=rng.choice((0, 100, 1000, rng.randrange(60_000))))
                lines = [line for line in said.splitlines() if not line.startswith("task ")]  # which tell the progress
                ends += not ((code_then == 2 and len(lines) == 1) or code_then == command.code)
            else:
                number = SIGNALS[i // 2 % len(SIGNALS)]
                ends += not _ends_well(command, new, rng.uniform(0, took), number)
            torn += _torn(_state(command, new), before, after)
        for place in {path.parent for path in new.glob(command.outputs)}:  # as a kill in the middle of a file leaves it
            atomic.temporary_name(place / "half", "").write_text("half")
        if command.content is Path.read_bytes and before:  # so that something is left to do
            first = next(path for path in new.glob(command.outputs) if path.name in before)
            first.write_bytes(before[first.name])
        last, _ = _run(command, new)
        well = code == last == command.code and _state(command, new).keys() == after.keys() and not _temporary(new)
        bad = not well or _torn(_state(command, new), after, after)
    return {"kills": float(kills), "torn files": float(torn), "wrong ends": float(ends), "bad restarts": float(bad)}


def _ends_well(command: Command, folder: Path, after: float, number: signal.Signals) -> bool:
    """Whether a signal that comes `after` so many seconds ends the command as it should, or comes too late."""
    before = _temporary(folder)
    code, said = _run(command, folder, kill=after, number=number)
    if number != signal.SIGINT:
        return code in (-number, 128 + number, command.code)  # a render that keeps what it has says 128 + number
    if code == command.code or "Fatal Python error: init" in said:  # Python itself was not there yet
        return True
    return code in (exit_code.INTERRUPTED, -number) and _temporary(folder) <= before


def _temporary(folder: Path) -> set[Path]:
    """What only a command that is still running may have there."""
    return {path for path in folder.rglob("*") if path.name.startswith(".") or path.name == "validation.lock"}


def _state(command: Command, folder: Path) -> dict[str, Any]:
    state = {}
    for path in folder.glob(command.outputs):
        if path.is_file() and not path.name.startswith(".") and path.name not in GROWING:
            try:
                state[path.name] = command.content(path)
            except (OSError, ValueError) as error:
                state[path.name] = error
    return state


def _torn(state: dict[str, Any], *known: dict[str, Any]) -> int:
    """The number of files that are in none of the known states."""
    return sum(not any(found == each.get(name) for each in known) for name, found in state.items())


def _run(
    command: Command,
    folder: Path,
    kill: float | None = None,
    number: signal.Signals = signal.SIGKILL,
    size: int | None = None,
) -> tuple[int, str]:
    """Exit code (−9: by SIGKILL) and stderr of the command in a process of its own, with a signal after `kill` s."""
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        _become(command, folder, writing, size)
    os.close(writing)
    if kill is not None:
        time.sleep(kill)
        os.kill(child, number)
    with os.fdopen(reading, "rb") as said:
        text = said.read().decode(errors="replace")
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), text


def _become(command: Command, folder: Path, writing: int, size: int | None) -> None:
    """In the child: run the command, and do not return."""
    code = 99
    try:
        os.dup2(os.open(os.devnull, os.O_RDWR), 1)
        os.dup2(writing, 2)
        signal.alarm(HANG)
        if size is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
        code = command.run(folder)
    except KeyboardInterrupt:
        code = exit_code.INTERRUPTED
    finally:
        os._exit(code)


def _rows(context: Context) -> list[Row]:
    kills = KILLS[context.profile.name]
    # In a process without threads, which a fork would leave behind.
    words = [sys.executable, "-m", __spec__.name, str(kills)]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    if ended.returncode:
        raise ValueError(f"killed commands: {' '.join(ended.stderr.split())[-300:]}")
    return [
        Row(STUDY.name, name, "killed", "", values, budgets=BUDGETS, replay={"seed": 0, "kills": kills})
        for name, values in json.loads(ended.stdout).items()
    ]


STUDY = Study(
    "killed commands",
    "Killed commands and full disks",
    about(__doc__),
    TERMS,
    lambda context: [Task("killed commands", lambda: _rows(context), timed=True)],
)


def main(arguments: Sequence[str]) -> int:
    """`KILLS [COMMAND …]`."""
    chosen = arguments[1:] or list(COMMANDS)
    print(json.dumps({name: examine(COMMANDS[name], int(arguments[0]), seed=0) for name in chosen}))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

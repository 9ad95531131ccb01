"""Run times of comparisons, of reading the files, and of writing the HTML page; and the memory of a comparison.

The images are smooth, with the noise of 16 samples per pixel, in zip-compressed EXR files. All subjects run once per
round; the rows have medians over the rounds, with 95 % intervals. Times depend on the machine, so they have goals
instead of budgets; only times "from the shell" include the start of Python and its imports. The size of the page has a
budget. Memory is the peak of a process that compares and writes the page.
"""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_refract.image_diff import folders, html_report
from mi_refract.image_diff.methods import AUTO, METHODS
from mi_refract.image_diff.settings import Settings
from mi_refract.io import image_file
from mi_refract.report.row import Row
from validation import limits
from validation.run import kernel_timing
from validation.run.context import Context
from validation.study import Study, Task, about

TERMS = {
    "seconds": "median time to read and compare, or to write the page; low, high: its 95 % interval",
    "time / reading": "median of the rounds' ratios to reading the same files; low, high: its 95 % interval",
    "time / libraries": "the same for the ratio to a process that only imports OpenImageIO and NumPy",
    "MB of page": "size of the HTML file",
    "MB of memory": "the largest resident set of the whole process",
    "8 + 8": "8 renders of one image on each side",
    AUTO: "tolerance here: the images have no information on their noise",
}
SHELL, LIBRARIES = "from the shell", "import the libraries"
NAME = "diff_times"
SEED = 2034
SPP, GAIN = 16, 1.05  # the noise of the renders; the gain of a quarter of the other image
SMALL, RENDERS = 256, 8  # width and height of the small images in pixels; renders per side
MEGABYTE = 1e6


@dataclass(frozen=True)
class Size:
    """Size of the large images, number of pairs in the folder of small images, number of rounds."""

    height: int
    width: int
    pairs: int
    rounds: int


SIZES = {"quick": Size(135, 240, 5, 6), "standard": Size(270, 480, 20, 7), "full": Size(1080, 1920, 1000, 7)}
PROCESS = """
import sys
from mi_refract.cli import main
main(sys.argv[1:])
print([line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")][0])
"""


@dataclass(frozen=True)
class Subject:
    """A timed function, its images, and the subject `beside` for the `ratio` of times; "" for none."""

    case: str
    run: Callable[[], object]
    beside: str = ""
    ratio: str = "time / reading"


def tasks(context: Context) -> list[Task]:
    """Return one task: its subjects take turns."""
    return [Task("diff, times", functools.partial(measure, SIZES[context.profile.name], context.variant), timed=True)]


def measure(size: Size, setting: str) -> list[Row]:
    """Return a row per subject, a row of the page's size, and a row of the memory of the largest comparison."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        write(root, size)
        subjects = subjects_of(root, size)
        timed = {name: subject.run for name, subject in subjects.items()}
        seconds = kernel_timing.rounds(timed, _clock, size.rounds)  # the first round is a warm-up
        rows = []
        for name, subject in subjects.items():
            values = kernel_timing.interval("seconds", seconds[name])
            if subject.beside:
                values |= kernel_timing.ratio(subject.ratio, seconds[name], seconds[subject.beside])
            limited = size == SIZES["full"] and name in limits.DIFF_SECONDS
            goals = {"seconds": limits.DIFF_SECONDS[name]} if limited else {}
            replay = {"seed": SEED, "rounds": size.rounds}
            rows.append(Row(NAME, name, subject.case, setting, values, goals=goals, replay=replay))
        page = {"MB of page": (root / "page.html").stat().st_size / MEGABYTE}
        budgets = {"MB of page": limits.PAGE_MEGABYTES}
        rows.append(Row(NAME, "size of the page", subjects["page"].case, setting, page, budgets))
        case = subjects["welch"].case
        if not Path("/proc/self/status").exists():
            return [*rows, Row(NAME, "memory", case, setting, reason="this system does not report peak memory")]
        words = ["diff", str(root / "a"), str(root / "b"), "--renders", "--report", str(root / "welch.html")]
        memory = {"MB of memory": 1024 * json.loads(python("-c", PROCESS, *words).split()[-1]) / MEGABYTE}
        return [*rows, Row(NAME, "memory", case, setting, memory, {"MB of memory": limits.MEMORY_MEGABYTES})]


def write(root: Path, size: Size) -> None:
    """Write `a`, `b`: renders of one image; and `many_a`, `many_b`: small images that differ in last bits only."""
    rng = np.random.default_rng(SEED)
    y, x = np.mgrid[: size.height, : size.width]
    smooth = ((0.4 + 0.3 * np.sin(x / 90) * np.cos(y / 70))[..., None] * [1, 0.8, 0.6]).astype(np.float32)
    for side in ("a", "b"):
        (root / side).mkdir()
        for seed in range(RENDERS):
            image = smooth * rng.gamma(SPP, 1 / SPP, smooth.shape).astype(np.float32)
            if side == "b":
                image[: size.height // 2, : size.width // 2] *= GAIN
            image_file.write_exr(root / side / f"{seed}.exr", image)
    small = smooth[:SMALL, :SMALL]
    for side, gain in (("many_a", 1.0), ("many_b", 1 + 1e-5)):
        (root / side).mkdir()
        for number in range(size.pairs):
            noise = np.random.default_rng(number).gamma(SPP, 1 / SPP, small.shape).astype(np.float32)
            image_file.write_exr(root / side / f"{number:04}.exr", np.float32(gain) * small * noise)


def subjects_of(root: Path, size: Size) -> dict[str, Subject]:
    """Return the subjects: reading alone; the verdict of each method and of a folder; the page of a different image."""
    a, b = root / "a", root / "b"
    one = f"{size.width} × {size.height}"
    several, many = f"{one}, {RENDERS} + {RENDERS}", f"{size.pairs} pairs of {SMALL}²"
    files = [[sorted((root / f"{kind}{side}").iterdir()) for side in "ab"] for kind in ("", "many_")]

    def read(sides: list[list[Path]]) -> None:
        with ThreadPoolExecutor(2) as pool:
            for pair in zip(*sides, strict=True):
                list(pool.map(image_file.read, pair))

    subjects = {
        "read the pair": Subject(one, functools.partial(read, [side[:1] for side in files[0]])),
        "read the renders": Subject(several, functools.partial(read, files[0])),
        "read the folder": Subject(many, functools.partial(read, files[1])),
        LIBRARIES: Subject("", functools.partial(python, "-c", "import OpenImageIO, numpy")),
    }
    for name, method in METHODS.items():
        sides = (a, b) if method.takes_renders else (a / "0.exr", b / "0.exr")
        compare = functools.partial(folders.diff, *sides, Settings.for_all(method=name), renders=method.takes_renders)
        beside = "read the renders" if method.takes_renders else "read the pair"
        subjects[name] = Subject(several if method.takes_renders else one, compare, beside)
    subjects[AUTO] = Subject(many, functools.partial(folders.diff, root / "many_a", root / "many_b"), "read the folder")
    small = [str(root / side / "0000.exr") for side in ("many_a", "many_b")]
    shell = functools.partial(python, "-m", "mi_refract.cli", "diff", *small)
    subjects[SHELL] = Subject(f"a pair of {SMALL}²", shell, LIBRARIES, "time / libraries")
    judged = folders.diff(a / "0.exr", b / "0.exr", Settings.for_all(method="tolerance"), maps=True)
    subjects["page"] = Subject(one, functools.partial(html_report.write, root / "page.html", judged))
    return subjects


def python(*words: str) -> str:
    """Run Python and return its output, with cached byte code as in an installed package. OSError if it fails."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    done = subprocess.run([sys.executable, *words], env=environment, capture_output=True, text=True)
    if done.returncode:
        raise OSError(f"diff, times: {done.stderr.strip()}")
    return done.stdout


def _clock(run: Callable[[], object]) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


STUDY = Study(NAME, "Diff, times", about(__doc__), TERMS, tasks)

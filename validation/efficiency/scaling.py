"""Scaling: time to the first image, time of later images, and memory, as one property of a scene grows.

Each measurement is a new process with an empty kernel cache. "First image" is the time from the loaded scene to the
image, including tracing and compilation; "render" is the median of the following images; "after an edit" is one more
image after one index of refraction was changed. Imports and loading are not counted. Methods run in turn, and medians
over the processes are reported.
"""

from __future__ import annotations

import functools
import json
import math
import os
import site
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
from scipy.spatial import ConvexHull

from mi_refract.numerics import mitsuba_mesh
from mi_refract.report.row import Row
from validation import limits
from validation.run.context import SCENES, Context
from validation.run.render_methods import BUILTIN, METHODS, Camera, Method, camera, sensor
from validation.study import Study, Task, about

TERMS = {
    "first image": "seconds, including compilation; / built-in: over those of path + dielectric",
    "render": "seconds of a later image, with the kernels in memory",
    "after an edit": "seconds of the image after an edit of one index of refraction",
    "arrays MB": "peak memory of Dr.Jit's arrays; process MB: peak memory of the whole process",
}
AXES = {"x": "size", "y": "seconds", "slope": None}
NAME = "scaling"
SCALAR = "needs a compiled variant: a scalar one compiles nothing"
LIMIT = 600.0  # seconds of a process
TIMES = ("first image", "render", "after an edit")


@dataclass(frozen=True)
class Knob:
    """A property that grows: `make(method, size, resolution)` returns the camera; `quick` and `full` are the sizes.

    `every`: also measure the methods that split, which differ by their kernels only.
    """

    make: Callable[[Method, int, int], Camera]
    quick: tuple[int, ...]
    full: tuple[int, ...]
    every: bool = False


@dataclass(frozen=True)
class Job:
    """One process; `renders`: the number of images after the first."""

    variant: str
    knob: str
    size: int
    method: str
    resolution: int
    spp: int
    renders: int


# Scenes --------------------------------------------------------------------------------------------------------


def _glasses(method: Method, size: int, resolution: int) -> Camera:
    """Return a square of balls, each with its own index from 1.3 to 2.5, in an environment of radiance 1."""
    side = math.ceil(math.sqrt(size))
    parts = {
        f"ball_{i}": {
            "type": "sphere",
            "center": [10 * (i % side - (side - 1) / 2), 10 * (i // side - (side - 1) / 2), 0],
            "radius": 4.5,
            "bsdf": {"type": method.bsdf, "int_ior": 1.3 + 1.2 * i / size, "ext_ior": 1.0},
        }
        for i in range(size)
    }
    return _in_memory(method, parts, 10.0 * side, resolution)


def _triangles(method: Method, size: int, resolution: int) -> Camera:
    """Return a ball of BK7 with about `size` triangles."""
    import mitsuba as mi

    vertices, faces = ball_mesh(size)
    properties = mi.Properties()
    properties["glass"] = mi.load_dict({"type": method.bsdf, "int_ior": "bk7", "ext_ior": "air"})
    mesh = mitsuba_mesh.make(mi, 4.5 * vertices, faces, properties=properties)
    return _in_memory(method, {"ball": mesh}, 10.0, resolution)


def ball_mesh(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and outward triangles of a unit sphere of `size` triangles: the hull of Fibonacci points."""
    count = size // 2 + 2
    i = np.arange(count) + 0.5
    z, turn = 1 - 2 * i / count, np.pi * (1 + math.sqrt(5)) * i
    vertices = np.column_stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z])
    faces = ConvexHull(vertices).simplices
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", a, np.cross(b, c)) < 0
    faces[inward] = faces[inward][:, ::-1]
    return vertices.astype(np.float32), faces.astype(np.uint32)


def _in_memory(method: Method, parts: dict[str, Any], extent: float, resolution: int) -> Camera:
    import mitsuba as mi

    view = sensor(resolution, 20, [0, 0, 3 * extent])
    scene = mi.load_dict({"type": "scene", "sensor": view, "sky": {"type": "constant"}, **parts})
    return Camera(scene, mi.load_dict(method.plugin(24)))


KNOBS = {
    "glasses": Knob(_glasses, (1, 64), (1, 4, 16, 64, 256, 1000)),
    "triangles": Knob(_triangles, (30_000,), (1000, 10_000, 100_000, 1_000_000)),
    "depth": Knob(
        lambda m, size, res: camera(SCENES / "lightpipe.xml", m, res, max_depth=size), (4, 64), (4, 16, 64, 256)
    ),
    "pixels": Knob(
        lambda m, size, res: camera(SCENES / "balls.xml", m, math.isqrt(size)),
        (128**2,),
        (32**2, 128**2, 512**2, 1024**2),
    ),
    "spp": Knob(lambda m, size, res: camera(SCENES / "balls.xml", m, res), (16,), (4, 32, 256), every=True),
}


# One process ---------------------------------------------------------------------------------------------------


def measure(job: Job) -> dict[str, float]:
    """Measure in this process: seconds of the first image, of later ones, and after an edit; peak memory in MB."""
    import mitsuba as mi

    import mi_refract  # noqa: F401  its plugins

    mi.set_variant(job.variant)
    method = next(method for method in METHODS if method.name == job.method)
    camera = KNOBS[job.knob].make(method, job.size, job.resolution)
    spp = job.size if job.knob == "spp" else job.spp
    first, *later = [camera(spp, seed)[1] for seed in range(1 + job.renders)]
    arrays = dr.detail.malloc_watermark(dr.backend_v(mi.Float))
    values = {"first image": first, "render": statistics.median(later), "arrays MB": arrays / 1e6}
    parameters = mi.traverse(camera.scene)
    name = next(name for name in parameters.keys() if name.endswith("eta"))  # noqa: SIM118  no dictionary
    parameters[name] = parameters[name] * 1.01
    parameters.update()
    values["after an edit"] = camera(spp, seed=0)[1]
    # The peak of this process; in `getrusage` a child inherits the peak of its parent.
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    values["process MB"] = next((1.024e-3 * float(x.split()[1]) for x in lines if x.startswith("VmHWM:")), math.nan)
    return values


def run(job: Job, home: str) -> dict[str, float]:
    """Run `measure` in a process with the kernel cache in the folder `home`; NaN as first image if nothing compiled.

    Dr.Jit's cache is below the home folder, which is the only way to move it; CUDA and OptiX have their own variables.
    RuntimeError, with the last line on stderr, if the process fails.
    """
    before = _files(home)
    environment = dict.fromkeys(("HOME", "CUDA_CACHE_PATH", "OPTIX_CACHE_PATH"), home)
    environment["PYTHONUSERBASE"] = site.getuserbase()  # packages may be below the home folder too
    done = subprocess.run(
        [sys.executable, "-m", "validation.efficiency.scaling", json.dumps(vars(job))],
        cwd=SCENES.parent,
        check=False,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=LIMIT,
    )
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise RuntimeError(f"{job.method}, {job.knob} = {job.size}: exit code {done.returncode}: {last}")
    values: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return values if _files(home) > before else values | {"first image": math.nan}


def _files(folder: str) -> int:
    return sum(path.is_file() for path in Path(folder).rglob("*"))


# Rows ----------------------------------------------------------------------------------------------------------


def tasks(context: Context) -> list[Task]:
    """Return one task per knob; in the profile `quick`, only the number of glasses."""
    knobs = ("glasses",) if context.profile.quick else tuple(KNOBS)
    return [Task(f"scaling: {name}", functools.partial(knob_rows, context, name), timed=True) for name in knobs]


def knob_rows(context: Context, knob: str, methods: tuple[Method, ...] = METHODS) -> list[Row]:
    """Return a row per size and method, and rows with the curves."""
    if context.scalar:
        return [Row(NAME, "every method", knob, context.variant, reason=SCALAR)]
    if not KNOBS[knob].every:
        methods = tuple(method for method in methods if not method.parameters)
    sizes = KNOBS[knob].full if context.profile.name == "full" else KNOBS[knob].quick
    by_size = {size: _size_rows(context, knob, size, methods) for size in sizes}
    rows = [row for of_size in by_size.values() for row in of_size]
    for metric in TIMES[:2] if len(sizes) > 1 else ():
        curves = {
            method.name: [(float(size), of_size[i].values[metric]) for size, of_size in by_size.items()]
            for i, method in enumerate(methods)
        }
        processes = {"processes": float(_processes(context))}
        rows.append(Row(NAME, "every method", f"{knob}: {metric}", context.variant, processes, curves=curves))
    return rows


def _size_rows(context: Context, knob: str, size: int, methods: tuple[Method, ...]) -> list[Row]:
    """Return a row per method, of which the first is the built-in: medians over processes that alternate."""
    full = context.profile.name == "full"
    resolution, renders = (128, 5) if full else (64, 3)
    jobs = {m.name: Job(context.variant, knob, size, m.name, resolution, 16, renders) for m in methods}
    measured: dict[str, list[dict[str, float]]] = {name: [] for name in jobs}
    order = list(jobs)
    for _ in range(_processes(context)):
        for name in order:
            with tempfile.TemporaryDirectory() as home:
                measured[name].append(run(jobs[name], home))
        order.reverse()
    medians = {
        name: {metric: statistics.median(values[metric] for values in runs) for metric in runs[0]}
        for name, runs in measured.items()
    }
    rows = []
    for name, values in medians.items():
        goals: dict[str, float] = {}
        if name != BUILTIN.name:
            values |= {f"{metric} / built-in": values[metric] / medians[BUILTIN.name][metric] for metric in TIMES}
            goals = limits.SCALING.get((knob, size), {})
        case, replay = f"{knob} = {size}", vars(jobs[name])
        rows.append(Row(NAME, name, case, context.variant, values, goals=goals, replay=replay))
    return rows


def _processes(context: Context) -> int:
    return 3 if context.profile.name == "full" else 1


STUDY = Study(NAME, "Scaling", about(__doc__), TERMS, tasks, axes=AXES)


if __name__ == "__main__":
    print(json.dumps(measure(Job(**json.loads(sys.argv[1])))))

"""Indices that change: a new scene for each image, an edit among many glasses, a sweep.

`dielectric` has its index in the kernel, so a new index needs a compilation; `refract` reads it from memory. A new
scene is timed from its dictionary to its image, an edit from the number to the image, a sweep over all its images.
Everything else is compiled before. The two plugins alternate, every second round in reverse order, each alone in
memory, since Dr.Jit compiles the code of all plugins in memory. No index is used twice.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.plugins import PLUGIN
from mi_refract.report.row import Row
from validation import limits
from validation.run import kernel_timing
from validation.run.context import Context
from validation.run.glass_balls import Balls, alone, seconds_of
from validation.run.metrics import TIME_OVER_BUILTIN
from validation.run.render_methods import BUILTIN, OURS
from validation.study import Study, Task, about

NAME = "changing indices"
TERMS = {
    TIME_OVER_BUILTIN: f"of `{PLUGIN}` by `{OURS}`, over `{BUILTIN.bsdf}` by `{BUILTIN.integrator}`; the median over "
    "the rounds; low, high: its 95 % interval",
    "ms": "median time in milliseconds",
}
SIDES = {OURS: PLUGIN, BUILTIN.integrator: BUILTIN.bsdf}
ROUNDS, DEPTH = 9, 8
MANY = {"quick": 64, "standard": 300, "full": 300}  # number of glasses, of which one is edited
SWEEP = 12  # number of indices


def tasks(context: Context) -> list[Task]:
    """Return one task per way to change an index."""
    if context.scalar:
        return [Task(NAME, lambda: [Row(NAME, OURS, "every way", context.variant, reason="nothing is compiled")])]
    many = MANY[context.profile.name]
    ways: dict[str, Callable[[Callable[[], float], str], float]] = {
        "a new scene for each image": new_scene,
        f"an edit among {many} glasses": functools.partial(edits, many, 1),
        f"a sweep of {SWEEP} indices": functools.partial(edits, 1, SWEEP),
    }
    return [Task(f"{NAME}: {way}", functools.partial(rows, context, way, ways[way]), timed=True) for way in ways]


def rows(context: Context, way: str, clock: Callable[[Callable[[], float], str], float]) -> list[Row]:
    """Return the row of a way to change an index."""
    fresh = functools.partial(np.random.default_rng().uniform, 1.2, 1.9)
    seconds = kernel_timing.rounds({name: name for name in SIDES}, functools.partial(clock, fresh), ROUNDS)
    values = kernel_timing.ratio(TIME_OVER_BUILTIN, *seconds.values())
    values |= {f"ms, {SIDES[name]}": 1e3 * float(np.median(x)) for name, x in seconds.items()}
    goals = {TIME_OVER_BUILTIN: limits.CHANGING[way]} if way in limits.CHANGING else {}
    return [Row(NAME, OURS, way, context.variant, values, goals=goals, replay={"rounds": ROUNDS})]


def new_scene(fresh: Callable[[], float], side: str) -> float:
    """Return the seconds from a dictionary to its image, after an image of another scene."""
    with alone(SIDES[side], 1, integrator=side, max_depth=DEPTH) as before:
        dr.eval(before.image())
    in_memory = []  # until the time is taken

    def image() -> Any:
        in_memory.append(Balls(SIDES[side], 1, integrator=side, max_depth=DEPTH, least=fresh()))
        return in_memory[0].image()

    return seconds_of(image)


def edits(count: int, times: int, fresh: Callable[[], float], side: str) -> float:
    """Return the seconds of `times` edits of one of `count` glasses, each with its image."""
    with alone(SIDES[side], count, integrator=side, max_depth=DEPTH) as balls:
        dr.eval(balls.image())

        def images() -> None:
            for _ in range(times):
                balls.edit(fresh())
                dr.eval(balls.image())

        return seconds_of(images)


STUDY = Study(NAME, "Indices that change", about(__doc__), TERMS, tasks)

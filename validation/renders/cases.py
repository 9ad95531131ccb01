"""Shared by the studies of `refract_path`: one task per case, under the case's variant of Mitsuba, and scene parts."""

from __future__ import annotations

import functools
import gc
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from mi_refract.report.row import Row
from validation.repeated import by_tasks
from validation.run.context import Context
from validation.run.render_methods import OURS, under
from validation.study import Study, Task, about

Nodes = dict[str, Any]  # for `mi.load_dict`
GLASS = {"type": "refract", "int_ior": 1.5, "ext_ior": 1.0}
MATT = {"type": "diffuse", "reflectance": 0.6}
BLACK = {"type": "diffuse", "reflectance": 0.0}


@dataclass(frozen=True)
class Case:
    """One case of a study: `rows()` measures it under `variant`. `title` is unique within the study."""

    title: str
    variant: str
    rows: Callable[[], list[Row]]


def study(
    name: str,
    title: str,
    doc: str | None,
    terms: Mapping[str, str],
    cases: Callable[[Context], Iterable[Case]],
    timed: Callable[[Context], Iterable[Case]] = lambda context: (),
) -> Study:
    """Return a study with a task per case; all but the `timed` cases are repeated with other seeds."""

    def rows(context: Context, case: Case) -> list[Row]:
        if reason := context.variants.get(case.variant):
            return [Row(name, OURS, case.title, case.variant, reason=reason)]
        gc.collect()  # Dr.Jit compiles every plugin in memory
        with under(case.variant):
            return case.rows()

    def tasks(context: Context) -> list[Task]:
        if context.scalar:
            reason = "scalar variants have no derivatives and no random numbers of split paths, and take hours"
            return [Task(name, lambda: [Row(name, OURS, "every case", context.variant, reason=reason)])]
        return [Task(f"{name}: {case.title}", functools.partial(rows, context, case)) for case in cases(context)]

    def every(context: Context) -> list[Task]:
        timed_cases = () if context.scalar else timed(context)
        return tasks(context) + [
            Task(f"{name}: {case.title}", functools.partial(rows, context, case), timed=True) for case in timed_cases
        ]

    return Study(name, title, about(doc), terms, every, again=by_tasks(tasks))


def variants(context: Context) -> tuple[str, str, str]:
    """Return the RGB, spectral and polarised variants of the run's backend."""
    family = context.variant.removesuffix("rgb")
    return context.variant, f"{family}spectral", f"{family}spectral_polarized"


def bitmap(pixels: Any, **parameters: Any) -> Nodes:
    """Return a texture of numbers, height × width (× channels)."""
    pixels = np.asarray(pixels, np.float32)
    image = mi.Bitmap(pixels if pixels.ndim == 3 else pixels[..., None])
    return {"type": "bitmap", "bitmap": image, "raw": True} | parameters


def flat(value: Any, size: int = 1) -> Nodes:
    """Return a bitmap of one value, a number or three."""
    return bitmap(np.ones((size, size, 3)) * np.asarray(value))


def environment(pixels: Any) -> Nodes:
    """Return an environment map, height × width × 3."""
    return {"type": "envmap", "bitmap": mi.Bitmap(np.asarray(pixels, np.float32))}


TURNED = [0.5 + 0.5 * np.sin(0.35), 0.5, 0.5 + 0.5 * np.cos(0.35)]  # a normal map that tilts normals by 20 degrees

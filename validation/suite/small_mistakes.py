"""Small mistakes: do backward errors detect mistakes that the error bound of the textbook formula lets pass?

The textbook formula answers rays of the regime in which a mistake matters, once correctly and once with the mistake.
An answer within the bound passes as "as good as the textbook formula". It is right if it is the exact refraction of
inputs perturbed by no more roundings than the textbook formula itself needs. A mistake is detected if any answer is
above that.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mi_refract.formulas import FORMULAS
from mi_refract.ray_sets import ray_set
from mi_refract.ray_sets.header import PRECISIONS
from mi_refract.ray_sets.judged_answers import RIGHT, JudgedAnswers, judge_answers
from mi_refract.ray_sets.tir_signal import LOOSEST
from mi_refract.report.row import Row
from validation import limits, repeated
from validation.run import seeds
from validation.run.context import Context
from validation.study import Study, Task, about

NAME = "small mistakes"
SEED, COUNT = 2041, 2000
TERMS = {
    "passed before": "share of the answers that are within the error bound",
    "seen": f"share of the answers whose backward error, of direction or length, is above {RIGHT:g} u",
    "m, median": "median of the backward errors, in u",
    "m, worst": "the largest backward error, in u",
    "m, worst, without": "the largest one without the mistake, in u",
    "not seen": "1 if no backward error is above what rounding causes without the mistake",
}
Vectors = np.ndarray
Answer = Callable[[Vectors, Vectors, Vectors], Vectors]  # a, n (N, 3) and k (N, 1) of one precision → b


def textbook(a: Vectors, n: Vectors, k: Vectors) -> Vectors:
    """Return b = k a − (k c + √(1 − k² (1 − c²))) n with c = n·a < 0; zero under total internal reflection."""
    c = _dot(n, a)
    radicand = 1 - k * k * (1 - c * c)
    return np.where(radicand < 0, 0, k * a - (k * c + np.sqrt(np.maximum(radicand, 0))) * n)


def tilted(a: Vectors, n: Vectors, k: Vectors) -> Vectors:
    """Return the answer for n off by 1e-6 rad within the plane of incidence."""
    t = a - _dot(n, a) * n
    n = n + n.dtype.type(1e-6) * t / np.sqrt(_dot(t, t))
    return textbook(a, n / np.sqrt(_dot(n, n)), k)


def by_angles(a: Vectors, n: Vectors, k: Vectors) -> Vectors:
    """Return the answer from the angles of incidence and refraction, by acos and asin in float32."""
    incident = np.arccos(np.minimum(-_dot(n, a), 1).astype(np.float32))
    sine = k * np.sin(incident).astype(k.dtype)
    refracted = np.arcsin(np.minimum(sine, 1).astype(np.float32)).astype(k.dtype)
    t = a - _dot(n, a) * n
    return np.where(sine > 1, 0, np.sin(refracted) * t / np.sqrt(_dot(t, t)) - np.cos(refracted) * n)


def rounded_contrast(a: Vectors, n: Vectors, k: Vectors) -> Vectors:
    """Return b = k (a − c n) − √(c² − κ (1 − c²)) n with κ = k² − 1 in float32."""
    single, c = k.astype(np.float32), _dot(n, a)
    contrast = (single * single - 1).astype(k.dtype)
    across = np.cross(n, a)
    radicand = c * c - contrast * _dot(across, across)
    return np.where(radicand < 0, 0, k * (a - c * n) - np.sqrt(np.maximum(radicand, 0)) * n)


def _dot(x: Vectors, y: Vectors) -> Vectors:
    return np.asarray((x * y).sum(1, keepdims=True))


@dataclass(frozen=True)
class Mistake:
    """`regime`: where the mistake matters. `harmless`: a precision in which it is no error beyond rounding, and why."""

    answer: Answer
    regime: str
    harmless: tuple[str, str] = ("", "")


MISTAKES = {
    "eta rounded to half precision": Mistake(
        lambda a, n, k: textbook(a, n, k.astype(np.float16).astype(k.dtype)), "generic"
    ),
    "normal off by 1e-6 rad": Mistake(tilted, "generic"),
    "angles by acos in float32": Mistake(by_angles, "near-normal"),
    "normal not made unit": Mistake(lambda a, n, k: textbook(a, n * n.dtype.type(1 - 1e-6), k), "critical"),
    "k² − 1 in float32": Mistake(
        rounded_contrast,
        "matched",
        ("f32", "no error of k: fl(k²) − 1 is the exact k² − 1 of a k less than 1 u off"),
    ),
}


def tasks(context: Context) -> list[Task]:
    """Return one task per mistake and precision."""
    return [
        Task(f"{NAME}: {name}, {precision}", functools.partial(rows, name, precision))
        for name in MISTAKES
        for precision in PRECISIONS
    ]


def rows(name: str, precision: str) -> list[Row]:
    """Return one row: the answers of the textbook formula with a mistake."""
    mistake = MISTAKES[name]
    rays = ray_set.make([mistake.regime], COUNT, precision, seeds.current(SEED))

    def judged(answer: Answer) -> JudgedAnswers:
        with np.errstate(all="ignore"):
            b = answer(rays.rays.a, rays.rays.n, rays.rays.k[:, None])
        if b.dtype != rays.rays.a.dtype:
            raise TypeError(f"{name}: answers in {b.dtype}; expected {rays.rays.a.dtype}")
        return judge_answers(b.astype(np.float64), None, rays.rays, precision, FORMULAS[LOOSEST].budget, "zero")

    with_it, without = judged(mistake.answer), judged(textbook)
    values = {
        "passed before": float(1 - with_it.wrong.mean()),
        "seen": float(1 - with_it.backward_within(RIGHT).mean()),
        "m, median": float(np.median(with_it.backward)),
        "m, worst": float(with_it.backward.max()),
        "m, worst, without": float(without.backward.max()),
        "not seen": float(with_it.backward_within(RIGHT).all()),
    }
    harmless = mistake.harmless[1] if precision == mistake.harmless[0] else ""
    budgets: dict[str, float] = {"m, worst, without": limits.TEXTBOOK_BACKWARD}
    budgets |= {} if harmless else {"not seen": 0.0}
    replay = {"regime": mistake.regime, "count": COUNT, "seed": seeds.current(SEED)}
    return [Row(NAME, name, mistake.regime, precision, values, budgets, reason=harmless, replay=replay)]


STUDY = Study(NAME, "Small mistakes", about(__doc__), TERMS, tasks, again=repeated.by_tasks(tasks))

"""Gradients of images by `refract_path`, in forward and in backward mode, against finite differences of its images.

A derivative g is compared with the central difference D = (4 D(h) − D(2h))/3, whose four images have the same random
numbers. D splits; g does not, and has other random numbers. Of both, Σ W g and Σ W D are taken over the pixels; W is a
D of a seed of its own, so that nothing cancels. The terms d = W (g − D) of the pixels are independent of each other,
with the mean 0 where the derivative is right: z = Σ d / √Σ d². Backward mode draws the numbers of forward mode, so both
differ by rounding only.

Edges that move, in the image or in the view of a matt surface, are in none of these derivatives: where a scene has
them, rows record by how much each integrator is off. In the profile `full` Mitsuba's own stand beside, with a render
each; else `path` where something is excluded.

`python -m validation stability`
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refract.report.row import Row
from validation import limits
from validation.repeated import by_tasks
from validation.run.context import Context
from validation.run.render_methods import OURS, under
from validation.run.seeds import current
from validation.study import Study, Task, about

from .gradient_scenes import CASES, QUICK, Case

NAME = "gradients"
TERMS = {
    "gradient": "Σ W g in forward mode; differences: Σ W D of finite differences",
    "off": "|gradient / differences − 1|",
    "z": "their difference over its standard error; above the limit once in 10⁵ rows by chance",
    "detectable": "relative difference that is an alarm with probability 1/2",
    "truncation": "what the step of finite differences changes in D(h), relative",
    "backward": "backward mode minus forward mode, over the standard error",
    "right by path only": "1 where `path` gives the derivative and `refract_path` does not",
}
RENDERS, SEED = 3, 2037


class Images:
    """The images of a case by an integrator, and their derivatives in the case's parameter."""

    def __init__(self, case: Case, integrator: str, **parameters: int) -> None:
        """`parameters` of the integrator."""
        self.case, self.scene = case, mi.load_dict(case.make(), parallel=False, optimize=False)
        self.integrator: Any = mi.load_dict({"type": integrator, "max_depth": 6, "rr_depth": 100} | parameters)
        self.params = mi.traverse(self.scene)
        (self.key,) = [key for key in self.params.keys() if key.endswith(case.key)]  # noqa: SIM118  no dictionary
        self.before = dr.detach(self.params[self.key])

    def _set(self, x: float) -> None:
        self.params[self.key] = self.case.of(dr.opaque(mi.Float, x), self.before)
        self.params.update()

    @contextmanager
    def _attached(self) -> Iterator[Any]:
        """The parameter, for a while: Dr.Jit differentiates all plugins that are in memory."""
        x = dr.opaque(mi.Float, self.case.at)
        dr.enable_grad(x)
        self.params[self.key] = self.case.of(x, self.before)
        self.params.update()
        try:
            yield x
        finally:
            self._set(self.case.at)

    def differences(self, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """D and D(h), as images."""

        def image(x: float) -> np.ndarray:
            self._set(x)
            return np.array(mi.render(self.scene, integrator=self.integrator, spp=self.case.spp, seed=seed), float)

        at, h = self.case.at, self.case.step
        near, far = ((image(at + s * h) - image(at - s * h)) / (2 * s * h) for s in (1, 2))
        return (4 * near - far) / 3, near

    def forward(self, seed: int) -> np.ndarray:
        """The derivative of the image."""
        with self._attached() as x:
            dr.forward(x, dr.ADFlag.ClearEdges)  # Mitsuba's forward mode begins at the parameters of the scene
            return np.array(self.integrator.render_forward(self.scene, params=x, spp=self.case.spp, seed=seed), float)

    def backward(self, weights: np.ndarray, seed: int) -> float:
        """That of the sum of the weighted pixels."""
        given = mi.TensorXf(weights.astype(np.float32))
        with self._attached() as x:
            self.integrator.render_backward(self.scene, params=x, grad_in=given, spp=self.case.spp, seed=seed)
            return float(dr.grad(x)[0])


def tasks(context: Context) -> list[Task]:
    """One a case; two in the profile `quick`."""
    if context.scalar:
        reason = "scalar variants have no derivatives"
        return [Task(NAME, lambda: [Row(NAME, OURS, "every case", context.variant, reason=reason)])]
    names = QUICK if context.profile.quick else tuple(CASES)
    return [Task(f"{NAME}: {name}", functools.partial(rows, context, name)) for name in names]


def rows(context: Context, name: str) -> list[Row]:
    """A row of `refract_path`, and one of each of Mitsuba's integrators that stand beside it."""
    case = CASES[name]
    others = case.others if context.profile.name == "full" else ("path",) if case.excluded else ()
    variant = context.variant.replace("rgb", "spectral") if case.spectral else context.variant
    if reason := context.variants.get(variant):
        return [Row(NAME, OURS, name, variant, reason=reason)]
    seed = current(SEED)
    replay = {"seed": seed, "spp": case.spp, "renders": RENDERS, "step": case.step}
    with under(variant):
        split = Images(case, OURS, split_depth=2)
        weights = split.differences(seed)[0]
        weights /= np.sqrt((weights**2).mean())
        expected, near = weights * np.mean([split.differences(seed + 1 + i) for i in range(RENDERS)], axis=0)
        ours = Images(case, OURS)
        found = weights * [ours.forward(seed + 100 + i) for i in range(RENDERS)]
        values, error = compared(found.mean(axis=0), expected)
        backward = split.backward(weights / weights.size, seed + 100) - float(found[0].mean())
        beside = [other(case, each, weights, expected, variant, replay) for each in others]
    worse = [is_right(row.values) and not is_right(values) for row in beside if row.subject == "path"]
    values |= {"truncation": abs(float(near.mean() / expected.mean()) - 1), "backward": abs(backward) / error}
    values |= {"right by path only": float(any(worse))}
    budgets = {"backward": limits.BACKWARD_MODE, "right by path only": 0.0}
    if not case.excluded:
        budgets |= {"z": limits.GRADIENT_ALARM, "detectable": limits.GRADIENT, "truncation": limits.TRUNCATION}
    return [Row(NAME, OURS, name, variant, values, budgets, reason=case.excluded, replay=replay), *beside]


def other(case: Case, integrator: str, weights: Any, expected: Any, variant: str, replay: dict[str, Any]) -> Row:
    """What another integrator gives, or how it refuses; nothing is demanded."""
    name = next(name for name, each in CASES.items() if each is case)
    try:
        found = weights * Images(case, integrator).forward(replay["seed"] + 100)
    except RuntimeError as error:
        return Row(NAME, integrator, name, variant, reason=f"an error: {str(error).splitlines()[0]}")
    if not np.isfinite(found).all():
        return Row(NAME, integrator, name, variant, reason="infinite")
    return Row(NAME, integrator, name, variant, compared(found, expected)[0], replay=replay)


def compared(found: np.ndarray, expected: np.ndarray) -> tuple[dict[str, float], float]:
    """The values of a row, and the standard error of the difference."""
    terms, gradient, mean = (found - expected).sum(axis=2) / found.size, float(found.mean()), float(expected.mean())
    error = float(np.sqrt((terms**2).sum()))
    values = {"gradient": gradient, "differences": mean, "off": abs(gradient / mean - 1)}
    return values | {"z": abs(gradient - mean) / error, "detectable": limits.GRADIENT_ALARM * error / mean}, error


def is_right(values: dict[str, float]) -> bool:
    """Whether a derivative is that of the image, as far as can be told."""
    return bool(values) and values["z"] <= limits.GRADIENT_ALARM and values["detectable"] <= limits.GRADIENT


STUDY = Study(NAME, "Gradients of images", about(__doc__), TERMS, tasks, again=by_tasks(tasks))

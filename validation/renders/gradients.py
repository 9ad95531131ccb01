"""Gradients of images by `refract_path`, in forward and in backward mode, against finite differences of its images.

A derivative g is compared with the central difference D = (4 D(h) − D(2h))/3, whose four images have the same random
numbers. D splits; g does not, and has other random numbers. Of both, Σ W g and Σ W D are taken over the pixels; W is a
D of a seed of its own, so that nothing cancels. The terms d = W (g − D) of the pixels are independent of each other,
with the mean 0 where the derivative is right: z = Σ d / √Σ d². Backward mode draws the numbers of forward mode, so both
differ by rounding only.

Edges that move, in the image or in the view of a matt surface, are in none of these derivatives: where a scene has
them, rows record by how much each integrator is off. In the profile `full` Mitsuba's own stand beside, with a render
each; else `path` where something is excluded.

`python -m validation renders`
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
from validation.run.context import Context
from validation.run.render_methods import OURS
from validation.run.seeds import current

from . import cases
from .gradient_scenes import CASES, CHANGES, QUICK, Gradient

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

    def __init__(self, case: Gradient, integrator: str, **parameters: int) -> None:
        """`parameters` of the integrator."""
        self.case, self.scene = case, mi.load_dict(case.make(), parallel=False, optimize=False)
        self.integrator: Any = mi.load_dict({"type": integrator, "max_depth": 6, "rr_depth": 100} | parameters)
        self.params = mi.traverse(self.scene)
        (self.key,) = [key for key in self.params.keys() if key.endswith(case.key)]  # noqa: SIM118  no dictionary
        self.before = dr.detach(self.params[self.key])

    def set(self, x: Any) -> None:
        """The parameter as it is at `x`."""
        self.params[self.key] = CHANGES[self.case.change](x, self.before)
        self.params.update()

    @contextmanager
    def attached(self) -> Iterator[Any]:
        """The parameter, for a while: Dr.Jit differentiates all plugins that are in memory."""
        x = dr.opaque(mi.Float, self.case.at)
        dr.enable_grad(x)
        self.set(x)
        try:
            yield x
        finally:
            self.set(dr.opaque(mi.Float, self.case.at))

    def differences(self, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """D and D(h), as images."""

        def image(x: float) -> np.ndarray:
            self.set(dr.opaque(mi.Float, x))
            return np.array(mi.render(self.scene, integrator=self.integrator, spp=self.case.spp, seed=seed), float)

        at, h = self.case.at, self.case.step
        near, far = ((image(at + s * h) - image(at - s * h)) / (2 * s * h) for s in (1, 2))
        return (4 * near - far) / 3, near

    def forward(self, seed: int) -> np.ndarray:
        """The derivative of the image."""
        with self.attached() as x:
            dr.forward(x, dr.ADFlag.ClearEdges)  # Mitsuba's forward mode begins at the parameters of the scene
            return np.array(self.integrator.render_forward(self.scene, params=x, spp=self.case.spp, seed=seed), float)

    def backward(self, weights: np.ndarray, seed: int) -> float:
        """That of the sum of the weighted pixels."""
        grad_in = mi.TensorXf(weights.astype(np.float32))
        with self.attached() as x:
            self.integrator.render_backward(self.scene, params=x, grad_in=grad_in, spp=self.case.spp, seed=seed)
            return float(dr.grad(x)[0])


def all_cases(context: Context) -> Iterator[cases.Case]:
    """Two in the profile `quick`."""
    for name in QUICK if context.profile.quick else CASES:
        variant = cases.variants(context)[CASES[name].spectral]
        yield cases.Case(name, variant, functools.partial(rows, context, name))


def rows(context: Context, name: str) -> list[Row]:
    """A row of `refract_path`, and one of each of Mitsuba's integrators that stand beside it."""
    case, variant = CASES[name], cases.variants(context)[CASES[name].spectral]
    others = case.others if context.profile.name == "full" else ("path",) if case.excluded else ()
    seed = current(SEED)
    replay = {"seed": seed, "spp": case.spp, "renders": RENDERS, "step": case.step}
    split, ours = Images(case, OURS, split_depth=2), Images(case, OURS)
    weights = split.differences(seed)[0]
    weights /= np.sqrt((weights**2).mean())
    expected, near = weights * np.mean([split.differences(seed + 1 + i) for i in range(RENDERS)], axis=0)
    forward = weights * [ours.forward(seed + 100 + i) for i in range(RENDERS)]
    values, error = compared(forward.mean(axis=0), expected)
    backward = split.backward(weights / weights.size, seed + 100) - float(forward[0].mean())

    beside = []  # what other integrators give, or how they refuse; nothing is demanded
    for integrator in others:
        row = functools.partial(Row, NAME, integrator, name, variant)
        try:
            theirs = weights * Images(case, integrator).forward(seed + 100)
        except RuntimeError as refusal:
            beside.append(row(reason=f"an error: {str(refusal).splitlines()[0]}"))
            continue
        finite = np.isfinite(theirs).all()
        beside.append(row(compared(theirs, expected)[0], replay=replay) if finite else row(reason="infinite"))
    by_path = any(row.subject == "path" and is_right(row.values) for row in beside)
    values |= {"truncation": abs(float(near.mean() / expected.mean()) - 1), "backward": abs(backward) / error}
    values |= {"right by path only": float(by_path and not is_right(values))}
    budgets = {"backward": limits.BACKWARD_MODE, "right by path only": 0.0}
    if not case.excluded:
        budgets |= {"z": limits.GRADIENT_ALARM, "detectable": limits.GRADIENT, "truncation": limits.TRUNCATION}
    return [Row(NAME, OURS, name, variant, values, budgets, reason=case.excluded, replay=replay), *beside]


def compared(gradient: np.ndarray, expected: np.ndarray) -> tuple[dict[str, float], float]:
    """The values of a row, and the standard error of the difference."""
    terms, g, mean = (gradient - expected).sum(axis=2) / gradient.size, float(gradient.mean()), float(expected.mean())
    error = float(np.sqrt((terms**2).sum()))
    values = {"gradient": g, "differences": mean, "off": abs(g / mean - 1)}
    return values | {"z": abs(g - mean) / error, "detectable": limits.GRADIENT_ALARM * error / mean}, error


def is_right(values: dict[str, float]) -> bool:
    """Whether a derivative is that of the image, as far as can be told."""
    return bool(values) and values["z"] <= limits.GRADIENT_ALARM and values["detectable"] <= limits.GRADIENT


STUDY = cases.study(NAME, "Gradients of images", __doc__, TERMS, all_cases)

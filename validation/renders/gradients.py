"""Derivatives of images by `refract_path` and by Mitsuba's integrators, against finite differences of converged images.

The derivative with respect to a parameter is that of Σ W I over the pixels I, in backward mode. The truth is Σ W D with
central differences D = (4 D(h) − D(2h))/3, whose four images by `refract_path` have the same random numbers. W is a D
with a different seed, so that nothing cancels. `off` is the ratio of the two − 1. Its interval is by Student's t over
the seeds of both (Welch's degrees of freedom), widened by the remaining truncation of the step. The derivative is right
if the interval contains 0 and ends within ± 5 %, and biased if the interval does not contain 0. It is missing if it is
0, infinite or an error, or if it is biased in a scene with a moving edge, in the image or in the view of a matt
surface: only `prb_projective` samples edges. As long as none of this holds, the number of seeds is doubled; a row that
stays undecided fails. With all looks together, one row in 10⁵ calls a right derivative biased, or a derivative that is
off by more than 5 % right. `refract_path` must be right in all scenes without such an edge. The profile `standard`
measures all integrators for the parameters of the table in the documentation, `full` for all parameters.
"""

from __future__ import annotations

import functools
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refract.numerics import mitsuba_mesh
from mi_refract.report.row import Row
from validation import limits
from validation.run import kernel_timing
from validation.run.context import Context
from validation.run.render_methods import OURS, sensor
from validation.run.seeds import current

from . import cases
from .cases import GLASS, MATT, Nodes, bitmap, environment

NAME = "gradients"
INTEGRATORS = ("path", "prb", "volpath", "prb_projective", OURS)
LOOKS = (8, 16, 32, 64)  # numbers of seeds, until there is a verdict
ROUNDS, SEED = 6, 2037
SIZE = 16
VARIANCE, TIME = "variance", "time / image"
RIGHT, BIASED, MISSING = "right", "biased", "missing"
ERROR = "an error: "
TERMS = {
    "off": "|gradient / differences − 1|",
    "interval": "half the width of its interval, which misses the truth once in 10⁵ rows: the detectable error",
    "at most": "off + interval",
    "off / interval": "above 1 the derivative is biased",
    "error": "standard error of gradient − differences",
    "gradient": "Σ W g in backward mode; differences: Σ W D of finite differences",
    VARIANCE: "of the derivative by one path, over the square of `differences`; N paths have 1 / N of it",
    "seeds": "number of seeds, one per render, at the verdict",
    "undecided": "1 if the derivative is neither right nor biased with the largest number of seeds",
    "truncation": "relative change of D(h) by the step of finite differences",
    "forward": "forward mode minus backward mode, over `error`",
    "right by path only": "1 if `path` gives the derivative and `refract_path` does not",
    TIME: "backward mode over an image by `path` with as many samples, alternating; median of the rounds, 95 % "
    "interval",
}
ROUGH, ROUGH_GLASS = {"type": "roughconductor", "alpha": 0.2}, {"type": "roughdielectric", "alpha": 0.5, "int_ior": 2.2}
PRINCIPLED = {"type": "principled", "metallic": 1.0, "roughness": 0.4}
CONSTANT, POINT = {"type": "constant"}, {"type": "point", "position": [1, 2, 1]}
LENS = {"type": "sphere", "center": [0, 1.5, 1], "radius": 0.5, "bsdf": GLASS}
CAUCHY = "cauchy(1.5, 10000)"
BK7 = "sellmeier(1.03961212, 0.231792344, 1.01046945, 6000.69867, 20017.9144, 103560653)"


# Scenes --------------------------------------------------------------------------------------------------------


def scene(fov: float, **parts: Any) -> Nodes:
    """Return a scene of `parts` with a camera in front of the origin."""
    return {"type": "scene", "sensor": sensor(SIZE, fov, [0.3, 0.5, 4], (0.1, 0, 0))} | parts


def waves(low: float, high: float, channels: int = 3) -> Nodes:
    """Return a texture without edges."""
    u, v = np.meshgrid(*[np.linspace(0, 2 * np.pi, 8)] * 2)
    pixels = np.stack([0.5 + 0.25 * (np.sin(u + i) + np.sin(v + 2 * i)) for i in range(channels)], axis=2)
    return bitmap(low + (high - low) * pixels)


def sky() -> Nodes:
    """Return an environment map of stripes without edges."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 64), np.linspace(0, np.pi, 32))
    stripes = [np.exp(np.sin(v) * (np.sin(u + i) + 1.5 * np.sin(3 * u + i))) for i in (0, 2, 4)]
    return environment(np.stack(stripes, axis=2))


def ball(fov: float = 12, **glass: Any) -> Nodes:
    """Return a ball that fills the view; seen from within, it has no edge."""
    return scene(fov, ball={"type": "sphere", "bsdf": GLASS | glass}, light=sky())


def core(bsdf: Nodes, glass: Nodes = GLASS, **more: Any) -> Nodes:
    """Return a ball of `bsdf` inside a ball of glass that fills the view."""
    inner = {"type": "sphere", "radius": 0.6, "bsdf": bsdf}
    return scene(8, ball={"type": "sphere", "bsdf": glass}, core=inner, **{"light": sky()} | more)


def plane(bsdf: Nodes, light: Nodes | None = None, **more: Nodes) -> Nodes:
    """Return a plane that fills the view."""
    wide = mi.ScalarTransform4f().rotate([1, 0, 0], -30).scale(9)
    return scene(20, plane={"type": "rectangle", "to_world": wide, "bsdf": bsdf}, light=light or sky(), **more)


def mesh(bsdf: Nodes) -> Nodes:
    """Return a plane whose normals vary from vertex to vertex."""
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    corners = np.array([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]])
    normals = np.array([[0.2, 0, 1], [0, 0.3, 1], [0, 0, 1], [-0.1, 0.1, 1]])
    square = mitsuba_mesh.make(mi, corners, np.array([[0, 1, 2], [0, 2, 3]]), normals, properties=props)
    return scene(20, mesh=square, light=sky())


def room(floor: Nodes = MATT, light: Nodes | None = None, **glass: Any) -> Nodes:
    """Return a ball on a floor, for parameters that do not move edges."""
    flat = mi.ScalarTransform4f().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(6)
    floor = {"type": "rectangle", "to_world": flat, "bsdf": floor}
    return scene(30, ball={"type": "sphere", "bsdf": GLASS | glass}, floor=floor, light=light or sky())


def lamp(x: float, y: float, z: float, size: float) -> Nodes:
    """Return a square lamp that faces the origin."""
    facing = mi.ScalarTransform4f().look_at([x, y, z], [0, 0, 0], [0, 1, 0.1]).scale(size)
    return {"type": "rectangle", "to_world": facing, "emitter": {"type": "area", "radiance": 5.0}}


def screen(radiance: Nodes) -> Nodes:
    """Return a textured lamp behind a plane of glass."""
    light = {"type": "area", "radiance": radiance}
    behind = mi.ScalarTransform4f().translate([0, 0, -3]).scale(9)
    return plane(GLASS, screen={"type": "rectangle", "to_world": behind, "emitter": light})


def checkers() -> Nodes:
    """Return a texture with edges."""
    return {"type": "checkerboard", "to_uv": mi.ScalarTransform4f().scale(7)}


def blend(other: Nodes) -> Nodes:
    """Return a blend of `other` and a dark surface."""
    return {"type": "blendbsdf", "weight": 0.4, "a": {"type": "diffuse", "reflectance": 0.1}, "b": other}


# Cases ---------------------------------------------------------------------------------------------------------


def entries(numbers: Any, first: int, count: int, x: Any) -> Any:
    """Return `numbers` with `x` added to `count` of them, from `first`."""
    place = dr.arange(mi.UInt32, dr.width(numbers))
    return numbers + dr.select((place >= first) & (place < first + count), x, 0)


# Kind of change: the value at x, from x and the value before. "texel": of a map of 66 columns; "vertex": the third one.
CHANGES: dict[str, Callable[[Any, Any], Any]] = {
    "value": lambda x, before: type(before)(x),
    "times": lambda x, before: before * x,
    "turned": lambda x, before: dr.ravel(mi.Transform4f().rotate([0, 1, 0], x) @ dr.unravel(mi.Normal3f, before)),
    "texel": lambda x, before: type(before)(entries(before.array, 3 * (66 * 16 + 2), 3, x), before.shape),
    "vertex": lambda x, before: entries(before, 3 * 2 + 2, 1, x),
    "moved": lambda x, before: before @ mi.Transform4f().translate([x, 0, 0]),
    "rotated": lambda x, before: before @ mi.Transform4f().rotate([1, 0, 0], x),
    "scaled": lambda x, before: before @ mi.Transform4f().scale(x),
}


@dataclass(frozen=True)
class Gradient:
    """The derivative in x, at x = `at`, of the scene `make()` whose parameter ending in `key` is CHANGES[change](x).

    `step`: h. `excluded`: why `refract_path` cannot compute this derivative.
    """

    make: Callable[[], Nodes]
    key: str
    at: float
    step: float
    change: str = "value"
    spp: int = 64
    excluded: str = ""
    spectral: bool = False


PIXEL = "an edge moves in the image"
VERTEX = "an edge moves in the view of a matt surface"
GRAZING = "rays that graze glass have unbounded derivatives: the noise does not fall with more samples"
DELTA = "the choice of a delta lobe has no derivative"
# fmt: off
CASES = {
    "albedo": Gradient(room, "floor.bsdf.reflectance.value", 0.6, 0.03),
    "albedo, textured": Gradient(
        lambda: room(MATT | {"reflectance": waves(0.2, 0.9)}), "floor.bsdf.reflectance.data", 1, 0.03, "times"),
    "radiance of a lamp": Gradient(lambda: room(light=lamp(0, 2, 0, size=1.5)), "radiance.value", 5, 0.5, spp=256),
    "radiance of an `envmap`": Gradient(room, "light.data", 1, 0.1, "times"),
    "a texel of an `envmap`": Gradient(ball, "light.data", 0, 1, "texel", spp=256),
    "radiance of a `constant`": Gradient(lambda: room(light=CONSTANT), "radiance.value", 1, 0.1),
    "intensity of a `point`": Gradient(lambda: room(light=POINT), "intensity.value", 1, 0.1),
    "`specular_reflectance`": Gradient(
        lambda: room(specular_reflectance=0.7), "specular_reflectance.value", 0.7, 0.03, spp=256),
    "`specular_transmittance`": Gradient(
        lambda: room(specular_transmittance=0.7), "specular_transmittance.value", 0.7, 0.03),
    "`int_absorption`": Gradient(lambda: room(int_absorption=0.5), "int_absorption.value", 0.5, 0.03),
    "`alpha` of `roughconductor`": Gradient(
        lambda: plane(ROUGH, lamp(0, 2.4, 1.8, size=0.8)), "alpha.value", 0.2, 0.01, spp=128),
    "`alpha` of `roughconductor`, in glass": Gradient(lambda: core(ROUGH), "alpha.value", 0.2, 0.01, spp=128),
    "`alpha` of `roughdielectric`": Gradient(lambda: plane(ROUGH_GLASS), "alpha.value", 0.5, 0.02, spp=256),
    "`roughness` of `principled`": Gradient(lambda: plane(PRINCIPLED), "roughness.value", 0.4, 0.02, spp=128),
    "`eta`": Gradient(ball, "eta", 1.5, 0.01),
    "`eta`, a matt ball within": Gradient(lambda: core(MATT), "ball.bsdf.eta", 1.5, 0.04, spp=512),
    "`int_ior`, textured": Gradient(lambda: ball(int_ior=waves(1.4, 1.6, 1)), "int_ior.data", 1, 0.005, "times"),
    "`int_ior_A`": Gradient(lambda: ball(int_ior=CAUCHY), "int_ior_A", 1.5, 0.01, spp=128, spectral=True),
    "`int_ior_B`": Gradient(lambda: ball(int_ior=CAUCHY), "int_ior_B", 1e4, 2e3, spp=128, spectral=True),
    "`int_ior_B1`": Gradient(lambda: ball(int_ior=BK7), "int_ior_B1", 1.03961212, 0.03),
    "`int_ior_B1`, spectral": Gradient(lambda: ball(int_ior=BK7), "int_ior_B1", 1.03961212, 0.03, spectral=True),
    "normals of matt vertices": Gradient(lambda: mesh(MATT), "normals", 0, 2, "turned"),
    "normals of rough vertices": Gradient(lambda: mesh(ROUGH), "normals", 0, 1, "turned"),
    "normals of glass vertices": Gradient(lambda: mesh(GLASS), "normals", 0, 1, "turned"),
    "a vertex of a smooth mesh of glass": Gradient(lambda: mesh(GLASS), "vertex_positions", 0, 0.2, "vertex"),
    "translation of glass": Gradient(ball, "ball.to_world", 0, 0.004, "moved"),
    "rotation of glass": Gradient(lambda: plane(GLASS), "plane.to_world", 0, 0.5, "rotated"),
    "scale of glass": Gradient(ball, "ball.to_world", 1, 0.01, "scaled"),
    "translation of a lamp's texture behind glass": Gradient(
        lambda: screen(waves(0.2, 2)), "screen.to_world", 0, 0.01, "moved"),
    "translation of the camera": Gradient(ball, "sensor.to_world", 0, 0.004, "moved"),
    "`weight` of a `blendbsdf`, both matt": Gradient(lambda: room(blend(MATT)), "weight.value", 0.4, 0.03),
    "`weight` of a `blendbsdf`, matt and glass": Gradient(
        lambda: core(MATT, blend(GLASS)), "weight.value", 0.4, 0.03, excluded=DELTA),
    "`eta`, a checkerboard behind": Gradient(lambda: screen(checkers()), "eta", 1.5, 0.02, spp=256, excluded=PIXEL),
    "translation of a matt ball, its outline in view": Gradient(
        lambda: scene(40, ball={"type": "sphere", "bsdf": MATT}, light=sky()), "ball.to_world", 0, 0.03, "moved",
        spp=256, excluded=PIXEL),
    "`eta` of a ball between a lamp and a matt plane": Gradient(
        lambda: plane(MATT, lamp(0, 2.6, 1.73, size=0.3), ball=LENS), "ball.bsdf.eta", 1.5, 0.02, spp=256,
        excluded=VERTEX),
    "translation of glass, its outline in view": Gradient(
        lambda: ball(40), "ball.to_world", 0, 0.004, "moved", spp=512, excluded=GRAZING),
}
# fmt: on
TABLE = (
    *("`eta`", "`int_ior_B1`", "`int_ior_B1`, spectral", "`int_absorption`", "a texel of an `envmap`"),
    *("translation of glass", "translation of a lamp's texture behind glass", "a vertex of a smooth mesh of glass"),
    *("translation of a matt ball, its outline in view", "`eta`, a checkerboard behind"),
)
QUICK = ("`alpha` of `roughconductor`", "`eta`")


class Images:
    """The images of a case, and their derivatives with respect to its parameter."""

    def __init__(self, case: Gradient) -> None:
        """Load the scene. ValueError if it has no such parameter, or one that cannot be differentiated (integers)."""
        self.case, self.scene = case, mi.load_dict(case.make(), parallel=False, optimize=False)
        self.params = mi.traverse(self.scene)
        keys = [key for key in self.params.keys() if key.endswith(case.key)]  # noqa: SIM118  no dictionary
        if len(keys) != 1:
            raise ValueError(f"{NAME}: {len(keys)} parameters end with {case.key!r}; expected one")
        (self.key,) = keys
        self.before = dr.detach(self.params[self.key])
        probe = type(self.before)(self.before)  # Mitsuba's flag is wrong for the position of a camera
        dr.enable_grad(probe)
        if not dr.grad_enabled(probe):
            raise ValueError(f"{NAME}: no integrator differentiates {self.key!r}; expected a differentiable parameter")

    def set(self, x: Any) -> None:
        """Set the parameter to its value at `x`."""
        self.params[self.key] = CHANGES[self.case.change](x, self.before)
        self.params.update()

    @contextmanager
    def attached(self) -> Iterator[Any]:
        """Attach the parameter for a while, and yield x. Dr.Jit would differentiate all plugins in memory."""
        x = dr.opaque(mi.Float, self.case.at)
        dr.enable_grad(x)
        self.set(x)
        try:
            yield x
        finally:
            self.set(dr.opaque(mi.Float, self.case.at))

    def image(self, method: Any, seed: int) -> np.ndarray:
        """Return an image, without derivatives."""
        return np.array(mi.render(self.scene, integrator=method, spp=self.case.spp, seed=seed), float)

    def differences(self, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Return D and D(h) as images."""
        method = integrator(OURS, split_depth=2, caustics="path")  # as a differentiated render has it

        def at(x: float) -> np.ndarray:
            self.set(dr.opaque(mi.Float, x))
            return self.image(method, seed)

        x, h = self.case.at, self.case.step
        near, far = ((at(x + s * h) - at(x - s * h)) / (2 * s * h) for s in (1, 2))
        return (4 * near - far) / 3, near

    def forward(self, method: Any, seed: int) -> np.ndarray:
        """Return the derivative of the image by forward mode."""
        with self.attached() as x:
            dr.forward(x, dr.ADFlag.ClearEdges)  # Mitsuba's forward mode starts at the parameters of the scene
            return np.array(method.render_forward(self.scene, params=x, spp=self.case.spp, seed=seed), float)

    def backward(self, method: Any, weights: np.ndarray, seed: int) -> float:
        """Return the derivative of the mean of the weighted pixels by backward mode."""
        grad_in = mi.TensorXf((weights / weights.size).astype(np.float32))
        with self.attached() as x:
            method.render_backward(self.scene, params=x, grad_in=grad_in, spp=self.case.spp, seed=seed)
            return float(dr.grad(x)[0])


def integrator(name: str, **parameters: int | str) -> Any:
    """Return an integrator of depth 6 without Russian roulette, and without guiding, whose octree takes seconds."""
    guiding = {"guiding": "none"} if name == "prb_projective" else {}
    return mi.load_dict({"type": name, "max_depth": 6, "rr_depth": 100} | guiding | parameters)


def all_cases(context: Context) -> Iterator[cases.Case]:
    """Yield all cases; in the profile `quick`, two."""
    for title in QUICK if context.profile.quick else CASES:
        variant = cases.variants(context)[CASES[title].spectral]
        yield cases.Case(title, variant, functools.partial(rows, context, title))


def timed_cases(context: Context) -> Iterator[cases.Case]:
    """Yield the times of the cases of the table; none in the profile `quick`."""
    for title in () if context.profile.quick else TABLE:
        variant = cases.variants(context)[CASES[title].spectral]
        yield cases.Case(f"{title}: {TIME}", variant, functools.partial(times, variant, title))


def rows(context: Context, title: str) -> list[Row]:
    """Return a row per integrator that computes the derivative, `refract_path` last."""
    case, variant, seed = CASES[title], cases.variants(context)[CASES[title].spectral], current(SEED)
    every = not context.profile.quick and (title in TABLE or context.profile.name == "full")
    images, made = Images(case), list[Row]()
    weights = images.differences(seed)[0]
    weights /= np.sqrt((weights**2).mean())

    @functools.cache
    def differences(i: int) -> list[float]:
        return [float((weights * d).mean()) for d in images.differences(seed + 1 + i)]

    for name in INTEGRATORS if every else ("path", OURS) if case.excluded else (OURS,):
        method = integrator(name)
        gradient = functools.cache(lambda i, m=method: images.backward(m, weights, seed + 1000 + i))
        values, verdict = judged(gradient, lambda i: differences(i)[0], case)
        values["undecided"], budgets = float(not verdict), {"undecided": 0.0}
        if name == OURS:
            expected, near = np.mean([differences(i) for i in range(LOOKS[0])], axis=0)
            values["truncation"] = abs(float(near / expected) - 1)
            values["forward"] = float("nan")
            if "error" in values:
                forward = float((weights * images.forward(method, seed + 1000)).mean())
                values["forward"] = abs(forward - gradient(0)) / values["error"]
            right = "path" in {row.subject for row in made if row.reason == RIGHT}
            values["right by path only"] = float(right and verdict != RIGHT)
            budgets |= {"forward": limits.FORWARD_MODE, "right by path only": 0.0}
            if not case.excluded:
                values = dict.fromkeys(("off", "at most", "off / interval"), np.nan) | values
                budgets |= {"at most": limits.GRADIENT, "off / interval": limits.UNBIASED}
                budgets |= {"truncation": limits.TRUNCATION}
        replay = {"seed": seed, "spp": case.spp, "pixels": SIZE**2, "step": case.step}
        made.append(Row(NAME, name, title, variant, values, budgets, reason=verdict, replay=replay))
    return made


def judged(
    gradient: Callable[[int], float], difference: Callable[[int], float], case: Gradient
) -> tuple[dict[str, float], str]:
    """Return the values of a row, and its verdict: RIGHT, BIASED, MISSING with the reason, or "" if undecided.

    `gradient(i)`, `difference(i)`: Σ W g and Σ W D of render i.
    """
    values = dict[str, float]()
    for count in LOOKS:
        try:
            gradients = [gradient(i) for i in range(count)]
        except RuntimeError as error:
            return {}, f"{MISSING}: {ERROR}{first_cause(error)}"
        if not (np.isfinite(gradients).all() and any(gradients)):
            return {}, f"{MISSING}: {'infinite' if any(gradients) else 'it is 0'}"
        values = compared(gradients, [difference(i) for i in range(count)], case.spp)
        if values["off / interval"] > 1:
            return values, f"{MISSING}: {case.excluded}" if case.excluded else BIASED
        if values["at most"] <= limits.GRADIENT:
            return values, RIGHT
    return values, ""


def first_cause(error: BaseException) -> str:
    """Return the first sentence of the original error: Mitsuba wraps errors of plugins and loops in others."""
    while error.__cause__:
        error = error.__cause__
    return re.split(r"[.!] |\n", str(error))[0]


def compared(gradients: list[float], differences: list[float], spp: int) -> dict[str, float]:
    """Return the values of a row from the results of all seeds. The error of the ratio is of first order in both."""
    from scipy.special import stdtrit

    count, g, expected = len(gradients), float(np.mean(gradients)), float(np.mean(differences))
    variance = float(np.var(gradients, ddof=1))
    squared_errors = [variance / count, float(np.var(differences, ddof=1)) * (g / expected) ** 2 / count]
    error = sum(squared_errors) ** 0.5
    degrees_of_freedom = (count - 1) * sum(squared_errors) ** 2 / sum(x**2 for x in squared_errors)
    quantile = -stdtrit(degrees_of_freedom, limits.GRADIENT_ALARM / len(LOOKS) / 2)
    off, interval = abs(g / expected - 1), float(quantile * error / abs(expected)) + limits.STEP
    return {
        "off": off,
        "interval": interval,
        "at most": off + interval,
        "off / interval": off / interval,
        "seeds": float(count),
        "gradient": g,
        "differences": expected,
        "error": error,
        VARIANCE: variance * spp * SIZE**2 / expected**2,
    }


def times(variant: str, title: str) -> list[Row]:
    """Return a row per integrator: the time of backward mode over that of an image by `path`."""
    images, weights = Images(CASES[title]), np.ones((SIZE, SIZE, 3))
    image, path = functools.partial(images.image, seed=SEED), integrator("path")
    works: dict[str, Callable[[], Any]] = {"image": lambda: image(path)}
    works |= {x: functools.partial(images.backward, integrator(x), weights, SEED) for x in INTEGRATORS}

    def clock(work: Callable[[], Any]) -> float:
        start = time.perf_counter()
        try:
            work()  # returns numbers, so the kernels have finished
        except RuntimeError:
            return float("nan")
        return time.perf_counter() - start

    seconds = kernel_timing.rounds(works, clock, ROUNDS)
    replay = {"rounds": ROUNDS, "spp": CASES[title].spp, "pixels": SIZE**2}
    finite = [x for x in INTEGRATORS if np.isfinite(seconds[x]).all()]
    ratios = {x: kernel_timing.ratio(TIME, seconds[x], seconds["image"]) for x in finite}
    return [Row(NAME, x, f"{title}: {TIME}", variant, ratios[x], replay=replay) for x in finite]


STUDY = cases.study(NAME, "Gradients of images", __doc__, TERMS, all_cases, timed_cases)

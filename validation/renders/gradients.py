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
from validation.run.context import Context
from validation.run.render_methods import OURS, sensor
from validation.run.seeds import current

from . import cases
from .cases import GLASS, MATT, Nodes, bitmap, environment

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
SIZE = 16
ROUGH, ROUGH_GLASS = {"type": "roughconductor", "alpha": 0.2}, {"type": "roughdielectric", "alpha": 0.5, "int_ior": 2.2}
PRINCIPLED = {"type": "principled", "metallic": 1.0, "roughness": 0.4}
CONSTANT, POINT = {"type": "constant"}, {"type": "point", "position": [1, 2, 1]}
LENS = {"type": "sphere", "center": [0, 1.5, 1], "radius": 0.5, "bsdf": GLASS}
CAUCHY = "cauchy(1.5, 10000)"


# Scenes --------------------------------------------------------------------------------------------------------


def scene(fov: float, **parts: Any) -> Nodes:
    """A camera before the origin."""
    return {"type": "scene", "sensor": sensor(SIZE, fov, [0.3, 0.5, 4], (0.1, 0, 0))} | parts


def waves(low: float, high: float, channels: int = 3) -> Nodes:
    """A texture without edges."""
    u, v = np.meshgrid(*[np.linspace(0, 2 * np.pi, 8)] * 2)
    pixels = np.stack([0.5 + 0.25 * (np.sin(u + i) + np.sin(v + 2 * i)) for i in range(channels)], axis=2)
    return bitmap(low + (high - low) * pixels)


def sky() -> Nodes:
    """Stripes without edges."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 64), np.linspace(0, np.pi, 32))
    stripes = [np.exp(np.sin(v) * (np.sin(u + i) + 1.5 * np.sin(3 * u + i))) for i in (0, 2, 4)]
    return environment(np.stack(stripes, axis=2))


def ball(fov: float = 12, **glass: Any) -> Nodes:
    """A ball that fills the view; it has no edge that is seen from within."""
    return scene(fov, ball={"type": "sphere", "bsdf": GLASS | glass}, light=sky())


def core(bsdf: Nodes, glass: Nodes = GLASS, **more: Any) -> Nodes:
    """A ball that fills the view, around the centre of one of glass."""
    inner = {"type": "sphere", "radius": 0.6, "bsdf": bsdf}
    return scene(8, ball={"type": "sphere", "bsdf": glass}, core=inner, **{"light": sky()} | more)


def plane(bsdf: Nodes, light: Nodes | None = None, **more: Nodes) -> Nodes:
    """It fills the view."""
    wide = mi.ScalarTransform4f().rotate([1, 0, 0], -30).scale(9)
    return scene(20, plane={"type": "rectangle", "to_world": wide, "bsdf": bsdf}, light=light or sky(), **more)


def mesh(bsdf: Nodes) -> Nodes:
    """A plane whose normals vary from vertex to vertex."""
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    corners = np.array([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]])
    normals = np.array([[0.2, 0, 1], [0, 0.3, 1], [0, 0, 1], [-0.1, 0.1, 1]])
    square = mitsuba_mesh.make(mi, corners, np.array([[0, 1, 2], [0, 2, 3]]), normals, properties=props)
    return scene(20, mesh=square, light=sky())


def room(floor: Nodes = MATT, light: Nodes | None = None, **glass: Any) -> Nodes:
    """A ball on a floor: for parameters that move nothing."""
    flat = mi.ScalarTransform4f().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(6)
    floor = {"type": "rectangle", "to_world": flat, "bsdf": floor}
    return scene(30, ball={"type": "sphere", "bsdf": GLASS | glass}, floor=floor, light=light or sky())


def lamp(x: float, y: float, z: float, size: float) -> Nodes:
    """A square that faces the origin."""
    facing = mi.ScalarTransform4f().look_at([x, y, z], [0, 0, 0], [0, 1, 0.1]).scale(size)
    return {"type": "rectangle", "to_world": facing, "emitter": {"type": "area", "radiance": 5.0}}


def tiles() -> Nodes:
    """A ball that fills the view, before a checkerboard."""
    squares = {"type": "checkerboard", "to_uv": mi.ScalarTransform4f().scale(7)}
    behind = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -3]).scale(9)}
    return scene(12, ball=ball()["ball"], behind=behind | {"bsdf": MATT | {"reflectance": squares}}, light=CONSTANT)


def blend(other: Nodes) -> Nodes:
    """Some of it, and some of a dark surface."""
    return {"type": "blendbsdf", "weight": 0.4, "a": {"type": "diffuse", "reflectance": 0.1}, "b": other}


# Cases ---------------------------------------------------------------------------------------------------------

# The parameter at x, by what it was.
CHANGES: dict[str, Callable[[Any, Any], Any]] = {
    "value": lambda x, before: type(before)(x),
    "times": lambda x, before: before * x,
    "turned": lambda x, before: dr.ravel(mi.Transform4f().rotate([0, 1, 0], x) @ dr.unravel(mi.Normal3f, before)),
    "moved": lambda x, before: before @ mi.Transform4f().translate([x, 0, 0]),
    "rotated": lambda x, before: before @ mi.Transform4f().rotate([1, 0, 0], x),
    "scaled": lambda x, before: before @ mi.Transform4f().scale(x),
}


@dataclass(frozen=True)
class Gradient:
    """The parameter whose name ends with `key` is that of CHANGES[change] at x = `at`.

    `step`: h. `others`: integrators of Mitsuba beside. `excluded`: why none of them can have this derivative.
    """

    make: Callable[[], Nodes]
    key: str
    at: float
    step: float
    change: str = "value"
    others: tuple[str, ...] = ("path",)
    spp: int = 256
    excluded: str = ""
    spectral: bool = False


ALL = ("path", "volpath", "prb")
PIXEL = "an edge moves in the image"
VERTEX = "an edge moves in the view of a matt surface"
GRAZING = "rays that graze glass have derivatives of any size: the noise does not fall with more samples"
DELTA = "the choice of a delta lobe has no derivative"
# fmt: off
CASES = {
    "albedo": Gradient(room, "floor.bsdf.reflectance.value", 0.6, 0.03, others=ALL),
    "albedo, textured": Gradient(
        lambda: room(MATT | {"reflectance": waves(0.2, 0.9)}), "floor.bsdf.reflectance.data", 1, 0.03, "times"),
    "radiance of a lamp": Gradient(
        lambda: room(light=lamp(0, 2, 0, size=1.5)), "radiance.value", 5, 0.5, others=ALL, spp=1024),
    "radiance of an `envmap`": Gradient(room, "light.data", 1, 0.1, "times"),
    "radiance of a `constant`": Gradient(lambda: room(light=CONSTANT), "radiance.value", 1, 0.1),
    "intensity of a `point`": Gradient(lambda: room(light=POINT), "intensity.value", 1, 0.1),
    "`specular_reflectance`": Gradient(
        lambda: room(specular_reflectance=0.7), "specular_reflectance.value", 0.7, 0.03, spp=1024),
    "`specular_transmittance`": Gradient(
        lambda: room(specular_transmittance=0.7), "specular_transmittance.value", 0.7, 0.03, others=ALL),
    "`int_absorption`": Gradient(lambda: room(int_absorption=0.5), "int_absorption.value", 0.5, 0.03, others=()),
    "`alpha` of `roughconductor`": Gradient(
        lambda: plane(ROUGH, lamp(0, 2.4, 1.8, size=0.8)), "alpha.value", 0.2, 0.01, others=ALL, spp=512),
    "`alpha` of `roughconductor`, in glass": Gradient(lambda: core(ROUGH), "alpha.value", 0.2, 0.01, spp=512),
    "`alpha` of `roughdielectric`": Gradient(
        lambda: plane(ROUGH_GLASS), "alpha.value", 0.5, 0.02, others=ALL, spp=1024),
    "`roughness` of `principled`": Gradient(lambda: plane(PRINCIPLED), "roughness.value", 0.4, 0.02, spp=512),
    "`eta`": Gradient(ball, "eta", 1.5, 0.01, others=ALL),
    "`eta`, a matt ball within": Gradient(lambda: core(MATT), "ball.bsdf.eta", 1.5, 0.04, others=ALL, spp=2048),
    "`int_ior`, textured": Gradient(
        lambda: ball(int_ior=waves(1.4, 1.6, 1)), "int_ior.data", 1, 0.005, "times", others=ALL),
    "`int_ior_A`": Gradient(lambda: ball(int_ior=CAUCHY), "int_ior_A", 1.5, 0.01, others=(), spp=512, spectral=True),
    "`int_ior_B`": Gradient(lambda: ball(int_ior=CAUCHY), "int_ior_B", 1e4, 2e3, others=(), spp=512, spectral=True),
    "normals of matt vertices": Gradient(lambda: mesh(MATT), "normals", 0, 2, "turned"),
    "normals of rough vertices": Gradient(lambda: mesh(ROUGH), "normals", 0, 1, "turned", others=ALL),
    "normals of glass vertices": Gradient(lambda: mesh(GLASS), "normals", 0, 1, "turned", others=ALL),
    "translation of glass": Gradient(ball, "ball.to_world", 0, 0.004, "moved", others=ALL),
    "rotation of glass": Gradient(lambda: plane(GLASS), "plane.to_world", 0, 0.5, "rotated"),
    "scale of glass": Gradient(ball, "ball.to_world", 1, 0.01, "scaled"),
    "translation of the camera": Gradient(ball, "sensor.to_world", 0, 0.004, "moved"),
    "`weight` of a `blendbsdf`, both matt": Gradient(
        lambda: room(blend(MATT)), "weight.value", 0.4, 0.03, others=ALL),
    "`weight` of a `blendbsdf`, matt and glass": Gradient(
        lambda: core(MATT, blend(GLASS)), "weight.value", 0.4, 0.03, others=ALL, excluded=DELTA),
    "`eta`, a checkerboard behind": Gradient(tiles, "eta", 1.5, 0.03, others=ALL, spp=1024, excluded=PIXEL),
    "translation of a matt ball, its outline in view": Gradient(
        lambda: scene(40, ball={"type": "sphere", "bsdf": MATT}, light=sky()), "ball.to_world", 0, 0.004, "moved",
        others=ALL, excluded=PIXEL),
    "`eta` of a ball between a lamp and a matt plane": Gradient(
        lambda: plane(MATT, lamp(0, 2.6, 1.73, size=0.3), ball=LENS), "ball.bsdf.eta", 1.5, 0.02, others=ALL, spp=1024,
        excluded=VERTEX),
    "translation of glass, its outline in view": Gradient(
        lambda: ball(40), "ball.to_world", 0, 0.004, "moved", others=ALL, spp=2048, excluded=GRAZING),
}
# fmt: on
QUICK = ("`alpha` of `roughconductor`", "`eta`")


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
        figures = compared(theirs, expected)[0] if finite else {}
        beside.append(row(figures, reason="recorded, for comparison" if finite else "infinite", replay=replay))
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

"""The absorbing medium that a path is in, from boundary to boundary.

A boundary says σ on both of its sides: a path that goes through it is in the medium beyond. What the boundary says of
the side from which light comes must be what the path has, or the image is wrong: a neighbour says something else of the
medium between them, or the camera is in a medium of which nothing was said. `Crossings.refuse` says where this was met.

A ray starts a little beside the surface that it left. Next to an edge where three media meet it may miss a boundary,
and be in a medium that is not there: one in 30,000 in a tumbler of water. So few are no contradiction.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .absorption import BEYOND, HERE, absorbing_parameter
from .scene_features import nested

TOLERANCE = 1e-3  # relative: σ may have been given as a number here and as a colour there
STRAY = 0.01  # of the crossings of a shape: more are a contradiction
NEVER = 2**32 - 1  # as the number of a vertex
FEW = 2  # crossings: of a shape with few of them, so many may be beside an edge, unless they are half of all
# A null lobe is no boundary. What scatters on its way through is one as well.
THROUGH = mi.BSDFFlags.DeltaTransmission | mi.BSDFFlags.GlossyTransmission | mi.BSDFFlags.DiffuseTransmission


class Crossings:
    """How often light went through each shape, how often it came through another medium than it says, and how soon."""

    def __init__(self, v: Any, scene: Any) -> None:
        """`v`: the variant's module."""
        self.v, self.vectorised = v, dr.is_jit_v(v.Float)
        self.names: dict[int, str] = {}
        self.counts: list[Any] = []  # arrays by the number of a shape
        self.tally: dict[str, list[int]] = {}  # in scalar variants, by its name
        # What a frozen function writes nobody reads.
        if self.vectorised and not dr.flag(dr.JitFlag.FreezingScope):
            self.names = {self._number(v.ShapePtr(shape)): str(shape.id()) for shape in scene.shapes()}
            # The last number is that of all shapes within instances.
            size = max(self.names, default=0) + 2
            self.counts = [dr.opaque(v.UInt32, start, size) for start in (0, 0, NEVER)]

    def _number(self, pointer: Any) -> int:
        number: Any = dr.reinterpret_array(self.v.UInt32, pointer)
        return int(number[0])

    def add(self, shape: Any, depth: Any, through: Any, wrong: Any) -> None:
        """`wrong`: of those that go `through`. `depth`: the number of the vertex, 0 for the first."""
        if self.vectorised and self.counts:
            crossed, contradicted, first = self.counts
            last: Any = len(crossed) - 1
            number = dr.minimum(dr.reinterpret_array(self.v.UInt32, shape), last)
            dr.scatter_add(crossed, self.v.UInt32(1), number, through)
            dr.scatter_add(contradicted, self.v.UInt32(1), number, wrong)
            dr.scatter_reduce(dr.ReduceOp.Min, first, depth, number, wrong)
        elif not self.vectorised:
            found = self.tally.setdefault(str(shape.id()), [0, 0, NEVER])
            found[0] += 1
            if wrong:
                found[1:] = found[1] + 1, min(found[2], int(depth))

    def refuse(self) -> None:
        """ValueError with a shape, if light came to it through another medium than its BSDF says."""
        rows = {name: tuple(found) for name, found in self.tally.items()}
        for number, found in enumerate(zip(*self.counts, strict=True)):
            rows[self.names.get(number, "a shape")] = tuple(map(int, found))
        wrong = {name: found for name, found in rows.items() if _contradicts(*found[:2])}
        if wrong:
            name = min(wrong, key=lambda name: wrong[name][2])  # what is wrong first is the cause
            raise ValueError(_message(name, wrong[name][2] == 0))


def _contradicts(crossed: int, wrong: int) -> bool:
    return wrong > STRAY * crossed and (wrong > FEW or 2 * wrong >= crossed)


class MediumTracker:
    """For one render."""

    def __init__(self, v: Any, start: Any, crossings: Crossings) -> None:
        """`v`: the variant's module. `start`: σ at the camera."""
        self.v, self.start, self.crossings, self.vectorised = v, start, crossings, dr.is_jit_v(v.Float)

    def cross(self, s: Any, si: Any, bs: Any, bsdf: Any, active: Any) -> Any:
        """σ after a sample of the BSDF: of the other side where light goes through, as it was where it does not."""
        through = active & ((bs.sampled_type & THROUGH) != 0)
        if not self.vectorised and not through:
            return s.sigma
        here, beyond = (self._side(name, si, bsdf, through) for name in (HERE, BEYOND))
        apart = dr.abs(here - s.sigma) - TOLERANCE * dr.maximum(here, s.sigma)
        self.crossings.add(si.shape, s.depth, through, through & (dr.max(apart) > 0))
        return dr.select(through, beyond, s.sigma)

    def _side(self, name: str, si: Any, bsdf: Any, through: Any) -> Any:
        """σ on a side; 0 where a BSDF says nothing."""
        if self.vectorised or bsdf.has_attribute(name, through):
            return bsdf.eval_attribute(name, si, through)
        return self.v.UnpolarizedSpectrum(0)


def check_integrator(scene: Any) -> None:
    """ValueError where a BSDF absorbs and the scene's integrator is another than `refract_path`."""
    if type(scene.integrator()).__name__ == "RefractPath":
        return
    for bsdf in (each for shape in scene.shapes() for each in nested(shape.bsdf())):
        if name := absorbing_parameter(bsdf):
            raise ValueError(f"refract: {name}: accepted: the integrator refract_path, or no absorption")


def check_wrappers(scene: Any) -> None:
    """ValueError where an absorbing BSDF is within another one, which does not pass on what it says of its media."""
    for shape in scene.shapes():
        outer = shape.bsdf()
        within = any(getattr(bsdf, "absorbing", False) for bsdf in nested(outer))
        if within and not dr.all(outer.has_attribute(BEYOND)):
            text = f"{shape.id()!r} has an absorbing BSDF within a {outer.class_name()}"
            raise ValueError(f"refract_path: {text}: accepted: absorption of the shape's own BSDF")


def _message(shape: str, at_camera: bool) -> str:
    camera = "camera_absorption, or the sensor's medium, as the camera's surroundings absorb"
    outside = "ext_absorption (or ext_colour) as the medium around it absorbs"
    accepted = f"{camera}; {outside}" if at_camera else f"{outside}; {camera}"
    return f"refract_path: light comes to {shape!r} through another absorption than its BSDF says: accepted: {accepted}"

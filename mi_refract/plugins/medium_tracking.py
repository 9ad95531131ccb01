"""The absorbing medium that a path is in, from boundary to boundary: of the BSDFs (`MediumTracker`), or of the shapes.

A BSDF says σ on both of its sides: a path that goes through it is in the medium beyond. What the boundary says of
the side from which light comes must be what the path has, or the image is wrong: a neighbour says something else of the
medium between them, or the camera is in a medium of which nothing was said. `Crossings.refuse` says where this was met.

A ray starts a little beside the surface that it left. Next to an edge where three media meet it may miss a boundary,
and be in a medium that is not there: one in 30,000 in a tumbler of water. So few are no contradiction. A sheet that is
thinner than that distance, 1e-4 of the largest coordinate, is refused: a path would never leave it.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .absorption import BEYOND, HERE, absorbing_parameter
from .scene_features import all_shapes, nested

TOLERANCE = 1e-3  # relative: σ may have been given as a number here and as a colour there
STRAY = 0.01  # of the crossings of a shape: more are a contradiction
NEVER = 2**32 - 1  # as the number of a vertex
FEW = 2  # crossings: of a shape with few of them, so many may be beside an edge, unless they are half of all
# Of the way from a surface to the origin of the next ray: a surface nearer to the first one than the rest is not seen.
# The rounding of a point is a thousandth of that way.
SEARCHED = 1 - 1 / 64
# A null lobe is no boundary. What scatters on its way through is one as well.
THROUGH = mi.BSDFFlags.DeltaTransmission | mi.BSDFFlags.GlossyTransmission | mi.BSDFFlags.DiffuseTransmission


class Crossings:
    """For each shape: how often light went through it, came through another medium than it says, how soon, and how
    often it was stepped over because it is too thin."""

    def __init__(self, v: Any, scene: Any) -> None:
        """`v`: the variant's module."""
        self.v, self.vectorised = v, dr.is_jit_v(v.Float)
        self.shapes: dict[int, int] = {}  # the position of a shape in the scene, by its number
        self.counts: list[Any] = []  # arrays by the number of a shape
        self.tally: dict[int, list[int]] = {}  # in scalar variants, by its position
        self.scene_shapes = all_shapes(scene)
        # What a frozen function writes nobody reads.
        if self.vectorised and not dr.flag(dr.JitFlag.FreezingScope):
            self.shapes = {self._number(v.ShapePtr(shape)): i for i, shape in enumerate(self.scene_shapes)}
            # The last number is that of all shapes that the scene does not show.
            size = max(self.shapes, default=0) + 2
            self.counts = [dr.opaque(v.UInt32, start, size) for start in (0, 0, NEVER, 0)]

    def _number(self, pointer: Any) -> int:
        number: Any = dr.reinterpret_array(self.v.UInt32, pointer)
        return int(number[0])

    def add(self, shape: Any, depth: Any, through: Any, wrong: Any, thin: Any) -> None:
        """`wrong`, `thin`: of those that go `through`. `depth`: the number of the vertex, 0 for the first."""
        if self.vectorised and self.counts:
            crossed, contradicted, first, stepped_over = self.counts
            last: Any = len(crossed) - 1
            number = dr.minimum(dr.reinterpret_array(self.v.UInt32, shape), last)
            dr.scatter_add(crossed, self.v.UInt32(1), number, through)
            dr.scatter_add(contradicted, self.v.UInt32(1), number, wrong)
            dr.scatter_reduce(dr.ReduceOp.Min, first, depth, number, wrong)
            dr.scatter_add(stepped_over, self.v.UInt32(1), number, thin)
        elif not self.vectorised:
            position = next((i for i, each in enumerate(self.scene_shapes) if each is shape), -1)
            found = self.tally.setdefault(position, [0, 0, NEVER, 0])
            found[0] += 1
            found[3] += bool(thin)
            if wrong:
                found[1:3] = found[1] + 1, min(found[2], int(depth))

    def refuse(self) -> None:
        """ValueError with a shape that light came to through another medium than its BSDF says, or stepped over."""
        rows = {position: tuple(found) for position, found in self.tally.items()}
        for number, found in enumerate(zip(*self.counts, strict=True)):
            rows[self.shapes.get(number, -1)] = tuple(map(int, found))
        for position, found in rows.items():
            if _contradicts(found[0], found[3]):
                raise ValueError(
                    f"refract_path: {self._name(position)} absorbs, and is so thin that rays step over it; expected a "
                    "sheet thicker than 1e-4 of its largest coordinate: move the scene to the origin"
                )
        wrong = {position: found for position, found in rows.items() if _contradicts(*found[:2])}
        if wrong:
            first = min(wrong, key=lambda position: wrong[position][2])  # what is wrong first is the cause
            raise ValueError(_message(self._name(first), wrong[first][2] == 0))

    def _name(self, position: int) -> str:
        return shape_name(self.scene_shapes, position) if position >= 0 else "a shape"


def _contradicts(crossed: int, wrong: int) -> bool:
    return wrong > STRAY * crossed and (wrong > FEW or 2 * wrong >= crossed)


def shape_name(shapes: list[Any], position: int) -> str:
    """The shape's name in quotes, or its class and its position in the scene where it has no name."""
    shape = shapes[position]
    return repr(str(shape.id())) if shape.id() else f"shape {position + 1} of {len(shapes)} ({shape.class_name()})"


class MediumTracker:
    """Absorption that the BSDFs declare, for one render."""

    def __init__(self, v: Any, scene: Any, start: Any, way: Any, crossings: Crossings) -> None:
        """`v`: the variant's module. `start`: σ at the camera. `way`: from there to the origin of the first ray."""
        self.v, self.scene, self.crossings, self.vectorised = v, scene, crossings, dr.is_jit_v(v.Float)
        self.start, self.way = start, way

    def cross(self, s: Any, si: Any, bs: Any, bsdf: Any, ray: Any, active: Any) -> Any:
        """σ along `ray`, after a sample of the BSDF: of the other side where light goes through, else as it was."""
        through = active & ((bs.sampled_type & THROUGH) != 0)
        if not self.vectorised and not through:
            return s.sigma
        here, beyond = (self._side(name, si, bsdf, through) for name in (HERE, BEYOND))
        apart = dr.abs(here - s.sigma) - TOLERANCE * dr.maximum(here, s.sigma)
        # Whether there is another surface between this one and the origin of the ray.
        back = si.p - ray.o
        length = dr.norm(back)
        absorbs = through & (dr.max(beyond) > 0) & (length > 0)
        search = self.v.Ray3f(ray.o, back / dr.select(length > 0, length, 1), ray.time, ray.wavelengths)
        search.maxt = length * SEARCHED
        thin = absorbs & self.scene.ray_test(dr.detach(search), absorbs)
        self.crossings.add(si.shape, s.depth, through, through & (dr.max(apart) > 0), thin)
        return dr.select(through, beyond, s.sigma)

    def _side(self, name: str, si: Any, bsdf: Any, through: Any) -> Any:
        """σ on a side; 0 where a BSDF says nothing."""
        if self.vectorised or bsdf.has_attribute(name, through):
            return bsdf.eval_attribute(name, si, through)
        return self.v.UnpolarizedSpectrum(0)


class ShapeMedia:
    """Absorption by the media of the shapes (`interior`, `exterior`), as `volpath` follows them."""

    def __init__(self, v: Any, start: Any, way: Any) -> None:
        """`v`: the variant's module. `start`: σ at the camera. `way`: from there to the origin of the first ray."""
        self.v, self.start, self.way, self.vectorised = v, start, way, dr.is_jit_v(v.Float)

    def cross(self, s: Any, si: Any, bs: Any, bsdf: Any, ray: Any, active: Any) -> Any:
        """σ along `ray`: of the medium on its side of the shape, where the shape has media."""
        turns = active & si.is_medium_transition()
        if not self.vectorised and not turns:
            return s.sigma
        medium = si.target_medium(ray.d)
        if not self.vectorised and medium is None:
            return self.v.UnpolarizedSpectrum(0)
        return dr.select(turns, extinction(self.v, medium, si.wavelengths, turns), s.sigma)


def extinction(v: Any, medium: Any, wavelengths: Any, active: Any) -> Any:
    """σ of a homogeneous medium; 0 where there is none."""
    mei = dr.zeros(v.MediumInteraction3f)
    mei.wavelengths = wavelengths
    return medium.get_scattering_coefficients(mei, active)[2]


def absorbs_only(v: Any, medium: Any) -> bool:
    """Whether a medium is homogeneous and scatters no light of any visible wavelength."""
    if not medium.is_homogeneous():
        return False
    if dr.flag(dr.JitFlag.FreezingScope):  # what a frozen function computes nobody reads
        return True
    mei = dr.zeros(v.MediumInteraction3f)
    visible = [(mi.MI_CIE_MIN + (mi.MI_CIE_MAX - mi.MI_CIE_MIN) * i / 64,) for i in range(65)]
    for line in visible if v.is_spectral else [()]:
        mei.wavelengths = type(mei.wavelengths)(*line)
        if dr.any(medium.get_scattering_coefficients(mei, True)[0] != 0, axis=None):
            return False
    return True


def check_media(v: Any, scene: Any) -> None:
    """ValueError where a shape has a medium that scatters, or where a BSDF of the scene absorbs as well."""
    shapes = all_shapes(scene)
    absorbing = any(absorbing_parameter(each) for shape in shapes if (outer := shape.bsdf()) for each in nested(outer))
    for i, shape in enumerate(shapes):
        for side, medium in (("interior", shape.interior_medium()), ("exterior", shape.exterior_medium())):
            if medium is not None and not absorbs_only(v, medium):
                raise ValueError(
                    f"refract_path: the {side} medium of {shape_name(shapes, i)} scatters or varies; expected a "
                    "homogeneous medium with an albedo of 0, or the integrator volpath"
                )
            if medium is not None and absorbing:
                raise ValueError(
                    f"refract_path: {shape_name(shapes, i)} has an {side} medium in a scene whose BSDFs absorb; "
                    "expected media of shapes only, or absorption of BSDFs only"
                )


def check_integrator(scene: Any) -> None:
    """ValueError where a BSDF absorbs and the scene's integrator is another than `refract_path`."""
    if type(scene.integrator()).__name__ == "RefractPath":
        return
    for bsdf in (each for shape in all_shapes(scene) if (outer := shape.bsdf()) for each in nested(outer)):
        if name := absorbing_parameter(bsdf):
            raise ValueError(f"refract: {name}; expected the integrator refract_path, or no absorption")


def check_wrappers(scene: Any) -> None:
    """ValueError where an absorbing BSDF is within another one, which does not pass on what it says of its media."""
    shapes = all_shapes(scene)
    for i, shape in enumerate(shapes):
        outer = shape.bsdf()
        within = outer is not None and any(getattr(bsdf, "absorbing", False) for bsdf in nested(outer))
        if within and not dr.all(outer.has_attribute(BEYOND)):
            text = f"{shape_name(shapes, i)} has an absorbing BSDF within a {outer.class_name()}"
            raise ValueError(f"refract_path: {text}; expected absorption of the shape's own BSDF")


def _message(shape: str, at_camera: bool) -> str:
    camera = "camera_absorption, or the sensor's medium, as the camera's surroundings absorb"
    outside = "ext_absorption (or ext_colour) as the medium around it absorbs"
    accepted = f"{camera}; {outside}" if at_camera else f"{outside}; {camera}"
    return f"refract_path: light comes to {shape} through another absorption than its BSDF says; expected {accepted}"

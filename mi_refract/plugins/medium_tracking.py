"""The absorbing medium that a path is in: declared by the BSDFs (`MediumTracker`), or by the shapes (`ShapeMedia`).

A BSDF declares σ on both of its sides: a path that goes through it is in the medium beyond. What it declares of the
side from which light comes must be what the path has, or the image is wrong: a neighbour declares another σ of the
medium between them, or the camera is in a medium that was not declared. `Crossings.refuse` names such a shape.

A ray starts a little beside the surface that it left. Next to an edge where three media meet it may miss a boundary,
and be in a medium that is not there: one in 30,000 in a tumbler of water. So few are no contradiction. A sheet that is
thinner than that distance (`ray_origins`) is refused: a path would never leave it.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refract.numerics import (
    BSDF,
    BSDFSample,
    Count,
    Interaction,
    Mask,
    MediumPlugin,
    Number,
    Ray,
    Scene,
    Shape,
    Spectrum,
    Variant,
)

from .absorption import BEYOND, HERE, absorbing_parameter
from .scene_features import all_shapes, check_shapes, children, nested, plugin_number, shape_name

TOLERANCE = 1e-3  # relative: σ may have been given as a number here and as a colour there
STRAY = 0.01  # of the crossings of a shape: more are a contradiction
NEVER = 2**32 - 1  # as the number of a vertex
FEW = 2  # crossings: of a shape with few of them, so many may be beside an edge, unless they are half of all
# Of the distance from a surface to the origin of the next ray: a surface nearer to the first one than the rest is not
# seen. Rounding moves a point by up to an eighth of that distance (`ray_origins`).
SEARCHED = 3 / 4
# A null lobe is no boundary. What scatters on its way through is one as well.
THROUGH = mi.BSDFFlags.DeltaTransmission | mi.BSDFFlags.GlossyTransmission | mi.BSDFFlags.DiffuseTransmission


class Crossings:
    """For each shape: how often light went through it, came through another medium than it declares, how soon, and how
    often it was stepped over because it is too thin."""

    def __init__(self, v: Variant, scene: Scene) -> None:
        """`v`: the variant's module."""
        self.v, self.vectorised, self.shapes = v, dr.is_jit_v(v.Float), all_shapes(scene)
        self.tally: dict[int, list[int]] = {}  # in scalar variants, by the position of the shape in the scene
        self.positions: dict[int, int] = {}  # of a shape, by its number
        self.counts: list[Any] = []  # the tally in compiled variants: arrays by the number of a shape
        # What a frozen function writes nobody reads.
        if self.vectorised and not dr.flag(dr.JitFlag.FreezingScope):
            for i, shape in enumerate(self.shapes):
                self.positions[plugin_number(v, v.ShapePtr(shape))] = i
            # The last number is that of all shapes that the scene does not show.
            size = max(self.positions, default=0) + 2
            self.counts = [dr.opaque(v.UInt32, start, size) for start in (0, 0, NEVER, 0)]

    def add(self, shape: Shape, depth: Count, through: Mask, wrong: Mask, thin: Mask) -> None:
        """`wrong`, `thin`: of those that go `through`. `depth`: the number of the vertex, 0 for the first."""
        if self.counts:
            crossed, contradicted, first, stepped_over = self.counts
            numbers: Count = dr.reinterpret_array(self.v.UInt32, shape)
            number = dr.minimum(numbers, len(crossed) - 1)
            dr.scatter_add(crossed, self.v.UInt32(1), number, through)
            dr.scatter_add(contradicted, self.v.UInt32(1), number, wrong)
            dr.scatter_reduce(dr.ReduceOp.Min, first, depth, number, wrong)
            dr.scatter_add(stepped_over, self.v.UInt32(1), number, thin)
        elif not self.vectorised:
            position = next((i for i, other in enumerate(self.shapes) if other is shape), -1)
            row = self.tally.setdefault(position, [0, 0, NEVER, 0])
            row[0] += 1
            row[3] += bool(thin)
            if wrong:
                row[1:3] = row[1] + 1, min(row[2], int(depth))

    def refuse(self) -> None:
        """ValueError with a shape that light came to through another medium than it declares, or stepped over."""

        def contradicts(crossed: int, wrong: int) -> bool:
            return wrong > STRAY * crossed and (wrong > FEW or 2 * wrong >= crossed)

        counted = enumerate(zip(*self.counts, strict=True))
        rows = [(self.positions.get(number, -1), [int(count) for count in row]) for number, row in counted]
        first, worst = NEVER, None  # what is wrong first is the cause
        for position, (crossed, wrong, depth, stepped_over) in sorted([*rows, *self.tally.items()]):
            name = shape_name(self.shapes, position) if position >= 0 else "a shape"
            if contradicts(crossed, stepped_over):
                raise ValueError(
                    f"refract_path: {name} absorbs, and is so thin that rays miss one of its sides; expected a sheet "
                    "thicker than 1e-5 of its size and its largest coordinate: move the scene to the origin"
                )
            if contradicts(crossed, wrong) and (worst is None or depth < first):
                first, worst = depth, name
        if worst is not None:
            camera = "camera_absorption, or the sensor's medium, as the camera's surroundings absorb"
            outside = "ext_absorption (or ext_colour) as the medium around it absorbs"
            raise ValueError(
                f"refract_path: inconsistent absorption at {worst}: the medium that light arrives in differs from the "
                f"one its BSDF declares; expected {f'{outside}; {camera}' if first else f'{camera}; {outside}'}"
            )


class MediumTracker:
    """Absorption that the BSDFs declare, for one render."""

    def __init__(self, v: Variant, scene: Scene) -> None:
        """`v`: the variant's module."""
        self.v, self.scene, self.vectorised = v, scene, dr.is_jit_v(v.Float)
        self.crossings = Crossings(v, scene)

    def cross(
        self, sigma: Spectrum, depth: Count, si: Interaction, bs: BSDFSample, bsdf: BSDF, ray: Ray, active: Mask
    ) -> Spectrum:
        """σ along `ray`, after a sample of the BSDF: of the other side where light goes through, else as it was."""
        v, through = self.v, active & ((bs.sampled_type & THROUGH) != 0)
        if not self.vectorised and not through:
            return sigma
        # A BSDF that declares nothing has σ = 0; asking for an attribute that is absent raises in scalar variants.
        declared = [self.vectorised or bsdf.has_attribute(name, through) for name in (HERE, BEYOND)]
        here, beyond = (
            bsdf.eval_attribute(name, si, through) if known else v.UnpolarizedSpectrum(0)
            for name, known in zip((HERE, BEYOND), declared, strict=True)
        )
        apart = dr.abs(here - sigma) - TOLERANCE * dr.maximum(here, sigma)
        # Whether there is another surface between this one and the origin of the ray.
        back = si.p - ray.o
        length = dr.norm(back)
        absorbs = through & (dr.max(beyond) > 0) & (length > 0)
        search = v.Ray3f(ray.o, back / dr.select(length > 0, length, 1), ray.time, ray.wavelengths)
        search.maxt = length * SEARCHED
        thin = absorbs & self.scene.ray_test(dr.detach(search), absorbs)
        self.crossings.add(si.shape, depth, through, through & (dr.max(apart) > 0), thin)
        return dr.select(through, beyond, sigma)


class ShapeMedia:
    """Absorption by the media of the shapes (`interior`, `exterior`), as `volpath` follows them."""

    def __init__(self, v: Variant) -> None:
        """`v`: the variant's module."""
        self.v, self.vectorised = v, dr.is_jit_v(v.Float)

    def cross(
        self, sigma: Spectrum, depth: Count, si: Interaction, bs: BSDFSample, bsdf: BSDF, ray: Ray, active: Mask
    ) -> Spectrum:
        """σ along `ray`: of the medium on its side of the shape, where the shape has media."""
        turns = active & si.is_medium_transition()
        if not self.vectorised and not turns:
            return sigma
        medium = si.target_medium(ray.d)
        if not self.vectorised and medium is None:
            return self.v.UnpolarizedSpectrum(0)
        return dr.select(turns, extinction(self.v, medium, si.wavelengths, turns), sigma)


def extinction(v: Variant, medium: MediumPlugin, wavelengths: Number, active: Mask) -> Spectrum:
    """σ of a homogeneous medium; 0 where there is none."""
    mei = dr.zeros(v.MediumInteraction3f)
    mei.wavelengths = wavelengths
    return medium.get_scattering_coefficients(mei, active)[2]


def absorbs_only(v: Variant, medium: MediumPlugin) -> bool:
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


def check_integrator(scene: Scene) -> None:
    """ValueError where a BSDF absorbs and the scene's integrator is neither `refract_path` nor calls only that.

    Also for what `check_shapes` says.
    """
    check_shapes(scene)

    def follows(integrator: Any) -> bool:
        called = [child for child in children(integrator) if hasattr(child, "aov_names")]
        return type(integrator).__name__ == "RefractPath" or (bool(called) and all(map(follows, called)))

    declared = (absorbing_parameter(bsdf) for shape in all_shapes(scene) for bsdf in nested(shape.bsdf()))
    name = next(filter(None, declared), "")
    if name and not follows(scene.integrator()):
        raise ValueError(f"refract: {name}; expected the integrator refract_path, or no absorption")


def check_media(v: Variant, scene: Scene) -> None:
    """ValueError for what is not followed.

    That is a medium of a sensor or a shape that scatters, one in a scene whose BSDFs absorb as well, and an absorbing
    BSDF within another one, which does not pass on what it declares.
    """

    def check(owner: str, medium: MediumPlugin, otherwise: str = "") -> None:
        if medium is not None and not absorbs_only(v, medium):
            expected = f"a homogeneous medium with an albedo of 0{otherwise}"
            raise ValueError(f"refract_path: {owner} scatters or varies; expected {expected}")

    for sensor in scene.sensors():
        check("the sensor's medium", sensor.get_medium())
    shapes = all_shapes(scene)
    absorbing = [any(absorbing_parameter(bsdf) for bsdf in nested(shape.bsdf())) for shape in shapes]
    for i, shape in enumerate(shapes):
        name = shape_name(shapes, i)
        if absorbing[i] and not dr.all(shape.bsdf().has_attribute(BEYOND)):
            text = f"{name} has an absorbing BSDF within a {shape.bsdf().class_name()}"
            raise ValueError(f"refract_path: {text}; expected absorption of the shape's own BSDF")
        for side, medium in (("interior", shape.interior_medium()), ("exterior", shape.exterior_medium())):
            check(f"the {side} medium of {name}", medium, ", or the integrator volpath")
            if medium is not None and any(absorbing):
                raise ValueError(
                    f"refract_path: {name} has an {side} medium in a scene whose BSDFs absorb; expected either media "
                    "of shapes or absorption of BSDFs, not both"
                )

"""The absorbing medium that a path is in: declared by the BSDFs (`MediumTracker`), or by the shapes (`ShapeMedia`).

A BSDF declares σ on both of its sides. A path that goes through it enters the medium of the other side. The σ declared
on the side from which the path arrives must equal the σ of the path. Otherwise the image is wrong: a neighbour declares
another σ for the medium between them, or the camera is in a medium that was not declared. `Crossings.refuse` raises an
error with the name of such a shape.

A ray starts at a small distance from the surface that it leaves. Near an edge where three media meet it may miss a
boundary, and have the wrong σ: one ray in 30,000 in a tumbler of water. So a small share of wrong crossings is not an
error. An absorbing sheet that is thinner than that distance (`ray_origins`) is one: a path would never leave it.
"""

from __future__ import annotations

import math
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
    Sensor,
    Shape,
    Spectrum,
    Variant,
    Vector3,
)

from .absorption import BEYOND, HERE, absorbing_parameter
from .index_parameter import warn_once
from .refract import without_dispersion
from .scene_features import all_shapes, check_shapes, children, inspect, nested, plugin_number, shape_name

TOLERANCE = 1e-3  # relative: one side may give σ as a number and the other one as a colour
STRAY = 0.01  # the largest share of wrong crossings of a shape that is not an error
FEW = 2  # so many wrong crossings are not an error either, unless they are half of the crossings
NEVER = 2**32 - 1  # the depth of a shape's first wrong crossing, if none exists
# The share of the way from a ray's origin back to the surface that is searched for another surface. Rounding moves a
# point by up to an eighth of this distance (`ray_origins`), or by a thousandth of Mitsuba's, which is larger; a point
# on a cylinder or on a sphere in an instance by more (`ray_origins.inexact`).
SEARCHED, SEARCHED_FAR = 3 / 4, 1 - 1 / 64
# A null lobe does not change the medium. Rough and diffuse transmission do.
THROUGH = mi.BSDFFlags.DeltaTransmission | mi.BSDFFlags.GlossyTransmission | mi.BSDFFlags.DiffuseTransmission
WITHOUT_LIGHT = {"DepthIntegrator", "AOVIntegrator", "MomentIntegrator"}  # unless they call others


class Crossings:
    """Counts for each shape: [crossings, wrong crossings, least depth of a wrong crossing, times it was stepped over].

    A crossing is wrong if the σ of the path is not the one that the shape declares. A shape is stepped over if it is so
    thin that the ray starts beyond it.
    """

    def __init__(self, v: Variant, scene: Scene, thinnest: str) -> None:
        """`v`: the variant's module. `thinnest`: how thick a sheet must be, for messages."""
        self.v, self.vectorised, self.shapes = v, dr.is_jit_v(v.Float), all_shapes(scene)
        self.thinnest = thinnest
        self.tally: dict[int, list[int]] = {}  # scalar variants: position of the shape in the scene → its counts
        self.positions: dict[int, int] = {}  # Mitsuba's number of a shape → its position
        self.counts: list[Any] = []  # compiled variants: four arrays, indexed by the number of the shape
        if self.vectorised and dr.flag(dr.JitFlag.FreezingScope):  # what such a function counts could not be read
            warn_once(
                "refract_path: a frozen function cannot tell whether absorption is consistent; "
                "render the scene once without dr.freeze to check it"
            )
        elif self.vectorised:
            for i, shape in enumerate(self.shapes):
                self.positions[plugin_number(v, v.ShapePtr(shape))] = i
            # The last entry counts all shapes that `all_shapes` does not return.
            size = max(self.positions, default=0) + 2
            self.counts = [dr.opaque(v.UInt32, start, size) for start in (0, 0, NEVER, 0)]

    def add(self, shape: Shape, depth: Count, through: Mask, wrong: Mask, thin: Mask) -> None:
        """Count the lanes that go `through` a shape; `wrong` and `thin` are subsets of them. `depth`: 0 at first."""
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
        """ValueError names a shape that was stepped over, or the shape with the earliest wrong crossing."""

        def contradicts(crossed: int, wrong: int) -> bool:
            return wrong > STRAY * crossed and (wrong > FEW or 2 * wrong >= crossed)

        counted = enumerate(zip(*self.counts, strict=True))
        rows = [(self.positions.get(number, -1), [int(count) for count in row]) for number, row in counted]
        first, cause = NEVER, None  # later wrong crossings follow from the first
        for position, (crossed, wrong, depth, stepped_over) in sorted([*rows, *self.tally.items()]):
            name = shape_name(self.shapes, position) if position >= 0 else "a shape"
            if contradicts(crossed, stepped_over):
                raise ValueError(
                    f"refract_path: {name} absorbs, and is so thin that rays miss one of its sides; expected a sheet "
                    f"thicker than {self.thinnest}: move the scene to the origin"
                )
            if contradicts(crossed, wrong) and (cause is None or depth < first):
                first, cause = depth, name
        if cause is not None:
            camera = "camera_absorption, or the sensor's medium, as the camera's surroundings absorb"
            outside = "ext_absorption (or ext_colour) as the medium around it absorbs"
            raise ValueError(
                f"refract_path: inconsistent absorption at {cause}: the medium that light arrives in differs from the "
                f"one its BSDF declares; expected {f'{outside}; {camera}' if first else f'{camera}; {outside}'}"
            )


class MediumTracker:
    """Absorption that the BSDFs declare, for one render."""

    def __init__(self, v: Variant, scene: Scene, extent: float) -> None:
        """`v`: the variant's module. `extent`: that of the shapes with delta lobes; ∞ if rays start as Mitsuba's do."""
        self.v, self.scene, self.vectorised = v, scene, dr.is_jit_v(v.Float)
        self.near = extent < math.inf
        thinnest = "1e-5 of its size and its largest coordinate" if self.near else "1e-4 of 1 + its largest coordinate"
        self.crossings = Crossings(v, scene, thinnest)

    def cross(
        self, sigma: Spectrum, depth: Count, si: Interaction, bs: BSDFSample, bsdf: BSDF, ray: Ray, active: Mask
    ) -> Spectrum:
        """Return σ along `ray`, the next ray, and count the crossing.

        That is the σ of the other side if the BSDF sample is a transmission, else `sigma`.
        """
        v, through = self.v, active & ((bs.sampled_type & THROUGH) != 0)
        if not self.vectorised and not through:
            return sigma
        # A BSDF that declares nothing has σ = 0. In scalar variants `eval_attribute` raises for an absent attribute.
        declared = [self.vectorised or bsdf.has_attribute(name, through) for name in (HERE, BEYOND)]
        here, beyond = (
            bsdf.eval_attribute(name, si, through) if has else v.UnpolarizedSpectrum(0)
            for name, has in zip((HERE, BEYOND), declared, strict=True)
        )
        excess = dr.abs(here - sigma) - TOLERANCE * dr.maximum(here, sigma)
        # Another surface between this one and the origin of the next ray?
        back = si.p - ray.o
        length = dr.norm(back)
        absorbs = through & (dr.max(beyond) > 0) & (length > 0)
        ray_back = v.Ray3f(ray.o, back / dr.select(length > 0, length, 1), ray.time, ray.wavelengths)
        ray_back.maxt = length * (SEARCHED if self.near else SEARCHED_FAR)
        if self.near:
            thin = absorbs & self.scene.ray_test(dr.detach(ray_back), absorbs)
        else:  # rounding may move the surface itself into this range: another one, or one that faces the other way
            found = self.scene.ray_intersect(dr.detach(ray_back), mi.RayFlags.Minimal, False, absorbs)
            other = (found.shape != si.shape) | (found.instance != si.instance)
            other |= (found.prim_index != si.prim_index) | (dr.dot(found.n, si.n) < 0)
            thin = absorbs & found.is_valid() & other
        self.crossings.add(si.shape, depth, through, through & (dr.max(excess) > 0), thin)
        return dr.select(through, beyond, sigma)

    def toward(self, sigma: Spectrum, si: Interaction, d: Vector3, active: Mask) -> Spectrum:
        """Return σ along a shadow ray, which does not cross the boundary."""
        return sigma


class ShapeMedia:
    """Absorption by the media of the shapes (`interior`, `exterior`), which are followed as `volpath` does."""

    def __init__(self, v: Variant) -> None:
        """`v`: the variant's module."""
        self.v, self.vectorised = v, dr.is_jit_v(v.Float)

    def cross(
        self, sigma: Spectrum, depth: Count, si: Interaction, bs: BSDFSample, bsdf: BSDF, ray: Ray, active: Mask
    ) -> Spectrum:
        """Return σ along `ray`, the next ray."""
        return self.toward(sigma, si, ray.d, active)

    def toward(self, sigma: Spectrum, si: Interaction, d: Vector3, active: Mask) -> Spectrum:
        """Return σ in the direction d: that of the medium on its side if the shape has media, else `sigma`."""
        transition = active & si.is_medium_transition()
        if not self.vectorised and not transition:
            return sigma
        medium = si.target_medium(d)
        if not self.vectorised and medium is None:
            return self.v.UnpolarizedSpectrum(0)
        return dr.select(transition, extinction(self.v, medium, si.wavelengths, transition), sigma)


def extinction(v: Variant, medium: MediumPlugin, wavelengths: Number, active: Mask) -> Spectrum:
    """Return σ of a homogeneous medium; 0 for a null pointer."""
    mei = dr.zeros(v.MediumInteraction3f)
    mei.wavelengths = wavelengths
    return medium.get_scattering_coefficients(mei, active)[2]


def absorbs_only(v: Variant, medium: MediumPlugin) -> bool:
    """Whether a medium is homogeneous and scatters no light of any visible wavelength."""
    if not medium.is_homogeneous():
        return False
    if dr.flag(dr.JitFlag.FreezingScope):  # while a frozen function is recorded, values cannot be read
        warn_once("refract_path: a frozen function cannot tell whether a medium scatters; expected an albedo of 0")
        return True
    mei = dr.zeros(v.MediumInteraction3f)
    visible = [(mi.MI_CIE_MIN + (mi.MI_CIE_MAX - mi.MI_CIE_MIN) * i / 64,) for i in range(65)]
    for wavelength in visible if v.is_spectral else [()]:
        mei.wavelengths = type(mei.wavelengths)(*wavelength)
        if dr.any(medium.get_scattering_coefficients(mei, True)[0] != 0, axis=None):
            return False
    return True


def follows_media(integrator: Any) -> bool:
    """Return whether an integrator is `refract_path`, or calls only integrators that are."""
    called = [child for child in children(integrator) if hasattr(child, "aov_names")]
    return type(integrator).__name__ == "RefractPath" or (bool(called) and all(map(follows_media, called)))


def sees_light(integrator: Any) -> bool:
    """Return whether an integrator, or one that it calls, renders light; unknown ones do."""
    called = [child for child in children(integrator) if hasattr(child, "aov_names")]
    return any(map(sees_light, called)) or integrator.class_name() not in WITHOUT_LIGHT


def defects(scene: Scene) -> list[str]:
    """Return what the scene's integrator renders wrong without an error, one line each.

    These are: shapes of glass that are too thin for `refract_path`, or on which Mitsuba's points are inexact as seen
    from a camera; and dispersion with an integrator of light other than `refract_path`.
    """
    features, integrator = inspect(scene), scene.integrator()
    ours = follows_media(integrator)
    bsdfs = (bsdf for shape in all_shapes(scene) for bsdf in nested(shape.bsdf()))
    dispersive = (x for x in bsdfs if getattr(x, "dispersive", False) and not ours and sees_light(integrator))
    grey = next(map(without_dispersion, dispersive), "")
    return [text for text in (features.thin if ours else "", features.inexact, grey) if text]


def check_integrator(scene: Scene) -> None:
    """ValueError if a BSDF states absorption, even 0, and the integrator is not `refract_path` nor calls only that.

    ValueError also for shapes that Mitsuba renders wrong; see `check_shapes`.
    """
    check_shapes(scene)
    parameters = (absorbing_parameter(bsdf) for shape in all_shapes(scene) for bsdf in nested(shape.bsdf()))
    name = next(filter(None, parameters), "")
    if name and not follows_media(scene.integrator()):
        raise ValueError(f"refract: {name}; expected the integrator refract_path, or no absorption")


def check_media(v: Variant, scene: Scene, sensor: Sensor | None = None) -> None:
    """ValueError for a medium that `refract_path` cannot follow. `sensor`: as in `inspect`.

    These are: a medium of a sensor or a shape that scatters or varies; a medium of a shape in a scene whose BSDFs
    absorb; and an absorbing BSDF nested in another one, which hides its attributes.
    """

    def check(owner: str, medium: MediumPlugin, alternative: str = "") -> None:
        if medium is not None and not absorbs_only(v, medium):
            expected = f"a homogeneous medium with an albedo of 0{alternative}"
            raise ValueError(f"refract_path: {owner} scatters or varies; expected {expected}")

    for view in filter(None, (*scene.sensors(), sensor)):
        check("the sensor's medium", view.get_medium())
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

"""What a loaded Mitsuba scene needs of an integrator, and what an integrator can leave out. For every variant.

A black surface needs nothing: that is a `diffuse` whose reflectance is the number 0, as an area light without a BSDF
has it. In spectral variants `<rgb value="0"/>` is a spectrum of about 3e-8, which is not black. A part is left out only
for plugins on the lists below, which are known not to need it. Any other plugin, and an instance, needs everything.
"""

from __future__ import annotations

import functools
import math
import operator
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refract.numerics import BSDF, Scene, Shape, Variant

from . import ray_origins

# fmt: off
KNOWN = {
    "BlendBSDF", "BumpMap", "MaskBSDF", "NormalMap", "TwoSidedBRDF",
    "CircularPolarizer", "Hair", "LinearPolarizer", "LinearRetarder", "Measured", "MeasuredPolarized", "Null",
    "PolarizedPlastic", "Principled", "PrincipledThin", "Refract", "RoughConductor", "RoughDielectric", "RoughPlastic",
    "SmoothConductor", "SmoothDielectric", "SmoothDiffuse", "SmoothPlastic", "ThinDielectric",
}
KNOWN_SHAPES = {
    "BSplineCurve", "BlenderMesh", "Cube", "Cylinder", "Disk", "Ellipsoids", "EllipsoidsMesh", "LinearCurve", "Mesh",
    "OBJMesh", "PLYMesh", "Rectangle", "SDFGrid", "SerializedMesh", "Sphere",
}
PLAIN_LAMPS = {"AreaLight", "DirectionalArea"}
CONSTANT_TEXTURES = {
    "BlackBodySpectrum", "D65Spectrum", "IrregularSpectrum", "RawConstantTexture", "RawConstantTextureImpl",
    "RegularSpectrum", "SRGBReflectanceSpectrum", "UniformSpectrum",
}
# fmt: on
PERTURBING = {"BumpMap", "NormalMap"}  # their shading normal is not that of the interaction
# One reflected and one refracted direction, each sampled by a side of one threshold of `sample1`: what can be split.
BOUNDARIES = {"Refract", "SmoothDielectric"}
# No choice is left to chance where the lobes of `BOUNDARIES` are both followed.
DETERMINISTIC = BOUNDARIES | {"SmoothConductor", "TwoSidedBRDF"}
# Of a hit these need the shading normal only, which is all that `RayFlags.ShadingFrame` gives: no tangent, no (u, v).
WITHOUT_TANGENT = DETERMINISTIC | {"BlendBSDF", "MaskBSDF", "Null", "ThinDielectric"}
# Plugins that sample with `sample1` or with `sample2`, and never with both.
EITHER = DETERMINISTIC | {"Null", "RoughConductor", "SmoothDiffuse", "ThinDielectric"}
TRACED_LAMPS = {"AreaLight", "DirectionalEmitter", "PointLight", "SpotLight"}  # that `lamp_tracing` takes
CAST = "L S+ D (S|D)* E"  # the class of paths of caustics; see `SceneFeatures.missing`
BEAM = "DirectionalArea"  # the emitter of zero size that no shadow ray finds: its `sample_direction` gives nothing
# Integrators that find lamps of zero size by shadow rays only, as they call themselves → `volumes` of `missing`.
SHADOW_RAYS = {
    **dict.fromkeys(("PathIntegrator", "PathProjectiveIntegrator", "PRBIntegrator", "RefractPath"), False),
    **dict.fromkeys(("PRBVolpathIntegrator", "VolumetricMisPathIntegrator", "VolumetricSimplePathIntegrator"), True),
}


@dataclass(frozen=True)
class SceneFeatures:
    """Facts about a scene. `unknown`: the plugins that are not known, and so count as needing everything."""

    smooth: bool  # some BSDF has a lobe that is not a delta: then sampling emitters is worth while
    delta_perturbed: str  # one within a BSDF with delta lobes that may have a shading normal of its own, or ""
    sampleable: bool  # some emitter can be sampled
    lamps: bool  # some emitter other than the environment can be
    area: bool  # some shape emits
    environment: bool
    plain_environment: bool  # it has the same radiance in all directions
    both_numbers: bool  # some BSDF samples with `sample1` and with `sample2`, too
    only_glass: bool  # every BSDF has delta lobes only
    textured: bool  # a BSDF or a light may vary over its surface, or with its tangent
    null: bool  # some BSDF has a null lobe
    dispersive: bool  # some BSDF refracts by wavelength
    absorbing: bool  # some BSDF has an absorbing medium on one side
    media: bool  # some shape, sensor or emitter has a medium of Mitsuba's
    shape_media: bool  # some shape has one
    refracting: bool  # some BSDF has a refracted direction
    delta: bool  # some BSDF has a delta lobe other than a null lobe
    zero_size: tuple[str, ...]  # the classes of the emitters whose light has one position, or one direction at each
    splitting: bool  # some shape's BSDF is of `BOUNDARIES`
    chance: str  # the first plugin that is not of `DETERMINISTIC`, and its shape; "" where there is none
    delta_extent: float  # of the largest shape with delta lobes, as `ray_origins` takes it
    thin: str  # the first shape of glass that rays step over, and why; "" where there is none
    unknown: tuple[str, ...] = ()

    @property
    def left_out(self) -> dict[str, str]:
        """What an integrator can leave out: feature → the reason, in words."""
        no_emitter = "no emitter can be sampled" if self.smooth else "every BSDF has delta lobes only"
        constant = self.plain_environment and self.smooth
        reasons = {
            "emitter sampling": (not (self.smooth and self.sampleable), no_emitter),
            "a random number": (not self.both_numbers, "no BSDF samples with one number and with two as well"),
            "area lights": (not self.area, "no shape emits"),
            "environment": (not self.environment, "no environment emitter"),
            "sampling the environment": (constant, "a constant one is met by the BSDFs' own samples"),
            "media": (not self.media, "neither a shape, a sensor nor an emitter has a medium"),
            "null lobes": (not self.null, "no BSDF has one"),
            "textures": (not self.textured, "no BSDF and no area light varies over its surface"),
            "dispersion": (not self.dispersive, "no BSDF refracts by wavelength"),
            "absorption": (not self.absorbing, "no BSDF has an absorbing medium on a side"),
        }
        return {feature: reason for feature, (left_out, reason) in reasons.items() if left_out}

    def missing(self, caustics: str = "path", max_depth: int = -1, *, volumes: bool = False) -> dict[str, str]:
        """The light of lamps of zero size that is not found: class of paths → what is black, and what mends it.

        In Heckbert's notation: L is a lamp, S a delta or null lobe, D any other lobe, E the camera. A class is listed
        where the scene has a lamp of zero size and the lobes, and `max_depth` allows its shortest path. Its geometry
        may leave no such path. L S* E is not listed: a lamp of zero size is not visible itself.
        Source: Heckbert 1990, "Adaptive radiosity textures for bidirectional ray tracing".

        `caustics`: "path" where all paths begin at the camera, "lamp" where those of L S+ (D|S)* D E begin at the lamp;
        else ValueError.
        `max_depth`: as of `path`. `volumes`: shadow rays go through null lobes and media scatter, as in `volpath`.
        """
        if caustics not in ("path", "lamp"):
            raise ValueError(f"missing: caustics = {caustics!r}; expected path or lamp")
        null, most = self.null and not volumes, math.inf if max_depth < 0 else max_depth
        lobes = ", ".join([*["glass", "mirrors"] * self.delta, *["null"] * null])
        shadowed, beam = (", ".join(x for x in self.zero_size if (x == BEAM) == only) for only in (False, True))
        lamps, area = ", ".join(self.zero_size), "area lights in place of such lamps"
        seen = "where such lobes show it"
        traced = "refract_path with caustics = lamp, or " if {*self.zero_size} <= TRACED_LAMPS else ""
        cast = f"that delta lobes ({lobes}) cast on other surfaces is black"
        # Class, whether its lamps and lobes are there, edges of its shortest path, text.
        classes = {
            "path": (
                (CAST, shadowed and lobes, 3, f"light of {shadowed} {cast}; expected {traced}{area}"),
                ("L (S|D)* D (S|D)* E", beam, 2, f"all light of {beam} is black; expected a lamp of another type"),
            ),
            "lamp": (
                ("L S+ D (S|D)* S E", lamps and lobes, 4, f"light of {lamps} {cast} {seen}; expected {area}"),
                ("L D (S|D)* E", beam, 2, f"direct light of {beam} is black; expected a lamp of another type"),
            ),
        }[caustics]
        surface = self.smooth or (self.media and volumes)
        return {name: text for name, there, edges, text in classes if there and surface and edges <= most}


def inspect(scene: Scene) -> SceneFeatures:
    """What a Mitsuba scene needs as it is now; an edit of its parameters can change that."""
    shapes, emitters, sky = all_shapes(scene), scene.emitters(), scene.environment()
    opaque = [shape.class_name() for shape in shapes if shape.class_name() not in KNOWN_SHAPES]
    within = [[] if _black(shape.bsdf()) else [*nested(shape.bsdf())] for shape in shapes]
    bsdfs = [bsdf for each in within for bsdf in each]
    names = {bsdf_name(bsdf) for bsdf in bsdfs}
    unknown = tuple(sorted((names - KNOWN) | {*opaque}))
    random = {*opaque, *(names - DETERMINISTIC)}
    chance = (
        f"{kind} at {shape_name(shapes, i)}"
        for i in (range(len(shapes)) if random else ())
        for kind in (shapes[i].class_name(), *map(bsdf_name, within[i]))
        if kind in random
    )
    perturbed = (
        name
        for each in within
        if each and each[0].flags() & +mi.BSDFFlags.Delta
        for name in map(bsdf_name, each)
        if name not in KNOWN - PERTURBING
    )
    everything = bool(unknown)
    lobes = mi.BSDFFlags
    flags = functools.reduce(operator.or_, (bsdf.flags() for bsdf in bsdfs), 0)
    deltas = {bsdf_name(bsdf) for bsdf in bsdfs if not bsdf.flags() & +lobes.Smooth}
    lamps = [shape.emitter() for shape in shapes if shape.is_emitter()]
    points = [emitter for emitter in emitters if emitter.flags() & +mi.EmitterFlags.Delta]
    glass = {  # and mirrors
        i: functools.reduce(operator.or_, (bsdf.flags() for bsdf in inner))
        for i, inner in enumerate(within)
        if any(bsdf.flags() & +lobes.Delta or bsdf_name(bsdf) not in KNOWN for bsdf in inner)
    }
    sizes = {i: ray_origins.size_of(shapes[i]) for i in glass}
    delta_extent = math.inf if opaque else ray_origins.extent_of([*sizes.values()])
    thin = (
        f"{shape_name(shapes, i)} {text}"
        for i, flags_of_all in glass.items()
        if flags_of_all & +lobes.DeltaTransmission and (text := ray_origins.too_thin(sizes[i], delta_extent))
    )
    shape_media = any(shape.interior_medium() or shape.exterior_medium() for shape in shapes)
    return SceneFeatures(
        smooth=everything or bool(flags & +lobes.Smooth),
        delta_perturbed=next(perturbed, ""),
        sampleable=bool(emitters),  # Mitsuba refuses a scene all of whose emitters have the weight 0
        lamps=any(not emitter.is_environment() and emitter.sampling_weight() > 0 for emitter in emitters),
        area=bool(opaque or lamps),
        environment=sky is not None,
        plain_environment=sky is not None and sky.class_name() == "ConstantBackgroundEmitter",
        both_numbers=everything or bool(names - EITHER),
        only_glass=not (everything or flags & +(lobes.Smooth | lobes.Delta1D)),
        textured=everything
        or any(
            hasattr(child, "is_spatially_varying")
            and (child.is_spatially_varying() or child.class_name() not in CONSTANT_TEXTURES)
            for node in (*bsdfs, *lamps)
            for child in children(node)
        )
        or not deltas <= WITHOUT_TANGENT
        or not {lamp.class_name() for lamp in lamps} <= PLAIN_LAMPS,
        null=everything or bool(flags & +lobes.Null),
        dispersive=everything or any(getattr(bsdf, "dispersive", False) for bsdf in bsdfs),  # no plugin of Mitsuba's is
        absorbing=everything or any(getattr(bsdf, "absorbing", False) for bsdf in bsdfs),
        media=shape_media or any(end.get_medium() for end in (*emitters, *scene.sensors())),
        shape_media=shape_media,
        refracting=everything or bool(flags & +lobes.Transmission),
        delta=everything or bool(flags & +(lobes.DeltaReflection | lobes.DeltaTransmission)),
        zero_size=tuple(sorted({lamp.class_name() for lamp in points if lamp.sampling_weight() > 0})),
        splitting=any(bsdf_name(bsdf) in BOUNDARIES for each in within for bsdf in each[:1]),
        chance=next(chance, ""),
        delta_extent=delta_extent,
        thin=next(thin, ""),
        unknown=unknown,
    )


def missing_light(scene: Scene) -> dict[str, str]:
    """The light that the scene's integrator, and those that it calls, cannot find: as `SceneFeatures.missing`.

    Known of `path`, `refract_path`, `prb`, `prb_projective`, `volpath`, `volpathmis` and `prbvolpath`; nothing is
    returned for others.
    """
    features, integrators, missing = inspect(scene), [scene.integrator()], dict[str, str]()
    while integrators:
        integrator = integrators.pop()
        integrators += [child for child in children(integrator) if hasattr(child, "aov_names")]
        name, _, parameters = str(integrator).partition("[")
        if name in SHADOW_RAYS and (depth := re.search(r"max_depth = (-?\d+)", parameters)):
            own = integrator is scene.integrator() and hasattr(integrator, "caustics_of")
            caustics = integrator.caustics_of(scene, scene.sensors()[0]) if own else "path"
            missing |= features.missing(caustics, int(depth[1]), volumes=SHADOW_RAYS[name])
    return missing


def differentiated(scene: Scene) -> bool:
    """Whether a parameter of the scene has a derivative, also while derivatives are suspended, as in `mi.render`."""

    def attached(value: Any) -> bool:
        if not dr.is_diff_v(value):
            return False
        if dr.is_tensor_v(value):
            return attached(value.array)
        return any(map(attached, value)) if dr.depth_v(value) > 1 else value.index_ad != 0

    return any(attached(value) for _, value in mi.traverse(scene))


def check_attributes(scene: Scene) -> None:
    """ValueError for attributes of meshes that Mitsuba does not read right.

    One that a texture of `refract` names and the shape does not have is 0 there. One that a lamp emits is read in the
    first face wherever a point on the lamp is sampled.
    """
    shapes = all_shapes(scene)
    for i, shape in enumerate(shapes):
        lamp = shape.emitter()
        if lamp is not None and lamp.sampling_weight() > 0 and (found := mesh_attributes(lamp)):
            raise ValueError(
                f"refract_path: {shape_name(shapes, i)} emits the attribute {found[0]!r} of its mesh, which Mitsuba "
                "reads in one face only where it samples a lamp; expected a bitmap, or sampling_weight = 0"
            )
        for bsdf in nested(shape.bsdf()):
            for name in mesh_attributes(bsdf) if bsdf_name(bsdf) == "Refract" else []:
                if not dr.all(shape.has_attribute(name)):
                    raise ValueError(
                        f"refract: {shape_name(shapes, i)} has no attribute {name!r}, which a texture of its BSDF "
                        "reads; expected a mesh with that attribute"
                    )


def mesh_attributes(node: mi.Object) -> list[str]:
    """The names of the attributes of meshes that the textures of a BSDF or a lamp read."""
    names, textures = list[str](), children(node)
    while textures:
        texture = textures.pop()
        textures += children(texture)
        # It shows its name nowhere else.
        if texture.class_name() == "MeshAttribute" and (name := re.search(r'name = "(.*)"', str(texture))):
            names.append(name[1])
    return names


def all_shapes(scene: Scene) -> list[Shape]:
    """The shapes of a scene, and those within its shape groups, which `scene.shapes()` leaves out."""
    groups = [child for child in children(scene) if child.class_name() == "ShapeGroupPlugin"]
    return [*scene.shapes(), *(part for group in groups for part in children(group) if hasattr(part, "bsdf"))]


def shape_name(shapes: list[Shape], position: int) -> str:
    """The shape's name in quotes, or its class and its position in the scene where it has no name."""
    shape = shapes[position]
    return repr(str(shape.id())) if shape.id() else f"shape {position + 1} of {len(shapes)} ({shape.class_name()})"


def plugin_number(v: Variant, pointer: Any) -> int:
    """The number by which Mitsuba registered a plugin, of a pointer of one entry."""
    numbers: Any = dr.reinterpret_array(v.UInt32, pointer)
    return int(numbers[0])


def bsdf_name(bsdf: BSDF) -> str:
    """The C++ class; of a Python plugin, which Mitsuba calls "BSDF", its own, with its module unless it is ours."""
    name, kind = bsdf.class_name(), type(bsdf)
    if name != "BSDF" and kind.__module__.startswith("mitsuba"):
        return str(name)
    return kind.__name__ if kind.__module__.startswith("mi_refract.") else f"{kind.__module__}.{kind.__name__}"


def nested(bsdf: BSDF) -> Iterator[BSDF]:
    """A BSDF, and those that it shows within it; nothing for None."""
    if bsdf is None:
        return
    yield bsdf
    for child in children(bsdf):
        if hasattr(child, "eval_null_transmission"):
            yield from nested(child)


def _black(bsdf: BSDF) -> bool:
    # A frozen function is recorded for every value that will come.
    if bsdf is None or bsdf_name(bsdf) != "SmoothDiffuse" or dr.flag(dr.JitFlag.FreezingScope):
        return False
    (reflectance,) = children(bsdf)
    exact = reflectance.class_name() == "UniformSpectrum" or "spectral" not in bsdf.variant_name()
    zero = exact and not reflectance.is_spatially_varying() and reflectance.max() == 0
    # The derivative of an image in a reflectance of 0 is not 0.
    return zero and not any(dr.grad_enabled(value) for _, value in mi.traverse(bsdf))


def children(node: mi.Object) -> list[Any]:
    """The Mitsuba objects that a plugin shows of itself."""

    class Children(mi.TraversalCallback):
        def __init__(self) -> None:
            super().__init__()
            # Not in a closure of the class: classes live until the garbage collector runs, and scenes would with them.
            self.objects: list[Any] = []

        def put(self, name: str, value: Any, flags: Any, cpptype: Any = None) -> None:
            if isinstance(value, mi.Object):
                self.objects.append(value)

    callback = Children()
    node.traverse(callback)
    return callback.objects

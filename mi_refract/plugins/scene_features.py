"""The features that a loaded Mitsuba scene needs of an integrator, and those that it can omit, in every variant.

A black surface needs no feature: it is a `diffuse` with the number 0 as reflectance, Mitsuba's default for area lights.
In spectral variants `<rgb value="0"/>` is a spectrum of about 3e-8, which is not black. A feature is omitted only if
all plugins are in the lists below, of plugins known not to need it. Any other plugin, and an instance, needs
everything.
"""

from __future__ import annotations

import functools
import math
import operator
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refract.numerics import BSDF, Scene, Sensor, Shape, Variant

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
PERTURBING = {"BumpMap", "NormalMap"}  # they change the shading normal of the interaction
# BSDFs that can be split: one reflected and one refracted direction, selected by a threshold of `sample1`.
BOUNDARIES = {"Refract", "SmoothDielectric"}
ONE_SIDED = {"BSplineCurve", "Ellipsoids", "EllipsoidsMesh", "LinearCurve"}  # rays do not meet them from within
# BSDFs that make no random choice if both lobes of `BOUNDARIES` are followed.
DETERMINISTIC = BOUNDARIES | {"SmoothConductor", "TwoSidedBRDF"}
# BSDFs that use only the shading normal of an interaction, as `RayFlags.ShadingFrame` gives it: no tangent, no (u, v).
WITHOUT_TANGENT = DETERMINISTIC | {"BlendBSDF", "MaskBSDF", "Null", "ThinDielectric"}
# BSDFs that sample with `sample1` or with `sample2`, and never with both.
EITHER = DETERMINISTIC | {"Null", "RoughConductor", "SmoothDiffuse", "ThinDielectric"}
TRACED_LAMPS = {"AreaLight", "DirectionalEmitter", "PointLight", "SpotLight"}  # emitters that `lamp_tracing` supports
CAST = "L S+ D (S|D)* E"  # the class of paths of caustics; see `SceneFeatures.missing`
CONSTANT = "ConstantBackgroundEmitter"
BEAM = "DirectionalArea"  # the emitter of zero size that shadow rays do not find: its `sample_direction` returns 0
# Integrators that find lamps of zero size only by shadow rays, by their names in `str` → `volumes` of `missing`.
SHADOW_RAYS = {
    **dict.fromkeys(("PathIntegrator", "PathProjectiveIntegrator", "PRBIntegrator", "RefractPath"), False),
    **dict.fromkeys(("PRBVolpathIntegrator", "VolumetricMisPathIntegrator", "VolumetricSimplePathIntegrator"), True),
}


@dataclass(frozen=True)
class SceneFeatures:
    """Facts about a scene. `unknown`: the names of plugins that are not known, which count as needing everything."""

    smooth: bool  # some BSDF has a lobe that is not a delta lobe, so emitter sampling is useful
    delta_perturbed: str  # a plugin that may change the shading normal in a BSDF with delta lobes (not null), or ""
    sampleable: bool  # some emitter can be sampled
    lamps: bool  # some emitter other than the environment can be sampled
    lamps_at_infinity: bool  # some emitter other than a constant environment has no position
    area: bool  # some shape emits
    environment: bool  # an environment emitter exists
    plain_environment: bool  # the environment has the same radiance in all directions
    both_numbers: bool  # some BSDF samples with both `sample1` and `sample2`
    only_glass: bool  # every BSDF has delta lobes only
    textured: bool  # a BSDF or a light may vary over its surface, or depend on the tangent
    null: bool  # some BSDF has a null lobe
    dispersive: bool  # the refraction of some BSDF depends on the wavelength
    absorbing: bool  # some BSDF has an absorbing medium on one side
    media: bool  # some shape, sensor or emitter has a Mitsuba medium
    shape_media: bool  # some shape has a Mitsuba medium
    refracting: bool  # some BSDF has a refracted direction
    delta: bool  # some BSDF has a delta lobe other than a null lobe
    zero_size: tuple[str, ...]  # classes of emitters whose light has one position, or one direction at each position
    splitting: bool  # some shape's BSDF is in `BOUNDARIES`
    chance: str  # the first plugin that is not in `DETERMINISTIC`, and its shape; "" if none exists
    delta_extent: float  # extent of the largest shape with delta lobes, for `ray_origins`
    thin: str  # the first shape of glass that is too thin for rays to enter, and why; "" if none exists
    # The first shape of glass on which Mitsuba's points err by more than rays allow, from a camera, and why; or "".
    inexact: str = field(compare=False)
    unknown: tuple[str, ...] = ()

    @property
    def left_out(self) -> dict[str, str]:
        """The features that an integrator can omit: feature → the reason, in words."""
        no_emitter = "no emitter can be sampled" if self.smooth else "every BSDF has delta lobes only"
        constant = self.plain_environment and self.smooth
        reasons = {
            "emitter sampling": (not (self.smooth and self.sampleable), no_emitter),
            "a random number": (not self.both_numbers, "no BSDF samples with both sample1 and sample2"),
            "area lights": (not self.area, "no shape emits"),
            "environment": (not self.environment, "no environment emitter"),
            "sampling the environment": (constant, "it is constant, so BSDF sampling finds it"),
            "media": (not self.media, "no shape, sensor or emitter has a medium"),
            "null lobes": (not self.null, "no BSDF has one"),
            "textures": (not self.textured, "no BSDF or area light varies over its surface"),
            "dispersion": (not self.dispersive, "no BSDF refracts by wavelength"),
            "absorption": (not self.absorbing, "no BSDF has an absorbing medium on one side"),
        }
        return {feature: reason for feature, (left_out, reason) in reasons.items() if left_out}

    def missing(self, caustics: str = "path", max_depth: int = -1, *, volumes: bool = False) -> dict[str, str]:
        """Return the light of lamps of zero size that an integrator misses: class of paths → a text with a remedy.

        In Heckbert's notation: L is a lamp, S a delta or null lobe, D any other lobe, E the camera. A class is listed
        if the scene has a lamp of zero size and the lobes, and `max_depth` allows the shortest path of the class; the
        geometry may still exclude such paths. L S* E is not listed: a lamp of zero size is not visible itself.
        Source: Heckbert 1990, "Adaptive radiosity textures for bidirectional ray tracing".

        `caustics`: "path" if all paths start at the camera, "lamp" if those of L S+ (D|S)* D E start at the lamp; else
        ValueError. `max_depth`: as in `path`. `volumes`: media scatter and shadow rays pass null lobes (`volpath`).
        """
        if caustics not in ("path", "lamp"):
            raise ValueError(f"missing: caustics = {caustics!r}; expected path or lamp")
        null, limit = self.null and not volumes, math.inf if max_depth < 0 else max_depth
        lobes = ", ".join([*["glass", "mirrors"] * self.delta, *["null"] * null])
        beam = BEAM if BEAM in self.zero_size else ""
        others = ", ".join(name for name in self.zero_size if name != BEAM)
        lamps, area = ", ".join(self.zero_size), "area lights in place of such lamps"
        traced = "refract_path with caustics = lamp, or " if {*self.zero_size} <= TRACED_LAMPS else ""
        cast = f"that delta lobes ({lobes}) cast on other surfaces is black"
        indirectly = "where it is seen through such lobes"
        # Class, whether the scene has its lamps and lobes, edges of its shortest path, text.
        classes = {
            "path": (
                (CAST, others and lobes, 3, f"light of {others} {cast}; expected {traced}{area}"),
                ("L (S|D)* D (S|D)* E", beam, 2, f"all light of {beam} is black; expected a lamp of another type"),
            ),
            "lamp": (
                ("L S+ D (S|D)* S E", lamps and lobes, 4, f"light of {lamps} {cast} {indirectly}; expected {area}"),
                ("L D (S|D)* E", beam, 2, f"direct light of {beam} is black; expected a lamp of another type"),
            ),
        }[caustics]
        scatters = self.smooth or (self.media and volumes)
        return {name: text for name, exists, edges, text in classes if exists and scatters and edges <= limit}


def inspect(scene: Scene, sensor: Sensor | None = None) -> SceneFeatures:
    """Return the features of a Mitsuba scene as it is now; an edit of its parameters can change them.

    `sensor`: one that views the scene and may not be part of it.
    """
    shapes, emitters, sky = all_shapes(scene), scene.emitters(), scene.environment()
    unknown_shapes = [shape.class_name() for shape in shapes if shape.class_name() not in KNOWN_SHAPES]
    bsdfs_of_shapes = [[] if _black(shape.bsdf()) else [*nested(shape.bsdf())] for shape in shapes]
    bsdfs = [bsdf for of_shape in bsdfs_of_shapes for bsdf in of_shape]
    names = {bsdf_name(bsdf) for bsdf in bsdfs}
    unknown = tuple(sorted((names - KNOWN) | {*unknown_shapes}))
    random = {*unknown_shapes, *(names - DETERMINISTIC)}
    chance = (
        f"{kind} at {shape_name(shapes, i)}"
        for i in (range(len(shapes)) if random else ())
        for kind in (shapes[i].class_name(), *map(bsdf_name, bsdfs_of_shapes[i]))
        if kind in random
    )
    perturbed = (
        name
        for of_shape in bsdfs_of_shapes
        if of_shape and of_shape[0].flags() & (+mi.BSDFFlags.DeltaReflection | +mi.BSDFFlags.DeltaTransmission)
        for name in map(bsdf_name, of_shape)
        if name not in KNOWN - PERTURBING
    )
    everything = bool(unknown)
    lobes = mi.BSDFFlags
    flags = functools.reduce(operator.or_, (bsdf.flags() for bsdf in bsdfs), 0)
    deltas = {bsdf_name(bsdf) for bsdf in bsdfs if not bsdf.flags() & +lobes.Smooth}
    lamps = [shape.emitter() for shape in shapes if shape.is_emitter()]
    points = [emitter for emitter in emitters if emitter.flags() & +mi.EmitterFlags.Delta]
    with_delta = {  # the flags of all BSDFs of a shape, for shapes of glass and mirrors
        i: functools.reduce(operator.or_, (bsdf.flags() for bsdf in of_shape))
        for i, of_shape in enumerate(bsdfs_of_shapes)
        if any(bsdf.flags() & +lobes.Delta or bsdf_name(bsdf) not in KNOWN for bsdf in of_shape)
    }
    sizes = {i: ray_origins.size_of(shapes[i]) for i in with_delta}
    delta_extent = math.inf if unknown_shapes else ray_origins.extent_of([*sizes.values()])
    thin = (
        f"{shape_name(shapes, i)} {text}; expected a thicker shape, or one nearer to the origin"
        for i, flags_of_shape in with_delta.items()
        if flags_of_shape & +lobes.DeltaTransmission and (text := ray_origins.too_thin(sizes[i], delta_extent))
    )
    glass = [i for i, flags_of_shape in with_delta.items() if flags_of_shape & +lobes.DeltaTransmission]
    places = ray_origins.places_of([x for x in (*scene.sensors(), sensor) if x is not None])
    inexact = (
        f"{shape_name(shapes, i)} {text}"
        for i, instances in _suspects(scene, shapes, glass).items()
        if (text := ray_origins.inexact(shapes[i], instances, places))
    )
    shape_media = any(shape.interior_medium() or shape.exterior_medium() for shape in shapes)
    return SceneFeatures(
        smooth=everything or bool(flags & +lobes.Smooth),
        delta_perturbed=next(perturbed, ""),
        sampleable=bool(emitters),  # Mitsuba raises an error if all emitters have the weight 0
        lamps=any(not emitter.is_environment() and emitter.sampling_weight() > 0 for emitter in emitters),
        lamps_at_infinity=any(
            emitter.flags() & +mi.EmitterFlags.Infinite and emitter.class_name() != CONSTANT for emitter in emitters
        ),
        area=bool(unknown_shapes or lamps),
        environment=sky is not None,
        plain_environment=sky is not None and sky.class_name() == CONSTANT,
        both_numbers=everything or bool(names - EITHER),
        only_glass=not (everything or flags & +(lobes.Smooth | lobes.Delta1D)),
        textured=everything
        or any(
            hasattr(child, "is_spatially_varying") and may_vary(child)
            for node in (*bsdfs, *lamps)
            for child in children(node)
        )
        or not deltas <= WITHOUT_TANGENT
        or not {lamp.class_name() for lamp in lamps} <= PLAIN_LAMPS,
        null=everything or bool(flags & +lobes.Null),
        dispersive=everything or any(getattr(bsdf, "dispersive", False) for bsdf in bsdfs),  # no Mitsuba plugin is
        absorbing=everything or any(getattr(bsdf, "absorbing", False) for bsdf in bsdfs),
        media=shape_media or any(x.get_medium() for x in (*emitters, *scene.sensors(), sensor) if x is not None),
        shape_media=shape_media,
        refracting=everything or bool(flags & +lobes.Transmission),
        delta=everything or bool(flags & +(lobes.DeltaReflection | lobes.DeltaTransmission)),
        zero_size=tuple(sorted({lamp.class_name() for lamp in points if lamp.sampling_weight() > 0})),
        splitting=any(bsdf_name(bsdf) in BOUNDARIES for of_shape in bsdfs_of_shapes for bsdf in of_shape[:1]),
        chance=next(chance, ""),
        delta_extent=delta_extent,
        thin=next(thin, ""),
        inexact=next(inexact, ""),
        unknown=unknown,
    )


def missing_light(scene: Scene) -> dict[str, str]:
    """Return the light that the scene's integrator, and those that it calls, miss; see `SceneFeatures.missing`.

    Only `path`, `refract_path`, `prb`, `prb_projective`, `volpath`, `volpathmis` and `prbvolpath` are examined. Whether
    `refract_path` traces lamps is asked for the first sensor; without a sensor none is traced.
    """
    features, integrators, missing = inspect(scene), [scene.integrator()], dict[str, str]()
    while integrators:
        integrator = integrators.pop()
        integrators += [child for child in children(integrator) if hasattr(child, "aov_names")]
        name, _, parameters = str(integrator).partition("[")
        if name in SHADOW_RAYS and (depth := re.search(r"max_depth = (-?\d+)", parameters)):
            may_trace = integrator is scene.integrator() and hasattr(integrator, "caustics_of") and scene.sensors()
            by_path = not may_trace or integrator.caustics_of(scene, scene.sensors()[0]) == "path"
            missing |= features.missing("path" if by_path else "lamp", int(depth[1]), volumes=SHADOW_RAYS[name])
    return missing


def differentiated(node: mi.Object) -> bool:
    """Whether a parameter of a plugin is differentiated, also while derivatives are suspended, as in `mi.render`."""
    with dr.resume_grad():
        return any(dr.grad_enabled(value) for _, value in mi.traverse(node))


def check_shapes(scene: Scene) -> None:
    """ValueError for shapes that Mitsuba renders wrong.

    A mesh attribute that a texture of `refract` reads and its shape lacks would be 0. An attribute that a lamp emits
    would be read in the first face wherever a point on the lamp is sampled. Rays within a curve or an ellipsoid of
    `ellipsoids` do not meet it.
    """
    shapes = all_shapes(scene)
    for i, shape in enumerate(shapes):
        lamp = shape.emitter()
        if lamp is not None and lamp.sampling_weight() > 0 and (names := mesh_attributes(lamp)):
            raise ValueError(
                f"{shape_name(shapes, i)} emits the attribute {names[0]!r} of its mesh, which Mitsuba "
                "reads in one face only where it samples a lamp; expected a bitmap, or sampling_weight = 0"
            )
        for bsdf in nested(shape.bsdf()):
            if bsdf_name(bsdf) in BOUNDARIES and shape.class_name() in ONE_SIDED:
                raise ValueError(
                    f"{shape_name(shapes, i)} is a {shape.class_name()} of glass, which rays do not "
                    "meet from within; expected a mesh"
                )
            for name in mesh_attributes(bsdf) if bsdf_name(bsdf) == "Refract" else []:
                if not dr.all(shape.has_attribute(name)):
                    raise ValueError(
                        f"refract: {shape_name(shapes, i)} has no attribute {name!r}, which a texture of its BSDF "
                        "reads; expected a mesh with that attribute"
                    )


def may_vary(texture: Any) -> bool:
    """Whether a texture may vary over a surface. Mitsuba's mesh attributes, also within `d65`, say that they do not."""
    names = {x.class_name() for x in (texture, *children(texture))}
    return bool(texture.is_spatially_varying()) or not names <= CONSTANT_TEXTURES


def mesh_attributes(node: mi.Object) -> list[str]:
    """Return the names of the mesh attributes that the textures of a BSDF or an emitter read."""
    names, textures = list[str](), children(node)
    while textures:
        texture = textures.pop()
        textures += children(texture)
        # Mitsuba exposes the name only in `str`.
        if texture.class_name() == "MeshAttribute" and (match := re.search(r'name = "(.*)"', str(texture))):
            names.append(match[1])
    return names


def all_shapes(scene: Scene) -> list[Shape]:
    """Return the shapes that rays can meet: those of a scene, and those in its `shape_groups`.

    `scene.shapes()` omits the latter.
    """
    return [*scene.shapes(), *(shape for group in shape_groups(scene) for shape in shapes_of(group))]


def shape_groups(scene: Scene) -> list[Any]:
    """Return the shape groups of a scene that instances show; rays meet no others."""
    groups = [child for child in children(scene) if child.class_name() == "ShapeGroupPlugin"]
    names = {group_name(x) for x in scene.shapes() if x.class_name() == "Instance"} if groups else set()
    unknown = names - {group.id() for group in groups}  # another format of `str`: any group may be shown
    return [group for group in groups if unknown or group.id() in names]


def group_name(instance: Shape) -> str | None:
    """Return the name of an instance's shape group, which Mitsuba exposes only in `str`."""
    match = re.search(r'name = "(.*)"', str(instance))
    return match[1] if match else None


def _suspects(scene: Scene, shapes: list[Shape], glass: list[int]) -> dict[int, list[Shape] | None]:
    """Return the positions of cylinders, with None, and of cylinders and spheres in groups, with their instances.

    `shapes`: `all_shapes` of the scene; `glass`: the positions that are examined.
    """
    own, found = len(scene.shapes()), dict[int, list[Shape] | None]()
    in_groups: list[int] = []
    for i in glass:
        kind = shapes[i].class_name()
        if i < own and kind == "Cylinder":
            found[i] = None
        elif i >= own and kind in ("Cylinder", "Sphere"):
            in_groups.append(i)
    if in_groups:
        instances = [(group_name(x), x) for x in shapes[:own] if x.class_name() == "Instance"]
        groups = [group.id() for group in shape_groups(scene) for _ in shapes_of(group)]
        for i in in_groups:
            found[i] = [instance for name, instance in instances if name in (groups[i - own], None)]
    return found


def shapes_of(group: mi.Object) -> list[Shape]:
    """Return the shapes in a shape group."""
    return [child for child in children(group) if hasattr(child, "bsdf")]


def shape_name(shapes: list[Shape], position: int) -> str:
    """Return the shape's name in quotes, or its class and position in the scene if it has no name."""
    shape = shapes[position]
    return repr(str(shape.id())) if shape.id() else f"shape {position + 1} of {len(shapes)} ({shape.class_name()})"


def plugin_number(v: Variant, pointer: Any) -> int:
    """Return the number by which Mitsuba registered the plugin of a pointer with one entry."""
    numbers: Any = dr.reinterpret_array(v.UInt32, pointer)
    return int(numbers[0])


def bsdf_name(bsdf: BSDF) -> str:
    """Return the name of a BSDF's C++ class; for a Python plugin its own class, with the module unless it is ours.

    Mitsuba calls all Python plugins "BSDF".
    """
    name, kind = bsdf.class_name(), type(bsdf)
    if name != "BSDF" and kind.__module__.startswith("mitsuba"):
        return str(name)
    return kind.__name__ if kind.__module__.startswith("mi_refract.") else f"{kind.__module__}.{kind.__name__}"


def nested(bsdf: BSDF) -> Iterator[BSDF]:
    """Yield a BSDF and those nested in it, as far as they are exposed; nothing for None."""
    if bsdf is None:
        return
    yield bsdf
    for child in children(bsdf):
        if hasattr(child, "eval_null_transmission"):
            yield from nested(child)


def _black(bsdf: BSDF) -> bool:
    """Whether a BSDF is a `diffuse` of reflectance 0. False while a function is recorded, as the value may change."""
    if bsdf is None or bsdf_name(bsdf) != "SmoothDiffuse" or dr.flag(dr.JitFlag.FreezingScope):
        return False
    (reflectance,) = children(bsdf)
    exact = reflectance.class_name() == "UniformSpectrum" or "spectral" not in bsdf.variant_name()
    zero = exact and not may_vary(reflectance) and reflectance.max() == 0
    # A reflectance of 0 that is differentiated counts: the derivative of the image is not 0.
    return zero and not any(dr.grad_enabled(value) for _, value in mi.traverse(bsdf))


def children(node: mi.Object) -> list[Any]:
    """Return the Mitsuba objects that a plugin exposes by `traverse`."""

    class Children(mi.TraversalCallback):
        def __init__(self) -> None:
            super().__init__()
            # Not in a closure of the class: classes live until the garbage collector runs, and would keep scenes alive.
            self.objects: list[Any] = []

        def put(self, name: str, value: Any, flags: Any, cpptype: Any = None) -> None:
            if isinstance(value, mi.Object):
                self.objects.append(value)

    callback = Children()
    node.traverse(callback)
    return callback.objects

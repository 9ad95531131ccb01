"""Light traced from the lamps, through glass and over mirrors, onto surfaces that the camera sees: caustics.

A path from a lamp L to the camera E has vertices S, where the light takes a delta lobe (a null lobe is one), and D, any
others. In a render with `caustics` = `lamp` each class of paths belongs to one part:

| class (Heckbert's notation) | part | found by |
|---|---|---|
| L E, L S⁺ E | path tracing | rays that hit the lamp |
| L D (S\\|D)* E | path tracing | rays that hit the lamp, and emitter sampling |
| L S (S\\|D)* S E | path tracing | rays that hit the lamp: of a lamp of zero size nothing |
| L S E′, L S (S\\|D)* D E | **lamp tracing** | connections of the last D with the camera |

So the lamps' part has the paths whose first vertex is S and whose last one is D, and path tracing leaves out what it
finds of them: radiance of a lamp that a ray meets after a delta lobe, on a path whose first lobe was none. Light of the
environment is path tracing's alone. With `auto` only lamps of zero size are traced: path tracing finds none of their
paths in the last row, and all paths of the other lamps.

A light path starts at a point on a lamp, in a direction aimed at the bounding sphere of a shape with delta lobes. With
the probability p_j of sphere j, whose cone has the solid angle ω_j as seen from that point, a direction has the density

    q = Σ p_j / ω_j    over the spheres that it meets,

so where spheres overlap no light is counted twice. A directional lamp has disks in the place of cones. Light of a lamp
far away starts just before the spheres, as float32 would not find them from the lamp; a ray back to the lamp tests what
is between. Adjoint BSDFs, with the correction for shading normals: Veach 1997, section 5.3.2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refract.numerics import (
    BSDF,
    Count,
    Emitter,
    Interaction,
    Mask,
    Number,
    Point2,
    Ray,
    Scene,
    Sensor,
    Shape,
    Spectrum,
    Variant,
    Vector3,
    mitsuba_mesh,
)

from . import ray_origins
from .absorption import HERE
from .film import Splats, expected_weights, film_colours
from .medium_tracking import THROUGH
from .path_loop import PathLoop
from .refract import DISPERSED, followed_context
from .sampling import IndependentNumbers, KeyedMultijitter
from .scene_features import (
    KNOWN,
    KNOWN_SHAPES,
    PERTURBING,
    all_shapes,
    bsdf_name,
    children,
    mesh_attributes,
    nested,
    shape_groups,
    shapes_of,
)

MOST_TARGETS = 16  # spheres at which directions are aimed
FAR = 8  # a lamp is far if `Line.way` is more than this many times `Line.back`
MARGIN = 1 + 1e-4  # of a sphere's radius: rounding must not leave its rim out
LANES = 2**24  # light paths at a time
PILOT, MOST_PILOT = 256, 2**14  # light paths that estimate the power of a lamp, and of all lamps
DEFENSIVE = 0.1  # share of the light paths that is divided equally, whatever the estimate
SENSORS = {"PerspectiveCamera", "ThinLensCamera", "OrthographicCamera"}
AREA, PLACE, DIRECTION = range(3)  # kinds of lamps
KINDS = {"AreaLight": AREA, "PointLight": PLACE, "SpotLight": PLACE, "DirectionalEmitter": DIRECTION}  # TRACED_LAMPS
# The models of hair and thin slabs are not reciprocal; measured BSDFs interpolate wi and wo in different ways.
ONE_WAY = PERTURBING | {"Hair", "Measured", "MeasuredPolarized", "PrincipledThin"}
UNSAMPLED = {"Ellipsoids", "SDFGrid"}  # shapes whose `sample_position` returns 0
LOBES = mi.BSDFFlags


def has_area(lamp: Emitter) -> bool:
    """Whether a lamp is neither the environment nor of zero size."""
    return not lamp.is_environment() and not lamp.flags() & +mi.EmitterFlags.Delta


def refused_lamps(v: Variant, scene: Scene, every: bool) -> str:
    """Why the lamps of a scene, with `every` or else only those of zero size, cannot be traced; "" if they can be."""
    lamps = [lamp for lamp in scene.emitters() if not lamp.is_environment() and (every or not has_area(lamp))]
    if untraced := {lamp.class_name() for lamp in lamps} - KINDS.keys():
        return f"it traces area, point, spot and directional lamps, not {min(untraced)}"
    shapes = [lamp.get_shape() for lamp in lamps if lamp.class_name() == "AreaLight"]
    if any(shape.is_mesh() and mitsuba_mesh.is_smooth(shape) for shape in shapes):
        return "the normals of an area lamp are not those of its faces"
    if unsampled := {shape.class_name() for shape in shapes} & UNSAMPLED:
        return f"Mitsuba samples no points on an area lamp of type {min(unsampled)}"
    # Mitsuba's position samples there have the normal of the other side.
    if any(shape.class_name() == "Cylinder" and dr.all(dr.det(matrix_of(shape, "to_world")) < 0) for shape in shapes):
        return "an area lamp on a mirrored Cylinder"
    if any(map(mesh_attributes, lamps)):
        return "an area lamp emits an attribute of its mesh"
    # Mitsuba returns the same matrix for light from the lamp, but its factors would have to be in reverse order.
    if v.is_polarized and any(
        bsdf_name(bsdf) == "LinearRetarder" for shape in all_shapes(scene) for bsdf in nested(shape.bsdf())
    ):
        return "a retarder"
    unbounded = (x.class_name() for x in scene.shapes() if not math.isfinite(bounding_sphere(x).radius))
    return next((f"the bounds of a {name} are not known" for name in unbounded), "")


def refused_sensor(sensor: Sensor) -> str:
    """Why light cannot be traced to a sensor; "" if it can be."""
    if sensor.class_name() not in SENSORS:
        return f"it traces light to perspective, thinlens and orthographic cameras, not {sensor.class_name()}"
    if mi.has_flag(sensor.film().flags(), mi.FilmFlags.Special) or sensor.film().sample_border():
        return "it traces light to a hdrfilm without sample_border"
    return ""


def by_area(lamp: Emitter) -> bool:
    """Whether points on a lamp are sampled by its area, though its radiance varies."""
    if lamp.class_name() != "AreaLight":
        return False
    textures = [x for x in children(lamp) if hasattr(x, "is_spatially_varying") and x.is_spatially_varying()]
    exact = lamp.get_shape().class_name() in ("Disk", "Rectangle")
    inner = [child for texture in textures for child in children(texture)]  # of `d65`
    matrices = (matrix_of(texture, "to_uv") for texture in (*textures, *inner))  # which Mitsuba ignores
    moved = (x is not None and bool(dr.any(x != dr.identity(type(x)), axis=None)) for x in matrices)
    return bool(textures) and (not exact or any(moved))


def matrix_of(node: mi.Object, name: str) -> Any:
    """A copy of the matrix of a transform that a plugin exposes; None if it exposes none."""
    parameters = mi.traverse(node)  # a transform is part of them, and does not keep them alive
    return type(parameters[name].matrix)(parameters[name].matrix) if name in parameters else None


def is_one_way(bsdf: BSDF) -> bool:
    """Whether a BSDF, or one within it, may not have the same value for light that goes the other way."""
    return not {*map(bsdf_name, nested(bsdf))} <= KNOWN - ONE_WAY


def outward(v: Variant, lamp: Emitter) -> tuple[float, ...]:
    """The centre of a lamp on a sphere, and the sign of its normal; 0 for other lamps.

    Mitsuba's samples of positions on a turned or mirrored sphere have the normal of another place.
    """
    if lamp.class_name() != "AreaLight" or (shape := lamp.get_shape()).class_name() != "Sphere":
        return 0.0, 0.0, 0.0, 0.0
    ball = bounding_sphere(shape)
    x, y, z = ball.center
    si = shape.ray_intersect(v.Ray3f(v.Point3f(x + 2 * ball.radius, y, z), v.Vector3f(-1, 0, 0)))
    sign: Any = dr.slice(si.sh_frame.n.x)
    return x, y, z, float(sign)


def lit(lamp: Emitter) -> bool:
    """Whether path tracing would find light of a lamp; a lamp of zero size is found only by emitter sampling."""
    return KINDS[lamp.class_name()] == AREA or lamp.sampling_weight() > 0


# Aim ------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sphere:
    """Bounds of some shapes."""

    center: tuple[float, ...]
    radius: float


def targets(scene: Scene) -> list[Sphere]:
    """Up to MOST_TARGETS spheres that bound all shapes that have a delta lobe or are unknown."""

    def is_target(shape: Shape) -> bool:
        names = {bsdf_name(bsdf): bsdf.flags() for bsdf in nested(shape.bsdf())}
        unknown = shape.class_name() not in KNOWN_SHAPES or not names.keys() <= KNOWN
        return unknown or any(flags & +LOBES.Delta for flags in names.values())

    edited = edited_groups(scene)
    return merged([bounding_sphere(shape, edited) for shape in scene.shapes() if is_target(shape)], MOST_TARGETS)


def edited_groups(scene: Scene) -> list[Any]:
    """The bounding boxes of the shape groups that have changed since they were loaded."""
    boxes = []
    for group in shape_groups(scene):
        box = type(group.bbox())()
        for shape in shapes_of(group):
            box.expand(mitsuba_mesh.bounding_box(shape))
        if box.valid() and box != group.bbox():
            boxes.append(box)
    return boxes


def bounding_sphere(shape: Shape, edited: Sequence[Any] = ()) -> Sphere:
    """A sphere around the bounding box of a shape; the radius is infinite or NaN if the bounds are unknown.

    Mitsuba's box of an instance is that of its group when that was loaded. So the box is extended by all groups that
    were `edited`.
    """
    box = mitsuba_mesh.bounding_box(shape)
    if edited and shape.class_name() == "Instance":
        import numpy as np

        to_world = np.array(mi.traverse(shape)["to_world"].matrix).reshape(4, 4)
        for corner in (group.corner(i) for group in edited for i in range(8)):
            box.expand((to_world[:3, :3] @ np.array(corner) + to_world[:3, 3]).tolist())
    half = [float(x) / 2 for x in box.extents()]
    radius = half[0] if shape.class_name() == "Sphere" else math.hypot(*half)
    return Sphere(tuple(map(float, box.center())), radius * MARGIN)


def merged(spheres: list[Sphere], most: int) -> list[Sphere]:
    """Up to `most` spheres that bound these: halves along the axis on which the centres are farthest apart."""
    if len(spheres) <= most:
        return spheres
    columns = list(zip(*(s.center for s in spheres), strict=True))
    if most == 1:
        center = tuple((min(x) + max(x)) / 2 for x in columns)
        return [Sphere(center, max(math.dist(center, s.center) + s.radius for s in spheres))]
    axis = max(range(3), key=lambda i: max(columns[i]) - min(columns[i]))
    ordered, half = sorted(spheres, key=lambda s: s.center[axis]), len(spheres) // 2
    return merged(ordered[:half], most // 2) + merged(ordered[half:], most - most // 2)


class Table:
    """Numbers that are read by index."""

    def __init__(self, v: Variant, values: Iterable[float]) -> None:
        """`v`: the variant's module."""
        self.v, self.values = v, v.Float([*values]) if dr.is_jit_v(v.Float) else [*values]
        dr.make_opaque(self.values)

    def __getitem__(self, index: Count) -> Number:
        """The number at each lane's index, without a derivative."""
        return dr.gather(self.v.Float, self.values, index) if dr.is_jit_v(self.v.Float) else self.values[int(index)]


@dataclass(frozen=True)
class Line:
    """A line from a lamp through a sphere."""

    p: Vector3  # a point near the sphere
    d: Vector3
    density: Number
    way: Number  # from the lamp to p
    back: Number  # from p back to where it has not met any sphere


class Aim:
    """Lines from lamps through spheres."""

    def __init__(self, v: Variant, spheres: list[Sphere], odds: list[list[float]]) -> None:
        """`v`: the variant's module. `odds`: for each lamp the probability of each sphere."""
        self.v, self.count = v, len(spheres)
        self.x, self.y, self.z = (Table(v, (s.center[i] for s in spheres)) for i in range(3))
        self.radius = Table(v, (s.radius for s in spheres))
        self.odds = Table(v, (p for row in odds for p in row))

    def sphere(self, j: Count) -> tuple[Vector3, Number]:
        """The centre and the radius of sphere j."""
        return self.v.Point3f(self.x[j], self.y[j], self.z[j]), self.radius[j]

    def choose(self, lamp: Count, sample: Number) -> Count:
        """Choose the sphere at which a light path of a lamp is aimed."""
        chosen, below = self.v.UInt32(0), self.v.Float(0)
        for j in range(self.count - 1):
            below += self.odds[lamp * self.count + j]
            chosen = dr.select(sample >= below, self.v.UInt32(j + 1), chosen)
        return chosen

    def from_point(self, lamp: Count, chosen: Count, o: Vector3, sample: Point2) -> Line:
        """A line from `o` toward the chosen sphere; its density is per solid angle."""
        v, (center, radius) = self.v, self.sphere(chosen)
        sine2 = self._sine2(chosen, o)
        height = sample.x * _one_minus_cosine(sine2)  # 1 − cos, which in a narrow cone is below the steps of a cosine
        around = dr.sincos(2 * math.pi * sample.y)
        r, cosine = dr.safe_sqrt(height * (2 - height)), 1 - height
        distance, outside = dr.norm(center - o), sine2 <= 1
        frame = v.Frame3f(dr.select(outside, (center - o) / dr.select(outside, distance, 1), v.Vector3f(0, 0, 1)))
        d = frame.to_world(v.Vector3f(r * around[1], r * around[0], cosine))
        # Where the line is nearest to the centre: o + way d, but without the rounding errors of a long way.
        sideways = v.Vector3f(cosine * r * around[1], cosine * r * around[0], -dr.square(r))
        p = dr.select(outside, center + distance * frame.to_world(sideways), o + radius * d)
        way, back, density = dr.select(outside, distance * cosine, radius), v.Float(0), v.Float(0)
        for j in range(self.count):
            other_sine2 = self._sine2(j, o)
            around_lamp = other_sine2 > 1
            met, behind = self._meets(j, p, d)
            inside = (chosen == j) | around_lamp | (met & (behind < way))
            share = self.odds[lamp * self.count + j] / (2 * math.pi * _one_minus_cosine(other_sine2))
            density += dr.select(inside, share, 0)
            back = dr.select(inside, dr.maximum(back, behind + self.radius[j]), back)
        return Line(v.Point3f(p), d, density, way, back)

    def from_infinity(self, lamp: Count, chosen: Count, d: Vector3, sample: Point2) -> Line:
        """A line in the direction d through the chosen sphere; its density is per area."""
        v = self.v
        center, radius = self.sphere(chosen)
        disk = v.warp.square_to_uniform_disk_concentric(sample)
        p = center + v.Frame3f(d).to_world(v.Vector3f(disk.x * radius, disk.y * radius, 0))
        back, density = v.Float(0), v.Float(0)
        for j in range(self.count):
            met, behind = self._meets(j, p, d)
            inside = (chosen == j) | met
            density += dr.select(inside, self.odds[lamp * self.count + j] / (math.pi * dr.square(self.radius[j])), 0)
            back = dr.select(inside, dr.maximum(back, behind + self.radius[j]), back)
        return Line(v.Point3f(p), d, density, v.Float(dr.inf), back)

    def _meets(self, j: Count, p: Vector3, d: Vector3) -> tuple[Mask, Number]:
        """Whether sphere j is on the line through p, and how far behind p its centre is."""
        center, radius = self.sphere(j)
        return dr.squared_norm(dr.cross(p - center, d)) <= dr.square(radius), dr.dot(p - center, d)

    def _sine2(self, j: Count, o: Vector3) -> Number:
        """Squared sine of the half angle of the cone from `o` about sphere j; from within it, 2."""
        center, radius = self.sphere(j)
        distance2 = dr.squared_norm(center - o)
        outside = distance2 > dr.square(radius)
        return dr.select(outside, dr.square(radius) / dr.select(outside, distance2, 1), 2)


def _quotient(a: Number, b: Number) -> Number:
    """a / b; 0 where b is 0."""
    return dr.select(b > 0, a / dr.select(b > 0, b, 1), 0)


def _one_minus_cosine(sine2: Number) -> Number:
    """1 − cos of an angle from its squared sine; 2, for a whole sphere, if that is above 1."""
    return dr.select(sine2 > 1, 2, sine2 / (1 + dr.safe_sqrt(1 - sine2)))


# Light paths ----------------------------------------------------------------------------------------------------------


@dataclass
class LightPath:
    """The state of a light path between vertices; None for parts that the features leave out."""

    ray: Ray
    throughput: Spectrum
    depth: Count  # vertices so far
    active: Mask
    # --- dispersion
    wavelength_count: Number = None  # as in the path loop
    # --- absorption: that of the medium at the lamp is not known before the first boundary, which declares it
    sigma: Spectrum = None  # of the medium that the ray is in
    known: Mask = None
    unattenuated: Number = None  # length of the way in the unknown medium
    skipped: Number = None  # as in the path loop


class LampTracer:
    """Renders the lamps' part of an image; see the module docstring."""

    def __init__(self, loop: PathLoop, sensor: Sensor, camera_medium: Callable[[Ray], tuple[Spectrum, Number]]) -> None:
        """`loop`: of path tracing. `camera_medium`: returns σ at the camera, and the way from it to a ray's origin."""
        v, scene = loop.v, loop.scene
        self.v, self.scene, self.loop, self.features = v, scene, loop, loop.features
        self.vectorised = loop.vectorised
        self.context = followed_context()
        self.context.mode = mi.TransportMode.Importance
        self.one_way = loop.ranges(is_one_way)
        self.camera, self.camera_medium = Camera(v, sensor), camera_medium
        emitters = scene.emitters()
        every = loop.features.caustics_apart
        indices = [
            i
            for i, lamp in enumerate(emitters)
            if not lamp.is_environment() and (every or not has_area(lamp)) and lit(lamp)
        ]
        self.lamps = [emitters[i] for i in indices]
        kinds = [KINDS[lamp.class_name()] for lamp in self.lamps]
        self.kinds: Any = v.UInt32(kinds) if self.vectorised else kinds
        dr.make_opaque(self.kinds)
        self.any = set(kinds)
        shapes = [lamp.get_shape() for lamp, kind in zip(self.lamps, kinds, strict=True) if kind == AREA]
        self.extent = ray_origins.extent_of([ray_origins.size_of(shape) for shape in shapes])
        self.pointers = dr.gather(v.EmitterPtr, scene.emitters_dr(), v.UInt32(indices)) if self.vectorised else None
        # With a varying texture Mitsuba samples meshes with overlapping (u, v) and turned cylinders wrongly. They are
        # called directly: a call through a pointer is also traced for shapes that cannot be sampled.
        self.round = [Table(v, column) for column in zip(*(outward(v, x) for x in self.lamps), strict=True)]
        self.by_area = [i for i, lamp in enumerate(self.lamps) if by_area(lamp)]
        spheres = targets(scene)
        odds = [self._odds(lamp, spheres) for lamp in self.lamps]
        self.aim = Aim(v, spheres, odds)
        self.choice = v.DiscreteDistribution([1.0] * len(self.lamps))
        self.unit = 1.0  # a power of two near the mean power of a light path: sums of splats have a range
        if self.vectorised or len(self.lamps) > 1:
            sums, paths = self._pilot()
            total, even = sum(sums), 1 / len(sums)
            odds_of_lamps = [DEFENSIVE * even + (1 - DEFENSIVE) * (x / total if total else even) for x in sums]
            self.choice = v.DiscreteDistribution(odds_of_lamps)
            self.unit = 2.0 ** min(max(math.frexp(total / paths)[1], -126), 126)

    def _odds(self, lamp: Emitter, spheres: list[Sphere]) -> list[float]:
        """The probability of each sphere: by its solid angle as seen from the lamp, or by its disk."""
        if KINDS[lamp.class_name()] == DIRECTION:
            sizes = [s.radius**2 for s in spheres]
        else:
            place = lamp.bbox().center()
            squares = [(s.radius, math.dist(s.center, map(float, place))) for s in spheres]
            sizes = [float(_one_minus_cosine(2.0 if r >= x else (r / x) ** 2)) for r, x in squares]
        total = sum(sizes) or 1.0
        return [DEFENSIVE / len(sizes) + (1 - DEFENSIVE) * size / total for size in sizes]

    def _pilot(self) -> tuple[list[float], int]:
        """The power of each lamp toward the spheres, estimated by some light paths, and the number of these paths."""
        import numpy as np

        v, count = self.v, min(PILOT, MOST_PILOT // len(self.lamps) + 1) * len(self.lamps)
        numbers: Any = KeyedMultijitter(v, v.UInt32(0), count, count) if self.vectorised else IndependentNumbers(v, 0)
        sums = [0.0] * len(self.lamps)
        for _ in range(1 if self.vectorised else count):
            lamps, _, light, _ = self._emitted(numbers, v.Bool(True))
            powers = dr.sum(v.unpolarized_spectrum(light))
            # Added in a fixed order: the bits of an image depend on the sums.
            for lamp, power in np.broadcast(np.ravel(lamps), np.ravel(powers)):
                sums[lamp] += float(power) if math.isfinite(power) else 0
        return sums, count

    def _emitted(self, numbers: Any, active: Mask) -> tuple[Count, Ray, Spectrum, Number]:
        """A lamp, a ray from it toward a sphere, its power over the density of all that was chosen, and the way to it.

        A ray of a far lamp starts just before the spheres, a `way` from the lamp; from the lamp it would miss them.
        """
        v, camera = self.v, self.camera.sensor
        time = camera.shutter_open()
        if camera.shutter_open_time() > 0:
            time = time + numbers.next_1d(None, 4) * camera.shutter_open_time()
        reference = dr.zeros(v.SurfaceInteraction3f)
        number = numbers.next_1d(None, 5) if v.is_spectral else 0.0
        wavelengths, weight = camera.sample_wavelengths(reference, number, active)
        lamp, probability = v.UInt32(0), v.Float(1)
        if len(self.lamps) > 1:
            lamp, probability = self.choice.sample_pmf(numbers.next_1d(None, 0), active)
        emitter = dr.gather(v.EmitterPtr, self.pointers, lamp) if self.vectorised else self.lamps[int(lamp)]
        kind = dr.gather(v.UInt32, self.kinds, lamp) if self.vectorised else self.kinds[int(lamp)]
        chosen = self.aim.choose(lamp, numbers.next_1d(None, 2))
        on_lamp, aimed = numbers.next_2d(None, 1), numbers.next_2d(None, 3)
        reference.time, reference.wavelengths = time, wavelengths
        origin, power, zero = v.Point3f(0), v.Spectrum(0), v.Float(0)
        line = Line(v.Point3f(0), v.Vector3f(0, 0, 1), zero, zero, zero)

        here = active & (kind == AREA)
        if AREA in self.any and (self.vectorised or here):
            ps, place = emitter.sample_position(time, on_lamp, here)
            for i in self.by_area:
                this = here & (lamp == i)
                if self.vectorised or this:
                    own = self.lamps[i].get_shape().sample_position(time, on_lamp, this)
                    ps, place = dr.select(this, own, ps), dr.select(this, _quotient(1, own.pdf), place)
            toward = self.aim.from_point(lamp, chosen, ps.p, aimed)
            x, y, z, sign = (column[lamp] for column in self.round)
            ps.n = dr.select(sign == 0, ps.n, sign * dr.normalize(ps.p - v.Point3f(x, y, z)))
            si = v.SurfaceInteraction3f(ps, wavelengths)
            si.shape = emitter.get_shape()
            si.wi = si.to_local(toward.d)
            radiance = emitter.eval(si, here)
            ray = ray_origins.spawn_ray(v, si, toward.d, self.extent, True)
            line, origin = dr.select(here, toward, line), dr.select(here, ray.o, origin)
            power = dr.select(here, radiance * (place * dr.abs(si.wi.z)), power)
        here = active & (kind == PLACE)
        if PLACE in self.any and (self.vectorised or here):
            ds, _ = emitter.sample_direction(reference, on_lamp, here)
            toward = self.aim.from_point(lamp, chosen, ds.p, aimed)
            reference.p = toward.p
            _, irradiance = emitter.sample_direction(reference, on_lamp, here)
            line, origin = dr.select(here, toward, line), dr.select(here, ds.p, origin)
            power = dr.select(here, irradiance * dr.squared_norm(toward.p - ds.p), power)
        here = active & (kind == DIRECTION)
        if DIRECTION in self.any and (self.vectorised or here):
            ds, irradiance = emitter.sample_direction(reference, on_lamp, here)
            line = dr.select(here, self.aim.from_infinity(lamp, chosen, -ds.d, aimed), line)
            power = dr.select(here, irradiance, power)
        power = power * dr.select(line.density > 0, 1 / (line.density * probability), 0)
        # Between the lamp and this origin there are no delta lobes, so any surface there blocks the light.
        far = active & (line.way > FAR * line.back)
        way = dr.select(far, line.way - line.back, 0)
        if self.vectorised or far:
            origin = dr.select(far, line.p - line.back * line.d, origin)
            before = v.Ray3f(origin, -line.d, way * (1 - v.math.ShadowEpsilon), time, wavelengths)
            power = dr.select(self.scene.ray_test(before, far), 0, power)
        return lamp, v.Ray3f(origin, line.d, time, wavelengths), power * v.Spectrum(weight), way

    def trace(self, numbers: Any, splat: Callable[..., None]) -> None:
        """Trace a light path per lane: `splat(place on the film, value, wavelengths, active)` for each connection."""
        v, features = self.v, self.features
        _, ray, power, way = self._emitted(numbers, v.Bool(True))
        s = LightPath(ray, power, v.UInt32(0), dr.max(v.unpolarized_spectrum(power)) > 0)
        if features.dispersion:
            s.wavelength_count = v.Float(dr.size_v(v.UnpolarizedSpectrum))
        if features.absorption:
            s.sigma, s.known = v.UnpolarizedSpectrum(0), v.Bool(False)
            s.unattenuated, s.skipped = v.Float(way), v.Float(0)
        start = dr.max(v.unpolarized_spectrum(power))

        def vertex(s: LightPath) -> tuple[LightPath]:
            return self._vertex(s, numbers, start, splat)

        dr.while_loop((s,), lambda s: s.active, vertex, label="lamp_tracing")

    def _vertex(self, s: LightPath, numbers: Any, start: Number, splat: Callable[..., None]) -> tuple[LightPath]:
        v, features, loop = self.v, self.features, self.loop
        key = (s.depth + 2) * 4

        # ---------------------- Surface interaction ----------------------
        si = self.scene.ray_intersect(s.ray, +mi.RayFlags.All, False, s.active)
        hit = s.active & si.is_valid()
        if not (self.vectorised or hit):
            s.active = False
            return (s,)
        if features.absorption:
            length = si.t + s.skipped
            s.throughput = dr.select(s.known, loop.attenuated(s.throughput, s.sigma, length), s.throughput)
            s.unattenuated = dr.select(s.known, 0, s.unattenuated + length)
        bsdf = si.bsdf()

        # ---------------------- Connection with the camera ----------------------
        connected = hit & (s.depth > 0) & mi.has_flag(bsdf.flags(), LOBES.Smooth) & (s.depth + 2 <= features.max_depth)
        sample_1, roulette_1, *rest = numbers.independent(key, 4)
        aperture = sample_2 = v.Point2f(*rest)
        if self.vectorised or connected:
            self._connect(s, si, bsdf, aperture, connected, splat)

        # ---------------------- BSDF sampling ----------------------
        active_next = hit & (s.depth + 2 < features.max_depth)
        if not (self.vectorised or active_next):
            s.active = False
            return (s,)
        bs, weight = bsdf.sample(self.context, si, sample_1, sample_2, active_next)
        active_next &= (s.depth > 0) | mi.has_flag(bs.sampled_type, LOBES.Delta)
        if v.is_polarized:
            weight = si.to_world_mueller(weight, -si.wi, bs.wo)
        # Shading normals n: |n·wi| |geometric·wo| / (|n·wo| |geometric·wi|).
        geometric = _quotient(dr.abs(dr.dot(si.n, si.to_world(bs.wo))), dr.abs(dr.dot(si.n, s.ray.d)))
        weight = weight * (geometric * _quotient(dr.abs(si.wi.z), dr.abs(bs.wo.z)))
        one_way = loop.is_of(self.one_way, bsdf) if self.vectorised else is_one_way(bsdf)
        own = active_next & (s.depth > 0) & one_way
        if self.one_way if self.vectorised else own:
            weight = self._seen(si, bsdf, bs, weight, s.ray.d, numbers, key + 1, own)
        ray = loop.spawn_ray(si, bs)
        throughput = loop.times(weight, s.throughput)
        if features.dispersion:
            dispersed = (bs.sampled_type & DISPERSED) != 0
            throughput = throughput * dr.select(dispersed, s.wavelength_count, 1)
            s.wavelength_count = dr.select(dispersed, 1, s.wavelength_count)
        if features.absorption:
            throughput = self._cross(s, si, bs, bsdf, ray, throughput, active_next)
        s.ray, s.throughput, s.depth = ray, throughput, s.depth + 1

        # ---------------------- Stopping criterion ----------------------
        largest = dr.max(v.unpolarized_spectrum(s.throughput))
        active_next &= largest > 0
        if features.roulette:
            probability = dr.minimum(largest / start, 0.95)
            roulette = active_next & (s.depth >= features.rr_depth)
            active_next &= (roulette & (roulette_1 >= probability)) ^ True
            s.throughput = dr.select(roulette, s.throughput * dr.rcp(probability), s.throughput)
        s.active = active_next
        return (s,)

    def _cross(
        self, s: LightPath, si: Interaction, bs: Any, bsdf: Any, ray: Ray, throughput: Spectrum, active: Mask
    ) -> Spectrum:
        """Enter the medium beyond a boundary. The medium on this side, which it declares, is that of the way so far."""
        through = active & ((bs.sampled_type & THROUGH) != 0)
        first = through & (s.known ^ True)
        if self.vectorised or (first and bsdf.has_attribute(HERE, first)):
            here = bsdf.eval_attribute(HERE, si, first)
            throughput = dr.select(first, self.loop.attenuated(throughput, here, s.unattenuated), throughput)
            s.sigma = dr.select(first, here, s.sigma)
        s.known = s.known | through
        s.sigma = self.loop.media.cross(s.sigma, s.depth, si, bs, bsdf, ray, active)
        s.skipped = dr.dot(ray.o - si.p, ray.d)
        return throughput

    def _seen(
        self, si: Interaction, bsdf: Any, bs: Any, weight: Spectrum, arriving: Vector3, numbers: Any, key: Count,
        active: Mask,
    ) -> Spectrum:  # fmt: skip
        """The weight of a sample of a BSDF, evaluated as in path tracing; the direction in `bs` may change.

        Light may leave in directions that the BSDF never samples for light from the lamp. So half of the directions
        are those of samples, and the other half are uniform.
        """
        choice, x, y = numbers.independent(key, 3)
        sampled = choice < 0.5
        delta = active & sampled & mi.has_flag(bs.sampled_type, LOBES.Delta)
        smooth = active & (delta ^ True)
        bs.wo = dr.select(smooth & (sampled ^ True), self.v.warp.square_to_uniform_sphere(self.v.Point2f(x, y)), bs.wo)
        density = (bsdf.pdf(self.context, si, bs.wo, smooth) + 1 / (4 * math.pi)) / 2
        cosines = _quotient(dr.abs(dr.dot(si.n, si.to_world(bs.wo))), dr.abs(dr.dot(si.n, arriving)))
        value = self._radiance(si, bsdf, bs.wo, smooth) * (cosines / density)
        side = dr.select(si.wi.z * bs.wo.z > 0, +LOBES.DiffuseReflection, +LOBES.DiffuseTransmission)
        bs.sampled_type = dr.select(smooth, side, bs.sampled_type)
        return dr.select(smooth, value, dr.select(delta, 2, 1) * weight)

    def _radiance(self, si: Interaction, bsdf: Any, wo: Vector3, active: Mask) -> Spectrum:
        """The BSDF times the cosine of wi, for light along −wi that leaves along wo, as path tracing evaluates it."""
        seen = self.v.SurfaceInteraction3f(si)
        seen.wi = wo
        value = bsdf.eval(self.loop.context, seen, si.wi, active)
        return si.to_world_mueller(value, -si.wi, wo) if self.v.is_polarized else value

    def _connect(
        self, s: LightPath, si: Interaction, bsdf: Any, aperture: Point2, active: Mask, splat: Callable[..., None]
    ) -> None:
        v, loop = self.v, self.loop
        place, camera_ray, importance, active = self.camera.connect(si, aperture, active)
        if self.features.hide_emitters and self.features.area:
            # The camera looks past lamps, and does not see the surface of one.
            active = active & (si.shape.emitter() == None) if self.vectorised else active and not si.shape.emitter()  # noqa: E711
            camera_ray = loop.past_emitters(camera_ray, active)
            active &= dr.dot(si.p - camera_ray.o, camera_ray.d) > 0
        d = -camera_ray.d
        value = self._radiance(si, bsdf, si.to_local(d), active)
        active &= dr.max(dr.abs(v.unpolarized_spectrum(value))) > 0
        ray = ray_origins.ray_to(v, si, camera_ray.o, self.features.delta_extent)
        active &= self.scene.ray_test(ray, active) ^ True
        value = loop.times(value, s.throughput) * (
            importance * _quotient(dr.abs(dr.dot(si.n, d)), dr.abs(dr.dot(si.n, s.ray.d)))
        )
        if self.features.absorption:
            sigma, way = self.camera_medium(camera_ray)
            length = dr.norm(si.p - camera_ray.o) + way + s.unattenuated
            value = loop.attenuated(value, dr.select(s.known, s.sigma, sigma), length)
        if self.vectorised or active:
            splat(place, value, si.wavelengths, active)


class Camera:
    """How much of the light that leaves a point a camera's film receives."""

    def __init__(self, v: Variant, sensor: Sensor) -> None:
        """`v`: the variant's module. `sensor`: of SENSORS."""
        self.v, self.sensor = v, sensor
        film = sensor.film()
        self.width, self.height = (int(n) for n in film.crop_size())
        self.parallel = sensor.class_name() == "OrthographicCamera"
        rays = (sensor.sample_ray(0, 0, v.Point2f(*p), v.Point2f(0.5))[0] for p in ((0, 0), (1, 0), (0, 1)))
        to_world = sensor.world_transform()
        self.axis = v.Vector3f(to_world @ v.Vector3f(0, 0, 1))
        if self.parallel:  # places on the film
            self.axis, (corner, right, down) = dr.normalize(self.axis), (ray.o for ray in rays)
        else:  # places at the distance 1, through the middle of the lens
            self.origin = v.Point3f(to_world @ v.Point3f(0))
            corner, right, down = (ray.d / dr.dot(ray.d, self.axis) for ray in rays)
        self.has_lens = sensor.class_name() == "ThinLensCamera"
        if self.has_lens:
            lens = mi.traverse(sensor)
            self.focus, radius = v.Float(lens["focus_distance"]), v.Float(lens["aperture_radius"])
            self.lens_x, self.lens_y = (radius * v.Vector3f(to_world @ v.Vector3f(*x)) for x in ((1, 0, 0), (0, 1, 0)))
        x, y = right - corner, down - corner
        # (x, y) of a place p on the film, from 0 to 1, is that of p − corner in the basis dual to x, y.
        normal = dr.cross(x, y)
        self.corner, self.area = corner, dr.abs(dr.dot(normal, self.axis))
        self.to_x = dr.cross(y, self.axis) / dr.dot(x, dr.cross(y, self.axis))
        self.to_y = dr.cross(x, self.axis) / dr.dot(y, dr.cross(x, self.axis))

    def connect(self, si: Interaction, aperture: Point2, active: Mask) -> tuple[Point2, Ray, Number, Mask]:
        """Place on the film in pixels, the camera's ray through it, its importance; whether the film sees the point.

        Importance: radiance of a pixel of area 1 from reflected power, ∫ L dx = Σ f Φ W.
        """
        v, pixels = self.v, self.width * self.height
        if self.parallel:
            seen, importance = si.p, pixels / self.area
            active &= dr.dot(si.p - self.corner, self.axis) > 0
        else:
            # Not Mitsuba's `sample_direction`, which sees nothing if the focus is not between the clipping planes.
            toward, shift = si.p - self.origin, v.Vector3f(0)
            if self.has_lens:
                disk = v.warp.square_to_uniform_disk_concentric(aperture)
                on_lens = disk.x * self.lens_x + disk.y * self.lens_y
                toward, shift = toward - on_lens, on_lens / self.focus
            depth, distance = dr.dot(toward, self.axis), dr.norm(toward)
            active &= depth > 0
            seen = toward / dr.select(depth > 0, depth, 1) + shift
            importance = _quotient(pixels, self.area * _quotient(depth, distance) ** 3 * dr.square(distance))
        apart = seen - self.corner
        place = v.Point2f(dr.dot(apart, self.to_x), dr.dot(apart, self.to_y))
        active &= (place.x >= 0) & (place.x < 1) & (place.y >= 0) & (place.y < 1)
        ray, _ = self.sensor.sample_ray(si.time, 0, place, aperture, active)
        ray.wavelengths = si.wavelengths
        far = dr.dot(si.p - ray.o, ray.d)
        active &= (importance > 0) & (far > 0) & (far <= ray.maxt)
        return v.Point2f(place.x * self.width, place.y * self.height), ray, importance, active


def lamp_image(tracer: LampTracer, seed: int, paths: int, channels: tuple[str, ...], *, squares: bool = False) -> Any:
    """The lamps' part of an image from `paths` light paths, H × W × colours, and its variance.

    Both are in float64. The variance is None without `squares`.
    """
    v, camera = tracer.v, tracer.camera
    pixels = camera.width * camera.height
    colours = 3 if channels[0] in ("R", "X") else 1
    sums = Splats(v, camera.sensor, colours)
    of_squares = Splats(v, camera.sensor, colours, squares=True) if squares else None

    def splat(place: Point2, value: Spectrum, wavelengths: Number, active: Mask) -> None:
        values = [x / tracer.unit / pixels for x in film_colours(v, value, wavelengths, channels)]
        sums.add(place, values, active)
        if of_squares:
            of_squares.add(place, values, active)

    if tracer.vectorised:
        for number, start in enumerate(range(0, paths, LANES)):
            lanes = min(LANES, paths - start)
            chunk = v.sample_tea_32(dr.opaque(v.UInt32, seed), number)[0]
            tracer.trace(KeyedMultijitter(v, chunk, lanes, lanes), splat)
            dr.eval(*(each for every in (sums, of_squares) if every for each in (every.digits, every.beyond)))
    else:
        numbers = IndependentNumbers(v, seed)
        for _ in range(paths):
            tracer.trace(numbers, splat)
    expected = expected_weights(camera.sensor.film())
    scale = pixels * tracer.unit / (1 if expected is None else expected)
    mean = sums.image() * (scale / paths)
    if of_squares is None:
        return mean, None
    return mean, (of_squares.image() * (scale**2 / paths) - mean**2).clip(0) / paths

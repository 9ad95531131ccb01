"""The path loop of `refract_path`, in the terms of Mitsuba's `path` and `prb_basic`, with three optional parts.

Each part, and each section of the loop, is traced only where `PathFeatures` has it:

- *absorption*: the throughput is multiplied by exp(−σ t) along each ray; σ is that of the medium that the ray is in.
- *dispersion*: where the direction depends on the wavelength, the path goes on with its first wavelength, whose
  throughput is multiplied by the number of wavelengths that the path carried.
- *splitting*: at a boundary both lobes are followed, depth first. One lobe goes on at once, the other is pushed on a
  stack; where a path ends, the branch that was pushed last is popped. So the stack of a lane has `split_depth` entries
  at most, however many paths the lane follows.

In scalar variants a pointer may be None and needs an `if`; in the others lanes are masked.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable
from dataclasses import dataclass, make_dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refract.numerics import (
    BSDF,
    BSDFSample,
    Count,
    Emitter,
    Interaction,
    Mask,
    Number,
    Point2,
    Ray,
    Sampler,
    Scene,
    Spectrum,
    Variant,
    Vector3,
)

from . import ray_origins
from .absorption import absorbed
from .medium_tracking import MediumTracker, ShapeMedia
from .refract import DISPERSED, followed_context
from .sampling import ONE, KeyedMultijitter, NonConstantEmitters, SceneEmitters, SceneSampler
from .scene_features import BOUNDARIES, all_shapes, bsdf_name, children, nested, plugin_number

# Samples near 0 and near 1 select the two lobes of a boundary; a lobe of smaller probability is not followed.
FIRST, LAST = 2.0**-25, ONE
LOBES = mi.BSDFFlags


@dataclass(frozen=True)
class PathFeatures:
    """The features that are traced: those that the scene needs and the integrator's parameters allow."""

    max_depth: int
    rr_depth: int
    hide_emitters: bool
    split_depth: int
    split_weight: float
    deterministic: bool
    emitter_sampling: bool
    lamps_only: bool  # emitter sampling leaves out a constant environment
    area: bool  # some shape emits
    environment: bool
    first_number: bool  # a BSDF sample takes `sample1`
    second_number: bool  # a BSDF sample takes `sample2`, two numbers; delta lobes need none
    all_of_hit: bool  # a hit needs more than its shading frame
    dispersion: bool  # some boundary refracts by wavelength
    absorption: bool  # some medium absorbs
    null: bool  # a BSDF may have a null lobe
    caustics_apart: bool = False  # `lamp_tracing` adds its paths, which are left out here
    delta_extent: float = math.inf  # of the largest shape with delta lobes; see `ray_origins`

    @property
    def roulette(self) -> bool:
        """Whether Russian roulette may end a path."""
        return self.rr_depth < self.max_depth and not self.deterministic

    @property
    def environment_after_loop(self) -> bool:
        """Whether the environment is evaluated once, after the loop: a lane has one path only."""
        return self.environment and not self.split_depth


@dataclass
class LoopState:
    """The state of a lane between vertices; None for parts that the features leave out."""

    ray: Ray
    throughput: Spectrum
    result: Spectrum  # radiance accumulated so far
    depth: Count  # depth of the current vertex
    active: Mask
    valid_ray: Mask  # whether the pixel is opaque here
    sampler: Sampler
    eta: Number  # product of the relative indices along the path
    escaped: Mask = None  # the ray has left the scene
    # --- emitter sampling: the previous vertex, and the density and kind of its BSDF sample
    prev_si: Interaction = None
    prev_bsdf_pdf: Number = None
    prev_bsdf_delta: Mask = None
    # --- caustics apart
    surface_first: Mask = None  # the lobe at the first vertex was no delta
    # --- splitting
    specular_so_far: Mask = None  # every lobe since the camera was a delta; after another the path is not split
    share: Number = None  # share of the pixel's light: product of the probabilities of the lobes that were split
    node: Count = None  # number of this branch in the tree: 2 n and 2 n + 1 are the branches of n
    waiting: Count = None  # how many branches are on the stack
    stack: Any = None
    truncated: Number = None  # `deterministic`: light that was dropped
    # --- dispersion
    wavelength_count: Number = None  # wavelengths that the path carries: all, or one after a dispersive boundary
    # --- absorption
    sigma: Spectrum = None  # of the medium that the ray is in
    skipped: Number = None  # distance from the last vertex to the origin of the ray, which is beside the surface


@functools.cache
def branch_type(v: Variant, dispersion: bool, absorption: bool) -> type:
    """The type of what is on the stack: of a branch, the part of `LoopState` that it has to itself."""
    branch = {"o": v.Point3f, "d": v.Vector3f, "throughput": v.Spectrum, "depth": v.UInt32, "eta": v.Float}
    branch |= {"share": v.Float, "node": v.UInt32}
    branch |= {"wavelength_count": v.Float} if dispersion else {}
    branch |= {"sigma": v.UnpolarizedSpectrum, "skipped": v.Float} if absorption else {}
    return make_dataclass("Branch", branch.items())


class ScalarStack:
    """`dr.alloc_local` for scalar variants, which have no local memory."""

    def __init__(self) -> None:
        """An empty stack."""
        self.branches: list[Any] = []

    def write(self, branch: Any, index: int, active: bool) -> None:
        """Put `branch` at `index`; entries above it are lost."""
        self.branches[index:] = [branch]

    def read(self, index: int, active: bool) -> Any:
        """The branch at `index`."""
        return self.branches[index]


def power_heuristic(a: Number, b: Number) -> Number:
    """The weight a²/(a² + b²) of a sample whose technique has density `a`, where another has `b`; 0 if both are 0.

    Source: Veach 1997, section 9.2.4, β = 2.
    """
    a, b = dr.square(a), dr.square(b)
    some = (a + b > 0) & dr.isfinite(a)
    return dr.select(some, a / dr.select(some, a + b, 1), 0)


def at_fixed_direction(
    v: Variant, context: Any, si: Interaction, bsdf: BSDF, bs: BSDFSample, weight: Spectrum, d: Vector3, active: Mask,
    own_odds: Mask,
) -> tuple[Spectrum, Vector3, Number]:  # fmt: skip
    """Weight, world direction and density of a sample, as they are differentiated.

    The direction of a delta lobe moves with the parameters; its probability p is not differentiated: of its weight f/p
    it is f'/p. Any other direction is a fixed point of the integrand: d/dx ∫ f dω = ∫ f'(ω)/p(ω) p(ω) dω, in which
    neither ω nor p is differentiated. `own_odds`: where the BSDF's weight of a delta lobe is so already, though p is
    differentiated.
    """
    if dr.grad_enabled(bs.pdf):
        odds = dr.select(active & (bs.pdf > 0) & (own_odds ^ True), bs.pdf, 1)
        weight = weight * (odds / dr.detach(odds))
    smooth = active & mi.has_flag(bs.sampled_type, LOBES.Smooth)
    wo = si.to_local(dr.detach(d))
    value, pdf = bsdf.eval_pdf(context, si, wo, smooth)
    if v.is_polarized:
        value = si.to_world_mueller(value, -wo, si.wi)
    smooth &= pdf > 0
    value = value / dr.detach(dr.select(smooth, pdf, 1))
    return dr.select(smooth, value, weight), dr.select(smooth, dr.detach(d), d), dr.select(smooth, pdf, bs.pdf)


def has_own_odds(bsdf: BSDF) -> bool:
    """Whether a mask whose opacity may have a derivative is within a BSDF; see `at_fixed_direction`."""
    masks = [inner for inner in nested(bsdf) if bsdf_name(inner) == "MaskBSDF"]
    textures = (child for mask in masks for child in children(mask) if hasattr(child, "is_spatially_varying"))
    opacities = (value for mask in masks for key, value in mi.traverse(mask) if key.startswith("opacity"))
    return any(texture.is_spatially_varying() for texture in textures) or any(map(dr.grad_enabled, opacities))


class PathLoop:
    """The loop over the vertices of a path, and of all that it splits into."""

    def __init__(
        self,
        v: Variant,
        scene: Scene,
        features: PathFeatures,
        numbers: SceneSampler | KeyedMultijitter,
        media: MediumTracker | ShapeMedia | None = None,
    ) -> None:
        """`v`: the variant's module. `numbers`: those of all paths. `media`: needed where `features.absorption`."""
        self.v, self.scene, self.features, self.numbers = v, scene, features, numbers
        self.media: Any = media
        self.vectorised, self.context = dr.is_jit_v(v.Float), followed_context()
        self.emitters = (NonConstantEmitters if features.lamps_only else SceneEmitters)(v, scene)
        self.ray_flags = +(mi.RayFlags.All if features.all_of_hit else mi.RayFlags.ShadingFrame)
        # Derivatives need loops that are evaluated. The kernels of their reverse sweep may run after the scene is gone,
        # so they must not trace rays: what a ray meets is evaluated at once.
        self.evaluated = self.vectorised and not dr.flag(dr.JitFlag.SymbolicLoops)
        self.branch = branch_type(v, features.dispersion, features.absorption)
        self.boundaries = self.ranges(lambda bsdf: bsdf_name(bsdf) in BOUNDARIES) if features.split_depth else []
        self.own_odds = self.ranges(has_own_odds) if self.evaluated else []

    def refuse(self) -> None:
        """ValueError where the absorption that the paths met was contradictory."""
        if isinstance(self.media, MediumTracker):
            self.media.crossings.refuse()

    def run(self, ray: Ray, sampler: Sampler, active: Mask, sigma: Spectrum = 0, way: Number = 0) -> LoopState:
        """Follow `ray` and everything that it splits into. `result` of the state at the end is the radiance.

        `sigma`: absorption at the camera. `way`: from there to the origin of the ray.
        """
        v, features, skipped = self.v, self.features, way

        # ---------------------- Hide area emitters ----------------------
        if features.hide_emitters and features.area:
            camera, ray = ray, self.past_emitters(ray, active)
            skipped += dr.dot(ray.o - camera.o, ray.d)

        # --------------------- Configure loop state ----------------------
        valid_ray = v.Bool(features.environment and not features.hide_emitters)
        s = LoopState(ray, v.Spectrum(1), v.Spectrum(0), v.UInt32(0), active, valid_ray, sampler, v.Float(1))
        if features.environment_after_loop:
            s.escaped = v.Bool(False)
        if features.emitter_sampling:
            s.prev_si, s.prev_bsdf_pdf, s.prev_bsdf_delta = dr.zeros(v.Interaction3f), v.Float(1), v.Bool(True)
        if features.caustics_apart:
            s.surface_first = v.Bool(False)
        if features.split_depth:
            s.share, s.node, s.waiting, s.specular_so_far = v.Float(1), v.UInt32(1), v.UInt32(0), v.Bool(True)
            s.stack = dr.alloc_local(self.branch, features.split_depth) if self.vectorised else ScalarStack()
        if features.deterministic:
            s.truncated = v.Float(0)
        if features.dispersion:
            s.wavelength_count = v.Float(dr.size_v(v.UnpolarizedSpectrum))
        if features.absorption:
            s.sigma, s.skipped = v.UnpolarizedSpectrum(sigma), v.Float(skipped)

        (s,) = dr.while_loop((s,), lambda s: s.active, self._vertex, label="refract_path")

        # ------------------ Environment, after the loop ------------------
        if features.environment_after_loop:
            si = dr.zeros(v.SurfaceInteraction3f)
            si.t, si.time, si.wavelengths, si.wi = dr.inf, s.ray.time, s.ray.wavelengths, -s.ray.d
            radiance = self._emitted(s, si, self.scene.environment(), s.escaped)
            s.result += dr.select(s.escaped, self.times(s.throughput, radiance), 0)
        return s

    def past_emitters(self, ray: Ray, active: Mask) -> Ray:
        """The ray from behind the area lights that it meets first."""

        def step(ray: Ray, active: Mask) -> tuple[Ray, Mask]:
            si = self.scene.ray_intersect(ray, +mi.RayFlags.Minimal, True, active)
            if self.vectorised or si.is_valid():
                active = active & si.is_valid() & operator.ne(si.shape.emitter(), None)
            else:
                active = False
            ray.o = dr.select(active, si.spawn_ray(ray.d).o, ray.o)
            return ray, active

        return dr.while_loop((self.v.Ray3f(ray), active), lambda _, active: active, step)[0]

    def _vertex(self, s: LoopState) -> tuple[LoopState]:
        """One iteration: from a ray to the vertex that it meets, and on to the next ray."""
        v, scene, features = self.v, self.scene, self.features

        # ---------------------- Surface interaction ----------------------
        if self.evaluated:
            pi = scene.ray_intersect_preliminary(s.ray, s.depth == 0, s.active)
            dr.eval(pi)
            si = pi.compute_surface_interaction(s.ray, self.ray_flags, s.active)
        else:
            si = scene.ray_intersect(s.ray, self.ray_flags, s.depth == 0)
        hit = si.is_valid()
        if features.absorption:
            s.throughput = self.attenuated(s.throughput, s.sigma, si.t + s.skipped)

        # ---------------------- Direct emission ----------------------
        emitter: Emitter = None
        met = hit
        if features.environment_after_loop:
            s.escaped = hit ^ True
        if features.environment and not features.environment_after_loop:
            emitter, met = si.emitter(scene), v.Bool(True)
        elif features.area and (self.vectorised or hit):
            emitter = si.shape.emitter()
        if emitter is not None:
            s.result += self.times(s.throughput, self._emitted(s, si, emitter, met))

        # Should we continue tracing to reach one more vertex?
        active_next = hit & (s.depth + 1 < features.max_depth)
        if features.deterministic:
            self._truncate(s, hit & (active_next ^ True), s.throughput, s.eta)
        # Where the last vertex is transparent the pixel is: `path` samples the BSDF there, too.
        if not (self.vectorised or active_next or (hit and features.null)):
            s.valid_ray = s.valid_ray or hit
            s.active = self._pop(s, active_next) if features.split_depth else active_next
            return (s,)
        bsdf = si.bsdf()
        # Random numbers of split paths are those of their vertex in the tree.
        key = (s.node * 0x9E3779B9 + s.depth) * 4 if features.split_depth else 0

        # ---------------------- Emitter sampling ----------------------
        active_em = active_next & mi.has_flag(bsdf.flags(), LOBES.Smooth) if features.emitter_sampling else False
        if features.emitter_sampling and (self.vectorised or active_em):
            ds, emitter_weight = self.emitters.sample(si, self.numbers.next_2d(s.sampler, key), active_em)
            wo = si.to_local(ds.d)
            bsdf_value, bsdf_pdf = bsdf.eval_pdf(self.context, si, wo, active_em)
            active_em &= ds.pdf != 0
            if not dr.grad_enabled(bsdf_value):  # a value of 0 needs no shadow ray, but may have a derivative
                active_em &= dr.max(dr.abs(v.unpolarized_spectrum(bsdf_value))) > 0
            active_em = active_em & (scene.ray_test(si.spawn_ray_to(ds.p), active_em) ^ True)
            if self.evaluated:
                dr.eval(active_em)
            if v.is_polarized:
                bsdf_value = si.to_world_mueller(bsdf_value, -wo, si.wi)
            if features.absorption:
                endless = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
                emitter_weight = self.attenuated(emitter_weight, s.sigma, dr.select(endless, dr.inf, ds.dist))
            contribution = self.times(self.times(s.throughput, bsdf_value), emitter_weight)
            contribution *= dr.select(ds.delta, 1, power_heuristic(ds.pdf, bsdf_pdf))
            s.result = dr.select(active_em, s.result + contribution, s.result)

        # ---------------------- BSDF sampling ----------------------
        sample_1 = self.numbers.next_1d(s.sampler, key + 1) if features.first_number else None
        sample_2 = self.numbers.next_2d(s.sampler, key + 2) if features.second_number else v.Point2f(0.5)
        sample_1 = sample_2.x if sample_1 is None else sample_1
        active_bsdf = hit if features.null else active_next
        bsdf_sample, bsdf_weight = bsdf.sample(self.context, si, sample_1, sample_2, active_bsdf)
        ray, throughput, optional = self._next(s, si, bsdf, bsdf_sample, bsdf_weight, active_next)

        # ---- Update loop variables based on current interaction -----
        s.valid_ray = s.valid_ray | (hit & (mi.has_flag(bsdf_sample.sampled_type, LOBES.Null) ^ True))
        s.depth = s.depth + 1
        if features.split_depth:
            throughput = self._split(s, si, bsdf, bsdf_sample, sample_2, throughput, active_next)
        s.eta = s.eta * bsdf_sample.eta
        for name, value in optional.items():
            setattr(s, name, dr.select(hit, value, getattr(s, name)))
        # A ray that has left the scene is kept for the environment.
        s.ray, s.throughput = dr.select(hit, ray, s.ray), dr.select(hit, throughput, s.throughput)
        if features.emitter_sampling:
            s.prev_si = dr.select(hit, v.Interaction3f(si), s.prev_si)
            s.prev_bsdf_pdf = dr.select(hit, bsdf_sample.pdf, s.prev_bsdf_pdf)
            s.prev_bsdf_delta = dr.select(hit, mi.has_flag(bsdf_sample.sampled_type, LOBES.Delta), s.prev_bsdf_delta)
        if features.caustics_apart:
            first = s.depth == 1
            s.surface_first = dr.select(
                first, mi.has_flag(bsdf_sample.sampled_type, LOBES.Delta) ^ True, s.surface_first
            )

        # ---------------------- Stopping criterion ----------------------
        throughput_max = dr.max(v.unpolarized_spectrum(s.throughput))
        differentiated = dr.grad_enabled(s.throughput)
        if not differentiated:  # a throughput of 0 may have a derivative
            active_next = active_next & (throughput_max != 0)
        if features.roulette:
            # A branch must not be ended because it is one of several: its probability is that of an unsplit path.
            unsplit = throughput_max / s.share if features.split_depth else throughput_max
            rr_prob = dr.detach(dr.minimum(unsplit * dr.square(s.eta), 0.95))
            if differentiated:
                rr_prob = dr.select(rr_prob > 0, rr_prob, 0.5)
            rr_active = active_next & (s.depth >= features.rr_depth)
            rr_end = rr_active & (self.numbers.next_1d(s.sampler, key + 3) >= rr_prob)
            s.throughput = dr.select(rr_active, s.throughput * dr.rcp(rr_prob), s.throughput)
            active_next = active_next & (rr_end ^ True)

        s.active = self._pop(s, active_next) if features.split_depth else active_next
        return (s,)

    def spawn_ray(self, si: Interaction, bs: BSDFSample) -> Ray:
        """The ray in the direction of a BSDF sample."""
        delta = mi.has_flag(bs.sampled_type, LOBES.Delta) if self.features.second_number else True
        return ray_origins.spawn_ray(self.v, si, si.to_world(bs.wo), self.features.delta_extent, delta)

    def _next(
        self, s: LoopState, si: Interaction, bsdf: BSDF, bs: BSDFSample, weight: Spectrum, active: Mask
    ) -> tuple[Ray, Spectrum, dict[str, Any]]:
        """The ray after a sample of the BSDF, its throughput, and the state of optional parts that it changes."""
        v = self.v
        if v.is_polarized:
            weight = si.to_world_mueller(weight, -bs.wo, si.wi)
        ray = self.spawn_ray(si, bs)
        if dr.grad_enabled(weight, ray.d):
            own_odds = self.is_of(self.own_odds, bsdf)
            weight, ray.d, bs.pdf = at_fixed_direction(v, self.context, si, bsdf, bs, weight, ray.d, active, own_odds)
        throughput, optional = self.times(s.throughput, weight), dict[str, Any]()
        if self.features.dispersion:
            # The first wavelength stands for all that end here; each is the first equally often.
            dispersed = (bs.sampled_type & DISPERSED) != 0
            throughput = throughput * dr.select(dispersed, s.wavelength_count, 1)
            optional["wavelength_count"] = dr.select(dispersed, 1, s.wavelength_count)
        if self.features.absorption:
            optional["sigma"] = self.media.cross(s.sigma, s.depth, si, bs, bsdf, ray, active)
            optional["skipped"] = dr.dot(ray.o - si.p, ray.d)
        return ray, throughput, optional

    def _emitted(self, s: LoopState, si: Interaction, emitter: Emitter, active: Mask) -> Spectrum:
        """The radiance of an emitter that the ray has met, with its weight beside emitter sampling."""
        radiance = emitter.eval(si, active)
        if not self.features.emitter_sampling:
            return radiance
        if self.features.caustics_apart:
            radiance = dr.select(si.is_valid() & s.surface_first & s.prev_bsdf_delta, 0, radiance)
        ds = self.v.DirectionSample3f(self.scene, si, s.prev_si)
        pdf = self.emitters.pdf(s.prev_si, ds, active & (s.prev_bsdf_delta ^ True))
        return radiance * dr.select(s.prev_bsdf_delta, 1, power_heuristic(s.prev_bsdf_pdf, pdf))

    def times(self, a: Spectrum, b: Spectrum) -> Spectrum:
        """The product of two spectra, or of Mueller matrices."""
        return a @ b if self.v.is_polarized else a * b

    def attenuated(self, light: Spectrum, sigma: Spectrum, length: Number) -> Spectrum:
        """Light after a distance in an absorbing medium."""
        share = absorbed(sigma, length)
        return self.times(light, self.v.mueller.absorber(share) if self.v.is_polarized else share)

    # Splitting -----------------------------------------------------------------------------------------------------

    def _split(
        self, s: LoopState, si: Interaction, bsdf: BSDF, bs: BSDFSample, sample_2: Point2, throughput: Spectrum,
        active: Mask,
    ) -> Spectrum:  # fmt: skip
        """Push the lobe that was not sampled where both are worth following; the throughput of the other one."""
        features, p = self.features, dr.detach(bs.pdf)
        boundary = active & s.specular_so_far & self._is_boundary(bsdf)
        s.specular_so_far = s.specular_so_far & mi.has_flag(bs.sampled_type, LOBES.Delta)
        both = boundary & (s.depth <= features.split_depth) & (s.share * dr.minimum(p, 1 - p) > features.split_weight)
        asked = boundary if features.deterministic else both
        if self.vectorised or asked:
            reflected = mi.has_flag(bs.sampled_type, LOBES.DeltaReflection)
            other, weight = bsdf.sample(self.context, si, dr.select(reflected, LAST, FIRST), sample_2, asked)
            asked = asked & (other.sampled_type != bs.sampled_type)
            both = both & asked
            ray, other_throughput, optional = self._next(s, si, bsdf, other, weight * other.pdf, asked)
            if features.deterministic:
                # The sample 1/2 has selected the stronger lobe; where it alone is followed the other one is dropped.
                self._truncate(s, asked & (both ^ True), other_throughput, s.eta * other.eta)
        if self.vectorised or both:
            # The lobe that was sampled has the odd number.
            branch = self.branch(
                ray.o, ray.d, other_throughput, s.depth, s.eta * other.eta, s.share * dr.detach(other.pdf), 2 * s.node,
                **optional,
            )  # fmt: skip
            # The index of an idle lane must be in range as well: local memory is accessed there.
            s.stack.write(branch, dr.select(both, s.waiting, 0), both)
            s.waiting = dr.select(both, s.waiting + 1, s.waiting)
            s.node = dr.select(both, 2 * s.node + 1, s.node)
            s.share = dr.select(both, s.share * dr.detach(bs.pdf), s.share)
        both = boundary if features.deterministic else both
        return dr.select(both, throughput * bs.pdf, throughput)

    def _pop(self, s: LoopState, active_next: Mask) -> Mask:
        """Where a path has ended, go on with the branch that was pushed last."""
        popped = (active_next ^ True) & (s.waiting > 0)
        if not self.vectorised and not popped:
            return active_next
        s.waiting = dr.select(popped, s.waiting - 1, s.waiting)
        branch = s.stack.read(dr.select(popped, s.waiting, 0), popped)
        s.ray.o, s.ray.d = dr.select(popped, branch.o, s.ray.o), dr.select(popped, branch.d, s.ray.d)
        for name in self.branch.__annotations__.keys() - {"o", "d"}:
            setattr(s, name, dr.select(popped, getattr(branch, name), getattr(s, name)))
        if self.features.emitter_sampling:
            s.prev_bsdf_pdf, s.prev_bsdf_delta = dr.select(popped, 1, s.prev_bsdf_pdf), s.prev_bsdf_delta | popped
        s.specular_so_far = s.specular_so_far | popped
        return active_next | popped

    def _truncate(self, s: LoopState, where: Mask, throughput: Spectrum, eta: Number) -> None:
        # η²: radiance that was lost where the path entered a denser medium is regained where it leaves.
        lost = dr.max(self.v.unpolarized_spectrum(throughput)) * dr.square(eta)
        s.truncated = dr.select(where, s.truncated + lost, s.truncated)

    def ranges(self, wanted: Callable[[BSDF], bool]) -> list[tuple[Count, Count]]:
        """The numbers of the shapes' BSDFs that are wanted, as ranges: first, and one after the last.

        Mitsuba numbers BSDFs as they are loaded. Opaque: another scene is other data, not another kernel.
        """
        if not self.vectorised:
            return []
        v, ranges = self.v, list[list[int]]()
        bsdfs = [bsdf for shape in all_shapes(self.scene) if (bsdf := shape.bsdf()) and wanted(bsdf)]
        for number in sorted({plugin_number(v, v.BSDFPtr(bsdf)) for bsdf in bsdfs}):
            if ranges and ranges[-1][1] == number:
                ranges[-1][1] += 1
            else:
                ranges.append([number, number + 1])
        return [(dr.opaque(v.UInt32, first), dr.opaque(v.UInt32, last)) for first, last in ranges]

    def is_of(self, ranges: list[tuple[Count, Count]], bsdf: BSDF) -> Mask:
        """Whether the number of a BSDF is in one of the ranges."""
        number, inside = dr.reinterpret_array(self.v.UInt32, bsdf), self.v.Bool(False)
        for first, last in ranges:
            inside |= (number >= first) & (number < last)
        return inside

    def _is_boundary(self, bsdf: BSDF) -> Mask:
        """Whether a BSDF is known to have one reflected and one refracted direction, and no others."""
        if not self.vectorised:
            return bsdf_name(bsdf) in BOUNDARIES
        return self.is_of(self.boundaries, bsdf)

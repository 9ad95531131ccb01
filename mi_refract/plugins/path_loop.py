"""The path loop of `refract_path`. It follows Mitsuba's `path` and `prb_basic`, and has three optional parts.

Each part, and each section of the loop, is traced only if `PathFeatures` contains it:

- *absorption*: along each ray the throughput is multiplied by exp(−σ t) of the medium that the ray is in.
- *dispersion*: if the direction depends on the wavelength, only the first wavelength continues. Its throughput is
  multiplied by the number of wavelengths that the path had.
- *splitting*: at a boundary both lobes are followed, depth first. One lobe continues at once, the other one is pushed
  on a stack. When a path ends, the last branch is popped. So the stack of a lane has at most `split_depth` entries,
  however many paths the lane follows.

In scalar variants a pointer may be None, which needs an `if`; in vectorised variants lanes are masked.
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
from .sampling import GOLDEN, ONE, KeyedMultijitter, NonConstantEmitters, SceneEmitters, SceneSampler
from .scene_features import BOUNDARIES, all_shapes, bsdf_name, children, may_vary, nested, plugin_number

# These values of `sample1` select the first and the last lobe of a boundary. A less probable lobe is not followed.
FIRST, LAST = 2.0**-25, ONE
LOBES = mi.BSDFFlags


@dataclass(frozen=True)
class PathFeatures:
    """The features that the loop traces: those that the scene needs and the integrator's parameters allow."""

    max_depth: int
    rr_depth: int
    hide_emitters: bool
    split_depth: int
    split_weight: float
    deterministic: bool
    emitter_sampling: bool
    lamps_only: bool  # emitter sampling excludes the environment, which is constant
    lamps_at_infinity: bool  # some emitter that is sampled has no position
    area: bool  # some shape emits
    environment: bool  # an environment emitter exists
    first_number: bool  # BSDF sampling uses `sample1`
    second_number: bool  # BSDF sampling uses `sample2`, two numbers; delta lobes do not
    all_of_hit: bool  # BSDFs use more of an interaction than its shading frame
    dispersion: bool  # the refraction of some boundary depends on the wavelength
    absorption: bool  # some medium absorbs
    null: bool  # a BSDF may have a null lobe
    lamps_traced: bool = False  # `lamp_tracing` renders caustics of lamps of zero size, at least
    caustics_apart: bool = False  # and of area lamps, so this loop skips them
    delta_extent: float = math.inf  # extent of the largest shape with delta lobes; see `ray_origins`

    @property
    def roulette(self) -> bool:
        """Whether Russian roulette may end a path."""
        return self.rr_depth < self.max_depth and not self.deterministic

    @property
    def environment_after_loop(self) -> bool:
        """Whether the environment is evaluated once, after the loop: possible if a lane has one path only."""
        return self.environment and not self.split_depth


@dataclass
class LoopState:
    """The loop state of a lane; fields of optional parts are None if the features do not contain the part."""

    ray: Ray
    throughput: Spectrum
    result: Spectrum  # radiance accumulated so far
    depth: Count  # depth of the current vertex
    active: Mask
    valid_ray: Mask  # the alpha of the sample
    sampler: Sampler
    eta: Number  # product of the relative indices along the path
    escaped: Mask = None  # the ray has left the scene
    # --- emitter sampling: the previous vertex, the density of its BSDF sample, and whether that is of a delta lobe
    prev_si: Interaction = None
    prev_bsdf_pdf: Number = None
    prev_bsdf_delta: Mask = None
    # --- caustics apart
    surface_first: Mask = None  # the lobe at the first vertex was not a delta lobe
    # --- splitting
    specular_so_far: Mask = None  # all lobes since the camera were delta lobes; only such paths split
    share: Number = None  # product of the probabilities of the lobes at which the path was split
    node: Count = None  # number of this branch in the tree: 2 n and 2 n + 1 are the branches of n
    waiting: Count = None  # number of branches on the stack
    stack: Any = None
    truncated: Number = None  # `deterministic`: throughput of the dropped branches
    # --- dispersion
    wavelength_count: Number = None  # wavelengths of the path: all, or one after a dispersive boundary
    # --- absorption
    sigma: Spectrum = None  # σ of the medium that the ray is in
    skipped: Number = None  # distance from the previous vertex to the origin of the ray


@functools.cache
def branch_type(v: Variant, dispersion: bool, absorption: bool) -> type:
    """Return the type of a stack entry: the fields of `LoopState` that a branch does not share."""
    branch = {"o": v.Point3f, "d": v.Vector3f, "throughput": v.Spectrum, "depth": v.UInt32, "eta": v.Float}
    branch |= {"share": v.Float, "node": v.UInt32}
    branch |= {"wavelength_count": v.Float} if dispersion else {}
    branch |= {"sigma": v.UnpolarizedSpectrum, "skipped": v.Float} if absorption else {}
    return make_dataclass("Branch", branch.items())


class ScalarStack:
    """A replacement of `dr.alloc_local` for scalar variants, which have no local memory."""

    def __init__(self) -> None:
        """An empty stack."""
        self.branches: list[Any] = []

    def write(self, branch: Any, index: int, active: bool) -> None:
        """Write `branch` at `index`, and drop the entries above it."""
        self.branches[index:] = [branch]

    def read(self, index: int, active: bool) -> Any:
        """Return the branch at `index`."""
        return self.branches[index]


def power_heuristic(a: Number, b: Number) -> Number:
    """Return the weight a²/(a² + b²) of a sample of a technique with the density `a`; the other technique has `b`.

    The weight is 0 if both are 0, and if a² is infinite. Source: Veach 1997, section 9.2.4, β = 2.
    """
    a, b = dr.square(a), dr.square(b)
    valid = (a + b > 0) & dr.isfinite(a)
    return dr.select(valid, a / dr.select(valid, a + b, 1), 0)


def at_fixed_direction(
    v: Variant, context: Any, si: Interaction, bsdf: BSDF, bs: BSDFSample, weight: Spectrum, d: Vector3, active: Mask,
    own_odds: Mask, masked: Mask,
) -> tuple[Spectrum, Vector3, Number]:  # fmt: skip
    """Return weight, world direction and density of a BSDF sample, with the derivatives that an estimator needs.

    The direction of a delta lobe moves with the parameters, but its probability p must be detached: the derivative of
    the weight f/p is f'/p. The direction ω of any other lobe is detached: d/dx ∫ f dω = ∫ f'(ω)/p(ω) p(ω) dω, where
    ω and p are not differentiated. `own_odds`: lanes in which the BSDF's weight of a delta lobe has the derivative f'/p
    already, although p is attached. `masked`: lanes of `is_opaque_mask`, in which this is so for the factor of p that
    the opacity is.
    """
    if dr.grad_enabled(bs.pdf):
        opacity = 1 - v.unpolarized_spectrum(bsdf.eval_null_transmission(si, masked))[0]
        opacity = dr.select(masked & (opacity > 0), opacity, 1)  # of 0 only the null lobe is sampled
        nested_odds = dr.select(mi.has_flag(bs.sampled_type, LOBES.Null), 1, bs.pdf / opacity)
        odds = dr.select(active & (bs.pdf > 0) & (own_odds ^ True), dr.select(masked, nested_odds, bs.pdf), 1)
        weight = weight * (odds / dr.detach(odds))
    smooth = active & mi.has_flag(bs.sampled_type, LOBES.Smooth)
    wo = si.to_local(dr.detach(d))
    value, pdf = bsdf.eval_pdf(context, si, wo, smooth)
    if v.is_polarized:
        value = si.to_world_mueller(value, -wo, si.wi)
    # A sample along the surface has the density 0, but after rounding it may be above the surface.
    smooth &= (bs.pdf > 0) & (pdf > 0)
    value = value / dr.detach(dr.select(smooth, pdf, 1))
    return dr.select(smooth, value, weight), dr.select(smooth, dr.detach(d), d), dr.select(smooth, pdf, bs.pdf)


def is_opaque_mask(bsdf: BSDF) -> bool:
    """Whether a BSDF is a `mask` around one without a null lobe: then 1 − `eval_null_transmission` is its opacity."""
    _, *inner = nested(bsdf)
    return bsdf_name(bsdf) == "MaskBSDF" and not any(x.flags() & +LOBES.Null for x in inner)


def has_own_odds(bsdf: BSDF) -> bool:
    """Whether a BSDF hides a `mask` whose opacity may be differentiated; see `at_fixed_direction`."""
    if is_opaque_mask(bsdf):
        return False
    masks = [inner for inner in nested(bsdf) if bsdf_name(inner) == "MaskBSDF"]
    textures = (child for mask in masks for child in children(mask) if hasattr(child, "is_spatially_varying"))
    opacities = (value for mask in masks for key, value in mi.traverse(mask) if key.startswith("opacity"))
    return any(map(may_vary, textures)) or any(map(dr.grad_enabled, opacities))


class PathLoop:
    """The loop over the vertices of a path, and of all paths that it splits into."""

    def __init__(
        self,
        v: Variant,
        scene: Scene,
        features: PathFeatures,
        numbers: SceneSampler | KeyedMultijitter,
        media: MediumTracker | ShapeMedia | None = None,
    ) -> None:
        """`v`: the variant's module. `numbers`: random numbers. `media`: required if `features.absorption`."""
        self.v, self.scene, self.features, self.numbers = v, scene, features, numbers
        self.media: Any = media
        self.vectorised, self.context = dr.is_jit_v(v.Float), followed_context()
        self.emitters = (NonConstantEmitters if features.lamps_only else SceneEmitters)(v, scene)
        self.ray_flags = +(mi.RayFlags.All if features.all_of_hit else mi.RayFlags.ShadingFrame)
        # Derivatives need evaluated loops. The kernels of the reverse sweep may run after the scene was freed, so they
        # must not trace rays: intersections are evaluated at once.
        self.evaluated = self.vectorised and not dr.flag(dr.JitFlag.SymbolicLoops)
        self.lamp_extent = math.inf
        if features.hide_emitters and features.area:
            lamps = [shape for shape in all_shapes(scene) if shape.is_emitter()]
            self.lamp_extent = ray_origins.extent_of([ray_origins.size_of(shape) for shape in lamps])
        self.branch = branch_type(v, features.dispersion, features.absorption)
        self.boundaries = self.ranges(lambda bsdf: bsdf_name(bsdf) in BOUNDARIES) if features.split_depth else []
        self.own_odds = self.ranges(has_own_odds) if self.evaluated else []
        self.masks = self.ranges(is_opaque_mask) if self.evaluated else []

    def refuse(self) -> None:
        """ValueError if the absorption along the paths was inconsistent; see `Crossings.refuse`."""
        if isinstance(self.media, MediumTracker):
            self.media.crossings.refuse()

    def run(self, ray: Ray, sampler: Sampler, active: Mask, sigma: Spectrum = 0, distance: Number = 0) -> LoopState:
        """Follow `ray` and all paths that it splits into. Return the final state; its `result` is the radiance.

        `sigma`: σ at the camera. `distance`: from the camera to the origin of the ray.
        """
        v, features, skipped = self.v, self.features, distance

        # ---------------------- Hide area emitters ----------------------
        if features.hide_emitters and features.area:
            camera_ray, ray = ray, self.past_emitters(ray, active)
            skipped += dr.dot(ray.o - camera_ray.o, ray.d)

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
        """Return the ray beyond the area lights that it hits first."""

        def step(ray: Ray, active: Mask) -> tuple[Ray, Mask]:
            si = self.scene.ray_intersect(ray, +mi.RayFlags.Minimal, True, active)
            if self.vectorised or si.is_valid():
                active = active & si.is_valid() & operator.ne(si.shape.emitter(), None)
            else:
                active = False
            near = ray_origins.spawn_ray(self.v, si, ray.d, self.lamp_extent, True).o
            beyond = dr.select(si.t > 0, near, si.spawn_ray(ray.d).o)  # farther if the last step had no effect
            ray.o = dr.select(active, beyond, ray.o)
            return ray, active

        return dr.while_loop((self.v.Ray3f(ray), active), lambda _, active: active, step)[0]

    def _vertex(self, s: LoopState) -> tuple[LoopState]:
        """Run one iteration: intersect the ray, process the vertex, and sample the next ray."""
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
        active_emitter = hit
        if features.environment_after_loop:
            s.escaped = hit ^ True
        if features.environment and not features.environment_after_loop:
            emitter, active_emitter = si.emitter(scene), v.Bool(True)
        elif features.area and (self.vectorised or hit):
            emitter = si.shape.emitter()
        if emitter is not None:
            s.result += self.times(s.throughput, self._emitted(s, si, emitter, active_emitter))

        # Should we continue tracing to reach one more vertex?
        active_next = hit & (s.depth + 1 < features.max_depth)
        if features.deterministic:
            self._truncate(s, hit & (active_next ^ True), s.throughput, s.eta)
        # If the last vertex is transparent, the pixel is: like `path`, sample the BSDF there, too.
        if not (self.vectorised or active_next or (hit and features.null)):
            s.valid_ray = s.valid_ray or hit
            s.active = self._pop(s, active_next) if features.split_depth else active_next
            return (s,)
        bsdf = si.bsdf()
        # Keyed random numbers depend on the vertex: its depth, and in a split path its place in the tree.
        key = (s.node * GOLDEN + s.depth if features.split_depth else s.depth) * 4

        # ---------------------- Emitter sampling ----------------------
        active_em = active_next & mi.has_flag(bsdf.flags(), LOBES.Smooth) if features.emitter_sampling else False
        if features.emitter_sampling and (self.vectorised or active_em):
            ds, emitter_weight = self.emitters.sample(si, self.numbers.next_2d(s.sampler, key), active_em)
            wo = si.to_local(ds.d)
            bsdf_value, bsdf_pdf = bsdf.eval_pdf(self.context, si, wo, active_em)
            active_em &= ds.pdf != 0
            if not dr.grad_enabled(bsdf_value):  # a value of 0 needs a shadow ray only for its derivative
                active_em &= dr.max(dr.abs(v.unpolarized_spectrum(bsdf_value))) > 0
            shadow_ray = ray_origins.ray_to(v, si, ds.p, features.delta_extent)
            shadow_ray.maxt *= 1 - v.math.ShadowEpsilon
            # In scalar variants a `directionalarea`, which has no samples, leaves no emitter.
            if at_infinity := features.lamps_at_infinity and (self.vectorised or bool(ds.emitter)):
                # Mitsuba places such a light beyond the scene's bounding box, in which merged rectangles are missing,
                # and later edits, too. So these shadow rays have no end.
                at_infinity = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
                endless = ray_origins.spawn_ray(v, si, ds.d, features.delta_extent, False)
                shadow_ray = dr.select(at_infinity, endless, shadow_ray)
            active_em = active_em & (scene.ray_test(shadow_ray, active_em) ^ True)
            if self.evaluated:
                dr.eval(active_em)
            if v.is_polarized:
                bsdf_value = si.to_world_mueller(bsdf_value, -wo, si.wi)
            if features.absorption:
                way = dr.select(at_infinity, dr.inf, ds.dist)
                sigma = self.media.toward(s.sigma, si, ds.d, active_em)
                emitter_weight = self.attenuated(emitter_weight, sigma, way)
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
        # A ray that has left the scene keeps its state for the environment.
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
        if not differentiated:  # a differentiated throughput of 0 may have a derivative
            active_next = active_next & (throughput_max != 0)
        if features.roulette:
            # Roulette uses the throughput of the unsplit path, so that a branch does not end because it is one of many.
            unsplit = throughput_max / s.share if features.split_depth else throughput_max
            rr_prob = dr.detach(dr.minimum(unsplit * dr.square(s.eta), 0.95))
            if differentiated:
                rr_prob = dr.select(rr_prob > 0, rr_prob, 0.5)
            rr_active = active_next & (s.depth >= features.rr_depth)
            survives = self.numbers.next_1d(s.sampler, key + 3) < rr_prob  # false for NaN, so that its path ends
            s.throughput = dr.select(rr_active, s.throughput * dr.rcp(rr_prob), s.throughput)
            active_next = active_next & ((rr_active ^ True) | survives)

        s.active = self._pop(s, active_next) if features.split_depth else active_next
        return (s,)

    def spawn_ray(self, si: Interaction, bs: BSDFSample) -> Ray:
        """Return the ray in the direction of a BSDF sample."""
        delta = mi.has_flag(bs.sampled_type, LOBES.Delta) if self.features.second_number else True
        return ray_origins.spawn_ray(self.v, si, si.to_world(bs.wo), self.features.delta_extent, delta)

    def _next(
        self, s: LoopState, si: Interaction, bsdf: BSDF, bs: BSDFSample, weight: Spectrum, active: Mask
    ) -> tuple[Ray, Spectrum, dict[str, Any]]:
        """Return the next ray of a BSDF sample, its throughput, and new values for the state of optional parts."""
        v = self.v
        if v.is_polarized:
            weight = si.to_world_mueller(weight, -bs.wo, si.wi)
        ray = self.spawn_ray(si, bs)
        if dr.grad_enabled(weight, ray.d):
            masks = (self.is_of(ranges, bsdf) for ranges in (self.own_odds, self.masks))
            weight, ray.d, bs.pdf = at_fixed_direction(v, self.context, si, bsdf, bs, weight, ray.d, active, *masks)
        throughput, optional = self.times(s.throughput, weight), dict[str, Any]()
        if self.features.dispersion:
            # The first wavelength represents all that end here; each wavelength is the first one equally often.
            dispersed = (bs.sampled_type & DISPERSED) != 0
            throughput = throughput * dr.select(dispersed, s.wavelength_count, 1)
            optional["wavelength_count"] = dr.select(dispersed, 1, s.wavelength_count)
        if self.features.absorption:
            optional["sigma"] = self.media.cross(s.sigma, s.depth, si, bs, bsdf, ray, active)
            optional["skipped"] = dr.dot(ray.o - si.p, ray.d)
        return ray, throughput, optional

    def _emitted(self, s: LoopState, si: Interaction, emitter: Emitter, active: Mask) -> Spectrum:
        """Return the radiance of an emitter that the ray has hit, times its weight against emitter sampling."""
        radiance = emitter.eval(si, active)
        if not self.features.emitter_sampling:
            return radiance
        if self.features.caustics_apart:
            radiance = dr.select(si.is_valid() & s.surface_first & s.prev_bsdf_delta, 0, radiance)
        ds = self.v.DirectionSample3f(self.scene, si, s.prev_si)
        pdf = self.emitters.pdf(s.prev_si, ds, active & (s.prev_bsdf_delta ^ True))
        return radiance * dr.select(s.prev_bsdf_delta, 1, power_heuristic(s.prev_bsdf_pdf, pdf))

    def times(self, a: Spectrum, b: Spectrum) -> Spectrum:
        """Return the product of two spectra or Mueller matrices."""
        return a @ b if self.v.is_polarized else a * b

    def attenuated(self, light: Spectrum, sigma: Spectrum, length: Number) -> Spectrum:
        """Return `light` after a distance in an absorbing medium."""
        transmittance = absorbed(sigma, length)
        return self.times(light, self.v.mueller.absorber(transmittance) if self.v.is_polarized else transmittance)

    # Splitting -----------------------------------------------------------------------------------------------------

    def _split(
        self, s: LoopState, si: Interaction, bsdf: BSDF, bs: BSDFSample, sample_2: Point2, throughput: Spectrum,
        active: Mask,
    ) -> Spectrum:  # fmt: skip
        """Push the other lobe where the path splits; return the throughput of the sampled lobe."""
        features, p = self.features, dr.detach(bs.pdf)
        is_boundary = self.is_of(self.boundaries, bsdf) if self.vectorised else bsdf_name(bsdf) in BOUNDARIES
        at_boundary = active & s.specular_so_far & is_boundary
        s.specular_so_far = s.specular_so_far & mi.has_flag(bs.sampled_type, LOBES.Delta)
        split = at_boundary & (s.depth <= features.split_depth)
        split = split & (s.share * dr.minimum(p, 1 - p) > features.split_weight)
        active_other = at_boundary if features.deterministic else split
        if self.vectorised or active_other:
            reflected = mi.has_flag(bs.sampled_type, LOBES.DeltaReflection)
            other, weight = bsdf.sample(self.context, si, dr.select(reflected, LAST, FIRST), sample_2, active_other)
            active_other = active_other & (other.sampled_type != bs.sampled_type)
            split = split & active_other
            ray, other_throughput, optional = self._next(s, si, bsdf, other, weight * other.pdf, active_other)
            if features.deterministic:
                # sample1 = 1/2 has selected the stronger lobe. Where the path does not split, the other one is dropped.
                self._truncate(s, active_other & (split ^ True), other_throughput, s.eta * other.eta)
        if self.vectorised or split:
            # The sampled lobe has the odd number.
            branch = self.branch(
                ray.o, ray.d, other_throughput, s.depth, s.eta * other.eta, s.share * dr.detach(other.pdf), 2 * s.node,
                **optional,
            )  # fmt: skip
            # Inactive lanes access local memory as well, so their index must be in range.
            s.stack.write(branch, dr.select(split, s.waiting, 0), split)
            s.waiting = dr.select(split, s.waiting + 1, s.waiting)
            s.node = dr.select(split, 2 * s.node + 1, s.node)
            s.share = dr.select(split, s.share * dr.detach(bs.pdf), s.share)
        without_chance = at_boundary if features.deterministic else split
        return dr.select(without_chance, throughput * bs.pdf, throughput)

    def _pop(self, s: LoopState, active_next: Mask) -> Mask:
        """Continue with the branch that was pushed last where a path has ended; return the active lanes."""
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

    def _truncate(self, s: LoopState, dropped: Mask, throughput: Spectrum, eta: Number) -> None:
        """Add the throughput of the `dropped` branches to `truncated`."""
        # η²: radiance that is reduced where the path enters a denser medium is increased again where it leaves it.
        lost = dr.max(self.v.unpolarized_spectrum(throughput)) * dr.square(eta)
        s.truncated = dr.select(dropped, s.truncated + lost, s.truncated)

    def ranges(self, predicate: Callable[[BSDF], bool]) -> list[tuple[Count, Count]]:
        """Return the numbers of the shapes' BSDFs that satisfy `predicate`, as ranges: first, and one after the last.

        Mitsuba numbers BSDFs in the order of loading. The ranges are opaque, so that scenes share a kernel.
        """
        if not self.vectorised:
            return []
        v, ranges = self.v, list[list[int]]()
        bsdfs = [bsdf for shape in all_shapes(self.scene) if (bsdf := shape.bsdf()) and predicate(bsdf)]
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

"""The path loop of `refract_path`: each lane follows one path after the other, with a stack of branches for later.

A plugin belongs to one variant, so everything here is given that variant's module, `v`. Paths are followed depth first:
of a pair of delta lobes one is followed and the other pushed on the stack; where a path ends, the branch pushed last is
popped. So the stack of a lane holds at most `split_depth` branches, however many paths the lane follows.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass, make_dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .absorption import absorbed
from .emitter_sampling import NonConstantEmitters, SceneEmitters
from .integrator_context import DISPERSED, context
from .keyed_sampler import ONE
from .scene_features import BOUNDARIES, all_shapes, bsdf_name

# Samples near 0 and near 1 pick the one lobe and the other; a lobe with a smaller power than these is not followed.
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
    dispersion: bool  # some boundary bends light by its wavelength
    absorption: bool  # some medium absorbs
    null: bool  # a BSDF may have a null lobe

    @property
    def roulette(self) -> bool:
        """Whether Russian roulette may end a path."""
        return self.rr_depth < self.max_depth and not self.deterministic

    @property
    def environment_after_loop(self) -> bool:
        """Whether the environment is looked up once, after the loop: a lane has one path only."""
        return self.environment and not self.split_depth


@dataclass
class LoopState:
    """The state of a lane between vertices; None for parts that the features do not need."""

    ray: Any
    throughput: Any
    result: Any
    depth: Any
    active: Any
    valid: Any
    sampler: Any
    eta: Any
    escaped: Any = None
    previous: Any = None  # the interaction at the vertex before,
    pdf: Any = None  # the density of its BSDF sample,
    delta: Any = None  # and whether that was of a delta lobe
    specular_so_far: Any = None  # the path from the camera has had delta lobes only; after another lobe it is not split
    share: Any = None  # the share of the pixel's light: the product of the powers of the lobes that were split
    node: Any = None  # the number of this branch in the tree: 2 n and 2 n + 1 are the branches of n
    waiting: Any = None  # how many branches are on the stack
    stack: Any = None
    truncated: Any = None
    wavelength_count: Any = None  # how many wavelengths the path carries: all, or one since a dispersive boundary
    sigma: Any = None  # absorption of the medium that the path is in
    skipped: Any = None  # from the last vertex to the origin of the ray, which is beside the surface


def branch_class(v: Any, plan: PathFeatures) -> type:
    """The class of a branch on the stack: a path that goes on from a delta lobe. Local memory needs a type."""
    fields = {
        "o": v.Point3f,
        "d": v.Vector3f,
        "throughput": v.Spectrum,
        "depth": v.UInt32,
        "eta": v.Float,
        "share": v.Float,
        "node": v.UInt32,
    }
    fields |= {"wavelength_count": v.Float} if plan.dispersion else {}
    fields |= {"sigma": v.UnpolarizedSpectrum, "skipped": v.Float} if plan.absorption else {}
    return make_dataclass("Branch", fields.items())


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


def power_heuristic(a: Any, b: Any) -> Any:
    """The weight a²/(a² + b²) of a sample whose technique has density `a`, where another has `b`; 0 if both are 0.

    Source: Veach 1997, section 9.2.4, β = 2.
    """
    a, b = dr.square(a), dr.square(b)
    some = (a + b > 0) & dr.isfinite(a)
    return dr.select(some, a / dr.select(some, a + b, 1), 0)


class Trace:
    """The path loop for one call of the integrator's `sample`.

    In scalar variants a pointer may be None and needs an `if`; in the others its lanes are masked.
    """

    def __init__(self, v: Any, scene: Any, plan: PathFeatures, numbers: Any, media: Any = None) -> None:
        """`v`: the variant's module. `numbers`: `Sampled` or `KeyedMultijitter`. `media`: where there is absorption."""
        self.media = media
        self.v, self.scene, self.plan, self.numbers = v, scene, plan, numbers
        self.vectorised, self.branch = dr.is_jit_v(v.Float), branch_class(v, plan)
        self.context = context()
        self.emitters = (NonConstantEmitters if plan.lamps_only else SceneEmitters)(v, scene)
        self.flags = +(mi.RayFlags.All if plan.all_of_hit else mi.RayFlags.ShadingFrame)
        # Derivatives need loops that are evaluated. The kernels of their reverse sweep may run after the scene is gone,
        # so these must not trace rays: what rays meet is evaluated at once.
        self.evaluated = self.vectorised and not dr.flag(dr.JitFlag.SymbolicLoops)
        if plan.split_depth and self.vectorised:
            self.boundaries = self._boundaries()

    def run(self, ray: Any, sampler: Any, active: Any) -> LoopState:
        """Follow `ray` and all that it splits into; the state at the end, whose `result` is the radiance."""
        way = self.media.way if self.plan.absorption else 0
        if self.plan.hide_emitters and self.plan.area:
            camera, ray = ray, self._past_emitters(ray, active)
            way += dr.dot(ray.o - camera.o, ray.d)
        start = self._start(ray, way, sampler, active)
        (end,) = dr.while_loop((start,), lambda s: s.active, self._step, label="refract_path")
        if self.plan.environment_after_loop:
            self._add_environment(end)
        return end

    def _start(self, ray: Any, way: Any, sampler: Any, active: Any) -> LoopState:
        v, plan = self.v, self.plan
        valid = v.Bool(plan.environment and not plan.hide_emitters)
        s = LoopState(ray, v.Spectrum(1), v.Spectrum(0), v.UInt32(0), active, valid, sampler, v.Float(1))
        if plan.environment_after_loop:
            s.escaped = v.Bool(False)
        if plan.emitter_sampling:
            s.previous, s.pdf, s.delta = dr.zeros(v.Interaction3f), v.Float(1), v.Bool(True)
        if plan.split_depth:
            s.share, s.node, s.waiting, s.specular_so_far = v.Float(1), v.UInt32(1), v.UInt32(0), v.Bool(True)
            s.stack = dr.alloc_local(self.branch, plan.split_depth) if self.vectorised else ScalarStack()
        if plan.deterministic:
            s.truncated = v.Float(0)
        if plan.dispersion:
            s.wavelength_count = v.Float(dr.size_v(v.UnpolarizedSpectrum))
        if plan.absorption:
            s.sigma, s.skipped = v.UnpolarizedSpectrum(self.media.start), v.Float(way)
        return s

    def _past_emitters(self, ray: Any, active: Any) -> Any:
        """The ray from behind the area lights that it meets first."""

        def step(ray: Any, active: Any) -> tuple[Any, Any]:
            si = self.scene.ray_intersect(ray, +mi.RayFlags.Minimal, True, active)
            if self.vectorised or si.is_valid():
                active = active & si.is_valid() & operator.ne(si.shape.emitter(), None)
            else:
                active = False
            ray.o = dr.select(active, si.spawn_ray(ray.d).o, ray.o)
            return ray, active

        return dr.while_loop((self.v.Ray3f(ray), active), lambda _, active: active, step)[0]

    # One vertex ----------------------------------------------------------------------------------------------------

    def _step(self, s: LoopState) -> tuple[LoopState]:
        si = self._intersect(s)
        hit = si.is_valid()
        if self.plan.absorption:
            s.throughput = self._times(s.throughput, self._left(s.sigma, si.t + s.skipped))
        self._add_emission(s, si, hit)
        onward = hit & (s.depth + 1 < self.plan.max_depth)
        if self.plan.deterministic:
            self._truncate(s, hit & (onward ^ True), 1)
        # Where the last vertex is transparent the pixel is: `path` asks there, too.
        if self.vectorised or onward or (hit and self.plan.null):
            onward = self._scatter(s, si, si.bsdf(), hit, onward)
        else:
            s.valid = s.valid or hit
        if self.plan.split_depth:
            onward = self._pop(s, onward)
        s.active = onward
        return (s,)

    def _intersect(self, s: LoopState) -> Any:
        if not self.evaluated:
            return self.scene.ray_intersect(s.ray, self.flags, s.depth == 0)
        found = self.scene.ray_intersect_preliminary(s.ray, s.depth == 0, s.active)
        dr.eval(found)
        return found.compute_surface_interaction(s.ray, self.flags, s.active)

    def _scatter(self, s: LoopState, si: Any, bsdf: Any, hit: Any, onward: Any) -> Any:
        """Emitter sampling, the next ray, and whether there is one."""
        plan = self.plan
        key = (s.node * 0x9E3779B9 + s.depth) * 4 if plan.split_depth else 0
        if plan.emitter_sampling:
            self._add_direct(s, si, bsdf, onward, key)
        first = self.numbers.one(s.sampler, key + 1) if plan.first_number else None
        second = self.numbers.two(s.sampler, key + 2) if plan.second_number else self.v.Point2f(0.5)
        first = second.x if first is None else first
        bs, weight = bsdf.sample(self.context, si, first, second, hit if plan.null else onward)
        ray, throughput, inside = self._next(s, si, bsdf, bs, weight, onward)
        s.valid = s.valid | (hit & (mi.has_flag(bs.sampled_type, LOBES.Null) ^ True))
        s.depth = s.depth + 1
        if plan.split_depth:
            throughput = self._split(s, si, bsdf, bs, second, throughput, onward)
        s.eta = s.eta * bs.eta
        for name, value in inside.items():
            setattr(s, name, dr.select(hit, value, getattr(s, name)))
        # A ray that left the scene keeps all that the environment asks for.
        s.ray, s.throughput = dr.select(hit, ray, s.ray), dr.select(hit, throughput, s.throughput)
        if plan.emitter_sampling:
            s.previous, s.pdf = dr.select(hit, self.v.Interaction3f(si), s.previous), dr.select(hit, bs.pdf, s.pdf)
            s.delta = dr.select(hit, mi.has_flag(bs.sampled_type, LOBES.Delta), s.delta)
        return self._roulette(s, onward, key)

    def _next(self, s: LoopState, si: Any, bsdf: Any, bs: Any, weight: Any, active: Any) -> tuple[Any, Any, dict]:
        """The ray after a sample of the BSDF, its throughput, and what else of the state the sample changes."""
        if self.v.is_polarized:
            weight = si.to_world_mueller(weight, -bs.wo, si.wi)
        ray = si.spawn_ray(si.to_world(bs.wo))
        if dr.grad_enabled(weight, ray.d):
            weight, ray.d, bs.pdf = self._at_fixed_direction(si, bsdf, bs, weight, ray.d, active)
        throughput, changed = self._times(s.throughput, weight), {}
        if self.plan.dispersion:
            # The first wavelength stands for all that end here. Each is the first as often as any other.
            dispersed = (bs.sampled_type & DISPERSED) != 0
            throughput = throughput * dr.select(dispersed, s.wavelength_count, 1)
            changed["wavelength_count"] = dr.select(dispersed, 1, s.wavelength_count)
        if self.plan.absorption:
            changed["sigma"] = self.media.cross(s, si, bs, bsdf, ray, active)
            changed["skipped"] = dr.dot(ray.o - si.p, ray.d)
        return ray, throughput, changed

    def _at_fixed_direction(
        self, si: Any, bsdf: Any, bs: Any, weight: Any, d: Any, active: Any
    ) -> tuple[Any, Any, Any]:
        """Weight, direction and density of a sample, as they are differentiated.

        The direction of a delta lobe moves with the parameters. Any other is a fixed place of the integrand:
        d/dx ∫ f dω = ∫ f'(ω)/p(ω) p(ω) dω, where neither ω nor the p that it was drawn with is differentiated.
        """
        smooth = active & mi.has_flag(bs.sampled_type, LOBES.Smooth)
        wo = si.to_local(dr.detach(d))
        value, pdf = bsdf.eval_pdf(self.context, si, wo, smooth)
        if self.v.is_polarized:
            value = si.to_world_mueller(value, -wo, si.wi)
        smooth &= pdf > 0
        value = value / dr.detach(dr.select(smooth, pdf, 1))
        return dr.select(smooth, value, weight), dr.select(smooth, dr.detach(d), d), dr.select(smooth, pdf, bs.pdf)

    def _roulette(self, s: LoopState, onward: Any, key: Any) -> Any:
        brightest = dr.max(self.v.unpolarized_spectrum(s.throughput))
        differentiated = dr.grad_enabled(s.throughput)
        if not differentiated:  # a throughput of 0 may have a derivative
            onward = onward & (brightest != 0)
        if not self.plan.roulette:
            return onward
        # A branch is not to be ended for being one of several: as if there had been no split.
        whole = brightest / s.share if self.plan.split_depth else brightest
        survival = dr.detach(dr.minimum(whole * dr.square(s.eta), 0.95))
        if differentiated:
            survival = dr.select(survival > 0, survival, 0.5)
        late = onward & (s.depth >= self.plan.rr_depth)
        ends = late & (self.numbers.one(s.sampler, key + 3) >= survival)
        s.throughput = dr.select(late, s.throughput * dr.rcp(survival), s.throughput)
        return onward & (ends ^ True)

    def _times(self, a: Any, b: Any) -> Any:
        return a @ b if self.v.is_polarized else a * b

    def _left(self, sigma: Any, length: Any) -> Any:
        """What a way of this length leaves of the light."""
        share = absorbed(sigma, length)
        return self.v.mueller.absorber(share) if self.v.is_polarized else share

    # Emitters ------------------------------------------------------------------------------------------------------

    def _add_emission(self, s: LoopState, si: Any, hit: Any) -> None:
        plan = self.plan
        if plan.environment_after_loop:
            s.escaped = hit ^ True
        if plan.environment and not plan.environment_after_loop:
            emitter, met = si.emitter(self.scene), self.v.Bool(True)
        elif plan.area and (self.vectorised or hit):
            emitter, met = si.shape.emitter(), hit
        else:
            return
        if self.vectorised or emitter is not None:
            s.result += self._times(s.throughput, self._emission(s, si, emitter, met))

    def _add_environment(self, s: LoopState) -> None:
        si = dr.zeros(self.v.SurfaceInteraction3f)
        si.t, si.time, si.wavelengths, si.wi = dr.inf, s.ray.time, s.ray.wavelengths, -s.ray.d
        found = self._emission(s, si, self.scene.environment(), s.escaped)
        s.result += dr.select(s.escaped, self._times(s.throughput, found), 0)

    def _emission(self, s: LoopState, si: Any, emitter: Any, active: Any) -> Any:
        radiance = emitter.eval(si, active)
        if not self.plan.emitter_sampling:
            return radiance
        ds = self.v.DirectionSample3f(self.scene, si, s.previous)
        pdf = self.emitters.pdf(s.previous, ds, active & (s.delta ^ True))
        return radiance * dr.select(s.delta, 1, power_heuristic(s.pdf, pdf))

    def _add_direct(self, s: LoopState, si: Any, bsdf: Any, onward: Any, key: Any) -> None:
        smooth = onward & mi.has_flag(bsdf.flags(), LOBES.Smooth)
        if not self.vectorised and not smooth:
            return
        ds, radiance = self.emitters.sample(si, self.numbers.two(s.sampler, key), smooth)
        wo = si.to_local(ds.d)
        value, pdf = bsdf.eval_pdf(self.context, si, wo, smooth)
        lit = smooth & (ds.pdf != 0)
        if not dr.grad_enabled(value):  # what reflects nothing needs no shadow ray, but may have a derivative
            lit &= dr.max(dr.abs(self.v.unpolarized_spectrum(value))) > 0
        lit = lit & (self.scene.ray_test(si.spawn_ray_to(ds.p), lit) ^ True)
        if self.evaluated:
            dr.eval(lit)
        if self.v.is_polarized:
            value = si.to_world_mueller(value, -wo, si.wi)
        if self.plan.absorption:
            endless = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
            radiance = self._times(radiance, self._left(s.sigma, dr.select(endless, dr.inf, ds.dist)))
        found = self._times(self._times(s.throughput, value), radiance)
        found *= dr.select(ds.delta, 1, power_heuristic(ds.pdf, pdf))
        s.result = dr.select(lit, s.result + found, s.result)

    # Both lobes ----------------------------------------------------------------------------------------------------

    def _split(self, s: LoopState, si: Any, bsdf: Any, bs: Any, second: Any, throughput: Any, onward: Any) -> Any:
        """Push the other lobe where both are worth following; the throughput of the lobe that was sampled."""
        plan, p = self.plan, dr.detach(bs.pdf)
        pair = onward & s.specular_so_far & self._is_boundary(bsdf)
        s.specular_so_far = s.specular_so_far & mi.has_flag(bs.sampled_type, LOBES.Delta)
        both = pair & (s.depth <= plan.split_depth) & (s.share * dr.minimum(p, 1 - p) > plan.split_weight)
        if self.vectorised or both:
            both = self._push(s, si, bsdf, bs, second, both)
        if plan.deterministic:
            # The sample 1/2 has picked the stronger lobe; the other one is lost.
            self._truncate(s, pair & (both ^ True), 1 - p)
            both = pair
        return dr.select(both, throughput * bs.pdf, throughput)

    def _truncate(self, s: LoopState, where: Any, share: Any) -> None:
        # η²: what radiance lost where the path entered a denser medium it regains where it leaves.
        lost = dr.max(self.v.unpolarized_spectrum(s.throughput)) * dr.square(s.eta) * share
        s.truncated = dr.select(where, s.truncated + lost, s.truncated)

    def _boundaries(self) -> list[tuple[Any, Any]]:
        """The numbers of the BSDFs that are `BOUNDARIES`, as ranges: from, up to and without.

        Mitsuba numbers BSDFs as they are loaded. Opaque: another scene is other data, not another kernel.
        """
        v, ranges = self.v, list[list[int]]()
        bsdfs = [bsdf for shape in all_shapes(self.scene) if (bsdf := shape.bsdf()) is not None]
        pointers: list[Any] = [
            dr.reinterpret_array(v.UInt32, v.BSDFPtr(b)) for b in bsdfs if bsdf_name(b) in BOUNDARIES
        ]
        for number in sorted({int(pointer[0]) for pointer in pointers}):
            if ranges and ranges[-1][1] == number:
                ranges[-1][1] += 1
            else:
                ranges.append([number, number + 1])
        return [(dr.opaque(v.UInt32, first), dr.opaque(v.UInt32, last)) for first, last in ranges]

    def _is_boundary(self, bsdf: Any) -> Any:
        """Whether a BSDF is known to have one reflected and one refracted direction, and no others."""
        if not self.vectorised:
            return bsdf_name(bsdf) in BOUNDARIES
        number, found = dr.reinterpret_array(self.v.UInt32, bsdf), self.v.Bool(False)
        for first, last in self.boundaries:
            found |= (number >= first) & (number < last)
        return found

    def _push(self, s: LoopState, si: Any, bsdf: Any, bs: Any, second: Any, both: Any) -> Any:
        reflected = mi.has_flag(bs.sampled_type, LOBES.DeltaReflection)
        other, weight = bsdf.sample(self.context, si, dr.select(reflected, LAST, FIRST), second, both)
        both = both & (other.sampled_type != bs.sampled_type)
        ray, throughput, inside = self._next(s, si, bsdf, other, weight * other.pdf, both)
        # The lobe that was sampled has the odd number.
        branch = self.branch(
            ray.o, ray.d, throughput, s.depth, s.eta * other.eta, s.share * dr.detach(other.pdf), 2 * s.node,
            **inside,
        )  # fmt: skip
        # The index of an idle lane must be in range as well: local memory is accessed there.
        s.stack.write(branch, dr.select(both, s.waiting, 0), both)
        s.waiting = dr.select(both, s.waiting + 1, s.waiting)
        s.node = dr.select(both, 2 * s.node + 1, s.node)
        s.share = dr.select(both, s.share * dr.detach(bs.pdf), s.share)
        return both

    def _pop(self, s: LoopState, onward: Any) -> Any:
        """Where a path has ended, pop the branch pushed last and go on with it."""
        found = (onward ^ True) & (s.waiting > 0)
        if not self.vectorised and not found:
            return onward
        s.waiting = dr.select(found, s.waiting - 1, s.waiting)
        branch = s.stack.read(dr.select(found, s.waiting, 0), found)
        s.ray.o, s.ray.d = dr.select(found, branch.o, s.ray.o), dr.select(found, branch.d, s.ray.d)
        for name in self.branch.__annotations__.keys() - {"o", "d"}:
            setattr(s, name, dr.select(found, getattr(branch, name), getattr(s, name)))
        if self.plan.emitter_sampling:
            s.pdf, s.delta = dr.select(found, 1, s.pdf), s.delta | found
        s.specular_so_far = s.specular_so_far | found
        return onward | found

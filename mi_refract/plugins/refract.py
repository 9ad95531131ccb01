"""The Mitsuba BSDF `refract`, which takes the place of `dielectric`. The mathematics is in `mi_refract.formulas`.

A plugin class belongs to one variant, so `plugin_class` builds it from that variant's module, and `register`
makes it known there. Parameters: `int_ior`, `ext_ior` (see `index_parameter`), `int_absorption`, `ext_absorption` and
others (see `absorption`), `specular_reflectance`, `specular_transmittance` (textures or numbers), `formula` (a key of
FORMULAS, or "auto").

At a boundary that is dispersive, `refract_path` is given the refracted direction of the first wavelength, the hero,
and of the refracted light this wavelength only; reflected light has one direction, and all wavelengths:

    a lobe is chosen by the hero's R;   reflected: weights R_i / R_hero;   refracted: 1 for the hero, 0 for the others

so that for each wavelength the reflected light has the right mean. What the hero weighs more for the others' having
ended, the integrator knows (`DISPERSED` in `sampled_type`). For other integrators the index is that of the d line.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from mi_refract.formulas import FORMULAS, LARGEST_RATIO, SMALLEST_RATIO, fresnel, local_cosines, resolve
from mi_refract.media import LINES
from mi_refract.numerics import differentiated, ieee_divide, replace_grad

from .absorption import BEYOND, HERE, absorbing_parameter, read_absorption
from .index_parameter import PLUGIN
from .index_ratio import DispersiveRatio, TexturedRatio, read_ratio
from .who_asks import DISPERSED, is_followed, warn_once

LOBES = ("specular_reflectance", "specular_transmittance")  # tint of the reflected and of the transmitted lobe


class Side(NamedTuple):
    """The boundary as seen from one side: k = n_from / n_to and κ = k² − 1, in float64."""

    k: Any
    contrast: Any


class Ray(NamedTuple):
    """A refracted ray in the local frame: a = −wi, `eta` = n_to / n_from, `r` : `t` the unpolarised powers."""

    a: Any
    side: Side
    wo: Any
    eta: Any
    transmitted: Any
    r: Any
    t: Any
    active: Any  # where there is an index


def _checked(name: str, eta: float) -> float:
    if not SMALLEST_RATIO <= eta <= LARGEST_RATIO:
        raise ValueError(f"{PLUGIN}: {name} = {eta!r}: accepted: a ratio from {SMALLEST_RATIO} to {LARGEST_RATIO}")
    return eta


def _faces(eta: Any, active: Any) -> tuple[Any, Any, Any]:
    """k from inside and from outside where there is a ratio, 1 elsewhere; and where there is one."""
    found = dr.isfinite(eta)
    eta = dr.select(found, eta, 1)
    return eta, 1 / eta, active & found


def plugin_class(v: Any) -> type:
    """The class of the plugin for one variant, given its module (`mitsuba.llvm_ad_rgb`, say)."""
    flags = mi.BSDFFlags
    reflection, transmission = flags.DeltaReflection, flags.DeltaTransmission
    both_sides = flags.FrontSide | flags.BackSide
    wide: Any = dr.float64_array_t(v.Float)

    class Refract(v.BSDF):
        """Smooth dielectric boundary; see the module docstring."""

        def __init__(self, props: Any, formula: str = "auto") -> None:
            super().__init__(props)
            self.varying: Any  # a ratio that is not one number, or None
            self.varying, eta = read_ratio(v, props)
            if formula != "auto" and "formula" in props:
                raise ValueError(f"{PLUGIN}_{formula}: formula = {props['formula']!r}: accepted: nothing here")
            self.requested = props.get("formula", formula)
            try:
                self.formula_name, self.formula = resolve(self.requested, dr.backend_v(v.Float))
            except ValueError as error:
                raise ValueError(f"{PLUGIN}: {error}") from None
            self.textures = {name: props.get_texture(name, 1.0) for name in LOBES if name in props}
            self.absorptions = {side: read_absorption(PLUGIN, props, side) for side in ("int", "ext")}
            # Scalar variants: Mitsuba can set an array of one number, but not a bare Python float.
            number = v.Float if dr.is_jit_v(v.Float) else dr.scalar.Array1f
            self.eta = number(eta)
            self._face(_checked("int_ior / ext_ior", eta))
            self.m_components = [reflection | both_sides, transmission | both_sides | flags.NonSymmetric]
            self.m_flags = self.m_components[0] | self.m_components[1]

        @property
        def dispersive(self) -> bool:
            """Whether light is bent by its wavelength, where `refract_path` asks."""
            return v.is_spectral and isinstance(self.varying, DispersiveRatio)

        @property
        def absorbing(self) -> bool:
            """Whether a side absorbs light, which `refract_path` alone can do."""
            return any(self.absorptions.values())

        def _face(self, eta: Any) -> None:
            """Set k from either side, in float64. Opaque: an edit changes the data of a kernel and not its code.

            A kernel gathers these numbers ray by ray, so there are no more than save it a division. κ = (k − 1)(k + 1)
            is formed there: it is off by 2⁻⁵²/κ, which is what rounding the ratio of the indices to float64 makes it.
            """
            self.k_inner, self.k_outer = wide(eta), wide(1 / eta)
            dr.make_opaque(self.eta, self.k_inner, self.k_outer)

        def traverse(self, cb: Any) -> None:
            if self.varying:
                self.varying.traverse(cb)
            else:
                cb.put("eta", self.eta, mi.ParamFlags.Differentiable)
            for name, texture in self.textures.items():
                cb.put(name, texture, mi.ParamFlags.Differentiable)
            for absorption in filter(None, self.absorptions.values()):
                cb.put(absorption.name, absorption.texture, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: Any) -> None:
            if self.varying:
                self.varying.changed(keys)
                if isinstance(self.varying, DispersiveRatio):
                    self._face(self.varying.at(wide(LINES["d"])))
            elif not keys or "eta" in keys:
                if len(self.eta) != 1:
                    raise ValueError(f"{PLUGIN}: eta has {len(self.eta)} entries; accepted: one number")
                # Only a derivative needs a kernel here; a number is read back, so that an edit compiles nothing.
                number = _checked("eta", float(self.eta[0]))
                eta = wide(self.eta) if dr.grad_enabled(self.eta) else number
                self._face(eta)

        def _eta(self) -> Any:
            return self.eta if dr.is_jit_v(v.Float) else self.eta[0]

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            has_r, has_t = ctx.is_enabled(reflection, 0), ctx.is_enabled(transmission, 1)
            if not (has_r or has_t):
                return dr.zeros(v.BSDFSample3f), v.Spectrum(0)
            by_wavelength = self._by_wavelength(ctx)
            bs = v.BSDFSample3f()
            both, ray = has_r and has_t, self._refract(si, by_wavelength, active)
            whole, active = ray.r + ray.t, ray.active
            # sample1 < R, without waiting for the division. Not ≤: an index-matched boundary never reflects, not even
            # the sample that is exactly 0.
            selected_r = (wide(sample1) * whole < ray.r if both else v.Bool(has_r)) & active
            selected_t = (selected_r ^ True) & active
            value = v.Float(ieee_divide(dr.select(selected_r, ray.r, ray.t), whole))
            bs.pdf = 1 if not both else dr.detach(value) if differentiated(value) else value
            bs.sampled_component = dr.select(selected_r, v.UInt32(0), v.UInt32(1))
            refracted = +transmission | (DISPERSED if by_wavelength else 0)
            bs.sampled_type = dr.select(selected_r, v.UInt32(+reflection), v.UInt32(refracted))
            bs.wo = dr.select(selected_r, v.Vector3f(ray.a.x, ray.a.y, si.wi.z), ray.wo)
            bs.eta = dr.select(selected_r, v.Float(1), ray.eta)
            radiance = ctx.mode == mi.TransportMode.Radiance
            factor = dr.select(selected_t, dr.square(v.Float(ray.side.k)), 1) if radiance else 1
            if v.is_polarized:
                # Cosines below 1e-19 have squares of 0 in float32: such a lobe has no density and no weight.
                scale = dr.select(bs.pdf > 0, ieee_divide(factor, bs.pdf), 0)
                weight = self._mueller(ctx, si, bs, ray, selected_r, by_wavelength) * scale
            else:
                weight = v.Spectrum(self._attached(value) * factor if both else value * factor)
                if by_wavelength:
                    weight *= self._relative_powers(si, ray, selected_r)
            for name, texture in self.textures.items():
                selected = selected_r if name == LOBES[0] else selected_t
                tint = dr.select(selected, texture.eval(si, selected), v.UnpolarizedSpectrum(1))
                weight = weight @ v.mueller.absorber(tint) if v.is_polarized else weight * tint
            if self.absorbing and not is_followed(ctx):
                weight = v.Spectrum(self._refuse_others())
            return bs, dr.select(active, weight, 0)

        def _refuse_others(self) -> Any:
            """An infinite weight, where only `refract_path` can be right; in scalar variants a RuntimeError.

            Dr.Jit asks the BSDFs of all scenes in memory, also where no light meets them: an error would be one of
            scenes that do not absorb. (Some integrators leave out a sample that is NaN.)
            """
            text = f"{PLUGIN}: {absorbing_parameter(self)}: accepted: the integrator refract_path, or no absorption"
            if not dr.is_jit_v(v.Float):
                raise RuntimeError(text)
            warn_once(f"{text}; where light meets it, the image is infinite")
            return dr.inf

        def _by_wavelength(self, ctx: Any) -> bool:
            """Whether the wavelengths go their own ways."""
            followed = is_followed(ctx)
            if self.dispersive and not followed:
                warn_once(f"{PLUGIN}: {self.varying.names()}: not refract_path: all light has the index of the d line")
            return followed and self.dispersive

        def _refract(self, si: Any, by_wavelength: bool, active: Any) -> Ray:
            """The ray's side, refracted direction and reflectance. The normal is a literal: Dr.Jit folds it away."""
            a, outside = -si.wi, si.wi.z >= 0
            inner, outer, active = self._ratios(si, by_wavelength, active)
            k, eta = (dr.select(outside, *x) for x in ((outer, inner), (inner, outer)))
            side = Side(k, (k - 1) * (k + 1))
            # Unchecked: the ratio is checked where it is set, and NaN stays NaN.
            local = local_cosines(a.x, a.y, a.z, side.contrast)
            wo, transmitted = self.formula.unchecked(a, v.Vector3f(0, 0, 1), *side, local)
            return Ray(a, side, wo, v.Float(eta), transmitted, *fresnel.local_odds(local, transmitted, *side), active)

        def _ratios(self, si: Any, by_wavelength: bool, active: Any) -> tuple[Any, Any, Any]:
            """k from inside and from outside, and the lanes that have an index."""
            if by_wavelength:
                return _faces(self.varying.at(wide(si.wavelengths[0])), active)
            if isinstance(self.varying, TexturedRatio):
                return _faces(self.varying.at(si, active), active)
            return self.k_inner, self.k_outer, active

        def _other_rays(self, si: Any, a: Any, outside: Any) -> Iterator[tuple[Side, Any, Any]]:
            """For each wavelength but the first: the side, whether it has an index, and R."""
            for i in range(1, dr.size_v(v.UnpolarizedSpectrum)):
                inner, outer, found = _faces(self.varying.at(wide(si.wavelengths[i])), v.Bool(True))
                k = dr.select(outside, outer, inner)
                side = Side(k, (k - 1) * (k + 1))
                local = local_cosines(a.x, a.y, a.z, side.contrast)
                r, t = fresnel.local_odds(local, local.radicand >= 0, *side)
                yield side, found, v.Float(ieee_divide(r, r + t))

        def _relative_powers(self, si: Any, ray: Ray, selected_r: Any) -> Any:
            """Weights of the wavelengths, over that of the first."""
            hero = v.Float(ieee_divide(ray.r, ray.r + ray.t))
            hero = dr.select(selected_r, hero, 1)
            others = [
                dr.select(selected_r & found, r / hero, 0) for _, found, r in self._other_rays(si, ray.a, si.wi.z >= 0)
            ]
            return v.UnpolarizedSpectrum(1, *others)

        @staticmethod
        def _attached(value: Any) -> Any:
            """1, with the derivative of log `value`: the choice of a lobe is detached, its probability is not."""
            return replace_grad(v.Float(1), value / dr.detach(value)) if differentiated(value) else 1

        def _mueller(self, ctx: Any, si: Any, bs: Any, ray: Ray, selected_r: Any, by_wavelength: bool) -> Any:
            """The Mueller matrix of the selected lobe, turned into the implicit Stokes bases of both directions."""
            cos_i, cos_t = dr.abs(si.wi.z), dr.abs(ray.wo.z)
            r = fresnel.mueller_reflection(cos_i, *ray.side)
            t = fresnel.mueller_transmission(cos_i, cos_t, ray.transmitted, ray.side.k)
            if by_wavelength:
                r, t = self._of_all_wavelengths(si, ray, r, t)
            entries = [
                [dr.select(selected_r, x, y) for x, y in zip(*rows, strict=True)] for rows in zip(r, t, strict=True)
            ]
            matrix = v.Spectrum(entries) if by_wavelength else v.Spectrum(v.Matrix4f(entries))
            # Radiance: light arrives along −wo and leaves along wi. Importance: the other way round.
            radiance = ctx.mode == mi.TransportMode.Radiance
            arrival, departure = (-bs.wo, si.wi) if radiance else (-si.wi, bs.wo)
            axes = [self._perpendicular(direction) for direction in (arrival, departure)]
            return v.mueller.rotate_mueller_basis(
                matrix,
                arrival,
                axes[0],
                v.mueller.stokes_basis(arrival),
                departure,
                axes[1],
                v.mueller.stokes_basis(departure),
            )

        def _of_all_wavelengths(self, si: Any, ray: Ray, r: Any, t: Any) -> tuple[Any, Any]:
            """The Mueller matrices of both lobes; the first wavelength's are given, and only it is refracted."""
            cos_i, outside = dr.abs(si.wi.z), si.wi.z >= 0
            others = [
                [[dr.select(found, x, 0) for x in row] for row in fresnel.mueller_reflection(cos_i, *side)]
                for side, found, _ in self._other_rays(si, ray.a, outside)
            ]
            ended = [0] * len(others)
            reflected = [
                [v.UnpolarizedSpectrum(r[i][j], *(m[i][j] for m in others)) for j in range(4)] for i in range(4)
            ]
            return reflected, [[v.UnpolarizedSpectrum(x, *ended) for x in row] for row in t]

        @staticmethod
        def _perpendicular(direction: Any) -> Any:
            """The unit normal of the plane of incidence; any tangent where there is no such plane."""
            axis = v.Vector3f(-direction.y, direction.x, 0)
            length = dr.norm(axis)
            return dr.select(length > 0, axis / dr.select(length > 0, length, 1), v.Vector3f(1, 0, 0))

        # A pair of delta lobes has no density anywhere.

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return v.Spectrum(0)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return v.Float(0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            return v.Spectrum(0), v.Float(0)

        def has_attribute(self, name: str, active: Any = True) -> Any:
            return v.Bool(name == "eta" or name in self.textures or (name in (HERE, BEYOND) and self.absorbing))

        def eval_attribute(self, name: str, si: Any, active: Any = True) -> Any:
            if name in (HERE, BEYOND):
                return self._sigma(si, (si.wi.z >= 0) ^ (name == HERE), active)
            return v.UnpolarizedSpectrum(self._eta()) if name == "eta" else self._texture(name).eval(si, active)

        def eval_attribute_1(self, name: str, si: Any, active: Any = True) -> Any:
            return self._eta() if name == "eta" else self._texture(name).eval_1(si, active)

        def eval_attribute_3(self, name: str, si: Any, active: Any = True) -> Any:
            return v.Color3f(self._eta()) if name == "eta" else self._texture(name).eval_3(si, active)

        def _sigma(self, si: Any, inside: Any, active: Any) -> Any:
            """Absorption on one side."""
            sides = (x.eval(si, active) if x else v.UnpolarizedSpectrum(0) for x in self.absorptions.values())
            return dr.select(inside, *sides)

        def _texture(self, name: str) -> Any:
            if name not in self.textures:
                raise RuntimeError(f"{PLUGIN}: no attribute {name!r}; it has {', '.join(('eta', *self.textures))}")
            return self.textures[name]

        def to_string(self) -> str:
            chosen = f"{self.formula_name} (auto)" if self.requested == "auto" else self.formula_name
            lines = self.varying.lines() if self.varying else [f"eta = {dr.slice(self._eta())}"]
            lines += [f"formula = {chosen}", *(f"{name} = {texture}" for name, texture in self.textures.items())]
            lines += [f"{each.name} = {each.texture}" for each in self.absorptions.values() if each]
            return "Refract[\n" + "".join("  " + line.replace("\n", "\n  ") + ",\n" for line in lines) + "]"

    return Refract


def register(variant: Any) -> None:
    """Make `refract` known to one variant, given its module; and `refract_<formula>` for every formula.

    The latter are for scenes whose plugin is a parameter: there no word is left to name the formula with.
    Registering again is harmless.
    """
    plugin = plugin_class(variant)
    variant.register_bsdf(PLUGIN, plugin)
    for name in FORMULAS:
        variant.register_bsdf(f"{PLUGIN}_{name}", functools.partial(plugin, formula=name))

"""The Mitsuba BSDF `refract`, which takes the place of `dielectric`. The mathematics is in `mi_refract.formulas`.

A plugin class belongs to one variant, so `plugin_class` builds it from that variant's module, and `register`
makes it known there. Parameters: `int_ior`, `ext_ior` (number or a name from Mitsuba's table),
`specular_reflectance`, `specular_transmittance` (textures or numbers), `formula` (a key of FORMULAS, or "auto").
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from mi_refract.formulas import FORMULAS, LARGEST_RATIO, SMALLEST_RATIO, fresnel, local_cosines, resolve
from mi_refract.numerics import differentiated, ieee_divide, replace_grad

PLUGIN = "refract"
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


def read_ior(props: Any, name: str, default: str) -> float:
    """An index of refraction in double precision, from a number or a name in Mitsuba's table.

    ValueError with parameter, value and what is accepted, for all but a positive finite number or such a name.
    """
    value = props.get(name, default)
    if isinstance(value, str):
        return _named_ior(name, value)
    if isinstance(value, (int, float)) and not isinstance(value, bool) and 0 < value < math.inf:
        return float(value)
    raise ValueError(f"{PLUGIN}: {name} = {value!r}: accepted: a positive finite number, or a material's name")


def _checked(name: str, eta: float) -> float:
    if not SMALLEST_RATIO <= eta <= LARGEST_RATIO:
        raise ValueError(f"{PLUGIN}: {name} = {eta!r}: accepted: a ratio from {SMALLEST_RATIO} to {LARGEST_RATIO}")
    return eta


def _named_ior(name: str, material: str) -> float:
    query = mi.Properties()
    query[name] = material
    try:
        single = mi.lookup_ior(query, name, material)
    except RuntimeError as error:
        known = str(error).partition("choices are:")[2] or "the names of Mitsuba's table"
        raise ValueError(f"{PLUGIN}: {name} = {material!r}: unknown material; accepted: {known.strip()}") from None
    # The table holds decimal numbers of at most seven digits in float32: the shortest decimal gives them back.
    return float(f"{single:.7g}")


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
            int_ior, ext_ior = read_ior(props, "int_ior", "bk7"), read_ior(props, "ext_ior", "air")
            if formula != "auto" and "formula" in props:
                raise ValueError(f"{PLUGIN}_{formula}: formula = {props['formula']!r}: accepted: nothing here")
            self.requested = props.get("formula", formula)
            try:
                self.formula_name, self.formula = resolve(self.requested, dr.backend_v(v.Float))
            except ValueError as error:
                raise ValueError(f"{PLUGIN}: {error}") from None
            self.textures = {name: props.get_texture(name, 1.0) for name in LOBES if name in props}
            # Scalar variants: Mitsuba can set an array of one number, but not a bare Python float.
            number = v.Float if dr.is_jit_v(v.Float) else dr.scalar.Array1f
            self.eta = number(int_ior / ext_ior)
            self._face(_checked("int_ior / ext_ior", int_ior / ext_ior))
            self.m_components = [reflection | both_sides, transmission | both_sides | flags.NonSymmetric]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def _face(self, eta: Any) -> None:
            """Set k from either side, in float64. Opaque: an edit changes the data of a kernel and not its code.

            A kernel gathers these numbers ray by ray, so there are no more than save it a division. κ = (k − 1)(k + 1)
            is formed there: it is off by 2⁻⁵²/κ, which is what rounding the ratio of the indices to float64 makes it.
            """
            self.k_inner, self.k_outer = wide(eta), wide(1 / eta)
            dr.make_opaque(self.eta, self.k_inner, self.k_outer)

        def traverse(self, cb: Any) -> None:
            cb.put("eta", self.eta, mi.ParamFlags.Differentiable)
            for name, texture in self.textures.items():
                cb.put(name, texture, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: Any) -> None:
            if not keys or "eta" in keys:
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
            bs = v.BSDFSample3f()
            both, ray = has_r and has_t, self._refract(si.wi)
            whole = ray.r + ray.t
            # sample1 < R, without waiting for the division. Not ≤: an index-matched boundary never reflects, not even
            # the sample that is exactly 0.
            selected_r = (wide(sample1) * whole < ray.r if both else v.Bool(has_r)) & active
            selected_t = (selected_r ^ True) & active
            value = v.Float(ieee_divide(dr.select(selected_r, ray.r, ray.t), whole))
            bs.pdf = 1 if not both else dr.detach(value) if differentiated(value) else value
            bs.sampled_component = dr.select(selected_r, v.UInt32(0), v.UInt32(1))
            bs.sampled_type = dr.select(selected_r, v.UInt32(+reflection), v.UInt32(+transmission))
            bs.wo = dr.select(selected_r, v.Vector3f(ray.a.x, ray.a.y, si.wi.z), ray.wo)
            bs.eta = dr.select(selected_r, v.Float(1), ray.eta)
            radiance = ctx.mode == mi.TransportMode.Radiance
            factor = dr.select(selected_t, dr.square(v.Float(ray.side.k)), 1) if radiance else 1
            if v.is_polarized:
                # Cosines below 1e-19 have squares of 0 in float32: such a lobe has no density and no weight.
                scale = dr.select(bs.pdf > 0, ieee_divide(factor, bs.pdf), 0)
                weight = self._mueller(ctx, si, bs, ray, selected_r) * scale
            else:
                weight = v.Spectrum(self._attached(value) * factor if both else value * factor)
            for name, texture in self.textures.items():
                selected = selected_r if name == LOBES[0] else selected_t
                tint = dr.select(selected, texture.eval(si, selected), v.UnpolarizedSpectrum(1))
                weight = weight @ v.mueller.absorber(tint) if v.is_polarized else weight * tint
            return bs, dr.select(active, weight, 0)

        def _refract(self, wi: Any) -> Ray:
            """The ray's side, refracted direction and reflectance. The normal is a literal: Dr.Jit folds it away."""
            a, outside = -wi, wi.z >= 0
            k, eta = (dr.select(outside, *x) for x in ((self.k_outer, self.k_inner), (self.k_inner, self.k_outer)))
            side = Side(k, (k - 1) * (k + 1))
            # Unchecked: the ratio is checked where it is set, and NaN stays NaN.
            local = local_cosines(a.x, a.y, a.z, side.contrast)
            wo, transmitted = self.formula.unchecked(a, v.Vector3f(0, 0, 1), *side, local)
            return Ray(a, side, wo, v.Float(eta), transmitted, *fresnel.local_odds(local, transmitted, *side))

        @staticmethod
        def _attached(value: Any) -> Any:
            """1, with the derivative of log `value`: the choice of a lobe is detached, its probability is not."""
            return replace_grad(v.Float(1), value / dr.detach(value)) if differentiated(value) else 1

        def _mueller(self, ctx: Any, si: Any, bs: Any, ray: Ray, selected_r: Any) -> Any:
            """The Mueller matrix of the selected lobe, turned into the implicit Stokes bases of both directions."""
            cos_i, cos_t = dr.abs(si.wi.z), dr.abs(ray.wo.z)
            r = fresnel.mueller_reflection(cos_i, *ray.side)
            t = fresnel.mueller_transmission(cos_i, cos_t, ray.transmitted, ray.side.k)
            entries = [
                [dr.select(selected_r, x, y) for x, y in zip(*rows, strict=True)] for rows in zip(r, t, strict=True)
            ]
            matrix = v.Spectrum(v.Matrix4f(entries))
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
            return v.Bool(name == "eta" or name in self.textures)

        def eval_attribute(self, name: str, si: Any, active: Any = True) -> Any:
            return v.UnpolarizedSpectrum(self._eta()) if name == "eta" else self._texture(name).eval(si, active)

        def eval_attribute_1(self, name: str, si: Any, active: Any = True) -> Any:
            return self._eta() if name == "eta" else self._texture(name).eval_1(si, active)

        def eval_attribute_3(self, name: str, si: Any, active: Any = True) -> Any:
            return v.Color3f(self._eta()) if name == "eta" else self._texture(name).eval_3(si, active)

        def _texture(self, name: str) -> Any:
            if name not in self.textures:
                raise RuntimeError(f"{PLUGIN}: no attribute {name!r}; it has {', '.join(('eta', *self.textures))}")
            return self.textures[name]

        def to_string(self) -> str:
            chosen = f"{self.formula_name} (auto)" if self.requested == "auto" else self.formula_name
            lines = [f"eta = {dr.slice(self._eta())}", f"formula = {chosen}"]
            lines += [f"{name} = {texture}" for name, texture in self.textures.items()]
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

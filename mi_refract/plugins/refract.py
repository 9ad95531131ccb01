"""The Mitsuba BSDF `refract`, a drop-in for `dielectric`. The mathematics is in `mi_refract.formulas`.

| parameter | type | meaning and default | exposed | differentiable |
|---|---|---|---|---|
| `int_ior`, `ext_ior` | number, name | index inside (`bk7`, which is 1.5046) and outside (`air`) | `eta` | yes |
| | dispersive material | a text of `mi_refract.media`, such as `SCHOTT:N-BK7` | `int_ior_B1`, … | yes |
| | spectrum | index by wavelength, in spectral variants | `int_ior_n_360`, … | yes |
| | texture | index by point; a missing mesh attribute is an error, or a warning (below) | yes | yes |
| `eta` | number | int_ior / ext_ior, only by `mi.traverse` | yes | yes |
| `specular_reflectance`, `specular_transmittance` | number, spectrum, texture | tint of the lobe, ≥ 0 (1) | yes | yes |
| `int_absorption`, `ext_absorption` | number, spectrum | σ of the medium on that side, per length (0) | yes | yes |
| | `file:…` | k from a file, with `int_absorption_unit` | yes | yes |
| `int_absorption_unit`, `ext_absorption_unit` | number | the scene's unit of length in metres; no default | no | no |
| `int_colour`, `ext_colour` | number, spectrum | instead of σ: the share of white light after a distance | yes | yes |
| `int_colour_distance`, `ext_colour_distance` | number | that distance; no default | no | no |
| `formula` | string | a key of `mi_refract.FORMULAS`, or `auto` (default) | no | no |

After a distance t in a medium, exp(−σ t) of the light is left; σ = 4πk/λ, and a colour, above 0 and up to 1, is
exp(−σ t). Only `refract_path` renders absorption; it is also needed if a stated σ is 0, or a stated colour 1, as these
can be edited. A ratio of indices outside 2⁻²⁰ … 2²⁰ is an error; if an edit of a texture makes such a ratio, its light
is lost. `auto` is the fastest formula that is right to the last bit. An edit of `eta` compiles no kernel. Coefficients
of a dispersive material are exposed for λ in nm, also where its text or file has µm. `refract_<formula>` is the same
plugin with that formula.

With integrators other than `refract_path`, and in RGB and mono variants, a dispersive index is its value at the d line.

With integrators other than `refract_path`, absorption and a missing mesh attribute are errors in scalar variants, and
in the others if Dr.Jit evaluates loops and calls; in symbolic ones, the default, they are warnings.
"""

from __future__ import annotations

import functools
from collections.abc import Collection
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeAlias

import drjit as dr
import mitsuba as mi

from mi_refract.formulas import FORMULAS, LARGEST_RATIO, SMALLEST_RATIO, fresnel, local_cosines, resolve
from mi_refract.media import LINES, Medium
from mi_refract.numerics import (
    BSDFSample,
    Interaction,
    Mask,
    Number,
    Point2,
    Properties,
    Spectrum,
    Variant,
    Vector3,
    differentiated,
    ieee_divide,
    replace_grad,
)

from .absorption import BEYOND, HERE, absorbing_parameter, read_absorption, read_values
from .index_parameter import PLUGIN, DispersiveRatio, TexturedRatio, one_number, parameter_type, read_ratio, warn_once
from .scene_features import mesh_attributes

Refract: TypeAlias = Any  # an object of the class that `plugin_class` makes
Context: TypeAlias = Any  # an `mi.BSDFContext`
LOBES = ("specular_reflectance", "specular_transmittance")  # tint of the reflected and of the transmitted lobe
FLAGS = mi.BSDFFlags
FIXED_DIRECTIONS = "prb, prb_basic, prb_projective and prbvolpath do not differentiate the direction of a delta lobe"
MOVING_DIRECTIONS = "refract_path or volpath, or path, which is biased"
VALUE_AT_LOBE = 1e-4  # `evaluate` returns tint × this; prbvolpath clamps values to at least 1e-8, where no tint matters
SAME_DIRECTION = 1e-4  # a sampled direction that is transformed to world space and back has an error of 1e-6

# A BSDF's arguments are wavelengths and a direction; it does not know the path. So the integrator reports by a bit of
# `type_mask` in the context that it follows wavelengths and media. (State outside of the arguments would be wrong:
# Dr.Jit samples a BSDF again for derivatives, after the integrator has returned.) The same bit of a sample's
# `sampled_type` reports that its direction is valid for the first wavelength only.
DISPERSED = 1 << 30
if any(int(flag) & DISPERSED for flag in FLAGS):
    raise ImportError("bit 30 of mitsuba.BSDFFlags is in use; expected a version of Mitsuba that leaves it free")


def followed_context() -> Context:
    """Return a context for sampling BSDFs by an integrator that follows wavelengths and media along a path.

    Every render of `refract_path` uses it, as Dr.Jit also traces the BSDFs of other scenes in memory.
    """
    context = mi.BSDFContext()
    context.type_mask |= DISPERSED
    return context


def is_followed(context: Context) -> bool:
    """Whether the integrator of a context follows wavelengths and media."""
    return bool(context.type_mask & DISPERSED)


class Side(NamedTuple):
    """The boundary as seen from one side: k = n_from / n_to and κ = k² − 1, in float64."""

    k: Number
    contrast: Number


class Ray(NamedTuple):
    """A refracted ray in the local frame: a = −wi, `eta` = n_to / n_from, `r` : `t` the unpolarised powers."""

    a: Vector3
    side: Side
    wo: Vector3
    eta: Number
    transmitted: Mask
    r: Number
    t: Number
    active: Mask  # lanes that have an index


class OtherRay(NamedTuple):
    """Values of a wavelength other than the hero."""

    side: Side
    valid: Mask  # lanes that have an index
    r: Number  # reflectance; 0 without an index


# Parameters ----------------------------------------------------------------------------------------------------------


def read_parameters(self: Refract, props: Properties, formula: str = "auto") -> None:
    """Set the attributes of a new plugin. ValueError names plugin, parameter and what is expected."""
    v = self.v
    v.BSDF.__init__(self, props)
    self.varying, eta = read_ratio(v, props)  # `varying`: a ratio that is not one number, or None
    if formula != "auto" and "formula" in props:
        raise ValueError(f"{PLUGIN}_{formula}: `formula` cannot be set on {PLUGIN}_{formula}")
    self.requested = props.get("formula", formula)
    try:
        self.formula_name, self.formula = resolve(self.requested)
    except ValueError as error:
        raise ValueError(f"{PLUGIN}: {error}") from None
    tints = [name for name in LOBES if name in props]
    for name in tints:
        read_values(PLUGIN, props, name, "a number, a spectrum or a texture, ≥ 0 and finite")
    self.textures = {name: props.get_texture(name, 1.0) for name in tints}
    self.absorptions = {side: read_absorption(PLUGIN, props, side) for side in ("int", "ext")}
    self.reported = set[str]()  # texts that `LostLight` has logged
    self.eta = parameter_type(v)(eta)
    set_ratio(self, checked("int_ior / ext_ior", eta))
    both_sides = FLAGS.FrontSide | FLAGS.BackSide
    self.m_components = [FLAGS.DeltaReflection | both_sides, FLAGS.DeltaTransmission | both_sides | FLAGS.NonSymmetric]
    self.m_flags = self.m_components[0] | self.m_components[1]
    textured = self.textures or isinstance(self.varying, TexturedRatio)
    # Mesh attributes that textures read. Only `sample` knows the shape; scalar variants raise if the shape lacks one.
    self.attributes = mesh_attributes(self) if textured and dr.is_jit_v(v.Float) else []


def checked(name: str, eta: float) -> float:
    """Return `eta`. ValueError if it is not a ratio of indices."""
    if not SMALLEST_RATIO <= eta <= LARGEST_RATIO:
        raise ValueError(f"{PLUGIN}: {name} = {eta!r}; expected a ratio from {SMALLEST_RATIO} to {LARGEST_RATIO}")
    return eta


def checked_ratio(self: Refract) -> float:
    """Return the ratio of dispersive media at the d line.

    ValueError if it is not a ratio of indices there, or in spectral variants at another visible wavelength.
    """
    import numpy as np

    wavelengths = [LINES["d"], *(self.varying.visible() if self.v.is_spectral else ())]
    lanes = [self.wide(wavelengths)] if dr.is_jit_v(self.wide) else wavelengths
    ratios = np.concatenate([np.array(dr.detach(self.varying.at(lane)), float).ravel() for lane in lanes])
    at_d_line = checked("int_ior / ext_ior", float(ratios[0]))
    for wavelength, ratio in zip(wavelengths[1:], ratios[1:], strict=True):
        checked(f"int_ior / ext_ior at {wavelength:.4g} nm", float(ratio))
    return at_d_line


def set_ratio(self: Refract, eta: Number) -> None:
    """Set k of both sides, in float64. They are opaque, so that an edit changes the data of a kernel and not its code.

    A kernel gathers these numbers for each ray, so only those that save a division are stored. The kernel computes
    κ = (k − 1)(k + 1) with a relative error of 2⁻⁵²/κ; rounding the ratio of the indices to float64 causes as much.

    No derivatives are tracked here: the first `dr.backward` would free their graph, and a second image would have none.
    `ratios` builds the graph in each render.
    """
    eta = dr.detach(eta)
    self.k_inner, self.k_outer = self.wide(eta), self.wide(1 / eta)
    dr.make_opaque(self.eta, self.k_inner, self.k_outer)


def traverse(self: Refract, cb: mi.TraversalCallback) -> None:
    """Expose the parameters."""
    if self.varying:
        self.varying.traverse(cb)
    else:
        cb.put("eta", self.eta, mi.ParamFlags.Differentiable)
    for name, texture in self.textures.items():
        cb.put(name, texture, mi.ParamFlags.Differentiable)
    for absorption in filter(None, self.absorptions.values()):
        cb.put(absorption.name, absorption.texture, mi.ParamFlags.Differentiable)


def parameters_changed(self: Refract, keys: Collection[str]) -> None:
    """Read the edited parameters. ValueError for a value that is not an index."""
    # Numbers cannot be read while a function is recorded. Light is lost if the value is not an index.
    frozen = dr.is_jit_v(self.eta) and dr.flag(dr.JitFlag.FreezingScope)
    if self.varying:
        self.varying.changed(keys)
        if isinstance(self.varying, DispersiveRatio):
            set_ratio(self, dr.detach(self.varying.at(self.wide(LINES["d"]))) if frozen else checked_ratio(self))
    elif not keys or "eta" in keys:
        if frozen:
            eta = self.wide(dr.detach(self.eta))
            set_ratio(self, dr.select((eta >= SMALLEST_RATIO) & (eta <= LARGEST_RATIO), eta, dr.nan))
            return
        # The number is read back, so that an edit compiles no kernel. An unedited one keeps its double precision.
        values: Any = dr.slice(self.k_inner), dr.slice(one_number("eta", self.eta))
        before, number = map(float, values)
        edited = dr.scalar.Array1f(before)[0] != number
        set_ratio(self, checked("eta", number) if edited else before)


def ratios(
    self: Refract, si: Interaction, active: Mask, wavelength: Number | None = None
) -> tuple[Number, Number, Mask]:
    """Return k from inside, k from outside, in float64, at a wavelength or the d line; and the lanes that have them."""
    if wavelength is not None or isinstance(self.varying, TexturedRatio):
        eta = self.varying.at(si, active) if wavelength is None else self.varying.at(self.wide(wavelength))
        valid = dr.isfinite(eta)
        eta = dr.select(valid, eta, 1)
        return eta, 1 / eta, active & valid
    if not (self.varying.differentiated if self.varying else differentiated(self.eta)):
        return self.k_inner, self.k_outer, active
    eta = self.varying.at(self.wide(LINES["d"])) if self.varying else self.wide(self.eta)
    return replace_grad(self.k_inner, eta), replace_grad(self.k_outer, 1 / eta), active


# Sampling ------------------------------------------------------------------------------------------------------------


def sample(
    self: Refract, ctx: Context, si: Interaction, sample1: Number, sample2: Point2, active: Mask = True
) -> tuple[BSDFSample, Spectrum]:
    """Sample one of the two lobes; `sample1` selects it.

    At a dispersive boundary a path of `refract_path` has N wavelengths (4). Reflected light keeps all of them, as their
    direction is the same. Refracted light has the direction of the first one, the hero, and the others end. Let R_i be
    the reflectance of wavelength i, R̄ the mean of R_i, and T the transmittance of the hero; R_i and T are 0 for a
    wavelength without an index. The probabilities of reflection and refraction are

        P = R̄ / (R̄ + T),    1 − P = T / (R̄ + T)

    with the weights R_i / P for reflected light and T / (1 − P) = R̄ + T for the refracted hero, so the mean of each
    wavelength is right. A weight is at most N + 1 if reflected, as R_i / P = R_i + R_i T / R̄ and R_i ≤ N R̄, and at
    most 2 if refracted. (With the hero's R as the probability, R_i / R_hero has no bound: R_hero = 0 if the indices are
    equal. With R̄, a refracted weight reaches N, and N² with the factor below.) If all R_i are equal, P = R and the
    weights are 1. To account for the wavelengths that end, the integrator multiplies the throughput of the hero by the
    number of wavelengths that the path had, up to N (`DISPERSED` in `sampled_type`).
    """
    v = self.v
    has_r, has_t = ctx.is_enabled(FLAGS.DeltaReflection, 0), ctx.is_enabled(FLAGS.DeltaTransmission, 1)
    if not (has_r or has_t):
        return dr.zeros(v.BSDFSample3f), v.Spectrum(0)
    both, followed = has_r and has_t, is_followed(ctx)
    by_wavelength = followed and self.dispersive
    if self.dispersive and not followed:
        warn_once(without_dispersion(self))
    ray, hit = refract(self, si, active, si.wavelengths[0] if by_wavelength else None), v.Bool(active)
    active, others = ray.active, other_rays(self, si, ray) if by_wavelength else []

    # --- The lobe ---
    odds_r, odds_t = ray.r, ray.t
    if by_wavelength:
        hero_r, hero_t = (dr.select(active, v.Float(ieee_divide(x, ray.r + ray.t)), 0) for x in (ray.r, ray.t))
        reflectances = hero_r, *(other.r for other in others)
        odds_r, odds_t = self.wide(sum(reflectances)) / len(reflectances), self.wide(hero_t)
        active = hit & (odds_r + odds_t > 0)  # other wavelengths are reflected even if the hero has no index
    total = dr.select(active, odds_r + odds_t, 1) if by_wavelength else odds_r + odds_t
    # sample1 < P, without waiting for the division. Not ≤: an index-matched boundary must not reflect if sample1 = 0.
    selected_r = (self.wide(sample1) * total < odds_r if both else v.Bool(has_r)) & active
    selected_t = (selected_r ^ True) & active
    value = v.Float(ieee_divide(dr.select(selected_r, odds_r, odds_t), total))
    bs = v.BSDFSample3f()
    bs.pdf = 1 if not both else dr.detach(value) if differentiated(value) else value
    bs.sampled_component = dr.select(selected_r, v.UInt32(0), v.UInt32(1))
    refracted = +FLAGS.DeltaTransmission | (DISPERSED if by_wavelength else 0)
    bs.sampled_type = dr.select(selected_r, v.UInt32(+FLAGS.DeltaReflection), v.UInt32(refracted))
    bs.wo = dr.select(selected_r, v.Vector3f(ray.a.x, ray.a.y, si.wi.z), ray.wo)
    bs.eta = dr.select(selected_r, v.Float(1), ray.eta)

    # --- Its weight ---
    radiance = ctx.mode == mi.TransportMode.Radiance
    factor = dr.select(selected_t, dr.square(v.Float(ray.side.k)), 1) if radiance else 1
    # Squares of cosines below 1e-19 are 0 in float32: the density and the weight of such a lobe are 0.
    scale = dr.select(bs.pdf > 0, ieee_divide(factor, bs.pdf), 0) if v.is_polarized or by_wavelength else factor
    if v.is_polarized:
        weight = mueller(self, ctx, si, bs, ray, selected_r, others) * scale
    elif by_wavelength:
        powers = [dr.select(selected_r, r, t) for r, t in zip(reflectances, (hero_t, *[0] * len(others)), strict=True)]
        weight = v.Spectrum(*powers) * scale
    elif both:
        # 1, with the derivative of log `value`: the choice of the lobe is detached, its probability is attached.
        one = replace_grad(v.Float(1), value / dr.detach(value)) if differentiated(value) else 1
        weight = v.Spectrum(one * factor)
    else:
        weight = v.Spectrum(value * factor)
    for name, texture in self.textures.items():
        selected = selected_r if name == LOBES[0] else selected_t
        tint = dr.select(selected, texture.eval(si, selected), v.UnpolarizedSpectrum(1))
        weight = weight @ v.mueller.absorber(tint) if v.is_polarized else weight * tint
    if self.absorbing and not followed:
        # Infinite, as only `refract_path` renders absorption. (Not NaN: some integrators drop NaN.)
        text = f"{absorbing_parameter(self)}; expected the integrator refract_path, or no absorption"
        self.lost.report(self, text, "where light meets it, the image is not finite", active)
        weight = v.Spectrum(dr.inf)
    # Attributes are not checked if `refract_path` has done it, if the interaction has no shape, or while a function is
    # recorded, as values cannot be read then.
    unchecked = followed or si.shape is None or dr.flag(dr.JitFlag.FreezingScope)
    for name in () if unchecked else self.attributes:
        text = f"a shape has no attribute {name!r}, which a texture of its BSDF reads; expected a mesh that has it"
        has_shape = hit & (si.shape != None)  # noqa: E711  an array
        missing = has_shape & (si.shape.has_attribute(name, has_shape) ^ True)
        self.lost.report(self, text, "Mitsuba takes it for 0", missing)
    return bs, dr.select(active, weight, 0)


def refract(self: Refract, si: Interaction, active: Mask, wavelength: Number | None = None) -> Ray:
    """Return the refracted ray. The normal is a literal, which Dr.Jit folds."""
    a, outside = -si.wi, si.wi.z >= 0
    inner, outer, active = ratios(self, si, active, wavelength)
    k, eta = (dr.select(outside, *pair) for pair in ((outer, inner), (inner, outer)))
    side = Side(k, (k - 1) * (k + 1))
    # Unchecked: the ratio was checked when it was set, and NaN in `a` stays NaN.
    local = local_cosines(a.x, a.y, a.z, side.contrast)
    wo, transmitted = self.formula.unchecked(a, self.v.Vector3f(0, 0, 1), *side, local)
    odds = fresnel.local_odds(local, transmitted, *side)
    return Ray(a, side, wo, self.v.Float(eta), transmitted, *odds, active)


def other_rays(self: Refract, si: Interaction, ray: Ray) -> list[OtherRay]:
    """Return the values of all wavelengths but the first."""
    v, others = self.v, []
    for i in range(1, dr.size_v(v.UnpolarizedSpectrum)):
        inner, outer, valid = ratios(self, si, v.Bool(True), si.wavelengths[i])
        k = dr.select(si.wi.z >= 0, outer, inner)
        side = Side(k, (k - 1) * (k + 1))
        local = local_cosines(ray.a.x, ray.a.y, ray.a.z, side.contrast)
        r, t = fresnel.local_odds(local, local.radicand >= 0, *side)
        others.append(OtherRay(side, valid, dr.select(valid, v.Float(ieee_divide(r, r + t)), 0)))
    return others


def mueller(
    self: Refract, ctx: Context, si: Interaction, bs: BSDFSample, ray: Ray, selected_r: Mask, others: list[OtherRay]
) -> Spectrum:
    """Return the Mueller matrix of the selected lobe, rotated to the implicit Stokes bases of both directions.

    `others`: the wavelengths but the first, which are only reflected; [] if all wavelengths have one direction.
    """
    v, cos_i, cos_t = self.v, dr.abs(si.wi.z), dr.abs(ray.wo.z)
    r: Any = fresnel.mueller_reflection(cos_i, *ray.side)
    t: Any = fresnel.mueller_transmission(cos_i, cos_t, ray.transmitted, ray.side.k)
    if others:
        matrices: Any = [fresnel.mueller_reflection(cos_i, *other.side) for other in others]
        for i in range(4):
            for j in range(4):
                entries = (dr.select(other.valid, m[i][j], 0) for other, m in zip(others, matrices, strict=True))
                r[i][j] = v.UnpolarizedSpectrum(r[i][j], *entries)
                t[i][j] = v.UnpolarizedSpectrum(t[i][j], *[0] * len(others))
    selected = [[dr.select(selected_r, x, y) for x, y in zip(*rows, strict=True)] for rows in zip(r, t, strict=True)]
    matrix = v.Spectrum(selected) if others else v.Spectrum(v.Matrix4f(selected))
    # Radiance: light arrives along −wo and leaves along wi. Importance: in reverse.
    radiance = ctx.mode == mi.TransportMode.Radiance
    bases = []
    for direction in (-bs.wo, si.wi) if radiance else (-si.wi, bs.wo):
        # The unit normal of the plane of incidence; at normal incidence, which defines no plane, any tangent.
        axis = v.Vector3f(-direction.y, direction.x, 0)
        length = dr.norm(axis)
        normal = dr.select(length > 0, axis / dr.select(length > 0, length, 1), v.Vector3f(1, 0, 0))
        bases += [direction, normal, v.mueller.stokes_basis(direction)]
    return v.mueller.rotate_mueller_basis(matrix, *bases)


# Densities -----------------------------------------------------------------------------------------------------------


def evaluate(self: Refract, ctx: Context, si: Interaction, wo: Vector3, active: Mask = True) -> Spectrum:
    """Return 0, as delta lobes have no density; but a value above 0 to `prb` and its variants while they differentiate.

    These sample without derivatives, in a symbolic loop, and differentiate log eval at the sampled direction, which
    gives no derivative if eval is 0. So if `wo` is the direction of a lobe, the value is the lobe's tint times a
    constant, and the derivative in a tint is right. The derivative in the index would be wrong, as the direction should
    move with it; so it is infinite. (Not NaN, which Dr.Jit leaves out of sums.)
    """
    v = self.v
    if not (dr.is_diff_v(v.Float) and dr.flag(dr.JitFlag.SymbolicLoops)):
        return v.Spectrum(0)
    reflected = wo.z * si.wi.z > 0
    tints = [self.textures[x].eval(si, active) if x in self.textures else v.UnpolarizedSpectrum(1) for x in LOBES]
    value, index = dr.select(reflected, *tints), ratios(self, si, active)[0]
    if not (differentiated(value) or differentiated(index)):
        return v.Spectrum(0)
    if differentiated(index):
        warn_once(
            f"{PLUGIN}: the derivative in the index is infinite: {FIXED_DIRECTIONS}; expected {MOVING_DIRECTIONS}"
        )
        value *= replace_grad(v.Float(1), v.Float(index) * dr.inf)
    ray = refract(self, si, active)
    lobe = dr.select(reflected, v.Vector3f(ray.a.x, ray.a.y, si.wi.z), ray.wo)
    on_lobe = active & (dr.squared_norm(dr.detach(wo - lobe)) < SAME_DIRECTION**2)
    value = dr.select(on_lobe, value * VALUE_AT_LOBE, 0)
    return v.Spectrum(v.mueller.absorber(value)) if v.is_polarized else value


def pdf(self: Refract, ctx: Context, si: Interaction, wo: Vector3, active: Mask = True) -> Number:
    """Return 0: a delta lobe has no density."""
    return self.v.Float(0)


def eval_pdf(self: Refract, ctx: Context, si: Interaction, wo: Vector3, active: Mask = True) -> tuple[Spectrum, Number]:
    """Return 0 and 0. Values above 0 of `evaluate` are for `prb` and its variants only."""
    return self.v.Spectrum(0), self.v.Float(0)


# Attributes: Mitsuba finds what `traverse` exposes; others are 0, or an error in scalar variants ---------------------


def has_attribute(self: Refract, name: str, active: Mask = True) -> Mask:
    """Whether an attribute exists: a parameter that `traverse` exposes, or `HERE` and `BEYOND` if a side absorbs."""
    v = self.v
    return v.Bool(self.absorbing) if name in (HERE, BEYOND) else v.BSDF.has_attribute(self, name, active)


def eval_attribute(self: Refract, name: str, si: Interaction, active: Mask = True) -> Spectrum:
    """Return the value of an attribute; in vectorised variants 0 if it does not exist."""
    v = self.v
    if name not in (HERE, BEYOND):
        return v.BSDF.eval_attribute(self, name, si, active)
    sides = (x.eval(si, active) if x else v.UnpolarizedSpectrum(0) for x in self.absorptions.values())
    return dr.select((si.wi.z >= 0) ^ (name == HERE), *sides)


def eval_attribute_1(self: Refract, name: str, si: Interaction, active: Mask = True) -> Number:
    """Return the value of an attribute that is one number, as `eval_attribute`."""
    if name == "eta" and not self.varying and not dr.is_jit_v(self.v.Float):
        return self.eta[0]  # an array, which Mitsuba does not read
    return self.v.BSDF.eval_attribute_1(self, name, si, active)


def to_string(self: Refract) -> str:
    """Return the parameters, one a line."""
    chosen = f"{self.formula_name} (auto)" if self.requested == "auto" else self.formula_name
    sides = self.varying.sides.items() if self.varying else [("eta", self.eta[0])]
    lines = [f"{side} = {index.name if isinstance(index, Medium) else index}" for side, index in sides]
    lines += [f"formula = {chosen}", *(f"{name} = {texture}" for name, texture in self.textures.items())]
    lines += [f"{side.name} = {side.texture}" for side in self.absorptions.values() if side]
    return "Refract[\n" + "".join("  " + line.replace("\n", "\n  ") + ",\n" for line in lines) + "]"


def without_dispersion(bsdf: Refract) -> str:
    """Return what another integrator than `refract_path` makes of a dispersive BSDF, and what is expected."""
    names = " in ".join(medium.name for medium in bsdf.varying.sides.values())
    return f"{PLUGIN}: {names}: all light has the index of the d line; expected the integrator refract_path"


class LostLight:
    """Reports of light that cannot be rendered correctly: an error if one can be raised, else a warning.

    A symbolic call traces the BSDFs of all scenes in memory, before it is known which of them light will hit. Then
    `dr.print`, which runs when the image is computed, logs one warning for all BSDFs that light hits the first time.
    """

    def __init__(self, v: Variant) -> None:
        """`v`: the variant's module."""
        self.v, self.logged = v, set[str]()  # texts logged for the image that was traced last

    def report(self, bsdf: Refract, text: str, effect: str, active: Mask) -> None:
        """RuntimeError, or a warning when the image is computed, if a lane is `active`; once for each BSDF and text."""
        v, text = self.v, f"{PLUGIN}: {text}"

        def warn(_: str) -> None:
            bsdf.reported.add(text)
            if text not in self.logged:
                self.logged.add(text)
                mi.Log(mi.LogLevel.Warn, f"{text}; {effect}")  # type: ignore[operator]

        frozen = dr.flag(dr.JitFlag.FreezingScope)  # while a function is recorded, values cannot be read
        if not frozen and not dr.flag(dr.JitFlag.SymbolicScope):
            if dr.any(active):
                raise RuntimeError(text)
        elif text not in bsdf.reported:
            self.logged.discard(text)
            if frozen:
                warn("")
                return
            order = dr.scatter_inc(dr.opaque(v.UInt32, 0), v.UInt32(0), active)
            dr.print("", order=order, active=active & (order == 0), file=SimpleNamespace(write=warn))


# The class -----------------------------------------------------------------------------------------------------------


def plugin_class(v: Variant) -> type:
    """Return the class of the plugin for one variant, given its module, such as `mitsuba.llvm_ad_rgb`.

    Its methods are the functions above. `self.v` is that module and `self.wide` its type of float64.
    """

    def dispersive(self: Refract) -> bool:
        """Whether the direction depends on the wavelength if `refract_path` samples."""
        return v.is_spectral and isinstance(self.varying, DispersiveRatio)

    def absorbing(self: Refract) -> bool:
        """Whether a side has absorption, even if it is 0, which only `refract_path` renders."""
        return any(self.absorptions.values())

    members = {
        "__doc__": "Smooth dielectric boundary; see the module docstring.",
        "v": v,
        "wide": dr.float64_array_t(v.Float),
        "lost": LostLight(v),
        "__init__": read_parameters,
        "eval": evaluate,
        "dispersive": property(dispersive),
        "absorbing": property(absorbing),
    }
    methods = traverse, parameters_changed, sample, pdf, eval_pdf, has_attribute, eval_attribute, eval_attribute_1
    members |= {method.__name__: method for method in (*methods, to_string)}
    return type("Refract", (v.BSDF,), members)


def register(variant: Variant) -> None:
    """Register `refract` in one variant, given its module; and `refract_<formula>` for every formula.

    The latter serve scenes that take the name of the plugin as a parameter. Registering again is harmless.
    """
    plugin = plugin_class(variant)
    variant.register_bsdf(PLUGIN, plugin)
    for name in FORMULAS:
        variant.register_bsdf(f"{PLUGIN}_{name}", functools.partial(plugin, formula=name))

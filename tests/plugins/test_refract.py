"""The BSDF `refract`: equal to Mitsuba's `dielectric` as a drop-in, more accurate at the limits; its errors."""

import itertools
import json
import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.glass_scenes import refusal, sampled, surface, vector

from mi_refract.formulas import FORMULAS, fresnel
from mi_refract.numerics import mitsuba_mesh

TINTED = {"int_ior": 1.5, "ext_ior": 1.0, "specular_reflectance": 0.3, "specular_transmittance": 0.6}
REFLECTED, TRANSMITTED = mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission
LOBES = {
    "both lobes": {},
    "reflection": {"component": 0},
    "transmission": {"component": 1},
    "reflection by mask": {"type_mask": REFLECTED},
    "transmission by mask": {"type_mask": TRANSMITTED},
}


def load(plugin="refract", **parameters):
    return mi.load_dict({"type": plugin} | parameters)


def context(mode="Radiance", **parameters):
    ctx = mi.BSDFContext(getattr(mi.TransportMode, mode))
    for name, value in parameters.items():
        setattr(ctx, name, value)
    return ctx


# As a drop-in --------------------------------------------------------------------------------------------------


def test_flags_and_densities_equal_those_of_dielectric(each_variant):
    """A delta lobe has no density."""
    ours, theirs = load(), load("dielectric")
    assert ours.component_count() == theirs.component_count() and ours.flags() == theirs.flags()
    assert [ours.flags(i) for i in range(2)] == [theirs.flags(i) for i in range(2)]
    arguments = mi.BSDFContext(), surface(), mi.Vector3f(0, 0, -1)
    for x in (*ours.eval_pdf(*arguments), ours.eval(*arguments), ours.pdf(*arguments)):
        assert not np.array(x).any()
    no_lobe = sampled(ours, (0, 0, 1), 0.0, context(component=3))
    assert (no_lobe.weight == 0).all() and no_lobe.pdf == 0


@pytest.mark.parametrize("mode", ["Radiance", "Importance"])
@pytest.mark.parametrize("lobes", LOBES)
def test_samples_equal_those_of_dielectric(each_variant, mode, lobes):
    """From both sides, also beyond the critical angle; in polarised variants whole Mueller matrices."""
    bsdfs, ctx, weights = (load(**TINTED), load("dielectric", **TINTED)), context(mode, **LOBES[lobes]), []
    for z, sample1 in itertools.product((0.9999, 0.9, 0.3, -0.9, -0.6, -0.2), (0.0, 0.999)):
        wi = 0.6 * math.sqrt(1 - z * z), 0.8 * math.sqrt(1 - z * z), z
        ours, theirs = (vars(sampled(bsdf, wi, sample1, ctx)) for bsdf in bsdfs)
        weights.append(np.abs(theirs["weight"]).max())
        for name in theirs if weights[-1] else ("weight", "mueller"):  # with the weight 0 the direction is irrelevant
            assert ours[name] == pytest.approx(theirs[name], abs=3e-6), (name, z, sample1)
    assert max(weights) > 0.1
    assert all(weights) == (not lobes.startswith("transmission"))


def test_attached_sampling_has_the_derivative_of_the_reflectance(llvm_variant):
    angle = mi.Float(math.radians(10))
    dr.enable_grad(angle)
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.n = mi.Normal3f(dr.sin(angle), 0, dr.cos(angle))
    si.sh_frame = mi.Frame3f(si.n)
    si.wi = si.sh_frame.to_local(mi.Vector3f(0, 0, 1))
    _, weight = load().sample(mi.BSDFContext(), si, 0, [0, 0])
    dr.forward(angle)
    assert vector(dr.grad(weight)) == pytest.approx(0.008912204764783382, rel=1e-4)


@pytest.mark.parametrize("formula", ["auto", *FORMULAS])
def test_every_formula_refracts_and_is_in_the_text(typical_variant, formula):
    text = f"formula = {'promoted (auto)' if formula == 'auto' else formula},"
    bsdfs = [load(int_ior=1.5, ext_ior=1, formula=formula)]
    bsdfs += [load(f"refract_{formula}", int_ior=1.5, ext_ior=1)] if formula != "auto" else []
    for bsdf in bsdfs:
        assert text in str(bsdf)
        assert sampled(bsdf, (0.6, 0, 0.8), 0.9).wo == pytest.approx([-0.4, 0, -math.sqrt(1 - 0.16)], abs=1e-6)


@pytest.mark.parametrize(
    ("parameters", "eta"),
    [
        ({}, 1.5046 / 1.000277),
        ({"int_ior": "water", "ext_ior": "vacuum"}, 1.333),
        ({"int_ior": "Diamond", "ext_ior": 1}, 2.419),
        ({"int_ior": 1, "ext_ior": 1.25}, 0.8),
        ({"int_ior": 0.9, "ext_ior": 1.0}, 0.9),
    ],
)
def test_index_from_names_numbers_and_ints(typical_variant, parameters, eta):
    assert sampled(load(**parameters), (0, 0, 1), 1.0).eta == np.float32(eta)


def test_the_contrast_is_computed_in_double_precision(typical_variant):
    """Indices that differ by 3e-8: their ratio is 1 in float32, but the contrast keeps the difference."""
    inside = 1.0003 + 3e-8
    exact, wi = inside / 1.0003, (math.sqrt(1 - 1e-4**2), 0, 1e-4)
    bsdf = load(int_ior=inside, ext_ior=1.0003, formula="promoted")
    c = float(np.float32(1e-4))
    expected = math.sqrt(c * c + (exact * exact - 1) * float(np.float32(wi[0])) ** 2)
    assert -sampled(bsdf, wi, 0.9999999, context(component=1)).wo[2] == pytest.approx(expected / exact, rel=1e-5)
    assert expected / exact > 2 * c  # so the contrast does count


def test_eta_can_be_read_and_edited(typical_variant):
    bsdf = load(**TINTED)
    params = mi.traverse(bsdf)
    assert {"specular_reflectance.value", "specular_transmittance.value"} < {*params.keys()}
    eta = params["eta"][0]  # an array of one number, as in `roughdielectric`
    assert (float(eta), f"{eta:.3f}", json.dumps(eta)) == (1.5, "1.500", "1.5")
    params["eta"] = 1.25
    params.update()
    assert sampled(bsdf, (0.6, 0, 0.8), 0.9).wo == pytest.approx([-0.48, 0, -math.sqrt(1 - 0.48**2)], abs=1e-6)
    assert vector(bsdf.eval_attribute_1("eta", surface())) == 1.25
    for bad in (0.0, -1.5, math.nan, math.inf):
        params["eta"] = bad
        assert "eta = " in refusal(params.update)


def test_a_change_without_keys_reads_all_parameters(scalar_variant):
    for keys, eta in (([], 1.25), (["eta"], 1.25), (["specular_reflectance"], 1.5)):
        bsdf = load(int_ior=1.5, ext_ior=1)
        bsdf.eta = dr.scalar.Array1f(1.25)  # as Mitsuba sets it
        bsdf.parameters_changed(keys)
        assert sampled(bsdf, (0.6, 0, 0.8), 0.9).eta == eta


TINTS = {"specular_reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.8]}, "specular_transmittance": 0.4}


@pytest.mark.parametrize("tints", [{}, TINTS], ids=["plain", "tinted"])
@pytest.mark.parametrize("name", ["eta", *TINTS, "int_ior", "roughness"])
def test_attributes_equal_those_of_rough_glass(typical_variant, name, tints):
    """An absent attribute is 0 in compiled variants, and an error in scalar ones. (`dielectric` returns 0 for eta.)"""

    def values(bsdf):
        results = [vector(bsdf.has_attribute(name)).any()]
        for evaluate in (bsdf.eval_attribute, bsdf.eval_attribute_1, bsdf.eval_attribute_3):
            try:
                results.append(vector(evaluate(name, surface())).tolist())
            except RuntimeError:
                results.append("raised")
        return results

    assert values(load(**tints)) == values(load("roughdielectric", **tints))


def test_an_attribute_can_be_evaluated_for_all_bsdfs_of_a_scene(llvm_variant):
    """Scripts that write feature buffers do so: glass lacks the attribute, a plastic wall has it."""
    plastic = {"type": "plastic", "specular_reflectance": 0.5}
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3), "bsdf": plastic}
    scene = mi.load_dict({"type": "scene", "wall": wall, "glass": {"type": "sphere", "bsdf": {"type": "refract"}}})
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(mi.Float(0, 2), 0, 5), mi.Vector3f(0, 0, -1)))
    has = si.bsdf().has_attribute("specular_reflectance")
    assert vector(has).tolist() == [0, 1]
    for evaluate in (si.bsdf().eval_attribute_3, si.bsdf().eval_attribute):
        assert np.array(evaluate("specular_reflectance", si, active=has)).T.tolist() == [[0] * 3, [0.5] * 3]


def test_the_weight_of_an_inactive_sample_is_0(scalar_variant):
    for bsdf, sample1 in itertools.product((load(), load(**TINTED)), (0.0, 0.9)):
        weights = [bsdf.sample(context(), surface(), sample1, [0, 0], active)[1] for active in (False, True)]
        assert [np.array(weight).any() for weight in weights] == [False, True]


# At the limits -------------------------------------------------------------------------------------------------


def test_an_index_matched_boundary_transmits_and_total_reflection_reflects_all(typical_variant):
    """Also if sample1 is exactly 0, where `dielectric` reflects with the density 0. NaN stays NaN."""
    matched, glass = load(int_ior=1.3, ext_ior=1.3), load(int_ior=1.5, ext_ior=1)
    for wi in ((0, 0, 1), (0.6, 0, 0.8), (0.6, 0, -0.8)):
        transmitted = sampled(matched, wi, 0.0)
        assert transmitted.wo.tolist() == [-np.float32(x) for x in wi]
        assert transmitted.pdf == 1 and transmitted.weight == pytest.approx(1)
    reflected = sampled(glass, (0.8, 0, -0.6), 0.999999)
    assert reflected.pdf == 1 and reflected.weight == pytest.approx(1)
    assert reflected.wo == pytest.approx([-0.8, 0, -0.6])
    assert np.isnan(sampled(glass, (math.nan, 0, 1), 0.5).wo).any()
    invalid = sampled(glass, (0, 0, math.nan), 0.5)
    assert np.isnan(invalid.wo).any() and np.isnan(invalid.pdf)


@pytest.mark.parametrize("z", [0.0, 1e-30, 1e-12, 1e-7, 1e-4])
@pytest.mark.parametrize("int_ior", [1.3, 1.5])
def test_weights_and_densities_are_probabilities_down_to_grazing_incidence(typical_variant, z, int_ior):
    bsdf = load(int_ior=int_ior, ext_ior=1.3)
    for lobes in LOBES.values():
        grazing = sampled(bsdf, (math.sqrt(1 - z * z), 0, z), 0.999, context("Importance", **lobes))
        assert 0 <= grazing.pdf <= 1
        assert (grazing.weight >= 0).all() and (grazing.weight <= 1 + 1e-6).all()


def test_the_powers_are_a_short_kernel(vectorised):
    """Counts the operations of the kernel that computes R and T from (a, mask, k, κ), with the root of cos θ_t."""
    if vectorised.name != "float32":
        pytest.skip("the plugin's precision is float32")
    x = [dr.value_t(vectorised.vector)(np.linspace(0.1, 0.9, 64)) for _ in range(5)]
    transmitted = x[0] > 0.2
    dr.eval(x, transmitted)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.eval(fresnel.local_powers(vectorised.vector(*x[:3]), transmitted, x[3], x[4]))
        most = {"llvm": 45, "cuda": 47}[vectorised.backend]
        assert max(entry.get("operation_count", 0) for entry in dr.kernel_history()) <= most


# An index that is a texture: a number at each point of the surface ----------------------------------------------


def texture(*values):
    pixels = np.array(values, np.float32).reshape(1, -1, 1)
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, "filter_type": "nearest"}


def test_each_point_has_its_own_index(each_variant):
    bsdf = load(int_ior=texture(1.2, 1.8), ext_ior=1.0)
    for u, eta in ((0.25, 1.2), (0.75, 1.8)):
        transmitted = sampled(bsdf, (0.6, 0, 0.8), 0.999999, u=u)
        assert transmitted.wo == pytest.approx([-0.6 / eta, 0, -math.sqrt(1 - (0.6 / eta) ** 2)], rel=1e-6)
        assert transmitted.weight == pytest.approx(eta**-2, rel=1e-6)
    both = load(int_ior=texture(1.2, 1.8), ext_ior=texture(1.1, 1.1))
    assert sampled(both, (0.6, 0, 0.8), 0.999999, u=0.75).wo[0] == pytest.approx(-0.6 * 1.1 / 1.8, rel=1e-6)
    parameters = mi.traverse(bsdf)
    parameters["int_ior.data"][:] = 1.6
    parameters.update()
    assert sampled(bsdf, (0.6, 0, 0.8), 0.999999, u=0.25).wo[0] == pytest.approx(-0.6 / 1.6, rel=1e-6)


@pytest.mark.parametrize("index", [0.0, -1.5, math.nan, math.inf, 1e30, 1e-10])
def test_an_invalid_index_in_a_texture_is_an_error_and_an_edit_to_it_loses_light(typical_variant, index):
    checkers = {"type": "checkerboard", "color0": 1.5, "color1": texture(1.5, index)}
    for name, bad in (("int_ior", texture(1.5, index)), ("ext_ior", checkers)):
        message = f"refract: {name}: its texture contains {index:g}; expected indices from"
        assert message in refusal(load, **{name: bad})
    bsdf = load(int_ior=texture(1.5, 1.5), ext_ior=1.0)
    parameters = mi.traverse(bsdf)
    parameters["int_ior.data"][:] = index
    parameters.update()
    for sample1 in (0.0, 0.999999):
        assert (sampled(bsdf, (0.6, 0, 0.8), sample1, u=0.75).weight == 0).all()


@pytest.mark.parametrize("nested", [False, True])
def test_a_missing_mesh_attribute_is_an_error(llvm_variant, nested, logged):
    """In `refract_path`. With other integrators it is one warning, when light hits the shape."""
    glass = {"type": "refract", "int_ior": {"type": "mesh_attribute", "name": "vertex_n"}}
    if nested:
        checkers = {"type": "checkerboard", "color0": 1.5, "color1": glass["int_ior"]}
        glass = {"type": "mask", "opacity": 0.5, "inner": glass | {"int_ior": checkers}}
    camera = {"type": "perspective", "film": {"type": "hdrfilm", "width": 2, "height": 2}}
    for missing in (False, True):
        props = mi.Properties()
        props["glass"] = mi.load_dict(glass)
        mesh = mitsuba_mesh.make(mi, np.eye(3), np.arange(3)[None], properties=props)
        if not missing:
            mesh.add_attribute("vertex_n", 1, [1.5] * 3)
        scene = mi.load_dict({"type": "scene", "mesh": mesh, "integrator": {"type": "refract_path"}, "camera": camera})
        for _ in range(2):
            dr.eval(mi.render(scene, spp=4, integrator=mi.load_dict({"type": "path"})))
            dr.sync_thread()
        lines = [text for text in logged if "refract: a shape has no attribute 'vertex_n', which a texture" in text]
        assert len(lines) == missing and all(line.endswith("Mitsuba takes it for 0") for line in lines)
        if missing:
            assert "refract: 'mesh' has no attribute 'vertex_n', which a texture" in refusal(mi.render, scene, spp=1)
        else:
            mi.render(scene, spp=1)


def test_the_index_of_an_rgb_texture_is_its_luminance(llvm_variant):
    green, black = (
        {"type": "bitmap", "bitmap": mi.Bitmap(np.full((1, 1, 3), colour, np.float32)), "raw": True}
        for colour in ([0.0, 2.0, 0.0], [0.0, 0.0, 0.0])
    )
    assert load(int_ior=green)
    assert "its texture contains 0;" in refusal(load, int_ior=black)


def test_numbers_beside_an_rgb_colour_are_checked_in_spectral_variants(spectral_variant):
    """The colour itself is not checked there."""
    checkers = {"type": "checkerboard", "color0": {"type": "rgb", "value": [0.9, 0.9, 0.9]}, "color1": 0.0}
    assert "its texture contains 0;" in refusal(load, int_ior=checkers)


# Errors --------------------------------------------------------------------------------------------------------

TOO_FAR = "int_ior / ext_ior = {}; expected a ratio from"


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"int_ior": 0}, "int_ior = 0; expected"),
        ({"int_ior": -1.5}, "int_ior = -1.5; expected"),
        ({"ext_ior": math.nan}, "ext_ior = nan; expected"),
        ({"ext_ior": math.inf}, "ext_ior = inf; expected"),
        ({"int_ior": True}, "int_ior = True; expected"),
        ({"int_ior": "unobtainium"}, "int_ior = 'unobtainium': unknown material; expected vacuum"),
        ({"formula": "snell"}, "formula = 'snell': unknown; expected auto, wedge"),
        ({"formula": 3}, "formula = 3: unknown; expected auto"),
        ({"roughness": 0.1}, "roughness"),
        ({"int_ior": 1e300, "ext_ior": 1}, TOO_FAR.format("1e+300")),
        ({"int_ior": 1e-50, "ext_ior": 1}, TOO_FAR.format("1e-50")),
        ({"int_ior": 1e200, "ext_ior": 1e-200}, TOO_FAR.format("inf")),
        ({"int_ior": 1e-320, "ext_ior": 1}, TOO_FAR.format("1e-320")),
        (
            {"int_ior": {"type": "checkerboard"}, "ext_ior": "cauchy(1.5, 4000)"},
            "refract: ext_ior is dispersive, but the other index is a texture; expected one index",
        ),
    ],
)
def test_invalid_parameters_are_errors_with_what_is_expected(typical_variant, parameters, message):
    assert message in refusal(load, **parameters).replace("\n", " ")

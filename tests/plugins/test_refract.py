"""The plugin: what Mitsuba's tests ask of its own dielectric, what a drop-in must keep, and what ours does better."""

import json
import math

import drjit as dr
import numpy as np
import pytest
from support.glass_scenes import refusal

from mi_refract.formulas import FORMULAS

mi = pytest.importorskip("mitsuba")

BOTH, REFLECTION, TRANSMISSION = 0xFFFFFFFF, 0, 1


def load(**parameters):
    return mi.load_dict({"type": "refract"} | parameters)


def tinted():
    return load(int_ior=1.5, ext_ior=1.0, specular_reflectance=0.3, specular_transmittance=0.6)


def interaction(wi):
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(*map(float, wi))
    dr.make_opaque(si.wi)  # no literal: one kernel serves every direction
    return si


def sample(bsdf, wi, sample1, mode="Radiance", component=BOTH, type_mask=None):
    context = mi.BSDFContext(getattr(mi.TransportMode, mode))
    context.component = component
    if type_mask is not None:
        context.type_mask = type_mask
    bs, weight = bsdf.sample(context, interaction(wi), dr.opaque(mi.Float, sample1), [0, 0])
    return bs, np.array(mi.unpolarized_spectrum(weight), dtype=float).ravel()


def number(x):
    return float(np.array(x, dtype=float).ravel()[0])


def vector(x):
    return np.array(x, dtype=float).ravel()


# As Mitsuba tests its dielectric -------------------------------------------------------------------------------


def test_flags_and_components_are_those_of_the_built_in(each_variant):
    ours, theirs = load(), mi.load_dict({"type": "dielectric"})
    assert ours.component_count() == theirs.component_count()
    assert [ours.flags(i) for i in range(2)] == [theirs.flags(i) for i in range(2)]
    assert ours.flags() == theirs.flags()


@pytest.mark.parametrize("mode", ["Radiance", "Importance"])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_normal_incidence_from_both_sides(each_variant, mode, side):
    eta = 1.5**side
    bs, weight = sample(tinted(), (0, 0, side), 0.0, mode)
    assert (number(bs.pdf), number(bs.eta)) == pytest.approx((0.04, 1))
    assert vector(bs.wo) == pytest.approx([0, 0, side])
    assert weight == pytest.approx(0.3)
    assert (number(bs.sampled_component), number(bs.sampled_type)) == (0, mi.BSDFFlags.DeltaReflection)
    bs, weight = sample(tinted(), (0, 0, side), 0.05, mode)
    assert (number(bs.pdf), number(bs.eta)) == pytest.approx((0.96, eta))
    assert vector(bs.wo) == pytest.approx([0, 0, -side])
    assert weight == pytest.approx(0.6 / eta**2 if mode == "Radiance" else 0.6)
    assert (number(bs.sampled_component), number(bs.sampled_type)) == (1, mi.BSDFFlags.DeltaTransmission)


@pytest.mark.parametrize("sample1", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("by_mask", [False, True])
def test_one_lobe_alone(typical_variant, sample1, by_mask):
    flags = {REFLECTION: mi.BSDFFlags.DeltaReflection, TRANSMISSION: mi.BSDFFlags.DeltaTransmission}
    expected = {REFLECTION: (0.3 * 0.04, 1, [0, 0, 1]), TRANSMISSION: (0.6 * 0.96, 1.5, [0, 0, -1])}
    for lobe, (value, eta, wo) in expected.items():
        choice = {"type_mask": flags[lobe]} if by_mask else {"component": lobe}
        bs, weight = sample(tinted(), (0, 0, 1), sample1, "Importance", **choice)
        assert weight == pytest.approx(value)
        assert (number(bs.pdf), number(bs.eta)) == pytest.approx((1, eta))
        assert vector(bs.wo) == pytest.approx(wo)
        assert number(bs.sampled_component) == lobe


def test_a_component_that_does_not_exist_gives_nothing(typical_variant):
    bs, weight = sample(tinted(), (0, 0, 1), 0.0, component=3)
    assert (weight == 0).all()
    assert number(bs.pdf) == 0


def test_spot_value_at_80_degrees_and_back(typical_variant):
    angle, inside = math.radians(80), math.radians(41.03641052520335)
    wi = math.sin(angle), 0, math.cos(angle)
    bs, _ = sample(tinted(), wi, 0.0)
    assert number(bs.pdf) == pytest.approx(0.387704354691473, rel=1e-5)
    assert vector(bs.wo) == pytest.approx([-wi[0], 0, wi[2]])
    bs, _ = sample(tinted(), wi, 1.0)
    assert number(bs.pdf) == pytest.approx(1 - 0.387704354691473, rel=1e-5)
    assert vector(bs.wo) == pytest.approx([-math.sin(inside), 0, -math.cos(inside)], abs=1e-6)
    bs, _ = sample(tinted(), vector(bs.wo), 1.0)
    assert vector(bs.wo) == pytest.approx(wi, abs=2e-6)


def test_attached_sampling_has_the_derivative_of_the_reflectance(typical_variant):
    if not dr.is_diff_v(mi.Float):
        pytest.skip(f"{typical_variant}: no automatic differentiation")
    angle = mi.Float(math.radians(10))
    dr.enable_grad(angle)
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.n = mi.Normal3f(dr.sin(angle), 0, dr.cos(angle))
    si.sh_frame = mi.Frame3f(si.n)
    si.wi = si.sh_frame.to_local(mi.Vector3f(0, 0, 1))
    _, weight = load().sample(mi.BSDFContext(), si, 0, [0, 0])
    dr.forward(angle)
    assert vector(mi.unpolarized_spectrum(dr.grad(weight))) == pytest.approx(0.008912204764783382, rel=1e-4)


# As a drop-in --------------------------------------------------------------------------------------------------


def test_delta_lobes_have_no_density(typical_variant):
    bsdf, context, si = load(), mi.BSDFContext(), interaction((0, 0, 1))
    wo = mi.Vector3f(0, 0, -1)
    value, pdf = bsdf.eval_pdf(context, si, wo)
    for x in (value, pdf, bsdf.eval(context, si, wo), bsdf.pdf(context, si, wo)):
        assert not np.array(x).any()


@pytest.mark.parametrize("formula", ["auto", *FORMULAS])
def test_every_formula_bends_the_ray_and_is_named(typical_variant, formula):
    bsdf = load(int_ior=1.5, ext_ior=1, formula=formula)
    assert f"formula = {formula if formula != 'auto' else ''}" in str(bsdf)
    bs, _ = sample(bsdf, (0.6, 0, 0.8), 0.9)
    assert vector(bs.wo) == pytest.approx([-0.4, 0, -math.sqrt(1 - 0.16)], abs=1e-6)


def test_automatic_choice_is_written_out(typical_variant):
    name = "compensated" if typical_variant.startswith("cuda") else "promoted"
    assert f"formula = {name} (auto)" in str(load())


def test_a_plugin_named_after_its_formula(typical_variant):
    assert "formula = cross" in str(mi.load_dict({"type": "refract_cross"}))


@pytest.mark.parametrize(
    ("parameters", "eta"),
    [
        ({}, 1.5046 / 1.000277),
        ({"int_ior": "water", "ext_ior": "vacuum"}, 1.333),
        ({"int_ior": "Diamond", "ext_ior": 1}, 2.419),
        ({"int_ior": 2, "ext_ior": 1}, 2.0),
        ({"int_ior": 1, "ext_ior": 1.25}, 0.8),
        ({"int_ior": 0.9, "ext_ior": 1.0}, 0.9),
    ],
)
def test_index_from_names_numbers_and_ints(typical_variant, parameters, eta):
    bs, _ = sample(load(**parameters), (0, 0, 1), 1.0)
    assert number(bs.eta) == np.float32(eta)


def test_contrast_is_formed_in_double_and_rounded_once(typical_variant):
    """Indices that differ by 3e-8: float32 sees no difference in their ratio, the contrast keeps all of it."""
    inside = 1.0003 + 3e-8
    bsdf = load(int_ior=inside, ext_ior=1.0003, formula="promoted")
    exact = inside / 1.0003
    wi = math.sqrt(1 - 1e-4**2), 0, 1e-4
    bs, _ = sample(bsdf, wi, 0.9999999, component=TRANSMISSION)
    c = float(np.float32(1e-4))
    expected = math.sqrt(c * c + (exact * exact - 1) * float(np.float32(wi[0])) ** 2)
    assert -vector(bs.wo)[2] == pytest.approx(expected / exact, rel=1e-5)
    assert expected / exact > 2 * c  # so the contrast does count


def test_eta_can_be_read_and_edited(typical_variant):
    bsdf = load(int_ior=1.5, ext_ior=1)
    params = mi.traverse(bsdf)
    eta = params["eta"][0]  # an array of one number, as `roughdielectric` has it
    assert (float(eta), f"{eta:.3f}", json.dumps(eta)) == (1.5, "1.500", "1.5")
    params["eta"] = 1.25
    params.update()
    bs, _ = sample(bsdf, (0.6, 0, 0.8), 0.9)
    assert vector(bs.wo) == pytest.approx([-0.48, 0, -math.sqrt(1 - 0.48**2)], abs=1e-6)
    assert number(bsdf.eval_attribute_1("eta", interaction((0, 0, 1)))) == 1.25


def test_textures_are_traversed_and_tint_their_lobe_only(typical_variant):
    bsdf = tinted()
    names = {key.partition(".")[0] for key in mi.traverse(bsdf).keys()}  # noqa: SIM118
    assert {"specular_reflectance", "specular_transmittance"} <= names
    only_reflected = load(int_ior=1.5, ext_ior=1, specular_reflectance=0.25)
    _, reflected = sample(only_reflected, (0, 0, 1), 0.0, "Importance")
    _, transmitted = sample(only_reflected, (0, 0, 1), 0.9, "Importance")
    assert reflected == pytest.approx(0.25)
    assert transmitted == pytest.approx(1)


TINTS = {"specular_reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.8]}, "specular_transmittance": 0.4}


@pytest.mark.parametrize("tints", [{}, TINTS], ids=["plain", "tinted"])
@pytest.mark.parametrize("name", ["eta", *TINTS, "int_ior", "roughness"])
def test_attributes_are_those_of_rough_glass(typical_variant, name, tints):
    """In compiled variants what is absent is 0; in scalar ones both raise. (Smooth glass gives 0 for its eta.)"""
    si, bsdfs = interaction((0, 0, 1)), (load(**tints), mi.load_dict({"type": "roughdielectric"} | tints))

    def answers(bsdf):
        found = [vector(bsdf.has_attribute(name)).any()]
        for evaluate in (bsdf.eval_attribute, bsdf.eval_attribute_1, bsdf.eval_attribute_3):
            try:
                found.append(vector(evaluate(name, si)).tolist())
            except RuntimeError:
                found.append("raised")
        return found

    assert answers(bsdfs[0]) == answers(bsdfs[1])


def test_an_attribute_is_asked_of_all_bsdfs_of_a_scene(llvm_variant):
    """As scripts that write feature buffers do: of glass that lacks it, beside a plaster that has it."""
    parts = {"glass": {"type": "sphere", "bsdf": {"type": "refract"}}}
    plaster = {"type": "plastic", "specular_reflectance": 0.5}
    parts["wall"] = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3), "bsdf": plaster}
    scene = mi.load_dict({"type": "scene"} | parts)
    x = mi.Float(0, 2)
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, 0, 5), mi.Vector3f(0, 0, -1)))
    bsdf = si.bsdf()
    has = bsdf.has_attribute("specular_reflectance")
    assert vector(has).tolist() == [0, 1]
    found = bsdf.eval_attribute_3("specular_reflectance", si, active=has)
    assert np.array(found).T.tolist() == [[0] * 3, [0.5] * 3]


@pytest.mark.parametrize(("keys", "eta"), [([], 1.25), (["eta"], 1.25), (["specular_reflectance"], 1.5)])
def test_a_change_without_keys_may_be_of_anything(scalar_variant, keys, eta):
    bsdf = load(int_ior=1.5, ext_ior=1)
    bsdf.eta = dr.scalar.Array1f(1.25)  # as Mitsuba sets it
    bsdf.parameters_changed(keys)
    assert number(sample(bsdf, (0.6, 0, 0.8), 0.9)[0].eta) == eta


@pytest.mark.parametrize("sample1", [0.0, 0.9])
def test_a_sample_that_is_not_asked_for_has_no_weight(scalar_variant, sample1):
    si, context = interaction((0, 0, 1)), mi.BSDFContext()
    for bsdf in (load(), tinted()):
        weights = [bsdf.sample(context, si, sample1, [0, 0], active)[1] for active in (False, True)]
        assert [np.array(weight).any() for weight in weights] == [False, True]


def test_nothing_reflects_where_nothing_differs(typical_variant):
    """Index-matched, and the sample that is exactly 0: the built-in reflects with density 0 there."""
    bsdf = load(int_ior=1.3, ext_ior=1.3)
    for wi in ((0, 0, 1), (0.6, 0, 0.8), (0.6, 0, -0.8)):
        bs, weight = sample(bsdf, wi, 0.0)
        assert number(bs.pdf) == 1
        assert vector(bs.wo).tolist() == [-np.float32(x) for x in wi]
        assert weight == pytest.approx(1)


def test_total_internal_reflection_takes_everything(typical_variant):
    bsdf = load(int_ior=1.5, ext_ior=1)
    wi = 0.8, 0, -0.6
    bs, weight = sample(bsdf, wi, 0.999999)
    assert number(bs.pdf) == 1
    assert vector(bs.wo) == pytest.approx([-0.8, 0, -0.6])
    assert weight == pytest.approx(1)
    _, weight = sample(bsdf, wi, 0.5, component=TRANSMISSION)
    assert (weight == 0).all()


def test_a_direction_that_is_none_stays_none(typical_variant):
    bs, _ = sample(load(), (math.nan, 0, 1), 0.5)
    assert np.isnan(vector(bs.wo)).any()
    bs, _ = sample(load(), (0, 0, math.nan), 0.5)
    assert np.isnan(vector(bs.wo)).any()
    assert np.isnan(number(bs.pdf))


@pytest.mark.parametrize(
    ("parameters", "words"),
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
    ],
)
def test_bad_parameters_are_named_with_what_is_accepted(typical_variant, parameters, words):
    assert words in refusal(load, **parameters).replace("\n", " ")


@pytest.mark.parametrize(("int_ior", "ext_ior"), [(1e300, 1), (1e-50, 1), (1e200, 1e-200), (1e-320, 1)])
def test_indices_whose_ratio_is_beyond_float32_are_refused(typical_variant, int_ior, ext_ior):
    said = refusal(load, int_ior=int_ior, ext_ior=ext_ior)
    assert "int_ior / ext_ior = " in said and "; expected a ratio from" in said


@pytest.mark.parametrize("eta", [0.0, -1.5, math.nan, math.inf])
def test_an_edit_that_is_no_index_is_refused(typical_variant, eta):
    params = mi.traverse(load())
    params["eta"] = eta
    assert "eta = " in refusal(params.update)


@pytest.mark.parametrize("z", [0.0, 1e-30, 1e-12, 1e-7, 1e-4])
@pytest.mark.parametrize("int_ior", [1.3, 1.5])
def test_weights_and_densities_are_probabilities_down_to_grazing_incidence(typical_variant, z, int_ior):
    bsdf = load(int_ior=int_ior, ext_ior=1.3)
    for component in (BOTH, REFLECTION, TRANSMISSION):
        bs, weight = sample(bsdf, (math.sqrt(1 - z * z), 0, z), 0.999, "Importance", component)
        assert 0 <= number(bs.pdf) <= 1
        assert (weight >= 0).all()
        assert (weight <= 1 + 1e-6).all()


@pytest.mark.parametrize("z", [0.9, 0.3, -0.9, -0.6, -0.2])
@pytest.mark.parametrize("sample1", [0.0, 0.999])
def test_mueller_matrices_are_those_of_the_built_in(polarized_variant, z, sample1):
    ours, theirs = load(), mi.load_dict({"type": "dielectric"})
    for mode in ("Radiance", "Importance"):
        wi = 0.6 * math.sqrt(1 - z * z), 0.8 * math.sqrt(1 - z * z), z
        context = mi.BSDFContext(getattr(mi.TransportMode, mode))
        number = dr.opaque(mi.Float, sample1)
        x, y = (np.array(b.sample(context, interaction(wi), number, [0, 0])[1]) for b in (ours, theirs))
        assert x == pytest.approx(y, abs=3e-6)
        assert np.abs(y).max() > 0.1

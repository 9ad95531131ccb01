"""A boundary whose index depends on the wavelength, asked as a BSDF."""

import itertools
import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refract import media
from mi_refract.plugins import integrator_context

GLASS = "cauchy(1.5, 20000)"  # n from 1.53 at 830 nm to 1.65 at 360 nm
WAVELENGTHS = 450.0, 700.0, 550.0, 600.0
D_LINE = 587.5618
REFLECTED, REFRACTED = 0.0, 0.999999


def n(wavelength):
    return 1.5 + 20000 / wavelength**2


def load(int_ior=GLASS, ext_ior=1.0, **parameters):
    return mi.load_dict({"type": "refract", "int_ior": int_ior, "ext_ior": ext_ior} | parameters)


def interaction(wi, wavelengths=WAVELENGTHS):
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(*map(float, wi))
    if mi.is_spectral:
        si.wavelengths = type(si.wavelengths)(*wavelengths)
    return si


def sample(bsdf, wi, sample1, **more):
    bs, weight = bsdf.sample(integrator_context.context(), interaction(wi, **more), sample1, [0.5, 0.5])
    return bs, np.array(mi.unpolarized_spectrum(weight), dtype=float).ravel()


def vector(x):
    return np.array(x, dtype=float).ravel()


def tilted(angle, side=1):
    return math.sin(angle), 0.0, side * math.cos(angle)


def reflectance(sin_i, eta):
    """Fresnel's equations for n_to/n_from = eta, unpolarised; 1 where reflection is total."""
    cos_i, square = math.sqrt(1 - sin_i**2), 1 - (sin_i / eta) ** 2
    if square <= 0:
        return 1.0
    cos_t = math.sqrt(square)
    s = (cos_i - eta * cos_t) / (cos_i + eta * cos_t)
    p = (eta * cos_i - cos_t) / (eta * cos_i + cos_t)
    return (s * s + p * p) / 2


def is_dispersed(bs):
    return bool((vector(bs.sampled_type).astype(int) & integrator_context.DISPERSED).any())


@pytest.mark.parametrize("side", [1, -1])
def test_refracted_light_is_of_the_first_wavelength_in_its_direction(spectral_variant, side):
    eta = n(WAVELENGTHS[0]) ** side
    powers = [reflectance(math.sin(0.5), n(x) ** side) for x in WAVELENGTHS]
    total = np.mean(powers) + 1 - powers[0]  # of both lobes, R̄ + T
    bs, weight = sample(load(), tilted(0.5, side), REFRACTED)
    assert vector(bs.wo)[0] == pytest.approx(-math.sin(0.5) / eta, rel=1e-6)
    assert vector(bs.eta)[0] == pytest.approx(eta, rel=1e-6)
    assert weight == pytest.approx([total * eta**-2, 0, 0, 0], rel=1e-5)
    assert vector(bs.pdf)[0] == pytest.approx((1 - powers[0]) / total, rel=1e-5)
    assert is_dispersed(bs)


@pytest.mark.parametrize("angle", [0.0, 0.5, 1.3])
def test_reflected_light_keeps_all_wavelengths_each_with_its_power(spectral_variant, angle):
    powers = np.array([reflectance(math.sin(angle), n(x)) for x in WAVELENGTHS])
    bs, weight = sample(load(), tilted(angle), REFLECTED)
    chosen = powers.mean() / (powers.mean() + 1 - powers[0])
    assert vector(bs.pdf)[0] == pytest.approx(chosen, rel=1e-5)
    assert weight == pytest.approx(powers / chosen, rel=1e-4)
    assert len(set(powers.round(3))) > 1
    assert not is_dispersed(bs)


def test_where_one_wavelength_is_totally_reflected_the_others_keep_what_they_have(spectral_variant):
    """From within, between the critical angles: blue is reflected whole, red in part."""
    sin_i = 1 / n(550)
    powers = np.array([reflectance(sin_i * (1 + 1e-6), 1 / n(x)) for x in WAVELENGTHS])
    assert powers[0] == 1 > powers[1]
    bs, weight = sample(load(), tilted(math.asin(sin_i * (1 + 1e-6)), -1), 0.5)
    assert vector(bs.sampled_component)[0] == 0
    assert weight == pytest.approx(powers, rel=2e-3)


OIL = "table(360: 1.52, 500: 1.5, 600: 1.5, 830: 1.49)"  # a plateau at the index of the glass beside it
PAIRS = {
    "equal": ("cauchy(1.5, 4000)", "cauchy(1.5, 4000)"),
    "a plateau at the index outside": (OIL, 1.5),
    "1e-4 beside it": (OIL, 1.4999),
    "a plateau inside, seen from it": (1.5, OIL),
    "crossing": ("table(360: 1.6, 830: 1.4)", "table(360: 1.4, 830: 1.6)"),
    "glasses that cross at 580 nm": ("SCHOTT:N-SK16", "SCHOTT:N-F2"),
    "glasses that cross at 700 nm": ("SCHOTT:N-BAF10", "SCHOTT:N-SF5"),
    "an end of the range": ("table(385: 1.6, 800: 1.45)", 1.5),
}
WHOLE, BENT = len(WAVELENGTHS) + 1, 2  # the bounds of a weight, reflected and refracted


@pytest.mark.parametrize("pair", PAIRS)
def test_weights_are_bounded_and_each_wavelength_has_its_powers(pair, spectral_variant):
    """Every wavelength in turn is the hero: P w_i = R_i for all, (1 − P) w = T for the hero, and weights are bounded.

    Of R the float32 cosine leaves (cos θ)⁻¹ u times a few, of κ near 0 what float64 leaves: 1e-4 and 1e-12 are wide.
    """
    inside, outside = PAIRS[pair]
    bsdf, waves = load(inside, outside), (380.0, 550.0, 579.7, 699.0)
    pair_ = [media.parse(x, name="pair") for x in (inside, outside)]

    def ratio(wavelength):
        valid = all(m.valid[0] <= wavelength <= m.valid[1] for m in pair_ if m.dispersive)
        return float(media.relative_index(*pair_, wavelength)) if valid else None

    for turn, side, angle in itertools.product(range(4), (1, -1), (0.0, 0.7, 1.2, 1.5)):
        wavelengths = waves[turn:] + waves[:turn]
        etas = [ratio(x) for x in wavelengths]
        powers = np.array([0.0 if eta is None else reflectance(math.sin(angle), eta**side) for eta in etas])
        for number in (REFLECTED, REFRACTED):
            bs, weight = sample(bsdf, tilted(angle, side), number, wavelengths=wavelengths)
            if etas[0] is None:
                assert (weight == 0).all()
                continue
            p = vector(bs.pdf)[0]
            if vector(bs.sampled_component)[0] == 0:
                assert p * weight == pytest.approx(powers, rel=1e-4, abs=1e-12)
                assert weight.max() <= WHOLE * (1 + 1e-6)
            else:
                weight[0] *= etas[0] ** (2 * side)
                assert p * weight == pytest.approx([1 - powers[0], 0, 0, 0], rel=1e-4, abs=1e-6)
                assert weight.max() <= BENT * (1 + 1e-6)


def test_at_the_plateau_the_light_of_the_others_is_reflected_by_chance(spectral_variant):
    """The hero has the index outside, so R = 0, and the others have not."""
    bs, weight = sample(load(OIL, 1.5), tilted(1.2), REFLECTED, wavelengths=(550.0, 380.0, 450.0, 700.0))
    assert vector(bs.sampled_component)[0] == 0 and vector(bs.pdf)[0] > 0
    assert weight[0] == 0 and (weight[1:] > 0).all()


def test_an_index_within_1e_7_of_the_surroundings_is_not_rounded(spectral_variant):
    """κ = k² − 1 = 4e-7 at grazing incidence: in float32 the index would be off by a third of n − 1."""
    excess, wavelength = 2e-7, 500.0
    bsdf = load(f"cauchy(1, {excess * wavelength**2!r})")
    angle = math.pi / 2 - 1e-3
    bs, _ = sample(bsdf, tilted(angle), REFRACTED, wavelengths=(wavelength,) * 4)
    sin_i = float(np.float32(math.sin(angle)))
    cos_i = float(np.float32(math.cos(angle)))
    expected = math.sqrt(1 - sin_i**2 / (sin_i**2 + cos_i**2) / (1 + excess) ** 2)
    assert -vector(bs.wo)[2] == pytest.approx(expected, rel=4e-7)
    assert abs(expected - cos_i) > 1e-4 * cos_i


def test_an_integrator_that_does_not_ask_and_colours_have_the_index_of_the_d_line(each_variant):
    asked = mi.BSDFContext() if mi.is_spectral else integrator_context.context()
    bs, weight = load().sample(asked, interaction(tilted(0.5)), REFRACTED, [0.5, 0.5])
    assert vector(bs.wo)[0] == pytest.approx(-math.sin(0.5) / n(D_LINE), rel=1e-6)
    assert vector(mi.unpolarized_spectrum(weight)) == pytest.approx(n(D_LINE) ** -2, rel=1e-6)
    assert not is_dispersed(bs)


def test_both_media_may_be_dispersive(spectral_variant):
    outside = "cauchy(1.3, 3000)"
    bs, _ = sample(load(ext_ior=outside), tilted(0.5), REFRACTED)
    eta = n(450) / (1.3 + 3000 / 450**2)
    assert vector(bs.wo)[0] == pytest.approx(-math.sin(0.5) / eta, rel=1e-6)


def test_light_outside_the_range_of_a_medium_is_lost(spectral_variant):
    bsdf = load("table(380: 1.5, 800: 1.4)")
    for number in (REFLECTED, REFRACTED):
        assert (sample(bsdf, tilted(0.5), number, wavelengths=(370.0, 500, 600, 700))[1] == 0).all()
        weight = sample(bsdf, tilted(0.5), number, wavelengths=(500.0, 370, 600, 700))[1]
        assert weight[0] > 0 and weight[1] == 0 and np.isfinite(weight).all()


def test_a_spectrum_may_jump_between_knots_that_agree_to_nine_digits(spectral_variant):
    text = '<bsdf type="refract" version="3.0.0"><spectrum name="int_ior" value="{}"/><float name="ext_ior" value="1"/>'
    bsdf = mi.load_string(text.format("360:1.5, 600:1.5, 600.00000001:1.6, 830:1.6") + "</bsdf>")
    for wavelength, index in ((500.0, 1.5), (700.0, 1.6)):
        bs, _ = sample(bsdf, tilted(0.5), REFRACTED, wavelengths=(wavelength, 500.0, 600.0, 700.0))
        assert vector(bs.wo)[0] == pytest.approx(-math.sin(0.5) / index, rel=1e-6)


def test_a_medium_whose_range_leaves_out_colour_is_refused(spectral_variant):
    with pytest.raises(
        RuntimeError, match=r"int_ior: .* from 420 to 830 nm: .* of the colour lies outside; expected at most"
    ):
        load("table(420: 1.5, 830: 1.4)")


def test_coefficients_are_parameters(spectral_variant):
    """Also within a scene: Mitsuba reports a change by what follows the last dot of a name."""
    ball = {"type": "sphere", "bsdf": {"type": "refract", "int_ior": GLASS, "ext_ior": "cauchy(1.1, 0)"}}
    scene = mi.load_dict({"type": "scene", "ball": ball})
    parameters = mi.traverse(scene)
    assert {f"ball.bsdf.{side}_ior_{x}" for side in ("int", "ext") for x in "AB"} <= set(parameters.keys())
    parameters["ball.bsdf.int_ior_B"] = 40000.0
    parameters.update()
    bsdf = scene.shapes()[0].bsdf()
    for wavelength, context in ((450, integrator_context.context()), (D_LINE, mi.BSDFContext())):
        bs, _ = bsdf.sample(context, interaction(tilted(0.5)), REFRACTED, [0.5, 0.5])
        assert vector(bs.wo)[0] == pytest.approx(-math.sin(0.5) / (1.5 + 40000 / wavelength**2) * 1.1, rel=1e-6)


def test_a_coefficient_is_one_number(llvm_spectral):
    parameters = mi.traverse(load())
    parameters["int_ior_B"] = mi.Float(1, 2)
    with pytest.raises(ValueError, match=r"refract: int_ior_B has 2 entries; expected one number"):
        parameters.update()


def test_directions_have_derivatives_in_the_coefficients(llvm_spectral):
    bsdf = load()
    parameters = mi.traverse(bsdf)
    dr.enable_grad(parameters["int_ior_B"])
    parameters.update()
    bs, _ = sample(bsdf, tilted(0.5), REFRACTED)
    dr.backward(bs.wo.x)
    # wo.x = −sin θ / n, so its derivative in B is sin θ / (n λ)²
    expected = math.sin(0.5) / (n(450) * 450) ** 2
    assert dr.grad(parameters["int_ior_B"])[0] == pytest.approx(expected, rel=1e-5)


def test_the_text_names_the_media(spectral_variant):
    assert f"int_ior = {GLASS}" in str(load())

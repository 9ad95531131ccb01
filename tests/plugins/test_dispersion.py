"""Boundaries whose index depends on the wavelength: samples of the BSDF, and paths through them.

Only one wavelength continues after a refraction, and the energy of all wavelengths is conserved.
"""

import functools
import itertools
import math
import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.glass_scenes import PLACE, attached, camera, refusal, render, sampled, sky, surface

from mi_refract import media
from mi_refract.image_diff import pixelwise
from mi_refract.plugins import path_loop
from mi_refract.plugins.refract import DISPERSED, followed_context

GLASS = "cauchy(1.5, 20000)"  # n from 1.53 at 830 nm to 1.65 at 360 nm
WAVELENGTHS = 450.0, 700.0, 550.0, 600.0
D_LINE = media.LINES["d"]
REFLECTED, REFRACTED = 0.0, 0.999999


def n(wavelength):
    return 1.5 + 20000 / wavelength**2


def load(int_ior=GLASS, ext_ior=1.0, **parameters):
    return mi.load_dict({"type": "refract", "int_ior": int_ior, "ext_ior": ext_ior} | parameters)


def sample(bsdf, wi, sample1, wavelengths=WAVELENGTHS):
    return sampled(bsdf, wi, sample1, followed_context(), wavelengths=wavelengths)


def tilted(angle, side=1):
    return math.sin(angle), 0.0, side * math.cos(angle)


def reflectance(sin_i, eta):
    """Return the unpolarised Fresnel reflectance for n_to/n_from = eta; 1 for total reflection."""
    cos_i, square = math.sqrt(1 - sin_i**2), 1 - (sin_i / eta) ** 2
    if square <= 0:
        return 1.0
    cos_t = math.sqrt(square)
    s, p = ((x - y) / (x + y) for x, y in ((cos_i, eta * cos_t), (eta * cos_i, cos_t)))
    return (s * s + p * p) / 2


# A boundary ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", [1, -1])
def test_refracted_light_has_the_first_wavelength_and_its_direction(spectral_variant, side):
    eta = n(WAVELENGTHS[0]) ** side
    powers = [reflectance(math.sin(0.5), n(x) ** side) for x in WAVELENGTHS]
    total = np.mean(powers) + 1 - powers[0]  # R̄ + T
    bent = sample(load(), tilted(0.5, side), REFRACTED)
    assert (bent.wo[0], bent.eta) == pytest.approx((-math.sin(0.5) / eta, eta), rel=1e-6)
    assert bent.weight == pytest.approx([total * eta**-2, 0, 0, 0], rel=1e-5)
    assert bent.pdf == pytest.approx((1 - powers[0]) / total, rel=1e-5)
    assert int(bent.type) & DISPERSED
    both = sample(load(ext_ior="cauchy(1.3, 3000)"), tilted(0.5), REFRACTED)
    assert both.wo[0] == pytest.approx(-math.sin(0.5) / n(450) * (1.3 + 3000 / 450**2), rel=1e-6)


def test_reflected_light_keeps_all_wavelengths_each_with_its_power(spectral_variant):
    for angle in (0.0, 0.5, 1.3):
        powers = np.array([reflectance(math.sin(angle), n(x)) for x in WAVELENGTHS])
        reflected = sample(load(), tilted(angle), REFLECTED)
        probability = powers.mean() / (powers.mean() + 1 - powers[0])
        assert reflected.pdf == pytest.approx(probability, rel=1e-5)
        assert reflected.weight == pytest.approx(powers / probability, rel=1e-4)
        assert len(set(powers.round(3))) > 1
        assert not int(reflected.type) & DISPERSED


def test_wavelengths_have_their_reflectances_if_the_first_is_totally_reflected(spectral_variant):
    """From inside, between the critical angles: blue is totally reflected, red partly."""
    sin_i = (1 + 1e-6) / n(550)
    powers = np.array([reflectance(sin_i, 1 / n(x)) for x in WAVELENGTHS])
    assert powers[0] == 1 > powers[1]
    reflected = sample(load(), tilted(math.asin(sin_i), -1), 0.5)
    assert reflected.component == 0
    assert reflected.weight == pytest.approx(powers, rel=2e-3)


@pytest.mark.parametrize(("angle", "side"), [(0.0, 1), (math.atan(1.6), 1), (1.3, 1), (0.3, -1), (0.68, -1)])
def test_reflected_light_has_the_mueller_matrix_of_each_wavelength(angle, side, spectral_variant):
    """At 0.68 rad inside, 450 nm are totally reflected, the others partly. In variants without polarisation: powers."""
    dispersive, *constant = (sample(load(x), tilted(angle, side), REFLECTED) for x in (GLASS, *map(n, WAVELENGTHS)))
    found, *expected = ((x.pdf * x.mueller).reshape(-1, len(WAVELENGTHS)) for x in (dispersive, *constant))
    for i, of_this_index in enumerate(expected):
        assert found[:, i] == pytest.approx(of_this_index[:, i], rel=1e-3, abs=1e-5)


OIL = "table(360: 1.52, 500: 1.5, 600: 1.5, 830: 1.49)"  # from 500 to 600 nm the index of the glass beside it
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
MOST_REFLECTED, MOST_REFRACTED = len(WAVELENGTHS) + 1, 2  # bounds of a weight


@pytest.mark.parametrize("pair", PAIRS)
def test_weights_are_bounded_and_give_the_powers_of_each_wavelength(pair, spectral_variant):
    """Each wavelength in turn is the hero: P w_i = R_i for all, (1 − P) w = T for the hero, and weights are bounded.

    The float32 cosine gives R a relative error of a few u / cos θ, and float64 limits κ near 0: 1e-4 and 1e-12 are
    generous. Light outside the range of a medium is lost: R_i = 0, and if it is the hero, T = 0.
    """
    bsdf, lines = load(*PAIRS[pair]), (380.0, 550.0, 579.7, 699.0)
    sides = [media.parse(x, name="pair") for x in PAIRS[pair]]

    def ratio(wavelength):
        valid = all(m.valid[0] <= wavelength <= m.valid[1] for m in sides if m.dispersive)
        return float(media.relative_index(*sides, wavelength)) if valid else None

    for hero, side, angle in itertools.product(range(4), (1, -1), (0.0, 0.7, 1.2, 1.5)):
        wavelengths = lines[hero:] + lines[:hero]
        etas = [ratio(x) for x in wavelengths]
        powers = np.array([0.0 if eta is None else reflectance(math.sin(angle), eta**side) for eta in etas])
        for sample1 in (REFLECTED, REFRACTED):
            s = sample(bsdf, tilted(angle, side), sample1, wavelengths)
            if etas[0] is None:
                assert s.component == 0 and s.pdf == 1
            if s.component == 0:
                assert s.pdf * s.weight == pytest.approx(powers, rel=1e-4, abs=1e-12)
                assert s.weight.max() <= MOST_REFLECTED * (1 + 1e-6)
            else:
                s.weight[0] *= etas[0] ** (2 * side)
                assert s.pdf * s.weight == pytest.approx([1 - powers[0], 0, 0, 0], rel=1e-4, abs=1e-6)
                assert s.weight.max() <= MOST_REFRACTED * (1 + 1e-6)


def test_other_wavelengths_are_reflected_if_the_first_is_index_matched(spectral_variant):
    """The hero has R = 0, the others have R > 0."""
    reflected = sample(load(OIL, 1.5), tilted(1.2), REFLECTED, (550.0, 380.0, 450.0, 700.0))
    assert reflected.component == 0 and reflected.pdf > 0
    assert reflected.weight[0] == 0 and (reflected.weight[1:] > 0).all()


def test_an_index_within_1e_7_of_the_surroundings_is_not_rounded(spectral_variant):
    """κ = k² − 1 = 4e-7 at grazing incidence: in float32 the index would have an error of a third of n − 1."""
    excess, wavelength, angle = 2e-7, 500.0, math.pi / 2 - 1e-3
    gas = load(f"cauchy_um(1, {excess * (wavelength / 1000) ** 2!r})")
    bent = sample(gas, tilted(angle), REFRACTED, (wavelength,) * 4)
    sin_i, cos_i = (float(np.float32(x)) for x in (math.sin(angle), math.cos(angle)))
    expected = math.sqrt(1 - sin_i**2 / (sin_i**2 + cos_i**2) / (1 + excess) ** 2)
    assert -bent.wo[2] == pytest.approx(expected, rel=4e-7)
    assert abs(expected - cos_i) > 1e-4 * cos_i


def test_other_integrators_and_rgb_variants_use_the_index_of_the_d_line(each_variant):
    bent = sampled(load(), tilted(0.5), REFRACTED, None if mi.is_spectral else followed_context())
    assert bent.wo[0] == pytest.approx(-math.sin(0.5) / n(D_LINE), rel=1e-6)
    assert bent.weight == pytest.approx(n(D_LINE) ** -2, rel=1e-6)
    assert not int(bent.type) & DISPERSED


SPECTRUM = '<spectrum name="int_ior" value="360:1.5, 600:1.5, 600.00000001:1.6, 830:1.6"/>'
JUMP = f'<bsdf type="refract" version="3.0.0">{SPECTRUM}<float name="ext_ior" value="1"/></bsdf>'


def test_a_spectrum_may_jump_between_knots_that_agree_to_nine_digits(spectral_variant):
    bsdf = mi.load_string(JUMP)
    for wavelength, index in ((500.0, 1.5), (700.0, 1.6)):
        bent = sample(bsdf, tilted(0.5), REFRACTED, (wavelength, 500.0, 600.0, 700.0))
        assert bent.wo[0] == pytest.approx(-math.sin(0.5) / index, rel=1e-6)


def test_an_edited_knot_of_a_table_acts_like_a_new_table(spectral_variant):
    edited, expected = load("table(360: 1.5, 500: 1.6, 830: 1.7)"), load("table(360: 1.5, 500: 1.55, 830: 1.7)")
    parameters = mi.traverse(edited)
    parameters["int_ior_n_500"] = type(parameters["int_ior_n_500"])(1.55)
    parameters.update()
    for wavelength in (400.0, 500.0, 600.0):
        a, b = (sample(x, tilted(0.5), REFRACTED, (wavelength, 500.0, 600.0, 700.0)) for x in (edited, expected))
        assert a.wo[0] == pytest.approx(b.wo[0], rel=1e-6)  # 1.55 is set in float32


def test_a_spectrum_as_an_index_is_an_error_in_rgb_variants(scalar_variant):
    with pytest.raises(RuntimeError, match=r"int_ior: this variant converts spectra to colours; .*'table\(360.0: 1.5"):
        mi.load_string(JUMP)


def test_a_medium_without_an_index_at_the_d_line_is_an_error_in_rgb_variants(rgb_variant):
    expected = r"expected a wavelength from 600 to 700 nm, or hold\(…\)"
    with pytest.raises(RuntimeError, match=rf"refract: int_ior: table.*: no index at 587.562 nm; {expected}"):
        load("table(600: 1.5, 700: 1.4)")


def test_a_medium_whose_range_excludes_visible_light_is_an_error(spectral_variant, logged):
    """A share of the colour of white light of up to 0.1 % is a warning."""
    form = r"int_ior: .* from {} to {} nm: {} of the colour lies outside; expected at least 380 … 716 nm, or hold\(…\)"
    for low, high, lost in ((420, 830, "5.1%"), (400, 700, "0.5%"), (390, 710, "0.15%"), (600, 605, "100%")):
        with pytest.raises(RuntimeError, match=form.format(low, high, lost)):
            load(f"table({low}: 1.5, {high}: 1.4)")
    for low, high, lost in ((380, 716, "0.059%"), (385, 716, "0.082%")):
        load(f"table({low}: 1.5, {high}: 1.4)")
        assert f"from {low} to {high} nm; other light ({lost} of the colour) is lost" in logged[-1]


def test_hold_extends_the_index_at_the_ends_with_a_warning(spectral_variant, logged):
    bsdf = load("hold(table(450: 1.5, 700: 1.4))")
    for wavelength, index in ((380.0, 1.5), (450.0, 1.5), (575.0, 1.45), (800.0, 1.4)):
        bent = sample(bsdf, tilted(0.5), REFRACTED, (wavelength, 500.0, 600.0, 700.0))
        assert bent.wo[0] == pytest.approx(-math.sin(0.5) / index, rel=1e-6)
    (text,) = logged
    assert re.search(r"450 to 700 nm; other light \(46% of the colour\) has the index of the range's end", text)


def test_the_file_of_an_index_is_relative_to_the_scene(spectral_variant, tmp_path):
    (tmp_path / "glass.csv").write_text("µm,n\n0.36,1.5\n0.83,1.4\n", "utf-8")
    (tmp_path / "scene.xml").write_text(
        '<bsdf type="refract" version="3.0.0"><string name="int_ior" value="file:glass.csv"/>'
        '<float name="ext_ior" value="1"/></bsdf>'
    )
    bent = sample(mi.load_file(str(tmp_path / "scene.xml")), tilted(0.5), REFRACTED, (360.0, 500.0, 600.0, 700.0))
    assert bent.wo[0] == pytest.approx(-math.sin(0.5) / 1.5, rel=1e-6)


def test_coefficients_are_parameters(spectral_variant):
    """Also in a scene, where Mitsuba reports a change by the part of the name after the last dot."""
    scene = mi.load_dict({"type": "scene", "ball": ball(ext_ior="cauchy(1.1, 0)")})
    params = mi.traverse(scene)
    assert {f"ball.bsdf.{side}_ior_{x}" for side in ("int", "ext") for x in "AB"} <= set(params.keys())
    params["ball.bsdf.int_ior_B"] = 40000.0
    params.update()
    bsdf = scene.shapes()[0].bsdf()
    for wavelength, context in ((450, followed_context()), (D_LINE, mi.BSDFContext())):
        bent = sampled(bsdf, tilted(0.5), REFRACTED, context)
        assert bent.wo[0] == pytest.approx(-math.sin(0.5) / (1.5 + 40000 / wavelength**2) * 1.1, rel=1e-6)
    assert f"int_ior = {GLASS}" in str(bsdf)


@pytest.mark.parametrize("value", [-40.0, 1e9, math.nan, math.inf])
def test_an_edit_of_a_coefficient_to_no_index_is_an_error(each_variant, value):
    params = mi.traverse(load())
    params["int_ior_A"] = value
    assert "refract: int_ior / ext_ior = " in refusal(params.update)


def test_an_edit_to_no_index_at_another_visible_wavelength_is_an_error(spectral_variant):
    """n = 1.5 − 4e5/λ² is positive from 517 nm on. Wavelengths outside the range of a table do not count."""
    params = mi.traverse(load())
    params["int_ior_B"] = -4e5
    assert "refract: int_ior / ext_ior at 360 nm = nan; expected a ratio from" in refusal(params.update)
    params = mi.traverse(load("table(380: 1.5, 780: 1.6)"))
    params["int_ior_n_780"] = 1.7
    params.update()


def test_directions_have_derivatives_in_the_coefficients(llvm_spectral):
    """A coefficient with two entries is an error."""
    bsdf = load()
    params, (key,) = attached(bsdf, "int_ior_B")
    dr.backward(bsdf.sample(followed_context(), surface(tilted(0.5)), REFRACTED, [0.5, 0.5])[0].wo.x)
    # wo.x = −sin θ / n, so its derivative in B is sin θ / (n λ)²
    assert dr.grad(params[key])[0] == pytest.approx(math.sin(0.5) / (n(450) * 450) ** 2, rel=1e-5)
    params[key] = mi.Float(1, 2)
    with pytest.raises(ValueError, match=r"refract: int_ior_B has 2 entries; expected one number"):
        params.update()


# Paths -----------------------------------------------------------------------------------------------------------

FAR = PLACE().translate([0, 0, 99])


def ball(**parameters):
    return {"type": "sphere", "bsdf": {"type": "refract", "int_ior": GLASS, "ext_ior": 1.0} | parameters}


def scene(resolution=8, light=None, **parts):
    """Return a scene seen from 5 radii away, in a constant environment unless `light` is given."""
    sensor = camera(resolution, 22, component_format="float32")
    return mi.load_dict({"type": "scene", "sensor": sensor, "light": light or {"type": "constant"}} | parts)


def means(made, spp, count, first=0, **parameters):
    """Return the mean colours of `count` independent renders, count × 3."""
    method = {"max_depth": -1, "rr_depth": 10_000} | parameters
    return np.stack([render(made, spp, first + i, **method)[..., :3].mean((0, 1)) for i in range(count)])


@functools.cache
def whites(variant):
    """Return `means` of an empty scene. A ball outside of the view makes the scene dispersive as well."""
    return means(scene(far=ball() | {"to_world": FAR}), 2048, 8, 100)


METHODS = {"by chance": {}, "both lobes": {"split_depth": 2}}
METHODS |= {"deterministic": {"deterministic": True, "split_weight": 1 / 4096}}


@pytest.mark.parametrize("method", METHODS)
def test_glass_is_invisible_in_a_white_furnace(method, spectral_variant):
    """The weight is applied once, also with a second dispersive surface. Bound: five standard deviations."""
    if not dr.is_jit_v(mi.Float):
        pytest.skip("a scalar variant would render for minutes")
    inner = ball(int_ior="cauchy(1.3, 8000)", ext_ior=GLASS) | {"radius": 0.5}
    empty = whites(mi.variant())
    images = means(scene(ball=ball(), inner=inner), 256, 8, **METHODS[method])
    error = np.sqrt((images.var(0, ddof=1) + empty.var(0, ddof=1)) / len(images))
    assert (error < 0.01 * empty.mean(0)).all()
    assert (np.abs(images.mean(0) - empty.mean(0)) < 5 * error).all()


def test_wavelengths_end_only_where_dispersive_glass_refracts(llvm_spectral, monkeypatch):
    """Checked in the final state of the path loop."""
    states, run = [], path_loop.PathLoop.run

    def recording(*arguments):
        states.append(run(*arguments))
        return states[-1]

    monkeypatch.setattr(path_loop.PathLoop, "run", recording)

    def end(made):
        """Return the numbers of wavelengths at the ends of the paths, None without dispersion, and the depths."""
        image = mi.render(made, integrator=mi.load_dict({"type": "refract_path"}), spp=4)
        state = states.pop()
        assert state.sigma is None and state.skipped is None  # fields for absorption
        dr.eval(image, state.depth, state.wavelength_count)
        return None if state.wavelength_count is None else np.array(state.wavelength_count), np.array(state.depth)

    count, depth = end(scene(ball=ball(specular_transmittance=0.0)))
    assert (depth == 2).any() and (count[depth == 2] == 4).all()  # reflected, then the sky
    assert 1 in count[depth == 1]  # refracted, and black
    count, depth = end(scene(ball=ball()))
    assert set(count[depth >= 3].tolist()) == {1.0}  # into the ball, out of it, then the sky
    assert set(count[depth == 2].tolist()) == {4.0}  # reflected
    count, depth = end(scene(ball=ball(int_ior=1.5), far=ball() | {"to_world": FAR}))
    assert (count[depth >= 1] == 4).all()
    assert end(scene(ball=ball(int_ior=1.5)))[0] is None


def test_an_image_equals_a_render_with_the_index_of_its_wavelength(llvm_spectral):
    """The light has a narrow band of 5 nm, and the index there is a number. One false alarm in 10⁶."""
    band = {"type": "irregular", "wavelengths": "447, 447.1, 452.9, 453", "values": "0, 1, 1, 0"}
    place = PLACE().translate([0.5, 0.3, -4]).scale(0.8)
    lamp = {"type": "sphere", "to_world": place, "emitter": {"type": "area", "radiance": band}}
    indices = GLASS, float(media.index(GLASS, 450.0))
    ours, expected = (means(scene(light=lamp, ball=ball(int_ior=x)), 4096, 6, max_depth=16) for x in indices)
    strongest = expected.mean(0).argmax()
    ours, expected = ours[:, strongest], expected[:, strongest]
    error = np.sqrt((ours.var(ddof=1) + expected.var(ddof=1)) / 6)
    assert error < 0.05 * expected.mean()
    assert abs(ours.mean() - expected.mean()) < 5 * error


def test_path_renders_the_d_line_with_one_warning(llvm_spectral, logged):
    number = float(media.index(GLASS, D_LINE))
    dispersive, constant = scene(light=sky(), ball=ball()), scene(light=sky(), ball=ball(int_ior=number))
    scenes = dispersive, constant, dispersive
    images = [render(x, 16, type="path", max_depth=16, rr_depth=100)[..., :3] for x in scenes]
    assert pixelwise.changes(images[1], images[0], 1e-4).share <= 1e-2
    (text,) = [text for text in logged if "expected the integrator refract_path" in text]
    assert "all light has the index of the d line" in text

"""What a scene may say of a material, and the one line that it gets for anything else."""

import math

import drjit as dr
import numpy as np
import pytest

from mi_refract import media
from mi_refract.media import LINES


def one_line(error):
    assert "\n" not in str(error.value)
    return str(error.value)


def test_names_of_mitsuba_are_its_numbers(needs_variant):
    import mitsuba as mi

    needs_variant("scalar_rgb")
    mi.set_variant("scalar_rgb")
    assert media.index("bk7", 500.0) == media.index("bk7", 600.0) == 1.5046
    assert media.index("air", 500.0) == 1.000277
    assert not media.parse("diamond").dispersive


BAD = {
    "cauchy(1.5, nan)": r"expected cauchy\(A, B, …\), λ in nm, up to 8, finite numbers",
    "cauchy()": r"expected cauchy\(A, B, …\)",
    "cauchy(1,2,3,4,5,6,7,8,9)": "up to 8",
    "cauchy(1, -1e6)": "n is not positive at 360 nm; expected a positive index everywhere in 360 … 830 nm",
    "cauchy(1, 2": r"expected cauchy\(…\), sellmeier\(…\), sellmeier_nm\(…\), abbe\(…\), table\(…\)",
    "sine(1, 2)": r"expected cauchy\(…\)",
    "sellmeier(1)": "as many C in nm² as B",
    "sellmeier(1, 0.01)": "C1 = 0.01; expected nm²; from µm² multiply by 1e6",
    "sellmeier(1, -0.01)": "C1 = -0.01; expected nm²",
    "sellmeier(1, 1, 10000, 250000)": "C2: n is infinite at 500 nm; expected no pole in 360 … 830 nm",
    "sellmeier(-1.5, 10000)": "n is not positive at 360 nm",
    "sellmeier_nm(1, 0.1)": "L1 = 0.1; expected nm; from µm multiply by 1e3",
    "sellmeier_nm(1, -100)": "L1 = -100; expected nm",
    "sellmeier_nm(1, 500)": "L1: n is infinite at 500 nm",
    "abbe(1.5)": r"expected abbe\(n_d, V_d\)",
    "abbe(1.5, 0)": "V_d = 0; expected",
    "table(500: 1.5)": "two or more, wavelengths in nm, increasing",
    "table(500: 1.5, 400: 1.5)": "increasing",
    "table(500: 1.5, 500: 1.6)": "increasing",
    "table(0: 1.5, 500: 1.6)": "increasing",
    "table(400: 1.5, inf: 1.6)": "increasing",
    "table(400, 500)": "expected table",
    "table(400: 1.5, 500: 0)": "n = 0 at 500 nm; expected a positive finite index",
    "table(400: 1.5, 500: nan)": "n = nan at 500 nm",
    "MATERIAL:wader": "unknown material; nearest: MATERIAL:water, ",
    "FOO:BAR": "expected these, or CDGM:…, HIKARI:…",
    0: "expected a positive finite number, or a material's name",
    -1.5: "expected a positive finite number",
    math.inf: "expected a positive finite number",
    math.nan: "expected a positive finite number",
    None: "expected a positive finite number",
    True: "expected a positive finite number",
}


@pytest.mark.parametrize(("spec", "said"), BAD.items(), ids=map(repr, BAD))
def test_what_is_refused_is_said_in_one_line_with_the_parameter(spec, said):
    with pytest.raises(ValueError, match=said) as error:
        media.parse(spec, "refract: int_ior")
    assert one_line(error).startswith(f"refract: int_ior = {spec!r}")


def test_poles_outside_the_visible_end_the_range():
    found = media.parse("sellmeier_nm(1, 0.01, 200, 9000)")
    assert found.valid == pytest.approx((200, 9000))


@pytest.mark.parametrize("wavelength", [399.0, 901.0, math.nan, math.inf, -500.0, 0.0])
def test_outside_its_range_a_medium_has_no_index(wavelength, vectorised):
    found = media.parse("table(400: 1.53, 900: 1.5)")
    with pytest.raises(ValueError, match=r"no index at .* nm; expected a wavelength from 400 to 900 nm") as error:
        found.index(wavelength)
    one_line(error)
    with pytest.raises(ValueError, match="no index at"):
        found.index(np.array([500.0, wavelength]))
    lanes = np.array(found.index(dr.value_t(vectorised.vector)(500.0, wavelength)))
    assert np.isfinite(lanes[0]) and np.isnan(lanes[1])
    assert math.isnan(found.index_or_nan(wavelength))
    assert found.index(400.0) == 1.53 and found.index(900.0) == 1.5


def test_a_coefficient_that_makes_n_negative_gives_no_index():
    assert math.isnan(media.parse("cauchy(1, 2000)").index_or_nan(500.0, {"A": -1.0}))


# Air and vacuum.

GLASS = 1.5


def in_air(n):
    return media.Medium("glass", media.parse(n).dispersion, {"n": n}, relative_to="air")


def named(name):
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    return media.parse(name)


def test_beside_a_glass_of_a_catalogue_air_has_the_index_1(needs_variant):
    needs_variant("scalar_rgb")
    assert media.relative_index(in_air(GLASS), named("air"), 500.0) == GLASS
    assert media.relative_index(named("air"), in_air(GLASS), 500.0) == 1 / GLASS
    assert media.relative_index(in_air(GLASS), media.parse("AIR:ciddor"), 500.0) == GLASS


def test_beside_vacuum_a_glass_of_a_catalogue_has_its_index_in_vacuum(needs_variant):
    """Air at 20 °C and 101325 Pa: n − 1 = 2.71800e-4 at 633 nm, between the lines of Ciddor's table."""
    needs_variant("scalar_rgb")
    assert media.relative_index(in_air(GLASS), named("vacuum"), 633.0) == pytest.approx(GLASS * 1.00027180, rel=2e-8)
    assert media.relative_index(named("vacuum"), in_air(GLASS), 633.0) == pytest.approx(
        1 / (GLASS * 1.00027180), rel=2e-8
    )
    water = media.parse("MATERIAL:water")
    expected = GLASS * 1.00027180 / water.index(633.0)
    assert media.relative_index(in_air(GLASS), water, 633.0) == pytest.approx(expected, rel=2e-8)


def test_of_media_of_one_kind_the_ratio_is_that_of_the_numbers():
    assert media.relative_index(in_air(1.6), in_air(1.5), 500.0) == 1.6 / 1.5
    assert media.relative_index(media.parse(1.6), in_air(1.5), 500.0) == 1.6 / 1.5


def test_where_a_medium_has_no_index_the_ratio_is_nan():
    found = media.parse("table(400: 1.53, 900: 1.5)")
    for pair in ((found, media.parse(1.0)), (media.parse(1.0), found), (found, media.parse("AIR:ciddor"))):
        assert math.isnan(media.relative_index(*pair, 300.0))
    assert math.isnan(media.relative_index(in_air(1.5), media.parse("AIR:ciddor"), 2000.0))  # where no air is known


def test_coefficients_of_a_ratio_may_be_arrays(vectorised):
    glass, outside = media.parse("cauchy(1.5, 3000)"), media.parse("cauchy(1.3, 0)")
    wide = dr.float64_array_t(dr.value_t(vectorised.vector))
    found = media.relative_index(
        glass, outside, dr.value_t(vectorised.vector)(500.0), {"A": wide(1.6)}, {"A": wide(1.2)}
    )
    assert np.array(found)[0] == pytest.approx((1.6 + 3000 / 500**2) / 1.2, rel=1e-15)


# Materials, against numbers that were printed elsewhere than their formulas.

PRINTED = [
    ("AIR:ciddor", 633.0, 1.0002765, 6e-8),
    ("AIR:edlen", 632.9908, 1.00027652, 6e-9),
    ("MATERIAL:fused-silica", LINES["d"], 1.45846, 5e-6),  # Malitson's table
    ("MATERIAL:fused-silica", LINES["C"], 1.45637, 5e-6),
    ("MATERIAL:fused-silica", LINES["F"], 1.46313, 5e-6),
    ("MATERIAL:water", LINES["D"], 1.33299 * 1.00027, 2e-5),  # relative to air 1.33299 at 20 °C
    ("MATERIAL:diamond", LINES["D"], 2.4173, 3e-4),
]


@pytest.mark.parametrize(("name", "wavelength", "n", "bound"), PRINTED)
def test_materials_have_the_printed_index(name, wavelength, n, bound):
    assert media.index(name, wavelength) == pytest.approx(n, abs=bound)


def test_materials_are_named_in_any_case():
    assert media.parse("material:Water") is media.parse("MATERIAL:water")

"""Indices of materials: formulas against the same ones for single numbers, catalogues and materials against published
values, and errors of one line for anything else."""

import math
import re
import sys
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from support.readme import DOCS, python_blocks

from mi_refract import media
from mi_refract.media import LINES

# N-BK7 by Schott: coefficients printed for micrometres.
B = 1.03961212, 0.231792344, 1.01046945
C = 0.00600069867, 0.0200179144, 103.560653
SELLMEIER = f"sellmeier({B[0]}, {B[1]}, {B[2]}, {C[0] * 1e6}, {C[1] * 1e6}, {C[2] * 1e6})"
RESONANCES = f"sellmeier_nm({B[0]}, {B[1]}, {B[2]}, {', '.join(repr(1e3 * math.sqrt(c)) for c in C)})"
MICROMETRES = f"sellmeier_um({', '.join(map(str, (*B, *C)))})"  # as catalogues print them
TABLE = "table(400: 1.53, 500: 1.52, 900: 1.5)"


def bk7(w):
    square = (w / 1000) ** 2
    return math.sqrt(1 + sum(b * square / (square - c) for b, c in zip(B, C, strict=True)))


def abbe(w, n_d=1.5168, v_d=64.17):
    return n_d + (n_d - 1) / v_d * (w**-2 - LINES["d"] ** -2) / (LINES["F"] ** -2 - LINES["C"] ** -2)


CLOSED = {
    "1.5": lambda w: 1.5,
    "cauchy(1.458, 3540, 1e7)": lambda w: 1.458 + 3540 / w**2 + 1e7 / w**4,
    "cauchy_um(1.458, 0.00354, 1e-5)": lambda w: 1.458 + 3540 / w**2 + 1e7 / w**4,
    SELLMEIER: bk7,
    MICROMETRES: bk7,
    RESONANCES: bk7,
    "abbe(1.5168, 64.17)": abbe,
    "517642": lambda w: abbe(w, 1.517, 64.2),
    "003-283": lambda w: abbe(w, 2.003, 28.3),
    TABLE: lambda w: float(np.interp(w, [400, 500, 900], [1.53, 1.52, 1.5])),
    "table_um(0.4: 1.53, 0.5: 1.52, 0.9: 1.5)": lambda w: float(np.interp(w, [400, 500, 900], [1.53, 1.52, 1.5])),
    f"hold( {TABLE} )": lambda w: float(np.interp(w, [400, 500, 900], [1.53, 1.52, 1.5])),
}
medium = media.parse


@pytest.fixture(params=list(CLOSED), ids=lambda spec: spec.partition("(")[0])
def spec(request):
    return request.param


# Formulas --------------------------------------------------------------------------------------------------------


def test_the_index_equals_the_formula(spec):
    """For floats, and for numpy arrays, which keep their shape."""
    wavelengths = np.array([[410.0, 500.0, 505.0], [587.5618, 700.0, 899.0]])
    expected = np.array([[CLOSED[spec](w) for w in row] for row in wavelengths])
    np.testing.assert_allclose(medium(spec).index(wavelengths), expected, rtol=4e-16)
    for w, n in zip(wavelengths.ravel().tolist(), expected.ravel(), strict=True):
        assert medium(spec).index(w) == pytest.approx(n, rel=4e-16)
        assert type(medium(spec).index(w)) is float
    assert medium(spec).dispersive == (spec != "1.5")


def test_arrays_of_drjit_are_evaluated_in_double_precision(spec, setting):
    number, wavelengths = dr.value_t(setting.vector), (410.0, 500.0, 700.0)
    n = medium(spec).index(number(*wavelengths) if dr.is_jit_v(number) else number(wavelengths[0]))
    assert dr.type_v(n) == dr.VarType.Float64 or not dr.is_array_v(n)
    n = np.atleast_1d(np.array(n, dtype=float)).ravel()
    np.testing.assert_allclose(n, [CLOSED[spec](w) for w in wavelengths][: len(n)], rtol=4e-16)


def test_drjit_differentiates_in_the_wavelength_and_the_coefficients(spec, vectorised):
    """Against central differences, between the knots of the table."""
    glass = medium(spec)
    wide = dr.float64_array_t(dr.diff_array_t(dr.value_t(vectorised.vector)))
    for at in (450.0, 620.0):
        w, c = wide(at), {name: wide(value) for name, value in glass.coefficients.items()}
        dr.enable_grad(w, *c.values())
        dr.backward(glass.index(w, c))
        slope = (CLOSED[spec](at + 1e-3) - CLOSED[spec](at - 1e-3)) / 2e-3
        assert dr.grad(w)[0] == pytest.approx(slope, rel=1e-6, abs=1e-12)
        for name, value in glass.coefficients.items():
            step = 1e-5 * abs(value)
            ends = [glass.index(at, {name: value + sign * step}) for sign in (1, -1)]
            assert dr.grad(c[name])[0] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-5, abs=1e-10), name


def test_coefficients_of_drjit_are_differentiated_at_wavelengths_of_numpy(spec, vectorised):
    glass = medium(spec)
    wide = dr.float64_array_t(dr.diff_array_t(dr.value_t(vectorised.vector)))
    for at in (450.0, np.array([450.0, 620.0])):
        c = {name: wide(value) for name, value in glass.coefficients.items()}
        dr.enable_grad(*c.values())
        dr.backward(dr.sum(glass.index(at, c)))
        for name, value in glass.coefficients.items():
            step = 1e-5 * abs(value)
            ends = [np.sum(glass.index(at, {name: value + sign * step})) for sign in (1, -1)]
            assert dr.grad(c[name])[0] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-5, abs=1e-10), name


def test_a_coefficient_of_another_name_is_an_error(vectorised):
    for wavelength in (500.0, np.array([500.0]), dr.value_t(vectorised.vector)(500)):
        with pytest.raises(ValueError, match=r"cauchy.*: unknown coefficient b; expected A, B"):
            media.parse("cauchy(1.5, 3000)").index(wavelength, {"b": 4000.0})


def test_a_table_has_its_values_at_its_knots():
    """Also for knots that agree in nine digits."""
    assert [media.index(TABLE, w) for w in (400.0, 500.0, 900.0)] == [1.53, 1.52, 1.5]
    close = math.nextafter(500.0, 600)
    material = media.parse(f"table(400: 1.5, 500: 1.5, {close!r}: 1.6, 600: 1.7)")
    assert [material.index(w) for w in (400.0, 450.0, 500.0, close, 600.0)] == [1.5, 1.5, 1.5, 1.6, 1.7]
    assert len(material.coefficients) == 4


def test_a_table_of_many_knots_is_searched_in_a_small_kernel(vectorised):
    """The search is exact, and takes 10 steps for 1000 knots."""
    number, counts = dr.value_t(vectorised.vector), []
    for count in (4, 1000):
        knots = np.linspace(400, 800, count)
        indices = 1.5 + np.sin(knots) / 9
        pairs = zip(knots.tolist(), indices.tolist(), strict=True)
        material = media.parse("table(" + ", ".join(f"{w!r}: {n!r}" for w, n in pairs) + ")")
        at = np.linspace(400, 800, 5000).astype(np.float32)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            n = material.index(number(at))
            dr.eval(n)
            counts.append(max(kernel.get("operation_count", 0) for kernel in dr.kernel_history()))
        expected = np.interp(at.astype(np.float64), knots, indices)
        np.testing.assert_allclose(np.array(n), expected, rtol=4e-16)
        np.testing.assert_allclose(material.index(at), expected, rtol=4e-16)
    assert counts[1] < 5 * counts[0]


def test_a_value_of_a_table_may_differ_from_lane_to_lane(vectorised):
    number = dr.float64_array_t(dr.value_t(vectorised.vector))
    values = {"n_500": number(1.52, 1.6, 1.7)}
    material = media.parse(TABLE).index(number(500, 500, 450), values)
    np.testing.assert_allclose(material, [1.52, 1.6, (1.53 + 1.7) / 2], rtol=4e-16)


@pytest.mark.parametrize("wavelength", [399.0, 901.0, math.nan, math.inf, -500.0, 0.0])
def test_a_medium_has_no_index_outside_its_range(wavelength, vectorised):
    material = media.parse("table(400: 1.53, 900: 1.5)")
    for wavelengths in (wavelength, np.array([500.0, wavelength])):
        with pytest.raises(ValueError, match=r"no index at .* nm; expected a wavelength from 400 to 900 nm") as error:
            material.index(wavelengths)
        assert "\n" not in str(error.value)
    lanes = np.array(material.index(dr.value_t(vectorised.vector)(500.0, wavelength)))
    assert np.isfinite(lanes[0]) and np.isnan(lanes[1])
    assert math.isnan(material.index_or_nan(wavelength))
    assert material.index(400.0) == 1.53 and material.index(900.0) == 1.5


@pytest.mark.parametrize("spec", [spec for spec in CLOSED if spec != "1.5" and not spec.startswith("hold")])
def test_a_formula_has_no_index_at_a_wavelength_in_micrometres(spec):
    with pytest.raises(ValueError, match=r"no index at 0.5876 nm; expected a wavelength from .* nm"):
        media.index(spec, 0.5876)


# Invalid specifications ------------------------------------------------------------------------------------------

BAD = {
    "cauchy(1.5, nan)": r"expected cauchy\(A, B, …\), λ in nm, up to 8, finite numbers",
    "cauchy(1_5, 0)": r"expected cauchy\(A, B, …\), λ in nm, up to 8, finite numbers",
    "table(4_00: 1.5, 500: 1.5)": "expected table",
    "cauchy()": r"expected cauchy\(A, B, …\)",
    "cauchy(1,2,3,4,5,6,7,8,9)": "up to 8",
    "cauchy(1, -1e6)": "n is not positive at 360 nm; expected a positive index everywhere in 360 … 830 nm",
    "cauchy(1, 2": r"expected cauchy\(…\), sellmeier\(…\), sellmeier_nm\(…\), abbe\(…\), table\(…\)",
    "sine(1, 2)": r"expected cauchy\(…\)",
    "sellmeier(1)": "as many C in nm² as B",
    "sellmeier(1, 0.01)": r"C1 = 0.01; expected nm²; from µm² multiply by 1e6, or write sellmeier_um\(…\)",
    "sellmeier_um(1, 1, 6000, 20000)": r"C1 = 6000; expected µm²; from nm² write sellmeier\(…\)",
    "cauchy(1.5046, 0.0042)": r"B = 0.0042; expected nm²; from µm² multiply by 1e6, or write cauchy_um\(…\)",
    "cauchy(1.5, 4000, 1e-5)": "C = 1e-05; expected nm⁴; from µm⁴ multiply by 1e12, or",
    "cauchy_um(1.5, 4200)": "n = 32408.9 at 360 nm; expected up to 10 in 360 … 830 nm; coefficients in another unit",
    "abbe_um(1.5, 64)": r"or with _um, such as table_um\(…\)",
    "abbe(64.2, 1.517)": r"n_d = 64.2, V_d = 1.517; expected n_d first: abbe\(1.517, 64.2\)",
    "abbe(0.9, 64)": "n_d = 0.9; expected an index above 1, up to 10",
    "abbe(1.5, 500)": "V_d = 500; expected .*, from 5 to 200",
    "517000": "V_d = 0; expected",
    "table(0.4: 1.53, 0.7: 1.51)": r"the first wavelength = 0.4; expected nm; from µm write table_um\(…\)",
    "table_um(400: 1.53, 700: 1.51)": r"the first wavelength = 400; expected µm; from nm write table\(…\)",
    "hold(table(400: 1.53))": "two or more wavelengths",
    "N-BK7": "unknown material; a glass needs the name of its manufacturer: SCHOTT:N-BK7$",
    "s-bsl7": "the name of its manufacturer: OHARA:S-BSL 7$",
    "nan": "expected a positive finite number, or a material's name",
    "-1.5": "expected a positive finite number",
    "sellmeier(1, -0.01)": "C1 = -0.01; expected nm²",
    "sellmeier(1, 1, 10000, 250000)": "C2: n is infinite at 500 nm; expected no pole in 360 … 830 nm",
    "sellmeier(-1.5, 10000)": "n is not positive at 360 nm",
    "sellmeier_nm(1, 0.1)": "L1 = 0.1; expected nm; from µm multiply by 1e3",
    "sellmeier_nm(1, -100)": "L1 = -100; expected nm",
    "sellmeier_nm(1, 500)": "L1: n is infinite at 500 nm",
    "abbe(1.5)": r"expected abbe\(n_d, V_d\)",
    "abbe(1.5, 0)": "V_d = 0; expected",
    "table(500: 1.5)": "two or more wavelengths, increasing",
    "table(500: 1.5, 400: 1.5)": "increasing",
    "table(500: 1.5, 500: 1.6)": "increasing",
    "table(0: 1.5, 500: 1.6)": "increasing",
    "table(400: 1.5, inf: 1.6)": "increasing",
    "table(400, 500)": "expected table",
    "table(400: 1.5, 500: 0)": "n = 0 at 500 nm; expected a positive finite index",
    "table(400: 1.5, 500: nan)": "n = nan at 500 nm",
    "MATERIAL:wader": "unknown material; nearest: MATERIAL:water, ",
    "FOO:BAR": "expected these, or CDGM:…, HIKARI:…",
    517642: "expected an index; the code of a glass is a text: '517642'",
    0: "expected a positive finite number, or a material's name",
    -1.5: "expected a positive finite number",
    math.inf: "expected a positive finite number",
    math.nan: "expected a positive finite number",
    None: "expected a positive finite number",
    True: "expected a positive finite number",
}


@pytest.mark.parametrize(("spec", "message"), BAD.items(), ids=map(repr, BAD))
def test_errors_are_one_line_with_the_parameter(spec, message):
    with pytest.raises(ValueError, match=message) as error:
        media.parse(spec, "refract: int_ior")
    assert str(error.value).startswith(f"refract: int_ior = {spec!r}") and "\n" not in str(error.value)


def test_only_formulas_and_files_are_limited_to_an_index_of_10():
    assert media.index("12", 500.0) == media.index(12, 500.0) == media.index("12", 0.5) == 12
    with pytest.raises(ValueError, match="expected up to 10 in 360 … 830 nm"):
        media.parse("cauchy(12)")


def test_poles_outside_the_visible_limit_the_range():
    assert media.parse("sellmeier_nm(1, 0.01, 200, 9000)").valid == pytest.approx((200, 9000))
    assert math.isnan(media.parse("cauchy(1, 2000)").index_or_nan(500.0, {"A": -1.0}))


def test_the_values_of_the_page(llvm_variant):
    (code,) = python_blocks(DOCS / "how-to/dispersion-and-coloured-glass.md")
    exec(code, names := {})
    values = re.findall(r"^(.*\S)  # (1\.\d{5}|\(.*?\))", code, re.MULTILINE)
    assert len(values) == 4
    for text, value in values:
        assert eval(text, names) == pytest.approx(eval(value), abs=5e-6)


@pytest.fixture
def named(scalar_variant):
    """`media.parse` in a variant where names have the numbers of Mitsuba's table."""
    assert media.index("bk7", 500.0) == media.index("bk7", 600.0) == 1.5046
    assert media.index("air", 500.0) == 1.000277
    assert not media.parse("diamond").dispersive
    return media.parse


# Air and vacuum --------------------------------------------------------------------------------------------------

ratio = media.relative_index


def in_air(n):
    return media.Medium("glass", media.parse(n).dispersion, {"n": n}, relative_to="air")


def test_next_to_a_catalogue_glass_air_has_the_index_1(named):
    glass, ciddor = in_air(1.5), media.parse("AIR:ciddor")
    pairs = (glass, named("air")), (glass, named("Air")), (named("air"), glass), (glass, ciddor)
    assert [ratio(*pair, 500.0) for pair in pairs] == [1.5, 1.5, 1 / 1.5, 1.5]
    assert ratio(in_air(1.6), glass, 500.0) == ratio(media.parse(1.6), glass, 500.0) == 1.6 / 1.5
    assert math.isnan(ratio(glass, ciddor, 2000.0))  # outside the range of Ciddor's formula


def test_next_to_vacuum_a_catalogue_glass_has_its_index_in_vacuum(named):
    """Air at 20 °C and 101325 Pa: n − 1 = 2.71800e-4 at 633 nm, between the lines of Ciddor's table."""
    glass, water, expected = in_air(1.5), media.parse("MATERIAL:water"), 1.5 * 1.00027180
    for name in ("vacuum", "Vacuum"):
        assert ratio(glass, named(name), 633.0) == pytest.approx(expected, rel=2e-8)
    assert ratio(named("vacuum"), glass, 633.0) == pytest.approx(1 / expected, rel=2e-8)
    assert ratio(glass, water, 633.0) == pytest.approx(expected / water.index(633.0), rel=2e-8)
    edlen = replace(media.parse("AIR:edlen"), valid=(200.0, math.inf))
    for wavelength in (200.0, 1700.0, 2500.0, 1e4):  # outside the range of Ciddor's formula
        expected = 1.5 * (1 + (edlen.index(wavelength) - 1) * 288.15 / 293.15)
        assert ratio(glass, named("vacuum"), wavelength) == pytest.approx(expected, abs=5e-7)
    assert math.isnan(ratio(glass, named("vacuum"), 199.0))


def test_the_ratio_is_nan_if_a_medium_has_no_index():
    table, one = media.parse(TABLE), media.parse(1.0)
    for pair in ((table, one), (one, table), (table, media.parse("AIR:ciddor"))):
        assert math.isnan(ratio(*pair, 300.0))


def test_coefficients_of_a_ratio_may_be_arrays(vectorised):
    pair, number = (media.parse("cauchy(1.5, 3000)"), media.parse("cauchy(1.3, 0)")), dr.value_t(vectorised.vector)
    wide = dr.float64_array_t(number)
    k = ratio(*pair, number(500.0), {"A": wide(1.6)}, {"A": wide(1.2)})
    assert np.array(k)[0] == pytest.approx((1.6 + 3000 / 500**2) / 1.2, rel=1e-15)


@pytest.mark.parametrize(
    ("name", "wavelength", "n", "bound"),
    [
        ("AIR:ciddor", 633.0, 1.0002765, 6e-8),
        ("AIR:edlen", 632.9908, 1.00027652, 6e-9),
        ("MATERIAL:fused-silica", LINES["d"], 1.45846, 5e-6),  # Malitson's table
        ("MATERIAL:fused-silica", LINES["C"], 1.45637, 5e-6),
        ("MATERIAL:fused-silica", LINES["F"], 1.46313, 5e-6),
        ("MATERIAL:water", LINES["D"], 1.33299 * 1.00027, 2e-5),  # relative to air 1.33299 at 20 °C
        ("MATERIAL:diamond", LINES["D"], 2.4173, 3e-4),
    ],
)
def test_materials_have_their_published_index(name, wavelength, n, bound):
    assert media.index(name, wavelength) == pytest.approx(n, abs=bound)
    assert media.parse(name.title()) is media.parse(name)


# Catalogues of glass ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("glass", "n_d", "v_d"),
    [
        ("SCHOTT:N-BK7", 1.51680, 64.17),
        ("SCHOTT:N-SF11", 1.78472, 25.68),
        ("SCHOTT:F2", 1.62004, 36.37),
        ("OHARA:S-BSL 7", 1.51633, 64.14),
        ("HOYA:FCD1", 1.49700, 81.61),
        ("HIKARI:J-BK7A", 1.51680, 64.14),
        ("CDGM:H-K9L", 1.51680, 64.20),
        ("SUMITA:K-BK7", 1.51633, 64.1),
        ("abbe(1.5168, 64.17)", 1.51680, 64.17),
    ],
)
def test_n_d_and_v_d_are_those_of_the_manufacturer(glass, n_d, v_d):
    """To half a unit of the fifth decimal plus 1e-6."""
    n = {line: media.index(glass, LINES[line]) for line in "dFC"}
    assert n["d"] == pytest.approx(n_d, abs=6e-6)
    assert (n["d"] - 1) / (n["F"] - n["C"]) == pytest.approx(v_d, abs=0.06 if ":" in glass else 1e-10)


@pytest.mark.parametrize(
    ("glass", "low", "high"), [("SCHOTT:N-BK7", 290, 2500), ("SCHOTT:F2", 320, 2500), ("HOYA:FCD515", 320, 2500)]
)
def test_the_range_of_a_glass_is_that_of_its_printed_indices_and_transmittances(glass, low, high):
    """For F2 the printed transmittance of 10 mm at 310 nm is 0."""
    assert media.parse(glass).valid == (low, high)
    for beyond in (low - 10.0, high + 500.0):
        message = f"{glass}: no index at {beyond:g} nm; expected a wavelength from {low} to"
        with pytest.raises(ValueError, match=message):
            media.index(glass, beyond)


@pytest.mark.parametrize(
    ("glass", "valid", "fitted", "beyond"),
    [
        ("CDGM:D-ZF93", (400, 2400), (404, 1014), 2325.0),  # there the index is 1.9250 and the formula gives 1.9150
        ("HOYA:BSC7", (280, 1550), (365, 1014), 1530.0),
        ("SCHOTT:N-BK7", (290, 2500), (365, 2326), 334.1),
        ("OHARA:S-BSL 7", (290, 2400), (365, 2325), 2400.0),
    ],
)
def test_an_index_outside_the_fitted_range_is_a_warning(glass, valid, fitted, beyond):
    material = media.parse(glass)
    assert (material.valid, material.fitted, material.relative_to) == (valid, fitted, "air")
    for inside in fitted:
        material.index(inside)
    message = f"{glass}: the index at {beyond:g} nm is an extrapolation; .* {fitted[0]} to {fitted[1]} nm"
    for wavelength in (beyond, [fitted[0], beyond]):
        with pytest.warns(UserWarning, match=message):
            material.index(wavelength)


def test_names_of_glasses_ignore_case_and_errors_suggest_names():
    assert media.parse("schott:n-bk7").name == "SCHOTT:N-BK7"
    assert media.parse("OHARA:S-BSL7").name == media.parse("ohara: s-bsl 7").name == "OHARA:S-BSL 7"
    text = "^int_ior = 'SCHOTT:N-BK8': unknown glass; expected one of the .*nearest: SCHOTT:N-BK7, SCHOTT:[^,]+, SCHO"
    with pytest.raises(ValueError, match=text):
        media.parse("SCHOTT:N-BK8", "int_ior")
    with pytest.raises(ValueError, match="its catalogue has no formula for this glass; use another glass, or table"):
        media.parse("HIKARI:J-PSKH8")


# Files -----------------------------------------------------------------------------------------------------------

PAGE = "DATA:\n  - type: {}\n    wavelength_range: 0.3 2.5\n    coefficients: {}\n"
NK = "DATA:\n  - type: tabulated nk\n    data: |\n        0.4 1.53 1e-7\n        0.5 1.52 2e-7\n        0.9 1.5 3e-7\n"
SELLMEIER_2 = f"0 {B[0]} {C[0]} {B[1]} {C[1]} {B[2]} {C[2]}"
SELLMEIER_1 = f"0 {B[0]} {C[0] ** 0.5!r} {B[1]} {C[1] ** 0.5!r} {B[2]} {C[2] ** 0.5!r}"
ZEMAX = """CC a catalogue
NM OTHER 2 0 1.6 36 0 1
CD 1 0.01
NM X-1 {} 517642 1.517 64.2 0 1
CD {}
TD 0 0 0 0 0 0
LD 0.3 2.5
"""


def interpolated(w):
    return float(np.interp(w, [400, 500, 900], [1.53, 1.52, 1.5]))


def powers(*pairs, exponent=0.5):
    """n or n² = Σ a λ^p, λ in µm."""
    return lambda w: sum(a * (w / 1000) ** p for a, p in pairs) ** exponent


def gas(w):
    return 1 + 1e-8 * (5792105 / (238.0185 - (w / 1000) ** -2) + 167917 / (57.362 - (w / 1000) ** -2))


SCHOTT_1992 = powers((2.27, 0), (-0.01, 2), (0.0105, -2), (1e-4, -4))
LONG = (2.27, 0), (-0.01, 2), (0.0105, -2), (1e-4, 4)
FILES = {
    "nm.csv": ('# mine\n"Wavelength (nm)","n","k"\n400,1.53,0\n500,1.52,0\n900,1.5,1e-3\n', interpolated),
    "um.csv": ("k;wl_µm;n\n0;0.4;1.53\n0;0.5;1.52\n0;0.9;1.5\n", interpolated),
    "nk.yml": (NK, interpolated),
    "1.yml": (PAGE.format("formula 1", SELLMEIER_1), bk7),
    "2.yml": (PAGE.format("formula 2", SELLMEIER_2), bk7),
    "3.yml": (PAGE.format("formula 3", "2.27 -0.01 2 0.0105 -2 1e-4 -4"), SCHOTT_1992),
    "5.yaml": (
        PAGE.format("formula 5", "1.5 0.004 -2 1e-3 -3.5"),
        powers((1.5, 0), (4e-3, -2), (1e-3, -3.5), exponent=1),
    ),
    "5.yml": (  # powers that agree in six digits
        PAGE.format("formula 5", "1.5 0.004 -1.0000001 1e-3 -1.0000002"),
        powers((1.5, 0), (4e-3, -1.0000001), (1e-3, -1.0000002), exponent=1),
    ),
    "6.yml": (PAGE.format("formula 6", "0 0.05792105 238.0185 0.00167917 57.362"), gas),
    "1.agf:x-1": (ZEMAX.format(1, "2.27 -0.01 0.0105 1e-4 0 0"), SCHOTT_1992),
    "2.agf:X-1": (ZEMAX.format(2, f"{B[0]} {C[0]} {B[1]} {C[1]} {B[2]} {C[2]} 0 0"), bk7),
    "5.AGF:X-1": (ZEMAX.format(5, "1.5 0.004 1e-3"), powers((1.5, 0), (0.004, -1), (1e-3, -3.5), exponent=1)),
    "11.agf:X-1": (ZEMAX.format(11, f"{B[0]} {C[0]} {B[1]} {C[1]} {B[2]} {C[2]} 0 0 0 0"), bk7),
    "12.agf:X-1": (ZEMAX.format(12, "2.27 -0.01 0.0105 0 0 0 1e-4 1e-5"), powers(*LONG, (1e-5, 6))),
    "13.agf:X-1": (ZEMAX.format(13, "2.27 -0.01 1e-4 0.0105"), powers(*LONG)),
}


@pytest.mark.parametrize("name", FILES)
def test_reading_an_index_from_a_file(name, tmp_path, vectorised):
    """Also in a folder with a colon in its name, in UTF-16 as Zemax writes it, and for Dr.Jit arrays."""
    folder = tmp_path / "a:b (c)"
    folder.mkdir()
    (folder / name.partition(":")[0]).write_text(FILES[name][0], "utf-16" if name.startswith("11.agf") else "utf-8")
    material = media.parse(f"file:{folder}/{name}")
    wavelengths = [410.0, 505.0, 700.0]
    expected = [FILES[name][1](w) for w in wavelengths]
    np.testing.assert_allclose(material.index(np.array(wavelengths)), expected, rtol=1e-14)
    np.testing.assert_allclose(material.index(dr.value_t(vectorised.vector)(*wavelengths)), expected, rtol=1e-14)
    assert material.valid == ((400, 900) if FILES[name][1] is interpolated else (300, 2500))
    assert material.relative_to == ("air" if "agf" in name.lower() else "")
    assert media.file_in(f"hold( file:{folder}/{name})") == f"{folder}/{name.partition(':')[0]}"


ENDS = {
    "a.csv": "wl_µm,n\n0.3597,1.5\n1.001,1.4\n",
    "a.yml": NK.replace("0.4 ", "0.3597 ").replace("0.9 ", "1.001 "),
    "b.yml": PAGE.format("formula 2", SELLMEIER_2).replace("0.3 2.5", "0.3597 1.001"),
    "a.agf:X-1": FILES["1.agf:x-1"][0].replace("0.3 2.5", "0.3597 1.001"),
}


@pytest.mark.parametrize("name", ["", *ENDS])
def test_a_range_in_micrometres_contains_its_ends(name, tmp_path):
    """In float64, 1000 · 0.3597 is more than 359.7, and 1000 · 1.001 is less than 1001."""
    if name:
        (tmp_path / name.partition(":")[0]).write_text(ENDS[name], "utf-8")
    material = media.parse(f"file:{tmp_path}/{name}" if name else "table_um(0.3597: 1.5, 1.001: 1.4)")
    assert material.valid == (359.7, 1001)
    assert np.isfinite(material.index(np.array([359.7, 1001.0]))).all()


@pytest.mark.parametrize(
    ("conditions", "relative"),
    [("SPECS:\n    n_absolute: false\n", "air"), ("CONDITIONS:\n    n_is_absolute: true\n", "vacuum"), ("", "")],
)
def test_reading_k_and_the_reference_medium(conditions, relative, tmp_path):
    table = "  - type: tabulated k\n    data: |\n        0.4 1e-8\n        0.8 2e-8\n"
    page = PAGE.format("formula 2", SELLMEIER_2) + table + conditions
    (tmp_path / "glass.yml").write_text(page)
    material = media.parse("file:glass.yml", find=lambda name: tmp_path / name)
    assert (material.relative_to, material.k, material.valid) == (relative, ((400, 800), (1e-8, 2e-8)), (300, 2500))
    (tmp_path / "nk.yml").write_text(NK)
    held = media.parse(f"hold(file:{tmp_path}/nk.yml)")
    assert (held.k, held.hold) == (((400, 500, 900), (1e-7, 2e-7, 3e-7)), True)


def test_the_error_without_yaml_names_the_extra(tmp_path, monkeypatch):
    (tmp_path / "glass.yml").write_text(NK)
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(ImportError, match=r"YAML needs PyYAML: pip install 'mi-refract\[yaml\]'"):
        media.parse(f"file:{tmp_path}/glass.yml")


def test_hold_extends_an_index_beyond_its_range_with_a_warning(vectorised):
    material = media.parse(f"hold({TABLE})")
    with pytest.warns(UserWarning, match="the index at 390 nm is that of the end of its range, 400 to 900 nm"):
        assert material.index(390.0) == 1.53
    assert np.array(material.index(dr.value_t(vectorised.vector)(390, 400, 1000))).tolist() == [1.53, 1.53, 1.5]
    assert math.isnan(material.index_or_nan(math.nan)) and math.isnan(material.index_or_nan(-1.0))


BAD_FILES = {
    "no.csv": (None, "No such file"),
    "a.csv": ("wl,n\n0.4,1.5\n0.5,1.5\n", "header 'wl,n'; expected a column whose name contains nm or µm, a column n"),
    "b.csv": ("nm,n\n400,1.5\n", "two or more"),
    "c.csv": ("nm,n\n400,x\n500,1.5\n", "expected numbers in the columns nm, n"),
    "d.csv": ("nm,n\n400,1.5\n500\n", "expected numbers"),
    "i.csv": ("nm;n\n400;1,52\n500;1,51\n", "expected numbers in the columns nm, n, with decimal points, and no more"),
    "e.csv": ("nm,n\n500,1.5\n400,1.5\n", "increasing"),
    "f.csv": ("nm,n,k\n400,1.5,-1\n500,1.5,0\n", "k = -1; expected a finite number ≥ 0"),
    "g.csv": ("nm,n\n400,15\n500,15\n", "n = 15 at 400 nm; expected up to 10"),
    "h.txt": ("", "expected a .csv, a .yml of refractiveindex.info, or a glass of a Zemax catalogue as file:NAME.agf:"),
    "a.yml": ("just: text", "expected a page of refractiveindex.info"),
    "b.yml": ("[", "expected a page of refractiveindex.info"),
    "c.yml": (PAGE.format("formula 4", "1 2 3"), "formula 4; expected formula 1, 2, 3, 5 or 6, or a table"),
    "d.yml": ("DATA:\n  - type: tabulated k\n    data: |\n        0.4 1\n        0.5 1\n", "no index; expected"),
    "e.yml": (PAGE.format("formula 2", "0 1 0.25"), "C1: n is infinite at 500 nm"),
    "f.yml": (
        "DATA:\n  - type: tabulated n\n    data: |\n        0.4 1 1 1\n        0.5\n",
        "a table of n; expected n, k or nk, and a number for each",
    ),
    "g.yml": (PAGE.format("formula 2", "0 1"), "2 coefficients; expected an odd number of them"),
    "a.agf": (ZEMAX, "expected a .csv"),
    "a.agf:Y": (ZEMAX.format(1, "1"), "no glass Y; nearest: "),
    "b.agf:X-1": (ZEMAX.format(3, "1"), "glass X-1: formula 3; expected one of 1, 2, 5, 6, 10, 11, 12, 13"),
    "c.agf:OTHER": (ZEMAX, "glass OTHER: expected a formula, and lines CD and LD of numbers"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_errors_of_files_are_one_line(name, tmp_path):
    content, message = BAD_FILES[name]
    if content is not None:
        (tmp_path / name.partition(":")[0]).write_text(content, "utf-8")
    with pytest.raises(ValueError) as error:
        media.parse(f"file:{tmp_path}/{name}", "int_ior")
    assert message in str(error.value) and "\n" not in str(error.value)
    assert str(error.value).startswith(f"int_ior = 'file:{tmp_path}/{name}': ")

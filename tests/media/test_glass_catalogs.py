"""Glasses of catalogues against the numbers that their makers print."""

import sys
from importlib.util import find_spec

import pytest

from mi_refract import media
from mi_refract.media import LINES, glass_catalogs

READS = pytest.mark.skipif(
    not all(find_spec(name) for name in ("opticalglass", "pandas")),
    reason="opticalglass is not installed: pip install 'mi-refract[glass]'",
)
PRINTED = 5e-6 + 1e-6  # half a unit of the fifth decimal, and what is asked for


@READS
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
    ],
)
def test_n_d_and_v_d_are_those_of_the_maker(glass, n_d, v_d):
    n = {line: media.index(glass, LINES[line]) for line in "dFC"}
    assert n["d"] == pytest.approx(n_d, abs=PRINTED)
    assert (n["d"] - 1) / (n["F"] - n["C"]) == pytest.approx(v_d, abs=0.06)


@READS
@pytest.mark.parametrize(
    ("glass", "low", "high"),
    [("SCHOTT:N-BK7", 290, 2500), ("SCHOTT:F2", 320, 2500), ("HOYA:FCD515", 320, 2500)],
)
def test_a_glass_has_an_index_where_its_maker_prints_one_or_a_transmittance_above_0(glass, low, high):
    """Of F2 the transmittance of 10 mm at 310 nm is printed, as 0."""
    assert media.parse(glass).valid == (low, high)
    for beyond in (low - 10.0, high + 500.0):
        with pytest.raises(
            ValueError, match=f"{glass}: no index at {beyond:g} nm; expected a wavelength from {low} to"
        ):
            media.index(glass, beyond)


@READS
@pytest.mark.parametrize(
    ("glass", "valid", "fitted", "beyond"),
    [
        ("CDGM:D-ZF93", (400, 2400), (404, 1014), 2325.0),  # where its index is 1.9250 and the formula gives 1.9150
        ("HOYA:BSC7", (280, 1550), (365, 1014), 1530.0),
        ("SCHOTT:N-BK7", (290, 2500), (365, 2326), 334.1),
        ("OHARA:S-BSL 7", (290, 2400), (365, 2325), 2400.0),
    ],
)
def test_beyond_the_makers_fit_an_index_is_a_warning(glass, valid, fitted, beyond):
    medium = media.parse(glass)
    assert (medium.valid, medium.fitted) == (valid, fitted)
    for inside in fitted:
        medium.index(inside)
    said = f"{glass}: the index at {beyond:g} nm is an extrapolation; .* {fitted[0]} to {fitted[1]} nm"
    for asked in (beyond, [fitted[0], beyond]):
        with pytest.warns(UserWarning, match=said):
            medium.index(asked)


@READS
def test_glasses_are_relative_to_air_and_named_in_any_case_with_or_without_spaces():
    assert media.parse("schott:n-bk7").relative_to == "air"
    assert media.parse("schott:n-bk7").name == "SCHOTT:N-BK7"
    assert media.parse("OHARA:S-BSL7").name == media.parse("ohara: s-bsl 7").name == "OHARA:S-BSL 7"


@READS
def test_an_unknown_glass_is_told_the_nearest_three():
    text = "nearest: SCHOTT:N-BK7, SCHOTT:[^,]+, SCHOTT:[^,]+$"
    with pytest.raises(ValueError, match=text) as error:
        media.parse("SCHOTT:N-BK8", "refract: int_ior")
    assert str(error.value).startswith("refract: int_ior = 'SCHOTT:N-BK8': unknown glass; expected one of the ")


@READS
def test_a_glass_that_is_printed_without_a_formula_is_refused():
    with pytest.raises(ValueError, match="its catalogue has no formula for this glass; use another glass, or table"):
        media.parse("HIKARI:J-PSKH8")


def test_without_the_package_a_glass_says_which_command_brings_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "opticalglass", None)
    for name in [name for name in sys.modules if name.startswith("opticalglass.")]:
        monkeypatch.delitem(sys.modules, name)
    glass_catalogs.read.cache_clear()
    with pytest.raises(ValueError, match=r"^int_ior = 'SCHOTT:N-BK7': .*pip install 'mi-refract\[glass\]'$") as error:
        media.parse("SCHOTT:N-BK7", "int_ior")
    assert "\n" not in str(error.value)

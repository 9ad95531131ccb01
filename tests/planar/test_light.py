"""Colours by wavelength: their indices, powers, and what the eye makes of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mi_refract import media
from mi_refract.planar import light
from mi_refract.planar.light import Light, of_wavelengths
from mi_refract.planar.scene_file import load

SCENES = Path(__file__).parents[2] / "scenes" / "planar"
SCENE = """
wavelengths = [486.1327, 587.5618]
[[shape]]
kind = "circle"
radius = 1
n = "cauchy(1.5, 4000)"
[[beam]]
kind = "parallel"
from = [-3, -0.5]
to = [-3, 0.5]
direction = 0
count = 3
"""


def written(tmp_path, text=SCENE):
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return path


def test_a_material_has_the_index_of_each_wavelength(tmp_path):
    scene = load(written(tmp_path))
    expected = tuple(1.5 + 4000 / w**2 for w in (486.1327, 587.5618))
    assert scene.regions[0].indices == pytest.approx(expected, rel=1e-15)
    assert [segments.n_left[0] for segments in scene.segments] == pytest.approx(expected, rel=1e-15)
    assert scene.colours == ("486.133 nm", "587.562 nm")
    assert scene.index == (1.0, 1.0)


def test_without_wavelengths_it_has_that_of_the_d_line(tmp_path):
    scene = load(written(tmp_path, SCENE.replace("wavelengths", "#")))
    assert scene.regions[0].indices == pytest.approx((1.5 + 4000 / media.LINES["d"] ** 2,), rel=1e-15)


def test_wavelengths_may_be_given_from_outside(tmp_path):
    scene = load(written(tmp_path), [450.0])
    assert scene.light.wavelengths == (450.0,)
    spread = load(written(tmp_path), 36).light.wavelengths
    assert spread == tuple(np.linspace(380, 730, 36))


def test_what_is_measured_against_vacuum_is_made_relative_to_air():
    found = Light(("", ""), (500.0, 600.0)).indices("MATERIAL:water", "n")
    expected = [media.index("MATERIAL:water", w) / media.LABORATORY_AIR.index(w) for w in (500.0, 600.0)]
    assert found == pytest.approx(expected, rel=1e-15)
    assert Light().indices("AIR:ciddor", "n") == (1.0,)


BAD = {
    "unknown": ('"cauchy(1.5, 4000)"', '"glas"', "shape[0].n = 'glas': unknown material; expected vacuum"),
    "formula": ('"cauchy(1.5, 4000)"', '"cauchy(1.5"', "shape[0].n = 'cauchy(1.5'; expected cauchy(…)"),
    "range": ('"cauchy(1.5, 4000)"', '"table(500: 1.5, 900: 1.4)"', "shape[0].n: table(500: 1.5, 900: 1.4): no index"),
    "one": ("[486.1327, 587.5618]", "1", "wavelengths: expected `int` >= 2"),
    "negative": ("[486.1327, 587.5618]", "[-500]", "wavelengths[0]: expected `float` > 0.0"),
    "many": ("[486.1327, 587.5618]", "257", "wavelengths: expected `int` <= 256"),
    "both": (
        "wavelengths =",
        'colours = ["red", "blue"]\nwavelengths =',
        "colours and wavelengths are both set; expected one",
    ),
    "light": ("wavelengths =", 'light = "A"\nwavelengths =', "light: invalid enum value 'A'; expected D65, flat"),
}


@pytest.mark.parametrize(("old", "new", "said"), BAD.values(), ids=BAD)
def test_what_is_refused_is_one_line(old, new, said, tmp_path):
    with pytest.raises(ValueError) as caught:
        load(written(tmp_path, SCENE.replace(old, new, 1)))
    assert said in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "red", "1", "nan", "450,", "-450", "inf"])
def test_words_that_are_no_wavelengths(text):
    with pytest.raises(ValueError, match="expected wavelengths in nm, such as"):
        light.parsed(text)


def test_words_that_are_wavelengths():
    assert light.parsed("450.5, 600") == [450.5, 600.0]
    assert light.parsed("450") == [450.0]
    assert light.parsed("32") == 32
    assert light.parsed("550") == [550.0]  # more than MOST is no number of them


# Seen -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("power", light.POWERS)
def test_colours_are_those_of_the_standard_observer(power):
    """CIE 1931 x̄, ȳ, z̄ at 450, 550 and 600 nm; XYZ to linear sRGB of IEC 61966-2-1; all together are white."""
    xyz = np.array([(0.3362, 0.038, 1.77211), (0.43345, 0.99495, 0.00875), (1.0622, 0.631, 0.0008)])
    to_rgb = [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
    chosen = of_wavelengths([450.0, 550.0, 600.0], power)
    expected = xyz @ np.transpose(to_rgb) * np.array(chosen.powers)[:, None]
    assert light.linear_srgb(chosen) == pytest.approx(expected / expected.sum(0), rel=0.01, abs=0.01)


def test_daylight_has_the_powers_of_cie():
    """D65 at 450, 560 and 650 nm: 117.008, 100 and 80.0268."""
    powers = of_wavelengths([450, 560, 650], "D65").powers
    assert np.array(powers) / powers[1] == pytest.approx([1.17008, 1, 0.800268], rel=2e-5)

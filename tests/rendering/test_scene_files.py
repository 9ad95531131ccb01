"""Scene files from Python: what is loaded, and refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from mi_refract.rendering import scene_files

ROOT = Path(__file__).parents[2]
SCENE = ROOT / "scenes" / "nested.xml"
SMALL = {"res": "8"}


pytestmark = pytest.mark.usefixtures("scalar_variant")


@pytest.mark.parametrize(
    "bsdf, formulas", [("refract", ["promoted (auto)"]), ("refract_cross", ["cross"]), ("dielectric", [])]
)
def test_the_formulas_of_a_scene(bsdf, formulas):
    assert scene_files.formulas_in(scene_files.load_scene(SCENE, SMALL | {"bsdf": bsdf})) == formulas


def test_a_film_is_measured_before_the_rendering():
    with pytest.raises(ValueError, match=r"nested\.xml: a film of 8193 × 8193 pixels; expected up to 67108864"):
        scene_files.load_scene(SCENE, {"res": "8193"})


ABSORBING = """<scene version="3.0.0"><default name="integrator" value="path"/><integrator type="$integrator"/>
<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="4"/></film></sensor>
<shape type="sphere"><bsdf type="refract"><float name="int_absorption" value="0.5"/></bsdf></shape></scene>"""


def test_absorption_with_an_integrator_that_knows_none_is_refused_by_name(tmp_path):
    path = tmp_path / "a.xml"
    path.write_text(ABSORBING)
    with pytest.raises(ValueError) as error:
        scene_files.load_scene(path)
    assert (
        str(error.value) == f"{path}: refract: int_absorption; expected the integrator refract_path, or no absorption"
    )
    scene_files.load_scene(path, {"integrator": "refract_path"})


def test_a_spectrum_of_one_pair_is_refused_by_the_name_of_its_parameter(tmp_path):
    path = tmp_path / "a.xml"
    text = ABSORBING.replace('<float name="int_absorption" value="0.5"/>', '<spectrum name="int_ior" value="$pairs"/>')
    path.write_text(text.replace("<default", '<default name="pairs" value="400:1.5"/><default', 1))
    with pytest.raises(ValueError) as error:
        scene_files.load_scene(path)
    said = "int_ior = '400:1.5'; expected a number, or two pairs and more of a wavelength in nm and a value"
    assert str(error.value) == f"{path}: {said}"

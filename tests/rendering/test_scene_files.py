"""Scene files from Python: what is loaded, and what is refused before the rendering."""

from __future__ import annotations

import pytest
from support.renders import SCENES

from mi_refract.rendering import scene_files

NESTED = SCENES / "nested.xml"
ABSORBING = """<scene version="3.0.0"><default name="integrator" value="path"/><integrator type="$integrator"/>
<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="4"/></film></sensor>
<shape type="sphere"><bsdf type="refract">PARAMETER</bsdf></shape></scene>"""
FILM = "a film of 8193 × 8193 pixels; expected up to 67108864"
ABSORPTION = "refract: int_absorption; expected the integrator refract_path, or no absorption"

pytestmark = pytest.mark.usefixtures("scalar_variant")


@pytest.mark.parametrize(
    "bsdf, formulas", [("refract", ["promoted (auto)"]), ("refract_cross", ["cross"]), ("dielectric", [])]
)
def test_the_formulas_of_a_scene(bsdf, formulas):
    assert scene_files.formulas_in(scene_files.load_scene(NESTED, {"res": "8", "bsdf": bsdf})) == formulas


@pytest.mark.parametrize(
    ("parameter", "defines", "message"),
    [
        ("", {"res": "8193"}, FILM),
        ('<float name="int_absorption" value="0.5"/>', {}, ABSORPTION),
        ('<float name="int_absorption" value="0.5"/>', {"integrator": "refract_path"}, ""),
    ],
)
def test_what_is_refused_is_named(tmp_path, parameter, defines, message):
    path = NESTED if "res" in defines else tmp_path / "a.xml"
    (tmp_path / "a.xml").write_text(ABSORBING.replace("PARAMETER", parameter))
    if not message:
        scene_files.load_scene(path, defines)
        return
    with pytest.raises(ValueError) as error:
        scene_files.load_scene(path, defines)
    assert str(error.value).startswith(f"{path}: {message}")

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
    with pytest.raises(ValueError, match=r"nested\.xml: a film of 8193 × 8193 pixels; accepted: up to 67108864"):
        scene_files.load_scene(SCENE, {"res": "8193"})

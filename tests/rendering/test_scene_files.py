"""Scene files from Python: what is loaded, rendered, refused; the example of the README."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from support.readme import python_blocks

from mi_refract.io.image_file import read_exr
from mi_refract.rendering import scene_files

ROOT = Path(__file__).parents[2]
SCENE = ROOT / "scenes" / "nested.xml"
SMALL = {"res": "8"}


pytestmark = pytest.mark.usefixtures("scalar_variant")


def test_the_header_renders_the_same_image_again(tmp_path):
    first = scene_files.render_to_exr(SCENE, tmp_path / "a.exr", defines=SMALL, spp=2, seed=5)
    again = {"spp": first["mi_refract:spp"], "seed": first["mi_refract:seed"]}
    scene_files.render_to_exr(first["mi_refract:scene"], tmp_path / "b.exr", defines=SMALL, **again)
    (pixels, header), (same, _) = (read_exr(tmp_path / name) for name in ("a.exr", "b.exr"))
    np.testing.assert_array_equal(pixels, same)
    assert pixels.shape[:2] == (8, 8)
    seconds = "mi_refract:render_seconds"  # stored in float32
    assert {name: header[name] for name in first if name != seconds} == {n: v for n, v in first.items() if n != seconds}


WRONG = [{"spp": 0}, {"spp": -1}, {"seed": -1}, {"seed": 2**32}, {"defines": {"config": "x"}}]


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_numbers_are_refused_before_the_rendering(tmp_path, monkeypatch, wrong):
    monkeypatch.setattr(mi, "render", lambda *arguments, **named: pytest.fail("rendered"))
    with pytest.raises(ValueError, match="accepted: ") as error:
        scene_files.render_to_exr(SCENE, tmp_path / "a.exr", **wrong)
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_a_film_is_measured_before_the_rendering(tmp_path, monkeypatch):
    monkeypatch.setattr(mi, "render", lambda *arguments, **named: pytest.fail("rendered"))
    with pytest.raises(ValueError, match=r"nested\.xml: a film of 8193 × 8193 pixels; accepted: up to 67108864"):
        scene_files.render_to_exr(SCENE, tmp_path / "a.exr", defines={"res": "8193"})


@pytest.mark.parametrize(
    "bsdf, formulas", [("refract", ["promoted (auto)"]), ("refract_cross", ["cross"]), ("dielectric", [])]
)
def test_the_formulas_of_a_scene(bsdf, formulas):
    assert scene_files.formulas_in(scene_files.load_scene(SCENE, SMALL | {"bsdf": bsdf})) == formulas


def test_the_example_of_the_readme(tmp_path, monkeypatch):
    (code,) = python_blocks(Path(scene_files.__file__).with_name("README.md"))
    monkeypatch.chdir(ROOT)
    for old, new in (
        ('"nested.exr"', f'r"{tmp_path}/nested.exr"'),
        ("spp=256", "spp=1"),
        ('{"bsdf"', '{"res": "8", "bsdf"'),
    ):
        assert old in code
        code = code.replace(old, new)
    exec(code, {})
    assert read_exr(tmp_path / "nested.exr")[1]["mi_refract:seed"] == 1

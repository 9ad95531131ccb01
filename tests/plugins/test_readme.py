"""The examples of the README run as they are printed, but for smaller numbers."""

from pathlib import Path

import pytest
from support.readme import python_blocks

from mi_refract import plugins

ROOT = Path(__file__).parents[2]
IN_A_SCENE, INVERSE = python_blocks(Path(plugins.__file__).with_name("README.md"))


def run(code, **changes):
    for old, new in changes.values():
        assert old in code
        code = code.replace(old, new)
    names = {}
    exec(code, names)
    return names


@pytest.fixture(autouse=True)
def llvm(needs_variant):
    needs_variant("llvm_ad_rgb")


def test_in_a_scene(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    run(
        IN_A_SCENE,
        output=('"diamond.png"', f'r"{tmp_path}/diamond.png"'),
        size=('bsdf="refract"', 'bsdf="refract", res=8, spp=1'),
        wait=("mi.render(scene)", "mi.render(scene), write_async=False"),
    )
    assert (tmp_path / "diamond.png").stat().st_size > 0


def test_an_index_is_recovered_from_an_image(capsys):
    names = run(INVERSE, pixels=('"width": 64, "height": 64', '"width": 24, "height": 24'), steps=("60", "50"))
    (eta,) = names["adam"]["ball.bsdf.eta"]
    assert eta == pytest.approx(1.6, abs=0.05)
    assert capsys.readouterr().out.startswith("[1.")

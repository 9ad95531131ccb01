"""The bundle of a scene: complete, unpacked elsewhere, refused where it would not work there."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_refract.rendering import scene_bundle
from mi_refract.rendering.render_pass import pass_renderer
from mi_refract.rendering.scene_bundle import pack
from mi_refract.rendering.scene_files import load_scene

SCENE = """<scene version="3.0.0">
  <default name="tint" value="none"/>
  <integrator type="path"/>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0,0,-4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/></film>
    <sampler type="independent"><integer name="sample_count" value="2"/></sampler>
  </sensor>
  {more}
  <shape type="sphere"><bsdf type="diffuse">
    <texture type="bitmap" name="reflectance"><string name="filename" value="{texture}"/></texture>
  </bsdf></shape>
</scene>"""
SKY = '<include filename="../common/gone/../sky.xml"/>'

pytestmark = pytest.mark.usefixtures("scalar_variant")


@pytest.fixture
def folder(tmp_path):
    """scenes/, common/sky.xml, and two textures: common/bright.exr, and far/dark.exr."""
    for name in ("scenes", "common/gone", "far"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "common" / "sky.xml").write_text('<scene version="3.0.0"><emitter type="constant"/></scene>')
    for name, value in (("common/bright.exr", 0.8), ("far/dark.exr", 0.1)):
        mi.Bitmap(np.full((4, 4, 3), value, np.float32)).write(str(tmp_path / name))
    return tmp_path


def written(folder, texture="../common/bright.exr", more=SKY):
    path = folder / "scenes" / "scene.xml"
    path.write_text(SCENE.format(texture=texture, more=more))
    return path


def image(scene):
    return pass_renderer(scene, 0).render(0, 2).total


def elsewhere(folder, bundle, defines=None):
    """The scene of a bundle, loaded after all that it was made of has gone."""
    target = folder.parent / f"{folder.name}-there"
    target.mkdir(exist_ok=True)
    for each in ("scenes", "common", "far"):
        (folder / each).rename(folder / f"{each}-gone")
    return scene_bundle.load(bundle, str(mi.variant()), defines or {}, str(target))[0]


@pytest.mark.parametrize("name", ["../common/bright.exr", "{far}/dark.exr", "dark.exr"])
def test_the_same_image_elsewhere(folder, name):
    """`dark.exr` is found through a <path>; XML by `../`, also through a folder that holds nothing else."""
    more = f'{SKY}<path value="../far"/>' if name == "dark.exr" else SKY
    scene = written(folder, name.format(far=folder / "far"), more)
    expected = image(load_scene(scene))
    bundle = pack(scene, {})
    assert len(bundle.files) == 3
    found = image(elsewhere(folder, bundle))
    np.testing.assert_array_equal(found, expected)
    assert found.std() > 0


def test_a_define_may_name_a_file(folder):
    scene = written(folder, "$tint")
    defines = {"tint": str(folder / "far" / "dark.exr")}
    expected = image(load_scene(scene, defines))
    np.testing.assert_array_equal(image(elsewhere(folder, pack(scene, defines), defines)), expected)


def test_unpacked_and_loaded_once(folder, tmp_path_factory):
    bundle, target = pack(written(folder), {}), str(tmp_path_factory.mktemp("there"))
    first, second = (scene_bundle.load(bundle, "scalar_rgb", {}, target) for _ in range(2))
    assert first[0] is second[0] and len([*Path(target).iterdir()]) == 1


def test_the_digest_is_of_every_byte(folder):
    before = pack(written(folder), {}).digest
    assert pack(written(folder), {}).digest == before
    content = bytearray((folder / "common" / "bright.exr").read_bytes())
    content[-1] ^= 1
    (folder / "common" / "bright.exr").write_bytes(content)
    assert pack(written(folder), {}).digest != before


def refusal(scene, limit=256):
    with pytest.raises(ValueError) as caught:
        pack(scene, {}, limit)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_too_large(folder):
    scene = written(folder)
    mi.Bitmap(np.random.default_rng(0).random((400, 400, 3), np.float32)).write(str(folder / "common" / "bright.exr"))
    text = refusal(scene, 1)
    assert f"{scene}: 1." in text and f"the largest {folder}/common/bright.exr" in text
    assert text.endswith("expected with a cluster: 1 MiB, or --bundle-limit 2, if all workers have the memory")


ONLY_HERE = (
    "by an absolute name or from the working folder; expected with a cluster a name relative to the scene's folder"
)


def test_an_include_that_is_found_only_here(folder):
    text = refusal(written(folder, more=f'<include filename="{folder}/common/sky.xml"/>'))
    assert text == f"{folder}/common/sky.xml: included, {ONLY_HERE}"


@pytest.mark.parametrize("value, accepted", [("{common}", False), ("../common", True)])
def test_a_path_that_is_found_only_here(folder, value, accepted):
    value = value.format(common=folder / "common")
    scene = written(folder, more=f'<path value="{value}"/><include filename="sky.xml"/>')
    if accepted:
        assert len(pack(scene, {}).files) == 3
    else:
        assert ONLY_HERE in refusal(scene)


def test_an_empty_path_is_there_as_well(folder):
    """Mitsuba refuses a <path> to a folder that is not there."""
    (folder / "scenes" / "empty").mkdir()
    bundle = pack(written(folder, more=f'{SKY}<path value="empty"/>'), {})
    assert image(elsewhere(folder, bundle)).std() > 0


def test_a_spectrum_that_is_found_only_here(folder):
    (folder / "common" / "glass.spd").write_text("400 1\n700 1\n")
    spectrum = f'<spectrum name="radiance" filename="{folder}/common/glass.spd"/>'
    text = refusal(written(folder, more=f'<emitter type="constant">{spectrum}</emitter>'))
    assert text == (f"{folder}/common/glass.spd: opened by <spectrum>, {ONLY_HERE}")


def test_parents_behind_a_link(folder):
    """`link/..` is another folder than the text says."""
    (folder / "scenes" / "link").symlink_to(folder / "far")
    text = refusal(written(folder, "link/../common/bright.exr"))
    assert "by a symbolic link; expected" in text


def test_errors_name_the_files_as_they_are_here(folder):
    scene = written(folder)
    bundle = pack(scene, {})
    (folder / "there").mkdir()
    with pytest.raises(ValueError) as caught:
        scene_bundle.load(bundle, "scalar_rgb", {"nonesuch": "1"}, str(folder / "there"))
    assert str(caught.value).startswith(f"{scene}: ") and str(folder / "there") not in str(caught.value)

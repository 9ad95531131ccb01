"""The bundle of a scene: complete, unpacked elsewhere, refused where it would not work there."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mi_refract.rendering import scene_bundle
from mi_refract.rendering.render_pass import pass_renderer
from mi_refract.rendering.scene_files import load_scene, parse_scene

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


def pack(scene, defines=None):
    return scene_bundle.pack(parse_scene(scene, defines), defines or {})


def image(scene):
    return pass_renderer(scene, 0).render(0, 2).total


def elsewhere(folder, bundle):
    """The scene of a bundle, loaded after all that it was made of has gone."""
    target = folder.parent / f"{folder.name}-there"
    target.mkdir()
    for name in ("scenes", "common", "far"):
        (folder / name).rename(folder / f"{name}-gone")
    return scene_bundle.load(bundle, str(mi.variant()), str(target))[0]


@pytest.mark.parametrize(
    ("name", "more", "defines"),
    [
        ("../common/bright.exr", SKY, {}),
        ("{far}/dark.exr", SKY, {}),
        ("dark.exr", f'{SKY}<path value="../far"/>', {}),
        ("$tint", SKY, {"tint": "{far}/dark.exr"}),
    ],
)
def test_the_same_image_elsewhere(folder, name, more, defines):
    """Named by `../`, by an absolute path, through a <path>, by a define; XML through a folder that is empty."""
    defines = {key: value.format(far=folder / "far") for key, value in defines.items()}
    scene = written(folder, name.format(far=folder / "far"), more)
    expected = image(load_scene(scene, defines))
    bundle = pack(scene, defines)
    assert len(bundle.files) == 3
    np.testing.assert_array_equal(image(elsewhere(folder, bundle)), expected)
    assert expected.std() > 0


def test_unpacked_and_loaded_once_for_each_set_of_defines(folder, tmp_path_factory):
    """The same files with another value are another scene."""

    target = tmp_path_factory.mktemp("there")
    more = '<emitter type="constant"><float name="radiance" value="$light"/></emitter>'
    scene = written(folder, more=f'<default name="light" value="1"/>{more}')
    bundles = [pack(scene, {"light": light}) for light in ("1", "1", "3")]
    one, same, other = (scene_bundle.load(bundle, "scalar_rgb", str(target))[0] for bundle in bundles)
    assert one is same and len([*target.iterdir()]) == 2
    np.testing.assert_allclose(image(other), 3 * image(one), rtol=1e-6)


def test_what_was_unpacked_in_part_is_unpacked_again(folder, tmp_path_factory, monkeypatch):
    bundle, target = pack(written(folder)), str(tmp_path_factory.mktemp("there"))

    def full(*_):
        raise OSError("No space left on device")

    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space"):
        patch.setattr(scene_bundle.Path, "write_bytes", full)
        scene_bundle.unpack(bundle, target)
    root = scene_bundle.unpack(bundle, target)
    assert {"/" + str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()} == {*bundle.files}


def test_the_digest_is_of_every_byte(folder):
    before = pack(written(folder)).digest
    assert pack(written(folder)).digest == before
    content = bytearray((folder / "common" / "bright.exr").read_bytes())
    content[-1] ^= 1
    (folder / "common" / "bright.exr").write_bytes(content)
    assert pack(written(folder)).digest != before


def test_too_large(folder, monkeypatch):
    scene = written(folder)
    mi.Bitmap(np.random.default_rng(0).random((400, 400, 3), np.float32)).write(str(folder / "common" / "bright.exr"))
    message = rf"{scene}: 1\.\d MiB of files, the largest {folder}/common/bright\.exr \(1\.\d MiB\); "
    message += "the limit for a cluster is 1 MiB; raise it by --bundle-limit 2, if all workers have the memory"
    parsed = parse_scene(scene)
    monkeypatch.delattr(scene_bundle.Path, "read_bytes")  # known before anything is in memory
    with pytest.raises(ValueError, match=message):
        scene_bundle.pack(parsed, {}, 1)


BRIGHT = "../common/bright.exr"
SPECTRUM = '<emitter type="constant"><spectrum name="radiance" filename="{common}/glass.spd"/></emitter>'


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ('<include filename="{common}/sky.xml"/>', "sky.xml"),
        ('<path value="{common}"/>', "common"),
        (SPECTRUM, "glass.spd"),
        (f'<path value="common"/>{SKY}', "common"),
        (SPECTRUM.replace("{common}", "here"), "Mitsuba reads another scene on this worker; expected"),
    ],
)
def test_what_the_parser_finds_only_here_is_an_error_there(folder, more, message, monkeypatch):
    """By absolute names, by names from the working folder: nothing there, or something else."""
    common = folder / "common"
    monkeypatch.chdir(folder)
    for name in (common / "glass.spd", folder / "here" / "glass.spd"):
        name.parent.mkdir(exist_ok=True)
        name.write_text("400 1\n700 1\n")
    bundle = pack(written(folder, more=more.format(common=common)))
    (folder / "here" / "glass.spd").write_text("400 2\n700 2\n")
    with pytest.raises(ValueError, match=message) as caught:
        elsewhere(folder, bundle)
    assert "\n" not in str(caught.value)


def test_a_link_that_leads_elsewhere_is_refused(folder):
    (folder / "scenes" / "link").symlink_to(folder / "far")
    with pytest.raises(ValueError, match=r"link/\.\./common/bright\.exr: '\.\.' after a symbolic link; for"):
        pack(written(folder, "link/../common/bright.exr"))


@pytest.mark.parametrize(
    "more", ['<path value="../common"/><include filename="sky.xml"/>', f'{SKY}<path value="empty"/>']
)
def test_a_relative_path_is_there_as_well(folder, more):
    """Also one to an empty folder: Mitsuba refuses a <path> to a folder that is not there."""
    (folder / "scenes" / "empty").mkdir()
    assert image(elsewhere(folder, pack(written(folder, more=more)))).std() > 0


def test_errors_name_the_files_as_they_are_here(folder, tmp_path_factory):
    scene, there = written(folder), str(tmp_path_factory.mktemp("there"))
    bundle = pack(scene)
    bundle.defines["nonesuch"] = "1"
    with pytest.raises(ValueError, match=f"^{scene}: ") as caught:
        scene_bundle.load(bundle, "scalar_rgb", there)
    assert there not in str(caught.value)

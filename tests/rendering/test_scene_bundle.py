"""Scene files and their bundles: what is loaded, complete elsewhere, and refused before the rendering."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from support.renders import SCENES

from mi_refract.rendering import scene_bundle
from mi_refract.rendering.render_pass import pass_renderer
from mi_refract.rendering.scene_files import formulas_in, load_scene, parse_scene

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
BRIGHT, SKY = "../common/bright.exr", '<include filename="../common/gone/../sky.xml"/>'
LAMP = '<emitter type="constant"><spectrum name="radiance" filename="$spd"/></emitter>'

pytestmark = pytest.mark.usefixtures("scalar_variant")


@pytest.fixture
def folder(tmp_path):
    """scenes/, common/sky.xml, and two textures: common/bright.exr, and far/dark.exr."""
    for name in ("scenes/empty", "common/gone", "far"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "scenes" / "link").symlink_to(tmp_path / "far")
    (tmp_path / "common" / "sky.xml").write_text('<scene version="3.0.0"><emitter type="constant"/></scene>')
    for name in ("glass", "a&b"):
        (tmp_path / "common" / f"{name}.spd").write_text("400 1\n700 1\n")
    for name, value in (("common/bright.exr", 0.8), ("far/dark.exr", 0.1)):
        mi.Bitmap(np.full((4, 4, 3), value, np.float32)).write(str(tmp_path / name))
    return tmp_path


@pytest.fixture
def there(tmp_path_factory):
    """The folder of another machine."""
    return tmp_path_factory.mktemp("there")


def written(folder, texture=BRIGHT, more=SKY):
    path = folder / "scenes" / "scene.xml"
    path.write_text(SCENE.format(texture=texture, more=more))
    return path


def pack(scene, defines=None):
    return scene_bundle.pack(parse_scene(scene, defines), defines or {})


def elsewhere(folder, there, bundle):
    """The scene of a bundle, loaded after all that it was made of has gone."""
    for name in ("scenes", "common", "far"):
        (folder / name).rename(folder / f"{name}-gone")
    return scene_bundle.load(bundle, str(mi.variant()), str(there))[0]


def image(scene):
    return pass_renderer(scene, 0).render(0, 2).total


@pytest.mark.parametrize(
    ("name", "more", "defines"),
    [
        (BRIGHT, SKY, {}),
        ("{far}/dark.exr", SKY, {}),
        ("dark.exr", f'{SKY}<path value="../far"/>', {}),
        ("$tint", SKY, {"tint": "{far}/dark.exr"}),
        (BRIGHT, '<path value="../common"/><include filename="sky.xml"/>', {}),
        (BRIGHT, f'<default name="spd" value="../common/a&amp;b.spd"/>{LAMP}', {}),
        (BRIGHT, f'{LAMP}<!-- it\'s <spectrum filename="{BRIGHT}"/> -->', {"spd": "../common/glass.spd"}),
        (BRIGHT, f'{SKY}<path value="empty"/>', {}),  # Mitsuba refuses a <path> to a folder that is not there
    ],
)
def test_the_same_image_elsewhere(folder, there, name, more, defines):
    """Named by `../`, absolutely, through a <path>, by a define; a spectrum by a parameter, too."""
    defines = {key: value.format(far=folder / "far") for key, value in defines.items()}
    scene = written(folder, name.format(far=folder / "far"), more)
    expected = image(load_scene(scene, defines))
    bundle = pack(scene, defines)
    assert len(bundle.files) == 3
    np.testing.assert_array_equal(image(elsewhere(folder, there, bundle)), expected)
    assert expected.std() > 0


def test_unpacked_and_loaded_once_for_each_set_of_defines(folder, there):
    """The same files with another value are another scene, also where Mitsuba would write the same text."""
    more = '<default name="light" value="1"/><default name="size" value="1"/>'
    more += '<emitter type="constant"><float name="radiance" value="$light"/></emitter>'
    more += '<shape type="sphere"><transform name="to_world"><scale value="$size"/></transform></shape>'
    scene = written(folder, more=more)
    assert len({pack(scene, {"size": size}).digest for size in ("1", "1.0000002")}) == 2
    bundles = [pack(scene, {"light": light}) for light in ("1", "1", "3")]
    one, same, other = (scene_bundle.load(bundle, "scalar_rgb", str(there))[0] for bundle in bundles)
    assert one is same and len([*there.iterdir()]) == 2
    np.testing.assert_allclose(image(other), 3 * image(one), rtol=1e-6)


def test_what_was_unpacked_in_part_is_unpacked_again(folder, there, monkeypatch):
    bundle = pack(written(folder))

    def full(*_):
        raise OSError("No space left on device")

    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space"):
        patch.setattr(scene_bundle.Path, "write_bytes", full)
        scene_bundle.unpack(bundle, str(there))
    root = scene_bundle.unpack(bundle, str(there))
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
def test_what_the_parser_finds_only_here_is_an_error_there(folder, there, more, message, monkeypatch):
    """By absolute names, by names from the working folder: nothing there, or something else."""
    common = folder / "common"
    monkeypatch.chdir(folder)
    (folder / "here").mkdir()
    (folder / "here" / "glass.spd").write_text("400 1\n700 1\n")
    bundle = pack(written(folder, more=more.format(common=common)))
    (folder / "here" / "glass.spd").write_text("400 2\n700 2\n")
    with pytest.raises(ValueError, match=message) as caught:
        elsewhere(folder, there, bundle)
    assert "\n" not in str(caught.value)


def test_a_link_that_leads_elsewhere_is_refused(folder):
    with pytest.raises(ValueError, match=r"link/\.\./common/bright\.exr: '\.\.' after a symbolic link; for"):
        pack(written(folder, "link/../common/bright.exr"))


def test_errors_name_the_files_as_they_are_here(folder, there):
    scene = written(folder)
    bundle = pack(scene)
    bundle.defines["nonesuch"] = "1"
    with pytest.raises(ValueError, match=f"^{scene}: ") as caught:
        scene_bundle.load(bundle, "scalar_rgb", str(there))
    assert str(there) not in str(caught.value)


# Scene files ----------------------------------------------------------------------------------------------------------

NESTED = SCENES / "nested.xml"
ABSORBING = """<scene version="3.0.0"><default name="integrator" value="path"/><integrator type="$integrator"/>
<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="4"/></film></sensor>
<shape type="sphere"><bsdf type="refract">PARAMETER</bsdf></shape></scene>"""
ABSORPTION = '<float name="int_absorption" value="0.5"/>'


@pytest.mark.parametrize(
    "bsdf, formulas", [("refract", ["promoted (auto)"]), ("refract_cross", ["cross"]), ("dielectric", [])]
)
def test_the_formulas_of_a_scene(bsdf, formulas):
    assert formulas_in(load_scene(NESTED, {"res": "8", "bsdf": bsdf})) == formulas


@pytest.mark.parametrize(
    ("parameter", "defines", "message"),
    [
        ("", {"res": "8193"}, "a film of 8193 × 8193 pixels; expected up to 67108864"),
        (ABSORPTION, {}, "refract: int_absorption; expected the integrator refract_path, or no absorption"),
        (ABSORPTION, {"integrator": "refract_path"}, ""),
    ],
)
def test_what_is_refused_is_named(tmp_path, parameter, defines, message):
    path = NESTED if "res" in defines else tmp_path / "a.xml"
    (tmp_path / "a.xml").write_text(ABSORBING.replace("PARAMETER", parameter))
    if not message:
        load_scene(path, defines)
        return
    with pytest.raises(ValueError) as error:
        load_scene(path, defines)
    assert str(error.value).startswith(f"{path}: {message}")

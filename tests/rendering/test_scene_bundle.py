"""Scene files and their bundles: loading here and on another machine, and errors before the rendering."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from support.renders import SCENES

from mi_refract.plugins import scene_parser
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

GLASS = '<shape type="cube"><bsdf type="refract"><string name="int_ior" value="diamond"/></bsdf></shape></scene>'

pytestmark = pytest.mark.usefixtures("scalar_variant")


@pytest.fixture
def folder(tmp_path):
    """Return a folder with scenes/, common/sky.xml, two spectra, and textures common/bright.exr and far/dark.exr."""
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
def other_machine(tmp_path_factory):
    """Return the folder of another machine."""
    return tmp_path_factory.mktemp("other_machine")


def write_scene(folder, texture=BRIGHT, more=SKY):
    path = folder / "scenes" / "scene.xml"
    path.write_text(SCENE.format(texture=texture, more=more))
    return path


def pack(scene, defines=None):
    return scene_bundle.pack(parse_scene(scene, defines))


def load_without_originals(folder, other_machine, bundle):
    """Load the scene of a bundle after all original files have been moved away."""
    for name in ("scenes", "common", "far"):
        (folder / name).rename(folder / f"{name}-gone")
    return scene_bundle.load(bundle, str(mi.variant()), str(other_machine))[0]


def image(scene):
    return pass_renderer(scene, 0).render(0, 2).total


SPECTRUM = '<emitter type="constant"><spectrum name="radiance" filename="{folder}/common/glass.spd"/></emitter>'


@pytest.mark.parametrize(
    ("texture", "more", "defines"),
    [
        (BRIGHT, SKY, {}),
        ("{folder}/far/dark.exr", SKY, {}),
        ("link/../common/bright.exr", SKY, {}),
        ("dark.exr", f'{SKY}<path value="../far"/>', {}),
        ("$tint", SKY, {"tint": "{folder}/far/dark.exr"}),
        (BRIGHT, '<path value="../common"/><include filename="sky.xml"/>', {}),
        (BRIGHT, '<path value="{folder}/common"/><include filename="{folder}/common/sky.xml"/>', {}),
        (BRIGHT, f'<default name="spd" value="../common/a&amp;b.spd"/>{LAMP}', {}),
        (BRIGHT, LAMP, {"spd": "../common/glass.spd"}),
        (BRIGHT, SPECTRUM, {}),
        (BRIGHT, SPECTRUM.replace("{folder}/common", "common"), {}),  # from the working folder
    ],
)
def test_a_bundle_gives_the_same_image_on_another_machine(folder, other_machine, texture, more, defines, monkeypatch):
    """Files are named by `../`, also after a link, by an absolute path, through a <path>, and by a define."""
    monkeypatch.chdir(folder)
    defines = {key: value.format(folder=folder) for key, value in defines.items()}
    scene = write_scene(folder, texture.format(folder=folder), more.format(folder=folder))
    expected = image(load_scene(scene, defines))
    bundle = pack(scene, defines)
    assert len(bundle.files) == 1
    np.testing.assert_array_equal(image(load_without_originals(folder, other_machine, bundle)), expected)
    assert expected.std() > 0


def test_a_file_with_the_name_of_a_material_is_not_used(folder, other_machine):
    scene = write_scene(folder)
    scene.write_text(scene.read_text().replace("</scene>", GLASS))
    (scene.parent / "diamond").write_text("no material")
    expected = image(load_scene(scene))
    np.testing.assert_array_equal(image(load_without_originals(folder, other_machine, pack(scene))), expected)


def test_a_file_of_an_index_is_part_of_the_scene_and_its_bundle(folder, other_machine):
    scene = write_scene(folder)
    glass = GLASS.replace("diamond", "hold(file:../far/n(1).csv)")
    scene.write_text(scene.read_text().replace("</scene>", glass))
    (folder / "far" / "n(1).csv").write_text("nm,n\n400,1.5\n700,1.5\n")
    assert parse_scene(scene).files()["hold(file:../far/n(1).csv)"].samefile(folder / "far" / "n(1).csv")
    expected = image(load_scene(scene))
    np.testing.assert_array_equal(image(load_without_originals(folder, other_machine, pack(scene))), expected)
    # The same image as with the number in the file.
    (folder / "scenes-gone").rename(folder / "scenes")
    (folder / "common-gone").rename(folder / "common")
    scene.write_text(scene.read_text().replace("hold(file:../far/n(1).csv)", "1.5"))
    np.testing.assert_allclose(image(load_scene(scene)), expected, rtol=1e-5)


PARAMETERS = """<scene version="3.0.0"><medium type="homogeneous" id="m"><rgb name="albedo" value="1 2 3"/></medium>
<sensor type="thinlens"><transform name="to_world"><rotate x="1" y="2" angle="33.3"/><scale x="0.3" y="7"/></transform>
<string name="fov_axis" value="a&quot;&lt;b"/><float name="fov" value="1e-3"/></sensor>
<shape type="cylinder"><point name="p0" x="1" y="0.1" z="3"/><bsdf type="null"/><ref id="m" name="interior"/>
<boolean name="flip_normals" value="true"/><emitter type="area"><spectrum name="radiance" value="1"/></emitter></shape>
<emitter type="constant"><spectrum name="radiance" value="400:1, 500:2e-300, 700:3"/></emitter></scene>"""


@pytest.mark.parametrize("scene", [None, *sorted(SCENES.glob("*.xml"))], ids=lambda path: path and path.stem)
def test_a_scene_is_restored_to_the_last_bit(tmp_path, scene):
    """Every parameter, also the inverses of transforms. XML that Mitsuba writes loses these, and some children."""
    (tmp_path / "scene.xml").write_text(PARAMETERS)
    parsed = parse_scene(scene or tmp_path / "scene.xml")
    restored = scene_parser.restore(parsed.path, json.loads(json.dumps(parsed.nodes)))
    pairs = list(zip(parsed.state.nodes, restored.state.nodes, strict=True))
    for a, b in pairs:
        b.file_index, b.offset = a.file_index, a.offset
    assert all(a == b for a, b in pairs) and len(pairs) > 5
    for a, b in pairs:  # Mitsuba compares only the matrices of transforms
        for name in (name for name in a.props.keys() if a.props.type(name).name == "Transform"):  # noqa: SIM118
            inverses = (np.array(node.props[name].inverse_transpose) for node in (a, b))
            np.testing.assert_array_equal(*inverses)


def test_a_bundle_is_unpacked_and_loaded_once_for_each_set_of_defines(folder, other_machine):
    """The same files with another value are another scene, also if Mitsuba would write both values alike."""
    more = '<default name="light" value="1"/><default name="size" value="1"/>'
    more += '<emitter type="constant"><float name="radiance" value="$light"/></emitter>'
    more += '<shape type="sphere"><transform name="to_world"><scale value="$size"/></transform></shape>'
    scene = write_scene(folder, more=more)
    assert len({pack(scene, {"size": size}).digest for size in ("1", "1.0000002")}) == 2
    bundles = [pack(scene, {"light": light}) for light in ("1", "1", "3")]
    one, same, brighter = (scene_bundle.load(bundle, "scalar_rgb", str(other_machine))[0] for bundle in bundles)
    assert one is same and len([*other_machine.iterdir()]) == 2
    np.testing.assert_allclose(image(brighter), 3 * image(one), rtol=1e-6)


def test_an_incomplete_bundle_is_unpacked_again(folder, other_machine, monkeypatch):
    bundle = pack(write_scene(folder))

    def full(*_):
        raise OSError("No space left on device")

    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space"):
        patch.setattr(scene_bundle.Path, "write_bytes", full)
        scene_bundle.unpack(bundle, str(other_machine))
    moved = scene_bundle.unpack(bundle, str(other_machine))
    assert {name: Path(path).read_bytes() for name, path in moved.items()} == bundle.files


def test_the_digest_depends_on_every_byte(folder):
    before = pack(write_scene(folder)).digest
    assert pack(write_scene(folder)).digest == before
    content = bytearray((folder / "common" / "bright.exr").read_bytes())
    content[-1] ^= 1
    (folder / "common" / "bright.exr").write_bytes(content)
    assert pack(write_scene(folder)).digest != before


def test_a_bundle_that_is_too_large_is_refused_before_files_are_read(folder, monkeypatch):
    scene = write_scene(folder)
    mi.Bitmap(np.random.default_rng(0).random((400, 400, 3), np.float32)).write(str(folder / "common" / "bright.exr"))
    message = rf"{scene}: 1\.\d MiB of files, the largest {folder}/scenes/\.\./common/bright\.exr \(1\.\d MiB\); "
    message += "the limit for a cluster is 1 MiB; raise it by --bundle-limit 2, if all workers have the memory"
    parsed = parse_scene(scene)
    monkeypatch.delattr(scene_bundle.Path, "read_bytes")
    with pytest.raises(ValueError, match=message):
        scene_bundle.pack(parsed, 1)


def test_errors_of_a_bundle_contain_the_original_names_of_files(folder, other_machine):
    scene = write_scene(folder)
    (folder / "common" / "bright.exr").write_bytes(b"no image")
    with pytest.raises(ValueError, match=rf"^{scene}: .*\.\./common/bright\.exr") as error:
        scene_bundle.load(pack(scene), "scalar_rgb", str(other_machine))
    assert str(other_machine) not in str(error.value)


# Scene files ----------------------------------------------------------------------------------------------------------

NESTED = SCENES / "nested.xml"
ABSORBING = """<scene version="3.0.0"><default name="integrator" value="path"/><integrator type="$integrator"/>
<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="4"/></film></sensor>
<shape type="sphere" id="ball"><bsdf type="refract">PARAMETER</bsdf></shape></scene>"""
ABSORPTION = '<float name="int_absorption" value="0.5"/>'
ATTRIBUTE = '<texture type="mesh_attribute" name="ext_ior"><string name="name" value="vertex_n"/></texture>'


@pytest.mark.parametrize(
    "bsdf, formulas", [("refract", ["promoted (auto)"]), ("refract_cross", ["cross"]), ("dielectric", [])]
)
def test_formulas_in_a_scene_are_those_of_its_refract_bsdfs(bsdf, formulas):
    assert formulas_in(load_scene(NESTED, {"res": "8", "bsdf": bsdf})) == formulas


def test_formulas_in_a_scene_include_those_of_instances(tmp_path):
    (tmp_path / "scene.xml").write_text(
        ABSORBING.replace("PARAMETER", '<string name="formula" value="cross"/>')
        .replace('<shape type="sphere"', '<shape type="shapegroup" id="group"><shape type="sphere"')
        .replace("</scene>", '</shape><shape type="instance"><ref id="group"/></shape></scene>')
    )
    assert formulas_in(load_scene(tmp_path / "scene.xml")) == ["cross"]


@pytest.mark.parametrize(
    ("parameter", "defines", "message"),
    [
        ("", {"res": "8193"}, "a film of 8193 × 8193 pixels; expected 1 to 67108864"),
        (ABSORPTION, {}, "refract: int_absorption; expected the integrator refract_path, or no absorption"),
        (ABSORPTION, {"integrator": "refract_path"}, ""),
        (ATTRIBUTE, {}, "refract: 'ball' has no attribute 'vertex_n', which a texture of its BSDF reads; expected"),
    ],
)
def test_errors_of_a_scene_name_its_file_and_the_problem(tmp_path, parameter, defines, message):
    path = NESTED if "res" in defines else tmp_path / "a.xml"
    (tmp_path / "a.xml").write_text(ABSORBING.replace("PARAMETER", parameter))
    if not message:
        load_scene(path, defines)
        return
    with pytest.raises(ValueError) as error:
        load_scene(path, defines)
    assert str(error.value).startswith(f"{path}: {message}")

"""A scene file runs no code but Mitsuba's and ours."""

import os
import re

import mitsuba as mi
import numpy as np
import pytest
from support.processes import python

from mi_refract import SCENES
from mi_refract.plugins import scene_parser

SENSOR = '<sensor type="perspective"/>'

pytestmark = pytest.mark.usefixtures("scalar_variant")


@pytest.fixture
def load(tmp_path):
    """`load("<bsdf/>", other="<scene/>")` loads a scene of these elements, with other scene files in its folder."""

    def call(elements, *allowed, defines=None, **files):
        for name, text in ({"s": elements} | files).items():
            content = text if isinstance(text, bytes) else f'<scene version="3.0.0">{text}</scene>'.encode()
            (tmp_path / f"{name}.xml").write_bytes(content)
        return scene_parser.parse(tmp_path / "s.xml", defines).load(allowed)

    return call


@pytest.fixture
def bait(tmp_path):
    """A folder with files where Mitsuba looks for plugins. It would fail to load them with an error."""
    for path in ("plugins/evil.so", "evil.so", "more/plugins/evil.so", "more/evil.so"):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text("native code")
    return tmp_path


# Plugins ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "elements",
    [
        '<bsdf type="evil"/>',
        '<bsdf type="../evil"/>',
        '<path value="more"/><bsdf type="evil"/>',
        '<shape type="sphere"><bsdf type="twosided"><bsdf type="evil"/></bsdf></shape>',
        '<bsdf type="diffuse"><spectrum name="reflectance" type="evil"/></bsdf>',
        '<default name="name" value="evil"/><integrator type="$name"/>',
        '<include filename="other.xml"/>',
        '<bsdf type="%s/evil"/>',
    ],
)
def test_a_plugin_that_ships_with_the_scene_is_an_error(elements, load, bait):
    with pytest.raises(ValueError, match=r"s\.xml: plugin '.*evil': neither Mitsuba's nor .*--allow-plugins .*evil$"):
        load(elements.replace("%s", str(bait)), other='<bsdf type="evil"/>')


@pytest.mark.parametrize("place", ["scene", "path", "working folder"])
def test_a_file_with_the_name_of_a_python_plugin_is_an_error(place, load, tmp_path, monkeypatch):
    """In scalar variants Mitsuba registers none of these plugins, and looks for a file. Ours are always registered."""
    folder, searched = tmp_path if place == "scene" else tmp_path / "more", '<path value="more"/>' * (place == "path")
    (folder / "plugins").mkdir(parents=True)
    if place == "working folder":
        monkeypatch.chdir(folder)
    for name in (*scene_parser.PYTHON, "refract"):
        (folder / "plugins" / f"{name}.so").write_text("native code")
        if name != "refract":
            with pytest.raises(ValueError, match=f"plugin '{name}': neither Mitsuba's"):
                load(f'{searched}<bsdf type="{name}"/>')
    assert load(f'{SENSOR}{searched}<shape type="sphere"><bsdf type="refract"/></shape>').shapes()[0].bsdf().eta[0] > 1


def test_an_allowed_plugin_is_loaded(load, bait):
    """Mitsuba's error about the file, which is not native code, shows that it tried to load it."""
    with pytest.raises(RuntimeError, match=r"Error while loading plugin .*plugins/evil\.so"):
        load('<bsdf type="evil"/>', "evil")
    with pytest.raises(ValueError, match="plugin 'worse'"):
        load('<bsdf type="evil"/><bsdf type="worse"/>', "evil")


BAIT = """
import os, sys
from pathlib import Path
import mitsuba as mi
import mi_refract
from mi_refract.cli import main
folder = Path("plugins")
folder.mkdir()
for path in (Path(mi.__file__).parent / "plugins").iterdir():
    (folder / path.name).write_text("native code")
Path("more").mkdir()
os.symlink(folder.resolve(), "more/plugins")
code = main(["trace", "t.toml", "--backend", "scalar"])  # a mesh has a diffuse BSDF
sys.exit(code or main(["render", "s.xml", "-o", "out.exr", "--variant", "scalar_rgb", "--spp", "1"]))
"""


def test_mitsubas_plugins_are_not_loaded_from_the_folder_of_the_scene(tmp_path, monkeypatch):
    """Nor from a <path> or the working folder. In a process of its own, as a plugin is loaded once a process."""
    film = '<film type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/></film>'
    sensor = f'<sensor type="perspective">{film}</sensor>'
    elements = f'<path value="more"/><integrator type="path"/>{sensor}<shape type="sphere"/><emitter type="constant"/>'
    (tmp_path / "s.xml").write_text(f'<scene version="3.0.0">{elements}</scene>')
    beam = '[[beam]]\nkind = "fan"\nat = [0, 0]\nangles = [0, 90]\ncount = 3'
    (tmp_path / "t.toml").write_text(f'[[shape]]\nkind = "circle"\nradius = 1\nn = 1.5\nfacets = 60\n{beam}')
    monkeypatch.chdir(tmp_path)
    with python(BAIT) as process:
        out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert "t.toml: 3 rays" in out


def test_all_plugins_of_mitsuba_are_known():
    """C++ plugins are files in its folder; Python plugins are registered by its modules."""
    own = scene_parser.own_folder()
    text = "".join(path.read_text() for path in (own / "python").rglob("*.py"))
    assert sorted(re.findall(r"\.register_\w+\(\s*[\"'](\w+)[\"']", text)) == sorted(scene_parser.PYTHON)
    known = scene_parser.known_plugins()
    assert {"diffuse", "dielectric", "path", "prb", "refract", "refract_cross", "refract_path"} < known
    assert not any("/" in name or not name for name in scene_parser.known_plugins())


def test_our_scenes_use_known_plugins_and_existing_files():
    for path in SCENES.glob("*.xml"):
        parsed = scene_parser.parse(path)
        assert {node.props.plugin_name() for node in parsed.state.nodes} <= scene_parser.known_plugins()
        assert all(file.is_file() for file in parsed.files().values())


def test_loading_restores_the_search_path(load):
    before = [str(folder) for folder in mi.file_resolver()]
    load(f"{SENSOR}<path value='.'/>")
    with pytest.raises(ValueError, match="evil"):
        load('<bsdf type="evil"/>')
    assert [str(folder) for folder in mi.file_resolver()] == before


@pytest.mark.parametrize("last", [3, 10**9])
def test_a_face_with_a_missing_vertex_is_an_error(last, load, tmp_path):
    """Mitsuba would write a normal for each vertex of a face, also to invalid memory, unless face normals are used."""
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n"
    mesh = tmp_path / "more" / "m.ply"
    mesh.parent.mkdir()
    mesh.write_text(f"{head}3 0 1 2\n")
    scene = f'{SENSOR}<path value="more"/><shape type="ply"><string name="filename" value="m.ply"/></shape>'
    assert len(load(scene).shapes()) == 1
    mesh.write_text(f"{head}3 0 1 {last}\n")
    with pytest.raises(ValueError, match=rf"m\.ply: vertex {last} of a face; expected 0 to 2, the vertices"):
        load(scene)


EMPTY = """
import sys
from pathlib import Path
import mitsuba as mi
mi.set_variant("scalar_rgb")
from mi_refract.plugins import scene_parser
KINDS = "bsdf", "emitter", "integrator", "medium", "rfilter", "sensor", "shape", "texture", "volume"
for name in sys.argv[1].split():
    for kind in KINDS:
        with open("s.xml", "w") as file:
            file.write(f'<scene version="3.0.0"><sensor type="perspective"/><{kind} type="{name}"/></scene>')
        print(name, kind, flush=True)
        try:
            scene_parser.parse(Path("s.xml")).load()
        except (RuntimeError, ValueError):
            pass
"""


def test_no_plugin_crashes_without_parameters(tmp_path, monkeypatch):
    """Every plugin of Mitsuba, empty, as every kind of plugin."""
    monkeypatch.chdir(tmp_path)
    names = {*scene_parser.known_plugins(), "rgb", "spectrum"}
    with python(EMPTY, " ".join(sorted(names))) as process:
        out, _ = process.communicate(timeout=120)
    assert process.returncode == 0, out.splitlines()[-1]


@pytest.mark.parametrize("element", ["emitter type='envmap'", "texture type='bitmap'"])
def test_an_image_with_a_corrupt_header_is_an_error(element, load, tmp_path):
    """Mitsuba does not check it: a width of 8 million took minutes, an attribute of 800 MB as much memory."""
    good = (SCENES / "lamps.exr").read_bytes()
    scene = f'{SENSOR}<{element}><string name="filename" value="sky.exr"/></{element.split()[0]}>'
    (tmp_path / "sky.exr").write_bytes(good)
    load(scene)
    window, channels = b"dataWindow\0box2i\0", b"channels\0chlist\0"

    def patched(after, offset, number):
        place = good.index(after) + len(after) + offset
        return good[:place] + number.to_bytes(4, "little") + good[place + 4 :]

    place = good.index(window)
    cut = good[:place] + b"x\0string\0" + (2**30).to_bytes(4, "little") + good[place:]
    for content, message in (
        (patched(window, 12, 2**23), "resolution"),
        (patched(channels, 0, 2**29), "corrupt"),
        (patched(window, 12, 2**19), "expected up to 21116"),
        (cut, "corrupt"),
    ):
        (tmp_path / "sky.exr").write_bytes(content)
        with pytest.raises(ValueError, match=rf"sky\.exr: .*{message}") as caught:
            load(scene)
        assert "max-values" not in str(caught.value)


# Scenes that would crash the process ------------------------------------------------------------------------------


def chain(count, back=1):
    """Return BSDFs, each with a reference to the previous one, or with `back=-1` to the next one."""
    links = range(1, count) if back > 0 else range(count - 1)
    last = 0 if back > 0 else count - 1
    bsdfs = "".join(f'<bsdf type="twosided" id="b{i}"><ref id="b{i - back}"/></bsdf>' for i in links)
    return f'<bsdf type="diffuse" id="b{last}"/>{bsdfs}'


REFUSED = {
    "deep by references": (chain(2000), "plugins nested"),
    "deep by references, forward": (chain(2000, -1), "plugins nested"),
    "many lobes": (chain(20), "65536 lobes of a BSDF"),
    "circle": (
        '<bsdf type="twosided" id="a"><ref id="b"/></bsdf><bsdf type="twosided" id="b"><ref id="a"/></bsdf>',
        "circular reference",
    ),
    "pipe as an image": ('<texture type="bitmap"><string name="filename" value="pipe"/></texture>', "pipe: not a"),
    "device as a mesh": ('<shape type="ply"><string name="filename" value="/dev/zero"/></shape>', "/dev/zero: not a"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_scene_that_would_crash_the_process_is_an_error(case, load, tmp_path, monkeypatch):
    elements, message = REFUSED[case]
    os.mkfifo(tmp_path / "pipe")
    monkeypatch.setattr(mi.parser, "instantiate", lambda *arguments: pytest.fail("ran"))
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        load(elements)
    assert "\n" not in str(caught.value)


def test_a_text_too_long_for_a_file_name_is_no_error(load):
    table = ", ".join(f"{360 + 5 * i}: 1.5" for i in range(95))
    load(f'{SENSOR}<bsdf type="refract"><string name="int_ior" value="table({table})"/></bsdf>')


def test_a_scene_that_is_a_pipe_is_an_error(tmp_path):
    os.mkfifo(tmp_path / "s.xml")
    with pytest.raises(ValueError, match=r"s\.xml: not a regular file"):
        scene_parser.parse(tmp_path / "s.xml")


# Files of a scene -------------------------------------------------------------------------------------------------


def test_files_are_those_that_mitsuba_opens(load, tmp_path):
    """Files in the folder of a <path> precede those in the scene's folder; for included files it is the reverse."""
    for i, folder in enumerate((tmp_path, tmp_path / "more")):
        (folder / "plugins").mkdir(parents=True)
        (folder / "plugins" / "evil.so").write_text("native code")
        (folder / "plugins" / "other.so").touch()
        mi.Bitmap(np.full((1, 1, 3), float(i), np.float32)).write(str(folder / "sky.exr"))
        (folder / "inner.xml").write_text('<scene version="3.0.0">' + '<shape type="sphere"/>' * (i + 1) + "</scene>")
        (folder / "n.spd").write_text(f"300 {0.2 + 0.2 * i}\n900 {0.2 + 0.2 * i}")
    sky = '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
    n = '<bsdf type="diffuse"><spectrum name="reflectance" filename="n.spd"/></bsdf>'
    elements = f'{SENSOR}<path value="more"/><include filename="inner.xml"/><include filename="inner.xml"/>{sky}'
    scene = load(elements + n)
    parsed = scene_parser.parse(tmp_path / "s.xml")
    assert len(scene.shapes()) == 2
    params = mi.traverse(scene)
    assert np.array(params[next(key for key in [*params.keys()] if key.endswith(".data"))]).max() == 1
    values = np.concatenate([np.ravel(np.array(params[key])) for key in [*params.keys()] if "reflectance" in key])
    assert {0.4} <= {*values.round(1).tolist()} <= {0.4, 0.5}  # 0.5: of the sphere
    assert parsed.files() == {"sky.exr": tmp_path / "more" / "sky.exr"}
    assert ("reflectance", "Spectrum", ([300.0, 900.0], [0.4, 0.4])) in [x for node in parsed.nodes for x in node[3]]
    with pytest.raises(RuntimeError, match=rf"Error while loading plugin .*{tmp_path}/more/plugins/evil\.so"):
        load(elements + '<bsdf type="evil"/>', "evil")
    code = scene_parser.parse(tmp_path / "s.xml").files(("evil",))
    assert code["plugins/evil.so"] == tmp_path / "more" / "plugins" / "evil.so" and "plugins/other.so" not in code

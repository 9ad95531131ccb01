"""Scene files: the ones that ship say what their comments claim, and what a file cannot be is one line with its key."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from mi_refract.io import toml_schema
from mi_refract.planar import Event, scene_schema, shapes, trace
from mi_refract.planar.scene_file import load

SCENES = Path(__file__).parents[2] / "scenes" / "planar"
ULP = 2.0**-52


def paths(scene, colour=0, **options):
    return trace(scene.segments[colour], scene.origins, scene.directions, scene.max_depth, **options)


def last_legs(found):
    """Where the last legs start."""
    count = (found.hits >= 0).sum(1)
    return found.points[np.arange(len(count)), count]


def misses(found, point=(0.0, 0.0)):
    """Signed distances of the last legs' lines from a point."""
    (x, y), (u, v) = (last_legs(found) - point).T, found.directions.T
    return x * v - y * u


def written(tmp_path, text):
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return path


# The scenes that ship ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.toml")), ids=lambda path: path.stem)
def test_scenes_load_and_all_rays_find_their_way_out(path, needs_variant):
    scene = load(path)
    if path.stem == "luneburg":
        needs_variant("llvm_ad_rgb")  # a second a ray on scalar numbers
    assert len(scene.segments) == len(scene.colours) == len(scene.index)
    assert len(scene.origins) == len(scene.directions) == len(scene.beams)
    assert np.abs(np.hypot(*scene.directions.T) - 1).max() <= 2 * ULP
    for colour, segments in enumerate(scene.segments):
        assert {Event(e) for e in np.unique(paths(scene, colour).events)} <= {
            Event.NONE,
            Event.REFRACTED,
            Event.REFLECTED,
            Event.ESCAPED,
        }
        assert segments.start.tolist() == scene.segments[0].start.tolist()
    for region in scene.regions:
        assert len(region.indices) == len(scene.colours)
        x, y = region.outline.T
        assert np.dot(x, np.roll(y, -1)) > np.dot(y, np.roll(x, -1))


def test_the_scenes_are_those_of_the_document():
    lens, box = load(SCENES / "lens.toml"), load(SCENES / "box.toml")
    exact = shapes.document_lens().mapped(np.eye(2), (0, -40))
    for found, expected in ((lens.segments[0].start, exact.start), (lens.segments[0].control, exact.control)):
        order, other = (np.lexsort(np.round(p, 9).T) for p in (found, expected))
        assert np.abs(found[order] - expected[other]).max() <= 64 * ULP * 40
    assert lens.segments[0].n_left.tolist() == [shapes.LENS_INDEX] * 4
    assert lens.origins.tolist() == [[x, -100] for x in range(-30, 31, 5)]
    assert box.origins.tolist() == [[x, -100] for x in range(-130, 71, 5)]
    reflected = (paths(box).events == Event.REFLECTED).sum(1)
    assert sorted(reflected[reflected > 0].tolist()) == [1, 4]


def test_the_ellipse_focuses_to_rounding_in_any_medium(tmp_path):
    assert np.abs(misses(paths(load(SCENES / "ellipse.toml")))).max() <= 8 * ULP * 4
    wet = written(tmp_path, "index = 1.1\n" + (SCENES / "ellipse.toml").read_text())
    assert np.abs(misses(paths(load(wet)))).max() <= 8 * ULP * 4


def test_the_aplanatic_ball_has_one_virtual_image():
    found = paths(load(SCENES / "aplanatic.toml"))
    assert np.abs(misses(found, (-4.5, 0))).max() <= 16 * ULP * 4.5
    assert np.abs(misses(found, (-4.4, 0))).max() > 1e-2


def test_the_luneburg_lens_focuses_the_better_the_more_layers(tmp_path, needs_variant):
    needs_variant("llvm_ad_rgb")
    text = (SCENES / "luneburg.toml").read_text()
    spread = []
    for layers in (16, 64, 256):
        scene = load(written(tmp_path, text.replace("layers = 50", f"layers = {layers}").replace("= 128", "= 600")))
        spread.append(float(np.sqrt(np.mean(misses(paths(scene), (1, 0)) ** 2))))
    # A ray turns within a layer: the error goes like the root of its width, 0.055, 0.026, 0.012.
    assert spread[1] < 0.6 * spread[0]
    assert spread[2] < 0.6 * spread[1]


def test_the_prism_deviates_by_the_least_angle():
    scene = load(SCENES / "prism.toml")
    for colour, n in enumerate((1.51432, 1.51680, 1.52238)):
        u, v = paths(scene, colour).directions.T
        least = 2 * math.asin(n / 2) - math.pi / 3
        found = math.radians(19.32) - np.arctan2(v, u)
        assert np.ptp(found) <= 8 * ULP
        assert 0 <= found[0] - least < 2e-5


def test_the_rainbow_ends_at_its_angle_red_outside():
    scene = load(SCENES / "rainbow.toml")
    bows = []
    for colour, n in enumerate((1.33122, 1.33299, 1.33712)):
        u, v = paths(scene, colour, reflect=0b10).directions.T
        bows.append(np.degrees(np.arctan2(-v, -u)).max())
        i = math.acos(math.sqrt((n * n - 1) / 3))  # Descartes
        assert bows[-1] == pytest.approx(math.degrees(4 * math.asin(math.sin(i) / n) - 2 * i), abs=5e-4)
    assert bows[0] > bows[1] > bows[2] > 41


def test_the_light_guide_keeps_every_ray():
    scene = load(SCENES / "fibre.toml")
    found = paths(scene)
    assert (last_legs(found)[:, 1] == 20).all()
    assert (found.events == Event.REFLECTED).sum(1).max() >= 20


def test_the_achromat_unites_three_colours():
    scene = load(SCENES / "doublet.toml")
    assert len(scene.segments[0]) == 10  # 12 pieces of two lenses, the surface between them once
    rays = np.abs(scene.origins[:, 1]) > 1
    foci = []
    for colour in range(3):
        found = paths(scene, colour)
        (x, y), (u, v) = last_legs(found)[rays].T, found.directions[rays].T
        foci.append(x - y * u / v)
    assert np.ptp(np.mean(foci, axis=1)) < 0.1  # of a lens of N-BK7 alone: 1.6
    assert np.abs(np.array(foci) - 102.75).max() < 0.15


# Reading ----------------------------------------------------------------------------------------------------------


SCENE = """
title = "A disc"
index = [1, 1.1]
colours = ["red", "blue"]
max_depth = 5
branches = 1
view = [-2, 2, -1.5, 1.5]
[[shape]]
kind = "circle"
name = "disc"
radius = 2
n = [1.5, 1.6]
scale = [1, 0.5]
rotate = 30
at = [1, 2]
[[shape]]
kind = "luneburg"
radius = 0.2
layers = 2
within = "disc"
at = [1, 2]
[[shape]]
kind = "ellipse"
radii = [1, 2]
n = 1.3
outside = [1, 1.1]
at = [9, 0]
facets = 20
[[beam]]
kind = "parallel"
from = [-5, -1]
to = [-5, 1]
direction = [3, 4]
count = 1
[[beam]]
kind = "fan"
at = [-5, 0]
angles = [-90, 90]
count = 3
[[beam]]
kind = "rays"
origins = [[0, 1], [2, 3]]
directions = [180, [0, -1e300]]
"""


def test_a_scene_is_read_as_it_is_written(tmp_path):
    scene = load(written(tmp_path, SCENE))
    assert (scene.title, scene.colours, scene.index) == ("A disc", ("red", "blue"), (1.0, 1.1))
    assert (scene.max_depth, scene.branches, scene.view) == (5, 1, (-2.0, 2.0, -1.5, 1.5))
    assert scene.origins.tolist() == [[-5, 0], [-5, 0], [-5, 0], [-5, 0], [0, 1], [2, 3]]
    assert scene.directions.tolist() == [[0.6, 0.8], [0, -1], [1, 0], [0, 1], [-1, 0], [0, -1]]
    assert scene.beams.tolist() == [0, 1, 1, 1, 2, 2]
    assert [region.indices for region in scene.regions] == [
        (1.5, 1.6),
        tuple(math.sqrt(1.25) * n for n in (1.5, 1.6)),
        tuple(math.sqrt(1.75) * n for n in (1.5, 1.6)),
        (1.3, 1.3),
    ]
    for colour, segments in enumerate(scene.segments):
        disc, outer, inner, ellipse = (region.indices[colour] for region in scene.regions)
        around = scene.index[colour]
        assert segments.n_left.tolist() == [disc] * 4 + [outer] * 4 + [inner] * 4 + [ellipse] * 20
        assert segments.n_right.tolist() == [around] * 4 + [disc] * 4 + [outer] * 4 + [around] * 20
    vertex = scene.segments[0].start[0] - (1, 2)
    assert vertex == pytest.approx([2 * math.cos(math.pi / 6), 2 * math.sin(math.pi / 6)], abs=1e-15)


def test_what_is_not_said_of_a_scene(tmp_path):
    text = '[[shape]]\nkind = "circle"\nradius = 1\nn = 1.5\n[[beam]]\nkind = "rays"\norigins = [[0, 3]]\n'
    scene = load(written(tmp_path, text + "directions = [0]\n"))
    assert (scene.max_depth, scene.branches, scene.index, scene.view) == (16, 0, (1.0,), None)


def test_rays_start_at_round_numbers_where_they_can():
    for count in range(2, 200):
        beam = {"from": [0, 1], "to": [count - 1, 1], "direction": np.array([0, 1]), "count": count}
        origins, _ = scene_schema.BEAMS["parallel"].build(beam)
        assert origins.tolist() == [[j, 1] for j in range(count)]


def test_a_file_without_a_title_has_its_own_name(tmp_path):
    scene = load(written(tmp_path, SCENE.replace('title = "A disc"', "")))
    assert scene.title == "scene"
    assert scene.path.name == "scene.toml"


BAD = {  # what is replaced, by what: the key, what was found, what is accepted
    "unknown key": ("max_depth = 5", "max_depths = 5", "max_depths: unknown; expected title, index"),
    "unknown key of a shape": ("facets = 20", "radius = 3", "shape[2].radius: unknown; expected radii"),
    "strange key": ("max_depth = 5", '"a\\nb" = 5', r"'a\nb': unknown"),
    "missing key": ("radius = 0.2", "", "shape[1].radius: missing; expected a number above 0"),
    "missing index": ("n = [1.5, 1.6]", "", "shape[0].n: missing; expected a number above 0, a list"),
    "wrong type": ("radius = 2\n", 'radius = "2"\n', "shape[0].radius: '2'; expected a number above 0"),
    "bool": ("radius = 2\n", "radius = true\n", "shape[0].radius: true; expected a number"),
    "NaN": ("radius = 2\n", "radius = nan\n", "shape[0].radius: nan; expected a number"),
    "infinity": ("at = [9, 0]", "at = [inf, 0]", "shape[2].at: [inf, 0]; expected [x, y]"),
    "no float": ("rotate = 30", f"rotate = 1{'0' * 400}", "shape[0].rotate: 1000"),
    "date": ("rotate = 30", "rotate = 1999-12-31", "shape[0].rotate: datetime.date(1999, 12, 31); expected a number"),
    "index 0": ("n = 1.3", "n = 0", "shape[2].n: 0; expected a number above 0"),
    "negative index": ("index = [1, 1.1]", "index = [1, -1.1]", "index: [1, -1.1]; expected a number above 0"),
    "index of a third colour": ("n = 1.3", "n = [1, 2, 3]", "shape[2].n: 3 numbers; expected 1 for all or each of 2"),
    "colours missing": ('colours = ["red", "blue"]', "", "index: 2 numbers; expected 1 for all or each of 1"),
    "no colours": ('["red", "blue"]', "[]", "colours: []; expected a list of texts"),
    "max_depth 0": ("max_depth = 5", "max_depth = 0", "max_depth: 0; expected a whole number, 1 to"),
    "max_depth 1.5": ("max_depth = 5", "max_depth = 1.5", "max_depth: 1.5; expected a whole number"),
    "branches": ("branches = 1", "branches = -1", "branches: -1; expected a whole number, 0 to"),
    "view": ("view = [-2, 2,", "view = [2, -2,", "view: [2, -2, -1.5, 1.5]; expected [x0, x1, y0, y1]"),
    "unknown kind": ('"ellipse"', '"elipse"', "shape[2].kind: 'elipse'; expected polygon, rectangle, prism"),
    "kind missing": ('kind = "ellipse"', "", "shape[2].kind: missing; expected polygon"),
    "kind of beam": ('"fan"', '"torch"', "beam[1].kind: 'torch'; expected parallel, fan, rays"),
    "kind as a list": ('kind = "fan"', "kind = []", "beam[1].kind: []; expected parallel"),
    "name taken": ("radii = [1, 2]", 'radii = [1, 2]\nname = "disc"', "shape[2].name: 'disc' is another shape's"),
    "within nothing": ('"disc"\nat', '"dish"\nat', "shape[1].within: 'dish'; expected the name of a shape above"),
    "within and outside": ('"disc"\nat', '"disc"\noutside = 1\nat', "shape[1].within: 'disc', beside `outside`"),
    "scale 0": ("scale = [1, 0.5]", "scale = [1, 0]", "shape[0].scale: [1, 0]; expected a number of size"),
    "out of range": ("radii = [1, 2]\n", "radii = [1, 1e99]\nscale = 99\n", "shape[2]: coordinates beyond 1e+100"),
    "lost": ("radii = [1, 2]", "radii = [1e-20, 2e-20]", "shape[2]: a point, beside coordinates of 9; expected above"),
    "facets": ("facets = 20", "facets = 3", "shape[2].facets: 3, for 4 arcs"),
    "no rays": ("count = 3", "count = 0", "beam[1].count: 0; expected a whole number, 1 to"),
    "no direction": ("direction = [3, 4]", "direction = [0, 0]", "beam[0].direction: [0, 0]; expected degrees, or"),
    "three coordinates": ("at = [-5, 0]", "at = [-5, 0, 1]", "beam[1].at: [-5, 0, 1]; expected [x, y]"),
    "far away": ("origins = [[0, 1]", "origins = [[0, 1e101]", "beam[2]: coordinates beyond 1e+100"),
    "too few directions": ("[180, [0, -1e300]]", "[180]", "beam[2].directions: 1, for 2 origins"),
    "no list": ("origins = [[0, 1], [2, 3]]", "origins = 3", "beam[2].origins: 3; expected a list of [x, y]"),
    "one table": ("[[shape]]", "[shape]", "expected TOML"),
    "syntax": ("max_depth = 5", "max_depth = = 5", "(at line 5, column 13); expected TOML"),
    "twice": ("max_depth = 5", "max_depth = 5\nmax_depth = 5", "expected TOML"),
    "nesting": ("max_depth = 5", f"max_depth = {'[' * 5000}", "expected TOML"),
}


@pytest.mark.parametrize("old, new, expected", BAD.values(), ids=BAD)
def test_what_a_file_cannot_be_is_one_line_with_file_and_key(tmp_path, old, new, expected):
    assert old in SCENE
    path = written(tmp_path, SCENE.replace(old, new, 1))
    with pytest.raises(ValueError) as caught:
        load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    assert len(message) < 400
    assert expected in message


def without(table):
    """The scene without its [[shape]]s, or without its [[beam]]s."""
    head, *tables = SCENE.split("\n[[")
    return "\n[[".join([head, *(text for text in tables if not text.startswith(table))])


@pytest.mark.parametrize(
    "text, expected",
    [
        ("", "shape: missing; expected a table or more"),
        (without("shape"), "shape: missing"),
        (without("beam"), "beam: missing"),
        (without("beam") + "\n[beam]\ncount = 1", "beam: {'count': 1}; expected a table or more, in double brackets"),
        ("shape = []\n" + without("shape"), "shape: []; expected a table or more"),
    ],
)
def test_an_empty_scene_is_none(tmp_path, text, expected):
    with pytest.raises(ValueError, match=r"^[^\n]*$") as caught:
        load(written(tmp_path, text))
    assert expected in str(caught.value)


def test_what_is_no_text_is_no_scene(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_bytes(b"title = '\xff'")
    with pytest.raises(ValueError, match=r"scene\.toml: byte 9 is not UTF-8; expected TOML"):
        load(path)
    with pytest.raises(FileNotFoundError, match=r"^[^\n]*none\.toml[^\n]*$"):
        load(tmp_path / "none.toml")
    with pytest.raises(IsADirectoryError, match=r"^[^\n]*$"):
        load(tmp_path)


@pytest.mark.parametrize(
    "shape, expected",
    [
        ('kind = "lens"\ncurvature = [0.1, 0.2]\nthickness = 1', "shape[0].curvature = [0.1, 0.2]: the surfaces never"),
        ('kind = "lens"\ncurvature = [1, -1]\nthickness = 1\nradius = 2', "shape[0].radius = 2: a surface ends"),
        ('kind = "ellipse_lens"\nfocal_length = 1\nthickness = 2\nradius = 1', "shape[0].n = 1.5, thickness = 2;"),
        ('kind = "polygon"\npoints = [[0, 0], [1, 1]]', "shape[0].points: they enclose no area"),
        ('kind = "polygon"\npoints = [[0, 0]]', "shape[0].points: 1; expected at least 2"),
        ('kind = "polygon"\npoints = [[0, 0], [1, 1], [0, 1]]\narcs = [9]', "shape[0].arcs: 1 for 3 pieces"),
        ('kind = "prism"\nside = 1\napex = 180', "shape[0].apex: 180; expected degrees, above 0 and below 180"),
    ],
)
def test_what_a_shape_cannot_be_names_its_key(tmp_path, shape, expected):
    text = f"[[shape]]\nn = 1.5\n{shape}\n[[beam]]\n{SCENE.rpartition('[[beam]]')[2]}"
    with pytest.raises(ValueError, match=r"^[^\n]*$") as caught:
        load(written(tmp_path, text))
    assert expected in str(caught.value)


def test_the_reference_knows_every_kind_and_key():
    text = scene_schema.reference()
    for kinds in (scene_schema.SHAPES, scene_schema.BEAMS):
        for name, kind in kinds.items():
            assert f"| `{name}` |" in text
            assert all(f"`{key}`" in text for key in kind.keys)
    assert all(line.count("|") == 4 for line in text.splitlines() if line)


NASTY = [0, -1, 1, 3, 1e-300, -1e300, 1e308, 10**400, math.inf, math.nan, True, "", "disc", [], {}, [{}], [[[0]]]]
NASTY += [[1], [0, 0], [1, -1], [1e200, 1e-200], [1e300, 1e300], [[0, 0], [1, 0], [0, 1]], [[1e308, 0], [-1e308, 1]]]


def toml(value):
    """As a TOML value."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return f"[{', '.join(map(toml, value))}]"
    return json.dumps(value).replace("Infinity", "inf").replace("NaN", "nan")


def plain(value):
    """What a default is in a file."""
    return 1 if value is toml_schema.REQUIRED or value is None else value


@pytest.mark.filterwarnings("error")
def test_whatever_the_values_a_file_is_a_scene_or_one_line(tmp_path):
    """600 files with values that a key may or may not have, in any place."""
    rng, read = np.random.default_rng(20), 0
    beam = {"kind": "rays", "origins": [[0, 0]], "directions": [0]}
    for _ in range(600):
        name = str(rng.choice(list(scene_schema.SHAPES)))
        table = {key: plain(entry.default) for key, entry in scene_schema.SHAPES[name].keys.items()}
        table = {"kind": name} | {key: value for key, value in table.items() if key not in ("within", "facets", "arcs")}
        table |= {"points": [[0, 0], [1, 0], [0, 1]]} if "points" in table else {}
        table |= {key: [0.1, -0.2] for key in ("curvature", "radii") if key in table}
        table |= {"name": "a"} if "name" in table else {}
        for key in rng.choice([*scene_schema.SHAPES[name].keys], rng.integers(0, 3)):
            table[str(key)] = NASTY[rng.integers(len(NASTY))]
        path = written(tmp_path, f"shape = {toml([table])}\nbeam = {toml([beam])}")
        try:
            scene = load(path)
        except ValueError as error:
            line = rf"{re.escape(str(path))}: shape\[0\](\.\w+)?( = |: )[^\n]+"
            assert re.fullmatch(line, str(error)), error
        else:
            read += 1
            assert all(np.isfinite(region.outline).all() for region in scene.regions)
    assert 100 < read < 500

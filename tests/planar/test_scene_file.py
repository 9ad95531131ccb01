"""Scene files: valid and invalid content, colours, shapes that touch, the shipped scenes, and the how-to page."""

import math
import re
from typing import get_args

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies
from support.readme import DOCS, ROOT, blocks, python_blocks

from mi_refract import media
from mi_refract.planar import Event, light, scene_file, trace
from mi_refract.planar.light import Light, of_wavelengths
from mi_refract.planar.scene_file import load

SCENES = ROOT / "scenes" / "planar"
PAGE = DOCS / "how-to/trace-rays-in-two-dimensions.md"
ULP = 2.0**-52


def paths(scene, colour=0, **options):
    return trace(scene.segments[colour], scene.origins, scene.directions, scene.max_depth, **options)


def last_legs(traced):
    """The starts of the last legs."""
    count = (traced.hits >= 0).sum(1)
    return traced.points[np.arange(len(count)), count]


@pytest.fixture
def read(tmp_path):
    """`read(text)`: the scene of a file with that text."""

    def read(text, *options):
        path = tmp_path / "scene.toml"
        path.write_text(text)
        return load(path, *options)

    return read


# Shipped scenes -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_scenes_load_and_all_rays_escape(path, needs_variant, variant):
    """The scalar backend, which takes a minute for a double rainbow, traces only the first and the last colour."""
    scene = load(path)
    colours = range(len(scene.segments)) if variant == "llvm_ad_rgb" else {0, len(scene.segments) - 1}
    if path.stem == "luneburg":
        needs_variant("llvm_ad_rgb")  # a second per ray on the scalar backend
    assert len(scene.segments) == len(scene.light.names) == len(scene.index)
    assert len(scene.origins) == len(scene.directions) == len(scene.beams)
    assert np.abs(np.hypot(*scene.directions.T) - 1).max() <= 2 * ULP
    for segments in scene.segments:
        assert segments.start.tolist() == scene.segments[0].start.tolist()
    for colour in colours:
        assert set(np.unique(paths(scene, colour).events)) <= {0, Event.REFRACTED, Event.REFLECTED, Event.ESCAPED}
    for region in scene.regions:
        assert len(region.indices) == len(scene.light.names)
        x, y = region.outline.T
        assert np.dot(x, np.roll(y, -1)) > np.dot(y, np.roll(x, -1))


def test_lens_and_box_are_those_of_the_document():
    """The lens: |y + 40| = k + c r² / (1 + √(1 − (1 + K) c² r²)), x = 4 r. The box: one or four reflections."""
    lens, box = load(SCENES / "lens.toml"), load(SCENES / "box.toml")
    x, y = lens.regions[0].outline.T
    sag = -0.04 * (x / 4) ** 2 / (1 + np.sqrt(np.maximum(1 - 2.9 * (0.04 * x / 4) ** 2, 0)))
    assert np.abs(np.abs(y + 40) - (8.2 + sag)).max() <= 1e-13
    assert (lens.segments[0].n_left.tolist(), len(x)) == ([4.4] * 4, 4 * 64)
    assert lens.origins.tolist() == [[x, -100] for x in range(-30, 31, 5)]
    assert box.origins.tolist() == [[x, -100] for x in range(-130, 71, 5)]
    reflected = (paths(box).events == Event.REFLECTED).sum(1)
    assert sorted(reflected[reflected > 0].tolist()) == [1, 4]


@pytest.mark.parametrize("index", ["", "index = 1.1\n"])
def test_the_ellipse_focuses_to_rounding_in_any_medium_around_it(read, index):
    traced = paths(read(index + (SCENES / "ellipse.toml").read_text()))
    (x, y), (u, v) = last_legs(traced).T, traced.directions.T
    assert np.abs(x * v - y * u).max() <= 8 * ULP * 4


def test_the_achromat_focuses_three_colours_together():
    scene = load(SCENES / "doublet.toml")
    assert len(scene.segments[0]) == 10  # 12 pieces of two lenses, which share the surface between them
    rays, foci = np.abs(scene.origins[:, 1]) > 1, []
    for colour in range(3):
        traced = paths(scene, colour)
        (x, y), (u, v) = last_legs(traced)[rays].T, traced.directions[rays].T
        foci.append(x - y * u / v)
    assert np.ptp(np.mean(foci, axis=1)) < 0.1  # of a lens of N-BK7 alone: 1.6
    assert np.abs(np.array(foci) - 102.75).max() < 0.15


# Reading ----------------------------------------------------------------------------------------------------------


HEAD = """title = "A disc"
index = [1, 1.1]
colours = ["red", "blue"]
max_depth = 5
branches = 1
view = [-2, 2, -1.5, 1.5]
"""
SHAPES = """shape = [
    {kind = "circle", name = "disc", radius = 2, n = [1.5, 1.6], scale = [1, 0.5], rotate = 30, at = [1, 2]},
    {kind = "luneburg", radius = 0.2, layers = 2, within = "disc", at = [1, 2]},
    {kind = "ellipse", radii = [1, 2], n = 1.3, outside = [1, 1.1], at = [9, 0], facets = 20},
]
"""
BEAMS = """beam = [
    {kind = "parallel", from = [-5, -1], to = [-5, 1], direction = [3, 4], count = 1},
    {kind = "fan", at = [-5, 0], angles = [-90, 90], count = 3},
    {kind = "rays", origins = [[0, 1], [2, 3]], directions = [180, [0, -1e300]]},
]
"""
SCENE = HEAD + SHAPES + BEAMS


def test_a_scene_has_the_values_of_its_file(read):
    scene = read(SCENE)
    assert (scene.title, scene.light.names, scene.index) == ("A disc", ("red", "blue"), (1.0, 1.1))
    assert (scene.max_depth, scene.branches, scene.view) == (5, 1, (-2.0, 2.0, -1.5, 1.5))
    assert scene.origins.tolist() == [[-5, 0], [-5, 0], [-5, 0], [-5, 0], [0, 1], [2, 3]]
    assert scene.directions.tolist() == [[0.6, 0.8], [0, -1], [1, 0], [0, 1], [-1, 0], [0, -1]]
    assert scene.beams.tolist() == [0, 1, 1, 1, 2, 2]
    layers = [tuple(math.sqrt(x) * n for n in (1.5, 1.6)) for x in (1.25, 1.75)]
    assert [region.indices for region in scene.regions] == [(1.5, 1.6), *layers, (1.3, 1.3)]
    for colour, segments in enumerate(scene.segments):
        disc, outer, inner, ellipse = (region.indices[colour] for region in scene.regions)
        around = scene.index[colour]
        assert segments.n_left.tolist() == [disc] * 4 + [outer] * 4 + [inner] * 4 + [ellipse] * 20
        assert segments.n_right.tolist() == [around] * 4 + [disc] * 4 + [outer] * 4 + [around] * 20
    disc, outer, inner = scene.segments[0].start[:12:4] - (1, 2)
    assert disc == pytest.approx([2 * math.cos(math.pi / 6), 2 * math.sin(math.pi / 6)], abs=1e-15)
    assert [*outer, *inner] == pytest.approx([0.2, 0, 0.2 * math.sqrt(0.5), 0], abs=1e-15)


DISC = '[[shape]]\nkind = "circle"\nradius = 1\nn = 1.5\n'
RAY = "[[beam]]\nkind = 'rays'\norigins = [[0, 3]]\ndirections = [0]\n"


def test_defaults_and_whole_numbers_of_rays(read):
    scene = read(DISC + RAY)
    assert (scene.max_depth, scene.branches, scene.index, scene.view) == (16, 0, (1.0,), None)
    assert (scene.title, scene.path.name) == ("scene", "scene.toml")
    beam = '[[beam]]\nkind = "parallel"\nfrom = [0, 1]\nto = [{}, 1]\ndirection = 0\ncount = {}\n'
    scene = read(DISC + "".join(beam.format(count - 1, count) for count in range(2, 200)))
    assert scene.origins.tolist() == [[j, 1] for count in range(2, 200) for j in range(count)]


BAD = [  # replaced text, replacement, part of the error
    ("max_depth = 5", "max_depths = 5", "unknown key `max_depths`; expected title, index"),
    ("radius = 2,", 'radius = "2",', "shape[0].radius: text; expected a number"),
    ("radius = 2,", "radius = nan,", "shape[0].radius: nan; expected a finite number"),
    ("n = 1.3", "n = 0", "shape[2].n: expected a number > 0.0"),
    ("index = [1, 1.1]", "index = [1, -1.1]", "index[1]: expected a number > 0.0"),
    ('title = "A disc"', 'title = " "', "title: expected text that is not blank"),
    ('name = "disc"', 'name = ""', "shape[0].name: expected text that is not blank"),
    ("view = ", 'light = "D65"\nview = ', "light: 'D65' without wavelengths; expected"),
    ("n = 1.3", "n = 517642", "shape[2].n = 517642.0; expected an index; the code of a glass is a text: '517642'"),
    ("n = 1.3", "n = [1, 2, 3]", "shape[2].n: 3 numbers; expected 1, or one for each of 2"),
    ('colours = ["red", "blue"]', "", "index: 2 numbers; expected 1, or one for each of 1"),
    ('["red", "blue"]', "[]", "colours: expected a list [ … ] of length >= 1"),
    ("max_depth = 5", "max_depth = 0", "max_depth: expected a whole number >= 1"),
    ("branches = 1", "branches = -1", "branches: expected a whole number >= 0"),
    ("view = [-2, 2,", "view = [2, -2,", "view: [2.0, -2.0, -1.5, 1.5]; expected [x0, x1, y0, y1], x0 < x1"),
    ('"ellipse"', '"elipse"', "shape[2].kind: invalid value 'elipse'; expected polygon, rectangle"),
    ("radii = [1, 2]", 'radii = [1, 2], name = "disc"', "shape[2].name: 'disc' is the name of another shape"),
    ('"disc", at', '"dish", at', "shape[1].within: 'dish'; expected the name of a shape above: 'disc'"),
    ('"disc", at', '"disc", outside = 1, at', "shape[1].within: 'disc', but `outside` is set"),
    ("scale = [1, 0.5]", "scale = [1, 0]", "shape[0]: scale: (1.0, 0.0); expected numbers of size"),
    ("radii = [1, 2]", "radii = [1, 1e99], scale = 99", "expected up to ±1e+100"),
    ("radii = [1, 2]", "radii = [1e-20, 2e-20]", "shape[2]: too small, rounding makes it a point; expected"),
    ("facets = 20", "facets = 3", "shape[2].facets: 3 for 4 arcs"),
    ("count = 3", "count = 0", "beam[1].count: expected a whole number >= 1"),
    ("direction = [3, 4]", "direction = [0, 0]", "beam[0].direction: [0, 0]; expected degrees, or"),
    ("origins = [[0, 1]", "origins = [[0, 1e101]", "beam[2]: 1e+101; expected up to ±1e+100"),
    ("[-90, 90]", "[-1e308, 1e308]", "beam[1].angles: [-1e+308, 1e+308]"),
    ("[180, [0, -1e300]]", "[180]", "beam[2]: directions: 1 for 2 origins"),
    ("shape = [", "shape = 3 # [", "expected TOML"),
    ("max_depth = 5", "max_depth = .5", "max_depth = .5: numbers have a digit on either side of the point, as 0.8"),
    ("max_depth = 5", "index = [ 1., 2]", "index = [ 1., 2]: numbers have a digit on either side of the point"),
    ('title = "A disc"', "title = Disc", "line 1, column 9): title = Disc: text is in quotes; true and false are"),
    (SHAPES, "", "object missing required field `shape`"),
    (SHAPES, "[shape]\nradius = 1\n", "shape: a table { … }; expected a list [ … ] of tables, [[…]] in TOML"),
    ('kind = "circle", ', "", "shape[0]: object missing required field `kind`; expected polygon, rectangle, prism"),
    ("radius = 2,", "", "shape[0]: object missing required field `radius`"),
    (SHAPES, "shape = []\n", "shape: expected a list [ … ] of length >= 1"),
    (BEAMS, "", "object missing required field `beam`"),
]
# Colours by wavelength.
CAUCHY, TWO_LINES = "cauchy(1.5, 4000)", "wavelengths = [486.1327, 587.5618]"
GLASSES = SCENE.replace("n = 1.3", f'n = "{CAUCHY}"').replace('colours = ["red", "blue"]', TWO_LINES)
BAD_GLASSES = [
    (CAUCHY, "glas", "shape[2].n = 'glas': unknown material; expected vacuum"),
    (CAUCHY, "cauchy(1.5", "shape[2].n = 'cauchy(1.5'; expected cauchy(…)"),
    (CAUCHY, "table(500: 1.5, 900: 1.4)", "shape[2].n: table(500: 1.5, 900: 1.4): no index"),
    (TWO_LINES, "wavelengths = 1", "wavelengths: expected a whole number >= 2"),
    (TWO_LINES, "wavelengths = [-500]", "wavelengths[0]: expected a number >= 100.0"),
    (TWO_LINES, "wavelengths = 257", "wavelengths: expected a whole number <= 256"),
    ("title", 'colours = ["a", "b"]\ntitle', "colours and wavelengths are both set; expected one"),
    ("title", 'light = "A"\ntitle', "light: invalid enum value 'A'; expected D65, flat"),
]


@pytest.mark.parametrize(
    "scene, old, new, expected", [(SCENE, *case) for case in BAD] + [(GLASSES, *case) for case in BAD_GLASSES]
)
def test_errors_name_file_and_key_in_one_line(read, tmp_path, scene, old, new, expected):
    assert old in scene
    with pytest.raises(ValueError) as caught:
        read(scene.replace(old, new, 1))
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'scene.toml'}: ") and "\n" not in message and len(message) < 400
    assert expected in message


@pytest.mark.parametrize("kind", [x.__struct_config__.tag for x in get_args(scene_file.AnyShape)])
def test_the_lists_of_keys_are_those_that_a_shape_takes(read, kind):
    listed = set()
    for text in scene_file.reference().split("\n\n"):
        title, _, keys = text.partition(":\n") if text.startswith("Every") else text.partition("\n")
        of_all = title.startswith("Every") and f"`{kind}`" not in title
        if of_all or title.startswith(f'[[shape]] kind = "{kind}"'):
            listed |= set(re.findall(r"^  (\w+)", keys, re.MULTILINE))
    with pytest.raises(ValueError) as caught:
        read(f"[[shape]]\nkind = '{kind}'\nunknown = 1")
    assert listed == set(str(caught.value).partition("expected ")[2].split(", "))


def test_files_that_cannot_be_read(tmp_path):
    path = tmp_path / "scene.toml"
    for content, match in (
        (b"title = '\xff'", r"^[^\n]*scene\.toml: 'utf-8' codec [^\n]*position 9[^\n]*; expected TOML$"),
        (b" " * (2**24 + 1), r"scene\.toml: \d+ bytes; expected up to \d+"),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=match):
            load(path)
    for path, error in ((tmp_path / "none.toml", FileNotFoundError), (tmp_path, OSError), ("/dev/zero", ValueError)):
        with pytest.raises(error, match=rf"^[^\n]*{path}[^\n]*$"):
            load(path)


FAN = '[[beam]]\nkind = "fan"\nat = [0, 0]\nangles = [0, 90]\ncount = 1000000\n'
BALL = '[[shape]]\nkind = "luneburg"\nradius = 1\nlayers = 10000\nfacets = 500\n'
LENS = DISC.replace('"circle"', '"lens"') + "thickness = 1\ncurvature = [1, -1]\n" + RAY


@pytest.mark.parametrize(
    "text, expected",
    [  # sizes are checked before memory is allocated
        (BALL + FAN, "shape[0]: 5000000 or more pieces; expected at most 4194304"),
        ('colours = ["red", "blue"]\n' + BALL + FAN, "shape[0]: 10000000 or more pieces"),
        (DISC + FAN * 17, "beam[16].count: 17000000 rays in this beam and those before it; expected up to 16777216"),
        (LENS.replace("radius = 1", "radius = 2"), "shape[0].radius = 2: larger than a surface"),
        (LENS.replace("radius = 1\n", "").replace("-1", "2"), "shape[0].curvature = [1.0, 2.0]: the surfaces never"),
        (LENS.replace("curvature", "R1 = 1\ncurvature"), "shape[0]: curvature, R1, R2; expected either `curvature`"),
        (LENS.replace("curvature = [1, -1]", "R1 = 1"), "shape[0]: curvature, R1, R2; expected either `curvature`, or"),
    ],
)
def test_errors_of_sizes_and_shapes_name_their_key(read, text, expected):
    with pytest.raises(ValueError, match=r"^[^\n]*$") as caught:
        read(text)
    assert expected in str(caught.value)


def test_a_lens_accepts_curvatures_or_radii(read):
    keys = "curvature = [0.25, 0]", "R1 = 4\nR2 = 0"
    curvatures, radii = (read(LENS.replace("curvature = [1, -1]", x)) for x in keys)
    for name, values in vars(curvatures.segments[0]).items():
        np.testing.assert_array_equal(getattr(radii.segments[0], name), values)


NUMBERS = [0, -1, 1, 3, 0.5, 1e-300, -1e300, 1e308, 10**400, math.inf, math.nan, True, "", "disc"]
PAIRS = [[0, 0], [1, -1], [0.1, -0.2], [1e200, 1e-200], [1e300, 1e300], [], [1]]
VALUES = strategies.sampled_from([*NUMBERS, *PAIRS, {}, [{}], [[0, 0], [1, 0], [0, 1]], [[1e308, 0], [-1e308, 1]]])
PLAUSIBLE = {
    **{"points": [[0, 0], [1, 0], [0, 1]], "curvature": [0.1, -0.2], "radii": [1, 2], "name": "a", "n": 1.5},
    **{"focal_length": 4, "scale": 2, "at": [1, 2], "facets": 40, "arcs": [0, 30, 0], "conic": [0, -1]},
}


def toml(value):
    """The text of a TOML value."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return f"[{', '.join(map(toml, value))}]"
    return str(value).lower() if isinstance(value, bool) else repr(value)


@pytest.mark.filterwarnings("error")
@hypothesis.settings(max_examples=400)
@hypothesis.given(
    kind=strategies.sampled_from(scene_file.AnyShape.__args__),
    changes=strategies.lists(strategies.tuples(strategies.integers(0, 20), VALUES), max_size=2),
)
def test_any_values_give_a_scene_or_an_error_of_one_line(tmp_path_factory, kind, changes):
    fields = [x for x in kind.__struct_fields__ if x not in ("within", "outside", "facets", "arcs", "R1", "R2")]
    table = {"kind": kind.__struct_config__.tag} | {name: PLAUSIBLE.get(name, 1) for name in fields}
    table |= {kind.__struct_fields__[j % len(kind.__struct_fields__)]: value for j, value in changes}
    path = tmp_path_factory.getbasetemp() / "any.toml"
    path.write_text(f"shape = {toml([table])}\nbeam = [{{kind = 'rays', origins = [[0, 0]], directions = [0]}}]")
    try:
        scene = load(path)
    except ValueError as error:
        assert re.fullmatch(rf"{re.escape(str(path))}: shape\[0\][^\n]+", str(error)), error
        assert changes, "the plausible values must be a valid scene"
    else:
        assert all(np.isfinite(region.outline).all() for region in scene.regions)


# Shapes that touch ------------------------------------------------------------------------------------------------


TWO = """index = 1.1
beam = [{{kind = "parallel", from = [-5, -0.7], to = [-5, 0.8], direction = 0, count = 5}}]
shape = [
    {{kind = "rectangle", name = "left", width = 2, height = 2, n = 1.5, at = [{first}, 0.1]}},
    {{kind = "rectangle", width = 2, height = 2, n = 1.7, at = [{second}, 0.1]}},
    {more}
]
"""
INNER = '{kind = "polygon", points = [[-0.7, -0.9], [1.3, -0.9], [1.3, 1.1]], n = 1.3, within = "left"}'
AGAIN = '{kind = "rectangle", width = 2, height = 2, n = 1.6, at = [0.3, 0.1]}'
ALONG = '{kind = "boundary", points = [[1.3, -0.9], [1.3, 1.1]], n_left = 1.5, n_right = 1.7}'


def media_of(scene):
    """The indices on both sides of the scene's boundaries."""
    return sorted(zip(scene.segments[0].n_left.tolist(), scene.segments[0].n_right.tolist(), strict=True))


@pytest.mark.parametrize(
    "first, second", [("0.3", "2.3"), ("0.1", "2.1"), ("-0.7", "1.3"), ("0.3", "2.3000000000000003")]
)
def test_shapes_that_share_an_edge_are_cemented(read, first, second):
    scene = read(TWO.format(first=first, second=second, more=""))
    assert media_of(scene) == [(1.5, 1.1)] * 3 + [(1.5, 1.7)] + [(1.7, 1.1)] * 3
    assert paths(scene, weights=True).indices[:, :4].tolist() == [[1.1, 1.5, 1.7, 1.1]] * 5


def test_only_gaps_within_rounding_are_closed(read):
    scene = read(TWO.format(first="0.3", second="2.300000001", more=""))
    assert media_of(scene) == [(1.5, 1.1)] * 4 + [(1.7, 1.1)] * 4
    assert paths(scene, weights=True).indices[0, :5].tolist() == [1.1, 1.5, 1.1, 1.7, 1.1]


def test_a_shape_may_touch_the_one_around_it_with_the_same_index_outside(read):
    inner = [(1.3, 1.1), (1.3, 1.5), (1.3, 1.7), (1.5, 1.1), (1.5, 1.1), (1.7, 1.1), (1.7, 1.1), (1.7, 1.1)]
    assert media_of(read(TWO.format(first="0.3", second="2.3", more=INNER))) == inner
    for more, expected in (
        (INNER.replace(', within = "left"', ""), r"shape\[2\]: the index along shape\[0\] 'left' is 1.5; expected 1.1"),
        (AGAIN, r"shape\[2\]: the index along shape\[0\] 'left' is 1.5; expected 1.1"),
        (ALONG, r"shape\[2\]: runs along shape\[0\] 'left'"),
    ):
        with pytest.raises(ValueError, match=expected):
            read(TWO.format(first="0.3", second="2.3", more=more))


def test_arcs_with_the_same_ends_are_separate_and_a_repeated_corner_is_ignored(read):
    shape = '[[shape]]\nkind = "polygon"\npoints = {}\n{}\n'
    ends = "[[0, -1], [0, 1]]"
    moon, disc = shape.format(ends, "arcs = [90, -45]\nn = 1.5"), shape.format(ends, "arcs = [45, 60]\nn = 1.6")
    assert media_of(read(moon + disc + RAY)) == [(1.5, 1.0), (1.5, 1.6), (1.6, 1.0)]
    assert len(read(shape.format("[[0, 0], [1, 0], [1, 1], [0, 0]]", "n = 1.5") + RAY).segments[0]) == 3


@pytest.mark.parametrize("turn", [50, 60, 75, 85])
def test_arcs_with_the_same_ends_and_tangents_coincide_only_with_equal_weights(read, turn):
    """Stretched arcs of circles that turn by other angles are other arcs. Weights that differ by rounding are equal."""
    shape = '[[shape]]\nkind = "polygon"\npoints = [[0, -1], [0, 1]]\n'
    outer = f'{shape}arcs = [{turn}, 0]\nscale = [{1 / math.tan(math.radians(turn / 2))}, 1]\nn = 1.5\nname = "a"\n'
    inner = f'{shape}arcs = [90, 0]\nn = 1.6\nwithin = "a"\n'
    assert media_of(read(outer + inner + RAY)) == [(1.5, 1.0), (1.6, 1.0), (1.6, 1.5)]
    x, y = 1 - math.cos(math.radians(turn)), math.sin(math.radians(turn))
    lens = f'[[shape]]\nkind = "lens"\nR1 = 1\nR2 = 0\nthickness = 1\nradius = {y}\nn = 1.5\nname = "a"\n'
    front = f'[[shape]]\nkind = "polygon"\npoints = [[{x}, {y}], [{x}, {-y}]]\narcs = [{2 * turn}, 0]\n'
    scene = read(f'{lens}{front}n = 1.6\nwithin = "a"\n{RAY}')
    assert media_of(scene) == [(1.5, 1.0)] * 4 + [(1.6, 1.0)] * 2 + [(1.6, 1.5)]


# Colours ----------------------------------------------------------------------------------------------------------


def test_a_material_has_the_index_of_each_wavelength(read):
    scene = read(GLASSES)
    expected = tuple(1.5 + 4000 / w**2 for w in (486.1327, 587.5618))
    assert scene.regions[-1].indices == pytest.approx(expected, rel=1e-15)
    assert [segments.n_left[-1] for segments in scene.segments] == pytest.approx(expected, rel=1e-15)
    assert scene.light.names == ("486.133 nm", "587.562 nm")
    lights = [read(GLASSES.replace("[1, 1.1]", "1").replace("[1.5, 1.6]", "1.5"), x).light for x in ([450.0], 36)]
    assert [x.wavelengths for x in lights] == [(450.0,), tuple(np.linspace(380, 730, 36))]
    plain = read(SCENE.replace("n = 1.3", f'n = "{CAUCHY}"'))  # without wavelengths: the d line
    assert plain.regions[-1].indices == pytest.approx((1.5 + 4000 / media.LINES["d"] ** 2,) * 2, rel=1e-15)


def test_an_index_file_is_relative_to_the_scene_file(read, tmp_path):
    (tmp_path / "glass.csv").write_text("nm,n\n480,1.6\n580,1.5\n")
    with pytest.warns(UserWarning, match="587.562 nm is that of the end of its range"):
        scene = read(GLASSES.replace(CAUCHY, "hold(file:glass.csv)"))
    assert scene.regions[-1].indices == pytest.approx((1.6 - 6.1327e-3, 1.5), rel=1e-9)


def test_indices_relative_to_vacuum_are_converted_to_air():
    indices = Light(("", ""), (500.0, 600.0)).indices("MATERIAL:water", "n")
    expected = [media.index("MATERIAL:water", w) / media.LABORATORY_AIR.index(w) for w in (500.0, 600.0)]
    assert indices == pytest.approx(expected, rel=1e-15)
    assert Light().indices("AIR:ciddor", "n") == (1.0,)
    with pytest.warns(UserWarning, match="air at 20 °C: the index at 2000 nm is an extrapolation; .* 230 to 1690 nm"):
        assert Light(("",), (2000.0,)).indices("vacuum", "n") == pytest.approx((1 / 1.00026835,), abs=1e-8)


@pytest.mark.parametrize("others", [[587.5618, 486.1327], [450.0, 550.0], 2])
def test_indices_for_the_wavelengths_of_the_file_are_not_those_of_others(others, read):
    """Those of the file itself may be named again."""
    assert read(GLASSES, [486.1327, 587.5618]).index == read(GLASSES).index
    with pytest.raises(ValueError, match=r": 2 numbers, for the wavelengths of the file; expected 1, or a material"):
        read(GLASSES, others)


def test_parsing_the_wavelengths_option():
    for text, expected in {"450.5, 600": [450.5, 600.0], "450": [450.0], "32": 32, "550": [550.0]}.items():
        assert light.parsed(text) == expected  # 550 exceeds MOST, so it is a wavelength
    for text in ("", "red", "1", "nan", "450,", "-450", "inf"):
        with pytest.raises(ValueError, match="expected wavelengths in nm, such as"):
            light.parsed(text)


def test_invisible_wavelengths_are_an_error():
    with pytest.raises(ValueError, match="wavelengths: none of 1000 nm is visible; expected some from 360 to 830 nm"):
        light.linear_srgb(of_wavelengths([1000.0]))


@pytest.mark.parametrize("power", ["flat", "D65"])
@pytest.mark.parametrize(
    ("wavelengths", "white"),
    [([450, 550, 600], True), ([450], False), ([590], False), ([450, 460], False), ([450, 550], False)],
)
def test_colours_are_those_of_the_standard_observer(wavelengths, white, power):
    """CIE 1931 x̄, ȳ, z̄; XYZ to linear sRGB of IEC 61966-2-1; the sum is white, or keeps its hue."""
    xyz = {450: (0.3362, 0.038, 1.77211), 460: (0.2908, 0.06, 1.6692), 550: (0.43345, 0.99495, 0.00875)}
    xyz |= {590: (1.0263, 0.757, 0.0011), 600: (1.0622, 0.631, 0.0008)}
    to_rgb = [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
    colours = of_wavelengths([float(w) for w in wavelengths], power)
    expected = np.array([xyz[w] for w in wavelengths]) @ np.transpose(to_rgb) * np.array(colours.powers)[:, None]
    total = expected.sum(0)
    assert light.linear_srgb(colours) == pytest.approx(expected / (total if white else total.max()), rel=0.01, abs=0.01)


def test_the_lines_of_an_achromat_are_white_together():
    lines = of_wavelengths([media.LINES[line] for line in "FdC"])
    assert light.linear_srgb(lines).sum(0) == pytest.approx(1)


def test_daylight_has_the_powers_of_cie():
    """D65 at 450, 560 and 650 nm: 117.008, 100 and 80.0268."""
    powers = of_wavelengths([450, 560, 650], "D65").powers
    assert np.array(powers) / powers[1] == pytest.approx([1.17008, 1, 0.800268], rel=2e-5)


# The how-to page ---------------------------------------------------------------------------------------------------


def test_the_code_and_the_scene_of_the_page_work(read, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenes").symlink_to(SCENES.parent)
    (toml_text,) = blocks(PAGE, "toml")
    for code in python_blocks(PAGE):
        exec(code, {})
    assert "escaped" in capsys.readouterr().out
    assert (tmp_path / "doublet.svg").stat().st_size > 1000
    assert len(read(toml_text).origins) == 15


def test_every_event_is_on_the_page():
    assert all(f"| `{event.name}` |" in PAGE.read_text("utf-8") for event in Event if event.name != "NONE")

"""Shapes: arcs lie on their conics, curves close with their inside on the left, and an affine map keeps both."""

import math

import numpy as np
import pytest

from mi_refract.planar import shapes
from mi_refract.planar.curves import Curve, affine, area, points, unit

ULP = 2.0**-52
# Curvature, conic constant and half aperture: every kind of conic, up to the rim of a half sphere and a half ellipse.
SURFACES = [
    *((0.02, 0.0, 12.0), (1 / 3, 0.0, 3.0), (1 / 49, 0.0, 49.0), (-0.04, 1.9, 14.6)),
    *((0.75, -4 / 9, 1.5), (0.1, -1.0, 7.0), (-0.3, -2.5, 4.0), (0.0, 0.0, 5.0)),
]


def off_conic(p, curvature, conic):
    """Distance from c r² − 2 z + c (1 + K) z² = 0, to first order."""
    z, r = p[..., 0], p[..., 1]
    value = curvature * r * r - 2 * z + curvature * (1 + conic) * z * z
    return np.abs(value) / (2 * np.hypot(curvature * r, curvature * (1 + conic) * z - 1))


SHAPES = {
    "polygon": shapes.polygon([(0, 0), (3, 0), (1, 2)], [0, 30, -40]),
    "clockwise": shapes.polygon([(0, 0), (1, 2), (3, 0)]),
    "half disc": shapes.polygon([(0, 1), (0, -1)], [180, 0]),
    "segment of a disc": shapes.polygon([(0, 1), (0, -1)], [60, 0]),
    "rectangle": shapes.rectangle(3, 2),
    "prism": shapes.prism(60, 2),
    "circle": shapes.circle(1.7),
    "ellipse": shapes.ellipse(3, 0.5),
    "lens": shapes.lens((0.02, -0.03), 5, radius=9, conic=(-1.5, 0.4)),
    "meniscus": shapes.lens((0.03, 0.02), 2, vertex=7),
    "flat lens": shapes.lens((0, -0.05), 3),
    "concave lens": shapes.lens((-0.05, 0.05), 1, radius=8),
    "ellipse lens": shapes.ellipse_lens(1.5, 4, 1.5, 1.5),
    "faceted circle": shapes.circle(1).faceted(37),
}
MAPS = {
    "as it is": (affine(), (0, 0)),
    "turned, stretched, moved": (affine(30, (2, 0.7)), (3, -1)),
    "mirrored": (affine(-75, (-1, 1)), (0.1, 0)),
    "sheared": (np.array([[1, 0.4], [0.1, 1]]), (0, 5)),
}


def winding_number(outline, p):
    """How often a closed outline runs around p, counter-clockwise."""
    x, y = (outline - p).T
    turn = np.diff(np.unwrap(np.arctan2(y, x), axis=0), append=np.nan)[:-1].sum()
    first = math.atan2(x[-1] * y[0] - y[-1] * x[0], x[-1] * x[0] + y[-1] * y[0])
    return round((turn + first) / (2 * math.pi))


def assert_closed(curve: Curve):
    """Check that every vertex is one start and one end, bit for bit, and that the inside is left of every piece."""
    assert curve.closed
    starts, ends = ({tuple(p) for p in places.tolist()} for places in (curve.start, curve.end))
    assert starts == ends
    assert len(starts) == len(curve)
    outline = curve.outline()
    assert area(curve) > 0
    along = points(curve.between(1, 1), 4)
    middle, ahead = along[:, 2], along[:, 3] - along[:, 1]
    left = 1e-3 * np.stack([-ahead[:, 1], ahead[:, 0]], 1)
    step = max(1, len(curve) // 40)
    for p, aside in zip(middle[::step], left[::step], strict=True):
        assert (winding_number(outline, p + aside), winding_number(outline, p - aside)) == (1, 0)


@pytest.mark.parametrize("curve", SHAPES.values(), ids=SHAPES)
def test_mapped_shapes_are_closed_with_their_inside_on_the_left(curve):
    for matrix, at in MAPS.values():
        assert_closed(curve.mapped(matrix, at))
    with pytest.raises(AssertionError):
        assert_closed(curve.reversed())


@pytest.mark.parametrize("curvature, conic, radius", SURFACES)
def test_lens_surfaces_lie_on_their_conics(curvature, conic, radius):
    curve = shapes.lens((curvature, curvature), 1.0, radius=radius, conic=(conic, conic))
    front = points(curve.between(1, 1), 100)[:2]
    assert off_conic(front, curvature, conic).max() <= 4 * ULP * radius
    back = points(curve.between(1, 1), 100)[3:5] - [1.0, 0]
    assert off_conic(back, curvature, conic).max() <= 8 * ULP * radius
    assert np.abs(front[..., 0] - shapes.sag(front[..., 1], curvature, conic))[:, 1:-1].max() <= 1e-13 * radius
    if curvature:
        for defect in (curve.weight * (1 + 1e-13), curve.weight * (1 - 1e-13)):
            bent = points(Curve(curve.vertices, curve.control, defect, True).between(1, 1), 100)[:2]
            assert off_conic(bent, curvature, conic).max() > 4 * ULP * radius


@pytest.mark.parametrize("rx, ry", [(1, 1), (3, 0.5), (1e-3, 1e3)])
def test_ellipses_satisfy_their_equation(rx, ry):
    x, y = points(shapes.ellipse(rx, ry).between(1, 1), 100).reshape(-1, 2).T
    assert np.abs(np.hypot(x / rx, y / ry) - 1).max() <= 4 * ULP


def test_arcs_turn_by_the_given_angle():
    for turn in (-350, -90, 45, 90.5, 180, 270):
        curve = shapes.polyline([(1, 2), (4, 3)], [turn])
        chord, along = np.array([3, 1]), points(curve.between(1, 1), 90).reshape(-1, 2)
        start, end = curve.control[0] - curve.start[0], curve.end[-1] - curve.control[-1]
        for direction, angle in ((start, -turn / 2), (end, turn / 2)):
            c, s = unit(angle)
            expected = np.array([[c, -s], [s, c]]) @ chord / math.hypot(*chord)
            assert direction / math.hypot(*direction) == pytest.approx(expected, abs=1e-14)
        radius = abs(math.hypot(*chord) / 2 / math.sin(math.radians(turn / 2)))
        normal = np.array([-chord[1], chord[0]]) / math.hypot(*chord)
        centre = np.array([2.5, 2.5]) + normal * math.hypot(*chord) / 2 / math.tan(math.radians(turn / 2))
        assert np.abs(np.hypot(*(along - centre).T) - radius).max() <= 1e-14 * radius * 10


def test_mapping_a_curve_maps_its_points():
    lens = shapes.lens((0.02, -0.3), 5, radius=2.5, conic=(-1.5, 0.4))
    for matrix, at in MAPS.values():
        expected = lens.outline(9) @ np.asarray(matrix).T + at
        mapped = lens.mapped(matrix, at)
        mapped = mapped if np.linalg.det(matrix) > 0 else mapped.reversed()
        assert np.abs(mapped.outline(9) - expected).max() <= 8 * ULP * np.abs(expected).max()
        assert mapped.straight.tolist() == lens.straight.tolist()


def test_a_mirrored_boundary_keeps_its_sides():
    """The left of the x axis is y > 0. Mirrored at the y axis it still is, so the boundary keeps its direction."""
    boundary = shapes.polyline([(1, 0), (2, 0)])
    assert boundary.mapped(affine(0, (-1, 1))).vertices.tolist() == [[-2, 0], [-1, 0]]
    assert boundary.mapped(affine(0, (1, -1))).vertices.tolist() == [[2, 0], [1, 0]]


def test_quarter_turns_are_exact():
    square = shapes.rectangle(0.3, 0.7).vertices
    assert shapes.rectangle(0.3, 0.7).mapped(affine(450)).vertices.tolist() == [[-y, x] for x, y in square.tolist()]
    assert unit(-270) == unit(90 + 360e6) == (0, 1)
    assert unit(1e17) == unit(10**17 % 360)
    assert unit(45) == (math.sqrt(0.5), math.sqrt(0.5))
    assert all(math.hypot(*unit(x)) == pytest.approx(1, abs=ULP) for x in (1e300, 0.1, -44.9, 123.4))


# Facets -----------------------------------------------------------------------------------------------------------


def test_facets_have_the_given_number_and_lie_on_the_curve():
    for facets in (4, 6, 1001):
        polygon = shapes.circle(2).faceted(facets)
        assert len(polygon) == facets
        assert polygon.straight.all()
        assert np.abs(np.hypot(*polygon.vertices.T) - 2).max() <= 4 * ULP
    sides = np.hypot(*(shapes.circle(1).faceted(8).end - shapes.circle(1).faceted(8).start).T)
    assert np.ptp(sides) <= 4 * ULP
    rimmed = shapes.lens((0.02, -0.03), 5, radius=9)
    assert len(rimmed.faceted(40)) == 42  # plus two straight rims
    hyperbola = shapes.lens((0.5, 0.5), 1.0, radius=4, conic=(-3, -3)).faceted(30)
    assert off_conic(hyperbola.vertices[:16], 0.5, -3).max() <= 4 * ULP * 4


# Lenses -----------------------------------------------------------------------------------------------------------


def test_pointed_lenses_end_where_their_surfaces_meet():
    for curvature, conic, thickness in (
        ((0.02, -0.03), (-1.5, 0.4), 5),
        ((0.03, 0.02), (0, 0), 2),
        ((0, -0.05), (0, 0), 3),
        ((0.1, 0.0), (-1, 0), 2),
        ((0.3, 0.05), (-3, -1), 1),  # the surfaces meet again at r = 24
    ):
        curve = shapes.lens(curvature, thickness, conic=conic)
        z, r = curve.vertices[0]
        assert len(curve) == 4
        assert conic != (-3, -1) or r < 15
        assert off_conic(np.array([z, r]), curvature[0], conic[0]) <= 8 * ULP * r
        assert off_conic(np.array([z - thickness, r]), curvature[1], conic[1]) <= 8 * ULP * r


def test_surfaces_may_touch_at_the_rim_but_not_before():
    """A hyperbola and a parabola have the least gap at equal slopes, where 6 = √(1 + 2 c² r²) for the hyperbola."""
    conic = (-3, -1)
    for c in np.linspace(0.01, 3, 200):
        curvature, touching = (c, c / 6), math.sqrt(35 / 2) / c
        front, back = (float(shapes.sag(touching, *surface)) for surface in zip(curvature, conic, strict=True))
        thickness = front - back
        while thickness + back < front:  # by rounding
            thickness = math.nextafter(thickness, math.inf)
        assert shapes.lens(curvature, thickness, radius=touching, conic=conic).closed
        assert shapes.lens(curvature, thickness * 1.001, radius=2 * touching, conic=conic).closed
        with pytest.raises(ValueError, match="the surfaces meet inside it; expected at most"):
            shapes.lens(curvature, thickness * 0.999, radius=2 * touching, conic=conic)


def test_a_surface_reaches_as_far_as_it_exists():
    """1/(c √(1 + K)) is rounded, so the argument of the root in the sag may be slightly below 0."""
    for c in np.linspace(0.01, 3, 200):
        for conic in (0, -0.3, 1.9):
            radius = 1 / (c * math.sqrt(1 + conic))
            hemisphere = shapes.lens((c, c), 1, radius=radius, conic=(conic, conic))
            assert off_conic(hemisphere.vertices[0], c, conic) <= 8 * ULP * radius
            with pytest.raises(ValueError, match="larger than a surface"):
                shapes.lens((c, c), 1, radius=radius * (1 + 1e-14), conic=(conic, conic))


IMPOSSIBLE = [
    *((lambda c=c, t=t: shapes.lens(c, t), "curvature.*never meet") for c, t in (((0.02, 0.03), 1), ((0, 0), 1))),
    (lambda: shapes.lens((0.1, -0.5), 20.5), "curvature.*never meet"),  # but their far halves do
    (lambda: shapes.lens((0.02, -0.02), 1, radius=60), "radius = 60: larger than a surface; expected at most 50"),
    (lambda: shapes.lens((0.02, -0.02), 1, radius=20), "radius = 20: the surfaces meet inside it; expected at most 7."),
    (
        lambda: shapes.lens((0.3, 0.05), 1, radius=30, conic=(-3, -1)),  # they part again at 23.97
        "radius = 30: the surfaces meet inside it; expected at most 3.47",
    ),
    (lambda: shapes.ellipse_lens(1.0, 4, 1.5, 1), "expected n > 1, 0 < thickness < 4"),
    (lambda: shapes.ellipse_lens(1.5, 4, 4, 1), "expected n > 1, 0 < thickness < 4"),
    (lambda: shapes.polygon([(0, 0)]), "points: 1"),
    (lambda: shapes.polygon([(0, 0), (1, 1), (2, 2)]), "no area"),
    (lambda: shapes.polygon([(0, 0), (1, 0), (0, 1)], [0, 0]), "arcs: 2 for 3 pieces"),
    (lambda: shapes.polygon([(0, 0), (1, 0), (0, 1)], [0, 360, 0]), "above -360"),
    (lambda: shapes.circle(2).faceted(3), "facets: 3 for 4 arcs"),
    (lambda: shapes.rectangle(1, 1).faceted(100), "for 0 arcs"),
    *((lambda m=m: shapes.circle(1).mapped(m), "determinant") for m in (np.zeros((2, 2)), [[math.nan, 0], [0, 1]])),
    (lambda: shapes.polyline([(1, 0), (2, 0)]).mapped([[1, 2], [2, 4]]), "determinant"),
]


@pytest.mark.parametrize("make, match", IMPOSSIBLE)
def test_impossible_shapes_are_errors(make, match):
    with pytest.raises(ValueError, match=match):
        make()

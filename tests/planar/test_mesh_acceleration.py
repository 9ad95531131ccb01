"""The strokes name every segment that a ray may cross: the paths are those of trying all, to the last bit."""

import re

import numpy as np
import pytest
from support.planar_scenes import polygon, star, together

from mi_refract.planar import Event, Segments, trace

RAYS = 600


def circle(count, n=1.5):
    angle = np.arange(count) * 2 * np.pi / count
    return polygon(np.column_stack([np.cos(angle), np.sin(angle)]), n)


def lattice(count=5):
    """Squares cut in two along a diagonal, half of them of another medium than their other half, in air."""
    rng = np.random.default_rng(3)
    below, above = np.ones((2, count + 2, count + 2))
    below[1:-1, 1:-1], above[1:-1, 1:-1] = rng.choice([1.0, 1.33, 1.5, 2.4], (2, count, count))
    parts = []
    for i in range(count + 1):
        for j in range(count + 1):
            parts.append(((i, j), (i, j + 1), below[i, j + 1], above[i + 1, j + 1]))
            parts.append(((i, j), (i + 1, j), below[i + 1, j + 1], above[i + 1, j]))
            parts.append(((i, j), (i + 1, j + 1), above[i + 1, j + 1], below[i + 1, j + 1]))
    inside = [part for part in parts if max(*part[0], *part[1]) <= count]
    start, end, left, right = map(np.array, zip(*inside, strict=True))
    return Segments(start * 0.1, end * 0.1, left, right)


def slivers(count=30):
    """Triangles whose long sides are within the margin of the strokes for half of their length, around a square."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)[:, None]
    tip, far = np.column_stack([np.cos(angle), np.sin(angle)]), np.column_stack([np.cos(angle), np.sin(angle)]) * 0.2
    aside = 4e-6 * np.column_stack([-np.sin(angle), np.cos(angle)])
    return together(*(polygon([t, f - a, f + a][::-1], 1.3) for t, f, a in zip(tip, far, aside, strict=True)))


def across(segments):
    """Through places near the segments' starts, at all angles."""

    def rays(rng):
        i, share = rng.integers(0, len(segments), RAYS), 10 ** rng.uniform(-5, 0, (RAYS, 1))
        places = segments.start[i] * (1 - share) + segments.end[i] * share
        directions = rng.normal(size=(RAYS, 2))
        return places - directions, directions

    return rays


def far(segments):
    """The same elsewhere: float32 has there but a thousandth of its extent."""
    return Segments(segments.start + 2.0**13, segments.end + 2.0**13, segments.n_left, segments.n_right)


def slab(top):
    """With the outside of its upper side facing what lies above."""
    return polygon([(1, top), (0, top), (0, top - 0.1), (1, top - 0.1)])


def anywhere(rng):
    return rng.normal(size=(RAYS, 2)) * 0.5, rng.normal(size=(RAYS, 2))


def from_afar(rng):
    origins = rng.normal(size=(RAYS, 2)) * 300
    return origins, rng.uniform(-1, 1, size=(RAYS, 2)) - origins


def along_the_wall(rng):
    """Inside a circle, at 10⁻⁶ to 0.1 of the wall's direction."""
    angle, grazing = rng.uniform(0, 2 * np.pi, RAYS), 10 ** rng.uniform(-6, -1, RAYS)
    away = angle - grazing
    return 0.999999 * np.column_stack([np.cos(angle), np.sin(angle)]), np.column_stack([-np.sin(away), np.cos(away)])


def within_segments(segments):
    """From places on the segments, their ends among them, along them, and from others on the same line."""

    def rays(rng):
        i, share = rng.integers(0, len(segments), RAYS), rng.choice([-2, -1, 0, 0.3, 0.7, 1], (RAYS, 1))
        e = segments.end[i] - segments.start[i]
        return segments.start[i] + share * e, e

    return rays


def at_vertices(segments):
    def rays(rng):
        origins = rng.normal(size=(RAYS, 2)) * 2
        return origins, segments.start[rng.integers(0, len(segments), RAYS)] - origins

    return rays


def along_segments(segments):
    def rays(rng):
        i = rng.integers(0, len(segments), RAYS)
        e = segments.end[i] - segments.start[i]
        return segments.start[i] - 3 * e, e

    return rays


CASES = {
    "circle": (circle(2000), anywhere),
    "circle, from afar": (circle(300), from_afar),
    "fine circle, along its wall": (circle(20_000), along_the_wall),
    "circle, at vertices": (circle(2000), at_vertices(circle(2000))),
    "circle, along segments": (circle(2000), along_segments(circle(2000))),
    "star": (star(300), anywhere),
    "star, at tips": (star(300), at_vertices(star(300))),
    "lattice, along its edges": (lattice(), within_segments(lattice())),
    "star, far away": (far(star(300)), across(far(star(300)))),
    "slivers": (slivers(), across(slivers())),
}


def both(case, precision, rays=None):
    segments, make = CASES[case]
    origins, directions = make(np.random.default_rng(11))
    options = {"max_depth": 10, "precision": precision, "backend": "llvm"}
    return (trace(segments, origins[:rays], directions[:rays], method=m, **options) for m in ("brute", "mesh"))


@pytest.fixture
def llvm(needs_variant):
    needs_variant("llvm_ad_rgb")


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("case", CASES)
def test_paths_are_those_of_trying_all(llvm, case, precision):
    brute, mesh = both(case, precision)
    for name in ("hits", "events", "points", "directions"):
        assert np.array_equal(getattr(brute, name), getattr(mesh, name), equal_nan=True), name
    assert not (brute.events == Event.MEDIUM_MISMATCH).any()
    assert (brute.hits >= 0).sum() > RAYS / 4


def test_scalar_variants_have_strokes_too():
    segments = circle(200)
    origins, directions = from_afar(np.random.default_rng(2))
    brute, mesh = (
        trace(segments, origins[:5], directions[:5], 3, method=m, backend="scalar") for m in ("brute", "mesh")
    )
    assert np.array_equal(brute.points, mesh.points, equal_nan=True)
    assert (brute.hits >= 0).sum() >= 5


@pytest.mark.parametrize(
    ("segments", "message"),
    [
        (polygon([(0, 0), (1, 0), (1, 1e-7)]), "'mesh': a segment of 2.0e-07; expected straight segments"),
        (Segments([(0, 0)], [(1, 0)], [1.5], [1.0], [(0.5, 0.5)], [1.0]), "'mesh': arcs; expected straight segments"),
        (together(slab(0.5), slab(0.6 + 1e-6)), "'mesh': segments 0 and 6; expected straight segments"),
        (together(slab(0.5), slab(0.6 + 1.5e-6)), "'mesh': segments 0 and 6; expected straight segments"),
    ],
)
def test_what_strokes_cannot_tell_apart_is_refused(segments, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        trace(segments, [(0.5, 3)], [(0, -1)], 2, method="mesh")
    assert trace(segments, [(0.5, 3)], [(0, -1)], 2).hits[0, 0] >= 0

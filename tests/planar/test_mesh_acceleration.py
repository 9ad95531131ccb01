"""The mesh finds every segment that a ray may cross: the paths equal those of testing all segments, bit for bit."""

import re

import numpy as np
import pytest
from support.planar_scenes import polygon, star, together

from mi_refract.planar import Event, Segments, trace

RAYS = 600
METHODS = "brute", "mesh"


def round_places(count):
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.column_stack([np.cos(angle), np.sin(angle)])


def lattice(count=5):
    """Squares in air, cut along a diagonal; the two halves have random media."""
    rng = np.random.default_rng(3)
    below, above = np.ones((2, count + 2, count + 2))
    below[1:-1, 1:-1], above[1:-1, 1:-1] = rng.choice([1.0, 1.33, 1.5, 2.4], (2, count, count))
    parts = []
    for i, j in np.ndindex(count + 1, count + 1):
        parts.append(((i, j), (i, j + 1), below[i, j + 1], above[i + 1, j + 1]))
        parts.append(((i, j), (i + 1, j), below[i + 1, j + 1], above[i + 1, j]))
        parts.append(((i, j), (i + 1, j + 1), above[i + 1, j + 1], below[i + 1, j + 1]))
    inside = [part for part in parts if max(*part[0], *part[1]) <= count]
    start, end, left, right = map(np.array, zip(*inside, strict=True))
    return Segments(start * 0.1, end * 0.1, left, right)


def slivers(count=30):
    """Narrow triangles: for half of their length, the long sides are within the margin of the strokes."""
    tips = round_places(count)
    aside = 4e-6 * np.column_stack([-tips[:, 1], tips[:, 0]])
    return together(*(polygon([t, 0.2 * t - a, 0.2 * t + a][::-1], 1.3) for t, a in zip(tips, aside, strict=True)))


def far(segments):
    """The segments moved to 2¹³, where the steps of float32 are a thousandth of the figure."""
    return Segments(segments.start + 2.0**13, segments.end + 2.0**13, segments.n_left, segments.n_right)


def slab(top):
    """A slab below y = `top`."""
    return polygon([(1, top), (0, top), (0, top - 0.1), (1, top - 0.1)])


def anywhere(segments, rng):
    return rng.normal(size=(RAYS, 2)) * 0.5, rng.normal(size=(RAYS, 2))


def from_afar(segments, rng):
    origins = rng.normal(size=(RAYS, 2)) * 300
    return origins, rng.uniform(-1, 1, size=(RAYS, 2)) - origins


def along_the_wall(segments, rng):
    """Rays inside a circle, at 10⁻⁶ to 0.1 rad from the wall's direction."""
    angle, grazing = rng.uniform(0, 2 * np.pi, RAYS), 10 ** rng.uniform(-6, -1, RAYS)
    away = angle - grazing
    return 0.999999 * np.column_stack([np.cos(angle), np.sin(angle)]), np.column_stack([-np.sin(away), np.cos(away)])


def across(segments, rng):
    """Rays through places near the segments' starts, at all angles."""
    i, share = rng.integers(0, len(segments), RAYS), 10 ** rng.uniform(-5, 0, (RAYS, 1))
    directions = rng.normal(size=(RAYS, 2))
    return segments.start[i] * (1 - share) + segments.end[i] * share - directions, directions


def within_segments(segments, rng):
    """Rays along the segments, from places on them, their ends included, and from others on the same line."""
    i, share = rng.integers(0, len(segments), RAYS), rng.choice([-2, -1, 0, 0.3, 0.7, 1], (RAYS, 1))
    e = segments.end[i] - segments.start[i]
    return segments.start[i] + share * e, e


def at_vertices(segments, rng):
    origins = rng.normal(size=(RAYS, 2)) * 2
    return origins, segments.start[rng.integers(0, len(segments), RAYS)] - origins


def along_segments(segments, rng):
    i = rng.integers(0, len(segments), RAYS)
    e = segments.end[i] - segments.start[i]
    return segments.start[i] - 3 * e, e


CIRCLE, STAR = polygon(round_places(2000)), star(300)
CASES = {
    "circle": (CIRCLE, anywhere),
    "circle, from afar": (polygon(round_places(300)), from_afar),
    "fine circle, along its wall": (polygon(round_places(20_000)), along_the_wall),
    "circle, at vertices": (CIRCLE, at_vertices),
    "circle, along segments": (CIRCLE, along_segments),
    "star": (STAR, anywhere),
    "star, at tips": (STAR, at_vertices),
    "lattice, along its edges": (lattice(), within_segments),
    "star, far away": (far(STAR), across),
    "slivers": (slivers(), across),
}


@pytest.mark.parametrize("case", CASES)
def test_mesh_and_brute_give_the_same_paths(vectorised, case):
    segments, make = CASES[case]
    rays = make(segments, np.random.default_rng(11))
    options = {"precision": vectorised.name, "backend": vectorised.backend, "weights": True}
    brute, mesh = (trace(segments, *rays, 10, method=method, **options) for method in METHODS)
    for name in ("hits", "events", "points", "directions", "indices", "polarised"):
        assert np.array_equal(getattr(brute, name), getattr(mesh, name), equal_nan=True), name
    assert not (brute.events == Event.MEDIUM_MISMATCH).any()
    assert (brute.hits >= 0).sum() > RAYS / 4


def test_the_mesh_works_on_the_scalar_backend():
    segments = polygon(round_places(200))
    origins, directions = from_afar(segments, np.random.default_rng(2))
    brute, mesh = (trace(segments, origins[:5], directions[:5], 3, method=m, backend="scalar") for m in METHODS)
    assert np.array_equal(brute.points, mesh.points, equal_nan=True)
    assert (brute.hits >= 0).sum() >= 5


@pytest.mark.parametrize(
    ("segments", "message"),
    [
        (polygon([(0, 0), (1, 0), (1, 1e-7)]), "'mesh': a segment of 2.0e-07; expected straight segments, longer and "),
        (Segments([(0, 0)], [(1, 0)], [1.5], [1.0], [(0.5, 0.5)], [1.0]), "'mesh': arcs; expected straight segments"),
        (together(slab(0.5), slab(0.6 + 1e-6)), "'mesh': segments 0 and 6; expected straight segments"),
        (together(slab(0.5), slab(0.6 + 1.5e-6)), "'mesh': segments 0 and 6; expected straight segments"),
        *(
            (together(slab(0.5), slab(0.6 + gap)), "'mesh': segments 0 and 6; expected straight segments")
            for gap in (1e-12, 1e-9, 1e-8, 1e-7, 3e-7)
        ),
    ],
)
def test_mesh_rejects_segments_that_it_cannot_separate(segments, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        trace(segments, [(0.5, 3)], [(0, -1)], 2, method="mesh")
    assert trace(segments, [(0.5, 3)], [(0, -1)], 2).hits[0, 0] >= 0


def test_mesh_separates_segments_that_are_far_enough_apart():
    """A quarter more than the least distance, 2⁻¹⁸ of half the extent."""
    segments = together(slab(0.5), slab(0.6 + 1.25 * 2.0**-18 / 2))
    brute, mesh = (trace(segments, [(0.5, 3)], [(0, -1)], 4, method=method) for method in METHODS)
    assert np.array_equal(brute.points, mesh.points, equal_nan=True) and mesh.hits[0].tolist() == brute.hits[0].tolist()

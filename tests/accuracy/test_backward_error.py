"""Backward errors, against the exact refraction of inputs that were changed on purpose."""

import numpy as np
import pytest

from mi_refract import oracle, regimes
from mi_refract.accuracy import backward_error, lengths
from mi_refract.formulas import TEXTBOOK_BACKWARD
from mi_refract.regimes import Rays

EPSILON = 1e-7


def unit(v):
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def drawn(count=300):
    """Rays at least 0.01 from the critical angle, transmitted, with the normal against them."""
    rng = np.random.default_rng(1)
    cos_i, k = rng.uniform(0.02, 0.999, 8 * count), np.exp(rng.uniform(-np.log(2.5), np.log(2.5), 8 * count))
    kept = np.flatnonzero(1 - k * k * (1 - cos_i * cos_i) > 0.01)[:count]
    n = unit(rng.normal(size=(count, 3)))
    t = unit(np.cross(n, rng.normal(size=(count, 3))))
    a = unit(np.sqrt(1 - cos_i[kept] ** 2)[:, None] * t - cos_i[kept][:, None] * n)
    return Rays(a, n, k[kept])


RAYS = drawn()
A, N, K = RAYS.a, RAYS.n, RAYS.k


def refracted(rays):
    return oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False).direction


B = refracted(RAYS)
GAMMA = ((K[:, None] * A - B) * N).sum(1)


def turned(v, toward, angle):
    """`v` turned by `angle`, in the plane of both."""
    side = unit(toward - (toward * v).sum(1, keepdims=True) * v)
    return unit(np.cos(angle) * v + np.sin(angle) * side)


def found(a=A, n=N, k=K):
    """Of the exact refraction of these inputs, as an answer to RAYS."""
    return backward_error.of_directions(refracted(Rays(a, n, k)), RAYS)


def test_inputs_that_were_changed_are_found_as_far_off_as_they_are():
    rng = np.random.default_rng(2)
    for _ in range(5):
        a, n = (turned(v, rng.normal(size=v.shape), EPSILON) for v in (A, N))
        off = found(a, n, K * (1 + EPSILON * rng.choice([-1, 1], len(K))))
        assert (off <= EPSILON * (1 + 1e-5)).all() and off.max() > 0.5 * EPSILON
    # The worst: along the surface, all three the same way: a forward, k up, and n as the sign of γ says, for δn×n γ and
    # n×δa are parallel to n×t.
    t = A - (A * N).sum(1, keepdims=True) * N
    for step in (EPSILON, -EPSILON):
        n = np.where(GAMMA[:, None] > 0, turned(N, t, -step), turned(N, t, step))
        off = found(turned(A, t, step), n, K * (1 + step))
        assert off == pytest.approx(np.full(len(K), EPSILON), rel=1e-4)
    # Across the plane of incidence; the largest over φ is within 1 part in 1000 of that across.
    across, gamma = np.cross(N, A), np.abs(GAMMA)
    assert found(a=turned(A, across, EPSILON)) == pytest.approx(EPSILON * K / (K + gamma), rel=1e-3)
    assert found(n=turned(N, across, EPSILON)) == pytest.approx(EPSILON * gamma / (K + gamma), rel=1e-3)


def test_lengths_are_not_in_it_and_what_is_no_direction_or_on_the_wrong_side_is():
    scaled, b = Rays(A * 3e5, N * 2e-9, K), B * 7
    assert (backward_error.of_directions(b, scaled) < 2.0**-52).all()
    b[0], b[1], b[2] = 0, np.nan, b[2] - 2 * (b[2] @ N[2]) * N[2]
    off = backward_error.of_directions(b, scaled)
    assert np.isinf(off[:2]).all() and off[2] >= abs(B[2] @ N[2]) and off[3] < 2.0**-52


def test_mirror_directions():
    mirror, every = A - 2 * (A * N).sum(1, keepdims=True) * N, np.ones(len(K), bool)
    assert (backward_error.of_directions(mirror, RAYS, every) < 4 * 2.0**-53).all()
    off = backward_error.of_directions(turned(mirror, A, EPSILON), RAYS, every)
    assert off == pytest.approx(np.full(len(K), EPSILON / 3), rel=1e-4)  # a alone turns b once, n twice
    assert (backward_error.of_directions(mirror, RAYS) > 0.01).all()


@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize("name", regimes.REGIMES)
def test_a_rounded_exact_answer_is_off_by_no_more_than_its_rounding(name, precision):
    """Rounding moves b by up to u |b|, and no input of h ≥ 1 need move farther than b does."""
    rays = regimes.make(name, 400, precision, seed=5)
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    off = backward_error.of_directions(exact.direction.astype(precision), rays, ~exact.transmitted)
    assert off.max() <= np.finfo(precision).eps / 2


@pytest.mark.parametrize("alpha", [0.0, 1e-14, 1e-9, 1e-3, 1.0])
def test_mirror_directions_off_by_any_share_along_and_across(alpha):
    """Next to the surface, `alpha` above it, b off by x in the plane of incidence and by y across it.

    δa moves b by 1, δn by 2 along and 2 sin alpha across: there is a disc and an ellipse, of which 20001 tangents are
    searched for the farthest.
    """
    sin, cos, turns = np.sin(alpha), np.cos(alpha), np.linspace(0, np.pi / 2, 20001)
    rays = Rays(np.array([[cos, 0.0, -sin]]), np.array([[0.0, 0.0, 1.0]]), np.ones(1))
    mirror, plane, across = np.array([[cos, 0, sin], [-sin, 0, cos], [0, 1, 0]])
    for x, y in ((3, 0), (3, 1), (2, 2), (0.5, 1), (0, 1)):
        b = (mirror + EPSILON * (x * plane + y * across))[None]
        h = 1 + 2 * np.hypot(np.cos(turns), sin * np.sin(turns))
        least = EPSILON * ((x * np.cos(turns) + y * np.sin(turns)) / h).max()
        assert backward_error.of_directions(b, rays, np.ones(1, bool))[0] == pytest.approx(least, rel=2e-3)


@pytest.mark.parametrize("distance", [1e-12, 1e-9, 1e-6, 1e-3, -1e-12, -1e-9, -1e-6, -1e-3])
def test_inputs_just_so_far_off_are_on_the_other_side_of_the_critical_angle(distance):
    k = np.random.default_rng(3).uniform(1.05, 3, 50)
    angle, beyond = np.arcsin(1 / k) + distance, distance > 0
    n = np.tile([0.0, 0, 1], (50, 1))
    off = backward_error.of_decisions(Rays(np.stack([np.sin(angle), 0 * k, -np.cos(angle)], 1), n, k))
    for share, flips in ((0.98, False), (1.02, True)):
        step = (-share if beyond else share) * off  # both a and n turn toward, or away from, the other side
        assert ((k * (1 + step) * np.sin(angle + 2 * step) > 1) == (beyond != flips)).all()
    # At normal incidence vectors must turn to the critical angle.
    a = np.array([[0.0, 0, -1], [0, 0, -1]])
    found = backward_error.of_decisions(Rays(a, -a, np.array([1e5, 0.5])))
    assert found[0] == pytest.approx(1e-5 / 2) and np.isinf(found[1])


def test_what_rounding_leaves_of_the_textbook_s_formula_is_the_largest_of_all_angles():
    """The bounds at TEXTBOOK_BACKWARD, at k up to 2.5; of decisions at the critical angle."""
    k, c = np.linspace(1e-3, 2.5, 800)[:, None], np.linspace(1e-6, 1, 2000)
    e, root2 = k * np.sqrt(1 - c * c), 1 - k * k * (1 - c * c)
    root = np.sqrt(np.maximum(root2, 0))
    q, radicand = np.abs(k * c - root), k * k * (6 * c + 5 * c * c + 1 - c * c) + 2 * e * e + 1
    linear = k + q + 1 + e
    directions = (linear + e * (radicand / 2 + 2 * root * (k * c + q + 1))) / (k * c + q + e)
    lengths, decisions = (radicand + 2 * linear) / (4 * (2 * k + 1)), radicand / (2 * (2 * k * c + 1))
    worst = directions[root2 >= 0].max(), decisions[np.abs(root2) < 1e-3].max(), lengths[root2 >= 0].max()
    assert worst == pytest.approx((7.8, 5.8, 3.4), abs=0.1) and max(worst) < TEXTBOOK_BACKWARD


def test_the_length_of_an_answer_whose_parts_are_those_of_inputs_so_far_off():
    """The part along the surface of one input, that across it of another."""
    rng = np.random.default_rng(4)
    e, found = K * np.sqrt(1 - (A * N).sum(1) ** 2), 0
    for signs in ((1, 1), (1, -1), (-1, 1)):
        parts = [np.sin(np.arcsin(e / K) + 2 * s * EPSILON) * K * (1 + s * EPSILON) for s in signs]
        b = np.stack([parts[0], np.sqrt(1 - parts[1] ** 2), 0 * K], 1) * rng.choice([1.0, 3.0])
        off = backward_error.of_lengths(
            b, Rays(A * lengths(b)[:, None].round().astype(float), N, K), np.zeros(len(K), bool)
        )
        assert (off <= EPSILON * (1 + 1e-5)).all()
        found = max(found, off.max())
    assert found > 0.3 * EPSILON
    mirror = backward_error.of_lengths(B * (1 + 6 * EPSILON), RAYS, np.ones(len(K), bool))
    assert mirror == pytest.approx(np.full(len(K), EPSILON), rel=1e-5)
    assert (backward_error.of_lengths(0 * B, RAYS, np.zeros(len(K), bool)) > 0.01).all()

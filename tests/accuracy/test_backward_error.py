"""Backward errors, against the exact refraction of inputs with known changes."""

import numpy as np
import pytest

from mi_refract import oracle, regimes
from mi_refract.accuracy import backward_error, lengths
from mi_refract.formulas import TEXTBOOK_BACKWARD
from mi_refract.regimes import Rays

EPSILON = 1e-7


def unit(v):
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def random_rays(count=300):
    """Transmitted rays with a radicand above 0.01, and normals that face them."""
    rng = np.random.default_rng(1)
    cos_i, k = rng.uniform(0.02, 0.999, 8 * count), np.exp(rng.uniform(-np.log(2.5), np.log(2.5), 8 * count))
    selected = np.flatnonzero(1 - k * k * (1 - cos_i * cos_i) > 0.01)[:count]
    n = unit(rng.normal(size=(count, 3)))
    t = unit(np.cross(n, rng.normal(size=(count, 3))))
    a = unit(np.sqrt(1 - cos_i[selected] ** 2)[:, None] * t - cos_i[selected][:, None] * n)
    return Rays(a, n, k[selected])


RAYS = random_rays()
A, N, K = RAYS.a, RAYS.n, RAYS.k


def refracted(rays):
    return oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False).direction


B = refracted(RAYS)
GAMMA = ((K[:, None] * A - B) * N).sum(1)


def turned(v, toward, angle):
    """`v` turned by `angle` in the plane of `v` and `toward`."""
    side = unit(toward - (toward * v).sum(1, keepdims=True) * v)
    return unit(np.cos(angle) * v + np.sin(angle) * side)


def errors_of(a=A, n=N, k=K):
    """The backward errors of the exact refraction of these inputs as an answer to RAYS."""
    return backward_error.of_directions(refracted(Rays(a, n, k)), RAYS)


def test_the_backward_error_is_the_size_of_the_change_of_the_inputs():
    rng = np.random.default_rng(2)
    for _ in range(5):
        a, n = (turned(v, rng.normal(size=v.shape), EPSILON) for v in (A, N))
        errors = errors_of(a, n, K * (1 + EPSILON * rng.choice([-1, 1], len(K))))
        assert (errors <= EPSILON * (1 + 1e-5)).all() and errors.max() > 0.5 * EPSILON
    # The worst case: all three changes add up along the surface: a forward, k larger, and n by the sign of γ, as δn×n γ
    # and n×δa are parallel to n×t.
    t = A - (A * N).sum(1, keepdims=True) * N
    for step in (EPSILON, -EPSILON):
        n = np.where(GAMMA[:, None] > 0, turned(N, t, -step), turned(N, t, step))
        errors = errors_of(turned(A, t, step), n, K * (1 + step))
        assert errors == pytest.approx(np.full(len(K), EPSILON), rel=1e-4)
    # Changes across the plane of incidence; the largest value over φ is within 1 part in 1000 of that across.
    across, gamma = np.cross(N, A), np.abs(GAMMA)
    assert errors_of(a=turned(A, across, EPSILON)) == pytest.approx(EPSILON * K / (K + gamma), rel=1e-3)
    assert errors_of(n=turned(N, across, EPSILON)) == pytest.approx(EPSILON * gamma / (K + gamma), rel=1e-3)


def test_lengths_do_not_count_but_zero_nan_and_the_wrong_side_do():
    scaled, b = Rays(A * 3e5, N * 2e-9, K), B * 7
    assert (backward_error.of_directions(b, scaled) < 2.0**-52).all()
    b[0], b[1], b[2] = 0, np.nan, b[2] - 2 * (b[2] @ N[2]) * N[2]
    errors = backward_error.of_directions(b, scaled)
    assert np.isinf(errors[:2]).all() and errors[2] >= abs(B[2] @ N[2]) and errors[3] < 2.0**-52


def test_the_backward_error_of_mirror_directions():
    mirror, all_mirrored = A - 2 * (A * N).sum(1, keepdims=True) * N, np.ones(len(K), bool)
    assert (backward_error.of_directions(mirror, RAYS, all_mirrored) < 4 * 2.0**-53).all()
    errors = backward_error.of_directions(turned(mirror, A, EPSILON), RAYS, all_mirrored)
    assert errors == pytest.approx(np.full(len(K), EPSILON / 3), rel=1e-4)  # δa turns b by as much, δn by twice as much
    assert (backward_error.of_directions(mirror, RAYS) > 0.01).all()


@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize("name", regimes.REGIMES)
def test_the_backward_error_of_a_rounded_exact_answer_is_at_most_u(name, precision):
    """Rounding moves b by up to u |b|; as h ≥ 1, the inputs need not move farther than b."""
    rays = regimes.make(name, 400, precision, seed=5)
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    errors = backward_error.of_directions(exact.direction.astype(precision), rays, ~exact.transmitted)
    assert errors.max() <= np.finfo(precision).eps / 2


@pytest.mark.parametrize("alpha", [0.0, 1e-14, 1e-9, 1e-3, 1.0])
def test_errors_of_mirror_directions_in_and_across_the_plane_of_incidence(alpha):
    """Near the surface, at the angle `alpha` to it, b has an error x in the plane of incidence and y across it.

    δa moves b by 1, δn by 2 in the plane and by 2 sin alpha across it: a disc and an ellipse. The test searches 20001
    of their tangents for the largest value.
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
def test_inputs_at_the_backward_error_of_a_decision_are_beyond_the_critical_angle(distance):
    k = np.random.default_rng(3).uniform(1.05, 3, 50)
    angle, beyond = np.arcsin(1 / k) + distance, distance > 0
    n = np.tile([0.0, 0, 1], (50, 1))
    errors = backward_error.of_decisions(Rays(np.stack([np.sin(angle), 0 * k, -np.cos(angle)], 1), n, k))
    for share, flips in ((0.98, False), (1.02, True)):
        step = (-share if beyond else share) * errors  # both a and n turn toward the other side, or away from it
        assert ((k * (1 + step) * np.sin(angle + 2 * step) > 1) == (beyond != flips)).all()
    # At normal incidence, a and n must turn to the critical angle.
    a = np.array([[0.0, 0, -1], [0, 0, -1]])
    error = backward_error.of_decisions(Rays(a, -a, np.array([1e5, 0.5])))
    assert error[0] == pytest.approx(1e-5 / 2) and np.isinf(error[1])


def test_the_bounds_of_the_textbook_formula_are_the_largest_values_over_all_angles():
    """The bounds in the comment at TEXTBOOK_BACKWARD, for k up to 2.5; decisions at the critical angle."""
    k, c = np.linspace(1e-3, 2.5, 800)[:, None], np.linspace(1e-6, 1, 2000)
    e, root2 = k * np.sqrt(1 - c * c), 1 - k * k * (1 - c * c)
    root = np.sqrt(np.maximum(root2, 0))
    q, radicand = np.abs(k * c - root), k * k * (6 * c + 5 * c * c + 1 - c * c) + 2 * e * e + 1
    linear = k + q + 1 + e
    directions = (linear + e * (radicand / 2 + 2 * root * (k * c + q + 1))) / (k * c + q + e)
    lengths, decisions = (radicand + 2 * linear) / (4 * (2 * k + 1)), radicand / (2 * (2 * k * c + 1))
    worst = directions[root2 >= 0].max(), decisions[np.abs(root2) < 1e-3].max(), lengths[root2 >= 0].max()
    assert worst == pytest.approx((7.8, 5.8, 3.4), abs=0.1) and max(worst) < TEXTBOOK_BACKWARD


def test_the_length_of_an_answer_combined_from_two_changed_inputs():
    """The component along the surface is that of one changed input, the component across it that of another."""
    rng = np.random.default_rng(4)
    e, largest = K * np.sqrt(1 - (A * N).sum(1) ** 2), 0
    for signs in ((1, 1), (1, -1), (-1, 1)):
        parts = [np.sin(np.arcsin(e / K) + 2 * s * EPSILON) * K * (1 + s * EPSILON) for s in signs]
        b = np.stack([parts[0], np.sqrt(1 - parts[1] ** 2), 0 * K], 1) * rng.choice([1.0, 3.0])
        rays = Rays(A * lengths(b)[:, None].round().astype(float), N, K)
        errors = backward_error.of_lengths(b, rays, np.zeros(len(K), bool))
        assert (errors <= EPSILON * (1 + 1e-5)).all()
        largest = max(largest, errors.max())
    assert largest > 0.3 * EPSILON
    mirror = backward_error.of_lengths(B * (1 + 6 * EPSILON), RAYS, np.ones(len(K), bool))
    assert mirror == pytest.approx(np.full(len(K), EPSILON), rel=1e-5)
    assert (backward_error.of_lengths(0 * B, RAYS, np.zeros(len(K), bool)) > 0.01).all()

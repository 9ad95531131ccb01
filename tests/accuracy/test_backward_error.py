"""Backward errors, against the exact refraction of inputs that were changed on purpose."""

import numpy as np
import pytest

from mi_refract import oracle, regimes
from mi_refract.accuracy import backward_error
from mi_refract.regimes import Rays

EPSILON = 1e-7


def drawn(count=300, seed=1, largest=2.5):
    """Rays at least 0.01 from the critical angle, transmitted, with the normal against them."""
    rng = np.random.default_rng(seed)
    cos_i, k = rng.uniform(0.02, 0.999, 8 * count), np.exp(rng.uniform(-np.log(largest), np.log(largest), 8 * count))
    kept = np.flatnonzero(1 - k * k * (1 - cos_i * cos_i) > 0.01)[:count]
    n = unit(rng.normal(size=(count, 3)))
    t = unit(np.cross(n, rng.normal(size=(count, 3))))
    a = unit(np.sqrt(1 - cos_i[kept] ** 2)[:, None] * t - cos_i[kept][:, None] * n)
    return Rays(a, n, k[kept])


def unit(v):
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def refracted(rays):
    return oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False).direction


def tangent(a, n):
    return unit(a - (a * n).sum(1, keepdims=True) * n)


def turned(v, toward, angle):
    """`v` turned by `angle`, in the plane of both."""
    side = unit(toward - (toward * v).sum(1, keepdims=True) * v)
    return unit(np.cos(angle) * v + np.sin(angle) * side)


def test_what_is_exact_for_inputs_so_far_off_has_no_larger_backward_error():
    rays, rng = drawn(), np.random.default_rng(2)
    for _ in range(5):
        a, n = (turned(v, rng.normal(size=v.shape), EPSILON) for v in (rays.a, rays.n))
        changed = Rays(a, n, rays.k * (1 + EPSILON * rng.choice([-1, 1], len(rays))))
        found = backward_error.of_directions(refracted(changed), rays)
        assert (found <= EPSILON * (1 + 1e-5)).all() and found.max() > 0.5 * EPSILON


@pytest.mark.parametrize("sign", [-1, 1])
def test_inputs_off_in_the_worst_way_are_found_as_far_off_as_they_are(sign):
    """Along the surface, all three the same way: a forward, k up, and n as the sign of γ = k cos θ_i − cos θ_t says."""
    rays = drawn()
    t = tangent(rays.a, rays.n)
    gamma = ((rays.k[:, None] * rays.a - refracted(rays)) * rays.n).sum(1, keepdims=True)
    # δn×n γ and n×δa are parallel to n×t: both add up where δn is along −γ t.
    n = np.where(gamma > 0, turned(rays.n, t, -sign * EPSILON), turned(rays.n, t, sign * EPSILON))
    changed = Rays(turned(rays.a, t, sign * EPSILON), n, rays.k * (1 + sign * EPSILON))
    found = backward_error.of_directions(refracted(changed), rays)
    assert found == pytest.approx(np.full(len(rays), EPSILON), rel=1e-4)


@pytest.mark.parametrize("name", ["a", "n"])
def test_inputs_off_across_the_plane_of_incidence(name):
    rays = drawn()
    across = np.cross(rays.n, rays.a)
    changed = {"a": rays.a, "n": rays.n} | {name: turned(getattr(rays, name), across, EPSILON)}
    found = backward_error.of_directions(refracted(Rays(**changed, k=rays.k)), rays)
    gamma = np.abs(((rays.k[:, None] * rays.a - refracted(rays)) * rays.n).sum(1))
    of = {"a": rays.k, "n": gamma}[name]
    # The largest over φ is within 1 part in 1000 of that across.
    assert found == pytest.approx(EPSILON * of / (rays.k + gamma), rel=1e-3)


def test_lengths_are_not_in_it():
    rays = drawn()
    b = refracted(rays)
    scaled = Rays(rays.a * 3e5, rays.n * 2e-9, rays.k)
    assert (backward_error.of_directions(b * 7, scaled) < 2.0**-52).all()


def test_what_is_no_direction_or_on_the_wrong_side():
    rays = drawn(4)
    b = refracted(rays)
    cos_t = np.abs((b * rays.n).sum(1))
    b[0], b[1], b[2] = 0, np.nan, b[2] - 2 * (b[2] @ rays.n[2]) * rays.n[2]
    found = backward_error.of_directions(b, rays)
    assert np.isinf(found[:2]).all() and found[2] >= cos_t[2] and found[3] < 2.0**-52


def test_mirror_directions():
    rays = drawn()
    mirror = rays.a - 2 * (rays.a * rays.n).sum(1, keepdims=True) * rays.n
    every = np.ones(len(rays), bool)
    assert (backward_error.of_directions(mirror, rays, every) < 4 * 2.0**-53).all()
    off = backward_error.of_directions(turned(mirror, rays.a, EPSILON), rays, every)
    assert off == pytest.approx(np.full(len(rays), EPSILON / 3), rel=1e-4)  # a alone turns b once, n twice
    assert (backward_error.of_directions(mirror, rays) > 0.01).all()


@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize("name", regimes.REGIMES)
def test_a_rounded_exact_answer_is_off_by_no_more_than_its_rounding(name, precision):
    """Rounding moves b by up to u |b|, and no input of h ≥ 1 need move farther than b does."""
    rays = regimes.make(name, 400, precision, seed=5)
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    found = backward_error.of_directions(exact.direction.astype(precision), rays, ~exact.transmitted)
    assert found.max() <= np.finfo(precision).eps / 2


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


@pytest.mark.parametrize("distance", [1e-12, 1e-9, 1e-6, 1e-3])
@pytest.mark.parametrize("beyond", [False, True])
def test_inputs_just_so_far_off_are_on_the_other_side_of_the_critical_angle(distance, beyond):
    rng = np.random.default_rng(3)
    k = rng.uniform(1.05, 3, 50)
    angle = np.arcsin(1 / k) + (distance if beyond else -distance)
    n = np.broadcast_to([0.0, 0, 1], (50, 3))
    rays = Rays(np.stack([np.sin(angle), np.zeros(50), -np.cos(angle)], 1), n.copy(), k)
    sign = -1 if beyond else 1
    for share, flips in ((0.98, False), (1.02, True)):
        step = sign * share * backward_error.of_decisions(rays)
        a, turn = angle + step, step  # both turn toward, or away from, the other side
        changed = k * (1 + step) * np.sin(a + turn)
        assert ((changed > 1) == (beyond != flips)).all()


def test_at_normal_incidence_vectors_must_turn_to_the_critical_angle():
    a = np.array([[0.0, 0, -1], [0, 0, -1]])
    found = backward_error.of_decisions(Rays(a, -a, np.array([1e5, 0.5])))
    assert found[0] == pytest.approx(1e-5 / 2) and np.isinf(found[1])

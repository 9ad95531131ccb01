"""The errata of the documents: each printed form is wrong, and the corrected one is right."""

import math

import drjit as dr
import numpy as np
import pytest

from mi_refract import FORMULAS, refract_2d
from mi_refract.planar import Segments, trace

Vector = dr.scalar.Array3f64
K = 0.75


def numbers(b):
    return [float(x) for x in b]


def test_004_prints_a_wrong_sine():
    """X = k R/(1 + R²) is not k sin(atan R): at 45° the sine is √½, the printed form says ½."""
    printed = K * 1 / (1 + 1**2)
    (_, along), _ = refract_2d((math.sqrt(0.5), math.sqrt(0.5)), (0.0, 1.0), K)
    assert along == pytest.approx(K * math.sqrt(0.5), rel=1e-15)
    assert abs(printed - along) > 0.1


def test_004_prints_a_wrong_intersection_and_the_wrong_sign_of_mu():
    """The right-hand side needs the direction of the boundary: l_x + μ l_α, not l_x + μ i_α; r_* belong to the ray.

    With the denominator of λ, the printed μ = −(i_α(i_y − l_y) + i_β(l_x − i_x))/… has the wrong sign.
    """
    i_s, i_d, l_s, l_d = (np.array(x) for x in ([0.0, 0.0], [1.0, 1.0], [4.0, 0.0], [0.0, 8.0]))
    lam, mu = np.linalg.solve(np.column_stack([i_d, -l_d]), l_s - i_s)
    denominator = i_d[0] * l_d[1] - l_d[0] * i_d[1]
    assert i_s + lam * i_d == pytest.approx(l_s + mu * l_d)  # the lines meet at (4, 4)
    assert np.abs(l_s + mu * i_d - (i_s + lam * i_d)).max() > 1
    assert lam == pytest.approx(-(l_d[0] * (l_s[1] - i_s[1]) + l_d[1] * (i_s[0] - l_s[0])) / denominator)
    printed = -(i_d[0] * (i_s[1] - l_s[1]) + i_d[1] * (l_s[0] - i_s[0])) / denominator
    assert printed == pytest.approx(-mu)
    paths = trace(Segments([l_s], [l_s + l_d], [1.0], [1.0]), [i_s], [i_d], 1)
    assert paths.points[0, 1] == pytest.approx(l_s + mu * l_d)
    # A segment in the opposite direction does not meet the ray; with the printed sign it would.
    assert trace(Segments([l_s], [l_s - l_d], [1.0], [1.0]), [i_s], [i_d], 1).hits[0, 0] == -1


def test_004_fails_for_rays_along_the_boundary():
    """R = i_β/i_α is infinite, and ∞/(1 + ∞²) is NaN; `refract_2d` does not divide by i_α.

    As i_Bα = 0, the printed (sign(i_Bα) √(1 − X²), sign(i_Bβ) X) is (0, k), shorter than i.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        r = np.float64(1.0) / np.float64(0.0)
        assert np.isnan(r / (1 + r**2))
    printed = np.sign(0.0) * math.sqrt(1 - K * K), np.sign(1.0) * K
    assert math.hypot(*printed) == K
    b, transmitted = refract_2d((0.0, 1.0), (0.0, 1.0), K)
    assert (numbers(b), transmitted) == ([0.0, 1.0], False)


@pytest.mark.parametrize("name", FORMULAS)
def test_formulas_hold_for_indices_below_one_which_004_excludes(name):
    """Plasmas: from vacuum into n = 0.9, 30° is within the critical angle; into n = 0.75, 60° is beyond it."""
    b, transmitted = FORMULAS[name](Vector(0.5, 0, -math.sqrt(0.75)), Vector(0, 0, 1), 1 / 0.9)
    assert transmitted and b.x == pytest.approx(0.5 / 0.9, rel=1e-12)
    assert not FORMULAS[name](Vector(math.sqrt(0.75), 0, -0.5), Vector(0, 0, 1), 1 / 0.75)[1]


def test_001_is_undefined_at_normal_incidence():
    """ĉ = c/‖c‖ is 0/0 for i ∥ n; ‖c‖ (n × ĉ) = n × c is not."""
    i, n = Vector(0, 0, -1), Vector(0, 0, 1)
    c = K * np.cross(numbers(i), numbers(n))
    with np.errstate(invalid="ignore"):
        assert np.isnan(c / np.linalg.norm(c)).all()
    b, transmitted = FORMULAS["cross"](i, n, K)
    assert (numbers(b), transmitted) == ([0, 0, -1], True)


def as_printed_002(a, n, k):
    c = dr.dot(n, a)
    return n * (-k * c - math.sqrt(1 - k * k * (1 - c * c))) + k * a


def as_printed_000(a, n, k):
    c = dr.dot(n, a)
    return k * (a - n * c) - n * math.sqrt(dr.dot(a, a) - k * k * (dr.dot(a, a) - c * c))


@pytest.mark.parametrize(("printed", "name"), [(as_printed_002, "decomposed"), (as_printed_000, "wedge")])
def test_000_and_002_hold_on_one_side_only(printed, name):
    """Both assume n·a < 0: with the normal on the other side they send the ray back to its own side."""
    for z in (-0.8, 0.8):
        a, n = Vector(0.6, 0, z), Vector(0, 0, 1)
        b, _ = FORMULAS[name](a, n, K)
        assert b.z * z > 0
        agrees = np.abs(np.array(numbers(b)) - numbers(printed(a, n, K))).max() < 1e-12
        assert agrees == (z < 0)

"""How answers say that a ray is totally reflected, found from the answers alone."""

from __future__ import annotations

import numpy as np

from mi_refract import oracle
from mi_refract.formulas import FORMULAS
from mi_refract.ray_sets import tir_signal
from mi_refract.ray_sets.judged_answers import judge_answers
from mi_refract.ray_sets.tir_signal import LOOSEST, SeenAnswers
from mi_refract.regimes import Rays

U = 2.0**-53
K = 1.4


def rays(radicands):
    """In float64, totally reflected: 1 − k² sin² θ is each of these."""
    sin = np.sqrt(1 - np.asarray(radicands)) / K
    a = np.stack([sin, 0 * sin, -np.sqrt(1 - sin**2)], 1)
    return Rays(a, np.tile([0.0, 0.0, 1.0], (len(sin), 1)), np.full(len(sin), K))


def seen(given, b):
    return SeenAnswers(b, given, oracle.refract(given.a, given.n, given.k, fresnel=False, progress=False), U)


def test_rays_far_beyond_the_critical_angle_decide():
    """Four of ten say zero; the others are within 1e-4 of the critical angle, and answer along the surface."""
    given = rays([-0.5] * 4 + [-1e-4] * 6)
    b = np.array([[0.0, 0, 0]] * 4 + [[1.0, 0, 0]] * 6)
    found = tir_signal.count(seen(given, b))
    assert (found.total, found.certain, found.of_certain["zero"]) == (10, 4, 4)
    assert found.signal == "zero"


def test_where_none_is_far_beyond_it_all_decide():
    given = rays([-1e-4] * 10)
    found = tir_signal.count(seen(given, np.zeros((10, 3))))
    assert (found.total, found.certain, found.signal) == (10, 0, "zero")


def test_signals_are_counted_where_they_are_asked_for():
    given, budget = rays([-0.5] * 4), FORMULAS[LOOSEST].budget
    told = judge_answers(np.zeros((4, 3)), None, given, "f64", budget, "zero")
    assert told.signals is None
    asked = judge_answers(np.zeros((4, 3)), None, given, "f64", budget, "zero", counted=True)
    assert asked.signals.of_total["zero"] == 4
    assert judge_answers(np.zeros((4, 3)), None, given, "f64", budget).tir == "zero"


def test_a_mirror_direction_is_one_at_any_length():
    """Of transmitted rays the answer is along the refracted direction, and both are three times as long as asked."""
    given = rays([-0.5, -0.2, 0.3, 0.6])
    exact = oracle.refract(given.a, given.n, given.k, fresnel=False, progress=False)
    mirror = given.a * [1, 1, -1]
    for length in (1 / 3, 1.0, 3.0):
        b = length * np.where(exact.transmitted[:, None], exact.direction, mirror)
        assert (
            tir_signal.reflected(seen(given, b), None, "reflected", np.ones(4, bool)).tolist()
            == [True] * 2 + [False] * 2
        )

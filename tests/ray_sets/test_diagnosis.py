"""Mistakes as predictions of what a program answers."""

from __future__ import annotations

import numpy as np

from mi_refract import oracle
from mi_refract.accuracy import RayBounds
from mi_refract.formulas import FORMULAS
from mi_refract.ray_sets.diagnosis import Case, _by_angle, _refracted
from mi_refract.ray_sets.tir_signal import LOOSEST
from mi_refract.regimes import Rays


def test_code_with_angles_goes_straight_on_at_normal_incidence():
    """Where the ray is along the normal there is no tangent to turn towards."""
    slanted = [0.6, 0.0, -0.8]
    given = Rays(np.array([[0.0, 0, -1], slanted]), np.tile([0.0, 0, 1], (2, 1)), np.full(2, 0.75))
    exact = oracle.refract(given.a, given.n, given.k, fresnel=False, progress=False)
    case = Case.of(RayBounds(given, exact, FORMULAS[LOOSEST].budget, 2.0**-53, normalised=True), np.arange(2))
    np.testing.assert_allclose(_by_angle(_refracted)(case), exact.direction, atol=1e-15)

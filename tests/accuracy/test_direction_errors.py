"""Measures of directions and rays, against the oracle."""

import numpy as np
import pytest

from mi_refract import oracle, regimes
from mi_refract.accuracy import relative_radicand


@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_near_the_critical_angle_the_relative_radicand_is_that_of_the_oracle(precision):
    rays = regimes.make("critical", 50, precision, seed=1)
    exact = oracle.relative_radicand(rays.a, rays.n, rays.k)
    near = np.abs(exact) < 1e-2
    assert near.sum() > 10
    np.testing.assert_allclose(relative_radicand(rays)[near].astype(float), np.abs(exact[near]), rtol=1e-2)

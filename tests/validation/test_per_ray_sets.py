"""The sets of rays that other systems are given are what they were when their goals were set."""

import numpy as np
import pytest

from mi_refract import regimes
from mi_refract.ray_sets import ray_set
from validation.suite import per_ray


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_the_random_rays_are_those_of_before_any_result(precision):
    """None is left out: rays near the critical angle stay where they were drawn."""
    count, dtype = 10_000, ray_set.PRECISIONS[precision]
    rng = np.random.default_rng([2040, 0])
    n = regimes.normalised(rng.normal(size=(count, 3))).astype(dtype)
    cosine, k = rng.uniform(0, 1, count), 1.5 ** rng.choice([-1.0, 1.0], count)
    across = np.cross(n.astype(float), rng.normal(size=n.shape))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    rays = per_ray.given(precision)
    rays = rays.rays[rays.regime == "random"]
    behind = (rays.a * n).sum(1, keepdims=True) > 0  # there the normal is turned: all face the ray
    np.testing.assert_array_equal(rays.n, np.where(behind, -n, n))
    np.testing.assert_array_equal(rays.k, k.astype(dtype))
    tolerance = 8 * np.finfo(dtype).eps
    np.testing.assert_allclose(np.abs((rays.a * n).sum(1)), cosine, atol=tolerance)
    sine = np.sqrt(1 - cosine**2)
    np.testing.assert_allclose((rays.a * across).sum(1), sine, atol=tolerance)
    assert (np.abs(1 - k**2 * sine**2) < per_ray.LEFT_OUT).any()

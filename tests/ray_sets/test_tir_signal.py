"""How answers say that a ray is totally reflected, found from the answers alone."""

from __future__ import annotations

import numpy as np
import pytest

from mi_refract import oracle
from mi_refract.ray_sets import tir_signal
from mi_refract.ray_sets.tir_signal import SeenAnswers
from mi_refract.regimes import Rays

K = 1.4


def seen(radicands, b=None):
    """Answers to rays in float64: 1 − k² sin² θ is each of the radicands, negative under total internal reflection."""
    sin = np.sqrt(1 - np.asarray(radicands)) / K
    a = np.stack([sin, 0 * sin, -np.sqrt(1 - sin**2)], 1)
    rays = Rays(a, np.tile([0.0, 0.0, 1.0], (len(sin), 1)), np.full(len(sin), K))
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    return SeenAnswers(a if b is None else np.array(b), rays, exact, 2.0**-53)


ZERO, ALONG = [0.0, 0, 0], [1.0, 0, 0]


@pytest.mark.parametrize(
    ("radicands", "b", "signal"),
    [
        ([-0.5] * 4 + [-1e-4] * 6, [ZERO] * 4 + [ALONG] * 6, "zero"),  # far from the critical angle, four decide
        ([-1e-4] * 10, [ZERO] * 10, "zero"),  # where none is far, all decide
        ([-0.5] * 10, [ZERO] * 9 + [ALONG], "zero"),
        ([-0.5] * 10, [ZERO] * 8 + [ALONG] * 2, tir_signal.UNCLEAR),
        ([0.5] * 10, [ZERO] * 10, tir_signal.NONE),
    ],
)
@pytest.mark.parametrize("size", [3, 10])
def test_the_signal_that_most_rays_agree_on(radicands, b, signal, size):
    assert tir_signal.detect(seen(radicands[i : i + size], b[i : i + size]) for i in range(0, 10, size)) == signal


@pytest.mark.parametrize("length", [1 / 3, 1.0, 3.0])
def test_a_mirror_direction_is_one_at_any_length(length):
    """Also of transmitted rays the answer is along the refracted direction at any length."""
    answers = seen([-0.5, -0.2, 0.3, 0.6])
    exact = answers.exact
    b = length * np.where(exact.transmitted[:, None], exact.direction, answers.rays.a * [1, 1, -1])
    called = tir_signal.reflected(seen([-0.5, -0.2, 0.3, 0.6], b), None, "reflected", np.ones(4, bool))
    assert called.tolist() == [True] * 2 + [False] * 2

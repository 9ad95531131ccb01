"""What the forms at the rounding limit rest on: the error of the radicand."""

from fractions import Fraction

import drjit as dr
import numpy as np
import pytest

from mi_refract.accuracy import arrays
from mi_refract.formulas import well_conditioned
from mi_refract.numerics import DoubleWord, TripleWord, error_free
from mi_refract.regimes import Rays

COUNT = {"scalar": 40, "llvm": 400, "cuda": 400}
# k of three kinds: the critical angle far from both ends, at grazing, and at almost normal incidence.
RATIOS = {"critical": (1.02, 2.5), "matched": (1 + 2e-7, 1 + 1e-4), "k ≫ 1": (1e2, 1e6)}


def near_critical(kind, count, precision):
    """Rays at the critical angle but for the rounding of their components: (a, n, k) as numpy arrays."""
    rng = np.random.default_rng(5)
    low, high = np.log(np.subtract(RATIOS[kind], 1))
    k = (1 + np.exp(rng.uniform(low, high, count))).astype(precision)
    n = rng.normal(size=(count, 3))
    n = (n / np.linalg.norm(n, axis=1)[:, None]).astype(precision)
    t = np.cross(n, rng.normal(size=(count, 3)))
    t, sine = t / np.linalg.norm(t, axis=1)[:, None], 1 / k.astype(float)[:, None]
    a = np.sqrt(1 - sine**2) * n * rng.choice([-1, 1], (count, 1)) + sine * t
    return a.astype(precision), n, k


def each_ray(setting, function, a, n, k):
    """`function(a, n, k)`, a double word, as exact fractions, ray by ray."""
    if setting.backend == "scalar":
        found = [function(setting.vector(x), setting.vector(y), float(z)) for x, y, z in zip(a, n, k, strict=True)]
        return [Fraction(float(x.hi)) + Fraction(float(x.lo)) for x in found]
    found = function(*arrays(Rays(a, n, k), setting.vector))
    parts = (np.broadcast_to(np.array(x), len(k)) for x in (found.hi, found.lo))
    return [Fraction(float(x)) + Fraction(float(y)) for x, y in zip(*parts, strict=True)]


def terms(a, n, k):
    """c² and κ w², exactly."""
    a, n, k = [Fraction(float(x)) for x in a], [Fraction(float(x)) for x in n], Fraction(float(k))
    c = sum(x * y for x, y in zip(a, n, strict=True))
    squares = sum(x * x for x in a) * sum(x * x for x in n)
    return c * c, (k * k - 1) * (squares - c * c)


def radicand(a, n, k):
    kappa = DoubleWord.product(k, k) - 1
    return well_conditioned._radicand(error_free.dot(n, a), error_free.cross(n, a), kappa)


def radicand_of_plain_contrast(a, n, k):
    kappa = DoubleWord((k - 1) * (k + 1))
    return well_conditioned._radicand(error_free.dot(n, a), error_free.cross(n, a), kappa)


def radicand_of_plain_cosine(a, n, k):
    kappa = DoubleWord.product(k, k) - 1
    return well_conditioned._radicand(TripleWord(dr.dot(n, a)), error_free.cross(n, a), kappa)


def radicand_of_the_second_order(a, n, k):
    """What pairs keep: the errors of first order, each rounded."""
    kappa, c, w = DoubleWord.product(k, k) - 1, error_free.dot(n, a).pair, [x.pair for x in error_free.cross(n, a)]
    return c * c - kappa * (w[0] * w[0] + w[1] * w[1] + w[2] * w[2])


def largest_error(function, kind, setting):
    """In u³ of the larger term, beyond u² of the radicand itself, which is what a pair can hold."""
    rays, u = near_critical(kind, COUNT[setting.backend], setting.precision), Fraction(setting.roundoff)
    errors = []
    for found, ray in zip(each_ray(setting, function, *rays), zip(*rays, strict=True), strict=True):
        c2, kw2 = terms(*ray)
        errors.append((abs(found - (c2 - kw2)) - u**2 * abs(c2 - kw2)) / max(c2, kw2) / u**3)
    return float(max(errors))


@pytest.mark.parametrize("kind", RATIOS)
def test_the_radicand_keeps_what_its_inequalities_say(kind, setting):
    assert largest_error(radicand, kind, setting) <= 100


@pytest.mark.parametrize("mutant", [radicand_of_plain_contrast, radicand_of_plain_cosine, radicand_of_the_second_order])
def test_a_term_of_the_radicand_that_loses_its_low_parts_is_seen(mutant, setting):
    assert largest_error(mutant, "critical", setting) > 1e3

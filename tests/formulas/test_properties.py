"""What refraction keeps, without the oracle: reversed light, the plane of incidence, scales, both sides.

Each property holds for every formula within its own budget, and is seen to fail on a planted defect.
"""

import functools

import numpy as np
import pytest

from mi_refract import FORMULAS
from mi_refract.accuracy import absolute_radicand, evaluate, lengths
from mi_refract.formulas.bounds import root
from mi_refract.regimes import REGIMES, Rays, make
from validation.directions.planted_defects import EXACT, MUTANTS


def has_denormals(name):
    """Those are neither scaled exactly, nor numbers other than 0 on every backend."""
    rays = make(name, 64, np.float32)
    return any(((v != 0) & (np.abs(v) < np.finfo(np.float32).smallest_normal)).any() for v in (rays.a, rays.n))


UNIT = [name for name, regime in REGIMES.items() if regime.unit and not has_denormals(name)]
COUNTS = {"scalar": 12, "llvm": 256, "cuda": 256}  # rays of each regime


@functools.cache
def rays_of(setting):
    """Rays of all regimes in one set."""
    parts = [make(name, COUNTS[setting.backend], setting.precision, seed=21) for name in UNIT]
    return Rays(*(np.concatenate([getattr(part, x) for part in parts]) for x in ("a", "n", "k")))


class Case:
    """Rays, what a subject makes of them, and what its budget allows."""

    def __init__(self, subject, budget, rays, setting):
        self.rays, self.budget = rays, budget
        self.b, self.transmitted = evaluate(subject, rays, setting.vector)
        self.a, self.n, self.k = (x.astype(np.longdouble) for x in (rays.a, rays.n, rays.k))
        off = np.maximum(np.abs(lengths(self.a) - 1), np.abs(lengths(self.n) - 1))
        self.u = np.maximum(setting.roundoff, off)
        self.sin_t = np.minimum(1, self.k * lengths(np.cross(self.n, self.a)) / (lengths(self.n) * lengths(self.a)))
        self.cos_t = np.sqrt((1 - self.sin_t) * (1 + self.sin_t))

    def bound(self, moved=0.0):
        """How far b may be from that of rays whose a and n were moved by `moved`, and rounded.

        Moved are the tangent by k, the radicand by 2 sin θ_t k and the square of that.
        """
        across = np.where(self.transmitted, np.maximum(1, self.k), 1) * moved
        x = across * (2 * self.sin_t + across) + self.budget.radicand_error_bound(self.u, self.k)
        terms = self.budget.of_terms(self.u, self.k, self.transmitted)
        return 2 * across + terms + np.where(self.transmitted, root(x, self.cos_t), 0)

    def undecidable(self, moved=0.0):
        """Rays so near to the critical angle that the budget, or the move, leaves the decision open."""
        across = np.maximum(1, self.k) * moved
        return absolute_radicand(self.rays) <= self.budget.radicand_error_bound(self.u, self.k) + across * (2 + across)


def differing(x, y):
    """How many; NaN differs from itself. (Of a number pytest prints less than of arrays.)"""
    return np.count_nonzero(x != y)


def agree(b, other, bound, kept):
    share = (lengths(b - other) / bound)[kept].max(initial=0)
    assert share <= 1


def asked(mask, least=0.85):
    """The mask; a property that leaves out most rays says nothing. Next to the critical angle it may leave out all."""
    share = mask.reshape(len(UNIT), -1)[[not name.startswith("critical") for name in UNIT]].mean()
    if share < least:  # no AssertionError, which is what a defect is seen by
        raise RuntimeError(f"of the rays far from the critical angle only {share:.0%} were asked for")
    return mask


# The properties: of a subject, with its budget -----------------------------------------------------------------


def reversibility(subject, budget, setting):
    """Sent back by 1/k, the refracted ray is the incident one."""
    rays = rays_of(setting)
    there = Case(subject, budget, rays, setting)
    kept = there.transmitted & ~there.undecidable()
    inverse = (1 / rays.k.astype(np.longdouble)).astype(setting.precision)
    back = Case(subject, budget, Rays((-there.b).astype(setting.precision), rays.n, inverse), setting)
    # What is off: the way there, the length of b, 1/k by u.
    moved = there.bound() + there.u
    kept &= back.transmitted & ~back.undecidable(moved)
    # Of a ray along the surface that may be its side.
    kept &= np.abs((there.b * there.n).sum(1)) > moved
    agree(back.b, -there.a, back.bound(moved), asked(kept, 0.4))  # the others are reflected


def coplanarity(subject, budget, setting):
    """b stays in the plane of a and n, to what is linear in rounding: the root is along n."""
    case = Case(subject, budget, rays_of(setting), setting)
    w = np.cross(case.n, case.a)
    across = np.abs((case.b * w).sum(1))
    bound = lengths(w) * case.budget.of_terms(case.u, case.k, case.transmitted)
    share = (across / (bound + 2.0**-60)).max()  # extended precision rounds w and the sum, too
    assert share <= 1


def powers_of_two(subject, budget, setting):
    """Scaling `a` scales b, scaling `n` nothing, bit for bit."""
    rays = rays_of(setting)
    i, j = np.random.default_rng(22).integers(-12, 12, (2, len(rays.k), 1), endpoint=True)
    scaled = Rays(np.ldexp(rays.a, i), np.ldexp(rays.n, j), rays.k)
    b, transmitted = evaluate(subject, rays, setting.vector)
    other, same = evaluate(subject, scaled, setting.vector)
    assert differing(transmitted, same) == 0
    assert differing(np.ldexp(b, i), other) == 0


def both_sides(subject, budget, setting):
    """The normal on the other side: the same b, bit for bit."""
    rays = rays_of(setting)
    b, transmitted = evaluate(subject, rays, setting.vector)
    other, same = evaluate(subject, Rays(rays.a, -rays.n, rays.k), setting.vector)
    assert differing(transmitted, same) == 0
    assert differing(b, other) == 0


# Each property, the formulas it holds for, and a defect that breaks it.
PROPERTIES = [
    (reversibility, tuple(FORMULAS), "k off"),
    (coplanarity, tuple(FORMULAS), "slipped cross product"),
    (powers_of_two, EXACT, "unit normal assumed"),
    (both_sides, tuple(FORMULAS), "one-sided"),
]
CASES = [pytest.param(p, name, m, id=f"{p.__name__}-{name}") for p, names, m in PROPERTIES for name in names]


@pytest.mark.parametrize(("holds", "name", "mutant"), CASES)
def test_property_holds_and_fails_on_a_defect(holds, name, mutant, setting):
    formula = FORMULAS[name]
    holds(formula, formula.budget, setting)
    with pytest.raises(AssertionError):
        holds(MUTANTS[mutant].make(formula), formula.budget, setting)

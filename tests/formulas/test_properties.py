"""What refraction keeps, without the oracle: reversed light, the plane of incidence, scales, rotations, both sides.

Each property holds for every formula within its own budget, and is seen to fail on a planted defect.
"""

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

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
COUNTS = {"scalar": 12, "llvm": 256, "cuda": 256}
# Powers of two by which `a` and `n` are scaled.
EXPONENTS = st.integers(-12, 12)
SEEDS = st.tuples(st.sampled_from(UNIT), st.integers(0, 2**32 - 1))
# The same examples every time. A regime and a seed cannot be made any smaller, so nothing is shrunk.
REPLAYED = settings(max_examples=12, derandomize=True, deadline=None, database=None, phases=[Phase.generate])


def rays_of(seed, setting):
    return make(seed[0], COUNTS[setting.backend], setting.precision, seed[1])


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


def agree(b, other, bound, kept):
    error = lengths(b - other)
    assert (error <= bound)[kept].all(), (error / bound)[kept].max()


class Kept:
    """What a property was asked of, over all its examples: one that leaves out most rays says nothing."""

    def __init__(self, least=0.85):
        self.least, self.masks = least, []

    def __call__(self, mask):
        self.masks.append(mask)
        return mask

    def check(self, property):
        property()
        share = np.concatenate(self.masks).mean()
        if share < self.least:  # no AssertionError, which is what a defect is seen by
            raise RuntimeError(f"of all rays only {share:.0%} were asked for")


# The properties: of a subject, with its budget -----------------------------------------------------------------


def reversibility(subject, budget, setting):
    """Sent back by 1/k, the refracted ray is the incident one."""
    asked = Kept(0.4)  # the others are reflected

    @REPLAYED
    @given(SEEDS)
    def check(seed):
        rays = rays_of(seed, setting)
        there = Case(subject, budget, rays, setting)
        kept = there.transmitted & ~there.undecidable()
        inverse = (1 / rays.k.astype(np.longdouble)).astype(setting.precision)
        back_rays = Rays((-there.b).astype(setting.precision), rays.n, inverse)
        back = Case(subject, budget, back_rays, setting)
        # What is off: the way there, the length of b, 1/k by u.
        moved = there.bound() + there.u
        kept &= back.transmitted & ~back.undecidable(moved)
        # Of a ray along the surface that may be its side.
        kept &= np.abs((there.b * there.n).sum(1)) > moved
        agree(back.b, -there.a, back.bound(moved), asked(kept))

    asked.check(check)


def coplanarity(subject, budget, setting):
    """b stays in the plane of a and n, to what is linear in rounding: the root is along n."""

    @REPLAYED
    @given(SEEDS)
    def check(seed):
        case = Case(subject, budget, rays_of(seed, setting), setting)
        w = np.cross(case.n, case.a)
        across = np.abs((case.b * w).sum(1))
        bound = lengths(w) * case.budget.of_terms(case.u, case.k, case.transmitted)
        assert (across <= bound + 2.0**-60).all()  # extended precision rounds w and the sum, too

    check()


def powers_of_two(subject, budget, setting):
    """Scaling `a` scales b, scaling `n` nothing, bit for bit."""

    @REPLAYED
    @given(SEEDS, EXPONENTS, EXPONENTS)
    def check(seed, i, j):
        rays = rays_of(seed, setting)
        scaled = Rays(np.ldexp(rays.a, i), np.ldexp(rays.n, j), rays.k)
        b, transmitted = evaluate(subject, rays, setting.vector)
        other, same = evaluate(subject, scaled, setting.vector)
        assert (transmitted == same).all()
        assert (np.ldexp(b, i) == other).all()

    check()


def any_factor(subject, budget, setting):
    """Scaled by what is no power of two, `a` and `n` are rounded: b moves as far as that takes it."""
    kept = Kept()

    @REPLAYED
    @given(SEEDS, st.floats(2.0**-10, 2.0**10), st.floats(2.0**-10, 2.0**10))
    def check(seed, s, t):
        rays = rays_of(seed, setting)
        s, t = (np.longdouble(setting.precision(x)) for x in (s, t))
        one = Case(subject, budget, rays, setting)
        scaled = Rays((s * one.a).astype(setting.precision), (t * one.n).astype(setting.precision), rays.k)
        b, transmitted = evaluate(subject, scaled, setting.vector)
        moved = 2 * setting.roundoff
        mask = kept(~one.undecidable(moved))
        assert (transmitted == one.transmitted)[mask].all()
        agree(b / s, one.b, 2 * one.bound(moved), mask)

    kept.check(check)


def rotation(subject, budget, setting):
    """Turned rays have turned answers."""
    kept = Kept()

    @REPLAYED
    @given(SEEDS, st.integers(0, 2**32 - 1), st.booleans())
    def check(seed, turn, exact):
        rays = rays_of(seed, setting)
        one = Case(subject, budget, rays, setting)
        r = signed_permutation(turn) if exact else quaternion_rotation(turn)
        turned = Rays((one.a @ r.T).astype(setting.precision), (one.n @ r.T).astype(setting.precision), rays.k)
        b, transmitted = evaluate(subject, turned, setting.vector)
        moved = lengths(turned.a - one.a @ r.T) + lengths(turned.n - one.n @ r.T)
        mask = kept(~one.undecidable(moved))
        assert (transmitted == one.transmitted)[mask].all()
        agree(b, one.b @ r.T, 2 * one.bound(moved), mask)

    kept.check(check)


def both_sides(subject, budget, setting):
    """The normal on the other side: the same b, bit for bit."""

    @REPLAYED
    @given(SEEDS)
    def check(seed):
        rays = rays_of(seed, setting)
        b, transmitted = evaluate(subject, rays, setting.vector)
        other, same = evaluate(subject, Rays(rays.a, -rays.n, rays.k), setting.vector)
        assert (transmitted == same).all()
        assert (b == other).all()

    check()


def signed_permutation(turn):
    """One of the 24 rotations that only swap and flip axes: they round nothing."""
    rng = np.random.default_rng(turn)
    r = np.eye(3)[rng.permutation(3)] * rng.choice([-1.0, 1.0], 3)[:, None]
    r[0] *= np.sign(np.linalg.det(r))
    return r.astype(np.longdouble)


def quaternion_rotation(turn):
    q = np.random.default_rng(turn).normal(size=4).astype(np.longdouble)
    w, x, y, z = q / np.sqrt((q**2).sum())
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


# Each property, the formulas it holds for, and a defect that breaks it.
PROPERTIES = [
    (reversibility, tuple(FORMULAS), "k off"),
    (coplanarity, tuple(FORMULAS), "slipped cross product"),
    (powers_of_two, EXACT, "unit normal assumed"),
    (any_factor, EXACT, "unit normal assumed"),
    (rotation, tuple(FORMULAS), "slipped cross product"),
    (both_sides, tuple(FORMULAS), "one-sided"),
]
HELD = [pytest.param(p, name, id=f"{p.__name__}-{name}") for p, names, _ in PROPERTIES for name in names]
BROKEN = [pytest.param(p, name, m, id=f"{p.__name__}-{name}") for p, names, m in PROPERTIES for name in names]


@pytest.mark.parametrize(("holds", "name"), HELD)
def test_property(holds, name, setting):
    holds(FORMULAS[name], FORMULAS[name].budget, setting)


@pytest.mark.parametrize(("holds", "name", "mutant"), BROKEN)
def test_property_is_seen_to_fail_on_a_defect(holds, name, mutant, setting):
    with pytest.raises(AssertionError):
        holds(MUTANTS[mutant].make(FORMULAS[name]), FORMULAS[name].budget, setting)

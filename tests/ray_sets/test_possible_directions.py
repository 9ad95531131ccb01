"""Where rounding may have changed a direction beyond recognition: what is right passes, what cannot be is wrong."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from support.ray_programs import GOOD, dot, glsl, mirrored

from mi_refract import oracle
from mi_refract.accuracy import RayBounds
from mi_refract.formulas import FORMULAS
from mi_refract.ray_sets import possible_directions, ray_set, reports
from mi_refract.ray_sets.check_answers import check
from mi_refract.ray_sets.ray_set import Answers
from mi_refract.ray_sets.tir_signal import LOOSEST

STEEP = ("k ≫ 1", "generic")


@functools.cache
def steep():
    """Rays, the certified answers, and those whose bound is beyond a half turn, which are half of the transmitted."""
    to = ray_set.make(STEEP, 300, seed=4)
    exact = oracle.refract(to.rays.a, to.rays.n, to.rays.k, fresnel=False, progress=False)
    return to, exact, (to.rays.k > 3000) & exact.transmitted


def answers(program):
    to = steep()[0]
    return program(to.rays.a, to.rays.n, to.rays.k).astype(float)


def unit(v):
    return v / np.sqrt(dot(v, v))


def turned(v, n, angle):
    """`v` turned about n, which is unit."""
    return np.cos(angle) * v + np.sin(angle) * np.cross(n, v) + (1 - np.cos(angle)) * dot(n, v) * n


def tangent(a, n):
    return unit(a - dot(a, n) * n)


GARBAGE = {
    "a random direction along the surface": lambda rng, a, n, b: turned(
        tangent(a, n), n, rng.uniform(0.5, 5, (len(a), 1))
    ),
    "a random direction": lambda rng, a, n, b: unit(rng.normal(size=a.shape)),
    "backward along the surface": lambda rng, a, n, b: -tangent(a, n),
    "turned about the normal": lambda rng, a, n, b: turned(b, n, 0.5),
    "the way that it came": lambda rng, a, n, b: -a,
    "back from the surface": lambda rng, a, n, b: b - 2 * dot(b, n) * n,
}


@pytest.mark.parametrize("tir", GOOD)
@pytest.mark.parametrize("garbage", GARBAGE.values(), ids=GARBAGE)
def test_garbage_does_not_pass_where_the_bound_is_beyond_a_half_turn(tir, garbage):
    to, exact, lost = steep()
    b = answers(GOOD[tir])
    a, n = (unit(v[lost].astype(float)) for v in (to.rays.a, to.rays.n))
    b[lost] = garbage(np.random.default_rng(1), a, n, exact.direction[lost])
    found = check(to, Answers(to.ids, b), tir=tir)
    assert found.exit_code == 1
    # Of a random direction a few are possible; next to k sinθ = 0 all angles about the normal are.
    assert found.problem_count("impossible") == found.wrong >= 0.5 * lost.sum()


@pytest.mark.parametrize("tir", GOOD)
@pytest.mark.parametrize("made_unit", [False, True])
def test_the_textbook_passes_there_at_any_length(tir, made_unit):
    to = steep()[0]
    b = answers(GOOD[tir])
    if made_unit:
        b = np.where(b.any(1, keepdims=True), unit(np.where(b.any(1, keepdims=True), b, 1)), 0)
    found = check(to, Answers(to.ids, b), tir=tir)
    assert (found.exit_code, found.problems) == (0, ())


def test_only_right_answers_are_possible_where_the_bound_is_tight():
    """In float64 and far from the critical angle no other direction is, however the answer is long."""
    to = ray_set.make(("generic", "k ≪ 1", "critical"), 60, "f64", 4)
    a, n, k = to.rays.a, to.rays.n, to.rays.k
    exact = oracle.refract(a, n, k, fresnel=False, progress=False)
    bounds = RayBounds(to.rays, exact, FORMULAS[LOOSEST].budget, to.roundoff, normalised=True)
    for possible, b, asked in (
        (possible_directions.possible, 3 * exact.direction, exact.transmitted),
        (possible_directions.possible_tangent, 3 * tangent(a, n), ~exact.transmitted),
        (possible_directions.possible_mirror, 3 * mirrored(a, n, k), ~exact.transmitted),
    ):
        some = np.flatnonzero(asked & (bounds.chord < 1e-9))
        assert len(some) > 20
        assert possible(b, bounds, some).all()
        across = np.cross(a, n)
        for wrong in (-b, b + 1e-6 * across, turned(b, n, 1e-6)):
            assert not possible(wrong, bounds, some).any()
        if possible is not possible_directions.possible_tangent:
            assert not possible(b + 1e-6 * n, bounds, some).any()


def test_undecidable_rays_are_counted():
    to, _, lost = steep()
    found = check(to, Answers(to.ids, answers(glsl)))
    steep_, generic = found.regimes
    assert (generic.undecidable, generic.judged) == (0, generic.compared)
    assert lost.sum() <= steep_.undecidable < steep_.rays
    assert steep_.judged + steep_.undecidable <= steep_.rays
    assert f"; {steep_.undecidable} rays are undecidable (error bound above 0.1 rad)" in reports.sentence(found)
    assert reports.as_data(found)["regimes"][0]["undecidable"] == steep_.undecidable


def test_undecidable_rays_alone_are_no_pass():
    to, exact, lost = steep()
    found = check(to[lost], Answers(to.ids[lost], exact.direction[lost]))
    assert (found.exit_code, found.wrong, found.total("judged")) == (1, 0, 0)
    assert found.total("compared") > 0
    assert "none of them a decidable direction" in reports.sentence(found)


@pytest.mark.parametrize("tir", ["reflected", "tangent"])
def test_a_direction_that_signals_total_reflection_is_in_the_plane_of_incidence(tir):
    """Tangents and mirror directions turned about the normal, next to the critical angle."""
    to = ray_set.make(("critical, to the ulp",), 200, "f64", 4)
    exact = oracle.refract(to.rays.a, to.rays.n, to.rays.k, fresnel=False, progress=False)
    a, n = to.rays.a, to.rays.n
    b = mirrored(a, n, to.rays.k) if tir == "reflected" else tangent(a, n)
    assert check(to, Answers(to.ids, b), tir=tir).wrong == 0  # so near to the critical angle any ray may be reflected
    assert exact.transmitted.any() and not exact.transmitted.all()
    found = check(to, Answers(to.ids, turned(b, n, 0.1)), tir=tir)
    assert (found.exit_code, found.wrong) == (1, len(to))


def test_a_direction_may_be_turned_about_the_normal_by_the_slack_of_its_part_along_the_surface():
    """cos θ between 0.3 and 0.7, so that none of its powers are alike: by L u of the answer, and not by 1.03 L u."""
    to = ray_set.make(("generic",), 800, "f32", 4)
    exact = oracle.refract(to.rays.a, to.rays.n, to.rays.k, fresnel=False, progress=False)
    bounds = RayBounds(to.rays, exact, FORMULAS[LOOSEST].budget, to.roundoff, normalised=True)
    some = np.flatnonzero(exact.transmitted & (exact.cos_t > 0.3) & (exact.cos_t < 0.7) & (bounds.chord < 1e-5))
    assert len(some) > 20
    slack = bounds.budget.of_terms(bounds.u, bounds.k) / np.sqrt(1 - exact.cos_t**2)
    for share, accepted in ((0.97, True), (1.03, False)):
        b = turned(exact.direction, unit(to.rays.n.astype(float)), share * slack[:, None])
        assert (possible_directions.possible(b, bounds, some) == accepted).all()

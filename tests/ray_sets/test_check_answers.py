"""Right answers pass, and every planted mistake is found and named."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import media_rays
from support import ray_programs as programs
from support.ray_programs import BAD, GOOD, dot, glsl, mirrored, unit, with_nan

from mi_refract import oracle
from mi_refract.accuracy import RayBounds, lengths
from mi_refract.formulas import FORMULAS
from mi_refract.ray_sets import header, judged_answers, ray_set, reports, tir_signal
from mi_refract.ray_sets.check_answers import LOOSEST, check
from mi_refract.ray_sets.judged_answers import RIGHT
from mi_refract.ray_sets.ray_set import Answers, RaySet
from mi_refract.ray_sets.tir_signal import SeenAnswers
from mi_refract.regimes import Rays
from validation.suite import small_mistakes

PRECISIONS = list(ray_set.PRECISIONS)
COUNT = 40
LARGE = {"k ≫ 1", "critical, any k, to the ulp", "axes, signed zeros", "denormal"}  # regimes with ratios far above 1


@functools.cache
def some(precision="f32", names=ray_set.DEFAULT, count=COUNT, two_sided=False):
    return ray_set.make(names, count, precision, 4, two_sided=two_sided)


def answered(to, program, dtype=None):
    """What a program that computes in `dtype` says, every number of it."""
    dtype = dtype or to.rays.a.dtype
    with np.errstate(all="ignore"):
        b = program(*(getattr(to.rays, name).astype(dtype) for name in "ank"))
    assert b.dtype == dtype
    return Answers(to.ids, b.astype(np.float64))


def changed(answers, rows, b):
    new = answers.b.copy()
    new[rows] = b
    return Answers(answers.ids, new, answers.transmitted)


def certified(to):
    return oracle.refract(to.rays.a, to.rays.n, to.rays.k, fresnel=False, progress=False)


@functools.cache
def exact(precision, names=ray_set.DEFAULT):
    """The certified answers in the set's precision, as long as a; mirror directions where nothing is transmitted."""
    to = some(precision, names)
    found = certified(to)
    wide = (found.direction + found.direction_low.astype(np.longdouble)) * lengths(to.rays.a)[:, None]
    return found, Answers(to.ids, wide.astype(ray_set.PRECISIONS[precision]).astype(np.float64))


def across(b, n):
    """Unit vectors out of the plane of incidence."""
    v = np.cross(b, n)
    return v / lengths(v).astype(float)[:, None]


# What is right


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("tir", GOOD)
def test_the_textbook_passes_with_every_signal(precision, tir):
    to = some(precision)
    answers = answered(to, GOOD[tir])
    for declared in ("auto", tir):
        found = check(to, answers, tir=declared)
        assert (found.exit_code, found.wrong, found.problems, found.explanations) == (0, 0, (), ())
        assert (found.tir, found.tir_given) == (tir, declared != "auto")
        assert [regime.regime for regime in found.regimes] == list(ray_set.DEFAULT)
    assert found.total("exact") < found.answered == len(to)  # it is not exact, and it is not called so
    strict = check(to, answers, error_bound="promoted")
    assert strict.exit_code == 1 and strict.wrong == found.answered - found.total("exact")


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("names", [ray_set.DEFAULT, ("lengths", "off unit", "tangential", "exactly critical")])
def test_the_exact_answers_are_exact(precision, names):
    to, (known, answers) = some(precision, names), exact(precision, names)
    for budget in (LOOSEST, "promoted"):
        found = check(to, answers, error_bound=budget)
        assert (found.exit_code, found.total("tir_misclassified")) == (0, 0)
        assert found.total("exact") == found.answered == len(to)
        assert max(regime.worst for regime in found.regimes) <= found.ulp
    for kind in (bool, np.uint8, float):
        flagged = check(to, Answers(to.ids, answers.b, known.transmitted.astype(kind)))
        assert (flagged.exit_code, flagged.tir, flagged.wrong) == (0, "flag", 0)
    if precision == "f32":  # the shortest decimals, read as float64, are up to half an ulp off
        printed = np.array([[float(str(x)) for x in row] for row in answers.b.astype(np.float32)])
        assert (printed != answers.b).any() and check(to, Answers(to.ids, printed), error_bound="promoted").wrong == 0


def test_figures_are_what_they_say():
    """A turn by a known angle in half of one regime; the worst ray is called by its id."""
    to, (known, answers) = some("f64"), exact("f64")
    rows = np.flatnonzero((to.regime == "generic") & known.transmitted)
    angle = np.linspace(1e-5, 1e-3, len(rows))[:, None]
    turned = 1.25 * (np.cos(angle) * answers.b[rows] + np.sin(angle) * across(answers.b[rows], to.rays.n[rows]))
    found = check(to, changed(answers, rows, turned))
    generic = found.regimes[0]
    compared = np.concatenate([angle.ravel(), np.zeros(generic.compared - len(rows))])
    for value, expected in (
        (generic.worst, 1e-3),
        (generic.mean, compared.mean()),
        (generic.p99, np.quantile(compared, 0.99)),
        (generic.length_error, 0.25),
    ):
        assert value == pytest.approx(expected, rel=1e-6)
    assert generic.wrong == found.wrong == len(rows) and generic.exact == generic.rays - len(rows)
    worst = generic.replay["id"]
    assert worst in to.ids[rows] and found.ulp == 2.0**-52
    assert [float.fromhex(x) for x in generic.replay["a"]] == to.rays.a[worst].tolist()


def test_one_wrong_answer_is_enough_and_giving_up_before_the_critical_angle_is_seen():
    to = some()
    answers = answered(to, glsl)
    row = int(np.flatnonzero((to.regime == "Brewster") & answers.b.any(1))[7])
    found = check(to, changed(answers, row, answers.b[row] + [0, 2e-4, 0]))
    assert (found.exit_code, found.wrong, found.diagnosis) == (1, 1, None)
    assert found.regimes[ray_set.DEFAULT.index("Brewster")].replay["id"] == to.ids[row]
    to, (known, _) = some("f64"), exact("f64")
    rows = np.flatnonzero(known.transmitted & (known.cos_t < 1e-3) & (to.regime == "critical"))
    found = check(to, changed(answered(to, glsl), rows, 0))
    critical = found.regimes[ray_set.DEFAULT.index("critical")]
    assert critical.tir_beyond_bound >= len(rows) == critical.wrong > 0 and found.exit_code == 1


@pytest.mark.parametrize("program", [lambda b: b, lambda b: -b, lambda b: np.round(b, 3)])
def test_findings_depend_neither_on_the_pieces_nor_on_the_order(program):
    to = some(names=("generic", "critical", "grazing"))
    b, order = program(answered(to, glsl).b), np.random.default_rng(1).permutation(len(to))
    one, other = (reports.as_data(check(to, Answers(order, b[order]), piece=size)) for size in (1000, 7))
    assert repr(one) == repr(other) == repr(reports.as_data(check(to, Answers(to.ids, b))))
    assert check(to, Answers(order, b)).diagnosis is None  # the answers of others


# Backward errors


@pytest.mark.parametrize("precision", PRECISIONS)
def test_the_textbook_is_right_but_where_k_is_large(precision):
    to = ray_set.make(count=200, precision=precision, seed=3)
    found, strict = (check(to, answered(to, glsl), most_backward=most) for most in (np.inf, RIGHT))
    assert found.exit_code == 0
    for regime in found.regimes:
        worst = max(regime.backward_worst, regime.backward_length)
        assert (worst > RIGHT) == (regime.right < regime.rays) == (regime.regime in LARGE)
        assert regime.backward_median <= regime.backward_p99 <= regime.backward_worst
    assert strict.exit_code == 1 and strict.wrong == found.answered - found.right
    assert {regime.regime for regime in strict.regimes if regime.wrong} == LARGE


def test_where_k_is_large_the_sine_is_lost_in_1_minus_c_squared():
    """sin²θ_i from 1 − c² is off by u, and the radicand by k² u; from |n × a|² by u sin²θ_i. That is all of it."""
    to = ray_set.make(["k ≫ 1"], 500, "f32", 3)

    def by(sine_squared):
        def answer(a, n, k):
            k, c = k[:, None], dot(n, a)
            radicand = 1 - k * k * sine_squared(a, n, c)
            return np.where(radicand < 0, 0, k * (a - c * n) - np.sqrt(np.maximum(radicand, 0)) * n)

        return check(to, answered(to, answer))

    lost, kept = by(lambda a, n, c: 1 - c * c), by(lambda a, n, c: (np.cross(n, a) ** 2).sum(1, keepdims=True))
    assert lost.right < 0.6 * lost.answered and lost.regimes[0].backward_worst > 100
    assert kept.right == kept.answered and kept.regimes[0].backward_worst < 1


def test_what_is_within_the_bound_and_not_right():
    """A formula that is not stable; a lost ray, and no direction, are exact for no input nearby."""
    to = ray_set.make(["k ≫ 1"], 500, "f32", 3)
    answers = answered(to, glsl)
    found = check(to, answers)
    assert (found.exit_code, reports.grade(found.regimes[0])) == (0, "within bound")
    assert found.right < found.answered and check(to, answers, most_backward=RIGHT).exit_code == 1
    to = ray_set.make(["generic"], 500, "f32", 3)
    assert check(to, answered(to, lambda a, n, k: small_mistakes.tilted(a, n, k[:, None]))).wrong > 10
    answers = answered(to, glsl)
    rows = np.flatnonzero(answers.b.any(axis=1))[:50]
    for value, wrong in ((0.0, 1), (np.nan, 50)):
        (regime,) = check(to, changed(answers, rows[:wrong], value), tir="zero").regimes
        assert regime.right == regime.rays - wrong
        assert regime.backward_worst == np.inf if wrong == 50 else 1e3 < regime.backward_worst < np.inf


# Mistakes

CASES = [("f32", name, i) for name, makers in BAD.items() for i in range(len(makers))]
CASES += [("f64", name, 0) for name in BAD]


@pytest.mark.parametrize("precision, name, i", CASES)
def test_a_mistake_is_called_by_its_name(precision, name, i):
    found = check(some(precision), answered(some(precision), BAD[name][i]))
    assert found.exit_code == 1
    assert found.diagnosis is not None, found.explanations
    assert found.diagnosis.mistake == name
    assert [x.mistake for x in found.explanations] == [*BAD, "f32 where f64 was claimed", "too few digits"]


@pytest.mark.parametrize("precision", PRECISIONS)
def test_code_for_normals_that_face_the_ray_and_for_unit_vectors(precision):
    to = some(precision, two_sided=True)
    assert check(to, answered(to, glsl)).diagnosis.text == "n was taken to face the ray, where it does not"
    assert check(to, answered(to, programs.two_sided)).exit_code == 0
    to = some("f64", ("lengths",), 300)
    assert check(to, answered(to, glsl)).diagnosis.text == "a and n were taken for unit vectors"
    assert check(to, answered(to, programs.with_normals_made_unit)).exit_code == 0


def test_float32_where_float64_was_claimed():
    """Errors of its inputs and its formula at once: 2 u in the bound. A turn by less of the bound is float32."""
    assert check(some("f64"), answered(some("f64"), glsl, np.float32)).diagnosis.mistake == "f32 where f64 was claimed"
    loose = exact("f64")[1]
    longer = check(some("f64"), Answers(loose.ids, loose.b * (1 + 1e-11)))
    assert longer.diagnosis.mistake == "missing normalisation"
    to, (known, answers) = some("f64", ("generic",)), exact("f64", ("generic",))
    rows = np.flatnonzero(known.transmitted)
    bound = FORMULAS[LOOSEST].budget.chord(2 * 2.0**-24, to.rays.k, known.cos_t, cos_i=known.cos_i)[rows]
    for share, mistake in ((0.8, "f32 where f64 was claimed"), (1.3, None)):
        off = (share * bound)[:, None]
        b = (answers.b[rows] + off * across(answers.b[rows], to.rays.n[rows])) / np.hypot(1, off)
        diagnosis = check(to, changed(answers, rows, b)).diagnosis
        assert (diagnosis and diagnosis.mistake) == mistake


@pytest.mark.parametrize("precision, digits", [("f32", 4), ("f32", 6), ("f64", 6), ("f64", 12)])
@pytest.mark.parametrize("form, word", [("f", "decimals"), ("g", "significant digits")])
def test_too_few_digits(precision, digits, form, word):
    to = some(precision, count=150)
    printed = np.array([[float(f"{x:.{digits}{form}}") for x in row] for row in answered(to, glsl).b.tolist()])
    found = check(to, Answers(to.ids, printed))
    assert (found.exit_code, found.diagnosis.mistake) == (1, "too few digits")
    assert found.diagnosis.text == f"numbers are rounded to {digits} {word}"


def test_what_names_no_mistake():
    """Nothing visible at normal incidence; fewer than ten wrong answers; two mistakes at once; noise."""
    to = some("f64", ("near-normal",))
    found = check(to, changed(answered(to, glsl), slice(3), [0, 1, 0]))
    shares = {x.mistake: x.share for x in found.explanations}
    assert (found.wrong, found.diagnosis) == (3, None)
    assert shares["eta inverted"] == shares["an index ignored"] == shares["degrees and radians"] == 0
    to = some("f32", ("generic",))
    right, wrong = answered(to, glsl).b, answered(to, lambda a, n, k: -glsl(a, n, k)).b
    for count in (9, 10):
        rows = np.flatnonzero(right.any(1))[:count]
        found = check(to[np.isin(to.ids, rows)], Answers(to.ids[rows], wrong[rows]))
        assert found.wrong == count and (found.diagnosis is not None) == (count == 10)
    noise = np.random.default_rng(1).normal(size=some().rays.a.shape).astype(np.float32)
    for program in (lambda a, n, k: programs.swapped(glsl(a, n, 1 / k)), lambda a, n, k: unit(noise)):
        found = check(some(), answered(some(), program))
        assert (found.exit_code, found.diagnosis) == (1, None)


# Total internal reflection


def test_a_wrong_signal_and_several_signals_are_stated():
    answers = answered(some(), glsl)
    for tir in set(GOOD) - {"zero"}:
        found = check(some(), answers, tir=tir)
        assert (found.exit_code, found.tir, found.problems[0].kind) == (1, tir, "zero")
    with pytest.raises(ValueError, match="expected answers with a column `transmitted`"):
        check(some(), answers, tir="flag")
    mixed = changed(answers, np.flatnonzero(~exact("f32")[0].transmitted)[::2], np.nan)
    found = check(some(), mixed)
    assert (found.exit_code, found.tir) == (1, tir_signal.UNCLEAR)
    assert {problem.kind for problem in found.problems} == {"zero", "non-finite"}


def test_a_flag_goes_before_the_direction_and_a_mirror_direction_is_judged_too():
    to, (known, answers) = some("f64"), exact("f64")
    b = np.where(known.transmitted[:, None], answers.b, 7.0)
    assert check(to, Answers(to.ids, b, known.transmitted)).exit_code == 0
    found = check(to, Answers(to.ids, b, ~known.transmitted))
    assert (found.exit_code, found.total("tir_misclassified")) == (1, len(to))
    assert found.total("tir_beyond_bound") > 0.6 * len(to)
    to, (known, _) = some(), exact("f32")
    answers = answered(to, programs.with_mirror)
    row = int(np.flatnonzero(~known.transmitted & (to.regime == "k ≫ 1"))[0])
    found = check(to, changed(answers, row, answers.b[row] + [0, 1e-3, 0]))
    assert (found.exit_code, found.wrong) == (1, 1)


def test_no_ray_with_total_internal_reflection():
    to = some("f32", ("k ≪ 1", "near-normal"))
    answers = answered(to, glsl)
    assert check(to, answers).tir == tir_signal.NONE
    for b, kind in ((np.nan, "non-finite"), (0, "zero"), (np.inf, "non-finite")):
        found = check(to, changed(answers, [3, 5], b))
        assert (found.exit_code, found.wrong) == (1, 2)
        assert [(x.kind, x.count, x.text) for x in found.problems] == [(kind, 2, "ids 3, 5")]


@pytest.mark.parametrize("value", [np.nan, 0.0])
def test_answers_to_ambiguous_rays_alone_are_no_pass(value):
    for regime in ("exactly critical", "tangential"):
        to = some("f32", (regime,))
        found = check(to, Answers(to.ids, np.full((len(to), 3), value)))
        assert (found.exit_code, found.total("compared"), found.wrong) == (1, 0, 0)
    found = check(some(), Answers(some().ids, np.full((len(some()), 3), value)))  # nor to all rays
    assert found.exit_code == 1 and found.wrong > found.answered / 2


@pytest.mark.parametrize("precision", PRECISIONS)
def test_next_to_the_surface_total_reflection_is_decided_all_the_same(precision):
    """Cosines of 1e-4, of either angle: far from all that rounding excuses, |n·a| ≤ 4 u and |radicand| ≤ 14 u k²."""
    dtype, u = ray_set.PRECISIONS[precision], float(np.finfo(ray_set.PRECISIONS[precision]).eps) / 2
    near = 1e-4 if precision == "f64" else 4e-3  # cos θ_t: its square is the radicand
    assert near**2 > 2 * 14 * u * 1.5**2
    grazing, critical = np.sqrt(1 - 1e-8), np.sqrt(1 + np.array([-1, 1]) * near**2) / 1.5
    sine, k = np.array([grazing, grazing, *critical]), np.array([0.5, 1.5, 1.5, 1.5])
    cosine = np.array([1e-4, 1e-4, *np.sqrt(1 - critical**2)])
    a = np.stack([sine, 0 * sine, -cosine], 1).astype(dtype)
    rays = Rays(a, np.tile(np.array([[0, 0, 1]], dtype), (4, 1)), k.astype(dtype))
    to = RaySet(rays, np.arange(4), {"precision": precision, "regimes": {"x": [0, 3]}, "checksum": ""})
    known = certified(to)
    assert known.transmitted.tolist() == [True, False, True, False]
    assert check(to, Answers(to.ids, known.direction, known.transmitted)).wrong == 0
    for called in (np.ones(4, bool), np.zeros(4, bool)):
        assert check(to, Answers(to.ids, known.direction, called)).total("tir_beyond_bound") == 2


ZERO, ALONG = [0.0, 0, 0], [1.0, 0, 0]


def seen(radicands, b=None):
    """Answers to rays in float64: 1 − k² sin² θ is each of the radicands, negative under total internal reflection."""
    sin, k = np.sqrt(1 - np.asarray(radicands)) / 1.4, np.full(len(radicands), 1.4)
    a = np.stack([sin, 0 * sin, -np.sqrt(1 - sin**2)], 1)
    rays = Rays(a, np.tile([0.0, 0.0, 1.0], (len(sin), 1)), k)
    known = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    return SeenAnswers(a if b is None else np.array(b), rays, known, 2.0**-53)


@pytest.mark.parametrize(
    ("radicands", "b", "signal"),
    [
        ([-0.5] * 4 + [-1e-4] * 6, [ZERO] * 4 + [ALONG] * 6, "zero"),  # far from the critical angle, four decide
        ([-1e-4] * 10, [ZERO] * 10, "zero"),  # where none is far, all decide
        ([-0.5] * 10, [ZERO] * 9 + [ALONG], "zero"),
        ([-0.5] * 10, [ZERO] * 8 + [ALONG] * 2, tir_signal.UNCLEAR),
        ([0.5] * 10, [ZERO] * 10, tir_signal.NONE),
        ([-1e-16] * 9 + [1e-16], [ALONG] * 6 + [ZERO] * 4, "zero"),  # in doubt some are transmitted, along the surface
        ([-1e-16] * 10, [ALONG] * 10, "tangent"),
        ([-1e-16] * 10, [ZERO] * 5 + [[np.nan] * 3] * 5, tir_signal.UNCLEAR),
    ],
)
def test_the_signal_that_most_rays_agree_on(radicands, b, signal):
    for size in (3, 10):
        assert tir_signal.detect(seen(radicands[i : i + size], b[i : i + size]) for i in range(0, 10, size)) == signal


@pytest.mark.parametrize("length", [1 / 3, 1.0, 3.0])
def test_a_mirror_direction_is_one_at_any_length(length):
    """Also of transmitted rays the answer is along the refracted direction at any length."""
    answers = seen([-0.5, -0.2, 0.3, 0.6])
    b = length * np.where(answers.exact.transmitted[:, None], answers.exact.direction, answers.rays.a * [1, 1, -1])
    called = tir_signal.reflected(seen([-0.5, -0.2, 0.3, 0.6], b), None, "reflected", np.ones(4, bool))
    assert called.tolist() == [True] * 2 + [False] * 2


# Where rounding may have changed a direction beyond recognition ----------------------------------------------------


@functools.cache
def steep():
    """Rays, the certified answers, and those whose bound is beyond a half turn, which are half of the transmitted."""
    to = ray_set.make(("k ≫ 1", "generic"), 300, seed=4)
    known = certified(to)
    return to, known, (to.rays.k > 3000) & known.transmitted


def turned(v, n, angle):
    """`v` turned about n, which is unit."""
    return np.cos(angle) * v + np.sin(angle) * np.cross(n, v) + (1 - np.cos(angle)) * dot(n, v) * n


def tangent(a, n):
    return unit(a - dot(a, n) * n)


GARBAGE = {
    "along the surface": lambda rng, a, n, b: turned(tangent(a, n), n, rng.uniform(0.5, 5, (len(a), 1))),
    "a random direction": lambda rng, a, n, b: unit(rng.normal(size=a.shape)),
    "backward along the surface": lambda rng, a, n, b: -tangent(a, n),
    "turned about the normal": lambda rng, a, n, b: turned(b, n, 0.5),
    "the way that it came": lambda rng, a, n, b: -a,
    "back from the surface": lambda rng, a, n, b: b - 2 * dot(b, n) * n,
}


@pytest.mark.parametrize("tir", GOOD)
def test_where_the_bound_is_beyond_a_half_turn_the_textbook_passes_and_garbage_does_not(tir):
    """Of a random direction a few are possible; next to k sinθ = 0 all angles about the normal are."""
    to, known, lost = steep()
    b = answered(to, GOOD[tir]).b
    directions = b.any(1, keepdims=True)
    for right in (b, np.where(directions, unit(np.where(directions, b, 1)), 0)):
        found = check(to, Answers(to.ids, right), tir=tir)
        assert (found.exit_code, found.problems) == (0, ())
    a, n = (unit(v[lost].astype(float)) for v in (to.rays.a, to.rays.n))
    for garbage in GARBAGE.values():
        b[lost] = garbage(np.random.default_rng(1), a, n, known.direction[lost])
        found = check(to, Answers(to.ids, b), tir=tir)
        assert found.exit_code == 1
        assert found.problem_count("impossible") == found.wrong >= 0.5 * lost.sum()


def test_undecidable_rays_are_counted_and_alone_are_no_pass():
    to, known, lost = steep()
    found = check(to, answered(to, glsl))
    wide, generic = found.regimes
    assert (generic.undecidable, generic.judged) == (0, generic.compared)
    assert lost.sum() <= wide.undecidable < wide.rays >= wide.judged + wide.undecidable
    assert f"; {wide.undecidable} rays are undecidable (error bound above 0.1 rad)" in reports.sentence(found)
    found = check(to[lost], Answers(to.ids[lost], known.direction[lost]))
    assert (found.exit_code, found.wrong, found.total("judged")) == (1, 0, 0) and found.total("compared") > 0
    assert "none of them a decidable direction" in reports.sentence(found)


def bounds_of(to):
    known = certified(to)
    return known, RayBounds(to.rays, known, FORMULAS[LOOSEST].budget, to.roundoff, normalised=True)


def test_only_right_answers_are_possible_where_the_bound_is_tight():
    """In float64 and far from the critical angle no other direction is, however the answer is long."""
    to = ray_set.make(("generic", "k ≪ 1", "critical"), 60, "f64", 4)
    a, n = to.rays.a, to.rays.n
    known, bounds = bounds_of(to)
    for signal, b, asked in (
        ("", 3 * known.direction, known.transmitted),
        ("tangent", 3 * tangent(a, n), ~known.transmitted),
        ("reflected", 3 * mirrored(a, n, 1), ~known.transmitted),
    ):
        some = np.flatnonzero(asked & (bounds.chord < 1e-9))
        assert len(some) > 20 and judged_answers.possible(b, bounds, some, signal).all()
        off_normal = [b + 1e-6 * n] if signal != "tangent" else []
        for wrong in (-b, b + 1e-6 * np.cross(a, n), turned(b, n, 1e-6), *off_normal):
            assert not judged_answers.possible(wrong, bounds, some, signal).any()


@pytest.mark.parametrize("tir", ["reflected", "tangent"])
def test_a_direction_that_signals_total_reflection_is_in_the_plane_of_incidence(tir):
    """Tangents and mirror directions turned about the normal, next to the critical angle."""
    to = ray_set.make(("critical, to the ulp",), 200, "f64", 4)
    b = mirrored(to.rays.a, to.rays.n, 1) if tir == "reflected" else tangent(to.rays.a, to.rays.n)
    assert check(to, Answers(to.ids, b), tir=tir).wrong == 0  # so near to the critical angle any ray may be reflected
    assert len(set(certified(to).transmitted)) == 2
    found = check(to, Answers(to.ids, turned(b, to.rays.n, 0.1)), tir=tir)
    assert (found.exit_code, found.wrong) == (1, len(to))


def test_a_direction_may_be_turned_about_the_normal_by_the_slack_of_its_part_along_the_surface():
    """cos θ between 0.3 and 0.7, so that none of its powers are alike: by L u of the answer, and not by 1.03 L u."""
    to = ray_set.make(("generic",), 800, "f32", 4)
    known, bounds = bounds_of(to)
    some = np.flatnonzero(known.transmitted & (known.cos_t > 0.3) & (known.cos_t < 0.7) & (bounds.chord < 1e-5))
    assert len(some) > 20
    slack = bounds.budget.of_terms(bounds.u, bounds.k) / np.sqrt(1 - known.cos_t**2)
    for share, accepted in ((0.97, True), (1.03, False)):
        b = turned(known.direction, unit(to.rays.n.astype(float)), share * slack[:, None])
        assert (judged_answers.possible(b, bounds, some) == accepted).all()


@pytest.mark.parametrize("precision", PRECISIONS)
def test_vectors_off_unit_excuse_no_more_than_making_them_unit_costs(precision):
    """1000 u across the plane of incidence, where 3 u of the vectors allow 10 · 3 u and less than 14 · 3 u k²."""
    to, (known, answers) = some(precision, ("lengths",)), exact(precision, ("lengths",))
    rows = np.flatnonzero(known.transmitted & (to.rays.k < 2) & (known.cos_t > 0.5))
    off = 1000 * to.roundoff * lengths(answers.b[rows]).astype(float)[:, None]
    assert len(rows) > 5
    moved = answers.b[rows] + off * across(answers.b[rows], to.rays.n[rows])
    assert check(to, changed(answers, rows, moved)).wrong == len(rows)
    u, k = 2.0**-24, np.geomspace(1e-3, 1e6, 50)
    bounds = {name: formula.budget.chord(u, k) for name, formula in FORMULAS.items()}
    assert all((bound <= bounds[LOOSEST]).all() for bound in bounds.values())


# Every mistake, and every sound program -------------------------------------------------------------------------------

TURN = 1e-5


def only(mask, mistake, program=glsl):
    """The program, and the mistake where `mask(a, n, k)` (N,) holds."""
    return lambda a, n, k: np.where(mask(a, n, k)[:, None], mistake(a, n, k), program(a, n, k))


def every(period, value):
    return lambda a, n, k: np.where((np.arange(len(k)) % period == 0)[:, None], a.dtype.type(value), glsl(a, n, k))


def out_of_plane(a, n, k):
    b, w = glsl(a, n, k), np.cross(n, a)
    return (b + TURN * b.any(1, keepdims=True) * w / np.maximum(np.sqrt(dot(w, w)), 1e-30)).astype(a.dtype)


def minus_zero(a, n, k):
    return ((n == 0) & np.signbit(n)).any(1)


def in_half(program):
    return lambda a, n, k: program(*(v.astype(np.float16).astype(v.dtype) for v in (a, n)), k)


def bent(rule):
    """GLSL's, with another radicand."""

    def answer(a, n, k):
        k, c = k[:, None], dot(n, a)
        radicand = rule(1 - k * k * (1 - c * c), k)
        return np.where(radicand < 0, 0, k * a - (k * c + np.sqrt(np.maximum(radicand, 0))) * n).astype(a.dtype)

    return answer


WRONG = {
    "normal's sign, k < 1 only": only(lambda a, n, k: k < 1, lambda a, n, k: glsl(a, -n, k)),
    "eta inverted, k < 1 only": only(lambda a, n, k: k < 1, lambda a, n, k: glsl(a, n, 1 / k)),
    "eta inverted, k > 1 only": only(lambda a, n, k: k > 1, lambda a, n, k: glsl(a, n, 1 / k)),
    "k² for k": lambda a, n, k: glsl(a, n, k * k),
    "inputs in float16": in_half(glsl),
    "NaN for some": every(50, np.nan),
    "infinity for some": every(50, np.inf),
    "zero for some": every(50, 0),
    "zero for all": every(1, 0),
    "one direction for all": every(1, 0.5),
    "the answer to the next ray": lambda a, n, k: np.roll(glsl(a, n, k), 1, 0),
    "the answers in reverse": lambda a, n, k: glsl(a, n, k)[::-1],
    "axes swapped for n_z > 0.9": only(lambda a, n, k: n[:, 2] > 0.9, lambda a, n, k: programs.swapped(glsl(a, n, k))),
    "wrong on negative zero": only(minus_zero, mirrored),
    "straight on under total reflection": bent(lambda radicand, k: np.abs(radicand)),
    "total reflection too early": bent(lambda radicand, k: radicand - k * k * radicand.dtype.type(1e-4)),
    "two signals": lambda a, n, k: np.where((np.arange(len(k)) % 2 == 0)[:, None], with_nan(a, n, k), glsl(a, n, k)),
    "an unknown signal": lambda a, n, k: np.where(glsl(a, n, k).any(1, keepdims=True), glsl(a, n, k), a),
    "1.001 times as long": lambda a, n, k: 1.001 * glsl(a, n, k),
}
ONE_REGIME = {
    "turned by 1e-5 out of the plane of incidence": out_of_plane,
    "four decimals": lambda a, n, k: np.round(glsl(a, n, k), 4),
    "axes swapped": lambda a, n, k: programs.swapped(glsl(a, n, k)),
    "the other side": lambda a, n, k: glsl(a, n, k) - 2 * dot(n, glsl(a, n, k)) * n,
}


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", WRONG)
def test_no_wrong_program_passes(precision, name):
    assert check(some(precision), answered(some(precision), WRONG[name])).exit_code == 1


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", ONE_REGIME)
def test_no_program_passes_that_is_wrong_in_one_regime_only(precision, name):
    to = some(precision)
    right, wrong = answered(to, glsl), answered(to, ONE_REGIME[name])
    for regime in ray_set.DEFAULT:
        rows = np.flatnonzero(to.regime == regime)
        found = check(to, changed(right, rows, wrong.b[rows]))
        assert (found.exit_code, [x.regime for x in found.regimes if x.wrong]) == (1, [regime]), regime


@pytest.mark.parametrize(
    ("least", "length", "limit", "wrong"),  # wrong: in which regime
    [
        (0, 1 + 1e-5, np.inf, "critical, to the ulp"),  # where the angle may be off by 1e-3
        (1e3, 1.5, np.inf, ""),  # so far a textbook's formula may be off
        (1e3, 1.5, RIGHT, "k ≫ 1"),
        (1e5, 40, RIGHT, "k ≫ 1"),
        (0, 1 + 1e-7, RIGHT, ""),
    ],
)
def test_a_length_is_judged_by_itself(least, length, limit, wrong):
    to, (known, exact_answers) = some(), exact("f32")
    off = (to.rays.k > least) & known.transmitted & exact_answers.b.any(1)
    b = np.where(off[:, None], length, 1) * exact_answers.b
    found = check(to, Answers(to.ids, b), tir="reflected", most_backward=limit)
    assert found.exit_code == bool(wrong) and (found.right < found.answered) == (length > 1 + 1e-6)
    assert not wrong or wrong in {regime.regime for regime in found.regimes if regime.wrong}


SOUND = (
    GOOD | programs.FORMULAS | {f"{name}, made unit": programs.made_unit(f) for name, f in programs.FORMULAS.items()}
)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", SOUND)
def test_every_sound_program_passes(precision, name):
    """In the set's precision and in float64; also on each regime alone, if it has directions to judge."""
    for dtype in (None, np.float64):
        assert check(some(precision), answered(some(precision), SOUND[name], dtype)).exit_code == 0
    for regime in (*ray_set.DEFAULT, "exactly critical"):
        to = some(precision, (regime,), 60)
        found = check(to, answered(to, lambda a, n, k: SOUND[name](unit(a), unit(n), k)))
        assert found.exit_code == 0, regime


# Answers that are not those to the rays ------------------------------------------------------------------------------


@given(st.lists(st.integers(-9, 40), max_size=90), st.integers(1, 30))
def test_missing_duplicate_and_unknown_answers_and_the_first_one_counts(ids, count):
    to = some("f32", ("near-normal",), 40)[np.arange(40) < count]
    right = answered(some("f32", ("near-normal",), 40), glsl).b
    first = [i not in ids[:row] for row, i in enumerate(ids)]
    b = np.array([right[i] if 0 <= i < 40 and first[row] else [0, 0, 1] for row, i in enumerate(ids)]).reshape(-1, 3)
    found = check(to, Answers(np.array(ids, int), b))
    expected = {
        "missing": [i for i in range(count) if i not in ids],
        "duplicate": sorted({i for i in ids if ids.count(i) > 1}),
        "unknown": sorted({i for i in ids if not 0 <= i < count}),
    }
    said = {
        x.kind: (x.count, [int(i) for i in x.text.removesuffix(", …").split(" ", 1)[1].split(", ")])
        for x in found.problems
    }
    assert said == {kind: (len(of), of[:5]) for kind, of in expected.items() if of}
    assert found.answered == count - len(expected["missing"])
    assert (found.exit_code == 2) == bool(said or not ids) and found.wrong == 0


@pytest.mark.parametrize(
    "work, message",
    [
        (lambda to, b: check(to, Answers(to.ids, b), tir="zeros"), "TIR signal 'zeros': unknown; expected auto, zero"),
        (lambda to, b: check(to, Answers(to.ids, b), error_bound="x"), "error bound 'x': unknown; expected wedge"),
        *(
            (lambda to, b, x=x: check(to, Answers(to.ids, b), most_backward=x), "expected a positive number of round")
            for x in (0.0, np.nan)
        ),
        (lambda to, b: check(to, Answers(to.ids, b, header={"checksum": "x"})), "the answers are to rays with the ch"),
        (lambda to, b: Answers(to.ids, b[1:]), "expected a direction for each id"),
        (lambda to, b: Answers(to.ids, b, n_ratio=np.ones(2)), "expected a direction for each id"),
        (lambda to, b: Answers(to.ids, b, np.full(len(b), 2)), "^answers: transmitted is 2; expected 0 or 1$"),
    ],
)
def test_invalid_options_and_answers(work, message):
    to, (_, answers) = some(), exact("f32")
    assert check(to, Answers(to.ids, answers.b, header=to.header)).exit_code == 0
    with pytest.raises(ValueError, match=message):
        work(to, answers.b)


# The ratio of indices that was used ----------------------------------------------------------------------------------


def off(rays, factor, rows=slice(None)):
    """The ratios of a program whose glass is another, in the set's precision."""
    k = rays.rays.k.copy()
    k[rows] *= k.dtype.type(factor)
    return k


@pytest.mark.parametrize("precision", PRECISIONS)
def test_another_index_is_no_wrong_direction_and_another_direction_no_wrong_index(precision):
    """Without the column, all directions seem wrong."""
    rays = ray_set.make(("generic", "critical", "grazing"), 60, precision, 2, **media_rays.ALL)
    say = functools.partial(media_rays.answered, rays)
    found = check(rays, say())
    assert (found.exit_code, found.wrong, found.problems, found.ratio.largest) == (0, 0, (), 0)
    assert check(rays, say(said=False)).ratio is None
    k = off(rays, 1 + 3e-4)
    found, without = check(rays, say(k)), check(rays, say(k, said=False))
    assert (found.exit_code, found.wrong, found.problem_count("index")) == (1, 0, len(rays))
    assert found.ratio.largest == pytest.approx(3e-4, rel=1e-3)
    assert reports.sentence(found).startswith(f"{len(rays)} answers, all right; ")
    assert reports.sentence(found).endswith(f"; {len(rays)} answers are for a different ratio of indices")
    assert without.exit_code == 1 and without.wrong > len(rays) / 3 and not without.problem_count("index")
    found = check(rays, say(direction=1 / rays.rays.k))
    assert (found.exit_code, found.diagnosis.mistake) == (1, "eta inverted")
    assert found.ratio.largest == 0 and not found.problem_count("index")
    both = check(rays, say(off(rays, 1.01), direction=1 / off(rays, 1.01)))
    assert "are wrong: eta inverted; 180 answers are for a different" in reports.sentence(both)
    k = off(rays, 1 + 1e-3, [4, 70])
    k[70] *= k.dtype.type(1 - 5e-3)
    found = check(rays, say(k))
    assert (found.ratio.id, found.ratio.ray) == (70, header.described(rays.header, 70))
    (line,) = reports.ratio(found)
    assert f"(id 70, {found.ratio.ray}); up to 1e-5 counts as equal" in line
    assert "2 answers used a different ratio of indices (n_ratio): ids 4, 70" in map(
        reports.problem_text, found.problems
    )


ULP = {precision: float(np.finfo(dtype).eps) for precision, dtype in ray_set.PRECISIONS.items()}
FACTORS = [("f64", media_rays.ALL, 1 + x, abs(x) > 1e-5) for x in (9e-6, -9e-6, 1.1e-5, -1.1e-5)]
FACTORS += [(name, {}, 1 + ulps * ULP[name], ulps > 4) for name in ULP for ulps in (3, 5)]
FACTORS += [(name, {}, factor, True) for name in ULP for factor in (1e-9, 1e9)]


@pytest.mark.parametrize(("precision", "of_media", "factor", "counts"), FACTORS)
def test_a_maker_s_five_decimals_leave_some_open_and_a_ratio_in_the_file_nothing_but_rounding(
    precision, of_media, factor, counts
):
    rays = ray_set.make(["generic"], 12, precision, **of_media)
    given = dataclasses.replace(media_rays.answered(rays), n_ratio=rays.rays.k.astype(float) * factor)
    found = check(rays, given)
    assert bool(found.problem_count("index")) == counts and bool(found.ratio.ray) == bool(of_media)


def test_rays_are_certified_for_the_ratio_as_it_is_written():
    """In float64, also in a set of float32; and total internal reflection is that of the ratio used."""
    rays = ray_set.make(["generic", "critical"], 60, "f32", **media_rays.ALL)
    ratio = rays.rays.k.astype(float) * (1 + 4e-6)
    known = oracle.refract(*(getattr(rays.rays, x).astype(float) for x in "an"), ratio, fresnel=False, progress=False)
    found = check(rays, Answers(rays.ids, np.where(known.transmitted[:, None], known.direction, 0), n_ratio=ratio))
    assert (found.exit_code, found.total("exact")) == (0, len(rays))
    rays = ray_set.make(["critical"], 400, **media_rays.ALL)
    told, without = (
        check(rays, media_rays.answered(rays, off(rays, 1 + 1e-3), said=said), tir="zero") for said in (True, False)
    )
    assert (told.wrong, told.total("tir_beyond_bound")) == (0, 0) and without.total("tir_beyond_bound") > 20

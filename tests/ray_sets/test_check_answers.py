"""Right answers pass, and every planted mistake is detected and named."""

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
from mi_refract.ray_sets.tir_signal import ComparedAnswers
from mi_refract.regimes import Rays
from validation.suite import small_mistakes

PRECISIONS = list(ray_set.PRECISIONS)
COUNT = 40
LARGE = {"k ≫ 1", "critical, any k, to the ulp", "axes, signed zeros", "denormal"}  # regimes with ratios far above 1


@functools.cache
def standard_rays(precision="f32", names=ray_set.DEFAULT, count=COUNT, two_sided=False):
    return ray_set.make(names, count, precision, 4, two_sided=two_sided)


def answered(rays, program, dtype=None):
    """The answers of a program that computes in `dtype`, as float64."""
    dtype = dtype or rays.rays.a.dtype
    with np.errstate(all="ignore"):
        b = program(*(getattr(rays.rays, name).astype(dtype) for name in "ank"))
    assert b.dtype == dtype
    return Answers(rays.ids, b.astype(np.float64))


def changed(answers, rows, b):
    new = answers.b.copy()
    new[rows] = b
    return Answers(answers.ids, new, answers.transmitted)


def certified(rays):
    return oracle.refract(rays.rays.a, rays.rays.n, rays.rays.k, fresnel=False, progress=False)


@functools.cache
def exact(precision, names=ray_set.DEFAULT):
    """The certified answers in the set's precision, as long as `a`; mirror directions under total reflection."""
    rays = standard_rays(precision, names)
    known = certified(rays)
    wide = (known.direction + known.direction_low.astype(np.longdouble)) * lengths(rays.rays.a)[:, None]
    return known, Answers(rays.ids, wide.astype(ray_set.PRECISIONS[precision]).astype(np.float64))


def out_of_plane_units(b, n):
    """Unit vectors perpendicular to the plane of incidence."""
    v = np.cross(b, n)
    return v / lengths(v).astype(float)[:, None]


# Right answers


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("tir", GOOD)
def test_the_textbook_formula_passes_with_every_signal(precision, tir):
    rays = standard_rays(precision)
    answers = answered(rays, GOOD[tir])
    for declared in ("auto", tir):
        findings = check(rays, answers, tir=declared)
        assert (findings.exit_code, findings.wrong, findings.problems, findings.explanations) == (0, 0, (), ())
        assert (findings.tir, findings.tir_given) == (tir, declared != "auto")
        assert [regime.regime for regime in findings.regimes] == list(ray_set.DEFAULT)
    assert findings.total("exact") < findings.answered == len(rays)  # the formula is not reported as exact
    strict = check(rays, answers, error_bound="promoted")
    assert strict.exit_code == 1 and strict.wrong == findings.answered - findings.total("exact")


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("names", [ray_set.DEFAULT, ("lengths", "off unit", "tangential", "exactly critical")])
def test_the_exact_answers_are_exact(precision, names):
    rays, (known, answers) = standard_rays(precision, names), exact(precision, names)
    for budget in (LOOSEST, "promoted"):
        findings = check(rays, answers, error_bound=budget)
        assert (findings.exit_code, findings.total("tir_misclassified")) == (0, 0)
        assert findings.total("exact") == findings.answered == len(rays)
        assert max(regime.worst for regime in findings.regimes) <= findings.ulp
    for kind in (bool, np.uint8, float):
        flagged = check(rays, Answers(rays.ids, answers.b, known.transmitted.astype(kind)))
        assert (flagged.exit_code, flagged.tir, flagged.wrong) == (0, "flag", 0)
    if precision == "f32":  # the shortest decimals, read as float64, have errors of up to half an ulp
        printed = np.array([[float(str(x)) for x in row] for row in answers.b.astype(np.float32)])
        assert (printed != answers.b).any()
        assert check(rays, Answers(rays.ids, printed), error_bound="promoted").wrong == 0


def test_the_errors_of_a_regime_are_right():
    """Answers turned by known angles in half of one regime; `replay` contains the worst ray."""
    rays, (known, answers) = standard_rays("f64"), exact("f64")
    rows = np.flatnonzero((rays.regime == "generic") & known.transmitted)
    angle = np.linspace(1e-5, 1e-3, len(rows))[:, None]
    across = out_of_plane_units(answers.b[rows], rays.rays.n[rows])
    turned = 1.25 * (np.cos(angle) * answers.b[rows] + np.sin(angle) * across)
    findings = check(rays, changed(answers, rows, turned))
    generic = findings.regimes[0]
    compared = np.concatenate([angle.ravel(), np.zeros(generic.compared - len(rows))])
    errors = generic.worst, generic.mean, generic.p99, generic.length_error
    assert errors == pytest.approx((1e-3, compared.mean(), np.quantile(compared, 0.99), 0.25), rel=1e-6)
    assert generic.wrong == findings.wrong == len(rows) and generic.exact == generic.rays - len(rows)
    worst = generic.replay["id"]
    assert worst in rays.ids[rows] and findings.ulp == 2.0**-52
    assert [float.fromhex(x) for x in generic.replay["a"]] == rays.rays.a[worst].tolist()


def test_one_wrong_answer_fails_and_so_does_total_reflection_before_the_critical_angle():
    rays = standard_rays()
    answers = answered(rays, glsl)
    row = int(np.flatnonzero((rays.regime == "Brewster") & answers.b.any(1))[7])
    findings = check(rays, changed(answers, row, answers.b[row] + [0, 2e-4, 0]))
    assert (findings.exit_code, findings.wrong, findings.diagnosis) == (1, 1, None)
    assert findings.regimes[ray_set.DEFAULT.index("Brewster")].replay["id"] == rays.ids[row]
    rays, (known, _) = standard_rays("f64"), exact("f64")
    rows = np.flatnonzero(known.transmitted & (known.cos_t < 1e-3) & (rays.regime == "critical"))
    findings = check(rays, changed(answered(rays, glsl), rows, 0))
    critical = findings.regimes[ray_set.DEFAULT.index("critical")]
    assert critical.tir_beyond_bound >= len(rows) == critical.wrong > 0 and findings.exit_code == 1


@pytest.mark.parametrize("program", [lambda b: b, lambda b: -b, lambda b: np.round(b, 3)])
def test_findings_do_not_depend_on_pieces_or_order(program):
    rays = standard_rays(names=("generic", "critical", "grazing"))
    b, order = program(answered(rays, glsl).b), np.random.default_rng(1).permutation(len(rays))
    large_pieces, small_pieces = (
        reports.as_data(check(rays, Answers(order, b[order]), piece=size)) for size in (1000, 7)
    )
    assert repr(large_pieces) == repr(small_pieces) == repr(reports.as_data(check(rays, Answers(rays.ids, b))))
    assert check(rays, Answers(order, b)).diagnosis is None  # answers with the wrong ids


# Backward errors


@pytest.mark.parametrize("precision", PRECISIONS)
def test_the_textbook_formula_is_right_unless_k_is_large(precision):
    rays = ray_set.make(count=200, precision=precision, seed=3)
    findings, strict = (check(rays, answered(rays, glsl), most_backward=most) for most in (np.inf, RIGHT))
    assert findings.exit_code == 0
    for regime in findings.regimes:
        worst = max(regime.backward_worst, regime.backward_length)
        assert (worst > RIGHT) == (regime.right < regime.rays) == (regime.regime in LARGE)
        assert regime.backward_median <= regime.backward_p99 <= regime.backward_worst
    assert strict.exit_code == 1 and strict.wrong == findings.answered - findings.right
    assert {regime.regime for regime in strict.regimes if regime.wrong} == LARGE


def test_for_large_k_the_textbook_formula_loses_the_sine_in_1_minus_c_squared():
    """sin²θ_i from 1 − c² has an error of u, so the radicand one of k² u; from |n × a|² the error is u sin²θ_i only."""
    rays = ray_set.make(["k ≫ 1"], 500, "f32", 3)

    def findings_of(sine_squared):
        def answer(a, n, k):
            k, c = k[:, None], dot(n, a)
            radicand = 1 - k * k * sine_squared(a, n, c)
            return np.where(radicand < 0, 0, k * (a - c * n) - np.sqrt(np.maximum(radicand, 0)) * n)

        return check(rays, answered(rays, answer))

    textbook = findings_of(lambda a, n, c: 1 - c * c)
    stable = findings_of(lambda a, n, c: (np.cross(n, a) ** 2).sum(1, keepdims=True))
    assert textbook.right < 0.6 * textbook.answered and textbook.regimes[0].backward_worst > 100
    assert stable.right == stable.answered and stable.regimes[0].backward_worst < 1


def test_answers_within_the_bound_that_are_not_right():
    """An unstable formula; and zero or NaN in place of a direction, which are exact for no input nearby."""
    rays = ray_set.make(["k ≫ 1"], 500, "f32", 3)
    answers = answered(rays, glsl)
    findings = check(rays, answers)
    assert (findings.exit_code, reports.grade(findings.regimes[0])) == (0, "within bound")
    assert findings.right < findings.answered and check(rays, answers, most_backward=RIGHT).exit_code == 1
    rays = ray_set.make(["generic"], 500, "f32", 3)
    assert check(rays, answered(rays, lambda a, n, k: small_mistakes.tilted(a, n, k[:, None]))).wrong > 10
    answers = answered(rays, glsl)
    rows = np.flatnonzero(answers.b.any(axis=1))[:50]
    for value, wrong in ((0.0, 1), (np.nan, 50)):
        (regime,) = check(rays, changed(answers, rows[:wrong], value), tir="zero").regimes
        assert regime.right == regime.rays - wrong
        assert regime.backward_worst == np.inf if wrong == 50 else 1e3 < regime.backward_worst < np.inf


# Mistakes

CASES = [("f32", name, i) for name, makers in BAD.items() for i in range(len(makers))]
CASES += [("f64", name, 0) for name in BAD]


@pytest.mark.parametrize("precision, name, i", CASES)
def test_the_diagnosis_names_the_mistake(precision, name, i):
    findings = check(standard_rays(precision), answered(standard_rays(precision), BAD[name][i]))
    assert findings.exit_code == 1
    assert findings.diagnosis is not None, findings.explanations
    assert findings.diagnosis.mistake == name
    lost = ["f32 where f64 was claimed"] if precision == "f64" else []
    assert [x.mistake for x in findings.explanations] == [*BAD, *lost, "too few digits"]


def test_a_diagnosis_must_explain_half_of_the_wrong_answers():
    """Also on rays where its effect is not visible: here most answers are wrong in another way there."""
    rays = standard_rays(names=("generic", "near-normal", "matched"))
    answers = answered(rays, BAD["eta inverted"][0])
    assert check(rays, answers).diagnosis.mistake == "eta inverted"
    rows = np.flatnonzero(rays.regime != "generic")
    mixed = check(rays, changed(answers, rows, answers.b[rows] + (0.02, 0, 0)))
    assert mixed.diagnosis is None and reports.explained(mixed)[0].startswith("nearest of the common mistakes, no ")


@pytest.mark.parametrize("precision", PRECISIONS)
def test_diagnoses_of_two_sided_normals_and_lengths(precision):
    rays = standard_rays(precision, two_sided=True)
    assert check(rays, answered(rays, glsl)).diagnosis.text == "n was taken to face the ray, where it does not"
    assert check(rays, answered(rays, programs.two_sided)).exit_code == 0
    rays = standard_rays("f64", ("lengths",), 300)
    assert check(rays, answered(rays, glsl)).diagnosis.text == "a and n were taken for unit vectors"
    assert check(rays, answered(rays, programs.with_normals_made_unit)).exit_code == 0


def test_the_diagnosis_of_float32_where_float64_was_claimed():
    """The bound of float32 has 2 u, for inputs and formula. Errors within it are diagnosed as float32."""
    rays, loose = standard_rays("f64"), exact("f64")[1]
    assert check(rays, answered(rays, glsl, np.float32)).diagnosis.mistake == "f32 where f64 was claimed"
    longer = check(rays, Answers(loose.ids, loose.b * (1 + 1e-11)))
    assert longer.diagnosis.mistake == "missing normalisation"
    rays, (known, answers) = standard_rays("f64", ("generic",)), exact("f64", ("generic",))
    rows = np.flatnonzero(known.transmitted)
    bound = FORMULAS[LOOSEST].budget.chord(2 * 2.0**-24, rays.rays.k, known.cos_t, cos_i=known.cos_i)[rows]
    for share, mistake in ((0.8, "f32 where f64 was claimed"), (1.3, None)):
        off = (share * bound)[:, None]
        b = (answers.b[rows] + off * out_of_plane_units(answers.b[rows], rays.rays.n[rows])) / np.hypot(1, off)
        diagnosis = check(rays, changed(answers, rows, b)).diagnosis
        assert (diagnosis and diagnosis.mistake) == mistake


@pytest.mark.parametrize("precision, digits", [("f32", 4), ("f32", 6), ("f64", 6), ("f64", 12)])
@pytest.mark.parametrize("form, word", [("f", "decimals"), ("g", "significant digits")])
def test_the_diagnosis_of_too_few_digits(precision, digits, form, word):
    rays = standard_rays(precision, count=150)
    printed = np.array([[float(f"{x:.{digits}{form}}") for x in row] for row in answered(rays, glsl).b.tolist()])
    findings = check(rays, Answers(rays.ids, printed))
    assert (findings.exit_code, findings.diagnosis.mistake) == (1, "too few digits")
    assert findings.diagnosis.text == f"numbers are rounded to {digits} {word}"


def test_answers_without_a_diagnosis():
    """No visible effect at normal incidence; fewer than ten wrong answers; two mistakes at once; noise."""
    rays = standard_rays("f64", ("near-normal",))
    findings = check(rays, changed(answered(rays, glsl), slice(3), [0, 1, 0]))
    shares = {x.mistake: x.share for x in findings.explanations}
    assert (findings.wrong, findings.diagnosis) == (3, None)
    assert shares["eta inverted"] == shares["an index ignored"] == shares["degrees and radians"] == 0
    rays = standard_rays("f32", ("generic",))
    right, wrong = answered(rays, glsl).b, answered(rays, lambda a, n, k: -glsl(a, n, k)).b
    for count in (9, 10):
        rows = np.flatnonzero(right.any(1))[:count]
        findings = check(rays[np.isin(rays.ids, rows)], Answers(rays.ids[rows], wrong[rows]))
        assert findings.wrong == count and (findings.diagnosis is not None) == (count == 10)
    noise = np.random.default_rng(1).normal(size=standard_rays().rays.a.shape).astype(np.float32)
    for program in (lambda a, n, k: programs.swapped(glsl(a, n, 1 / k)), lambda a, n, k: unit(noise)):
        findings = check(standard_rays(), answered(standard_rays(), program))
        assert (findings.exit_code, findings.diagnosis) == (1, None)


# Total internal reflection


def test_a_wrong_signal_and_mixed_signals_are_reported():
    answers = answered(standard_rays(), glsl)
    for tir in set(GOOD) - {"zero"}:
        findings = check(standard_rays(), answers, tir=tir)
        assert (findings.exit_code, findings.tir, findings.problems[0].kind) == (1, tir, "zero")
    with pytest.raises(ValueError, match="expected answers with a column `transmitted`"):
        check(standard_rays(), answers, tir="flag")
    mixed = changed(answers, np.flatnonzero(~exact("f32")[0].transmitted)[::2], np.nan)
    findings = check(standard_rays(), mixed)
    assert (findings.exit_code, findings.tir) == (1, tir_signal.UNCLEAR)
    assert {problem.kind for problem in findings.problems} == {"zero", "non-finite"}


def test_a_flag_overrides_the_direction_and_mirror_directions_are_judged():
    rays, (known, answers) = standard_rays("f64"), exact("f64")
    b = np.where(known.transmitted[:, None], answers.b, 7.0)
    assert check(rays, Answers(rays.ids, b, known.transmitted)).exit_code == 0
    findings = check(rays, Answers(rays.ids, b, ~known.transmitted))
    assert (findings.exit_code, findings.total("tir_misclassified")) == (1, len(rays))
    assert findings.total("tir_beyond_bound") > 0.6 * len(rays)
    rays, (known, _) = standard_rays(), exact("f32")
    answers = answered(rays, programs.with_mirror)
    row = int(np.flatnonzero(~known.transmitted & (rays.regime == "k ≫ 1"))[0])
    findings = check(rays, changed(answers, row, answers.b[row] + [0, 1e-3, 0]))
    assert (findings.exit_code, findings.wrong) == (1, 1)


def test_rays_without_total_internal_reflection_need_no_signal():
    rays = standard_rays("f32", ("k ≪ 1", "near-normal"))
    answers = answered(rays, glsl)
    assert check(rays, answers).tir == tir_signal.NONE
    for b, kind in ((np.nan, "non-finite"), (0, "zero"), (np.inf, "non-finite")):
        findings = check(rays, changed(answers, [3, 5], b))
        assert (findings.exit_code, findings.wrong) == (1, 2)
        assert [(x.kind, x.count, x.text) for x in findings.problems] == [(kind, 2, "ids 3, 5")]


@pytest.mark.parametrize("value", [np.nan, 0.0])
def test_answers_without_directions_do_not_pass(value):
    for regime in ("exactly critical", "tangential"):
        rays = standard_rays("f32", (regime,))
        findings = check(rays, Answers(rays.ids, np.full((len(rays), 3), value)))
        assert (findings.exit_code, findings.total("compared"), findings.wrong) == (1, 0, 0)
    rays = standard_rays()  # nor do they for all rays
    findings = check(rays, Answers(rays.ids, np.full((len(rays), 3), value)))
    assert findings.exit_code == 1 and findings.wrong > findings.answered / 2


@pytest.mark.parametrize("precision", PRECISIONS)
def test_total_reflection_is_decided_next_to_the_surface(precision):
    """Cosines of 1e-4 of either angle are far from what rounding allows, |n·a| ≤ 4 u and |radicand| ≤ 14 u k²."""
    dtype, u = ray_set.PRECISIONS[precision], float(np.finfo(ray_set.PRECISIONS[precision]).eps) / 2
    near = 1e-4 if precision == "f64" else 4e-3  # cos θ_t: its square is the radicand
    assert near**2 > 2 * 14 * u * 1.5**2
    grazing, critical = np.sqrt(1 - 1e-8), np.sqrt(1 + np.array([-1, 1]) * near**2) / 1.5
    sine, k = np.array([grazing, grazing, *critical]), np.array([0.5, 1.5, 1.5, 1.5])
    cosine = np.array([1e-4, 1e-4, *np.sqrt(1 - critical**2)])
    a = np.stack([sine, 0 * sine, -cosine], 1).astype(dtype)
    rays = Rays(a, np.tile(np.array([[0, 0, 1]], dtype), (4, 1)), k.astype(dtype))
    tested = RaySet(rays, np.arange(4), {"precision": precision, "regimes": {"x": [0, 3]}, "checksum": ""})
    known = certified(tested)
    assert known.transmitted.tolist() == [True, False, True, False]
    assert check(tested, Answers(tested.ids, known.direction, known.transmitted)).wrong == 0
    for called in (np.ones(4, bool), np.zeros(4, bool)):
        assert check(tested, Answers(tested.ids, known.direction, called)).total("tir_beyond_bound") == 2


ZERO, ALONG = [0.0, 0, 0], [1.0, 0, 0]


def compared_answers(radicands, b=None):
    """Answers to float64 rays with the given radicands 1 − k² sin² θ, negative under total internal reflection."""
    sin, k = np.sqrt(1 - np.asarray(radicands)) / 1.4, np.full(len(radicands), 1.4)
    a = np.stack([sin, 0 * sin, -np.sqrt(1 - sin**2)], 1)
    rays = Rays(a, np.tile([0.0, 0.0, 1.0], (len(sin), 1)), k)
    known = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    return ComparedAnswers(a if b is None else np.array(b), rays, known, 2.0**-53)


@pytest.mark.parametrize(
    ("radicands", "b", "signal"),
    [
        ([-0.5] * 4 + [-1e-4] * 6, [ZERO] * 4 + [ALONG] * 6, "zero"),  # only rays far from the critical angle decide
        ([-1e-4] * 10, [ZERO] * 10, "zero"),  # if none is far, all rays decide
        ([-0.5] * 10, [ZERO] * 9 + [ALONG], "zero"),
        ([-0.5] * 10, [ZERO] * 8 + [ALONG] * 2, tir_signal.UNCLEAR),
        ([0.5] * 10, [ZERO] * 10, tir_signal.NONE),
        ([-1e-16] * 9 + [1e-16], [ALONG] * 6 + [ZERO] * 4, "zero"),  # some rays near the critical angle are transmitted
        ([-1e-16] * 10, [ALONG] * 10, "tangent"),
        ([-1e-16] * 10, [ZERO] * 5 + [[np.nan] * 3] * 5, tir_signal.UNCLEAR),
    ],
)
def test_detecting_the_signal_that_most_rays_agree_on(radicands, b, signal):
    for size in (3, 10):
        parts = (compared_answers(radicands[i : i + size], b[i : i + size]) for i in range(0, 10, size))
        assert tir_signal.detect(parts) == signal


@pytest.mark.parametrize("length", [1 / 3, 1.0, 3.0])
def test_mirror_directions_may_have_any_length(length):
    """Directions of transmitted rays may have any length too."""
    answers = compared_answers([-0.5, -0.2, 0.3, 0.6])
    b = length * np.where(answers.exact.transmitted[:, None], answers.exact.direction, answers.rays.a * [1, 1, -1])
    called = tir_signal.reflected(compared_answers([-0.5, -0.2, 0.3, 0.6], b), None, "reflected", np.ones(4, bool))
    assert called.tolist() == [True] * 2 + [False] * 2


# Rays for which rounding allows errors of any size ---------------------------------------------------------------


@functools.cache
def steep():
    """Rays, their certified answers, and a mask of those with a bound beyond a half turn, half of the transmitted."""
    rays = ray_set.make(("k ≫ 1", "generic"), 300, seed=4)
    known = certified(rays)
    return rays, known, (rays.rays.k > 3000) & known.transmitted


def turned(v, n, angle):
    """`v` turned about the unit vector n."""
    return np.cos(angle) * v + np.sin(angle) * np.cross(n, v) + (1 - np.cos(angle)) * dot(n, v) * n


def tangent(a, n):
    return unit(a - dot(a, n) * n)


GARBAGE = {
    "along the surface": lambda rng, a, n, b: turned(tangent(a, n), n, rng.uniform(0.5, 5, (len(a), 1))),
    "a random direction": lambda rng, a, n, b: unit(rng.normal(size=a.shape)),
    "backward along the surface": lambda rng, a, n, b: -tangent(a, n),
    "turned about the normal": lambda rng, a, n, b: turned(b, n, 0.5),
    "reversed": lambda rng, a, n, b: -a,
    "back to the side of the ray": lambda rng, a, n, b: b - 2 * dot(b, n) * n,
}


@pytest.mark.parametrize("tir", GOOD)
def test_with_a_bound_beyond_a_half_turn_the_textbook_formula_passes_and_garbage_fails(tir):
    """A few random directions are possible answers; near k sinθ = 0 all angles about the normal are possible."""
    rays, known, lost = steep()
    b = answered(rays, GOOD[tir]).b
    directions = b.any(1, keepdims=True)
    for right in (b, np.where(directions, unit(np.where(directions, b, 1)), 0)):
        findings = check(rays, Answers(rays.ids, right), tir=tir)
        assert (findings.exit_code, findings.problems) == (0, ())
    a, n = (unit(v[lost].astype(float)) for v in (rays.rays.a, rays.rays.n))
    for garbage in GARBAGE.values():
        b[lost] = garbage(np.random.default_rng(1), a, n, known.direction[lost])
        findings = check(rays, Answers(rays.ids, b), tir=tir)
        assert findings.exit_code == 1
        assert findings.problem_count("impossible") == findings.wrong >= 0.5 * lost.sum()


def test_undecidable_rays_are_counted_and_do_not_pass_alone():
    rays, known, lost = steep()
    findings = check(rays, answered(rays, glsl))
    wide, generic = findings.regimes
    assert (generic.undecidable, generic.judged) == (0, generic.compared)
    assert lost.sum() <= wide.undecidable < wide.rays >= wide.judged + wide.undecidable
    assert f"; {wide.undecidable} rays are undecidable (error bound above 0.1 rad)" in reports.sentence(findings)
    findings = check(rays[lost], Answers(rays.ids[lost], known.direction[lost]))
    assert (findings.exit_code, findings.wrong, findings.total("judged")) == (1, 0, 0)
    assert findings.total("compared") > 0
    assert "none with a decidable direction" in reports.sentence(findings)


def bounds_of(rays):
    known = certified(rays)
    return known, RayBounds(rays.rays, known, FORMULAS[LOOSEST].budget, rays.roundoff, normalised=True)


def test_only_right_answers_are_possible_within_a_tight_bound():
    """In float64 and far from the critical angle no other direction is possible; the length of the answer is free."""
    rays = ray_set.make(("generic", "k ≪ 1", "critical"), 60, "f64", 4)
    a, n = rays.rays.a, rays.rays.n
    known, bounds = bounds_of(rays)
    for signal, b, relevant in (
        ("", 3 * known.direction, known.transmitted),
        ("tangent", 3 * tangent(a, n), ~known.transmitted),
        ("reflected", 3 * mirrored(a, n, 1), ~known.transmitted),
    ):
        rows = np.flatnonzero(relevant & (bounds.chord < 1e-9))
        assert len(rows) > 20 and judged_answers.possible(b, bounds, rows, signal).all()
        off_normal = [b + 1e-6 * n] if signal != "tangent" else []
        for wrong in (-b, b + 1e-6 * np.cross(a, n), turned(b, n, 1e-6), *off_normal):
            assert not judged_answers.possible(wrong, bounds, rows, signal).any()


@pytest.mark.parametrize("tir", ["reflected", "tangent"])
def test_a_direction_that_signals_total_reflection_must_be_in_the_plane_of_incidence(tir):
    """Tangents and mirror directions, turned about the normal, near the critical angle."""
    rays = ray_set.make(("critical, to the ulp",), 200, "f64", 4)
    b = mirrored(rays.rays.a, rays.rays.n, 1) if tir == "reflected" else tangent(rays.rays.a, rays.rays.n)
    assert check(rays, Answers(rays.ids, b), tir=tir).wrong == 0  # so near the critical angle any ray may be reflected
    assert len(set(certified(rays).transmitted)) == 2
    findings = check(rays, Answers(rays.ids, turned(b, rays.rays.n, 0.1)), tir=tir)
    assert (findings.exit_code, findings.wrong) == (1, len(rays))


def test_the_angle_by_which_a_possible_direction_may_be_turned_about_the_normal():
    """It is L u of the component along the surface: 0.97 of it is possible, 1.03 is not.

    cos θ is between 0.3 and 0.7, so that its powers differ.
    """
    rays = ray_set.make(("generic",), 800, "f32", 4)
    known, bounds = bounds_of(rays)
    rows = np.flatnonzero(known.transmitted & (known.cos_t > 0.3) & (known.cos_t < 0.7) & (bounds.chord < 1e-5))
    assert len(rows) > 20
    slack = bounds.budget.of_terms(bounds.u, bounds.k) / np.sqrt(1 - known.cos_t**2)
    for share, accepted in ((0.97, True), (1.03, False)):
        b = turned(known.direction, unit(rays.rays.n.astype(float)), share * slack[:, None])
        assert (judged_answers.possible(b, bounds, rows) == accepted).all()


@pytest.mark.parametrize("precision", PRECISIONS)
def test_vectors_off_unit_do_not_widen_the_bound(precision):
    """Errors of 1000 u out of the plane of incidence are wrong: 3 u of the vectors allow 10 · 3 u and 14 · 3 u k²."""
    rays, (known, answers) = standard_rays(precision, ("lengths",)), exact(precision, ("lengths",))
    rows = np.flatnonzero(known.transmitted & (rays.rays.k < 2) & (known.cos_t > 0.5))
    shift = 1000 * rays.roundoff * lengths(answers.b[rows]).astype(float)[:, None]
    assert len(rows) > 5
    moved = answers.b[rows] + shift * out_of_plane_units(answers.b[rows], rays.rays.n[rows])
    assert check(rays, changed(answers, rows, moved)).wrong == len(rows)
    u, k = 2.0**-24, np.geomspace(1e-3, 1e6, 50)
    bounds = {name: formula.budget.chord(u, k) for name, formula in FORMULAS.items()}
    assert all((bound <= bounds[LOOSEST]).all() for bound in bounds.values())


# Every mistake, and every sound program -------------------------------------------------------------------------------

TURN = 1e-5


def only(mask, mistake, program=glsl):
    """The program with the mistake on the rays where `mask(a, n, k)` (N,) is True."""
    return lambda a, n, k: np.where(mask(a, n, k)[:, None], mistake(a, n, k), program(a, n, k))


def every(period, value):
    return lambda a, n, k: np.where((np.arange(len(k)) % period == 0)[:, None], a.dtype.type(value), glsl(a, n, k))


def out_of_plane(a, n, k):
    b, w = glsl(a, n, k), np.cross(n, a)
    return (b + TURN * b.any(1, keepdims=True) * w / np.maximum(np.sqrt(dot(w, w)), 1e-30)).astype(a.dtype)


def bent(rule):
    """GLSL's formula with its radicand changed by `rule`."""

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
    "inputs in float16": lambda a, n, k: glsl(*(v.astype(np.float16).astype(v.dtype) for v in (a, n)), k),
    "NaN for some": every(50, np.nan),
    "infinity for some": every(50, np.inf),
    "zero for some": every(50, 0),
    "zero for all": every(1, 0),
    "one direction for all": every(1, 0.5),
    "the answer to the next ray": lambda a, n, k: np.roll(glsl(a, n, k), 1, 0),
    "the answers in reverse": lambda a, n, k: glsl(a, n, k)[::-1],
    "axes swapped for n_z > 0.9": only(lambda a, n, k: n[:, 2] > 0.9, lambda a, n, k: programs.swapped(glsl(a, n, k))),
    "wrong on negative zero": only(lambda a, n, k: ((n == 0) & np.signbit(n)).any(1), mirrored),
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
    assert check(standard_rays(precision), answered(standard_rays(precision), WRONG[name])).exit_code == 1


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", ONE_REGIME)
def test_a_program_that_is_wrong_in_one_regime_does_not_pass(precision, name):
    rays = standard_rays(precision)
    right, wrong = answered(rays, glsl), answered(rays, ONE_REGIME[name])
    for regime in ray_set.DEFAULT:
        rows = np.flatnonzero(rays.regime == regime)
        findings = check(rays, changed(right, rows, wrong.b[rows]))
        assert (findings.exit_code, [x.regime for x in findings.regimes if x.wrong]) == (1, [regime]), regime


@pytest.mark.parametrize(
    ("least", "length", "limit", "wrong"),  # wrong: a regime with wrong answers, if any
    [
        (0, 1 + 1e-5, np.inf, "critical, to the ulp"),  # where the bound of the angle is 1e-3
        (1e3, 1.5, np.inf, ""),  # the bound of a textbook's formula allows this
        (1e3, 1.5, RIGHT, "k ≫ 1"),
        (1e5, 40, RIGHT, "k ≫ 1"),
        (0, 1 + 1e-7, RIGHT, ""),
    ],
)
def test_lengths_are_judged_apart_from_directions(least, length, limit, wrong):
    rays, (known, exact_answers) = standard_rays(), exact("f32")
    off = (rays.rays.k > least) & known.transmitted & exact_answers.b.any(1)
    b = np.where(off[:, None], length, 1) * exact_answers.b
    findings = check(rays, Answers(rays.ids, b), tir="reflected", most_backward=limit)
    assert findings.exit_code == bool(wrong) and (findings.right < findings.answered) == (length > 1 + 1e-6)
    assert not wrong or wrong in {regime.regime for regime in findings.regimes if regime.wrong}


SOUND = GOOD | programs.FORMULAS
SOUND |= {f"{name}, made unit": programs.made_unit(f) for name, f in programs.FORMULAS.items()}


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", SOUND)
def test_every_sound_program_passes(precision, name):
    """In the set's precision and in float64; also on each regime alone that has directions to judge."""
    for dtype in (None, np.float64):
        assert check(standard_rays(precision), answered(standard_rays(precision), SOUND[name], dtype)).exit_code == 0
    for regime in (*ray_set.DEFAULT, "exactly critical"):
        rays = standard_rays(precision, (regime,), 60)
        findings = check(rays, answered(rays, lambda a, n, k: SOUND[name](unit(a), unit(n), k)))
        assert findings.exit_code == 0, regime


# Answers that do not match the rays ----------------------------------------------------------------------------------


@given(st.lists(st.integers(-9, 40), max_size=90), st.integers(1, 30))
def test_missing_duplicate_and_unknown_answers(ids, count):
    rays = standard_rays("f32", ("near-normal",), 40)[np.arange(40) < count]
    right = answered(standard_rays("f32", ("near-normal",), 40), glsl).b
    first = [i not in ids[:row] for row, i in enumerate(ids)]
    b = np.array([right[i] if 0 <= i < 40 and first[row] else [0, 0, 1] for row, i in enumerate(ids)]).reshape(-1, 3)
    findings = check(rays, Answers(np.array(ids, int), b))
    expected = {
        "missing": [i for i in range(count) if i not in ids],
        "duplicate": sorted({i for i in ids if ids.count(i) > 1}),
        "unknown": sorted({i for i in ids if not 0 <= i < count}),
    }
    reported = {
        x.kind: (x.count, [int(i) for i in x.text.removesuffix(", …").split(" ", 1)[1].split(", ")])
        for x in findings.problems
    }
    assert reported == {kind: (len(listed), listed[:5]) for kind, listed in expected.items() if listed}
    assert findings.answered == count - len(expected["missing"])
    assert (findings.exit_code == 2) == bool(reported or not ids) and findings.wrong == 0


@pytest.mark.parametrize(
    "work, message",
    [
        (lambda to, b: check(to, Answers(to.ids, b), tir="zeros"), "TIR signal 'zeros': unknown; expected auto, zero"),
        (lambda to, b: check(to, Answers(to.ids, b), error_bound="x"), "error bound 'x': unknown; expected wedge"),
        *(
            (lambda to, b, x=x: check(to, Answers(to.ids, b), most_backward=x), "expected a positive number of round")
            for x in (0.0, np.nan)
        ),
        (lambda to, b: check(to, Answers(to.ids, b, header={"checksum": "x"})), "the answers belong to rays with"),
        (lambda to, b: Answers(to.ids, b[1:]), "expected a direction for each id"),
        (lambda to, b: Answers(to.ids, b, n_ratio=np.ones(2)), "expected a direction for each id"),
        (lambda to, b: Answers(to.ids, b, np.full(len(b), 2)), "^answers: transmitted is 2; expected 0 or 1$"),
    ],
)
def test_invalid_options_and_answers(work, message):
    rays, (_, answers) = standard_rays(), exact("f32")
    assert check(rays, Answers(rays.ids, answers.b, header=rays.header)).exit_code == 0
    with pytest.raises(ValueError, match=message):
        work(rays, answers.b)


def test_rays_of_float64_need_extended_precision(monkeypatch):
    (_, single), (_, double) = exact("f32"), exact("f64")
    monkeypatch.setattr(np, "longdouble", np.float64)
    assert check(standard_rays("f32"), single, error_bound="promoted").exit_code == 0
    with pytest.raises(ValueError, match=r"^rays of f64: numpy\.longdouble has 53 bits on this system; expected 64"):
        check(standard_rays("f64"), double)


# The ratio of indices that a program used -----------------------------------------------------------------------------


def changed_ratios(rays, factor, rows=slice(None)):
    """The ratios of indices times `factor`, in the set's precision, as if a program used another glass."""
    k = rays.rays.k.copy()
    k[rows] *= k.dtype.type(factor)
    return k


@pytest.mark.parametrize("precision", PRECISIONS)
def test_indices_and_directions_are_judged_apart(precision):
    """Without the column `n_ratio`, directions for another index are wrong."""
    rays = ray_set.make(("generic", "critical", "grazing"), 60, precision, 2, **media_rays.ALL)
    answers_for = functools.partial(media_rays.answered, rays)
    findings = check(rays, answers_for())
    assert (findings.exit_code, findings.wrong, findings.problems, findings.ratio.largest) == (0, 0, (), 0)
    assert check(rays, answers_for(said=False)).ratio is None
    k = changed_ratios(rays, 1 + 3e-4)
    findings, without = check(rays, answers_for(k)), check(rays, answers_for(k, said=False))
    assert (findings.exit_code, findings.wrong, findings.problem_count("index")) == (1, 0, len(rays))
    assert findings.ratio.largest == pytest.approx(3e-4, rel=1e-3)
    assert reports.sentence(findings).startswith(f"{len(rays)} answers, all right; ")
    assert reports.sentence(findings).endswith(f"; {len(rays)} answers are for a different ratio of indices")
    assert without.exit_code == 1 and without.wrong > len(rays) / 3 and not without.problem_count("index")
    findings = check(rays, answers_for(direction=1 / rays.rays.k))
    assert (findings.exit_code, findings.diagnosis.mistake) == (1, "eta inverted")
    assert findings.ratio.largest == 0 and not findings.problem_count("index")
    both = check(rays, answers_for(changed_ratios(rays, 1.01), direction=1 / changed_ratios(rays, 1.01)))
    assert "are wrong: eta inverted; 180 answers are for a different" in reports.sentence(both)
    k = changed_ratios(rays, 1 + 1e-3, [4, 70])
    k[70] *= k.dtype.type(1 - 5e-3)
    findings = check(rays, answers_for(k))
    assert (findings.ratio.id, findings.ratio.ray) == (70, header.described(rays.header, 70))
    (line,) = reports.ratio(findings)
    assert f"(id 70, {findings.ratio.ray}); up to 1e-5 counts as equal" in line
    texts = [*map(reports.problem_text, findings.problems)]
    assert "2 answers used a different ratio of indices (n_ratio): ids 4, 70" in texts


ULP = {precision: float(np.finfo(dtype).eps) for precision, dtype in ray_set.PRECISIONS.items()}
FACTORS = [("f64", media_rays.ALL, 1 + x, abs(x) > 1e-5) for x in (9e-6, -9e-6, 1.1e-5, -1.1e-5)]
FACTORS += [(name, {}, 1 + ulps * ULP[name], ulps > 4) for name in ULP for ulps in (3, 5)]
FACTORS += [(name, {}, factor, True) for name in ULP for factor in (1e-9, 1e9)]


@pytest.mark.parametrize(("precision", "of_media", "factor", "counts"), FACTORS)
def test_the_tolerance_of_ratios_with_and_without_media(precision, of_media, factor, counts):
    rays = ray_set.make(["generic"], 12, precision, **of_media)
    answers = dataclasses.replace(media_rays.answered(rays), n_ratio=rays.rays.k.astype(float) * factor)
    findings = check(rays, answers)
    assert bool(findings.problem_count("index")) == counts and bool(findings.ratio.ray) == bool(of_media)


def test_rays_are_certified_for_the_ratio_that_the_program_used():
    """The ratio is in float64 also in a set of float32, and it decides about total internal reflection."""
    rays = ray_set.make(["generic", "critical"], 60, "f32", **media_rays.ALL)
    ratio = rays.rays.k.astype(float) * (1 + 4e-6)
    known = oracle.refract(*(getattr(rays.rays, x).astype(float) for x in "an"), ratio, fresnel=False, progress=False)
    findings = check(rays, Answers(rays.ids, np.where(known.transmitted[:, None], known.direction, 0), n_ratio=ratio))
    assert (findings.exit_code, findings.total("exact")) == (0, len(rays))
    rays = ray_set.make(["critical"], 400, **media_rays.ALL)
    answers = (media_rays.answered(rays, changed_ratios(rays, 1 + 1e-3), said=said) for said in (True, False))
    reporting, without = (check(rays, x, tir="zero") for x in answers)
    assert (reporting.wrong, reporting.total("tir_beyond_bound")) == (0, 0) and without.total("tir_beyond_bound") > 20

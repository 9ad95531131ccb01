"""Right answers pass, and every planted mistake is found and named."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import ray_programs as programs
from support.ray_programs import BAD, GOOD

from mi_refract import oracle
from mi_refract.accuracy import lengths
from mi_refract.formulas import FORMULAS
from mi_refract.ray_sets import ray_set, reports, tir_signal
from mi_refract.ray_sets.check_answers import LOOSEST, check
from mi_refract.ray_sets.judged_answers import RIGHT
from mi_refract.ray_sets.ray_set import Answers, RaySet
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


@functools.cache
def exact(precision, names=ray_set.DEFAULT):
    """The certified answers in the set's precision, as long as a; mirror directions where nothing is transmitted."""
    to = some(precision, names)
    found = oracle.refract(to.rays.a, to.rays.n, to.rays.k, fresnel=False)
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
        assert found.answered == len(to)
        assert [regime.regime for regime in found.regimes] == list(ray_set.DEFAULT)
    assert found.total("exact") < found.answered  # it is not exact, and it is not called so


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("names", [ray_set.DEFAULT, ("lengths", "off unit", "tangential", "exactly critical")])
def test_the_exact_answers_are_exact(precision, names):
    to, (certified, answers) = some(precision, names), exact(precision, names)
    for budget in (LOOSEST, "promoted"):
        found = check(to, answers, error_bound=budget)
        assert found.exit_code == 0
        assert found.total("exact") == found.answered == len(to)
        assert found.total("tir_misclassified") == 0
        assert max(regime.worst for regime in found.regimes) <= found.ulp
    for kind in (bool, int, np.uint8, float):
        flagged = check(to, Answers(to.ids, answers.b, certified.transmitted.astype(kind)))
        assert (flagged.exit_code, flagged.tir, flagged.wrong) == (0, "flag", 0)


def test_the_shortest_decimals_of_float32_will_do():
    """Read as float64 they are up to half an ulp from the number that was printed."""
    to, (_, answers) = some(), exact("f32")
    printed = np.array([[float(str(x)) for x in row] for row in answers.b.astype(np.float32)])
    assert (printed != answers.b).any()
    assert check(to, Answers(to.ids, printed), error_bound="promoted").exit_code == 0


def test_figures_are_what_they_say():
    """A turn by a known angle in half of one regime; the worst ray is called by its id."""
    to, (certified, answers) = some("f64"), exact("f64")
    rows = np.flatnonzero((to.regime == "generic") & certified.transmitted)
    angle = np.linspace(1e-5, 1e-3, len(rows))[:, None]
    turned = 1.25 * (np.cos(angle) * answers.b[rows] + np.sin(angle) * across(answers.b[rows], to.rays.n[rows]))
    found = check(to, changed(answers, rows, turned))
    generic = found.regimes[0]
    assert generic.worst == pytest.approx(1e-3, rel=1e-9)
    compared = np.concatenate([angle.ravel(), np.zeros(generic.compared - len(rows))])
    assert generic.mean == pytest.approx(compared.mean(), rel=1e-6)
    assert generic.p99 == pytest.approx(np.quantile(compared, 0.99), rel=1e-6)
    assert generic.length_error == pytest.approx(0.25, rel=1e-9)
    assert generic.wrong == found.wrong == len(rows)
    assert generic.exact == generic.rays - len(rows)
    worst = generic.replay["id"]
    assert worst in to.ids[rows]
    assert [float.fromhex(x) for x in generic.replay["a"]] == to.rays.a[worst].tolist()
    assert found.ulp == 2.0**-52


def test_one_wrong_answer_is_enough():
    to = some()
    answers = answered(to, programs.glsl)
    row = int(np.flatnonzero((to.regime == "Brewster") & answers.b.any(1))[7])
    found = check(to, changed(answers, row, answers.b[row] + [0, 2e-4, 0]))
    assert (found.exit_code, found.wrong, found.diagnosis) == (1, 1, None)
    assert found.regimes[ray_set.DEFAULT.index("Brewster")].replay["id"] == to.ids[row]


def test_the_textbook_is_not_exact():
    found = check(some(), answered(some(), programs.glsl), error_bound="promoted")
    assert (found.exit_code, found.error_bound) == (1, "promoted")
    assert found.wrong == sum(regime.rays - regime.exact for regime in found.regimes)


@pytest.mark.parametrize("lost", [1e-2, 1e-3])
def test_giving_up_before_the_critical_angle_is_seen(lost):
    to, (certified, _) = some("f64"), exact("f64")
    rows = np.flatnonzero(certified.transmitted & (certified.cos_t < lost) & (to.regime == "critical"))
    found = check(to, changed(answered(to, programs.glsl), rows, 0))
    critical = found.regimes[ray_set.DEFAULT.index("critical")]
    assert critical.tir_beyond_bound >= len(rows) == critical.wrong > 0
    assert found.exit_code == 1


@pytest.mark.parametrize("program", [lambda b: b, lambda b: -b, lambda b: np.round(b, 3), lambda b: 1.01 * b])
def test_findings_do_not_depend_on_the_pieces(program):
    to = some(names=("generic", "critical", "grazing"))
    b, order = program(answered(to, programs.glsl).b), np.random.default_rng(1).permutation(len(to))[3:]
    for answers in (Answers(to.ids, b), Answers(order, b[order])):
        one, other = (repr(reports.as_data(check(to, answers, piece=size))) for size in (1000, 7))
        assert one == other


# Backward errors


@pytest.mark.parametrize("precision", PRECISIONS)
def test_the_textbook_is_right_but_where_k_is_large(precision):
    """Near the critical angle, rounding leaves one ray in 10,000 above 4 u; there is none among these."""
    to = ray_set.make(count=200, precision=precision, seed=3)
    found, strict = (check(to, answered(to, programs.glsl), most_backward=most) for most in (np.inf, RIGHT))
    assert found.exit_code == 0
    for regime in found.regimes:
        assert (regime.backward_worst > RIGHT) == (regime.right < regime.rays) == (regime.regime in LARGE)
        assert regime.backward_median <= regime.backward_p99 <= regime.backward_worst
    assert strict.exit_code == 1 and strict.wrong == found.answered - found.right
    assert {regime.regime for regime in strict.regimes if regime.wrong} == LARGE


def test_where_k_is_large_the_sine_is_lost_in_1_minus_c_squared():
    """sin²θ_i from 1 − c² is off by u, and the radicand by k² u; from |n × a|² by u sin²θ_i. That is all of it."""
    to = ray_set.make(["k ≫ 1"], 500, "f32", 3)

    def by(sine_squared):
        def answer(a, n, k):
            k, c = k[:, None], (n * a).sum(1, keepdims=True)
            radicand = 1 - k * k * sine_squared(a, n, c)
            return np.where(radicand < 0, 0, k * (a - c * n) - np.sqrt(np.maximum(radicand, 0)) * n)

        return check(to, answered(to, answer))

    lost, kept = by(lambda a, n, c: 1 - c * c), by(lambda a, n, c: (np.cross(n, a) ** 2).sum(1, keepdims=True))
    assert lost.right < 0.6 * lost.answered and lost.regimes[0].backward_worst > 100
    assert kept.right == kept.answered and kept.regimes[0].backward_worst < 1


def test_a_normal_off_by_a_millionth_is_within_the_bound_and_not_right():
    to = ray_set.make(["generic"], 500, "f32", 3)
    answers = answered(to, lambda a, n, k: small_mistakes.tilted(a, n, k[:, None]))
    found = check(to, answers)
    assert (found.exit_code, reports.grade(found.regimes[0])) == (0, "within bound")
    assert found.right < found.answered / 2
    assert check(to, answers, most_backward=RIGHT).exit_code == 1


@pytest.mark.parametrize("value, wrong", [(0.0, 1), (np.nan, 50)])
def test_a_lost_ray_and_no_direction_are_exact_for_no_input_nearby(value, wrong):
    to = ray_set.make(["generic"], 100, "f32", 3)
    answers = answered(to, programs.glsl)
    rows = np.flatnonzero(answers.b.any(axis=1))[:wrong]
    (regime,) = check(to, changed(answers, rows, value), tir="zero").regimes
    assert regime.right == regime.rays - wrong
    assert regime.backward_worst == np.inf if np.isnan(value) else 1e3 < regime.backward_worst < np.inf


# Mistakes

CASES = [("f32", name, i) for name, makers in BAD.items() for i in range(len(makers))]
CASES += [("f64", name, 0) for name in BAD]


@pytest.mark.parametrize("precision, name, i", CASES)
def test_a_mistake_is_called_by_its_name(precision, name, i):
    to = some(precision)
    found = check(to, answered(to, BAD[name][i]))
    assert found.exit_code == 1
    assert found.diagnosis is not None, found.explanations
    assert found.diagnosis.mistake == name
    assert [x.mistake for x in found.explanations] == [*BAD, "f32 where f64 was claimed", "too few digits"]


@pytest.mark.parametrize("precision", PRECISIONS)
def test_code_for_normals_that_face_the_ray(precision):
    to = some(precision, two_sided=True)
    found = check(to, answered(to, programs.glsl))
    assert found.diagnosis.text == "n was taken to face the ray, where it does not"
    assert check(to, answered(to, programs.two_sided)).exit_code == 0


def test_code_for_unit_vectors():
    to = some("f64", ("lengths",), 300)
    found = check(to, answered(to, programs.glsl))
    assert (found.exit_code, found.diagnosis.mistake) == (1, "missing normalisation")
    assert found.diagnosis.text == "a and n were taken for unit vectors"
    assert check(to, answered(to, programs.with_normals_made_unit)).exit_code == 0


def test_float32_where_float64_was_claimed():
    found = check(some("f64"), answered(some("f64"), programs.glsl, np.float32))
    assert (found.exit_code, found.diagnosis.mistake) == (1, "f32 where f64 was claimed")
    loose = exact("f64")[1]
    found = check(some("f64"), Answers(loose.ids, loose.b * (1 + 1e-11)))
    assert (found.exit_code, found.diagnosis.mistake) == (1, "missing normalisation")


@pytest.mark.parametrize("share, mistake", [(0.8, "f32 where f64 was claimed"), (1.3, None)])
def test_errors_of_float32_are_those_of_its_inputs_and_its_formula(share, mistake):
    """Both at once: 2u in the bound. A turn by less of the bound is float32, a turn by more is not."""
    to, (certified, answers) = some("f64", ("generic",)), exact("f64", ("generic",))
    rows = np.flatnonzero(certified.transmitted)
    bound = FORMULAS[LOOSEST].budget.chord(2 * 2.0**-24, to.rays.k, certified.cos_t, cos_i=certified.cos_i)[rows]
    off = (share * bound)[:, None]
    b = (answers.b[rows] + off * across(answers.b[rows], to.rays.n[rows])) / np.hypot(1, off)
    diagnosis = check(to, changed(answers, rows, b)).diagnosis
    assert (diagnosis and diagnosis.mistake) == mistake


@pytest.mark.parametrize("precision, digits", [("f32", 4), ("f64", 6), ("f64", 8), ("f64", 12)])
@pytest.mark.parametrize("form, word", [("f", "decimals"), ("g", "significant digits")])
def test_too_few_digits(precision, digits, form, word):
    to = some(precision)
    answers = answered(to, programs.glsl)
    printed = np.array([[float(f"{x:.{digits}{form}}") for x in row] for row in answers.b.tolist()])
    found = check(to, Answers(to.ids, printed))
    assert (found.exit_code, found.diagnosis.mistake) == (1, "too few digits")
    assert found.diagnosis.text == f"numbers are rounded to {digits} {word}"


def test_at_normal_incidence_code_with_angles_and_the_index_has_no_visible_mistake():
    """All directions go straight on, whatever k is: nothing there may name a mistake."""
    to = some("f64", ("near-normal",))
    found = check(to, changed(answered(to, programs.glsl), slice(3), [0, 1, 0]))
    assert (found.wrong, found.diagnosis) == (3, None)
    shares = {x.mistake: x.share for x in found.explanations}
    assert shares["eta inverted"] == shares["an index ignored"] == shares["degrees and radians"] == 0


@pytest.mark.parametrize("count", [9, 10])
def test_fewer_than_ten_wrong_answers_are_no_evidence(count):
    to = some("f32", ("generic",))
    right, wrong = (answered(to, programs.glsl).b, answered(to, lambda a, n, k: -programs.glsl(a, n, k)).b)
    rows = np.flatnonzero(right.any(1))[:count]
    found = check(to[np.isin(to.ids, rows)], Answers(to.ids[rows], wrong[rows]))
    assert found.wrong == count and (found.diagnosis is not None) == (count == 10)


@pytest.mark.parametrize(
    "program",
    [
        lambda a, n, k: programs.swapped(programs.glsl(a, n, 1 / k)),
        lambda a, n, k: programs.unit(np.random.default_rng(1).normal(size=a.shape)).astype(a.dtype),
    ],
    ids=["two mistakes", "noise"],
)
def test_what_has_no_name(program):
    found = check(some(), answered(some(), program))
    assert (found.exit_code, found.diagnosis) == (1, None)


# Total internal reflection


def test_a_wrong_signal_is_stated():
    answers = answered(some(), programs.glsl)
    for tir in set(GOOD) - {"zero"}:
        found = check(some(), answers, tir=tir)
        assert (found.exit_code, found.tir) == (1, tir)
        assert found.problems[0].kind == "zero"
    with pytest.raises(ValueError, match="no column `transmitted`"):
        check(some(), answers, tir="flag")


def test_several_signals_at_once():
    to, (certified, _) = some(), exact("f32")
    found = check(to, changed(answered(to, programs.glsl), np.flatnonzero(~certified.transmitted)[::2], np.nan))
    assert (found.exit_code, found.tir) == (1, tir_signal.UNCLEAR)
    assert {problem.kind for problem in found.problems} == {"zero", "non-finite"}


def test_a_mirror_direction_is_judged_too():
    to, (certified, _) = some(), exact("f32")
    answers = answered(to, programs.with_mirror)
    row = int(np.flatnonzero(~certified.transmitted & (to.regime == "k ≫ 1"))[0])
    found = check(to, changed(answers, row, answers.b[row] + [0, 1e-3, 0]))
    assert (found.exit_code, found.wrong) == (1, 1)


def test_exactly_critical_rays_may_be_signalled_as_reflected():
    to = some("f64", ("exactly critical",), 100)
    answers = answered(to, programs.with_normals_made_unit)
    assert 0 < (answers.b == 0).all(1).sum() < len(to)
    found = check(to, answers)
    assert (found.exit_code, found.tir, found.problems) == (0, tir_signal.NONE, ())


def test_a_flag_goes_before_the_direction():
    to, (certified, answers) = some("f64"), exact("f64")
    b = np.where(certified.transmitted[:, None], answers.b, 7.0)
    assert check(to, Answers(to.ids, b, certified.transmitted)).exit_code == 0
    found = check(to, Answers(to.ids, b, ~certified.transmitted))
    assert (found.exit_code, found.total("tir_misclassified")) == (1, len(to))
    assert found.total("tir_beyond_bound") > 0.6 * len(to)


def test_no_ray_with_total_internal_reflection():
    to = some("f32", ("k ≪ 1", "near-normal"))
    answers = answered(to, programs.glsl)
    assert check(to, answers).tir == tir_signal.NONE
    for b, kind in ((np.nan, "non-finite"), (0, "zero"), (np.inf, "non-finite")):
        found = check(to, changed(answers, [3, 5], b))
        assert (found.exit_code, found.wrong) == (1, 2)
        assert [(x.kind, x.count, x.text) for x in found.problems] == [(kind, 2, "ids 3, 5")]


@pytest.mark.parametrize("regime", ["exactly critical", "tangential"])
@pytest.mark.parametrize("value", [np.nan, 0.0])
def test_answers_to_ambiguous_rays_alone_are_no_pass(regime, value):
    to = some("f32", (regime,))
    found = check(to, Answers(to.ids, np.full((len(to), 3), value)))
    assert (found.exit_code, found.total("compared"), found.wrong) == (1, 0, 0)
    found = check(some(), Answers(some().ids, np.full((len(some()), 3), value)))  # nor to all rays
    assert found.exit_code == 1 and found.wrong > found.answered / 2


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("flip", [True, False], ids=["transmitted", "reflected"])
def test_next_to_the_surface_total_reflection_is_decided_all_the_same(precision, flip):
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
    certified = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    assert certified.transmitted.tolist() == [True, False, True, False]
    assert check(to, Answers(to.ids, certified.direction, certified.transmitted)).wrong == 0
    called = certified.transmitted ^ (certified.transmitted == flip)
    assert check(to, Answers(to.ids, certified.direction, called)).total("tir_beyond_bound") == 2


# Answers that are not those to the rays


@given(st.lists(st.integers(-9, 40), max_size=90), st.integers(1, 30))
def test_missing_duplicate_and_unknown_answers_and_the_first_one_counts(ids, count):
    to = some("f32", ("near-normal",), 40)[np.arange(40) < count]
    right = answered(some("f32", ("near-normal",), 40), programs.glsl).b
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


def test_any_order_will_do():
    to, answers = some(), answered(some(), programs.glsl)
    order = np.random.default_rng(2).permutation(len(to))
    assert check(to, Answers(answers.ids[order], answers.b[order])).exit_code == 0
    found = check(to, Answers(answers.ids[order], answers.b))
    assert (found.exit_code, found.diagnosis) == (1, None)


def test_answers_to_other_rays():
    to, other = some(), ray_set.make(count=COUNT, seed=5)
    answers = answered(to, programs.glsl)
    assert check(to, Answers(to.ids, answers.b, header=to.header)).exit_code == 0
    with pytest.raises(ValueError, match="the answers are to rays with the checksum"):
        check(to, Answers(to.ids, answers.b, header=other.header))


@pytest.mark.parametrize(
    "options, message",
    [
        ({"tir": "zeros"}, "TIR signal 'zeros': unknown; expected auto, zero"),
        ({"error_bound": "decompose"}, "error bound 'decompose': unknown; expected wedge"),
        *(({"most_backward": x}, "expected a positive number of roundings") for x in (0.0, -1.0, np.nan)),
    ],
)
def test_invalid_options(options, message):
    with pytest.raises(ValueError, match=message):
        check(some(), exact("f32")[1], **options)


@pytest.mark.parametrize(
    "columns, message",
    [
        ({"b": np.zeros((2, 3))}, "expected a direction for each id"),
        ({"n_ratio": np.ones(2)}, "expected a direction for each id"),
        ({"transmitted": np.full(3, 2)}, "^answers: transmitted is 2; expected 0 or 1$"),
    ],
)
def test_answers_of_another_shape(columns, message):
    with pytest.raises(ValueError, match=message):
        Answers(**{"ids": np.arange(3), "b": np.zeros((3, 3))} | columns)


# How wide the bounds are


def test_the_default_bound_is_the_loosest():
    u, k = 2.0**-24, np.geomspace(1e-3, 1e6, 50)
    bounds = {name: formula.budget.chord(u, k) for name, formula in FORMULAS.items()}
    assert all((bound <= bounds[LOOSEST]).all() for bound in bounds.values())


@pytest.mark.parametrize("precision", PRECISIONS)
def test_vectors_off_unit_excuse_no_more_than_making_them_unit_costs(precision):
    """1000 u across the plane of incidence, where 3 u of the vectors allow 10 · 3 u and less than 14 · 3 u k²."""
    to, (found, answers) = some(precision, ("lengths",)), exact(precision, ("lengths",))
    rows = np.flatnonzero(found.transmitted & (to.rays.k < 2) & (found.cos_t > 0.5))
    off = 1000 * to.roundoff * lengths(answers.b[rows]).astype(float)[:, None]
    assert len(rows) > 5
    moved = answers.b[rows] + off * across(answers.b[rows], to.rays.n[rows])
    assert check(to, changed(answers, rows, moved)).wrong == len(rows)

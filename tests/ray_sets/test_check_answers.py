"""Right answers pass, and every planted mistake is found and named."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from support import ray_programs as programs
from support.ray_programs import BAD, GOOD

from mi_refract import oracle
from mi_refract.accuracy import lengths
from mi_refract.formulas import FORMULAS
from mi_refract.ray_sets import diagnosis, ray_set, tir_signal
from mi_refract.ray_sets.check_answers import LOOSEST, check
from mi_refract.ray_sets.diagnosis import MISTAKES
from mi_refract.ray_sets.judged_answers import judge_answers
from mi_refract.ray_sets.ray_set import Answers, RaySet
from mi_refract.regimes import Rays

PRECISIONS = list(ray_set.PRECISIONS)
COUNT = 40
BUDGET = FORMULAS[LOOSEST].budget


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


# What is right


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("tir", GOOD)
def test_the_textbook_passes_with_every_signal(precision, tir):
    to = some(precision)
    answers = answered(to, GOOD[tir])
    for told in ("auto", tir):
        found = check(to, answers, tir=told)
        assert (found.exit_code, found.wrong, found.problems, found.explanations) == (0, 0, (), ())
        assert (found.tir, found.tir_given) == (tir, told != "auto")
        assert found.answered == len(to)
        assert [each.regime for each in found.regimes] == list(ray_set.DEFAULT)
    assert found.total("exact") < found.answered  # it is not exact, and it is not called so


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("names", [ray_set.DEFAULT, ("lengths", "off unit", "tangential", "exactly critical")])
def test_the_exact_answers_are_exact(precision, names):
    to, (certified, answers) = some(precision, names), exact(precision, names)
    for budget in (LOOSEST, "promoted"):
        found = check(to, answers, error_bound=budget)
        assert found.exit_code == 0
        assert found.total("exact") == found.answered == len(to)
        assert sum(each.tir_misclassified for each in found.regimes) == 0
        assert max(each.worst for each in found.regimes) <= found.ulp
    flagged = check(to, Answers(to.ids, answers.b, certified.transmitted))
    assert (flagged.exit_code, flagged.tir) == (0, "flag")
    for kind in (int, np.uint8, float):
        assert check(to, Answers(to.ids, answers.b, certified.transmitted.astype(kind))).total("wrong") == 0
    with pytest.raises(ValueError, match=r"^answers: transmitted is 2; expected 0 or 1$"):
        Answers(to.ids, answers.b, np.full(len(to), 2))


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
    across = np.cross(answers.b[rows], to.rays.n[rows])
    across /= lengths(across).astype(float)[:, None]
    turned = 1.25 * (np.cos(angle) * answers.b[rows] + np.sin(angle) * across)
    found = check(to, changed(answers, rows, turned))
    generic = found.regimes[0]
    assert generic.worst == pytest.approx(1e-3, rel=1e-9)
    compared = np.concatenate([angle.ravel(), np.zeros(generic.compared - len(rows))])
    assert generic.mean == pytest.approx(compared.mean(), rel=1e-6)
    assert generic.p99 == pytest.approx(np.quantile(compared, 0.99), rel=1e-6)
    assert generic.length_error == pytest.approx(0.25, rel=1e-9)
    assert generic.wrong == found.wrong == len(rows)
    assert generic.exact == generic.rays - len(rows)
    assert generic.replay["id"] in to.ids[rows]
    assert found.ulp == 2.0**-52


def test_one_wrong_answer_is_enough():
    to = some()
    answers = answered(to, programs.glsl)
    row = int(np.flatnonzero((to.regime == "Brewster") & answers.b.any(1))[7])
    found = check(to, changed(answers, row, answers.b[row] + [0, 2e-4, 0]))
    assert (found.exit_code, found.wrong) == (1, 1)
    worst = found.regimes[ray_set.DEFAULT.index("Brewster")].replay
    assert worst["id"] == to.ids[row]
    assert [float.fromhex(x) for x in worst["a"]] == to.rays.a[row].tolist()
    assert found.diagnosis is None


def test_the_textbook_is_not_exact():
    found = check(some(), answered(some(), programs.glsl), error_bound="promoted")
    assert found.exit_code == 1
    assert found.error_bound == "promoted"
    assert found.wrong == sum(each.rays - each.exact for each in found.regimes)


@pytest.mark.parametrize("lost", [1e-2, 1e-3])
def test_giving_up_before_the_critical_angle_is_seen(lost):
    to, (certified, _) = some("f64"), exact("f64")
    answers = answered(to, programs.glsl)
    rows = np.flatnonzero(certified.transmitted & (certified.cos_t < lost) & (to.regime == "critical"))
    found = check(to, changed(answers, rows, 0))
    critical = found.regimes[ray_set.DEFAULT.index("critical")]
    assert len(rows) > 0
    assert critical.tir_beyond_bound >= len(rows) == critical.wrong
    assert found.exit_code == 1


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
    assert len({each.mistake for each in found.explanations}) == len(found.explanations) == len(MISTAKES) + 2


def test_every_usual_mistake_was_planted():
    assert set(BAD) == set(MISTAKES)


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
    b = answers.b[rows]
    across = np.cross(b, to.rays.n[rows])
    across *= (share * bound / lengths(across).astype(float))[:, None]
    diagnosis = check(to, changed(answers, rows, (b + across) / np.hypot(1, share * bound)[:, None])).diagnosis
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


def test_a_mistake_that_changes_nothing_explains_nothing():
    """Its share is 0, and not that of the answers to no ray: the variant with an effect is the one that is named."""
    to = some("f32", ("generic",))
    judged = judge_answers(
        answered(to, lambda a, n, k: programs.glsl(a, n, 1 / k)).b, None, to.rays, "f32", BUDGET, "zero"
    )
    case = diagnosis.Case.of(judged.verdict.bounds, np.arange(len(to)))
    table = {"none": lambda case: case.right, "some": lambda case: -case.right}
    found = diagnosis._best_variant("x", table, case, judged.b, judged.verdict.wrong)
    assert (found.share, found.explains) == (0, False)
    with np.errstate(invalid="ignore"):
        found = diagnosis._best_variant("x", table | {"it": lambda case: case.inverted}, case, judged.b, judged.wrong)
    assert (found.text, found.share, found.explains) == ("it", 1, True)


def test_two_mistakes_have_no_name():
    to = some()
    found = check(to, answered(to, lambda a, n, k: programs.swapped(programs.glsl(a, n, 1 / k))))
    assert (found.exit_code, found.diagnosis) == (1, None)


def test_noise_has_no_name():
    to = some()
    b = np.random.default_rng(1).normal(size=(len(to), 3))
    found = check(to, Answers(to.ids, b / np.sqrt((b * b).sum(1, keepdims=True))))
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
    answers = answered(to, programs.glsl)
    rows = np.flatnonzero(~certified.transmitted)[::2]
    found = check(to, changed(answers, rows, np.nan))
    assert (found.exit_code, found.tir) == (1, tir_signal.UNCLEAR)
    assert {each.kind for each in found.problems} == {"zero", "non-finite"}


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
    assert found.exit_code == 1
    assert sum(each.tir_misclassified for each in found.regimes) == len(to)
    assert sum(each.tir_beyond_bound for each in found.regimes) > 0.6 * len(to)


def test_no_ray_with_total_internal_reflection():
    to = some("f32", ("k ≪ 1", "near-normal"))
    answers = answered(to, programs.glsl)
    assert check(to, answers).tir == tir_signal.NONE
    for b, kind in ((np.nan, "non-finite"), (0, "zero"), (np.inf, "non-finite")):
        found = check(to, changed(answers, [3, 5], b))
        assert (found.exit_code, found.wrong) == (1, 2)
        assert [(each.kind, each.count, each.text) for each in found.problems] == [(kind, 2, "ids 3, 5")]


def test_only_nan_passes_nothing():
    for precision in PRECISIONS:
        found = check(some(precision), answered(some(precision), lambda a, n, k: a * np.nan))
        assert found.exit_code == 1
        assert found.wrong > found.answered / 2


# Answers that are not those to the rays


@pytest.mark.parametrize("regime", ["exactly critical", "tangential"])
@pytest.mark.parametrize("value", [np.nan, 0.0])
def test_answers_to_ambiguous_rays_alone_are_no_pass(regime, value):
    to = some("f32", (regime,))
    found = check(to, Answers(to.ids, np.full((len(to), 3), value)))
    assert (found.exit_code, found.total("compared"), found.wrong) == (1, 0, 0)


def test_missing_duplicate_and_unknown():
    to = some()
    answers = answered(to, programs.glsl)
    keep = np.r_[0:50, 53 : len(to)]
    ids = np.r_[answers.ids[keep], 7, 9, -4, 10**9]
    found = check(to, Answers(ids, np.vstack([answers.b[keep], np.ones((4, 3))])))
    assert found.exit_code == 2
    told = {each.kind: (each.count, each.text) for each in found.problems}
    assert told == {
        "missing": (3, "ids 50, 51, 52"),
        "duplicate": (2, "ids 7, 9"),
        "unknown": (2, "ids -4, 1000000000"),
    }
    assert found.answered == len(to) - 3
    assert found.wrong == 0  # the first answer counts


def test_any_order_will_do():
    to, answers = some(), answered(some(), programs.glsl)
    order = np.random.default_rng(2).permutation(len(to))
    assert check(to, Answers(answers.ids[order], answers.b[order])).exit_code == 0
    found = check(to, Answers(answers.ids[order], answers.b))
    assert (found.exit_code, found.diagnosis) == (1, None)


@pytest.mark.parametrize("ids", [[], [-1, -2]])
def test_no_answer_at_all(ids):
    found = check(some(), Answers(np.array(ids, int), np.ones((len(ids), 3))))
    assert (found.exit_code, found.answered, found.regimes) == (2, 0, ())
    assert {"missing"} <= {each.kind for each in found.problems}


def test_answers_to_other_rays():
    to, other = some(), ray_set.make(count=COUNT, seed=5)
    answers = answered(to, programs.glsl)
    assert check(to, Answers(to.ids, answers.b, header=to.header)).exit_code == 0
    with pytest.raises(ValueError, match="the answers are to rays with the checksum"):
        check(to, Answers(to.ids, answers.b, header=other.header))


@pytest.mark.parametrize("given", [{"tir": "zeros"}, {"error_bound": "decompose"}])
def test_unknown_names(given):
    with pytest.raises(ValueError, match="unknown; expected "):
        check(some(), exact("f32")[1], **given)


def test_answers_of_another_shape():
    with pytest.raises(ValueError, match=r"expected a direction for each id"):
        Answers(np.arange(3), np.zeros((2, 3)))


def test_the_default_bound_is_the_loosest():
    u, k = 2.0**-24, np.geomspace(1e-3, 1e6, 50)
    bounds = {name: formula.budget.chord(u, k) for name, formula in FORMULAS.items()}
    assert all((bound <= bounds[LOOSEST]).all() for bound in bounds.values())


# How wide the bounds are


@pytest.mark.parametrize("precision", PRECISIONS)
def test_vectors_off_unit_excuse_no_more_than_making_them_unit_costs(precision):
    """1000 u across the plane of incidence, where 3 u of the vectors allow 10 · 3 u and less than 14 · 3 u k²."""
    to, (found, answers) = some(precision, ("lengths",)), exact(precision, ("lengths",))
    rows = np.flatnonzero(found.transmitted & (to.rays.k < 2) & (found.cos_t > 0.5))
    across = np.cross(answers.b[rows], to.rays.n[rows])
    across *= lengths(answers.b[rows]).astype(float)[:, None] / lengths(across).astype(float)[:, None]
    off = changed(answers, rows, answers.b[rows] + 1000 * to.roundoff * across)
    assert len(rows) > 5
    assert check(to, off).wrong == len(rows)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("flip", [True, False], ids=["transmitted", "reflected"])
def test_next_to_the_surface_total_reflection_is_decided_all_the_same(precision, flip):
    """Cosines of 1e-4, of either angle: far from all that rounding excuses, |n·a| ≤ 4 u and |radicand| ≤ 14 u k²."""
    c = np.float64(1e-4)
    sin = np.sqrt(1 - c * c)
    dtype, u = ray_set.PRECISIONS[precision], float(np.finfo(ray_set.PRECISIONS[precision]).eps) / 2
    near = 1e-4 if precision == "f64" else 4e-3  # cos θ_t: its square is the radicand
    cases = [  # θ_i, k
        *[(sin, -c, 0.5), (sin, -c, 1.5)],  # grazing: transmitted, reflected
        *[
            (np.sqrt(1 - near**2) / 1.5, None, 1.5),
            (np.sqrt(1 + near**2) / 1.5, None, 1.5),
        ],  # next to the critical angle
    ]
    a = np.array([[s, 0, z if z is not None else -np.sqrt(1 - s * s)] for s, z, _ in cases]).astype(dtype)
    n, k = np.tile(np.array([[0, 0, 1]], dtype), (4, 1)), np.array([x[2] for x in cases], dtype)
    rays = Rays(a, n, k)
    to = RaySet(rays, np.arange(4), {"precision": precision, "regimes": {"x": [0, 3]}, "checksum": ""})
    certified = oracle.refract(a, n, k, fresnel=False, progress=False)
    assert certified.transmitted.tolist() == [True, False, True, False]
    assert near**2 > 2 * 14 * u * 1.5**2
    right = Answers(to.ids, certified.direction, certified.transmitted)
    assert check(to, right).wrong == 0
    rows = certified.transmitted == flip
    found = check(to, Answers(to.ids, certified.direction, certified.transmitted ^ rows))
    assert found.total("tir_beyond_bound") == 2

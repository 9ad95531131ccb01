"""The studies of directions: the fast screen is right, the worst rays are replayed, and planted defects are seen."""

import dataclasses
import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refract import oracle, regimes
from mi_refract.accuracy import errors, evaluate, judge_formula
from mi_refract.formulas import FORMULAS
from mi_refract.ray_sets import ray_set
from mi_refract.ray_sets.judged_answers import RIGHT
from mi_refract.regimes import REGIMES
from validation import limits
from validation.directions import bsdf_samples, per_formula, planted_defects, search, sweep
from validation.directions.planted_defects import MUTANTS
from validation.directions.search import Found
from validation.reference.fast_reference import Screen
from validation.run import seeds
from validation.run.array_settings import budget_of, settings
from validation.suite import small_mistakes

PROMOTED = FORMULAS["promoted"]


@pytest.fixture
def replace(monkeypatch):
    """Put `function` in the place of a formula."""

    def plant(name, **fields):
        monkeypatch.setitem(FORMULAS, name, dataclasses.replace(FORMULAS[name], **fields))

    return plant


def margin(a, n, k):
    """How near to the critical angle, for planted defects."""
    wide = dr.float64_array_t(type(a))
    _, d, terms = regimes.radicand(wide(a), wide(n), dr.value_t(wide)(k))
    return dr.value_t(type(a))(dr.abs(d[0]) / terms)


# Sweep and search ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("regime", REGIMES)
def test_the_screen_is_right_where_it_is_certain(regime, vectorised):
    rays = regimes.make(regime, 1500, vectorised.precision, seed=11)
    screen = Screen(rays, vectorised.vector)
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    b, transmitted = evaluate(PROMOTED, rays, vectorised.vector)
    chord, wrong = screen.judge(PROMOTED)
    certain = ~screen.doubtful
    assert (wrong == (transmitted != exact.transmitted))[certain].all()
    certified = errors(b, rays, exact)[0] / vectorised.roundoff
    assert np.abs(chord - certified)[certain & ~wrong].max(initial=0) <= limits.SCREEN_OFF
    # Neither has terms at k = 1 along the surface; their sum is up to twice the larger one.
    theirs, ours = oracle.relative_radicand(rays.a, rays.n, rays.k)[certain], screen.relative_radicand[certain]
    assert (np.isnan(theirs) == np.isnan(ours)).all()
    ratio = (ours / theirs)[~np.isnan(theirs) & (theirs != 0)]
    assert ((ratio >= 0.49) & (ratio <= 1.01)).all()
    assert certain.all() or regime in ("exactly critical", "on a denormal")
    assert np.isinf(screen.judge(lambda a, n, k: (a * dr.nan, k > 0))[0]).all()


def rare(a, n, k, contrast=None):
    """Wrong in the last digits, of one ray in ten thousand."""
    b, transmitted = PROMOTED.function(a, n, k, contrast)
    return dr.select(dr.abs(a[0]) < 1e-4, b * (1 + 4 * dr.epsilon(type(b))), b), transmitted


def stubborn(a, n, k, contrast=None):
    """Takes what is next to the critical angle for beyond it."""
    b, transmitted = PROMOTED.function(a, n, k, contrast)
    return b, transmitted & (margin(a, n, k) > 1e-6)


@pytest.mark.parametrize(
    ("defect", "regime", "broken"),
    [(rare, "generic", {"error / bound"}), (stubborn, "critical", {"TIR misclassified, beyond its bound"})],
)
def test_a_sweep_sees_defects_of_a_few_rays(defect, regime, broken, float32, replace):
    count = 2 * sweep.CHUNK + 1000
    replace("compensated", function=defect)
    rows = {row.subject: row for row in sweep.regime_rows(regime, float32, count, 16)}
    assert rows["promoted"].verdict == "pass" and rows["promoted"].values["rays"] == count
    assert set(rows["compensated"].broken) == broken
    assert {"a", "n", "k"} == set(rows["compensated"].replay["worst ray"])


def rare_twice(a, n, k):
    """2 u off where the radicand is within u/100 of 0; a wrong decision where it is u/1000 to u/500 of its terms."""
    b, transmitted = PROMOTED(a, n, k)
    u = dr.epsilon(type(b)) / 2
    near = margin(a, n, k) / u
    return dr.select(near < 0.01, b * (1 + 4 * u), b), transmitted ^ ((near > 1e-3) & (near < 2e-3))


def test_the_search_finds_defects_that_sampling_misses(vectorised):
    sample = Screen(regimes.make("critical", search.SAMPLE, vectorised.precision, search.SEED), vectorised.vector)
    chord, wrong = sample.judge(rare_twice)
    assert chord.max() < 0.8724 and not wrong.any()

    def over(subject):
        herd = search.climb("promoted", subject, ["critical"], vectorised, 40)
        found = search.certify("promoted", subject, herd, vectorised)
        return {f.objective for f in found if f.share > {"chord": 1, "decision": 0}[f.objective]}

    assert over(rare_twice) == {"chord", "decision"}
    assert over(PROMOTED) == set()


def test_the_herd_stays_in_its_domain_and_gets_no_better(vectorised, monkeypatch):
    """Of one child a parent, which is often worse than it: of many, one nearly always is as bad."""
    monkeypatch.setattr(search, "CHILDREN", 1)
    names = ("generic", "lengths", "axes, signed zeros")
    first, *_, last = herds = [search.climb("promoted", PROMOTED, names, vectorised, g) for g in (0, 1, 2, 12)]
    assert all((y.score >= x.score).all() for x, y in itertools.pairwise(herds))
    assert (last.score > first.score).any()
    unit, slack = last.regime == 0, 3**0.5 / 2 * vectorised.roundoff  # rounding moves a length by √3/2 u
    for v in (last.rays.a, last.rays.n):
        length = np.sqrt((v.astype(np.longdouble) ** 2).sum(1))
        assert np.where(unit, np.abs(length - 1) <= slack, (length > 1e-18) & (length < 1e18)).all()
    assert ((last.rays.k >= 1e-6) & (last.rays.k <= np.where(unit, 1.5, 1e6))).all()


def test_rays_that_are_not_judged_do_not_leave_their_regime(vectorised):
    """In float64 the screen resolves no ray of this regime, so that every child is as bad as its parent."""
    herd = search.climb("promoted", PROMOTED, ["on a denormal"], vectorised, 4, sample=500)
    lengths = np.linalg.norm(np.stack([herd.rays.a, herd.rays.n]).astype(float), axis=2)
    assert np.abs(lengths - 1).max() <= 4 * vectorised.roundoff


def test_every_formula_has_its_rows(scalar_context, monkeypatch, float32):
    for study in (search, sweep):
        monkeypatch.setattr(study, "settings", lambda context: [float32])
    context = scalar_context(sweep_rays=2000, certified=4, generations=1)
    rows = [row for study in (sweep, search) for task in study.tasks(context) for row in task.run()]
    assert {(row.study, row.subject) for row in rows} == {(s, name) for s in ("sweep", "search") for name in FORMULAS}
    assert [row.name for row in rows if row.verdict not in ("pass", "info")] == []
    assert {row.case for row in rows if row.verdict == "info"} == {"on a denormal"}


# The worst rays ------------------------------------------------------------------------------------------------------


def broken(name, subject, lines, setting):
    """The lines on which `subject` breaks the budget of `name`, and by what."""
    rays = search.rays_of(lines, setting.name)
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    seen = judge_formula(subject, rays, exact, setting.vector, budget_of(name))
    counted = [not setting.no_budget(budget_of(name), line.regime) for line in lines]
    wrong = np.flatnonzero(seen.wrong & counted).tolist()
    return [(lines[i].line(), "misjudged" if seen.far[i] else f"{seen.share[i]:.3g} of the bound") for i in wrong]


def test_every_formula_is_within_its_budget_on_the_worst_rays_and_forms_that_cancel_are_not(setting):
    lines = [found for found in search.worst_rays() if found.precision == setting.name]
    assert {found.formula for found in lines} == set(FORMULAS)
    assert len({found.regime for found in lines} & set(REGIMES)) >= len(REGIMES) / 2
    assert all(Found.parse(found.line()) == found for found in lines)
    for name, formula in FORMULAS.items():
        assert broken(name, formula, lines, setting) == []
    if setting.backend != "scalar":
        for name in ("decomposed", "cross"):
            assert len(broken("promoted", FORMULAS[name], lines, setting)) > len(lines) / 2


@pytest.mark.parametrize(
    "text", ["float32 | promoted", "p | f | r | o | 1 | 0 0 nan | 0 0 1 | 1", "p | f | r | o | 1 | 0 0 | 0 0 1 | 1"]
)
def test_a_line_that_is_no_ray_is_refused(text, tmp_path):
    (tmp_path / "worst.txt").write_text(f"# remark\n{text}\n")
    with pytest.raises(ValueError, match="not"):
        search.worst_rays(tmp_path / "worst.txt")


# Planted defects -----------------------------------------------------------------------------------------------------


def test_every_formula_is_spoilt_and_what_escapes_or_is_seen_in_vain_fails(monkeypatch, vectorised):
    spoilt = [set(mutant.of) for name, mutant in MUTANTS.items() if name != "control"]
    assert set.union(*spoilt) == set(FORMULAS) == set(MUTANTS["control"].of)
    rows, sample = {}, planted_defects.draw(100, vectorised.precision)
    for planted, other in (("swapped k", "control"), ("control", "swapped k")):
        with monkeypatch.context() as patch:
            patch.setitem(MUTANTS, planted, dataclasses.replace(MUTANTS[planted], answer=MUTANTS[other].answer))
            rows[planted] = planted_defects.row(planted, "promoted", vectorised, sample)
    assert rows["swapped k"].broken == {"escaped": 0.0}
    assert rows["control"].broken == {"rays that see it": 0.0}
    assert rows["control"].reason.startswith("caught by ")
    assert f": {planted_defects.MISCLASSIFIED_FAR} " in rows["control"].reason


def test_a_rare_defect_is_seen_by_many_rays_with_any_seed(vectorised):
    """Of as many rays of each regime one to six see it; with this seed none did."""
    with seeds.shifted(12):
        sample = planted_defects.draw(planted_defects.COUNT, vectorised.precision)
        row = planted_defects.row("radicand of second order", "compensated", vectorised, sample)
    assert row.verdict == "pass" and row.values["rays that see it"] > 10


@pytest.mark.parametrize("precision", ray_set.PRECISIONS)
def test_small_mistakes_are_seen_where_they_matter_and_fail_where_they_are_not(precision, monkeypatch):
    monkeypatch.setitem(small_mistakes.MISTAKES, "none", small_mistakes.Mistake(small_mistakes.textbook, "generic"))
    for name, mistake in small_mistakes.MISTAKES.items():
        (row,) = small_mistakes.rows(name, precision)
        harmless = precision == mistake.harmless[0]
        assert row.broken == ({"not seen": 0.0} if name == "none" else {}), name
        assert row.values["not seen"] == (harmless or name == "none")
        assert row.values["m, worst, without"] <= RIGHT < row.values["m, worst"] or row.values["not seen"]


@pytest.mark.parametrize(("constant", "factor"), [("linear", 6), ("radicand", 6), ("linear", 1), ("linear", 0.2)])
def test_a_loose_or_too_tight_budget_fails_the_full_sweep(constant, factor, scalar_context, replace, monkeypatch):
    monkeypatch.setattr(limits, "SLACK_FROM_RAYS", 60)
    budget, setting = FORMULAS["decomposed"].budget, settings(scalar_context())[0]
    replace("decomposed", budget=dataclasses.replace(budget, **{constant: factor * getattr(budget, constant)}))
    subject, regimes = FORMULAS["decomposed"], ("grazing", "critical", "k ≫ 1")
    parts = [per_formula.regime_row("decomposed", subject, regime, setting, 3000) for regime in regimes]
    whole = per_formula.summary("decomposed", parts, setting, {})
    assert set(whole.budgets) == {"slack, linear", "slack, radicand"}
    seen = {metric for row in (whole, *parts) for metric in row.broken}
    assert seen == ({f"slack, {constant}"} if factor > 1 else {"error / bound"} if factor < 1 else set())


def test_directions_name_what_does_not_run_and_hold_what_does(scalar_context):
    context = scalar_context(scalar_rays=60)
    absent = {s.label for s in settings(context) if s.vector is None}
    asked = [task for task in per_formula.tasks(context) if "scalar" in task.name or task.name.endswith((*absent, "-"))]
    rows = [row for task in asked for row in task.run()]
    assert {row.setting for row in rows if row.verdict == "not run" and row.reason} == absent
    assert {row.verdict for row in rows if row.setting not in absent} == {"info", "pass"}


# Samples of the plugins ----------------------------------------------------------------------------------------------


def test_samples_pass_and_see_an_index_that_is_off(scalar_context, monkeypatch):
    rows = lambda: bsdf_samples.tasks(scalar_context(scalar_rays=200))[0].run()  # noqa: E731
    assert {row.verdict for row in rows()} == {"pass"}
    load = mi.load_dict
    # By 1e-5: one bound for all rays, that of the critical angle, would allow 1.4e-3.
    monkeypatch.setattr(mi, "load_dict", lambda d: load(d | {"int_ior": 1.50001} if d["type"] == "refract" else d))
    assert {"eta worst", "wo / bound", "pdf / bound", "weight / bound"} <= set(rows()[0].broken)


@pytest.mark.parametrize(("expected", "most"), [(0.0, 0), (1e-7, 0), (1e-3, 1), (0.05, 3), (1.0, 9)])
def test_flips_are_allowed_as_chance_has_them(expected, most):
    """The smallest m with P(Poisson > m) ≤ 1e-6: for a small mean x, x^(m+1)/(m+1)!."""
    assert bsdf_samples.most_flips(expected) == most

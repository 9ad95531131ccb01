"""Screen, sweep and search: they agree with the oracle, find planted defects, and the worst rays are replayed."""

import dataclasses
import itertools

import drjit as dr
import numpy as np
import pytest

from mi_refract import oracle, regimes
from mi_refract.accuracy import errors, evaluate, judge_formula
from mi_refract.formulas import FORMULAS
from mi_refract.regimes import REGIMES, Rays
from validation import limits
from validation.directions import search, sweep
from validation.directions.search import Found
from validation.reference.fast_reference import Screen
from validation.run.array_settings import Setting, budget_of


@pytest.fixture(scope="module")
def measured(vectorised):
    """The setting of the tests as one of the validation."""
    return Setting(vectorised.backend, vectorised.precision, vectorised.vector)


@pytest.fixture(scope="module")
def in_float32(float32):
    """As `measured`, in float32 only."""
    return Setting(float32.backend, float32.precision, float32.vector)


@pytest.fixture
def replace(monkeypatch):
    """Put `function` in the place of a formula."""

    def plant(name, function):
        monkeypatch.setitem(FORMULAS, name, dataclasses.replace(FORMULAS[name], function=function))

    return plant


def margin(a, n, k):
    """How near to the critical angle, for planted defects."""
    wide = dr.float64_array_t(type(a))
    _, d, terms = regimes.radicand(wide(a), wide(n), dr.value_t(wide)(k))
    return dr.value_t(type(a))(dr.abs(d[0]) / terms)


# The screen ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("regime", REGIMES)
def test_the_screen_is_right_where_it_is_certain(regime, measured):
    rays = regimes.make(regime, 1500, measured.precision, seed=11)
    screen = Screen(rays, measured.vector)
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    b, transmitted = evaluate(FORMULAS["promoted"], rays, measured.vector)
    chord, wrong = screen.judge(FORMULAS["promoted"])
    certain = ~screen.doubtful
    assert (wrong == (transmitted != exact.transmitted))[certain].all()
    compared = certain & ~wrong
    certified = errors(b, rays, exact)[0] / measured.roundoff
    assert np.abs(chord - certified)[compared].max(initial=0) <= limits.SCREEN_OFF
    # Neither has terms at k = 1 along the surface; their sum is up to twice the larger one.
    theirs, ours = oracle.relative_radicand(rays.a, rays.n, rays.k)[certain], screen.relative_radicand[certain]
    assert (np.isnan(theirs) == np.isnan(ours)).all()
    ratio = (ours / theirs)[~np.isnan(theirs) & (theirs != 0)]
    assert ((ratio >= 0.49) & (ratio <= 1.01)).all()
    assert certain.all() or regime in ("exactly critical", "on a denormal")


def test_the_screen_sees_one_bit_and_calls_nan_infinite(measured):
    screen = Screen(regimes.make("generic", 400, measured.precision, seed=2), measured.vector)

    def last_bit(a, n, k):
        b, transmitted = FORMULAS["promoted"](a, n, k)
        return b * (1 + 2 * dr.epsilon(type(b))), transmitted

    assert screen.judge(FORMULAS["promoted"])[0].max() < 0.8724 < 2 < screen.judge(last_bit)[0].max()
    assert np.isinf(screen.judge(lambda a, n, k: (a * dr.nan, k > 0))[0]).all()


# The sweep -----------------------------------------------------------------------------------------------------


def test_the_best_are_the_best_of_all_chunks():
    rng = np.random.default_rng(1)
    score = rng.random(1000)
    rays = Rays(np.repeat(score[:, None], 3, 1), np.zeros((1000, 3)), score)
    kept = sweep.Best(20)
    for chunk in np.array_split(np.arange(1000), 7):
        kept.add(rays[chunk], score[chunk], score[chunk] < 0.9, 2 * score[chunk])
    expected = np.sort(score[score < 0.9])[-20:]
    assert np.sort(kept.score).tolist() == expected.tolist() == np.sort(kept.rays.k).tolist()
    assert (kept.chord == 2 * kept.score).all()
    assert kept.offered == np.count_nonzero(score < 0.9)


def rare(a, n, k, contrast=None):
    """Wrong in the last digits, of one ray in ten thousand."""
    b, transmitted = FORMULAS["promoted"].function(a, n, k, contrast)
    return dr.select(dr.abs(a[0]) < 1e-4, b * (1 + 4 * dr.epsilon(type(b))), b), transmitted


def stubborn(a, n, k, contrast=None):
    """Takes what is next to the critical angle for beyond it."""
    b, transmitted = FORMULAS["promoted"].function(a, n, k, contrast)
    return b, transmitted & (margin(a, n, k) > 1e-6)


@pytest.mark.parametrize(
    ("defect", "regime", "broken"),
    [(rare, "generic", {"error / bound"}), (stubborn, "critical", {"TIR misclassified, beyond its bound"})],
)
def test_a_sweep_sees_defects_of_a_few_rays(defect, regime, broken, in_float32, replace, monkeypatch):
    monkeypatch.setattr(sweep, "CHUNK", 20_000)
    sound = {row.subject: row for row in sweep.regime_rows(regime, in_float32, 50_000, 16)}
    assert sound["promoted"].verdict == "pass"
    assert sound["promoted"].values["rays"] == 50_000
    replace("compensated", defect)
    row = {row.subject: row for row in sweep.regime_rows(regime, in_float32, 50_000, 16)}["compensated"]
    assert set(row.broken) == broken
    assert {"a", "n", "k"} == set(row.replay["worst ray"])


def test_what_the_screen_cannot_resolve_is_certified_or_counted(measured):
    row = {row.subject: row for row in sweep.regime_rows("exactly critical", measured, 1000, 4)}["promoted"]
    assert row.verdict == "pass"
    assert row.values["certified"] == 4 * sweep.UNRESOLVED_SHARE
    assert row.values["unresolved"] == 1000 - 4 * sweep.UNRESOLVED_SHARE


# The search ----------------------------------------------------------------------------------------------------


def bump(a, n, k):
    """2 u off, but only where the radicand is within u/100 of 0."""
    b, transmitted = FORMULAS["promoted"](a, n, k)
    width, u = 0.01 * dr.epsilon(type(b)) / 2, dr.epsilon(type(b)) / 2
    return dr.select(margin(a, n, k) < width, b * (1 + 4 * u), b), transmitted


def window(a, n, k):
    """A decision that is wrong only where the radicand is between u/1000 and u/500 of its terms."""
    b, transmitted = FORMULAS["promoted"](a, n, k)
    near = margin(a, n, k) * 1e3 / (dr.epsilon(type(b)) / 2)
    return b, transmitted ^ ((near > 1) & (near < 2))


def rare_twice(a, n, k):
    """Both."""
    (b, _), (_, transmitted) = bump(a, n, k), window(a, n, k)
    return b, transmitted


def test_the_search_finds_defects_that_sampling_misses(measured):
    sample = Screen(regimes.make("critical", search.SAMPLE, measured.precision, search.SEED), measured.vector)
    chord, wrong = sample.judge(rare_twice)
    assert chord.max() < 0.8724 and not wrong.any()

    def over(subject):
        herd = search.climb("promoted", subject, ["critical"], measured, 40)
        found = search.certify("promoted", subject, herd, measured)
        return {f.objective for f in found if f.share > {"chord": 1, "decision": 0}[f.objective]}

    assert over(rare_twice) == {"chord", "decision"}
    assert over(FORMULAS["promoted"]) == set()


def test_the_herd_stays_in_its_domain_and_gets_no_better(measured):
    names = ("generic", "lengths", "axes, signed zeros")
    herds = [search.climb("promoted", FORMULAS["promoted"], names, measured, g) for g in (0, 1, 2, 12, 12)]
    for before, after in itertools.pairwise(herds):
        assert (after.score >= before.score).all()
    assert (herds[3].score > herds[0].score).any()
    assert herds[4].rays.a.tobytes() == herds[3].rays.a.tobytes()
    unit, slack = herds[3].regime == 0, 3**0.5 / 2 * measured.roundoff  # rounding moves a length by √3/2 u
    for v in (herds[3].rays.a, herds[3].rays.n):
        length = np.sqrt((v.astype(np.longdouble) ** 2).sum(1))
        assert np.where(unit, np.abs(length - 1) <= slack, (length > 1e-18) & (length < 1e18)).all()
    assert ((herds[3].rays.k >= 1e-6) & (herds[3].rays.k <= np.where(unit, 1.5, 1e6))).all()


def test_every_formula_has_its_rows(in_float32, scalar_context, monkeypatch):
    monkeypatch.setattr(search, "settings", lambda context: [in_float32])
    monkeypatch.setattr(sweep, "settings", lambda context: [in_float32])
    context = scalar_context(sweep_rays=2000, certified=4, generations=1)
    rows = [row for study in (sweep, search) for task in study.tasks(context) for row in task.run()]
    assert {(row.study, row.subject) for row in rows} == {(s, name) for s in ("sweep", "search") for name in FORMULAS}
    assert [row.name for row in rows if row.verdict not in ("pass", "info")] == []
    assert {row.case for row in rows if row.verdict == "info"} == {"on a denormal"}


# The worst rays ------------------------------------------------------------------------------------------------


LINE = "float32 | promoted | generic | chord | 0.8700 | 0x1.8p-1 0x0p+0 -0x1p-1 | 0x0p+0 0x0p+0 0x1p+0 | 0x1.8p+0"


def test_a_line_is_a_ray():
    found = Found.parse(LINE)
    assert (found.formula, found.regime, found.objective, found.score) == ("promoted", "generic", "chord", 0.87)
    assert Found.parse(found.line()) == found
    assert search.rays_of([found], "float32").k.tolist() == [1.5] and not len(search.rays_of([found], "float64"))


@pytest.mark.parametrize(
    "text", ["float32 | promoted", "p | f | r | o | 1 | 0 0 nan | 0 0 1 | 1", "p | f | r | o | 1 | 0 0 | 0 0 1 | 1"]
)
def test_a_line_that_is_no_ray_is_refused(text, tmp_path):
    (tmp_path / "worst.txt").write_text(f"# remark\n{LINE}\n{text}\n")
    with pytest.raises(ValueError, match="not"):
        search.worst_rays(tmp_path / "worst.txt")


def broken(name, subject, lines, setting):
    """The lines on which `subject` breaks the budget of `name`, and by what."""
    rays = search.rays_of(lines, setting.precision.__name__)
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    seen = judge_formula(subject, rays, exact, setting.vector, budget_of(name))
    counted = [not setting.no_budget(budget_of(name), line.regime) for line in lines]
    return [
        (lines[i].line(), "misjudged" if seen.far[i] else f"{seen.share[i]:.3g} of the bound")
        for i in np.flatnonzero(seen.wrong & counted).tolist()
    ]


@pytest.fixture(scope="module")
def lines(setting):
    return [found for found in search.worst_rays() if found.precision == setting.name]


@pytest.mark.parametrize("name", FORMULAS)
def test_every_formula_is_within_its_budget_on_the_worst_rays(name, setting, lines):
    measured = Setting(setting.backend, setting.precision, setting.vector)
    assert broken(name, FORMULAS[name], lines, measured) == []


@pytest.mark.parametrize("mutant", ["decomposed", "cross"])
def test_the_replay_sees_a_form_that_cancels(mutant, measured):
    lines = [found for found in search.worst_rays() if found.precision == measured.precision.__name__]
    assert len(broken("promoted", FORMULAS[mutant], lines, measured)) > len(lines) / 2


def test_the_worst_rays_are_of_all_formulas_and_of_most_regimes(setting, lines):
    assert {found.formula for found in lines} == set(FORMULAS)
    assert len({found.regime for found in lines} & set(REGIMES)) >= len(REGIMES) / 2

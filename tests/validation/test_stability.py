"""The closed answers of the stability study against independent evaluations, and its sight of planted defects."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from flint import arb, ctx, fmpq

from mi_refract import FORMULAS, backend, oracle
from validation.reference import closed_forms, optical_systems
from validation.run.array_settings import BUILTIN
from validation.run.context import SCALAR_PROFILES, Context
from validation.stability import layer_chains, optical_chains
from validation.stability.layer_chains import air, carry, enter, exact_ratios, pipe

HERE = Context(SCALAR_PROFILES["standard"], Path(), "scalar_rgb", backend.detect(), backend.usable_variants())
SETTINGS = {setting.label: setting for setting in optical_chains.settings(HERE)}
SCALAR = SETTINGS["scalar float64"]
SMALL = optical_chains.Extent((40,), ("askew",), 60, (89.4, 89.8), False)
ASKEW = optical_chains.PLANES["askew"]
DEGREES = optical_chains.PASSING + optical_chains.TURNING


def compiled(precision):
    setting = SETTINGS[f"llvm {precision}"]
    return setting if setting.vector is not None else pytest.skip(f"llvm: {setting.reason}")


def exactly(x):
    """A number of extended precision as a ball: two doubles hold its 64 bits."""
    high = float(x)
    return arb(high) + arb(float(x - np.longdouble(high)))


# Chains: closed answers ----------------------------------------------------------------------------------------


def step_by_step(index, c2, s2):
    """cos² after each layer, from one application of Snell's law per boundary; up to where none is left."""
    found = [c2]
    for above, below in itertools.pairwise(index):
        s2 = s2 * (above / below) ** 2
        if s2 > 1:
            break
        found.append(1 - s2)
    return found


@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize("layers", ["air", "exact ratios"])
def test_layers_are_what_snells_law_makes_of_them_one_by_one(layers, precision):
    with ctx.workprec(300):
        if layers == "air":
            found = air(1000)
            step = arb(layer_chains.MIRAGE) / 1000
            index = [arb(layer_chains.TOP) - j * step for j in range(1001)]
        else:
            found = exact_ratios(250)
            index = [arb(layer_chains.TOP) / (1 + arb(2.0**-23)) ** j for j in range(251)]
        rays = enter(found, np.array(DEGREES), np.full(len(DEGREES), found.count), ASKEW, precision)
        n = [arb(float(x)) for x in rays.normal]
        for ray, a in enumerate([arb(float(x)) for x in a] for a in rays.a):
            dot = sum(x * y for x, y in zip(a, n, strict=True))
            c2 = dot**2 / (sum(x * x for x in a) * sum(x * x for x in n))
            cosines = step_by_step(index, c2, 1 - c2)
            assert rays.passes[ray] == (len(cosines) == found.count + 1)
            assert rays.last[ray] == len(cosines) - 1
            end = (cosines[-1] if rays.passes[ray] else c2).sqrt()
            assert abs(float(exactly(rays.end[ray]) / end - 1)) < 1e-15
    assert rays.passes.tolist() == [True] * 4 + [False] * 3


def follow(index, c, tilts, errors):
    """(cos θ at the end, deepest layer) of cos θ₀ = c, when step by step direction and ratio are off by these."""
    layer, way, sine, deepest = 0, 1, np.sqrt(1 - c * c), 0
    for tilt, error in zip(tilts, errors, strict=True):
        if not 0 <= layer + way < len(index):
            break
        new = sine * index[layer] / index[layer + way] * (1 + error)
        if new > 1:
            way, new = -way, sine
        else:
            layer += way
        angle = np.arcsin(new) + tilt
        sine, deepest = np.sin(angle), max(deepest, layer)
    return np.cos(angle), deepest


@pytest.mark.parametrize("degrees", [89.0, 89.9])
def test_conditions_are_sums_of_derivatives(degrees):
    layers = air(60)
    rays = enter(layers, np.array([degrees]), np.array([60]), optical_chains.PLANES["upright"], np.float64)
    c, many, nudge = np.sqrt(1 - rays.sine2[0]), 2 * int(rays.last[0]) + 1, 1e-12
    steps = many if not rays.passes[0] else 60
    exact, _ = follow(layers.index, c, np.zeros(steps), np.zeros(steps))
    assert float(exact / rays.end[0] - 1) == pytest.approx(0, abs=1e-14)
    moved = [[], []]
    for step in range(steps):
        for kind in range(2):
            both = np.zeros((2, steps), np.longdouble)
            both[kind, step] = nudge
            moved[kind].append(abs(follow(layers.index, c, *both)[0] / exact - 1) / nudge)
    contrasts, ratios = (rays.fed(feed, np.float64).condition[0] for feed in ("contrasts", "ratios"))
    assert float(contrasts) == pytest.approx(float(sum(moved[0])), rel=2e-3)
    # The boundary that mirrors a ray tells it nothing of its ratio.
    assert float(ratios - contrasts) == pytest.approx(float(sum(moved[1])), rel=2e-3)


def test_the_height_is_what_tilting_every_direction_makes_of_it():
    layers, nudge = air(100_000), 1e-9
    rays = enter(layers, np.array([89.8]), np.array([layers.count]), optical_chains.PLANES["upright"], np.float64)
    last, c = int(rays.last[0]), np.sqrt(1 - rays.sine2[0])
    heights = [follow(layers.index, c, np.full(last + 1, x), np.zeros(last + 1))[1] for x in (0, nudge)]
    assert heights[0] == last
    expected = float(rays.fed("contrasts", np.float64).height[0]) * nudge
    assert 100 < expected < 1000
    assert last - heights[1] == pytest.approx(expected, rel=0.03)


def test_the_pipe_ends_where_exact_reflections_do():
    a, chain, exact = pipe(101, 4, optical_chains.CORE, np.float32)
    for ray in range(4):
        b = [fmpq(*float(x).as_integer_ratio()) for x in a[ray]]
        for normal in chain.normals[ray]:
            n = [fmpq(*float(x).as_integer_ratio()) for x in normal]
            c = sum(x * y for x, y in zip(n, b, strict=True))
            assert c > 0  # normals point outward, and the ray hits the wall from within
            b = [x - 2 * c * y / sum(z * z for z in n) for x, y in zip(b, n, strict=True)]
        assert [float(x.p) / float(x.q) for x in b] == pytest.approx(exact[ray].astype(float).tolist(), abs=1e-15)


def test_compiled_and_scalar_chains_are_the_same():
    setting, stop = compiled("float64"), np.array([40, 40, 7])
    rays = enter(air(40), np.array([89.4, 89.8, 89.0]), stop, ASKEW, np.float64)
    for feed in ("ratios", "contrasts"):
        chain = rays.fed(feed, np.float64).chain
        one, other = (carry(FORMULAS["compensated"], chain, rays.a, stop, s) for s in (SCALAR, setting))
        assert np.array_equal(one.place, other.place)
        assert one.place.tolist() == [40, -1, 7]
        assert np.array_equal(one.passed, other.passed)
        assert np.abs(one.b - other.b).max() < 1e-14


# Systems: closed answers ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", optical_systems.SYSTEMS)
def test_snells_law_gives_the_closed_form(name):
    system = optical_systems.SYSTEMS[name]()
    for answer, x in system.off(system.path()).items():
        assert np.abs(x).max() < 1e-17 * system.condition.max() + system.printed.get(answer, 0)
    assert len(system.origins) in (9, optical_systems.RAYS)


def test_the_law_in_extended_precision_is_the_oracles():
    rng = np.random.default_rng(5)
    a, n, k = rng.normal(size=(50, 3)), rng.normal(size=(50, 3)), rng.uniform(0.3, 1.2, 50)
    exact = oracle.refract(a, n, k, progress=False)
    a, n, k = (x[exact.transmitted] for x in (a, n, k))
    b = optical_systems.unit(optical_systems.snell(*(x.astype(np.longdouble) for x in (a, n)), k))
    difference = (b - exact.direction[exact.transmitted]) - exact.direction_low[exact.transmitted]
    assert len(a) > 20
    assert np.abs(difference).max() < 1e-17


def test_rainbows_and_the_prism_stand_at_the_extreme_of_the_deflection():
    index = np.longdouble(4) / 3
    for order, bow in ((1, 180 - 42.03), (2, 180 + 50.98)):
        i = closed_forms.rainbow_incidence(index, order)
        d = [float(closed_forms.deflection(x, index, order)) for x in (i - 1e-3, i, i + 1e-3)]
        assert math.degrees(d[1]) == pytest.approx(bow, abs=0.01)
        assert 1e-7 < d[0] - d[1] < 1e-5
        assert 1e-7 < d[2] - d[1] < 1e-5
    apex, n = np.deg2rad(np.longdouble(60)), optical_systems.BK7
    first = closed_forms.least_deviated(apex, n)
    before, least, after = (float(closed_forms.deviation(first + x, apex, n)) for x in (-1e-3, 0, 1e-3))
    assert least == pytest.approx(float(2 * first - apex), abs=1e-15)
    assert 1e-7 < before - least < 1e-5
    assert 1e-7 < after - least < 1e-5


@pytest.mark.parametrize("name", optical_systems.SYSTEMS)
def test_a_condition_bounds_what_random_errors_do_and_not_by_far(name):
    system, rng, size, worst = optical_systems.SYSTEMS[name](), np.random.default_rng(3), 1e-9, 0.0

    def off(x):
        return x + size * np.sqrt(optical_systems.dot(x, x)) * optical_systems.unit(rng.normal(size=x.shape))

    for _ in range(20):
        error = system.errors(
            lambda a, n, k: off(optical_systems.snell(a, off(n), k * (1 + size * rng.choice([-1, 1]))))
        )
        worst = np.maximum(worst, np.sqrt((error**2).sum(1)) / (system.condition * size))
    assert 0.2 < worst.max() < 1


# Planted defects -----------------------------------------------------------------------------------------------

promoted = FORMULAS["promoted"]


def single(x):
    return float(np.float32(x))


def defect(k=lambda k: k, contrast=lambda k, contrast: contrast, b=lambda b: b, transmitted=lambda t: t):
    """The promoted form with a change of an input or of an output."""

    def formula(a, n, k_, contrast_=None):
        out, through = promoted(a, n, k(k_), contrast(k_, contrast_))
        return b(out), transmitted(through)

    return formula


DEFECTS = {
    "none": promoted,
    "five digits": defect(k=lambda k: k * (1 + 1e-5), contrast=lambda k, c: None),
    "swapped": defect(k=lambda k: 1 / k, contrast=lambda k, c: None),
    "single contrast": defect(contrast=lambda k, c: single(single(k) * single(k) - 1)),
    "single result": defect(b=lambda b: type(b)(*map(single, b))),
    "not a number": defect(b=lambda b: b * math.nan, transmitted=lambda t: False),
    "leaking": defect(transmitted=lambda t: True),
    "long mirror": defect(b=lambda b: b * (1 + 1e-13)),
}


def mirage(subject, feed):
    stop = np.full(2, SMALL.layers[0])
    fed = enter(air(SMALL.layers[0]), np.array(SMALL.angles), stop, ASKEW, np.float64).fed(feed, np.float64)
    return optical_chains.mirage_row("promoted", subject, "mirage", fed, SCALAR, SMALL)[0]


ROWS = {f"mirage, {feed}": (lambda subject, feed=feed: mirage(subject, feed)) for feed in ("ratios", "contrasts")}
ROWS["pipe"] = lambda subject: optical_chains.pipe_row("promoted", subject, SCALAR, SMALL)
ROWS |= {
    name: (lambda subject, name=name: optical_chains.system_row("promoted", subject, name, SCALAR))
    for name in optical_systems.SYSTEMS
}
OFF = {"five digits", "swapped", "single result", "not a number"}
SEEN = {"mirage": OFF | {"single contrast"}, "pipe": {"long mirror", "leaking", "single result", "not a number"}}


@pytest.mark.parametrize("case", ROWS)
def test_a_chain_or_system_passes_and_sees_planted_defects(case):
    failed = {name for name, subject in DEFECTS.items() if ROWS[case](subject).verdict == "fail"}
    assert "none" not in failed and failed >= SEEN.get(case.partition(",")[0], OFF)


def test_a_pipe_counts_what_leaks_and_what_grows():
    assert ROWS["pipe"](DEFECTS["leaking"]).values["TIR misclassified"] == 60 * 2
    assert ROWS["pipe"](DEFECTS["long mirror"]).values["length drift"] == pytest.approx(60e-13, rel=1e-2)


# Rows ----------------------------------------------------------------------------------------------------------


def test_single_precision_stays_within_its_budgets_and_shows_what_ratios_cost():
    setting = compiled("float32")
    how = optical_chains.Extent((1000,), ("upright",), 1000, DEGREES, False)
    rows = optical_chains.mirage_rows(FORMULAS, "mirage", air(1000), optical_chains.PLANES["upright"], setting, how)
    assert {row.verdict for row in rows} == {"pass", "info"}
    at = {(row.subject, row.case.partition(", ")[2]): row.values for row in rows}
    for name in FORMULAS:
        assert at[name, "ratios"]["89.0°"] == pytest.approx(0.116, abs=0.005)  # the layers are not there at all
        assert at[name, "reciprocals"]["89.0°"] == pytest.approx(0.48, abs=0.005)
        assert at[name, "reciprocals"]["89.4°"] == 1
    assert at["promoted", "contrasts"]["89.55°"] < 1e-3 < at["promoted", "indices"]["89.55°"]
    rounded = {"promoted": lambda a, n, k, contrast=None: promoted(a, n, k, None if contrast is None else k * k - 1)}
    rows = optical_chains.mirage_rows(rounded, "mirage", air(1000), optical_chains.PLANES["upright"], setting, how)
    assert [row.case for row in rows if row.verdict == "fail"] == ["mirage, contrasts"]


def test_a_budget_that_no_answer_could_break_is_none():
    """100 000 ratios, each off by u in float32: condition · u is above 1 for every ray, in float64 for none."""

    def row(precision, angles):
        rays = enter(air(100_000), np.array(angles), np.full(len(angles), 100_000), ASKEW, precision)
        how, fed = optical_chains.Extent((), (), 0, angles, False), rays.fed("ratios", precision)
        setting = optical_chains.Setting("scalar", precision, SCALAR.vector)
        straight = lambda a, n, k, contrast=None: (a, True)  # noqa: E731
        return optical_chains.mirage_row("promoted", straight, "mirage", fed, setting, how)[0]

    lost = row(np.float32, (89.4, 89.8))
    assert (lost.verdict, lost.reason) == ("info", optical_chains.NOTHING)
    assert row(np.float64, (89.4,)).broken.keys() == {"error / condition"}
    held = row(np.float64, (89.4, 89.8))
    assert held.budgets.keys() == {"error / condition", "TIR misclassified", "turning height"}
    assert held.broken.keys() == held.budgets.keys()


def test_curves_run_through_the_layers():
    how = optical_chains.Extent((30,), ("askew",), 10, (89.0, 89.95), True)
    found = {"promoted": promoted, "wedge": FORMULAS["wedge"]}
    rows = optical_chains.mirage_rows(found, "mirage", air(30), ASKEW, SCALAR, how)
    (problem,) = (row for row in rows if row.subject == optical_chains.PROBLEM and row.case.endswith("ratios"))
    assert set(problem.curves) == {*found, "condition · u"}
    assert all([x for x, _ in line][:: len(line) - 1] == [1, 30] for line in problem.curves.values())
    limit = dict(problem.curves["condition · u"])
    assert all(y <= limit[x] for x, y in problem.curves["promoted"])
    assert limit[30] == problem.values["condition · u"]


def test_what_does_not_run_is_named_and_mitsuba_runs_on_scalars_too():
    for setting in SETTINGS.values():
        absent = optical_chains.absent(HERE, setting)
        found = optical_chains.subjects(HERE, setting) if setting.vector is not None else {}
        assert found.keys() | absent.keys() == {*FORMULAS, BUILTIN} and all(absent.values())
        if setting.vector is None:
            assert {row.verdict for row in optical_chains.chain_rows(HERE, setting)} == {"not run"}
    single = SETTINGS["scalar float32"]
    row = optical_chains.system_row(BUILTIN, optical_chains.subjects(HERE, single)[BUILTIN], "prism", single)
    assert row.verdict == "info" and 0.01 < row.values["error / condition"] < 2

"""The studies of stability: closed answers against independent evaluations, and defects that they must see."""

import dataclasses
import itertools
import math
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refract import FORMULAS, backend, oracle
from mi_refract.formulas import fresnel
from mi_refract.plugins import refract as bsdf
from validation import limits
from validation.reference import closed_forms, optical_systems
from validation.run.array_settings import BUILTIN
from validation.run.context import PROFILES, SCALAR_PROFILES, Context
from validation.run.metrics import MISCLASSIFIED, MISCLASSIFIED_FAR
from validation.stability import derivatives, energy, layered_paths, optical_chains
from validation.stability.layer_chains import air, enter
from validation.stability.layered_paths import FIBRE, MIRAGE

HERE = Context(SCALAR_PROFILES["standard"], Path(), "scalar_rgb", backend.detect(), backend.usable_variants())
SETTINGS = {setting.label: setting for setting in optical_chains.settings(HERE)}
SCALAR = SETTINGS["scalar float64"]
SMALL = optical_chains.Extent((40,), ("askew",), 60, (89.4, 89.8), False)
UPRIGHT, ASKEW = (optical_chains.PLANES[name] for name in ("upright", "askew"))
DEGREES = optical_chains.PASSING + optical_chains.TURNING
LIMITED = [name for name, formula in FORMULAS.items() if formula.budget.at_the_limit]
promoted = FORMULAS["promoted"]


def compiled(precision, needs_mitsuba=False):
    setting = SETTINGS[f"llvm {precision}"]
    running = setting.vector is not None and (setting.mitsuba or not needs_mitsuba)
    return setting if running else pytest.skip(f"llvm: {setting.reason or 'no variant of Mitsuba runs here'}")


# Chains: closed answers ----------------------------------------------------------------------------------------------


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
    layers, nudge = air(60), 1e-12
    rays = enter(layers, np.array([degrees]), np.array([60]), UPRIGHT, np.float64)
    c, steps = np.sqrt(1 - rays.sine2[0]), 60 if rays.passes[0] else 2 * int(rays.last[0]) + 1
    exact, _ = follow(layers.index, c, np.zeros(steps), np.zeros(steps))
    assert float(exact / rays.end[0] - 1) == pytest.approx(0, abs=1e-14)
    moved = [0, 0]
    for step, kind in itertools.product(range(steps), range(2)):
        both = np.zeros((2, steps), np.longdouble)
        both[kind, step] = nudge
        moved[kind] += abs(follow(layers.index, c, *both)[0] / exact - 1) / nudge
    contrasts, ratios = (rays.fed(feed, np.float64).condition[0] for feed in ("contrasts", "ratios"))
    assert float(contrasts) == pytest.approx(float(moved[0]), rel=2e-3)
    # The boundary that mirrors a ray tells it nothing of its ratio.
    assert float(ratios - contrasts) == pytest.approx(float(moved[1]), rel=2e-3)


def test_the_height_is_what_tilting_every_direction_makes_of_it():
    layers, nudge = air(100_000), 1e-9
    rays = enter(layers, np.array([89.8]), np.array([layers.count]), UPRIGHT, np.float64)
    last, c = int(rays.last[0]), np.sqrt(1 - rays.sine2[0])
    heights = [follow(layers.index, c, np.full(last + 1, x), np.zeros(last + 1))[1] for x in (0, nudge)]
    expected = float(rays.fed("contrasts", np.float64).height[0]) * nudge
    assert heights[0] == last and 100 < expected < 1000
    assert last - heights[1] == pytest.approx(expected, rel=0.03)


def test_single_precision_stays_within_its_budgets_and_shows_what_ratios_cost():
    setting = compiled("float32")
    how = optical_chains.Extent((1000,), ("upright",), 1000, DEGREES, False)
    rows = optical_chains.mirage_rows(FORMULAS, "mirage", air(1000), UPRIGHT, setting, how)
    assert {row.verdict for row in rows} == {"pass", "info"}
    at = {(row.subject, row.case.partition(", ")[2]): row.values for row in rows}
    for name in FORMULAS:
        assert at[name, "ratios"]["89.0°"] == pytest.approx(0.116, abs=0.005)  # the layers are not there at all
        assert at[name, "reciprocals"]["89.0°"] == pytest.approx(0.48, abs=0.005)
        assert at[name, "reciprocals"]["89.4°"] == 1
    assert at["promoted", "contrasts"]["89.55°"] < 1e-3 < at["promoted", "indices"]["89.55°"]
    rounded = {"promoted": lambda a, n, k, contrast=None: promoted(a, n, k, None if contrast is None else k * k - 1)}
    rows = optical_chains.mirage_rows(rounded, "mirage", air(1000), UPRIGHT, setting, how)
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
    assert held.broken.keys() == held.budgets.keys() == {"error / condition", MISCLASSIFIED_FAR, "turning height"}


def test_a_decided_ray_may_not_turn_although_others_may():
    """Of ratios in float32 five of seven rays may take any path, but not that of 88 degrees."""

    def mirrored(a, n, k, contrast=None):
        b, transmitted = promoted(a, n, k, contrast)
        steep = dr.abs(dr.dot(a, n)) > 0.03
        return dr.select(steep, a - n * (2 * dr.dot(a, n)), b), transmitted & ~steep

    setting = compiled("float32")
    how = optical_chains.Extent((1000,), ("upright",), 1000, DEGREES, False)
    fed = enter(air(1000), np.array(DEGREES), np.full(7, 1000), UPRIGHT, np.float32).fed("ratios", np.float32)
    row = optical_chains.mirage_row
    right, wrong = (row("promoted", x, "mirage", fed, setting, how)[0] for x in (promoted, mirrored))
    assert right.verdict == "pass" and right.values[MISCLASSIFIED] <= wrong.values[MISCLASSIFIED] <= 4
    assert wrong.broken == {MISCLASSIFIED_FAR: 0.0}


# Systems: closed answers ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", optical_systems.SYSTEMS)
def test_snells_law_gives_the_closed_form_and_conditions_bound_random_errors_and_not_by_far(name):
    system, rng, size, worst = optical_systems.SYSTEMS[name](), np.random.default_rng(3), 1e-9, 0.0
    for answer, x in system.off(system.path()).items():
        assert np.abs(x).max() < 1e-17 * system.condition.max() + system.printed.get(answer, 0)

    def off(x):
        return x + size * np.sqrt(optical_systems.dot(x, x)) * optical_systems.unit(rng.normal(size=x.shape))

    for _ in range(20):
        error = system.errors(
            lambda a, n, k: off(optical_systems.snell(a, off(n), k * (1 + size * rng.choice([-1, 1]))))
        )
        worst = np.maximum(worst, np.sqrt((error**2).sum(1)) / (system.condition * size))
    assert 0.2 < worst.max() < 1


def test_rainbows_and_the_prism_stand_at_the_extreme_of_the_deflection():
    index, apex, n = np.longdouble(4) / 3, np.deg2rad(np.longdouble(60)), optical_systems.BK7
    extremes = [(lambda x: closed_forms.deviation(x, apex, n), closed_forms.least_deviated(apex, n))]
    for order in (1, 2):
        turned = lambda x, order=order: closed_forms.deflection(x, index, order)  # noqa: E731
        extremes.append((turned, closed_forms.rainbow_incidence(index, order)))
    for turned, at in extremes:
        before, there, after = (float(turned(at + x)) for x in (-1e-3, 0, 1e-3))
        assert 1e-7 < before - there < 1e-5 and 1e-7 < after - there < 1e-5


# Chains and systems: planted defects ---------------------------------------------------------------------------------


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
    rows = {name: ROWS[case](subject) for name, subject in DEFECTS.items()}
    failed = {name for name, row in rows.items() if row.verdict == "fail"}
    assert "none" not in failed and failed >= SEEN.get(case.partition(",")[0], OFF)
    if case == "pipe":
        assert rows["leaking"].values["TIR misclassified"] == 60 * 2
        assert rows["long mirror"].values["length drift"] == pytest.approx(60e-13, rel=1e-2)


def test_what_does_not_run_is_named():
    for setting in SETTINGS.values():
        absent = optical_chains.absent(HERE, setting)
        found = optical_chains.subjects(HERE, setting) if setting.vector is not None else {}
        assert found.keys() | absent.keys() == {*FORMULAS, BUILTIN} and all(absent.values())
        if setting.vector is None or setting.is_scalar:
            rows = derivatives.setting_rows(HERE, setting)
            rows += [] if setting.is_scalar else optical_chains.chain_rows(HERE, setting)
            rows += [] if setting.is_scalar else energy.setting_rows(HERE, setting)
            assert {row.verdict for row in rows} == {"not run"} and all(row.reason for row in rows)
    rows = [row for task in layered_paths.tasks(HERE) for row in task.run()]
    assert {row.verdict for row in rows} == {"not run"}
    assert {row.case for row in rows} >= {"mirage", "fibre", "mirage, telescope: image"}


# Energy --------------------------------------------------------------------------------------------------------------


@pytest.fixture
def few(scalar_context):
    return scalar_context(rays=800, scalar_rays=60)


def failing(rows):
    return {(row.subject, row.case) for row in rows if row.verdict == "fail"}


POWERS, LOCAL_POWERS = fresnel.powers, fresnel.local_powers


def differences(c, y, transmitted, k, contrast=None):
    """As printed, with T by subtraction."""
    s, p = (k * c - y) / (k * c + y), (c - k * y) / (c + k * y)
    r = dr.select(transmitted, (s * s + p * p) / 2, 1)
    return r, 1 - r


def spoilt(powers, factor, of=lambda c: 1):
    """The same with more transmitted."""

    def more(c, *rest):
        r, t = powers(c, *rest)
        return r, t * (1 + factor * of(c))

    return more


DIFFUSE, NEAR_ONE = ("powers", "diffuse light, n = 1.5"), ("powers", "k → 1")


@pytest.mark.parametrize(
    ("function", "defect", "seen"),
    [
        ("powers", differences, {("powers", "matched, grazing"), NEAR_ONE}),
        ("powers", lambda c, y, t, k, *e: POWERS(c, y, t, 1 / k, *e), {("powers", "generic"), DIFFUSE}),
        ("powers", spoilt(POWERS, 3e-6), {("powers", "generic"), DIFFUSE}),
        ("powers", spoilt(POWERS, math.nan), {("powers", "generic"), DIFFUSE}),
        ("powers", spoilt(POWERS, 3e-6, lambda c: c), {("powers", "reciprocity")}),
        ("local_powers", spoilt(LOCAL_POWERS, 3e-6), {("pipeline", "generic")}),
    ],
)
def test_defects_in_the_powers_are_seen(function, defect, seen, few, monkeypatch):
    monkeypatch.setattr(fresnel, function, defect)
    monkeypatch.setattr(energy, "CASES", ["generic", "matched, grazing"])
    assert seen <= failing(energy.setting_rows(few, compiled("float32", True)))


@pytest.mark.parametrize(("case", "weight"), [("white furnace", 1.000001), ("basic radiance", 1.00001)])
def test_a_plugin_that_gives_too_much_is_seen(case, weight, few, monkeypatch):
    """A `refract` whose weights are a millionth too large."""
    rows = {"white furnace": energy.furnace_row, "basic radiance": energy.radiance_row}
    plugin = bsdf.plugin_class(mi.scalar_rgb)

    class Brighter(plugin):
        def sample(self, *arguments):
            bs, value = super().sample(*arguments)
            return bs, value * weight

    mi.register_bsdf("refract_brighter", Brighter)
    monkeypatch.setattr(mi, "load_dict", lambda d, load=mi.load_dict: load(d | {"type": "refract_brighter"}))
    assert rows[case](few, "refract").verdict == "fail"


# Derivatives ---------------------------------------------------------------------------------------------------------


def regraded(formula, factor):
    """The right direction with the derivative of another one."""

    def scaled(a, n, k):
        b, transmitted = formula(a, n, k)
        return dr.replace_grad(b, b * factor), transmitted

    return scaled


def unsafe(a, n, k):
    """The right direction plus a root that is 0, where its derivative is infinite."""
    b, transmitted = promoted(a, n, k)
    return b + n * dr.sqrt(k - dr.detach(k)), transmitted


def undeclared(a, n, k):
    """The right direction with the derivative of another one where light is transmitted, which it denies."""
    b, transmitted = promoted(a, n, k)
    return dr.replace_grad(b, dr.select(transmitted, 1.1 * b, b)), transmitted & False


def test_wrong_derivatives_are_seen(monkeypatch):
    setting = compiled("float32")
    given = derivatives.inputs(20, setting.precision)
    wrong_ones = (regraded(promoted, 1.00001), "error / condition"), (unsafe, "not finite")
    for wrong, metric in (*wrong_ones, (undeclared, MISCLASSIFIED_FAR)):
        rows, _ = derivatives.formula_rows("promoted", wrong, given, setting)
        assert all(metric in row.broken for row in rows if row.case == "∂b/∂k")
    short = derivatives.only(given, given.rays.k < 1e-3)  # where an absolute error would hide that of the étendue
    rows, _ = derivatives.formula_rows("compensated", regraded(FORMULAS["compensated"], 1 + 1e-5), short, setting)
    assert next(row for row in rows if row.case == "étendue").verdict == "fail"
    # ∂R/∂η through the cosine and k alone.
    monkeypatch.setattr(fresnel, "powers", lambda c, y, t, k: POWERS(c, y, t, k, dr.detach(k * k - 1)))
    assert "error / condition" in derivatives.reflectance_row(given, setting).broken


@pytest.mark.parametrize("k", [882668.0, 30000.0])
def test_the_derivative_of_the_reflectance_keeps_its_digits_near_the_critical_angle(k):
    """1 − k² sin²θ between 1e-6 and 0.5 at sin θ = √(…)/k: 2k cos²θ − 2k would lose 1/sin²θ = k² times u."""
    setting, sine = compiled("float64"), np.sqrt(1 - np.geomspace(1e-6, 0.5, 40)) / k
    cos_i, ratio = np.sqrt((1 - sine) * (1 + sine)), np.full(40, k)
    exact = oracle.derivatives.derivative_of_powers(cos_i, ratio, 0.0, ratio)
    number = dr.value_t(dr.diff_array_t(setting.vector))

    def reflectance(k):
        cos_t, transmitted = fresnel.refracted_cosine(number(cos_i), k)
        return fresnel.powers(number(cos_i), cos_t, transmitted, k)[0]

    found = np.array(derivatives.forward(reflectance, number(ratio), number(ratio))[1])
    size = derivatives.size_of_powers(oracle.fresnel(cos_i, ratio), cos_i, ratio)
    assert (np.abs(found - exact) <= limits.REFLECTANCE["float64"] * setting.roundoff * size).all()
    assert (np.abs(found - exact) <= 1e-9 * np.abs(exact)).sum() > 20


# Paths through layered scenes ----------------------------------------------------------------------------------------


@pytest.fixture
def context(tmp_path):
    profile = dataclasses.replace(PROFILES["standard"], resolution=48, spp=4)
    return Context(profile, tmp_path, "llvm_ad_rgb", backend.detect(), {})


def test_exact_paths_conserve_their_invariants_and_a_deviation_is_the_one_that_was_put_in():
    """n sin θ of the mirage, n d_z and the skew n (x × d)_z of the fibre; a path at an angle 1 % too large."""

    def into_the_mirage(sine, height):
        start, d = [-layered_paths.POOL, height, 0], [math.sqrt(1 - sine**2), -sine, 0]
        return layered_paths.exact_path(MIRAGE, start, d, 0)

    def kept(layers, path, values):
        return np.ptp(np.array(layers.indices)[list(path.media)] * values)

    for sine in (4e-4, 9e-3):
        path = into_the_mirage(sine, 0.005)
        assert kept(MIRAGE, path, path.directions[:, 0]) < 1e-14
        assert path.directions[-1, 1] == pytest.approx(sine, rel=1e-12)  # out as it came in
    for path in layered_paths.bundle(FIBRE).exact(FIBRE, offset=0.0):
        assert kept(FIBRE, path, path.directions[:, 2]) < 1e-14
        assert kept(FIBRE, path, np.cross(path.starts, path.directions)[:, 2]) < 1e-12
        radius = np.hypot(*path.ends[:-1, :2].T)
        assert min(abs(radius[:, None] - FIBRE.boundaries).min(1), default=0) < 1e-12
    right, wrong = (into_the_mirage(sine, 1.0) for sine in (8e-4, 8.08e-4))
    found = layered_paths.deviation(MIRAGE, right, wrong.segments())
    assert found.direction[0] == pytest.approx(0.01, rel=1e-3) and found.boundaries == 0
    same = layered_paths.deviation(MIRAGE, right, right.segments())
    assert same.direction.max() < 1e-12 and same.place.max() < 1e-12


def test_only_forms_at_the_rounding_limit_keep_to_the_path_and_a_fibre_guides_every_ray(llvm_variant, context):
    rows = {row.subject: row for row in layered_paths.path_rows(context, MIRAGE) if row.case == "mirage: path"}
    assert list(rows) == [*layered_paths.plugins(), layered_paths.INDICES, layered_paths.RATIOS]
    budgets = rows["refract"].budgets
    held = {"refract", *(f"refract_{name}" for name in LIMITED)}
    assert {name for name, row in rows.items() if row.verdict == "pass"} == held
    # What has no budget would break it: the check can fail.
    for name, row in rows.items():
        if name not in held:
            assert not row.budgets and dataclasses.replace(row, budgets=budgets).broken.keys() == budgets.keys(), name
    rows = [row for row in layered_paths.path_rows(context, FIBRE) if row.case == "fibre: path"]
    assert {row.values["wrong path"] for row in rows} == {0.0}
    assert all(row.values["direction"] < 0.01 for row in rows)


def test_the_built_in_differs_from_exact_paths_in_the_telescope(llvm_variant, context, monkeypatch):
    """Why `renders` demands nothing of this scene's agreement; and a formula that is not right is seen."""
    context = dataclasses.replace(context, profile=dataclasses.replace(context.profile, resolution=48))
    (row,) = layered_paths.view_rows(context, *layered_paths.VIEWS[0])
    assert row.verdict == "pass" and row.values["pixels off"] > 5e-3
    assert all((context.out / path).is_file() for path in row.images.values())
    monkeypatch.setattr(layered_paths, "PLUGIN", "refract_decomposed")
    (row,) = layered_paths.view_rows(context, *layered_paths.VIEWS[0])
    assert row.broken.keys() == {"pixels off, control", "off exact / built-in"}

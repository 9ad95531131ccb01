"""The table of standard numbers against other formulas and printed values; and planted errors in their measurement."""

import dataclasses
import json
import math
from typing import Any

import numpy as np
import pytest
from support.readme import DOCS

from mi_refract import media
from mi_refract.ray_sets import ray_set
from mi_refract.ray_sets.ray_set import Answers
from mi_refract.ray_sets.renderer_file import RaysCommand
from mi_refract.report.row import Row
from validation import limits, tables
from validation.ground_truth import bench
from validation.ground_truth import standard_numbers as study
from validation.reference import optical_systems
from validation.reference import standard_numbers as table
from validation.run.context import here
from validation.run.render_methods import under
from validation.suite import standard_numbers as others
from validation.suite.small_mistakes import textbook

NUMBERS = table.NUMBERS


def value(name):
    return NUMBERS[name].value


# The table -------------------------------------------------------------------------------------------------------

# Values with their well-known digits.
SLABS, PRISMS = {0: 0.91832, 30: 0.91596, 45: 0.90253, 60: 0.84347}, {1.5: 37.181, 1.5168: 38.647, 1.52: 38.928}
BOWS = {1.3333: (42.03, 50.97), 1.3318: (42.25, 50.58), 1.3435: (40.58, 53.61)}
KNOWN = {f"slab, n = 1.52, {angle}°": share for angle, share in SLABS.items()}
KNOWN |= {f"prism of 60°, n = {n}": angle for n, angle in PRISMS.items()}
KNOWN |= {f"rainbow of order {i}, n = {n}": angle for n, angles in BOWS.items() for i, angle in enumerate(angles, 1)}


@pytest.mark.parametrize("name", KNOWN)
def test_numbers_have_their_well_known_digits(name):
    decimals = len(repr(KNOWN[name]).partition(".")[2])
    assert round(value(name), decimals) == KNOWN[name]


def test_the_table_is_plain_data_and_every_number_has_a_source():
    rows = table.rows()
    assert len(rows) == len(NUMBERS) >= 18
    assert json.loads(json.dumps(rows, allow_nan=False)) == rows
    assert all(row["source"] and row["law"] and row["kind"] in table.KINDS and row["given"] for row in rows)
    assert {row["kind"] for row in rows} == set(table.KINDS)


def test_measured_indices_are_of_glasses_that_the_plugin_knows_and_glTFs_sample_is_only_quoted():
    glasses = {number.medium.format(**number.given) for number in NUMBERS.values() if number.kind == "index"}
    assert glasses == {*(f"SCHOTT:{name}" for name in table.GLASSES), "abbe(2.42, 55.0)"}
    page = (DOCS / "reference/standard-numbers.md").read_text()
    assert all(f"{2.42 + sign * (2.42 - 1) * 0.025 * 20 / 55:.5f}" in page for sign in (-1, 1))


@pytest.mark.parametrize("name", [name for name, number in NUMBERS.items() if number.printed])
def test_laws_give_the_printed_digits_except_for_the_fitted_glass(name):
    row = NUMBERS[name].as_dict()
    within = 0.0021 if row["fitted"] else row["printed_half_unit"] * (1 + 1e-9)
    assert abs(row["off_print"]) <= within and row["off_print"] == row["value"] - row["printed_value"]


def test_the_glass_of_the_cie_is_its_polynomial_and_its_absorbance_is_the_least_squares_fit():
    cosines = np.cos(np.deg2rad(np.arange(0, 90, 10)))
    polynomial = np.polynomial.polynomial.polyval(cosines, table.CIE_POLYNOMIAL)
    assert [f"{x:.4f}" for x in polynomial] == list(table.CIE_PRINTED)

    def misses(absorbance):
        return sum(
            (float(NUMBERS[f"CIE 171 clear glass, {angle}°"].at(absorbance=absorbance)) - float(printed)) ** 2
            for angle, printed in zip(range(0, 90, 10), table.CIE_PRINTED, strict=True)
        )

    best = table.cie_absorbance()
    assert misses(best) < min(misses(best - 1e-5), misses(best + 1e-5))


def test_plates_are_the_sum_of_all_paths_and_clear_piles_obey_stokes_formula():
    piles: list[dict[str, Any]] = [
        {"n": 1.52, "incidence": 60.0},
        {"n": 1.52, "incidence": 70.0, "absorbance": 0.3},
        {"n": 1.7, "incidence": 45.0, "count": 3},
        {"n": 1.52, "incidence": 60.0, "together": True, "count": 2},
    ]
    for pile in piles:
        passed, left = table.paths_through(150, **pile)
        assert passed.sum(0) == pytest.approx(table.polarised_plates(**pile), abs=1e-13) and left.max() < 1e-13
    r, _ = table.reflectances(1.7, 45.0)
    assert table.polarised_plates(1.7, 45.0, 3) == pytest.approx((1 - r) / (1 + 5 * r), abs=1e-16)
    # If each boundary transmits the mean of both polarisations, less is transmitted, except at normal incidence.
    assert value("slab without polarisation, n = 1.52, 60°") < value("slab, n = 1.52, 60°") - 0.01
    assert table.plates(n=1.52, incidence=0.0, together=True) == table.plates(n=1.52, incidence=0.0)


def test_the_rhomb_retards_by_90_degrees_at_two_incidences_and_most_between_them():
    gentle, steep = (table.retarding_incidence(1.51, 45, steep) for steep in (False, True))
    for incidence, minutes in ((gentle, 48 * 60 + 37), (steep, 54 * 60 + 37)):
        assert abs(float(incidence) * 60 - minutes) < 0.6
        # From the amplitudes, which are complex beyond the critical angle.
        i = math.radians(float(incidence))
        beyond = 1j * math.sqrt((1.51 * math.sin(i)) ** 2 - 1)
        s = (1.51 * math.cos(i) - beyond) / (1.51 * math.cos(i) + beyond)
        p = (math.cos(i) - 1.51 * beyond) / (math.cos(i) + 1.51 * beyond)
        assert abs(math.degrees(np.angle(p / s))) == pytest.approx(45, abs=1e-9)
    largest = NUMBERS["largest retardation, n = 1.51"]
    assert largest.value == pytest.approx(2 * math.degrees(math.atan((1.51**2 - 1) / (2 * 1.51))), abs=1e-12)
    assert gentle < largest.given["incidence"] < steep and largest.slope("incidence") < 1e-6


def test_the_package_has_the_indices_of_the_table():
    for number in NUMBERS.values():
        if number.kind == "index" and number.medium.startswith("SCHOTT"):
            assert media.index(number.medium, number.given["nm"]) == pytest.approx(number.value, rel=1e-15)


def test_diffuse_shares_add_up_to_1_and_conserve_etendue():
    for n in (1.5, 1.333):
        shares = {
            (side, what): value(f"diffuse {what}, n = {n:g}, from {side}")
            for side in ("outside", "inside")
            for what in ("reflectance", "transmittance")
        }
        for side in ("outside", "inside"):
            assert shares[side, "reflectance"] + shares[side, "transmittance"] == pytest.approx(1, abs=1e-15)
        assert shares["inside", "transmittance"] * n * n == pytest.approx(shares["outside", "transmittance"], abs=1e-15)


# Measurements ----------------------------------------------------------------------------------------------------


def altered(number, bound):
    """The number with another index or wavelength, so that its value is two bounds away."""
    name = next(name for name in ("n", "n_d", "nm") if name in number.given)
    step = 2 * bound / number.slope(name)
    return dataclasses.replace(number, given={**number.given, name: number.given[name] + step})


def fails(number, measured, bound):
    """Whether the row of a number fails with another measurement."""
    return study.row(number, dataclasses.replace(measured, bound=bound), "refract", "").broken == {"error / bound": 1.0}


def check_bounds(numbers, samples=0):
    """Assert that each number is within its bound, and beyond it if the plugin gets an altered number."""
    measured = study.measure(numbers, samples)
    rows = [study.row(number, measured[number.name], "refract", "") for number in numbers]
    assert [(row.case, row.broken) for row in rows if row.verdict != "pass"] == []
    wrong = study.measure([altered(number, measured[number.name].bound) for number in numbers], samples)
    assert [x.name for x in numbers if not fails(x, wrong[x.name], measured[x.name].bound)] == []


SCALAR = [kind for kind in table.KINDS if kind != "double Gauss"]


@pytest.mark.parametrize("kind", SCALAR)
def test_numbers_are_within_their_bounds_and_twice_that_is_detected(kind, needs_variant):
    numbers = [number for number in NUMBERS.values() if number.kind == kind and number.given.get("count", 1) == 1]
    for variant in dict.fromkeys(study.SCALAR[study.need(number)] for number in numbers):
        needs_variant(variant)
        with under(variant):
            check_bounds([number for number in numbers if study.SCALAR[study.need(number)] == variant])


@pytest.mark.parametrize(("need", "count"), [("polarised", 2), ("plain", 4)])
def test_piles_are_within_their_bounds_and_twice_that_is_detected(need, count, needs_variant):
    needs_variant(study.COMPILED[need])
    numbers = [x for x in NUMBERS.values() if x.given.get("count") == count and study.need(x) == need]
    with under(study.COMPILED[need]):
        check_bounds(numbers, 1 << 14)


def test_the_double_gauss_is_within_its_bounds_and_twice_that_is_detected(scalar_context, monkeypatch):
    numbers = [number for number in NUMBERS.values() if number.kind == "double Gauss"]
    measured, glass, share = study.measure(numbers), bench.glass, 1e-6
    assert [x.name for x in numbers if study.row(x, measured[x.name], "refract", "").verdict != "pass"] == []
    denser = optical_systems.double_gauss_data()["prescription"]
    path = optical_systems.double_gauss([[c, d, n * (1 + share * (n > 1))] for c, d, n in denser]).path()
    changed = [abs(float(table.behind_the_lens(path, **x.given)) - x.value) / share for x in numbers]
    more = max(2 * measured[x.name].bound / change for x, change in zip(numbers, changed, strict=True))
    monkeypatch.setattr(bench, "glass", lambda plugin, *n: glass(plugin, *(x * (1 + more * (x > 1)) for x in n)))
    wrong = study.measure(numbers)
    assert [x.name for x in numbers if not fails(x, wrong[x.name], measured[x.name].bound)] == []


LENS = [(1, lambda path: table.behind_the_lens(path, 1, 0)), (5, lambda path: table.behind_the_lens(path, 5, 1))]
TRACED = {  # a bench, and the readings of its rays
    "prism": lambda: study.angle_read(NUMBERS["prism of 60°, n = 1.5"]),
    "drop": lambda: study.angle_read(NUMBERS["rainbow of order 2, n = 1.3333"]),
    "double Gauss": lambda: (bench.benches()["double Gauss"], LENS),
}


@pytest.mark.parametrize("name", TRACED)
def test_independent_roundings_come_near_the_bound_of_a_ray_but_not_beyond(name):
    case, readings = TRACED[name]()
    bounds, rng, sizes = study.read_bounds(case, readings), np.random.default_rng(3), case.roundings()
    exact, ratios = case.system.path(), []
    counts = {key: round(bench.COUNTS[key[1]] if key[0] >= 0 else bench.FIRST) for key in sizes}
    for _ in range(60):
        shifts = {x: s / counts[x] * rng.uniform(-1, 1, (counts[x], len(s), 3)).sum(0) for x, s in sizes.items()}
        path = case.system.path(moved=lambda j, what, x, axis, s=shifts: x + s.get((j, what), 0))
        ratios += [abs(float(read(path) - read(exact))) / x for (_, read), x in zip(readings, bounds, strict=True)]
    assert 0.2 < max(ratios) < 1


def test_a_bound_that_tests_nothing_fails():
    for number in NUMBERS.values():
        if "n" in number.given and not study.noisy(number):
            wide = study.Measured(number.value, 2e-3 * number.slope("n") * number.given["n"])
            assert study.row(number, wide, "refract", "").broken == {"index seen": limits.STANDARD_SEEN}


def test_a_run_has_a_row_per_number_of_a_variant_or_the_reason_for_none(tmp_path):
    context = here("quick", tmp_path, "scalar_rgb")
    rows = [row for task in study.STUDY.tasks(context) if task.name.endswith("spectral") for row in task.run()]
    assert {row.case for row in rows} == {x.name for x in NUMBERS.values() if "nm" in x.given}
    assert [row.case for row in rows if row.verdict != "pass" or not row.reason or row.values["seconds"] <= 0] == []
    absent = dataclasses.replace(context, variants={**context.variants, "scalar_spectral": "absent"})
    assert {(row.verdict, row.reason) for row in study.rows("spectral", absent)} == {("not run", "absent")}


def test_piles_of_plates_are_not_run_in_scalar_variants_and_say_so(tmp_path, monkeypatch):
    exact = lambda numbers, _: {x.name: study.Measured(x.value, 1e-6) for x in numbers}  # noqa: E731
    monkeypatch.setattr(study, "measure", exact)
    needs = {need: study.rows(need, here("quick", tmp_path, "scalar_rgb")) for need in study.COMPILED}
    assert {row.case for rows in needs.values() for row in rows} == NUMBERS.keys()
    left_out = {row.case for rows in needs.values() for row in rows if row.verdict == "not run" and row.remedy}
    assert left_out == {x.name for x in NUMBERS.values() if x.given.get("count", 1) > 1} != set()


# By others -------------------------------------------------------------------------------------------------------


def program(share=0.0):
    """The textbook formula as a program that answers rays; the denser index has the relative error `share`."""

    def refract(rays):
        k = rays.rays.k[:, None].astype(float)
        with np.errstate(invalid="ignore"):
            a, n = (x.astype(float) for x in (rays.rays.a, rays.rays.n))
            b = textbook(a, n, np.where(k > 1, k * (1 + share), k / (1 + share)))
        return Answers(rays.ids, b.astype(rays.rays.a.dtype).astype(float), header={"system": "textbook"})

    return refract


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_the_textbook_formula_is_within_the_bounds_of_rays_and_twice_that_is_detected(precision):
    call, numbers = RaysCommand("textbook", precision, ("program",)), others.of_kind(*others.RAYS)

    def rows(share):
        measured = others.measure(numbers, call, program(share))
        return {x.name: others.row(x, "textbook", precision, *measured[x.name], "") for x in numbers}

    right, tiny = rows(0.0), 1e-4 if precision == "f32" else 1e-9
    assert [name for name, row in right.items() if row.verdict != "pass"] == []
    moved = {name: abs(row.values["measured"] - right[name].values["measured"]) for name, row in rows(tiny).items()}
    share = max(2 * right[name].values["bound"] / moved[name] * tiny for name in moved if moved[name] > 0)
    assert share < tiny
    assert [name for name, row in rows(share).items() if row.broken != {"error / bound": 1.0}] == []


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_a_direction_along_the_surface_is_a_signal_of_total_reflection(precision):
    """Its component across the surface is a rounding error, here 3 u toward the other side."""

    def refract(rays):
        answers, a, n = program()(rays), rays.rays.a.astype(float), rays.rays.n.astype(float)
        along = a - (a * n).sum(1, keepdims=True) * n
        along = along / np.linalg.norm(along, axis=1, keepdims=True) - 3 * rays.roundoff * n
        is_reflected = (answers.b == 0).all(1, keepdims=True)
        assert is_reflected.any()
        return dataclasses.replace(answers, b=np.where(is_reflected, along.astype(rays.rays.a.dtype), answers.b))

    call, numbers = RaysCommand("clamped", precision, ("program",)), others.of_kind("critical angle")
    measured = others.measure(numbers, call, refract)
    assert {others.row(x, "clamped", precision, *measured[x.name], "").verdict for x in numbers} == {"pass"}


def boundary(precision, share=0.0):
    """Fresnel's equations as a program that returns reflectances; the denser index has the relative error `share`."""
    real = np.float32 if precision == "f32" else np.float64

    def reflect(rays):
        c, k = -rays.rays.a[:, 2], rays.rays.k.astype(real)
        n = (1 / (np.where(k > 1, k * (1 + share), k / (1 + share)))).astype(real)
        root = np.sqrt((n * n - (1 - c * c)).astype(np.complex64 if precision == "f32" else complex))
        s, p = (c - root) / (c + root), (n * n * c - root) / (n * n * c + root)
        return {"s": np.abs(s) ** 2, "p": np.abs(p) ** 2, "phase": np.angle(p / s)}

    return reflect


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_fresnels_equations_are_within_the_bounds_of_a_boundary_and_twice_that_is_detected(precision):
    numbers = others.reflected(("p", "phase"))

    def rows(share):
        measured = others.measure_reflected(numbers, precision, boundary(precision, share))
        return {x.name: others.row(x, "a program", precision, *measured[x.name], "") for x in numbers}

    assert {x.kind for x in numbers} == {"Brewster's angle", "retardation", "diffuse"}
    right, tiny = rows(0.0), 1e-4 if precision == "f32" else 1e-9
    assert [name for name, row in right.items() if row.verdict != "pass"] == []
    moved = {name: abs(row.values["measured"] - right[name].values["measured"]) for name, row in rows(tiny).items()}
    flat = "largest retardation, n = 1.51"  # stationary in the incidence, not in the index
    for name in {*moved} - {flat}:
        share = 2.5 * right[name].values["bound"] / moved[name] * tiny
        assert share < 20 * tiny and rows(share)[name].broken == {"error / bound": 1.0}, name


def test_programs_of_reflectances_pass_and_missing_answers_fail(tmp_path, monkeypatch):
    title, *rest = others.FRESNEL
    context = here("quick", tmp_path, "scalar_rgb")
    rows = others.fresnel_rows(title, context)
    assert len(rows) == 9 and {row.verdict for row in rows} == {"pass"}
    for text, reason in {
        '{"system": "one", "s": [], "p": [0.5], "phase": [0]}': "[(0,), (1,), (1,)] answers; expected 517",
        '{"system": "one", "s": []}': "no answer: KeyError('p'); expected system, s, p, phase in JSON",
        "[]": "no answer: TypeError('list indices must be integers or slices, not str'); expected system, s, p, phase",
    }.items():
        monkeypatch.setattr(others.environments, "run", lambda *_, text=text: text)
        (row,) = others.fresnel_rows(title, context)
        assert row.broken == {"unanswered": 0.0} and row.reason.startswith(reason)
    monkeypatch.setattr(others.environments, "absent", lambda system: "install it")
    assert all(row.verdict == "not run" for name in rest for row in others.fresnel_rows(name, context))


def test_catalogue_indices_are_the_printed_ones_and_other_or_missing_ones_fail():
    numbers = [x for x in others.of_kind("index") if x.medium.startswith("SCHOTT:")]
    media, lines = list(dict.fromkeys(x.medium for x in numbers)), list(table.LINES.values())
    rays = ray_set.make(["generic"], 40, "f64", 0, media=media, wavelengths=lines)

    def broken(ratio):
        answers = Answers(rays.ids, rays.rays.a, n_ratio=ratio)
        used = others.indices(rays, answers, numbers)
        return [others.row(x, "catalogue", "f64", n, 5e-6, "").broken for x, n in zip(numbers, used, strict=True)]

    k = rays.rays.k
    assert broken(k) == [{}] * 9
    assert broken(np.where(k > 1, k + 1e-5, 1 / (1 / k + 1e-5))) == [{"error / bound": 1.0}] * 9
    assert broken(None) == [{"error / bound": 1.0}] * 9


def test_means_of_images_have_students_bound():
    rng, number = np.random.default_rng(7), NUMBERS["slab without polarisation, n = 1.52, 60°"]
    means = rng.binomial(1 << 16, number.value, others.SEEDS) / (1 << 16)
    value, bound = others.mean_and_bound(means)
    assert others.row(number, "x", "", value, bound, "").verdict == "pass" and bound < 0.01
    assert others.row(number, "x", "", value + 2 * bound, bound, "").broken == {"error / bound": 1.0}
    black = others.mean_and_bound(np.zeros(others.SEEDS))
    assert black == (0, 0) and others.row(number, "x", "", *black, "").broken == {"error / bound": 1.0}


def test_plates_are_closed_and_lit_from_behind():
    scene = others.plate_scene(NUMBERS["4 slabs without polarisation, n = 1.52, 0°"])
    *plates, lamp = scene.meshes
    for plate in plates:
        a, b, c = plate.triangles().swapaxes(0, 1)
        volume = (a * np.cross(b, c)).sum() / 6  # positive where normals point outward
        assert volume == pytest.approx((2 * others.WIDE) ** 2 * others.THICK)
    a, b, c = lamp.triangles().swapaxes(0, 1)
    assert len(plates) == 4 and a[:, 2].min() > plates[-1].vertices[:, 2].max()
    assert (np.cross(b - a, c - a)[:, 2] < 0).all()


def test_the_tables_of_the_documentation_have_all_measured_numbers():
    numbers = [NUMBERS["slab, n = 1.52, 0°"], NUMBERS["index of F2, line d"]]
    own = [study.row(x, study.Measured(x.value, 1e-6), "refract", "llvm_ad_mono") for x in numbers]
    lines = tables.numbers(own).splitlines()[-2:]
    assert lines[0].startswith("| slab, n = 1.52, 0° | 0.918318028 | – | 0.918318028 |") and "| 1.62004 |" in lines[1]
    theirs = [others.row(x, name, "f64", x.value, 1e-6, "") for x in numbers for name in ("A", "B")]
    theirs += [others.row(numbers[0], "C", "", 1.0, 1e-6, ""), Row(others.NAME, "D", "every ray", "f32", reason="none")]
    text = tables.numbers_elsewhere(theirs)
    assert "| number | A, f64 | B, f64 | C |" in text and " ✗ |" in text and "Not run here: D." in text
    for make in (tables.numbers, tables.numbers_elsewhere):
        with pytest.raises(ValueError, match="documentation: no "):
            make([])

"""Rules for all studies: tasks and rows have unique names, bounds have reasons and are not too wide.

Rows are those of studies whose quick form takes a second or two; the validation itself runs all studies.
"""

import functools
import importlib
import inspect
import math
import types
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mi_refract.io.image_file import srgb_decode
from mi_refract.media import glass_catalogs
from mi_refract.report.row import Row
from validation import __main__ as command
from validation import limits, repeated, runner
from validation.ground_truth import rainbow
from validation.run import seeds, tightness
from validation.run.array_settings import settings
from validation.run.context import here, profiles
from validation.study import Study, Task

MODULES = command.modules([], "full")
STUDIES = {name: importlib.import_module(f"validation.{name}").STUDY for name in MODULES}
RUN = (
    *("directions.bsdf_samples", "directions.planted_defects", "directions.sweep", "diff.planted_defects"),
    *("ground_truth.traced_bodies", "media.catalogs", "media.closed_forms", "planar.against_retrace"),
    *("planar.closed_paths", "planar.extruded_scenes", "planar.joints", "renders.random_numbers"),
    *("stability.derivatives", "stability.energy", "stability.layered_paths", "stability.optical_chains"),
    *("suite.small_mistakes", "media.ray_directions", "renders.gradients"),
)


# Studies and tasks ---------------------------------------------------------------------------------------------------


def test_every_study_is_listed_and_described():
    root = Path(command.__file__).parent
    modules = {".".join(path.relative_to(root).with_suffix("").parts): path.read_text() for path in root.glob("*/*.py")}
    assert {name for name, text in modules.items() if "\nSTUDY = " in text} == set(MODULES)
    assert set(command.QUICK) < set(MODULES) == set(command.modules([], "standard"))
    assert len({study.name for study in STUDIES.values()}) == len(STUDIES)
    assert all(study.title and study.text and study.terms for study in STUDIES.values())


# A task that may call one of these measures a time. `Camera` measures times too, which other tasks ignore.
CLOCKS = {"perf_counter", "process_time", "kernel_timing.interval", "scaling.run"}
NOT_JUDGED = "render_methods.Camera.__call__"


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"])
def test_tasks_have_unique_names_and_all_that_measure_times_are_timed(variant, needs_variant):
    needs_variant(variant)
    for profile in profiles(variant):
        tasks = runner.tasks(list(STUDIES.values()), here(profile, Path(), variant))
        assert {task.name for task in tasks if not task.timed and reachable(task.run) & CLOCKS} == set()
        assert any(reachable(task.run) & CLOCKS for task in tasks if task.timed)
    duplicate = Study("s", "", "", {}, lambda context: [Task("a", list), Task("a", list)])
    with pytest.raises(ValueError, match="two tasks have the name 'a'; expected unique names"):
        runner.tasks([duplicate], here("quick", Path(), variant))


def reachable(start):
    """Clocks and functions of the validation (module.name) that `start` may call, by the names in their code."""
    reached, queue = set(), [start]
    while queue:
        item = queue.pop()
        if isinstance(item, functools.partial):
            queue += [item.func, *item.args]
            continue
        if isinstance(item, Study):
            queue.append(item.again)
            continue
        if inspect.isclass(item):
            queue += vars(item).values()
            continue
        function = inspect.unwrap(item) if callable(item) else None
        if not isinstance(function, types.FunctionType):
            continue
        name = f"{function.__module__.rpartition('.')[2]}.{function.__qualname__}"
        if function.__module__.startswith(("validation", __name__)) and name not in reached | {NOT_JUDGED}:
            names = names_in(function.__code__)
            reached |= {name} | names & CLOCKS
            modules = [x for x in function.__globals__.values() if inspect.ismodule(x)]
            scopes = [function.__globals__, *(vars(x) for x in modules if x.__name__.startswith("validation"))]
            queue += [scope[name] for scope in scopes for name in names & scope.keys()]
            queue += [cell.cell_contents for cell in function.__closure__ or ()]
    return reached


def names_in(code):
    inner = [constant for constant in code.co_consts if isinstance(constant, types.CodeType)]
    return set(code.co_names).union(*map(names_in, inner))


def test_rows_without_cuda_say_what_it_needs():
    machine = here("quick", Path(), "scalar_rgb")
    absent = [setting.reason for setting in settings(machine) if setting.backend == "cuda" and not setting.vector]
    absent += [reason for name, reason in machine.variants.items() if name.startswith("cuda") and reason]
    rows = [Row("s", "x", "y", "cuda", reason=reason) for reason in absent]
    assert {row.remedy for row in rows} <= {"an NVIDIA GPU with its driver"}
    assert all(machine.variants[name] is None for name in machine.variants if name.startswith("scalar"))


# Seeds ---------------------------------------------------------------------------------------------------------------

# Studies that need no other seeds: their random draws decide no verdict on errors.
NOT_REPEATED = {
    "renders.against_dielectric": "eight seeds a side, compared by a test with a stated probability of alarm",
    "renders.colours": "images are shown; no value has a bound",
    "renders.unused_features": "times and equality to the last bit",
    "efficiency.error_against_time": "several seeds per method, with intervals",
    "efficiency.changing_indices": "times",
    "efficiency.chosen_settings": "several seeds per method, with intervals",
    "efficiency.caustics": "eight seeds a side, and six per time",
    "efficiency.scaling": "times",
    "planar.times": "times",
    "diff.planted_defects": "each trial has a different seed",
    "diff.times": "times",
    "suite.caustic_energies": "two seeds if a renderer is random; only a level is compared",
    "suite.exports": "several seeds a side",
    "suite.rendered_images": "several seeds a side",
    "suite.standard_numbers": "eight seeds per image; indices of glasses do not depend on the rays",
    "media.renders": "sixteen seeds a side in the furnace and by Welch's test; the rest is times and closed forms",
    "robustness.code_mutants": "each mutant is a case; the profile full has more of them",
    "ground_truth.standard_numbers": "one number is drawn, in sixteen sets of samples; the rest has no noise",
    "ground_truth.traced_bodies": "bodies are fixed; the rainbow's seeds are its sample",
}


@pytest.mark.parametrize("name", MODULES)
def test_randomised_studies_are_repeated_with_other_seeds_or_have_a_reason(name):
    assert NOT_REPEATED.keys() <= STUDIES.keys()
    source = Path(importlib.import_module(f"validation.{name}").__file__).read_text()
    draws = any(word in source for word in ("default_rng", "regimes.make(", "seed=", "SEED"))
    assert STUDIES[name].again is not None or name in NOT_REPEATED or not draws
    assert STUDIES[name].again is None or name not in NOT_REPEATED


def rows_of_one_seed(context):
    """A row whose bound holds for the study's own seed only."""
    value, own = np.random.default_rng(seeds.current(5)).random(), np.random.default_rng(5).random()
    return [Row("s", "x", "case", "", {"error": abs(value - own)}, {"error": 1e-9})]


@pytest.mark.parametrize(("profile", "count"), [("quick", 0), ("standard", 3), ("full", 10)])
def test_a_bound_that_holds_for_one_seed_only_fails(profile, count, tmp_path):
    context = here(profile, tmp_path, "scalar_rgb")
    assert rows_of_one_seed(context)[0].verdict == "pass"
    tasks = repeated.tasks(Study("s", "S", "", {}, lambda context: [], again=rows_of_one_seed), context)
    assert len(tasks) == count
    for task in tasks:
        summary, broken = task.run()
        assert (summary.values["checks"], summary.values["broken"], summary.verdict) == (1, 1, "fail")
        assert summary.values["largest share"] > 1e6 and broken.verdict == "fail"
    assert seeds.current(5) == 5


def test_a_repetition_without_checks_fails_and_one_that_cannot_run_is_not_run():
    def again(**row):
        study = Study("s", "S", "", {}, lambda c: [], again=lambda c: [Row("s", "x", "y", "", **row)])
        return repeated.rows_of(study, here("quick", Path(), "scalar_rgb"), 1)

    assert again(values={"error": 1.0})[0].broken == {"nothing checked": 0.0}
    (row,) = again(reason="install x")
    assert (row.verdict, row.case, row.reason) == ("not run", "other seed 1", "install x")
    for value, bound, share in ((0, 0, 0), (1, 0, np.inf), (np.nan, 0, np.nan), (1, 4, 0.25)):
        assert repeated.share(float(value), float(bound)) == pytest.approx(share, nan_ok=True)


DRAWN = "directions.bsdf_samples", "planar.closed_paths", "stability.energy", "stability.optical_chains"


@pytest.mark.parametrize("name", DRAWN)
def test_repetitions_depend_on_the_seed(name, tmp_path, llvm_variant):
    """Except for a few rows whose worst error is one ulp for any seed."""

    def rows(shift):
        with seeds.shifted(shift):
            return {row.name: row.values for row in STUDIES[name].again(here("quick", tmp_path, "llvm_ad_rgb"))}

    one, two = rows(1), rows(2)
    assert one.keys() == two.keys() and sum(one[x] == two[x] for x in one) <= len(one) // 20


@pytest.mark.parametrize("name", ["directions.per_formula", "stability.derivatives"])
def test_repetitions_on_scalar_variants(name, scalar_context, monkeypatch):
    context = scalar_context(rays=80, scalar_rays=2)
    absent = {key: replace(backend, usable=False, reason="absent") for key, backend in context.backends.items()}
    (row,) = repeated.rows_of(STUDIES[name], replace(context, backends=absent), 1)
    assert row.verdict == ("not run" if name == "stability.derivatives" else "pass")


def test_random_draws_are_cached_by_seed():
    calls = []
    draw = seeds.cached(lambda x: calls.append(x) or seeds.current(x))
    with seeds.shifted(1):
        other = draw(1)
    assert (draw(1), draw(1), other, calls) == (1, 1, 1 + seeds.STEP, [1, 1])


# Rows and bounds -----------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:.*is an extrapolation")  # some wavelengths are outside the fit of a glass
@pytest.mark.parametrize("name", RUN)
def test_studies_pass_and_no_bound_is_a_hundred_times_too_wide(name, tmp_path, llvm_variant, monkeypatch):
    monkeypatch.setattr(glass_catalogs, "CATALOGS", ("SCHOTT",))  # each takes a second
    tasks = STUDIES[name].tasks(here("quick", tmp_path, "llvm_ad_rgb"))
    rows_by_task = [(task, row) for task in tasks for row in task.run()]
    unexplained = [row for task, row in rows_by_task if not (row.bounds or row.reason or task.timed)]
    assert [row.name for row in unexplained if row.subject not in STUDIES[name].records] == []
    rows = STUDIES[name].summarise([row for _, row in rows_by_task])
    assert {row.study for row in rows} <= {STUDIES[name].name, "self-test"}
    assert [name for name, count in Counter(row.name for row in rows).items() if count > 1] == []
    assert [(row.name, row.broken) for row in rows if row.verdict == "fail"] == []
    assert any(row.verdict == "pass" for row in rows)
    assert all(math.isfinite(bound) and bound >= 0 for row in rows for bound in row.budgets.values())
    assert [row.reason for row in tightness.rows(rows) if row.verdict != "pass"] == []
    used: dict[limits.Limit, list[float]] = {}  # one metric may have several limits
    for row in rows:
        for metric, bound in row.budgets.items() if row.values else ():
            if isinstance(bound, limits.Limit) and not tightness.excluded(row.study, row.subject, metric):
                used.setdefault(bound, []).append(row.values[metric] / bound)
    assert [limit.reason for limit, shares in used.items() if max(shares) * tightness.LOOSE < 1] == []


def limits_in(value):
    if isinstance(value, limits.Limit):
        return [value]
    nested = value.values() if isinstance(value, dict) else ()
    return [limit for inner in nested for limit in limits_in(inner)]


def test_limits_are_finite_and_positive_and_have_reasons():
    every = [limit for name, value in vars(limits).items() if name.isupper() for limit in limits_in(value)]
    assert len(every) > 50
    assert [limit for limit in every if not (limit.reason and math.isfinite(limit) and limit > 0)] == []


def test_limits_of_noise_are_below_the_defects_that_they_must_reveal():
    """INDEX_SEEN moves the rainbow; one code of an 8-bit image is the least visible change of white."""
    moved = abs(rainbow.angle(rainbow.INDEX + limits.INDEX_SEEN) - rainbow.angle())
    assert moved / 11 < limits.RAINBOW_RESOLVED < moved / 9
    assert (1 - srgb_decode(np.array(254 / 255))) / 2 > limits.FURNACE_CHANNEL


def bounded(subject, case, value, bound=1.0, study="energy", metric="error"):
    return Row(study, subject, case, "", {metric: value}, {metric: bound})


def test_bounds_far_above_the_errors_must_be_explained():
    """A bound may be far above the errors of one case of two. Far above those of all, it needs an explanation."""
    near = [bounded("x", "easy", 0.001), bounded("x", "hard", 0.5), bounded("x", "never", 0.0, bound=0.0)]
    (row,) = tightness.rows(near)
    assert (row.values["checks"], row.values["far from the bound"], row.verdict) == (2, 1, "pass")
    assert row.reason == "x, error: 1 of 2 rows, others use up to 0.5 of it"
    (row,) = tightness.rows([*near, bounded("y", "easy", 0.002)])
    assert row.values["loose in every case"] == 1
    assert row.broken == {"unexplained": 0.0}
    for subject, verdict in (("powers", "pass"), ("amplitudes", "fail")):
        (row,) = tightness.rows([bounded(subject, "n = 2", 1e-4, metric="inside: R / u")])
        assert row.verdict == verdict and ("excludes: roundings" in row.reason) == (verdict == "pass")

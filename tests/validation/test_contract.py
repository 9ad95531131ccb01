"""What every study must keep to: tasks and rows have names of their own, bounds have reasons and exclude something.

Rows are those of the studies whose quick form takes a second or two; the validation itself runs all of them.
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


def test_every_study_is_in_a_room_and_described():
    root = Path(command.__file__).parent
    modules = {".".join(path.relative_to(root).with_suffix("").parts): path.read_text() for path in root.glob("*/*.py")}
    assert {name for name, text in modules.items() if "\nSTUDY = " in text} == set(MODULES)
    assert set(command.QUICK) < set(MODULES) == set(command.modules([], "standard"))
    assert len({study.name for study in STUDIES.values()}) == len(STUDIES)
    assert all(study.title and study.text and study.terms for study in STUDIES.values())


# A task that reaches one of them measures a time. What `Camera` measures is not judged by those that are not `timed`.
CLOCKS = {"perf_counter", "process_time", "kernel_timing.interval", "scaling.run"}
NOT_JUDGED = "render_methods.Camera.__call__"


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"])
def test_tasks_have_different_names_and_those_that_time_something_say_so(variant, needs_variant):
    needs_variant(variant)
    for profile in profiles(variant):
        tasks = runner.tasks(list(STUDIES.values()), here(profile, Path(), variant))
        assert {task.name for task in tasks if not task.timed and reached(task.run) & CLOCKS} == set()
        assert any(reached(task.run) & CLOCKS for task in tasks if task.timed)
    twice = Study("s", "", "", {}, lambda context: [Task("a", list), Task("a", list)])
    with pytest.raises(ValueError, match="two tasks have the name 'a'; expected unique names"):
        runner.tasks([twice], here("quick", Path(), variant))


def reached(start):
    """Clocks, and functions of the validation (module.name), that `start` may call, by the names in their code."""
    found, left = set(), [start]
    while left:
        this = left.pop()
        if isinstance(this, functools.partial):
            left += [this.func, *this.args]
        elif isinstance(this, Study):
            left.append(this.again)
        elif inspect.isclass(this):
            left += vars(this).values()
        elif isinstance(this := inspect.unwrap(this) if callable(this) else None, types.FunctionType):
            name = f"{this.__module__.rpartition('.')[2]}.{this.__qualname__}"
            if this.__module__.startswith(("validation", __name__)) and name not in found | {NOT_JUDGED}:
                names = names_in(this.__code__)
                found |= {name} | names & CLOCKS
                modules = [x for x in this.__globals__.values() if inspect.ismodule(x)]
                scopes = [this.__globals__, *(vars(x) for x in modules if x.__name__.startswith("validation"))]
                left += [scope[name] for scope in scopes for name in names & scope.keys()]
                left += [cell.cell_contents for cell in this.__closure__ or ()]
    return found


def names_in(code):
    inner = [constant for constant in code.co_consts if isinstance(constant, types.CodeType)]
    return set(code.co_names).union(*map(names_in, inner))


def test_why_cuda_does_not_run_says_what_it_needs():
    machine = here("quick", Path(), "scalar_rgb")
    absent = [setting.reason for setting in settings(machine) if setting.backend == "cuda" and not setting.vector]
    absent += [reason for name, reason in machine.variants.items() if name.startswith("cuda") and reason]
    rows = [Row("s", "x", "y", "cuda", reason=reason) for reason in absent]
    assert {row.remedy for row in rows} <= {"an NVIDIA GPU with its driver"}
    assert all(machine.variants[name] is None for name in machine.variants if name.startswith("scalar"))


# Seeds ---------------------------------------------------------------------------------------------------------------

# Their random draws decide no verdict on errors: times, noise of several seeds of their own, or a sampled defect.
OTHERWISE = {
    "renders.against_dielectric": "eight seeds a side, compared by a test with a stated probability of alarm",
    "renders.colours": "images are shown; no figure has a bound",
    "renders.unused_features": "times and equality to the last bit",
    "efficiency.error_against_time": "several seeds a method, with intervals",
    "efficiency.changing_indices": "times",
    "efficiency.chosen_settings": "several seeds a method, with intervals",
    "efficiency.caustics": "eight seeds a side, and six of each time",
    "efficiency.scaling": "times",
    "planar.times": "times",
    "diff.planted_defects": "trials with seeds of their own",
    "diff.times": "times",
    "suite.caustic_energies": "two seeds, where a renderer is random; a level is compared",
    "suite.exports": "several seeds a side",
    "suite.rendered_images": "several seeds a side",
    "suite.standard_numbers": "eight seeds an image; of glasses, which rays they are does not matter",
    "media.renders": "sixteen seeds a side in the furnace, eight by Welch's test; the rest is times and closed forms",
    "robustness.code_mutants": "each mutant is a case of its own, and the study is longer in full",
    "ground_truth.standard_numbers": "one number is drawn, in sixteen sets of samples; the rest has no noise",
    "ground_truth.traced_bodies": "bodies are fixed; the rainbow's seeds are its sample",
}


@pytest.mark.parametrize("name", MODULES)
def test_a_study_that_draws_is_repeated_with_other_seeds_or_says_why_not(name):
    assert OTHERWISE.keys() <= STUDIES.keys()
    source = Path(importlib.import_module(f"validation.{name}").__file__).read_text()
    draws = any(word in source for word in ("default_rng", "regimes.make(", "seed=", "SEED"))
    assert STUDIES[name].again is not None or name in OTHERWISE or not draws
    assert STUDIES[name].again is None or name not in OTHERWISE


def drawn(context):
    """A bound that holds for the study's own seed and for no other."""
    value, own = np.random.default_rng(seeds.current(5)).random(), np.random.default_rng(5).random()
    return [Row("s", "x", "case", "", {"error": abs(value - own)}, {"error": 1e-9})]


@pytest.mark.parametrize(("profile", "count"), [("quick", 0), ("standard", 3), ("full", 10)])
def test_a_bound_that_only_its_own_seed_holds_fails(profile, count, tmp_path):
    context = here(profile, tmp_path, "scalar_rgb")
    assert drawn(context)[0].verdict == "pass"
    tasks = repeated.tasks(Study("s", "S", "", {}, lambda context: [], again=drawn), context)
    assert len(tasks) == count
    for task in tasks:
        summary, broken = task.run()
        assert (summary.values["checks"], summary.values["broken"], summary.verdict) == (1, 1, "fail")
        assert summary.values["largest share"] > 1e6 and broken.verdict == "fail"
    assert seeds.current(5) == 5


def test_a_repetition_that_checks_nothing_fails_and_one_of_what_cannot_be_run_is_not_run():
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
def test_what_is_repeated_depends_on_the_seed(name, tmp_path, llvm_variant):
    """But for a row or two whose worst error is one ulp either way."""

    def rows(shift):
        with seeds.shifted(shift):
            return {row.name: row.values for row in STUDIES[name].again(here("quick", tmp_path, "llvm_ad_rgb"))}

    one, two = rows(1), rows(2)
    assert one.keys() == two.keys() and sum(one[x] == two[x] for x in one) <= len(one) // 20


@pytest.mark.parametrize("name", ["directions.per_formula", "stability.derivatives"])
def test_where_nothing_is_compiled_scalars_are_repeated_or_the_row_is_not_run(name, scalar_context, monkeypatch):
    context = scalar_context(rays=80, scalar_rays=2)
    absent = {key: replace(backend, usable=False, reason="absent") for key, backend in context.backends.items()}
    (row,) = repeated.rows_of(STUDIES[name], replace(context, backends=absent), 1)
    assert row.verdict == ("not run" if name == "stability.derivatives" else "pass")


def test_what_is_drawn_is_kept_by_seed():
    calls = []
    draw = seeds.cached(lambda x: calls.append(x) or seeds.current(x))
    with seeds.shifted(1):
        other = draw(1)
    assert (draw(1), draw(1), other, calls) == (1, 1, 1 + seeds.STEP, [1, 1])


# Rows and bounds -----------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:.*is an extrapolation")  # wavelengths are drawn beyond the fit of a glass
@pytest.mark.parametrize("name", RUN)
def test_a_study_holds_its_bounds_none_of_which_is_a_hundred_times_too_wide(name, tmp_path, llvm_variant, monkeypatch):
    monkeypatch.setattr(glass_catalogs, "CATALOGS", ("SCHOTT",))  # each takes a second
    tasks = STUDIES[name].tasks(here("quick", tmp_path, "llvm_ad_rgb"))
    made = [(task, row) for task in tasks for row in task.run()]
    silent = [row.name for task, row in made if not (row.bounds or row.reason or task.timed)]
    assert [x for x in silent if x.split(" / ")[1] not in STUDIES[name].records] == []
    rows = STUDIES[name].summarise([row for _, row in made])
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
    nested = value.values() if isinstance(value, dict) else ()
    return [value] if isinstance(value, limits.Limit) else [limit for each in nested for limit in limits_in(each)]


def test_a_limit_is_a_number_with_a_reason_and_on_noise_lets_no_defect_hide_that_it_is_for():
    """An index off by INDEX_SEEN moves the rainbow; one code of an 8-bit image is the least that is seen in white."""
    every = [limit for name, value in vars(limits).items() if name.isupper() for limit in limits_in(value)]
    assert len(every) > 50
    assert [limit for limit in every if not (limit.reason and math.isfinite(limit) and limit > 0)] == []
    moved = abs(rainbow.angle(rainbow.INDEX + limits.INDEX_SEEN) - rainbow.angle())
    assert moved / 11 < limits.RAINBOW_RESOLVED < moved / 9
    assert (1 - srgb_decode(np.array(254 / 255))) / 2 > limits.FURNACE_CHANNEL


def bounded(subject, case, value, bound=1.0, study="energy", metric="error"):
    return Row(study, subject, case, "", {metric: value}, {metric: bound})


def test_bounds_far_above_the_errors_are_listed_and_must_be_explained():
    """Far in one case of two: the bound is the other's. Far in every case: an explanation, or the row fails."""
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

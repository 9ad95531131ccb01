"""The validation sees planted defects, resumes what was interrupted, and refuses misuse in one line."""

import dataclasses
import importlib
import math
import os
import re
import types
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_refract import FORMULAS, oracle, regimes
from mi_refract.accuracy import errors
from mi_refract.image_diff import self_test
from mi_refract.image_diff.methods import METHODS
from mi_refract.image_diff.self_test import DEFECTS
from mi_refract.plugins import refract as bsdf
from mi_refract.report.row import Row
from mi_refract.report.run_report import read_json
from validation import __main__ as command
from validation import limits, readme_tables, runner
from validation.diff import planted_defects, visible_changes
from validation.directions import bsdf_samples, per_formula
from validation.renders import against_dielectric, colours
from validation.renders import scene_needs as scenes
from validation.run import array_settings as settings
from validation.run import render_methods
from validation.run.context import SCENES, beyond_builtin
from validation.stability import layered_paths
from validation.study import Study, Task
from validation.suite.renderers import SYSTEMS
from validation.suite.renderers.image_renderers import IMAGE_RENDERERS


@pytest.fixture
def context(scalar_context):
    return scalar_context(scalar_rays=60, resolution=8, spp=4, pairs=8, curve_spp=(1,))


def defective(props):
    """A plugin whose index is off by one part in a hundred."""
    plugin = bsdf.plugin_class(mi.scalar_rgb)(props)
    params = mi.traverse(plugin)
    params["eta"] = 1.01 * float(plugin.eta[0])
    params.update()
    return plugin


def tinted(props):
    props["specular_transmittance"] = 0.999
    return props


# Studies -------------------------------------------------------------------------------------------------------


def test_errors_are_those_that_were_put_in():
    rays = regimes.make("generic", 50, np.float64, seed=1)
    exact = oracle.refract(rays.a, rays.n, rays.k, progress=False)
    length = np.sqrt((rays.a.astype(np.longdouble) ** 2).sum(1))[:, None]
    direction = exact.direction.astype(np.longdouble) + exact.direction_low
    chord, angle, drift = errors(direction * length, rays, exact)
    assert max(chord.max(), angle.max(), drift.max()) < 1e-18
    across = np.cross(direction, np.roll(direction, 1, axis=1))
    across /= np.sqrt((across**2).sum(1))[:, None]
    chord, angle, _ = errors((direction + 1e-9 * across) * length, rays, exact)
    assert chord == pytest.approx(1e-9, rel=1e-6)
    assert angle == pytest.approx(1e-9, rel=1e-6)
    chord, angle, drift = errors(direction * 1.001 * length, rays, exact)
    assert (chord, drift) == (pytest.approx(1e-3), pytest.approx(1e-3))
    assert angle.max() < 1e-18
    chord, _, _ = errors(direction * np.nan, rays, exact)
    assert np.isinf(chord).all()


def test_directions_name_what_does_not_run_and_hold_what_does(context):
    rows = [row for task in per_formula.tasks(context) if "scalar" in task.name for row in task.run()]
    assert {row.verdict for row in rows} == {"info", "pass"}
    absent = [s for s in settings.settings(context) if s.vector is None]
    assert all(row.verdict == "not run" and row.reason for s in absent for row in per_formula._setting_rows(context, s))
    worst = next(row for row in rows if row.subject == "promoted" and row.case == "critical")
    assert {"error / bound", "TIR misclassified, beyond its bound"} == set(worst.budgets)
    assert len(worst.replay["largest error"]["a"]) == 3


@pytest.mark.parametrize(("constant", "factor"), [("linear", 6), ("radicand", 6), ("linear", 1), ("linear", 0.2)])
def test_a_budget_that_is_loose_or_too_tight_fails_the_full_sweep(constant, factor, context, monkeypatch):
    monkeypatch.setattr(limits, "SLACK_FROM_RAYS", 60)
    formula = FORMULAS["decomposed"]
    off = dataclasses.replace(formula.budget, **{constant: factor * getattr(formula.budget, constant)})
    monkeypatch.setitem(FORMULAS, "decomposed", dataclasses.replace(formula, budget=off))
    setting = settings.settings(context)[0]
    parts = [per_formula._regime_row("decomposed", formula, r, setting, 3000) for r in ("grazing", "critical", "k ≫ 1")]
    whole = per_formula._summary("decomposed", parts, setting, {})
    assert set(whole.budgets) == {"slack, linear", "slack, radicand"}
    broken = {metric for row in (whole, *parts) for metric in row.broken}
    assert broken == ({f"slack, {constant}"} if factor > 1 else {"error / bound"} if factor < 1 else set())


def test_samples_pass_and_see_an_index_that_is_off(context, monkeypatch):
    modes = bsdf_samples._modes()
    assert all(bsdf_samples._mode_row(*mode, 200, "scalar_rgb").verdict == "pass" for mode in modes)
    load = mi.load_dict
    # By 1e-5: one bound for all rays, that of the critical angle, would allow 1.4e-3.
    monkeypatch.setattr(mi, "load_dict", lambda d: load(d | {"int_ior": 1.50001} if d["type"] == "refract" else d))
    broken = bsdf_samples._mode_row(*modes[0], 200, "scalar_rgb").broken
    assert {"eta worst", "wo / bound", "pdf / bound", "weight / bound"} <= set(broken)


@pytest.mark.parametrize(("expected", "most"), [(0.0, 0), (1e-7, 0), (1e-3, 1), (0.05, 3), (1.0, 9)])
def test_flips_are_allowed_as_chance_has_them(expected, most):
    """The smallest m with P(Poisson > m) ≤ 1e-6: for a small mean x, x^(m+1)/(m+1)!."""
    assert bsdf_samples.most_flips(expected) == most


@pytest.mark.parametrize(("plugin", "verdict"), [("refract", "pass"), ("refract_defect", "fail")])
def test_renders_agree_and_see_an_index_that_is_off(context, plugin, verdict):
    mi.register_bsdf("refract_defect", defective)
    (row,) = against_dielectric._compare(context, SCENES / "sphere.xml", plugin)
    assert row.verdict == verdict, row.values
    assert sorted(path.name for path in (context.out / "images/sphere").iterdir()) == sorted(
        ["dielectric.exr", f"{plugin} difference.exr", f"{plugin} test.exr"]
    )
    assert set(row.curves) == ({"refract", "dielectric"} if plugin == "refract" else set())


def test_what_is_the_same_is_not_tested_by_chance_and_still_compared(context):
    """The furnace has no noise: no Welch test, but an image that is off fails; and NaN is no image at all."""
    mi.register_bsdf("refract_tinted", lambda props: bsdf.plugin_class(mi.scalar_rgb)(tinted(props)))
    right, wrong = (
        against_dielectric._compare(context, SCENES / "furnace.xml", p)[0] for p in ("refract", "refract_tinted")
    )
    assert right.verdict == "pass" and right.reason.startswith("left out: Welch's test")
    assert "Welch alarms" not in right.values and not right.curves
    assert {"|mean ratio − 1|", "changed share"} <= set(wrong.broken)
    quiet, noisy = np.ones((4, 8, 8, 3)), np.random.default_rng(1).random((4, 8, 8, 3))
    assert against_dielectric._budgets("nested", "").keys() == {"|mean ratio − 1|", "Welch alarms"}
    assert against_dielectric._budgets("nested", "left out").keys() == {"|mean ratio − 1|", "changed share"}
    assert against_dielectric._budgets("mirage", "left out") == {}
    assert "bit for bit" in against_dielectric.no_question(noisy, noisy)
    assert "independent seeds" in against_dielectric.no_question(quiet + 1e-7, quiet)
    assert against_dielectric.no_question(quiet * np.nan, quiet) == against_dielectric.no_question(noisy, quiet) == ""


def test_scenes_say_what_they_need_and_what_is_left_out(context):
    (row,) = scenes.scene_rows(context, SCENES / "slab.xml")
    assert {name for name, value in row.values.items() if value} == {
        "sampleable",
        "lamps",
        "area",
        "environment",
        "plain environment",
        "only glass",
        "textured",
        "polarising",
        "refracting",
        "deterministic",
    }
    assert row.reason == "left out: emitter sampling, a random number, media, null lobes, dispersion, absorption"
    assert row.replay["left out"]["dispersion"] == "no BSDF bends light by its wavelength"


def test_an_image_of_colours_is_of_as_many_renders_as_its_noise_asks_for():
    """Of 48 × 48 numbers with a relative noise of 0.4: 64 renders leave 0.05; its estimate is off by 1 %."""
    rng = np.random.default_rng(5)

    def camera(spp, seed):
        return (rng.normal(2, 0.8, (48, 48, 3)),)

    for count, most, expected in ((16, 1, 16), (16, 2, 32), (16, 16, 64 + 16), (80, 4, 80)):
        image, noise, seeds = colours._mean(camera, 1, count, most)
        assert seeds == pytest.approx(expected, abs=16 if most == 16 else 0)
        assert noise == pytest.approx(0.4 / np.sqrt(seeds), rel=0.06)
        assert image.mean() == pytest.approx(2, rel=0.01)


def test_colours_are_shown_where_the_spectral_variant_runs(context, needs_variant):
    path = SCENES / "rainbow_drop.xml"
    (row,) = colours.scene_rows(context, path)
    assert (row.values, row.reason) == ({}, colours.SCALAR)
    needs_variant("llvm_ad_spectral")
    (row,) = colours.scene_rows(dataclasses.replace(context, variant="llvm_ad_rgb"), path)
    assert row.setting == "llvm_ad_spectral" and row.values[colours.COLOUR] > 0.1
    assert (context.out / row.images["test"]).is_file()
    assert mi.variant() == "scalar_rgb"


# The run -------------------------------------------------------------------------------------------------------


def row(**values):
    return Row("directions", "promoted", "all regimes", "scalar float64", values or {"worst / u": 0.5})


def test_an_interrupted_run_goes_on_where_it_stopped(context):
    calls = []

    def work(name):
        calls.append(name)
        return [row()]

    def interrupt():
        raise KeyboardInterrupt

    first, last = Task("first", lambda: work("first")), Task("last", lambda: work("last"))
    with pytest.raises(KeyboardInterrupt):
        runner.run([first, Task("last", interrupt)], context)
    rows, spent = runner.run([first, last], context)
    assert rows == [row(), row()]
    assert [(each["task"], each["CPU seconds"] >= 0) for each in spent] == [("first", True), ("last", True)]
    assert calls == ["first", "last"]
    other = dataclasses.replace(context, profile=dataclasses.replace(context.profile, rays=17))
    runner.run([first], other)
    assert calls == ["first", "last", "first"]
    runner.forget(context)
    runner.run([first], context)
    assert calls[-2:] == ["first", "first"]


def test_rows_are_in_the_order_of_the_tasks_and_of_each(context):
    made = [dataclasses.replace(row(), subject=name) for name in "abcd"]
    tasks = [Task("first", lambda: made[:2]), Task("last", lambda: made[2:])]
    for _ in range(2):  # measured, then taken up again
        assert runner.run(tasks, context)[0] == made


def test_rows_are_taken_up_again_for_the_same_sources_only(context, tmp_path, monkeypatch):
    names = ("package/room/a.py", "validation/room/b.py", "validation/room/c.json", "scenes/planar/d.toml")
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("old")
    monkeypatch.setattr(runner.mi_refract, "__file__", str(tmp_path / "package/__init__.py"))
    monkeypatch.setattr(runner, "__file__", str(tmp_path / "validation/runner.py"))
    monkeypatch.setattr(runner, "SCENES", tmp_path / "scenes")
    calls = []
    task = Task("a task", lambda: calls.append(1) or [row()])
    for count, name in enumerate((*names, None), 1):
        for _ in range(2):
            runner.run([task], context)
        assert len(calls) == count, names[count - 2]
        if name:
            (tmp_path / name).write_text("new")


def study(*rows):
    return types.SimpleNamespace(
        STUDY=Study("directions", "A study", "What it asks.", {}, lambda context: [Task("a task", lambda: list(rows))])
    )


@pytest.mark.parametrize(("budget", "code"), [(1.0, 0), (0.4, 1), (float("nan"), 1)])
def test_the_exit_code_follows_the_budgets(tmp_path, monkeypatch, capsys, budget, code):
    measured = dataclasses.replace(row(), budgets={"worst / u": budget})
    monkeypatch.setattr(command, "import_module", lambda name: study(measured))
    assert command.main(["directions", "--out", str(tmp_path)]) == code
    assert {path.name for path in tmp_path.iterdir()} == {"rows.json", "junit.xml", "report.html"}
    rows, context = read_json(tmp_path / "rows.json")
    assert rows[0].verdict == ("pass" if code == 0 else "fail")
    assert context["versions"]["mitsuba"] == mi.__version__


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["refractions"], "unknown study 'refractions'; expected directions, stability, renders, efficiency, media"),
        (["--profile", "slow"], "unknown profile 'slow'; expected quick, standard, full"),
        (["--out", __file__], "File exists; expected a writable folder"),
        (["--speed", "9"], "No such option: --speed"),
        (["--write-tables"], "--write-tables with the profile 'quick'; expected --profile standard, --profile full"),
        (["renderers", "--install", "blender"], "unknown system 'blender'; expected batoid, cycles"),
        (["renderers", "--list", "--install", "pyglm"], "expected one of them"),
        (["renderers", "pyglm"], "unexpected extra argument"),
    ],
)
def test_misuse_is_one_line_and_exit_code_2(arguments, words, capsys):
    code = command.main(arguments)
    printed = capsys.readouterr().err
    assert code == 2
    assert words in printed
    assert len(printed.splitlines()) == 1


def test_an_interruption_is_exit_code_130_and_says_how_to_go_on(tmp_path, monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "_run", interrupted)
    assert command.main(["--out", str(tmp_path)]) == 130
    assert "run the same command again to resume" in capsys.readouterr().err


def test_two_validations_do_not_share_a_folder(tmp_path, monkeypatch, capsys):
    inside = []

    def second():
        inside.append(command.main(["directions", "--out", str(tmp_path)]))
        return [row()]

    holding = Study("directions", "A study", "", {}, lambda context: [Task("a task", second)])
    monkeypatch.setattr(command, "import_module", lambda name: types.SimpleNamespace(STUDY=holding))
    assert command.main(["directions", "--out", str(tmp_path)]) == 0
    assert inside == [2]
    said = [line for line in capsys.readouterr().err.splitlines() if "runs there already" in line]
    assert len(said) == 1 and f"{tmp_path}: a validation runs there already, process {os.getpid()} on " in said[0]
    assert {path.name for path in tmp_path.iterdir()} == {"rows.json", "junit.xml", "report.html"}


def test_every_study_is_in_a_room_and_has_rows_of_its_own():
    names = [name for profile in command.PROFILES for name in command.modules([], profile)]
    assert set(command.QUICK) < set(command.modules([], "standard")) == set(command.modules([], "full"))
    root = Path(command.__file__).parent
    modules = {str(p.relative_to(root).with_suffix("")).replace("/", ".") for p in root.glob("*/*.py")}
    holding = {name for name in modules if "\nSTUDY = Study(" in (root / f"{name.replace('.', '/')}.py").read_text()}
    assert holding == set(names)
    studies = [importlib.import_module(f"validation.{name}").STUDY for name in sorted(holding)]
    assert len({each.name for each in studies}) == len(studies)
    assert all(each.title and each.text and each.terms for each in studies)


def test_a_limit_is_a_number_with_a_reason():
    table = limits.table()
    assert len(table) > 50
    assert [name for name, limit in table.items() if not (limit.reason and math.isfinite(limit) and limit > 0)] == []


# The README ----------------------------------------------------------------------------------------------------


def test_the_accuracy_table_holds_the_rows_and_nothing_else():
    settings = {"llvm float32": {"TIR misclassified": 3.0}, "llvm float64": {}}
    rows = [
        Row(
            "directions",
            "promoted",
            "all regimes",
            setting,
            {
                "worst chord": 4.97e-8,
                "worst / u": 0.834,
                "time / copy": 1.01,
                "time / copy, low": 0.98,
                "time / copy, high": 1.2,
                "time / plain": 1.05,
            }
            | more,
            replay={"rays": 28000},
        )
        for setting, more in settings.items()
    ]
    floor = [dataclasses.replace(r, subject="copy", values={"time / copy": 1.0}, replay={}) for r in rows]
    lines = readme_tables.accuracy([*rows, *floor]).splitlines()
    assert len(lines) == 6
    assert [cell.strip() for cell in lines[-1].split("|")][1:-1] == [
        "`promoted`",
        "this project",
        "4.97e-8",
        "0.834",
        "3",
        "1.01 (0.98–1.2)",
        "1.05",
        "4.97e-8",
        "0.834",
        "1.01 (0.98–1.2)",
    ]


def test_a_share_of_several_scenes_is_that_of_all():
    assert readme_tables._percent([0.31, 0.1, 0.25]) == "10–31 %"
    assert readme_tables._percent([0.101, 0.1]) == "10 %"


NOTHING_MEASURED = {
    "accuracy": "no directions were measured",
    "renders": "no scene was rendered",
    "paths": "no paths were traced",
    "efficiency": "no efficiency was measured",
    "planar": "no planar paths were traced",
    "seen": "no defects were planted",
    "visible": "no visible changes were planted",
    "suite": "no other renderer was run",
}


@pytest.mark.parametrize("table", NOTHING_MEASURED)
def test_a_readme_is_not_written_from_a_run_that_measured_too_little(table):
    with pytest.raises(ValueError, match=NOTHING_MEASURED[table]):
        getattr(readme_tables, table)([])


def test_the_readmes_hold_their_tables():
    scenes = [path.stem for path in SCENES.glob("*.xml") if not beyond_builtin(path)]
    ways = [method.name for method in render_methods.METHODS]
    others = [call.title for system in SYSTEMS.values() for call in system.calls]
    words_of = {
        "accuracy": FORMULAS,
        "renders": scenes,
        "paths": layered_paths.plugins(),
        "efficiency": ways,
        "changing": ["a new scene for each image", "an edit among 300 glasses", "a sweep of 12 indices"],
        "planar": [path.stem for path in SCENES.glob("planar/*.toml")],
        "defects": [*planted_defects.GLASSES, *DEFECTS, *METHODS],
        "visible": [*visible_changes.KINDS, *map(str, visible_changes.SQUARES)],
        "suite": [*others, *IMAGE_RENDERERS],
    }
    assert words_of.keys() == readme_tables.TABLES.keys()
    readme_tables.check(list(command.ROOMS))
    for marker, words in words_of.items():
        text = (readme_tables.ROOT / readme_tables.TABLES[marker].path).read_text()
        table = text.partition(f"<!-- begin: {marker} -->")[2].partition(f"<!-- end: {marker} -->")[0]
        assert [word for word in words if word not in table] == []


def test_the_table_of_other_renderers_is_written_where_the_suite_is_named():
    assert readme_tables.chosen([]).keys() == readme_tables.TABLES.keys() - {"suite"}
    assert readme_tables.chosen(["suite"]).keys() == {"suite"}
    assert readme_tables.chosen(["planar", "diff"]).keys() == {"planar", "defects", "visible"}
    assert {table.study for table in readme_tables.TABLES.values()} <= command.ROOMS.keys()


def test_the_table_of_defects_is_made_of_the_rows_of_the_self_test():
    rng = np.random.default_rng(1)
    rows = self_test.examine(rng.gamma(16, 1 / 16, (4, 16, 16, 3)), "noise", trials=1, null_pairs=2)
    lines = readme_tables.seen(rows).splitlines()
    assert lines[0].startswith("noise; 1 trials each of 2 renders a side. Minimum detectable difference in a tile: ")
    assert [line.split("|")[1].strip() for line in lines[4:-1]] == list(DEFECTS)
    assert [cell.strip() for cell in lines[-1].split("|")[2:4]] == ["identical", "0 of 4"]


def test_images_of_the_first_page_exist():
    text = (readme_tables.ROOT / "README.md").read_text()
    images = re.findall(r"!\[[^]]*\]\(([^)]+)\)", text)
    assert images
    assert all((readme_tables.ROOT / path).is_file() for path in images)
    assert len(text.splitlines()) <= 200


def test_a_scene_is_loaded_in_the_same_order_every_time(context):
    """Loading with Mitsuba's defaults gives one of two images, about one time in four the other one."""
    scenes = [render_methods.opened(SCENES / "diamond.xml", "dielectric", 8) for _ in range(12)]
    images = [render_methods.Camera(scene)(1, seed=0)[0] for scene in scenes]
    assert all((image == images[0]).all() for image in images)

"""The command of the validation: resuming, misuse, and the tables of the documentation."""

import dataclasses
import functools
import importlib
import json
import os
import re
import types

import dask
import mitsuba as mi
import pytest
from support.dask_workers import tls_settings

from mi_refract import FORMULAS
from mi_refract.backend import Backend
from mi_refract.cluster.connection import ClusterTarget, connected
from mi_refract.image_diff import self_test
from mi_refract.image_diff.methods import METHODS
from mi_refract.report.row import Row
from validation import __main__ as command
from validation import runner, tables
from validation.diff import planted_defects, visible_changes
from validation.efficiency import caustic_scenes
from validation.reference.standard_numbers import NUMBERS
from validation.renders import gradients, samplers, thin_panes
from validation.run import render_methods
from validation.run.context import SCENES, beyond_builtin, here
from validation.run.metrics import EQUAL_TIME, EQUAL_TIME_DEFAULTS
from validation.stability import layered_paths
from validation.study import Study, Task
from validation.suite import caustic_energies, rendered_images
from validation.suite import standard_numbers as by_others
from validation.suite.renderers import SYSTEMS, system
from validation.suite.renderers.image_renderers import IMAGE_RENDERERS

MODULES = ("stability.optical_chains", "stability.layered_paths")
WORKERS = runner.OnCluster(MODULES, "quick", "scalar_rgb")
FILES = {"rows.json", "junit.xml", "report.html"}


@pytest.fixture
def context(tmp_path, scalar_variant):
    return here("quick", tmp_path, "scalar_rgb")


def row(**changes):
    default = Row("directions", "promoted", "all regimes", "scalar float64", {"worst / u": 0.5}, replay={"rays": 3})
    return dataclasses.replace(default, **changes)


# Running and resuming ------------------------------------------------------------------------------------------------


class FakeWorkers:
    """Workers that run the tasks in this process, from the last to the first."""

    def __init__(self, tasks, order):
        self.tasks, self.order = tasks, order

    def run(self, work, context):
        for number, name in reversed(work):
            self.order.append(f"worker: {name}")
            yield number, runner.timed(self.tasks[number])


@pytest.mark.parametrize("on_workers", [False, True])
def test_an_interrupted_run_resumes(context, on_workers):
    calls, fails = [], ["a" if on_workers else "b"]

    def work(name):
        calls.append(name)
        if name in fails:
            raise KeyboardInterrupt
        return [row(subject=f"{name}{i}") for i in range(2)]

    tasks = [Task(name, functools.partial(work, name)) for name in "ab"]
    workers = FakeWorkers(tasks, []) if on_workers else None
    with pytest.raises(KeyboardInterrupt):
        runner.run(tasks, context, workers)
    fails.clear()
    rows, spent = runner.run(tasks, context, workers)
    assert [row.subject for row in rows] == ["a0", "a1", "b0", "b1"]  # in the order of the tasks
    assert [(task["task"], task["CPU seconds"] >= 0) for task in spent] == [("a", True), ("b", True)]
    assert calls == (["b", "a", "a"] if on_workers else ["a", "b", "b"])
    runner.run(tasks, dataclasses.replace(context, profile=dataclasses.replace(context.profile, rays=17)))
    assert len(calls) == 5
    runner.run(tasks, context)
    assert len(calls) == 5
    runner.forget(context)
    runner.run(tasks, context)
    assert len(calls) == 7


def test_a_task_runs_again_only_if_its_image_is_gone_or_of_another_run(context, tmp_path):
    image, calls = tmp_path / "image.exr", []

    def work(name):
        calls.append(name)
        image.write_text(f"{name}, {len(calls)}")
        return [row(images={"reference": image.name})]

    tasks = [Task(name, functools.partial(work, name)) for name in "ab"]  # both write the reference
    other = dataclasses.replace(context, profile=dataclasses.replace(context.profile, rays=17))
    runs = [(context, "ab"), (context, ""), (other, "ab"), (other, ""), (context, "a"), (other, "a"), (context, "a")]
    for number, (state, expected) in enumerate(runs):
        before = len(calls)
        runner.run(tasks, state)
        assert calls[before:] == [*expected], number
    image.unlink()
    runner.run(tasks, context)
    assert calls[-2:] == ["a", "a"] and image.is_file()


def test_timed_tasks_run_last_and_not_on_workers(context):
    order = []
    tasks = [Task(n, lambda n=n: order.append(n) or [row(subject=n)], timed=n == "y") for n in "xyz"]
    rows, _ = runner.run(tasks, context, FakeWorkers(tasks, order))
    assert [row.subject for row in rows] == ["x", "y", "z"]
    assert order == ["worker: z", "z", "worker: x", "x", "y"]


def test_saved_rows_are_used_for_the_same_sources_only(context, tmp_path, monkeypatch):
    names = ("package/room/a.py", "package/room/glasses.json", "validation/room/b.py", "validation/room/c.json")
    names = (*names, "validation/room/scripts/e.mjs", "scenes/planar/d.toml")
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("old")
    monkeypatch.setattr(runner.mi_refract, "__file__", str(tmp_path / "package/__init__.py"))
    monkeypatch.setattr(runner, "__file__", str(tmp_path / "validation/runner.py"))
    monkeypatch.setattr(runner, "SCENES", tmp_path / "scenes")
    calls = []
    for count, name in enumerate((None, *names), 1):
        if name:
            (tmp_path / name).write_text("new")
        for _ in range(2):
            runner.run([Task("a task", lambda: calls.append(1) or [row()])], context)
        assert len(calls) == count, name


def test_saved_rows_are_used_only_if_the_machine_can_run_the_same(context, tmp_path, monkeypatch):
    calls = []

    def used(context):
        runner.run([Task("a task", lambda: calls.append(1) or [row()])], context)
        return len(calls)

    assert used(context) == used(context) == 1
    backends = context.backends | {"cuda": Backend("cuda", True, "another GPU")}
    assert used(dataclasses.replace(context, backends=backends)) == 2
    assert used(dataclasses.replace(context, variants=context.variants | {"llvm_ad_rgb": "broken"})) == 3
    (tmp_path / "a_package-1.0.dist-info").mkdir()
    (tmp_path / "a_package-1.0.dist-info/METADATA").write_text("Name: a-package\nVersion: 1.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert used(context) == 4
    monkeypatch.setattr(runner.shutil, "which", lambda name: f"/another/{name}")
    assert used(context) == used(context) == 5


def test_workers_return_the_same_rows_as_this_process(context, tmp_path):
    work = runner.tasks([importlib.import_module(f"validation.{name}").STUDY for name in MODULES], context)
    local, _ = runner.run(work, dataclasses.replace(context, out=tmp_path / "local"))
    with connected(workers=1) as client, dask.config.set(tls_settings(client.security)):
        workers = dataclasses.replace(WORKERS, target=ClusterTarget(client.scheduler.address))
        rows, spent = runner.run(work, context, workers)
    assert rows == local and len(rows) > 10
    assert [task["task"] for task in spent] == [task.name for task in work]
    assert all(task["machine"] == os.uname().nodename for task in spent)
    unreachable = dataclasses.replace(WORKERS, target=ClusterTarget("tcp://127.0.0.1:9"))
    saved, _ = runner.run(work, context, unreachable)
    facts = runner.facts("scalar_rgb")  # these must be equal on a worker
    assert facts["validation"] == runner.sources()[:8] and set(runner.PACKAGES) < facts.keys()
    assert [json.dumps(row.as_dict()) for row in saved] == [json.dumps(row.as_dict()) for row in local]


def test_a_worker_returns_files_and_raises_errors(monkeypatch, scalar_variant):
    def writes(context):
        (context.out / "images").mkdir()
        (context.out / "images/a.exr").write_bytes(b"pixels")
        return [row(images={"test": "images/a.exr"})]

    def fails(context):
        raise ValueError("a scene is wrong; expected others")

    study = Study("s", "", "", {}, lambda c: [Task(f.__name__, functools.partial(f, c)) for f in (writes, fails)])
    monkeypatch.setattr(runner, "import_module", lambda name: types.SimpleNamespace(STUDY=study))
    monkeypatch.setattr(runner.on_worker, "scratch_folder", lambda: None)
    monkeypatch.setattr(runner.on_worker, "in_variant", lambda variant, call: call())
    workers = dataclasses.replace(WORKERS, modules=("one",))
    (rows, _), files = workers.on_worker("writes")
    assert files == {"images/a.exr": b"pixels"} and rows[0].images == {"test": "images/a.exr"}
    with pytest.raises(ValueError, match="a scene is wrong; expected others"):
        workers.on_worker("fails")


# The command ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def validate(tmp_path, monkeypatch):
    """`validate(work)`: the exit code of a validation whose only task runs `work`."""

    def run(work, *options):
        study = Study("directions", "A study", "What it asks.", {}, lambda context: [Task("a task", work)])
        monkeypatch.setattr(command, "import_module", lambda name: types.SimpleNamespace(STUDY=study))
        return command.main(["robustness", "--out", str(tmp_path), *options])  # a room of one study

    return run


@pytest.mark.parametrize(("budget", "code"), [(1.0, 0), (0.4, 1), (float("nan"), 1)])
def test_the_exit_code_follows_the_budgets(validate, tmp_path, budget, code):
    assert validate(lambda: [row(budgets={"worst / u": budget})]) == code
    assert {path.name for path in tmp_path.iterdir()} == FILES
    written = json.loads((tmp_path / "rows.json").read_text())
    context = written["context"]
    assert written["rows"][0]["verdict"] == ("pass" if code == 0 else "fail")
    assert context["versions"]["mitsuba"] == mi.__version__
    assert context["replay"] == "python -m validation robustness --profile quick"


def test_a_variant_renders_instead_of_the_default_and_a_replay_names_it(validate, tmp_path):
    variants = []
    assert validate(lambda: variants.append(mi.variant()) or [row()], "--variant", "scalar_rgb") == 0
    context = json.loads((tmp_path / "rows.json").read_text())["context"]
    assert variants == [context["variant"]] == ["scalar_rgb"]
    assert context["replay"] == "python -m validation robustness --profile quick --variant scalar_rgb"


def test_an_interruption_prints_how_to_resume_and_two_validations_do_not_share_a_folder(validate, tmp_path, capsys):
    def interrupted():
        raise KeyboardInterrupt

    assert validate(interrupted) == 130
    assert "run the same command again to resume" in capsys.readouterr().err
    codes = []
    second = ["robustness", "--out", str(tmp_path)]
    assert validate(lambda: codes.append(command.main(second)) or [row()]) == 0
    assert codes == [2] and {path.name for path in tmp_path.iterdir()} == FILES
    (message,) = [line for line in capsys.readouterr().err.splitlines() if "is already running" in line]
    assert f"{tmp_path}: a validation is already running in process {os.getpid()} on " in message


def test_after_an_interruption_an_own_renderer_is_measured_anew(tmp_path, monkeypatch, capsys):
    """Its program may have changed."""
    calls, interrupted = [], [True]

    def stop():
        if interrupted.pop():
            raise KeyboardInterrupt
        return [row()]

    every = [Task("rays", lambda: calls.append(1) or [row()]), Task("images", stop)]
    study = Study("per_ray", "A study", "What it asks.", {}, lambda context: every)
    monkeypatch.setattr(command, "import_module", lambda name: types.SimpleNamespace(STUDY=study))
    monkeypatch.setattr(system, "join", lambda folder: system.System("mine", "Mine"))
    monkeypatch.setattr(rendered_images, "join", lambda own: None)
    arguments = ["suite.matrix", "--out", str(tmp_path), "--renderer", "mine"]
    assert command.main(arguments) == 130 and "resume" not in capsys.readouterr().err
    interrupted.append(False)
    assert command.main(arguments) == 0 and len(calls) == 2


def test_a_part_of_a_study_runs_alone_and_only_once():
    assert command.modules(["ground-truth.standard_numbers"], "quick") == ["ground_truth.standard_numbers"]
    both = command.modules(["diff.times", "diff"], "full")
    assert both[0] == "diff.times" and sorted(both) == sorted(command.modules(["diff"], "full"))
    assert "settings" in tables.chosen(["efficiency.chosen_settings"])
    assert "caustics" not in tables.chosen(["efficiency.chosen_settings"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["refractions"], "unknown study 'refractions'; expected directions, stability, renders, efficiency, media"),
        (["renders.colors"], "unknown study 'renders.colors'; expected directions"),
        (["--variant", "llvm_rgb"], "variant 'llvm_rgb': unknown; expected scalar_rgb"),
        (["--variant", "llvm_ad_spectral"], "--variant llvm_ad_spectral: studies render in RGB; expected cuda_ad_rgb"),
        (["renders."], "unknown study 'renders.'; expected directions"),
        (["--profile", "slow"], "unknown profile 'slow'; expected quick, standard, full"),
        (["--out", __file__], "File exists; expected a writable folder"),
        (["--speed", "9"], "No such option: --speed"),
        (["--write-tables"], "--write-tables needs more than the profile 'quick'; expected --profile standard or"),
        (["--scheduler", "tcp://h:1", "--workers", "2"], "--scheduler and --workers; expected one of them"),
        (["--workers", "0"], "Invalid value for '--workers': Input should be greater than or equal to 1"),
        (["planar", "--renderer", "x"], "--renderer x is used by the study `suite` only; add `suite`"),
        (["renderers", "--install", "blender"], "unknown system 'blender'; expected batoid, cycles"),
        (["renderers", "--list", "--install", "pyglm"], "expected one of them"),
        (["renderers", "pyglm"], "unexpected extra argument"),
    ],
)
def test_misuse_is_one_line_and_exit_code_2(arguments, words, capsys, tmp_path):
    out = [] if "renderers" in arguments or "--out" in arguments else ["--out", str(tmp_path)]
    assert command.main([*arguments, *out]) == 2
    printed = capsys.readouterr().err
    assert words in printed and len(printed.splitlines()) == 1


# The documentation ----------------------------------------------------------------------------------------------------


def test_the_accuracy_table_holds_the_measured_rows_only():
    values = {"worst chord": 4.97e-8, "worst / u": 0.834, "time / plain": 1.05, "TIR misclassified": 3.0}
    values |= {"time / copy": 1.01, "time / copy, low": 0.98, "time / copy, high": 1.2}
    replay = {"rays": 68000, "regimes": 17}
    rows = [row(setting=f"llvm {x}", values=values, replay=replay) for x in ("float32", "float64")]
    rows.append(dataclasses.replace(rows[0], subject="wedge", replay={"rays": 52000, "regimes": 13}))
    copies = [dataclasses.replace(r, subject="copy", values={"time / copy": 1.0}, replay={}) for r in rows]
    lines = tables.accuracy([*rows, *copies]).splitlines()
    assert len(lines) == 8
    single = ["4.97e-8", "0.834", "3", "1.01 (0.98–1.2)", "1.05"]
    expected = ["`promoted`", "this project", "68,000 in 17", *single, "4.97e-8", "0.834", "1.01 (0.98–1.2)"]
    assert [cell.strip() for cell in lines[-2].split("|")][1:-1] == expected
    assert lines[-1].startswith("| `wedge` | 000, boxed | 52,000 in 13 |")
    changes = {"case": "on a denormal", "values": values | {"TIR misclassified": 1469.0}}
    changes |= {"budgets": {}, "replay": {"count": 4000}}
    denormal = [dataclasses.replace(r, **changes) for r in rows]
    fewer = values | {"TIR misclassified": 7.0, "worst chord": 0.25}
    denormal += [dataclasses.replace(r, subject="cross", values=fewer) for r in denormal]
    lines = tables.accuracy([*rows, *denormal]).splitlines()
    assert len(lines) == 9 and "of the 18 regimes" in lines[0]
    assert lines[-1].startswith("| most misclassified of `FORMULAS`, `on a denormal` |")
    assert "| 4,000 in 1 | 4.97e-8 |" in lines[-1] and "| 1469 |" in lines[-1]


def test_a_table_states_every_size_of_its_images():
    sizes = {"sphere": 512, "balls": 128, "prism": 512}
    replay, values = {"spp": 25, "rounds": 8, "sampler": "multijitter"}, {EQUAL_TIME: 1.0, EQUAL_TIME_DEFAULTS: 0.5}
    rows = [
        Row("efficiency", method, scene, "llvm_ad_rgb", values, replay=replay | {"resolution": size})
        for scene, size in sizes.items()
        for method in (render_methods.BUILTIN.name, render_methods.OURS)
    ]
    assert tables.efficiency(rows).startswith("128² or 512² pixels, 25 spp, 8 rounds, llvm_ad_rgb.\n")


# Words that each table must contain.
NAMED = {
    "accuracy": [*FORMULAS, "on a denormal"],
    "on a GPU": [*FORMULAS, "ns per ray"],
    "renders": [path.stem for path in SCENES.glob("*.xml") if not beyond_builtin(path)],
    "panes": [f"{1000 * thickness:g} mm at {x:g} m" for thickness, x in thin_panes.PANES],
    "samplers": ["multijitter", "orthogonal", "stratified", "ldsampler", *(m.name for m in samplers.COMPARED)],
    "paths": layered_paths.plugins(),
    "efficiency": [method.name for method in render_methods.METHODS],
    "caustics": [*caustic_scenes.BODIES, *caustic_scenes.LAMPS],
    "changing": ["a new scene for each image", "an edit among 300 glasses", "a sweep of 12 indices"],
    "settings": ["balls", "slab", "ball, square 0.05"],
    "planar": [path.stem for path in SCENES.glob("planar/*.toml")],
    "defects": [*planted_defects.GLASSES, *self_test.DEFECTS, *METHODS],
    "derivatives": [*gradients.TABLE, *gradients.INTEGRATORS],
    "visible": [*visible_changes.KINDS, *map(str, visible_changes.SQUARES)],
    "caustics by others": [*caustic_energies.RENDERERS],
    "standard numbers": [*NUMBERS],
    "standard numbers by others": [
        *(x.name for x in [*by_others.of_kind(*by_others.RAYS, "index"), *by_others.plates()] if "glTF" not in x.name),
        *(call.title for name, system in SYSTEMS.items() if name != "mi_refract" for call in system.calls),
        *(title for title in IMAGE_RENDERERS if title not in by_others.NOT_ASKED),
    ],
    "suite": [*(call.title for system in SYSTEMS.values() for call in system.calls), *IMAGE_RENDERERS],
}


@pytest.mark.parametrize("marker", tables.TABLES)
def test_pages_hold_their_tables_and_incomplete_runs_do_not_write_them(marker):
    table = tables.TABLES[marker]
    measured = command.modules([table.study], "full")
    tables.check([table.study])
    text = (tables.ROOT / table.path).read_text()
    written = text.partition(f"<!-- begin: {marker} -->")[2].partition(f"<!-- end: {marker} -->")[0]
    assert [word for word in NAMED[marker] if word not in written] == []
    images = re.findall(r"!\[[^]]*\]\(([^)]+)\)", text)
    assert all(((tables.ROOT / table.path).parent / name).is_file() for name in images)
    nothing = [row(values={}, reason="not run")]
    if marker == "on a GPU":  # the table stays as it is
        assert table.make(nothing) is None
    else:
        with pytest.raises(ValueError, match=r"documentation: no .*"):
            table.make(nothing)
    assert (marker in tables.chosen([])) == (not measured[0].startswith("suite."))
    assert marker in tables.chosen([table.study]) and marker in tables.chosen([table.study.partition(".")[0]])
    assert marker not in tables.chosen(["robustness"])

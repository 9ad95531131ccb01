"""The validation on workers: the same rows, what times something alone and here, and who may run tasks."""

import dataclasses
import functools
import importlib
import inspect
import json
import os
import time
import types

import dask
import pytest
from support.dask_workers import tls_settings

from mi_refract import backend
from mi_refract.cluster import worker_facts
from mi_refract.cluster.connection import ClusterTarget, connected
from mi_refract.report.row import Row
from validation import __main__ as command
from validation import runner, spread
from validation.run import kernel_timing
from validation.run.context import SCALAR_PROFILES, Context, profiles
from validation.study import Study, Task

MODULES = ("stability.optical_chains", "stability.layered_paths")
ASKED = spread.Asked(MODULES, "quick", "scalar_rgb")


@pytest.fixture(scope="module")
def scheduler():
    with connected(workers=2) as client, dask.config.set(tls_settings(client.security)):
        yield ClusterTarget(client.scheduler.address)


@pytest.fixture
def context(tmp_path, scalar_variant):
    return Context(SCALAR_PROFILES["quick"], tmp_path, "scalar_rgb", backend.detect(), backend.usable_variants())


def studies():
    return [importlib.import_module(f"validation.{name}").STUDY for name in MODULES]


def test_the_rows_are_those_of_a_run_here(scheduler, context, tmp_path):
    work = spread.tasks(studies(), context)
    alone, _ = runner.run(work, dataclasses.replace(context, out=tmp_path / "alone"))
    rows, spent = runner.run(work, context, spread.OnCluster(ASKED, scheduler))
    assert rows == alone and len(rows) > 10
    assert [each["task"] for each in spent] == [task.name for task in work]
    assert all(each["machine"] == os.uname().nodename for each in spent)
    unreachable = spread.OnCluster(ASKED, ClusterTarget("tcp://127.0.0.1:9"))
    kept, _ = runner.run(work, context, unreachable)
    assert [json.dumps(each.as_dict()) for each in kept] == [json.dumps(each.as_dict()) for each in alone]


def row(**more):
    return Row("directions", "promoted", "all regimes", "scalar float64", {"worst / u": 0.5}, **more)


class Recorded:
    """Workers of a test: they run the tasks here, from the last to the first."""

    def __init__(self, tasks, order):
        self.tasks, self.order = tasks, order

    def run(self, work, context):
        for number, name in reversed(work):
            self.order.append(f"there: {name}")
            yield number, runner.timed(self.tasks[number])


def test_what_is_timed_runs_here_after_the_others_have_ended(context):
    order = []
    made = {name: [dataclasses.replace(row(), subject=name)] for name in "abc"}
    tasks = [
        Task(name, lambda name=name: order.append(name) or made[name], timed=timed)
        for name, timed in (("a", False), ("b", True), ("c", False))
    ]
    rows, _ = runner.run(tasks, context, Recorded(tasks, order))
    assert rows == [each for name in "abc" for each in made[name]]
    assert order == ["there: c", "c", "there: a", "a", "b"]


def test_finished_tasks_are_kept_where_another_one_fails(context):
    calls = []

    def work(name):
        calls.append(name)
        if calls == ["c", "a"]:
            raise KeyboardInterrupt
        return [row()]

    tasks = [Task(name, functools.partial(work, name)) for name in "ac"]
    with pytest.raises(KeyboardInterrupt):
        runner.run(tasks, context, Recorded(tasks, []))
    assert len(runner.run(tasks, context, Recorded(tasks, []))[0]) == 2
    assert calls == ["c", "a", "a"]


def planted(monkeypatch, *tasks):
    study = Study("directions", "A study", "What it asks.", {}, lambda context: list(tasks))
    monkeypatch.setattr(spread, "import_module", lambda name: types.SimpleNamespace(STUDY=study))
    for name, value in {"threads": 1, "scratch_folder": None}.items():
        monkeypatch.setattr(spread.on_worker, name, lambda value=value: value)
    monkeypatch.setattr(spread.on_worker, "limit_threads", lambda threads: None)


def test_a_worker_sends_files_and_errors_as_they_are(monkeypatch, scalar_variant):
    def writes(context):
        (context.out / "images").mkdir()
        (context.out / "images/a.exr").write_bytes(b"pixels")
        return [row(images={"test": "images/a.exr"})]

    def fails(context):
        raise ValueError("a scene is wrong; expected others")

    study = Study("s", "", "", {}, lambda c: [Task(f.__name__, functools.partial(f, c)) for f in (writes, fails)])
    planted(monkeypatch)
    monkeypatch.setattr(spread, "import_module", lambda name: types.SimpleNamespace(STUDY=study))
    outcome = spread.run_here(spread.Asked(("one",), "quick", "scalar_rgb"), "writes")
    assert outcome.files == {"images/a.exr": b"pixels"} and outcome.finished[0][0].images == {"test": "images/a.exr"}
    with pytest.raises(ValueError, match="a scene is wrong; expected others"):
        spread.run_here(spread.Asked(("one",), "quick", "scalar_rgb"), "fails")


def test_two_tasks_of_one_name_are_refused(context):
    elsewhere = spread.OnCluster(ASKED, ClusterTarget("tcp://127.0.0.1:9"))
    with pytest.raises(ValueError, match="two tasks are called 'a'; expected a name for each"):
        runner.run([Task("a", list), Task("a", list)], context, elsewhere)


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"])
def test_names_of_tasks_are_their_own_in_every_profile(context, variant, needs_variant):
    needs_variant(variant)
    every = [importlib.import_module(f"validation.{name}").STUDY for name in command.modules([], "full")]
    for profile in profiles(variant).values():
        tasks = spread.tasks(every, dataclasses.replace(context, profile=profile, variant=variant))
        assert len({task.name for task in tasks}) == len(tasks) > 0


def test_workers_with_other_sources_are_refused_by_name():
    here = {worker_facts.HOST: "here", "validation": "0123abcd", "other renderers": "none"}
    there = here | {"validation": "fedcba98"}
    assert worker_facts.differences(there, here) == ["validation fedcba98, here 0123abcd"]
    found = spread.facts("scalar_rgb")
    assert found["validation"] == runner.sources()[:8] and set(spread.PACKAGES) < found.keys()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--scheduler", "tcp://h:1", "--workers", "2"], "--scheduler and --workers; expected one of them"),
        (["--workers", "0"], "Invalid value for '--workers': Input should be greater than or equal to 1"),
    ],
)
def test_misuse_is_one_line(arguments, words, capsys, tmp_path):
    assert command.main([*arguments, "--out", str(tmp_path)]) == 2
    printed = capsys.readouterr().err
    assert words in printed and len(printed.splitlines()) == 1


def test_who_works_is_what_the_options_say(tmp_path, monkeypatch):
    given = []
    monkeypatch.setattr(command, "_run", lambda *arguments: given.append(arguments[-1]) or 0)
    assert command.main(["--scheduler", "tls://h:1", "--out", str(tmp_path / "out")]) == 0
    assert given == [ClusterTarget("tls://h:1")]


# Which tasks time something -------------------------------------------------------------------------------------------

# What a row of times is made by; `scaling.measure` is so in a process of its own.
CLOCKS = {"kernel_timing.interval", "scaling.run"}
READ = {"perf_counter", "process_time"}  # functions that name one of them are clocks, too
# Theirs are told beside a row, or are limits.
NOT_JUDGED = {"render_methods.Camera.__call__"}


def reached(start):
    """Names (module.function) of the validation's own functions that `start` may call, however indirectly.

    Those in READ are named as they are. By the names in their code: what a name means elsewhere may be counted, what
    is called is not missed.
    """
    found, left = set(), [start]
    while left:
        this = left.pop()
        if isinstance(this, functools.partial):
            left += [this.func, *(each for each in this.args if callable(each) or isinstance(each, Study))]
        elif isinstance(this, Study):
            left += [this.again] if this.again else []
        elif inspect.isclass(this):
            left += [each for each in vars(this).values() if inspect.isfunction(each)]
        elif isinstance(inner := inspect.unwrap(this) if callable(this) else None, types.FunctionType):
            name = f"{inner.__module__.rpartition('.')[2]}.{inner.__qualname__}"
            if inner.__module__.startswith(("validation", __name__)) and (key := (name, id(inner))) not in found:
                found.add(key)
                if name not in NOT_JUDGED:
                    found |= {(each, 0) for each in READ & names_in(inner)}
                left += called(inner)
    return {name for name, _ in found}


def called(function):
    """Everything of the validation that the code of a function names, and what it closes over."""
    names, cells = names_in(function), [cell.cell_contents for cell in function.__closure__ or ()]
    found = [function.__globals__[name] for name in names if name in function.__globals__]
    modules = [each for each in found if inspect.ismodule(each) and each.__name__.startswith("validation")]
    found += [vars(module)[name] for module in modules for name in names if name in vars(module)]
    return [each for each in (*found, *cells) if callable(each) or isinstance(each, Study)]


def names_in(function):
    """All names in the code of a function, and of those inside it."""
    codes, names = [function.__code__], set()
    while codes:
        code = codes.pop()
        names |= set(code.co_names)
        codes += [each for each in code.co_consts if isinstance(each, types.CodeType)]
    return names


def unmarked(tasks):
    """Names of the tasks that reach a clock and are not marked."""
    return {task.name for task in tasks if not task.timed and reached(task.run) & (CLOCKS | READ)}


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"])
def test_every_task_that_times_something_is_marked(context, variant, needs_variant):
    needs_variant(variant)
    every = [importlib.import_module(f"validation.{name}").STUDY for name in command.modules([], "full")]
    for profile in profiles(variant).values():
        tasks = spread.tasks(every, dataclasses.replace(context, profile=profile, variant=variant))
        assert not unmarked(tasks)
        assert any(task.timed for task in tasks) and any(not task.timed for task in tasks)


def test_a_task_that_is_not_marked_is_found():
    def direct():
        return kernel_timing.ratio("time / plain", [1.0], [2.0])

    def inner():
        return [direct() for _ in range(1)]

    def through_a_study(study):
        return study.again(None)

    def by_hand():
        return time.process_time()

    again = Study("s", "", "", {}, lambda c: [], again=lambda c: direct())
    tasks = [
        Task("direct", direct),
        Task("by hand", by_hand),
        Task("inner", functools.partial(inner)),
        Task("study", functools.partial(through_a_study, again)),
        Task("marked", direct, timed=True),
        Task("none", row),
    ]
    assert unmarked(tasks) == {"direct", "by hand", "inner", "study"}


def test_names_of_clocks_exist():
    from validation.efficiency import scaling

    assert {f"{f.__module__.rpartition('.')[2]}.{f.__name__}" for f in (kernel_timing.interval, scaling.run)} == CLOCKS

"""Mutants of our own code: planted ones are killed or survive as they must, and too many survivors fail."""

import json
import os
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

from mi_refract.report.row import Row
from validation.robustness import code_mutants, mutant_runs, mutants
from validation.robustness.code_mutants import Found
from validation.robustness.mutant_runs import Job
from validation.robustness.mutants import Mutant

PATH = "mi_refract/accuracy/tiny.py"
CODE = '''"""A tiny module."""

from __future__ import annotations

__all__ = ["larger"] + ["waits"]


def larger(a: int | float, b: int = 3) -> int | float:
    """The larger one: 1 + 1."""
    return a if a > b else b


def unused():
    return 2 * 3
'''
TEST = """
from mi_refract.accuracy.tiny import larger

def test_larger():
    assert (larger(1, 2), larger(4, 3)) == (2, 4)
"""


@pytest.fixture
def tree(tmp_path, monkeypatch):
    """A package with a module, and the test that guards it."""
    pytest.importorskip("cosmic_ray", reason="cosmic-ray is not installed")
    monkeypatch.setattr(code_mutants, "GUARDS", {"accuracy": ("accuracy",)})
    root = tmp_path / "root"
    for path, text in ((PATH, CODE), ("tests/accuracy/test_tiny.py", TEST)):
        (root / path).parent.mkdir(parents=True)
        (root / path).write_text(text)
    for folder in ("mi_refract", "mi_refract/accuracy"):
        (root / folder / "__init__.py").write_text("")
    return root


def planted(root, becomes):
    return next(mutant for mutant in mutants.every(root, PATH) if mutant.becomes == becomes)


def test_a_mutant_is_killed_where_a_test_sees_it_and_survives_where_none_does(tree, monkeypatch):
    seen, equal, unseen = (planted(tree, f"return {b}") for b in ("a if a < b else b", "a if a >= b else b", "2 + 3"))
    monkeypatch.setattr(code_mutants, "explained", lambda: {equal.key: "equivalent: the same number"})
    told = []
    found = code_mutants.examine([unseen, seen, equal], tree, told.append)
    assert [each.mutant for each in found] == [unseen, seen, equal]
    assert [(each.killed, each.reason, each.unexplained) for each in found] == [
        (False, "", True),
        (True, "", False),
        (False, "equivalent: the same number", False),
    ]
    assert "test_larger" in found[1].said
    assert sorted(map(str, told), key=str) == sorted(map(str, found), key=str)
    assert (tree / PATH).read_text() == CODE
    assert not list(tree.rglob("__pycache__"))


def test_tests_that_fail_without_a_mutant_are_an_error(tree):
    mutant = planted(tree, "return 2 + 3")
    (tree / PATH).write_text(CODE.replace("a > b", "a < b"))
    with pytest.raises(ValueError, match=r"tests of accuracy fail without a mutant: .*test_larger"):
        code_mutants.examine([mutant], tree)


WAITS = """
import os, pathlib, time

def test_waits():
    pathlib.Path(r"{folder}", "pid").write_text(str(os.getpid()))
    time.sleep(60)
"""


def gone(folder):
    """Whether the process that wrote its number there has ended."""
    pid = int((folder / "pid").read_text())
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def test_what_hangs_is_ended_and_did_not_pass(tree, tmp_path):
    (tree / "tests/accuracy/test_waits.py").write_text(WAITS.format(folder=tmp_path))
    (tmp_path / "copies").mkdir()
    start = time.monotonic()
    job = Job("waits", ["tests/accuracy/test_waits.py"], timeout=1.0)
    (outcome,) = mutant_runs.run([job], tmp_path / "copies", 1, tree)
    assert (outcome.passed, outcome.said) == (False, "no end within 1 s")
    assert time.monotonic() - start < 20
    assert not (tmp_path / "pid").exists() or gone(tmp_path)


def test_an_interruption_ends_the_processes_and_undoes_the_mutation(tree, tmp_path):
    (tree / "tests/accuracy/test_waits.py").write_text(WAITS.format(folder=tmp_path))
    copies = tmp_path / "copies"
    copies.mkdir()
    job = Job("waits", ["tests/accuracy/test_waits.py"], timeout=60, mutant=planted(tree, "return 2 + 3"))
    quick = Job("quick", ["tests/accuracy/test_tiny.py"], timeout=60)
    # The one that waits began first, and one worker of two is done with the other when it ends.
    running = mutant_runs.run([job, quick], copies, 2, tree)
    assert next(running).job.name == "quick"
    deadline = time.monotonic() + 20
    while not (tmp_path / "pid").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    running.close()  # as an exception in the loop over it does
    assert gone(tmp_path)
    assert (copies / "0" / PATH).read_text() == CODE


def test_what_cannot_change_behaviour_is_no_mutant(tree):
    lines = [mutant.line for mutant in mutants.every(tree, PATH)]
    assert {*lines} == {
        "def larger(a: int | float, b: int = 3) -> int | float:",  # the default
        "return a if a > b else b",
        "return 2 * 3",
    }
    defaults = [mutant.becomes for mutant in mutants.every(tree, PATH) if mutant.line.startswith("def")]
    assert [text.count("|") for text in defaults] == [2, 2]


def test_the_same_seed_gives_the_same_sample_and_a_smaller_one_begins_it(tree):
    samples = [mutants.sample(tree, count, seed) for count, seed in ((5, 0), (5, 0), (3, 0), (5, 1))]
    assert samples[0] == samples[1] != samples[3]
    assert samples[0][:3] == samples[2]
    places = [(mutant.line, mutant.operator.partition("_")[0]) for mutant in mutants.sample(tree, 99, 0)]
    assert 4 < len(places) < 10 and places.count(("return 2 * 3", "ReplaceBinaryOperator")) == 1


def test_a_decorator_that_is_gone_is_named(tree):
    (tree / PATH).write_text("import functools\n\n\n@functools.cache\ndef f():\n    pass\n")
    (mutant,) = mutants.every(tree, PATH)
    assert str(mutant) == f"{PATH}:4: RemoveDecorator: @functools.cache → "


def found(unexplained, explained=0, killed=0):
    mutant = Mutant(PATH, "AddNot", 0, 1, "if a:", "if not a:")
    kinds = [(False, "")] * unexplained + [(False, "equivalent")] * explained + [(True, "")] * killed
    return [Found(mutant, killed, "", 1.0, reason) for killed, reason in kinds]


def test_too_many_survivors_fail_and_explained_ones_do_not():
    every, room = code_mutants.rows(found(1, 4, 15), seed=7)
    assert every.values == {
        **{"mutants": 20, "killed": 15, "survived": 5, "explained": 4},
        **{"score": 0.95, "unexplained": 0.05},
    }
    assert (every.verdict, room.verdict, room.subject) == ("pass", "info", "accuracy")
    assert every.replay["survivors"] == [f"{PATH}:1: AddNot: if a: → if not a:"]
    assert every.replay["command"] == "python -m validation.robustness.code_mutants 20 7"
    assert code_mutants.rows(found(2, 3, 15), seed=0)[0].verdict == "fail"
    assert Row("s", "", "", "", code_mutants.values([]), {"unexplained": 1.0}).verdict == "fail"


def test_every_explanation_is_of_a_line_that_there_is():
    text = Path(code_mutants.__file__).with_name("explained_mutants.json").read_text("utf-8")
    reasons = code_mutants.explained()
    assert 0 < len(json.loads(text)) == len(reasons)
    for (path, operator, line, becomes), reason in reasons.items():
        assert reason.startswith(("equivalent: ", "unobservable: ")) and "\n" not in reason
        assert line in mutants.lines(mutant_runs.ROOT, path), (path, line)
        assert line != becomes
        assert find_spec("cosmic_ray") is None or operator in mutants.operators()


def test_tests_that_guard_a_package_are_there_and_the_modules_own_come_first():
    assert code_mutants.missing() in ("", "cosmic_ray not installed: pip install -e '.[dev]'")
    assert [*code_mutants.GUARDS] == [*mutants.ROOMS]
    mutant = Mutant("mi_refract/ray_sets/possible_directions.py", "AddNot", 0, 1, "", "")
    order = code_mutants.guards(mutant_runs.ROOT, mutant)
    assert order[0] == "tests/ray_sets/test_possible_directions.py"
    assert "tests/cli/test_rays.py" in order
    for room in mutants.ROOMS:
        assert all(path.is_file() for path in code_mutants._test_files(mutant_runs.ROOT, room))


def test_without_tests_or_cosmic_ray_it_is_not_run(tmp_path, monkeypatch):
    assert code_mutants.missing(tmp_path) == "no folder of tests beside the package: run it in a checkout"
    monkeypatch.setattr(code_mutants, "find_spec", lambda name: None)
    (row,) = code_mutants._rows(None)
    assert (row.verdict, row.reason) == ("not run", "cosmic_ray and pytest not installed: pip install -e '.[dev]'")

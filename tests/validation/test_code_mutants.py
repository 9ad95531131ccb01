"""Mutants of our own code: planted ones are killed or survive as they must, and too many survivors fail."""

import os
import re
import signal
import subprocess
import sys
import time
from importlib.util import find_spec

import pytest
from support.dask_workers import until
from support.processes import ENVIRONMENT

from validation.robustness import code_mutants
from validation.robustness.code_mutants import Found, Mutant

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
import os, pathlib, time
from mi_refract.accuracy.tiny import larger, unused

def test_larger():
    assert (larger(1, 2), larger(4, 3)) == (2, 4)

def test_waits():
    if unused() == 8:
        pathlib.Path(r"{folder}", "pid").write_text(str(os.getpid()))
        time.sleep(60)
"""


@pytest.fixture
def tree(tmp_path, monkeypatch):
    """A package with a module, and the test that guards it."""
    pytest.importorskip("cosmic_ray", reason="cosmic-ray is not installed")
    monkeypatch.setattr(code_mutants, "GUARDS", {"accuracy": ("accuracy",)})
    root = tmp_path / "root"
    for path, text in ((PATH, CODE), ("tests/accuracy/test_tiny.py", TEST.format(folder=tmp_path))):
        (root / path).parent.mkdir(parents=True)
        (root / path).write_text(text)
    for folder in ("mi_refract", "mi_refract/accuracy"):
        (root / folder / "__init__.py").write_text("")
    return root


def planted(root, becomes):
    return next(mutant for mutant in code_mutants.every(root, PATH) if mutant.becomes == becomes)


def test_a_mutant_is_killed_where_a_test_sees_it_and_survives_where_none_does(tree, monkeypatch):
    seen, equal, unseen = (planted(tree, f"return {b}") for b in ("a if a < b else b", "a if a >= b else b", "2 + 3"))
    monkeypatch.setattr(code_mutants, "explained", lambda: {equal.key: "equivalent: the same number"})
    found = list(code_mutants.examine([unseen, seen, equal], tree))
    assert [(each.mutant, each.killed, each.reason, each.unexplained) for each in found] == [
        (unseen, False, "", True),
        (seen, True, "", False),
        (equal, False, "equivalent: the same number", False),
    ]
    assert "test_larger" in found[1].said
    assert (tree / PATH).read_text() == CODE


def test_tests_that_fail_without_a_mutant_are_an_error(tree):
    mutant = planted(tree, "return 2 + 3")
    (tree / PATH).write_text(CODE.replace("a > b", "a < b"))
    with pytest.raises(ValueError, match=r"tests of accuracy fail without a mutant: .*test_larger"):
        list(code_mutants.examine([mutant], tree))


EXAMINE = """
import signal, sys
from pathlib import Path
from validation.robustness import code_mutants
if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    code_mutants.GUARDS = {"accuracy": ("accuracy",)}
    root = Path(sys.argv[1])
    waits = [m for m in code_mutants.every(root, "mi_refract/accuracy/tiny.py") if m.becomes == "return 2 ** 3"]
    list(code_mutants.examine(waits, root))
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_an_interruption_ends_the_processes_and_removes_the_copies(tree, tmp_path, number):
    (tmp_path / "examine.py").write_text(EXAMINE)
    command = [sys.executable, str(tmp_path / "examine.py"), str(tree)]
    (tmp_path / "copies").mkdir()
    environment = {**ENVIRONMENT, "TMPDIR": str(tmp_path / "copies")}
    with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL) as process:
        try:
            until((tmp_path / "pid").exists)
            process.send_signal(number)
            process.wait(20)
        finally:
            process.kill()
    pid = int((tmp_path / "pid").read_text())

    def gone():
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        return False

    until(gone, 5)
    assert not list((tmp_path / "copies").iterdir())


def test_what_hangs_is_ended_and_did_not_pass(tree, tmp_path, monkeypatch):
    waits, files = planted(tree, "return 2 ** 3"), ["tests/accuracy/test_tiny.py"]
    monkeypatch.setattr(code_mutants, "_COPY", tree)
    began = time.monotonic()
    passed, said, _ = code_mutants._test((files, 2.0, waits))
    assert (passed, said) == (False, "no end within 2 s") and time.monotonic() - began < 20
    assert (tree / PATH).read_text() == CODE


def test_what_cannot_change_behaviour_is_no_mutant(tree):
    mutants = code_mutants.every(tree, PATH)
    assert {mutant.line for mutant in mutants} == {
        "def larger(a: int | float, b: int = 3) -> int | float:",  # the default
        "return a if a > b else b",
        "return 2 * 3",
    }
    assert {mutant.becomes.count("|") for mutant in mutants if mutant.line.startswith("def")} == {2}


def test_the_same_seed_gives_the_same_sample_and_an_edit_changes_it_where_it_is(tree):
    samples = [code_mutants.sample(tree, count, seed) for count, seed in ((3, 0), (3, 0), (2, 0))]
    assert samples[0] == samples[1] and samples[0][:2] == samples[2]
    assert len({code_mutants.sample(tree, 3, seed)[0] for seed in range(9)}) > 2
    (tree / PATH).write_text(CODE.replace("def unused", "x = 1 + 1\n\n\ndef unused"))
    edited = code_mutants.sample(tree, 99, 0)
    assert [mutant.key for mutant in edited if mutant.line != "x = 1 + 1"] == [m.key for m in samples[0]]


def test_a_decorator_that_is_gone_is_named(tree):
    (tree / PATH).write_text("import functools\n\n\n@functools.cache\ndef f():\n    pass\n")
    (mutant,) = code_mutants.every(tree, PATH)
    assert str(mutant) == f"{PATH}:4: RemoveDecorator: @functools.cache → "


def found(unexplained, explained=0, killed=0):
    mutant = Mutant(PATH, "AddNot", 0, 1, "if a:", "if not a:")
    kinds = [(False, "")] * unexplained + [(False, "equivalent")] * explained + [(True, "")] * killed
    return [Found(mutant, killed, "", 1.0, reason) for killed, reason in kinds]


def test_too_many_survivors_fail_and_explained_ones_do_not():
    every, room = code_mutants.rows(found(1, 4, 15), seed=7)
    counts = {"mutants": 20, "killed": 15, "survived": 5, "explained": 4}
    assert every.values == {**counts, "score": 0.95, "unexplained": 0.05}
    assert (every.verdict, room.verdict, room.subject) == ("pass", "info", "accuracy")
    assert every.replay["survivors"] == [f"{PATH}:1: AddNot: if a: → if not a:"]
    assert every.replay["command"] == "python -m validation.robustness.code_mutants 20 7"
    assert code_mutants.rows(found(2, 3, 15), seed=0)[0].verdict == "fail"


def test_every_explanation_is_of_a_line_that_there_is():
    reasons = code_mutants.explained()
    assert reasons
    for (path, operator, line, becomes), reason in reasons.items():
        assert re.match("equivalent: |unobservable: ", reason) and "\n" not in reason
        assert line != becomes
        assert line in map(code_mutants.plain, (code_mutants.ROOT / path).read_text().splitlines()), (path, line)
        assert find_spec("cosmic_ray") is None or operator in code_mutants.operators()


def test_tests_that_guard_a_package_are_there_and_the_modules_own_come_first():
    mutant = Mutant("mi_refract/ray_sets/possible_directions.py", "AddNot", 0, 1, "", "")
    order = code_mutants.guards(code_mutants.ROOT, mutant)
    assert order[0] == "tests/ray_sets/test_possible_directions.py"
    assert "tests/cli/test_rays.py" in order
    for room in code_mutants.GUARDS:
        assert all((code_mutants.ROOT / path).is_file() for path in code_mutants.test_files(code_mutants.ROOT, room))


def test_without_tests_or_cosmic_ray_it_is_not_run(tmp_path, monkeypatch):
    assert code_mutants.missing(tmp_path) == "no folder of tests beside the package: run it in a checkout"
    monkeypatch.setattr(code_mutants, "find_spec", lambda name: None)
    (row,) = code_mutants._rows(None)
    assert (row.verdict, row.reason) == ("not run", "cosmic_ray and pytest not installed: pip install -e '.[dev]'")

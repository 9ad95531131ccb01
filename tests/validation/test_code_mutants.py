"""Mutants of our own code: planted ones are killed or survive as they must, and too many survivors fail."""

import json
import types

import pytest

from validation.robustness import code_mutants
from validation.robustness.code_mutants import Mutant

pytest.importorskip("cosmic_ray", reason="cosmic-ray is not installed")
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
def tree(tmp_path):
    """A package with a module, and the test that guards it."""
    for path, text in ((PATH, CODE), ("tests/accuracy/test_tiny.py", TEST)):
        (tmp_path / path).parent.mkdir(parents=True)
        (tmp_path / path).write_text(text)
    for folder in ("mi_refract", "mi_refract/accuracy"):
        (tmp_path / folder / "__init__.py").write_text("")
    return tmp_path


def planted(root, becomes):
    return next(mutant for mutant in code_mutants.every(root, PATH) if mutant.becomes == becomes)


def test_a_mutant_is_killed_where_a_test_sees_it_and_tests_that_fail_without_one_are_an_error(tree):
    seen, unseen = (planted(tree, f"return {becomes}") for becomes in ("a if a < b else b", "2 + 3"))
    assert dict(code_mutants.examine([unseen, seen], tree)) == {unseen: False, seen: True}
    assert (tree / PATH).read_text() == CODE
    (tree / PATH).write_text(CODE.replace("a > b", "a < b"))
    for tests in (r"test_tiny.py::test_larger", r"test_tiny.py.*"):
        with pytest.raises(ValueError, match=f"tests/accuracy/{tests} fails without a mutant"):
            list(code_mutants.examine([unseen], tree))
        (tree / "tests/conftest.py").write_text("raise ImportError\n")  # then pytest names no test that failed


def test_what_cannot_change_behaviour_is_no_mutant(tree):
    mutants = code_mutants.every(tree, PATH)
    assert {mutant.line for mutant in mutants} == {
        "def larger(a: int | float, b: int = 3) -> int | float:",  # the default
        "return a if a > b else b",
        "return 2 * 3",
    }
    assert {mutant.becomes.count("|") for mutant in mutants if mutant.line.startswith("def")} == {2}
    (tree / PATH).write_text("import functools\n\n\n@functools.cache\ndef f():\n    pass\n")
    (mutant,) = code_mutants.every(tree, PATH)
    assert str(mutant) == f"{PATH}:4: RemoveDecorator: @functools.cache → "


def test_the_same_seed_gives_the_same_sample_and_an_edit_changes_it_where_it_is(tree):
    samples = [code_mutants.sample(tree, count, seed) for count, seed in ((3, 0), (3, 0), (2, 0))]
    assert samples[0] == samples[1] and samples[0][:2] == samples[2] and len(samples[0]) == 3
    assert len({code_mutants.sample(tree, 3, seed)[0] for seed in range(9)}) > 2
    (tree / PATH).write_text(CODE.replace("def unused", "x = 1 + 1\n\n\ndef unused"))
    kept = [(mutant.line, mutant.becomes) for mutant in code_mutants.sample(tree, 99, 0) if mutant.line != "x = 1 + 1"]
    assert kept == [(mutant.line, mutant.becomes) for mutant in samples[0]]


def summary(outcomes, seed=0):
    return code_mutants.summarise([code_mutants.row_of(*outcome) for outcome in outcomes], seed)


def test_too_many_survivors_fail_and_explained_ones_do_not():
    mutant = Mutant(PATH, "AddNot", 0, 1, "if a:", "if not a:")
    entries = json.loads((code_mutants.CONFIG.parent / "explained_mutants.json").read_text())
    entry = entries[0]
    unobservable = Mutant(entry["file"], entry["operator"], 0, 1, entry["line"], entry["becomes"])
    survivors = [(mutant, False)] + [(unobservable, False)] * 4
    every, room, _ = summary(survivors + [(mutant, True)] * 15, seed=7)
    counts = {"mutants": 20, "killed": 15, "survived": 5, "explained": 4}
    assert every.values == {**counts, "score": 0.95, "unexplained": 0.05}
    assert (every.verdict, room.verdict, room.subject) == ("pass", "info", "accuracy")
    assert every.replay["survivors"] == [f"{PATH}:1: AddNot: if a: → if not a:"]
    assert every.replay["command"] == "python -m validation.robustness.code_mutants 20 7"
    assert summary([(mutant, False), *survivors, *[(mutant, True)] * 14])[0].verdict == "fail"


def test_explanations_say_why_a_mutant_cannot_be_observed():
    entries = json.loads((code_mutants.CONFIG.parent / "explained_mutants.json").read_text())
    assert entries
    for entry in entries:
        assert entry["reason"].startswith(("equivalent: ", "unobservable: ")) and "\n" not in entry["reason"]
        assert entry["line"] != entry["becomes"]
        # An entry whose line has changed explains nothing.
        source = (code_mutants.ROOT / entry["file"]).read_text("utf-8")
        assert entry["line"] in {" ".join(line.split()) for line in source.splitlines()}


def test_the_tests_of_a_module_come_first_and_without_any_nothing_is_run(tmp_path):
    files = code_mutants.guards(code_mutants.ROOT, "mi_refract/io/image_file.py")
    assert files == ["tests/io/test_image_file.py", "tests/io", "tests/test_rooms.py"]
    assert "tests/cli/test_diff.py" in code_mutants.guards(code_mutants.ROOT, "mi_refract/image_diff/pairing.py")
    assert code_mutants.missing(tmp_path) == "no folder of tests beside the package: run it in a checkout"


def test_the_tasks_of_a_run_examine_every_mutant_once(monkeypatch):
    context = types.SimpleNamespace(profile=types.SimpleNamespace(name="full"))
    mutants = [Mutant(PATH, "AddNot", i, 1, "if a:", "if not a:") for i in range(220)]
    examined = []
    monkeypatch.setattr(code_mutants, "sample", lambda root, count, seed: mutants[:count])
    monkeypatch.setattr(code_mutants, "examine", lambda part: examined.extend(part) or [(x, True) for x in part])
    rows = [row for task in code_mutants.tasks(context) for row in task.run()]
    assert examined == mutants and code_mutants.summarise(rows)[0].values["killed"] == len(mutants)

"""Every planted defect is seen by the judgement, on every backend and precision; small mistakes by backward errors."""

import dataclasses
import types

import pytest

from mi_refract import FORMULAS
from mi_refract.ray_sets import ray_set
from mi_refract.ray_sets.judged_answers import RIGHT
from validation.directions import planted_defects
from validation.directions.planted_defects import MUTANTS
from validation.suite import small_mistakes

CASES = [(name, formula) for name, mutant in MUTANTS.items() for formula in mutant.of]


def sample(setting):
    return planted_defects.draw(
        planted_defects.SCALAR_COUNT if setting.backend == "scalar" else planted_defects.COUNT, setting.precision
    )


@pytest.mark.parametrize(("name", "formula"), CASES)
def test_a_defect_is_seen_and_none_is_not(name, formula, setting):
    if MUTANTS[name].rare and setting.backend == "scalar":
        pytest.skip(planted_defects.RARE)
    seen = sample(setting).judge(name, formula, setting.vector).wrong.sum()
    assert (seen == 0) == (name == "control")


def test_every_formula_is_spoilt_and_the_control_is_first():
    assert next(iter(MUTANTS)) == "control"
    spoilt = [set(mutant.of) for name, mutant in MUTANTS.items() if name != "control"]
    assert set.union(*spoilt) == set(FORMULAS) == set(MUTANTS["control"].of)


def test_a_mutant_that_escapes_fails_its_row_and_so_does_a_control_that_is_seen(monkeypatch, vectorised):
    setting = types.SimpleNamespace(label="here", vector=vectorised.vector, is_scalar=False)
    rows = {}
    for planted, spoilt in (("swapped k", "control"), ("control", "swapped k")):
        monkeypatch.setitem(MUTANTS, planted, dataclasses.replace(MUTANTS[planted], answer=MUTANTS[spoilt].answer))
        rows[planted] = planted_defects.row(planted, "promoted", setting, sample(vectorised))
        monkeypatch.undo()
    assert rows["swapped k"].broken == {"escaped": 0.0}
    assert rows["control"].broken == {"rays that see it": 0.0}
    assert rows["control"].reason.startswith("caught by ")
    assert f": {planted_defects.MISCLASSIFIED_FAR} " in rows["control"].reason


@pytest.mark.parametrize("precision", ray_set.PRECISIONS)
@pytest.mark.parametrize("name", small_mistakes.MISTAKES)
def test_every_small_mistake_is_seen_where_it_matters(name, precision):
    (row,) = small_mistakes.rows(name, precision)
    harmless = precision == small_mistakes.MISTAKES[name].harmless[0]
    assert row.verdict == "pass" and row.values["not seen"] == harmless
    assert row.values["m, worst, without"] <= RIGHT < row.values["m, worst"] or harmless


def test_a_small_mistake_that_is_not_seen_fails(monkeypatch):
    monkeypatch.setitem(small_mistakes.MISTAKES, "none", small_mistakes.Mistake(small_mistakes.textbook, "generic"))
    (row,) = small_mistakes.rows("none", "f32")
    assert row.verdict == "fail" and row.broken == {"not seen": 0.0}

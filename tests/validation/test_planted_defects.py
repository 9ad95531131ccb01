"""Every planted defect is seen by the judgement, and its absence is not, on every backend and precision."""

import dataclasses
import types

import pytest

from mi_refract import FORMULAS
from validation.directions import planted_defects
from validation.directions.planted_defects import MUTANTS

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
        monkeypatch.setitem(MUTANTS, planted, dataclasses.replace(MUTANTS[planted], make=MUTANTS[spoilt].make))
        rows[planted] = planted_defects._row(planted, "promoted", setting, sample(vectorised))
        monkeypatch.undo()
    assert rows["swapped k"].broken == {"escaped": 0.0}
    assert rows["control"].broken == {"rays that see it": 0.0}
    assert rows["control"].reason.startswith("caught by ")
    assert f": {planted_defects.MISCLASSIFIED_FAR} " in rows["control"].reason

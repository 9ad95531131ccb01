"""Glasses by other ray tracers: another index is no other direction, and each known difference has its cause."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from support.media_rays import answered

from mi_refract import media
from validation.run.metrics import ERROR_OVER_BOUND
from validation.suite import glasses
from validation.suite.renderers import SYSTEMS, System, environments
from validation.suite.renderers.glass_catalogues import CATALOGUES, GLASSES, GlassCatalogue, OtherIndex
from validation.suite.renderers.system import SCRIPTS

pytest.importorskip("opticalglass")
STANDARD, FULL = (SimpleNamespace(profile=SimpleNamespace(name=name)) for name in ("standard", "full"))
SOME = ("SCHOTT:N-BK7", "SCHOTT:F2", "SUMITA:K-BK7")
G = media.LINES["g"]


def catalogue(others=(), script="", told="zero"):
    return GlassCatalogue(script, SOME, told, dict(others))


def rows(ratio=None, change=None, others=(), told="zero", **more):
    rays = glasses.given(SOME)
    answers = answered(rays, ratio, **more)
    return glasses.rows("A", catalogue(others, told=told), rays, change(answers) if change else answers)


def of(glass):
    """The rays that pass through a glass."""
    rays = glasses.given(SOME)
    pairs = glasses.media_rays.columns(rays.header, rays.ids)[:, 1]
    names = np.array(["".join(pair).replace("air", "") for pair in rays.header["media"]])
    return names[pairs.astype(int)] == glass


def scaled(glass, factor):
    k = glasses.given(SOME).rays.k.copy()
    k[of(glass)] *= factor
    return k


def failing(found):
    return {row.case: set(row.broken) for row in found if row.verdict == "fail"}


def test_every_catalogue_is_of_a_system_with_a_script():
    assert set(CATALOGUES) <= set(SYSTEMS)
    for found in CATALOGUES.values():
        assert (SCRIPTS / found.script).is_file()
        assert set(found.others) <= set(found.glasses) <= set(GLASSES)


def test_right_answers_pass():
    found = rows()
    assert [row.case for row in found] == [*glasses.REGIMES, *SOME]
    assert {row.verdict for row in found} == {"pass"}


def test_another_index_is_no_other_direction():
    """Of Schott's F2 by 1e-12, which no direction in doubt would show."""
    assert failing(rows(scaled("SCHOTT:F2", 1 + 1e-12))) == {"SCHOTT:F2": {glasses.INDEX_OFF}}


def test_another_direction_is_no_other_index():
    found = failing(rows(direction=1 / glasses.given(SOME).rays.k))
    assert set(found) == set(glasses.REGIMES) and all("wrong" in broken for broken in found.values())
    off = glasses.given(SOME).rays.k * (1 + 1e-12)
    assert failing(rows(direction=off))["generic"] == {"wrong", ERROR_OVER_BOUND}


@pytest.mark.parametrize(("off", "fails"), [(1e-4, False), (1.05e-4, True), (0.9e-4, True), (0.0, True)])
def test_a_known_difference_is_a_missed_goal_as_long_as_it_is_what_it_was(off, fails):
    others = {"SCHOTT:F2": OtherIndex(1.00e-4, "another edition")}
    (row,) = [row for row in rows(scaled("SCHOTT:F2", 1 + off), others=others) if row.case == "SCHOTT:F2"]
    assert (row.verdict == "fail") == fails
    assert row.reason.endswith("another edition")
    if off:
        assert row.missed == {glasses.INDEX_OFF: glasses.media_rays.SAME}


def test_a_glass_that_is_not_answered_fails():
    def without(answers):
        kept = ~of("SCHOTT:F2")
        return dataclasses.replace(answers, ids=answers.ids[kept], b=answers.b[kept], n_ratio=answers.n_ratio[kept])

    found = failing(rows(change=without))
    assert found.pop("SCHOTT:F2") == {glasses.INDEX_OFF}
    assert set(found) == set(glasses.REGIMES) and all("unfit" in broken for broken in found.values())


def test_another_signal_of_total_reflection_is_seen():
    assert failing(rows(told="nan")) == {"critical": {"other TIR signal"}}


# In a process ----------------------------------------------------------------------------------------------------

PROGRAM = f"""
import sys
sys.path.insert(0, {str(SCRIPTS)!r})
import numpy as np, table
rays = table.Rays("float64", lambda maker, name, w: {{index}})
k, a, n = rays.k[:, None], rays.a, rays.n
c = (a * n).sum(1, keepdims=True)
d = 1 - k * k * (1 - c * c)
b = np.where(d < 0, 0, k * a - (k * c + np.sqrt(np.abs(d))) * n)
{{write}}
"""


def of_program(tmp_path, index="1.5", write="table.write(rays, b, 'a program 1.0')"):
    path = tmp_path / "program.py"
    path.write_text(PROGRAM.format(index=index, write=write))
    return glasses.system_rows(System("a", "A", "none", None, 0, small=True), catalogue(script=str(path)), STANDARD)


def test_a_program_is_judged_for_its_own_index(tmp_path):
    """Every glass has n = 1.5: all directions are right, and no index is."""
    found = of_program(tmp_path)
    assert all(row.reason.startswith("a program 1.0") for row in found)
    assert set(failing(found)) == set(SOME)
    (f2,) = [row for row in found if row.case == "SCHOTT:F2"]
    assert f2.values[glasses.INDEX_OFF] == pytest.approx(media.index("SCHOTT:F2", G) / 1.5 - 1, rel=1e-6)
    assert f2.replay["wavelength"] == G


@pytest.mark.parametrize(
    ("defect", "said"),
    [
        ({"index": "1 / 0"}, "division by zero"),
        ({"write": "rays.between_glasses = False; table.write(rays, b, 'a program')"}, "no column n_ratio"),
        ({"write": "print('refracting …')"}, "A: "),
        ({"write": "import os; os.kill(os.getpid(), 9)"}, "SIGKILL"),
    ],
)
def test_a_broken_program_fails_for_its_reason(defect, said, tmp_path):
    (row,) = of_program(tmp_path, **defect)
    assert row.verdict == "fail" and said in row.reason and "\n" not in row.reason


def test_what_is_absent_or_large_is_not_run(tmp_path, monkeypatch):
    system = SYSTEMS["optiland"]
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (row,) = glasses.system_rows(system, CATALOGUES[system.name], FULL)
    assert (row.verdict, row.reason) == ("not run", "python -m validation renderers --install optiland")
    monkeypatch.setattr(environments, "absent", lambda system: "")
    (row,) = glasses.system_rows(system, CATALOGUES[system.name], STANDARD)
    assert row.verdict == "not run" and "full profile" in row.reason
    (row,) = of_program(tmp_path, write="print('no glass', file=sys.stderr); sys.exit(77)")
    assert (row.verdict, row.reason) == ("not run", "cannot run here: no glass")


def test_without_catalogues_here_the_row_is_not_run(monkeypatch):
    monkeypatch.setattr(glasses, "find_spec", lambda name: None)
    (row,) = glasses.system_rows(SYSTEMS["rayoptics"], CATALOGUES["rayoptics"], FULL)
    assert row.verdict == "not run" and "pip install" in row.reason


@pytest.mark.parametrize("name", CATALOGUES)
def test_systems_that_are_installed_answer_for_their_indices(name):
    system = SYSTEMS[name]
    if reason := environments.absent(system):
        pytest.skip(reason)
    found = glasses.system_rows(system, CATALOGUES[system.name], FULL)
    assert len(found) > len(glasses.REGIMES) and {row.verdict for row in found} == {"pass"}
    assert {row.case for row in found if row.missed} <= set(CATALOGUES[name].others)


# Why catalogues differ: the coefficients that another catalogue has -----------------------------------------------

# CDGM has published two formulas: Sellmeier's, in the catalogue for Zemax of 2022, and a power series in its
# spreadsheet. Sumita has changed two glasses since its catalogue of 2017, whose coefficients are those of λ⁰, λ², λ⁻²,
# …, in µm. raysect has Schott's catalogue of 2000; of N-BK7 only C1 = 6000.69867 nm² is another. Last: an index that
# the other catalogue prints, and its line.
OTHER_CATALOGUES = [
    ("optiland", "CDGM:H-K9L", (0.614555251, 0.656775017, 1.02699346, 14598.7884, 2877.69588, 107653051), 1.52669, "g"),
    ("optiland", "CDGM:H-LaF4", (0.210645313, 1.75547352, 1.28979005, 54275.9294, 11237.0777, 119852069), 1.77728, "g"),
    (
        "optiland",
        "SUMITA:K-GIR79",
        {0: 3.3195074, 2: -0.0085801253, -2: 0.039978521, -4: 0.0014465322, -6: -3.0453007e-05, -8: 7.8005005e-06},
        1.85588,
        "d",
    ),
    (
        "optiland",
        "SUMITA:K-SFLDn3",
        {0: 3.2503692, 2: -0.013195714, -2: 0.049790724, -4: 0.0022430157, -6: -7.7567761e-06, -8: 2.1169316e-05},
        1.84666,
        "d",
    ),
    ("raysect", "SCHOTT:LLF1", (1.23326922, 0.116923839, 0.862645379, 8853.9681, 43687.5155, 104992168), 1.56328, "g"),
    ("raysect", "SCHOTT:N-BK7", (1.03961212, 0.231792344, 1.01046945, 6000.6987, 20017.9144, 103560653), 1.52668, "g"),
]


@pytest.mark.parametrize(("system", "glass", "coefficients", "printed", "line"), OTHER_CATALOGUES)
def test_the_recorded_difference_is_that_of_the_other_catalogue(system, glass, coefficients, printed, line):
    def there(w):
        if isinstance(coefficients, dict):
            return sum(x * (w / 1000) ** power for power, x in coefficients.items()) ** 0.5
        return media.index(f"sellmeier({', '.join(map(str, coefficients))})", w)

    off = max(abs(there(w) / media.index(glass, w) - 1) for w in glasses.WAVELENGTHS)
    assert off == pytest.approx(CATALOGUES[system].others[glass].recorded, rel=5e-3)
    assert round(there(media.LINES[line]), 5) == printed

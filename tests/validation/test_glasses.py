"""Glasses and an achromat by other ray tracers: wrong indices and wrong directions or traces are told apart."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from support.media_rays import answered

from mi_refract import media
from validation.media.closed_forms import back_focal_distance
from validation.reference import exact_lens
from validation.reference.exact_lens import crossing
from validation.run.context import PROFILES, Context
from validation.run.metrics import ERROR_OVER_BOUND
from validation.suite import glasses, lenses
from validation.suite.renderers import SYSTEMS, System, environments
from validation.suite.renderers.glass_catalogues import CATALOGUES, GLASSES, GlassCatalogue, OtherIndex
from validation.suite.renderers.system import SCRIPTS

QUICK, FULL = (Context(PROFILES[name], Path(), "llvm_ad_rgb", {}, {}) for name in ("quick", "full"))
SOME = ("SCHOTT:N-BK7", "SCHOTT:F2", "SUMITA:K-BK7")


@pytest.fixture
def rays():
    return glasses.rays_for(SOME)


def through_f2(rays):
    """Mask of the rays that pass through F2."""
    pairs = glasses.header.columns(rays.header, rays.ids)[:, 1].astype(int)
    return np.array(["SCHOTT:F2" in pair for pair in rays.header["media"]])[pairs]


def broken(rows):
    return {row.case: set(row.broken) for row in rows if row.broken}


def judged(rays, answers, others=(), tir="zero"):
    return glasses.rows("A", GlassCatalogue("", SOME, tir, dict(others)), rays, answers)


def test_wrong_indices_and_wrong_directions_are_told_apart(rays):
    """An index of F2 off by 1e-12 breaks the row of F2 only; directions for other indices break no row of a glass."""
    k, f2 = rays.rays.k, through_f2(rays)
    right = judged(rays, answered(rays))
    assert [(row.case, row.verdict) for row in right] == [(case, "pass") for case in (*glasses.REGIMES, *SOME)]
    assert broken(judged(rays, answered(rays, np.where(f2, k * (1 + 1e-12), k)))) == {"SCHOTT:F2": {glasses.INDEX_OFF}}
    inverted = broken(judged(rays, answered(rays, direction=1 / k)))
    assert set(inverted) == set(glasses.REGIMES) and all("wrong" in x for x in inverted.values())
    off = broken(judged(rays, answered(rays, direction=k * (1 + 1e-12))))
    assert off["generic"] == {"wrong", ERROR_OVER_BOUND} and not set(SOME) & set(off)
    assert broken(judged(rays, answered(rays), tir="nan")) == {"critical": {"other TIR signal"}}
    complete = answered(rays)
    without_f2 = dataclasses.replace(complete, ids=complete.ids[~f2], b=complete.b[~f2], n_ratio=complete.n_ratio[~f2])
    incomplete = broken(judged(rays, without_f2))
    assert incomplete.pop("SCHOTT:F2") == {glasses.INDEX_OFF}
    assert set(incomplete) == set(glasses.REGIMES) and all("unfit" in x for x in incomplete.values())


@pytest.mark.parametrize(("off", "fails"), [(1e-4, False), (1.05e-4, True), (0.9e-4, True), (0.0, True)])
def test_a_recorded_difference_misses_a_goal_and_a_changed_one_fails(off, fails, rays):
    k = rays.rays.k
    answers = answered(rays, np.where(through_f2(rays), k * (1 + off), k))
    rows = judged(rays, answers, {"SCHOTT:F2": OtherIndex(1.00e-4, "another edition")})
    (row,) = (row for row in rows if row.case == "SCHOTT:F2")
    assert (row.verdict == "fail") == fails and row.reason.endswith("another edition")
    assert row.missed == ({glasses.INDEX_OFF: glasses.header.SAME} if off else {})


PROGRAM = f"""
import sys
sys.path.insert(0, {str(SCRIPTS)!r})
import numpy as np, table
rays = table.Rays("float64", lambda maker, name, w: 1.5)
k, a, n = rays.k[:, None], rays.a, rays.n
c = (a * n).sum(1, keepdims=True)
d = 1 - k * k * (1 - c * c)
table.write(rays, np.where(d < 0, 0, k * a - (k * c + np.sqrt(np.abs(d))) * n), "a program 1.0")
"""


def test_directions_are_judged_for_the_programs_own_index_and_broken_programs_fail(tmp_path):
    """All glasses have n = 1.5: all directions are right, and all indices wrong."""

    def rows_of(text):
        (tmp_path / "program.py").write_text(text)
        return glasses.system_rows(System("a", "A"), GlassCatalogue(str(tmp_path / "program.py"), SOME, "zero"), QUICK)

    rows = rows_of(PROGRAM)
    assert all(row.reason.startswith("a program 1.0") for row in rows) and set(broken(rows)) == set(SOME)
    (f2,) = (row for row in rows if row.case == "SCHOTT:F2")
    assert f2.values[glasses.INDEX_OFF] == pytest.approx(media.index("SCHOTT:F2", media.LINES["g"]) / 1.5 - 1, rel=1e-6)
    for text, verdict, reason in (
        (PROGRAM.replace("1.5)", "1 / 0)"), "fail", "division by zero"),
        (PROGRAM.replace("table.w", "rays.between_glasses = False; table.w"), "fail", "no column n_ratio"),
        ("import sys; sys.exit(77)", "not run", "cannot run here: "),
    ):
        (row,) = rows_of(text)
        assert row.verdict == verdict and reason in row.reason and "\n" not in row.reason


@pytest.mark.parametrize("name", CATALOGUES)
def test_installed_systems_pass(name):
    catalogue = CATALOGUES[name]
    assert (SCRIPTS / catalogue.script).is_file() and set(catalogue.others) <= set(catalogue.glasses) <= set(GLASSES)
    if reason := environments.absent(SYSTEMS[name]):
        pytest.skip(reason)
    rows = glasses.system_rows(SYSTEMS[name], catalogue, FULL)
    assert len(rows) > len(glasses.REGIMES) and {row.verdict for row in rows} == {"pass"}
    assert {row.case for row in rows if row.missed} <= set(catalogue.others)


# CDGM has published two formulas: Sellmeier's, in its catalogue for Zemax of 2022, and a power series in its
# spreadsheet. Sumita has changed two glasses since its catalogue of 2017, whose coefficients are those of λ⁰, λ², λ⁻²,
# …, in µm. raysect has Schott's catalogue of 2000; its N-BK7 differs only in C1 = 6000.69867 nm². The last two columns:
# an index that the other catalogue prints, and its line.
GIR79 = {0: 3.3195074, 2: -0.0085801253, -2: 0.039978521, -4: 0.0014465322, -6: -3.0453007e-05, -8: 7.8005005e-06}
SFLDN3 = {0: 3.2503692, 2: -0.013195714, -2: 0.049790724, -4: 0.0022430157, -6: -7.7567761e-06, -8: 2.1169316e-05}
OTHER_CATALOGUES = [
    ("optiland", "CDGM:H-K9L", (0.614555251, 0.656775017, 1.02699346, 14598.7884, 2877.69588, 107653051), 1.52669, "g"),
    ("optiland", "CDGM:H-LaF4", (0.210645313, 1.75547352, 1.28979005, 54275.9294, 11237.0777, 119852069), 1.77728, "g"),
    ("optiland", "SUMITA:K-GIR79", GIR79, 1.85588, "d"),
    ("optiland", "SUMITA:K-SFLDn3", SFLDN3, 1.84666, "d"),
    ("raysect", "SCHOTT:LLF1", (1.23326922, 0.116923839, 0.862645379, 8853.9681, 43687.5155, 104992168), 1.56328, "g"),
    ("raysect", "SCHOTT:N-BK7", (1.03961212, 0.231792344, 1.01046945, 6000.6987, 20017.9144, 103560653), 1.52668, "g"),
]


@pytest.mark.parametrize(("system", "glass", "coefficients", "printed", "line"), OTHER_CATALOGUES)
def test_recorded_differences_are_those_of_the_other_catalogue(system, glass, coefficients, printed, line):
    def other_index(w):
        if isinstance(coefficients, dict):
            return sum(x * (w / 1000) ** power for power, x in coefficients.items()) ** 0.5
        return media.index(f"sellmeier({', '.join(map(str, coefficients))})", w)

    off = max(abs(other_index(w) / media.index(glass, w) - 1) for w in glasses.WAVELENGTHS)
    assert off == pytest.approx(CATALOGUES[system].others[glass].recorded, rel=5e-3)
    assert round(other_index(media.LINES[line]), 5) == printed


# The achromat --------------------------------------------------------------------------------------------------------

NS = 1.0, 1.5168, 1.62, 1.0
LENS = exact_lens.ACHROMAT


def test_the_exact_trace_is_paraxial_near_the_axis_and_its_sensitivities_are_right():
    """The difference from the paraxial focus is spherical aberration, which is quadratic in the height."""
    focus = 8.5 + back_focal_distance(LENS, NS)
    off = [float(crossing(LENS, NS, h, exact_lens.START).place) / focus - 1 for h in (1e-6, 1.0, 0.5)]
    assert abs(off[0]) < 1e-12 and off[1] / off[2] == pytest.approx(4, rel=1e-2)
    assert all(f"{c}" in lenses.FILE.read_text() for c in LENS.curvatures)
    exact, (first, *others) = crossing(LENS, NS, 10.0, exact_lens.START), LENS.curvatures
    bent = crossing(dataclasses.replace(LENS, curvatures=(first * (1 + 1e-9), *others)), NS, 10.0, exact_lens.START)
    assert float(abs(bent.place - exact.place)) / 1e-9 == pytest.approx(exact.moves["bend"][0], rel=1e-6)
    height, distance = exact.meetings[2].y, float(exact.place) - 8.5
    assert exact.moves["turn"][2] == pytest.approx(distance**2 / height + height, rel=2e-2)


def traced(same_indices=None, own_glasses=None, indices=None):
    """The rows of a system that traces like the planar trace, except for the given rays and indices."""
    ours, known = lenses.planar()
    same_indices = ours if same_indices is None else same_indices
    rays = {lenses.GIVEN: same_indices, lenses.OWN: same_indices if own_glasses is None else own_glasses}
    return lenses.answer_rows("A", lenses.Answer("A 1.0", known if indices is None else indices, rays))


def test_wrong_traces_and_other_indices_are_told_apart():
    ours, known = lenses.planar()
    rows = traced()
    assert [(row.verdict, row.reason) for row in rows] == [("pass", "A 1.0")] * 4
    assert all(row.values[lenses.FOCUS_OFF] == row.values[lenses.SHIFT_OFF] == 0 for row in rows)
    moved, one = ours.copy(), ours.copy()
    moved[..., 0] += 1e-10
    one[3, :, 1] *= 1 + 1e-12  # at one wavelength
    lost = ours.copy()
    lost[3] = 0.0  # a ray without a direction crosses the axis nowhere
    for rays in (moved, one, ours.astype(np.float32).astype(float), lost):
        assert list(broken(traced(rays)).values()) == [{ERROR_OVER_BOUND}] * 4
    indices = known * [[1], [1 + 1e-8]]  # F2 of another maker, traced correctly
    start = exact_lens.START
    places = ([float(crossing(LENS, (1.0, *n, 1.0), h, start).place) for h in lenses.HEIGHTS] for n in indices.T)
    own = [[[x, 0.0, 1.0, 0.1] for x in row] for row in places]
    rows = traced(own_glasses=np.array(own), indices=indices)
    assert broken(rows) == {f"{lenses.OWN}, height {h:g}": {lenses.INDEX_OFF} for h in lenses.HEIGHTS}
    assert all(row.values[lenses.FOCUS_OFF] > 1e-9 for row in rows if row.case.startswith(lenses.OWN))
    # The same rays with the indices of the file are a wrong trace.
    assert set.union(*broken(traced(own_glasses=np.array(own))).values()) == {ERROR_OVER_BOUND}


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ("raise RuntimeError('out of glass')", "out of glass"),
        ("print('[]')", "no answer"),
        ("print(json.dumps({'system': 'A', 'indices': [], 'rays': {'given': [], 'own': []}}))", "shape"),
        (
            "print(json.dumps({'system': 'A', 'indices': lens['indices'], "
            "'rays': {name: [[[float('nan')] * 4] * 2] * 6 for name in ('given', 'own')}}))",
            "not finite",
        ),
        ("sys.exit(77)", "cannot run here: "),
    ],
)
def test_broken_lens_programs_fail_with_the_reason(body, reason, tmp_path):
    (tmp_path / "program.py").write_text(f"import json, sys\nlens = json.load(sys.stdin)\n{body}\n")
    (row,) = lenses.system_rows(System("a", "A", lens=("{python}", str(tmp_path / "program.py"))), QUICK)
    assert row.verdict == ("not run" if "77" in body else "fail") and reason in row.reason and "\n" not in row.reason

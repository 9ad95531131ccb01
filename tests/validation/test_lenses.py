"""An achromat by other ray tracers: the exact trace is right, and errors of traces and of indices are told apart."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mi_refract import media
from validation.media.closed_forms import back_focal_distance
from validation.reference.exact_lens import crossing
from validation.run.metrics import ERROR_OVER_BOUND
from validation.suite import lenses
from validation.suite.renderers import SYSTEMS, System, environments

STANDARD, FULL = (SimpleNamespace(profile=SimpleNamespace(name=name)) for name in ("standard", "full"))
NS = 1.0, 1.5168, 1.62, 1.0


def answer(rays=None, own=None, indices=None):
    """The planar trace's as another system's."""
    ours, known = lenses.planar()
    given = ours if rays is None else rays
    return lenses.Answer(
        "A 1.0", known if indices is None else indices, {lenses.GIVEN: given, lenses.OWN: given if own is None else own}
    )


def broken(rows):
    return {(row.case, metric) for row in rows for metric in row.broken}


def test_the_exact_trace_is_that_of_matrices_near_the_axis():
    """The rest is spherical aberration, and falls as the height's square."""
    focus = 8.5 + back_focal_distance(lenses.LENS.curvatures, NS, lenses.LENS.thicknesses)
    off = [float(crossing(lenses.LENS, NS, h, lenses.START).place) / focus - 1 for h in (1e-6, 1.0, 0.5)]
    assert abs(off[0]) < 1e-12
    assert off[1] / off[2] == pytest.approx(4, rel=1e-2)


def test_the_weights_of_errors_are_those_of_small_changes():
    """A turned ray after the last surface swings about its point; a bent surface is one of another curvature."""
    exact = crossing(lenses.LENS, NS, 10.0, lenses.START)
    first, *others = lenses.LENS.curvatures
    bent = crossing(replace(lenses.LENS, curvatures=(first * (1 + 1e-9), *others)), NS, 10.0, lenses.START)
    assert float(abs(bent.place - exact.place)) / 1e-9 == pytest.approx(exact.moves["bend"][0], rel=1e-6)
    height, distance = exact.meetings[2].y, float(exact.place) - 8.5
    assert exact.moves["turn"][2] == pytest.approx(distance**2 / height + height, rel=2e-2)


def test_right_answers_pass_and_say_who_gave_them():
    rows = lenses.answered("A", answer())
    assert [(row.verdict, row.reason) for row in rows] == [("pass", "A 1.0")] * 4
    assert all(row.values[lenses.FOCUS_OFF] == row.values[lenses.SHIFT_OFF] == 0 for row in rows)


@pytest.mark.parametrize("defect", ["a thickness", "a digit of a curvature", "one wavelength", "float32"])
def test_another_trace_is_no_other_index(defect):
    rays = lenses.planar()[0].copy()
    match defect:
        case "a thickness":
            rays[..., 0] += 1e-12 * 100
        case "a digit of a curvature":
            rays[..., 3] *= 1 + 1e-12
        case "one wavelength":
            rays[3, :, 1] *= 1 + 1e-12
        case "float32":
            rays = rays.astype(np.float32).astype(float)
    found = broken(lenses.answered("A", answer(rays)))
    assert {metric for _, metric in found} == {ERROR_OVER_BOUND}
    assert len(found) == 4


def test_another_index_is_no_other_trace(monkeypatch):
    """F2 of another maker, traced rightly: only the index is wrong, and the focus says by how much."""
    indices = lenses.planar()[1].copy()
    indices[1] *= 1 + 1e-8
    places = [
        [float(crossing(lenses.LENS, (1.0, *n, 1.0), h, lenses.START).place) for h in lenses.HEIGHTS] for n in indices.T
    ]
    rays = np.array([[[place, 0.0, 1.0, 0.1] for place in each] for each in places])
    rows = lenses.answered("A", answer(own=rays, indices=indices))
    assert broken(rows) == {(f"{lenses.OWN}, height {h:g}", lenses.INDEX_OFF) for h in lenses.HEIGHTS}
    assert all(row.values[lenses.FOCUS_OFF] > 1e-9 for row in rows if row.case.startswith(lenses.OWN))
    rows = lenses.answered("A", answer(own=rays))  # the same rays, said to be those of the file's glass
    assert {metric for _, metric in broken(rows)} == {ERROR_OVER_BOUND}


def program(tmp_path, body):
    path = tmp_path / "program.py"
    path.write_text(f"import json, sys\nlens = json.load(sys.stdin)\n{body}\n")
    return System("a", "A", "none", None, 0, small=True, lens=("{python}", str(path)))


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("raise RuntimeError('out of glass')", "out of glass"),
        ("print('tracing …')", "no answer"),
        ("print('[]')", "no answer"),
        ("print(json.dumps({'system': 'A', 'indices': [], 'rays': {'given': [], 'own': []}}))", "shape"),
        (
            "print(json.dumps({'system': 'A', 'indices': lens['indices'], "
            "'rays': {name: [[[float('nan')] * 4] * 2] * 6 for name in ('given', 'own')}}))",
            "not finite",
        ),
    ],
)
def test_a_broken_program_fails_for_its_reason(body, said, tmp_path):
    (row,) = lenses.system_rows(program(tmp_path, body), STANDARD)
    assert row.verdict == "fail" and said in row.reason and "\n" not in row.reason


def test_what_cannot_run_or_is_absent_or_large_is_not_run(tmp_path, monkeypatch):
    (row,) = lenses.system_rows(program(tmp_path, "print('no glass', file=sys.stderr); sys.exit(77)"), STANDARD)
    assert (row.verdict, row.reason) == ("not run", "cannot run here: no glass")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (row,) = lenses.system_rows(SYSTEMS["rayoptics"], STANDARD)
    assert (row.verdict, row.reason) == ("not run", "python -m validation renderers --install rayoptics")
    monkeypatch.setattr(environments, "absent", lambda system: "")
    (row,) = lenses.system_rows(SYSTEMS["optiland"], STANDARD)
    assert row.verdict == "not run" and "full profile" in row.reason


def test_the_lens_is_that_of_the_file():
    """Its glasses by name have the indices of the file's formulas."""
    pytest.importorskip("opticalglass")
    _, indices = lenses.planar()
    for glass, n in zip(lenses.GLASSES, indices, strict=True):
        assert np.abs(media.parse(":".join(glass)).index(np.array(lenses.wavelengths())) / n - 1).max() < 1e-15
    text = lenses.FILE.read_text()
    assert all(f"{c}" in text for c in lenses.LENS.curvatures)
    assert json.loads(json.dumps(lenses.question()))["start"] == -20

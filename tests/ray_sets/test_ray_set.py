"""Ray sets: exact, replayable, and an error for what is no set. The room's README: its program is right."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from support.ray_programs import BAD
from support.readme import python_blocks

from mi_refract import regimes
from mi_refract.numerics import float_expansions
from mi_refract.ray_sets import check_answers, ray_set, run_program

README = Path(ray_set.__file__).with_name("README.md")


def test_the_rays_are_the_regimes_own():
    made = ray_set.make(["Brewster", "grazing"], 50, "f64", 3, two_sided=True)
    assert made.header["regimes"] == {"Brewster": [0, 49], "grazing": [50, 99]}
    expected = regimes.make("grazing", 50, np.float64, 3)
    part = made.rays[made.regime == "grazing"]
    for name in "ank":
        np.testing.assert_array_equal(getattr(part, name), getattr(expected, name))


@pytest.mark.parametrize("precision", ray_set.PRECISIONS)
def test_normals_face_the_ray(precision):
    names = ("generic", "grazing", "on a denormal", "tangential")
    either, facing = (ray_set.make(names, 200, precision, two_sided=t).rays for t in (True, False))
    side = [float_expansions.dot(r.n.T.astype(float), r.a.T.astype(float))[0] for r in (either, facing)]
    assert (side[0] > 0).any() and (side[1] <= 0).all()
    np.testing.assert_array_equal(np.abs(facing.n), np.abs(either.n))
    np.testing.assert_array_equal(facing.a, either.a)


@pytest.mark.parametrize(
    "given, message",
    [
        ({"names": ["generc"]}, "regime 'generc': unknown; expected 'generic'"),
        ({"precision": "f16"}, "precision 'f16': unknown; expected f32, f64"),
        ({"count": 0}, "at least one ray"),
        ({"names": []}, "at least one ray"),
        ({"names": ["generic", "generic"]}, "each regime once"),
        ({"seed": -1}, "seed -1"),
    ],
)
def test_invalid_sets(given, message):
    with pytest.raises(ValueError, match=message):
        ray_set.make(**given)


def test_the_program_in_the_readme_is_right(tmp_path):
    (tmp_path / "my_tracer.py").write_text(python_blocks(README)[0])
    rays = ray_set.make(count=50)
    answers = run_program.answers_of([sys.executable, str(tmp_path / "my_tracer.py")], rays)
    assert check_answers.check(rays, answers).exit_code == 0


@pytest.mark.parametrize("mistake", [*BAD, "f32 where f64 was claimed", "too few digits"])
def test_every_mistake_is_in_the_table_of_the_readme(mistake):
    assert f"| {mistake} |" in README.read_text()

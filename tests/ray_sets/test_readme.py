"""The room's README: its program is right, and its tables are complete."""

import sys
from pathlib import Path

from support.readme import python_blocks

from mi_refract.ray_sets import check_answers, ray_set, run_program
from mi_refract.ray_sets.diagnosis import MISTAKES

README = Path(ray_set.__file__).with_name("README.md")


def test_the_program_is_right(tmp_path):
    (tmp_path / "my_tracer.py").write_text(python_blocks(README)[0])
    rays = ray_set.make(count=50)
    answers = run_program.answers_of([sys.executable, str(tmp_path / "my_tracer.py")], rays)
    assert check_answers.check(rays, answers).exit_code == 0


def test_every_mistake_is_in_the_table():
    for name in (*MISTAKES, "f32 where f64 was claimed", "too few digits"):
        assert f"| {name} |" in README.read_text()

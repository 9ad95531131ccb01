"""The room's README: its program is right, and its tables are complete."""

import re
import sys
from pathlib import Path

from mi_refract.ray_sets import check_answers, ray_set, run_program
from mi_refract.ray_sets.diagnosis import MISTAKES

README = Path(ray_set.__file__).with_name("README.md").read_text()


def test_the_program_is_right(tmp_path):
    program = re.search(r"```python\n(.*?)```", README, re.DOTALL)[1]
    (tmp_path / "my_tracer.py").write_text(program)
    rays = ray_set.make(count=50)
    answers = run_program.answers_of([sys.executable, str(tmp_path / "my_tracer.py")], rays)
    assert check_answers.check(rays, answers).exit_code == 0


def test_every_mistake_is_in_the_table():
    for name in (*MISTAKES, "f32 where f64 was claimed", "too few digits"):
        assert f"| {name} |" in README

"""The worst rays found so far: a text file with one ray per line, which the tests replay.

A line is `precision | formula | regime | objective | score | a | n | k`, with hexadecimal floats. The objective is
"chord", scored by the certified chord error in u, or "decision", a ray whose total internal reflection the formula
misclassified, scored by |D| in u² of the radicand's terms (`oracle.relative_radicand`); the score is 0 once the formula
classifies it correctly. When rays are added, the old ones are scored again, so that the present formula decides which
are kept.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np

from mi_refract.io.atomic import write_atomically
from mi_refract.regimes import Rays

PATH = Path(__file__).parents[2] / "tests" / "data" / "worst_rays.txt"
# Lines per precision, formula, regime and objective.
MOST = 2
_SEPARATOR = " | "


@dataclass(frozen=True)
class Found:
    """One line. `numbers` are a, n and k as seven hexadecimal floats."""

    precision: str
    formula: str
    regime: str
    objective: str
    score: float
    numbers: tuple[str, ...]

    @classmethod
    def at(cls, rays: Rays, i: int, formula: str, regime: str, objective: str, score: float) -> Found:
        """The line of ray `i`, with a score rounded to four digits."""
        ray = rays.hexed(i)
        numbers = *ray["a"], *ray["n"], ray["k"]
        return cls(rays.k.dtype.name, formula, regime, objective, float(f"{score:.4g}"), numbers)

    def scored(self, score: float) -> Found:
        """The same ray with another score."""
        return replace(self, score=float(f"{score:.4g}"))

    @property
    def group(self) -> tuple[str, ...]:
        """Lines of one group compete for MOST places."""
        return self.precision, self.formula, self.regime, self.objective

    def line(self) -> str:
        """The line as it stands in the file."""
        vectors = " ".join(self.numbers[:3]), " ".join(self.numbers[3:6]), self.numbers[6]
        return _SEPARATOR.join((*self.group, f"{self.score:.4g}", *vectors))

    @classmethod
    def parse(cls, line: str) -> Found:
        """ValueError where the line is not of this form."""
        precision, formula, regime, objective, score, a, n, k = line.split(_SEPARATOR)
        numbers = (*a.split(), *n.split(), k)
        if len(numbers) != 7 or not np.isfinite([float.fromhex(x) for x in numbers]).all():
            raise ValueError(f"not a ray: {line!r}; expected three numbers for a, three for n, one for k")
        return cls(precision, formula, regime, objective, float(score), numbers)


def read(path: Path = PATH) -> list[Found]:
    """All lines, none where there is no file. ValueError: a line that is not one."""
    lines = path.read_text().splitlines() if path.exists() else []
    return [Found.parse(line) for line in lines if line and not line.startswith("#")]


def rays_of(found: Iterable[Found], precision: str) -> Rays:
    """The rays of the lines of that precision, exactly."""
    numbers = [[float.fromhex(x) for x in line.numbers] for line in found if line.precision == precision]
    table = np.array(numbers, dtype=precision).reshape(-1, 7)
    return Rays(table[:, :3], table[:, 3:6], table[:, 6])


def keep(found: Iterable[Found], path: Path = PATH) -> int:
    """Merge into the file: no ray twice, sorted, the MOST worst of every group. Returns how many lines are new."""
    before = read(path)
    unique = {(line.group, line.numbers): line for line in (*before, *found)}
    ordered = sorted(unique.values(), key=lambda line: (*line.group, -line.score, line.numbers))
    kept = [line for _, lines in groupby(ordered, key=lambda line: line.group) for line in list(lines)[:MOST]]
    header = ["# " + line if line else "#" for line in __doc__.strip().splitlines()]
    write_atomically(path, "\n".join([*header, *(line.line() for line in kept)]) + "\n")
    return len(set(kept) - set(before))

"""Rows: what a measurement leaves behind, and the only thing a report reads.

`rows.json` is `{"schema": 1, "context": {...}, "rows": [row, ...]}`; a row is the dictionary form of `Row`
below plus its `verdict`. `context` holds what every row shares: versions, machine, profile, start.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mi_refract.io.safe_files import write_atomically

SCHEMA = 1


class Reason(str):
    """Why a row was not run, and in `remedy` what would make it run, e.g. "`--profile full`"."""

    remedy: str

    def __new__(cls, text: str, remedy: str = "") -> Reason:
        """`text` with a remedy."""
        reason = super().__new__(cls, text)
        reason.remedy = remedy
        return reason


@dataclass(frozen=True)
class Row:
    """One measurement: subject, case, backend, measured values and their bounds.

    `values` are the numbers by metric name. `budgets` are upper bounds for some of them; a NaN breaks its budget.
    `goals` are upper bounds for what a busy machine can spoil (times): a missed goal is shown and decides no verdict.
    A row without values was not run: `reason` says why, and `remedy`, which a `Reason` brings, what would make it run;
    with values, `reason` is a remark. `replay` repeats the row: seed, sizes, hex floats. `images` are EXR paths
    relative to the output folder, by role (`reference`, `test`, `overlay`, `difference`). `curves` are named lists of
    (x, y) points; the study's `axes` in the context say what x and y are.
    """

    study: str  # "directions"
    subject: str  # what is judged: a formula, a plugin
    case: str  # a regime of rays, a scene
    setting: str  # "llvm float32", a Mitsuba variant
    values: dict[str, float] = field(default_factory=dict)
    budgets: dict[str, float] = field(default_factory=dict)
    goals: dict[str, float] = field(default_factory=dict)
    reason: str = ""
    replay: dict[str, Any] = field(default_factory=dict)
    images: dict[str, str] = field(default_factory=dict)
    curves: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    remedy: str = ""

    def __post_init__(self) -> None:
        """Check that every bound has its value, and that a row without values says why. Errors: ValueError."""
        unmeasured = (self.budgets.keys() | self.goals.keys()) - self.values.keys() if self.values else set()
        if unmeasured:
            raise ValueError(f"row {self.name}: a bound without a value: {sorted(unmeasured)}")
        if not self.values and not self.reason:
            raise ValueError(f"row {self.name}: neither values nor the reason why it was not run")
        if isinstance(self.reason, Reason):
            object.__setattr__(self, "remedy", self.reason.remedy)
            object.__setattr__(self, "reason", str(self.reason))

    @property
    def name(self) -> str:
        """Study, subject, case and setting in one line."""
        return " / ".join((self.study, self.subject, self.case, self.setting))

    @property
    def bounds(self) -> dict[str, float]:
        """Budgets and goals by metric."""
        return self.goals | self.budgets

    @property
    def broken(self) -> dict[str, float]:
        """The budgets that did not hold, by metric."""
        return _exceeded(self.values, self.budgets)

    @property
    def missed(self) -> dict[str, float]:
        """The goals that were not reached."""
        return _exceeded(self.values, self.goals)

    @property
    def verdict(self) -> str:
        """ "not run", "fail", "pass", or "info" where nothing was demanded."""
        if not self.values:
            return "not run"
        if self.broken:
            return "fail"
        return "pass" if self.budgets else "info"

    def as_dict(self) -> dict[str, Any]:
        """The fields by name, and the verdict."""
        return dataclasses.asdict(self) | {"verdict": self.verdict}

    @classmethod
    def from_dict(cls, data: object) -> Row:
        """The row whose fields `data` holds, as JSON has them; other entries are ignored.

        Errors: ValueError, one line, for a missing field or another type.
        """
        import msgspec

        return msgspec.convert(data, cls, strict=False)  # not strict: NaN and the infinities are words

    @property
    def replay_text(self) -> str:
        """`replay` as JSON, one entry a line; "" where there is none."""
        form: Any = {"ensure_ascii": False, "default": str}
        entries = [f" {json.dumps(k, **form)}: {json.dumps(v, **form)}" for k, v in strict(self.replay).items()]
        return "{\n" + ",\n".join(entries) + "\n}" if entries else ""


def _exceeded(values: dict[str, float], bounds: dict[str, float]) -> dict[str, float]:
    return {m: b for m, b in bounds.items() if values and not (values[m] <= b)}  # not ≤: NaN breaks its bound


def by_study(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """The rows of each study, both in the order in which they first appear."""
    studies: dict[str, list[Row]] = {}
    for row in rows:
        studies.setdefault(row.study, []).append(row)
    return studies


def as_json(rows: Iterable[Row]) -> str:
    """The rows as strict JSON, a list. Errors: TypeError for a value JSON has no form for."""
    return json.dumps(strict([row.as_dict() for row in rows]), indent=1, allow_nan=False)


def write_strict_json(path: str | Path, document: object) -> None:
    """Write the document as JSON: NaN and the infinities become words.

    Errors: TypeError for a value JSON has no form for; OSError.
    """
    text = json.dumps(strict(document), indent=1, allow_nan=False)
    write_atomically(path, text + "\n")


def strict(value: object) -> Any:
    """`value` in the types strict JSON has: numpy's as lists and numbers, NaN and the infinities as words."""
    if isinstance(value, float):  # numpy's float64 too, hence the conversion
        return float(value) if math.isfinite(value) else str(float(value))
    if isinstance(value, Mapping):
        return {str(key): strict(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [strict(item) for item in value]
    if hasattr(value, "tolist"):  # numpy scalars and arrays
        return strict(value.tolist())
    return str(value) if isinstance(value, Path) else value

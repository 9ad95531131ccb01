"""Rows: the results of measurements, from which all reports are made.

`rows.json` is `{"schema": 1, "context": {...}, "rows": [row, ...]}`; a row is the dictionary form of `Row`
below plus its `verdict`. `context`: the properties that all rows share: versions, machine, profile, start.
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
    """The reason why a row was not run, and in `remedy` how to run it, e.g. "`--profile full`"."""

    remedy: str

    def __new__(cls, text: str, remedy: str = "") -> Reason:
        """Return `text` with a remedy."""
        reason = super().__new__(cls, text)
        reason.remedy = remedy
        return reason


@dataclass(frozen=True)
class Row:
    """One measurement: subject, case, backend, measured values and their bounds.

    - `values`: numbers by metric name. A row without values was not run.
    - `budgets`: upper bounds for some of the values; NaN breaks its budget. `goals`: upper bounds for values that
      depend on the load of the machine, such as times; a missed goal is shown and does not affect the verdict.
    - `reason`: why the row was not run, or with values a remark. `remedy`: how to run it, from a `Reason`.
    - `replay`: data to repeat the row: seed, sizes, hex floats.
    - `images`: EXR paths relative to the output folder, by role (`reference`, `test`, `overlay`, `difference`).
    - `curves`: named lists of (x, y) points; the study's `axes` in the context describe x and y.
    """

    study: str  # "directions"
    subject: str  # a formula, a plugin
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
        """Raise ValueError for a bound without a value, and for a row with neither values nor a reason."""
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
        """The budgets that are exceeded, by metric."""
        return _exceeded(self.values, self.budgets)

    @property
    def missed(self) -> dict[str, float]:
        """The goals that are exceeded, by metric."""
        return _exceeded(self.values, self.goals)

    @property
    def verdict(self) -> str:
        """ "not run", "fail", "pass", or "info" for a row without budgets."""
        if not self.values:
            return "not run"
        if self.broken:
            return "fail"
        return "pass" if self.budgets else "info"

    def as_dict(self) -> dict[str, Any]:
        """Return the fields by name, and the verdict."""
        return dataclasses.asdict(self) | {"verdict": self.verdict}

    @classmethod
    def from_dict(cls, data: object) -> Row:
        """Return the row with the fields in `data`, parsed from JSON; other entries are ignored.

        Errors: ValueError, one line, for a missing field or another type.
        """
        import msgspec

        return msgspec.convert(data, cls, strict=False)  # not strict, because NaN and infinities are strings in JSON

    @property
    def replay_text(self) -> str:
        """`replay` as JSON, one entry a line; "" if it is empty."""
        form: Any = {"ensure_ascii": False, "default": str}
        entries = [f" {json.dumps(k, **form)}: {json.dumps(v, **form)}" for k, v in strict(self.replay).items()]
        return "{\n" + ",\n".join(entries) + "\n}" if entries else ""


def _exceeded(values: dict[str, float], bounds: dict[str, float]) -> dict[str, float]:
    return {m: b for m, b in bounds.items() if values and not (values[m] <= b)}  # `not <=`: NaN exceeds its bound


def by_study(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Return the rows by study; studies and rows keep their order."""
    studies: dict[str, list[Row]] = {}
    for row in rows:
        studies.setdefault(row.study, []).append(row)
    return studies


def strict_json(document: object) -> str:
    """Return the document as JSON; NaN and infinities become strings. TypeError for what JSON cannot represent."""
    return json.dumps(strict(document), indent=1, allow_nan=False)


def write_strict_json(path: str | Path, document: object) -> None:
    """Write `strict_json` of the document. Errors: those of `strict_json`; OSError."""
    write_atomically(path, strict_json(document) + "\n")


def strict(value: object) -> Any:
    """Return `value` in types of strict JSON: NumPy's as lists and numbers, NaN and infinities as strings."""
    if isinstance(value, float):  # also NumPy's float64, hence the conversion
        return float(value) if math.isfinite(value) else str(float(value))
    if isinstance(value, Mapping):
        return {str(key): strict(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [strict(item) for item in value]
    if hasattr(value, "tolist"):  # numpy scalars and arrays
        return strict(value.tolist())
    return str(value) if isinstance(value, Path) else value

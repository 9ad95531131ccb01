"""The JSON of `mi-refract diff --json`: written, and read again for accepting what it names.

When it is read, its paths are taken as parts of two folders, which may be others than those that were compared: a CI's
JSON fits the new images that were downloaded from it.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import msgspec

from mi_refract.io import safe_files
from mi_refract.io.typed_table import convert
from mi_refract.report.row import write_strict_json

from . import pairing
from .results import FAILED, Result, Results, Status
from .settings import ComparisonSpec, Settings
from .text_reports import sentence

SCHEMA = 1
MOST = 2**28  # bytes of a file
EXPECTED = "expected a file that mi-refract diff --json wrote"
PathText = Annotated[str, msgspec.Meta(min_length=1, pattern=r"^[^\0]*$")]
Digest = Annotated[str, msgspec.Meta(pattern=r"^([0-9a-f]{64})?$")]


def write(path: str | Path, results: Results) -> None:
    """Write `as_data` as strict JSON: NaN and the infinities become words. OSError."""
    write_strict_json(path, as_data(results))


def as_data(results: Results) -> dict[str, Any]:
    """`{"schema": 1, "exit_code", "sentence", "reference", "test", "counts", "results": [...]}`."""
    counts = Counter(result.status for result in results.results)
    entries = []
    for result in results.results:
        comparison, how, digests = result.comparison, result.how, None
        if result.digests is not None and result.status in FAILED:  # of what was compared; "" where there is no file
            one, two = (result.digests[path] if path else "" for path in (result.reference, result.test))
            digests = {"reference": one, "test": two, "variants": [result.digests[path] for path in result.variants]}
        entries.append({
            "name": result.name,
            "status": str(result.status),
            "category": str(result.category),
            "reason": result.reason,
            "warning": result.warning,
            "error": result.error,
            "reference": result.reference,
            "test": result.test,
            "target": result.target,
            "digests": digests,
            "method": result.method,
            "method_why": comparison.chosen if comparison else "",
            "options": dict(how.options),
            "channels": how.channels,
            "variance": how.variance if how.reads_variance else "",
            "mask": how.mask,
            "ignore": how.ignore,
            "why_so": how.reason,
            "entries": how.entries,
            "matched": result.matched,
            "variants": result.variants,
            "metrics": [vars(metric) for metric in comparison.metrics] if comparison else [],
            "minimum_detectable_difference": comparison.minimum_detectable if comparison else math.nan,
            "reproduce": results.reproduce(result),
            "accept": results.accept(result)
        })  # fmt: skip
    return {
        "schema": SCHEMA,
        "exit_code": results.exit_code,
        "sentence": sentence(results),
        "reference": results.reference,
        "test": results.test,
        "renders": results.renders,
        "counts": {str(status): counts[status] for status in Status},
        "results": entries,
    }


# What is read of it -------------------------------------------------------------------------------------------------


class Digests(msgspec.Struct):
    """The SHA-256 of the files of an image when they were compared; "" where there was none."""

    reference: Digest
    test: Digest
    variants: list[Digest]


class Entry(msgspec.Struct):
    """What is needed of one image."""

    name: str
    status: Status
    target: PathText
    error: str = ""
    reference: PathText | None = None
    test: PathText | None = None
    variants: list[PathText] = []
    digests: Digests | None = None
    options: dict[str, Any] = {}
    variance: str = ""


class Document(msgspec.Struct):
    """What is needed of the file."""

    reference: PathText
    test: PathText
    results: list[Entry]
    renders: bool = False


def read(path: str | Path, reference: Path | None = None, test: Path | None = None) -> Results:
    """The results; those that are not equal with their digests. `reference`, `test`: by default the paths in the file.

    ValueError for a file that `--json` did not write, of another version, of `--renders`, or with a path outside of the
    two; OSError where it cannot be read.
    """
    try:
        data = json.loads(safe_files.read_bytes(path, MOST))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not JSON ({error}); {EXPECTED}") from None
    schema = data.get("schema") if isinstance(data, dict) else None
    if schema != SCHEMA:
        raise ValueError(f"{path}: schema {schema!r}; expected {SCHEMA}: {EXPECTED}")
    try:
        document = convert(data, Document, str(path))
    except ValueError as error:
        raise ValueError(f"{error}; {EXPECTED}") from None
    if document.renders:
        raise ValueError(f"{path}: written with --renders; expected the JSON of a comparison of single images")
    before = Path(document.reference), Path(document.test)
    now = reference or before[0], test or before[1]
    results = tuple(
        _result(f"{path}: results[{number}]", entry, before, now) for number, entry in enumerate(document.results)
    )
    return Results(*now, results)


def _result(where: str, entry: Entry, before: tuple[Path, Path], now: tuple[Path, Path]) -> Result:
    if entry.status not in FAILED:
        return Result(entry.name, entry.status, None, None)
    reference = _moved(f"{where}.reference", entry.reference, before[0], now[0]) if entry.reference else None
    test = _moved(f"{where}.test", entry.test, before[1], now[1]) if entry.test else None
    none = entry.target == "."  # of what is wrong in the settings and matches no image
    target = Path() if none else _moved(f"{where}.target", entry.target, before[0], now[0])
    # Of single files, the variants lie beside the reference.
    roots = (before[0].parent, now[0].parent) if entry.target == str(before[0]) else (before[0], now[0])
    variants = tuple(_moved(f"{where}.variants", each, *roots) for each in entry.variants)
    digests = None
    if entry.digests is not None:
        if len(entry.digests.variants) != len(variants):
            raise ValueError(f"{where}.digests: {len(entry.digests.variants)} of {len(variants)} variants; {EXPECTED}")
        words = zip(variants, entry.digests.variants, strict=True)
        pairs = [(reference, entry.digests.reference), (test, entry.digests.test), *words]
        digests = {path: word for path, word in pairs if path}
    options = {"allow_nonfinite": entry.options.get("allow_nonfinite") is True}
    how = ComparisonSpec(options=options, variance=entry.variance)
    result = Result(entry.name, entry.status, reference, test, how, error=entry.error)
    return replace(result, digests=digests, target=target, variants=variants)


def _moved(where: str, text: str, before: Path, now: Path) -> Path:
    """The path of the file as one in `now`. ValueError where it leads out of it, by `..` or by a link to a folder."""
    path = Path(text)
    moved = now / path.relative_to(before) if path.is_relative_to(before) else None
    if moved is None or not (moved == now or pairing.is_inside(moved, now)):
        raise ValueError(f"{where}: {path}; expected a path in {before}")
    return moved


def with_settings(results: Results, settings: Settings) -> Results:
    """The results with `settings`, of which the file says no more than whether values need be finite.

    ValueError for an image with a variance in a file of its own, of which the file has no digest.
    """
    changed = []
    for result in results.results:
        inside = result.target.is_relative_to(results.reference)
        target = result.target.relative_to(results.reference) if inside else Path()
        how = pairing.how_of(settings, result.name, target)
        if result.status in FAILED and (result.how.variance or how.reads_variance):
            raise ValueError(f"{result.name}: its variance is in a separate file; accept it without --from")
        changed.append(replace(result, how=replace(how, options=result.how.options)))
    return replace(results, results=tuple(changed))

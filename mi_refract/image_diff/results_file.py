"""Reading the JSON that `mi-refract diff --json` wrote, for accepting what it names.

Its paths are taken as parts of two folders, which may be others than those that were compared: a CI's JSON fits the new
images that were downloaded from it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from mi_refract.io import regular_file

from .results import FAILED, Result, Results, Status
from .settings import ComparisonSpec, Settings
from .text_reports import SCHEMA

MOST = 2**28  # bytes of a file
DIGEST = 64  # characters of a SHA-256
Table = Mapping[str, Any]


def read(path: str | Path, reference: Path | None = None, test: Path | None = None) -> Results:
    """The results; those that are not equal with their digests. `reference`, `test`: by default the paths in the file.

    ValueError for a file that `--json` did not write, of another version, of `--renders`, or with a path outside of the
    two; OSError where it cannot be read.
    """
    found = _document(path)
    if found.get("renders"):
        raise ValueError(f"{path}: of --renders; expected of a comparison of single images")
    one, two = _path(path, found, "reference"), _path(path, found, "test")
    if one is None or two is None:
        raise _not_ours(path, "reference, test")
    roots = {"reference": (one, reference or one), "test": (two, test or two)}
    results = []
    for number, entry in enumerate(found["results"]):
        where = f"{path}: results[{number}]"
        if not isinstance(entry, dict) or entry.get("status") not in list(Status):
            raise _not_ours(where, "status")
        results.append(_result(where, entry, roots))
    return Results(roots["reference"][1], roots["test"][1], tuple(results))


def with_settings(found: Results, settings: Settings) -> Results:
    """The results with `settings`, of which the file says no more than whether values need be finite.

    ValueError for an image with a variance in a file of its own, of which the file has no digest.
    """
    for each in found.results:
        if each.status in FAILED and (each.how.variance or settings.of(each.name).reads_variance):
            raise ValueError(f"{each.name}: has a variance in a file of its own; expected accept without --from")
    kept = [replace(settings.of(each.name), options=each.how.options) for each in found.results]
    return replace(found, results=tuple(replace(each, how=how) for each, how in zip(found.results, kept, strict=True)))


def _not_ours(path: str | Path, what: str) -> ValueError:
    return ValueError(f"{path}: {what}; expected a file that mi-refract diff --json wrote")


def _document(path: str | Path) -> dict[str, Any]:
    try:
        found = json.loads(regular_file.read_bytes(path, MOST))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: no JSON ({error}); expected a file that mi-refract diff --json wrote") from None
    if not isinstance(found, dict) or not isinstance(found.get("results"), list):
        raise _not_ours(path, "no results")
    if found.get("schema") != SCHEMA:
        raise ValueError(f"{path}: schema {found.get('schema')!r}; expected {SCHEMA}")
    return found


def _path(where: str | Path, table: Table, key: str) -> Path | None:
    value = table.get(key)
    if value is not None and (not isinstance(value, str) or not value or "\0" in value):
        raise _not_ours(where, key)
    return None if value is None else Path(value)


def _result(where: str, entry: Table, roots: Mapping[str, tuple[Path, Path]]) -> Result:
    name, error, status = entry.get("name"), entry.get("error", ""), Status(entry["status"])
    if not isinstance(name, str) or not isinstance(error, str):
        raise _not_ours(where, "name, error")
    if status not in FAILED:
        return Result(name, status, None, None)
    one, two = (_moved(where, _path(where, entry, role), role, *roots[role]) for role in roots)
    target = _moved(where, _path(where, entry, "target"), "target", *roots["reference"])
    variants = _variants(where, entry, *roots["reference"])
    digests = _digests(where, entry, [one, two, *variants])
    result = Result(name, status, one, two, _how(entry), error=error)
    return replace(result, target=target, variants=tuple(variants), digests=digests)


def _how(entry: Table) -> ComparisonSpec:
    options = entry.get("options")
    nonfinite = isinstance(options, dict) and options.get("allow_nonfinite") is True
    return ComparisonSpec(options={"allow_nonfinite": nonfinite}, variance=str(entry.get("variance") or ""))


def _variants(where: str, entry: Table, before: Path, now: Path) -> list[Path]:
    listed = entry.get("variants", [])
    if not isinstance(listed, list):
        raise _not_ours(where, "variants")
    folder = (before.parent, now.parent) if entry.get("target") == str(before) else (before, now)  # of single files
    paths = (_path(where, {"variants": each}, "variants") for each in listed)
    return [moved for path in paths if (moved := _moved(where, path, "variants", *folder))]


def _moved(where: str, path: Path | None, key: str, before: Path, now: Path) -> Path | None:
    """The path of the file as one in `now`. ValueError where it leads out of it, by `..` or by a link to a folder."""
    if path is None:
        return None
    inside = path.relative_to(before) if path.is_relative_to(before) else None
    moved = now / inside if inside is not None else None
    if moved is None or not (moved == now or moved.parent.resolve().is_relative_to(now.resolve())):
        raise ValueError(f"{where}.{key}: {path}; expected a path in {before}")
    return moved


def _digests(where: str, entry: Table, paths: list[Path | None]) -> dict[Path, str] | None:
    given = entry.get("digests")
    if given is None:
        return None
    if not isinstance(given, dict) or not isinstance(given.get("variants"), list):
        raise _not_ours(where, "digests")
    words = [given.get("reference"), given.get("test"), *given["variants"]]
    if len(words) != len(paths) or not all(map(_is_digest, words)):
        raise _not_ours(where, "digests")
    return {path: word for path, word in zip(paths, words, strict=True) if path}


def _is_digest(word: Any) -> bool:
    return isinstance(word, str) and len(word) in (0, DIGEST) and set(word) <= set("0123456789abcdef")

"""Results for other programs: JUnit, GitHub's workflow commands and JSON; and reading that JSON, to accept its images.

The JSON's paths are mapped to two folders, which may differ from the compared ones: the JSON of a CI run can be used
with the new images that were downloaded from that run.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from mi_refract.io import safe_files
from mi_refract.io.reference_pack import Origin
from mi_refract.io.text import json_text, printable
from mi_refract.io.typed_table import convert, doc
from mi_refract.report import documents
from mi_refract.report.row import write_strict_json

from . import pairing, text_reports
from .results import FAILED, Category, Result, Results, Status
from .settings import ComparisonSpec, Settings

SCHEMA: Literal[1] = 1
MOST = 2**28  # bytes of a JSON file
OUTCOMES: dict[Status, Literal["", "failure", "error", "skipped"]] = {  # the words of JUnit
    Status.ERROR: "error",
    Status.DIFFERENT: "failure",
    Status.INCONCLUSIVE: "failure",
    Status.EQUAL: "",
    Status.SKIPPED: "skipped",
}
EXPECTED = "expected a file that mi-refract diff --json wrote"


# The JSON -----------------------------------------------------------------------------------------------------------

_PathText = Annotated[str, msgspec.Meta(min_length=1, pattern=r"^[^\0]*$")]
_Number = float | Literal["nan", "inf", "-inf"]  # strict JSON has no numbers for these


_Digest = Annotated[str, msgspec.Meta(pattern=r"^([0-9a-f]{64})?$"), doc("SHA-256; empty where there is no file")]


class Digests(msgspec.Struct):
    """The SHA-256 of the files of an image at the time of the comparison."""

    reference: _Digest
    test: _Digest
    variants: list[_Digest]


class MeasuredNumber(msgspec.Struct):
    """A number that the method measured; for equal images it is at most its bound, if it has one."""

    name: str
    value: _Number
    bound: _Number | None


class Entry(msgspec.Struct):
    """One image, or with --renders one pair of folders."""

    name: Annotated[str, doc("path of the new image in its folder")]
    status: Annotated[Status, doc("the verdict; error: could not be compared")]
    category: Annotated[Category, doc("change of the image between the folders; unknown without a verdict")]
    reason: str
    warning: Annotated[str, doc("bounds for warnings that an equal image exceeds, and remarks on its mask")]
    error: Annotated[str, doc("why the image could not be compared")]
    reference: Annotated[_PathText | None, doc("null: only among the new images")]
    test: Annotated[_PathText | None, doc("null: only among the references")]
    target: Annotated[_PathText, doc("path of the reference, which may not exist yet")]
    digests: Annotated[Digests | None, doc("null for an unreadable file and with --renders")]
    method: str
    method_why: Annotated[str, doc("why `auto` chose this method")]
    options: Annotated[dict[str, Any], doc("the options of the method that were set")]
    channels: Annotated[list[tuple[str, str]], doc("pairs [name in the reference, in the new image]; empty: all")]
    variance: Annotated[str, doc("template of the image that contains the variance")]
    mask: Annotated[str, doc("template of the mask")]
    ignore: Annotated[list[tuple[int, int, int, int]], doc("rectangles not compared: [x, y, width, height]")]
    why_so: Annotated[str, doc("`reason` in the settings")]
    entries: Annotated[list[str], doc("tables of the settings that apply")]
    matched: Annotated[_PathText | None, doc("the variant that the image is equal to")]
    variants: Annotated[list[_PathText], doc("variants: further references, by `accept` in the settings")]
    metrics: list[MeasuredNumber]
    minimum_detectable_difference: Annotated[_Number, doc("relative; nan if the method has none")]
    reproduce: Annotated[str, doc("the command that compares this image again")]
    accept: Annotated[str, doc("the command that makes the new image the reference")]


class Document(Origin, frozen=True, kw_only=True):
    """The JSON of `mi-refract diff --json`. Keys may be added without a change of the number `schema`."""

    schema: Literal[1]
    exit_code: Annotated[int, msgspec.Meta(ge=0, le=3), doc("exit code of the command")]
    sentence: Annotated[str, doc("the last line of the output")]
    reference: _PathText
    test: _PathText
    renders: Annotated[bool, doc("--renders: each folder contains renders of one image")]
    counts: Annotated[dict[Status, int], doc("number of images of each status")]
    results: list[Entry]


def json_schema() -> str:
    """Return the JSON Schema (draft 2020-12) of the JSON that `write` writes, as text."""
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema"} | msgspec.json.schema(Document)
    return json_text(schema, 1)


# Writing ------------------------------------------------------------------------------------------------------------


def write(results: Results, origin: Origin, junit: Path | None = None, data: Path | None = None) -> None:
    """Write JUnit's XML to `junit`, and the JSON to `data`. OSError if a file cannot be written.

    JUnit has a case for each image: "different" is a failure, "inconclusive" is one unless it passes by the option
    --inconclusive, and an image that could not be compared is an error; if all are skipped, that is one more. The JSON
    is a `Document`, with `origin`.
    """
    if data:
        document = Document(
            **msgspec.structs.asdict(origin),
            schema=SCHEMA,
            exit_code=results.exit_code,
            sentence=text_reports.sentence(results),
            reference=str(results.reference),
            test=str(results.test),
            renders=results.renders,
            counts={status: len(results.of(status)) for status in Status},
            results=[_json_entry(result, results) for result in results.results],
        )
        write_strict_json(data, msgspec.to_builtins(document))
    if junit:
        cases = [_junit_case(result, results) for result in results.results]
        if results.error:
            cases.append(documents.Case("", "all images", "error", results.error))
        documents.write_junit(junit, "mi-refract diff", {str(results.test): cases})


def write_github(results: Results, report: str = "", url: str = "") -> None:
    """Print a workflow command for each image that is not equal or has a warning, and append to the job's summary.

    `text_reports.markdown` with `report` and `url` is appended to the file $GITHUB_STEP_SUMMARY. OSError if it cannot
    be written.
    """
    if results.error:
        print(f"::error title=mi-refract diff::{results.error}")
    for result in results.results:
        if result.warning or result.status in FAILED:
            file, title = result.test or result.reference or result.name, f"{result.name}: {result.word}"
            file, title = (_escaped(x).replace(":", "%3A").replace(",", "%2C") for x in (file, title))
            level = "error" if _outcome(result, results) in ("failure", "error") else "warning"
            print(f"::{level} file={file},title={title}::{_escaped(text_reports.why(result))}")
    if path := os.environ.get("GITHUB_STEP_SUMMARY"):
        with safe_files.full_disk_names(path), Path(path).open("a", encoding="utf-8") as stream:
            stream.write(text_reports.markdown(results, report, url))


def _outcome(result: Result, results: Results) -> Literal["", "failure", "error", "skipped"]:
    """Return the outcome in the words of JUnit; "" if the image passes."""
    if result.status is Status.INCONCLUSIVE and results.inconclusive == "pass":
        return ""
    return OUTCOMES[result.status]


def _junit_case(result: Result, results: Results) -> documents.Case:
    outcome, reason, details, metrics = _outcome(result, results), text_reports.why(result), [], []
    if result.warning and not outcome:
        details.append(f"warning: {result.warning}")
    if failed := outcome in ("failure", "error"):
        commands = {"reproduce": results.reproduce(result), "accept": results.accept(result)}
        details += [f"{verb}: {line}" for verb, line in commands.items() if line]
        measured = result.comparison.metrics if result.comparison else ()
        metrics = [(metric.name, metric.value, metric.bound) for metric in measured]
    kind, message = result.word if failed else "", reason if outcome else ""
    return documents.Case(result.method, result.name, outcome, message, details, kind, metrics)


def _json_entry(result: Result, results: Results) -> Entry:
    comparison, how, digests = result.comparison, result.how, None
    if result.digests is not None:
        of_reference, of_test = (result.digests[path] if path else "" for path in (result.reference, result.test))
        digests = Digests(of_reference, of_test, [result.digests[path] for path in result.variants])
    reference, test, matched = (str(x) if x else None for x in (result.reference, result.test, result.matched))
    return Entry(
        name=result.name,
        status=result.status,
        category=result.category,
        reason=result.reason,
        warning=result.warning,
        error=result.error,
        reference=reference,
        test=test,
        target=str(result.target),
        digests=digests,
        method=result.method,
        method_why=comparison.chosen if comparison else "",
        options=dict(how.options),
        channels=list(how.channels),
        variance=how.variance,
        mask=how.mask,
        ignore=list(how.ignore),
        why_so=how.reason,
        entries=list(how.entries),
        matched=matched,
        variants=[str(path) for path in result.variants],
        metrics=[MeasuredNumber(**vars(metric)) for metric in comparison.metrics] if comparison else [],
        minimum_detectable_difference=comparison.minimum_detectable if comparison else math.nan,
        reproduce=results.reproduce(result),
        accept=results.accept(result),
    )


def _escaped(text: object) -> str:
    """Return the text escaped for a workflow command."""
    return printable(text).replace("%", "%25")


# Reading ------------------------------------------------------------------------------------------------------------


def read(path: str | Path, reference: Path | None = None, test: Path | None = None) -> Results:
    """Return the results in a JSON file; all have the path of their reference, those that are not equal all paths.

    `reference`, `test`: by default the paths in the file. ValueError for a file that `--json` did not write, of another
    version, written with `--renders`, or with a path outside of the two folders; OSError if it cannot be read.
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
    results = []
    for number, entry in enumerate(document.results):
        where = f"{path}: results[{number}]"
        without_target = entry.target == "."  # an invalid entry of the settings that matches no image
        target = Path() if without_target else _mapped_path(f"{where}.target", entry.target, before[0], now[0])
        # If two files were compared, the variants are beside the reference.
        roots = (before[0].parent, now[0].parent) if entry.target == str(before[0]) else (before[0], now[0])
        if entry.status not in FAILED:
            matched = _mapped_path(f"{where}.matched", entry.matched, *roots) if entry.matched else None
            results.append(Result(entry.name, entry.status, None, None, target=target, matched=matched))
            continue
        old_image = _mapped_path(f"{where}.reference", entry.reference, before[0], now[0]) if entry.reference else None
        new_image = _mapped_path(f"{where}.test", entry.test, before[1], now[1]) if entry.test else None
        variants = tuple(_mapped_path(f"{where}.variants", path, *roots) for path in entry.variants)
        digests = None
        if entry.digests is not None:
            if len(entry.digests.variants) != len(variants):
                count = f"{len(entry.digests.variants)} of {len(variants)} variants"
                raise ValueError(f"{where}.digests: {count}; {EXPECTED}")
            of_variants = zip(variants, entry.digests.variants, strict=True)
            by_file = [(old_image, entry.digests.reference), (new_image, entry.digests.test), *of_variants]
            digests = {file: digest for file, digest in by_file if file}
        options = {"allow_nonfinite": entry.options.get("allow_nonfinite") is True}
        how = ComparisonSpec(options=options, variance=entry.variance)
        result = Result(entry.name, entry.status, old_image, new_image, how, error=entry.error)
        results.append(replace(result, digests=digests, target=target, variants=variants))
    return Results(*now, tuple(results))


def _mapped_path(where: str, text: str, before: Path, now: Path) -> Path:
    """Return the path in the folder `now` instead of `before`. ValueError if `..` or a link leads out of the folder."""
    path = Path(text)
    moved = now / path.relative_to(before) if path.is_relative_to(before) else None
    if moved is None or not (moved == now or pairing.is_inside(moved, now)):
        raise ValueError(f"{where}: {path}; expected a path in {before}")
    return moved


def with_settings(results: Results, settings: Settings) -> Results:
    """Return the results with `settings`; of the settings in the JSON only `allow_nonfinite` is kept.

    ValueError for an image whose settings name a variance file, because the JSON has no digest of it.
    """
    updated = []
    for result in results.results:
        inside = result.target.is_relative_to(results.reference)
        target = result.target.relative_to(results.reference) if inside else Path()
        how = pairing.how_of(settings, result.name, target)
        if result.status in FAILED and (result.how.variance or how.variance):
            text = f"{result.name}: `variance` is set, and the JSON has no digest of such files"
            raise ValueError(f"{text}; accept it without --from")
        updated.append(replace(result, how=replace(how, options=result.how.options)))
    return replace(results, results=tuple(updated))

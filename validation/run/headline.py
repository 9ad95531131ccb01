"""The first page of the report: five questions about `refract`, answered from the rows of a run.

In: rows. Out: sentences with numbers, one image and one plot (`first_page`), for the report and the terminal. The
template of the sentences is `headline.j2` in this folder. Studies are referred to by name, without importing them.
"""

from __future__ import annotations

import math
import re
import statistics
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract.io.text import compact
from mi_refract.report.row import Row
from mi_refract.report.study_page import NOT_RUN, Answer, FirstPage, ShownRow, State

from . import metrics

DIRECTIONS, EVERYTHING, COMMON = "directions", "all regimes", "generic"
OURS, BUILTIN_FORMULA = ("compensated", "promoted"), "mi.fresnel + mi.refract"
GROUND_TRUTH, RENDERS, EFFICIENCY, PATHS = "ground_truth", "renders", "efficiency", "paths"
PLUGIN, BUILTIN, INTEGRATOR, METHODS = "refract", "dielectric", "refract_path", "every method"
SUMMARY = "matrix"  # a study that repeats rows of others
FORMULAS_IN = (DIRECTIONS, "sweep", "search")  # studies that judge all formulas
JUDGED = (*OURS, PLUGIN, f"{PLUGIN} − {BUILTIN}")  # subjects that judge `refract`, in any study
MIRAGE, EXACT, ROUNDED = "mirage", "exact", "exact, indices in float32"
LAYERS, SHALLOW = 1000, "89.55°"
INSTALL = "python -m validation renderers --install"
ABSENT = f"other renderers, by `{INSTALL} "  # the remedy of rows of a renderer that is not installed, without its name
NOT_MEASURED = "Not measured in this run"
LEAD = "`refract` is this project's drop-in replacement for Mitsuba's material of smooth glass, `dielectric`."
LINES = "its thin lines are right, light along a layer of air"
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
PLOTTED = {
    "path + dielectric": "dielectric",
    "path + refract": "refract",
    "refract_path": "refract + refract_path",
    "refract_path, split 3": "the same with split_depth 3",
}


def first_page(rows: Sequence[Row], profile: str = "") -> FirstPage:
    """Return questions and answers, an image of a scene in which the plugins differ, and a plot of error and time."""
    directions, renders, paths = (select(rows, study) for study in (DIRECTIONS, RENDERS, PATHS))
    ours = select(renders, subject=PLUGIN)
    own = [row for row in rows if row.study != SUMMARY]
    judged = [row for row in own if row.subject in JUDGED]
    facts = _directions(directions) | _renders(ours, select(rows, EFFICIENCY)) | _paths(rows, paths)
    broken = [name for name in OURS if any(row.verdict == "fail" for row in judged if row.subject == name)]
    facts |= {
        "bodies": select(rows, GROUND_TRUTH, PLUGIN, metric=metrics.ERROR_OVER_BOUND),
        "failed": any(row.verdict == "fail" for row in judged),
        "broken": broken,
        "ours": [name for name in facts["ours"] if name not in broken],
        "remedies": remedies(own),
        "count": len(own),
        "quick": profile == "quick",
    }
    questions: dict[str, tuple[str, Sequence[Row], str]] = {  # question, rows that decide the state, study to link to
        "right": ("Is `refract` right?", judged, DIRECTIONS),
        "trusted": (
            "How far can each formula be trusted?",
            [
                row
                for row in own
                if (row.study in FORMULAS_IN and row.subject != BUILTIN_FORMULA) or row.subject in OURS
            ],
            DIRECTIONS,
        ),
        "fast": ("Is it as fast as `dielectric`?", [], EFFICIENCY if facts["equal_time"] else RENDERS),
        "differ": (
            "Where do the two differ, and which is right there?",
            ours + select(paths, subject=PLUGIN),
            PATHS if facts["paths"] else RENDERS,
        ),
        "missing": ("What was not run, and what does it need?", [], NOT_RUN if facts["remedies"] else ""),
    }
    texts, answers, unmeasured = _texts(facts), list[Answer](), list[str]()
    for key, (question, evidence, study) in questions.items():
        verdicts = {row.verdict for row in evidence}
        state: State = "no" if "fail" in verdicts else "yes" if "pass" in verdicts else "plain"
        if texts[key]:
            answers.append({"question": question, "text": texts[key], "state": state, "study": study})
        else:
            unmeasured.append(question)
    if unmeasured:
        answers.append({"question": NOT_MEASURED, "text": " ".join(unmeasured), "state": "not measured", "study": ""})
    page: FirstPage = {"lead": LEAD, "answers": answers}
    if image := _image(ours, select(paths, PATHS, PLUGIN)):
        page["image"] = image
    if plot := _plot(rows):
        page["plot"] = plot
    return page


def select(
    rows: Sequence[Row], study: str = "", subject: str = "", case: str = "", metric: str = "", setting: str = ""
) -> list[Row]:
    """Return the rows with these fields; "" matches all rows, and `setting` may be a part of the row's setting."""
    fields = {name: x for name, x in (("study", study), ("subject", subject), ("case", case)) if x}
    candidates = (row for row in rows if setting in row.setting and (not metric or metric in row.values))
    return [row for row in candidates if all(getattr(row, name) == x for name, x in fields.items())]


def _texts(facts: dict[str, Any]) -> dict[str, str]:
    """Return the answer to each question; "" if nothing was measured."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(undefined=StrictUndefined)
    filters: dict[str, Any] = {"degrees": degrees, "percent": percent, "span": span}
    environment.filters |= filters | {"extract": lambda name, mapping: mapping[name]}
    template = environment.from_string(Path(__file__).with_suffix(".j2").read_text("utf-8"))
    names = {"plugin": PLUGIN, "builtin": BUILTIN, "integrator": INTEGRATOR, "rounded": ROUNDED, "layers": LAYERS}
    context = template.new_context(facts | names | {"shallow": SHALLOW, "m": metrics, "most": most, "rays": rays})
    texts = {name: "".join(block(context)) for name, block in template.blocks.items()}
    return {name: re.sub(r"[ \n]+", " ", text).strip() for name, text in texts.items()}  # keeps no-break spaces


def most(rows: Sequence[Row], metric: str) -> float:
    """Return the largest value of a metric that all rows have; NaN if a value is NaN."""
    return float(np.max([row.values[metric] for row in rows]))


def rays(rows: Sequence[Row]) -> int:
    """Return the largest number of rays of a row."""
    return max(int(row.replay.get("rays", 0)) for row in rows)


def _directions(rows: Sequence[Row]) -> dict[str, Any]:
    """Return facts on the formulas by precision, from LLVM if it ran, otherwise from CUDA or scalar arrays."""

    def overall(precision: str, case: str = EVERYTHING) -> dict[str, Row]:
        return {
            row.subject: row
            for kind in ("scalar", "cuda", "llvm")  # the last one wins
            for row in select(rows, case=case, metric=metrics.WORST_ANGLE, setting=f"{kind} {precision}")
        }

    both = {"single precision": overall("float32"), "double precision": overall("float64")}
    precisions = {name: formulas for name, formulas in both.items() if formulas}
    lowest: dict[str, Row] = next(iter(precisions.values()), {})
    common = overall("float32" if both["single precision"] else "float64", COMMON)
    textbook = [row for name, row in lowest.items() if name not in (*OURS, BUILTIN_FORMULA)]
    return {
        "best": [lowest[name] for name in OURS if name in lowest],
        "precisions": precisions,
        "ours": [name for name in OURS if precisions and all(name in formulas for formulas in precisions.values())],
        "textbook": textbook,
        "worst": max(textbook, key=lambda row: row.values[metrics.WORST_ANGLE], default=None),
        "common": [common[row.subject] for row in textbook if row.subject in common],
        "wrong": [100 * r.values[metrics.MISCLASSIFIED] / r.replay["rays"] for r in textbook if r.replay.get("rays")],
    }


def by_scene(methods: Sequence[Row], splits: bool) -> dict[str, float]:
    """Return by scene MSE × time of `refract_path` over the built-in's, without or with the best `split_depth`.

    The best is chosen at fewer samples: the least of several in the same rounds would be too small.
    """
    measured = {
        (row.case, row.subject): row.values[metrics.EQUAL_TIME] for row in select(methods, metric=metrics.EQUAL_TIME)
    }
    if not splits:
        return {case: value for (case, subject), value in measured.items() if subject == INTEGRATOR}
    best: dict[str, float] = {}
    for row in select(methods, subject=METHODS):
        split = [x for x in row.curves.items() if x[0].startswith(f"{INTEGRATOR}, split")]
        costs = {name: seconds * rmse**2 for name, (*_, (seconds, rmse), _) in split}
        if costs:
            best[row.case] = measured[row.case, min(costs, key=lambda name: costs[name])]
    return best


def equal_time(methods: Sequence[Row]) -> list[str]:
    """Return sentences on the smallest, the median and the largest value of `by_scene`."""
    sentences = []
    for splits, how in ((False, "without splitting"), (True, "with the `split_depth` that was best at fewer samples")):
        if values := [*by_scene(methods, splits).values()]:
            middle = f" (median of {len(values)} scenes: {statistics.median(values):.2f})" if len(values) > 1 else ""
            sentences.append(f"MSE × time of `{INTEGRATOR}` {how} is {span(values, 2)} of that of `path`{middle}.")
    return sentences


def _renders(ours: Sequence[Row], methods: Sequence[Row]) -> dict[str, Any]:
    """Return times and differences of `refract` and `dielectric`, and errors at equal time of `refract_path`."""
    times = [row.values[metrics.TIME_OVER_DIELECTRIC] for row in select(ours, metric=metrics.TIME_OVER_DIELECTRIC)]
    compared = select(ours, metric=metrics.CHANGED_SHARE)
    return {
        "times": times,
        "median": statistics.median(times) if times else 0.0,
        "equal_time": equal_time(methods),
        "same": [row for row in compared if not differ(row)],
        "differing": [row for row in compared if differ(row)],
    }


def differ(row: Row) -> bool:
    """Return whether the images of a row differ by more than noise, or a check of the row failed."""
    return row.verdict == "fail" or bool(row.values.get(metrics.WELCH_ALARMS))


def _paths(rows: Sequence[Row], traced: Sequence[Row]) -> dict[str, Any]:
    """Return the lost light paths in the mirage, and errors after a thousand layers of air."""
    mirage = {row.subject: row for row in select(traced, case=f"{MIRAGE}: path", metric=metrics.WRONG_PATH)}
    contrasts, indices = (
        select(rows, case=f"mirage askew, {LAYERS} layers, {kind}", metric=SHALLOW) for kind in ("contrasts", "indices")
    )
    return {
        "paths": [mirage[PLUGIN]] if {PLUGIN, BUILTIN} <= mirage.keys() else [],
        "lost": {ROUNDED: 0.0} | {name: row.values[metrics.WRONG_PATH] for name, row in mirage.items()},
        "shallow_ours": [row.values[SHALLOW] for row in contrasts if row.subject in OURS],
        "shallow_theirs": [row.values[SHALLOW] for row in indices if row.subject == BUILTIN_FORMULA],
    }


def remedies(rows: Sequence[Row]) -> dict[str, int]:
    """Return the number of rows that were not run by their remedy, largest first; "" for other reasons, last."""
    missing = [row for row in rows if row.verdict == "not run"]
    counts = Counter(row.remedy for row in missing)
    installs = [name for name in counts if name.startswith(ABSENT)]
    if installs:
        names = sorted({name.removeprefix(ABSENT).rstrip("`") for name in installs})
        counts[f"{ABSENT}{','.join(names)}`"] = sum(counts.pop(name) for name in installs)
    others = counts.pop("", 0)
    return dict(counts.most_common()) | ({"": others} if others else {})


def _image(ours: Sequence[Row], paths: Sequence[Row]) -> ShownRow | None:
    """Return the image of both plugins and exact paths, otherwise of the scene in which the plugins differ most."""
    for row in (row for row in paths if EXACT in row.images):
        off, builtin_off = (row.values[metric] for metric in (metrics.OFF_EXACT, metrics.BUILTIN_OFF_EXACT))
        shares = f"{percent(builtin_off)} of the pixels of `{BUILTIN}` are wrong, {percent(off)} of those of `{PLUGIN}`"
        labels = {"reference": BUILTIN, "test": PLUGIN, EXACT: "exact paths"}
        lines = "" if row.verdict == "fail" else f"; {LINES}"
        caption = f"Scene `{MIRAGE}`: beside exact paths, {shares}{lines}."
        return {"row": row.name, "labels": labels, "caption": caption}
    pairs = [row for row in ours if {"reference", "test"} <= row.images.keys()]
    if not pairs:
        return None
    row = max(pairs, key=lambda row: (row.verdict == "fail", row.values.get(metrics.WELCH_ALARMS, 0)))
    text = "the two differ" if differ(row) else "the same up to noise"
    labels = {"reference": BUILTIN, "test": PLUGIN}
    return {"row": row.name, "labels": labels, "caption": f"Scene `{row.case}`: {text}."}


def _plot(rows: Sequence[Row]) -> ShownRow | None:
    """Return the plot of error against time, of all methods in the scene of median gain or of the two plugins."""
    gains = by_scene(select(rows, EFFICIENCY), splits=True)
    median = sorted(gains, key=lambda scene: gains[scene])[len(gains) // 2] if gains else ""
    choices = ((EFFICIENCY, METHODS, PLOTTED, False), (RENDERS, PLUGIN, {BUILTIN: BUILTIN, PLUGIN: PLUGIN}, True))
    for study, subject, labels, both in choices:
        for row in select(rows, study, subject, "" if both else median):
            shown = {name: label for name, label in labels.items() if name in row.curves}
            if row.curves if not both else len(shown) == len(labels):
                caption = f"Error against time, scene `{row.case}`: lower and further left is better."
                axes = {"x": "seconds", "y": "error (RMSE)"}
                return {"row": row.name, "labels": shown, "axes": axes, "caption": caption}
    return None


def degrees(radians: float) -> str:
    """Return an angle in degrees: 90°, 1.9 × 10⁻⁴°."""
    mantissa, _, exponent = compact(math.degrees(radians), 2).partition("e")
    power = f"\N{NO-BREAK SPACE}×\N{NO-BREAK SPACE}10{exponent.translate(SUPERSCRIPTS)}" if exponent else ""
    return f"{mantissa}{power}°"


def percent(share: float) -> str:
    """Return a share in percent, in plain digits: 6.5 %, 0.00022 %."""
    value = 100 * share
    digits = max(1 - math.floor(math.log10(value)), 0) if 0 < value < 10 else 0
    return f"{value:.{digits}f} %"


def span(values: Sequence[float], digits: int) -> str:
    """Return the smallest and the largest value: 0.97 to 1.10."""
    return " to ".join(dict.fromkeys(f"{value:.{digits}f}" for value in (min(values), max(values))))

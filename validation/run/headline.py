"""The first screen of the report: five questions about `refract`, answered from the rows of a run.

In: rows. Out: sentences with numbers, one image and one plot (`first_page`), for the report and the terminal. The
sentences are in `headline.j2`, beside this file. Studies are named without importing them.
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
MIRAGE, EXACT, ROUNDED = "mirage", "exact", "exact, indices in float32"
LAYERS, SHALLOW = 1000, "89.55°"
INSTALL = "other renderers, by `python -m validation renderers --install "
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
    """The questions and their answers, the images of the scene in which the plugins differ, and error against time."""
    directions, renders, paths = (select(rows, study) for study in (DIRECTIONS, RENDERS, PATHS))
    ours = select(renders, subject=PLUGIN)
    judged = [row for row in (*directions, *select(rows, GROUND_TRUTH)) if row.subject in (*OURS, PLUGIN)]
    facts = _directions(directions) | _renders(ours, select(rows, EFFICIENCY)) | _paths(rows, paths)
    facts |= {
        "bodies": select(rows, GROUND_TRUTH, PLUGIN, metric=metrics.ERROR_OVER_BOUND),
        "failed": any(row.verdict == "fail" for row in judged),
        "remedies": remedies(rows),
        "count": len(rows),
        "quick": profile == "quick",
    }
    questions: dict[str, tuple[str, Sequence[Row], str]] = {  # the rows that decide the state, and the study to link to
        "right": ("Is `refract` right?", judged, DIRECTIONS),
        "trusted": (
            "How far can each formula be trusted?",
            [row for row in directions if row.subject != BUILTIN_FORMULA],
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
    """The rows that have all of these, where not ""; `setting` is a part of theirs."""
    asked = {name: x for name, x in (("study", study), ("subject", subject), ("case", case)) if x}
    chosen = (row for row in rows if setting in row.setting and (not metric or metric in row.values))
    return [row for row in chosen if all(getattr(row, name) == x for name, x in asked.items())]


def _texts(facts: dict[str, Any]) -> dict[str, str]:
    """The answer to each question; "" where nothing was measured."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(undefined=StrictUndefined)
    filters: dict[str, Any] = {"degrees": degrees, "percent": percent, "span": span}
    environment.filters |= filters | {"extract": lambda name, mapping: mapping[name]}
    template = environment.from_string(Path(__file__).with_suffix(".j2").read_text("utf-8"))
    names = {"plugin": PLUGIN, "builtin": BUILTIN, "integrator": INTEGRATOR, "rounded": ROUNDED, "layers": LAYERS}
    context = template.new_context(facts | names | {"shallow": SHALLOW, "m": metrics, "most": most, "rays": rays})
    texts = {name: "".join(block(context)) for name, block in template.blocks.items()}
    return {name: re.sub(r"[ \n]+", " ", text).strip() for name, text in texts.items()}  # not the no-break space


def most(rows: Sequence[Row], metric: str) -> float:
    """The largest value of a metric that all rows have; NaN where one of them is."""
    return float(np.max([row.values[metric] for row in rows]))


def rays(rows: Sequence[Row]) -> int:
    """The largest number of rays that a row was measured with."""
    return max(int(row.replay.get("rays", 0)) for row in rows)


def _directions(rows: Sequence[Row]) -> dict[str, Any]:
    """Rows of the formulas by precision, on LLVM where it ran, else on CUDA, else on scalars."""

    def overall(precision: str, case: str = EVERYTHING) -> dict[str, Row]:
        return {
            row.subject: row
            for kind in ("scalar", "cuda", "llvm")  # the last one wins
            for row in select(rows, case=case, metric=metrics.WORST_ANGLE, setting=f"{kind} {precision}")
        }

    every = {"single precision": overall("float32"), "double precision": overall("float64")}
    precisions = {name: formulas for name, formulas in every.items() if formulas}
    narrowest: dict[str, Row] = next(iter(precisions.values()), {})
    common = overall("float32" if every["single precision"] else "float64", COMMON)
    textbook = [row for name, row in narrowest.items() if name not in (*OURS, BUILTIN_FORMULA)]
    return {
        "best": [narrowest[name] for name in OURS if name in narrowest],
        "precisions": precisions,
        "ours": [name for name in OURS if precisions and all(name in each for each in precisions.values())],
        "textbook": textbook,
        "worst": max(textbook, key=lambda row: row.values[metrics.WORST_ANGLE], default=None),
        "common": [common[row.subject] for row in textbook if row.subject in common],
        "wrong": [100 * r.values[metrics.MISCLASSIFIED] / r.replay["rays"] for r in textbook if r.replay.get("rays")],
    }


def by_scene(methods: Sequence[Row], splits: bool) -> dict[str, float]:
    """MSE × time of `refract_path` over the built-in's: as it is, or at the best `split_depth` of each scene."""
    best: dict[str, float] = {}
    for row in select(methods, metric=metrics.EQUAL_TIME):
        if row.subject.startswith(f"{INTEGRATOR}, split") if splits else row.subject == INTEGRATOR:
            best[row.case] = min(best.get(row.case, math.inf), row.values[metrics.EQUAL_TIME])
    return best


def equal_time(methods: Sequence[Row]) -> list[str]:
    """Sentences about all scenes: the smallest, the median and the largest of `by_scene`."""
    sentences = []
    for splits, how in ((False, "without splitting"), (True, "with the best `split_depth` of each scene")):
        if values := [*by_scene(methods, splits).values()]:
            middle = f" (median of {len(values)} scenes: {statistics.median(values):.2f})" if len(values) > 1 else ""
            sentences.append(f"MSE × time of `{INTEGRATOR}` {how} is {span(values, 2)} of that of `path`{middle}.")
    return sentences


def _renders(ours: Sequence[Row], methods: Sequence[Row]) -> dict[str, Any]:
    """Times and differences of `refract` and `dielectric`; errors at equal time of `refract_path`."""
    times = [row.values[metrics.TIME_OVER_DIELECTRIC] for row in select(ours, metric=metrics.TIME_OVER_DIELECTRIC)]
    compared = select(ours, metric=metrics.CHANGED_SHARE)
    return {
        "times": times,
        "median": statistics.median(times) if times else 0.0,
        "equal_time": equal_time(methods),
        "same": [row for row in compared if not row.values.get(metrics.WELCH_ALARMS)],
        "differing": [row for row in compared if row.values.get(metrics.WELCH_ALARMS)],
    }


def _paths(rows: Sequence[Row], traced: Sequence[Row]) -> dict[str, Any]:
    """Light paths lost in the mirage, or errors after a thousand layers of air."""
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
    """How many rows were not run, by what would make them run, most first; "" for other reasons, last."""
    missing = [row for row in rows if row.verdict == "not run"]
    counts = Counter(row.remedy for row in missing)
    installs = [name for name in counts if name.startswith(INSTALL)]
    if installs:
        names = sorted({name.removeprefix(INSTALL).rstrip("`") for name in installs})
        counts[f"{INSTALL}{','.join(names)}`"] = sum(counts.pop(name) for name in installs)
    others = counts.pop("", 0)
    return dict(counts.most_common()) | ({"": others} if others else {})


def _image(ours: Sequence[Row], paths: Sequence[Row]) -> ShownRow | None:
    """The two plugins beside exact paths; else the scene in which the plugins differ most, else the first one."""
    for row in (row for row in paths if EXACT in row.images):
        off, builtin_off = (percent(row.values[metric]) for metric in (metrics.OFF_EXACT, metrics.BUILTIN_OFF_EXACT))
        said = f"beside exact paths, {builtin_off} of the pixels of `{BUILTIN}` are wrong, {off} of those of `{PLUGIN}`"
        labels = {"reference": BUILTIN, "test": PLUGIN, EXACT: "exact paths"}
        return {"row": row.name, "labels": labels, "caption": f"Scene `{MIRAGE}`: {said}; {LINES}."}
    pairs = [row for row in ours if {"reference", "test"} <= row.images.keys()]
    if not pairs:
        return None
    row = max(pairs, key=lambda row: row.values.get(metrics.WELCH_ALARMS, 0))
    said = "the two differ" if row.values.get(metrics.WELCH_ALARMS) else "the same up to noise"
    if row.case == MIRAGE and row.values.get(metrics.WELCH_ALARMS):
        said = f"`{PLUGIN}` keeps the edges that `{BUILTIN}` breaks into stairs; {LINES}"
    labels = {"reference": BUILTIN, "test": PLUGIN}
    return {"row": row.name, "labels": labels, "caption": f"Scene `{row.case}`: {said}."}


def _plot(rows: Sequence[Row]) -> ShownRow | None:
    """Error against time of the methods, in the scene of median gain; else of the two plugins, in the first scene."""
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
    """An angle in degrees: 90°, 1.9 × 10⁻⁴°."""
    mantissa, _, exponent = compact(math.degrees(radians), 2).partition("e")
    power = f"\N{NO-BREAK SPACE}×\N{NO-BREAK SPACE}10{exponent.translate(SUPERSCRIPTS)}" if exponent else ""
    return f"{mantissa}{power}°"


def percent(share: float) -> str:
    """A share in percent, small ones in plain digits: 6.5 %, 0.00022 %."""
    value = 100 * share
    digits = max(1 - math.floor(math.log10(value)), 0) if 0 < value < 10 else 0
    return f"{value:.{digits}f} %"


def span(values: Sequence[float], digits: int) -> str:
    """The smallest and the largest: 0.97 to 1.10."""
    return " to ".join(dict.fromkeys(f"{value:.{digits}f}" for value in (min(values), max(values))))

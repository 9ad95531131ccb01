"""The first screen of the report: five questions about `refract`, answered from the rows of a run.

In: rows. Out: sentences with numbers, one image and one plot (`first_page`), for the report and the terminal. What the
run did not measure gets the sentence "Not measured in this run."
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence

from mi_refract.report.first_page import NOT_RUN, Answer, FirstPage, ShownImage, ShownPlot, not_run
from mi_refract.report.number_text import compact
from mi_refract.report.row import Row

from .metrics import (
    CHANGED_SHARE,
    EQUAL_TIME,
    ERROR_OVER_BOUND,
    MEANS_DIFFER,
    MISCLASSIFIED,
    MISCLASSIFIED_FAR,
    WELCH_ALARMS,
    WORST_ANGLE,
    WORST_IN_U,
    WRONG_PATH,
)

# Names of studies, cases and metrics that the sentences are made of; studies are named without importing them.
DIRECTIONS, EVERYTHING, COMMON, SINGLE, DOUBLE = "directions", "all regimes", "generic", "float32", "float64"
OURS, BUILTIN_FORMULA = ("compensated", "promoted"), "mi.fresnel + mi.refract"
GROUND_TRUTH, RENDERS, EFFICIENCY, PATHS = "ground_truth", "renders", "efficiency", "paths"
PLUGIN, BUILTIN, INTEGRATOR, METHODS = "refract", "dielectric", "refract_path", "every method"
TIME = "time / dielectric"
MIRAGE, ROUNDED = "mirage", "exact, indices in float32"
LAYERS, SHALLOW = 1000, "89.55°"
INDICES, CONTRASTS = (f"mirage askew, {LAYERS} layers, {given}" for given in ("indices", "contrasts"))
RENDERERS, QUICK = "other renderers", "quick"
INSTALL = "python -m validation renderers --install "
NOT_MEASURED = "Not measured in this run."
LEAD = "`refract` is this project's drop-in replacement for Mitsuba's material of smooth glass, `dielectric`."
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
# What would bring the rows whose reason says so.
REMEDIES = {
    "no NVIDIA driver": "an NVIDIA GPU with its driver",
    "left out: the profile": "`--profile full`",
    "in the full profile only": "`--profile full`",
    INSTALL: RENDERERS,
}

PLOTTED = {
    "path + dielectric": "dielectric",
    "path + refract": "refract",
    "refract_path": "refract + refract_path",
    "refract_path, split 3": "the same with split_depth 3",
}


def first_page(rows: Sequence[Row], profile: str = "") -> FirstPage:
    """The questions and their answers, the images of the scene in which the plugins differ, and error against time."""
    page: FirstPage = {
        "lead": LEAD,
        "answers": [_right(rows), _trusted(rows), _fast(rows), _differ(rows), _missing(rows, profile)],
    }
    if image := _image(rows):
        page["image"] = image
    if plot := _plot(rows):
        page["plot"] = plot
    return page


def _answer(question: str, text: str, rows: Iterable[Row], study: str) -> Answer:
    """`rows` are the evidence for the answer: their verdicts determine its state."""
    verdicts = {row.verdict for row in rows if row.values}
    state = "no" if "fail" in verdicts else "yes" if "pass" in verdicts else "plain"
    return {
        "question": question,
        "text": text or NOT_MEASURED,
        "state": state if text else "not measured",
        "study": study,
    }


def _overall(rows: Sequence[Row], precision: str, case: str = EVERYTHING) -> dict[str, Row]:
    """The row of each formula over one case in one precision: of LLVM where it ran, else of CUDA, else of scalars."""
    found: dict[str, Row] = {}
    for kind in ("llvm", "cuda", "scalar"):
        for row in rows:
            if (row.study, row.case, row.setting) == (
                DIRECTIONS,
                case,
                f"{kind} {precision}",
            ) and WORST_ANGLE in row.values:
                found.setdefault(row.subject, row)
    return found


def _right(rows: Sequence[Row]) -> Answer:
    question = "Is `refract` right?"
    measured = [row for row in rows if row.study in (DIRECTIONS, GROUND_TRUTH) and row.subject in (*OURS, PLUGIN)]
    sentences = []
    overall = _overall(rows, SINGLE) or _overall(rows, DOUBLE)
    if best := [overall[name] for name in OURS if name in overall]:
        sentences.append(_direction_sentence(best))
    truth = [
        row for row in rows if row.study == GROUND_TRUTH and row.subject == PLUGIN and ERROR_OVER_BOUND in row.values
    ]
    if truth:
        bodies = len({row.case for row in truth})
        kept = all(row.values[ERROR_OVER_BOUND] <= 1 for row in truth)
        stay = "all its rays stay within" if kept else "some of its rays leave"
        sentences.append(
            f"Through {bodies} bodies with a known answer, from a prism to a camera lens, {stay} their error bounds."
        )
    if sentences:
        sentences.insert(0, "No: a check failed." if any(row.verdict == "fail" for row in measured) else "Yes.")
    return _answer(question, " ".join(sentences), measured, DIRECTIONS)


def _direction_sentence(best: Sequence[Row]) -> str:
    rays = max(row.replay.get("rays", 0) for row in best)
    angle, roundoffs = (max(row.values[metric] for row in best) for metric in (WORST_ANGLE, WORST_IN_U))
    misclassified, far = (max(row.values[metric] for row in best) for metric in (MISCLASSIFIED, MISCLASSIFIED_FAR))
    rounding = ", no more than rounding the exact answer costs" if roundoffs <= 1 else ""
    among = f"Over {rays:,} rays, the hardest known among them"
    sentence = f"{among}, its direction is off by at most {_degrees(angle)}{rounding}."
    if far:
        return f"{sentence} It mistakes total internal reflection on {far:.0f} of them."
    close = f", but for {misclassified:.0f} too close to the critical angle to tell" if misclassified else ""
    return f"{sentence} Total internal reflection is decided rightly on all{close}."


def _trusted(rows: Sequence[Row]) -> Answer:
    single, double = _overall(rows, SINGLE), _overall(rows, DOUBLE)
    measured = [row for row in rows if row.study == DIRECTIONS and row.subject != BUILTIN_FORMULA]
    sentences = []
    found = {name: each for name, each in (("single precision", single), ("double precision", double)) if each}
    ours = [name for name in OURS if found and all(name in each for each in found.values())]
    if ours:
        names = " and ".join(f"`{name}`" for name in ours)
        worst = {name: max(each[formula].values[WORST_ANGLE] for formula in ours) for name, each in found.items()}
        ends = " and ".join(f"to {_degrees(angle)} in {name}" for name, angle in worst.items())
        sentences.append(f"{names}, which are this project's own, everywhere: {ends}.")
    precision, measured_in = (SINGLE, single) if single else (DOUBLE, double)
    textbook = [row for name, row in measured_in.items() if name not in (*OURS, BUILTIN_FORMULA)]
    if textbook:
        sentences.append(_textbook_sentence(textbook, _overall(rows, precision, COMMON)))
    return _answer("How far can each formula be trusted?", " ".join(sentences), measured, DIRECTIONS)


def _textbook_sentence(textbook: Sequence[Row], common: dict[str, Row]) -> str:
    """How far the documented formulas are off for glass at common angles, and on the hard rays."""
    usual = [common[row.subject].values[WORST_ANGLE] for row in textbook if row.subject in common]
    worst = max(textbook, key=lambda row: row.values[WORST_ANGLE])
    wrong = [100 * row.values[MISCLASSIFIED] / row.replay["rays"] for row in textbook if row.replay.get("rays")]
    good = f"are good to {_degrees(max(usual))} for glass at common angles, but " if usual else ""
    sentence = f"The {len(textbook)} textbook formulas {good}err by up to {_degrees(worst.values[WORST_ANGLE])}"
    sentence += f" (`{worst.subject}`) on rays made to be hard"
    mistaken = f", and mistake total internal reflection on {_ends(wrong, 0)} % of these" if wrong else ""
    return f"{sentence}{mistaken}."


def _fast(rows: Sequence[Row]) -> Answer:
    times = [row.values[TIME] for row in rows if row.study == RENDERS and row.subject == PLUGIN and TIME in row.values]
    sentences = []
    if times:
        sentences.append(_time_sentence(times))
    best: dict[str, float] = {}
    for row in rows:
        if row.study == EFFICIENCY and row.subject.startswith(INTEGRATOR) and EQUAL_TIME in row.values:
            best[row.case] = min(best.get(row.case, math.inf), row.values[EQUAL_TIME])
    if best:
        each = " and ".join(f"{_percent(share)} (`{scene}`)" for scene, share in list(best.items())[:3])
        sentences.append(f"With the integrator `{INTEGRATOR}`, the same error takes {each} of the built-in's time.")
    return _answer("Is it as fast as `dielectric`?", " ".join(sentences), (), EFFICIENCY if best else RENDERS)


def _time_sentence(times: Sequence[float]) -> str:
    middle = statistics.median(times)
    if middle > 2:  # only where nothing compiles it
        advice = "as a plugin written in Python does in scalar variants: use a compiled one"
        return f"A render takes {_ends(times, 0)} times as long, {advice}."
    faster = f"{_percent(abs(middle - 1))} {'slower' if middle > 1 else 'faster'}"
    return f"In the median of {len(times)} scenes it is {faster}: a render takes {_ends(times, 2)} times as long."


def _differ(rows: Sequence[Row]) -> Answer:
    compared = [row for row in rows if row.study == RENDERS and row.subject == PLUGIN and CHANGED_SHARE in row.values]
    differing = [row for row in compared if row.values.get(WELCH_ALARMS)]
    sentences = []
    if same := [row for row in compared if row not in differing]:
        most = _percent(max(row.values[MEANS_DIFFER] for row in same))
        nowhere = f"In {len(same)} of {len(compared)} scenes nowhere"
        sentences.append(
            f"{nowhere}: the means of the images differ by at most {most}, and no part differs beyond noise."
        )
    sentences += [f"In `{row.case}`, {_percent(row.values[CHANGED_SHARE])} of the pixels change." for row in differing]
    paths = {row.subject: row for row in rows if row.study == PATHS and row.case == f"{MIRAGE}: path" and row.values}
    if PLUGIN in paths and BUILTIN in paths:
        sentences.append(_paths_sentence(paths))
    elif layers := _layers_sentence(rows):
        sentences.append(layers)
    judging = [row for row in rows if row.study in (RENDERS, PATHS) and row.subject == PLUGIN]
    study = PATHS if paths else RENDERS
    return _answer("Where do the two differ, and which is right there?", " ".join(sentences), judging, study)


def _paths_sentence(paths: dict[str, Row]) -> str:
    """How many light paths through the mirage each plugin loses."""
    lost = {name: row.values[WRONG_PATH] for name, row in paths.items()}
    count = paths[PLUGIN].replay.get("rays", 0)
    right = (
        f"loses {lost[PLUGIN]:.0f} of {count} light paths" if lost[PLUGIN] else f"follows all {count} exact light paths"
    )
    rounded = lost.get(ROUNDED)
    why = (
        f". With indices rounded as `{BUILTIN}` rounds them, even exact arithmetic loses {rounded:.0f}"
        if rounded
        else ""
    )
    return f"There `{PLUGIN}` {right}; `{BUILTIN}` loses {lost[BUILTIN]:.0f}{why}."


def _layers_sentence(rows: Sequence[Row]) -> str:
    """The error after a thousand thin layers of air, with the inputs that each plugin gets; "" where not measured."""
    ours, theirs = (
        [row.values[SHALLOW] for row in rows if row.case == case and row.subject in subjects and SHALLOW in row.values]
        for case, subjects in ((CONTRASTS, OURS), (INDICES, (BUILTIN_FORMULA,)))
    )
    if not ours or not theirs:
        return ""
    off = f"the formulas of `{PLUGIN}` are off by {_percent(max(ours))}, Mitsuba's by {_percent(max(theirs))}"
    return f"After {LAYERS} thin layers of air, entered at {SHALLOW}, {off}."


def _missing(rows: Sequence[Row], profile: str) -> Answer:
    question = "What was not run, and what would bring it?"
    groups = not_run(rows)
    more = (
        f" The profile `{QUICK}` leaves studies out; `--profile standard` runs every study." if profile == QUICK else ""
    )
    if not groups:
        text = more.strip() or "Everything was run."
        return {"question": question, "text": text, "state": "plain", "study": ""}
    counts: dict[str, int] = {}
    renderers = []
    for reason, found in groups.items():
        if reason.startswith(INSTALL):
            renderers.append(reason.removeprefix(INSTALL))
        remedy = next((words for part, words in REMEDIES.items() if part in reason), "")
        counts[remedy] = counts.get(remedy, 0) + len(found)
    others = counts.pop("", 0)
    parts = [f"{number} need {remedy}" for remedy, number in sorted(counts.items(), key=lambda item: -item[1])]
    parts += [f"{others} have other reasons"] if others else []
    text = f"{sum(map(len, groups.values())):,} of {len(rows):,} measurements: {'; '.join(parts)}."
    text = text.replace(RENDERERS, f"{RENDERERS}, by `{INSTALL}{','.join(sorted(renderers))}`")
    return {"question": question, "text": text + more, "state": "plain", "study": NOT_RUN}


def _image(rows: Sequence[Row]) -> ShownImage | None:
    """The scene in which the plugins differ most, else the first one."""
    pairs = [r for r in rows if r.study == RENDERS and r.subject == PLUGIN and {"reference", "test"} <= r.images.keys()]
    if not pairs:
        return None
    row = max(pairs, key=lambda each: each.values.get(WELCH_ALARMS, 0))
    said = "the two differ" if row.values.get(WELCH_ALARMS) else "the same up to noise"
    if row.case == MIRAGE and row.values.get(WELCH_ALARMS):
        said = f"`{PLUGIN}` keeps the edges that `{BUILTIN}` breaks into stairs"
    labels = {"reference": BUILTIN, "test": PLUGIN}
    return {"row": row.name, "labels": labels, "caption": f"Scene `{row.case}`: {said}."}


def _plot(rows: Sequence[Row]) -> ShownPlot | None:
    """Error against time of the methods, else of the two plugins, in the first scene that has it."""
    axes = {"x": "seconds", "y": "error (RMSE)"}
    for row in rows:
        if (row.study, row.subject) == (EFFICIENCY, METHODS) and row.curves:
            labels = {name: label for name, label in PLOTTED.items() if name in row.curves}
            caption = f"Error against time, scene `{row.case}`: lower and further left is better."
            return {"row": row.name, "labels": labels, "axes": axes, "caption": caption}
    for row in rows:
        if (row.study, row.subject) == (RENDERS, PLUGIN) and {PLUGIN, BUILTIN} <= row.curves.keys():
            caption = f"Error against time, scene `{row.case}`: lower and further left is better."
            return {"row": row.name, "labels": {BUILTIN: BUILTIN, PLUGIN: PLUGIN}, "axes": axes, "caption": caption}
    return None


def _degrees(radians: float) -> str:
    """An angle in degrees: 90°, 1.9 × 10⁻⁴°."""
    mantissa, _, exponent = compact(math.degrees(radians), 2).partition("e")
    return (
        f"{mantissa}\N{NO-BREAK SPACE}×\N{NO-BREAK SPACE}10{exponent.translate(SUPERSCRIPTS)}°"
        if exponent
        else f"{mantissa}°"
    )


def _percent(share: float) -> str:
    """A share in percent, as small ones in plain digits: 6.5 %, 0.00022 %."""
    value = 100 * share
    digits = max(1 - math.floor(math.log10(value)), 0) if 0 < value < 10 else 0
    return f"{value:.{digits}f} %"


def _ends(values: Sequence[float], digits: int) -> str:
    """The smallest and the largest: 0.97 to 1.10."""
    return " to ".join(dict.fromkeys(f"{value:.{digits}f}" for value in (min(values), max(values))))

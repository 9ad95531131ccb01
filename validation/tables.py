"""Writes the tables of the documentation and the image galleries from the rows of one run.

Rows are selected by the constants of the studies, so a removed study or metric fails at import, not after the run.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from mi_refract.formulas import FORMULAS
from mi_refract.image_diff import self_test
from mi_refract.image_diff.methods import METHODS as COMPARISONS
from mi_refract.io import image_file
from mi_refract.io.image_file import srgb_encode
from mi_refract.io.safe_files import update_between, write_atomically
from mi_refract.io.text import compact
from mi_refract.plugins import PLUGIN
from mi_refract.ray_sets.header import PRECISIONS
from mi_refract.regimes import REGIMES
from mi_refract.report.embedded_images import png
from mi_refract.report.row import Row
from validation import repeated
from validation.diff import visible_changes
from validation.directions import per_formula
from validation.efficiency import caustics, changing_indices, chosen_settings, error_against_time
from validation.ground_truth import standard_numbers
from validation.planar import against_retrace
from validation.planar import times as planar_times
from validation.reference.standard_numbers import NUMBERS
from validation.renders import against_dielectric, colours, gradients, samplers, thin_panes
from validation.run import headline
from validation.run import metrics as m
from validation.run.array_settings import PLAIN
from validation.run.context import SCENES, Context
from validation.run.render_methods import BUILTIN, FROM_LAMPS
from validation.stability import layered_paths
from validation.suite import caustic_energies, matrix
from validation.suite import standard_numbers as numbers_by_others

ROOT = SCENES.parent
GALLERY, CAUSTICS = SCENES / "gallery.png", SCENES / "caustics.png"
PAGES = ".github/docs/explanation"
NUMBERS_PAGE = ".github/docs/reference/standard-numbers.md"


class Table(NamedTuple):
    """A table of the file `path`, between its markers. `study`: the command-line name of what measures it.

    `make` returns the Markdown; None if the table stays as it is, because it needs another machine. It raises
    ValueError, one line, if the rows lack what the table needs.
    """

    path: str
    study: str
    make: Callable[[list[Row]], str | None]


def check(studies: list[str]) -> None:
    """Raise ValueError, one line, if a file or a marker of the tables of these studies is missing."""
    for marker, table in chosen(studies).items():
        path = ROOT / table.path
        text = path.read_text() if path.is_file() else ""
        begin, end = f"<!-- begin: {marker} -->", f"<!-- end: {marker} -->"
        if begin not in text or end not in text:
            raise ValueError(f"{path}: no markers '{begin}' and '{end}' for its table")


def chosen(studies: list[str]) -> dict[str, Table]:
    """Return the tables of these studies or parts; without any, all tables except those of other renderers."""
    if not studies:
        return {name: table for name, table in TABLES.items() if not table.study.startswith("suite")}
    return {name: t for name, t in TABLES.items() if any(f"{t.study}.".startswith(f"{study}.") for study in studies)}


def write(rows: list[Row], context: Context, studies: list[str]) -> None:
    """Write the tables of the studies that were run, and the galleries if their scenes were rendered.

    ValueError if a marker is missing, or if the run did not measure what a table needs.
    """
    for marker, table in chosen(studies).items():
        if text := table.make(rows):
            update_between(ROOT / table.path, marker, text)
    with_images = {row.study for row in rows if row.images}
    if {against_dielectric.NAME, colours.NAME} <= with_images:
        write_atomically(GALLERY, gallery(rows, context))
    if caustics.NAME in with_images:
        write_atomically(CAUSTICS, caustic_pairs(rows, context))


def _measured(rows: list[Row], study: str, needs: Iterable[str] = (), subject: str = "") -> list[Row]:
    """Return the measured rows of a study (and a subject) that have all of these metrics, without other seeds."""
    measured = [row for row in rows if row.study == study and row.values and subject in ("", row.subject)]
    return [row for row in measured if row.values.keys() >= set(needs) and row.case == repeated.own_case(row.case)]


def _table(text: str, heading: Iterable[str], lines: list[list[str]], missing: str) -> str:
    """Return Markdown: a line of text and a table. ValueError without lines; `missing` says what was not measured."""
    if not lines:
        raise ValueError(f"documentation: no {missing}; its table needs them")
    heading = [*heading]
    first, *others = (f"| {' | '.join(cells)} |" for cells in (heading, *lines))
    return "\n".join([text, "", first, "|---" * len(heading) + "|", *others])


def _cells(row: Row | None, metrics: Iterable[str], intervals: bool = True) -> list[str]:
    """Return the values of a row with their 95 % intervals, if any; – for a missing value."""

    def cell(metric: str) -> str:
        if row is None or metric not in row.values:
            return "–"
        ends = [compact(row.values[end]) for end in (f"{metric}, low", f"{metric}, high") if end in row.values]
        return compact(row.values[metric]) + (f" ({'–'.join(ends)})" if ends and intervals else "")

    return [cell(metric) for metric in metrics]


def _replay(rows: list[Row], template: str) -> str:
    """Return the template, filled with the `replay` and the `setting` of the rows: all values if they differ."""

    def filled(field: re.Match[str]) -> str:
        texts = {field[0].format_map({**row.replay, "setting": row.setting}) for row in rows}
        return " or ".join(sorted(texts, key=lambda text: (len(text), text)))  # numbers by size

    return re.sub(r"\{[^}]*\}²?", filled, template) if rows else ""


def accuracy(rows: list[Row]) -> str:
    """Return, for each formula, the worst error over the regimes with a budget, misclassified rays and times.

    In float32 and float64. Regimes that need denormal numbers have no budget, because these are flushed to 0; each of
    them has a row of its own, of the formula of `FORMULAS` that misclassifies most rays.
    """
    columns = {
        "float32: worst chord": m.WORST_CHORD,
        "in u": m.WORST_IN_U,
        "TIR misclassified": m.MISCLASSIFIED,
        "time / copy": m.TIME_OVER_COPY,
        "time / plain": m.TIME_OVER_PLAIN,
    }
    wide = [m.WORST_CHORD, m.WORST_IN_U, m.TIME_OVER_COPY]
    by_name = {
        (row.subject, row.setting): row
        for row in _measured(rows, per_formula.NAME, [m.WORST_CHORD])
        if row.case == per_formula.ALL and row.setting in ("llvm float32", "llvm float64")
    }
    denormal = [name for name, regime in REGIMES.items() if regime.rests_on_denormals]
    counted = _measured(rows, per_formula.NAME, [m.MISCLASSIFIED])
    without_budget = {
        (row.case, row.setting): row
        for row in sorted(counted, key=lambda row: row.values[m.MISCLASSIFIED])
        if row.case in denormal and not row.budgets and row.subject in FORMULAS
    }
    outside = [name for name in denormal if (name, "llvm float32") in without_budget]
    text = (
        f"The worst ray, and the number of misclassified ones, in those of the {len(REGIMES)} regimes in which the "
        "formula has an\nerror bound, and in a regime without one (last row); u = 2⁻²⁴ or 2⁻⁵³; times are medians over "
        f"copying the same bytes\nand over `{PLAIN}`, with their 95 % intervals."
    )
    lines = []
    drawn = {row.subject: f"{row.replay['rays']:,} in {row.replay['regimes']}" for row in by_name.values()}
    for subject, rays in drawn.items():
        cells = [f"`{subject}`", FORMULAS[subject].source if subject in FORMULAS else "Mitsuba 3", rays]
        cells += _cells(by_name.get((subject, "llvm float32")), columns.values())
        lines.append(cells + _cells(by_name.get((subject, "llvm float64")), wide))
    for name in outside:
        single, double = without_budget[name, "llvm float32"], without_budget.get((name, "llvm float64"))
        cells = [f"most misclassified of `FORMULAS`, `{name}`", "denormal numbers are taken for 0"]
        cells += [f"{single.replay['count']:,} in 1", *_cells(single, columns.values())]
        lines.append(cells + _cells(double, wide))
    heading = ["formula", "source", "rays in regimes", *columns, "float64: worst chord", "in u", "time / copy"]
    return _table(text, heading, lines, "directions were measured on LLVM")


def on_a_gpu(rows: list[Row]) -> str | None:
    """Return, for each formula, the worst error over the regimes with a budget and the time, on CUDA."""
    columns = [m.WORST_IN_U, m.MISCLASSIFIED, "ns per ray", m.TIME_OVER_COPY]
    by_name = {
        (row.subject, row.setting): row
        for row in _measured(rows, per_formula.NAME, ["ns per ray"])
        if row.setting.startswith("cuda")
    }
    lines = []
    for subject in dict.fromkeys(subject for subject, _ in by_name):
        cells = (_cells(by_name.get((subject, f"cuda {x.__name__}")), columns, False) for x in PRECISIONS.values())
        lines.append([f"`{subject}`", *itertools.chain(*cells)])
    heading = ["formula", "float32: in u", "TIR misclassified", "ns per ray", "time / copy"]
    heading += ["float64: in u", *heading[2:]]
    return _table("Rays streamed through memory; medians.", heading, lines, "GPU") if lines else None


def renders(rows: list[Row]) -> str:
    """Return the comparison of `refract` and `dielectric`, scene by scene."""
    columns = {
        m.CHANGED_SHARE: "pixels changed",
        m.MEANS_DIFFER: "means differ by",
        m.SMALLEST_P: "Welch, smallest p",
        m.DETECTABLE: "minimum detectable difference",
        m.TIME_OVER_DIELECTRIC: "time",
    }
    measured = _measured(rows, against_dielectric.NAME, subject=PLUGIN)
    text = _replay(measured, "{resolution}² pixels, {spp} spp, {seeds} seeds, {variant}.")
    cells = [[row.case, *_cells(row, columns, intervals=False)] for row in measured]
    return _table(text, ["scene", *columns.values()], cells, "scenes were rendered")


def panes(rows: list[Row]) -> str:
    """Return the error of the radiance of thin panes, by method."""
    measured = _measured(rows, thin_panes.NAME)
    methods = dict.fromkeys(row.subject for row in measured)
    by_case = {(row.case, row.subject): row for row in measured}
    lines = [
        [case, *(_cells(by_case.get((case, method)), [thin_panes.OFF])[0] for method in methods)]
        for case in dict.fromkeys(row.case for row in measured)
    ]
    text = _replay(measured, "Deviation of the mean radiance from 1. {spp} spp, {setting}.")
    return _table(text, ["pane", *(f"`{method}`" for method in methods)], lines, "panes were rendered")


def biases(rows: list[Row]) -> str:
    """Return the bias of an image by each stratified sampler, by integrator."""
    measured, columns = _measured(rows, samplers.NAME), (samplers.BIAS, m.DETECTABLE_IMAGE, m.WELCH_ALARMS)
    methods = dict.fromkeys(row.subject for row in measured)
    by_case = {(row.case, row.subject): row for row in measured}
    lines = [
        [f"`{case}`", *(cell for method in methods for cell in _cells(by_case.get((case, method)), columns))]
        for case in dict.fromkeys(row.case for row in measured)
    ]
    text = _replay(measured, "`{scene}`, {resolution}² pixels, {renders} renders of {spp} spp, {setting}.")
    heading = [
        "sampler",
        *(x for method in methods for x in (f"`{method}`: bias", "detectable", "tiles and channels that differ")),
    ]
    return _table(text, heading, lines, "samplers were compared")


def derivatives(rows: list[Row]) -> str:
    """Return, for each parameter and integrator, the verdict on the derivative, its error, time and variance."""
    study, cells = gradients, {(row.case, row.subject): row for row in _measured(rows, gradients.NAME)}

    def cell(case: str, name: str) -> str:
        row = cells[case, name]
        verdict, error, _ = (row.reason or "undecided").partition(study.ERROR)  # the report quotes the error itself
        verdict += error.removesuffix(": ")
        if "off" in row.values:
            off = row.values["gradient"] / row.values["differences"] - 1
            verdict += f" ({off:+.1%} ± {row.values['interval']:.1%})"
        time, variance = _cells(cells.get((f"{case}: {study.TIME}", name)), [study.TIME], intervals=False), ""
        if study.VARIANCE in row.values:
            variance = f", variance {compact(row.values[study.VARIANCE])}"
        return f"{verdict}<br>time {time[0]}{variance}"

    complete = all((case, name) in cells for case in study.TABLE for name in study.INTEGRATORS)
    lines = [[case, *(cell(case, name) for name in study.INTEGRATORS)] for case in (study.TABLE if complete else ())]
    heading = ["derivative with respect to", *(f"`{name}`" for name in study.INTEGRATORS)]
    text = (
        "In brackets: how far the derivative is off, and its interval. Time: over that of an image by `path`. "
        "Variance:\nby one path, over the square of the derivative."
    )
    return _table(text, heading, lines, "derivatives were measured by every integrator")


def paths(rows: list[Row]) -> str:
    """Return the errors of paths through the mirage, for every plugin and for exact arithmetic with rounded indices."""
    columns = {
        m.WRONG_PATH: "wrong path",
        layered_paths.MEDIAN_DIRECTION: "direction, median",
        layered_paths.DIRECTION: "direction, worst",
        layered_paths.PLACE: "place, worst",
    }
    measured = _measured(rows, layered_paths.NAME, columns)
    measured = [row for row in measured if row.replay["scene"] == f"{layered_paths.MIRAGE.scene}.xml"]
    names = [row.subject if row.subject.startswith("exact") else f"`{row.subject}`" for row in measured]
    cells = [[name, *_cells(row, columns)] for name, row in zip(names, measured, strict=True)]
    return _table(_replay(measured, "{rays} rays, {setting}."), ["", *columns.values()], cells, "paths were traced")


def efficiency(rows: list[Row]) -> str:
    """Return MSE × time of every method by scene, over the built-in with the same sampler, and a summary."""
    measured = _measured(rows, error_against_time.NAME, [m.EQUAL_TIME, m.EQUAL_TIME_DEFAULTS])
    scenes: dict[str, dict[str, Row]] = {}
    for row in measured:
        scenes.setdefault(row.case, {})[row.subject] = row
    methods = [method.name for method in error_against_time.MEASURED if method != BUILTIN]
    cells = [
        [
            scene,
            by_name[BUILTIN.name].replay["sampler"],
            *_cells(by_name[BUILTIN.name], [m.EQUAL_TIME_DEFAULTS]),
            *(_cells(by_name.get(name), [m.EQUAL_TIME])[0] for name in methods),
        ]
        for scene, by_name in scenes.items()
    ]
    text = _replay(measured, "{resolution}² pixels, {spp} spp, {rounds} rounds, {setting}.")
    of_study = [row for row in rows if row.study == error_against_time.NAME]
    text += "".join(f"\n{sentence}" for sentence in headline.equal_time(of_study))
    left_out = [row.case for row in of_study if not row.values]
    text += f"\nNot measured: {', '.join(left_out)}." if left_out else ""
    heading = ["scene", "sampler", f"`{BUILTIN.name}`, over `independent`", *(f"`{name}`" for name in methods)]
    return _table(text, heading, cells, "efficiencies were measured")


def changing(rows: list[Row]) -> str:
    """Return the time of changing an index, over the built-in's."""
    measured = _measured(rows, changing_indices.NAME)
    cells = [[row.case, *_cells(row, [m.TIME_OVER_BUILTIN])] for row in measured]
    text = _replay(measured, "Median of {rounds} rounds, {setting}, two sides in turn.")
    return _table(text, ["", "time over the built-in's"], cells, "changes of indices were timed")


def settings(rows: list[Row]) -> str:
    """Return the settings that a pilot chooses, and MSE × time over the best by hand and over Mitsuba's defaults."""
    measured = [row for row in _measured(rows, chosen_settings.NAME) if row.case != chosen_settings.EVERY]
    metrics = m.EQUAL_TIME_HAND, m.EQUAL_TIME_DEFAULTS, chosen_settings.SHARE
    cells = [[row.case, f"`{row.replay['chosen']}`", *_cells(row, metrics)] for row in measured]
    text = _replay(measured, "MSE × time, pilot included, {resolution}² pixels, {spp} spp, {rounds} rounds, {setting}.")
    heading = ["scene", "chosen", "over the best by hand", "over Mitsuba's defaults", "pilot over render"]
    return _table(text, heading, cells, "chosen settings were measured")


def caustics_from_lamps(rows: list[Row]) -> str:
    """Return MSE × time and missing light by body and lamp, the remaining noise by class of paths, and energies."""
    study, missing = caustics, "caustics were rendered"
    path, ours, by_class = BUILTIN.name, FROM_LAMPS.name, caustics.BY_CLASS.name
    by_case: dict[str, dict[str, Row]] = {}
    for row in _measured(rows, study.NAME):
        by_case.setdefault(row.case, {})[row.subject] = row
    energies = {case: by_name for case, by_name in by_case.items() if case.startswith(study.ENERGY_OF)}
    images = {case: by_name for case, by_name in by_case.items() if path in by_name}
    columns = m.EQUAL_TIME, m.EQUAL_TIME_CAUSTIC
    cells = [
        [
            case,
            *_cells(by_name.get(ours), (*columns, m.TIME_OVER_BUILTIN)),
            *_cells(by_name.get(by_class), columns, intervals=False),
            # For a lamp with a size, the difference of `path` is noise.
            "–" if m.EQUAL_TIME in by_name[path].values else _percent(by_name[path], study.MISSING, 1),
            _percent(by_name.get(ours), study.MISSING, 1),
        ]
        for case, by_name in images.items()
    ]
    heading = ["body, lamp", "MSE × time", "of the caustic alone", "time", f"`{by_class}`: MSE × time"]
    heading += ["of the caustic alone", "light missing, `path`", "lamps traced"]
    text = _replay([by_name[path] for by_name in images.values()], "{resolution}² pixels, {spp} spp, {rounds} rounds, ")
    text += "over `path` + `dielectric`; `light_paths` at its default."
    parts = [_table(text, heading, cells, missing)]
    classes = study.SEEN, study.MIRRORED, study.LIT, study.CAST
    noise = [
        [case, *(_percent(by_name[study.BY_PART], name, 1) for name in classes)]
        for case, by_name in images.items()
        if study.BY_PART in by_name
    ]
    names = [f"`{name}`".replace("|", "\\|") for name in classes]
    parts.append(_table("Shares of the noise that is left, by class of paths:", ["", *names], noise, missing))
    off = [
        [case.removeprefix(study.ENERGY_OF), *(_off(by_name.get(x)) for x in (ours, by_class))]
        for case, by_name in energies.items()
    ]
    text = "Energy of the caustic below a body on the axis of a lamp: how far it is off, and its standard error.\n"
    text += f"`{by_class}` does not aim: below a point lamp it is not measured."
    parts.append(_table(text, ["", "lamps traced", f"`{by_class}`"], off, missing))
    return "\n\n".join(parts)


def caustics_by_others(rows: list[Row]) -> str:
    """Return the relative error of a caustic's power, by renderer."""
    study = caustic_energies
    measured = [row for row in rows if row.study == study.NAME]
    cases = [*dict.fromkeys(row.case for row in measured if row.values)]
    cells: dict[str, dict[str, str]] = {}
    for row in measured:
        off = f"{row.replay['power'] / row.replay['exact power'] - 1:+.1%}" if study.OFF in row.values else "not run"
        cells.setdefault(row.subject, {})[row.case] = off + (" ✗" if row.broken else "")
    lines = [[name, *(by_case.get(case, "–") for case in cases)] for name, by_case in cells.items()] if cases else []
    return _table("Power on the disk, over the exact one:", ["", *cases], lines, "caustics were rendered by others")


def _off(row: Row | None) -> str:
    """Return the relative error of an energy and its standard error."""
    return " ± ".join(_percent(row, x, 3) for x in (caustics.OFF, caustics.NOISE)) if row else "–"


def _percent(row: Row | None, metric: str, digits: int) -> str:
    """Return a value of a row in per cent; – if it is missing."""
    return f"{row.values[metric]:.{digits}%}" if row and metric in row.values else "–"


def planar(rows: list[Row]) -> str:
    """Return the distance of paths from the retrace by scene, and the time per path by number of segments."""
    study, missing = against_retrace, "planar paths were traced on LLVM"
    by_case = {(row.case, row.setting): row for row in _measured(rows, study.NAME, subject=study.TRACE)}
    retraced = []
    for case in dict.fromkeys(case for case, _ in by_case):
        exact, narrow = (by_case.get((case, f"llvm {precision}")) for precision in ("float64", "float32"))
        if exact and narrow:
            cells = [f"`{case}`", str(exact.replay["rays"]), f"{exact.values[study.BOUNDARIES]:.0f}"]
            cells += [compact(row.values[study.DIFFERENCE]) for row in (exact, narrow)]
            retraced.append(cells + _cells(narrow, [study.NEAREST, study.ITS_BOUND, m.ERROR_OVER_BOUND]))
    text = (
        "Largest distance from an independent retrace, over the scene's extent, on LLVM; and in float32 the error "
        "that\ncomes nearest to its bound, at one point of one path, with the bound there."
    )
    heading = ["scene", "rays", "boundaries", "float64: error", "float32: error", "nearest its bound", "bound", "ratio"]
    first = _table(text, heading, retraced, missing)
    times = {(row.subject, row.case, row.setting): row for row in _measured(rows, planar_times.NAME)}
    columns = {
        "float32": (planar_times.MESH, "llvm float32"),
        "float64": (planar_times.MESH, "llvm float64"),
        "float32, rays shuffled": (planar_times.SHUFFLED, "llvm float32"),
        "float32, every segment tried": (planar_times.BRUTE, "llvm float32"),
    }
    lines = [
        [case, *(_cells(times.get((s, case, x)), [planar_times.PER_PATH])[0] for s, x in columns.values())]
        for subject, case, setting in times
        if (subject, setting) == columns["float32"]
    ]
    text = "µs per path of two boundaries, with 95 % intervals."
    return "\n\n".join([first, _table(text, ["segments", *columns], lines, missing)])


def seen(rows: list[Row]) -> str:
    """Return in how many trials each method of comparison detected each planted defect, and its false alarms."""

    def percent(shares: list[float], digits: int = 0) -> str:
        """Return the range of the shares of several scenes; one number if they are equal."""
        return "–".join(dict.fromkeys(f"{100 * x:.{digits}f}" for x in (min(shares), max(shares)))) + " %"

    def shares(method: str, trials: list[Row]) -> str:
        if any(method not in row.values for row in trials):
            return "not read" if all(self_test.UNREADABLE in row.values for row in trials) else "–"
        return percent([row.values[method] for row in trials])

    def false_alarms(null: list[Row]) -> str:
        if any(row.reason == self_test.IDENTICAL for row in null):
            return "identical"
        alarms = sum(row.values["false alarms"] * row.values["null pairs"] for row in null)
        return f"{alarms:.0f} of {sum(row.values['null pairs'] for row in null):.0f}"

    defects: dict[str, list[Row]] = {}
    for row in _measured(rows, self_test.STUDY, ["missed"]):
        defects.setdefault(row.subject, []).append(row)
    nulls = [_measured(rows, self_test.STUDY, subject=f"null pairs, {name}") for name in COMPARISONS]
    if not defects or not all(nulls):
        return _table("", [], [], "defects were planted")
    cells = [[name, *(shares(method, trials) for method in COMPARISONS)] for name, trials in defects.items()]
    cells.append(["nothing: other seeds, or other last bits", *map(false_alarms, nulls)])
    trials = next(iter(defects.values()))
    detectable = percent([row.values[self_test.DETECTABLE] for row in trials], digits=1)
    text = _replay(trials, "{trials} trials each of {renders a side} renders a side. ")
    text = f"{', '.join(row.case for row in trials)}; {text}Minimum detectable difference in a tile: {detectable}."
    return _table(text, ["planted", *(f"`{name}`" for name in COMPARISONS)], cells, "")


def visible(rows: list[Row]) -> str:
    """Return the errors of FLIP for changes that a person does not see and for those that a person sees."""
    study, missing = visible_changes, "visible changes were planted"
    measured = _measured(rows, study.NAME)
    kinds = [row for row in measured if row.case != study.LIMIT and row.subject in (*study.KINDS, study.EDGE)]
    metrics = (*study.MEASURED, study.ERROR)
    cells = [
        [row.subject, row.reason, row.case, *_cells(row, metrics), f"{row.values[study.ALARMS]:.1%}"] for row in kinds
    ]
    options = COMPARISONS["flip"].options
    bounds = [
        f"{metric} (bound {compact(options[name].default)})"
        for metric, name in zip(study.MEASURED, ("local", "patch", "one_way"), strict=True)
    ]
    heading = ["change", "", "by a person", *bounds, study.ERROR, study.ALARMS]
    first = _table(_replay(kinds, "{trials} pairs of {size}² pixels each, {setting}."), heading, cells, missing)
    limits = [row for row in measured if row.case == study.LIMIT]
    squares = [row for row in limits if study.CODES in row.values]
    codes = [compact(row.values[study.CODES]) if row.values[study.CODES] < 255 else "never" for row in squares]
    edge = next((compact(row.values[study.PIXELS]) for row in limits if row.subject == study.EDGE), "")
    text = f"Smallest change of a gray square that is different; a black edge on white must move by {edge} pixels."
    sides = ["pixels a side", *(row.subject.split()[2] for row in squares)]
    return "\n\n".join([first, _table(text, sides, [["codes of 255", *codes]] if edge else [], missing)])


def numbers(rows: list[Row]) -> str:
    """Return all standard numbers with their printed digits and the plugin's results."""
    study, lines = standard_numbers, []
    by_name = {row.case: row for row in _measured(rows, study.NAME, [m.ERROR_OVER_BOUND], PLUGIN)}
    for number in NUMBERS.values():
        if row := by_name.get(number.name):
            digits = f"{number.value:.9g}{number.unit.replace('mm', ' mm')}"
            measured = f"{row.values[study.MEASURED]:.9g}"
            cells = _cells(row, [study.BOUND, m.ERROR_OVER_BOUND, study.SECONDS])
            lines.append([number.name, digits, number.printed or "–", measured, *cells, row.setting])
    text = 'Bounds are of |measured − value|; their terms are in the report\'s study "Standard numbers".'
    heading = ["number", "value", "printed", f"`{PLUGIN}`", "bound", "error / bound", "seconds", "variant"]
    return _table(text, heading, lines, "standard numbers were measured")


def numbers_elsewhere(rows: list[Row]) -> str:
    """Return the errors of other renderers' standard numbers over their bounds; ✗ above 1."""
    all_rows = [row for row in rows if row.study == numbers_by_others.NAME]
    cells: dict[str, dict[str, str]] = {}
    for row in _measured(all_rows, numbers_by_others.NAME, [m.ERROR_OVER_BOUND]):
        subject = f"{row.subject}, {row.setting}" if row.setting in PRECISIONS else row.subject
        (share,) = _cells(row, [m.ERROR_OVER_BOUND])
        cells.setdefault(subject, {})[row.case] = share + (" ✗" if row.broken else "")
    names = [name for name in NUMBERS if any(name in by_name for by_name in cells.values())]
    lines = [[name, *(by_name.get(name, "") for by_name in cells.values())] for name in names]
    absent = dict.fromkeys(row.subject for row in all_rows if not row.values)
    text = "Error over bound: of rays in each system's own precision."
    text += f"\nNot run here: {'; '.join(absent)}." if absent else ""
    return _table(text, ["number", *cells], lines, "other renderers were asked for standard numbers")


TABLES = {
    "accuracy": Table("README.md", "directions.per_formula", accuracy),
    "on a GPU": Table(f"{PAGES}/what-each-formula-costs.md", "directions.per_formula", on_a_gpu),
    "renders": Table(f"{PAGES}/refract-and-dielectric.md", "renders.against_dielectric", renders),
    "panes": Table(f"{PAGES}/refract-and-dielectric.md", "renders.thin_panes", panes),
    "samplers": Table(f"{PAGES}/passes-bits-and-errors.md", "renders.samplers", biases),
    "derivatives": Table(f"{PAGES}/which-derivatives-are-correct.md", "renders.gradients", derivatives),
    "paths": Table(f"{PAGES}/refract-and-dielectric.md", "stability.layered_paths", paths),
    "efficiency": Table(f"{PAGES}/what-each-formula-costs.md", "efficiency.error_against_time", efficiency),
    "changing": Table(f"{PAGES}/what-each-formula-costs.md", "efficiency.changing_indices", changing),
    "settings": Table(".github/docs/how-to/render-for-hours.md", "efficiency.chosen_settings", settings),
    "caustics": Table(f"{PAGES}/what-each-formula-costs.md", "efficiency.caustics", caustics_from_lamps),
    "caustics by others": Table(f"{PAGES}/what-each-formula-costs.md", "suite.caustic_energies", caustics_by_others),
    "planar": Table(f"{PAGES}/how-accurate-planar-paths-are.md", "planar", planar),
    "defects": Table(f"{PAGES}/what-image-methods-detect.md", "diff.planted_defects", seen),
    "visible": Table(f"{PAGES}/how-tolerance-and-flip-decide.md", "diff.visible_changes", visible),
    "standard numbers": Table(NUMBERS_PAGE, "ground-truth.standard_numbers", numbers),
    "standard numbers by others": Table(NUMBERS_PAGE, "suite.standard_numbers", numbers_elsewhere),
    "suite": Table(
        f"{PAGES}/what-the-validation-shows.md",
        "suite",
        lambda rows: _table(*matrix.table(rows), "other renderers were run"),
    ),
}


def gallery(rows: list[Row], context: Context) -> bytes:
    """Return a PNG of all scenes as `refract` rendered them, side by side.

    The furnace is left out: it is white if correct. Scenes with dispersion or absorption, from a spectral variant, are
    last.
    """
    rendered = [row for row in rows if row.subject == PLUGIN and row.images]
    paths = [r.images["test"] for study in (against_dielectric, colours) for r in rendered if r.study == study.NAME]
    images = [image_file.read_exr(context.out / path)[0] for path in paths]
    return _sheet([image for image in images if image.std() > 1e-3], 8)


def caustic_pairs(rows: list[Row], context: Context) -> bytes:
    """Return a PNG of all bodies and lamps, at equal irradiance: `path` above, with lamps traced below."""
    paths: dict[str, dict[str, str]] = {}  # by case and method
    for row in rows:
        if row.study == caustics.NAME and row.images:
            paths.setdefault(row.case, {})[row.subject] = row.images["test"]
    pairs = [
        np.concatenate([image_file.read_exr(context.out / by_method[x.name])[0] for x in (BUILTIN, FROM_LAMPS)])
        for by_method in paths.values()
    ]
    return _sheet([pair.repeat(2, 0).repeat(2, 1) for pair in pairs], 6)


def _sheet(tiles: list[np.ndarray], columns: int) -> bytes:
    """Return a PNG of images of one size in rows of `columns`."""
    (height, width), gap = tiles[0].shape[:2], 4
    lines = -(-len(tiles) // columns)
    sheet = np.ones((lines * (height + gap) - gap, columns * (width + gap) - gap, 3), np.float32)
    for i, tile in enumerate(tiles):
        y, x = i // columns * (height + gap), i % columns * (width + gap)
        sheet[y : y + height, x : x + width] = srgb_encode(tile.clip(0, 1))
    return png(np.rint(255 * sheet).astype(np.uint8))

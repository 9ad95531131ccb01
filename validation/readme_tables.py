"""The tables of the READMEs and the image gallery, all made from the rows of one run.

Rows are found by the studies' own constants for names of studies and metrics. So a renamed label is an error when this
module is imported, not after the run.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_refract.formulas import FORMULAS
from mi_refract.image_diff import self_test
from mi_refract.image_diff.methods import METHODS
from mi_refract.io import image_file
from mi_refract.io.atomic import update_between, write_atomically
from mi_refract.io.pixels import srgb_encode
from mi_refract.plugins.refract import PLUGIN
from mi_refract.report.number_text import compact
from mi_refract.report.row import Row
from validation.diff import visible_changes
from validation.directions import per_formula
from validation.efficiency import changing_indices, error_against_time
from validation.planar import against_retrace
from validation.planar import times as planar_times
from validation.reference.layered_scenes import MIRAGE
from validation.renders import against_dielectric, colours
from validation.run.array_settings import PLAIN
from validation.run.context import SCENES, Context
from validation.run.metrics import (
    CHANGED_SHARE,
    DETECTABLE,
    EQUAL_TIME,
    EQUAL_TIME_DEFAULTS,
    ERROR_OVER_BOUND,
    MEANS_DIFFER,
    MISCLASSIFIED,
    SMALLEST_P,
    TIME_OVER_BUILTIN,
    TIME_OVER_COPY,
    TIME_OVER_PLAIN,
    WORST_CHORD,
    WORST_IN_U,
    WRONG_PATH,
    high,
    low,
)
from validation.stability import layered_paths
from validation.suite import matrix

ROOT = SCENES.parent
GALLERY = SCENES / "gallery.png"
GALLERY_COLUMNS = 8


@dataclass(frozen=True)
class Table:
    """Where a table is written, between its markers; `study` is what must be run for it, by its command-line name."""

    path: str
    study: str
    make: Callable[[list[Row]], str]


def check(studies: list[str]) -> None:
    """ValueError, one line, where a file or a marker of the tables of these studies is missing."""
    for marker, table in chosen(studies).items():
        path = ROOT / table.path
        text = path.read_text() if path.is_file() else ""
        if f"<!-- begin: {marker} -->" not in text or f"<!-- end: {marker} -->" not in text:
            raise ValueError(
                f"{path}: no markers '<!-- begin: {marker} -->' and '<!-- end: {marker} -->' for its table"
            )


def chosen(studies: list[str]) -> dict[str, Table]:
    """The tables of these studies. Without any: all but that of other renderers, which needs them installed."""
    return {m: t for m, t in TABLES.items() if (t.study in studies if studies else t.study != "suite")}


def write(rows: list[Row], context: Context, studies: list[str]) -> None:
    """Write the tables of the studies that were run, and the gallery where scenes were rendered.

    ValueError where a marker is missing, or the run has not measured what a table holds.
    """
    for marker, table in chosen(studies).items():
        update_between(ROOT / table.path, marker, table.make(rows))
    if any(row.study == against_dielectric.NAME and row.images for row in rows):
        write_atomically(GALLERY, gallery(rows, context))


def accuracy(rows: list[Row]) -> str:
    """Markdown: by formula the worst error over all regimes, misclassified rays and times, in float32 and float64."""
    summaries = [r for r in rows if r.study == per_formula.NAME and r.case == per_formula.ALL]
    found = {(r.subject, r.setting): r for r in summaries if WORST_CHORD in r.values}
    subjects = list(dict.fromkeys(subject for subject, setting in found if setting in ACCURACY))
    if not subjects:
        raise ValueError("README: no directions were measured on LLVM; its accuracy table needs them")
    rays = max(row.replay["rays"] for (_, setting), row in found.items() if setting in ACCURACY)
    heading = ["formula", "source"]
    for setting, metrics in ACCURACY.items():
        heading += [(f"{setting.split()[1]}: " if i == 0 else "") + title for i, title in enumerate(metrics)]
    text = (
        f"Worst over {rays:,} rays in all regimes; u = 2⁻²⁴ or 2⁻⁵³; times are medians over copying the same bytes\n"
        f"and over `{PLAIN}`, with their 95 % intervals."
    )
    lines = []
    for subject in subjects:
        cells = [f"`{subject}`", FORMULAS[subject].source if subject in FORMULAS else "Mitsuba 3"]
        for setting, metrics in ACCURACY.items():
            row = found.get((subject, setting))
            cells += [_with_interval(row, metric) if row else "–" for metric in metrics.values()]
        lines.append(cells)
    return _table(text, heading, lines)


def _table(text: str, heading: list[str], rows: list[list[str]]) -> str:
    """Markdown: a line of text, and a table."""
    lines = [f"| {' | '.join(cells)} |" for cells in (heading, *rows)]
    return "\n".join([text, "", lines[0], "|---" * len(heading) + "|", *lines[1:]])


def _with_interval(row: Row, metric: str) -> str:
    ends = [compact(row.values[end]) for end in (low(metric), high(metric)) if end in row.values]
    return compact(row.values[metric]) + (f" ({'–'.join(ends)})" if ends else "")


ACCURACY = {
    "llvm float32": {
        "worst chord": WORST_CHORD,
        "in u": WORST_IN_U,
        "TIR misclassified": MISCLASSIFIED,
        "time / copy": TIME_OVER_COPY,
        "time / plain": TIME_OVER_PLAIN,
    },
    "llvm float64": {"worst chord": WORST_CHORD, "in u": WORST_IN_U, "time / copy": TIME_OVER_COPY},
}
RENDERS = {
    CHANGED_SHARE: "pixels changed",
    MEANS_DIFFER: "means differ by",
    SMALLEST_P: "Welch, smallest p",
    DETECTABLE: "minimum detectable difference",
    against_dielectric.TIME: "time",
}


def renders(rows: list[Row]) -> str:
    """Markdown: `refract` against `dielectric`, scene by scene."""
    found = [row for row in rows if row.study == against_dielectric.NAME and row.subject == PLUGIN and row.values]
    if not found:
        raise ValueError("README: no scene was rendered; its table needs them")
    replay = found[0].replay
    size = f"{replay['resolution']}² pixels, {replay['spp']} spp, {replay['seeds']} seeds, {replay['variant']}"
    cells = [
        [row.case, *(compact(row.values[metric]) if metric in row.values else "–" for metric in RENDERS)]
        for row in found
    ]
    return _table(f"{size}.", ["scene", *RENDERS.values()], cells)


PATHS = {
    WRONG_PATH: "wrong path",
    layered_paths.MEDIAN_DIRECTION: "direction, median",
    layered_paths.DIRECTION: "direction, worst",
    layered_paths.PLACE: "place, worst",
}


def paths(rows: list[Row]) -> str:
    """Markdown: the paths through the mirage, of every plugin and of exact arithmetic with rounded indices."""
    found = [row for row in rows if row.study == layered_paths.NAME and row.values.keys() >= PATHS.keys()]
    found = [row for row in found if row.replay["scene"] == f"{MIRAGE.scene}.xml"]
    if not found:
        raise ValueError("README: no paths were traced; its table needs a compiled variant")
    cells = [
        [
            row.subject if row.subject.startswith("exact") else f"`{row.subject}`",
            *(compact(row.values[metric]) for metric in PATHS),
        ]
        for row in found
    ]
    return _table(f"{found[0].replay['rays']} rays, {found[0].setting}.", ["", *PATHS.values()], cells)


EFFICIENCY = {
    TIME_OVER_BUILTIN: "time",
    EQUAL_TIME: "MSE at equal time",
    EQUAL_TIME_DEFAULTS: "… over its defaults",
}


def efficiency(rows: list[Row]) -> str:
    """Markdown: every method on the scenes that were measured, over the built-in with the same sampler."""
    found = [row for row in rows if row.study == error_against_time.NAME and row.values.keys() >= EFFICIENCY.keys()]
    if not found:
        raise ValueError("README: no efficiency was measured; its table needs a compiled variant")
    replay = found[0].replay
    size = f"{replay['resolution']}² pixels, {replay['spp']} spp, {replay['rounds']} rounds, {found[0].setting}."
    cells = []
    for row in found:
        name, default, _ = row.subject.partition(", independent")
        sampler = "independent" if default else row.replay["sampler"]
        cells.append([row.case, f"`{name}`", sampler, *(_with_interval(row, metric) for metric in EFFICIENCY)])
    return _table(size, ["scene", "method", "sampler", *EFFICIENCY.values()], cells)


def changing(rows: list[Row]) -> str:
    """Markdown: what it costs to change an index, over the built-in."""
    found = [row for row in rows if row.study == changing_indices.NAME and row.values]
    if not found:
        raise ValueError("README: no changes of indices were timed; their table needs a compiled variant")
    cells = [[row.case, _with_interval(row, TIME_OVER_BUILTIN)] for row in found]
    text = f"Median of {found[0].replay['rounds']} rounds, {found[0].setting}, two sides in turn."
    return _table(text, ["", "time over the built-in's"], cells)


def planar(rows: list[Row]) -> str:
    """Markdown: by scene the distance of paths from the retrace, and the time per path by the number of segments."""
    retraced, timed = _planar_errors(rows), _planar_times(rows)
    if not retraced or not timed:
        raise ValueError("README: no planar paths were traced on LLVM; its tables need them")
    columns = ["float32", "float64", "float32, rays shuffled", "float32, every segment tried"]
    errors = ["scene", "rays", "boundaries", "float64: error", "float32: error", "nearest its bound", "bound", "ratio"]
    return "\n\n".join(
        [
            _table(PLANAR_TEXT, errors, retraced),
            _table("µs per path of two boundaries, with 95 % intervals.", ["segments", *columns], timed),
        ]
    )


PLANAR_TEXT = (
    "Largest distance from an independent retrace, over the scene's extent, on LLVM; and in float32 the error that\n"
    "comes nearest to its bound, at one point of one path, with the bound there."
)


def _planar_errors(rows: list[Row]) -> list[list[str]]:
    study = against_retrace
    found = {(r.case, r.setting): r for r in rows if r.study == study.NAME and r.subject == study.TRACE and r.values}
    lines = []
    for case in dict.fromkeys(case for case, _ in found):
        exact, narrow = (found.get((case, f"llvm {precision}")) for precision in ("float64", "float32"))
        if exact and narrow:
            most, rays = f"{exact.values[study.BOUNDARIES]:.0f}", str(exact.replay["rays"])
            errors = [compact(row.values[study.DIFFERENCE]) for row in (exact, narrow)]
            nearest = [compact(narrow.values[m]) for m in (study.NEAREST, study.ITS_BOUND, ERROR_OVER_BOUND)]
            lines.append([f"`{case}`", rays, most, *errors, *nearest])
    return lines


def _planar_times(rows: list[Row]) -> list[list[str]]:
    study = planar_times
    found = {(r.subject, r.case, r.setting): r for r in rows if r.study == study.NAME and r.values}
    columns = [(study.MESH, "float32"), (study.MESH, "float64"), (study.SHUFFLED, "float32"), (study.BRUTE, "float32")]
    lines = []
    for subject, case, setting in found:
        if (subject, setting) == (study.MESH, "llvm float32"):
            timed = [found.get((name, case, f"llvm {precision}")) for name, precision in columns]
            lines.append([case, *(_with_interval(row, study.PER_PATH) if row else "–" for row in timed)])
    return lines


def seen(rows: list[Row]) -> str:
    """Markdown: in how many trials each method of comparison saw each planted defect, and its false alarms."""
    found = [row for row in rows if row.study == self_test.STUDY and row.values]
    defects: dict[str, list[Row]] = {}
    for row in found:
        if "missed" in row.values:
            defects.setdefault(row.subject, []).append(row)
    alarms = {name: [row for row in found if row.subject == f"null pairs, {name}"] for name in METHODS}
    if not defects or not all(alarms.values()):
        raise ValueError("README: no defects were planted; its table needs a compiled variant")
    cells = [[name, *(_shares(method, trials) for method in METHODS)] for name, trials in defects.items()]
    cells.append(["nothing: other seeds, or other last bits", *map(_false_alarms, alarms.values())])
    trials = next(iter(defects.values()))
    detectable = _percent([row.values[self_test.DETECTABLE] for row in trials], digits=1)
    replay, scenes = trials[0].replay, ", ".join(row.case for row in trials)
    text = f"{scenes}; {replay['trials']} trials each of {replay['renders a side']} renders a side. "
    text += f"Minimum detectable difference in a tile: {detectable}."
    return _table(text, ["planted", *(f"`{name}`" for name in METHODS)], cells)


def _shares(method: str, trials: list[Row]) -> str:
    if any(method not in row.values for row in trials):
        return "not read" if all(self_test.UNREADABLE in row.values for row in trials) else "–"
    return _percent([row.values[method] for row in trials])


def _false_alarms(rows: list[Row]) -> str:
    if any(row.reason == self_test.IDENTICAL for row in rows):
        return "identical"
    pairs = [row.values["null pairs"] for row in rows]
    alarms = sum(row.values["false alarms"] * count for row, count in zip(rows, pairs, strict=True))
    return f"{alarms:.0f} of {sum(pairs):.0f}"


def visible(rows: list[Row]) -> str:
    """Markdown: how large the errors of FLIP are in changes that nobody sees and that a person sees."""
    study = visible_changes
    own = (*study.KINDS, study.EDGE)  # not those of other seeds
    found = [row for row in rows if row.study == study.NAME and (row.subject in own or row.case == study.LIMIT)]
    kinds, limits_found = ([r for r in found if (r.case == study.LIMIT) is limit] for limit in (False, True))
    if not kinds or not limits_found:
        raise ValueError("README: no visible changes were planted; its table needs them")
    metrics = (study.LOCAL, study.THROUGHOUT, study.ERROR)
    cells = [
        [
            row.subject,
            row.reason,
            row.case,
            *(compact(row.values[m]) for m in metrics),
            f"{row.values[study.ALARMS]:.1%}",
        ]
        for row in kinds
    ]
    replay, bounds = kinds[0].replay, METHODS["flip"].options
    heading = [
        f"{name} (bound {compact(bounds[o].default)})" for name, o in zip(metrics, ("local", "patch"), strict=False)
    ]
    text = f"{replay['trials']} pairs of {replay['size']}² pixels each, {kinds[0].setting}."
    first = _table(text, ["change", "", "by a person", *heading, study.ERROR, study.ALARMS], cells)
    squares = [row for row in limits_found if study.CODES in row.values]
    codes = [compact(row.values[study.CODES]) if row.values[study.CODES] < 255 else "never" for row in squares]
    edge = next(compact(row.values[study.PIXELS]) for row in limits_found if row.subject == study.EDGE)
    text = f"Smallest change of a gray square that is different; a black edge on white must move by {edge} pixels."
    sides = [row.subject.split()[2] for row in squares]
    return "\n\n".join([first, _table(text, ["pixels a side", *sides], [["codes of 255", *codes]])])


def suite(rows: list[Row]) -> str:
    """Markdown: how far every system is off at most, check by check."""
    return _table(*matrix.table(rows))


def _percent(shares: list[float], digits: int = 0) -> str:
    """Of several scenes: one number where they are the same, else the smallest and the largest."""
    ends = list(dict.fromkeys(f"{100 * x:.{digits}f}" for x in (min(shares), max(shares))))
    return "–".join(ends) + " %"


TABLES = {
    "accuracy": Table("README.md", "directions", accuracy),
    "renders": Table("validation/README.md", "renders", renders),
    "paths": Table("validation/README.md", "stability", paths),
    "efficiency": Table("mi_refract/plugins/README.md", "efficiency", efficiency),
    "changing": Table("mi_refract/plugins/README.md", "efficiency", changing),
    "planar": Table("mi_refract/planar/README.md", "planar", planar),
    "defects": Table("mi_refract/image_diff/README.md", "diff", seen),
    "visible": Table("mi_refract/image_diff/README.md", "diff", visible),
    "suite": Table("validation/README.md", "suite", suite),
}


def gallery(rows: list[Row], context: Context) -> bytes:
    """A PNG of every scene as `refract` rendered it, side by side; without the furnace, which is white when right.

    Scenes with dispersion or absorption come last, from a spectral variant.
    """
    import OpenImageIO as oiio

    drawn = [row for row in rows if row.subject == PLUGIN and row.images]
    paths = [r.images["test"] for study in (against_dielectric, colours) for r in drawn if r.study == study.NAME]
    tiles = [tile for path in paths if (tile := image_file.read_exr(context.out / path)[0]).std() > 1e-3]
    gap = np.ones((tiles[0].shape[0], 4, 3), np.float32)
    strips = []
    for start in range(0, len(tiles), GALLERY_COLUMNS):
        row = tiles[start : start + GALLERY_COLUMNS]
        row += [np.ones_like(tiles[0])] * (GALLERY_COLUMNS - len(row))
        strip = [x for tile in row for x in (tile, gap)][:-1]
        strips += [np.concatenate(strip, axis=1), np.ones((4, sum(x.shape[1] for x in strip), 3), np.float32)]
    encoded = srgb_encode(np.concatenate(strips[:-1]).clip(0, 1)).astype(np.float32)
    image = oiio.ImageBuf(np.ascontiguousarray(encoded))
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "gallery.png"
        if not image.write(str(target), "uint8"):
            raise OSError(f"{target}: {image.geterror()}")
        return target.read_bytes()

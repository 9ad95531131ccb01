"""What the README quotes: tables and the gallery, all from the rows of one run."""

from __future__ import annotations

import tempfile
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
from validation.reference.layered_scenes import MIRAGE
from validation.run.array_settings import PLAIN
from validation.run.context import SCENES, Context

from .suite import matrix

GALLERY = SCENES / "gallery.png"
COLUMNS = 6


def update(path: Path, rows: list[Row], context: Context) -> None:
    """Write the tables between their markers in `path`, and the gallery beside the scenes.

    A run of nothing but the suite writes the table of other renderers, any other run all the rest. ValueError where a
    marker is missing or the run has not measured what the README quotes.
    """
    if {row.study for row in rows} <= {matrix.STUDY, *matrix.CHECKS}:
        update_between(path, "suite", suite(rows))
        return
    for marker, table in TABLES.items():
        update_between(path, marker, table(rows))
    write_atomically(GALLERY, gallery(rows, context))


def accuracy(rows: list[Row]) -> str:
    """Markdown: worst error over all regimes and misjudged rays by formula, in float32 and float64, and the times."""
    found = {(r.subject, r.setting): r for r in rows if r.case == "all regimes" and "worst chord" in r.values}
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
    ends = [compact(row.values[end]) for end in (f"{metric}, low", f"{metric}, high") if end in row.values]
    return compact(row.values[metric]) + (f" ({'–'.join(ends)})" if ends else "")


ACCURACY = {
    "llvm float32": {
        "worst chord": "worst chord",
        "in u": "worst / u",
        "misjudged": "misjudged",
        "time / copy": "time / copy",
        "time / plain": "time / plain",
    },
    "llvm float64": {"worst chord": "worst chord", "in u": "worst / u", "time / copy": "time / copy"},
}
RENDERS = {
    "changed share": "pixels changed",
    "|mean ratio − 1|": "means differ by",
    "smallest p, adjusted": "Welch, smallest p",
    "detectable difference": "detectable",
    "time / dielectric": "time",
}


def renders(rows: list[Row]) -> str:
    """Markdown: `refract` against `dielectric`, scene by scene."""
    found = [row for row in rows if row.study == "renders" and row.subject == PLUGIN and row.values]
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
    "astray": "astray",
    "median direction": "direction, median",
    "direction": "direction, worst",
    "place": "place, worst",
}


def paths(rows: list[Row]) -> str:
    """Markdown: the paths through the mirage, of every plugin and of exact arithmetic with rounded indices."""
    found = [row for row in rows if row.study == "paths" and row.values.keys() >= PATHS.keys()]
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
    "time / built-in": "time",
    "equal-time MSE": "MSE at equal time",
    "equal-time MSE / independent": "… over its defaults",
}


def efficiency(rows: list[Row]) -> str:
    """Markdown: every method on the scenes that were measured, over the built-in with the same sampler."""
    found = [row for row in rows if row.study == "efficiency" and row.values.keys() >= EFFICIENCY.keys()]
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


def planar(rows: list[Row]) -> str:
    """Markdown: scene by scene how far paths are from the retrace, and what a path costs by the number of segments."""
    found = {(r.study, r.subject, r.case, r.setting): r for r in rows if r.values}
    cells, times = [], []
    for _, _, case, setting in (key for key in found if key[:2] == ("planar", "trace")):
        exact, narrow = (found.get(("planar", "trace", case, f"llvm {p}")) for p in ("float64", "float32"))
        if setting == "llvm float64" and exact and narrow:
            most = f"{exact.values['boundaries']:.0f}"
            cells.append(
                [
                    f"`{case}`",
                    str(exact.replay["rays"]),
                    most,
                    compact(exact.values["difference"]),
                    compact(narrow.values["difference"]),
                    compact(narrow.values["error / bound"]),
                ]
            )
    for _, subject, case, setting in (key for key in found if key[0] == "planar_times"):
        if subject == "mesh" and setting == "llvm float32":
            columns = [("mesh", "float32"), ("mesh", "float64"), ("mesh, shuffled", "float32"), ("brute", "float32")]
            timed = [found.get(("planar_times", name, case, f"llvm {p}")) for name, p in columns]
            times.append([case, *(_with_interval(row, "µs per path") if row else "–" for row in timed)])
    if not cells or not times:
        raise ValueError("README: no planar paths were traced on LLVM; its tables need them")
    heading = ["scene", "rays", "boundaries", "float64: off by", "float32: off by", "over its bound"]
    return "\n\n".join(
        [
            _table("Largest distance from an independent retrace, over the scene's extent, on LLVM.", heading, cells),
            _table(
                "µs per path of two boundaries, with 95 % intervals.",
                ["segments", "float32", "float64", "float32, rays shuffled", "float32, every segment tried"],
                times,
            ),
        ]
    )


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
    cells = [
        [name, *(_percent([row.values[method] for row in trials]) for method in METHODS)]
        for name, trials in defects.items()
    ]
    cells.append(
        [
            "nothing: other seeds, or the same",
            *(
                f"{sum(r.values['false alarms'] * r.values['null pairs'] for r in each):.0f} of "
                f"{sum(r.values['null pairs'] for r in each):.0f}"
                for each in alarms.values()
            ),
        ]
    )
    trials = next(iter(defects.values()))
    detectable = _percent([row.values[self_test.DETECTABLE] for row in trials], digits=1)
    replay, scenes = trials[0].replay, ", ".join(row.case for row in trials)
    text = f"{scenes}; {replay['trials']} trials each of {replay['renders a side']} renders a side. "
    text += f"Minimum detectable difference in a tile: {detectable}."
    return _table(text, ["planted", *(f"`{name}`" for name in METHODS)], cells)


def suite(rows: list[Row]) -> str:
    """Markdown: how far every system is off at most, check by check."""
    cells: dict[str, dict[str, Row]] = {}
    for row in rows:
        if row.study == matrix.STUDY:
            cells.setdefault(row.subject, {})[row.case] = row
    if not any(row.values for each in cells.values() for row in each.values()):
        raise ValueError("README: no other renderer was run; its table needs some")
    checks = [check for each in matrix.CHECKS.values() for check in each]
    lines = [[system, *(_off(found.get(check)) for check in checks)] for system, found in cells.items()]
    return _table("Rays: radians; images: share of the mean.", ["", *checks], lines)


def _off(row: Row | None) -> str:
    if row is None or not row.values:
        return "not run" if row else ""
    if matrix.OFF not in row.values:
        return "✗" if row.broken else "✓"
    word = " **different**" if row.values.get("differs") else ""
    return compact(row.values[matrix.OFF]) + word + (" ✗" if row.broken else "")


def _percent(shares: list[float], digits: int = 0) -> str:
    """Of several scenes: one number where they are the same, else the smallest and the largest."""
    ends = list(dict.fromkeys(f"{100 * x:.{digits}f}" for x in (min(shares), max(shares))))
    return "–".join(ends) + " %"


TABLES = {
    "accuracy": accuracy,
    "renders": renders,
    "paths": paths,
    "efficiency": efficiency,
    "planar": planar,
    "gate": seen,
}


def gallery(rows: list[Row], context: Context) -> bytes:
    """A PNG of every scene as `refract` rendered it, side by side; without the furnace, which is white when right."""
    import OpenImageIO as oiio

    paths = [row.images["test"] for row in rows if row.study == "renders" and row.subject == PLUGIN]
    tiles = [tile for path in paths if (tile := image_file.read_exr(context.out / path)[0]).std() > 1e-3]
    gap = np.ones((tiles[0].shape[0], 4, 3), np.float32)
    strips = []
    for start in range(0, len(tiles), COLUMNS):
        row = tiles[start : start + COLUMNS]
        row += [np.ones_like(tiles[0])] * (COLUMNS - len(row))
        strip = [x for tile in row for x in (tile, gap)][:-1]
        strips += [np.concatenate(strip, axis=1), np.ones((4, sum(x.shape[1] for x in strip), 3), np.float32)]
    linear = np.clip(np.concatenate(strips[:-1]), 0, 1)
    encoded = srgb_encode(linear).astype(np.float32)
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "gallery.png"
        image = oiio.ImageBuf(np.ascontiguousarray(encoded))
        if not image.write(str(target), "uint8"):
            raise OSError(f"{target}: {image.geterror()}")
        return target.read_bytes()

"""Plots as SVG elements in the colours of the page: curves, scatter plots."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from mi_refract.io.text import compact, printable_lines

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Panel
    from matplotlib.figure import Figure

Points = Sequence[tuple[float, float]]

# Stand-in colours: matplotlib writes them, `_page_svg` turns each into the style sheet's variable.
INK, MUTED, LINE = "#010203", "#010204", "#010205"
SERIES = [f"#0102{16 + i:02x}" for i in range(12)]
DASHED = (0, (4, 3))
# Of a name relative to its point, in pixels: the nearest first.
PLACES = sorted(((x, y) for x in range(7, 130, 6) for y in range(-96, 97, 4)), key=lambda place: math.hypot(*place))
VARIABLES = {INK: "--ink", MUTED: "--muted", LINE: "--line"} | {c: f"--c{i}" for i, c in enumerate(SERIES)}

STYLE: dict[str, Any] = {
    "svg.fonttype": "none",  # text stays text: selectable, and in the page's own font
    "text.parse_math": False,  # a dollar sign in a name is a dollar sign
    "font.size": 10,
    "axes.edgecolor": LINE,
    "axes.labelcolor": MUTED,
    "axes.titlecolor": INK,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": LINE,
    "grid.linewidth": 0.6,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "text.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 9.5,
}


@dataclass(frozen=True)
class Axes:
    """Labels and scales, "log" or "linear", of a plot; `slope` is that of a dashed guide, y ~ x^slope.

    ValueError for another scale, or a slope without two logarithmic axes.
    """

    x: str = ""
    y: str = ""
    x_scale: str = "log"
    y_scale: str = "log"
    slope: float | None = None

    def __post_init__(self) -> None:
        """Check the scales. Errors: ValueError."""
        if not {self.x_scale, self.y_scale} <= {"log", "linear"}:
            raise ValueError(f"axes: scales {self.x_scale!r}, {self.y_scale!r}; expected 'log', 'linear'")
        if self.slope is not None and self.logarithmic != "xy":
            raise ValueError("axes: a slope needs both scales logarithmic")

    @property
    def logarithmic(self) -> str:
        """The axes that are logarithmic: "", "x", "y" or "xy"."""
        return ("x" if self.x_scale == "log" else "") + ("y" if self.y_scale == "log" else "")


def drawable(points: Points, axes: Axes) -> list[tuple[float, float]]:
    """The points that have a place on the axes: finite, and positive where a scale is logarithmic."""
    x_low, y_low = (0 if scale == "log" else -math.inf for scale in (axes.x_scale, axes.y_scale))
    return [(x, y) for x, y in points if x_low < x < math.inf and y_low < y < math.inf]


def curves_svg(curves: Mapping[str, Points], axes: Axes, *, salt: str, size: tuple[float, float] = (5.3, 3.0)) -> str:
    """One line per name, and a dashed guide of the axes' slope from the first line's start; the legend is below.

    Points without a place on the axes are left out. "" where nothing can be drawn.
    `salt` makes the ids inside the SVG unique on the page; the same arguments give the same bytes. `size` is width and
    height in inches without the legend.
    """
    lines = {name: drawable(points, axes) for name, points in curves.items()}
    if not any(lines.values()):
        return ""
    with _figure(salt) as figure:
        panel = figure.add_subplot(xscale=axes.x_scale, yscale=axes.y_scale, xlabel=axes.x, ylabel=axes.y)
        for i, (name, points) in enumerate(lines.items()):
            if points:
                xs, ys = zip(*points, strict=True)
                panel.plot(xs, ys, label=name, color=SERIES[i % len(SERIES)], marker="o", markersize=3.5, linewidth=1.6)
        if axes.slope is not None:
            first = next(points for points in lines.values() if points)
            start, y = min(first)
            stop = max(x for points in lines.values() for x, _ in points)
            if stop > start:
                ends, label = [y, y * (stop / start) ** axes.slope], f"slope {axes.slope:g}".replace("-", "−")
                panel.plot([start, stop], ends, color=MUTED, linewidth=1, linestyle=DASHED, label=label)
        _ticks(panel, axes.logarithmic)
        # Below the axes the legend covers no point; it has as many columns as its longest name leaves room for.
        handles, names = panel.get_legend_handles_labels()
        columns = max(1, min(len(names), int(size[0] * 72 // (5 * max(map(len, names)) + 44))))
        figure.set_size_inches(size[0], size[1] + 0.21 * math.ceil(len(names) / columns))
        figure.legend(handles, names, loc="outside lower left", ncols=columns, borderaxespad=0, columnspacing=1.2)
        return _page_svg(figure)


@dataclass
class Scatter:
    """A panel: points by subject, (subject, low x, high x, y) of the intervals, and the x of the floor."""

    points: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    intervals: list[tuple[str, float, float, float]] = field(default_factory=list)
    floor: float = math.nan


def scatter_svg(panels: Mapping[str, Scatter], axes: Axes, *, floor: str, front: bool, salt: str) -> str:
    """One panel per setting, one labelled colour per subject; `floor` names the floor's line, `front` draws the front.

    The points of a subject are joined, so that its spread over the cases is one vertical stroke.
    Points without a place on the axes are left out. "" where nothing can be drawn.
    """
    places = ((x, {s: sorted(drawable(p, axes)) for s, p in panel.points.items()}) for x, panel in panels.items())
    drawn = {setting: {s: p for s, p in subjects.items() if p} for setting, subjects in places}
    drawn = {setting: subjects for setting, subjects in drawn.items() if subjects}
    if not drawn:
        return ""
    names = dict.fromkeys(s for subjects in drawn.values() for s in subjects)
    colours = {s: SERIES[i % len(SERIES)] for i, s in enumerate(names)}
    with _figure(salt) as figure:
        columns = min(len(drawn), 2)
        lines = math.ceil(len(drawn) / columns)
        figure.set_size_inches(10.6 if columns == 2 else 7.5, 3.7 * lines)
        grid = figure.subplots(lines, columns, sharey=True, squeeze=False).flatten()
        for panel, (setting, subjects) in zip(grid, drawn.items(), strict=False):
            panel.set(xscale=axes.x_scale, yscale=axes.y_scale, title=setting, xlabel=axes.x)
            for subject, points in subjects.items():
                x, y = zip(*points, strict=True)
                panel.plot(x, y, color=colours[subject], marker="o", markersize=4.5, linewidth=1)
            for subject, low, high, height in panels[setting].intervals:
                if subject in subjects:
                    panel.plot([low, high], [height, height], color=colours[subject], linewidth=1)
            panel.margins(x=0.3, y=0.1)
            every = [point for points in subjects.values() for point in points]
            if axes.x_scale == "linear" and min(every)[0] >= 0:
                panel.set_xlim(left=0)
            if math.isfinite(least := panels[setting].floor):
                panel.axvline(least, color=MUTED, linewidth=1, linestyle=(0, (1, 2)))
            if front:  # steps along the front, on to the panel's edges
                best, (_, right), (_, top) = pareto(every), panel.get_xlim(), panel.get_ylim()
                xs, ys = zip((best[0][0], top), *best, (right, best[-1][1]), strict=True)
                steps = [x for x in xs for _ in "xy"][1:], [y for y in ys for _ in "xy"][:-1]
                panel.plot(*steps, color=MUTED, linewidth=1, zorder=1, scalex=False, scaley=False)
            _ticks(panel, axes.logarithmic)
        _printable(figure)
        figure.draw_without_rendering()  # settles the layout that the labels' places depend on
        for panel, (setting, subjects) in zip(grid, drawn.items(), strict=False):
            # A subject's name is right of its highest point, that of the floor at the foot of its line: as near as it
            # covers no line and no other name.
            heads = {s: max(points, key=lambda p: p[1]) for s, points in subjects.items()}
            named: list[tuple[Any, ...]] = [(s, heads[s], colours[s], "data") for s in heads]
            named.sort(key=lambda label: -label[1][1])
            if math.isfinite(least := panels[setting].floor):
                named.append((floor, (least, 0), MUTED, ("data", "axes fraction")))
            paths = [line.get_transform().transform_path(line.get_path()) for line in panel.lines]
            inside, taken = panel.get_window_extent(), list[Any]()
            style = {"fontsize": 9.5, "va": "center", "textcoords": "offset pixels", "in_layout": False}
            for name, point, colour, coordinates in named:
                text = printable_lines(name)
                label = panel.annotate(text, point, PLACES[0], xycoords=coordinates, color=colour, **style)
                for label.xyann in (*PLACES, PLACES[0]):
                    box = label.get_window_extent()
                    covers = any(x.intersects_bbox(box, filled=False) or box.count_contains(x.vertices) for x in paths)
                    if not covers and not box.count_overlaps(taken) and inside.y0 < box.y0 < box.y1 < inside.y1:
                        break
                taken.append(box)
        for panel in grid[len(drawn) :]:
            panel.set_visible(False)
        for panel in figure.axes[::columns]:
            panel.set_ylabel(axes.y)
        return _page_svg(figure)


def pareto(points: Points) -> list[tuple[float, float]]:
    """The points that no other one beats or equals in both coordinates (less is better), by growing x."""
    front: list[tuple[float, float]] = []
    for x, y in sorted(points):
        if not front or y < front[-1][1]:
            front.append((x, y))
    return front


@contextmanager
def _figure(salt: str) -> Iterator[Figure]:
    """An empty figure in the page's style, which holds as long as the context."""
    import matplotlib

    style: Any = STYLE | {"svg.hashsalt": salt}
    with matplotlib.rc_context(style):
        from matplotlib.figure import Figure

        yield Figure(layout="constrained", dpi=72)


def _ticks(panel: Panel, which: str) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    for name in which:
        axis = panel.xaxis if name == "x" else panel.yaxis
        low, high = sorted(axis.get_view_interval())
        axis.set_major_locator(LogLocator(subs=(1,) if high / low > 50 else (1, 2, 5), numticks=9))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(FuncFormatter(lambda v, _: compact(v)))


def _printable(figure: Figure) -> None:
    """Make every text of the figure, names of subjects and cases among them, printable."""
    from matplotlib.text import Text

    for found in figure.findobj(Text):
        assert isinstance(found, Text)
        found.set_text(printable_lines(found.get_text()))


def _page_svg(figure: Figure) -> str:
    """The figure as an `<svg>` element for a page: no declarations, links, dates, or ids but those in use."""
    _printable(figure)
    buffer = io.StringIO()
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    figure.savefig(buffer, format="svg", transparent=True, metadata=nothing)
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<style .*?</style>", "", text, flags=re.S)
    text = re.sub(r' xmlns(:xlink)?="[^"]*"|(?<=<g) id="[^"]*"| version="1.1"', "", text)
    text = text.replace("xlink:href=", "href=")
    text = re.sub(r"\n\s*", "\n", re.sub(r"\d+\.\d{3,}", lambda m: f"{float(m[0]):.2f}", text))
    return re.sub(r"#0102[01][0-9a-f]", lambda m: f"var({VARIABLES[m[0]]})", text)

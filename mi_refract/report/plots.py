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

# Placeholder colours: matplotlib writes them, and `_page_svg` replaces each by a variable of the style sheet.
INK, MUTED, LINE = "#010203", "#010204", "#010205"
SERIES = [f"#0102{16 + i:02x}" for i in range(12)]
DASHED = (0, (4, 3))
# Candidate positions of a label relative to its point, in pixels, the nearest first.
PLACES = sorted(((x, y) for x in range(7, 130, 6) for y in range(-96, 97, 4)), key=lambda place: math.hypot(*place))
VARIABLES = {INK: "--ink", MUTED: "--muted", LINE: "--line"} | {c: f"--c{i}" for i, c in enumerate(SERIES)}

STYLE: dict[str, Any] = {
    "svg.fonttype": "none",  # text remains text: selectable, and in the page's font
    "text.parse_math": False,  # a dollar sign in a name is literal
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
    """Labels and scales of a plot, "log" or "linear"; `slope`: exponent of a dashed guide, y ~ x^slope.

    ValueError for another scale, and for a slope without two logarithmic axes.
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
        """The logarithmic axes: "", "x", "y" or "xy"."""
        return ("x" if self.x_scale == "log" else "") + ("y" if self.y_scale == "log" else "")


def drawable(points: Points, axes: Axes) -> list[tuple[float, float]]:
    """Return the points that can be drawn: finite, and positive on logarithmic scales."""
    x_low, y_low = (0 if scale == "log" else -math.inf for scale in (axes.x_scale, axes.y_scale))
    return [(x, y) for x, y in points if x_low < x < math.inf and y_low < y < math.inf]


def curves_svg(curves: Mapping[str, Points], axes: Axes, *, salt: str, size: tuple[float, float] = (5.3, 3.0)) -> str:
    """Return an SVG with one line per name, a legend, and a dashed guide of the axes' slope from the first point.

    Points that cannot be drawn are left out; "" if no point can be. `salt` makes the ids inside the SVG unique on the
    page; the same arguments give the same bytes. `size`: width and height in inches without the legend.
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
        # The legend is below the axes, with as many columns as its longest name allows.
        handles, names = panel.get_legend_handles_labels()
        columns = max(1, min(len(names), int(size[0] * 72 // (5 * max(map(len, names)) + 44))))
        figure.set_size_inches(size[0], size[1] + 0.21 * math.ceil(len(names) / columns))
        figure.legend(handles, names, loc="outside lower left", ncols=columns, borderaxespad=0, columnspacing=1.2)
        return _page_svg(figure)


@dataclass
class Scatter:
    """A panel: points by subject, intervals as (subject, low x, high x, y), and the x of the floor."""

    points: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    intervals: list[tuple[str, float, float, float]] = field(default_factory=list)
    floor: float = math.nan


def scatter_svg(panels: Mapping[str, Scatter], axes: Axes, *, floor: str, front: bool, salt: str) -> str:
    """Return an SVG with one panel per setting and one labelled colour per subject.

    `floor`: label of the floor's line. `front`: draw steps along the Pareto front. The points of a subject are joined,
    so that its spread over the cases is one vertical line. Points that cannot be drawn are left out; "" if no point
    can be.
    """
    drawn: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for setting, scatter in panels.items():
        by_subject = {subject: sorted(drawable(points, axes)) for subject, points in scatter.points.items()}
        if any(by_subject.values()):
            drawn[setting] = {subject: points for subject, points in by_subject.items() if points}
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
                panel.plot(x, y, color=colours[subject], marker="o", markersize=4.5)
            for subject, low, high, height in panels[setting].intervals:
                if subject in subjects:
                    panel.plot([low, high], [height, height], color=colours[subject], linewidth=1)
            panel.margins(x=0.3, y=0.1)
            all_points = [point for points in subjects.values() for point in points]
            if axes.x_scale == "linear" and min(all_points)[0] >= 0:
                panel.set_xlim(left=0)
            if math.isfinite(panels[setting].floor):
                panel.axvline(panels[setting].floor, color=MUTED, linewidth=1, linestyle=(0, (1, 2)))
            if front:  # steps along the front, and on to the panel's edges
                best, (_, right), (_, top) = pareto(all_points), panel.get_xlim(), panel.get_ylim()
                xs, ys = zip((best[0][0], top), *best, (right, best[-1][1]), strict=True)
                steps = [x for x in xs for _ in "xy"][1:], [y for y in ys for _ in "xy"][:-1]
                panel.plot(*steps, color=MUTED, linewidth=1, zorder=1, scalex=False, scaley=False)
            _ticks(panel, axes.logarithmic)
        _printable(figure)
        figure.draw_without_rendering()  # computes the layout, on which the positions of labels depend
        for panel, (setting, subjects) in zip(grid, drawn.items(), strict=False):
            # A subject's label is right of its highest point, that of the floor at the lower end of its line, at the
            # nearest position where it covers no line and no other label.
            labels: list[tuple[Any, ...]] = []  # text, point, colour, coordinates of the point
            for subject, points in subjects.items():
                labels.append((subject, max(points, key=lambda point: point[1]), colours[subject], "data"))
            labels.sort(key=lambda label: -label[1][1])
            if math.isfinite(panels[setting].floor):
                labels.append((floor, (panels[setting].floor, 0), MUTED, ("data", "axes fraction")))
            paths = [line.get_transform().transform_path(line.get_path()) for line in panel.lines]
            area, boxes = panel.get_window_extent(), list[Any]()
            style = {"fontsize": 9.5, "va": "center", "textcoords": "offset pixels", "in_layout": False}
            for name, point, colour, coordinates in labels:
                text = printable_lines(name)
                label = panel.annotate(text, point, PLACES[0], xycoords=coordinates, color=colour, **style)
                for label.xyann in (*PLACES, PLACES[0]):
                    box = label.get_window_extent()
                    covers = any(x.intersects_bbox(box, filled=False) or box.count_contains(x.vertices) for x in paths)
                    if not covers and not box.count_overlaps(boxes) and area.y0 < box.y0 < box.y1 < area.y1:
                        break
                boxes.append(box)
        for panel in grid[len(drawn) :]:
            panel.set_visible(False)
        for panel in figure.axes[::columns]:
            panel.set_ylabel(axes.y)
        return _page_svg(figure)


def pareto(points: Points) -> list[tuple[float, float]]:
    """Return the points that no other one beats or equals in both coordinates (smaller is better), by increasing x."""
    front: list[tuple[float, float]] = []
    for x, y in sorted(points):
        if not front or y < front[-1][1]:
            front.append((x, y))
    return front


@contextmanager
def _figure(salt: str) -> Iterator[Figure]:
    """Yield an empty figure; within the context, matplotlib has the page's style."""
    import matplotlib

    style: Any = STYLE | {"svg.hashsalt": salt}
    with matplotlib.rc_context(style):
        from matplotlib.figure import Figure

        yield Figure(layout="constrained", dpi=72)


def _ticks(panel: Panel, logarithmic: str) -> None:
    """Set the ticks of the logarithmic axes: "", "x", "y" or "xy"."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    for name in logarithmic:
        axis = panel.xaxis if name == "x" else panel.yaxis
        low, high = sorted(axis.get_view_interval())
        axis.set_major_locator(LogLocator(subs=(1,) if high / low > 50 else (1, 2, 5), numticks=9))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(FuncFormatter(lambda v, _: compact(v)))


def _printable(figure: Figure) -> None:
    """Sanitise every text of the figure, such as names of subjects and cases."""
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        text.set_text(printable_lines(text.get_text()))


def _page_svg(figure: Figure) -> str:
    """Return the figure as an `<svg>` element for a page, without declarations, links, dates and unused ids."""
    _printable(figure)
    buffer = io.StringIO()
    no_metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    figure.savefig(buffer, format="svg", transparent=True, metadata=no_metadata)
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<style .*?</style>", "", text, flags=re.S)
    text = re.sub(r' xmlns(:xlink)?="[^"]*"|(?<=<g) id="[^"]*"| version="1.1"', "", text)
    text = text.replace("xlink:href=", "href=")
    # Coordinates are rounded; numbers in the text between tags are not.
    text = re.sub(r">[^<]+<|\d+\.\d{3,}", lambda m: m[0] if m[0][0] == ">" else f"{float(m[0]):.2f}", text)
    text = re.sub(r"\n\s*", "\n", text)
    return re.sub(r"#0102[01][0-9a-f]", lambda m: f"var({VARIABLES[m[0]]})", text)

"""What a page shows: numbers as compact text, plots as SVG in the page's theme, pictures as halves."""

from __future__ import annotations

import base64
import io
import math
import re
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Points = Sequence[tuple[float, float]]

# Stand-in colours: matplotlib writes them, `_page_svg` turns each into the style sheet's variable.
INK, MUTED, LINE = "#010203", "#010204", "#010205"
SERIES = [f"#0102{16 + i:02x}" for i in range(10)]
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


def compact(value: float, digits: int = 3) -> str:
    """`value` in at most `digits` significant digits, whole numbers below 10⁵ in full: 1.23e-7, 8056."""
    if not math.isfinite(value):
        return str(float(value))
    if value == int(value) and abs(value) < 1e5:
        return str(int(value))
    if 1e3 <= abs(value) < 1e5:
        return f"{value:.{max(digits - 4, 0)}f}"
    if 1e-2 <= abs(value) < 1e3:
        return f"{value:.{digits}g}"
    mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
    return f"{mantissa.rstrip('0').rstrip('.') if '.' in mantissa else mantissa}e{int(exponent)}"


def apart(value: float, budget: float) -> tuple[str, str]:
    """Both as text, with as many digits as it takes to tell them apart when they differ."""
    for digits in range(3, 18):
        texts = compact(value, digits), compact(budget, digits)
        if texts[0] != texts[1] or value == budget:
            return texts
    return repr(value), repr(budget)


def drawable(points: Points, *, log_x: bool) -> list[tuple[float, float]]:
    """The points that have a place on the axes: finite, and positive where the axis is logarithmic."""
    return [(x, y) for x, y in points if math.isfinite(x) and 0 < y < math.inf and (x > 0 or not log_x)]


def curves_svg(curves: Mapping[str, Points], *, error: str, slope: float, salt: str) -> str:
    """Error against seconds, both logarithmic, with a dashed guide of `slope` from the first curve's start.

    Points without a place on logarithmic axes are left out. "" where nothing can be drawn.
    `salt` makes the ids inside the SVG unique on the page; the same arguments give the same bytes.
    """
    lines = {name: drawable(points, log_x=True) for name, points in curves.items()}
    if not any(lines.values()):
        return ""
    import matplotlib

    with matplotlib.rc_context(_style(salt)):
        from matplotlib.figure import Figure

        figure = Figure(figsize=(5.3, 3.3), layout="constrained", dpi=72)
        axes = figure.add_subplot(xscale="log", yscale="log", xlabel="seconds", ylabel=error)
        for i, (name, points) in enumerate(lines.items()):
            if points:
                style = {"color": SERIES[i % len(SERIES)], "marker": "o", "markersize": 3.5, "linewidth": 1.6}
                axes.plot(*zip(*points, strict=True), label=name, **style)  # type: ignore[arg-type]
        _guide(axes, [points for points in lines.values() if points], slope)
        _ticks(axes, "xy")
        axes.legend()
        return _page_svg(figure)


def scatter_svg(panels: Mapping[str, Mapping[str, Points]], *, x: str, y: str, salt: str) -> str:
    """One panel per setting: `x` linear, `y` logarithmic, one labelled colour per subject.

    The points of a subject are joined, so that its spread over the cases is one vertical stroke.
    Points without a place on the axes are left out. "" where nothing can be drawn.
    """
    drawn = {
        setting: {s: p for s, points in subjects.items() if (p := sorted(drawable(points, log_x=False)))}
        for setting, subjects in panels.items()
    }
    drawn = {setting: subjects for setting, subjects in drawn.items() if subjects}
    if not drawn:
        return ""
    import matplotlib

    with matplotlib.rc_context(_style(salt)):
        from matplotlib.figure import Figure

        columns = min(len(drawn), 2)
        lines = math.ceil(len(drawn) / columns)
        figure = Figure(figsize=(10.6 if columns == 2 else 7.5, 3.7 * lines), layout="constrained", dpi=72)
        grid = figure.subplots(lines, columns, sharey=True, squeeze=False).flatten()
        names = dict.fromkeys(s for subjects in drawn.values() for s in subjects)
        colours = {s: SERIES[i % len(SERIES)] for i, s in enumerate(names)}
        for axes, (setting, subjects) in zip(grid, drawn.items(), strict=False):
            axes.set(yscale="log", title=setting, xlabel=x)
            for subject, points in subjects.items():
                style = {"color": colours[subject], "marker": "o", "markersize": 4.5, "linewidth": 1}
                axes.plot(*zip(*points, strict=True), **style)
            axes.margins(x=0.3, y=0.1)
            if min(px for points in subjects.values() for px, _ in points) >= 0:
                axes.set_xlim(left=0)
            _ticks(axes, "y")
        figure.canvas.draw()  # settles the layout that the labels' places depend on
        for axes, subjects in zip(grid, drawn.values(), strict=False):
            _labels(axes, subjects, colours)
        for axes in grid[len(drawn) :]:
            axes.set_visible(False)
        for axes in figure.axes[::columns]:
            axes.set_ylabel(y)
        return _page_svg(figure)


def _style(salt: str) -> Any:
    return STYLE | {"svg.hashsalt": salt}


def _guide(axes: Axes, lines: list[list[tuple[float, float]]], slope: float) -> None:
    start, y = min(lines[0])
    stop = max(x for points in lines for x, _ in points)
    if stop > start:
        end = y * (stop / start) ** slope
        label = f"slope {slope:g}".replace("-", "−")
        axes.plot([start, stop], [y, end], color=MUTED, linewidth=1, linestyle=(0, (4, 3)), label=label)


def _ticks(axes: Axes, which: str) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    for name in which:
        axis = axes.xaxis if name == "x" else axes.yaxis
        low, high = sorted(axis.get_view_interval())
        axis.set_major_locator(LogLocator(subs=(1,) if high / low > 50 else (1, 2, 5), numticks=9))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(FuncFormatter(lambda v, _: compact(v)))


def _labels(axes: Axes, subjects: Mapping[str, Points], colours: Mapping[str, str]) -> None:
    """Name every subject beside its highest point, moved down where another name is in the way."""
    heads = {s: max(points, key=lambda p: p[1]) for s, points in subjects.items()}
    placed: list[tuple[float, float]] = []
    for subject, head in sorted(heads.items(), key=lambda item: -item[1][1]):
        x, y = axes.transData.transform(head)
        lowered = y
        while any(abs(x - px) < 95 and abs(lowered - py) < 13 for px, py in placed):
            lowered -= 1
        placed.append((x, lowered))
        offset = (7, lowered - y)
        text = {"fontsize": 9.5, "color": colours[subject], "va": "center", "textcoords": "offset pixels"}
        axes.annotate(subject, head, offset, **text)  # type: ignore[arg-type]


def _page_svg(figure: Figure) -> str:
    """The figure as an `<svg>` element for a page: no declarations, links, dates, or ids but those in use."""
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


class Pictures:
    """The pictures a page embeds: each file once, as base64 of the deflated planes of its half floats.

    A value past 65504 becomes infinite. Errors: see `embed`.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.embedded: dict[str, dict[str, Any]] = {}

    def embed(self, path: str) -> dict[str, Any]:
        """Key, width, height and data of a picture, by its path relative to the folder.

        Errors: FileNotFoundError where it is missing, ValueError where it is not RGB or gray; both name it.
        """
        if path not in self.embedded:
            pixels = _read_half(self.folder / path)
            height, width, _ = pixels.shape
            # High bytes, then low bytes: a tenth to a half smaller than the halves in a row.
            planes = pixels.view("u1").reshape(-1, 2)[:, ::-1].T.tobytes()
            data = base64.b64encode(zlib.compress(planes)).decode()
            key = f"p{len(self.embedded)}"
            self.embedded[path] = {"key": key, "width": width, "height": height, "data": data}
        return self.embedded[path]


def _read_half(path: Path) -> Any:
    """The RGB of an image file as little-endian float16, (height, width, 3); gray is repeated."""
    import numpy as np
    import OpenImageIO as oiio

    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such picture")
    file = oiio.ImageInput.open(str(path))
    if not file:
        raise ValueError(f"{path}: {' '.join(oiio.geterror().split())}")
    try:
        names, pixels = list(file.spec().channelnames), file.read_image(oiio.FLOAT)
        if pixels is None:
            raise ValueError(f"{path}: {' '.join(file.geterror().split())}")
    finally:
        file.close()
    wanted = ["R", "G", "B"] if {"R", "G", "B"} <= set(names) else names[:1] * 3 if len(names) == 1 else []
    if not wanted:
        raise ValueError(f"{path}: neither RGB nor gray, but channels {', '.join(names)}")
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(pixels[..., [names.index(name) for name in wanted]], dtype="<f2")

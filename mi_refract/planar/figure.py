"""Figures of planar scenes: media tinted by index, boundaries, and rays with an opacity that grows with their power.

Few rays are drawn as lines. Many rays are drawn as a density, accumulated in floating point: a faint line among
thousands would need an opacity of less than 1/255, which graphics libraries round to 0.
"""

from __future__ import annotations

import importlib.util
import io
import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mi_refract.io.image_file import srgb_encode
from mi_refract.io.safe_files import write_atomically

from . import focal_points
from .curves import points
from .light import linear_srgb
from .path_tree import Branches, count, mismatches, summary
from .scene_file import PlanarScene
from .segments import Array, Event, Segments

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = (".svg", ".png", ".pdf")
# Above this number of lines, or above this total length in diagonals of the view, rays are drawn as a density.
LINES, DIAGONALS = 6000, 150
DPI = {".png": 200, ".svg": 150, ".pdf": 150}  # for .svg and .pdf: resolution of embedded raster images
RAY, WHITE, INK, MUTED = "#c8102e", "#55504c", "#222222", "#6b6b6b"  # WHITE: all colours together, on paper
DENSE, THIN = (0.73, 0.85, 0.97), (1.00, 0.92, 0.70)  # tints of the media that differ most from the outermost one
NIGHT, MOON = (0.06, 0.07, 0.09), "#8a93a0"  # dark background and outlines, for rays with wavelengths
LINE = 0.13  # height of a line of the caption, in inches
LEGEND_SIZE = 5  # largest number of media in the legend
TYPICAL = 0.35  # opacity/(1 − opacity) of a typical density
MARKS = {Event.MAX_DEPTH: "o", Event.MEDIUM_MISMATCH: "x"}
UNDATED: dict[str, Any] = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}, ".png": {}}
TICKS = {"color": "#b5b5b5", "labelcolor": MUTED, "labelsize": 8}
STYLE: Any = {
    "svg.hashsalt": "mi_refract",  # the same scene gives the same bytes
    "text.parse_math": False,
    "font.size": 9,
    **{"axes.edgecolor": "#b5b5b5", "axes.linewidth": 0.6, "axes.labelcolor": MUTED, "axes.titlecolor": INK},
    **{"axes.titlesize": 11, "axes.titlelocation": "left", "axes.titlepad": 21},
    **{f"{axis}tick.{key}": x for axis in "xy" for key, x in TICKS.items()},
    **{"legend.frameon": False, "legend.fontsize": 8, "legend.labelcolor": INK},
}
MARGIN = 0.08  # around the scene, as a share of its larger side
FAR = 8  # the view grows by at most this factor to include a focus
SHARED = -1  # the colour number of legs that all colours share
SAMPLES = 2**22  # samples of lines processed at a time: 0.3 GB
View = tuple[float, float, float, float]  # x0, x1, y0, y1


def save(path: Path, scene: PlanarScene, traced: Sequence[Branches]) -> None:
    """Draw the scene into a file in the format of its suffix, one of FORMATS.

    ValueError as for `draw`; OSError if the file cannot be written. After an error, an existing file is unchanged.
    """
    content = draw(scene, traced, path.suffix.lower())
    try:
        write_atomically(path, content)
    except OSError as error:
        raise OSError(f"{path}: cannot be written: {error.strerror or error}") from None


def draw(scene: PlanarScene, traced: Sequence[Branches], suffix: str) -> bytes:
    """The content of the figure's file; equal arguments give equal bytes. ValueError if matplotlib is missing."""
    require_matplotlib()
    import matplotlib.style

    buffer = io.BytesIO()
    with matplotlib.style.context(["default", STYLE]):  # instead of the user's style
        figure = build_figure(scene, traced, DPI[suffix])
        figure.savefig(buffer, format=suffix[1:], dpi="figure", metadata=UNDATED[suffix])
    return buffer.getvalue()


def build_figure(scene: PlanarScene, traced: Sequence[Branches], dpi: float) -> Figure:
    """The figure in matplotlib's current style; it has one pair of axes, in the scene's units."""
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    foci = focal_points.foci(scene, traced)
    view = scene.view or around(scene, traced, foci)
    # The size without the caption, in inches: about the same area for every view, but not wider than a page.
    ratio = max((view[1] - view[0]) / (view[3] - view[2]), 0.25)
    height = max(min(5.2 / ratio**0.5, 10.4 / ratio, 7.0), 0.6)
    width, height = min(max(height * ratio, 3.6), 10.4) + 0.6, height + 0.95
    lines = [f"{scene.file}: {summary(scene, traced)}", *(f"× {line}" for line in mismatches(scene, traced))]
    if stopped := count(traced)["MAX_DEPTH"]:
        lines.append(f"○ {stopped} stopped after `max_depth` boundaries, with another one ahead")
    inside = ((foci >= view[::2]) & (foci <= view[1::2])).all(axis=1)
    if inside.any():
        lines.append("◇ focus: the point nearest to all rays of a beam")
    caption = [part for line in lines for part in textwrap.wrap(line, int(14 * width))]
    figure = Figure((width, height + LINE * len(caption)), dpi, layout="constrained")
    panel = figure.add_subplot(xlim=view[:2], ylim=view[2:], aspect="equal")
    panel.set_title("\n".join(textwrap.wrap(scene.heading, int(10.5 * width))))
    panel.set_xlabel("\n".join(caption), loc="left", fontsize=7.5)
    _draw_media(panel, scene)
    # Fix the layout, so that an image of the density can have exactly the pixels of the panel.
    layout = figure.get_layout_engine()
    assert layout is not None
    layout.set(w_pad=0.12, h_pad=0.12)  # type: ignore[call-arg]
    for _ in range(2):  # in the first pass the place of the title is not known yet
        layout.execute(figure)
    panel.apply_aspect()
    figure.set_layout_engine("none")
    # Boundaries, rays, and marks where a path ended without escaping.
    many = len(scene.segments[0]) > LINES
    outlines = curves(scene.segments[0], 5 if many else 33)
    ink = MOON if scene.light.wavelengths else INK
    style: dict[str, Any] = {"colors": ink, "capstyle": "round", "zorder": 1.5}
    style["linewidths"] = 0.7 * max(min(1.0, 8 / len(outlines)), 0.15)
    panel.add_collection(LineCollection(outlines, rasterized=many, **style))
    panel.plot(0, 0, "+", color=MUTED, markersize=5, markeredgewidth=0.6, zorder=1.4, scalex=False, scaley=False)
    _draw_rays(panel, scene, legs(traced, view))
    marks = {mark: np.concatenate([x.tips[x.end == event] for x in traced]) for event, mark in MARKS.items()}
    for mark, places in (marks | {"D": foci[inside]}).items():
        if len(places):
            size = min(1.0, (40 / len(places)) ** 0.5)
            style = {"markersize": 1 + 4 * size, "markeredgewidth": 0.9 * size, "fillstyle": "none"}
            panel.plot(*places.T, mark, color=ink, zorder=3, scalex=False, scaley=False, **style)
    return figure


def require_matplotlib() -> None:
    """ValueError, with the extra to install, if matplotlib is missing."""
    if importlib.util.find_spec("matplotlib") is None:
        raise ValueError("images need the extra `plot`: pip install 'mi-refract[plot]'")


def _draw_media(panel: Axes, scene: PlanarScene) -> None:
    """Tint regions by the rank of their index, paler near the rank of the outermost medium, and draw a legend."""
    from matplotlib.patches import Patch, Polygon

    outermost = float(np.mean(scene.index))
    means = [float(np.mean(region.indices)) for region in scene.regions]
    dark = bool(scene.light.wavelengths)
    # By rank, not by index: of 1, 1.45 and 1.48 the last two would look alike.
    ranked = sorted({outermost, *means})
    base = ranked.index(outermost)
    largest = max(base, len(ranked) - 1 - base, 1)
    tints = {n: _tint((rank - base) / largest, dark) for rank, n in enumerate(ranked)}
    panel.set_facecolor(tints[outermost])
    for region, n in zip(scene.regions, means, strict=True):
        style: dict[str, Any] = {"facecolor": tints[n], "edgecolor": "none", "zorder": 0.5}
        panel.add_patch(Polygon(region.outline, rasterized=len(region.outline) > LINES, **style))
    labels = {outermost: _label(scene.index)}
    labels |= {n: _label(region.indices) for region, n in zip(scene.regions, means, strict=True)}
    shown = sorted(labels)
    if len(shown) > LEGEND_SIZE:  # of many media, show the first, the last and some between
        shown = [shown[round(i * (len(shown) - 1) / (LEGEND_SIZE - 1))] for i in range(LEGEND_SIZE)]
    patches = [Patch(facecolor=tints[n], edgecolor="#999999", linewidth=0.5, label=labels[n]) for n in shown]
    place: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0, 1), "borderaxespad": 0.1, "borderpad": 0.2}
    panel.legend(handles=patches, ncols=len(patches), handlelength=1.2, columnspacing=1.2, **place)


def _tint(rank: float, dark: bool) -> tuple[float, float, float]:
    """A medium's colour by its rank, −1 … 1, above the outermost one: blue if denser, else yellow; `dark`: on dark."""
    hue = np.array(DENSE if rank > 0 else THIN)
    if dark:
        share = abs(rank) and 0.3 + 0.7 * abs(rank)
        red, green, blue = np.array(NIGHT) + 0.2 * share * hue
    else:
        share = abs(rank) and 0.15 + 0.85 * abs(rank) ** 1.5
        red, green, blue = 1 - share * (1 - hue)
    return float(red), float(green), float(blue)


def _label(indices: Sequence[float]) -> str:
    low, high = (f"{n:.4g}" for n in (min(indices), max(indices)))
    return f"n = {low}" if low == high else f"n = {low} – {high}"


# Rays ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Legs:
    """L lines from `start` to `end` (L × 2), with their shares of the power and the numbers of their colours."""

    start: Array
    end: Array
    weight: Array
    colour: NDArray[np.intp]

    @property
    def strength(self) -> Array:
        """The opacity of each line: the square root of its share of the power, so that 4 % is visible."""
        return np.sqrt(self.weight)


def _draw_rays(panel: Axes, scene: PlanarScene, lines: Legs) -> None:
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_rgb

    if scene.light.wavelengths:  # light adds up, while lines would cover each other
        rgb = linear_srgb(scene.light)
        _draw_density(panel, lines, {SHARED: rgb.sum(axis=0)} | dict(enumerate(rgb)), light=True)
        return
    colours = {}
    for number, name in [(SHARED, WHITE), *enumerate(scene.light.names)]:
        try:
            colours[number] = np.array(to_rgb(name or RAY))
        except ValueError:
            raise ValueError(f"{scene.path}: colours: {name!r}; expected a colour that matplotlib knows") from None
    x0, x1, y0, y1 = *panel.get_xlim(), *panel.get_ylim()
    crowd = np.hypot(*(lines.end - lines.start).T).sum() / math.hypot(x1 - x0, y1 - y0)
    if len(lines.start) > LINES or crowd > DIAGONALS:
        _draw_density(panel, lines, colours, light=False)
    elif len(lines.start):  # the more lines there are, the thinner and fainter they are; the strongest is on top
        room = min(1.0, (40 / crowd) ** 0.5)
        order = np.argsort(lines.weight, kind="stable")
        opacity = np.maximum(lines.strength[order] * room, 0.02)
        rgba = np.column_stack([np.array([colours[c] for c in lines.colour[order]]), opacity])
        strokes = list(np.stack([lines.start, lines.end], axis=1)[order])
        style: dict[str, Any] = {"colors": rgba, "linewidths": 0.4 + 0.8 * room, "zorder": 2}
        panel.add_collection(LineCollection(strokes, **style))


def _draw_density(panel: Axes, lines: Legs, colours: dict[int, Array], *, light: bool) -> None:
    """Draw the density of the legs as an image in the resolution of the panel: as light, or as ink."""
    box = panel.get_window_extent()
    view = *panel.get_xlim(), *panel.get_ylim()
    width, height = max(round(box.width), 1), max(round(box.height), 1)
    layers = {}
    for number in colours:
        own_lines = Legs(*(x[lines.colour == number] for x in vars(lines).values()))
        layers[number] = density(own_lines, view, width, height)
    # The sum of the layers (… × 3), and its size, by which it is divided to get the colour.
    if light:
        mixed = np.clip(sum(layers[number][..., None] * colours[number] for number in layers), 0, None)
        size = mixed.max(axis=2)
    else:  # the part that all colours have in common gets the colour of SHARED
        shared = layers.pop(SHARED)
        parts = np.stack(list(layers.values())) / len(layers)
        common = parts.min(axis=0) * (len(layers) > 1)
        shared = shared + common * len(layers)
        size = shared + (parts - common).sum(axis=0)
        mixed = shared[..., None] * colours[SHARED]
        for part, number in zip(parts - common, layers, strict=True):
            mixed += part[..., None] * colours[number]
    colour = np.divide(mixed, size[..., None], out=np.ones_like(mixed), where=size[..., None] > 0)
    covered = size[size > 0]
    # Scaled by the median alone, a beam beside faint reflections all over the view would be black; by the mean alone,
    # those reflections would be invisible.
    scaled = size * TYPICAL / math.sqrt(covered.mean() * np.median(covered)) if covered.size else size
    opacity = scaled / (1 + scaled)  # saturates later than 1 − exp(−scaled)
    rgba = np.dstack([colour, opacity])
    pixels = ((srgb_encode(rgba) if light else rgba) * 255).round().astype(np.uint8)
    style: dict[str, Any] = {"extent": view, "origin": "lower", "aspect": "equal", "zorder": 2}
    panel.imshow(pixels, **style)


# Geometry --------------------------------------------------------------------------------------------------------


def around(scene: PlanarScene, traced: Sequence[Branches], foci: Array) -> View:
    """The view of all boundaries, all places where rays meet them, and near foci (F × 2), with a margin.

    A focus is near if including it makes the view at most FAR times as long.
    """
    segments = scene.segments[0]
    places = [segments.start, segments.end, *(region.outline for region in scene.regions)]
    places += [branches.paths.points[:, 1:].reshape(-1, 2) for branches in traced]
    points = np.concatenate(places)
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    largest = FAR * float((high - low).max())
    for focus in foci:
        lower, upper = np.minimum(low, focus), np.maximum(high, focus)
        if (upper - lower).max() <= largest:
            low, high = lower, upper
    pad = MARGIN * (float((high - low).max()) or 1.0)
    return float(low[0] - pad), float(high[0] + pad), float(low[1] - pad), float(high[1] + pad)


def legs(traced: Sequence[Branches], view: View) -> Legs:
    """The legs inside the view, without duplicates; rays that escape end at its edge."""
    x0, x1, y0, y1 = view
    parts = []
    for number, branches in enumerate(traced):
        start, own = branches.paths.points, branches.own
        # NaN if there is no leg, as after the last boundary of a path that stopped.
        end = np.full_like(start, np.nan)
        end[:, :-1] = start[:, 1:]
        escaped = np.flatnonzero(branches.end == Event.ESCAPED)
        tips = branches.tips[escaped]
        reach = np.hypot(*(tips - [(x0 + x1) / 2, (y0 + y1) / 2]).T) + math.hypot(x1 - x0, y1 - y0)
        end[escaped, branches.last[escaped]] = tips + branches.paths.directions[escaped] * reach[:, None]
        colour = np.full(own.shape, number)
        if len(traced) > 1:  # the colours separate at the first boundary
            colour[:, 0] = SHARED
            own[:, 0] &= number == 0
        first, last, inside = clip(start[own], end[own], view)
        parts.append([x[inside] for x in (first, last, branches.weights[own], colour[own])])
    return Legs(*map(np.concatenate, zip(*parts, strict=True)))


def clip(start: Array, end: Array, view: View) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Lines (L × 2) clipped to the view, and whether any part of each is inside; False for NaN."""
    first, final = np.zeros(len(start)), np.ones(len(start))
    along = end - start
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis in range(2):
            sides = (np.array([[view[2 * axis]], [view[2 * axis + 1]]]) - start[:, axis]) / along[:, axis]
            first, final = np.maximum(first, sides.min(axis=0)), np.minimum(final, sides.max(axis=0))
        inside = first < final
        return start + along * first[:, None], start + along * final[:, None], inside


def density(lines: Legs, view: View, width: int, height: int) -> Array:
    """Σ strength × length in each pixel, divided by the pixel's side (height × width, row 0 at the bottom).

    A line is sampled at every pixel along its longer axis; the two nearest pixels across that axis share each sample.
    """
    x0, x1, y0, y1 = view
    scale = np.array([width / (x1 - x0), height / (y1 - y0)])
    start, end = ((p - [x0, y0]) * scale - 0.5 for p in (lines.start, lines.end))
    value, steep = lines.strength, np.abs(end - start)[:, 1] > np.abs(end - start)[:, 0]
    flat = _flat_density(start[~steep], end[~steep], value[~steep], height, width)
    return flat + _flat_density(start[steep, ::-1], end[steep, ::-1], value[steep], width, height).T


def _flat_density(start: Array, end: Array, value: Array, rows: int, columns: int) -> Array:
    """The density of lines of slope 45° or less; ends as (column, row) from the centre of the first pixel."""
    backward = (start[:, 0] > end[:, 0])[:, None]
    left, right = np.where(backward, end, start), np.where(backward, start, end)
    run, rise = (right - left).T
    slope = np.divide(rise, run, out=np.zeros(len(run)), where=run > 0)
    value = value * np.hypot(1, slope)
    first = np.ceil(left[:, 0]).astype(int)
    lengths = np.maximum(np.floor(right[:, 0]).astype(int) - first + 1, 0)
    total = np.zeros((rows + 2) * (columns + 2))  # with a frame of one pixel
    step = max(SAMPLES // columns, 1)
    for i in range(0, len(value), step):
        batch = slice(i, i + step)
        line = np.repeat(np.arange(len(value))[batch], lengths[batch])
        before = np.cumsum(lengths[batch]) - lengths[batch]
        column = first[line] + np.arange(len(line)) - np.repeat(before, lengths[batch])
        y = left[line, 1] + slope[line] * (column - left[line, 0])
        row = np.floor(y).astype(int)
        pixel = (row + 1) * (columns + 2) + column + 1
        upper = (y - row) * value[line]
        total += np.bincount(pixel, value[line] - upper, len(total))
        total += np.bincount(pixel + columns + 2, upper, len(total))
    return total.reshape(rows + 2, columns + 2)[1:-1, 1:-1]


def curves(segments: Segments, samples: int = 33) -> list[Array]:
    """The boundaries as polylines of `samples` points per arc; a boundary that starts at the previous end is joined."""
    places = points(segments, samples - 1 if segments.turn.any() else 1)
    breaks = np.flatnonzero((segments.start[1:] != segments.end[:-1]).any(axis=1)) + 1
    return [np.concatenate([run[:, :-1].reshape(-1, 2), run[-1:, -1]]) for run in np.split(places, breaks)]

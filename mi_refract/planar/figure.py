"""Figures of planar scenes: media tinted by index, boundaries, and rays with an opacity that grows with their power.

Few rays are drawn as lines. Of many the density is drawn, accumulated in floating point: a faint line among thousands
would need an opacity of less than 1/255, which graphics libraries round to 0.
"""

from __future__ import annotations

import importlib.util
import io
import math
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mi_refract.io.atomic import write_atomically
from mi_refract.io.pixels import srgb_encode
from mi_refract.io.sanitise import printable

from .figure_geometry import SHARED, Legs, around, curves, density, legs
from .light import linear_srgb
from .path_tree import Branches, count, summary
from .scene_file import PlanarScene
from .segments import Event, Segments

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = (".svg", ".png", ".pdf")
# Above this number of lines, or above this total length in diagonals of the view, the density is drawn.
LINES, DIAGONALS = 6000, 150
DPI = {".png": 200, ".svg": 150, ".pdf": 150}  # in the last two of raster images only
RAY, WHITE, INK, MUTED = "#c8102e", "#55504c", "#222222", "#6b6b6b"  # WHITE: all colours together, on paper
DENSE, THIN = (
    (0.73, 0.85, 0.97),
    (1.00, 0.92, 0.70),
)  # tints of the media whose index differs most from the outermost one
NIGHT, MOON = (0.06, 0.07, 0.09), "#8a93a0"  # around all shapes, and their outlines, behind rays that shine
LINE = 0.13  # inches
NAMED = 5  # media in the legend
TYPICAL = 0.35  # opacity/(1 − opacity) of a typical density, where that is drawn
MARKS = {
    Event.MAX_DEPTH: ("o", "○ {} stopped after `max_depth` boundaries, with another one ahead"),
    Event.MEDIUM_MISMATCH: ("x", "× {} stopped: the next boundary does not border on the medium that the ray is in"),
}
UNDATED: dict[str, Any] = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}, ".png": {}}
STYLE: Any = {
    "svg.hashsalt": "mi_refract",  # the same scene gives the same bytes
    "text.parse_math": False,
    "font.size": 9,
    "axes.edgecolor": "#b5b5b5",
    "axes.linewidth": 0.6,
    "axes.labelcolor": MUTED,
    "axes.titlecolor": INK,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "axes.titlepad": 21,
    "xtick.color": "#b5b5b5",
    "ytick.color": "#b5b5b5",
    "xtick.labelcolor": MUTED,
    "ytick.labelcolor": MUTED,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "legend.labelcolor": INK,
}


def save(path: Path, scene: PlanarScene, traced: Sequence[Branches]) -> None:
    """Draw the scene into a file, in the format of the path's suffix, one of FORMATS.

    ValueError as for `draw`; OSError where the file cannot be written. An error leaves no file, or the old one.
    """
    content = draw(scene, traced, path.suffix.lower())
    try:
        write_atomically(path, content)
    except OSError as error:
        raise OSError(f"{path}: cannot be written: {error.strerror or error}") from None


def draw(scene: PlanarScene, traced: Sequence[Branches], suffix: str) -> bytes:
    """The figure as the content of a file; equal arguments give equal bytes. ValueError without matplotlib."""
    require_matplotlib()
    import matplotlib.style

    buffer = io.BytesIO()
    with matplotlib.style.context(["default", STYLE]):  # not the user's style
        drawn = build_figure(scene, traced, DPI[suffix])
        drawn.savefig(buffer, format=suffix[1:], dpi="figure", metadata=UNDATED[suffix])
    return buffer.getvalue()


def build_figure(scene: PlanarScene, traced: Sequence[Branches], dpi: float) -> Figure:
    """The figure in matplotlib's current style; its only axes are in the scene's units."""
    from matplotlib.figure import Figure

    view = scene.view or around(scene, traced)
    # Without its caption, in inches: of about the same area for every view.
    ratio = min(max((view[1] - view[0]) / (view[3] - view[2]), 0.25), 4)
    height = min(5.2 / ratio**0.5, 7.0)
    width, height = max(height * ratio, 3.6) + 0.6, height + 0.95
    caption = _caption(scene, traced, int(14 * width))
    drawn = Figure((width, height + LINE * len(caption)), dpi, layout="constrained")
    panel = drawn.add_subplot(xlim=view[:2], ylim=view[2:], aspect="equal")
    panel.set_title("\n".join(textwrap.wrap(printable(" ".join(scene.title.split())), int(10.5 * width))))
    panel.set_xlabel("\n".join(caption), loc="left", fontsize=7.5)
    _media(panel, scene)
    _settle(drawn)
    _boundaries(panel, scene.segments[0], MOON if scene.light.wavelengths else INK)
    _rays(panel, scene, legs(traced, view))
    _ends(panel, traced)
    return drawn


def require_matplotlib() -> None:
    """ValueError, which says what to install, where matplotlib is missing."""
    if importlib.util.find_spec("matplotlib") is None:
        raise ValueError("images need the extra `plot`: pip install 'mi-refract[plot]'")


def _settle(drawn: Figure) -> None:
    """Fix the layout: after this an image of the density can have exactly the pixels of the panel."""
    layout = drawn.get_layout_engine()
    assert layout is not None
    layout.set(w_pad=0.12, h_pad=0.12)  # type: ignore[call-arg]
    for _ in range(2):  # the first pass does not know yet where the title is
        layout.execute(drawn)
    for panel in drawn.axes:
        panel.apply_aspect()
    drawn.set_layout_engine("none")


# Media and boundaries ----------------------------------------------------------------------------------------------


def _media(panel: Axes, scene: PlanarScene) -> None:
    """Tint regions by index, paler the closer it is to the outermost medium's; a legend of up to NAMED media."""
    from matplotlib.patches import Patch, Polygon

    around = float(np.mean(scene.index))
    means = [float(np.mean(region.indices)) for region in scene.regions]
    most = max((abs(n - around) for n in means), default=0)
    dark = bool(scene.light.wavelengths)
    tints = {n: _tint((n - around) / (most or 1), dark) for n in (around, *means)}
    panel.set_facecolor(tints[around])
    for region, n in zip(scene.regions, means, strict=True):
        style: dict[str, Any] = {"facecolor": tints[n], "edgecolor": "none", "zorder": 0.5}
        panel.add_patch(Polygon(region.outline, rasterized=len(region.outline) > LINES, **style))
    labels = {around: _label(scene.index)} | {n: _label(r.indices) for r, n in zip(scene.regions, means, strict=True)}
    shown = sorted(labels)
    if len(shown) > NAMED:  # of many layers the first, the last and some between
        shown = [shown[round(i * (len(shown) - 1) / (NAMED - 1))] for i in range(NAMED)]
    patches = [Patch(facecolor=tints[n], edgecolor="#999999", linewidth=0.5, label=labels[n]) for n in shown]
    place: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0, 1), "borderaxespad": 0.1, "borderpad": 0.2}
    panel.legend(handles=patches, ncols=len(patches), handlelength=1.2, columnspacing=1.2, **place)


def _tint(contrast: float, dark: bool) -> tuple[float, float, float]:
    """A medium's colour by its contrast to the outermost one, −1 … 1. Denser media are blue, thinner ones yellow.

    dark: behind rays that shine in their own colours.
    """
    hue = np.array(DENSE if contrast > 0 else THIN)
    if dark:
        share = abs(contrast) and 0.3 + 0.7 * abs(contrast)
        red, green, blue = np.array(NIGHT) + 0.2 * share * hue
    else:
        share = abs(contrast) and 0.15 + 0.85 * abs(contrast) ** 1.5
        red, green, blue = 1 - share * (1 - hue)
    return float(red), float(green), float(blue)


def _label(indices: Sequence[float]) -> str:
    low, high = (f"{n:.4g}" for n in (min(indices), max(indices)))
    return f"n = {low}" if low == high else f"n = {low} – {high}"


def _boundaries(panel: Axes, segments: Segments, ink: str) -> None:
    from matplotlib.collections import LineCollection

    many = len(segments) > LINES
    lines = curves(segments, 5 if many else 33)
    width = 0.7 * max(min(1.0, 8 / len(lines)), 0.15)
    style: dict[str, Any] = {"colors": ink, "linewidths": width, "capstyle": "round", "zorder": 1.5}
    panel.add_collection(LineCollection(lines, rasterized=many, **style), autolim=False)
    panel.plot(0, 0, "+", color=MUTED, markersize=5, markeredgewidth=0.6, zorder=1.4, scalex=False, scaley=False)


# Rays ------------------------------------------------------------------------------------------------------------


def strength(weight: Any) -> Any:
    """Opacity of a ray: the square root of its share of the power, so that 4 % can be seen."""
    return np.sqrt(weight)


def _rays(panel: Axes, scene: PlanarScene, lines: Legs) -> None:
    from matplotlib.colors import to_rgb

    if scene.light.wavelengths:  # light adds up where lines would cover each other
        _shade(panel, lines, {SHARED: np.ones(3)} | dict(enumerate(linear_srgb(scene.light))), _add_light)
        return
    colours = {}
    for number, name in [(SHARED, WHITE), *enumerate(scene.light.names)]:
        try:
            colours[number] = np.array(to_rgb(name or RAY))
        except ValueError:
            raise ValueError(f"{scene.path}: colours: {name!r}; expected a colour that matplotlib knows") from None
    x0, x1, y0, y1 = *panel.get_xlim(), *panel.get_ylim()
    crowd = np.hypot(*(lines.end - lines.start).T).sum() / math.hypot(x1 - x0, y1 - y0)
    if len(lines) > LINES or crowd > DIAGONALS:
        _shade(panel, lines, colours, _blend)
    elif len(lines):
        _stroke(panel, lines, colours, min(1.0, (40 / crowd) ** 0.5))


def _stroke(panel: Axes, lines: Legs, colours: dict[int, Any], room: float) -> None:
    """Draw each leg as a line, thinner and fainter the less room there is; the strongest on top."""
    from matplotlib.collections import LineCollection

    order = np.argsort(lines.weight, kind="stable")
    opacity = np.maximum(strength(lines.weight[order]) * room, 0.02)
    rgba = np.column_stack([np.array([colours[c] for c in lines.colour[order]]), opacity])
    strokes = np.stack([lines.start, lines.end], axis=1)[order]
    width = 0.4 + 0.8 * room
    panel.add_collection(LineCollection(list(strokes), colors=rgba, linewidths=width, zorder=2), autolim=False)


def _shade(panel: Axes, lines: Legs, colours: dict[int, Any], mix: Callable[[Any, Any], Any]) -> None:
    """Draw the density of the legs as an image, with as many pixels as the panel has."""
    box = panel.get_window_extent()
    view = *panel.get_xlim(), *panel.get_ylim()
    width, height = max(round(box.width), 1), max(round(box.height), 1)
    layers = {}
    for number in colours:
        layer = lines.where(lines.colour == number)
        layers[number] = density(layer, strength(layer.weight), view, width, height)
    style: dict[str, Any] = {"extent": view, "origin": "lower", "aspect": "equal", "zorder": 2}
    panel.imshow(mix(layers, colours), **style)


def _blend(layers: dict[int, Any], colours: dict[int, Any]) -> Any:
    """Densities by colour → RGBA in bytes. What all colours have in common gets the colour of SHARED."""
    shared = layers.pop(SHARED)
    parts = np.stack(list(layers.values())) / len(layers)
    common = parts.min(axis=0) * (len(layers) > 1)
    shared = shared + common * len(layers)
    total = shared + (parts - common).sum(axis=0)
    mixed = shared[..., None] * colours[SHARED]
    for part, number in zip(parts - common, layers, strict=True):
        mixed += part[..., None] * colours[number]
    lit = total[total > 0]
    # The median alone would make a beam black beside faint reflections all over the view; the mean, those white.
    dense = total * TYPICAL / math.sqrt(lit.mean() * np.median(lit)) if lit.size else total
    colour = np.divide(mixed, total[..., None], out=np.ones_like(mixed), where=total[..., None] > 0)
    pixels = np.dstack([colour, dense / (1 + dense)])  # saturates later than 1 − exp(−dense)
    return (pixels * 255).round().astype(np.uint8)


def _add_light(layers: dict[int, Any], colours: dict[int, Any]) -> Any:
    """Densities by wavelength → RGBA in bytes. Light adds up, and is as bright as its typical density is shown."""
    light = sum(layers[number][..., None] * np.asarray(colours[number]) for number in layers)
    light = np.clip(light, 0, None)
    peak = light.max(axis=2)
    lit = peak[peak > 0]
    dense = peak * TYPICAL / math.sqrt(lit.mean() * np.median(lit)) if lit.size else peak
    strong = srgb_encode(dense / (1 + dense))
    colour = srgb_encode(np.divide(light, peak[..., None], out=np.ones_like(light), where=peak[..., None] > 0))
    return (np.dstack([colour, strong]) * 255).round().astype(np.uint8)


def _ends(panel: Axes, traced: Sequence[Branches]) -> None:
    """Mark where a path ended without escaping."""
    for event, (mark, _) in MARKS.items():
        ends = np.concatenate([branches.tips[branches.end == event] for branches in traced])
        if len(ends):
            size = min(1.0, (40 / len(ends)) ** 0.5)
            style: dict[str, Any] = {"markersize": 1 + 4 * size, "markeredgewidth": 0.9 * size, "fillstyle": "none"}
            panel.plot(*ends.T, mark, color=INK, zorder=3, scalex=False, scaley=False, **style)


def _caption(scene: PlanarScene, traced: Sequence[Branches], width: int) -> list[str]:
    """The lines below the figure, of at most `width` characters each."""
    numbers = count(traced)
    notes = [text.format(numbers[event.name]) for event, (_, text) in MARKS.items() if numbers[event.name]]
    lines = [f"{printable(scene.path.name)}: {summary(scene, traced)}", *notes]
    return [part for line in lines for part in textwrap.wrap(line, width)]

"""Progress, warnings and preview of `mi-refract render`, and the parsing of quantities such as 1%, 10m, 1h30m.

Progress is a bar on a terminal, otherwise a line every 30 s.
"""

from __future__ import annotations

import contextlib
import math
import re
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from mi_refract.io.image_file import TO_XYZ, srgb_encode
from mi_refract.io.safe_files import write_atomically
from mi_refract.io.text import parse_number, printable
from mi_refract.rendering.end_conditions import RelativeError
from mi_refract.report.embedded_images import png

if TYPE_CHECKING:  # this import loads Mitsuba
    from mi_refract.rendering.long_render import LongRender

PLAIN = 0.1  # the largest share that is accepted without a percent sign
_SECONDS = {"d": 86400.0, "h": 3600.0, "m": 60.0, "s": 1.0}
BAR = 12  # width of the bar in characters: the text takes the rest of an 80-column terminal
BETWEEN_LINES = 30.0  # seconds between two lines, without a terminal
BETWEEN_ESTIMATES = 2.0  # least seconds between two estimates of the error for the bar
ESTIMATE_COST = 50.0  # wait at least this many times the duration of an estimate until the next one
BETWEEN_PREVIEWS = 10.0  # seconds


@contextlib.contextmanager
def shown(console: Console, rendering: LongRender, preview: Path | None) -> Iterator[Callable[[LongRender], None]]:
    """Yield a function to call after every pass: it prints progress and warnings, and writes the preview."""
    columns = BarColumn(BAR), TextColumn("{task.fields[text]}", markup=False)
    has_bar = console.is_terminal and not console.is_dumb_terminal
    began, done = time.monotonic(), rendering.progress.done
    last_line, last_preview, warned = began, -math.inf, 0
    between_lines = BETWEEN_ESTIMATES if has_bar else BETWEEN_LINES

    def warn() -> None:
        nonlocal warned
        for warning in rendering.warnings[warned:]:
            print(printable(f"mi-refract: {warning}"), file=sys.stderr, flush=True)
        warned = len(rendering.warnings)

    def watch(render: LongRender) -> None:
        nonlocal last_line, last_preview, between_lines
        now = time.monotonic()
        if now - last_line >= between_lines:
            text = _text(render, now - began, render.progress.done - done)
            bar.update(task, completed=render.progress.done, text=text)
            if not has_bar:
                print(printable(f"{render.output}: {text}"), file=sys.stderr, flush=True)
            last_line = time.monotonic()
            between_lines = max(between_lines, ESTIMATE_COST * (last_line - now))
        if preview is not None and (render.ended_by or now - last_preview >= BETWEEN_PREVIEWS):
            last_preview = now
            write_preview(preview, render)
        warn()

    with Progress(*columns, console=console, transient=True, disable=not has_bar) as bar:
        task = bar.add_task("", total=rendering.spp, completed=done, text="first pass")
        try:
            yield watch
        finally:
            warn()  # after an error, too: the last checkpoint may have added warnings


def _text(rendering: LongRender, seconds: float, new: int) -> str:
    """Return one line of progress for a render that added `new` samples per pixel in `seconds`."""
    passes, count, done = rendering.plan.passes, rendering.progress.passes, rendering.progress.done
    parts = [f"pass {count} of {passes + rendering.progress.first}" if passes else f"{count} passes"]
    width, height = rendering.renderer.size
    rate, error = new / seconds, rendering.error()
    left = [(rendering.spp - done) / rate] if rendering.spp and rate else []
    if error is not None and math.isfinite(error.value):
        if (until := rendering.limits.until) and rate and math.isfinite(error.high):
            left.append(done * ((error.high / until) ** 2 - 1) / rate)
        parts.append(f"error {shown_error(error)}")
    if rendering.limits.seconds:
        left.append(rendering.limits.seconds - seconds)
    if left:
        parts.insert(1, f"{max(0.0, min(left)):.0f} s left")
    return ", ".join([*parts, f"{rate * width * height / 1e6:.3g} M samples/s", f"{done} spp"])


def write_preview(path: Path, rendering: LongRender) -> None:
    """Write the current image as an sRGB PNG file. If that fails, add a warning to the render."""
    if (image := rendering.image()) is None:
        return
    colours = 3 if rendering.renderer.colours >= 3 else 1
    linear = np.nan_to_num(image[..., :colours], posinf=1e38, neginf=-1e38)  # the matrix may not overflow
    if rendering.renderer.channels[:3] == ("X", "Y", "Z"):
        linear = linear @ np.linalg.inv(TO_XYZ).T
    linear = np.clip(linear, 0, 1)
    rgb = np.broadcast_to(np.rint(255 * srgb_encode(linear)), (*linear.shape[:2], 3)).astype(np.uint8)
    try:
        write_atomically(path, png(rgb))
    except OSError as error:
        rendering.warnings.append(f"{path}: no preview: {error.strerror or error}")


def parse_share(text: str, option: str) -> float:
    """Return the share that `1%` or `0.01` stands for, at most 1.

    ValueError for anything else, and for numbers above PLAIN without a percent sign: `0.5` could mean 0.5 % or 50 %.
    """
    number, percent = (text[:-1], True) if text.endswith("%") else (text, False)
    try:
        value = parse_number(number) / (100 if percent else 1)
    except ValueError:
        value = 0.0
    if not 0 < value <= (1 if percent else PLAIN):
        expected = f"expected more than 0 %, up to 100 %, such as 1% or 0.01 (up to {PLAIN} without %)"
        raise ValueError(f"{option} {text}; {expected}")
    return value


def parse_seconds(text: str, option: str) -> float:
    """Return the seconds of `90`, `90s`, `10m`, `1h30m` or `2d`, more than 0. ValueError for anything else."""
    number = r"\d{1,9}(?:\.\d{1,9})?"
    parts = re.fullmatch(rf"(?:({number})d)?(?:({number})h)?(?:({number})m)?(?:({number})s?)?", text)
    counts = zip(parts.groups(), _SECONDS.values(), strict=True) if parts else ()
    seconds = sum(float(count) * unit for count, unit in counts if count)
    if not seconds > 0:
        raise ValueError(f"{option} {text}; expected a time of more than 0, such as 90s, 10m or 1h30m")
    return seconds


def shown_error(error: RelativeError) -> str:
    """Return an estimate with its interval, if it has one: `0.42 % (0.4 to 0.44 %)`; or `at most 0.42 %`."""
    value, low, high = (f"{float(f'{100 * share:.2g}'):g}" for share in (error.value, error.low, error.high))
    interval = f" ({low} to {high} %)" if math.isfinite(error.high) else ""
    return f"{'at most ' * error.at_most}{value} %{interval}"

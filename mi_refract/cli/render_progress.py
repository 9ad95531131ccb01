"""What `mi-refract render` shows while it renders: a bar on a terminal, else a line now and then, and a preview."""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from mi_refract.io.atomic import write_atomically
from mi_refract.io.pixels import srgb_encode
from mi_refract.io.sanitise import printable
from mi_refract.report.thumbnails import png

from .quantities import shown_error

if TYPE_CHECKING:  # it imports Mitsuba
    from mi_refract.rendering.long_render import LongRender

BAR = 12  # characters: of a terminal of 80 the text takes the others
BETWEEN_LINES = 30.0  # seconds, where there is no terminal
BETWEEN_LOOKS = 2.0  # seconds between two estimates of the error for the bar, at least
LOOK_COST = 50.0  # times what an estimate takes is the least time between two
BETWEEN_PREVIEWS = 10.0  # seconds


@contextlib.contextmanager
def shown(console: Console, rendering: LongRender, preview: Path | None) -> Iterator[Callable[[LongRender], None]]:
    """Within, what it yields is to be called after every pass."""
    columns = BarColumn(BAR), TextColumn("{task.fields[said]}", markup=False)
    moving = console.is_terminal and not console.is_dumb_terminal
    with Progress(*columns, console=console, transient=True, disable=not moving) as bar:
        done = rendering.progress.done
        task = bar.add_task("", total=rendering.spp, completed=done, said="first pass")

        def line(text: str) -> None:
            bar.update(task, completed=rendering.progress.done, said=text)
            if not moving and text:
                print(printable(f"{rendering.output}: {text}"), file=sys.stderr, flush=True)

        watch = _Watch(line, preview, BETWEEN_LOOKS if moving else BETWEEN_LINES, done)
        try:
            yield watch
        finally:
            watch.warn(rendering)  # also of the last checkpoint, after an error


class _Watch:
    """After a pass: a line, the preview, and warnings, each where it is due."""

    def __init__(self, line: Callable[[str], None], preview: Path | None, between_lines: float, done: int) -> None:
        self.line, self.preview, self.between_lines = line, preview, between_lines
        self.began = self.last_line = time.monotonic()
        self.done, self.last_preview, self.warned = done, -math.inf, 0

    def __call__(self, rendering: LongRender) -> None:
        now = time.monotonic()
        if now - self.last_line >= self.between_lines:
            self.line(self._said(rendering, now))
            self.last_line = time.monotonic()
            self.between_lines = max(self.between_lines, LOOK_COST * (self.last_line - now))
        if self.preview is not None and now - self.last_preview >= BETWEEN_PREVIEWS:
            self.last_preview = now
            write_preview(self.preview, rendering)
        self.warn(rendering)

    def warn(self, rendering: LongRender) -> None:
        """Print the warnings that are new."""
        for warning in rendering.warnings[self.warned :]:
            print(printable(f"mi-refract: {warning}"), file=sys.stderr, flush=True)
        self.warned = len(rendering.warnings)

    def _said(self, rendering: LongRender, now: float) -> str:
        passes, count, done = rendering.plan.passes, rendering.progress.passes, rendering.progress.done
        parts = [f"pass {count} of {passes + rendering.progress.first}" if passes else f"{count} passes"]
        width, height = rendering.renderer.size
        rate = (done - self.done) / (now - self.began)  # spp a second
        error = rendering.error()
        left = [(rendering.spp - done) / rate] if rendering.spp and rate else []
        if error is not None and math.isfinite(error.value):
            if (until := rendering.limits.until) and rate and math.isfinite(error.high):
                left.append(done * ((error.high / until) ** 2 - 1) / rate)
            parts.append(f"error {shown_error(error)}")
        if rendering.limits.seconds:
            left.append(rendering.limits.seconds - (now - self.began))
        if left:
            parts.insert(1, f"{max(0.0, min(left)):.0f} s left")
        parts += [f"{rate * width * height / 1e6:.3g} M samples/s", f"{done} spp"]
        return ", ".join(parts)


def write_preview(path: Path, rendering: LongRender) -> None:
    """Write the image so far as a PNG file, sRGB. A failure is a warning of the render's."""
    image = rendering.image()
    if image is None:
        return
    shown = np.clip(np.nan_to_num(image[..., : 3 if image.shape[-1] >= 3 else 1]), 0, 1)
    rgb = np.broadcast_to(np.rint(255 * srgb_encode(shown)), (*shown.shape[:2], 3)).astype(np.uint8)
    try:
        write_atomically(path, png(rgb))
    except OSError as error:
        rendering.warnings.append(f"{path}: no preview: {error.strerror or error}")

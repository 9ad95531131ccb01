"""A progress bar, as ball arithmetic takes many seconds."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

CHUNK = 256  # rays


def watched(count: int, progress: bool) -> Iterator[slice]:
    """Slices of at most CHUNK rays; past two seconds, a progress bar."""
    start, bar, task = time.monotonic(), None, None
    try:
        for first in range(0, count, CHUNK):
            yield slice(first, min(first + CHUNK, count))
            if progress and bar is None and time.monotonic() - start > 2:
                bar, task = _progress_bar(count)
                progress = bar is not None
            if bar is not None:
                bar.update(task, completed=min(first + CHUNK, count))
    finally:
        if bar is not None:
            bar.stop()


def _progress_bar(count: int) -> tuple[Any, Any]:
    """A started rich bar on stderr and its task; (None, None) without rich, or where stderr is no terminal."""
    try:
        from rich.console import Console
        from rich.progress import Progress
    except ImportError:
        return None, None
    console = Console(stderr=True)
    if not console.is_terminal:
        return None, None
    bar = Progress(console=console, transient=True)
    bar.start()
    return bar, bar.add_task("oracle", total=count)

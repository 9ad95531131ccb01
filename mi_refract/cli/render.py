"""The command `mi-refract render`: a Mitsuba scene into an EXR file."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

from mi_refract import backend
from mi_refract.io import atomic
from mi_refract.io.outside_text import printable
from mi_refract.rendering import scene_files


def render(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.xml", help="The scene, in Mitsuba's XML.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT.exr", help="The image to write.")],
    define: Annotated[
        list[str] | None,
        typer.Option("-D", metavar="NAME=VALUE", help="Replace the value of a <default>; may be repeated."),
    ] = None,
    variant: Annotated[
        str | None, typer.Option(help="A Mitsuba variant; without it llvm_ad_rgb where that runs, else scalar_rgb.")
    ] = None,
    spp: Annotated[
        int | None, typer.Option(min=1, max=2**32 - 1, help="Samples per pixel; without it what the scene says.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Seed of the sampler.")] = 0,
    allow_plugins: Annotated[
        list[str] | None,
        typer.Option("--allow-plugins", metavar="NAME", help="Run this plugin, which the scene brings, too."),
    ] = None,
) -> None:
    """Render a Mitsuba scene into an EXR file that says how it was made.

    The scene may use the plugins `refract` and `refract_path`, which Mitsuba's own executable does not know.
    """
    defines = scene_files.parse_defines(define or [])
    chosen = backend.activate(variant, may_restart=True)
    console = Console(stderr=True)
    with _interruptible(console), _spinner(console, f"{scene.name}, {chosen}"):
        header = scene_files.render_to_exr(
            scene, output, defines=defines, spp=spp, seed=seed, allow_plugins=allow_plugins or []
        )
    done = f"{header['mi_refract:spp']} spp, {header['mi_refract:render_seconds']:.2f} s"
    print(printable(f"{output}: {chosen}, {done}"))
    if variant is None and not backend.llvm().usable:
        print(printable(f"mi-refract: {chosen} is slow; {backend.summary()}"), file=sys.stderr)


def _spinner(console: Console, text: str) -> contextlib.AbstractContextManager[Any]:
    return console.status(Text(printable(text))) if console.is_terminal else contextlib.nullcontext()


@contextlib.contextmanager
def _interruptible(console: Console) -> Iterator[None]:
    """Within, Ctrl-C ends the process at once with exit code 130, and removes a file that is only half written.

    Python's own handler would wait until Mitsuba returns from the whole rendering. But the interpreter writes a byte
    as soon as a signal comes, and a thread of ours waits for that byte.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    before = signal.set_wakeup_fd(writing)
    # Also in a background job, for which the shell ignores Ctrl-C: Mitsuba heeds it all the same.
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)

    def watch() -> None:
        for number in iter(lambda: os.read(reading, 1), b""):
            if number[0] == signal.SIGINT:
                atomic.remove_unfinished()
                if console.is_terminal:
                    console.show_cursor(True)
                os._exit(130)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        signal.set_wakeup_fd(before)
        os.close(writing)
        thread.join()
        os.close(reading)

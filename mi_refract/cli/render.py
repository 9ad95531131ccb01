"""The command `mi-refract render`: a Mitsuba scene into an EXR file."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

from mi_refract import backend
from mi_refract.io.outside_text import printable
from mi_refract.rendering import scene_files

from . import variants


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
    chosen = variants.activate(variant)
    console = Console(stderr=True)
    with _spinner(console, f"{scene.name}, {chosen}"):
        header = scene_files.render_to_exr(
            scene, output, defines=defines, spp=spp, seed=seed, allow_plugins=allow_plugins or []
        )
    done = f"{header['mi_refract:spp']} spp, {header['mi_refract:render_seconds']:.2f} s"
    print(printable(f"{output}: {chosen}, {done}"))
    if variant is None and not backend.llvm().usable:
        print(printable(f"mi-refract: {chosen} is slow; {backend.summary()}"), file=sys.stderr)


def _spinner(console: Console, text: str) -> contextlib.AbstractContextManager[Any]:
    return console.status(Text(printable(text))) if console.is_terminal else contextlib.nullcontext()

"""The command `mi-refract render`: it renders a Mitsuba scene into an EXR file, in passes."""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.text import Text

from mi_refract import backend
from mi_refract.cluster import on_worker
from mi_refract.cluster.connection import ClusterTarget, connected
from mi_refract.cluster.workers import Workers
from mi_refract.io.errors import UsageError
from mi_refract.io.text import printable
from mi_refract.rendering import scene_files

from . import interrupts
from .app import AllowPlugins, Define
from .doctor import activate
from .render_progress import parse_seconds, parse_share, shown, shown_error

if TYPE_CHECKING:  # this import loads Mitsuba
    from mi_refract.rendering.long_render import LongRender, Passes


def render(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.xml", help="The scene, in Mitsuba's XML.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT.exr", help="The image to write.")],
    define: Define = None,
    variant: Annotated[
        str | None, typer.Option(help="Mitsuba variant. Default: llvm_ad_rgb where it runs, else scalar_rgb.")
    ] = None,
    spp: Annotated[
        int | None, typer.Option(min=1, max=2**32 - 1, help="Samples per pixel. Default: the number in the scene.")
    ] = None,
    until: Annotated[
        str | None, typer.Option(metavar="SHARE", help="Stop when the relative RMSE falls below this, e.g. 1%.")
    ] = None,
    until_tile: Annotated[
        str | None,
        typer.Option(
            metavar="SHARE",
            help="Stop when the 99th-percentile relative error over 16 × 16 tiles that are not black is below this.",
        ),
    ] = None,
    duration: Annotated[
        str | None, typer.Option("--time", metavar="TIME", help="Stop after this time, e.g. 90s, 10m, 1h30m.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Seed of the sampler.")] = 0,
    pass_spp: Annotated[
        int | None, typer.Option(min=1, max=2**32 - 1, help="Samples per pixel in one pass; fewer need less memory.")
    ] = None,
    settings: Annotated[
        str | None,
        typer.Option(
            metavar="auto|NAME=VALUE,…",
            help="Replace the scene's sampler, integrator (path, refract_path), split_depth or caustics; auto: a short "
            "pilot render measures which settings are faster.",
        ),
    ] = None,
    restart: Annotated[
        bool, typer.Option("--restart", help="Start over; ignore any checkpoint or existing image.")
    ] = False,
    preview: Annotated[
        Path | None, typer.Option(metavar="X.png", help="Write a preview of the image every 10 seconds and at the end.")
    ] = None,
    allow_plugins: AllowPlugins = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Render on the workers of this Dask scheduler: tcp://host:8786."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, max=1024, help="Number of single-threaded worker processes (Dask).")
    ] = None,
    bundle_limit: Annotated[
        int,
        typer.Option(min=1, metavar="MIB", help="Largest total size of a scene's files to send to workers, in MiB."),
    ] = 256,
    mixed_workers: Annotated[
        bool,
        typer.Option(
            "--mixed-workers",
            help="Accept workers with another libLLVM or vector width; the image's bits then depend on the workers.",
        ),
    ] = False,
) -> None:
    """Render a Mitsuba scene into an EXR file with per-channel variance and provenance metadata.

    An interrupted render resumes from its checkpoint; a finished image with fewer samples is refined. The scene may
    use the plugins `refract` and `refract_path`, which Mitsuba's own executable does not have.
    """
    from mi_refract.io.safe_files import writable

    defines = scene_files.parse_defines(define or [])
    cluster = ClusterTarget(scheduler, workers)
    if mixed_workers and not cluster.given:
        raise UsageError("--mixed-workers requires --scheduler ADDRESS or --workers N")
    cluster.check()
    if cluster.given and allow_plugins:
        text = f"--allow-plugins {min(allow_plugins)}: native code is not sent to workers"
        raise UsageError(f"{text}; remove --scheduler or --workers")
    share = None if until is None else parse_share(until, "--until")
    tile_share = None if until_tile is None else parse_share(until_tile, "--until-tile")
    seconds = None if duration is None else parse_seconds(duration, "--time")
    if preview is not None:
        writable(preview, (".png",))
    active_variant = activate(variant)
    from mi_refract.rendering.end_conditions import Limits
    from mi_refract.rendering.long_render import Job, resume
    from mi_refract.rendering.render_settings import OWN

    limits = Limits(spp, share, tile_share, seconds, pass_spp)
    job = Job(scene, defines, seed, tuple(allow_plugins or ()), OWN if settings is None else settings)
    # FORCE_COLOR must not turn a pipe into a terminal.
    console = Console(stderr=True, force_terminal=sys.stderr.isatty())
    spinner = console.status(Text(printable(f"{scene.name}, {active_variant}"))) if console.is_terminal else None
    with spinner or contextlib.nullcontext():
        rendering = resume(job, output, limits, restart=restart)
    if rendering.missing:
        print(printable(f"mi-refract: {scene}: missing {rendering.missing}"), file=sys.stderr)
    for line in rendering.pilot_lines():
        print(printable(f"{output}: {line}"), file=sys.stderr)
    if rendering.progress.passes:
        state = "complete with" if rendering.end() else "resuming from"
        print(printable(f"{output}: {state} {rendering.progress.done} spp"), file=sys.stderr)
    with (
        cluster_passes(cluster, rendering, str(active_variant), bundle_limit, mixed=mixed_workers) as passes,
        interrupts.last_act(rendering.give_up),
        shown(console, rendering, preview) as watch,
    ):
        header = rendering.run(watch, passes)
    count, error = rendering.progress.passes, rendering.error()
    text = f"{output}: {active_variant}, {header['mi_refract:spp']} spp in {count} pass{'es' if count != 1 else ''}"
    text += f", {header['mi_refract:render_seconds']:.2f} s"
    if error is not None and math.isfinite(error.value):
        text += f", relative error {shown_error(error)}"
    has_all_samples = rendering.progress.done == rendering.spp
    print(printable(text if has_all_samples else f"{text}; ended by {rendering.ended_by}"))
    if bad := header["mi_refract:nonfinite_pixels"]:
        print(printable(f"mi-refract: {output}: {bad} pixels are not finite"), file=sys.stderr)
    if variant is None and not backend.llvm().usable:
        print(printable(f"mi-refract: {active_variant} is slow; {backend.summary()}"), file=sys.stderr)


@contextlib.contextmanager
def cluster_passes(
    target: ClusterTarget, rendering: LongRender, variant: str, bundle_limit: int, *, mixed: bool
) -> Iterator[Passes | None]:
    """Yield the function that renders passes on workers; None to render in this process.

    Refused workers are listed on stderr. ValueError for a scene that cannot be sent; ConnectionError if no scheduler
    answers or no worker is usable.
    """
    if not target.given or rendering.end():
        yield None
        return
    from mi_refract.rendering import scene_bundle
    from mi_refract.rendering.cluster_passes import ClusterPasses

    def warn(text: str) -> None:
        print(printable(f"mi-refract: {text}"), file=sys.stderr, flush=True)

    bundle = scene_bundle.pack(rendering.parsed, bundle_limit)
    with connected(target.scheduler, target.workers) as client:
        tolerated = on_worker.MIXED if mixed else ()
        workers = Workers(client, variant, on_worker.facts(variant), tolerated, warn, task="render")
        workers.wait()
        passes = ClusterPasses(workers, bundle, variant, rendering.job.seed, rendering.warnings.append)
        try:
            yield passes.nodes
        finally:
            passes.close()

"""The commands `mi-refract rays export|check|run`."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mi_refract.cluster.connection import ClusterTarget
from mi_refract.io.atomic import writable
from mi_refract.io.sanitise import printable
from mi_refract.ray_sets import files, ray_set, run_program
from mi_refract.ray_sets.ray_set import RaySet

from .interrupts import as_exceptions
from .rays_options import (
    Backward,
    CheckOptions,
    Count,
    File,
    Formula,
    Json,
    Junit,
    MadeRays,
    Medium,
    Precision,
    Regime,
    Regimes,
    Report,
    Seed,
    Tir,
    TwoSided,
    Wavelengths,
)

if TYPE_CHECKING:
    from mi_refract.ray_sets.renderer_file import RaysCommand, RendererFile

app = typer.Typer(
    help="Check the refraction of other programs against certified answers.",
    add_completion=False,
    rich_markup_mode=None,
)


@app.command()
def export(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT.csv|.npz|.exr", help="The file to write.")],
    regime: Regime = None,
    count: Count = ray_set.COUNT,
    precision: Precision = ray_set.PRECISION,
    seed: Seed = 0,
    two_sided: TwoSided = False,
    medium: Medium = None,
    wavelengths: Wavelengths = None,
    regimes: Regimes = False,
) -> None:
    """Write rays for another program: incident directions, normals and indices of refraction."""
    writable(output, files.SUFFIXES)
    made = MadeRays(regime, count, precision, seed, two_sided, medium, wavelengths)
    rays = ray_set.make(**made.arguments)
    files.write(output, rays)
    print(printable(f"{output}: {_summary(rays)}"))


@app.command()
def check(
    answers: Annotated[
        Path, typer.Argument(metavar="ANSWERS.csv|.npz|.exr", help="id, bx, by, bz[, transmitted][, n_ratio].")
    ],
    file: File = None,
    tir: Tir = "auto",
    formula: Formula = None,
    backward: Backward = None,
    regime: Regime = None,
    count: Count = ray_set.COUNT,
    precision: Precision = ray_set.PRECISION,
    seed: Seed = 0,
    two_sided: TwoSided = False,
    medium: Medium = None,
    wavelengths: Wavelengths = None,
    report: Report = None,
    junit: Junit = None,
    json: Json = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Certify on the workers of this Dask scheduler.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, max=1024, help="Number of worker processes that certify (Dask).")
    ] = None,
) -> None:
    """Check answers against certified ones. Exit code 0: right, 1: wrong, 2: the answers do not match the rays.

    Without --rays: the rays that `export` generates with the same options. The answers file never selects the rays.
    """
    target = ClusterTarget(scheduler, workers)
    options = CheckOptions(tir, formula, backward, report, junit, json, target)
    made = MadeRays(regime, count, precision, seed, two_sided, medium, wavelengths)
    chosen = _chosen(file, made.words)
    rays = files.read(file) if file else ray_set.make(**made.arguments)
    given = files.read_answers(answers, most=files.most_answers(rays))
    origin = "" if chosen else ", as of `export` without options; others: --rays FILE"
    print(printable(f"{answers}: {_summary(rays)}{origin}"))
    raise typer.Exit(options.check(rays, given, str(answers), ["check", str(answers), *chosen, *options.words]))


@app.command()
def run(
    command: Annotated[
        list[str] | None, typer.Argument(metavar="-- COMMAND", help="It reads rays and writes answers, as CSV.")
    ] = None,
    renderer: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="In place of COMMAND: every function of FOLDER/mi-refract-renderer.toml."),
    ] = None,
    file: File = None,
    regime: Regime = None,
    count: Count = ray_set.COUNT,
    precision: Annotated[
        str | None, typer.Option(help="f32 (default) or f64; of a renderer, that of each function.")
    ] = None,
    seed: Seed = 0,
    two_sided: TwoSided = False,
    medium: Medium = None,
    wavelengths: Wavelengths = None,
    tir: Tir = "auto",
    formula: Formula = None,
    backward: Backward = None,
    timeout: Annotated[
        float, typer.Option(min=0, metavar="SECONDS", help="Time limit of the command, up to a week.")
    ] = run_program.TIMEOUT,
    report: Report = None,
    junit: Junit = None,
    json: Json = None,
) -> None:
    """Run a command on rays and check its answers: rays go to its stdin, answers come from its stdout.

    Exit code 0: right, 1: wrong, 2: the answers do not match the rays, or the command fails or takes too long. With
    --renderer, the largest exit code of its functions.
    """
    options = CheckOptions(tir, formula, backward, report, junit, json)
    made = MadeRays(regime, count, precision or ray_set.PRECISION, seed, two_sided, medium, wavelengths)
    if renderer:
        raise typer.Exit(_run_renderer(renderer, command, file, made, precision, options, timeout))
    chosen = _chosen(file, made.words)
    rays = files.read(file) if file else ray_set.make(**made.arguments)
    with as_exceptions():
        given = run_program.answers_of(command or [], rays, timeout=timeout)
    name = shlex.join(command or [])
    print(printable(f"{name}: {_summary(rays)}"))
    raise typer.Exit(options.check(rays, given, name, ["run", *chosen, *options.words, "--", *(command or [])]))


def _run_renderer(
    folder: Path,
    command: list[str] | None,
    file: Path | None,
    made: MadeRays,
    precision: str | None,
    options: CheckOptions,
    timeout: float,
) -> int:
    """Every function of a renderer that has the precision asked for, if one is; the largest exit code."""
    from mi_refract.ray_sets import renderer_file

    if command:
        raise ValueError(f"--renderer {folder} and {command[0]}; expected one of them")
    known = renderer_file.load(folder)
    calls = [call for call in known.rays if precision in (None, call.precision)]
    if not calls:
        raise ValueError(f"{folder}: no function{f' in {precision}' if precision else ''}; expected [[rays]]")
    if len(calls) > 1 and (options.report or options.junit or options.json):
        raise ValueError(f"{folder}: {len(calls)} functions, and one report; expected --precision of one of them")
    return max(_run_function(known, call, file, made, options, timeout) for call in calls)


def _run_function(
    known: RendererFile, call: RaysCommand, file: Path | None, made: MadeRays, options: CheckOptions, timeout: float
) -> int:
    from mi_refract.ray_sets.renderer_file import filled

    made = replace(made, precision=call.precision)
    chosen = _chosen(file, made.words)
    rays = files.read(file) if file else ray_set.make(**made.arguments)
    command = filled(call.command)
    with as_exceptions():
        given = run_program.answers_of(command, rays, timeout=timeout, cwd=known.folder)
    print(printable(f"{call.title}: {_summary(rays)}"))
    asked = replace(options, tir=call.tir) if options.tir == "auto" else options
    code = asked.check(rays, given, call.title, ["run", "--renderer", str(known.folder), *chosen, *options.words])
    for regime, reason in call.deviations.items():
        print(printable(f"known of {call.title}: {regime}: {reason}"))
    return code


def _chosen(file: Path | None, made: list[str]) -> list[str]:
    """The options that choose the rays, none for those of `export` without options. `made`: those of `export`."""
    if file and made:
        raise ValueError(f"--rays {file} and {made[0]}: both choose the rays; expected one of them")
    return ["--rays", str(file)] if file else made


def _summary(rays: RaySet) -> str:
    number = len(rays.header["regimes"])
    regimes = f"{number} regime{'' if number == 1 else 's'}"
    return f"{len(rays)} rays, {regimes}, {rays.precision}, seed {rays.header['seed']}{_media(rays)}"


def _media(rays: RaySet) -> str:
    """How many media and wavelengths there are; "" without media."""
    if not (pairs := rays.header.get("media")):
        return ""
    media, wavelengths = len(pairs) // 2, len(rays.header["wavelengths"])
    kinds = "medium" if media == 1 else "media"
    return f", {media} {kinds} at {wavelengths} wavelength{'' if wavelengths == 1 else 's'}"

"""`python -m validation [STUDY …] [--profile quick|standard|full] [--out DIR]`, or `… renderers|pack …`.

Exit code: 0 if every budget holds, 1 if one is broken, 2 for misuse and errors, 130 after an interruption.
"""

from __future__ import annotations

import os
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mi_refract.cli import interrupts
from mi_refract.cluster.connection import ClusterTarget
from mi_refract.io import safe_files
from mi_refract.io.text import printable
from validation.run import command_line

if TYPE_CHECKING:
    from validation.study import Study
    from validation.suite.renderers import System

# Name on the command line (that of the folder) → modules whose STUDY is run, in the order of the report.
ROOMS = {
    "directions": ("per_formula", "planted_defects", "bsdf_samples", "sweep", "search"),
    "stability": ("optical_chains", "energy", "derivatives", "layered_paths"),
    "renders": (
        *("against_dielectric", "colours", "unused_features", "invisible_changes"),
        *("neighbours", "random_numbers", "samplers", "gradients", "rendering_passes", "thin_panes"),
    ),
    "efficiency": ("error_against_time", "scaling", "changing_indices", "caustics", "chosen_settings"),
    "media": ("catalogs", "ray_directions", "closed_forms", "renders"),
    "planar": ("against_retrace", "closed_paths", "joints", "extruded_scenes", "times"),
    "diff": ("planted_defects", "visible_changes", "welch_nulls", "times"),
    "ground-truth": ("traced_bodies", "standard_numbers"),
    "robustness": ("code_mutants",),
    "suite": (
        *("matrix", "per_ray", "small_mistakes", "rendered_images", "spectral_lines"),
        *("lenses", "glasses", "exports", "standard_numbers", "caustic_energies"),
    ),
}
# The studies of the profile `quick` if no study is named.
QUICK = (
    "directions.per_formula",
    "directions.bsdf_samples",
    "stability.optical_chains",
    "stability.layered_paths",
    "renders.against_dielectric",
    "planar.against_retrace",
    "diff.planted_defects",
)
LOCK = "validation.lock"  # exists in the report's folder during a run
PROFILES = {"quick": "a minute and a half", "standard": "2.5 hours", "full": "many hours"}

app = command_line.application()


def main(arguments: list[str] | None = None) -> int:
    """Run the command with `arguments` (default: those of the command line) and return its exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    if words[:1] == ["renderers"]:
        from validation.suite.renderers import command

        return command.main(words[1:])
    if words[:1] == ["pack"]:
        if arguments is None:  # while Mitsuba renders, Ctrl-C would end only the render
            interrupts.end_at_once(even_if_ignored=False)
        from validation.pack import command as pack_command

        return pack_command.main(words[1:])
    return command_line.exit_code(app, "validation", words)


@app.command(
    epilog="`python -m validation renderers` lists and installs other renderers; `pack` writes the reference pack."
)
def _command(
    studies: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="STUDY",
            help=f"Studies to run: {', '.join(ROOMS)}, or a part of one, such as renders.gradients. Default: all "
            "studies; in the profile quick, a selection.",
        ),
    ] = None,
    profile: Annotated[
        str, typer.Option(help=f"How much is measured: {', '.join(f'{k} ({v})' for k, v in PROFILES.items())}.")
    ] = "quick",
    out: Annotated[Path, typer.Option(help="Folder of the report.")] = Path("out"),
    variant: Annotated[
        str | None,
        typer.Option(
            help="cuda_ad_rgb, llvm_ad_rgb or scalar_rgb, which renders. Default: llvm_ad_rgb if it runs here."
        ),
    ] = None,
    write_tables: Annotated[
        bool, typer.Option("--write-tables", help="Also write the tables of the documentation and the gallery.")
    ] = False,
    goals: Annotated[
        bool, typer.Option("--goals", help="Also print the goals, most of which are for run times.")
    ] = False,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Run tasks that measure no times on this Dask scheduler.")
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, max=1024, help="Number of worker processes (Dask) for tasks that measure no times."),
    ] = None,
    renderers: Annotated[
        list[Path] | None,
        typer.Option(
            "--renderer",
            metavar="FOLDER",
            help="Also run the renderer of FOLDER/mi-refract-renderer.toml in `suite`.",
        ),
    ] = None,
) -> int:
    """Measure the formulas and the plugin against certified answers, and write the report."""
    names, target = studies or [], ClusterTarget(scheduler, workers)
    own_renderers: list[System] = []
    chosen = modules(names, profile)
    if profile not in PROFILES:
        raise ValueError(f"unknown profile {profile!r}; expected {', '.join(PROFILES)}")
    if variant and not variant.endswith("_rgb"):  # studies of spectra and polarisation choose their variants themselves
        raise ValueError(f"--variant {variant}: studies render in RGB; expected cuda_ad_rgb, llvm_ad_rgb or scalar_rgb")
    if write_tables and profile == "quick":
        raise ValueError(
            "--write-tables needs more than the profile 'quick'; expected --profile standard or --profile full"
        )
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"--out {out}: {error.strerror}; expected a writable folder") from None
    if not os.access(out, os.W_OK):
        raise ValueError(f"--out {out}: not writable; expected a writable folder")
    if renderers:
        if not any(name.startswith("suite.") for name in chosen):
            raise ValueError(f"--renderer {renderers[0]} is used by the study `suite` only; add `suite`")
        if target.given:
            raise ValueError(f"--renderer {renderers[0]} cannot be sent to workers; remove --workers or --scheduler")
        from validation.suite import rendered_images
        from validation.suite.renderers import system

        for folder in reversed(renderers):  # each one joins in front of the others
            own_renderers.insert(0, system.join(folder))
            rendered_images.join(own_renderers[0])
    target.check()
    try:
        with safe_files.held(out / LOCK, "a validation"):
            return _run(names, profile, out, variant, write_tables, goals, target, own_renderers)
    except KeyboardInterrupt:
        resumes = "" if own_renderers else "; run the same command again to resume"
        print(f"validation: interrupted{resumes}", file=sys.stderr)
        raise


def modules(studies: list[str], profile: str) -> list[str]:
    """Return the modules below `validation` whose studies are run.

    `studies`: folders ("renders") or single modules of them ("renders.gradients"). ValueError, one line, for another
    name.
    """
    if profile == "quick" and not studies:
        return list(QUICK)
    every = {f"{room}.{module}": f"{room.replace('-', '_')}.{module}" for room in ROOMS for module in ROOMS[room]}
    chosen: list[str] = []
    for study in studies or ROOMS:
        found = [path for name, path in every.items() if name == study or name.startswith(f"{study}.")]
        if not found:
            raise ValueError(f"unknown study {study!r}; expected {', '.join(ROOMS)}, or a part, as {next(iter(every))}")
        chosen += found
    return list(dict.fromkeys(chosen))


def _run(
    names: list[str],
    profile: str,
    out: Path,
    preferred: str | None,
    write_tables: bool,
    goals: bool,
    target: ClusterTarget,
    own_renderers: list[System],
) -> int:
    from rich.console import Console

    from mi_refract import backend
    from mi_refract.report import run_report
    from validation.run.context import here

    from . import runner
    from .run import headline, tightness

    start = time.perf_counter()
    variant = backend.activate(preferred, may_restart=True)
    print(printable(f"validation: {backend.summary()}"), file=sys.stderr)
    if write_tables:  # imported and checked before the run
        from . import tables

        tables.check(names)
    context = here(profile, out, variant)
    if own_renderers:  # their programs may have changed since an interruption
        runner.forget(context)
    chosen = modules(names, profile)
    studies: list[Study] = [import_module(f"validation.{name}").STUDY for name in chosen]
    workers = runner.OnCluster(tuple(chosen), profile, variant, target) if target.given else None
    rows, spent = runner.run(runner.tasks(studies, context), context, workers)
    for study in studies:
        rows = study.summarise(rows)
    if not context.profile.quick:  # its few cases need not come near any bound
        rows = [*rows, *tightness.rows(rows)]
    first_page = headline.first_page(rows, profile)
    if own_renderers:
        from validation.suite import matrix

        first_page["answers"] = [*matrix.answers(rows, own_renderers), *first_page["answers"]]
    chosen_variant = [f"--variant {preferred}"] if preferred else []
    about = runner.describe(context, time.perf_counter() - start)
    about |= {
        "replay": " ".join(["python -m validation", *names, f"--profile {profile}", *chosen_variant]),
        "studies": {study.name: study.described for study in studies} | {tightness.NAME: tightness.ABOUT},
        "scatter": [scatter for study in studies for scatter in study.scatter],
        "first_page": first_page,
    }
    run_report.write_json(out / "rows.json", rows, about | {"tasks": spent})
    run_report.write_junit(out / "junit.xml", rows, about)
    run_report.write_html(out / "report.html", rows, about, out)
    if write_tables:
        tables.write(rows, context, names)
    runner.forget(context)
    console = Console()
    console.print(run_report.summary(rows, about))
    if goals:
        console.print(run_report.goals_table(rows))
    console.print(printable(f"report: {out / 'report.html'}"), highlight=False, markup=False)
    return 1 if any(row.verdict == "fail" for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())

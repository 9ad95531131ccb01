"""The commands `mi-refract rays export|check|run`."""

from __future__ import annotations

import importlib.util
import math
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from mi_refract.formulas import TEXTBOOK_BACKWARD
from mi_refract.io import reference_pack
from mi_refract.io.image_file import versions
from mi_refract.io.safe_files import writable
from mi_refract.io.text import parse_number, printable
from mi_refract.ray_sets import files, ray_set
from mi_refract.ray_sets.ray_set import Answers, RaySet
from mi_refract.regimes import REGIMES

from .interrupts import as_exceptions

if TYPE_CHECKING:
    from mi_refract.io.reference_pack import PackReference
    from mi_refract.ray_sets.check_answers import Findings

app = typer.Typer(
    help="Check the refraction of other programs against certified answers.",
    add_completion=False,
    rich_markup_mode=None,
)

COLUMNS, UNWRAPPED = 80, 10_000  # width of a summary; a width beyond any line


def _print_regimes(is_set: bool) -> None:
    if is_set:
        table = Table("regime", "rays", "", box=None, pad_edge=False)
        for name, regime in REGIMES.items():
            table.add_row(name, regime.text, "" if name in ray_set.DEFAULT else "only with --regime")
        Console(width=None if sys.stdout.isatty() else UNWRAPPED).print(table, highlight=False)
        raise typer.Exit


Regime = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME", help="Regime of the rays, see --regimes; may be repeated. Default: all regimes of unit vectors."
    ),
]
Count = Annotated[int, typer.Option(min=1, help="Number of rays per regime.")]
Precision = Annotated[str, typer.Option(help="f32 or f64.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the ray generator.")]
TwoSided = Annotated[
    bool, typer.Option("--two-sided", help="Put normals on either side of the surface; by default they face the ray.")
]
Medium = Annotated[
    list[str] | None,
    typer.Option(
        metavar="SPEC", help="Material of one side, such as SCHOTT:N-BK7; the other side is air. May be repeated."
    ),
]
Wavelengths = Annotated[str | None, typer.Option(metavar="NM,…", help="Wavelengths in nm, with --medium.")]
Tir = Annotated[
    str, typer.Option(help="How answers signal total internal reflection: auto, zero, nan, reflected, tangent or flag.")
]
Formula = Annotated[
    str | None,
    typer.Option("--error-bound", metavar="FORMULA", help="Formula whose error bound applies. Default: the loosest."),
]
Backward = Annotated[
    float | None,
    typer.Option(
        "--backward-error",
        metavar="M",
        help="Also require each answer, and its length, to be exact for inputs perturbed by at most M roundings "
        f"(a sound program: {TEXTBOOK_BACKWARD:g}, for ratios of indices up to 2.5).",
    ),
]
Regimes = Annotated[bool, typer.Option("--regimes", is_eager=True, callback=_print_regimes, help="List the regimes.")]
WithTable = Annotated[bool, typer.Option("--table", help="Also print all numbers of each regime: a wide table.")]
Report = Annotated[Path | None, typer.Option(metavar="OUT.html", help="Write an HTML page.")]
Junit = Annotated[Path | None, typer.Option(metavar="OUT.xml", help="Write JUnit XML.")]
Json = Annotated[Path | None, typer.Option(metavar="OUT.json", help="Write JSON.")]


@app.command()
def export(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT.csv|.npz", help="The file to write.")],
    regime: Regime = None,
    count: Count = ray_set.COUNT,
    precision: Precision = ray_set.PRECISION,
    seed: Seed = 0,
    two_sided: TwoSided = False,
    medium: Medium = None,
    wavelengths: Wavelengths = None,
    regimes: Regimes = False,
) -> None:
    """Write rays for another program.

    A ray has an incident direction, a normal, and the indices of refraction of the media that it leaves and enters.
    """
    writable(output, files.SUFFIXES)
    rays = _make_rays(regime, count, precision, seed, two_sided, medium, wavelengths)
    files.write(output, rays)
    print(printable(f"{output}: {_summary(rays)}"))


@app.command()
def check(
    context: typer.Context,
    answers: Annotated[
        Path, typer.Argument(metavar="ANSWERS.csv|.npz", help="Columns id, bx, by, bz[, transmitted][, n_ratio].")
    ],
    file: Annotated[
        Path | None,
        typer.Option("--rays", metavar="FILE", help="The rays. Default: the rays that `export` writes by default."),
    ] = None,
    tir: Tir = "auto",
    formula: Formula = None,
    backward: Backward = None,
    table: WithTable = False,
    report: Report = None,
    junit: Junit = None,
    json: Json = None,
) -> None:
    """Check a file of answers against certified answers.

    Exit code 0: every answer is within the error bound, which does not show that every answer is right; 1: some are
    wrong; 2: the answers do not match the rays.
    """
    pack = reference_pack.of_references(file, answers) if file else None
    check_and_print, write_reports = _checker(context, tir, formula, backward, table, report, junit, json, pack)
    rays = files.read(file) if file else ray_set.make()
    findings = check_and_print(rays, files.read_answers(answers, most=files.most_answers(rays)), str(answers))
    raise typer.Exit(write_reports({str(answers): findings}))


# The parameters of `run` that select the rays.
SELECTING = ("regime", "count", "seed", "two_sided", "medium", "wavelengths")


@app.command()
def run(
    context: typer.Context,
    command: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="-- COMMAND",
            help="The command to run; it reads rays from stdin and writes answers to stdout, as CSV.",
        ),
    ] = None,
    renderer: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Instead of COMMAND, run every function of FOLDER/mi-refract-renderer.toml."
        ),
    ] = None,
    file: Annotated[
        Path | None,
        typer.Option(
            "--rays",
            metavar="FILE",
            help="Read the rays from this exported file; with --renderer, for the functions of its precision.",
        ),
    ] = None,
    regime: Regime = None,
    regimes: Regimes = False,
    count: Count = ray_set.COUNT,
    precision: Annotated[
        str | None, typer.Option(help="f32 (default) or f64; with --renderer, only the functions of this precision.")
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
    ] = files.TIMEOUT,
    table: WithTable = False,
    report: Report = None,
    junit: Junit = None,
    json: Json = None,
) -> None:
    """Run a command on rays and check its answers.

    Exit code 0: every answer is within the error bound, which does not show that every answer is right; 1: some are
    wrong; 2: the answers do not match the rays, or the command fails or exceeds its time limit. With --renderer, the
    largest exit code of its functions.
    """
    pack = reference_pack.of_references(file) if file else None
    check_and_print, write_reports = _checker(context, tir, formula, backward, table, report, junit, json, pack)
    if file:
        for name in SELECTING if renderer else (*SELECTING, "precision"):
            if getattr(context.get_parameter_source(name), "name", "") == "COMMANDLINE":
                option = f"--{name.replace('_', '-')}"
                raise ValueError(f"--rays {file} and {option}: both choose the rays; expected one of them")
    given = files.read(file) if file else None
    calls: list[tuple[list[str], str, str, str, dict[str, str]]]
    if renderer:
        from mi_refract.ray_sets import renderer_file

        if command:
            raise ValueError(f"--renderer {renderer} and {command[0]}; expected one of them")
        wanted = {precision or "", given.precision if given else ""} - {""}
        if not (functions := [x for x in renderer_file.load(renderer).rays if wanted <= {x.precision}]):
            in_both = f" in {' and '.join(sorted(wanted))}" if wanted else ""
            raise ValueError(f"{renderer}: no function{in_both}; expected [[rays]]")
        calls = [(renderer_file.filled(x.command), x.title, x.precision, x.tir, x.deviations) for x in functions]
    else:
        calls = [(command or [], shlex.join(command or []), precision or ray_set.PRECISION, "auto", {})]
    checks = {}
    for words, title, format_, declared, deviations in calls:
        rays = given or _make_rays(regime, count, format_, seed, two_sided, medium, wavelengths)
        with as_exceptions():
            answers = files.answers_of(words, rays, timeout=timeout, cwd=renderer)
        checks[f"{title}, {format_}" if renderer else title] = check_and_print(rays, answers, title, declared)
        for name, reason in deviations.items():
            print(printable(f"known deviation of {title}: {name}: {reason}"))
    raise typer.Exit(write_reports(checks))


def _checker(
    context: typer.Context,
    tir: str,
    formula: str | None,
    backward: float | None,
    table: bool,
    report: Path | None,
    junit: Path | None,
    json: Path | None,
    pack: PackReference | None,
) -> tuple[Callable[..., Findings], Callable[[dict[str, Findings]], int]]:
    """Check the options and return two functions, `check_and_print` and `write_reports`.

    `check_and_print(rays, answers, title, declared="auto")` checks the answers, prints the findings and returns them.
    `declared` is the renderer's own signal of total internal reflection; `tir` overrides it. `write_reports(checks)`
    writes the reports of all findings, by title, and returns the largest exit code. `pack`: the reference pack that the
    rays are from. ValueError or OSError for an invalid option.
    """
    needed = ("flint", "jinja2") if report else ("flint",)
    if not all(map(importlib.util.find_spec, needed)):
        raise ValueError("checking rays needs the extra `validation`: pip install 'mi-refract[validation]'")
    from mi_refract.ray_sets import check_answers, reports
    from mi_refract.ray_sets.tir_signal import LOOSEST

    error_bound = formula or LOOSEST
    most_backward = math.inf if backward is None else backward
    check_answers.check_options(tir, error_bound, most_backward)
    for path, suffixes in ((report, (".html", ".htm")), (junit, (".xml",)), (json, (".json",))):
        if path:
            writable(path, suffixes)

    def check_and_print(rays: RaySet, answers: Answers, title: str, declared: str = "auto") -> Findings:
        print(printable(f"{title}: {_summary(rays)}"))
        signal = declared if tir == "auto" else tir
        findings = check_answers.check(rays, answers, tir=signal, error_bound=error_bound, most_backward=most_backward)
        if table and findings.regimes:
            # On a terminal, too: a wrapped line is easier to read than a squeezed column.
            Console(width=UNWRAPPED).print(reports.table(findings), highlight=False)
        Console(width=COLUMNS).print(reports.summary(findings), highlight=False)
        return findings

    def write_reports(checks: dict[str, Findings]) -> int:
        origin = reference_pack.origin(context.obj, pack)
        if report:
            reports.write_html(report, checks, versions(), origin.command)
        if junit:
            reports.write_junit(junit, checks)
        if json:
            reports.write_json(json, checks, origin)
        return max(findings.exit_code for findings in checks.values())

    return check_and_print, write_reports


def _make_rays(
    regime: list[str] | None,
    count: int,
    precision: str,
    seed: int,
    two_sided: bool,
    medium: list[str] | None,
    wavelengths: str | None,
) -> RaySet:
    """Generate the rays that these options select. In names of regimes, `>>` and `<<` stand for ≫ and ≪."""
    try:
        in_nm = tuple(map(parse_number, wavelengths.split(","))) if wavelengths is not None else ()
    except ValueError:
        raise ValueError(f"--wavelengths {wavelengths}; expected numbers in nm, such as 486.1327,587.5618") from None
    names = [name.replace(">>", "≫").replace("<<", "≪") for name in regime or []] or None
    return ray_set.make(names, count, precision, seed, two_sided=two_sided, media=medium or (), wavelengths=in_nm)


def _summary(rays: RaySet) -> str:
    def counted(number: int, singular: str, plural: str) -> str:
        return f"{number} {singular if number == 1 else plural}"

    header = rays.header
    text = f"{len(rays)} rays, {counted(len(header['regimes']), 'regime', 'regimes')}, {rays.precision}"
    text += f", seed {header['seed']}"
    if "media" not in header:
        return text
    media = counted(len(header["media"]) // 2, "medium", "media")
    return f"{text}, {media} at {counted(len(header['wavelengths']), 'wavelength', 'wavelengths')}"

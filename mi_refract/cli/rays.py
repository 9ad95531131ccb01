"""The commands `mi-refract rays export|check|run`."""

from __future__ import annotations

import importlib.util
import math
import shlex
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from mi_refract.io.atomic import writable
from mi_refract.io.provenance import provenance
from mi_refract.io.sanitise import printable
from mi_refract.ray_sets import files, ray_set, run_program, tables
from mi_refract.ray_sets.ray_set import Answers, RaySet
from mi_refract.regimes import REGIMES

from .interrupts import as_exceptions

app = typer.Typer(
    help="Check the refraction of other programs against certified answers.",
    add_completion=False,
    rich_markup_mode=None,
)

UNWRAPPED = 10_000  # columns: wider than any line


def _print_regimes(wanted: bool) -> None:
    if wanted:
        table = Table("regime", "rays", "", box=None, pad_edge=False)
        for name, regime in REGIMES.items():
            table.add_row(name, regime.text, "" if name in ray_set.DEFAULT else "only with --regime")
        Console(width=None if sys.stdout.isatty() else UNWRAPPED).print(table, highlight=False)
        raise typer.Exit


Regime = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME",
        help="A regime of rays, see `export --regimes`; may be repeated. Default: all with unit vectors.",
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
        metavar="SPEC",
        help="Material of one side, such as SCHOTT:N-BK7; the other side is air. May be repeated.",
    ),
]
Wavelengths = Annotated[str | None, typer.Option(metavar="NM,…", help="Wavelengths in nm, with --medium.")]
Tir = Annotated[
    str,
    typer.Option(help="How answers signal total internal reflection: auto, zero, nan, reflected, tangent or flag."),
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
        help="Also require each answer to be exact for inputs perturbed by at most M roundings (a sound program: 4).",
    ),
]
Report = Annotated[Path | None, typer.Option(metavar="OUT.html", help="Write an HTML page.")]
Junit = Annotated[Path | None, typer.Option(metavar="OUT.xml", help="Write JUnit XML.")]
Json = Annotated[Path | None, typer.Option(metavar="OUT.json", help="Write JSON.")]


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
    regimes: Annotated[
        bool, typer.Option("--regimes", is_eager=True, callback=_print_regimes, help="List the regimes.")
    ] = False,
) -> None:
    """Write rays for another program: incident directions, normals and indices of refraction."""
    writable(output, tables.SUFFIXES)
    rays = _made(regime, count, precision, seed, two_sided, medium, wavelengths)
    files.write(output, rays)
    print(printable(f"{output}: {_summary(rays)}"))


@app.command()
def check(
    context: typer.Context,
    answers: Annotated[
        Path, typer.Argument(metavar="ANSWERS.csv|.npz|.exr", help="Columns id, bx, by, bz[, transmitted][, n_ratio].")
    ],
    file: Annotated[Path, typer.Option("--rays", metavar="RAYS.csv|.npz|.exr", help="The rays, as exported.")],
    tir: Tir = "auto",
    formula: Formula = None,
    backward: Backward = None,
    report: Report = None,
    junit: Junit = None,
    json: Json = None,
) -> None:
    """Check a file of answers against certified ones.

    Exit code 0: every answer is right; 1: some are wrong; 2: the answers do not match the rays.
    """
    checking = _Check(tir, formula, backward, report, junit, json)
    rays = files.read(file)
    read = files.read_answers(answers, most=files.most_answers(rays))
    raise typer.Exit(checking.run(rays, read, str(answers), _replay(context)))


# Those of `run` that choose the rays.
CHOOSING = ("regime", "count", "precision", "seed", "two_sided", "medium", "wavelengths")


@app.command()
def run(
    context: typer.Context,
    command: Annotated[
        list[str] | None,
        typer.Argument(metavar="-- COMMAND", help="Reads rays from stdin, writes answers to stdout, as CSV."),
    ] = None,
    renderer: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Instead of COMMAND: every function of FOLDER/mi-refract-renderer.toml."),
    ] = None,
    file: Annotated[
        Path | None,
        typer.Option("--rays", metavar="FILE", help="Use these rays, as exported, instead of generating some."),
    ] = None,
    regime: Regime = None,
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
    ] = run_program.TIMEOUT,
    report: Report = None,
    junit: Junit = None,
    json: Json = None,
) -> None:
    """Run a command on rays and check its answers.

    Exit code 0: every answer is right; 1: some are wrong; 2: the answers do not match the rays, or the command fails or
    exceeds its time limit. With --renderer, the largest exit code of its functions.
    """
    checking = _Check(tir, formula, backward, report, junit, json)
    typed = _typed(context)
    if file and (
        choosing := [typed[name][0] for name in CHOOSING if name in typed and not (renderer and name == "precision")]
    ):
        raise ValueError(f"--rays {file} and {choosing[0]}: both choose the rays; expected one of them")

    def answered(words: list[str], title: str, checking: _Check, precision: str, folder: Path | None = None) -> int:
        rays = files.read(file) if file else _made(regime, count, precision, seed, two_sided, medium, wavelengths)
        with as_exceptions():
            answers = run_program.answers_of(words, rays, timeout=timeout, cwd=folder)
        return checking.run(rays, answers, title, _replay(context))

    if not renderer:
        title = shlex.join(command or [])
        raise typer.Exit(answered(command or [], title, checking, precision or ray_set.PRECISION))

    from mi_refract.ray_sets import renderer_file

    if command:
        raise ValueError(f"--renderer {renderer} and {command[0]}; expected one of them")
    functions = [x for x in renderer_file.load(renderer).rays if precision in (None, x.precision)]
    if not functions:
        raise ValueError(f"{renderer}: no function{f' in {precision}' if precision else ''}; expected [[rays]]")
    if len(functions) > 1 and (report or junit or json):
        raise ValueError(f"{renderer}: {len(functions)} functions, and one report; expected --precision of one of them")
    codes = []
    for function in functions:
        declared = replace(checking, tir=function.tir) if tir == "auto" else checking
        words = renderer_file.filled(function.command)
        codes.append(answered(words, function.title, declared, function.precision, renderer))
        for name, reason in function.deviations.items():
            print(printable(f"known deviation of {function.title}: {name}: {reason}"))
    raise typer.Exit(max(codes))


@dataclass(frozen=True)
class _Check:
    """How answers are checked, and which files are written."""

    tir: str
    formula: str | None
    backward: float | None
    report: Path | None
    junit: Path | None
    json: Path | None

    def __post_init__(self) -> None:
        """ValueError or OSError, before anything runs, for an option that cannot be met."""
        needed = ("flint", "jinja2") if self.report else ("flint",)
        if not all(map(importlib.util.find_spec, needed)):
            raise ValueError("checking rays needs the extra `validation`: pip install 'mi-refract[validation]'")
        from mi_refract.ray_sets import check_answers

        check_answers.check_options(**self._options)
        for path, suffixes in ((self.report, (".html", ".htm")), (self.junit, (".xml",)), (self.json, (".json",))):
            if path:
                writable(path, suffixes)

    @property
    def _options(self) -> dict[str, Any]:
        from mi_refract.ray_sets.tir_signal import LOOSEST

        most = math.inf if self.backward is None else self.backward
        return {"tir": self.tir, "error_bound": self.formula or LOOSEST, "most_backward": most}

    def run(self, rays: RaySet, answers: Answers, title: str, replay: str) -> int:
        """Check the answers, print and write the reports; the exit code. `replay`: the command, for the HTML page."""
        from mi_refract.ray_sets import check_answers, reports

        print(printable(f"{title}: {_summary(rays)}"))
        found = check_answers.check(rays, answers, **self._options)
        # On a terminal, too: a wrapped line is easier to read than a squeezed column.
        Console(width=UNWRAPPED).print(reports.table(found), highlight=False)
        if self.report:
            about = {"answers": title} | {key: rays.header[key] for key in ("seed", "checksum")} | provenance()
            reports.write_html(self.report, found, about, replay)
        if self.junit:
            reports.write_junit(self.junit, found, title)
        if self.json:
            reports.write_json(self.json, found)
        return found.exit_code


def _typed(context: typer.Context) -> dict[str, list[str]]:
    """The options on the command line, as words, by name of the parameter; of arguments the values alone."""
    words = {}
    for parameter in context.command.params:
        source, value = context.get_parameter_source(parameter.name or ""), context.params.get(parameter.name or "")
        if source is None or source.name != "COMMANDLINE" or value is None:
            continue
        values = list(value) if isinstance(value, list | tuple) else [value]
        if parameter.param_type_name == "argument":
            words[parameter.name or ""] = list(map(str, values))
        elif isinstance(value, bool):
            words[parameter.name or ""] = [parameter.opts[-1]]
        else:
            words[parameter.name or ""] = [word for x in values for word in (parameter.opts[-1], str(x))]
    return words


def _replay(context: typer.Context) -> str:
    """The command that repeats the check, without the reports that it writes."""
    typed = _typed(context)
    words = [
        word for name, option in typed.items() if name not in ("command", "report", "junit", "json") for word in option
    ]
    program = ["--", *typed["command"]] if "command" in typed else []
    return shlex.join(["mi-refract", "rays", str(context.info_name), *words, *program])


def _made(
    regime: list[str] | None,
    count: int,
    precision: str,
    seed: int,
    two_sided: bool,
    medium: list[str] | None,
    wavelengths: str | None,
) -> RaySet:
    """The rays that these options choose; `>>` and `<<` stand for ≫ and ≪."""
    try:
        in_nm = tuple(map(float, wavelengths.split(","))) if wavelengths is not None else ()
    except ValueError:
        raise ValueError(f"--wavelengths {wavelengths}; expected numbers in nm, such as 486.1327,587.5618") from None
    names = [name.replace(">>", "≫").replace("<<", "≪") for name in regime or []]
    return ray_set.make(
        names or None, count, precision, seed, two_sided=two_sided, media=medium or (), wavelengths=in_nm
    )


def _summary(rays: RaySet) -> str:
    def counted(number: int, one: str, more: str) -> str:
        return f"{number} {one if number == 1 else more}"

    header = rays.header
    text = f"{len(rays)} rays, {counted(len(header['regimes']), 'regime', 'regimes')}, {rays.precision}"
    text += f", seed {header['seed']}"
    if "media" not in header:
        return text
    media = counted(len(header["media"]) // 2, "medium", "media")
    return f"{text}, {media} at {counted(len(header['wavelengths']), 'wavelength', 'wavelengths')}"

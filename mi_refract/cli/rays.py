"""The commands `mi-refract rays export|check|run`. Words in, words out, as in `cli.py`."""

from __future__ import annotations

import importlib.util
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from mi_refract.io.atomic import writable
from mi_refract.io.provenance import provenance
from mi_refract.ray_sets import ray_set as sets
from mi_refract.ray_sets import run_program
from mi_refract.ray_sets.ray_set import Answers, RaySet
from mi_refract.regimes import REGIMES

app = typer.Typer(help="Other people's refraction against the certified answers.", rich_markup_mode=None)

OUTPUTS = ((".html", ".htm"), (".xml",), (".json",))  # of --report, --junit, --json


def _print_regimes(asked: bool) -> None:
    if asked:
        width = max(map(len, REGIMES))
        for name, regime in REGIMES.items():
            print(f"{name:{width}}  {regime.text}{'' if name in sets.DEFAULT else '; only where it is asked for'}")
        raise typer.Exit


Regime = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME", help="A set of rays, see --regimes; without it, all for unit vectors."),
]
Count = Annotated[int, typer.Option(min=1, help="Rays of each regime.")]
Precision = Annotated[str, typer.Option(help="f32 or f64.")]
Seed = Annotated[int, typer.Option(min=0, help="Of the rays.")]
TwoSided = Annotated[bool, typer.Option("--two-sided", help="Normals on either side; else they face the ray.")]
Regimes = Annotated[bool, typer.Option("--regimes", is_eager=True, callback=_print_regimes, help="Print the regimes.")]
File = Annotated[Path | None, typer.Option("--rays", metavar="FILE", help="The rays, as they were exported.")]
Tir = Annotated[
    str, typer.Option(help="How total internal reflection is told: auto, zero, nan, reflected, tangent or flag.")
]
Formula = Annotated[
    str | None, typer.Option("--as-good-as", metavar="FORMULA", help="The measure; the loosest of a textbook if none.")
]
Report = Annotated[Path | None, typer.Option(metavar="OUT.html", help="Write a page to look at.")]
Junit = Annotated[Path | None, typer.Option(metavar="OUT.xml", help="Write JUnit's XML.")]
Json = Annotated[Path | None, typer.Option(metavar="OUT.json", help="Write JSON.")]


@dataclass(frozen=True)
class Wanted:
    """How answers are judged, and where that is written; whatever is amiss is said before anything runs."""

    tir: str
    formula: str | None
    report: Path | None
    junit: Path | None
    json: Path | None

    def __post_init__(self) -> None:
        needed = ("flint", "jinja2") if self.report else ("flint",)
        if not all(map(importlib.util.find_spec, needed)):
            raise ValueError("checking rays needs the extra `validation`: pip install 'mi-refract[validation]'")
        from mi_refract.formulas.documented import FORMULAS
        from mi_refract.ray_sets.tir_signal import AUTO, TIR

        if self.tir not in (AUTO, *TIR):
            raise ValueError(f"--tir {self.tir}: unknown; accepted: {', '.join((AUTO, *TIR))}")
        if self.formula not in (None, *FORMULAS):
            raise ValueError(f"--as-good-as {self.formula}: unknown; accepted: {', '.join(FORMULAS)}")
        for path, suffixes in zip((self.report, self.junit, self.json), OUTPUTS, strict=True):
            if path:
                writable(path, suffixes)

    @property
    def options(self) -> list[str]:
        chosen = ["--tir", self.tir] if self.tir != "auto" else []
        return chosen + (["--as-good-as", self.formula] if self.formula else [])

    def judge(self, rays: RaySet, answers: Answers, name: str, replay: list[str]) -> int:
        """Print, write, and give the exit code."""
        from mi_refract.ray_sets import check_answers, reports

        found = check_answers.check(rays, answers, tir=self.tir, budget=self.formula or check_answers.LOOSEST)
        # As wide as its numbers are: a wrapped line is read more easily than a squeezed column.
        Console(width=10_000).print(reports.table(found), highlight=False)
        if self.report:
            about = {"answers": name} | {key: rays.header[key] for key in ("seed", "checksum")} | provenance()
            reports.write_html(self.report, found, about, shlex.join(["mi-refract", "rays", *replay]))
        if self.junit:
            reports.write_junit(self.junit, found, name)
        if self.json:
            reports.write_json(self.json, found)
        return found.exit_code


@app.command()
def export(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT.csv|.npz|.exr", help="The file to write.")],
    regime: Regime = None,
    count: Count = sets.COUNT,
    precision: Precision = sets.PRECISION,
    seed: Seed = 0,
    two_sided: TwoSided = False,
    regimes: Regimes = False,
) -> None:
    """Write rays for another renderer: incident directions, normals, indices, and what is meant by them."""
    rays = sets.make(_names(regime), count, precision, seed, two_sided=two_sided)
    sets.write(output, rays)
    print(f"{output}: {_summary(rays)}")


@app.command()
def check(
    answers: Annotated[Path, typer.Argument(metavar="ANSWERS.csv|.npz|.exr", help="id, bx, by, bz[, transmitted].")],
    file: File = None,
    tir: Tir = "auto",
    formula: Formula = None,
    report: Report = None,
    junit: Junit = None,
    json: Json = None,
) -> None:
    """Compare answers with the certified ones. Exit code 0: right, 1: wrong, 2: not those to the rays.

    Without --rays they are to the rays that the answers' own # lines name, or those of `export` without options.
    """
    wanted = Wanted(tir, formula, report, junit, json)
    given = sets.read_answers(answers)
    known = file or "checksum" in given.header
    rays = sets.read(file) if file else sets.remake(given.header) if known else sets.make()
    print(f"{answers}: {_summary(rays)}{'' if known else ', as `export` without options; others with --rays FILE'}")
    replay = ["check", str(answers), *(["--rays", str(file)] if file else []), *wanted.options]
    raise typer.Exit(wanted.judge(rays, given, str(answers), replay))


@app.command()
def run(
    command: Annotated[list[str], typer.Argument(metavar="-- COMMAND", help="Reads rays, writes answers, as CSV.")],
    file: File = None,
    regime: Regime = None,
    count: Count = sets.COUNT,
    precision: Precision = sets.PRECISION,
    seed: Seed = 0,
    two_sided: TwoSided = False,
    timeout: Annotated[float, typer.Option(min=0, metavar="SECONDS", help="For the command.")] = run_program.TIMEOUT,
    tir: Tir = "auto",
    formula: Formula = None,
    report: Report = None,
    junit: Junit = None,
    json: Json = None,
) -> None:
    """Hand rays to a command and check what it answers: rays on its stdin, answers on its stdout.

    Exit code 0: right, 1: wrong, 2: not those to the rays, a command that fails, or takes too long.
    """
    wanted = Wanted(tir, formula, report, junit, json)
    made = _made_by(regime, count, precision, seed, two_sided)
    if file and made:
        raise ValueError(f"--rays {file}: says all of the rays; accepted: without {made[0]}")
    rays = sets.read(file) if file else sets.make(_names(regime), count, precision, seed, two_sided=two_sided)
    given = run_program.answers_of(command, rays, timeout=timeout)
    name = shlex.join(command)
    print(f"{name}: {_summary(rays)}")
    chosen = ["--rays", str(file)] if file else made
    raise typer.Exit(wanted.judge(rays, given, name, ["run", *chosen, *wanted.options, "--", *command]))


def _names(regime: list[str] | None) -> tuple[str, ...]:
    """ ">>" and "<<" stand for the signs that few keyboards have."""
    return tuple(name.replace(">>", "≫").replace("<<", "≪") for name in regime or sets.DEFAULT)


def _made_by(regime: list[str] | None, count: int, precision: str, seed: int, two_sided: bool) -> list[str]:
    """The options that make these rays, as far as they are not the default."""
    words = [word for name in regime or [] for word in ("--regime", name)]
    for option, value, default in (
        ("--count", count, sets.COUNT),
        ("--precision", precision, sets.PRECISION),
        ("--seed", seed, 0),
    ):
        words += [option, str(value)] if value != default else []
    return words + ["--two-sided"] * two_sided


def _summary(rays: RaySet) -> str:
    return f"{len(rays)} rays, {len(rays.header['regimes'])} regimes, {rays.precision}, seed {rays.header['seed']}"

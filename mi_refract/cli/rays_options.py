"""Options of `mi-refract rays export|check|run`: which rays, and how their answers are checked and reported."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import math
import shlex
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypedDict

import typer
from rich.console import Console
from rich.table import Table

from mi_refract.cluster.connection import LOCAL, ClusterTarget
from mi_refract.io.atomic import writable
from mi_refract.io.provenance import provenance
from mi_refract.io.sanitise import printable
from mi_refract.ray_sets import ray_set
from mi_refract.ray_sets.ray_set import Answers, RaySet
from mi_refract.regimes import REGIMES, Rays

if TYPE_CHECKING:  # they need python-flint
    from mi_refract.oracle import Certified
    from mi_refract.ray_sets.check_answers import Certify

OUTPUTS = ((".html", ".htm"), (".xml",), (".json",))  # of --report, --junit, --json
UNWRAPPED = 10_000  # columns: wider than any line


def _print_regimes(asked: bool) -> None:
    if asked:
        table = Table("regime", "rays", "", box=None, pad_edge=False)
        for name, regime in REGIMES.items():
            table.add_row(name, regime.text, "" if name in ray_set.DEFAULT else "only with --regime")
        Console(width=None if sys.stdout.isatty() else UNWRAPPED).print(table, highlight=False)
        raise typer.Exit


Regime = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME", help="A regime of rays, see --regimes; by default all with unit vectors."),
]
Count = Annotated[int, typer.Option(min=1, help="Number of rays per regime.")]
Precision = Annotated[str, typer.Option(help="f32 or f64.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the ray generator.")]
TwoSided = Annotated[
    bool, typer.Option("--two-sided", help="Put normals on either side; by default they face the ray.")
]
Medium = Annotated[
    list[str] | None,
    typer.Option(
        metavar="SPEC",
        help="Material of one side, such as SCHOTT:N-BK7; the other side is air; may be repeated.",
    ),
]
Wavelengths = Annotated[str | None, typer.Option(metavar="NM,…", help="Wavelengths in nm, of the media.")]
Regimes = Annotated[bool, typer.Option("--regimes", is_eager=True, callback=_print_regimes, help="List the regimes.")]
File = Annotated[Path | None, typer.Option("--rays", metavar="FILE", help="The file of rays, as exported.")]
Tir = Annotated[
    str,
    typer.Option(help="How answers signal total internal reflection: auto, zero, nan, reflected, tangent or flag."),
]
Formula = Annotated[
    str | None,
    typer.Option(
        "--error-bound", metavar="FORMULA", help="The formula whose error bound applies; by default the loosest."
    ),
]
Backward = Annotated[
    float | None,
    typer.Option(
        "--backward-error",
        metavar="M",
        help="An answer is wrong unless it is exact for inputs within M roundings of those given (a sound program: 4); "
        "by default it need only be within the error bound.",
    ),
]
Report = Annotated[Path | None, typer.Option(metavar="OUT.html", help="Write an HTML page.")]
Junit = Annotated[Path | None, typer.Option(metavar="OUT.xml", help="Write JUnit XML.")]
Json = Annotated[Path | None, typer.Option(metavar="OUT.json", help="Write JSON.")]


@dataclass(frozen=True)
class MadeRays:
    """The options that choose rays, as they were typed."""

    regime: list[str] | None
    count: int
    precision: str
    seed: int
    two_sided: bool
    medium: list[str] | None
    wavelengths: str | None

    @property
    def arguments(self) -> MadeArguments:
        """Those of `ray_set.make`. ">>" and "<<" may be typed for ≫ and ≪. ValueError for wrong wavelengths."""
        names = [name.replace(">>", "≫").replace("<<", "≪") for name in self.regime or []]
        return {
            "names": names or None,
            "count": self.count,
            "precision": self.precision,
            "seed": self.seed,
            "two_sided": self.two_sided,
            "media": self.medium or (),
            "wavelengths": _wavelengths(self.wavelengths),
        }

    @property
    def words(self) -> list[str]:
        """The options that choose these rays, without those that have their default."""
        words = [word for name in self.regime or [] for word in ("--regime", name)]
        for option, value, default in (
            ("--count", self.count, ray_set.COUNT),
            ("--precision", self.precision, ray_set.PRECISION),
            ("--seed", self.seed, 0),
            ("--wavelengths", self.wavelengths, None),
        ):
            words += [option, str(value)] if value != default else []
        words += [word for spec in self.medium or [] for word in ("--medium", spec)]
        return words + ["--two-sided"] * self.two_sided


class MadeArguments(TypedDict):
    """What `ray_set.make` takes."""

    names: list[str] | None
    count: int
    precision: str
    seed: int
    two_sided: bool
    media: Sequence[str]
    wavelengths: Sequence[float]


@dataclass(frozen=True)
class CheckOptions:
    """How answers are checked, and which files are written."""

    tir: str
    formula: str | None
    backward: float | None
    report: Path | None
    junit: Path | None
    json: Path | None
    target: ClusterTarget = LOCAL

    def __post_init__(self) -> None:
        """ValueError or OSError, before anything runs, for an option that cannot be met."""
        needed = ("flint", "jinja2") if self.report else ("flint",)
        if not all(map(importlib.util.find_spec, needed)):
            raise ValueError("checking rays needs the extra `validation`: pip install 'mi-refract[validation]'")
        from mi_refract.formulas import FORMULAS
        from mi_refract.ray_sets.tir_signal import AUTO, TIR

        if self.tir not in (AUTO, *TIR):
            raise ValueError(f"--tir {self.tir}: unknown; expected {', '.join((AUTO, *TIR))}")
        if self.formula not in (None, *FORMULAS):
            raise ValueError(f"--error-bound {self.formula}: unknown; expected {', '.join(FORMULAS)}")
        if self.backward is not None and not self.backward > 0:
            raise ValueError(f"--backward-error {self.backward:g}; expected a positive number of roundings")
        self.target.check()
        for path, suffixes in zip((self.report, self.junit, self.json), OUTPUTS, strict=True):
            if path:
                writable(path, suffixes)

    @property
    def words(self) -> list[str]:
        """The options of the check that are not the default."""
        chosen = ["--tir", self.tir] if self.tir != "auto" else []
        chosen += ["--error-bound", self.formula] if self.formula else []
        return chosen + (["--backward-error", f"{self.backward:g}"] if self.backward else [])

    def check(self, rays: RaySet, answers: Answers, name: str, replay: list[str]) -> int:
        """Check the answers, print and write the reports; the exit code. `replay`: the words of the command."""
        from mi_refract.ray_sets import check_answers, reports, spread_check
        from mi_refract.ray_sets.tir_signal import LOOSEST

        with contextlib.ExitStack() as stack:
            certify: Certify = check_answers.certify_here
            if self.target.given:
                certify = stack.enter_context(spread_check.certifying(self.target, _say))
            found = check_answers.check(
                rays,
                answers,
                tir=self.tir,
                error_bound=self.formula or LOOSEST,
                most_backward=self.backward or math.inf,
                certify=functools.partial(_watched, certify, len(rays)),
            )
        # On a terminal, too: a wrapped line is easier to read than a squeezed column.
        Console(width=UNWRAPPED).print(reports.table(found), highlight=False)
        if self.report:
            about = {"answers": name} | {key: rays.header[key] for key in ("seed", "checksum")} | provenance()
            reports.write_html(self.report, found, about, shlex.join(["mi-refract", "rays", *replay]))
        if self.junit:
            reports.write_junit(self.junit, found, name)
        if self.json:
            reports.write_json(self.json, found)
        return found.exit_code


def _watched(certify: Certify, total: int, pieces: Iterable[Rays]) -> Iterator[tuple[int, Certified]]:
    """As `certify`, with the number of rays so far on a terminal's stderr."""
    console, count = Console(stderr=True), 0
    status = console.status(f"certified 0 of {total} rays") if console.is_terminal else None
    with status or contextlib.nullcontext():
        for number, exact in certify(pieces):
            count += len(exact)
            if status:
                status.update(f"certified {count} of {total} rays")
            yield number, exact


def _say(text: str) -> None:
    print(printable(f"mi-refract: {text}"), file=sys.stderr, flush=True)


def _wavelengths(text: str | None) -> tuple[float, ...]:
    """The numbers of --wavelengths; none without. ValueError for anything else."""
    try:
        return tuple(map(float, text.split(","))) if text is not None else ()
    except ValueError:
        raise ValueError(f"--wavelengths {text}; expected numbers in nm, such as 486.1327,587.5618") from None

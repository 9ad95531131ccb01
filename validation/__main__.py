"""`python -m validation [STUDY …] [--profile quick|full] [--out DIR]`, or `python -m validation renderers …`.

Exit code 0 where every budget held, 1 where one was broken, 2 for misuse, 130 where it was interrupted.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

# Each study by name, and the modules that make it up.
STUDIES = {
    "directions": {
        "directions": "directions.per_formula",
        "mutants": "directions.planted_defects",
        "samples": "directions.bsdf_samples",
        "sweep": "directions.sweep",
        "search": "directions.search",
    },
    "stability": {
        "stability": "stability.optical_chains",
        "energy": "stability.energy",
        "derivatives": "stability.derivatives",
        "paths": "stability.layered_paths",
    },
    "renders": {
        "scenes": "renders.scene_needs",
        "renders": "renders.against_dielectric",
        "features": "renders.unused_features",
    },
    "efficiency": {"efficiency": "efficiency.error_against_time", "scaling": "efficiency.scaling"},
    "planar": {
        "planar": "planar.against_retrace",
        "planar_closed": "planar.closed_paths",
        "extrusion": "planar.extruded_scenes",
        "planar_times": "planar.times",
    },
    "gate": {"gate": "diff.planted_defects", "diff_times": "diff.times"},
    "truth": {"truth": "ground_truth.traced_bodies"},
    "suite": {"matrix": "suite.matrix", "per_ray": "suite.per_ray", "images": "suite.rendered_images"},
}


def main(arguments: list[str] | None = None) -> int:
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments[:1] == ["renderers"]:
        from validation.suite.renderers import command

        return command.main(arguments[1:])
    options = _parser().parse_args(arguments)
    try:
        _check(options)
    except (ValueError, OSError) as error:
        print(f"validation: {error}", file=sys.stderr)
        return 2
    try:
        return _run(options)
    except KeyboardInterrupt:
        print("validation: interrupted; the same command goes on from here", file=sys.stderr)
        return 130
    except (OSError, ImportError) as error:  # anything else is a defect of ours, and keeps its traceback
        print(f"validation: {error}", file=sys.stderr)
        return 2


class _OneLine(argparse.ArgumentParser):
    def error(self, message: str) -> None:  # type: ignore[override]
        self.exit(2, f"{self.prog}: {message}\n")


def _parser() -> argparse.ArgumentParser:
    parser = _OneLine(prog="validation", description="Measure the formulas and the plugin; write the report.")
    parser.add_argument("studies", nargs="*", metavar="STUDY", help=f"of {', '.join(STUDIES)}; all by default")
    parser.add_argument("--profile", default="quick", choices=("quick", "full"), help="minutes, or hours")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder of the report (default: out)")
    parser.add_argument("--readme", type=Path, help="write the tables and the gallery of this Markdown file, too")
    return parser


def _check(options: argparse.Namespace) -> None:
    unknown = [name for name in options.studies if name not in STUDIES]
    if unknown:
        raise ValueError(f"unknown study {unknown[0]!r}; accepted: {', '.join(STUDIES)}")
    try:
        options.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(f"--out {options.out}: {error.strerror}; accepted: a writable folder") from None
    if not os.access(options.out, os.W_OK):
        raise PermissionError(f"{options.out}: not writable")


def _run(options: argparse.Namespace) -> int:
    from mi_refract import backend
    from mi_refract.report import run_report
    from validation.run.context import PROFILES, SCALAR_PROFILES, Context

    from . import headline, readme_tables, runner

    start = time.perf_counter()
    variant = backend.activate(may_restart=True)
    print(f"validation: {backend.summary()}", file=sys.stderr)
    profiles = SCALAR_PROFILES if variant.startswith("scalar") else PROFILES
    context = Context(profiles[options.profile], options.out, variant, backend.detect(), backend.usable_variants())
    modules = {name: module for study in options.studies or STUDIES for name, module in STUDIES[study].items()}
    studies: dict[str, ModuleType] = {name: import_module(f"validation.{module}") for name, module in modules.items()}
    rows = runner.run([task for study in studies.values() for task in study.tasks(context)], context)
    for study in studies.values():
        rows = study.with_summary(rows) if hasattr(study, "with_summary") else rows
    described = runner.describe(context, time.perf_counter() - start)
    described["studies"] = {
        name: {"title": study.TITLE, "text": " ".join(study.TEXT.split()), "terms": study.TERMS}
        | ({"axes": study.AXES} if hasattr(study, "AXES") else {})
        for name, study in studies.items()
    }
    described["scatter"] = [scatter for study in studies.values() for scatter in getattr(study, "SCATTER", [])]
    described["first_page"] = headline.first_page(rows, context.profile.name)
    run_report.write_json(options.out / "rows.json", rows, described)
    run_report.write_junit(options.out / "junit.xml", rows, described)
    run_report.write_html(options.out / "report.html", rows, described, options.out)
    if options.readme:
        readme_tables.update(options.readme, rows, context)
    runner.forget(context)
    _print_summary(run_report.summary(rows, described), options.out / "report.html")
    return 1 if any(row.verdict == "fail" for row in rows) else 0


def _print_summary(summary: Any, page: Path) -> None:
    from rich.console import Console

    console = Console()
    console.print(summary)
    console.print(f"report: {page}", highlight=False)


if __name__ == "__main__":
    sys.exit(main())

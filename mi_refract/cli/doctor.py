"""The command `mi-refract doctor`: what runs on this machine."""

from __future__ import annotations

import sys
from typing import Annotated, Any

import typer

from mi_refract import __version__, backend
from mi_refract.io.provenance import installed_version
from mi_refract.io.sanitise import json_text, printable_lines

from . import variants


def doctor(as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False) -> None:
    """Show which Mitsuba variants run on this machine, why the others do not, and what to install."""
    variants.probe()
    facts = diagnose()
    print(json_text(facts, indent=2) if as_json else printable_lines(_as_text(facts)))
    if None not in facts["variants"].values():
        raise ValueError("no Mitsuba variant can run on this machine")


def diagnose() -> dict[str, Any]:
    """What `doctor` prints: `variants` (None, or why not), `libllvm` ("works", or the defect), `versions`, `advice`."""
    names = ("mitsuba", "drjit", "numpy", "OpenImageIO")
    versions = {"mi_refract": __version__, "python": sys.version.split()[0]}
    return {
        "variants": backend.usable_variants(),
        "libllvm": {library.path: library.defect or "works" for library in backend.libraries()},
        "versions": versions | {name: installed_version(name) for name in names},
        "advice": backend.advice(),
    }


def _as_text(facts: dict[str, Any]) -> str:
    variants = {name: "usable" if reason is None else f"no: {reason}" for name, reason in facts["variants"].items()}
    tables = {"variants": variants, "libLLVM": facts["libllvm"] or {"none found": ""}, "versions": facts["versions"]}
    lines = []
    for title, table in tables.items():
        width = max(map(len, table))
        lines += [title, *(f"  {name:{width}}  {text}".rstrip() for name, text in table.items()), ""]
    return "\n".join([*lines, facts["advice"]])

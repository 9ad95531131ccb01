"""The command `mi-refract doctor`, and the choice of the Mitsuba variant for the other commands."""

from __future__ import annotations

import sys
from typing import Annotated, Any

import typer

from mi_refract import __version__, backend
from mi_refract.io.image_file import installed_version
from mi_refract.io.text import json_text, printable_lines

from .interrupts import as_exceptions


def doctor(as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False) -> None:
    """Show which Mitsuba variants run on this machine, why the others do not, and what to install."""
    probe()
    libraries = {library.path: library.defect or "works" for library in backend.libraries()}
    versions = {name: installed_version(name) for name in ("mitsuba", "drjit", "numpy", "OpenImageIO")}
    facts: dict[str, Any] = {
        "variants": backend.usable_variants(),
        "libllvm": libraries,
        "versions": {"mi_refract": __version__, "python": sys.version.split()[0]} | versions,
        "advice": backend.advice(),
    }
    if as_json:
        print(json_text(facts, indent=2))
    else:
        variants = {name: "usable" if reason is None else f"no: {reason}" for name, reason in facts["variants"].items()}
        tables = {"variants": variants, "libLLVM": libraries or {"none found": ""}, "versions": facts["versions"]}
        lines = []
        for title, table in tables.items():
            width = max(map(len, table))
            lines += [title, *(f"  {name:{width}}  {text}".rstrip() for name, text in table.items()), ""]
        print(printable_lines("\n".join([*lines, facts["advice"]])))
    if None not in facts["variants"].values():
        raise ValueError("no Mitsuba variant can run on this machine")


def probe(*, every_backend: bool = True) -> None:
    """Test the installed libLLVMs and, with `every_backend`, all backends; `backend` caches the result.

    The tests run in child processes, which Ctrl-C also ends. This process may restart itself.
    """
    with as_exceptions():
        backend.restart_if_needed()
        if every_backend:
            backend.detect()


def activate(variant: str | None = None) -> str:
    """Set a Mitsuba variant, by default the best that runs here; return its name. Errors as `backend.activate`."""
    probe(every_backend=variant is not None and not variant.startswith("scalar_"))
    return backend.activate(variant)

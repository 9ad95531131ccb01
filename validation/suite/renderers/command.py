"""`python -m validation renderers [--list | --install NAME,… | --page OUT.html]`: the other renderers.

Exit code: 0; 1 if an installation fails, with one line on stderr for each; 2 for misuse.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from mi_refract.io import errors
from mi_refract.io.safe_files import writable
from validation.run import command_line

from . import environments
from .image_renderers import IMAGE_RENDERERS
from .system import SYSTEMS, System

NAME = "validation renderers"
app = command_line.application()


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    return command_line.exit_code(app, NAME, arguments)


@app.command()
def _command(
    listed: Annotated[
        bool, typer.Option("--list", help="List the renderers and whether they are installed (default).")
    ] = False,
    install: Annotated[str, typer.Option(metavar="NAME,…", help=f"Install some of {', '.join(SYSTEMS)}.")] = "",
    page: Annotated[
        Path | None, typer.Option(metavar="OUT.html", help="Write the results of the last validation as an HTML page.")
    ] = None,
    data: Annotated[Path | None, typer.Option("--json", metavar="OUT.json", help="Write them as JSON.")] = None,
    out: Annotated[Path, typer.Option(help="Folder of the validation report.")] = Path("out"),
) -> int:
    """List or install the other renderers and libraries, or write a page of their results."""
    if page or data:
        _write(page, data, out)
        return 0
    wanted = [name.strip() for name in install.split(",") if name.strip()]
    if unknown := [name for name in wanted if name not in SYSTEMS]:
        raise ValueError(f"unknown system {unknown[0]!r}; expected {', '.join(SYSTEMS)}")
    if listed and wanted:
        raise ValueError("--list with --install; expected one of them")
    if not wanted:
        print("\n".join(_line(system) for system in SYSTEMS.values()))
    return max([_install(SYSTEMS[name]) for name in wanted], default=0)


def _write(page: Path | None, data: Path | None, out: Path) -> None:
    from validation.suite import matrix

    for path, suffixes in ((page, (".html", ".htm")), (data, (".json",))):
        if path:
            writable(path, suffixes)
    results = matrix.read(out)
    if page:
        matrix.write_html(page, results)
    if data:
        matrix.write_json(data, results)


def _install(system: System) -> int:
    print(f"{system.name}: {system.source}", file=sys.stderr)
    try:
        environments.install(system)
    except OSError as error:
        print(f"{NAME}: {errors.describe(error)}", file=sys.stderr)
        return 1
    return 0


def _line(system: System) -> str:
    draws = any(renderer.system == system.name for renderer in IMAGE_RENDERERS.values())
    able = {"rays": system.calls, "images": draws, "lenses": system.lens}
    inputs = " and ".join(word for word, can in able.items() if can) or "exports"
    state = "absent" if environments.absent(system) else "installed"
    size = system.install.megabytes if system.install else 0
    name = f"{system.name:{max(map(len, SYSTEMS))}}"
    return f"{name} {state:9} {inputs:16} {size:5} MB  {system.source}  [{system.licence}]"

"""The command `mi-refract trace`: it traces rays through a planar scene."""

from __future__ import annotations

import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import typer

from mi_refract.io import safe_files
from mi_refract.io.text import json_text, printable
from mi_refract.planar import figure, focal_points, light, scene_file
from mi_refract.planar.path_tree import as_data, follow_scene, mismatches, summary, with_rays

from .app import shows
from .doctor import probe


def trace(
    scene: Annotated[
        Path, typer.Argument(metavar="SCENE.toml", help="The scene; --keys prints all keys of such a file.")
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="OUT.svg|.png|.pdf", help="Draw a figure.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the paths as JSON.")] = False,
    table: Annotated[bool, typer.Option("--table", help="Print focal points and spot sizes.")] = False,
    plane: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y[,DEGREES]", help="Also print spots on the plane through X,Y, perpendicular to +x or DEGREES."
        ),
    ] = None,
    branches: Annotated[
        int | None,
        typer.Option(min=0, max=scene_file.MOST_BRANCHES, help="Largest number of partial reflections on a path."),
    ] = None,
    rays: Annotated[int | None, typer.Option(min=1, help="Number of rays in each beam of more than one ray.")] = None,
    max_depth: Annotated[int | None, typer.Option(min=1, help="Largest number of boundaries on a path.")] = None,
    wavelengths: Annotated[
        str | None,
        typer.Option(metavar="NM,NM|COUNT", help="Wavelengths in nm, or their number; replaces those of the scene."),
    ] = None,
    precision: Annotated[str, typer.Option(help="float64, or float32 with LLVM or CUDA.")] = "float64",
    formula: Annotated[str | None, typer.Option(help="Formula of refraction. Default: the planar formula.")] = None,
    arrays: Annotated[str | None, typer.Option("--backend", help="llvm, cuda or scalar; see `doctor`.")] = None,
    keys: Annotated[
        bool,
        typer.Option(
            "--keys", is_eager=True, callback=shows(scene_file.reference), help="Print all keys of a scene file."
        ),
    ] = False,
) -> None:
    """Trace the rays of a planar scene; draw them, print their paths, or print focal points."""
    probe()
    if output:
        safe_files.writable(output, figure.FORMATS)
        figure.require_matplotlib()
    screen = None if plane is None else focal_points.plane(plane)
    loaded = scene_file.load(scene, None if wavelengths is None else light.parsed(wavelengths))
    branches = loaded.branches if branches is None else branches
    loaded = replace(loaded, branches=branches, max_depth=max_depth or loaded.max_depth)
    if rays:
        loaded = with_rays(loaded, rays)
    traced = follow_scene(loaded, formula=formula, precision=precision, backend=arrays)
    foci = focal_points.groups(loaded, traced, screen) if table or screen else None
    data = as_data(loaded, traced) if as_json else {}
    lines = [f"{loaded.file}: {summary(loaded, traced)}", *([focal_points.table(foci)] if foci else [])]
    if output:
        figure.save(output, loaded, traced)
        lines.append(printable(f"{output}: written"))
    if as_json and foci is not None:
        data["foci"] = [asdict(group) for group in foci]
    print(json_text(data) if as_json else "\n".join(lines))
    if wrong := mismatches(loaded, traced):
        expected = "expected shapes that share whole edges, lie in one another by `within`, or are apart"
        print(printable(f"mi-refract: {scene}: {'; '.join(wrong)}; {expected}"), file=sys.stderr)
        raise typer.Exit(1)

"""The commands `mi-refract scene export` and `mi-refract scene list`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from mi_refract import SCENES
from mi_refract.io.text import printable
from mi_refract.rendering import scene_files

from .app import Define
from .doctor import activate

app = typer.Typer(help="Write scenes for other renderers.", add_completion=False, rich_markup_mode=None)


@app.command("list")
def list_scenes() -> None:
    """List the scenes of the package.

    `export` takes the names of Mitsuba scenes; the others are files for `mi-refract trace`.
    """
    print(printable(f"in {SCENES}:"))
    paths = [*sorted(SCENES.glob("*.xml")), *sorted(SCENES.glob("planar/*.toml"))]
    names = [path.stem if path.suffix == ".xml" else str(path.relative_to(SCENES)) for path in paths]
    for name, path in zip(names, paths, strict=True):
        pattern = r"<!--(.*?[.:])\s" if path.suffix == ".xml" else r'title = "(.*?)"'
        match = re.search(pattern, path.read_text("utf-8"), re.DOTALL)
        title = " ".join(match[1].split()).rstrip(".:") if match else ""
        print(printable(f"{name:{max(map(len, names))}}  {title}"))


@app.command()
def export(
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="A Mitsuba scene, or the name of one of `scene list`.")],
    to: Annotated[
        str,
        typer.Option(metavar="TARGET", help="cycles, luxcore, radiance, raysect, povray, mitsuba, obj+json or gltf."),
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FOLDER", help="A new or empty folder. Default: NAME-TARGET."),
    ] = None,
    level: Annotated[
        int | None, typer.Option(help="Subdivision of curved shapes, 0 to 8; each level halves the edges. Default: 5.")
    ] = None,
    define: Define = None,
) -> None:
    """Write a Mitsuba scene for another renderer, as triangles.

    README.txt says how to render it.
    """
    defines = scene_files.parse_defines(define or [])
    activate("scalar_rgb")
    from mi_refract.scene_export import from_mitsuba, targets

    path = next((path for path in (Path(scene), SCENES / f"{scene}.xml") if path.is_file()), None)
    if path is None:
        names = sorted(path.stem for path in SCENES.glob("*.xml"))
        raise FileNotFoundError(f"{scene}: no such scene; expected {', '.join(['a file', *names])}")
    folder = output or Path(f"{path.stem}-{to}")
    plain = from_mitsuba.load(path, level=from_mitsuba.LEVEL if level is None else level, defines=defines)
    written = targets.write(plain, to, folder)
    triangles = sum(len(mesh.faces) for mesh in plain.meshes)
    summary = f"{len(written)} files, {triangles} triangles; {folder / 'README.txt'} says how to render them"
    print(printable(f"{folder}: {summary}"))

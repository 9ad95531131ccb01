"""`python -m validation pack -o FOLDER [--quick]` writes the reference pack."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Annotated

import typer

from mi_refract.io import safe_files
from mi_refract.io.image_file import installed_version
from mi_refract.io.text import printable
from validation.run import command_line

NAME = "validation pack"
app = command_line.application()


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    return command_line.exit_code(app, NAME, arguments)


@app.command()
def _command(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FOLDER", help="Folder for the archive.")],
    quick: Annotated[bool, typer.Option("--quick", help="Few rays and small images, for a first look.")] = False,
) -> None:
    """Write the reference pack: scenes, images, rays and standard numbers, in one zip file that needs no mi_refract."""
    safe_files.check_parent(output / "pack" if output.exists() else output)
    if not all(map(importlib.util.find_spec, ("flint", "jinja2", "trimesh"))):
        raise ValueError("a pack needs the extra `validation`: pip install 'mi-refract[validation]'")
    from mi_refract import __version__, backend

    variant = backend.activate("llvm_ad_rgb")
    from validation import runner

    from . import contents

    facts = runner.facts(variant)
    made_with = {name: facts[name] for name in sorted(facts) if name not in ("host", "cannot run", "other renderers")}
    pack = contents.Contents(contents.QUICK if quick else contents.FULL)
    parts = pack.parts()
    for number, (name, make) in enumerate(parts):
        print(printable(f"{NAME}: {number + 1} of {len(parts)}: {name}"), file=sys.stderr, flush=True)
        make()
    made_with |= {"variant": variant, "trimesh": installed_version("trimesh")}
    files = pack.whole(__version__, quick, made_with)
    top = f"mi-refract-pack-{__version__}{'-quick' if quick else ''}"
    output.mkdir(exist_ok=True)
    path = output / f"{top}.zip"
    safe_files.write_atomically(path, contents.archive(files, top))
    print(printable(f"{path}: {len(files)} files, {path.stat().st_size / 1e6:.1f} MB"))

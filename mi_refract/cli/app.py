"""The command `mi-refract`. Words in, words out: the work is done in the other modules.

Errors are one line on stderr, `mi-refract: ...`, and exit code 2. Ctrl-C exits with 130.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import threading
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

try:
    import typer
    from rich.console import Console
except ModuleNotFoundError as missing:
    if missing.name not in ("typer", "rich"):
        raise
    print("mi-refract needs the extra `cli`: pip install 'mi-refract[cli]'", file=sys.stderr)
    sys.exit(2)

from mi_refract import __version__, backend
from mi_refract.io import atomic, image_file
from mi_refract.planar import figure, focal_points, scene_file, scene_schema
from mi_refract.planar.path_tree import as_data, follow_scene, summary, with_rays
from mi_refract.rendering import scene_files

from . import diff as cli_diff
from . import rays as cli_rays
from . import scene as cli_scene

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.", is_eager=True)] = False,
) -> None:
    """The reference for refraction in rendering."""
    if version:
        print(__version__)
    elif context.invoked_subcommand is None:
        print(context.get_help())
        raise typer.Exit(2)


@app.command()
def doctor(as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False) -> None:
    """Say which Mitsuba variants run here, why the others do not, and what to install."""
    backend.restart_if_needed()
    facts = diagnose()
    print(json.dumps(facts, indent=2) if as_json else _as_text(facts))
    if None not in facts["variants"].values():
        raise ValueError("no variant of Mitsuba runs here; accepted: at least one")


def diagnose() -> dict[str, Any]:
    """What `doctor` prints: `variants` (None, or why not), `libllvm` ("works", or the defect), `versions`, `advice`."""
    names = ("mitsuba", "drjit", "numpy", "OpenImageIO")
    versions = {"mi_refract": __version__, "python": sys.version.split()[0]}
    return {
        "variants": backend.usable_variants(),
        "libllvm": {library.path: library.defect or "works" for library in backend.libraries()},
        "versions": versions | {name: scene_files.version(name) for name in names},
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


@app.command()
def render(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.xml", help="A Mitsuba scene.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT.exr", help="The image to write.")],
    define: Annotated[list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="Replace a <default>.")] = None,
    variant: Annotated[str | None, typer.Option(help="A Mitsuba variant; see `doctor`.")] = None,
    spp: Annotated[int | None, typer.Option(min=1, help="Samples per pixel; the scene's own by default.")] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Seed of the sampler.")] = 0,
) -> None:
    """Render a scene that may use the plugin `refract`, which Mitsuba's own executable cannot see."""
    defines = scene_files.parse_defines(define or [])
    chosen = backend.activate(variant, may_restart=True)
    console = Console(stderr=True)
    with _interruptible(console, image_file.temporary_name(output)), _spinner(console, f"{scene.name}, {chosen}"):
        header = scene_files.render_to_exr(scene, output, defines=defines, spp=spp, seed=seed)
    print(f"{output}: {chosen}, {header['mi_refract:spp']} spp, {header['mi_refract:render_seconds']:.2f} s")
    if variant is None and not backend.llvm().usable:
        print(f"mi-refract: {chosen} is slow; {backend.summary()}", file=sys.stderr)


def _print_keys(asked: bool) -> None:
    if asked:
        print(scene_schema.reference())
        raise typer.Exit


@app.command()
def trace(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="A planar scene.")],
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="OUT.svg|.png|.pdf", help="Draw.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the paths as JSON.")] = False,
    table: Annotated[bool, typer.Option("--table", help="Print focal points and spot sizes.")] = False,
    branches: Annotated[int | None, typer.Option(min=0, help="Partial reflections on a path, at most.")] = None,
    rays: Annotated[int | None, typer.Option(min=1, help="Rays of each beam that has several.")] = None,
    max_depth: Annotated[int | None, typer.Option(min=1, help="Boundaries on a path, at most.")] = None,
    precision: Annotated[str, typer.Option(help="float64 or float32.")] = "float64",
    formula: Annotated[str | None, typer.Option(help="A formula of refraction; the planar one by default.")] = None,
    arrays: Annotated[str | None, typer.Option("--backend", help="llvm, cuda or scalar; see `doctor`.")] = None,
    keys: Annotated[
        bool, typer.Option("--keys", is_eager=True, callback=_print_keys, help="Print what a scene file may hold.")
    ] = False,
) -> None:
    """Follow the rays of a planar scene; draw them, print their paths, or where they come together."""
    backend.restart_if_needed()
    if output:
        atomic.writable(output, figure.FORMATS)
        figure.require_matplotlib()
    told: dict[str, Any] = {"branches": branches, "max_depth": max_depth}
    loaded = replace(scene_file.load(scene), **{name: value for name, value in told.items() if value is not None})
    if rays:
        loaded = with_rays(loaded, rays)
    traced = follow_scene(loaded, formula=formula, precision=precision, backend=arrays)
    if output:
        figure.save(output, loaded, traced)
    found = focal_points.groups(loaded, traced) if table else []
    if as_json:
        focal = {"foci": [asdict(group) for group in found]} if table else {}
        print(json.dumps(as_data(loaded, traced) | focal, allow_nan=False))
    else:
        print("\n".join([f"{scene.name}: {summary(loaded, traced)}", *([focal_points.table(found)] if found else [])]))


app.command()(cli_diff.diff)
app.command()(cli_diff.accept)
app.add_typer(cli_rays.app, name="rays")
app.add_typer(cli_scene.app, name="scene")


def _spinner(console: Console, text: str) -> contextlib.AbstractContextManager[Any]:
    return console.status(text) if console.is_terminal else contextlib.nullcontext()


@contextlib.contextmanager
def _interruptible(console: Console, temporary: Path) -> Iterator[None]:
    """Within, Ctrl-C ends the process at once with 130.

    Python's own handler would wait until Mitsuba returns from the whole rendering. The byte that the interpreter
    writes on a signal wakes a thread of ours at once. All there is to clean up is a half-written file.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    before = signal.set_wakeup_fd(writing)
    # Also in a background job, for which the shell ignores Ctrl-C: Mitsuba heeds it all the same.
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)

    def watch() -> None:
        for number in iter(lambda: os.read(reading, 1), b""):
            if number[0] == signal.SIGINT:
                temporary.unlink(missing_ok=True)
                if console.is_terminal:
                    console.show_cursor(True)
                os._exit(130)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        signal.set_wakeup_fd(before)
        os.close(writing)
        thread.join()
        os.close(reading)


def main(arguments: list[str] | None = None) -> int:
    """The entry point: runs the command line, or `arguments`; the exit code."""
    try:
        return app(arguments, prog_name="mi-refract", standalone_mode=False) or 0
    except (ValueError, OSError) as error:
        return _fail(str(error))
    except KeyboardInterrupt:
        return 130
    except Exception as error:
        # Typer's parser raises errors of its own, in a module whose name depends on its version.
        if type(error).__name__ == "Abort":
            return 130
        if not hasattr(error, "format_message"):
            raise
        return _fail(error.format_message())


def _fail(message: str) -> int:
    print(f"mi-refract: {' '.join(message.split())}", file=sys.stderr)
    return 2

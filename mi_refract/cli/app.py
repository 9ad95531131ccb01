"""The list of commands of `mi-refract`, and the printing of errors.

A command's module is imported only when that command is called, which keeps `--help` and `--version` fast. Errors are
one line on stderr, `mi-refract: ...`, with exit code 2. Ctrl-C exits with 130.
"""

from __future__ import annotations

import functools
import importlib
import sys
import warnings
from collections.abc import Callable
from typing import Annotated, Any

try:
    import typer
    from typer.core import TyperGroup
except ModuleNotFoundError as missing:
    if missing.name not in ("typer", "rich"):
        raise
    print("mi-refract needs the extra `cli`: pip install 'mi-refract[cli]'", file=sys.stderr)
    sys.exit(2)

from mi_refract import __version__
from mi_refract.io.errors import exit_code
from mi_refract.io.text import printable

# Options of several commands.
Define = Annotated[
    list[str] | None,
    typer.Option("-D", metavar="NAME=VALUE", help="Replace the value of a <default>; may be repeated."),
]
AllowPlugins = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME", help="Also allow this plugin, which ships with the scene; may be repeated."),
]


# By command: its module, its function or `typer.Typer` of subcommands in that module, and its line in the help.
COMMANDS = {
    "render": ("render", "render", "Render a Mitsuba scene, with our plugins, into an EXR file."),
    "trace": ("trace", "trace", "Trace rays through a planar scene; draw them, print focal points."),
    "diff": ("diff", "diff", "Compare images with their references: equal or different?"),
    "accept": ("diff", "accept", "Make the images that differ the new references."),
    "self-test": ("diff", "self_test", "Show which defects a comparison of images would detect."),
    "rays": ("rays", "app", "Check another program's refraction, ray by ray."),
    "scene": ("scene", "app", "Export a Mitsuba scene for another renderer."),
    "doctor": ("doctor", "doctor", "Show which Mitsuba variants run here, and what is missing."),
}

# The examples at the end of a command's help, by the command's name.
EXAMPLES = {
    "": ("doctor", "render scene.xml -o image.exr --spp 256", "diff references/ new/ --report out.html"),
    "render": (
        "render scene.xml -o image.exr --spp 256",
        "render scene.xml -o image.exr --until 0.5% --preview image.png",
        "render scene.xml -o reference.exr --time 1h30m -D bsdf=dielectric",
    ),
    "trace": (
        "trace lens.toml --rays 2000 -o lens.svg",
        "trace lens.toml --table --wavelengths 486.1,587.6,656.3",
        "trace --keys",
    ),
    "diff": (
        "diff reference.exr new.exr",
        "diff references/ new/ --report out.html --junit out.xml",
        "diff references/ new/ --method tolerance --set fail=0.01",
    ),
    "accept": ("accept references/ new/", "accept --from out.json --yes"),
    "self-test": ("self-test reference.exr", "self-test scene.xml"),
    "rays": ("rays run --report out.html -- ./my_tracer", "rays export -o rays.csv"),
    "rays export": (
        "rays export -o rays.csv",
        "rays export -o rays.npz --regime critical --count 100000 --precision f64",
        "rays export --regimes",
    ),
    "rays check": ("rays check answers.csv", "rays check answers.csv --rays rays.csv --report out.html"),
    "rays run": (
        "rays run -- ./my_tracer",
        "rays run --medium SCHOTT:N-BK7 --wavelengths 450,550,650 -- ./my_tracer",
        "rays run --renderer my_renderer/ --junit out.xml",
    ),
    "scene": ("scene list", "scene export sphere --to cycles", "scene export my_scene.xml --to obj+json"),
    "scene list": ("scene list", "scene export prism --to mitsuba"),
    "scene export": (
        "scene export sphere --to cycles",
        "scene export my_scene.xml --to povray -o povray/ --level 6 -D bsdf=refract",
    ),
    "doctor": ("doctor", "doctor --json"),
}


def examples(name: str) -> str:
    """Return the EXAMPLES of a command as lines that typer does not wrap."""
    return "\n".join(["\b", "Examples:", *(f"  mi-refract {words}" for words in EXAMPLES.get(name, ()))])


def with_examples(command: Any, name: str) -> Any:
    """Append examples to the help of the command `name` and of its subcommands; return the command."""
    command.epilog = examples(name)
    for subname, subcommand in getattr(command, "commands", {}).items():
        with_examples(subcommand, f"{name} {subname}")
    return command


class Commands(TyperGroup):
    """The commands in COMMANDS; each module is imported when its command is called."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names in the order of the help."""
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return the command with that name. ValueError for an unknown name."""
        if cmd_name not in COMMANDS:
            raise ValueError(f"unknown command {cmd_name!r}; expected {', '.join(COMMANDS)}")
        module, attribute, _ = COMMANDS[cmd_name]
        command = getattr(importlib.import_module(f".{module}", __package__), attribute)
        if not isinstance(command, typer.Typer):
            single = typer.Typer(add_completion=False, rich_markup_mode=None)
            single.command(cmd_name)(command)
            command = single
        return with_examples(typer.main.get_command(command), cmd_name)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write one line per command, without importing the commands."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, _, text) in COMMANDS.items()])


app = typer.Typer(cls=Commands, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


@app.callback(invoke_without_command=True, epilog=examples(""))
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.", is_eager=True)] = False,
) -> None:
    """Refraction in rendering: plugins for Mitsuba, and checks of other programs.

    `mi-refract COMMAND --help` explains a command.
    """
    if version:
        print(__version__)
    elif context.invoked_subcommand is None:
        print(context.get_help())
        raise typer.Exit(2)


def shows(text: Callable[[], str]) -> Callable[[bool], None]:
    """Return the callback of an eager flag that prints a text instead of running the command."""

    def callback(is_set: bool) -> None:
        if is_set:
            print(text())
            raise typer.Exit

    return callback


def main(arguments: list[str]) -> int:
    """Run `arguments` and return the exit code. Warnings are one line on stderr."""
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_: print(printable(f"mi-refract: {message}"), file=sys.stderr)
        # `obj`: reports show the command line that made them.
        run = functools.partial(app, arguments, prog_name="mi-refract", standalone_mode=False, obj=arguments)
        return exit_code("mi-refract", run, (KeyboardInterrupt, typer.Abort))

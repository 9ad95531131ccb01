"""`python -m validation renderers [--list | --install NAME,…]`: the other systems, and what brings them.

Exit code 0; 1 where an installation failed, with a line on stderr for each; 2 for misuse.
"""

from __future__ import annotations

import argparse
import sys
from typing import NoReturn

from . import SYSTEMS, environments
from .system import System


class _OneLine(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}\n")


def main(arguments: list[str]) -> int:
    options = _parser().parse_args(arguments)
    wanted = [name.strip() for name in (options.install or "").split(",") if name.strip()]
    if unknown := [name for name in wanted if name not in SYSTEMS]:
        print(f"validation renderers: unknown system {unknown[0]!r}; accepted: {', '.join(SYSTEMS)}", file=sys.stderr)
        return 2
    if not wanted:
        print("\n".join(_line(system) for system in SYSTEMS.values()))
    return max([_install(SYSTEMS[name]) for name in wanted], default=0)


def _parser() -> argparse.ArgumentParser:
    parser = _OneLine(prog="validation renderers", description="Other renderers and libraries that can be run here.")
    choice = parser.add_mutually_exclusive_group()
    choice.add_argument("--list", action="store_true", help="what there is, and whether it is installed (default)")
    choice.add_argument("--install", metavar="NAME,…", help=f"of {', '.join(SYSTEMS)}")
    return parser


def _install(system: System) -> int:
    print(f"{system.name}: {system.source}", file=sys.stderr)
    try:
        environments.install(system)
    except OSError as error:
        print(f"validation renderers: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    return 0


def _line(system: System) -> str:
    does = " and ".join(word for word, able in (("rays", system.calls), ("images", system.draws)) if able)
    state = "absent" if environments.absent(system) else "here"
    return f"{system.name:10} {state:7} {does:18} {system.megabytes:5} MB  {system.source}  [{system.licence}]"

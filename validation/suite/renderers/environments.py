"""The environments of the other renderers: where they are, how they are made, and how a program in one is run."""

from __future__ import annotations

import functools
import hashlib
import json
import os
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from mi_refract.io import process_group
from mi_refract.io.atomic import write_atomically
from mi_refract.io.errors import TooMuchOutputError
from mi_refract.ray_sets import renderer_file

from .system import LOCKS, SCRIPTS, Apt, Npm, Pip, System

COMMAND = "python -m validation renderers --install"
CANNOT = 77  # the exit code of a script that cannot run on this machine
TIMEOUT = 600.0  # seconds; a busy machine is slow, a program that hangs is slower
_INSTALLING = 3600.0
_ASKING = 60.0
_FOREIGN = ("PYTHONPATH", "PYTHONHOME", "PYTHONSTARTUP", "VIRTUAL_ENV")


class Unable(Exception):
    """A program that cannot run on this machine; the text says why."""


class Broken(Exception):
    """A program that should run, and crashed or hung; the text says how."""


# Where they are --------------------------------------------------------------------------------------------------


def folder(system: System) -> Path:
    """`$XDG_CACHE_HOME/mi_refract/renderers/<name>`, there or not."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mi_refract" / "renderers" / system.name


def absent(system: System) -> str:
    """ "" where the system is installed in its pinned version; otherwise the command that installs it."""
    if isinstance(system.needs, Apt):
        program, version = shutil.which(system.needs.program), system.needs.version
        present = program is not None and (not version or version in _said_version(program))
    else:
        try:
            present = system.needs is None or json.loads(_marker(system).read_text()) == _mark(system)
        except (OSError, ValueError):
            present = False
    return "" if present else f"{COMMAND} {system.name}"


@functools.cache
def _said_version(program: str) -> str:
    """What a program says to --version; "" where it does not say it in time."""
    try:
        ended = process_group.run([program, "--version"], b"", _ASKING, keep_stderr=True)
    except (OSError, TimeoutError, TooMuchOutputError):
        return ""
    return (ended.out + ended.said).decode(errors="replace")


def _marker(system: System) -> Path:
    """Written once an installation is complete."""
    return folder(system) / "installed.json"


def _mark(system: System) -> list[str]:
    """What is installed: another version of the table or of the lock is another mark."""
    locks = [locked(system) / "package-lock.json" if isinstance(system.needs, Npm) else locked(system)]
    if isinstance(system.needs, Pip) and system.needs.built:
        locks.append(locked_source(system))
    return [repr(system.needs), *(hashlib.sha256(lock.read_bytes()).hexdigest() for lock in locks)]


def locked(system: System) -> Path:
    """The packages with their hashes, of all that may be installed: a file for pip, a folder for npm."""
    return LOCKS / (system.name if isinstance(system.needs, Npm) else f"{system.name}.txt")


def locked_source(system: System) -> Path:
    """The source of the one package that there is no wheel of, with its hash."""
    return LOCKS / f"{system.name}.source.txt"


def python(system: System) -> str:
    """The interpreter that the system's scripts are for."""
    return str(folder(system) / "bin" / "python") if isinstance(system.needs, Pip) else sys.executable


# Making them -----------------------------------------------------------------------------------------------------


def install(system: System) -> None:
    """Make the environment anew, unless it is there. OSError, one line, where that fails."""
    needs = system.needs
    if not absent(system):
        return
    if isinstance(needs, Apt):
        root = [] if os.geteuid() == 0 else ["sudo", "-n"]
        try:
            _do(system, [*root, "apt-get", "install", "-y", "-qq", "--no-install-recommends", *needs.packages])
        except OSError as error:
            try:
                names = [package.partition("=")[0] for package in needs.packages]
                listed = run(["apt-cache", "madison", *names], timeout=_ASKING).splitlines()
            except (Broken, Unable):
                listed = []
            versions = sorted({" ".join("".join(line.split("|")[:2]).split()) for line in listed})
            raise OSError(f"{error}; this distribution has {', '.join(versions) or 'none'}") from None
        _said_version.cache_clear()
        return
    if not locked(system).exists():
        raise OSError(f"{system.name}: its packages have no lock; expected {locked(system)}")
    shutil.rmtree(folder(system), ignore_errors=True)
    folder(system).mkdir(parents=True)
    if isinstance(needs, Npm):
        for name in ("package.json", "package-lock.json"):
            shutil.copy(locked(system) / name, folder(system))
        options = ["--ignore-scripts", "--silent", "--no-audit", "--no-fund"]
        _do(system, ["npm", "ci", *options, "--prefix", str(folder(system))])
    elif isinstance(needs, Pip):
        # This environment's pip for the other one: to make one there costs more than most of what it would install.
        own = f"{sys.version_info[0]}.{sys.version_info[1]}"
        interpreter = sys.executable if needs.python in ("", own) else shutil.which(f"python{needs.python}")
        if interpreter is None:
            raise OSError(f"{system.name}: needs Python {needs.python}; expected a python{needs.python} in PATH")
        _do(system, [interpreter, "-m", "venv", "--without-pip", str(folder(system))])
        pip = [sys.executable, "-m", "pip", "--python", python(system), "install"]
        options = ["--quiet", "--disable-pip-version-check", "--no-input", "--no-compile", "--no-deps"]
        # To build a package would run, and fetch, code without a hash; not so without isolation, by locked tools.
        safe = ["--require-hashes", "--only-binary", ":all:"]
        _do(system, [*pip, *options, *safe, "--requirement", str(locked(system))])
        if needs.built:
            safe = ["--require-hashes", "--no-binary", ":all:", "--no-build-isolation"]
            _do(system, [*pip, *options, *safe, "--requirement", str(locked_source(system))])
    write_atomically(_marker(system), json.dumps(_mark(system)))


def _do(system: System, command: Sequence[str]) -> None:
    try:
        run(command, timeout=_INSTALLING)
    except (Broken, Unable) as error:
        raise OSError(f"{system.name}: {' '.join(command)}: {error}") from None


# Running in them ---------------------------------------------------------------------------------------------------


def script(system: System, name: str, *arguments: str) -> list[str]:
    """The command that runs a script of scripts/ in the system's environment."""
    return [python(system), str(SCRIPTS / name), *arguments]


def ask(
    system: System,
    command: tuple[str, ...],
    given: str = "",
    timeout: float | None = None,
    values: Mapping[str, object] | None = None,
) -> str:
    """What a command of the system's file, filled in with `values`, answers to `given` on its stdin.

    Errors as of `run`. Unable also where its program is none of this machine.
    """
    words = renderer_file.filled(command, python=python(system), environment=folder(system), **(values or {}))
    if os.sep not in words[0] and not shutil.which(words[0]):
        raise Unable(f"no {words[0]} in PATH")
    return run(words, given, timeout, system.folder)


def run(command: Sequence[str], given: str = "", timeout: float | None = None, where: Path | None = None) -> str:
    """The output of a program with `given` on its stdin; all its processes have ended when this returns.

    Unable: it exits with CANNOT, for the reason that is its last line on stderr. Broken: it is not there, exits with
    another code than 0, is killed, prints no text, or runs for longer than `timeout` seconds (TIMEOUT by default).
    """
    own = {name: value for name, value in os.environ.items() if name not in _FOREIGN}
    own |= {"PYTHONNOUSERSITE": "1", "PYTHONUTF8": "1"}
    limit = TIMEOUT if timeout is None else timeout
    try:
        ended = process_group.run(command, given.encode(), limit, keep_stderr=True, cwd=where, env=own)
    except (TimeoutError, TooMuchOutputError) as error:
        raise Broken(str(error)) from None
    except OSError as error:
        raise Broken(f"{command[0]}: {error.strerror}") from None
    if ended.status == CANNOT:
        raise Unable(_last_word(ended.said))
    if ended.status:
        raise Broken(f"{ended.describe}: {_last_word(ended.said)}")
    try:
        return ended.out.decode()
    except UnicodeDecodeError:
        raise Broken(f"wrote {len(ended.out)} bytes that are not text") from None


def _last_word(said: bytes) -> str:
    """The last line on stderr, which names the error."""
    lines = [line.strip() for line in said.decode(errors="replace").splitlines() if line.strip()]
    return lines[-1] if lines else "no word on stderr"

"""The environments of the other renderers: where they are, how they are made, and how a program in one is run."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from mi_refract.io import process_group
from mi_refract.io.errors import MissingExtraError, TooMuchOutputError
from mi_refract.io.safe_files import write_atomically
from mi_refract.ray_sets import renderer_file
from mi_refract.report.row import Reason, Row

from .system import LOCKS, SCRIPTS, System

COMMAND = "python -m validation renderers --install"
CANNOT = 77  # the exit code of a script that cannot run on this machine
TIMEOUT = 600.0  # seconds; a busy machine is slow, a program that hangs is slower
_INSTALLING, _ASKING = 3600.0, 60.0
_FOREIGN = ("PYTHONPATH", "PYTHONHOME", "PYTHONSTARTUP", "VIRTUAL_ENV")
T = TypeVar("T")


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
    install, present = system.install, True
    try:
        if install and install.apt:
            ended = process_group.run([install.program, "--version"], b"", _ASKING, keep_stderr=True)
            present = install.version in (ended.out + ended.err).decode(errors="replace")
        elif install:
            present = json.loads((folder(system) / "installed.json").read_text()) == _mark(system)
    except (OSError, ValueError, TimeoutError, TooMuchOutputError):
        present = False
    return "" if present else f"{COMMAND} {system.name}"


def why_not(system: System, profile: str) -> str:
    """Why the system is not run in this profile: it is absent, or too large; "" where it is run."""
    if reason := absent(system):
        return reason
    if system.install and not system.install.small and profile != "full":
        return Reason(f"{system.install.megabytes} MB: in the full profile only", "`--profile full`")
    return ""


def _mark(system: System) -> list[str]:
    """What is installed: another version of the table or of the lock is another mark."""
    assert system.install
    if system.install.npm:
        words, lock = f"Npm(packages={system.install.npm!r})", locked(system) / "package-lock.json"
    else:
        words, lock = f"Pip(requirements={system.install.pip!r}, python={system.install.python!r})", locked(system)
    return [words, hashlib.sha256(lock.read_bytes()).hexdigest()]


def locked(system: System) -> Path:
    """The packages with their hashes, of all that may be installed: a file for pip, a folder for npm."""
    return LOCKS / (system.name if system.install and system.install.npm else f"{system.name}.txt")


def python(system: System) -> str:
    """The interpreter that the system's scripts are for."""
    return str(folder(system) / "bin" / "python") if system.install and system.install.pip else sys.executable


# Making them -----------------------------------------------------------------------------------------------------


def install(system: System) -> None:
    """Make the environment anew, unless it is there. OSError, one line, where that fails."""
    if not absent(system):
        return
    needs, where = system.install, folder(system)
    assert needs

    def do(*command: str) -> None:
        try:
            run(command, timeout=_INSTALLING)
        except (Broken, Unable) as error:
            raise OSError(f"{system.name}: {' '.join(command)}: {error}") from None

    if needs.apt:
        root = [] if os.geteuid() == 0 else ["sudo", "-n"]
        try:
            do(*root, "apt-get", "install", "-y", "-qq", "--no-install-recommends", *needs.apt)
        except OSError as error:
            try:
                names = [package.partition("=")[0] for package in needs.apt]
                listed = run(["apt-cache", "madison", *names], timeout=_ASKING).splitlines()
            except (Broken, Unable):
                listed = []
            versions = sorted({" ".join("".join(line.split("|")[:2]).split()) for line in listed})
            raise OSError(f"{error}; this distribution has {', '.join(versions) or 'none'}") from None
        return
    if not locked(system).exists():
        raise OSError(f"{system.name}: its packages have no lock; expected {locked(system)}")
    shutil.rmtree(where, ignore_errors=True)
    where.mkdir(parents=True)
    if needs.npm:
        for name in ("package.json", "package-lock.json"):
            shutil.copy(locked(system) / name, where)
        do("npm", "ci", "--ignore-scripts", "--silent", "--no-audit", "--no-fund", "--prefix", str(where))
    else:
        # This environment's pip for the other one: to make one there costs more than most of what it would install.
        own = f"{sys.version_info[0]}.{sys.version_info[1]}"
        interpreter = sys.executable if needs.python in ("", own) else shutil.which(f"python{needs.python}")
        if interpreter is None:
            raise OSError(f"{system.name}: needs Python {needs.python}; expected a python{needs.python} in PATH")
        do(interpreter, "-m", "venv", "--without-pip", str(where))
        pip = [sys.executable, "-m", "pip", "--python", python(system), "install"]
        options = ["--quiet", "--disable-pip-version-check", "--no-input", "--no-compile", "--no-deps"]
        # To build a package would run, and fetch, code without a hash.
        safe = ["--require-hashes", "--only-binary", ":all:"]
        do(*pip, *options, *safe, "--requirement", str(locked(system)))
    write_atomically(where / "installed.json", json.dumps(_mark(system)))


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
    lines = [line.strip() for line in ended.err.decode(errors="replace").splitlines() if line.strip()]
    last = lines[-1] if lines else "no word on stderr"  # which names the error
    if ended.status == CANNOT:
        raise Unable(last)
    if ended.status:
        raise Broken(f"{ended.describe}: {last}")
    try:
        return ended.out.decode()
    except UnicodeDecodeError:
        raise Broken(f"wrote {len(ended.out)} bytes that are not text") from None


def attempt(
    row: Callable[..., Row], reason: str, lost: tuple[str, float], answer: Callable[[], T]
) -> tuple[T | None, list[Row]]:
    """What `answer` returns, and no row; or None, and the one row that says why the system gives no answer.

    That row fails, with the metric and the number `lost`, where the program is broken or what it says is none
    (ValueError, OSError); it is not run for a `reason` that is not "" (see `why_not`), or where it cannot run here.
    """
    if reason:
        return None, [row(reason=reason)]
    try:
        return answer(), []
    except (Unable, MissingExtraError) as cause:
        return None, [row(reason=f"cannot run here: {' '.join(str(cause).split())}")]
    except (Broken, ValueError, OSError) as defect:
        metric, text = lost[0], " ".join(str(defect).split())
        return None, [row(values={metric: float(lost[1])}, budgets={metric: 0.0}, reason=text)]

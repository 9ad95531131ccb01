"""The environments of the other renderers: their folders, their installation, and running programs in them."""

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
from validation.run.headline import ABSENT, INSTALL

from .system import LOCKS, SCRIPTS, System

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
PROGRAMS = (*BROWSERS, "node", "g++")  # that renderers look for in PATH
CANNOT = 77  # exit code of a script that cannot run on this machine
TIMEOUT = 600.0  # seconds: enough on a busy machine; a program that takes longer hangs
_INSTALL_TIMEOUT, _QUERY_TIMEOUT = 3600.0, 60.0  # seconds
_FOREIGN = ("PYTHONPATH", "PYTHONHOME", "PYTHONSTARTUP", "VIRTUAL_ENV")
T = TypeVar("T")


class Unable(Exception):
    """A program cannot run on this machine; the message is the reason."""


class Broken(Exception):
    """A program that should run crashed or hung; the message says how."""


# Folders and versions --------------------------------------------------------------------------------------------


def folder(system: System) -> Path:
    """Return `$XDG_CACHE_HOME/mi_refract/renderers/<name>`, which need not exist."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mi_refract" / "renderers" / system.name


def absent(system: System) -> str:
    """Return the command that installs the system; "" if it is installed in its pinned version."""
    install, present = system.install, True
    try:
        if install and install.apt:
            ended = process_group.run([install.program, "--version"], b"", _QUERY_TIMEOUT, keep_stderr=True)
            present = install.version in (ended.out + ended.err).decode(errors="replace")
        elif install:
            present = json.loads((folder(system) / "installed.json").read_text()) == _mark(system)
    except (OSError, ValueError, TimeoutError, TooMuchOutputError):
        present = False
    return "" if present else Reason(f"{INSTALL} {system.name}", f"{ABSENT}{system.name}`")


def why_not(system: System, profile: str) -> str:
    """Return why the system is not run in this profile (it is absent, or too large); "" if it is run."""
    if reason := absent(system):
        return reason
    if system.install and not system.install.small and profile != "full":
        return Reason(f"{system.install.megabytes} MB: in the full profile only", "`--profile full`")
    return ""


def _mark(system: System) -> list[str]:
    """Return what an installation is made from: packages and the lock's hash. Another version gives another mark."""
    assert system.install
    if system.install.npm:
        words, lock = f"Npm(packages={system.install.npm!r})", locked(system) / "package-lock.json"
    else:
        words, lock = f"Pip(requirements={system.install.pip!r}, python={system.install.python!r})", locked(system)
    return [words, hashlib.sha256(lock.read_bytes()).hexdigest()]


def locked(system: System) -> Path:
    """Return the lock, with the hashes of all packages that may be installed: a file for pip, a folder for npm."""
    return LOCKS / (system.name if system.install and system.install.npm else f"{system.name}.txt")


def python(system: System) -> str:
    """Return the Python interpreter that runs the system's scripts."""
    return str(folder(system) / "bin" / "python") if system.install and system.install.pip else sys.executable


# Installation ----------------------------------------------------------------------------------------------------


def install(system: System) -> None:
    """Install the system unless its pinned version is installed. OSError, one line, if that fails."""
    if not absent(system):
        return
    needs, where = system.install, folder(system)
    assert needs

    def execute(*command: str) -> None:
        try:
            run(command, timeout=_INSTALL_TIMEOUT)
        except (Broken, Unable) as error:
            raise OSError(f"{system.name}: {' '.join(command)}: {error}") from None

    if needs.apt:
        root = [] if os.geteuid() == 0 else ["sudo", "-n"]
        try:
            execute(*root, "apt-get", "install", "-y", "-qq", "--no-install-recommends", *needs.apt)
        except OSError as error:
            try:
                names = [package.partition("=")[0] for package in needs.apt]
                lines = run(["apt-cache", "madison", *names], timeout=_QUERY_TIMEOUT).splitlines()
            except (Broken, Unable):
                lines = []
            versions = sorted({" ".join("".join(line.split("|")[:2]).split()) for line in lines})
            raise OSError(f"{error}; this distribution has {', '.join(versions) or 'none'}") from None
        return
    if not locked(system).exists():
        raise OSError(f"{system.name}: no lock of its packages; expected {locked(system)}")
    shutil.rmtree(where, ignore_errors=True)
    where.mkdir(parents=True)
    if needs.npm:
        for name in ("package.json", "package-lock.json"):
            shutil.copy(locked(system) / name, where)
        execute("npm", "ci", "--ignore-scripts", "--silent", "--no-audit", "--no-fund", "--prefix", str(where))
    else:
        own = f"{sys.version_info[0]}.{sys.version_info[1]}"
        interpreter = sys.executable if needs.python in ("", own) else shutil.which(f"python{needs.python}")
        if interpreter is None:
            raise OSError(f"{system.name}: needs Python {needs.python}; expected a python{needs.python} in PATH")
        # The pip of this environment installs into the other: a pip there would cost more than most of the packages.
        execute(interpreter, "-m", "venv", "--without-pip", str(where))
        pip = [sys.executable, "-m", "pip", "--python", python(system), "install"]
        options = ["--quiet", "--disable-pip-version-check", "--no-input", "--no-compile", "--no-deps"]
        # Wheels only: building a package would fetch and run code without a hash.
        safe = ["--require-hashes", "--only-binary", ":all:"]
        execute(*pip, *options, *safe, "--requirement", str(locked(system)))
    write_atomically(where / "installed.json", json.dumps(_mark(system)))


# Running programs ----------------------------------------------------------------------------------------------------


def script(system: System, name: str, *arguments: str) -> list[str]:
    """Return the command that runs a script of scripts/ in the system's environment."""
    return [python(system), str(SCRIPTS / name), *arguments]


def ask(
    system: System,
    command: tuple[str, ...],
    stdin: str = "",
    timeout: float | None = None,
    values: Mapping[str, object] | None = None,
) -> str:
    """Run a command of the system's file, filled in with `values`, and return its output.

    Errors as of `run`. Unable also if the program is not on this machine.
    """
    words = renderer_file.filled(command, python=python(system), environment=folder(system), **(values or {}))
    if os.sep not in words[0] and not shutil.which(words[0]):
        raise Unable(f"no {words[0]} in PATH")
    return run(words, stdin, timeout, system.folder)


def run(command: Sequence[str], stdin: str = "", timeout: float | None = None, where: Path | None = None) -> str:
    """Run a program in the folder `where` and return its output; all its processes have ended then.

    Unable: it exits with CANNOT; the reason is its last line on stderr. Broken: it does not exist, exits with a code
    other than 0, is killed, prints bytes that are not text, or runs longer than `timeout` seconds (default TIMEOUT).
    """
    own = {name: value for name, value in os.environ.items() if name not in _FOREIGN}
    own |= {"PYTHONNOUSERSITE": "1", "PYTHONUTF8": "1"}
    limit = TIMEOUT if timeout is None else timeout
    try:
        ended = process_group.run(command, stdin.encode(), limit, keep_stderr=True, cwd=where, env=own)
    except (TimeoutError, TooMuchOutputError) as error:
        raise Broken(str(error)) from None
    except OSError as error:
        raise Broken(f"{command[0]}: {error.strerror}") from None
    lines = [line.strip() for line in ended.err.decode(errors="replace").splitlines() if line.strip()]
    last = lines[-1] if lines else "nothing on stderr"  # the last line names the error
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
    """Return what `answer` returns, and no rows; or None, and one row with the reason why there is no answer.

    That row is not run if `reason` is not "" (see `why_not`) or if the program cannot run on this machine. It fails,
    with the metric and the number `lost`, if the program is broken or its answer is invalid (ValueError, OSError).
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

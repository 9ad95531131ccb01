"""What the bits of a result depend on, of a worker and of us, and how they differ."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
from collections.abc import Collection, Mapping
from pathlib import Path

from mi_refract import backend
from mi_refract.io.provenance import installed_version

LLVM, WIDTH = "libLLVM", "vector width"
MIXED = frozenset({LLVM, WIDTH})  # with other ones the same work is possible, but not the same bits
UNUSABLE = "cannot run"
HOST = "host"
_WIDTH_SYMBOL = "_Z21jit_llvm_vector_widthv"  # Dr.Jit does not show it to Python


@functools.cache
def facts(variant: str) -> dict[str, str]:
    """Of this process, by name: versions that the bits depend on, and why the variant cannot run, "" where it can."""
    family = variant.partition("_")[0]
    here = backend.detect()[family]
    found = {name: installed_version(name) for name in ("mitsuba", "drjit")}
    found |= {"mi_refract": our_version()}
    found |= {"Python": ".".join(platform.python_version_tuple()[:2]), "processor": platform.machine()}
    found[UNUSABLE] = "" if here.usable else f"{variant}: {here.reason}"
    if family == "llvm" and here.usable:
        found |= {LLVM: here.reason.removeprefix("libLLVM "), WIDTH: vector_width()}
    return found | {HOST: os.uname().nodename}


def vector_width() -> str:
    """Numbers that a CPU's kernel computes at once; "unknown" where Dr.Jit does not tell."""
    import drjit as dr

    try:
        dr.eval(dr.arange(dr.llvm.UInt32, 1))  # before the first kernel it is not known
        library = ctypes.CDLL(str(next(Path(dr.__file__).parent.glob("libdrjit-core.*"))))
        width = getattr(library, _WIDTH_SYMBOL)
    except (OSError, AttributeError, StopIteration, RuntimeError):
        return "unknown"
    width.restype = ctypes.c_uint32
    return str(width())


@functools.cache
def our_version() -> str:
    """With a short digest of the package's source: between two releases the version stays the same."""
    package, digest = Path(__file__).parents[1], hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        digest.update(str(path.relative_to(package)).encode() + b"\0" + path.read_bytes())
    return f"{installed_version('mi-refract')} ({digest.hexdigest()[:8]})"


def differences(there: Mapping[str, str], here: Mapping[str, str], tolerated: Collection[str] = ()) -> list[str]:
    """In words, what a worker has that we have not, but for the names in `tolerated`."""
    if there.get(UNUSABLE):
        return [there[UNUSABLE]]
    names = [name for name in here if name not in (HOST, UNUSABLE, *tolerated)]
    return [
        f"{name} {there.get(name, 'unknown')}, here {here[name]}" for name in names if there.get(name) != here[name]
    ]


def machine(there: Mapping[str, str], here: Mapping[str, str]) -> str:
    """The name of a worker's machine; with what it has that we have not and that was tolerated."""
    other = [f"{name} {there[name]}" for name in sorted(MIXED) if name in there and there[name] != here.get(name)]
    return f"{there[HOST]} ({'; '.join(other)})" if other else there[HOST]

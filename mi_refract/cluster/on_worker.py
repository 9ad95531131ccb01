"""Code that runs on workers: tasks, and facts of the worker that change the bits of a result."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import sys
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from mi_refract import backend
from mi_refract.io.image_file import installed_version

LLVM, WIDTH = "libLLVM", "vector width"
MIXED = frozenset({LLVM, WIDTH})  # a worker that differs in these can do the same work, with other bits
UNUSABLE = "cannot run"
HOST = "host"
_WIDTH_SYMBOL = "_Z21jit_llvm_vector_widthv"  # Dr.Jit does not export it to Python
Result = TypeVar("Result")
# One thread for all renders: Mitsuba's variant belongs to a thread, its objects are best used by the thread that loaded
# them, and one pass uses all threads of the worker.
_renderer = ThreadPoolExecutor(1, "renderer")


@functools.cache
def facts(variant: str) -> dict[str, str]:
    """Return facts of this process by name: versions that change the bits, the host, and why the variant cannot run.

    That reason, UNUSABLE, is "" for a variant that can run.
    """
    family = variant.partition("_")[0]
    status = backend.detect()[family]
    versions = {name: installed_version(name) for name in ("mitsuba", "drjit")}
    versions |= {"mi_refract": our_version(), "processor": platform.machine()}
    versions["Python"] = ".".join(platform.python_version_tuple()[:2])
    if family == "llvm" and status.usable:
        versions |= {LLVM: status.reason.removeprefix("libLLVM "), WIDTH: vector_width()}
    return versions | {UNUSABLE: "" if status.usable else f"{variant}: {status.reason}", HOST: platform.node()}


def vector_width() -> str:
    """Return how many numbers an LLVM kernel computes at once; "unknown" if Dr.Jit does not report it."""
    import drjit as dr

    try:
        dr.eval(dr.arange(dr.llvm.UInt32, 1))  # the width is known after the first kernel
        library = ctypes.CDLL(str(next(Path(dr.__file__).parent.glob("libdrjit-core.*"))))
        width = getattr(library, _WIDTH_SYMBOL)
    except (OSError, AttributeError, StopIteration, RuntimeError):
        return "unknown"
    width.restype = ctypes.c_uint32
    return str(width())


@functools.cache
def our_version() -> str:
    """Return this package's version, with a short hash of the names and contents of its source and glass files.

    The hash distinguishes states of the source that have the same version.
    """
    package, digest = Path(__file__).parents[1], hashlib.sha256()
    for path in sorted({*package.rglob("*.py"), *package.rglob("*.json")}):
        digest.update(str(path.relative_to(package)).encode() + b"\0" + path.read_bytes())
    return f"{installed_version('mi-refract')} ({digest.hexdigest()[:8]})"


def differences(theirs: Mapping[str, str], ours: Mapping[str, str], tolerated: Collection[str] = ()) -> list[str]:
    """Return the differences between a worker's facts and ours as text, without the names in `tolerated`."""
    if theirs.get(UNUSABLE):
        return [theirs[UNUSABLE]]
    names = [name for name in ours if name not in (HOST, UNUSABLE, *tolerated)]
    return [f"{x} {theirs.get(x, 'unknown')}, here {ours[x]}" for x in names if theirs.get(x) != ours[x]]


def machine(theirs: Mapping[str, str], ours: Mapping[str, str]) -> str:
    """Return the name of a worker's machine, with the tolerated differences."""
    differing = [f"{x} {theirs[x]}" for x in sorted(MIXED) if x in theirs and theirs[x] != ours.get(x)]
    return f"{theirs[HOST]} ({'; '.join(differing)})" if differing else theirs[HOST]


def one_at_a_time(call: Callable[[], Result]) -> Result:
    """Run `call` in the one thread of this process for such calls, and return its result."""
    return _renderer.submit(call).result()


def in_variant(variant: str, call: Callable[[], Result]) -> Result:
    """As `one_at_a_time`, in a Mitsuba variant, with as many Dr.Jit threads as the worker has threads.

    So the workers of one machine share its cores. Dr.Jit gets at least two threads: with one thread a kernel runs on
    the calling thread, which keeps denormals; Dr.Jit's threads flush them to 0. ValueError outside of a task.
    """
    threads = max(2, int(_worker().state.nthreads))

    def run() -> Result:
        mitsuba = sys.modules.get("mitsuba")
        if mitsuba is None or mitsuba.variant() != variant:
            backend.activate(variant)
        import drjit as dr

        if dr.thread_count() != threads:
            dr.set_thread_count(threads)
        return call()

    return one_at_a_time(run)


def _worker() -> Any:
    from distributed import get_worker

    return get_worker()


def address() -> str:
    """Return the worker's address, by which the scheduler knows it. ValueError outside of a task."""
    return str(_worker().address)


def with_address(function: Callable[..., Result], *arguments: Any) -> tuple[str, Result]:
    """Call the function and return the worker's address and the function's result."""
    return address(), function(*arguments)


def scratch_folder() -> str:
    """Return a folder for files, which is removed when the worker ends."""
    folder = str(_worker().local_directory)
    os.makedirs(folder, exist_ok=True)  # noqa: PTH103
    return folder

"""What runs on a worker: its facts, that the bits of a result depend on, how they differ from ours, and tasks."""

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
MIXED = frozenset({LLVM, WIDTH})  # with other ones the same work is possible, but not the same bits
UNUSABLE = "cannot run"
HOST = "host"
_WIDTH_SYMBOL = "_Z21jit_llvm_vector_widthv"  # Dr.Jit does not show it to Python
Result = TypeVar("Result")
# Mitsuba's variant is one of a thread, what it loads is best left to the thread that loaded it, and a pass uses all
# threads that the worker has.
_renderer = ThreadPoolExecutor(1, "renderer")


@functools.cache
def facts(variant: str) -> dict[str, str]:
    """Facts of this process by name: versions that the bits depend on, and why the variant cannot run, or ""."""
    family = variant.partition("_")[0]
    here = backend.detect()[family]
    by_name = {name: installed_version(name) for name in ("mitsuba", "drjit")}
    by_name |= {"mi_refract": our_version(), "processor": platform.machine()}
    by_name["Python"] = ".".join(platform.python_version_tuple()[:2])
    by_name[UNUSABLE] = "" if here.usable else f"{variant}: {here.reason}"
    if family == "llvm" and here.usable:
        by_name |= {LLVM: here.reason.removeprefix("libLLVM "), WIDTH: vector_width()}
    return by_name | {HOST: platform.node()}


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
    """The version and a short digest of the package's source and glasses, which change between two releases."""
    package, digest = Path(__file__).parents[1], hashlib.sha256()
    for path in sorted({*package.rglob("*.py"), *package.rglob("*.json")}):
        digest.update(str(path.relative_to(package)).encode() + b"\0" + path.read_bytes())
    return f"{installed_version('mi-refract')} ({digest.hexdigest()[:8]})"


def differences(there: Mapping[str, str], here: Mapping[str, str], tolerated: Collection[str] = ()) -> list[str]:
    """What a worker has that we have not, in words, but for the names in `tolerated`."""
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


def one_at_a_time(call: Callable[[], Result]) -> Result:
    """What `call` returns, in the thread of this process that has all calls, one after the other."""
    return _renderer.submit(call).result()


def in_variant(variant: str, call: Callable[[], Result]) -> Result:
    """As `one_at_a_time`, in a variant of Mitsuba, with as many threads of Dr.Jit as the worker was given.

    So workers of one machine share its cores. Two threads at least: by one thread, a kernel runs on the caller's, which
    keeps denormals; the others take them for 0. ValueError outside of a task.
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
    """The worker's address, its name for the scheduler. ValueError outside of a task."""
    return str(_worker().address)


def with_address(function: Callable[..., Result], *arguments: Any) -> tuple[str, Result]:
    """The address, and what the call returns."""
    return address(), function(*arguments)


def scratch_folder() -> str:
    """A folder for files, which is removed with the worker."""
    folder = str(_worker().local_directory)
    os.makedirs(folder, exist_ok=True)  # noqa: PTH103
    return folder

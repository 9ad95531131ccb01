"""What a task asks of the worker that runs it."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

Result = TypeVar("Result")
# Mitsuba's variant is one of a thread, what it loads is best left to the thread that loaded it, and a pass uses all
# threads that the worker has.
_renderer = ThreadPoolExecutor(1, "renderer")


def one_at_a_time(call: Callable[[], Result]) -> Result:
    """What `call` returns, in the thread of this process that has all calls, one after the other."""
    return _renderer.submit(call).result()


def _worker() -> Any:
    from distributed import get_worker

    return get_worker()


def address() -> str:
    """The worker's address, its name for the scheduler. ValueError outside of a task."""
    return str(_worker().address)


def scratch_folder() -> str:
    """A folder for files; it goes with the worker."""
    folder = str(_worker().local_directory)
    os.makedirs(folder, exist_ok=True)  # noqa: PTH103
    return folder


def variant() -> str | None:
    """This thread's variant of Mitsuba, which is not imported for it; None where none is set."""
    found = sys.modules.get("mitsuba")
    return None if found is None else found.variant()


def threads() -> int:
    """How many the worker was given. ValueError outside of a task."""
    return int(_worker().state.nthreads)


def limit_threads(threads: int) -> None:
    """Have Dr.Jit use so many threads, so that workers of one machine share its cores.

    Two at least: by one thread, a kernel runs on the caller's, which keeps denormals; the others take them for 0.
    """
    import drjit as dr

    threads = max(2, threads)
    if dr.thread_count() != threads:
        dr.set_thread_count(threads)

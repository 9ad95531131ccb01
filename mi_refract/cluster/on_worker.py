"""What a task needs to know of the worker that runs it, and how it runs there."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from mi_refract import backend

Result = TypeVar("Result")
# Mitsuba's variant is one of a thread, what it loads is best left to the thread that loaded it, and a pass uses all
# threads that the worker has.
_renderer = ThreadPoolExecutor(1, "renderer")


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


def scratch_folder() -> str:
    """A folder for files, which is removed with the worker."""
    folder = str(_worker().local_directory)
    os.makedirs(folder, exist_ok=True)  # noqa: PTH103
    return folder

"""What a task asks of the worker that runs it."""

from __future__ import annotations

import os
import sys
import threading
from typing import Any

ONE_AT_A_TIME = threading.Lock()  # for what uses all threads of the worker, or switches what is one for the process


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
    """Mitsuba's variant, of which each thread has its own; None where none is set. Mitsuba is not imported for it."""
    found = sys.modules.get("mitsuba")
    return None if found is None else found.variant()


def limit_threads() -> None:
    """Have Dr.Jit use as many threads as the worker was given, so that workers of one machine share its cores."""
    import drjit as dr

    threads = int(_worker().state.nthreads)
    if dr.thread_count() != threads:
        dr.set_thread_count(threads)

"""Ctrl-C ends a command at once with exit code 130, whatever its threads do, and leaves nothing unfinished.

While Mitsuba renders, a handler of its own takes SIGINT: it allocates memory, also where it has interrupted `malloc`,
and then both wait for ever; or it makes the rendering return early. Python's own handler waits until Mitsuba or an
import returns. So no handler runs here: SIGINT is blocked in every thread, and one thread waits for it.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from typing import NoReturn

SHOW_CURSOR = b"\x1b[?25h"  # which a spinner hides
_SIGINT = {signal.SIGINT}
_blocked = threading.Event()  # from `end_at_once` on
_unblocked = threading.Event()  # within `as_exceptions`


def end_at_once(*, even_if_ignored: bool) -> None:
    """From here on, SIGINT ends this process with 130; for the process's own command line, in its main thread.

    Call it before numpy, Mitsuba or Dr.Jit is imported: the threads that they start block what their parent blocks.
    Where the shell has SIGINT ignored, in a background job, it stays so, unless `even_if_ignored`.
    """
    ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    signal.pthread_sigmask(signal.SIG_BLOCK, _SIGINT)
    from mi_refract.io import atomic  # it takes longer than all before it

    _blocked.set()
    if ignored and not even_if_ignored:
        return
    signal.signal(signal.SIGINT, signal.default_int_handler)  # macOS does not queue what is ignored
    threading.Thread(target=_watch, args=(atomic.end_process,), name="Ctrl-C", daemon=True).start()


@contextlib.contextmanager
def as_exceptions() -> Iterator[None]:
    """Within, SIGINT is a KeyboardInterrupt, as usual: for starting other programs, which inherit what is blocked.

    Nothing that installs a handler of its own may be called. Without `end_at_once` nothing changes.
    """
    if not _blocked.is_set():
        yield
        return
    _unblocked.set()
    before = signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGINT)
    try:
        yield
    finally:
        _unblocked.clear()
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _watch(end_process: Callable[[int], NoReturn]) -> None:
    signal.sigwait(_SIGINT)
    while _unblocked.is_set():  # the system has the main thread take the signal, as a rule
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
        signal.sigwait(_SIGINT)
    if os.isatty(2):
        os.write(2, SHOW_CURSOR)
    end_process(130)

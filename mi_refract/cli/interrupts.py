"""Ctrl-C, SIGTERM and SIGHUP end a command at once with exit code 128 + signal, and leave no temporary file.

While Mitsuba renders, its own handler takes SIGINT. The handler allocates memory, which deadlocks if the signal
interrupted `malloc`; or it makes the render return early. Python's handler only runs after Mitsuba or an import
returns. So no handler runs here: every thread blocks the signals, and one thread waits for them. Windows cannot block
signals: there Ctrl-C is Python's KeyboardInterrupt, which ends a command with 130 as soon as Mitsuba returns.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator

SHOW_CURSOR = b"\x1b[?25h"  # a spinner hides the cursor
_blocked: set[signal.Signals] = set()  # filled by `end_at_once`
_unblocked = threading.Event()  # set within `as_exceptions`
_last_acts: list[Callable[[], None]] = []


def end_at_once(*, even_if_ignored: bool) -> None:
    """Make SIGINT, SIGTERM and SIGHUP end this process with exit code 128 + signal number; 130 for Ctrl-C.

    Call it in the main thread, before numpy, Mitsuba or Dr.Jit is imported: the threads that they start inherit the
    blocked signals. A signal that the caller ignores, such as SIGINT in a shell's background job or SIGHUP under
    `nohup`, stays ignored. With `even_if_ignored`, SIGINT ends the process even then.
    """
    if not hasattr(signal, "pthread_sigmask"):
        return
    ending = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
    ignored = {number for number in ending if signal.getsignal(number) is signal.SIG_IGN}
    _blocked.update(ending - ignored | {signal.SIGINT})  # Mitsuba's handler would take SIGINT even if it is ignored
    signal.pthread_sigmask(signal.SIG_BLOCK, _blocked)
    from mi_refract.io import safe_files  # a slow import, so after the signals are blocked

    def watch() -> None:
        caught = signal.sigwait(waited)
        while _unblocked.is_set():  # the main thread handles the signal
            signal.pthread_kill(threading.main_thread().ident or 0, caught)
            caught = signal.sigwait(waited)
        if _last_acts:
            acting = threading.Thread(target=_last_acts[-1], name="last act", daemon=True)
            acting.start()
            while acting.is_alive() and not signal.sigpending() & waited:
                acting.join(0.05)
        if os.isatty(2):
            os.write(2, SHOW_CURSOR)
        safe_files.end_process(128 + caught)

    if waited := _blocked - (set() if even_if_ignored else ignored):
        for number in waited:  # set a handler: macOS does not queue ignored signals
            handler = signal.default_int_handler if number == signal.SIGINT else lambda x, _: sys.exit(128 + x)
            signal.signal(number, handler)
        threading.Thread(target=watch, name="Ctrl-C", daemon=True).start()


@contextlib.contextmanager
def last_act(act: Callable[[], None]) -> Iterator[None]:
    """Within this context, call `act` before a signal ends the process. A second signal does not wait for `act`."""
    _last_acts.append(act)
    try:
        yield
    finally:
        _last_acts.remove(act)


@contextlib.contextmanager
def as_exceptions() -> Iterator[None]:
    """Within this context, SIGINT raises KeyboardInterrupt; SIGTERM and SIGHUP raise SystemExit.

    Use it to start other programs, which inherit blocked signals. Do not call code that installs its own signal
    handler. Nothing changes unless `end_at_once` was called.
    """
    if not _blocked:
        yield
        return
    _unblocked.set()
    before = signal.pthread_sigmask(signal.SIG_UNBLOCK, _blocked)
    try:
        yield
    finally:
        _unblocked.clear()
        signal.pthread_sigmask(signal.SIG_SETMASK, before)

"""Ctrl-C, SIGTERM and SIGHUP end a command at once with exit code 128 + signal, and leave no temporary file.

While Mitsuba renders, a handler of its own takes SIGINT: it allocates memory, also where it has interrupted `malloc`,
and then both wait for ever; or it makes the rendering return early. Python's own handler waits until Mitsuba or an
import returns. So no handler runs here: signals are blocked in every thread, and one thread waits for them. Windows can
block none: there Ctrl-C is Python's KeyboardInterrupt, which ends a command with 130 as soon as Mitsuba returns.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator

SHOW_CURSOR = b"\x1b[?25h"  # which a spinner hides
_blocked: set[signal.Signals] = set()  # from `end_at_once` on
_unblocked = threading.Event()  # within `as_exceptions`
_last_acts: list[Callable[[], None]] = []


def end_at_once(*, even_if_ignored: bool) -> None:
    """From here on, SIGINT, SIGTERM and SIGHUP end this process with 128 + their number; 130 for Ctrl-C.

    For the process's own command line, in its main thread. Call it before numpy, Mitsuba or Dr.Jit is imported: the
    threads that they start block what their parent blocks. A signal that the caller has ignored, such as SIGINT of a
    shell's background job or SIGHUP of `nohup`, stays ignored; but with `even_if_ignored` SIGINT ends the process.
    """
    if not hasattr(signal, "pthread_sigmask"):
        return
    ending = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
    ignored = {number for number in ending if signal.getsignal(number) is signal.SIG_IGN}
    _blocked.update(ending - ignored | {signal.SIGINT})  # Mitsuba's handler would take it even where it is ignored
    signal.pthread_sigmask(signal.SIG_BLOCK, _blocked)
    from mi_refract.io import safe_files  # it takes longer than all before it

    def watch() -> None:
        caught = signal.sigwait(waited)
        while _unblocked.is_set():  # the system has the main thread take the signal, as a rule
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
        for number in waited:  # macOS does not queue what is ignored
            signal.signal(
                number, signal.default_int_handler if number == signal.SIGINT else lambda x, _: sys.exit(128 + x)
            )
        threading.Thread(target=watch, name="Ctrl-C", daemon=True).start()


@contextlib.contextmanager
def last_act(act: Callable[[], None]) -> Iterator[None]:
    """Within, `act` is called before a signal ends the process. A second signal ends it without waiting for that."""
    _last_acts.append(act)
    try:
        yield
    finally:
        _last_acts.remove(act)


@contextlib.contextmanager
def as_exceptions() -> Iterator[None]:
    """Within, SIGINT is a KeyboardInterrupt, and SIGTERM and SIGHUP a SystemExit.

    For starting other programs, which inherit what is blocked; nothing that installs a handler of its own may be
    called. Without `end_at_once` nothing changes.
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

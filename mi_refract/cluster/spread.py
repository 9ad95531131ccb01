"""Calls that do not depend on each other, on the workers of a scheduler; only as many are begun as keep them busy."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from .connection import require_scheduler
from .workers import Workers

AHEAD = 2  # calls for each thread of the workers
_POLL = 0.5  # seconds


@dataclass(frozen=True)
class _Call:
    """One that is begun: its number, its arguments, and the addresses of the workers that may make it."""

    number: int
    arguments: tuple[Any, ...]
    allowed: frozenset[str]


def results(
    workers: Workers, function: Callable[..., Any], calls: Iterable[tuple[Any, ...]]
) -> Iterator[tuple[int, Any, str]]:
    """Of every `function(*call)` its number from 0, its result and the worker's machine, in the order of their ends.

    `calls` is asked for the next one as soon as a worker has room. A call whose worker is lost is made again by another
    one. The errors of a call pass as they are; ConnectionError, one line, where the scheduler or all workers have gone,
    or where a call has ended several workers. What is begun and not finished is cancelled at the end.
    """
    begun: dict[Any, _Call] = {}
    waiting = ((number, tuple(call)) for number, call in enumerate(calls))
    more = True
    try:
        while more or begun:
            workers.look()
            _begin_again(workers, function, begun)
            more = more and _begin(workers, function, begun, waiting)
            for future in _finished(workers, list(begun)):
                call = begun.pop(future)
                address, found = _result(workers, future, call.number)
                yield call.number, found, workers.machines.get(address, address)
    finally:
        if begun and workers.client.status == "running":
            workers.client.cancel(list(begun), force=True)


def _begin(
    workers: Workers,
    function: Callable[..., Any],
    begun: dict[Any, _Call],
    waiting: Iterator[tuple[int, tuple[Any, ...]]],
) -> bool:
    """Begin calls until each thread has AHEAD; whether there may be more."""
    while len(begun) < AHEAD * sum(workers.accepted.values()):
        if (following := next(waiting, None)) is None:
            return False
        _submit(workers, function, begun, *following)
    return True


def _submit(
    workers: Workers, function: Callable[..., Any], begun: dict[Any, _Call], number: int, arguments: tuple[Any, ...]
) -> None:
    allowed = frozenset(workers.accepted)
    future = workers.client.submit(
        _with_address, function, *arguments, workers=sorted(allowed), pure=False, priority=-number
    )
    begun[future] = _Call(number, arguments, allowed)


def _begin_again(workers: Workers, function: Callable[..., Any], begun: dict[Any, _Call]) -> None:
    """Ask others for the calls whose workers have all gone: Dask would wait for these to come back."""
    there = workers.accepted.keys()
    for future, call in list(begun.items()):
        if there and not call.allowed & there and not future.done():
            del begun[future]
            workers.client.cancel([future], force=True)
            _submit(workers, function, begun, call.number, call.arguments)


def _with_address(function: Callable[..., Any], *arguments: Any) -> tuple[str, Any]:
    from . import on_worker

    return on_worker.address(), function(*arguments)


def _finished(workers: Workers, futures: list[Any]) -> list[Any]:
    """Those that have ended, after a short wait for the first."""
    from distributed import wait

    if not futures:
        time.sleep(_POLL)
        return []
    try:
        with workers.client.as_current():
            wait(futures, timeout=_POLL, return_when="FIRST_COMPLETED")
    except TimeoutError:
        return []
    except Exception:  # cancelled, as the scheduler has gone
        require_scheduler(workers.client)
    return [future for future in futures if future.done()]


def _result(workers: Workers, future: Any, number: int) -> tuple[str, Any]:
    from distributed import KilledWorker
    from distributed.client import FutureCancelledError

    try:
        address, found = future.result()
    except KilledWorker as error:
        raise ConnectionError(
            f"task {number}: {error.allowed_failures + 1} workers were lost that ran it, the last {error.last_worker}; "
            "accepted: workers with enough memory"
        ) from None
    except FutureCancelledError:
        require_scheduler(workers.client)
        raise ConnectionError(f"task {number}: was cancelled on the cluster; accepted: not to") from None
    return address, found

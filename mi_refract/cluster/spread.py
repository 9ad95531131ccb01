"""Calls that do not depend on each other, on the workers of a scheduler; only as many are begun as keep them busy."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from .connection import scheduler_needed
from .workers import Workers

AHEAD = 2  # calls for each thread of the workers
_POLL, _FETCHED = 0.5, 20.0  # seconds


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
            with scheduler_needed(workers.client):
                _begin_again(workers, function, begun)
            more = more and _begin(workers, function, begun, waiting)
            for future in _ended(workers, list(begun)):
                with scheduler_needed(workers.client):
                    found = _result(future, begun[future].number)
                if found is not None:
                    yield begun.pop(future).number, found[1], workers.machines.get(found[0], found[0])
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


def _ended(workers: Workers, futures: list[Any]) -> list[Any]:
    """Those that have ended, after a short wait for the first."""
    from distributed import wait

    if not futures:
        time.sleep(_POLL)
        return []
    with contextlib.suppress(TimeoutError), scheduler_needed(workers.client), workers.client.as_current():
        wait(futures, timeout=_POLL, return_when="FIRST_COMPLETED")
    return [future for future in futures if future.done()]


def _result(future: Any, number: int) -> tuple[str, Any] | None:
    """The worker's address and what it returned; None where that was lost with the worker, and is computed again."""
    from distributed import KilledWorker

    try:
        found: tuple[str, Any] = future.result() if future.status != "finished" else future.result(timeout=_FETCHED)
    except KilledWorker as error:
        raise ConnectionError(
            f"task {number}: {error.allowed_failures + 1} workers were lost that ran it, the last "
            f"{error.last_worker.address}; accepted: workers with enough memory"
        ) from None
    except TimeoutError:
        if future.status == "error":
            raise
        return None
    return found

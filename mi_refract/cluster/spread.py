"""Calls that do not depend on each other, on the workers of a scheduler; only as many are begun as keep them busy."""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from mi_refract.io.errors import NoWorkersError

from . import on_worker
from .connection import scheduler_needed
from .workers import Workers

AHEAD = 2  # calls for each thread of the workers
_POLL, _FETCHED = 0.5, 20.0  # seconds


def results(
    workers: Workers, function: Callable[..., Any], calls: Iterable[tuple[Any, ...]]
) -> Iterator[tuple[int, Any, str]]:
    """Of every `function(*call)` its number from 0, its result and the worker's machine, in the order of their ends.

    `calls` is asked for the next one as soon as a worker has room. A call whose worker is lost is made again by another
    one. The errors of a call pass as they are; ConnectionError, one line, where the scheduler or all workers have gone,
    or where a call has ended several workers. What is begun and not finished is cancelled at the end.
    """
    from distributed import KilledWorker, wait

    client, waiting = workers.client, enumerate(calls)
    begun: dict[Any, tuple[int, tuple[Any, ...], frozenset[str]]] = {}  # number, arguments, who may make the call

    def begin(number: int, arguments: tuple[Any, ...]) -> None:
        allowed = frozenset(workers.accepted)
        options: dict[str, Any] = {"workers": sorted(allowed), "pure": False, "priority": -number}
        begun[client.submit(_with_address, function, *arguments, **options)] = number, arguments, allowed

    try:
        while True:
            workers.look()
            with scheduler_needed(client):
                for future, (number, arguments, allowed) in list(begun.items()):
                    # Dask would wait for these workers to come back.
                    if workers.accepted and allowed.isdisjoint(workers.accepted) and not future.done():
                        del begun[future]
                        client.cancel([future], force=True)
                        begin(number, arguments)
            room = AHEAD * sum(workers.accepted.values()) - len(begun)
            for number, arguments in itertools.islice(waiting, max(0, room)):
                begin(number, arguments)
            if not begun and workers.accepted:
                return
            if not begun:
                time.sleep(_POLL)
                continue
            with contextlib.suppress(TimeoutError), scheduler_needed(client), client.as_current():
                wait(list(begun), timeout=_POLL, return_when="FIRST_COMPLETED")
            for future in [each for each in begun if each.done()]:
                number = begun[future][0]
                try:
                    with scheduler_needed(client):
                        address, result = future.result(timeout=_FETCHED)
                except KilledWorker as error:
                    raise NoWorkersError(
                        f"task {number}: {error.allowed_failures + 1} workers were lost that ran it, the last "
                        f"{error.last_worker.address}; expected workers with enough memory"
                    ) from None
                except TimeoutError:
                    if future.status == "error":  # the call's own
                        raise
                    continue  # lost with the worker, and computed again
                del begun[future]
                yield number, result, workers.machines.get(address, address)
    finally:
        if begun and client.status == "running":
            client.cancel(list(begun), force=True)


def _with_address(function: Callable[..., Any], *arguments: Any) -> tuple[str, Any]:
    return on_worker.address(), function(*arguments)

"""Calls that do not depend on each other, on the workers of a scheduler; only as many are begun as keep them busy."""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from . import on_worker
from .connection import Client, Future, cluster_errors
from .workers import Workers

AHEAD = 2  # calls for each thread of the workers
_POLL, _FETCHED = 0.5, 20.0  # seconds


def finished(client: Client, futures: Sequence[Future]) -> list[Future]:
    """Those of the futures that are done, after waiting a little for one. Errors: those of `cluster_errors`."""
    from distributed import wait

    with contextlib.suppress(TimeoutError), cluster_errors(client), client.as_current():
        wait(futures, timeout=_POLL, return_when="FIRST_COMPLETED")
    return [future for future in futures if future.done()]


def fetched(client: Client, future: Future) -> tuple[Any, ...]:
    """(result,) of a future that is done; () where it was lost with its worker, and is being computed again.

    The task's own error passes; errors of `cluster_errors`.
    """
    with cluster_errors(client):
        try:
            return (future.result(timeout=_FETCHED),)
        except TimeoutError:
            if future.status == "error":  # the task's own
                raise
            return ()


def results(
    workers: Workers, function: Callable[..., Any], calls: Iterable[tuple[Any, ...]]
) -> Iterator[tuple[int, Any, str]]:
    """Of every `function(*call)` its number from 0, its result and the worker's machine, in the order of their ends.

    `calls` is asked for the next one as soon as a worker has room. A call whose worker is lost is made again by another
    one. The errors of a call pass as they are; ConnectionError, one line, where the scheduler or all workers have gone,
    or where a call has ended several workers. What is begun and not finished is cancelled at the end.
    """
    client, waiting = workers.client, enumerate(calls)
    begun: dict[Any, tuple[int, tuple[Any, ...], frozenset[str]]] = {}  # number, arguments, who may make the call

    def begin(number: int, arguments: tuple[Any, ...]) -> None:
        allowed = frozenset(workers.accepted)
        options: dict[str, Any] = {"workers": sorted(allowed), "pure": False, "priority": -number}
        begun[client.submit(_with_address, function, *arguments, **options)] = number, arguments, allowed

    try:
        while True:
            workers.look()
            with cluster_errors(client):
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
            for future in finished(client, list(begun)):
                for address, result in fetched(client, future):
                    number = begun.pop(future)[0]
                    yield number, result, workers.machines.get(address, address)
    finally:
        if begun and client.status == "running":
            client.cancel(list(begun), force=True)


def _with_address(function: Callable[..., Any], *arguments: Any) -> tuple[str, Any]:
    return on_worker.address(), function(*arguments)

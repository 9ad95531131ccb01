"""The workers of a scheduler that may have work, each asked for its facts before it gets any; and calls on them."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import itertools
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

from mi_refract.io.errors import NoWorkersError

from . import on_worker
from .connection import Client, Future, cluster_errors

AHEAD = 2  # calls for each thread of the workers
_POLL = 0.5  # seconds
PATIENCE = 120.0  # seconds until the first workers must have answered: they import Mitsuba, and try libLLVM
NOBODY = 30.0  # seconds until a scheduler must have a worker at all
ALONE = 120.0  # seconds until new workers must have come where all have gone
BETWEEN_LOOKS = 2.0  # seconds
# As text: a worker that cannot import a function which it is sent ends, and its nanny starts it again, without end.
_QUESTION = "__import__({!r}, fromlist=['facts']).facts({!r})"


class Workers:
    """The workers of a client's scheduler. `usable`: threads by address, of those that may have work.

    `refused`: why, by address; `machines`: the names of all that ever were usable.
    """

    def __init__(
        self,
        client: Client,
        variant: str,
        expected: Mapping[str, str],
        tolerated: Collection[str] = (),
        warn: Callable[[str], None] = lambda text: None,
        facts: str = on_worker.__name__,
        task: str = "work",
    ) -> None:
        """`expected`: facts that workers must have, but for `tolerated`. `warn` is called with who is refused, and why.

        `facts`: the name of the module whose `facts(variant)` workers are asked for. `task`: what they are for, a verb.
        """
        self.client, self.expected, self.tolerated, self.warn, self.task = client, expected, tolerated, warn, task
        self.usable: dict[str, int] = {}
        self.refused: dict[str, str] = {}
        self.machines: dict[str, str] = {}
        self._question = _QUESTION.format(facts, variant)
        self._asked: dict[str, Any] = {}  # answers that are awaited, by address
        self._looked = -BETWEEN_LOOKS
        self._alone_since: float | None = None

    def wait(self, nobody: float = NOBODY) -> None:
        """Wait until those that are there have answered. NoWorkersError, one line, where none may have work.

        `nobody`: seconds until there must be a worker.
        """
        began = time.monotonic()
        while True:
            self.look(at_once=True)
            waited = time.monotonic() - began
            answered = not self._asked and (self.usable or self.refused or waited > nobody)
            if answered or waited > PATIENCE:
                break
            time.sleep(0.05)
        if not self.usable:
            reason = "; ".join(self.refused.values()) or ("workers do not answer" if self._asked else "no workers")
            text = f"{self.client.scheduler.address}: no worker that may {self.task}: {reason}"
            raise NoWorkersError(f"{text}; expected at least one with the software and hardware of this process")

    def look(self, *, at_once: bool = False) -> None:
        """Ask those that are new, note what they answered and who has gone; seldom while some are there, or `at_once`.

        LostSchedulerError where the scheduler has gone, NoWorkersError where all workers have, for longer than ALONE.
        """
        with cluster_errors(self.client):
            if at_once or not self.usable or time.monotonic() - self._looked >= BETWEEN_LOOKS:
                self._looked, present = time.monotonic(), self.client.nthreads()
                for known in (self.usable, self.refused, self._asked):
                    for address in known.keys() - present.keys():
                        del known[address]
                for address, threads in present.items():
                    if address in self._asked and self._asked[address].done():
                        self._judge(address, threads, self._asked.pop(address))
                    elif not any(address in known for known in (self._asked, self.usable, self.refused)):
                        options: dict[str, Any] = {"workers": [address], "pure": False, "priority": 1000}
                        self._asked[address] = self.client.submit(eval, self._question, **options)
        if self.usable or not self.machines:
            self._alone_since = None
        elif self._alone_since is None:
            self._alone_since = time.monotonic()
        elif time.monotonic() - self._alone_since > ALONE:
            text = f"{self.client.scheduler.address}: all workers have gone"
            raise NoWorkersError(f"{text}; expected new ones within {ALONE:.0f} s")

    def _judge(self, address: str, threads: int, answer: Future) -> None:
        there: dict[str, str] = {}
        if answer.status != "finished":
            error = answer.exception() if answer.status == "error" else None
            different = [f"{type(error).__name__}: {error}" if error else answer.status]
        else:
            if not (answers := fetched(self.client, answer)):  # the worker has gone with it; else it is asked again
                return
            (there,) = answers
            different = on_worker.differences(there, self.expected, self.tolerated)
        if different:
            host = f" on {there[on_worker.HOST]}" if there else ""
            self.refused[address] = f"worker {address}{host} is refused: {'; '.join(different)}"
            self.warn(self.refused[address])
        else:
            self.usable[address] = threads
            self.machines[address] = on_worker.machine(there, self.expected)


def finished(client: Client, futures: Sequence[Future]) -> list[Future]:
    """The futures that are done, after a short wait for one. Errors: those of `cluster_errors`."""
    from distributed import wait

    with contextlib.suppress(TimeoutError), cluster_errors(client), client.as_current():
        wait(futures, timeout=_POLL, return_when="FIRST_COMPLETED")
    return [future for future in futures if future.done()]


def fetched(client: Client, future: Future) -> tuple[Any, ...]:
    """(result,) of a future that is done, however long it travels; () as soon as it is lost with its worker.

    `future.result()` would wait until the task is done again, perhaps for workers that do not come back. The task's own
    error passes; errors of `cluster_errors`.
    """
    with cluster_errors(client):
        transfer = asyncio.run_coroutine_threadsafe(client.gather(future, asynchronous=True), client.loop.asyncio_loop)
        try:
            while future.done() and client.status == "running":
                if concurrent.futures.wait([transfer], timeout=_POLL).done:
                    return (transfer.result(),)
            return ()
        finally:
            transfer.cancel()


def results(
    workers: Workers, function: Callable[..., Any], calls: Iterable[tuple[Any, ...]]
) -> Iterator[tuple[int, Any, str]]:
    """Number (from 0), result and worker's machine of every `function(*call)`, in the order in which they end.

    `calls` is asked for the next one as soon as a worker has room. A call whose worker is lost is made again by another
    one. The errors of a call pass as they are; ConnectionError, one line, where the scheduler or all workers have gone,
    or where a call has ended several workers. What is begun and not finished is cancelled at the end.
    """
    client, waiting = workers.client, enumerate(calls)
    begun: dict[Any, tuple[int, tuple[Any, ...], frozenset[str]]] = {}  # number, arguments, who may make the call

    def begin(number: int, arguments: tuple[Any, ...]) -> None:
        allowed = frozenset(workers.usable)
        options: dict[str, Any] = {"workers": sorted(allowed), "pure": False, "priority": -number}
        begun[client.submit(on_worker.with_address, function, *arguments, **options)] = number, arguments, allowed

    try:
        while True:
            workers.look()
            with cluster_errors(client):
                for future, (number, arguments, allowed) in list(begun.items()):
                    # Dask would wait for these workers to come back.
                    if workers.usable and allowed.isdisjoint(workers.usable) and not future.done():
                        del begun[future]
                        client.cancel([future], force=True)
                        begin(number, arguments)
                room = AHEAD * sum(workers.usable.values()) - len(begun)
                for number, arguments in itertools.islice(waiting, max(0, room)):
                    begin(number, arguments)
            if not begun and workers.usable:
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

"""The usable workers of a Dask scheduler, and function calls on them. A worker reports its facts before it is used."""

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

AHEAD = 2  # calls queued per worker thread
_POLL = 0.5  # seconds
PATIENCE = 120.0  # time limit for the first workers' facts, in seconds: workers import Mitsuba and test libLLVM
NOBODY = 30.0  # time limit for a scheduler without any worker, in seconds
ALONE = 120.0  # time limit for new workers after all have gone, in seconds
BETWEEN_LOOKS = 2.0  # seconds between two looks at the scheduler's workers
# Sent as text: a worker that cannot import the function it is sent dies, and its nanny restarts it again and again.
_QUERY = "__import__({!r}, fromlist=['facts']).facts({!r})"


class Workers:
    """The workers of a client's scheduler.

    `usable`: number of threads of each usable worker, by address. `refused`: the reason of each refusal, by address.
    `machines`: machine names of all workers that were ever usable, by address.
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
        """`expected`: facts that workers must have, except the names in `tolerated`.

        `warn` is called with a message for each refused worker. `facts`: name of the module whose `facts(variant)` runs
        on the workers. `task`: a verb for error messages, such as render.
        """
        self.client, self.expected, self.tolerated, self.warn, self.task = client, expected, tolerated, warn, task
        self.usable: dict[str, int] = {}
        self.refused: dict[str, str] = {}
        self.machines: dict[str, str] = {}
        self._query = _QUERY.format(facts, variant)
        self._pending: dict[str, Any] = {}  # futures of the facts, by address
        self._last_look = -BETWEEN_LOOKS
        self._alone_since: float | None = None

    def wait(self, nobody: float = NOBODY) -> None:
        """Wait until all present workers have reported their facts. NoWorkersError if none is usable.

        `nobody`: time limit for the first worker, in seconds.
        """
        began = time.monotonic()
        while True:
            self.look(at_once=True)
            waited = time.monotonic() - began
            answered = not self._pending and (self.usable or self.refused or waited > nobody)
            if answered or waited > PATIENCE:
                break
            time.sleep(0.05)
        if not self.usable:
            reason = "; ".join(self.refused.values()) or ("workers do not answer" if self._pending else "no workers")
            text = f"{self.client.scheduler.address}: no worker can {self.task}: {reason}"
            raise NoWorkersError(f"{text}; expected at least one with the software and hardware of this process")

    def look(self, *, at_once: bool = False) -> None:
        """Update `usable` and `refused`: query new workers, evaluate their facts, forget lost workers.

        While workers are usable this happens every BETWEEN_LOOKS, or `at_once`. LostSchedulerError if the scheduler has
        ended, NoWorkersError if all workers have been gone for longer than ALONE.
        """
        with cluster_errors(self.client):
            if at_once or not self.usable or time.monotonic() - self._last_look >= BETWEEN_LOOKS:
                self._last_look, present = time.monotonic(), self.client.nthreads()
                for known in (self.usable, self.refused, self._pending):
                    for address in known.keys() - present.keys():
                        del known[address]
                for address, threads in present.items():
                    if address in self._pending and self._pending[address].done():
                        self._judge(address, threads, self._pending.pop(address))
                    elif not any(address in known for known in (self._pending, self.usable, self.refused)):
                        options: dict[str, Any] = {"workers": [address], "pure": False, "priority": 1000}
                        self._pending[address] = self.client.submit(eval, self._query, **options)
        if self.usable or not self.machines:
            self._alone_since = None
        elif self._alone_since is None:
            self._alone_since = time.monotonic()
        elif time.monotonic() - self._alone_since > ALONE:
            text = f"{self.client.scheduler.address}: all workers have gone"
            raise NoWorkersError(f"{text}; expected new ones within {ALONE:.0f} s")

    def _judge(self, address: str, threads: int, answer: Future) -> None:
        """Add a worker to `usable` or to `refused`, from its facts."""
        facts: dict[str, str] = {}
        if answer.status != "finished":
            error = answer.exception() if answer.status == "error" else None
            differences = [f"{type(error).__name__}: {error}" if error else answer.status]
        else:
            results = fetched(self.client, answer)
            if not results:  # lost with the worker; a worker that is still there is queried again
                return
            (facts,) = results
            differences = on_worker.differences(facts, self.expected, self.tolerated)
        if differences:
            host = f" on {facts[on_worker.HOST]}" if facts else ""
            self.refused[address] = f"worker {address}{host} is refused: {'; '.join(differences)}"
            self.warn(self.refused[address])
        else:
            self.usable[address] = threads
            self.machines[address] = on_worker.machine(facts, self.expected)


def finished(client: Client, futures: Sequence[Future]) -> list[Future]:
    """Wait up to _POLL for a future, then return all that are done. Errors as `cluster_errors`."""
    from distributed import wait

    with contextlib.suppress(TimeoutError), cluster_errors(client), client.as_current():
        wait(futures, timeout=_POLL, return_when="FIRST_COMPLETED")
    return [future for future in futures if future.done()]


def fetched(client: Client, future: Future) -> tuple[Any, ...]:
    """Return (result,) of a future that is done, however long the transfer takes; () if its worker is lost meanwhile.

    `future.result()` would wait until the task has run again, perhaps for workers that never return. Raises the
    task's own error, and the errors of `cluster_errors`.
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
    """Run `function(*call)` on the workers for every call; yield (index of the call, result, the worker's machine).

    Results come in the order in which they finish. `calls` is read only as workers have room. If a worker is lost,
    another one repeats its call. An error of the function is raised unchanged. ConnectionError if the scheduler or all
    workers have gone, or if several workers were lost on the same call. Unfinished calls are cancelled on exit.
    """
    client, waiting = workers.client, enumerate(calls)
    submitted: dict[Any, tuple[int, tuple[Any, ...], frozenset[str]]] = {}  # index, arguments, allowed workers

    def submit(index: int, arguments: tuple[Any, ...]) -> None:
        allowed = frozenset(workers.usable)
        options: dict[str, Any] = {"workers": sorted(allowed), "pure": False, "priority": -index}
        submitted[client.submit(on_worker.with_address, function, *arguments, **options)] = index, arguments, allowed

    try:
        while True:
            workers.look()
            with cluster_errors(client):
                for future, (index, arguments, allowed) in list(submitted.items()):
                    # All allowed workers are lost: Dask would wait for their return.
                    if workers.usable and allowed.isdisjoint(workers.usable) and not future.done():
                        del submitted[future]
                        client.cancel([future], force=True)
                        submit(index, arguments)
                room = AHEAD * sum(workers.usable.values()) - len(submitted)
                for index, arguments in itertools.islice(waiting, max(0, room)):
                    submit(index, arguments)
            if not submitted and workers.usable:
                return
            if not submitted:
                time.sleep(_POLL)
                continue
            for future in finished(client, list(submitted)):
                for address, result in fetched(client, future):
                    index = submitted.pop(future)[0]
                    yield index, result, workers.machines.get(address, address)
    finally:
        if submitted and client.status == "running":
            client.cancel(list(submitted), force=True)

"""The workers of a scheduler that may have work: each is asked for its facts before it gets any."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping
from concurrent import futures
from typing import Any

from mi_refract.io.errors import LostSchedulerError, NoWorkersError

from . import worker_facts
from .connection import in_thread, scheduler_needed

PATIENCE = 120.0  # seconds until the first workers must have said what they are: they import Mitsuba, and try libLLVM
_NOBODY = 30.0  # seconds until a scheduler must have a worker at all
SILENT = 60.0  # seconds until a scheduler must have answered once it did before
ALONE = 120.0  # seconds until new workers must have come where all have gone
# As text: a worker that cannot import a function which it is sent ends, and its nanny starts it again, without end.
_QUESTION = "__import__({!r}, fromlist=['facts']).facts({!r})"
_POLL, _BETWEEN_LOOKS = 0.05, 2.0  # seconds
_FETCHING = 10.0  # seconds in which a worker that has answered hands its answer over: it may have gone since


class Workers:
    """Of a client's scheduler. `accepted`: threads by the addresses of those that are there and may have work.

    `refused`: why, by address; `machines`: the names of all that ever were accepted.
    """

    def __init__(
        self,
        client: Any,
        variant: str,
        expected: Mapping[str, str],
        tolerated: Collection[str] = (),
        warn: Callable[[str], None] = lambda text: None,
        facts: str = worker_facts.__name__,
        task: str = "work",
    ) -> None:
        """`expected`: facts that workers must have, but for `tolerated`. `warn` is told of who is refused.

        `facts`: the name of the module whose `facts(variant)` workers are asked for. `task`: what they are for, a verb.
        """
        self.facts, self._task = facts, task
        self.client, self.variant, self.expected, self.tolerated, self.warn = client, variant, expected, tolerated, warn
        self.accepted: dict[str, int] = {}
        self.refused: dict[str, str] = {}
        self.machines: dict[str, str] = {}
        self._asked: dict[str, Any] = {}
        self._looked = -_BETWEEN_LOOKS
        self._coming: futures.Future[dict[str, int]] | None = None  # who is there
        self._seen = False
        self._alone_since: float | None = None

    @property
    def all_accepted(self) -> bool:
        """Whether everyone who was there at the last look may have work."""
        return bool(self.accepted) and not self.refused and not self._asked

    def wait(self) -> None:
        """Until those that are there have answered. ConnectionError, one line, where none may have work."""
        began = time.monotonic()
        while True:
            self.look(at_once=True)
            waited = time.monotonic() - began
            answered = self._seen and not self._asked
            if waited > PATIENCE or (answered and (self.accepted or self.refused or waited > _NOBODY)):
                break
            time.sleep(_POLL)
        if self.accepted:
            return
        found = "; ".join(self.refused.values()) or ("workers do not answer" if self._asked else "no workers")
        raise NoWorkersError(
            f"{self._address}: no worker that may {self._task}: {found}; expected at least one like this process"
        )

    @property
    def _address(self) -> str:
        return str(self.client.scheduler.address)

    def look(self, *, at_once: bool = False) -> None:
        """Ask those that are new, note what they answered and who has gone; nobody is waited for. Seldom, or `at_once`.

        LostSchedulerError where the scheduler has gone, ConnectionError where all workers have, for longer than ALONE.
        """
        with scheduler_needed(self.client):
            if self._coming is None and (at_once or time.monotonic() - self._looked >= _BETWEEN_LOOKS):
                self._coming, self._looked = in_thread(self.client.nthreads), time.monotonic()
            if self._coming is not None and self._coming.done():
                present, self._coming = self._coming.result(), None
                self._ask(present)
                self._seen = True
        if self._coming is not None and time.monotonic() - self._looked > SILENT:
            raise LostSchedulerError(
                f"{self._address}: the Dask scheduler has not answered for {SILENT:.0f} s; expected one that does"
            )
        self._require_some()

    def _ask(self, present: Mapping[str, int]) -> None:
        for known in (self.accepted, self.refused, self._asked):
            for address in [each for each in known if each not in present]:
                del known[address]
        for address, threads in present.items():
            if address in self._asked and self._asked[address].done():
                self._judge(address, threads, self._asked.pop(address))
            elif address not in self._asked and address not in self.accepted and address not in self.refused:
                self._asked[address] = self.client.submit(
                    eval, _QUESTION.format(self.facts, self.variant), workers=[address], pure=False, priority=1000
                )

    def _require_some(self) -> None:
        if self.accepted or not self.machines:
            self._alone_since = None
        elif self._alone_since is None:
            self._alone_since = time.monotonic()
        elif time.monotonic() - self._alone_since > ALONE:
            raise NoWorkersError(f"{self._address}: all workers have gone; expected new ones within {ALONE:.0f} s")

    def _judge(self, address: str, threads: int, answer: Any) -> None:
        if answer.status != "finished":
            error = answer.exception() if answer.status == "error" else None
            different, there = [f"{type(error).__name__}: {error}" if error else answer.status], {}
        else:
            try:
                there = answer.result(timeout=_FETCHING)
            except TimeoutError:  # the worker has gone with its answer; where it has not, it is asked again
                return
            different = worker_facts.differences(there, self.expected, self.tolerated)
        if not different:
            self.accepted[address] = threads
            self.machines[address] = worker_facts.machine(there, self.expected)
            return
        host = f" on {there[worker_facts.HOST]}" if there else ""
        self.refused[address] = f"worker {address}{host} is refused: {'; '.join(different)}"
        self.warn(self.refused[address])

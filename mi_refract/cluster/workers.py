"""The workers of a scheduler that may have work: each is asked for its facts before it gets any."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping
from typing import Any

from mi_refract.io.errors import NoWorkersError

from . import worker_facts
from .connection import Client, Future, cluster_errors

PATIENCE = 120.0  # seconds until the first workers must have answered: they import Mitsuba, and try libLLVM
NOBODY = 30.0  # seconds until a scheduler must have a worker at all
ALONE = 120.0  # seconds until new workers must have come where all have gone
BETWEEN_LOOKS = 2.0  # seconds
# As text: a worker that cannot import a function which it is sent ends, and its nanny starts it again, without end.
_QUESTION = "__import__({!r}, fromlist=['facts']).facts({!r})"
_FETCHING = 10.0  # seconds in which a worker that has answered hands its answer over: it may have gone since


class Workers:
    """Of a client's scheduler. `accepted`: threads by the addresses of those that are there and may have work.

    `refused`: why, by address; `machines`: the names of all that ever were accepted.
    """

    def __init__(
        self,
        client: Client,
        variant: str,
        expected: Mapping[str, str],
        tolerated: Collection[str] = (),
        warn: Callable[[str], None] = lambda text: None,
        facts: str = worker_facts.__name__,
        task: str = "work",
    ) -> None:
        """`expected`: facts that workers must have, but for `tolerated`. `warn` is called with who is refused, and why.

        `facts`: the name of the module whose `facts(variant)` workers are asked for. `task`: what they are for, a verb.
        """
        self.client, self.expected, self.tolerated, self.warn, self.task = client, expected, tolerated, warn, task
        self.accepted: dict[str, int] = {}
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
            answered = not self._asked and (self.accepted or self.refused or waited > nobody)
            if answered or waited > PATIENCE:
                break
            time.sleep(0.05)
        if not self.accepted:
            reason = "; ".join(self.refused.values()) or ("workers do not answer" if self._asked else "no workers")
            text = f"{self._address}: no worker that may {self.task}: {reason}"
            raise NoWorkersError(f"{text}; expected at least one with the software and hardware of this process")

    @property
    def _address(self) -> str:
        return str(self.client.scheduler.address)

    def look(self, *, at_once: bool = False) -> None:
        """Ask those that are new, note what they answered and who has gone; seldom, or `at_once`.

        LostSchedulerError where the scheduler has gone, NoWorkersError where all workers have, for longer than ALONE.
        """
        with cluster_errors(self.client):
            if at_once or time.monotonic() - self._looked >= BETWEEN_LOOKS:
                self._looked = time.monotonic()
                self._ask(self.client.nthreads())
        if self.accepted or not self.machines:
            self._alone_since = None
        elif self._alone_since is None:
            self._alone_since = time.monotonic()
        elif time.monotonic() - self._alone_since > ALONE:
            raise NoWorkersError(f"{self._address}: all workers have gone; expected new ones within {ALONE:.0f} s")

    def _ask(self, present: Mapping[str, int]) -> None:
        for known in (self.accepted, self.refused, self._asked):
            for address in known.keys() - present.keys():
                del known[address]
        for address, threads in present.items():
            if address in self._asked and self._asked[address].done():
                self._judge(address, threads, self._asked.pop(address))
            elif address not in self._asked and address not in self.accepted and address not in self.refused:
                options: dict[str, Any] = {"workers": [address], "pure": False, "priority": 1000}
                self._asked[address] = self.client.submit(eval, self._question, **options)

    def _judge(self, address: str, threads: int, answer: Future) -> None:
        there: dict[str, str] = {}
        if answer.status != "finished":
            error = answer.exception() if answer.status == "error" else None
            different = [f"{type(error).__name__}: {error}" if error else answer.status]
        else:
            try:
                there = answer.result(timeout=_FETCHING)
            except TimeoutError:  # the worker has gone with its answer; where it has not, it is asked again
                return
            different = worker_facts.differences(there, self.expected, self.tolerated)
        if different:
            host = f" on {there[worker_facts.HOST]}" if there else ""
            self.refused[address] = f"worker {address}{host} is refused: {'; '.join(different)}"
            self.warn(self.refused[address])
        else:
            self.accepted[address] = threads
            self.machines[address] = worker_facts.machine(there, self.expected)

"""Work in threads that is bounded by what it takes, in whatever unit: bytes, values of images."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from concurrent.futures import Future

Item = TypeVar("Item")
Answer = TypeVar("Answer")
AHEAD = 2  # items in hand for each thread: a slow one does not leave the others idle at once


def bounded_map(
    work: Callable[[Item], Answer], items: Iterable[Item], takes: Callable[[Item], int], most: int, threads: int
) -> Iterator[Answer]:
    """Yield `work(item)` for each item, in order, from several threads. Raises what `work` raises.

    Items at work, and answers that wait for their turn, take `most` together; one that takes more is alone.
    """
    from concurrent.futures import ThreadPoolExecutor  # not needed for one item

    pending: deque[tuple[Future[Answer], int]] = deque()
    taken = 0
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                more = takes(item)
                while pending and (taken + more > most or len(pending) >= AHEAD * threads):
                    future, less = pending.popleft()
                    yield future.result()
                    taken -= less
                pending.append((pool.submit(work, item), more))
                taken += more
            while pending:
                yield pending.popleft()[0].result()
        finally:
            for future, _ in pending:
                future.cancel()

"""Seeds of the randomised studies: their own, and others for `validation.repeated`."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

T = TypeVar("T")
STEP = 10_007  # between two seeds of a study: larger than any range of seeds that a study uses
_SHIFT: ContextVar[int] = ContextVar("shift", default=0)


def current(seed: int) -> int:
    """Return the current seed for a study whose own seed is `seed`."""
    return seed + STEP * _SHIFT.get()


@contextmanager
def shifted(by: int) -> Iterator[None]:
    """Within this context, every study uses its seed number `by`; 0 is its own seed."""
    token = _SHIFT.set(by)
    try:
        yield
    finally:
        _SHIFT.reset(token)


def cached(function: Callable[..., T]) -> Callable[..., T]:
    """As `functools.cache`, with separate results for each shift of the seeds."""
    by_shift = functools.cache(lambda _, *args, **kwargs: function(*args, **kwargs))

    @functools.wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> T:
        result: T = by_shift(_SHIFT.get(), *args, **kwargs)
        return result

    vars(wrapper)["cache_clear"] = by_shift.cache_clear
    return wrapper

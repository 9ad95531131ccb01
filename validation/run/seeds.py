"""Seeds of the randomised studies: their own, and others that `validation.repeated` asks for."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

T = TypeVar("T")
STEP = 10_007  # between two seeds: no study has numbers of its own that come near
_SHIFT: ContextVar[int] = ContextVar("shift", default=0)


def current(seed: int) -> int:
    """The seed to draw with where a study's own is `seed`."""
    return seed + STEP * _SHIFT.get()


@contextmanager
def shifted(by: int) -> Iterator[None]:
    """Every study draws with its seed number `by`; 0 is its own."""
    token = _SHIFT.set(by)
    try:
        yield
    finally:
        _SHIFT.reset(token)


def cached(function: Callable[..., T]) -> Callable[..., T]:
    """As `functools.cache`, of what is drawn: what one seed gave is not the answer for another."""
    by_shift = functools.cache(lambda _, *args, **kwargs: function(*args, **kwargs))

    @functools.wraps(function)
    def found(*args: Any, **kwargs: Any) -> T:
        result: T = by_shift(_SHIFT.get(), *args, **kwargs)
        return result

    vars(found)["cache_clear"] = by_shift.cache_clear
    return found

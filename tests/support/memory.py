"""What a piece of work allocates."""

from __future__ import annotations

import tracemalloc


def peak(work):
    """The most bytes that were allocated at once."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()

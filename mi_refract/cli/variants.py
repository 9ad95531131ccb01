"""What Dr.Jit runs on, chosen for a command. It is tried in processes of their own, which Ctrl-C ends, too."""

from __future__ import annotations

from mi_refract import backend

from .interrupts import as_exceptions


def probe(*, every_backend: bool = True) -> None:
    """Try the libLLVMs, and `every_backend`; `backend` remembers how it went. It may start the command line again."""
    with as_exceptions():
        backend.restart_if_needed()
        if every_backend:
            backend.detect()


def activate(variant: str | None = None) -> str:
    """Set the variant, or the best that runs here, and return its name. Errors: those of `backend.activate`."""
    probe(every_backend=variant is not None and not variant.startswith("scalar_"))
    return backend.activate(variant)

"""A connection to a Dask scheduler, whose failures are one line."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent import futures
from dataclasses import dataclass
from typing import Any, TypeVar

from mi_refract.io.errors import LostSchedulerError, MissingExtraError, UsageError

from . import local_cluster

Result = TypeVar("Result")
PATIENCE = 6.0  # seconds until a scheduler must have answered
_CLOSING = 2.0  # seconds
_LOGGERS = ("distributed", "tornado", "asyncio")
_EXPECTED = (
    "expected the address of a Dask scheduler, such as tcp://host:8786, or tls://host:8786 and the files of "
    "`distributed.comm.tls` in Dask's configuration"
)


@dataclass(frozen=True)
class ClusterTarget:
    """Which processes work, as the options of a command say: this one where neither is given."""

    scheduler: str | None = None
    workers: int | None = None

    @property
    def given(self) -> bool:
        """Whether other processes work."""
        return self.scheduler is not None or self.workers is not None

    def check(self) -> None:
        """ValueError for options that exclude each other, ImportError without Dask."""
        if self.scheduler is not None and self.workers is not None:
            raise UsageError("--scheduler and --workers; expected one of them")
        if self.given:
            _require_dask()


LOCAL = ClusterTarget()


def _require_dask() -> None:
    try:
        import distributed  # noqa: F401
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            f"--scheduler and --workers need Dask ({error.name} is missing): pip install 'mi-refract[cluster]'"
        ) from None


@contextlib.contextmanager
def connected(scheduler: str | None = None, workers: int | None = None) -> Iterator[Any]:
    """A `distributed.Client` of the scheduler at an address, or of so many processes of one thread each, started here.

    The processes speak TLS. A client of a `tls://` scheduler takes certificates from Dask's configuration, and refuses
    every connection that is not encrypted. ConnectionError, one line, after PATIENCE where no scheduler answers;
    ImportError without Dask; ValueError unless exactly one of the two is given.
    """
    if (scheduler is None) == (workers is None):
        raise UsageError("expected either --scheduler ADDRESS or --workers N")
    _require_dask()
    from distributed.security import Security

    with _silent(), contextlib.ExitStack() as stack:
        if workers is not None:
            address, security = stack.enter_context(local_cluster.started(workers))
        else:
            address = str(scheduler)
            # None: as Dask's configuration says.
            security = Security(require_encryption=address.startswith("tls://") or None)
        client = _client(address, security)
        try:
            yield client
        finally:
            with contextlib.suppress(Exception):  # a scheduler that is gone
                client.close(timeout=_CLOSING)


def _client(address: str, security: Any) -> Any:
    from distributed import Client

    try:
        # First, as a client that found nobody would take 16 s to give up.
        kind = asyncio.run(_kind(address, security))
        if kind != "Scheduler":
            raise ValueError(f"a {kind} answers")
        # Results come from the workers themselves where these can be reached, else through the scheduler.
        return Client(address, security=security, timeout=PATIENCE, set_as_default=False, direct_to_workers=True)
    except Exception as error:
        said = [" ".join(str(each).split()) for each in (error.__cause__, error) if each is not None]
        text = re.sub(r"in <[^>]*>: ", "", next(filter(None, said), f"not within {PATIENCE:.0f} s"))
        raise ConnectionError(f"--scheduler {address}: no Dask scheduler answers: {text[:200]}; {_EXPECTED}") from None


async def _kind(address: str, security: Any) -> str:
    """What answers at an address, as it says."""
    from distributed import rpc

    arguments = security.get_connection_args("client")
    async with asyncio.timeout(PATIENCE), rpc(address, timeout=PATIENCE / 2, connection_args=arguments) as there:
        return str((await there.identity()).get("type"))


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Without Dask's own messages: what matters of them is raised or warned of here."""
    loggers = [logging.getLogger(name) for name in _LOGGERS]
    loggers += [logging.getLogger(name) for name in logging.root.manager.loggerDict if name.startswith("distributed.")]
    before = [each.level for each in loggers]
    for each in loggers:
        each.setLevel(logging.CRITICAL + 1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of versions, large graphs: versions that matter are compared by `workers`
            yield
    finally:
        for each, level in zip(loggers, before, strict=True):
            each.setLevel(level)


@contextlib.contextmanager
def scheduler_needed(client: Any) -> Iterator[None]:
    """Within, whatever Dask raises where the scheduler of a client has gone is a LostSchedulerError, one line."""
    from distributed import CancelledError
    from distributed.comm import CommClosedError

    address = getattr(client.scheduler, "address", "") or "--scheduler"
    lost = (
        f"{address}: the Dask scheduler is gone, or has given up its tasks; expected one that runs, or none: then here"
    )
    try:
        if client.status != "running":
            raise LostSchedulerError(lost)
        yield
    except (CommClosedError, CancelledError):
        raise LostSchedulerError(lost) from None
    except (OSError, RuntimeError) as error:
        if client.status != "running" and not isinstance(error, LostSchedulerError):
            raise LostSchedulerError(lost) from None
        raise


def in_thread(call: Callable[[], Result]) -> futures.Future[Result]:
    """What `call` returns, some day: Dask waits for ever for a scheduler that hangs, or for data that is lost."""
    found: futures.Future[Result] = futures.Future()

    def run() -> None:
        try:
            found.set_result(call())
        except BaseException as error:
            found.set_exception(error)

    threading.Thread(target=run, name="Dask", daemon=True).start()
    return found

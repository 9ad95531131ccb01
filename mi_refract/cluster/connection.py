"""Dask clients, of a scheduler at an address or of worker processes started here. Errors are one line."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, TypeAlias

from mi_refract.io.errors import LostSchedulerError, MissingExtraError, NoWorkersError, UsageError

from . import local_cluster

Client: TypeAlias = Any  # a `distributed.Client`
Future: TypeAlias = Any  # a `distributed.Future`
Security: TypeAlias = Any  # a `distributed.Security`
PATIENCE = 6.0  # time limit for the scheduler's answer, in seconds
_EXPECTED = (
    "expected the address of a Dask scheduler, such as tcp://host:8786, or tls://host:8786 and the files of "
    "`distributed.comm.tls` in Dask's configuration"
)


@dataclass(frozen=True)
class ClusterTarget:
    """The processes that render, from a command's options; without options, this process."""

    scheduler: str | None = None
    workers: int | None = None

    @property
    def given(self) -> bool:
        """Whether other processes render."""
        return self.scheduler is not None or self.workers is not None

    def check(self) -> None:
        """UsageError if both options are given, MissingExtraError without Dask."""
        if self.scheduler is not None and self.workers is not None:
            raise UsageError("--scheduler and --workers; expected one of them")
        if self.given:
            _require_dask()


LOCAL = ClusterTarget()


def _require_dask() -> None:
    try:
        import distributed  # noqa: F401
    except ModuleNotFoundError as error:
        text = f"--scheduler and --workers need Dask ({error.name} is missing)"
        raise MissingExtraError(f"{text}: pip install 'mi-refract[cluster]'") from None


@contextlib.contextmanager
def connected(scheduler: str | None = None, workers: int | None = None) -> Iterator[Client]:
    """Yield a `distributed.Client` of a scheduler at an address, or of `workers` one-thread processes started here.

    Local processes communicate by TLS. A client of a `tls://` scheduler takes certificates from Dask's configuration
    and refuses unencrypted connections. ConnectionError if no scheduler answers within PATIENCE; MissingExtraError
    without Dask; UsageError unless exactly one argument is given.
    """
    if (scheduler is None) == (workers is None):
        raise UsageError("expected either --scheduler ADDRESS or --workers N")
    _require_dask()
    import distributed

    async def server_type() -> str:
        """Return what the server at the address says it is, such as Scheduler."""
        options = {"timeout": PATIENCE / 2, "connection_args": security.get_connection_args("client")}
        async with asyncio.timeout(PATIENCE), distributed.rpc(address, **options) as server:
            return str((await server.identity()).get("type"))

    with contextlib.ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        # Dask warns of large graphs and of versions; `workers` compares the versions that matter.
        warnings.simplefilter("ignore")
        # Silence Dask's loggers: failures that matter are raised here.
        for logger in map(logging.getLogger, list(logging.root.manager.loggerDict)):
            if logger.name.partition(".")[0] in ("distributed", "tornado", "asyncio") and not logger.disabled:
                logger.disabled = True
                stack.callback(setattr, logger, "disabled", False)
        if workers is not None:
            address, security = stack.enter_context(local_cluster.started(workers))
        else:
            address = str(scheduler)
            # None: the value in Dask's configuration.
            security = distributed.Security(require_encryption=address.startswith("tls://") or None)
        try:
            # Check the server before making a client: without a scheduler a client would take 16 s to give up.
            if (answering := asyncio.run(server_type())) != "Scheduler":
                raise ValueError(f"a Dask {answering} answers there")
            # Results come directly from workers that can be reached, otherwise through the scheduler.
            options: dict[str, Any] = {"timeout": PATIENCE, "set_as_default": False, "direct_to_workers": True}
            client = distributed.Client(address, security=security, **options)
        except Exception as error:
            texts = [" ".join(str(cause).split()) for cause in (error.__cause__, error) if cause is not None]
            text = re.sub(r"in <[^>]*>: ", "", next(filter(None, texts), f"not within {PATIENCE:.0f} s"))
            reason = f"no Dask scheduler answers: {text[:200]}; {_EXPECTED}"
            raise ConnectionError(f"--scheduler {address}: {reason}") from None
        try:
            yield client
        finally:
            with contextlib.suppress(Exception):  # the scheduler may have ended
                client.close(timeout=2.0)


@contextlib.contextmanager
def cluster_errors(client: Client) -> Iterator[None]:
    """Within this context, turn Dask's errors into one line.

    LostSchedulerError if the scheduler has ended, NoWorkersError if several workers were lost on the same task.
    """
    from distributed import CancelledError, KilledWorker
    from distributed.comm import CommClosedError

    address = getattr(client.scheduler, "address", "") or "--scheduler"
    lost = f"{address}: the Dask scheduler has ended or cancelled the tasks; run the same command again to resume"
    try:
        if client.status != "running":
            raise LostSchedulerError(lost)
        yield
    except KilledWorker as error:
        count, last = error.allowed_failures + 1, error.last_worker.address
        text = f"{count} workers were lost while they ran the same task; the last was {last}"
        raise NoWorkersError(f"{address}: {text}; expected workers with enough memory") from None
    except (CommClosedError, CancelledError):
        raise LostSchedulerError(lost) from None
    except (OSError, RuntimeError) as error:
        if client.status != "running" and not isinstance(error, LostSchedulerError):
            raise LostSchedulerError(lost) from None
        raise

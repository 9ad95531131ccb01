"""A Dask client: of a scheduler at an address, or of worker processes that are started here. Failures are one line."""

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
PATIENCE = 6.0  # seconds until a scheduler must have answered
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
        """UsageError for options that exclude each other, MissingExtraError without Dask."""
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
def connected(scheduler: str | None = None, workers: int | None = None) -> Iterator[Client]:
    """A `distributed.Client` of the scheduler at an address, or of so many processes of one thread each, started here.

    The processes speak TLS. A client of a `tls://` scheduler takes certificates from Dask's configuration, and refuses
    every connection that is not encrypted. ConnectionError, one line, after PATIENCE where no scheduler answers;
    MissingExtraError without Dask; UsageError unless exactly one of the two is given.
    """
    if (scheduler is None) == (workers is None):
        raise UsageError("expected either --scheduler ADDRESS or --workers N")
    _require_dask()
    import distributed

    async def kind() -> str:
        """What answers at the address, as it says."""
        options = {"timeout": PATIENCE / 2, "connection_args": security.get_connection_args("client")}
        async with asyncio.timeout(PATIENCE), distributed.rpc(address, **options) as there:
            return str((await there.identity()).get("type"))

    with contextlib.ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore")  # of versions, large graphs: versions that matter are compared by `workers`
        # Dask logs nothing: what matters of it is raised here. Other loggers stay as they are.
        for logger in map(logging.getLogger, list(logging.root.manager.loggerDict)):
            if logger.name.partition(".")[0] in ("distributed", "tornado", "asyncio") and not logger.disabled:
                logger.disabled = True
                stack.callback(setattr, logger, "disabled", False)
        if workers is not None:
            address, security = stack.enter_context(local_cluster.started(workers))
        else:
            address = str(scheduler)
            # None: as Dask's configuration says.
            security = distributed.Security(require_encryption=address.startswith("tls://") or None)
        try:
            # First, as a client that found nobody would take 16 s to give up.
            if (answering := asyncio.run(kind())) != "Scheduler":
                raise ValueError(f"a Dask {answering} answers there")
            # Results come from the workers themselves where these can be reached, else through the scheduler.
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
            with contextlib.suppress(Exception):  # a scheduler that is gone
                client.close(timeout=2.0)


@contextlib.contextmanager
def cluster_errors(client: Client) -> Iterator[None]:
    """Within, Dask's errors are one line: LostSchedulerError where its scheduler has gone, NoWorkersError for a task
    that has ended several workers.
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

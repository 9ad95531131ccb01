"""`mi-refract render --scheduler` and `--workers`: other processes render, on a Dask cluster or on this machine."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mi_refract.cluster import worker_facts
from mi_refract.cluster.connection import LOCAL, ClusterTarget, connected
from mi_refract.cluster.workers import Workers
from mi_refract.io.errors import UsageError
from mi_refract.io.sanitise import printable

if TYPE_CHECKING:  # they import Mitsuba
    from mi_refract.rendering.long_render import LongRender, Passes


@dataclass(frozen=True)
class ClusterOptions:
    """Which processes render. `bundle_limit` in MiB."""

    target: ClusterTarget = LOCAL
    bundle_limit: int = 256
    mixed_workers: bool = False

    def check(self, plugins: Collection[str]) -> None:
        """UsageError for options that exclude each other, MissingExtraError without Dask. `plugins`: of the scene."""
        if self.mixed_workers and not self.target.given:
            raise UsageError("--mixed-workers requires --scheduler ADDRESS or --workers N")
        self.target.check()
        if self.target.given and plugins:
            raise UsageError(
                f"--allow-plugins {min(plugins)}: native code is not sent to workers; remove --scheduler or --workers"
            )


@contextlib.contextmanager
def cluster_passes(options: ClusterOptions, rendering: LongRender, variant: str) -> Iterator[Passes | None]:
    """Where passes are rendered; None for this process. Workers that are refused are named on stderr.

    ValueError for a scene that cannot be sent; ConnectionError where no scheduler answers or no worker may render.
    """
    if not options.target.given or rendering.end():
        yield None
        return
    from mi_refract.rendering import scene_bundle
    from mi_refract.rendering.cluster_passes import ClusterPasses

    def warn(text: str) -> None:
        print(printable(f"mi-refract: {text}"), file=sys.stderr, flush=True)

    bundle = scene_bundle.pack(rendering.parsed, rendering.job.defines, options.bundle_limit)
    with connected(options.target.scheduler, options.target.workers) as client:
        tolerated: frozenset[str] = worker_facts.MIXED if options.mixed_workers else frozenset()
        workers = Workers(client, variant, worker_facts.facts(variant), tolerated, warn, task="render")
        workers.wait()
        passes = ClusterPasses(workers, bundle, variant, rendering.job.seed, rendering.warnings.append)
        try:
            yield passes
        finally:
            passes.close()

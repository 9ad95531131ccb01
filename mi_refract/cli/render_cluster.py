"""The options of `mi-refract render` that have other processes render: on a Dask cluster, or on this machine."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mi_refract.cluster import worker_facts
from mi_refract.cluster.connection import LOCAL, ClusterTarget, connected
from mi_refract.cluster.workers import Workers
from mi_refract.io.sanitise import printable

if TYPE_CHECKING:  # they import Mitsuba
    from mi_refract.rendering.long_render import LongRender, Passes


@dataclass(frozen=True)
class ClusterOptions:
    """Who renders. `bundle_limit` in MiB."""

    target: ClusterTarget = LOCAL
    bundle_limit: int = 256
    mixed_workers: bool = False

    def check(self, plugins: Collection[str]) -> None:
        """ValueError for options that exclude each other, ImportError without Dask. `plugins`: the scene's own."""
        if self.mixed_workers and not self.target.given:
            raise ValueError("--mixed-workers; expected --scheduler ADDRESS or --workers N with it")
        self.target.check()
        if self.target.given and plugins:
            raise ValueError(
                f"--allow-plugins {min(plugins)}: native code, which is not sent to workers; "
                "expected no --scheduler and no --workers"
            )


@contextlib.contextmanager
def cluster_passes(options: ClusterOptions, rendering: LongRender, variant: str) -> Iterator[Passes | None]:
    """Who renders the passes; None for this process. Workers that are refused are named on stderr.

    ValueError for a scene that cannot be sent; ConnectionError where no scheduler answers or no worker may render.
    """
    if not options.target.given or rendering.end():
        yield None
        return
    from mi_refract.rendering import scene_bundle
    from mi_refract.rendering.cluster_passes import ClusterPasses, RenderedScene

    job = rendering.job
    bundle = scene_bundle.pack(rendering.parsed, job.defines, options.bundle_limit)
    with connected(options.target.scheduler, options.target.workers) as client:
        tolerated: frozenset[str] = worker_facts.MIXED if options.mixed_workers else frozenset()
        expected = worker_facts.facts(variant)
        workers = Workers(client, variant, expected, tolerated, _say, task="render")
        workers.wait()
        scene = RenderedScene(variant, job.seed, expected, tolerated)
        passes = ClusterPasses(workers, bundle, scene, rendering.warnings.append)
        try:
            yield passes
        finally:
            passes.close()


def _say(text: str) -> None:
    print(printable(f"mi-refract: {text}"), file=sys.stderr, flush=True)

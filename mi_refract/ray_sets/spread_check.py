"""Rays, certified on the workers of a Dask cluster."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterable, Iterator

from mi_refract.cluster import on_worker, spread, worker_facts
from mi_refract.cluster.connection import ClusterTarget, connected
from mi_refract.cluster.workers import Workers
from mi_refract.io.provenance import installed_version
from mi_refract.oracle import Certified
from mi_refract.regimes import Rays

from .check_answers import Certify
from .judged_answers import certified

VARIANT = "scalar_rgb"  # no kernel is run
PACKAGES = ("numpy", "python-flint")  # that the answers depend on, beside those of any render


def facts(variant: str) -> dict[str, str]:
    """What certified answers depend on, of this process, by name."""
    return worker_facts.facts(variant) | {name: installed_version(name) for name in PACKAGES}


@contextlib.contextmanager
def certifying(target: ClusterTarget, warn: Callable[[str], None]) -> Iterator[Certify]:
    """`certify` for `check_answers.check`: by workers of a scheduler, or by so many processes on this machine.

    `warn` is called for every worker that is refused. ConnectionError, ImportError or ValueError, one line, where there
    is no worker.
    """
    with connected(target.scheduler, target.workers) as client:
        workers = Workers(client, VARIANT, facts(VARIANT), warn=warn, facts=__name__)
        workers.wait()

        def certify(pieces: Iterable[Rays]) -> Iterator[tuple[int, Certified]]:
            for number, exact, _ in spread.results(workers, _certified, ((rays,) for rays in pieces)):
                yield number, exact

        yield certify


def _certified(rays: Rays) -> Certified:
    return on_worker.one_at_a_time(functools.partial(certified, rays))  # Python's, all of it: one core

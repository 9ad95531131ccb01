"""Pieces of a ray set, judged on the workers of a Dask cluster."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterable, Iterator

from mi_refract.cluster import on_worker, spread, worker_facts
from mi_refract.cluster.connection import ClusterTarget, connected
from mi_refract.cluster.workers import Workers
from mi_refract.io.provenance import installed_version

from .check_answers import Judge
from .judged_parts import JudgedPart, Piece, Question, judge_part

VARIANT = "scalar_rgb"  # no kernel is run
PACKAGES = ("numpy", "python-flint")  # that the findings depend on, beside those of any render


def facts(variant: str) -> dict[str, str]:
    """What findings depend on, of this process, by name."""
    return worker_facts.facts(variant) | {name: installed_version(name) for name in PACKAGES}


@contextlib.contextmanager
def judging(target: ClusterTarget, warn: Callable[[str], None]) -> Iterator[Judge]:
    """A judge for `check_answers.check`: workers of a scheduler, or so many processes on this machine.

    `warn` is told of every worker that is refused. ConnectionError, ImportError or ValueError, one line, where there is
    nobody who may judge.
    """
    with connected(target.scheduler, target.workers) as client:
        there = Workers(client, VARIANT, facts(VARIANT), warn=warn, facts=__name__)
        there.wait()

        def judge(calls: Iterable[tuple[Piece, Question]]) -> Iterator[tuple[int, JudgedPart]]:
            for number, part, _ in spread.results(there, _judged, calls):
                yield number, part

        yield judge


def _judged(piece: Piece, question: Question) -> JudgedPart:
    return on_worker.one_at_a_time(functools.partial(judge_part, piece, question))  # Python's, all of it: one core

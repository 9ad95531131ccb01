"""Calls on workers: all results, errors as they are, lost workers, and what is cancelled."""

from __future__ import annotations

import os
import time

import pytest
from support.dask_workers import accepted, kill, until

from mi_refract.cluster import spread
from mi_refract.cluster.connection import connected

VARIANT = "scalar_rgb"


@pytest.fixture(scope="module")
def workers():
    with connected(workers=2) as client:
        yield accepted(client, VARIANT)


def process_of(seconds):
    time.sleep(seconds)
    return os.getpid()


def half(x):
    return 1 / (x - 3)


def test_each_call_has_its_number_and_only_a_few_are_begun(workers):
    begun = []

    def calls():
        for i in range(20):
            begun.append(i)
            yield (i + 10,)

    results = spread.results(workers, half, calls())
    first = next(results)
    assert len(begun) <= 2 * spread.AHEAD + 1
    found = {number: value for number, value, machine in [first, *results] if machine == os.uname().nodename}
    assert found == {i: 1 / (i + 7) for i in range(20)}


def test_an_error_of_a_call_is_its_own(workers):
    with pytest.raises(ZeroDivisionError, match="division by zero"):
        list(spread.results(workers, half, [(i,) for i in range(6)]))
    assert len(list(spread.results(workers, half, [(1,)]))) == 1  # the workers are as before


def late():
    raise TimeoutError("of the call")


def test_an_error_that_dask_raises_too_is_that_of_the_call(workers):
    with pytest.raises(TimeoutError, match="of the call"):
        list(spread.results(workers, late, [()]))


def test_who_is_refused_gets_no_call(workers):
    refused = sorted(workers.accepted)[0]
    threads = workers.accepted.pop(refused)
    workers.refused[refused] = "made up"
    own = workers.client.run(os.getpid, workers=[refused])[refused]
    try:
        found = list(spread.results(workers, process_of, [(0.1,)] * 6))
    finally:
        del workers.refused[refused]
        workers.accepted[refused] = threads
    assert len(found) == 6 and own not in [pid for _, pid, _ in found]


def test_a_call_of_a_lost_worker_is_made_again(workers):
    results = spread.results(workers, process_of, [(1.0,)] * 4)
    first, _, _ = next(results)
    kill(workers.client, sorted(workers.client.nthreads())[0])
    assert sorted([first, *(number for number, _, _ in results)]) == [0, 1, 2, 3]
    until(lambda: len(workers.client.nthreads()) == 2)


def test_calls_of_workers_that_have_all_gone_are_made_by_those_that_come(workers):
    results = spread.results(workers, process_of, [(0.2,), (4.0,), (4.0,)])
    next(results)
    before = set(workers.client.nthreads())
    for address in before:
        kill(workers.client, address)
    assert sorted(number for number, _, _ in results) == [1, 2]
    assert not before & set(workers.accepted)


def test_what_is_not_finished_is_cancelled(workers):
    results = spread.results(workers, process_of, [(0.0,), (30.0,), (30.0,), (30.0,)])
    next(results)
    results.close()
    until(lambda: not any(workers.client.processing().values()), seconds=10)

"""Workers are asked what they are before they get work; who differs is refused by name."""

from __future__ import annotations

import os
import re
import time

import pytest
from support.dask_workers import accepted, until

from mi_refract.cluster import worker_facts, workers
from mi_refract.cluster.connection import connected
from mi_refract.cluster.worker_facts import HOST, LLVM, MIXED, UNUSABLE, WIDTH, differences, machine
from mi_refract.cluster.workers import Workers
from mi_refract.io.errors import LostSchedulerError

HERE = {"mitsuba": "3.9.1", LLVM: "19.1", WIDTH: "8", UNUSABLE: "", HOST: "here"}


@pytest.mark.parametrize(
    "change, tolerated, different",
    [
        ({HOST: "there"}, (), []),
        ({"mitsuba": "3.9.0"}, (), ["mitsuba 3.9.0, here 3.9.1"]),
        ({"mitsuba": "3.9.0", WIDTH: "16"}, MIXED, ["mitsuba 3.9.0, here 3.9.1"]),
        ({WIDTH: "16", LLVM: "18.1"}, (), ["libLLVM 18.1, here 19.1", "vector width 16, here 8"]),
        ({WIDTH: "16", LLVM: "18.1"}, MIXED, []),
        ({UNUSABLE: "llvm_ad_rgb: no libLLVM found", "mitsuba": "3"}, MIXED, ["llvm_ad_rgb: no libLLVM found"]),
    ],
)
def test_what_differs(change, tolerated, different):
    assert differences(HERE | change, HERE, tolerated) == different


def test_a_fact_that_is_missing_differs():
    assert differences({HOST: "there"}, {"drjit": "1.5.0"}) == ["drjit unknown, here 1.5.0"]


def test_a_machine_says_what_was_tolerated():
    assert machine(HERE | {HOST: "there"}, HERE) == "there"
    assert machine(HERE | {HOST: "there", WIDTH: "16", LLVM: "18.1"}, HERE) == "there (libLLVM 18.1; vector width 16)"


def test_facts_of_this_process(variant):
    found = worker_facts.facts(variant)
    assert found[UNUSABLE] == "" and found[HOST] == os.uname().nodename and found["Python"].startswith("3.")
    if variant.startswith("llvm"):
        assert found[WIDTH] in ("4", "8", "16") and re.fullmatch(r"[\d.]+", found[LLVM])


@pytest.fixture(scope="module")
def client():
    with connected(workers=2) as client:
        yield client


@pytest.mark.usefixtures("scalar_variant")
def test_who_differs_is_refused_by_name_and_gets_nothing(client, variant):
    said = []
    liar, honest = sorted(client.nthreads())
    lie = (
        "import mi_refract.cluster.worker_facts as w; own = w.facts; w.facts = lambda v: own(v) | {'mitsuba': '3.0.0'}"
    )
    client.run(exec, f"global own\n{lie}", workers=[liar])
    try:
        found = accepted(client, variant, warn=said.append)
    finally:
        client.run(exec, "import mi_refract.cluster.worker_facts as w; w.facts = own", workers=[liar])
    expected = worker_facts.facts(variant)["mitsuba"]
    text = f"worker {liar} on {os.uname().nodename} is refused: mitsuba 3.0.0, here {expected}"
    assert (list(found.accepted), found.refused, said) == ([honest], {liar: text}, [text])
    assert list(found.machines.values()) == [os.uname().nodename]


@pytest.mark.usefixtures("scalar_variant")
def test_nobody_is_left(client, variant):
    with pytest.raises(ConnectionError) as caught:
        Workers(client, variant, worker_facts.facts(variant) | {"drjit": "9"}).wait()
    text = str(caught.value)
    assert "\n" not in text and text.count("is refused: drjit") == 2
    assert "no worker that may work: worker tls://" in text and "expected at least one like this process" in text


@pytest.mark.usefixtures("scalar_variant")
def test_a_worker_without_the_package_is_refused(client, variant):
    liar, honest = sorted(client.nthreads())
    there = "sys.modules['mi_refract.cluster.worker_facts']"
    client.run(exec, f"global kept\nimport sys; kept = {there}; {there} = None", workers=[liar])
    try:
        found = accepted(client, variant)
    finally:
        client.run(exec, f"import sys; {there} = kept", workers=[liar])
    assert list(found.accepted) == [honest]
    assert "ModuleNotFoundError: import of mi_refract.cluster.worker_facts halted" in found.refused[liar]


def test_a_worker_that_goes_with_its_answer_is_asked_again(client, monkeypatch, variant):
    """Dask calls the answer finished, and waits without end for a worker that is not there."""

    class Lost:
        status = "finished"

        def done(self):
            return True

        def result(self, timeout=None):
            assert timeout, "would wait without end"
            raise TimeoutError

    submit, lost = client.submit, []
    monkeypatch.setattr(client, "submit", lambda *a, **k: submit(*a, **k) if lost else lost.append(Lost()) or lost[0])
    found = accepted(client, variant)
    until(lambda: found.look(at_once=True) or len(found.accepted) == 2)
    assert lost and not found.refused


def test_no_workers_at_all(client, monkeypatch, variant):
    monkeypatch.setattr(workers, "_NOBODY", 0.1)
    monkeypatch.setattr(client, "nthreads", dict)
    with pytest.raises(ConnectionError, match="no worker that may work: no workers; expected"):
        accepted(client, variant)
    with pytest.raises(ConnectionError, match="no worker that may render: no workers; expected"):
        accepted(client, variant, task="render")


def test_a_scheduler_that_hangs(client, monkeypatch, variant):
    found = accepted(client, variant)
    monkeypatch.setattr(workers, "SILENT", 0.1)
    monkeypatch.setattr(client, "nthreads", lambda: time.sleep(1))
    found.look(at_once=True)
    time.sleep(0.2)
    with pytest.raises(LostSchedulerError, match="the Dask scheduler has not answered for 0 s; expected one that does"):
        found.look()

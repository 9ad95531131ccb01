"""Workers are asked what they are before they get work; who differs is refused by name."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.dask_workers import accepted, until
from support.processes import ENVIRONMENT

from mi_refract.cluster import worker_facts
from mi_refract.cluster.connection import connected
from mi_refract.cluster.worker_facts import HOST, LLVM, MIXED, UNUSABLE, WIDTH, differences, machine
from mi_refract.cluster.workers import Workers
from mi_refract.io.errors import NoWorkersError

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
    assert (
        "no worker that may work: worker tls://" in text
        and "expected at least one with the software and hardware of this process" in text
    )


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


@pytest.mark.parametrize("task", ["work", "render"])
def test_no_workers_at_all(client, monkeypatch, task):
    monkeypatch.setattr(client, "nthreads", dict)
    with pytest.raises(NoWorkersError, match=f"no worker that may {task}: no workers; expected"):
        Workers(client, "scalar_rgb", HERE, task=task).wait(nobody=0.1)


def test_the_version_has_a_digest_of_the_sources(tmp_path):
    """Of names and contents: two installations of the same version may differ in a line."""
    package = Path(worker_facts.__file__).parents[1]
    copy = tmp_path / "mi_refract"
    shutil.copytree(package, copy, ignore=shutil.ignore_patterns("__pycache__"))
    code = "from mi_refract.cluster.worker_facts import our_version; print(our_version())"
    versions = []
    for path, text in ((None, ""), (copy / "formulas" / "__init__.py", "# a comment"), (copy / "new.py", "")):
        if path:
            path.write_text(text + (path.read_text() if path.exists() else ""))
        command = [sys.executable, "-c", code]
        environment = ENVIRONMENT | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *filter(None, sys.path)])}
        options = {"env": environment, "cwd": tmp_path, "capture_output": True, "text": True, "check": True}
        versions.append(subprocess.run(command, **options).stdout)
    assert versions[0].strip() == worker_facts.our_version() and len(set(versions)) == 3

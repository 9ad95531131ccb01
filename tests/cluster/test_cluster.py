"""Local clusters, their workers and calls on them: accepted and lost workers, and error messages."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path
from types import SimpleNamespace

import dask
import distributed
import pytest
from distributed import CancelledError
from distributed.comm import CommClosedError, connect
from support.dask_workers import accepted, kill, tls_settings
from support.processes import ENVIRONMENT, python, until

from mi_refract.cluster import on_worker
from mi_refract.cluster import workers as workers_module
from mi_refract.cluster.connection import cluster_errors, connected
from mi_refract.cluster.on_worker import HOST, LLVM, MIXED, UNUSABLE, WIDTH, differences, machine
from mi_refract.cluster.workers import AHEAD, Workers, fetched, results
from mi_refract.io.errors import LostSchedulerError, NoWorkersError, UsageError

VARIANT = "scalar_rgb"
HERE = {"mitsuba": "3.9.1", LLVM: "19.1", WIDTH: "8", UNUSABLE: "", HOST: "here"}


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    """A client of two workers, started in a folder of modules that they must not import."""
    folder, before = tmp_path_factory.mktemp("start"), Path.cwd()
    for name in ("dask", "distributed", "mi_refract", "pickle"):
        (folder / f"{name}.py").write_text("raise SystemExit")
    os.chdir(folder)
    try:
        with connected(workers=2) as client:
            os.chdir(before)
            yield client
    finally:
        os.chdir(before)


# Connections ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options, message",
    [
        ({"scheduler": "tcp://h:1", "workers": 1}, "expected either --scheduler ADDRESS or --workers N"),
        ({"workers": 0}, "--workers 0; expected a whole number from 1 to 1024"),
        ({"scheduler": "tls://h:1"}, "and the files of `distributed.comm.tls` in Dask's configuration"),
        ({"workers": 1}, "--workers 1: the local cluster did not start: ended with status 1; try fewer workers"),
    ],
)
def test_misuse(options, message, monkeypatch):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises((ConnectionError, ValueError)) as caught, connected(**options):
        pass
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_without_process_groups_workers_are_refused(monkeypatch):
    monkeypatch.delattr(os, "killpg")
    with pytest.raises(UsageError, match="--workers 1: Windows cannot end them"), connected(workers=1):
        pass


def test_a_client_is_not_dasks_default(client):
    """A program that uses both this package and Dask keeps its own default client."""
    with pytest.raises(ValueError, match="No clients"):
        distributed.default_client()


def test_unencrypted_connections_are_refused(client):
    """For local workers and for a TLS scheduler: Dask's default accepts a worker's results over any connection."""

    def refuses(client):
        with pytest.raises(RuntimeError, match="encryption required"):
            client.sync(connect, "tcp://127.0.0.1:9", **client.connection_args)

    refuses(client)
    assert client.run_on_scheduler(lambda dask_scheduler: dask_scheduler.security.require_encryption)
    with dask.config.set(tls_settings(client.security)), connected(client.scheduler.address) as other:
        refuses(other)


def test_dasks_pages_are_not_served(client):
    """Its HTTP servers do not use TLS: other users of this machine could read them."""
    ports = [client.run_on_scheduler(lambda dask_scheduler: dask_scheduler.http_server.port)]
    ports += client.run(lambda dask_worker: dask_worker.http_server.port).values()
    for port in ports:
        for page in ("json/identity.json", "info/main/workers.html", "metrics", "health", "status"):
            with pytest.raises(urllib.error.HTTPError, match="404"):
                urllib.request.urlopen(f"http://127.0.0.1:{port}/{page}", timeout=30)
    assert len(ports) == 3


LOST = "tcp://h:1: the Dask scheduler has ended or cancelled the tasks; run the same command again to resume"


@pytest.mark.parametrize(
    "status, then, raised, message",
    [
        ("running", "running", CommClosedError("x"), LOST),
        ("running", "running", CancelledError("x"), LOST),
        ("closed", "closed", None, LOST),
        ("running", "connecting", RuntimeError("cannot schedule"), LOST),
        ("running", "running", OSError("of the scene"), "of the scene"),
        ("running", "running", ValueError("of the scene"), "of the scene"),
    ],
)
def test_a_lost_scheduler_is_one_line(status, then, raised, message):
    client = SimpleNamespace(status=status, scheduler=SimpleNamespace(address="tcp://h:1"))
    expected = LostSchedulerError if message == LOST else type(raised)
    with pytest.raises(expected) as caught, cluster_errors(client):
        client.status = then
        raise raised
    assert str(caught.value) == message


def test_dask_is_imported_only_when_needed():
    code = """import sys, mi_refract.cli.app, mi_refract.cli.render
mi_refract.cli.app.main(["--help"])
sys.exit(str([name for name in sys.modules if name.partition(".")[0] in ("dask", "distributed")]))"""
    with python(code) as process:
        assert process.communicate()[1].splitlines()[-1] == "[]"


# Accepted workers -----------------------------------------------------------------------------------------------------


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
def test_differences_of_facts(change, tolerated, different):
    assert differences(HERE | change, HERE, tolerated) == different
    assert differences({HOST: "there"}, {"drjit": "1.5.0"}) == ["drjit unknown, here 1.5.0"]


def test_facts_of_this_process_and_the_name_of_a_machine(variant):
    facts = on_worker.facts(variant)
    assert facts[UNUSABLE] == "" and facts[HOST] == os.uname().nodename and facts["Python"].startswith("3.")
    if variant.startswith("llvm"):
        assert facts[WIDTH] in ("4", "8", "16") and re.fullmatch(r"[\d.]+", facts[LLVM])
    assert machine(HERE | {HOST: "there"}, HERE) == "there"
    assert machine(HERE | {HOST: "there", WIDTH: "16", LLVM: "18.1"}, HERE) == "there (libLLVM 18.1; vector width 16)"


def test_version_has_a_hash_of_sources_and_glasses(tmp_path):
    """The hash covers names and contents: two installations of one version may differ in a line or a glass."""
    copy = tmp_path / "mi_refract"
    shutil.copytree(Path(on_worker.__file__).parents[1], copy, ignore=shutil.ignore_patterns("__pycache__"))
    environment = ENVIRONMENT | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *filter(None, sys.path)])}
    versions = []
    changes = [(None, ""), (copy / "formulas" / "__init__.py", "# a comment"), (copy / "new.py", "")]
    changes += [(copy / "media" / "glasses.json", " ")]
    for path, text in changes:
        if path:
            path.write_text(text + (path.read_text() if path.exists() else ""))
        command = [sys.executable, "-c", "from mi_refract.cluster import on_worker; print(on_worker.our_version())"]
        versions.append(subprocess.check_output(command, env=environment, cwd=tmp_path, text=True).strip())
    assert versions[0] == on_worker.our_version() == on_worker.facts("scalar_rgb")["mi_refract"]
    assert len(set(versions)) == 4


MODULE = "mi_refract.cluster.on_worker"


@pytest.mark.parametrize(
    "lie, honest_again, different",
    [
        (
            f"import {MODULE} as w; own = w.facts; w.facts = lambda v: own(v) | {{'mitsuba': '3.0.0'}}",
            f"import {MODULE} as w; w.facts = own",
            f" on {os.uname().nodename} is refused: mitsuba 3.0.0, here ",
        ),
        (
            f"import sys; own = sys.modules.pop('{MODULE}', None); sys.modules['{MODULE}'] = None",
            f"import sys; sys.modules['{MODULE}'] = own",
            f" is refused: ModuleNotFoundError: import of {MODULE} halted",
        ),
    ],
    ids=["another version", "no package"],
)
def test_a_differing_worker_is_refused_with_its_name_and_differences(client, lie, honest_again, different):
    liar, honest = sorted(client.nthreads())
    warnings = []
    client.run(exec, f"import {MODULE}; global own\n{lie}", workers=[liar])
    try:
        workers = accepted(client, VARIANT, warn=warnings.append)
    finally:
        client.run(exec, honest_again, workers=[liar])
    assert (list(workers.usable), list(workers.refused), warnings) == ([honest], [liar], [workers.refused[liar]])
    assert warnings[0].startswith(f"worker {liar}{different}") and "\n" not in warnings[0]
    assert list(workers.machines.values()) == [os.uname().nodename]


def test_no_usable_worker_is_one_line(client, monkeypatch):
    with pytest.raises(NoWorkersError) as caught:
        Workers(client, VARIANT, on_worker.facts(VARIANT) | {"drjit": "9"}).wait()
    text = str(caught.value)
    assert "\n" not in text and text.count("is refused: drjit") == 2
    assert "no worker can work: worker tls://" in text
    assert text.endswith("expected at least one with the software and hardware of this process")
    monkeypatch.setattr(client, "nthreads", dict)
    with pytest.raises(NoWorkersError, match="no worker can render: no workers; expected"):
        Workers(client, VARIANT, HERE, task="render").wait(nobody=0.1)


def test_new_workers_are_awaited_for_two_minutes_after_all_have_gone(monkeypatch):
    clock = [1000.0]
    monkeypatch.setattr(workers_module, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    nobody = SimpleNamespace(status="running", scheduler=SimpleNamespace(address="tcp://here"), nthreads=dict)
    workers = Workers(nobody, VARIANT, HERE)
    workers.machines["tcp://lost"] = "there"
    for clock[0] in (1000.0, 1119.0):
        workers.look()
    clock[0] = 1121.0
    with pytest.raises(NoWorkersError, match=r"^tcp://here: all workers have gone; expected new ones within 120 s$"):
        workers.look()


def test_a_worker_whose_answer_is_lost_is_queried_again(client, monkeypatch):
    lost = []

    def lose_the_first(client, future):
        if lost:
            return fetched(client, future)
        lost.append(future)
        return ()

    monkeypatch.setattr(workers_module, "fetched", lose_the_first)
    workers = accepted(client, VARIANT)
    until(lambda: workers.look(at_once=True) or len(workers.usable) == 2)
    assert lost and not workers.refused


# Calls ----------------------------------------------------------------------------------------------------------------


@pytest.fixture
def workers(client):
    until(lambda: len(client.nthreads()) == 2)
    return accepted(client, VARIANT)


def sleep_and_return_pid(seconds):
    time.sleep(seconds)
    return os.getpid()


def reciprocal(x):
    """Return 1/(x − 3): an error for x = 3."""
    return 1 / (x - 3)


def raise_timeout_error():
    raise TimeoutError("of the call")


class Slow:
    """An object whose pickling takes long."""

    def __reduce__(self):
        time.sleep(3 * workers_module.BETWEEN_LOOKS / 4)
        return Slow, ()


def test_results_have_the_calls_index_and_few_calls_are_read_ahead(workers):
    read = []

    def calls():
        for i in range(20):
            read.append(i)
            yield (i + 10,)

    answers = results(workers, reciprocal, calls())
    first = next(answers)
    assert len(read) <= 2 * AHEAD + 1
    values = {index: value for index, value, machine in [first, *answers] if machine == os.uname().nodename}
    assert values == {i: 1 / (i + 7) for i in range(20)}


def test_a_worker_may_log_more_than_a_pipe_holds(workers):
    calls = results(workers, os.write, [(1, b"logged\n" * 20000)])
    assert [result for _, result, _ in calls] == [140000]


def test_an_error_of_a_call_is_raised_unchanged(workers):
    """Even a TimeoutError, which Dask raises, too."""
    with pytest.raises(ZeroDivisionError, match="division by zero"):
        list(results(workers, reciprocal, [(i,) for i in range(6)]))
    with pytest.raises(TimeoutError, match="of the call"):
        list(results(workers, raise_timeout_error, [()]))
    assert len(list(results(workers, reciprocal, [(1,)]))) == 1  # the workers still work


def test_refused_workers_get_no_calls(workers):
    refused = sorted(workers.usable)[0]
    workers.usable.pop(refused)
    workers.refused[refused] = "made up"
    refused_pid = workers.client.run(os.getpid, workers=[refused])[refused]
    pids = [pid for _, pid, _ in results(workers, sleep_and_return_pid, [(0.1,)] * 6)]
    assert len(pids) == 6 and refused_pid not in pids


def test_unfinished_calls_are_cancelled(workers, tmp_path):
    answers = results(workers, until, [(tmp_path.exists,), *[((tmp_path / "end").exists,)] * 3])
    next(answers)
    answers.close()
    until(lambda: not any(workers.client.processing().values()), seconds=10)
    (tmp_path / "end").touch()  # ends calls that are already running


def test_a_slow_result_is_waited_for_and_a_lost_one_is_not(workers):
    """Dask itself would wait until a lost result is computed again, which never happens here."""
    client, address = workers.client, sorted(workers.usable)[0]
    slow, lost = (client.submit(make, workers=[address], pure=False) for make in (Slow, os.getpid))
    until(lambda: slow.done() and lost.done())
    assert isinstance(fetched(client, slow)[0], Slow)
    kill(client, address)
    began = time.monotonic()
    assert fetched(client, lost) == () and time.monotonic() - began < 5


@pytest.mark.parametrize("count", [1, 2])
def test_calls_of_lost_workers_are_repeated(workers, count):
    """By the other worker, or by new workers if both are lost."""
    answers = results(workers, sleep_and_return_pid, [(0.2,), (2.0,), (2.0,)])
    next(answers)
    victims = sorted(workers.client.nthreads())[:count]
    for address in victims:
        kill(workers.client, address)
    assert sorted(index for index, _, _ in answers) == [1, 2]
    until(lambda: workers.look(at_once=True) or not {*victims} & {*workers.usable})

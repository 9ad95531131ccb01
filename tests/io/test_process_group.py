"""Other programs end with all processes that they started, after a timeout, a signal, or too much output."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support.processes import until

from mi_refract.io import process_group
from mi_refract.io.errors import TooMuchOutputError

# Writes its process id to a file, and sleeps.
SLEEPER = 'echo $$ > "$0.part"; mv "$0.part" "$0"; exec sleep 600'


def alive(pid):
    """Whether the process is running; a zombie is not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def shell(text, *arguments):
    return ["sh", "-c", text, *map(str, arguments)]


def test_stdin_stdout_stderr_and_status():
    content = os.urandom(300_000)  # larger than the buffers of both pipes
    ended = process_group.run(shell("cat; echo said >&2; exit 3"), content, 60, keep_stderr=True)
    assert (ended.status, ended.out, ended.err) == (3, content, b"said\n")
    size = 2**31 + 1  # more than Linux writes at a time; zeros that are never written take no memory
    assert int(process_group.run(["wc", "-c"], bytes(size), 60).out) == size
    assert process_group.run(["true"], content, 60).out == b""
    assert process_group.run(shell("exec <&-; sleep 0.1; echo x"), content, 60).out == b"x\n"


@pytest.mark.parametrize("stream", ["1", "2"])
def test_a_program_that_prints_too_much_is_ended(tmp_path, stream):
    endless = f'echo $$ > "$0"; while :; do echo yyyyyyyyyyyyyyyyyyyyyyyyyyyyyyyy >&{stream}; done'
    with pytest.raises(TooMuchOutputError, match="more than 20000 bytes"):
        process_group.run(shell(endless, tmp_path / "pid"), b"", 60, keep_stderr=True, most=20_000)
    assert not alive(int((tmp_path / "pid").read_text()))
    assert len(process_group.run(shell("head -c 20000 /dev/zero"), b"", 60, most=20_000).out) == 20_000


@pytest.mark.parametrize("timeout", [float("nan"), float("inf"), -1, 1e9])
def test_invalid_timeouts_are_errors(timeout):
    with pytest.raises(ValueError, match=r"expected 0 … 604800 s"):
        process_group.run(["true"], b"", timeout)


@pytest.mark.parametrize("text", ["sleep 600", "exec >&-; sleep 600"], ids=["stdout open", "stdout closed"])
def test_a_program_is_ended_after_the_timeout(text):
    start = time.monotonic()
    with pytest.raises(TimeoutError, match=r"did not end within 0\.2 s"):
        process_group.run(shell(text), b"", 0.2)
    assert time.monotonic() - start < 30


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
@pytest.mark.parametrize(("streams", "rest"), [("", "wait"), ("", ""), ("<&- >&-", "echo x")])
def test_what_a_program_started_is_ended_with_it(tmp_path, streams, rest):
    """A child that keeps stdout open, after the timeout; one that has closed it, at the end of the program."""
    text, pid = f'sh -c "$1" "$0" {streams} & until [ -e "$0" ]; do sleep 0.01; done; {rest}', tmp_path / "pid"
    words = shell(text, pid, SLEEPER)
    for timeout in (1, 20, 100):  # a busy machine may take long to start two processes
        if streams:
            assert process_group.run(words, b"", 60).out == b"x\n"
        else:
            with pytest.raises(TimeoutError):
                process_group.run(words, b"", timeout)
        if pid.exists():
            break
    until(lambda: not alive(int(pid.read_text())))


PARENT = f"""
import signal, sys
from mi_refract.io import process_group
from mi_refract.io.errors import TooMuchOutputError
signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of a shell ignore SIGINT
for number in (signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, signal.SIG_DFL)
process_group.run(["sh", "-c", {SLEEPER!r}, sys.argv[1]], b"", 600)
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_a_signal_to_the_caller_ends_the_program(tmp_path, number):
    """And has its usual effect on the caller."""
    caller = subprocess.Popen([sys.executable, "-c", PARENT, tmp_path / "pid"], stderr=subprocess.DEVNULL)
    try:
        until((tmp_path / "pid").exists)
        caller.send_signal(number)
        assert caller.wait(60) in (-number, 128 + number)
    finally:
        caller.kill()
        caller.wait()
    assert not alive(int((tmp_path / "pid").read_text()))


STARTED = "while not os.path.exists(sys.argv[1]):\n            time.sleep(0.01)"
UNUSUAL = {
    "while the program starts": f"""
import os, subprocess, time
class Popen(subprocess.Popen):
    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        {STARTED}
        os.kill(os.getpid(), signal.SIGINT)
subprocess.Popen = Popen
""",
    "in another thread": f"""
import os, threading, time
class Other(threading.Thread):
    def run(self):
        {STARTED}
        time.sleep(0.5)
        signal.pthread_kill(self.ident, signal.SIGINT)
Other(daemon=True).start()
""",
}


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
@pytest.mark.parametrize("signalled", UNUSUAL.values(), ids=[*UNUSUAL])
def test_a_signal_at_an_unusual_place_ends_the_program_too(tmp_path, signalled):
    code = PARENT.replace("process_group.run", f"{signalled}process_group.run")
    caller = subprocess.run([sys.executable, "-c", code, tmp_path / "pid"], capture_output=True, timeout=60)
    assert caller.returncode in (-signal.SIGINT, 128 + signal.SIGINT)
    assert not alive(int((tmp_path / "pid").read_text()))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_signals_that_the_caller_handles_are_not_changed(number):
    before = signal.signal(number, signal.SIG_IGN)
    try:
        assert process_group.run(shell("kill -$1 $PPID; echo x", "", int(number)), b"", 60).out == b"x\n"
    finally:
        signal.signal(number, before)
    assert signal.getsignal(number) is before

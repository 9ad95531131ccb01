"""Ctrl-C ends the process of a command at once, whatever its threads do; nobody else's SIGINT changes."""

from __future__ import annotations

import signal
import sys

import pytest
from support.processes import python

from mi_refract import cli
from validation.run.context import SCENES


def interrupted(process, code, number=signal.SIGINT):
    """Send the signal; it ends with this code, soon."""
    try:
        process.send_signal(number)
        assert process.wait(timeout=30) == code, process.stderr.read()
    finally:
        process.kill()  # or a failure would wait for it without end


# A libLLVM is tried, which takes a minute; it says so itself.
PROBING = """
import os, sys
os.environ.pop("DRJIT_LIBLLVM_PATH", None)  # which would be believed untried where it names no file
from mi_refract import backend, cli
backend.candidates = lambda: ["/proc/self/exe"]
backend._PROBE = '''
import os, signal, time
blocked = signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])
os.write(os.open("/proc/%d/fd/1" % os.getppid(), os.O_WRONLY), b"blocked\\\\n" if blocked else b"free\\\\n")
time.sleep(60)
'''
sys.exit(cli.main())
"""
# And so does a program that is given rays.
PROGRAM = "import os, signal, time\nif signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, []):\n"
PROGRAM += " os.write(2, b'free\\n')\ntime.sleep(60)"


def test_programs_that_are_started_heed_it_and_leave_nothing(tmp_path):
    words = ["render", SCENES / "sphere.xml", "-o", tmp_path / "out.exr"]
    with python(PROBING, *words, TMPDIR=str(tmp_path), XDG_CACHE_HOME=str(tmp_path / "none")) as process:
        assert process.stdout.readline() == "free\n"
        assert [*tmp_path.iterdir()]
        interrupted(process, 130)
    assert not [*tmp_path.iterdir()]
    code = "import sys\nfrom mi_refract import cli\nsys.exit(cli.main())"
    with python(code, "rays", "run", "--count", "10", "--", sys.executable, "-c", PROGRAM) as process:
        assert "free\n" in iter(process.stderr.readline, "")  # Dr.Jit may have said something of its own before
        interrupted(process, 130)


# Interrupted while a temporary folder and a temporary file are there; the thread that makes them goes on regardless.
UNFINISHED = """
import sys, time
from pathlib import Path
from mi_refract import cli
from mi_refract.cli import app
from mi_refract.io import safe_files
remove = safe_files._remove
def remove_slowly(temporary):
    remove(temporary)
    time.sleep(0.05)
safe_files._remove = remove_slowly
def command(arguments):
    with safe_files.temporary_folder() as folder, safe_files.replacing(Path(sys.argv[1], "file")) as file:
        (folder / "half").touch()
        print("there", flush=True)
        while file.exists():
            time.sleep(0.001)
        file.write_text("anew")
        raise OSError("a file of mine has gone")
app.main = command
sys.exit(cli.main())
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_what_is_unfinished_is_removed_also_where_a_thread_makes_it_anew(number, tmp_path):
    code = f"import signal\nsignal.signal({number:d}, signal.SIG_DFL)\n{UNFINISHED}"  # nohup has it ignored
    with python(code, tmp_path, TMPDIR=str(tmp_path)) as process:
        assert process.stdout.readline() == "there\n"
        assert len([*tmp_path.iterdir()]) == 2
        interrupted(process, 128 + number, number)
        assert process.stderr.read() == ""
    assert not [*tmp_path.iterdir()]


BACKGROUND = """
import os, signal, sys, time
signal.signal(signal.SIGINT, signal.SIG_IGN)
from mi_refract import cli
from mi_refract.cli import app
def command(arguments):
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.3)
    return 7
app.main = command
sys.exit(cli.main())
"""


def test_a_background_job_goes_on_where_nothing_is_rendered():
    with python(BACKGROUND, "trace") as process:
        assert (process.communicate(timeout=60), process.returncode) == (("", ""), 7)


def test_a_caller_from_python_keeps_his_own(capsys):
    def state():
        return signal.getsignal(signal.SIGINT), signal.pthread_sigmask(signal.SIG_BLOCK, [])

    before = state()
    assert cli.main(["trace", "--help"]) == 0
    assert state() == before and capsys.readouterr().out

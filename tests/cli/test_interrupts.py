"""Ctrl-C ends a command's process at once, whatever its threads do; callers from Python keep their own SIGINT."""

from __future__ import annotations

import signal
import sys

import pytest
from support.processes import python

from mi_refract import cli
from validation.run.context import SCENES


def interrupt(process, code, number=signal.SIGINT):
    """Send the signal and check that the process ends soon, with this exit code."""
    try:
        process.send_signal(number)
        assert process.wait(timeout=30) == code, process.stderr.read()
    finally:
        process.kill()  # otherwise a failed assertion would wait for the process forever


# The test of a libLLVM takes a minute; its process prints whether SIGINT is blocked.
PROBING = """
import os, sys
os.environ.pop("DRJIT_LIBLLVM_PATH", None)  # a path without a file would be used without a test
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
# A program that gets rays prints the same.
PROGRAM = "import os, signal, time\nif signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, []):\n"
PROGRAM += " os.write(2, b'free\\n')\ntime.sleep(60)"


def test_child_processes_end_on_ctrl_c_and_leave_no_files(tmp_path):
    words = ["render", SCENES / "sphere.xml", "-o", tmp_path / "out.exr"]
    with python(PROBING, *words, TMPDIR=str(tmp_path), XDG_CACHE_HOME=str(tmp_path / "none")) as process:
        assert process.stdout.readline() == "free\n"
        assert [*tmp_path.iterdir()]
        interrupt(process, 130)
    assert not [*tmp_path.iterdir()]
    heeded = "import signal\nsignal.signal(signal.SIGINT, signal.SIG_DFL)\n"  # a job in the background ignores it
    code = f"{heeded}import sys\nfrom mi_refract import cli\nsys.exit(cli.main())"
    with python(code, "rays", "run", "--count", "10", "--", sys.executable, "-c", PROGRAM) as process:
        assert "free\n" in iter(process.stderr.readline, "")  # after lines of Dr.Jit, if any
        interrupt(process, 130)


# Interrupted while a temporary folder and a temporary file exist; the thread that makes them continues regardless.
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
def test_temporary_files_are_removed_even_if_a_thread_recreates_them(number, tmp_path):
    code = f"import signal\nsignal.signal({number:d}, signal.SIG_DFL)\n{UNFINISHED}"  # under nohup SIGHUP is ignored
    with python(code, tmp_path, TMPDIR=str(tmp_path)) as process:
        assert process.stdout.readline() == "there\n"
        assert len([*tmp_path.iterdir()]) == 2
        interrupt(process, 128 + number, number)
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


def test_a_background_job_that_does_not_render_ignores_sigint():
    with python(BACKGROUND, "trace") as process:
        assert (process.communicate(timeout=60), process.returncode) == (("", ""), 7)


def test_a_caller_from_python_keeps_its_signal_handling(capsys):
    def state():
        return signal.getsignal(signal.SIGINT), signal.pthread_sigmask(signal.SIG_BLOCK, [])

    before = state()
    assert cli.main(["trace", "--help"]) == 0
    assert state() == before and capsys.readouterr().out

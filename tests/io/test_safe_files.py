"""Files and folders are replaced completely or not at all; temporary folders; locks; reading with a limit."""

import errno
import fcntl
import json
import os
import shutil
import socket
import stat
import tempfile
import tracemalloc
from pathlib import Path

import pytest
from support.processes import python

from mi_refract.io import safe_files
from mi_refract.io.errors import describe
from mi_refract.io.safe_files import replacing, update_between, write_atomically
from mi_refract.ray_sets import files, ray_set


@pytest.mark.parametrize("step", ["write_bytes", "replace"])
def test_a_failed_write_keeps_the_old_file(step, tmp_path, monkeypatch):
    path = tmp_path / "file"
    write_atomically(path, "old")

    def half(self, *_):
        with self.open("wb") as file:
            file.write(b"n")
        raise OSError("disk full")

    monkeypatch.setattr(Path, step, half)
    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, "new")
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


HOLDING = """
import time
from mi_refract.io.safe_files import temporary_folder
with temporary_folder() as folder:
    (folder / "half").touch()
    print(folder, flush=True)
    time.sleep(60)
"""


def test_temporary_folders_of_killed_processes_are_removed(tmp_path, monkeypatch):
    """Those of running processes and of other hosts remain, and other files and folders with similar names."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    others = [tmp_path / x for x in ("mi_refract_results", "mi_refract-1.part", "mi_refract-00000000-12345678.part")]
    for other in others:
        other.mkdir()
    with python(HOLDING, TMPDIR=str(tmp_path)) as living, python(HOLDING, TMPDIR=str(tmp_path)) as killed:
        locked, abandoned = (Path(process.stdout.readline().strip()) for process in (living, killed))
        killed.kill()
        killed.wait()
        assert (abandoned / "half").exists()
        link, file = (abandoned.with_stem(f"{abandoned.stem}_{kind}") for kind in ("link", "file"))
        link.symlink_to(tmp_path)
        file.touch()
        with safe_files.temporary_folder() as folder:
            assert {*tmp_path.iterdir()} == {locked, folder, link, file, *others}
        living.kill()
    assert not folder.exists()


def test_a_temporary_folder_removed_before_it_is_locked_is_created_again(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    real, removed = fcntl.flock, []

    def flock(file, how):
        if not removed:
            removed.extend(tmp_path.iterdir())
            removed[0].rmdir()
        real(file, how)

    monkeypatch.setattr(fcntl, "flock", flock)
    with safe_files.temporary_folder() as folder:
        assert folder.is_dir() and removed and folder not in removed
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG])
def test_the_error_of_a_full_disk_names_the_file(number, tmp_path, monkeypatch):
    def full(self, content):
        raise OSError(number, "full")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError) as error, replacing(tmp_path / "outer"):
        write_atomically(tmp_path / "file", "new")
    assert describe(error.value) == f"{tmp_path / 'file'}: full"


KINDS = {
    "pipe": os.mkfifo,
    "socket": lambda path: socket.socket(socket.AF_UNIX).bind(path.name),  # the path of a socket must be short
    "device": lambda path: path.symlink_to("/dev/null"),
    "stream": lambda path: path.symlink_to("/proc/self/fd/0"),  # to a regular file
    "folder": Path.mkdir,
    "linked pipe": lambda path: (os.mkfifo(path.with_name("pipe")), path.symlink_to(path.with_name("pipe"))),
}


@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.parametrize("kind", [*KINDS, "stream of a process"])
def test_pipes_devices_and_folders_are_not_replaced(kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "out.x" if kind in KINDS else Path("/dev/fd/1")
    KINDS.get(kind, lambda path: None)(path)

    def entries():  # without the time of access: reading a link changes it
        stats = {entry: entry.lstat() for entry in tmp_path.iterdir()}
        return {entry: (stat.st_mode, stat.st_ino, stat.st_size, stat.st_mtime_ns) for entry, stat in stats.items()}

    before = entries()
    for write in (lambda: safe_files.writable(path, (path.suffix,)), lambda: write_atomically(path, "new")):
        with pytest.raises(OSError, match=rf"{path}: is a {kind.replace('linked ', '').split()[0]}.*; expected the"):
            write()
    assert entries() == before


def test_links_to_files_and_broken_links_are_replaced(tmp_path):
    for target in (tmp_path / "target", tmp_path / "nothing"):
        (tmp_path / "target").write_text("old")
        path = tmp_path / f"to {target.name}"
        path.symlink_to(target)
        write_atomically(safe_files.writable(path, ("",)), "new")
        assert path.read_text() == "new" and not path.is_symlink()
        assert (tmp_path / "target").read_text() == "old"


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o444, 0o700, 0o750, 0o2775, 0o555])
@pytest.mark.parametrize("folder", [False, True])
def test_permissions_are_kept_during_and_after_writing(mode, folder, tmp_path):
    path = tmp_path / "out"
    path.mkdir() if folder else path.write_text("old")
    path.chmod(mode)
    with replacing(path, folder=folder) as temporary:
        assert temporary.stat().st_mode & 0o077 == mode & 0o077
        (temporary / "file" if folder else temporary).write_text("new")
    assert stat.S_IMODE(path.stat().st_mode) == mode
    assert (path / "file" if folder else path).read_text() == "new"


@pytest.mark.parametrize("folder", [False, True])
def test_temporary_names_are_new_random_and_beside_the_target(folder, tmp_path, monkeypatch):
    names = set()
    for _ in range(3):
        with replacing(tmp_path / "a.x", ".x", folder=folder) as temporary:
            names.add(temporary.name)
            assert temporary.parent == tmp_path and temporary.is_dir() is folder and temporary.name.startswith(".")
        shutil.rmtree(tmp_path / "a.x") if folder else (tmp_path / "a.x").unlink()
    assert len(names) == 3
    victim = tmp_path / "victim"
    victim.mkdir()
    (tmp_path / "link").symlink_to(victim)
    monkeypatch.setattr(safe_files, "temporary_name", lambda *_: tmp_path / "link")
    with pytest.raises(FileExistsError), replacing(tmp_path / "a.x", folder=folder):
        pass
    assert (tmp_path / "link").is_symlink() and not [*victim.iterdir()]
    monkeypatch.undo()
    for name in ("n" * 251 + ".txt", "é" * 120 + ".txt"):  # names of nearly the maximum length
        write_atomically(tmp_path / name, "x")
        assert (tmp_path / name).read_text() == "x"


# Text between markers -------------------------------------------------------------------------------------------------

BEGIN, END = "<!-- begin: t -->", "<!-- end: t -->"


def test_update_between_replaces_only_the_text_between_markers(tmp_path):
    path = tmp_path / "README.md"
    path.write_bytes(b"a\r\n<!-- begin: t -->\r\nold\r\n<!-- end: t -->\r\nb\r\n")
    for _ in range(2):
        update_between(path, "t", "new é\nline\n")
    assert path.read_bytes().decode() == "a\r\n<!-- begin: t -->\r\nnew é\r\nline\r\n<!-- end: t -->\r\nb\r\n"


@pytest.mark.parametrize(
    ("document", "text", "message"),
    [(document, "new", "expected one .*begin: t") for document in ("", BEGIN, END + BEGIN, BEGIN + BEGIN + END)]
    + [(f"{BEGIN}\nold\n{END}\n", text, "contains its own marker") for text in (f"new\n{BEGIN}", f"{END}\nnew")],
)
def test_update_between_refuses_ambiguous_markers(document, text, message, tmp_path):
    path = tmp_path / "README.md"
    path.write_text(document)
    with pytest.raises(ValueError, match=rf"README\.md: .*{message}"):
        update_between(path, "t", text)
    assert path.read_text() == document


# The lock -------------------------------------------------------------------------------------------------------------


def test_a_held_lock_names_its_holder_and_is_removed_at_the_end(tmp_path):
    path = tmp_path / "it.lock"
    path.write_text("left by a killed process")
    with safe_files.held(path, "a run"):
        assert json.loads(path.read_text())["process"] == os.getpid()
        for content, holder in ((path.read_text(), rf"process {os.getpid()} on \S+ since \d"), ("{", "an unknown")):
            path.write_text(content)
            text = f"^{tmp_path}: a run is already running in {holder}.*; expected another folder$"
            with pytest.raises(BlockingIOError, match=text), safe_files.held(path, "a run"):
                pass
        assert path.exists()
    assert not path.exists()


def test_locks_do_not_follow_links_and_work_without_file_locks(tmp_path, monkeypatch):
    path, victim = tmp_path / "it.lock", tmp_path / "victim"
    victim.write_text("old")
    path.symlink_to(victim)
    with pytest.raises(OSError), safe_files.held(path, "a run"):
        pass
    assert victim.read_text() == "old"

    def flock(*_):
        raise OSError(errno.ENOSYS, "Function not implemented")  # as on some network file systems

    monkeypatch.setattr(fcntl, "flock", flock)
    with safe_files.held(tmp_path / "a.lock", "a run"):
        assert (tmp_path / "a.lock").exists()
    assert not (tmp_path / "a.lock").exists()


# Reading --------------------------------------------------------------------------------------------------------------


def peak(work):
    """The maximum of the allocated bytes."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_reading_allocates_the_size_of_the_file(tmp_path):
    path, rays = tmp_path / "file", tmp_path / "rays.csv"
    path.write_bytes(b"x" * 10**6)
    assert safe_files.read_bytes(path, 2**40) == path.read_bytes()
    assert 10**6 < peak(lambda: safe_files.read_bytes(path, 2**40)) < 1.1e6
    files.write(rays, ray_set.make(count=10))
    assert peak(lambda: files.read(rays)) < 2e7
    if Path("/proc/self/status").exists():  # a file without a size
        assert safe_files.read_bytes("/proc/self/status", 10**6).startswith(b"Name:")


@pytest.mark.parametrize("size", [0, 1, 2**20, 2**20 + 1])
def test_a_growing_file_is_read_up_to_the_limit(size, tmp_path, monkeypatch):
    path = tmp_path / "file"
    path.write_bytes(bytes(size))
    initial = path.stat()

    def grow(file):
        with path.open("ab") as appended:
            appended.write(b"x" * 2**21)
        return initial

    monkeypatch.setattr(safe_files.os, "fstat", grow)
    assert safe_files.read_bytes(path, 2**23).rstrip(b"x") == bytes(size)
    with pytest.raises(ValueError, match=f"{path}: more than {size + 5} bytes"):
        safe_files.read_bytes(path, size + 5)

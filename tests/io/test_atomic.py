"""Files are written whole or not at all, and travel with the package."""

import errno
import json
import os
import shutil
import socket
import stat
import tomllib
from pathlib import Path

import numpy as np
import pytest

from mi_refract.io import atomic, image_file, lock
from mi_refract.io.atomic import update_between, write_atomically


def test_a_failed_write_leaves_the_old_file_alone(tmp_path, monkeypatch):
    path = tmp_path / "file"
    write_atomically(path, "old")

    def half(self, data):
        with self.open("wb") as out:
            out.write(data[:1])
        raise OSError("disk full")

    for name, broken in (("write_bytes", half), ("replace", lambda self, target: half(self, b"n"))):
        with monkeypatch.context() as patch, pytest.raises(OSError, match="disk full"):
            patch.setattr(Path, name, broken)
            write_atomically(path, "new")
        assert path.read_text() == "old"
        assert list(tmp_path.iterdir()) == [path]


def test_a_replaced_file_keeps_its_permissions(tmp_path):
    path = tmp_path / "file"
    write_atomically(path, "old")
    path.chmod(0o640)
    write_atomically(path, "new")
    assert path.read_text() == "new" and path.stat().st_mode & 0o777 == 0o640


@pytest.fixture(params=["pipe", "socket", "device", "stream", "stream by number", "folder", "link to a pipe"])
def no_file(request, tmp_path, monkeypatch):
    """A path with the ending .x of something that is no file, and what it is."""
    path = tmp_path / "out.x"
    match request.param:
        case "pipe":
            os.mkfifo(path)
        case "socket":
            monkeypatch.chdir(tmp_path)  # a socket's name is short
            with socket.socket(socket.AF_UNIX) as made:
                made.bind(path.name)
        case "device":
            path.symlink_to("/dev/null")
        case "stream":  # to a regular file
            path.symlink_to("/proc/self/fd/0")
        case "stream by number":
            path = Path("/dev/fd/1")
        case "folder":
            path.mkdir()
        case "link to a pipe":
            os.mkfifo(tmp_path / "pipe")
            path.symlink_to(tmp_path / "pipe")
    return path, request.param.replace("link to a ", "").replace(" by number", " of a process")


def test_what_is_no_file_is_not_replaced(no_file, tmp_path):
    path, kind = no_file
    before = {each: each.lstat() for each in tmp_path.iterdir()}
    for write in (lambda: atomic.writable(path, (path.suffix,)), lambda: write_atomically(path, "new")):
        with pytest.raises(OSError, match=rf"{path}: is a {kind}.*; expected the name of a file"):
            write()
    assert {each: each.lstat() for each in tmp_path.iterdir()} == before


def test_a_link_to_a_file_or_to_nothing_is_replaced(tmp_path):
    for target in (tmp_path / "target", tmp_path / "nothing"):
        (tmp_path / "target").write_text("old")
        path = tmp_path / f"to {target.name}"
        path.symlink_to(target)
        write_atomically(atomic.writable(path, ("",)), "new")
        assert path.read_text() == "new" and not path.is_symlink()
        assert (tmp_path / "target").read_text() == "old"


BEGIN, END = "<!-- begin: t -->", "<!-- end: t -->"


def test_update_between_replaces_that_text_only(tmp_path):
    path = tmp_path / "README.md"
    path.write_bytes(b"a\r\n<!-- begin: t -->\r\nold\r\n<!-- end: t -->\r\nb\r\n")
    for _ in range(2):
        update_between(path, "t", "new é\nline\n")
    assert path.read_bytes().decode() == "a\r\n<!-- begin: t -->\r\nnew é\r\nline\r\n<!-- end: t -->\r\nb\r\n"


@pytest.mark.parametrize(
    "text",
    ["", BEGIN, END + BEGIN, BEGIN + BEGIN + END],
)
def test_update_between_refuses_an_unclear_place(tmp_path, text):
    path = tmp_path / "README.md"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"README\.md: expected one .*begin: t"):
        update_between(path, "t", "new")
    assert path.read_text() == text


@pytest.mark.parametrize("text", [f"new\n{BEGIN}", f"{END}\nnew"])
def test_update_between_refuses_a_text_with_a_marker_of_its_own(tmp_path, text):
    path = tmp_path / "README.md"
    path.write_text(f"{BEGIN}\nold\n{END}\n")
    with pytest.raises(ValueError, match=r"README\.md: the text for 't' contains its own marker"):
        update_between(path, "t", text)
    assert path.read_text() == f"{BEGIN}\nold\n{END}\n"


def test_what_is_no_code_travels_with_the_package():
    """All of it but the READMEs: `py.typed`, and the templates of the pages."""
    root = Path(__file__).parents[2]
    data = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    folders = {name: root / name.replace(".", "/") for name in data}
    taken = {path for name, globs in data.items() for glob in globs for path in folders[name].glob(glob)}
    files = {path for path in (root / "mi_refract").rglob("*.*") if path.suffix not in (".py", ".pyc", ".md")}
    assert {path.suffix for path in files} >= {".j2", ".css", ".js", ".typed"}
    assert files <= taken


# Temporary files ---------------------------------------------------------------------------------------------------


@pytest.fixture
def started_anew(monkeypatch):
    """As if the process had not written anything yet."""
    monkeypatch.setattr(atomic, "_swept", set())


@pytest.mark.parametrize("folder", [False, True])
def test_a_temporary_is_new_unguessable_and_beside_its_target(folder, tmp_path, monkeypatch):
    names = set()
    for _ in range(3):
        with atomic.replacing(tmp_path / "a.x", ".x", folder=folder) as temporary:
            names.add(temporary.name)
            assert temporary.parent == tmp_path and temporary.is_dir() is folder and temporary.exists()
        shutil.rmtree(tmp_path / "a.x") if folder else (tmp_path / "a.x").unlink()
    assert len(names) == 3
    victim = tmp_path / "victim"
    victim.mkdir()
    for there in ("link", "file"):
        taken = tmp_path / there
        taken.symlink_to(victim) if there == "link" else taken.write_text("mine")
        monkeypatch.setattr(atomic, "temporary_name", lambda path, suffix, taken=taken: taken)
        with pytest.raises(FileExistsError), atomic.replacing(tmp_path / "a.x", folder=folder):
            pass
        assert taken.exists() and not [*victim.iterdir()]


def test_a_long_name_leaves_room_for_the_temporary_one(tmp_path):
    for name in ("n" * 251 + ".txt", "é" * 120 + ".txt"):
        write_atomically(tmp_path / name, "x")
        assert (tmp_path / name).read_text() == "x"


@pytest.mark.parametrize("mode", [0o700, 0o750, 0o2775, 0o555])
def test_an_existing_folder_keeps_its_mode(mode, tmp_path):
    place = tmp_path / "out"
    place.mkdir()
    place.chmod(mode)
    with atomic.replacing(place, folder=True) as temporary:
        assert temporary.stat().st_mode & 0o077 == mode & 0o077, "not even for a moment open to others"
        (temporary / "file").write_text("x")
    assert stat.S_IMODE(place.stat().st_mode) == mode
    assert (place / "file").read_text() == "x"


def test_a_private_file_is_private_while_it_is_written(tmp_path):
    path = tmp_path / "a"
    path.write_text("old")
    path.chmod(0o600)
    with atomic.replacing(path) as temporary:
        assert stat.S_IMODE(temporary.stat().st_mode) == 0o600


def test_stale_temporaries_of_ours_are_swept_and_nothing_else(tmp_path, started_anew):
    stale = [
        atomic.temporary_name(tmp_path / name, suffix) for name, suffix in (("a.exr", ".exr"), ("b", ""), ("c", ""))
    ]
    stale[0].write_text("half")
    stale[1].write_text("half")
    stale[2].mkdir()
    (stale[2] / "file").write_text("half")
    kept = [
        tmp_path / name for name in (".a.part", ".a.0123.part", "a.exr", f"a.{'0' * 32}.part", f".a.{'g' * 32}.part")
    ]
    for path in kept:
        path.write_text("mine")
    link = atomic.temporary_name(tmp_path / "link", "")
    link.symlink_to(tmp_path / "a.exr")
    fifo = atomic.temporary_name(tmp_path / "fifo", "")
    os.mkfifo(fifo)
    write_atomically(tmp_path / "new", "x")
    assert {*tmp_path.iterdir()} >= {*kept, link, fifo, tmp_path / "new"}
    assert not [path for path in stale if path.exists()]


def test_a_temporary_in_use_is_not_swept(tmp_path, started_anew, monkeypatch):
    """Not by another process, for which a lock on another descriptor stands here; nor when an EXR file is written."""
    seen = []
    with atomic.replacing(tmp_path / "a") as file, atomic.replacing(tmp_path / "b", folder=True) as folder:
        atomic._swept.clear()
        write_atomically(tmp_path / "c", "x")
        assert file.exists() and folder.exists()
    check = image_file.read_exr

    def sweep_then_read(path, *options):
        atomic._swept.clear()
        atomic.sweep(tmp_path)
        seen.append(path.exists())
        return check(path, *options)

    monkeypatch.setattr(image_file, "read_exr", sweep_then_read)
    image_file.write_exr(tmp_path / "d.exr", np.ones((4, 4, 3)))
    assert seen == [True]


# The lock ------------------------------------------------------------------------------------------------------------


def test_a_lock_says_who_holds_it_and_ends_with_its_process(tmp_path):
    path = tmp_path / "it.lock"
    with lock.held(path, "a run"):
        with pytest.raises(BlockingIOError) as refused, lock.held(path, "a run"):
            pass
        text = str(refused.value)
        assert text.startswith(
            f"{tmp_path}: a run runs there already, process {os.getpid()} on {socket.gethostname()} "
        )
        assert text.endswith("; expected another folder") and "\n" not in text
        path.write_text("{")
        with pytest.raises(BlockingIOError, match="has not said"), lock.held(path, "a run"):
            pass
        assert path.exists()
    assert not path.exists()
    path.write_text("what a killed process left")
    with lock.held(path, "a run"):
        assert json.loads(path.read_text())["process"] == os.getpid()


def test_a_lock_is_not_written_through_a_link(tmp_path):
    path, victim = tmp_path / "it.lock", tmp_path / "victim"
    victim.write_text("old")
    path.symlink_to(victim)
    with pytest.raises(OSError), lock.held(path, "a run"):
        pass
    assert victim.read_text() == "old"


def test_a_file_system_without_locks_keeps_nobody_out(tmp_path, monkeypatch):
    def flock(*_):
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(lock.fcntl, "flock", flock)
    with lock.held(tmp_path / "a.lock", "a run"):
        assert (tmp_path / "a.lock").exists()
    assert not (tmp_path / "a.lock").exists()

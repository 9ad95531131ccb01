"""Files are read as far as they go, and take no more memory than they hold."""

import sys
from pathlib import Path

import pytest
from support.memory import peak

from mi_refract.io import regular_file
from mi_refract.ray_sets import files, ray_set


def test_the_memory_is_that_of_the_file(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"x" * 10**6)
    assert regular_file.read_bytes(path, 2**40) == path.read_bytes()
    assert 10**6 < peak(lambda: regular_file.read_bytes(path, 2**40)) < 1.1e6


def test_a_small_table_of_rays_takes_little(tmp_path):
    path = tmp_path / "rays.csv"
    files.write(path, ray_set.make(count=10))
    assert peak(lambda: files.read(path)) < 2e7


@pytest.mark.parametrize("size", [0, 1, 2**20, 2**20 + 1])
def test_a_file_that_grows_meanwhile_is_read_up_to_the_limit(size, tmp_path, monkeypatch):
    path = tmp_path / "file"
    path.write_bytes(bytes(size))

    def grow(file):
        with path.open("ab") as more:
            more.write(b"x" * 2**21)
        return small

    small = path.stat()
    monkeypatch.setattr(regular_file.os, "fstat", grow)
    assert regular_file.read_bytes(path, 2**23).rstrip(b"x") == bytes(size)
    with pytest.raises(ValueError, match=f"{path}: more than {size + 5} bytes"):
        regular_file.read_bytes(path, size + 5)


@pytest.mark.skipif(sys.platform != "linux", reason="a file of /proc")
def test_a_file_without_a_size_is_read():
    assert regular_file.read_bytes("/proc/self/status", 10**6).startswith(b"Name:")
    assert Path("/proc/self/status").stat().st_size == 0

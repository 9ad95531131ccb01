"""Files are written whole or not at all, and travel with the package."""

import tomllib
from pathlib import Path

import pytest

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


def test_the_page_travels_with_the_package():
    root = Path(__file__).parents[2]
    project = tomllib.loads((root / "pyproject.toml").read_text())
    globs = project["tool"]["setuptools"]["package-data"]["mi_refract"]
    files = [p for p in (root / "mi_refract").iterdir() if p.is_file() and p.suffix != ".py"]
    assert not [p.name for p in files if not any(p.match(glob) for glob in globs)]

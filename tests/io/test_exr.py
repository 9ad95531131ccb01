"""EXR files: what is written is what is read, and nothing is ever half there."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from support.diff_images import cut

from mi_refract.io import image_file
from mi_refract.io.image_file import read_exr, write_exr

# Values that a detour over half floats, clamping or a colour transform would change.
PIXELS = np.array([[[0.1, -2.5, 1e20], [np.inf, 1e-30, 3]], [[1, 2, 65505], [4, 5, 6]], [[7, 8, 9], [0, -0.0, 1]]])


def test_round_trip(tmp_path):
    metadata = {"mi_refract:scene": "a b/ü.xml", "mi_refract:spp": 7, "mi_refract:seconds": 0.25, "Software": "us"}
    write_exr(tmp_path / "a.exr", PIXELS, metadata=metadata | {"mi_refract:seed": 2**32 - 1})
    pixels, read = read_exr(tmp_path / "a.exr")
    assert pixels.dtype == np.float32
    np.testing.assert_array_equal(pixels, PIXELS.astype(np.float32))
    assert read["channels"] == ("R", "G", "B")
    assert {name: read[name] for name in metadata} == metadata
    assert read["mi_refract:seed"] == str(2**32 - 1)
    assert os.listdir(tmp_path) == ["a.exr"]  # noqa: PTH208


def test_nan_is_kept(tmp_path):
    write_exr(tmp_path / "a.exr", np.full((1, 2, 1), np.nan), ["Y"])
    assert np.isnan(read_exr(tmp_path / "a.exr")[0]).all()


def test_channels_by_name(tmp_path):
    channels = ["S0.R", "A", "B", "G", "R"]
    write_exr(tmp_path / "a.exr", np.arange(30.0).reshape(3, 2, 5), channels)
    pixels, metadata = read_exr(tmp_path / "a.exr")
    assert sorted(metadata["channels"]) == sorted(channels)
    for i, name in enumerate(channels):
        np.testing.assert_array_equal(pixels[..., metadata["channels"].index(name)][0], [i, i + 5])


@pytest.mark.parametrize(
    "shape, channels", [((2, 2), "RGB"), ((2, 2, 4), "RGB"), ((0, 2, 3), "RGB"), ((2, 2, 3), "RGR")]
)
def test_shapes_that_do_not_fit(tmp_path, shape, channels):
    with pytest.raises(ValueError, match=r"a\.exr: .*expected"):
        write_exr(tmp_path / "a.exr", np.zeros(shape), channels)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("value", [None, [1], {"a": 1}, b"x"])
def test_attributes_that_do_not_fit(tmp_path, value):
    with pytest.raises(ValueError, match="expected str, int, float"):
        write_exr(tmp_path / "a.exr", PIXELS, metadata={"x": value})
    assert not list(tmp_path.iterdir())


def test_places_that_do_not_fit(tmp_path):
    (tmp_path / "folder.exr").mkdir()
    (tmp_path / "file").touch()
    for name, error in (
        ("a.png", ValueError),
        ("folder.exr", IsADirectoryError),
        ("none/a.exr", NotADirectoryError),
        ("file/a.exr", NotADirectoryError),
    ):
        with pytest.raises(error, match=name):
            write_exr(tmp_path / name, PIXELS)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.exr"]


@pytest.mark.parametrize("side", [2, 400], ids=["within a buffer", "beyond it"])
def test_a_full_disk_keeps_the_old_file(tmp_path, side, monkeypatch):
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full")
    path = tmp_path / "a.exr"
    path.write_text("old")
    monkeypatch.setattr(Path, "touch", lambda self, **_: self.symlink_to("/dev/full"))
    with pytest.raises(OSError, match=r"a\.exr: cannot be written: .") as error:
        write_exr(path, np.random.default_rng(1).random((side, side, 3)))
    assert "\n" not in str(error.value)
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.exr"]


def test_an_interrupted_write_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.exr"
    path.write_text("old")

    def interrupted(temporary, *_):
        temporary.write_text("half")
        raise KeyboardInterrupt

    monkeypatch.setattr(image_file, "_write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_exr(path, PIXELS)
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.exr"]


@pytest.mark.parametrize("keep", [0, 4, 60, 0.3, 0.6, -40, -1])
def test_a_truncated_file_is_not_an_image(tmp_path, keep):
    path = tmp_path / "a.exr"
    write_exr(path, np.random.default_rng(1).random((64, 64, 3)))
    cut(path, keep)
    with pytest.raises(ValueError, match=r"a\.exr: (corrupt|not an) EXR file") as error:
        read_exr(path)
    assert "\n" not in str(error.value)


def test_files_that_are_not_images(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.exr"):
        read_exr(tmp_path / "none.exr")
    (tmp_path / "text.exr").write_text("<scene/>")
    with pytest.raises(ValueError, match=r"text\.exr: not an EXR file"):
        read_exr(tmp_path / "text.exr")
    with pytest.raises(OSError, match=str(tmp_path)):
        read_exr(tmp_path)

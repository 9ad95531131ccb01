"""Files of rays and of answers: nothing is lost, and a file that was edited is an error."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest

from mi_refract.io import image_file
from mi_refract.ray_sets import files, ray_set

FORMATS = [("f32", "csv"), ("f32", "npz"), ("f32", "exr"), ("f64", "csv"), ("f64", "npz")]
SMALL = {"names": ("generic", "k ≪ 1", "k ≫ 1", "denormal"), "count": 300, "seed": 5}


def bits(found):
    return [getattr(found.rays, name).tobytes() for name in "ank"]


@pytest.mark.parametrize("precision, ending", FORMATS)
def test_every_bit_returns(tmp_path, precision, ending):
    made = ray_set.make(**SMALL, precision=precision)
    path = files.write(tmp_path / f"rays.{ending}", made)
    found = files.read(path)
    assert bits(found) == bits(made)
    assert found.rays.a.dtype == ray_set.PRECISIONS[precision]
    assert (found.header, list(found.regime)) == (made.header, list(made.regime))
    np.testing.assert_array_equal(found.ids, made.ids)
    denormal = made.rays.n[made.regime == "denormal"]
    assert (np.signbit(denormal) & (denormal == 0)).any()
    assert ((denormal != 0) & (np.abs(denormal) < np.finfo(denormal.dtype).tiny)).any()


@pytest.mark.parametrize("precision, ending", FORMATS)
def test_the_same_options_give_the_same_file(tmp_path, precision, ending):
    written = [files.write(tmp_path / f"{i}.{ending}", ray_set.make(**SMALL, precision=precision)) for i in range(2)]
    assert written[0].read_bytes() == written[1].read_bytes()
    other = files.write(tmp_path / f"3.{ending}", ray_set.make(**SMALL | {"seed": 6}, precision=precision))
    assert other.read_bytes() != written[0].read_bytes()


@pytest.mark.parametrize("precision", ray_set.PRECISIONS)
def test_numbers_read_in_either_precision_are_the_rays(precision):
    """A reader in float64 and one in float32 both have the very number; no reader loses anything of k."""
    made = ray_set.make(**SMALL, precision=precision)
    rows = [line.split(",") for line in files.as_csv(made).splitlines() if not line.startswith("#")]
    assert tuple(rows[0]) == files.COLUMNS
    text = np.array(rows[1:])
    vectors = np.hstack([made.rays.a, made.rays.n])
    np.testing.assert_array_equal(text[:, 1:7].astype(np.float64), vectors)
    np.testing.assert_array_equal(text[:, 1:7].astype(made.rays.a.dtype), vectors)
    n_from, n_to = text[:, 7:].astype(made.rays.k.dtype).T
    np.testing.assert_array_equal(n_from / n_to, made.rays.k)
    assert min(n_from.min(), n_to.min()) >= 1


@pytest.mark.parametrize("name", ["rays.txt", "rays", "none/rays.csv"])
def test_invalid_paths(tmp_path, name):
    with pytest.raises((ValueError, OSError), match="accepted"):
        files.write(tmp_path / name, ray_set.make(count=2))
    assert not list(tmp_path.iterdir())


def test_exr_holds_single_precision_only(tmp_path):
    with pytest.raises(ValueError, match=r"f64; accepted in EXR: f32"):
        files.write(tmp_path / "rays.exr", ray_set.make(count=2, precision="f64"))


# Files that somebody touched


EDITS = {
    "a digit": lambda text: text.replace("0.3", "0.4", 1),
    "an index": lambda text: text.replace(",1.5,1.0", ",1.5,2.0", 1),
    "a row less": lambda text: text.rstrip("\n").rpartition("\n")[0] + "\n",
    "two rows swapped": lambda text: text.replace("\n3,", "\n99,").replace("\n4,", "\n3,").replace("\n99,", "\n4,"),
    "a regime's ids": lambda text: text.replace("[0, 49]", "[0, 59]"),
    "another seed": lambda text: text.replace("# seed: 0", "# seed: 1"),
    "the precision": lambda text: text.replace("# precision: f64", "# precision: f32"),
    "no checksum": lambda text: "\n".join(line for line in text.split("\n") if "checksum" not in line),
    "half a row": lambda text: text[: len(text) // 2],
    "no header": lambda text: "\n".join(line for line in text.split("\n") if not line.startswith("#")),
    "other columns": lambda text: text.replace("n_from,n_to", "n_to,n_from"),
    "a word": lambda text: text.replace("\n7,", "\n7,x"),
    "ids that are none": lambda text: text.replace("\n7,", "\nnan,"),
    "a gap in the ranges": lambda text: text.replace('{"generic": [0, 49]', '{"generic": "?"'),
    "nothing left": lambda text: "",
}


@pytest.mark.parametrize("edit", EDITS.values(), ids=EDITS)
def test_an_edited_file_is_refused(tmp_path, edit):
    text = files.as_csv(ray_set.make(["generic", "critical"], 50, "f64"))
    path = tmp_path / "rays.csv"
    path.write_text(text)
    files.read(path)
    assert edit(text) != text
    path.write_text(edit(text))
    with pytest.raises(ValueError, match=r"^.*rays\.csv: .*accepted") as caught:
        files.read(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("ending", ["csv", "npz", "exr"])
@pytest.mark.parametrize("keep", [0, 0.3, 0.9])
def test_a_truncated_file_is_refused(tmp_path, ending, keep):
    path = files.write(tmp_path / f"rays.{ending}", ray_set.make(count=200))
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])
    with pytest.raises((ValueError, OSError), match=path.name) as caught:
        files.read(path)
    assert "\n" not in str(caught.value)


def test_another_image_is_refused(tmp_path):
    image_file.write_exr(tmp_path / "a.exr", np.zeros((2, 2, 3)))
    with pytest.raises(ValueError, match=r"a\.exr: no channel 'id'"):
        files.read(tmp_path / "a.exr")
    image_file.write_exr(tmp_path / "a.exr", np.zeros((2, 2, 9)), files.COLUMNS)
    with pytest.raises(ValueError, match="not a file of rays"):
        files.read(tmp_path / "a.exr")


def test_exr_holds_ids_up_to_those_of_float32(tmp_path, monkeypatch):
    made = ray_set.make(("generic",), 4)
    with pytest.raises(ValueError, match=r"4 rays in f64; accepted in EXR: f32, up to 16777216$"):
        files.write(tmp_path / "rays.exr", ray_set.make(("generic",), 4, "f64"))
    monkeypatch.setattr(files, "_EXR_IDS", 3)
    with pytest.raises(ValueError, match=r"4 rays in f32; accepted in EXR: f32, up to 3$"):
        files.write(tmp_path / "rays.exr", made)
    monkeypatch.setattr(files, "_EXR_IDS", 4)
    assert len(files.read(files.write(tmp_path / "rays.exr", made))) == 4


# Answers


def answers(text):
    return files.parse_answers(text, "answers.csv")


def test_answers_as_people_write_them():
    text = "\ufeff# seed: 3\r\n# by: us\r\n\r\nid, bx, by, bz, transmitted\r\n# a remark\r\n4, 1, 2.5e-3, -0, 1\r\n"
    text += "2,nan,-nan(ind),NaN,0\r\n\r\n0 ,inf,-INF,+1.5,1\r\n"
    for found in (answers(text[1:]), answers(text.encode())):
        assert found.header == {"seed": 3, "by": "us"}
        assert found.ids.tolist() == [4, 2, 0]
        np.testing.assert_array_equal(found.b, [[1, 2.5e-3, 0], [np.nan] * 3, [np.inf, -np.inf, 1.5]])
        assert found.transmitted.tolist() == [True, False, True]
    assert answers("id,bx,by,bz\n1,2,3,4").transmitted is None
    assert len(answers("id,bx,by,bz\n").ids) == 0


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "the table is empty; accepted, in this order: id,bx,by,bz or id,bx,by,bz,transmitted"),
        ("1,2,3,4\n", "the first row is '1,2,3,4'"),
        ("bx,by,bz\n", "the first row is 'bx,by,bz'"),
        ("id,by,bx,bz\n", "the first row is 'id,by,bx,bz'"),
        ("id,bx,by,bz\n1,2,3,4\n2,3,4\n3,x,1,2\n", "2 wrong rows, the first is line 3, '2,3,4'; accepted: 4 numbers"),
        ("id,bx,by,bz\n1,2,3,4,1\n", "1 wrong rows, the first is line 2"),
        ("id,bx,by,bz\n1,,,\n", "1 wrong rows"),
        ("id,bx,by,bz\n1.5,2,3,4\n", "1 ids are not whole numbers below 2^53, the first is 1.5"),
        (
            "id,bx,by,bz\nnan,2,3,4\ninf,2,3,4\n1e300,2,3,4\n",
            "3 ids are not whole numbers below 2^53, the first is nan",
        ),
        ("id,bx,by,bz,transmitted\n1,2,3,4,2\n2,2,3,4,nan\n", "transmitted is 2.0 for 2 rays; accepted: 0 or 1"),
        (b"\xff\xfe\x00id", "not text; accepted: CSV in UTF-8"),
    ],
)
def test_invalid_csv(text, message):
    with pytest.raises(ValueError) as caught:
        answers(text)
    assert str(caught.value).startswith("answers.csv: ")
    assert message in str(caught.value)


def test_answers_in_any_format(tmp_path):
    ids, b, flags = np.arange(5), np.arange(15.0).reshape(5, 3), np.array([1, 0, 1, 1, 0])
    np.savez(tmp_path / "a.npz", id=ids, b=b, transmitted=flags)
    pixels = np.zeros((2, 4, 5), np.float32)
    pixels[..., 0] = -1
    pixels.reshape(8, 5)[:5] = np.column_stack([ids, b, flags])
    image_file.write_exr(tmp_path / "a.exr", pixels, (*files.ANSWER_COLUMNS, files.TRANSMITTED))
    for ending in ("npz", "exr"):
        found = files.read_answers(tmp_path / f"a.{ending}")
        np.testing.assert_array_equal(found.ids, ids)
        np.testing.assert_array_equal(found.b, b)
        np.testing.assert_array_equal(found.transmitted, flags == 1)
    image_file.write_exr(tmp_path / "a.exr", pixels[..., :4], files.ANSWER_COLUMNS)
    assert files.read_answers(tmp_path / "a.exr").transmitted is None


def test_an_image_leaves_out_only_pixels_that_are_marked_empty(tmp_path):
    """By −1: what else is no id is not left out in silence."""
    pixels = np.zeros((1, 4, 4), np.float32)
    pixels[0, :, 0] = 0, -2, 2, -1
    image_file.write_exr(tmp_path / "a.exr", pixels, files.ANSWER_COLUMNS)
    assert files.read_answers(tmp_path / "a.exr").ids.tolist() == [0, -2, 2]
    pixels[0, 1, 0] = np.nan
    image_file.write_exr(tmp_path / "a.exr", pixels, files.ANSWER_COLUMNS)
    with pytest.raises(ValueError, match=r"a\.exr: "):
        files.read_answers(tmp_path / "a.exr")


IDS = np.arange(2)


@pytest.mark.parametrize("arrays", [{"id": IDS}, {"b": np.zeros((2, 3))}, {"id": IDS, "b": np.zeros(3)}])
def test_invalid_npz(tmp_path, arrays):
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(ValueError, match=r"a\.npz: .*accepted: an \.npz file with id, b"):
        files.read_answers(tmp_path / "a.npz")


@pytest.mark.parametrize(("megabytes", "accepted"), [(12, True), (20, False)])
def test_what_else_is_in_an_npz_may_have_16_megabytes(tmp_path, megabytes, accepted):
    """Beside twice the bytes of the numbers: the file is not read where it is larger."""
    np.savez(tmp_path / "a.npz", id=IDS, b=np.zeros((2, 3)), more=np.zeros(megabytes << 20, np.uint8))
    if accepted:
        assert len(files.read_answers(tmp_path / "a.npz", most=2).ids) == 2
    else:
        with pytest.raises(ValueError, match=r"a\.npz: .* bytes; accepted"):
            files.read_answers(tmp_path / "a.npz", most=2)


@pytest.mark.parametrize(("version", "accepted"), [((1, 0), True), ((2, 0), True), ((3, 0), False)])
def test_versions_of_numpys_format(tmp_path, version, accepted):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        for name, array in (("id", IDS), ("b", np.ones((2, 3)))):
            with archive.open(f"{name}.npy", "w") as file:
                np.lib.format.write_array(file, array, version)
    if accepted:
        np.testing.assert_array_equal(files.read_answers(tmp_path / "a.npz").b, np.ones((2, 3)))
    else:
        with pytest.raises(ValueError, match=r"id is in version \(3, 0\) of NumPy's format; accepted"):
            files.read_answers(tmp_path / "a.npz")


def test_the_numbers_of_the_largest_set_take_2_gib():
    assert files.MOST_RAYS * len(files.COLUMNS) * 8 <= 2**31 < (files.MOST_RAYS + 1) * len(files.COLUMNS) * 8


def test_a_pickle_is_not_opened(tmp_path):
    np.savez(tmp_path / "a.npz", id=np.arange(2), b=np.array([print, None], dtype=object))
    with pytest.raises(ValueError, match=r"a\.npz: .*accepted"):
        files.read_answers(tmp_path / "a.npz")

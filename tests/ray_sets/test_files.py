"""Files of rays and of answers: nothing is lost, and what was edited, damaged or forged is one line of error."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import subprocess
import sys
import time
import tracemalloc
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from support.processes import ENVIRONMENT

from mi_refract.io import image_file
from mi_refract.ray_sets import check_answers, files, ray_set, reports
from mi_refract.ray_sets.ray_set import Answers, RaySet

FORMATS = [("f32", "csv"), ("f32", "npz"), ("f32", "exr"), ("f64", "csv"), ("f64", "npz")]
SMALL = {"names": ("generic", "k ≪ 1", "k ≫ 1", "denormal"), "count": 300, "seed": 5}
IDS = np.arange(2)


def refused(path, message, read=files.read):
    """Assert that the error is one line that names the file."""
    with pytest.raises(ValueError) as caught, np.errstate(all="ignore"):
        read(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ") and message in text and "\n" not in text and len(text) < 600


# Rays


@pytest.mark.parametrize("precision, ending", FORMATS)
def test_every_bit_returns(tmp_path, precision, ending):
    made = ray_set.make(**SMALL, precision=precision)
    path = files.write(tmp_path / f"rays.{ending}", made)
    found = files.read(path)
    for name in "ank":
        one, other = getattr(found.rays, name), getattr(made.rays, name)
        assert (one.tobytes(), one.dtype) == (other.tobytes(), other.dtype)
    assert (found.header, list(found.regime), found.ids.tolist()) == (made.header, list(made.regime), list(range(1200)))
    denormal = made.rays.n[made.regime == "denormal"]
    assert (np.signbit(denormal) & (denormal == 0)).any()
    assert ((denormal != 0) & (np.abs(denormal) < np.finfo(denormal.dtype).tiny)).any()
    again, other = (ray_set.make(**SMALL | {"seed": seed}, precision=precision) for seed in (5, 6))
    assert files.write(tmp_path / f"again.{ending}", again).read_bytes() == path.read_bytes()
    assert files.write(tmp_path / f"other.{ending}", other).read_bytes() != path.read_bytes()


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_numbers_read_in_either_precision_are_the_rays(precision):
    """A reader in float64 and one in float32 both have the very number; no reader loses anything of k."""
    made = ray_set.make(**SMALL, precision=precision)
    rows = [line.split(",") for line in files.as_csv(made).splitlines() if not line.startswith("#")]
    assert tuple(rows[0]) == files.COLUMNS
    text, vectors = np.array(rows[1:]), np.hstack([made.rays.a, made.rays.n])
    for dtype in (np.float64, made.rays.a.dtype):
        np.testing.assert_array_equal(text[:, 1:7].astype(dtype), vectors)
    n_from, n_to = text[:, 7:].astype(made.rays.k.dtype).T
    np.testing.assert_array_equal(n_from / n_to, made.rays.k)
    assert min(n_from.min(), n_to.min()) >= 1


@pytest.mark.parametrize("name", ["rays.txt", "rays", "none/rays.csv"])
def test_paths_that_cannot_be_written(tmp_path, name):
    with pytest.raises((ValueError, OSError)):
        files.write(tmp_path / name, ray_set.make(("generic",), 2))
    assert not list(tmp_path.iterdir())


class Large(RaySet):
    """One ray more than float32 has ids for."""

    def __len__(self):
        return files.MOST_EXR_RAYS + 1


def test_sets_that_exr_cannot_hold(tmp_path):
    two = ray_set.make(("generic",), 2)
    for rays, words in (
        (ray_set.make(("generic",), 2, "f64"), "2 rays in f64"),
        (Large(two.rays, two.ids, two.header), "16777217 rays in f32"),
    ):
        with pytest.raises(ValueError, match=f"{words}; EXR holds f32 only, and up to 16777216 rays$"):
            files.write(tmp_path / "rays.exr", rays)


def without(word):
    return lambda text: "\n".join(line for line in text.split("\n") if not line.startswith(word))


EDITS = {
    "a digit": (lambda text: text.replace("0.3", "0.4", 1), "the checksum does not match"),
    "a row less": (lambda text: text.rstrip("\n").rpartition("\n")[0] + "\n", "the file has 99"),
    "two rows swapped": (
        lambda text: text.replace("\n3,", "\n99,").replace("\n4,", "\n3,").replace("\n99,", "\n4,"),
        "the checksum does not match",
    ),
    "a regime's ids": (lambda text: text.replace("[0, 49]", "[0, 59]"), "'generic' has the ids [0, 59]; expected"),
    "another seed": (lambda text: text.replace("# seed: 0", "# seed: 1"), "the checksum does not match"),
    "no checksum": (without("# checksum"), "header: object missing required field `checksum`"),
    "no header": (without("#"), "not a file of rays"),
    "other columns": (lambda text: text.replace("n_from,n_to", "n_to,n_from"), "the first row is 'id,ax"),
    "a word": (lambda text: text.replace("\n7,", "\n7,x"), "expected 9 numbers"),
    "nothing left": (lambda text: "", "the table is empty"),
}


@pytest.mark.parametrize("edit, message", EDITS.values(), ids=EDITS)
def test_an_edited_file_is_refused(tmp_path, edit, message):
    text = files.as_csv(ray_set.make(["generic", "critical"], 50, "f64"))
    assert edit(text) != text
    (tmp_path / "rays.csv").write_text(edit(text))
    refused(tmp_path / "rays.csv", message)


@pytest.mark.parametrize("ending", ["csv", "npz", "exr"])
@pytest.mark.parametrize("keep", [0, 0.3, 0.9])
def test_a_truncated_file_is_refused(tmp_path, ending, keep):
    path = files.write(tmp_path / f"rays.{ending}", ray_set.make(count=200))
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    with pytest.raises((ValueError, OSError), match=path.name) as caught:
        files.read(path)
    assert "\n" not in str(caught.value)


def test_another_image_is_refused(tmp_path):
    image_file.write_exr(tmp_path / "a.exr", np.zeros((2, 2, 3)))
    refused(tmp_path / "a.exr", "no channel 'id'")
    image_file.write_exr(tmp_path / "a.exr", np.zeros((2, 2, 9)), files.COLUMNS)
    refused(tmp_path / "a.exr", "not a file of rays")


# Headers and rays that somebody forged, with a checksum that fits


FOUR = ray_set.make(["generic", "critical"], 2)


def forged(rays, **changes):
    """The set with another header, without what is None there, and with a checksum that fits."""
    header = {key: value for key, value in (rays.header | changes).items() if value is not None}
    return ray_set.with_checksum(RaySet(rays.rays, rays.ids, header))


def text_of(rays):
    """As `files.as_csv`, of any header."""
    lines = [f"# {key}: {json.dumps(value)}" for key, value in rays.header.items()]
    return "\n".join([*lines, *(x for x in files.as_csv(FOUR).split("\n") if not x.startswith("#"))])


HEADERS = {
    "three rays unjudged": ({"regimes": {"generic": [0, 0]}, "count": 1}, "declares 1 × 1 rays, the file has 4"),
    "a gap": ({"regimes": {"generic": [0, 0], "critical": [2, 3]}}, "'generic' has the ids [0, 0]; expected [0, 1]"),
    "two at once": ({"regimes": {"generic": [0, 1], "critical": [1, 2]}}, "'critical' has the ids [1, 2]"),
    "no regime": ({"regimes": {}}, "the header declares 0 × 2 rays"),
    "numbers as text": ({"regimes": {"generic": ["0", "1"]}}, "header: regimes"),
    "a count that is too large": ({"count": 10**12}, "the header declares 2 × 1000000000000 rays, the file has 4"),
    "a count without an end": ({"count": 10**400}, "header: count"),
    "a count that is true": ({"count": True}, "header: count: expected `int`, got `bool`"),
    "another precision": ({"precision": "f16"}, "header: precision: invalid enum value 'f16'"),
    "NaN": ({"two_sided": float("nan")}, "header: two_sided: expected a finite number"),
    "more": ({"another": 1}, "header: unknown key `another`"),
    "a long text": ({"version": "x" * 201}, "header: version: expected `str` of length <= 200"),
}


@pytest.mark.parametrize("changes, message", HEADERS.values(), ids=HEADERS)
def test_a_header_that_is_not_ours_is_refused(tmp_path, changes, message):
    path = tmp_path / "rays.csv"
    path.write_text(text_of(forged(FOUR, seed=9)))
    assert files.read(path).header["seed"] == 9  # so the others are refused for what they say
    path.write_text(text_of(forged(FOUR, **changes)))
    refused(path, message)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda some: st.lists(some, max_size=3) | st.dictionaries(st.text(max_size=5), some, max_size=3),
    max_leaves=6,
)
KEYS = [*FOUR.header, "media", "wavelengths", "wavelength, medium"]


@pytest.fixture(scope="module")
def header_path(tmp_path_factory):
    return tmp_path_factory.mktemp("headers") / "rays.npz"


@given(changes=st.dictionaries(st.sampled_from(KEYS) | st.text(max_size=3), JSON, min_size=1, max_size=3))
def test_any_header_is_read_as_it_is_or_refused_in_one_line(header_path, changes):
    header = FOUR.header | changes
    arrays = {
        "id": FOUR.ids,
        "a": FOUR.rays.a,
        "n": FOUR.rays.n,
        **dict(zip(("n_from", "n_to"), FOUR.numbers[:, 7:9].T, strict=True)),
    }
    np.savez(header_path, **arrays, header=np.array(json.dumps(header)))
    try:
        assert files.read(header_path).header == FOUR.header  # with another, the checksum does not fit
    except ValueError as error:
        assert str(error).startswith(f"{header_path}: ") and "\n" not in str(error) and len(str(error)) < 600


@pytest.mark.parametrize("ending", ["csv", "npz", "exr"])
@pytest.mark.parametrize("text", ["[" * 100_000, "1" * 10_000, '{"format": NaN}', "7"])
def test_json_of_any_depth(tmp_path, ending, text):
    path, columns = tmp_path / f"rays.{ending}", FOUR.numbers
    if ending == "csv":
        path.write_text(files.as_csv(FOUR).replace('{"generic"', text + '{"generic"'))
    elif ending == "npz":
        arrays = dict(zip(("id", "a", "n", "n_from", "n_to"), np.split(columns, [1, 4, 7, 8], 1), strict=True))
        np.savez(path, **arrays, header=np.array(text))
    else:
        image_file.write_exr(path, columns[None], files.COLUMNS, {"mi_refract:rays": text})
    refused(path, "header: regimes: expected" if ending == "csv" else "not a file of rays")


@pytest.mark.parametrize("name", "ank")
@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, -1.5])
def test_rays_without_refraction_are_refused(tmp_path, name, value):
    changed, path = getattr(FOUR.rays, name).copy(), tmp_path / "rays.npz"
    changed[2] = value
    with np.errstate(all="ignore"):
        files.write(path, forged(RaySet(dataclasses.replace(FOUR.rays, **{name: changed}), FOUR.ids, FOUR.header)))
    if name != "k" and value == -1.5:  # a vector of any length is one
        assert len(files.read(path)) == 4
    else:  # NaN is equal to nothing
        invalid = "ray 2 is invalid: zero or non-finite vector, or index ≤ 0"
        refused(path, "checksum does not match" if np.isnan(value) else invalid)


def test_markup_and_escapes_in_a_regime_stay_text(tmp_path):
    """Rich would read [bold] and fail on [/]; a terminal would obey an escape."""
    name = "[/] [bold]x[link=http://a] \x1b[2J\u202e"
    one = ray_set.make(["generic"], 20)
    files.write(tmp_path / "rays.npz", forged(one, regimes={name: [0, 19]}))
    found = check_answers.check(files.read(tmp_path / "rays.npz"), Answers(one.ids, one.rays.a.astype(float)))
    stream = io.StringIO()
    Console(file=stream, width=1000, force_terminal=True, color_system=None).print(reports.table(found))
    assert "[/] [bold]x[link=http://a]" in stream.getvalue()
    assert "\x1b[2J" not in stream.getvalue() and "\u202e" not in stream.getvalue()


# Answers


def test_answers_as_people_write_them():
    text = "\ufeff# seed: 3\r\n# by: us\r\n\r\nid, bx, by, bz, transmitted\r\n# a remark\r\n4, 1, 2.5e-3, -0, 1\r\n"
    text += "2,nan,-nan(ind),-NaN(0x7ff),0\r\n  \n\r\n0 ,inf,-INF,+1.5,1 # right\r\n"
    for found in (files.parse_answers(text[1:]), files.parse_answers(text.encode())):
        assert found.header == {"seed": 3, "by": "us"}
        assert found.ids.tolist() == [4, 2, 0]
        np.testing.assert_array_equal(found.b, [[1, 2.5e-3, 0], [np.nan] * 3, [np.inf, -np.inf, 1.5]])
        assert found.transmitted.tolist() == [True, False, True]
    assert files.parse_answers("id,bx,by,bz\n1,2,3,4").transmitted is None
    assert files.parse_answers("id,bx,by,bz\n").b.shape == (0, 3)


TOP = "id,bx,by,bz\n"
LAYOUTS = " or ".join(f"id,bx,by,bz{more}" for more in ("", ",transmitted", ",n_ratio", ",transmitted,n_ratio"))
RATIO = "n_ratio is {} for 1 rays; expected n_from / n_to, 1e-09 … 1e+09"
TABLES = {
    "no names": ("1,2,3,4\n", "the first row is '1,2,3,4'"),
    "another order": ("id,bx,by,bz,n_ratio,transmitted\n", "the first row is 'id,bx,by,bz,n_ratio,transmitted'"),
    "a short row": (f"# x\n{TOP}\n1,2,3,4\n2,3,4\n3,x,1,2\n", "line 5 is '2,3,4'; expected 4 numbers"),
    "long rows": (TOP + "1,2,3,4,1\n", "line 2 is '1,2,3,4,1'; expected 4 numbers"),
    "hexadecimal": (TOP + "1,0x1p0,2,3\n", "line 2 is '1,0x1p0,2,3'"),
    "a fraction": (TOP + "1.5,2,3,4\n", "1 ids are not whole numbers below 2^53, the first is 1.5"),
    "ids": (TOP + "nan,2,3,4\ninf,2,3,4\n1e300,2,3,4\n", "3 ids are not whole numbers below 2^53, the first is nan"),
    "flags": ("id,bx,by,bz,transmitted\n1,2,3,4,2\n2,2,3,4,nan\n", "transmitted is 2.0 for 2 rays; expected 0 or 1"),
    "no text": (b"\xff\xfe\x00id", "not text; expected CSV in UTF-8"),
    "no text below": (TOP.encode() + b"1,2,3,4\n\xff,2,3,4\n", "not text; expected CSV in UTF-8"),
    "a line without end": (TOP + "1" * 2_000_000, "line 2 is longer than 1048576 characters"),
} | {
    f"a ratio of {x}": (f"id,bx,by,bz,n_ratio\n0,0,0,1,1.5\n1,0,0,1,{x}\n", RATIO.format(f"{float(x):g}"))
    for x in ("nan", "inf", "0", "-1.5", "1e-10", "1e10")
}  # fmt: skip


@pytest.mark.parametrize("text, message", TABLES.values(), ids=TABLES)
def test_tables_that_are_refused(tmp_path, text, message):
    with pytest.raises(ValueError) as caught:
        files.parse_answers(text, "answers.csv")
    assert str(caught.value).startswith("answers.csv: ") and message in str(caught.value)
    (tmp_path / "a.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    refused(tmp_path / "a.csv", message, files.read_answers)


def test_a_line_of_nan_takes_no_time():
    start = time.process_time()
    with pytest.raises(ValueError, match="line 2 is '1,nan"):
        files.parse_answers(TOP + "1," + "nan(" * 200_000 + "\n")
    assert time.process_time() - start < 2  # a quadratic search takes minutes


def saved(path, ids, b, **columns):
    """A file of answers in the format of the path's ending."""
    numbers = np.column_stack([ids, b, *columns.values()]).astype(float)
    names = (*files.ANSWER_COLUMNS, *columns)
    if path.suffix == ".npz":
        np.savez(path, id=ids, b=b, **columns)
    elif path.suffix == ".exr":
        image_file.write_exr(path, numbers[None].astype(np.float32), names)
    else:
        path.write_text("\n".join([",".join(names), *(",".join(map(repr, row)) for row in numbers.tolist()), ""]))
    return path


@pytest.mark.parametrize("names", [(), ("transmitted",), ("n_ratio",), ("transmitted", "n_ratio")])
@pytest.mark.parametrize("ending", ["csv", "npz", "exr"])
def test_answers_in_any_format_with_any_columns(tmp_path, ending, names):
    ids, b, more = (
        np.array([3, 0, 4, 1, 2]),
        np.arange(15.0).reshape(5, 3),
        {"transmitted": [1, 0, 1, 1, 0], "n_ratio": [0.5, 1, 2, 4, 8]},
    )
    found = files.read_answers(
        saved(tmp_path / f"a.{ending}", ids, b, **{name: np.array(more[name]) for name in names})
    )
    np.testing.assert_array_equal(found.ids, ids)
    np.testing.assert_array_equal(found.b, b)
    for name in more:
        column = getattr(found, name)
        assert (column is not None) == (name in names) and (column is None or column.tolist() == more[name])


def test_arrays_of_other_kinds_are_read(tmp_path):
    b = np.arange(15.0).reshape(5, 3)
    np.savez_compressed(tmp_path / "c.npz", id=np.arange(5)[:, None], b=np.asfortranarray(b.astype(np.longdouble)))
    np.testing.assert_array_equal(files.read_answers(tmp_path / "c.npz").b, b)


def test_an_image_leaves_out_only_pixels_that_are_marked_empty(tmp_path):
    """By −1: what else is no id is not left out in silence."""
    path = tmp_path / "a.exr"
    saved(path, np.array([0, -2, 2, -1]), np.zeros((4, 3)))
    assert files.read_answers(path).ids.tolist() == [0, -2, 2]
    saved(path, np.array([0, np.nan, 2, -1]), np.zeros((4, 3)))
    refused(path, "1 ids are not whole numbers", files.read_answers)


@pytest.mark.parametrize("ending", ["csv", "npz", "exr"])
def test_more_answers_than_rays_need(tmp_path, ending):
    path = saved(tmp_path / f"a.{ending}", np.ones(11), np.ones((11, 3)))
    assert len(files.read_answers(path, most=11).ids) == 11
    refused(path, "10", lambda path: files.read_answers(path, most=10))
    os.truncate(path, 2**40)
    if ending != "exr":
        refused(path, "1099511627776 bytes", files.read_answers)


def test_what_is_not_a_file(tmp_path):
    (tmp_path / "a.csv").mkdir()
    for name in ("a.csv", "b.npz"):
        with pytest.raises(OSError) as caught:
            files.read_answers(tmp_path / name)
        assert str(caught.value.filename) == str(tmp_path / name)
    os.mkfifo(tmp_path / "c.csv")
    (tmp_path / "d.npz").symlink_to("/dev/zero")
    for name in ("c.csv", "d.npz"):
        refused(tmp_path / name, "not a regular file", files.read_answers)
    refused(tmp_path / "e.txt", "expected a file name that ends in .csv or .npz or .exr", files.read_answers)


def test_rays_are_read_without_the_oracle():
    code = "import sys; sys.modules['flint'] = None; import mi_refract.ray_sets.files"
    subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, check=True)


# NumPy's archives


def npz(path, method=zipfile.ZIP_DEFLATED, **members):
    """Two answers, with other members: arrays, or bytes as they are."""
    np.savez(
        path, **{"id": IDS, "b": np.zeros((2, 3))} | {k: v for k, v in members.items() if not isinstance(v, bytes)}
    )
    with zipfile.ZipFile(path) as old:
        arrays = {name.removesuffix(".npy"): old.read(name) for name in old.namelist()}
    with zipfile.ZipFile(path, "w", method) as new:
        for name, content in (arrays | {k: v for k, v in members.items() if isinstance(v, bytes)}).items():
            new.writestr(f"{name}.npy", content)
    return path


def npy(shape, dtype="<f8", content=b""):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": dtype, "fortran_order": False, "shape": shape})
    return stream.getvalue() + content


B = "an .npz file with id, b"
MEMBERS = {
    "complex": (np.zeros((2, 3), complex), "b holds complex128, not real numbers"),
    "objects": (np.array([print, None], dtype=object), "Object arrays cannot be loaded"),
    "a row more": (np.zeros((3, 3)), "id has 2 rows, b has 3 rows"),
    "wide": (np.zeros((2, 4)), "b has the shape (2, 4)"),
    "a scalar": (np.zeros(()), "b has the shape ()"),
    "more than it has": (npy((10**12, 3)), B),
    "a negative length": (npy((-2, 3), content=bytes(48)), B),
    "less than it has": (npy((2, 3), content=bytes(4800)), "b is longer than its shape, (2, 3)"),
    "no array": (b"hello", B),
    "nothing": (b"", B),
    "a header of gigabytes": (b"\x93NUMPY\x02\x00\xff\xff\xff\xff" + b"(" * 20_000_000, B),
    "a deep header": (b"\x93NUMPY\x01\x00\x00\x20" + b"(" * 0x2000, B),
    "a pickle": (npy((2, 3), "|O", b"cos\nsystem\n(S'true'\ntR."), B),
}


@pytest.mark.parametrize("b, message", MEMBERS.values(), ids=MEMBERS)
def test_arrays_that_are_no_answers(tmp_path, b, message):
    refused(npz(tmp_path / "a.npz", b=b), message, files.read_answers)


def test_archives_that_are_no_answers(tmp_path):
    path = tmp_path / "a.npz"
    for header, message in ((np.array("x" * 2**19), "header has 2097280 bytes"), (np.zeros(3), "header is float64")):
        refused(npz(path, header=header), message, files.read_answers)
    np.savez(path, id=IDS)
    refused(path, "there is no b; expected an .npz file with id, b", files.read_answers)
    refused(npz(path, zipfile.ZIP_BZIP2), "id is compressed by method 12", files.read_answers)
    data = bytearray(npz(path).read_bytes())
    for signature, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        at = -1
        while (at := data.find(signature, at + 1)) >= 0:
            data[at + offset] |= 1
    path.write_bytes(data)
    refused(path, "is encrypted", files.read_answers)


def test_a_bomb_is_not_unpacked(tmp_path):
    """40 million rows of zeros in less than 1 MB, in an array that is asked for and in one that is not."""
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as new:
        for name in ("id", "else"):
            with new.open(f"{name}.npy", "w") as stream:
                stream.write(npy((40_000_000,), "|u1"))
                for _ in range(40):
                    stream.write(bytes(1_000_000))
        new.writestr("b.npy", npy((2, 3), content=bytes(48)))
    tracemalloc.start()
    refused(path, "id has 40000128 bytes, more than", lambda path: files.read_answers(path, most=1000))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4e6


def test_a_damaged_archive_is_one_line(tmp_path):
    """Every third byte changed in turn, of a small archive: an answer or one line, never another exception."""
    path = npz(tmp_path / "a.npz")
    data, refusals = path.read_bytes(), 0
    for at in range(0, len(data), 3):
        path.write_bytes(data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :])
        try:
            files.read_answers(path)
        except (ValueError, OSError) as error:
            refusals += 1
            assert "\n" not in str(error)
    assert refusals > len(data) / 6


def test_the_last_bit_of_an_array_is_checked(tmp_path):
    path = files.write(tmp_path / "rays.npz", ray_set.make(("generic",), 3000))
    with zipfile.ZipFile(path) as archive:
        info = archive.getinfo("n_to.npy")
    data = bytearray(path.read_bytes())
    data[data.find(b"\x93NUMPY", info.header_offset) + info.file_size - 1] ^= 1
    path.write_bytes(data)
    refused(path, "Bad CRC-32 for file 'n_to.npy'")


def test_what_else_is_in_an_npz_may_have_16_megabytes(tmp_path):
    """Beside twice the bytes of the numbers: the file is not read where it is larger."""
    path = npz(tmp_path / "a.npz", zipfile.ZIP_STORED, more=bytes(12 << 20))
    assert len(files.read_answers(path, most=2).ids) == 2
    npz(path, zipfile.ZIP_STORED, more=bytes(20 << 20))
    refused(path, "bytes", lambda path: files.read_answers(path, most=2))

"""Files that somebody made to deceive or to harm: one line, and nothing is believed or unpacked."""

from __future__ import annotations

import io
import json
import os
import time
import tracemalloc
import zipfile

import numpy as np
import pytest

from mi_refract.io import image_file
from mi_refract.ray_sets import check_answers, files, header, npz_arrays, ray_set, reports
from mi_refract.ray_sets.ray_set import Answers, RaySet
from mi_refract.regimes import Rays

DEEP = "[" * 100_000


@pytest.fixture(scope="module")
def four():
    return ray_set.make(["generic", "critical"], 2)


def forged(rays, **changes):
    """The set with another header, without what is None there, and with a checksum that fits."""
    bare = {key: value for key, value in rays.header.items() if key != "checksum"}
    header = {key: value for key, value in (bare | changes).items() if value is not None}
    made = RaySet(rays.rays, rays.ids, rays.regime, header)
    return RaySet(rays.rays, rays.ids, rays.regime, {"checksum": ray_set.checksum(made)} | header)


STORED = {files.read: files.read_stored, files.read_answers: lambda path: files.read_stored_answers(path, range(10))}


def refused(path, message, read=files.read):
    if read in STORED and "up to" not in message:
        with pytest.raises(ValueError) as stored, np.errstate(all="ignore"):
            STORED[read](path)
        with pytest.raises(ValueError) as whole, np.errstate(all="ignore"):
            read(path)
        ours, theirs = (str(each.value).partition("; accepted: up to")[0] for each in (stored, whole))
        assert ours == theirs
    with pytest.raises(ValueError) as caught:
        read(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ") and "accepted" in text and "\n" not in text and len(text) < 600
    assert message in text


# Headers

HEADERS = {
    "three rays unjudged": (
        {"regimes": {"generic": [0, 0]}, "count": 1},
        "the header is of 1 × 1 rays, the file has 4",
    ),
    "a gap": ({"regimes": {"generic": [0, 0], "critical": [2, 3]}}, "regime 'generic' has the ids [0, 0]"),
    "two at once": ({"regimes": {"generic": [0, 1], "critical": [1, 2]}}, "regime 'critical' has the ids [1, 2]"),
    "backward": ({"regimes": {"generic": [2, 3], "critical": [0, 1]}}, "regime 'generic' has the ids [2, 3]"),
    "negative": ({"regimes": {"generic": [0, 1], "critical": [-2, -1]}}, "the header's regimes is"),
    "no regime": ({"regimes": {}}, "the header is of 0 × 2 rays"),
    "a list": ({"regimes": [["generic", [0, 3]]]}, "the header's regimes is"),
    "numbers as text": ({"regimes": {"generic": ["0", "1"]}}, "the header's regimes is"),
    "a long name": ({"regimes": {"x" * 10_000: [0, 1], "critical": [2, 3]}}, "the header's regimes is"),
    "a count that is too large": ({"count": 10**12}, "the header is of 2 × 1000000000000 rays, the file has 4"),
    "a count without an end": ({"count": 10**400}, "the header's count is 1000"),
    "a count that is true": ({"count": True}, "the header's count is True"),
    "no seed": ({"seed": None}, "the header has no seed"),
    "a seed that is text": ({"seed": "0"}, "the header's seed is '0'"),
    "no precision": ({"precision": None}, "the header has no precision"),
    "a precision that is a list": ({"precision": ["f32"]}, "the header's precision is ['f32']"),
    "another precision": ({"precision": "f16"}, "the header's precision is 'f16'"),
    "NaN": ({"two_sided": float("nan")}, "the header's two_sided is nan"),
    "a checksum that is a number": ({"checksum": 7}, "the header's checksum is 7"),
    "more": ({"another": 1}, "the header has 'another'"),
}


@pytest.mark.parametrize("changes, message", HEADERS.values(), ids=HEADERS)
def test_a_header_that_is_not_ours_is_refused(tmp_path, four, changes, message):
    path = tmp_path / "rays.csv"
    path.write_text(_text(forged(four, **changes)))
    refused(path, message)


def _text(rays):
    """As `files.as_csv`, of any precision that the header claims."""
    lines = [f"# {key}: {json.dumps(value)}" for key, value in rays.header.items() if value is not None]
    return "\n".join([*lines, files.as_csv(rays).partition(f"{rays.header['checksum']}\n")[2]])


def test_the_ids_of_a_regime_that_would_be_accepted_are_named():
    ours = ray_set.make(["generic", "critical", "Brewster"], 3).header
    with pytest.raises(ValueError, match=r"'critical' has the ids \[3, 6\]; accepted: \[3, 5\]$"):
        header.check(ours | {"regimes": ours["regimes"] | {"critical": [3, 6]}}, 9)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("x" * 58, f"'{'x' * 58}'"),
        ("x" * 59, f"'{'x' * 59}…"),
        (["é"], r"['\xe9']"),
        (10**5000, "int"),
        (json.loads("[" * 900 + "]" * 900), "[" * 60 + "…"),
    ],
    ids=["60", "61", "accent", "digits", "deep"],
)
def test_a_value_is_shown_in_60_characters_of_ascii(value, text):
    assert header.shown(value) == text


def test_a_forged_header_that_is_ours_is_read(tmp_path, four):
    """So the cases above are refused for what they say they are."""
    files.write(tmp_path / "rays.csv", forged(four, seed=9))
    assert files.read(tmp_path / "rays.csv").header["seed"] == 9
    (tmp_path / "rays.csv").write_text(_text(forged(four, seed=9)))
    assert files.read(tmp_path / "rays.csv").header["seed"] == 9


@pytest.mark.parametrize("ending", ["csv", "npz", "exr"])
@pytest.mark.parametrize("text", [DEEP, "1" * 10_000, '{"format": NaN}', "7", "null"])
def test_json_of_any_depth(tmp_path, four, ending, text):
    path = tmp_path / f"rays.{ending}"
    columns = four.numbers
    if ending == "csv":
        path.write_text(files.as_csv(four).replace('{"generic"', text + '{"generic"'))
    elif ending == "npz":
        split = {
            "id": four.ids,
            "a": columns[:, 1:4],
            "n": columns[:, 4:7],
            "n_from": columns[:, 7],
            "n_to": columns[:, 8],
        }
        np.savez(path, **split, header=np.array(text))
    else:
        image_file.write_exr(path, columns[None], files.COLUMNS, {"mi_refract:rays": text})
    refused(path, "the header's regimes is" if ending == "csv" else "not a file of rays")


@pytest.mark.parametrize("column", [1, 4, 7, 8])
@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0])
def test_rays_without_refraction_are_refused(tmp_path, four, column, value):
    numbers = four.numbers
    numbers[2, column : column + 3 if column < 7 else column + 1] = value
    with np.errstate(all="ignore"):
        rays = files._ray_set(four.header, numbers)
        if column < 7:  # the checksum of other indices is that of what they become
            files.write(tmp_path / "rays.npz", forged(rays))
            refused(tmp_path / "rays.npz", "checksum does not match" if np.isnan(value) else "ray 2 is none")
        else:
            split = {"id": four.ids, "a": numbers[:, 1:4], "n": numbers[:, 4:7], "n_from": numbers[:, 7]}
            np.savez(tmp_path / "rays.npz", **split, n_to=numbers[:, 8], header=json.dumps(forged(rays).header))
            refused(tmp_path / "rays.npz", "accepted")


@pytest.mark.parametrize("k", [0.0, -0.5, -1.5, np.inf])
def test_an_index_that_is_not_above_0_is_refused(tmp_path, four, k):
    ratios = np.append(four.rays.k[:3], four.rays.k.dtype.type(k))
    rays = forged(RaySet(Rays(four.rays.a, four.rays.n, ratios), four.ids, four.regime, four.header))
    with np.errstate(invalid="ignore"):
        files.write(tmp_path / "rays.npz", rays)
        refused(tmp_path / "rays.npz", "ray 3 is none" if np.isfinite(k) else "accepted")


# Text


def test_a_line_of_nan_takes_no_time():
    text = "id,bx,by,bz\n1," + "nan(" * 200_000 + "\n"
    start = time.process_time()
    with pytest.raises(ValueError, match="1 wrong rows, the first is line 2"):
        files.parse_answers(text)
    assert time.process_time() - start < 2  # a quadratic search takes minutes
    assert np.isnan(files.parse_answers("id,bx,by,bz\n1,nan(ind),-NaN(0x7ff),nan()").b).all()


@pytest.mark.parametrize("row", ["1,1_0,2,3", "1,١,2,3", "1,0x1p0,2,3"])
def test_numbers_of_python_alone_are_a_wrong_row(row):
    with pytest.raises(ValueError, match="1 wrong rows, the first is line 2"):
        files.parse_answers(f"id,bx,by,bz\n{row}\n")


def test_markup_and_escapes_in_a_regime_stay_text(tmp_path):
    """Rich would read [bold] and fail on [/]; a terminal would obey an escape."""
    name = "[/] [bold]x[link=http://a] \x1b[2J\u202e"
    one = ray_set.make(["generic"], 20)
    regime = np.full(20, name, dtype=object)
    rays = forged(RaySet(one.rays, one.ids, regime, one.header), regimes={name: [0, 19]})
    files.write(tmp_path / "rays.npz", rays)
    found = check_answers.check(files.read(tmp_path / "rays.npz"), Answers(one.ids, one.rays.a.astype(float)))
    from rich.console import Console

    stream = io.StringIO()
    Console(file=stream, width=1000, force_terminal=True, color_system=None).print(reports.table(found))
    said = stream.getvalue()
    assert "[/] [bold]x[link=http://a]" in said
    assert "\x1b[2J" not in said and "\u202e" not in said


# NumPy's archives


def archive(path, *, b=None, **more):
    np.savez(path, id=np.arange(2), b=np.zeros((2, 3)) if b is None else b, **more)


def rewritten(path, change):
    """The archive with `change(name, bytes of the member)`."""
    with zipfile.ZipFile(path) as old:
        members = {info.filename: old.read(info) for info in old.infolist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for name, content in members.items():
            new.writestr(name, change(name, content))


def npy(shape, dtype="<f8", content=b""):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": dtype, "fortran_order": False, "shape": shape})
    return stream.getvalue() + content


ARRAYS = {
    "complex": (np.zeros((2, 3), complex), "b holds complex128, not real numbers"),
    "text": (np.full((2, 3), "1"), "b holds <U1, not real numbers"),
    "dates": (np.zeros((2, 3), "datetime64[s]"), "not real numbers"),
    "records": (np.zeros((2, 3), [("x", float)]), "not real numbers"),
    "a row more": (np.zeros((3, 3)), "b has the shape (3, 3) for 2 rows"),
    "flat": (np.zeros(6), "b has the shape (6,)"),
    "a scalar": (np.zeros(()), "b has the shape ()"),
}


@pytest.mark.parametrize("b, message", ARRAYS.values(), ids=ARRAYS)
def test_arrays_that_are_no_answers(tmp_path, b, message):
    archive(tmp_path / "a.npz", b=b)
    refused(tmp_path / "a.npz", message, files.read_answers)


MEMBERS = {
    "more than it has": npy((10**12, 3)),
    "a negative length": npy((-2, 3), content=bytes(48)),
    "two negative lengths": npy((-2, -3), content=bytes(48)),
    "less than it has": npy((2, 3), content=bytes(4800)),
    "no array": b"hello",
    "nothing": b"",
    "a later version": b"\x93NUMPY\x09\x00" + bytes(100),
    "a header of gigabytes": b"\x93NUMPY\x02\x00\xff\xff\xff\xff" + b"(" * 20_000_000,
    "a deep header": b"\x93NUMPY\x01\x00\x00\x20" + b"(" * 0x2000,
    "a pickle": npy((2, 3), "|O", b"cos\nsystem\n(S'true'\ntR."),
}


@pytest.mark.parametrize("content", MEMBERS.values(), ids=MEMBERS)
def test_members_that_do_not_hold_what_they_say(tmp_path, content):
    archive(tmp_path / "a.npz")
    rewritten(tmp_path / "a.npz", lambda name, old: content if name == "b.npy" else old)
    refused(tmp_path / "a.npz", "an .npz file with id, b", files.read_answers)


def test_an_encrypted_member(tmp_path):
    path = tmp_path / "a.npz"
    archive(path)
    data = bytearray(path.read_bytes())
    for signature, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        at = -1
        while (at := data.find(signature, at + 1)) >= 0:
            data[at + offset] |= 1
    path.write_bytes(data)
    refused(path, "id is encrypted", files.read_answers)


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
    refused(path, "40000000 rows; accepted: up to 1000", lambda path: files.read_answers(path, most=1000))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4e6


def test_a_damaged_archive_is_one_line(tmp_path):
    """Every byte changed in turn, of a small archive: an answer or one line, never another exception."""
    path = tmp_path / "a.npz"
    np.savez_compressed(path, id=np.arange(2), b=np.zeros((2, 3)))
    data = path.read_bytes()
    for at in range(0, len(data), 3):
        path.write_bytes(data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :])
        try:
            files.read_answers(path)
        except (ValueError, OSError) as error:
            assert "\n" not in str(error)


# Sizes


def test_more_answers_than_rays_need(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("id,bx,by,bz\n" + "1,2,3,4\n" * 11)
    assert len(files.read_answers(path, most=11).ids) == 11
    refused(path, "11 rows; accepted: up to 10", lambda path: files.read_answers(path, most=10))
    os.truncate(path, 2**40)
    refused(path, "1099511627776 bytes; accepted", files.read_answers)


def test_a_folder_and_a_missing_file(tmp_path):
    (tmp_path / "a.csv").mkdir()
    for name in ("a.csv", "b.npz"):
        with pytest.raises(OSError) as caught:
            files.read_answers(tmp_path / name)
        assert caught.value.filename == str(tmp_path / name) or caught.value.filename == tmp_path / name


def test_a_pipe_is_refused(tmp_path):
    os.mkfifo(tmp_path / "a.csv")
    (tmp_path / "b.npz").symlink_to("/dev/zero")
    for name in ("a.csv", "b.npz"):
        refused(tmp_path / name, "is a pipe or a device; accepted: a file", files.read_answers)


def test_a_header_that_is_too_long(tmp_path):
    np.savez(tmp_path / "a.npz", x=np.zeros(3), header=np.array("x" * 2**19))  # of 4 bytes each
    with pytest.raises(ValueError, match="header is <U524288"):
        npz_arrays.read(tmp_path / "a.npz", {"x": 1}, (), 10)


def test_a_file_as_large_as_its_numbers_may_be(tmp_path, monkeypatch):
    """16 bytes a number are let pass: those of a `longdouble`."""
    monkeypatch.setattr(npz_arrays, "_SPARE", 1000)
    np.savez(tmp_path / "a.npz", x=np.zeros((1000, 3)))
    assert npz_arrays.read(tmp_path / "a.npz", {"x": 3}, (), 1000)[1].shape == (1000, 3)

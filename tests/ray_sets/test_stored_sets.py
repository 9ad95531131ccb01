"""Sets outside of the memory: a piece at a time, they are read, refused and judged as arrays are."""

from __future__ import annotations

import dataclasses
import itertools
import json
import pickle
import subprocess
import sys
import zipfile

import numpy as np
import pytest
from support.memory import peak
from support.processes import ENVIRONMENT

from mi_refract import oracle
from mi_refract.io import image_file, scratch
from mi_refract.ray_sets import (
    check_answers,
    csv_table,
    files,
    judged_parts,
    kept_errors,
    npz_arrays,
    pieces,
    ray_set,
    reports,
    stored_answers,
    stored_rays,
)
from mi_refract.ray_sets.evidence import AllEvidence, Evidence
from mi_refract.ray_sets.ray_set import Answers
from mi_refract.report.row import strict

NAMES, COUNT = ("critical", "k ≫ 1", "generic"), 67
TOTAL = len(NAMES) * COUNT
STEPS = (7, 64, 200)  # of 201 rays: the last piece has 5, 9 and 1


@pytest.fixture(params=STEPS)
def step(request, monkeypatch):
    """Everything is read, matched and judged in pieces of so many rows, and nothing stays in memory."""
    return in_pieces(monkeypatch, request.param)


def in_pieces(monkeypatch, step):
    for module, name in (
        (pieces, "PIECE"),
        (pieces, "BLOCK"),
        (stored_answers, "BLOCK"),
        (stored_answers, "_STEP"),
        (stored_answers, "_DISTINCT"),
        (stored_rays, "STEP"),
        (files, "STEP"),
        (npz_arrays, "_STEP"),
        (csv_table, "_LINES"),
        (csv_table, "_BYTES"),
        (kept_errors, "_LEAF"),
    ):
        monkeypatch.setattr(module, name, max(step, 128) if name == "_LEAF" else step)
    monkeypatch.setattr(scratch, "IN_MEMORY", 0)
    return step


@pytest.fixture(scope="module")
def rays():
    return ray_set.make(NAMES, COUNT)


@pytest.fixture(scope="module")
def right(rays):
    exact = oracle.refract(rays.rays.a, rays.rays.n, rays.rays.k, fresnel=False, progress=False)
    return np.where(exact.transmitted[:, None], exact.direction, 0).astype(np.float32)


def packed(path, ids, b, flags=None, header="", save=np.savez):
    more = {} if flags is None else {"transmitted": flags}
    save(path, id=ids, b=b, **more, header=np.array(header))


def written(folder, kind, ids, b, flags=None):
    """The path of a file of answers."""
    path = folder / f"answers.{kind.rpartition(' ')[2]}"
    columns = [ids, b] if flags is None else [ids, b, flags]
    numbers = np.column_stack(columns).astype(float)
    if kind == "csv":
        rows = [",".join(map(repr, row)) for row in numbers.tolist()]
        path.write_bytes(
            "\r\n".join(["# by: us", "id,bx,by,bz" + ",transmitted" * (flags is not None), *rows]).encode()
        )
    elif kind == "exr":
        names = (*files.ANSWER_COLUMNS, *((files.TRANSMITTED,) if flags is not None else ()))
        image_file.write_exr(path, numbers[None].astype(np.float32), names)
    else:
        save = np.savez_compressed if kind.startswith("compressed") else np.savez
        packed(path, ids, np.asfortranarray(b) if kind.startswith("by column") else b, flags, save=save)
    return path


def shown(rays, answers):
    return json.dumps(strict(reports.as_data(check_answers.check(rays, answers))))


def same(rays, folder, kind, ids, b, flags=None):
    """Assert that the findings of a file that is stored are those of arrays; these."""
    path = written(folder, kind, ids, b, flags)
    files.write(folder / "rays.npz", rays)
    whole = shown(rays, Answers(np.asarray(ids), np.asarray(b, float), None if flags is None else flags == 1))
    stored = files.read_stored(folder / "rays.npz")
    assert shown(stored, files.read_stored_answers(path, stored)) == whole
    return json.loads(whole)


ALL = np.arange(TOTAL)
CHANGES = {
    "right": (ALL, lambda b: b),
    "wrong, the last": (ALL, lambda b: np.where(ALL[:, None] == TOTAL - 1, [1.0, 0, 0], b)),
    "no direction, the last": (ALL, lambda b: np.where(ALL[:, None] == TOTAL - 1, np.inf, b)),
    "reversed": (ALL, lambda b: -b),
    "length": (ALL, lambda b: 1.01 * b),
    "few digits": (ALL, lambda b: np.round(b, 3)),
    "unclear": (ALL, lambda b: np.where(ALL[:, None] % 2 & ~b.any(1, keepdims=True), np.nan, b)),
    "in any order": (np.random.default_rng(1).permutation(ALL), lambda b: b),
    "the last is missing": (ALL[:-1], lambda b: -b),
    "most are missing": (ALL[5::11], lambda b: b),
    "a regime is missing": (ALL[COUNT:], lambda b: b),
    "others, too": (np.r_[ALL, -5, 10**12, TOTAL, -5, 2**52, 7, 7, 200], lambda b: b),
    "all missing": (ALL[:0], lambda b: b),
}


@pytest.mark.parametrize("change", CHANGES)
def test_findings_are_those_of_arrays(tmp_path, rays, right, change, step):
    ids, made = CHANGES[change]
    found = same(rays, tmp_path, "npz", ids, made(right)[ids.clip(0, TOTAL - 1) % TOTAL])
    assert found["exit_code"] == {"right": 0, "in any order": 0}.get(change, 2 if len(ids) != TOTAL else 1)


@pytest.mark.parametrize("kind", ["compressed npz", "by column npz", "csv", "exr"])
@pytest.mark.parametrize("flagged", [False, True])
def test_findings_are_those_of_arrays_in_every_format(tmp_path, rays, right, kind, flagged, step):
    flags = right.any(1).astype(int) if flagged else None
    assert same(rays, tmp_path, kind, ALL, right, flags)["exit_code"] == 0


@pytest.mark.parametrize("ending", ["csv", "npz", "exr"])
def test_the_rays_are_those_of_arrays(tmp_path, ending, step):
    made = ray_set.make(NAMES, COUNT, "f32", 3, two_sided=True)
    stored = files.read_stored(files.write(tmp_path / f"rays.{ending}", made))
    for found in (stored, stored_rays.make(NAMES, COUNT, "f32", 3, two_sided=True)):
        assert (found.header, len(found), found.precision) == (made.header, TOTAL, "f32")
        given = found.read(0, TOTAL)
        assert [getattr(given, name).tobytes() for name in "ank"] == [
            getattr(made.rays, name).tobytes() for name in "ank"
        ]
        assert [x.dtype for x in (given.a, given.n, given.k)] == [np.float32] * 3


def test_more_than_a_double_holds(tmp_path):
    made = ray_set.make(NAMES, COUNT, "f64")
    given = files.read_stored(files.write(tmp_path / "rays.npz", made)).take(np.array([200, 3]))
    assert given.a.tobytes() == made.rays.a[[200, 3]].tobytes() and given.k.dtype == np.float64


# What is wrong in the last piece


def edited(path, change):
    numbers = np.load(path)
    arrays = {name: numbers[name].copy() for name in numbers.files}
    change(arrays)
    np.savez(path, **arrays)


def cut(path):
    path.write_bytes(path.read_bytes()[:-300])


def damaged(path, name):
    """The last byte of a member is another one."""
    with zipfile.ZipFile(path) as archive:
        info = archive.getinfo(name)
    data = bytearray(path.read_bytes())
    data[data.find(b"\x93NUMPY", info.header_offset) + info.file_size - 1] ^= 1
    path.write_bytes(data)


RAYS = {
    "a component": (lambda path: edited(path, lambda x: x["n"].__setitem__((-1, 2), 0.5)), "checksum does not match"),
    "an id": (lambda path: edited(path, lambda x: x["id"].__setitem__(-1, 7)), "checksum does not match"),
    "the first id": (lambda path: edited(path, lambda x: x["id"].__setitem__(0, 7)), "checksum does not match"),
    "a bit": (lambda path: damaged(path, "n_to.npy"), "Bad CRC-32 for file 'n_to.npy'"),
    "the end": (cut, "not a zip file"),
}


@pytest.mark.parametrize("change, message", RAYS.values(), ids=RAYS)
def test_rays_whose_last_is_wrong(tmp_path, rays, change, message, step):
    path = files.write(tmp_path / "rays.npz", rays)
    change(path)
    said = []
    for read in (files.read, files.read_stored):
        with pytest.raises(ValueError) as caught:
            read(path)
        said.append(str(caught.value))
    assert said[0] == said[1] and message in said[0]


def test_damage_comes_before_a_missing_header(tmp_path):
    path = files.write(tmp_path / "rays.npz", ray_set.make(("generic",), 3000))
    edited(path, lambda arrays: arrays.pop("header"))
    damaged(path, "n_to.npy")
    for read in (files.read, files.read_stored):
        with pytest.raises(ValueError, match=r"Bad CRC-32 for file 'n_to\.npy'"):
            read(path)


def test_a_last_ray_that_is_none(tmp_path, rays, step):
    a = rays.rays.a.copy()
    a[-1] = 0
    bare = ray_set.RaySet(ray_set.Rays(a, rays.rays.n, rays.rays.k), rays.ids, rays.regime, rays.header)
    path = files.write(tmp_path / "rays.npz", ray_set._with_checksum(bare))
    with pytest.raises(ValueError, match=f"ray {TOTAL - 1} is none; accepted"):
        files.read_stored(path)


ANSWERS = {
    "an id": ({"id": 1.5}, "1 ids are not whole numbers below 2^53, the first is 1.5"),
    "NaN": ({"id": np.nan, "transmitted": 3}, "1 ids are not whole numbers below 2^53, the first is nan"),
    "a flag": ({"transmitted": 2}, "transmitted is 2.0 for 1 rays; accepted: 0 or 1"),
}


@pytest.mark.parametrize("kind", ["npz", "compressed npz", "csv"])
@pytest.mark.parametrize("change, message", ANSWERS.values(), ids=ANSWERS)
def test_answers_whose_last_is_wrong(tmp_path, rays, right, kind, change, message, step):
    ids, flags = ALL.astype(float), np.ones(TOTAL)
    ids[-1], flags[-1] = change.get("id", TOTAL - 1), change.get("transmitted", 1)
    path = written(tmp_path, kind, ids, right, flags)
    said = []
    for read in (files.read_answers, lambda path: files.read_stored_answers(path, rays)):
        with pytest.raises(ValueError) as caught:
            read(path)
        said.append(str(caught.value))
    assert said[0] == said[1] == f"{path}: {message}" + "; accepted: the ids of the rays" * ("id" in change)


@pytest.mark.parametrize(
    "change, message",
    [
        (
            lambda text: text + b"\r\n1,2,3\r\n",
            "1 wrong rows, the first is line 204, '1,2,3'; accepted: 4 numbers a row",
        ),
        (
            lambda text: text.replace(b"\r\n3.0,", b"\r\n3.0,x,") + b"\r\n1,2",
            "2 wrong rows, the first is line 6, '3.0,x",
        ),
        (lambda text: text + b"\xff", "not text; accepted: CSV in UTF-8"),
        (lambda text: text.replace(b"by,", b"") + b"\r\n\xff", "not text; accepted: CSV in UTF-8"),
        (lambda text: text.replace(b"by,", b""), "the first row is 'id,bx,bz'"),
        (lambda text: text[:3], "the table is empty"),
        (lambda text: text + 400 * b"\r\n1,2,3,4", "601 rows; accepted: up to 502"),
    ],
)
def test_a_table_whose_last_is_wrong(tmp_path, rays, right, change, message, step):
    path = written(tmp_path, "csv", ALL, right)
    path.write_bytes(change(path.read_bytes()))
    said = []
    for read in (
        lambda path: files.read_answers(path, most=files.most_answers(rays)),
        lambda path: files.read_stored_answers(path, rays),
    ):
        with pytest.raises(ValueError) as caught:
            read(path)
        said.append(str(caught.value))
    assert said[0] == said[1] and message in said[0]


# Ids


@pytest.mark.parametrize("seed", range(20))
def test_ids_that_match_no_ray_are_those_of_arrays(seed, monkeypatch):
    rng = np.random.default_rng(seed)
    step = in_pieces(monkeypatch, int(rng.integers(1, 30)))
    total = int(rng.integers(1, 60))
    ids = rng.integers(-9 if seed % 2 else 0, total + 9, int(rng.integers(0, 130)))
    b, flags = rng.normal(size=(len(ids), 3)), rng.integers(0, 2, len(ids)) == 1
    ratios = rng.uniform(0.5, 2, len(ids))
    columns = (ids, b, flags, ratios)
    rows = (tuple(each[i : i + step] for each in columns) for i in range(0, len(ids), step))
    found = stored_answers.match({}, rows, total, True, True)
    to = ray_set.make(("generic",), total)
    mismatches, order = check_answers._match_ids(to, Answers(ids, b, flags))
    assert found.mismatches == mismatches
    np.testing.assert_array_equal(found.which(0, total), order >= 0)
    taken = np.flatnonzero(order >= 0)
    given, flag, ratio = found.take(taken)
    np.testing.assert_array_equal(ratio, ratios[order[taken]])
    np.testing.assert_array_equal(given, b[order[taken]])
    np.testing.assert_array_equal(flag, flags[order[taken]])
    assert found.answered.sum() == len(taken)


# Lines, angles, memory


@pytest.mark.parametrize("seed", range(20))
def test_lines_are_those_of_the_whole_text(seed):
    rng = np.random.default_rng(seed)
    text = "".join(rng.choice(list("ab\r\n\n\x0b\x85\u2028"), int(rng.integers(0, 200))))
    cuts = [0, *sorted(rng.integers(0, len(text) + 1, 9)), len(text)]
    parts = [text[i:j] for i, j in itertools.pairwise(cuts)]
    assert [line for each in csv_table.whole_lines(parts) for line in each.splitlines()] == text.splitlines()


def test_a_line_without_end_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(csv_table, "LONGEST", 1000)
    path = tmp_path / "a.csv"
    path.write_text("id,bx,by,bz\n" + "1" * 10_000_000)
    with pytest.raises(ValueError, match=r"a\.csv: a line has more than 1000 characters; accepted"):
        files.read_stored_answers(path, range(10**5))


@pytest.mark.parametrize("in_memory", [0, 2**24])
@pytest.mark.parametrize("count", [1, 2, 7, 8, 127, 129, 1000, 2**17, 2**17 + 9, 500_003])
def test_means_quantiles_and_medians_are_those_of_numpy(count, in_memory, monkeypatch):
    monkeypatch.setattr(scratch, "IN_MEMORY", in_memory)
    rng = np.random.default_rng(count)
    x = rng.random(count) * 10.0 ** rng.integers(-20, 1, count) * (rng.random(count) > 0.2)
    step = max(5, count // 30)
    kept = kept_errors.KeptErrors(count)
    numbers = range(-(-count // step))
    for number in reversed(numbers):
        kept.put(number, x[number * step : (number + 1) * step])
    found = kept.of(numbers)
    assert (found.largest, found.mean) == (x.max(), x.mean())
    assert [found.quantile(share) for share in (0, 0.3, 0.99, 1)] == [np.quantile(x, s) for s in (0, 0.3, 0.99, 1)]
    assert kept_errors.median(found.pieces) == np.median(x)


@pytest.mark.parametrize("seed", range(20))
def test_sums_are_cut_where_numpy_cuts_them(seed, monkeypatch):
    monkeypatch.setattr(kept_errors, "_LEAF", 128)
    rng = np.random.default_rng(seed)
    x = rng.random(int(rng.integers(129, 9000)))
    kept = kept_errors.KeptErrors(len(x))
    kept.put(0, x)
    assert kept.of([0]).mean == x.mean()


@pytest.mark.parametrize("seed", range(20))
def test_a_sample_is_evenly_over_all_parts(seed):
    rng = np.random.default_rng(seed)
    masks = [rng.random(int(rng.integers(0, 40))) < rng.random() for _ in range(9)]
    parts = [
        Evidence(len(mask), packed, packed, packed, packed, 0, {}) for mask in masks for packed in [np.packbits(mask)]
    ]
    index = np.flatnonzero(np.concatenate(masks))
    for count in (1, 7, 150):
        found = AllEvidence(parts, kept_errors.KeptErrors(1).of([])).evenly("right", count)
        assert found.tolist() == index[:: max(1, -(-len(index) // count))].tolist()


def test_no_angle_and_no_number():
    kept = kept_errors.KeptErrors(3)
    kept.put(0, np.array([1.0, np.nan, 2.0]))
    kept.put(1, np.empty(0))
    for found in (kept.of([0]), kept.of([1]), kept.of([])):
        values = found.largest, found.mean, found.quantile(0.99), kept_errors.median(found.pieces)
        assert np.isnan(values).all()


def stub(calls):
    """Judges that take no time: every answer is the first."""
    first = None
    for number, (piece, question) in enumerate(calls):
        first = first or judged_parts.judge_part(piece, question)
        yield number, dataclasses.replace(first, angles=np.zeros(len(piece.ids) * 20)[::20])


@pytest.mark.parametrize("ending", ["npz", "csv"])
def test_the_memory_does_not_grow_with_the_set(tmp_path, monkeypatch, ending):
    in_pieces(monkeypatch, 500)
    monkeypatch.setattr(csv_table, "_BYTES", 2**14)
    monkeypatch.setattr(stored_answers, "_DISTINCT", 2**22)
    monkeypatch.setattr(check_answers, "SEEN", 500)
    monkeypatch.setattr(scratch.tempfile, "SpooledTemporaryFile", lambda size: scratch.tempfile.TemporaryFile())
    peaks = []
    for count in (4000, 32_000):
        path = tmp_path / f"rays-{count}.{ending}"
        made = ray_set.make(("generic",), count)
        files.write(path, made)
        np.savez(tmp_path / "answers.npz", id=made.ids[::-1], b=made.rays.a)

        def work(path=path):
            stored = files.read_stored(path)
            given = files.read_stored_answers(tmp_path / "answers.npz", stored)
            check_answers.check(stored, given, judge=stub)

        del made
        peaks.append(peak(work))
    assert peaks[1] < 1.2 * peaks[0] < 8e6


def test_what_is_kept_of_a_ray_is_a_byte(rays, right):
    piece = judged_parts.Piece("generic", rays.rays, rays.ids, right.astype(float), None)
    many = np.arange(judged_parts.PIECE) % COUNT
    piece = judged_parts.Piece("generic", rays.rays[many], many, right[many].astype(float), None)
    part = judged_parts.judge_part(piece, judged_parts.Question("f32", "promoted", "auto", counted=True))
    assert len(pickle.dumps(part.without_errors())) < judged_parts.PIECE
    assert files.MOST_STORED <= 2**30


MAPPED = """
import numpy as np, resource
from mi_refract.io import scratch
table = scratch.Table((50_000_000,), float)
for start in range(0, len(table), 1_000_000):
    table.write(start, np.full(1_000_000, 2.0))
rows = np.arange(0, len(table), 1000)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
table.put(rows, 1 + table.take(rows))
assert table.take(rows).min() == 3
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="kibibytes there")
def test_scattered_rows_do_not_bring_the_table_into_the_memory():
    """400 MB, of which every page is near one that is asked for."""
    found = subprocess.run([sys.executable, "-c", MAPPED], env=ENVIRONMENT, check=True, capture_output=True, text=True)
    assert int(found.stdout) < 150 * 1024


def test_a_full_disk_is_one_line(monkeypatch):
    monkeypatch.setattr(scratch, "IN_MEMORY", 0)

    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(scratch.os, "posix_fallocate", full, raising=False)
    with pytest.raises(OSError, match=r"^/.*: no room for 2400 bytes: No space left on device; accepted: .* TMPDIR$"):
        scratch.Table((100, 3), float)


def test_where_nothing_is_reserved_zeros_are_written(monkeypatch):
    monkeypatch.setattr(scratch, "IN_MEMORY", 0)
    monkeypatch.delattr(scratch.os, "posix_fallocate", raising=False)
    table = scratch.Table((300_000,), float)
    table.put(np.array([5, 299_999]), np.array([2.0, 3.0]))
    assert table.read(0, len(table)).sum() == 5 and table.take(np.array([5]))[0] == 2


def test_rays_are_read_without_the_oracle():
    code = "import sys; sys.modules['flint'] = None; import mi_refract.ray_sets.files"
    subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, check=True)

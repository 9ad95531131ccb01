"""Ray sets and their files are exact and reproducible; edited, damaged or forged files give an error of one line."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import itertools
import json
import os
import subprocess
import sys
import time
import tracemalloc
import zipfile

import numpy as np
import pytest
from support.media_rays import ALL, CROWN, FLINT, MEDIA, WATER, WAVELENGTHS
from support.processes import ENVIRONMENT
from support.ray_programs import BAD
from support.readme import DOCS, python_blocks

from mi_refract import media, regimes
from mi_refract.numerics import float_expansions
from mi_refract.ray_sets import check_answers, files, header, ray_set
from mi_refract.ray_sets.ray_set import RaySet
from mi_refract.regimes import Rays

PAGE = DOCS / "how-to/check-a-shaders-rays.md"
FORMATS = list(itertools.product(ray_set.PRECISIONS, ("csv", "npz")))
SMALL = {"names": ("generic", "k ≪ 1", "k ≫ 1", "denormal"), "count": 300, "seed": 5}
AIR = dataclasses.replace(media.parse(1.0), relative_to="air")


def assert_refused(path, message, read=files.read):
    """Assert that reading fails with an error of one line that names the file."""
    with pytest.raises(ValueError) as caught, np.errstate(all="ignore"):
        read(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ") and message in text and "\n" not in text and len(text) < 800


# Rays ----------------------------------------------------------------------------------------------------------------


def test_sets_contain_the_rays_of_the_regimes_and_normals_face_them():
    two_regimes = ray_set.make(["Brewster", "grazing"], 50, "f64", 3, two_sided=True)
    assert two_regimes.header["regimes"] == {"Brewster": [0, 49], "grazing": [50, 99]}
    expected, grazing = regimes.make("grazing", 50, np.float64, 3), two_regimes.rays[two_regimes.regime == "grazing"]
    for name in "ank":
        np.testing.assert_array_equal(getattr(grazing, name), getattr(expected, name))
    for options in ({"names": ("generic", "grazing", "on a denormal", "tangential")}, {"count": 200, **ALL}):
        either, facing = (ray_set.make(**{"count": 50} | options, two_sided=x).rays for x in (True, False))
        side = [float_expansions.dot(r.n.T.astype(float), r.a.T.astype(float))[0] for r in (either, facing)]
        assert (side[0] > 0).any() and (side[1] <= 0).all()
        np.testing.assert_array_equal(np.abs(facing.n), np.abs(either.n))
        np.testing.assert_array_equal(facing.a, either.a)


def test_the_program_of_the_page_is_right_and_its_table_lists_every_mistake(tmp_path):
    (tmp_path / "my_tracer.py").write_text(python_blocks(PAGE)[0])
    rays = ray_set.make(count=50)
    answers = files.answers_of([sys.executable, str(tmp_path / "my_tracer.py")], rays)
    assert check_answers.check(rays, answers).exit_code == 0
    mistakes = [*BAD, "f32 where f64 was claimed", "too few digits"]
    assert all(f"| {mistake} |" in PAGE.read_text("utf-8") for mistake in mistakes)


@pytest.mark.parametrize("precision, ending", FORMATS)
@pytest.mark.parametrize("options", [SMALL, {"names": ("generic", "critical"), "count": 40, "seed": 5, **ALL}])
def test_files_keep_every_bit(tmp_path, precision, ending, options):
    """Readers of CSV in float64 and in the set's precision both get the exact numbers, and the exact k."""
    rays = ray_set.make(**options, precision=precision)
    path = files.write(tmp_path / f"rays.{ending}", rays)
    rays_read = files.read(path)
    for name in "ank":
        values, expected = getattr(rays_read.rays, name), getattr(rays.rays, name)
        assert (values.tobytes(), values.dtype) == (expected.tobytes(), expected.dtype)
    found = rays_read.header, list(rays_read.regime), rays_read.ids.tolist()
    assert found == (rays.header, list(rays.regime), list(range(len(rays))))
    np.testing.assert_array_equal(rays_read.numbers, rays.numbers)
    for seed in (5, 6):
        path2 = files.write(tmp_path / f"again.{ending}", ray_set.make(**options | {"seed": seed}, precision=precision))
        assert (path2.read_bytes() == path.read_bytes()) == (seed == 5)
    if ending == "csv":
        rows = [line.split(",") for line in path.read_text().splitlines() if not line.startswith("#")]
        text = np.array(rows[1:])
        for dtype in (np.float64, rays.rays.a.dtype):
            np.testing.assert_array_equal(text[:, 1:7].astype(dtype), np.hstack([rays.rays.a, rays.rays.n]))
        n_from, n_to = text[:, 7:9].astype(rays.rays.k.dtype).T
        np.testing.assert_array_equal(n_from / n_to, rays.rays.k)
        assert min(n_from.min(), n_to.min()) >= 1
    if options is SMALL:
        denormal = rays.rays.n[rays.regime == "denormal"]
        assert (np.signbit(denormal) & (denormal == 0)).any()
        assert ((denormal != 0) & (np.abs(denormal) < np.finfo(denormal.dtype).tiny)).any()


# Of a set written out in the test: random rays may differ in the last bit of NumPy's functions.
CHECKSUM = "sha256:e12027e60442a09b7176e9ca4925ed2885a1a663c062d16d2b3e4a925c4284ad"
WRITTEN = {
    "csv": "7436b4d65d4057d13c466b85879e7eca53dc17bd28eccd58730d5611c645ded2",
    "npz": "3fada76bec7c8781235839662b5fb0ada2c9754795b4c98a364eccf2557d42a5",
}


@pytest.mark.parametrize("ending", WRITTEN)
def test_files_do_not_change_between_versions(tmp_path, ending):
    a, n = np.array([[0.6, 0, 0.8], [0, -1, 0]]), np.array([[0, 0, -1.0], [0, 1, 0]])
    rays = Rays(*(x.astype(np.float32) for x in (a, n, np.array([0.6666667, 1.5]))))
    top = ray_set.make(["generic"], 2).header | {"version": "0"}
    rays_set = ray_set.with_checksum(RaySet(rays, np.arange(2), top))
    assert rays_set.header["checksum"] == CHECKSUM
    path = files.write(tmp_path / f"rays.{ending}", rays_set)
    assert hashlib.sha256(path.read_bytes()).hexdigest() == WRITTEN[ending]


@pytest.mark.parametrize("name", ["rays.txt", "rays", "none/rays.csv", "rays.exr"])
def test_paths_that_cannot_be_written(tmp_path, name):
    with pytest.raises((ValueError, OSError)):
        files.write(tmp_path / name, ray_set.make(("generic",), 2))
    assert not list(tmp_path.iterdir())


# Media ---------------------------------------------------------------------------------------------------------------


def medium_of_ray(rays, row):
    """(from, to, wavelength) of a ray, as a reader of the file gets them."""
    wavelength, pair = rays.numbers[row, 9:]
    return (*rays.header["media"][int(pair)], wavelength)


@pytest.mark.parametrize("precision", ray_set.PRECISIONS)
@pytest.mark.parametrize("name", header.TAKE_RATIOS)
def test_k_is_the_ratio_of_the_media_in_every_combination(name, precision):
    rays, dtype = ray_set.make([name], 12, precision, **ALL), ray_set.PRECISIONS[precision]
    for row in range(len(rays)):
        left, entered, wavelength = medium_of_ray(rays, row)
        pair = [AIR if medium == "air" else media.parse(medium) for medium in (left, entered)]
        assert rays.rays.k[row] == dtype(media.relative_index(*pair, wavelength))
    sides = [(medium, "air") for medium in MEDIA] + ([("air", x) for x in MEDIA] if name != "critical" else [])
    expected = {(*side, dtype(wavelength)) for side, wavelength in itertools.product(sides, WAVELENGTHS)}
    assert {medium_of_ray(rays, row) for row in range(12)} == expected
    if name not in ("critical", "Brewster"):  # their angles depend on the medium
        with_media, without = (ray_set.make([name], 24, "f64", 7, two_sided=True, **x).rays for x in (ALL, {}))
        np.testing.assert_array_equal(with_media.a, without.a)
        np.testing.assert_array_equal(with_media.n, without.n)
        assert (with_media.k != without.k).any()


def test_columns_defaults_and_descriptions(tmp_path):
    thin = ray_set.make(["critical"], 4, media=("0.9",), wavelengths=(500.0,))  # total reflection occurs in the air
    assert {medium_of_ray(thin, row)[:2] for row in range(4)} == {("air", "0.9")}
    glasses = ray_set.make(["generic"], 12, "f64", **ALL)
    lines = files.as_csv(glasses).splitlines()
    top = lines.index("id,ax,ay,az,nx,ny,nz,n_from,n_to,wavelength,medium")
    order = itertools.product(range(2), ("486.1327", "587.5618"), range(3))
    assert [line.split(",")[-2:] for line in lines[top + 1 :]] == [[x, str(2 * i + turned)] for turned, x, i in order]
    with np.load(files.write(tmp_path / "rays.npz", ray_set.make(["generic"], 12, **ALL))) as arrays:
        assert (arrays["wavelength"].dtype, arrays["medium"].dtype) == (np.float32, np.int64)
        assert arrays["medium"].tolist() == [0, 2, 4] * 2 + [1, 3, 5] * 2
    assert header.described(glasses.header, 2) == f"{WATER} to air at 486.1327 nm"
    assert header.described(glasses.header, 10) == f"air to {FLINT} at 587.5618 nm"
    assert header.described(thin.header | {"x": 1}, 0) and header.described({}, 2) == ""
    names = ("generic", "near-normal", "grazing", "critical", "Brewster", "axes, signed zeros", "denormal")
    rays = ray_set.make(count=12, media=list(MEDIA), wavelengths=np.array(WAVELENGTHS))
    assert tuple(rays.header["regimes"]) == ray_set.default(MEDIA) == names
    assert rays.header == ray_set.make(count=12, **ALL).header
    specs = tuple(f"1.{i}" for i in range(10, 74))  # the largest number allowed
    rays = ray_set.make(["generic"], 2 * 64 * 64, media=specs, wavelengths=tuple(range(400, 464)))
    assert len(np.unique(rays.numbers[:, 9:], axis=0)) == len(rays)


def test_names_of_glasses_ignore_case_and_unknown_ones_get_suggestions():
    names = "schott:n-bk7", "SCHOTT:N-BK7"
    lower, upper = (ray_set.make(["generic"], 4, media=(x,), wavelengths=(587.5618,)) for x in names)
    assert lower.header == upper.header
    assert lower.header["media"] == [["SCHOTT:N-BK7", "air"], ["air", "SCHOTT:N-BK7"]]
    assert lower.rays.k[0] == pytest.approx(1.5168, abs=1e-5)
    code = ray_set.make(["generic"], 4, media=("517642",), wavelengths=(587.5618,))
    assert code.rays.k[0] == pytest.approx(1.517, rel=1e-6) and code.header["media"][0] == ["517642", "air"]
    with pytest.raises(ValueError, match=r"unknown glass; .*nearest: SCHOTT:N-BK7, \S+, \S+$"):
        ray_set.make(["generic"], media=("SCHOTT:N-BK8",), wavelengths=(500.0,))


INVALID = {
    "regime 'generc': unknown; expected 'generic'": {"names": ["generc"]},
    "precision 'f16': unknown; expected f32, f64": {"precision": "f16"},
    "0 rays of ['generic'], seed 0; expected at least one ray": {"count": 0},
    "1000 rays of [], seed 0; expected at least one ray": {"names": []},
    "each regime once": {"names": ["generic", "generic"]},
    "seed -1": {"seed": -1},
    "rays of each of 2 regimes; expected up to 29826161 rays": {"names": ["generic", "critical"], "count": 14913081},
    "3 media and 0 wavelengths; expected neither, or at least one of each": {**ALL, "wavelengths": ()},
    "0 media and 2 wavelengths; expected neither, or at least one of each": {**ALL, "media": ()},
    "2 times; expected each once": {**ALL, "media": (CROWN, FLINT, f" {CROWN}")},
    "are not all different in f32; expected each once": {**ALL, "wavelengths": (500.0, 500.000001)},
    "[1e-60] are not all different in f32": {**ALL, "wavelengths": [1e-60]},
    "wavelength nan; expected nm, a number above 0": {**ALL, "wavelengths": (float("nan"),)},
    "wavelength -1; expected nm, a number above 0": {**ALL, "wavelengths": (500.0, -1.0)},
    "wavelength inf; expected nm, a number above 0": {**ALL, "wavelengths": (float("inf"),)},
    "no index at 900 nm": {**ALL, "wavelengths": (500.0, 900.0)},
    "65 media and 2 wavelengths; expected up to 64": {**ALL, "media": tuple(f"1.{i}" for i in range(10, 75))},
    "3 media and 65 wavelengths; expected up to 64": {**ALL, "wavelengths": tuple(range(400, 465))},
    "medium 'bk7'; expected a number, cauchy(A, B, …)": {**ALL, "media": ("bk7",)},
    "medium 'xxx": {**ALL, "media": ("x" * 10_000,)},
    "cauchy(111": {**ALL, "media": (f"cauchy({'1' * 600})",)},
    "unknown material; nearest: MATERIAL:water": {**ALL, "media": ("MATERIAL:watr",)},
    "n = 1e+09 beside air at 486.13269 nm; expected 1e-06 … 1e+06": {**ALL, "media": ("1e9",)},
    "11 rays of each regime; expected 12 or more, one for each medium": {**ALL, "count": 11},
} | {
    f"regime {name!r} defines its own ratios of indices; with media, expected one of ": {
        **ALL,
        "names": ("generic", name),
    }
    for name in regimes.REGIMES
    if name not in header.TAKE_RATIOS
}


@pytest.mark.parametrize("message", INVALID)
def test_invalid_sets(message):
    with pytest.raises(ValueError) as caught:
        ray_set.make(**{"names": ("generic",), "count": 1000} | INVALID[message])
    text = str(caught.value)
    assert message in text and "\n" not in text and len(text) < 800


# Edited and forged files ---------------------------------------------------------------------------------------------

FOUR = ray_set.make(["generic", "critical"], 2)
WITH_MEDIA = ray_set.make(["generic"], 12, "f64", **ALL)


def without(*words):
    return lambda text: "\n".join(line for line in text.split("\n") if not line.startswith(words))


def replaced(*pairs):
    def edit(text):
        for old, new in pairs:
            text = text.replace(old, new, 1)
        return text

    return edit


PLAIN_TEXT, MEDIA_TEXT = files.as_csv(ray_set.make(["generic", "critical"], 50, "f64")), files.as_csv(WITH_MEDIA)
EDITS = {
    "a digit": (PLAIN_TEXT, replaced(("0.3", "0.4")), "the checksum does not match"),
    "a row less": (PLAIN_TEXT, lambda text: text.rstrip("\n").rpartition("\n")[0] + "\n", "the file has 99"),
    "rows swapped": (PLAIN_TEXT, replaced(("\n3,", "\n99,"), ("\n4,", "\n3,"), ("\n99,", "\n4,")), "the checksum does"),
    "a regime's ids": (PLAIN_TEXT, replaced(("[0, 49]", "[0, 59]")), "'generic' has the ids [0, 59]; expected"),
    "another seed": (PLAIN_TEXT, replaced(("# seed: 0", "# seed: 1")), "the checksum does not match"),
    "no checksum": (PLAIN_TEXT, without("# checksum"), "header: object missing required field `checksum`"),
    "no header": (PLAIN_TEXT, without("#"), "not a file of rays"),
    "other columns": (PLAIN_TEXT, replaced(("n_from,n_to", "n_to,n_from")), "the first row is 'id,ax"),
    "a word": (PLAIN_TEXT, replaced(("\n7,", "\n7,x")), "expected 9 numbers"),
    "nothing left": (PLAIN_TEXT, lambda text: "", "the table is empty"),
    "a wavelength": (MEDIA_TEXT, replaced((",486.1327,0\n", ",587.5618,0\n")), "the checksum does not match"),
    "a medium": (MEDIA_TEXT, replaced((",486.1327,0\n", ",486.1327,2\n")), "the checksum does not match"),
    "wavelengths turned": (MEDIA_TEXT, replaced(("[486.1327, 587.5618]", "[587.5618, 486.1327]")), "the checksum does"),
    "no media": (MEDIA_TEXT, without("# media", "# wavel"), "expected"),
    "one column": (MEDIA_TEXT, replaced((",medium\n", "\n")), "in this order: id,ax,ay,az,nx,ny,nz,n_from,n_to or id,"),
    "deep JSON": (PLAIN_TEXT, replaced(('{"generic"', "[" * 100_000 + '{"generic"')), "regimes: text; expected a"),
}


@pytest.mark.parametrize("text, edit, message", EDITS.values(), ids=EDITS)
def test_edited_files_are_refused(tmp_path, text, edit, message):
    assert edit(text) != text
    (tmp_path / "rays.csv").write_text(edit(text))
    assert_refused(tmp_path / "rays.csv", message)


@pytest.mark.parametrize("ending", ["csv", "npz"])
@pytest.mark.parametrize("keep", [0, 0.3, 0.9])
def test_a_truncated_file_is_refused(tmp_path, ending, keep):
    path = files.write(tmp_path / f"rays.{ending}", ray_set.make(count=200))
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    assert_refused(path, "expected")


def npz_of(path, rays, text):
    """The set in an .npz file, with this header."""
    columns = dict(zip(("id", "a", "n", "n_from", "n_to"), np.split(rays.numbers[:, :9], [1, 4, 7, 8], 1), strict=True))
    more = dict(zip(header.COLUMNS, rays.numbers[:, 9:].T, strict=False))
    np.savez(path, **columns, **more, header=np.array(text))
    return path


HEADERS = {
    "declares 1 × 1 rays, the file has 4": {"regimes": {"generic": [0, 0]}, "count": 1},
    "'generic' has the ids [0, 0]; expected [0, 1]": {"regimes": {"generic": [0, 0], "critical": [2, 3]}},
    "'critical' has the ids [1, 2]": {"regimes": {"generic": [0, 1], "critical": [1, 2]}},
    "the header declares 0 × 2 rays": {"regimes": {}},
    "header: regimes": {"regimes": {"generic": ["0", "1"]}},
    "the header declares 2 × 1000000000000 rays, the file has 4": {"count": 10**12},
    "header: count": {"count": 10**400},
    "header: count: true or false; expected a whole number": {"count": True},
    "header: precision: invalid enum value 'f16'": {"precision": "f16"},
    "header: two_sided: nan; expected a finite number": {"two_sided": float("nan")},
    "header: unknown key `another`": {"another": 1},
    "header: version: expected text of length <= 200": {"version": "x" * 201},
}
OF_MEDIA = {
    "header: no key `wavelengths`; expected all of `wavelength, medium`, `media`": {"wavelengths": None},
    "header: no key `media`": {"media": None},
    "header: no key `wavelength, medium`": {"wavelength, medium": None},
    "header: media: text; expected a list [ … ]": {"media": CROWN},
    "header: media: expected a list [ … ] of length >= 2": {"media": []},
    "header: media[0]: expected a list [ … ] of length 2": {"media": [[CROWN, "air", "air"], ["air", CROWN]]},
    "header: media[0][0]: a number; expected text": {"media": [[1.5, "air"], ["air", 1.5]]},
    "header: media: [[": {"media": [[CROWN, "air"], [FLINT, "air"]]},
    "2 times; expected each once": {"media": [[CROWN, "air"], ["air", CROWN]] * 2},
    "header: media: expected a list [ … ] of length <= 128": {"media": [["1.5", "air"], ["air", "1.5"]] * 5000},
    "header: media[0][0]: expected text of": {"media": [["1" * 10**5, "air"], ["air", "1" * 10**5]]},
    "unknown material; nearest": {"media": [["MATERIAL:ice", "air"], ["air", "MATERIAL:ice"]]},
    "header: media: [['1.50'": {"media": [["1.50", "air"], ["air", "1.50"]]},
    "medium '\\x1b'; expected": {"media": [["\x1b", "air"], ["air", "\n\x1b"]]},
    "header: wavelengths[0]: text; expected a number": {"wavelengths": ["500"]},
    "header: wavelengths[0]: nan; expected a finite number": {"wavelengths": [float("nan")]},
    "header: wavelengths[0]: expected a number < 1000000000": {"wavelengths": [1e300]},
    "no index at 900 nm": {"wavelengths": [486.1327, 900.0]},
    "are not all different in f64": {"wavelengths": [500.0, 500.0]},
    "12 rays of each regime; expected 54 or more": {"wavelengths": [400.0 + i for i in range(9)]},
    "defines its own ratios of indices; with media, expected one of": {"regimes": {"k ≫ 1": [0, 11]}},
}


@pytest.mark.parametrize(
    ("rays", "message", "changes"),
    [(rays, *case) for rays, table in ((FOUR, HEADERS), (WITH_MEDIA, OF_MEDIA)) for case in table.items()],
)
def test_forged_headers_are_refused(tmp_path, rays, message, changes):
    """In CSV with a checksum that matches, and in .npz; a valid header with a matching checksum is accepted."""
    top = {key: value for key, value in (rays.header | changes).items() if value is not None}
    forged = ray_set.with_checksum(dataclasses.replace(rays, header={**rays.header, "seed": 9}))
    assert files.read(files.write(tmp_path / "rays.csv", forged)).header["seed"] == 9
    checksum = ray_set.checksum(top, rays.numbers)
    lines = [f"# {key}: {json.dumps(value)}" for key, value in (top | {"checksum": checksum}).items()]
    rows = files.as_csv(rays).split("\n")[len(rays.header) :]
    (tmp_path / "rays.csv").write_text("\n".join([*lines, *rows]))
    assert_refused(tmp_path / "rays.csv", message)
    assert_refused(npz_of(tmp_path / "rays.npz", rays, json.dumps(top)), message)


@pytest.mark.parametrize("text", ["[" * 100_000, "1" * 10_000, '{"format": NaN}', "7"])
def test_array_headers_of_other_json_are_refused(tmp_path, text):
    assert_refused(npz_of(tmp_path / "rays.npz", FOUR, text), "not a file of rays")


@pytest.mark.parametrize("name", "ank")
@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, -1.5])
def test_rays_without_refraction_are_refused(tmp_path, name, value):
    changed, path = getattr(FOUR.rays, name).copy(), tmp_path / "rays.npz"
    changed[2] = value
    with np.errstate(all="ignore"):
        rays = dataclasses.replace(FOUR.rays, **{name: changed})
        files.write(path, ray_set.with_checksum(RaySet(rays, FOUR.ids, FOUR.header)))
    if name != "k" and value == -1.5:  # vectors may have any length
        assert len(files.read(path)) == 4
    else:  # NaN is not equal to itself, so the numbers do not match
        invalid = "ray 2 is invalid: zero or non-finite vector, or index ≤ 0"
        assert_refused(path, "checksum does not match" if np.isnan(value) else invalid)


@pytest.mark.parametrize("wrong, factor", [(7, 1 + 5e-6), (0, 1 + 3e-5), (7, 1 - 3e-5), (11, 1.5)])
def test_ratios_must_be_those_of_the_media(tmp_path, wrong, factor):
    """Also with a checksum that matches: else a program would be blamed for its index."""
    k = WITH_MEDIA.rays.k.copy()
    k[wrong] *= factor
    rays = dataclasses.replace(WITH_MEDIA, rays=dataclasses.replace(WITH_MEDIA.rays, k=k))
    path = files.write(tmp_path / "rays.csv", ray_set.with_checksum(rays))
    if abs(factor - 1) < 1e-5:
        assert len(files.read(path)) == 12
    else:
        assert_refused(path, f"rays.csv: ray {wrong} has n_from / n_to = ")
        assert_refused(path, f", {header.described(rays.header, wrong)}")


# Answers -------------------------------------------------------------------------------------------------------------


def test_spellings_of_csv_answers():
    text = "\ufeff# seed: 3\r\n# by: us\r\n\r\nid, bx, by, bz, transmitted\r\n# a remark\r\n4, 1, 2.5e-3, -0, 1\r\n"
    text += "2,nan,-nan(ind),-NaN(0x7ff),0\r\n  \n\r\n0 ,inf,-INF,+1.5,1 # right\r\n"
    for answers in (files.parse_answers(text[1:]), files.parse_answers(text.encode())):
        assert (answers.header, answers.ids.tolist()) == ({"seed": 3, "by": "us"}, [4, 2, 0])
        np.testing.assert_array_equal(answers.b, [[1, 2.5e-3, 0], [np.nan] * 3, [np.inf, -np.inf, 1.5]])
        assert answers.transmitted.tolist() == [True, False, True]
    assert files.parse_answers("id,bx,by,bz\n1,2,3,4").transmitted is None
    assert files.parse_answers("id,bx,by,bz\n").b.shape == (0, 3)


TOP = "id,bx,by,bz\n"
RATIO = "n_ratio is {} for 1 rays; expected n_from / n_to, 1e-09 … 1e+09"
TABLES = {
    "the first row is '1,2,3,4'; expected, in this order: id,bx,by,bz or id,bx,by,bz,transmitted or": "1,2,3,4\n",
    "the first row is 'id,bx,by,bz,n_ratio,transmitted'": "id,bx,by,bz,n_ratio,transmitted\n",
    "line 5 is '2,3,4'; expected 4 numbers": f"# x\n{TOP}\n1,2,3,4\n2,3,4\n3,x,1,2\n",
    "line 2 is '1,2,3,4,1'; expected 4 numbers": TOP + "1,2,3,4,1\n",
    "line 2 is '1,0x1p0,2,3'": TOP + "1,0x1p0,2,3\n",
    "1 ids are not whole numbers below 2^53, the first is 1.5": TOP + "1.5,2,3,4\n",
    "3 ids are not whole numbers below 2^53, the first is nan": TOP + "nan,2,3,4\ninf,2,3,4\n1e300,2,3,4\n",
    "transmitted is 2.0; expected 0 or 1": "id,bx,by,bz,transmitted\n1,2,3,4,2\n2,2,3,4,nan\n",
    "not text; expected CSV": b"\xff\xfe\x00id",
    "not text; expected CSV in UTF-8": TOP.encode() + b"1,2,3,4\n\xff,2,3,4\n",
    "line 2 is longer than 1048576 characters": TOP + "1" * 2_000_000,
} | {
    RATIO.format(f"{float(x):g}"): f"id,bx,by,bz,n_ratio\n0,0,0,1,1.5\n1,0,0,1,{x}\n"
    for x in ("nan", "inf", "0", "-1.5", "1e-10", "1e10")
}


@pytest.mark.parametrize("message", TABLES)
def test_invalid_tables_are_refused(tmp_path, message):
    text = TABLES[message]
    with pytest.raises(ValueError) as caught:
        files.parse_answers(text, "answers.csv")
    assert str(caught.value).startswith("answers.csv: ") and message in str(caught.value)
    (tmp_path / "a.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    assert_refused(tmp_path / "a.csv", message, files.read_answers)


def test_a_long_line_of_nan_is_parsed_fast():
    start = time.process_time()
    with pytest.raises(ValueError, match="line 2 is '1,nan"):
        files.parse_answers(TOP + "1," + "nan(" * 200_000 + "\n")
    assert time.process_time() - start < 2  # a quadratic search takes minutes


@pytest.mark.parametrize("names", [(), ("transmitted",), ("n_ratio",), ("transmitted", "n_ratio")])
@pytest.mark.parametrize("ending", ["csv", "npz"])
def test_answers_in_any_format_with_any_columns_up_to_a_limit_of_rows(tmp_path, ending, names):
    ids, b, path = np.array([3, 0, 4, 1, 2]), np.arange(15.0).reshape(5, 3), tmp_path / f"a.{ending}"
    columns = {"transmitted": np.array([1, 0, 1, 1, 0]), "n_ratio": np.array([0.5, 1, 2, 4, 8])}
    more = {name: columns[name] for name in names}
    if ending == "npz":
        np.savez_compressed(path, id=ids[:, None], b=np.asfortranarray(b.astype(np.longdouble)), **more)
    else:
        rows = np.column_stack([ids, b, *more.values()]).tolist()
        path.write_text("\n".join([",".join([TOP.strip(), *more]), *(",".join(map(repr, row)) for row in rows), ""]))
    answers = files.read_answers(path, most=5)
    np.testing.assert_array_equal(answers.ids, ids)
    np.testing.assert_array_equal(answers.b, b)
    for name in columns:
        column = getattr(answers, name)
        assert (column is not None) == (name in names) and (column is None or column.tolist() == columns[name].tolist())
    assert_refused(path, "4", lambda path: files.read_answers(path, most=4))
    os.truncate(path, 2**40)
    assert_refused(path, "1099511627776 bytes", files.read_answers)


def test_paths_that_are_not_regular_files(tmp_path):
    (tmp_path / "a.csv").mkdir()
    for name in ("a.csv", "b.npz"):
        with pytest.raises(OSError) as caught:
            files.read_answers(tmp_path / name)
        assert str(caught.value.filename) == str(tmp_path / name)
    os.mkfifo(tmp_path / "c.csv")
    (tmp_path / "d.npz").symlink_to("/dev/zero")
    for name in ("c.csv", "d.npz"):
        assert_refused(tmp_path / name, "not a regular file", files.read_answers)
    assert_refused(tmp_path / "e.txt", "expected a file name that ends in .csv or .npz", files.read_answers)
    code = "import sys; sys.modules['flint'] = None; import mi_refract.ray_sets.files"  # reading needs no oracle
    subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, check=True)


# NumPy's archives ----------------------------------------------------------------------------------------------------


def npz(path, method=zipfile.ZIP_DEFLATED, **members):
    """An archive of two answers with other members: arrays, or the raw bytes of a member."""
    raw = {name: content for name, content in members.items() if isinstance(content, bytes)}
    arrays = {"id": np.arange(2), "b": np.zeros((2, 3))} | {k: v for k, v in members.items() if k not in raw}
    np.savez(path, **arrays)
    with zipfile.ZipFile(path) as old:
        parts = {name: old.read(name) for name in old.namelist()}
    with zipfile.ZipFile(path, "w", method) as new:
        for name, content in (parts | {f"{name}.npy": content for name, content in raw.items()}).items():
            new.writestr(name, content)
    return path


def npy(shape, dtype="<f8", content=b""):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": dtype, "fortran_order": False, "shape": shape})
    return stream.getvalue() + content


B = "an .npz file with id, b"
MEMBERS = {
    "complex": (np.zeros((2, 3), complex), "b contains complex128, not real numbers"),
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
def test_invalid_arrays_are_refused(tmp_path, b, message):
    assert_refused(npz(tmp_path / "a.npz", b=b), message, files.read_answers)


def test_invalid_archives_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    for top, message in ((np.array("x" * 2**19), "header has 2097280 bytes"), (np.zeros(3), "header is float64")):
        assert_refused(npz(path, header=top), message, files.read_answers)
    np.savez(path, id=np.arange(2))
    assert_refused(path, "there is no b; expected an .npz file with id, b", files.read_answers)
    assert_refused(npz(path, zipfile.ZIP_BZIP2), "id is compressed by method 12", files.read_answers)
    data = bytearray(npz(path).read_bytes())
    for signature, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        at = -1
        while (at := data.find(signature, at + 1)) >= 0:
            data[at + offset] |= 1
    path.write_bytes(data)
    assert_refused(path, "is encrypted", files.read_answers)
    # Other content of a file may have 16 MB.
    assert len(files.read_answers(npz(path, zipfile.ZIP_STORED, more=bytes(12 << 20)), most=2).ids) == 2
    npz(path, zipfile.ZIP_STORED, more=bytes(20 << 20))
    assert_refused(path, "bytes", lambda path: files.read_answers(path, most=2))


def test_a_zip_bomb_is_not_unpacked(tmp_path):
    """40 million rows of zeros in less than 1 MB, in an array that is read and in one that is not."""
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as new:
        for name in ("id", "else"):
            with new.open(f"{name}.npy", "w") as stream:
                stream.write(npy((40_000_000,), "|u1"))
                for _ in range(40):
                    stream.write(bytes(1_000_000))
        new.writestr("b.npy", npy((2, 3), content=bytes(48)))
    tracemalloc.start()
    assert_refused(path, "id has 40000128 bytes, more than", lambda path: files.read_answers(path, most=1000))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4e6


def test_errors_of_damaged_archives_are_one_line(tmp_path):
    """Each third byte is changed in turn: never another exception. A change of the last bit is detected."""
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
    path = files.write(tmp_path / "rays.npz", ray_set.make(("generic",), 3000))
    with zipfile.ZipFile(path) as archive:
        info = archive.getinfo("n_to.npy")
    data = bytearray(path.read_bytes())
    data[data.find(b"\x93NUMPY", info.header_offset) + info.file_size - 1] ^= 1
    path.write_bytes(data)
    assert_refused(path, "Bad CRC-32 for file 'n_to.npy'")

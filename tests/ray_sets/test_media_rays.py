"""Sets with media: each ray has the ratio of its media at its wavelength, and a set without media is what it was."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.util
import itertools
import json
import sys

import numpy as np
import pytest
from support.media_rays import ALL, CROWN, FLINT, MEDIA, WATER, WAVELENGTHS

from mi_refract import media, regimes
from mi_refract.ray_sets import files, media_rays, ray_set
from mi_refract.ray_sets.ray_set import RaySet
from mi_refract.regimes import Rays

AIR = dataclasses.replace(media.parse(1.0), relative_to="air")
with_glass = pytest.mark.skipif(
    not all(importlib.util.find_spec(name) for name in ("opticalglass", "pandas")),
    reason="opticalglass is not installed: pip install 'mi-refract[glass]'",
)


def of_ray(rays, row):
    """(from, to) by name, and the wavelength, as a reader of the file finds them."""
    wavelength, pair = rays.numbers[row, 9:]
    return (*rays.header["media"][int(pair)], wavelength)


# The rays


@pytest.mark.parametrize("precision", ray_set.PRECISIONS)
def test_k_is_the_ratio_of_the_media_at_the_wavelength(precision):
    rays = ray_set.make(media_rays.NAMES, 30, precision, **ALL)
    dtype = ray_set.PRECISIONS[precision]
    for row in range(len(rays)):
        left, entered, wavelength = of_ray(rays, row)
        pair = [AIR if name == "air" else media.parse(name) for name in (left, entered)]
        assert rays.rays.k[row] == dtype(media.relative_index(*pair, wavelength))
        assert wavelength in [dtype(each) for each in WAVELENGTHS]
    n_from, n_to = rays.numbers[:, 7:9].T
    np.testing.assert_array_equal(n_from / n_to, rays.rays.k)


@pytest.mark.parametrize("name", media_rays.NAMES)
def test_every_combination_occurs_and_directions_are_those_of_the_regime(name):
    rays = ray_set.make([name], 12, **ALL)
    sides = [(each, "air") for each in MEDIA] + ([] if name == "critical" else [("air", each) for each in MEDIA])
    assert {of_ray(rays, row) for row in range(12)} == {
        (*side, np.float32(each)) for side, each in itertools.product(sides, WAVELENGTHS)
    }
    if name not in ("critical", "Brewster"):  # they aim at the angles of the medium
        with_media, without = (ray_set.make([name], 24, "f64", 7, two_sided=True, **x).rays for x in (ALL, {}))
        np.testing.assert_array_equal(with_media.a, without.a)
        np.testing.assert_array_equal(with_media.n, without.n)
        assert (with_media.k != without.k).any()


def test_normals_face_the_ray_unless_two_sided():
    facing, either = (ray_set.make(["generic", "critical", "Brewster"], 40, two_sided=x, **ALL).rays for x in (0, 1))
    assert ((facing.a * facing.n).sum(1) <= 0).all() and ((either.a * either.n).sum(1) > 0).any()


def test_a_medium_that_is_thinner_than_air_is_critical_from_outside():
    rays = ray_set.make(["critical"], 4, media=("0.9",), wavelengths=(500.0,))
    assert {of_ray(rays, row)[:2] for row in range(4)} == {("air", "0.9")}


def test_by_default_there_are_the_regimes_that_take_ratios():
    rays = ray_set.make(count=12, media=list(MEDIA), wavelengths=np.array(WAVELENGTHS))
    names = ("generic", "near-normal", "grazing", "critical", "Brewster", "axes, signed zeros", "denormal")
    assert tuple(rays.header["regimes"]) == ray_set.default(MEDIA) == names
    assert ray_set.default() == ray_set.DEFAULT
    assert rays.header == ray_set.make(count=12, **ALL).header


@with_glass
def test_a_glass_is_the_same_in_any_case():
    lower, upper = (
        ray_set.make(["generic"], 4, media=(x,), wavelengths=(587.5618,)) for x in ("schott:n-bk7", "SCHOTT:N-BK7")
    )
    assert lower.header == upper.header
    assert lower.header["media"] == [["SCHOTT:N-BK7", "air"], ["air", "SCHOTT:N-BK7"]]
    assert lower.rays.k[0] == pytest.approx(1.5168, abs=1e-5)


# Files


@pytest.mark.parametrize(
    "precision, ending", [("f32", "csv"), ("f32", "npz"), ("f32", "exr"), ("f64", "csv"), ("f64", "npz")]
)
def test_every_bit_returns(tmp_path, precision, ending):
    made = ray_set.make(["generic", "critical"], 40, precision, 5, **ALL)
    found = files.read(files.write(tmp_path / f"rays.{ending}", made))
    assert found.header == made.header
    assert [getattr(found.rays, x).tobytes() for x in "ank"] == [getattr(made.rays, x).tobytes() for x in "ank"]
    np.testing.assert_array_equal(found.numbers, made.numbers)


def test_columns_and_arrays(tmp_path):
    made = ray_set.make(["generic"], 12, "f64", **ALL)
    lines = files.as_csv(made).splitlines()
    top = lines.index("id,ax,ay,az,nx,ny,nz,n_from,n_to,wavelength,medium")
    order = itertools.product(range(2), ("486.1327", "587.5618"), range(3))
    assert [line.split(",")[-2:] for line in lines[top + 1 :]] == [[x, str(2 * i + turned)] for turned, x, i in order]
    with np.load(files.write(tmp_path / "rays.npz", ray_set.make(["generic"], 12, **ALL))) as found:
        assert found["wavelength"].dtype == np.float32 and found["medium"].dtype == np.int64
        assert found["medium"].tolist() == [0, 2, 4] * 2 + [1, 3, 5] * 2
    assert media_rays.described(made.header, 2) == f"{WATER} to air at 486.1327 nm"
    assert media_rays.described(made.header, 10) == f"air to {FLINT} at 587.5618 nm"
    assert media_rays.described(ray_set.make(["generic"], 12).header, 2) == ""


# Of a set that is written here: what is drawn may differ in the last bit of NumPy's functions.
CHECKSUM = "sha256:e12027e60442a09b7176e9ca4925ed2885a1a663c062d16d2b3e4a925c4284ad"
WRITTEN = {
    "csv": "7436b4d65d4057d13c466b85879e7eca53dc17bd28eccd58730d5611c645ded2",
    "npz": "3fada76bec7c8781235839662b5fb0ada2c9754795b4c98a364eccf2557d42a5",
}


@pytest.mark.parametrize("ending", WRITTEN)
def test_a_set_without_media_is_what_it_was(tmp_path, ending):
    """Byte for byte, as before there were media."""
    a, n = np.array([[0.6, 0, 0.8], [0, -1, 0]]), np.array([[0, 0, -1.0], [0, 1, 0]])
    rays = Rays(*(x.astype(np.float32) for x in (a, n, np.array([0.6666667, 1.5]))))
    header = ray_set.make(["generic"], 2).header | {"version": "0"}
    made = ray_set.with_checksum(RaySet(rays, np.arange(2), header))
    assert made.header["checksum"] == CHECKSUM
    path = files.write(tmp_path / f"rays.{ending}", made)
    assert hashlib.sha256(path.read_bytes()).hexdigest() == WRITTEN[ending]


EDITS = {
    "a wavelength": lambda text: text.replace(",486.1327,0\n", ",587.5618,0\n", 1),
    "a medium": lambda text: text.replace(",486.1327,0\n", ",486.1327,2\n", 1),
    "wavelengths in another order": lambda text: text.replace("[486.1327, 587.5618]", "[587.5618, 486.1327]"),
    "no columns": lambda text: text.replace(",wavelength,medium", "").replace(",486.1327,0\n", "\n"),
    "no media": lambda text: "\n".join(x for x in text.split("\n") if not x.startswith(("# media", "# wavel"))),
    "one column": lambda text: text.replace(",medium\n", "\n"),
}


@pytest.mark.parametrize("edit", EDITS.values(), ids=EDITS)
def test_an_edited_file_is_refused(tmp_path, edit):
    text, path = files.as_csv(ray_set.make(["generic"], 12, "f64", **ALL)), tmp_path / "rays.csv"
    path.write_text(edit(text))
    assert edit(text) != text
    with pytest.raises(ValueError, match=r"^.*rays\.csv: .*expected") as caught:
        files.read(path)
    assert "\n" not in str(caught.value)


# What is refused


INVALID = {
    "no wavelength": ({"wavelengths": ()}, "3 media and 0 wavelengths; expected neither, or at least one of each"),
    "no medium": ({"media": ()}, "0 media and 2 wavelengths; expected neither, or at least one of each"),
    "a medium twice": ({"media": (CROWN, FLINT, f" {CROWN}")}, "2 times; expected each once"),
    "one in f32": ({"wavelengths": (500.0, 500.000001)}, "are not all different in f32; expected each once"),
    "none in f32": ({"wavelengths": (1e-60,)}, "are not all different in f32"),
    "not a number": ({"wavelengths": (float("nan"),)}, "wavelength nan; expected nm, a number above 0"),
    "negative": ({"wavelengths": (500.0, -1.0)}, "wavelength -1; expected nm, a number above 0"),
    "infinite": ({"wavelengths": (float("inf"),)}, "wavelength inf; expected nm, a number above 0"),
    "out of range": ({"wavelengths": (500.0, 900.0)}, "no index at 900 nm"),
    "many media": ({"media": tuple(f"1.{i}" for i in range(10, 75))}, "65 media and 2 wavelengths; expected up to 64"),
    "many wavelengths": ({"wavelengths": tuple(range(400, 465))}, "3 media and 65 wavelengths; expected up to 64"),
    "a name of Mitsuba's": ({"media": ("bk7",)}, "medium 'bk7'; expected a number, cauchy(A, B, …)"),
    "a long text": ({"media": ("x" * 10_000,)}, "medium 'xxx"),
    "a long formula": ({"media": (f"cauchy({'1' * 600})",)}, "cauchy(111"),
    "an unknown material": ({"media": ("MATERIAL:watr",)}, "unknown material; nearest: MATERIAL:water"),
    "an index without end": ({"media": ("1e9",)}, "n = 1e+09 beside air at 486.13269 nm; expected 1e-06 … 1e+06"),
    "few rays": ({"count": 11}, "11 rays of each regime; expected 12 or more, one for each medium"),
    **{
        name: (
            {"names": ("generic", name)},
            f"regime {name!r} defines its own ratios of indices; with media, expected one of ",
        )
        for name in regimes.REGIMES
        if name not in media_rays.NAMES
    },
}  # fmt: skip


@pytest.mark.parametrize("changes, message", INVALID.values(), ids=INVALID)
def test_invalid_sets(changes, message):
    with pytest.raises(ValueError) as caught:
        ray_set.make(**{"names": ("generic",), "count": 1000, **ALL} | changes)
    text = str(caught.value)
    assert message in text and "\n" not in text and len(text) < 800


def test_as_many_as_there_may_be():
    specs = tuple(f"1.{i}" for i in range(10, 74))
    rays = ray_set.make(["generic"], 2 * 64 * 64, media=specs, wavelengths=tuple(range(400, 464)))
    assert len(np.unique(rays.numbers[:, 9:], axis=0)) == len(rays)


@with_glass
def test_an_unknown_glass_has_nearest_names():
    with pytest.raises(ValueError, match=r"unknown glass; .*nearest: SCHOTT:N-BK7, \S+, \S+$"):
        ray_set.make(["generic"], media=("SCHOTT:N-BK8",), wavelengths=(500.0,))


def test_without_the_extra_it_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "opticalglass", None)
    for name in [name for name in sys.modules if name.startswith("opticalglass.")]:
        monkeypatch.setitem(sys.modules, name, None)
    media.glass_catalogs.read.cache_clear()
    with pytest.raises(ValueError, match=r"pip install 'mi-refract\[glass\]'$"):
        ray_set.make(["generic"], media=("SUMITA:K-BK7",), wavelengths=(501.0,))


HEADERS = {
    "no wavelengths": (
        {"wavelengths": None},
        "header: no key `wavelengths`; expected all of `wavelength, medium`, `media`",
    ),
    "no media": ({"media": None}, "header: no key `media`"),
    "no words": ({"wavelength, medium": None}, "header: no key `wavelength, medium`"),
    "media in text": ({"media": CROWN}, "header: media: expected `array`"),
    "no medium": ({"media": []}, "header: media: expected `array` of length >= 2"),
    "three": ({"media": [[CROWN, "air", "air"], ["air", CROWN]]}, "header: media[0]: expected `array` of length 2"),
    "numbers": ({"media": [[1.5, "air"], ["air", 1.5]]}, "header: media[0][0]: expected `str`"),
    "one side": ({"media": [[CROWN, "air"], [FLINT, "air"]]}, "header: media: [["),
    "glass to glass": ({"media": [[CROWN, FLINT], [FLINT, CROWN]]}, "header: media: [["),
    "twice": ({"media": [[CROWN, "air"], ["air", CROWN]] * 2}, "2 times; expected each once"),
    "a huge list": (
        {"media": [["1.5", "air"], ["air", "1.5"]] * 5000},
        "header: media: expected `array` of length <= 128",
    ),
    "a huge text": ({"media": [["1" * 10**5, "air"], ["air", "1" * 10**5]]}, "header: media[0][0]: expected `str`"),
    "an unknown medium": ({"media": [["MATERIAL:ice", "air"], ["air", "MATERIAL:ice"]]}, "unknown material; nearest"),
    "another spelling": ({"media": [["1.50", "air"], ["air", "1.50"]]}, "header: media: [['1.50'"),
    "control characters": ({"media": [["\x1b", "air"], ["air", "\n\x1b"]]}, "medium '\\x1b'; expected"),
    "wavelengths in text": ({"wavelengths": ["500"]}, "header: wavelengths[0]: expected `float`"),
    "a truth": ({"wavelengths": [True]}, "header: wavelengths[0]: expected `float`"),
    "NaN": ({"wavelengths": [float("nan")]}, "header: wavelengths[0]: expected a finite number"),
    "huge": ({"wavelengths": [1e300]}, "header: wavelengths[0]: expected `float` < 1000000000"),
    "out of range": ({"wavelengths": [486.1327, 900.0]}, "no index at 900 nm"),
    "equal": ({"wavelengths": [500.0, 500.0]}, "are not all different in f32"),
    "more than rays": ({"wavelengths": [400.0 + i for i in range(9)]}, "12 rays of each regime; expected 54 or more"),
    "another regime": (
        {"regimes": {"k ≫ 1": [0, 11]}},
        "defines its own ratios of indices; with media, expected one of",
    ),
}


@pytest.mark.parametrize("ending", ["csv", "npz"])
@pytest.mark.parametrize("changes, message", HEADERS.values(), ids=HEADERS)
def test_headers_that_no_set_has(tmp_path, ending, changes, message):
    """They are refused before the checksum is compared."""
    rays = ray_set.make(["generic"], 12, **ALL)
    header = {key: value for key, value in (rays.header | changes).items() if value is not None}
    path = tmp_path / f"rays.{ending}"
    if ending == "csv":
        rows = files.as_csv(rays).split("\n")[len(rays.header) :]
        path.write_text("\n".join([*(f"# {key}: {json.dumps(value)}" for key, value in header.items()), *rows]))
    else:
        with np.load(files.write(path, rays)) as arrays:
            members = dict(arrays)
        np.savez(path, **members | {"header": np.array(json.dumps(header))})
    with pytest.raises(ValueError) as caught:
        files.read(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ") and message in text and "\n" not in text and len(text) < 800


@pytest.mark.parametrize("wrong, factor", [(7, 1 + 5e-6), (0, 1 + 3e-5), (7, 1 - 3e-5), (11, 1.5)])
def test_ratios_that_are_not_those_of_the_media(tmp_path, wrong, factor):
    """With a checksum that fits: a program would be blamed for its index."""
    rays = ray_set.make(["generic"], 12, **ALL)
    k = rays.rays.k.copy()
    k[wrong] *= np.float32(factor)
    changed = ray_set.with_checksum(dataclasses.replace(rays, rays=dataclasses.replace(rays.rays, k=k)))
    path = files.write(tmp_path / "rays.csv", changed)
    if abs(factor - 1) < 1e-5:
        assert len(files.read(path)) == 12
        return
    with pytest.raises(ValueError, match=rf"rays\.csv: ray {wrong} has n_from / n_to = \S+; expected \S+, ") as caught:
        files.read(path)
    assert str(caught.value).endswith(media_rays.described(rays.header, wrong))


def test_both_columns_or_none(tmp_path):
    (tmp_path / "rays.csv").write_text("id,ax,ay,az,nx,ny,nz,n_from,n_to,wavelength\n")
    base = "id,ax,ay,az,nx,ny,nz,n_from,n_to"
    with pytest.raises(ValueError, match=rf"expected, in this order: {base} or {base},wavelength,medium$"):
        files.read(tmp_path / "rays.csv")

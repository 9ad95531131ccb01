"""Sets with media: each ray has the ratio of its media at its wavelength, and a set without media is what it was."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.util
import itertools
import sys

import numpy as np
import pytest
from support.media_rays import ALL, CROWN, FLINT, MEDIA, WATER, WAVELENGTHS

from mi_refract import media
from mi_refract.ray_sets import files, media_rays, ray_set
from mi_refract.ray_sets.header import MEDIA as KEYS
from mi_refract.regimes import Rays

AIR = dataclasses.replace(media.parse(1.0), relative_to="air")
FORMATS = [("f32", "csv"), ("f32", "npz"), ("f32", "exr"), ("f64", "csv"), ("f64", "npz")]
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
def test_every_combination_is_asked(name):
    rays = ray_set.make([name], 12, **ALL)
    found = {of_ray(rays, row) for row in range(len(rays))}
    sides = [(each, "air") for each in MEDIA] + ([] if name == "critical" else [("air", each) for each in MEDIA])
    assert found == {(*side, np.float32(each)) for side, each in itertools.product(sides, WAVELENGTHS)}


@pytest.mark.parametrize("name", [each for each in media_rays.NAMES if each not in ("critical", "Brewster")])
def test_directions_are_those_of_the_regime(name):
    with_media, without = (ray_set.make([name], 24, "f64", 7, two_sided=True, **more).rays for more in (ALL, {}))
    np.testing.assert_array_equal(with_media.a, without.a)
    np.testing.assert_array_equal(with_media.n, without.n)
    assert (with_media.k != without.k).any()


def test_normals_face_the_ray_unless_two_sided():
    rays = ray_set.make(["generic", "critical", "Brewster"], 40, **ALL).rays
    assert ((rays.a * rays.n).sum(1) <= 0).all()
    rays = ray_set.make(["generic", "critical", "Brewster"], 40, two_sided=True, **ALL).rays
    assert ((rays.a * rays.n).sum(1) > 0).any()


def test_a_medium_that_is_thinner_than_air_is_critical_from_outside():
    rays = ray_set.make(["critical"], 4, media=("0.9",), wavelengths=(500.0,))
    assert {of_ray(rays, row)[:2] for row in range(4)} == {("air", "0.9")}


def test_by_default_there_are_the_regimes_that_take_ratios():
    rays = ray_set.make(count=12, **ALL)
    assert tuple(rays.header["regimes"]) == ray_set.default(MEDIA) == (
        "generic", "near-normal", "grazing", "critical", "Brewster", "axes, signed zeros", "denormal",
    )  # fmt: skip
    assert ray_set.default() == ray_set.DEFAULT


def test_arrays_of_wavelengths_are_taken():
    made = ray_set.make(["generic"], 12, media=list(MEDIA), wavelengths=np.array(WAVELENGTHS))
    assert made.header == ray_set.make(["generic"], 12, **ALL).header


@with_glass
def test_a_glass_is_the_same_in_any_case():
    made = [
        ray_set.make(["generic"], 4, media=(name,), wavelengths=(587.5618,))
        for name in ("schott:n-bk7", "SCHOTT:N-BK7")
    ]
    assert made[0].header == made[1].header
    assert made[0].header["media"] == [["SCHOTT:N-BK7", "air"], ["air", "SCHOTT:N-BK7"]]
    assert made[0].rays.k[0] == pytest.approx(1.5168, abs=1e-5)


# Files


@pytest.mark.parametrize("precision, ending", FORMATS)
def test_every_bit_returns(tmp_path, precision, ending):
    made = ray_set.make(["generic", "critical"], 40, precision, 5, **ALL)
    path = files.write(tmp_path / f"rays.{ending}", made)
    found = files.read(path)
    assert found.header == made.header
    assert [getattr(found.rays, x).tobytes() for x in "ank"] == [getattr(made.rays, x).tobytes() for x in "ank"]
    np.testing.assert_array_equal(found.numbers, made.numbers)


def test_a_row_of_csv():
    made = ray_set.make(["generic"], 12, "f64", **ALL)
    lines = files.as_csv(made).splitlines()
    top = lines.index("id,ax,ay,az,nx,ny,nz,n_from,n_to,wavelength,medium")
    assert [line.split(",")[-2:] for line in lines[top + 1 :]] == [
        [wavelength, str(2 * medium + turned)]
        for turned in range(2) for wavelength in ("486.1327", "587.5618") for medium in range(3)
    ]  # fmt: skip


def test_arrays_of_npz(tmp_path):
    path = files.write(tmp_path / "rays.npz", ray_set.make(["generic"], 12, **ALL))
    with np.load(path) as found:
        assert found["wavelength"].dtype == np.float32 and found["medium"].dtype == np.int64
        assert found["medium"].tolist() == [0, 2, 4] * 2 + [1, 3, 5] * 2


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
    header = ray_set.header_of(["generic"], 2, "f32", 0, False) | {"version": "0"}
    bare = ray_set.RaySet(rays, np.arange(2), header)
    assert ray_set.checksum(bare) == CHECKSUM
    made = ray_set.RaySet(rays, bare.ids, header | {"checksum": CHECKSUM})
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
    text = files.as_csv(ray_set.make(["generic"], 12, "f64", **ALL))
    path = tmp_path / "rays.csv"
    path.write_text(edit(text))
    assert edit(text) != text
    for read in (files.read,):
        with pytest.raises(ValueError, match=r"^.*rays\.csv: .*expected") as caught:
            read(path)
        assert "\n" not in str(caught.value)


# What is refused


INVALID = {
    "no wavelength": ({"wavelengths": ()}, "3 media and 0 wavelengths; expected neither, or at least one of each"),
    "no medium": ({"media": ()}, "0 media and 2 wavelengths; expected neither, or at least one of each"),
    "a medium twice": ({"media": (CROWN, FLINT, f" {CROWN}")}, "2 times; expected each once"),
    "a wavelength twice": ({"wavelengths": (500.0, 500.0)}, "are not all different in f32; expected each once"),
    "one in f32": ({"wavelengths": (500.0, 500.000001)}, "are not all different in f32; expected each once"),
    "none in f32": ({"wavelengths": (1e-60,)}, "are not all different in f32"),
    "not a number": ({"wavelengths": (float("nan"),)}, "wavelength nan; expected nm, above 0"),
    "negative": ({"wavelengths": (500.0, -1.0)}, "wavelength -1; expected nm, above 0"),
    "infinite": ({"wavelengths": (float("inf"),)}, "wavelength inf; expected nm, above 0"),
    "out of range": ({"wavelengths": (500.0, 900.0)}, "no index at 900 nm"),
    "many media": ({"media": tuple(f"1.{i}" for i in range(10, 75))}, "65 media and 2 wavelengths; expected up to 64"),
    "many wavelengths": ({"wavelengths": tuple(range(400, 465))}, "3 media and 65 wavelengths; expected up to 64"),
    "a name of Mitsuba's": ({"media": ("bk7",)}, "medium 'bk7'; expected a number, cauchy(A, B, …)"),
    "a long text": ({"media": ("x" * 10_000,)}, "medium 'xxx"),
    "a long formula": ({"media": (f"cauchy({'1' * 600})",)}, "cauchy(111"),
    "an unknown material": ({"media": ("MATERIAL:watr",)}, "unknown material; nearest: MATERIAL:water"),
    "an index without end": (
        {"media": ("1e9",)},
        "1000000000.0: n = 1e+09 beside air at 486.13269 nm; expected 1e-06 … 1e+06",
    ),
    "few rays": (
        {"count": 11},
        "11 rays of each regime; expected 12 or more, one for each medium, wavelength and side",
    ),
    "k ≫ 1": (
        {"names": ("generic", "k ≫ 1")},
        "regime 'k ≫ 1' has ratios of indices of its own; expected with media: ",
    ),
}


@pytest.mark.parametrize("given, message", INVALID.values(), ids=INVALID)
def test_invalid_sets(given, message):
    with pytest.raises(ValueError) as caught:
        ray_set.make(**{"names": ("generic",), "count": 1000, **ALL} | given)
    text = str(caught.value)
    assert message in text and "\n" not in text and len(text) < 800


def test_all_regimes_that_are_refused_name_those_that_are_not():
    for name in set(ray_set.regimes.REGIMES) - set(media_rays.NAMES):
        with pytest.raises(ValueError, match="expected with media: 'generic', 'near-normal'"):
            ray_set.make([name], **ALL)


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


def forged(rays, changes, k=None):
    """The set with another header and with a checksum that fits."""
    header = {key: value for key, value in (rays.header | changes).items() if key != "checksum" and value is not None}
    of = rays.rays if k is None else dataclasses.replace(rays.rays, k=k)
    made = ray_set.RaySet(of, rays.ids, header)
    try:
        sum_ = ray_set.checksum(made)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeWarning):  # no header at all
        sum_ = "sha256:" + 64 * "0"
    return header | {"checksum": sum_}, of


HEADERS = {
    "no wavelengths": ({"wavelengths": None}, "the header has no wavelengths"),
    "no media": ({"media": None}, "the header has no media"),
    "no words": ({"wavelength, medium": None}, "the header has no wavelength, medium"),
    "words that are none": ({"wavelength, medium": 7}, "the header's wavelength, medium is 7"),
    "media in text": ({"media": CROWN}, "the header's media is 'cauchy"),
    "no medium": ({"media": []}, "the header's media is []"),
    "a single name": ({"media": [CROWN, "air"]}, "the header's media is ['cauchy"),
    "three": ({"media": [[CROWN, "air", "air"], ["air", CROWN]]}, "the header's media is"),
    "numbers": ({"media": [[1.5, "air"], ["air", 1.5]]}, "the header's media is [[1.5"),
    "one side": ({"media": [[CROWN, "air"]]}, "the header's media is"),
    "glass to glass": ({"media": [[CROWN, FLINT], [FLINT, CROWN]]}, "the header's media is"),
    "twice": ({"media": [[CROWN, "air"], ["air", CROWN]] * 2}, "the header's media is"),
    "a huge list": ({"media": [["1.5", "air"], ["air", "1.5"]] * 5000}, "the header's media is [['1.5'"),
    "a huge text": ({"media": [["1" * 10**5, "air"], ["air", "1" * 10**5]]}, "the header's media is [['111"),
    "an unknown medium": ({"media": [["MATERIAL:ice", "air"], ["air", "MATERIAL:ice"]]}, "unknown material; nearest"),
    "another spelling": ({"media": [["1.50", "air"], ["air", "1.50"]]}, "the header's media is [['1.50'"),
    "a wavelength": ({"wavelengths": 500.0}, "the header's wavelengths is 500.0"),
    "none": ({"wavelengths": []}, "the header's wavelengths is []"),
    "wavelengths in text": ({"wavelengths": ["500"]}, "the header's wavelengths is ['500']"),
    "a truth": ({"wavelengths": [True]}, "the header's wavelengths is [True]"),
    "NaN": ({"wavelengths": [float("nan")]}, "the header's wavelengths is [nan]"),
    "huge": ({"wavelengths": [1e300]}, "the header's wavelengths is [1e+300]"),
    "out of range": ({"wavelengths": [486.1327, 900.0]}, "no index at 900 nm"),
    "equal": ({"wavelengths": [500.0, 500.0]}, "are not all different in f32"),
    "too many": ({"wavelengths": [400.0 + i for i in range(65)]}, "the header's wavelengths is [400.0"),
    "more than rays": ({"wavelengths": [400.0 + i for i in range(9)]}, "12 rays of each regime; expected 54 or more"),
    "another regime": ({"regimes": {"k ≫ 1": [0, 11]}}, "has ratios of indices of its own; expected with media"),
}


@pytest.mark.parametrize("ending", ["csv", "npz"])
@pytest.mark.parametrize("changes, message", HEADERS.values(), ids=HEADERS)
def test_headers_that_no_set_has(tmp_path, ending, changes, message):
    rays = ray_set.make(["generic"], 12, **ALL)
    header, _ = forged(rays, changes)
    path = tmp_path / f"rays.{ending}"
    if ending == "csv":
        path.write_text(files.with_header(header, (*files.COLUMNS, *media_rays.COLUMNS), rays.numbers))
    else:
        columns = dict(zip(media_rays.COLUMNS, rays.numbers[:, 9:].T, strict=True))
        arrays = {"id": rays.ids, "a": rays.rays.a, "n": rays.rays.n, "n_from": rays.rays.k, "n_to": rays.rays.k}
        np.savez(path, **arrays, **columns, header=np.array(files.json.dumps(header)))
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
    header, changed = forged(rays, {}, k)
    path = files.write(tmp_path / "rays.csv", ray_set.RaySet(changed, rays.ids, header))
    if abs(factor - 1) < 1e-5:
        assert len(files.read(path)) == 12
    else:
        with pytest.raises(
            ValueError, match=rf"rays\.csv: ray {wrong} has n_from / n_to = \S+; expected \S+, "
        ) as caught:
            files.read(path)
        assert str(caught.value).endswith(media_rays.described(rays.header, wrong))


def test_both_columns_or_none(tmp_path):
    (tmp_path / "rays.csv").write_text("id,ax,ay,az,nx,ny,nz,n_from,n_to,wavelength\n")
    base = "id,ax,ay,az,nx,ny,nz,n_from,n_to"
    with pytest.raises(ValueError, match=rf"expected, in this order: {base} or {base},wavelength,medium$"):
        files.read(tmp_path / "rays.csv")


def test_the_keys_of_the_header():
    header = ray_set.make(["generic"], 12, **ALL).header
    assert set(KEYS) < set(header)
    assert media_rays.described(header, 2) == f"{WATER} to air at 486.13269 nm"
    assert media_rays.described(header, 10) == f"air to {FLINT} at 587.561829 nm"
    assert media_rays.described(ray_set.make(["generic"], 12).header, 2) == ""

"""Pairs of images: who is compared with whom, settings, samples, exit codes, and what accepting writes."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from support.diff_images import BROKEN, found, image, samples

from mi_refract.image_diff import folders as diff
from mi_refract.image_diff import methods
from mi_refract.image_diff.results import Result, Results, Status
from mi_refract.image_diff.settings import ComparisonSpec, Entry, Settings
from mi_refract.io import image_file


def test_folders_are_matched_by_name(folders):
    results = diff.diff(*folders)
    assert found(results) == {
        "added.exr": ("different", "added"),
        "inner/changed.exr": ("different", "changed"),
        "removed.exr": ("different", "removed"),
        "same.exr": ("equal", "unchanged"),
    }
    assert results.exit_code == 1
    assert results.results[-1].name == "same.exr"  # failures first
    assert {r.name: r.reason for r in results.results if not r.comparison} == {
        "added.exr": "only among the new images",
        "removed.exr": "only among the references",
    }


def test_the_pair_is_the_one_of_that_name(folders):
    old, new = folders
    for result in diff.diff(old, new).results:
        assert result.reference in (None, old / result.name)
        assert result.test in (None, new / result.name)


def test_two_files_of_any_names(tmp_path):
    image(tmp_path / "a.exr")
    image(tmp_path / "b.exr")
    image(tmp_path / "c.exr", gain=1.1)
    assert found(diff.diff(tmp_path / "a.exr", tmp_path / "b.exr")) == {"a.exr": ("equal", "unchanged")}
    assert found(diff.diff(tmp_path / "a.exr", tmp_path / "c.exr")) == {"a.exr": ("different", "changed")}


@pytest.mark.parametrize("spoil", BROKEN.values(), ids=BROKEN)
@pytest.mark.parametrize("side", [0, 1])
def test_one_bad_image_keeps_no_other_from_being_compared(folders, side, spoil):
    bad = folders[side] / "same.exr"
    bad.unlink()
    spoil(bad)
    results = diff.diff(*folders)
    assert found(results)["same.exr"] == ("error", "unknown")
    assert found(results)["inner/changed.exr"] == ("different", "changed")
    assert results.exit_code == 2
    (error,) = [result.error for result in results.of(Status.ERROR)]
    assert "same.exr" in error
    assert "\n" not in error


def test_no_permission(folders, monkeypatch):
    """By a planted error: who runs as root may read everything."""
    read = image_file.read_parts

    def refuse(path, *most):
        if path.name == "same.exr":
            raise PermissionError(13, "Permission denied", str(path))
        return read(path, *most)

    monkeypatch.setattr(image_file, "read_parts", refuse)
    results = diff.diff(*folders)
    assert [(r.name, r.error) for r in results.of(Status.ERROR)] == [
        ("same.exr", f"{folders[0] / 'same.exr'}: Permission denied")
    ]
    assert len(results.of(Status.DIFFERENT)) == 3


@pytest.mark.parametrize(
    "planted, words",
    [
        (MemoryError("Unable to allocate 9 GiB"), "out of memory: Unable to allocate 9 GiB"),
        (RecursionError("too deep"), "internal error: RecursionError: too deep"),
        (OverflowError("a method's\nmistake"), "internal error: OverflowError: a method's mistake"),
        (AssertionError(), "internal error: AssertionError"),
        (FloatingPointError(), "internal error: FloatingPointError"),
    ],
    ids=lambda x: type(x).__name__,
)
def test_no_error_with_one_image_ends_the_run(folders, monkeypatch, planted, words):
    compare = methods.compare

    def fail(method, one, two, **options):
        if one[0].path.name == "same.exr":
            raise planted
        return compare(method, one, two, **options)

    monkeypatch.setattr(methods, "compare", fail)
    results = diff.diff(*folders)
    assert (found(results)["same.exr"], found(results)["inner/changed.exr"][0]) == (("error", "unknown"), "different")
    assert (results.exit_code, len(results.results)) == (2, 4)
    (error,) = [result.error for result in results.of(Status.ERROR)]
    assert error.startswith(f"{folders[1] / 'same.exr'}: {words}")
    assert "\n" not in error


@pytest.mark.parametrize("spp", [float("inf"), float("nan"), (4, 5, 6), (1.0, 2.0, 3.0), "many", -4, 1, 1e30, 2.5])
def test_a_header_may_say_anything_of_its_samples(tmp_path, spp):
    for side in ("old", "new"):
        image(tmp_path / side / "same.exr")
        path = tmp_path / side / "noisy.exr"
        spec = oiio.ImageSpec(8, 8, 2, "float")
        spec.channelnames = ("Y", "Y.variance")
        kind = f"{'int' if type(spp[0]) is int else 'float'}[3]" if isinstance(spp, tuple) else ""
        spec.attribute("mi_refract:spp", *([kind] if kind else []), spp)
        output = oiio.ImageOutput.create(str(path))
        assert output.open(str(path), spec) and output.write_image(np.ones((8, 8, 2), np.float32)) and output.close()
    results = diff.diff(tmp_path / "old", tmp_path / "new")
    assert {r.name: str(r.status) for r in results.results} == {"noisy.exr": "error", "same.exr": "equal"}
    assert "old/noisy.exr: its header names " in results.results[0].error


def test_images_larger_than_allowed_are_not_compared(folders):
    most = 32 * 48 * 3
    assert not diff.diff(*folders, Settings(ComparisonSpec(max_values=most))).of(Status.ERROR)
    results = diff.diff(*folders, Settings(ComparisonSpec(max_values=most - 1)))
    assert [r.name for r in results.of(Status.ERROR)] == ["inner/changed.exr", "same.exr"]
    ending = f"changed.exr: 48 × 32 × 3 values; expected up to {most - 1} values (max-values)"
    assert results.of(Status.ERROR)[0].error.endswith(ending)
    assert results.reproduce(results.results[0]).endswith(f"changed.exr --max-values {most - 1}")
    with pytest.raises(ValueError, match="max-values"):
        diff.read_renders(folders[0], most - 1)
    ruled = Settings(ComparisonSpec(max_values=most - 1), rules=(Entry("same.exr", {"method": "exact"}),))
    assert found(diff.diff(*folders, ruled))["same.exr"] == ("error", "unknown")


def test_pairs_that_are_compared_at_once_have_no_more_values_than_one_may(tmp_path, monkeypatch):
    """The large image has as many as four small ones, and is as large as allowed; then where more is allowed."""
    for side in ("old", "new"):
        for i in range(12):
            image(tmp_path / side / f"{i}.exr", shape=(8, 8, 3))
        image(tmp_path / side / "large.exr", shape=(8, 32, 3))
        (tmp_path / side / "broken.exr").write_text("none")
    compare, lock, now, most = methods.compare, threading.Lock(), [0], [0]

    def slowly(method, one, two, **options):
        values = one[0].pixels.size + two[0].pixels.size
        with lock:
            now[0] += values
            most[0] = max(*most, *now)
        time.sleep(0.05)
        with lock:
            now[0] -= values
        return compare(method, one, two, **options)

    monkeypatch.setattr(methods, "compare", slowly)
    monkeypatch.setattr(diff, "WORKERS", 8)
    pair = 2 * 8 * 8 * 3
    for limit, least, largest in ((8 * 32 * 3, 2 * pair, 4 * pair), (10**6, 5 * pair, 11 * pair)):
        most[0] = 0
        results = diff.diff(tmp_path / "old", tmp_path / "new", Settings(ComparisonSpec(max_values=limit)))
        assert [r.name for r in results.results] == [
            "broken.exr",
            *sorted([f"{i}.exr" for i in range(12)]),
            "large.exr",
        ]
        assert {r.status for r in results.results[1:]} == {Status.EQUAL}
        assert least <= most[0] <= largest


def test_a_folder_inside_without_permission(folders, monkeypatch):
    walk = os.walk

    def refuse(folder, onerror):
        onerror(PermissionError(13, "Permission denied", str(folder / "locked")))
        return walk(folder, onerror=onerror)

    monkeypatch.setattr(os, "walk", refuse)
    results = diff.diff(*folders)
    assert [r.name for r in results.of(Status.ERROR)] == ["locked", "locked"]
    assert all("Permission denied" in r.error for r in results.of(Status.ERROR))
    assert len(results.results) == 6


@pytest.mark.parametrize("link", [os.symlink, os.link])
def test_an_image_is_not_compared_with_itself(folders, link):
    old, new = folders
    (new / "same.exr").unlink()
    link(old / "same.exr", new / "same.exr")
    results = diff.diff(old, new)
    assert found(results)["same.exr"] == ("error", "unknown")
    assert "the same file" in results.results[0].error


def test_a_link_to_a_folder_is_not_passed_over(folders):
    for side in folders:
        (side / "linked").symlink_to(side / "inner")
    results = diff.diff(*folders)
    assert [(r.name, r.status) for r in results.results[:2]] == [("linked", "error")] * 2
    assert results.exit_code == 2


def test_nothing_to_compare(folders, tmp_path):
    old, new = folders
    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / "notes.txt").write_text("no image")
    (tmp_path / "link").symlink_to(old)
    for reference, test, error, message in [
        (old, empty, ValueError, "empty: holds no image"),
        (empty, new, ValueError, "empty: holds no image"),
        (old, old, ValueError, "the same as the reference"),
        (old, tmp_path / "link", ValueError, "the same as the reference"),
        (old / "same.exr", old / "same.exr", ValueError, "the same as the reference"),
        (old, old / "inner", ValueError, "one path contains the other"),
        (tmp_path, new, ValueError, "one path contains the other"),
        (old, new / "same.exr", ValueError, "cannot compare a folder with a file"),
        (old / "same.exr", new, ValueError, "cannot compare a folder with a file"),
        (old, tmp_path / "none", FileNotFoundError, "none"),
        (tmp_path / "none", new, FileNotFoundError, "none"),
    ]:
        with pytest.raises(error, match=message):
            diff.diff(reference, test)


@pytest.mark.parametrize(
    "statuses, inconclusive, code",
    [
        ([], "", 2),
        (["equal", "equal"], "", 0),
        (["equal", "different", "inconclusive"], "", 1),
        (["equal", "inconclusive"], "", 3),
        (["equal", "inconclusive"], "pass", 0),
        (["equal", "inconclusive"], "fail", 1),
        (["different", "inconclusive"], "pass", 1),
        (["error", "different", "inconclusive", "equal"], "pass", 2),
    ],
)
def test_exit_codes(tmp_path, statuses, inconclusive, code):
    results = tuple(Result(str(i), Status(status), tmp_path, tmp_path) for i, status in enumerate(statuses))
    assert Results(tmp_path, tmp_path, results, inconclusive=inconclusive).exit_code == code


def test_maps_are_kept_on_request_and_where_images_differ(folders):
    assert not any(r.comparison and r.comparison.maps for r in diff.diff(*folders).results)
    kept = {r.name: bool(r.comparison.maps) for r in diff.diff(*folders, maps=True).results if r.comparison}
    assert kept == {"inner/changed.exr": True, "same.exr": False}


def test_the_order_of_the_table_is_that_of_the_results(pair):
    statuses = [result.status for result in diff.diff(*pair).results]
    assert statuses == sorted(statuses, key=list(Status).index) == [Status.DIFFERENT, Status.EQUAL]


# Samples ----------------------------------------------------------------------------------------------------------


def test_samples(tmp_path):
    old, same, other = (
        samples(tmp_path / "old"),
        samples(tmp_path / "same", first=100),
        samples(tmp_path / "other", first=200, gain=1.3),
    )
    equal, different = (diff.diff(old, test, renders=True) for test in (same, other))
    assert found(equal) == {"old": ("equal", "unchanged")}
    assert found(different) == {"old": ("different", "changed")}
    assert different.results[0].comparison.method == "welch"
    assert (different.results[0].reference, different.results[0].test) == (old, other)


def test_samples_too_noisy_for_a_verdict(tmp_path):
    old, new = samples(tmp_path / "old", 2, noise=1.0), samples(tmp_path / "new", 2, 100, noise=1.0)
    assert diff.diff(old, new, renders=True).exit_code == 3


def test_bad_samples(tmp_path):
    good = samples(tmp_path / "good")
    twice = samples(tmp_path / "twice", first=100)
    (twice / "again.exr").write_bytes((twice / "3.exr").read_bytes())
    empty = tmp_path / "empty"
    empty.mkdir()
    for folder, message in [
        (twice, r"the same pixels as .*; expected renders of different seeds"),
        (samples(tmp_path / "one", 1, 200), "one"),
        (empty, "empty: holds no image"),
    ]:
        results = diff.diff(good, folder, renders=True)
        assert results.exit_code == 2
        with pytest.raises(ValueError, match=message):
            raise ValueError(results.results[0].error)
    with pytest.raises(NotADirectoryError, match=r"0\.exr; expected with --renders: a folder"):
        diff.diff(good, twice / "0.exr", renders=True)


def test_the_mean_of_renders_is_that_of_all_and_one_stays_as_it_is():
    pixels = np.arange(36, dtype=np.float32).reshape(3, 2, 2, 3) ** 2
    several = [image_file.Image(Path(f"{i}.exr"), each, ("R", "G", "B")) for i, each in enumerate(pixels)]
    found = diff.mean_image(several)
    np.testing.assert_allclose(found.pixels, pixels.mean(0), rtol=1e-6)
    assert (found.path, found.pixels.dtype) == (Path("0.exr"), np.float32)
    assert diff.mean_image(several[1:2]) is several[1]

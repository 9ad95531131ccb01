"""Pairs of images: who is compared with whom, settings, samples, exit codes, and what accepting writes."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from support.diff_images import BROKEN, found, image, samples

from mi_refract.image_diff import folders as diff
from mi_refract.image_diff import methods
from mi_refract.image_diff import settings as diff_settings
from mi_refract.image_diff.folders import Result, Results, Status
from mi_refract.image_diff.settings import How, Settings
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
    read = image_file.read

    def refuse(path, *most):
        if path.name == "same.exr":
            raise PermissionError(13, "Permission denied", str(path))
        return read(path, *most)

    monkeypatch.setattr(image_file, "read", refuse)
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
    assert not diff.diff(*folders, Settings(How(max_values=most))).of(Status.ERROR)
    results = diff.diff(*folders, Settings(How(max_values=most - 1)))
    assert [r.name for r in results.of(Status.ERROR)] == ["inner/changed.exr", "same.exr"]
    ending = f"changed.exr: 48 × 32 × 3 values; accepted: up to {most - 1} values (max-values)"
    assert results.of(Status.ERROR)[0].error.endswith(ending)
    assert results.reproduce(results.results[0]).endswith(f"changed.exr --max-values {most - 1}")
    with pytest.raises(ValueError, match="max-values"):
        diff.read_renders(folders[0], most - 1)
    ruled = Settings(How(max_values=most - 1), rules=(("same.exr", How("exact")),))
    assert found(diff.diff(*folders, ruled))["same.exr"] == ("error", "unknown")


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
        (old, old / "inner", ValueError, "one within the other"),
        (tmp_path, new, ValueError, "one within the other"),
        (old, new / "same.exr", ValueError, "a folder and a file"),
        (old / "same.exr", new, ValueError, "a folder and a file"),
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
        (twice, r"the same pixels as .*; accepted: renders of different seeds"),
        (samples(tmp_path / "one", 1, 200), "one"),
        (empty, "empty: holds no image"),
    ]:
        results = diff.diff(good, folder, renders=True)
        assert results.exit_code == 2
        with pytest.raises(ValueError, match=message):
            raise ValueError(results.results[0].error)
    with pytest.raises(NotADirectoryError, match=r"0\.exr: accepted with --renders: a folder"):
        diff.diff(good, twice / "0.exr", renders=True)


# Settings ---------------------------------------------------------------------------------------------------------

RULES = """
[[image]]
name = "inner/*"
method = "tolerance"
fail = 1
reason = "glass"

[[image]]
name = "inner/changed.exr"
method = "tolerance"
fail = 0.2
fail_relative = 0.0
reason = "more glass"
"""


@pytest.fixture
def rules(tmp_path):
    def write(text):
        path = tmp_path / "rules.toml"
        path.write_text(text)
        return diff_settings.load(path)

    return write


def test_the_last_rule_that_matches_holds(rules):
    settings = Settings(rules=rules(RULES))
    assert settings.of("inner/changed.exr") == How("tolerance", {"fail": 0.2, "fail_relative": 0.0}, "more glass")
    assert settings.of("inner/deep/other.exr") == How("tolerance", {"fail": 1.0}, "glass")
    assert settings.of("changed.exr") == How()
    assert Settings(rules=rules("")).of("changed.exr") == How()


def test_a_rule_goes_before_the_command_line(rules):
    settings = Settings(How("tolerance", {"fail": 0.5, "hard_fail": 0.6}), rules(RULES))
    assert settings.of("inner/changed.exr").options == {"fail": 0.2, "fail_relative": 0.0, "hard_fail": 0.6}
    assert settings.of("other.exr").options == {"fail": 0.5, "hard_fail": 0.6}
    exact = Settings(How("exact"), rules(RULES))
    assert exact.of("inner/changed.exr").method == "tolerance"
    assert exact.of("other.exr") == How("exact")
    silent = Settings(How("exact"), rules('[[image]]\nname = "a"\nreason = "NaN"\nallow_nonfinite = true'))
    assert silent.of("a") == How("exact", {"allow_nonfinite": True}, "NaN")


def test_a_rule_that_allows_no_nan_holds_and_its_command_says_the_same(rules):
    settings = Settings(
        rules=rules('[[image]]\nname = "a"\nreason = "never"\nallow_nonfinite = false'), allow_nonfinite=("*",)
    )
    assert settings.of("a").options == {"allow_nonfinite": False}
    assert settings.of("a").flags == []
    assert settings.of("b").flags == ["--allow-nonfinite", "*"]


def test_what_is_set_is_what_is_compared_by(folders, rules):
    settings = Settings(rules=rules(RULES))
    by_name = {result.name: result for result in diff.diff(*folders, settings).results}
    assert by_name["inner/changed.exr"].status is Status.EQUAL
    assert by_name["inner/changed.exr"].how.reason == "more glass"
    tight = Settings(rules=rules(RULES.replace("fail = 0.2", "fail = 0.05")))
    assert diff.diff(*folders, tight).results[1].status is Status.DIFFERENT


def test_patterns_that_match_nothing_are_told(folders, rules):
    stale = RULES + '[[image]]\nname = "gone.exr"\nreason = "was noisy"\n'
    assert diff.diff(*folders, Settings(rules=rules(stale), allow_nonfinite=("sane.exr",))).unused == (
        "gone.exr",
        "sane.exr",
    )
    assert diff.diff(*folders, Settings(rules=rules(RULES), allow_nonfinite=("same*",))).unused == ()


def test_nan_is_allowed_where_it_is_named(tmp_path):
    for side in ("old", "new"):
        image(tmp_path / side / "a.exr", value=np.nan)
        image(tmp_path / side / "b.exr", value=np.nan)
    settings = Settings(allow_nonfinite=("a.exr",))
    statuses = found(diff.diff(tmp_path / "old", tmp_path / "new", settings))
    assert statuses == {"a.exr": ("equal", "unchanged"), "b.exr": ("different", "changed")}


def test_the_readme_names_every_method_and_its_settings_are_accepted(rules):
    text = (Path(diff.__file__).parent / "README.md").read_text("utf-8")
    assert all(f"| `{name}` |" in text for name in methods.METHODS)
    (example,) = re.findall("```toml\n(.*?)```", text, re.DOTALL)
    assert rules(example)[0][1].method == "tolerance"


BAD_RULES = {
    "no name": ('[[image]]\nreason = "r"', "image[0].name: missing"),
    "no reason": ('[[image]]\nname = "a"', "image[0].reason: missing; accepted: a text"),
    "empty reason": ('[[image]]\nname = "a"\nreason = " "', "image[0].reason: ' '"),
    "unknown key": ('[[image]]\nname = "a"\nreason = "r"\nfale = 1', "image[0].fale: unknown; accepted: name"),
    "option of no method": ('[[image]]\nname = "a"\nreason = "r"\nfail = 1', "image[0].fail: unknown"),
    "option of another": (
        '[[image]]\nname = "a"\nreason = "r"\nmethod = "exact"\nfail = 1',
        "image[0].fail: unknown",
    ),
    "method": ('[[image]]\nname = "a"\nreason = "r"\nmethod = "idiff"', "image[0].method: 'idiff'; accepted: auto, "),
    "type of method": ('[[image]]\nname = "a"\nreason = "r"\nmethod = 3', "image[0].method: 3; accepted: auto, "),
    "type": (RULES.replace("fail = 0.2", 'fail = "0.2"'), "image[1].fail: '0.2'; accepted: a number"),
    "bool for number": (RULES.replace("fail = 0.2", "fail = true"), "image[1].fail: true"),
    "nan": (RULES.replace("fail = 0.2", "fail = nan"), "image[1].fail: nan"),
    "flag": ('[[image]]\nname = "a"\nreason = "r"\nallow_nonfinite = 1', "image[0].allow_nonfinite: 1"),
    "table": ("[images]", "images: unknown; accepted: image"),
    "top": ('method = "exact"', "method: unknown; accepted: image"),
    "no list": ('[image]\nname = "a"', "image: "),
    "no TOML": ("[[", "rules.toml: "),
    "nested": ("a = " + "[" * 5000, "rules.toml: "),
}


@pytest.mark.parametrize("text, message", BAD_RULES.values(), ids=BAD_RULES)
def test_bad_settings(rules, text, message):
    with pytest.raises(ValueError) as error:
        rules(text)
    assert message in str(error.value)
    assert "rules.toml: " in str(error.value)
    assert "\n" not in str(error.value)


def test_settings_that_are_no_text(tmp_path):
    path = tmp_path / "rules.toml"
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match=r"rules\.toml: "):
        diff_settings.load(path)


def test_options_in_words():
    assert diff_settings.from_words("auto", []) == How()
    how = diff_settings.from_words("welch", ["tile=8", "equivalence_margin=1", "correction=holm"])
    assert how == How("welch", {"tile": 8, "equivalence_margin": 1.0, "correction": "holm"})
    assert type(how.options["equivalence_margin"]) is float
    assert diff_settings.from_words("tolerance", ["fail=inf"]).options == {"fail": np.inf}


@pytest.mark.parametrize("method", methods.METHODS)
def test_every_option_of_every_method_in_words_and_back(method):
    defaults = {name: option.default for name, option in methods.METHODS[method].options.items()}
    flags = How(method, defaults).flags
    assert flags[:2] == ["--method", method]
    assert diff_settings.from_words(method, flags[3::2]).options == defaults


@pytest.mark.parametrize(
    "method, words, message",
    [
        ("idiff", [], "--method idiff: accepted: auto, exact"),
        ("auto", ["fail=1"], "--set fail=1: the options of which method?"),
        ("tolerance", ["fail"], "--set fail: accepted: NAME=VALUE"),
        ("tolerance", ["fail=1", "fail=2"], "--set fail=2: accepted: NAME=VALUE, each name once"),
        ("tolerance", ["fale=1"], "--set fale: unknown; accepted: fail"),
        ("tolerance", ["fail=much"], "--set fail: 'much'; accepted: a number"),
        ("tolerance", ["fail=nan"], "--set fail: nan"),
        ("welch", ["tile=1.5"], "--set tile: 1.5; accepted: a whole number"),
        ("welch", ["correction="], "--set correction: ''"),
    ],
)
def test_bad_options_in_words(method, words, message):
    with pytest.raises(ValueError) as error:
        diff_settings.from_words(method, words)
    assert str(error.value).startswith(message)


def test_an_option_out_of_its_range_is_no_verdict(folders):
    results = diff.diff(*folders, Settings(How("tolerance", {"fail": -1.0})))
    assert {result.status for result in results.results if None not in (result.reference, result.test)} == {"error"}


def test_the_mean_of_renders_is_that_of_all_and_one_stays_as_it_is():
    pixels = np.arange(36, dtype=np.float32).reshape(3, 2, 2, 3) ** 2
    several = [image_file.Image(Path(f"{i}.exr"), each, ("R", "G", "B")) for i, each in enumerate(pixels)]
    found = diff.mean_image(several)
    np.testing.assert_allclose(found.pixels, pixels.mean(0), rtol=1e-6)
    assert (found.path, found.pixels.dtype) == (Path("0.exr"), np.float32)
    assert diff.mean_image(several[1:2]) is several[1]

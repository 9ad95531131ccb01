"""Comparison of files and folders: pairs, results after errors, exit codes, and commands."""

from __future__ import annotations

import os
import shlex
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.diff_images import image, outcomes, samples, save

from mi_refract.image_diff import accept, methods, name_patterns, pairing, text_reports
from mi_refract.image_diff import folders as diff
from mi_refract.image_diff.comparison import Comparison, Verdict
from mi_refract.image_diff.results import Result, Results, Status
from mi_refract.image_diff.settings import ComparisonSpec, Entry, Map, Settings, from_words
from mi_refract.io import image_file

OSL = Settings(maps=(Map("{dir}/ref/{name}", "{dir}/{name}"),))
VARIANTS = Settings.for_all(accept=("{stem}-*{suffix}",))


def images(folder, gains):
    for name, gain in gains.items():
        image(folder / name, gain=gain)


def test_results_are_sorted_by_the_ratio_to_the_bound(tmp_path):
    """By the largest ratio of a number to its bound; images of one side are last among those that differ."""
    old, new = tmp_path / "old", tmp_path / "new"
    for side, few in ((old, 0), (new, 7)):
        for name, columns in {"a.exr": few, "b.exr": 5 * few, "c.exr": 0, "d.exr": 2 * few}.items():
            pixels = np.full((40, 60, 3), 0.5)
            pixels[:, :columns] = 1
            image_file.write_exr(tmp_path / "x.exr", pixels, ("R", "G", "B"))
            side.mkdir(exist_ok=True)
            (tmp_path / "x.exr").rename(side / name)
    image(old / "0 removed.exr")
    names = ["b.exr", "d.exr", "a.exr", "0 removed.exr", "c.exr"]
    assert [result.name for result in diff.diff(old, new).results] == names


def test_folders_are_matched_by_name(folders):
    old, new = folders
    results = diff.diff(old, new)
    expected = {"added.exr": ("different", "added"), "inner/changed.exr": ("different", "changed")}
    expected |= {"removed.exr": ("different", "removed"), "same.exr": ("equal", "unchanged")}
    assert outcomes(results) == expected
    assert (results.exit_code, results.results[-1].name) == (1, "same.exr")  # failures first
    assert {r.name: r.reason for r in results.results if not r.comparison} == {
        "added.exr": "only among the new images",
        "removed.exr": "only among the references",
    }
    for result in results.results:
        assert result.reference in (None, old / result.name) and result.test in (None, new / result.name)
    commands = {r.name: (bool(results.reproduce(r)), bool(results.accept(r))) for r in results.results}
    expected = {"added.exr": (False, True), "inner/changed.exr": (True, True), "removed.exr": (False, False)}
    assert commands == expected | {"same.exr": (True, False)}
    assert not any(r.comparison and r.comparison.maps for r in results.results)
    has_maps = {r.name: bool(r.comparison.maps) for r in diff.diff(old, new, maps=True).results if r.comparison}
    assert has_maps == {"inner/changed.exr": True, "same.exr": False}
    changed = {"inner/changed.exr": ("different", "changed")}
    assert outcomes(diff.diff(old, new, names=["inner/*"])) == changed
    pair = outcomes(diff.diff(old / "inner/changed.exr", new / "inner/changed.exr"))
    assert pair == {"changed.exr": ("different", "changed")}
    with pytest.raises(ValueError, match=r"none\.exr: matches no image; expected "):
        diff.diff(old, new, names=["none.exr"])
    assert diff.diff(old, new, Settings((Entry("added.exr", {}),)), names=["same.exr"]).unused == ()


# Errors with single images ----------------------------------------------------------------------------------------


def check_one_error(results, name, *words):
    """Assert that one image has an error of one line, and that the others have verdicts."""
    (bad,) = results.of(Status.ERROR)
    assert (bad.name, results.exit_code) == (name, 2)
    assert "\n" not in bad.error and all(word in bad.error for word in words), bad.error
    others = {"added.exr": "different", "inner/changed.exr": "different", "removed.exr": "different"}
    assert {r.name: r.status for r in results.results if r.name not in (name, "same.exr")} == others


PLANTED = [
    (PermissionError(13, "Permission denied", "/old/same.exr"), "/old/same.exr: Permission denied"),
    (MemoryError("Unable to allocate 9 GiB"), "same.exr: out of memory: Unable to allocate 9 GiB"),
    (OverflowError("a method's\nmistake"), "same.exr: internal error: OverflowError: a method's mistake"),
    (AssertionError(), "same.exr: internal error: AssertionError"),
]


@pytest.mark.parametrize(("error", "words"), PLANTED, ids=lambda x: type(x).__name__)
@pytest.mark.parametrize("where", ["read", "compare"])
def test_an_error_with_one_image_does_not_stop_the_others(folders, monkeypatch, where, error, words):
    module, name = {"read": (image_file, "read_parts"), "compare": (methods, "compare")}[where]
    original = getattr(module, name)

    def fail(first, *more, **options):
        path = first if where == "read" else more[0][0].path
        if path.name == "same.exr":
            raise error
        return original(first, *more, **options)

    monkeypatch.setattr(module, name, fail)
    for maps in (False, True):
        check_one_error(diff.diff(*folders, maps=maps), "same.exr", words)


@pytest.mark.parametrize("link", [os.symlink, os.link])
def test_an_image_is_not_compared_with_itself(folders, link):
    old, new = folders
    (new / "same.exr").unlink()
    link(old / "same.exr", new / "same.exr")
    check_one_error(diff.diff(old, new), "same.exr", "the same file")


def test_subfolders_that_cannot_be_read_are_errors(folders, monkeypatch):
    """Folders without permission and links to folders are errors on both sides."""
    for side in folders:
        (side / "linked").symlink_to(side / "inner")
    walk = os.walk

    def refuse(folder, onerror):
        onerror(PermissionError(13, "Permission denied", str(folder / "locked")))
        return walk(folder, onerror=onerror)

    monkeypatch.setattr(os, "walk", refuse)
    results = diff.diff(*folders)
    assert sorted(r.name for r in results.of(Status.ERROR)) == ["linked", "linked", "locked", "locked"]
    assert (results.exit_code, len(results.results)) == (2, 8)


def test_a_folder_that_cannot_be_read_is_an_error_and_not_empty(folders, monkeypatch):
    """The compared folder itself; also where its name begins with a dot."""
    old, new = folders
    new = new.rename(new.parent / ".new")
    walk = os.walk

    def refuse(folder, onerror):
        if folder != new:
            return walk(folder, onerror=onerror)
        onerror(PermissionError(13, "Permission denied", str(folder)))
        return iter(())

    monkeypatch.setattr(os, "walk", refuse)
    results = diff.diff(old, new)
    assert [(r.name, r.error) for r in results.of(Status.ERROR)] == [(".", f"[Errno 13] Permission denied: '{new}'")]
    assert results.exit_code == 2


def test_hidden_images_are_skipped_and_unsupported_formats_are_errors(folders):
    """Images of unsupported formats are skipped, too, if the settings say so."""
    old, new = folders
    hidden, unsupported = (".cache/a.exr", ".hidden.exr", "inner/.b.PNG"), ("inner/photo.HEIC", "a.avif")
    for name in (*hidden, *unsupported, ".a.qoi", "a.txt", "a.svg", ".exr"):
        (new / name).parent.mkdir(exist_ok=True)
        (new / name).write_bytes(b"")
    (new / ".cache/link").symlink_to(old)
    results = diff.diff(old, new)
    skipped = {result.name: text_reports.why(result) for result in results.of(Status.SKIPPED)}
    assert skipped == dict.fromkeys(hidden, "skipped [hidden: a name in its path begins with a dot]")
    errors = {result.name: result.error for result in results.of(Status.ERROR)}
    message = "OpenImageIO does not read {}; expected a format that it reads"
    assert errors == {name: f"{new / name}: {message.format(name[-4:].upper())}" for name in unsupported}
    assert (len(results.results), results.exit_code) == (9, 2)
    skipping = Settings(tuple(Entry(name, {"skip": True, "reason": "no image"}) for name in unsupported))
    results = diff.diff(old, new, skipping)
    assert {x.name for x in results.of(Status.SKIPPED)} == {*hidden, *unsupported} and not results.of(Status.ERROR)


def test_circular_links_do_not_stop_the_comparison(folders):
    old, new = folders
    (old / "a.exr").symlink_to("b.exr")
    (old / "b.exr").symlink_to("a.exr")
    (new / "same-2.exr").symlink_to("same-2.exr")
    for settings in (Settings(), VARIANTS, Settings(maps=(Map("{name}", "{name}"),))):
        statuses = {result.name: str(result.status) for result in diff.diff(old, new, settings).results}
        assert statuses["same.exr"] == "equal" and statuses["a.exr"] == statuses["b.exr"] == "different"
    image(new / "a.exr")
    errors = {result.name: result.reason for result in diff.diff(old, new).of(Status.ERROR)}
    assert errors == {"a.exr": f"{old / 'a.exr'}: Too many levels of symbolic links"}


@pytest.mark.parametrize("spp", [float("nan"), (4, 5, 6), (1.0, 2.0, 3.0), "many", -4, 1, 1e30, 2.5])
def test_an_invalid_number_of_samples_in_a_header_is_an_error(tmp_path, spp):
    for side in ("old", "new"):
        image(tmp_path / side / "same.exr")
        kind = f"{'int' if type(spp[0]) is int else 'float'}[3]" if isinstance(spp, tuple) else ""
        attributes = {"mi_refract:spp": (*([kind] if kind else []), spp)}
        names = ("Y", "Y.variance")
        save(tmp_path / side / "noisy.exr", np.ones((8, 8, 2), np.float32), "float", attributes, channelnames=names)
    results = diff.diff(tmp_path / "old", tmp_path / "new")
    assert {r.name: str(r.status) for r in results.results} == {"noisy.exr": "error", "same.exr": "equal"}
    assert "old/noisy.exr: samples per pixel in its header: " in results.results[0].error


def test_concurrent_pairs_respect_the_limit_of_values(tmp_path, monkeypatch):
    """The large image has as many values as four small ones. With the lower limit it is as large as allowed."""
    for side in ("old", "new"):
        for i in range(12):
            image(tmp_path / side / f"{i}.exr", shape=(8, 8, 3))
        image(tmp_path / side / "large.exr", shape=(8, 32, 3))
        (tmp_path / side / "broken.exr").write_text("none")
    compare, lock, current, maximum = methods.compare, threading.Lock(), 0, 0

    def compare_slowly(method, one, two, **options):
        nonlocal current, maximum
        values = one[0].pixels.size + two[0].pixels.size
        with lock:
            current += values
            maximum = max(maximum, current)
        time.sleep(0.05)
        with lock:
            current -= values
        return compare(method, one, two, **options)

    monkeypatch.setattr(methods, "compare", compare_slowly)
    monkeypatch.setattr(diff, "WORKERS", 8)
    pair = 2 * 8 * 8 * 3
    for limit, least, largest in ((8 * 32 * 3, 2 * pair, 4 * pair), (10**6, 5 * pair, 11 * pair)):
        maximum = 0
        results = diff.diff(tmp_path / "old", tmp_path / "new", Settings(max_values=limit))
        names = ["broken.exr", *sorted([f"{i}.exr" for i in range(12)]), "large.exr"]
        assert [r.name for r in results.results] == names
        assert {r.status for r in results.results[1:]} == {Status.EQUAL}
        assert least <= maximum <= largest


# Work in threads ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("items", "bound"),
    [*(([1, 5, 2, 2, 0, 7, 3, 1, 1, 1, 4, 0, 0, 6] * 3, n) for n in (5, 12, 100)), ([1, 9, 1, 9], 3)],
)
def test_bounded_map_keeps_order_and_bound(items, bound):
    """An item counts from the start of its work until its result is yielded; a larger item is processed alone."""
    lock, current, maximum = threading.Lock(), 0, 0

    def work(item):
        nonlocal current, maximum
        with lock:
            current += item
            maximum = max(maximum, current)
        time.sleep(0.002)
        return item

    for item, result in zip(items, diff.bounded_map(work, items, lambda item: item, bound, 4), strict=True):
        assert result == item
        with lock:
            current -= result
    assert maximum <= max(bound, *items) and (maximum > max(items) or bound < 12)


@pytest.mark.parametrize("size", [0, 1])
def test_bounded_map_keeps_all_threads_busy(size):
    gate = threading.Barrier(4, timeout=10)
    assert list(diff.bounded_map(lambda item: gate.wait() >= 0, range(20), lambda item: size, 4, 4)) == [True] * 20


def test_bounded_map_raises_errors_in_order_and_starts_no_further_items():
    results = diff.bounded_map(lambda item: 6 // item, [1, 2, 0, 3], lambda item: item, 9, 2)
    assert [next(results), next(results)] == [6, 3]
    with pytest.raises(ZeroDivisionError):
        next(results)
    begun = []

    def interrupt(item):
        if item == diff.AHEAD:
            raise KeyboardInterrupt
        return 0

    with pytest.raises(KeyboardInterrupt):
        list(diff.bounded_map(lambda item: begun.append(item) or time.sleep(0.3), range(10), interrupt, 1, 1))
    assert begun in ([], [0])


# Names ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pattern", "name", "same"),
    [
        ("a[1].exr", "a[1].exr", True),
        ("a[1].exr", "a1.exr", False),
        ("glass/*.exr", "glass/a/b.exr", True),
        ("glass/?.exr", "glass/a.exr", True),
        ("glass/?.exr", "glass/ab.exr", False),
        ("*.exr", "a.exr.png", False),
        ("a.exr", "aaexr", False),
        ("*", "line\nbreak.exr", True),
        ("a*ab*b", "aabb", True),
        ("a*ab*b", "aab", False),
        ("*a" * 20 + "b", "a" * 60, False),  # fast for any number of stars
        (20 * "*a", "a" * 60, True),
    ],
)
def test_patterns(pattern, name, same):
    assert name_patterns.matches(pattern, name) == same


@given(st.text("a*?[].\\\n", max_size=6), st.text("ab", max_size=3))
def test_escaped_names_and_filled_templates_match_themselves(name, more):
    assert name_patterns.matches(name_patterns.literal(name), name)
    assert name_patterns.matches(f"{name_patterns.literal(name)}*", name + more)
    values = {"stem": name}
    assert name_patterns.expanded("{stem}-*", values, [f"{name}-{more}", f"b{name}-"]) == [f"{name}-{more}"]


@pytest.mark.parametrize(
    ("template", "name", "values"),
    [
        ("{dir}/ref/{name}", "a/b/ref/out.exr", {"dir": "a/b", "name": "out.exr"}),
        ("{dir}/ref/{name}", "ref/out.exr", {"dir": "", "name": "out.exr"}),
        ("{dir}/ref/{name}", "a/out.exr", None),
        ("{dir}/{stem}.png", "a.b.png", {"dir": "", "stem": "a.b"}),
        ("{stem}_ref{suffix}", "a_ref.exr", {"stem": "a", "suffix": ".exr"}),
        ("{stem}/{stem}.exr", "a/b.exr", None),
        ("{dir}/ref/{dir}/{name}", "a/ref/a/out.exr", {"dir": "a", "name": "out.exr"}),
        ("{dir}/ref/{dir}/{name}", "ref/out.exr", {"dir": "", "name": "out.exr"}),
        ("{dir}/ref/{dir}/{name}", "a/ref/out.exr", None),
        ("{dir}/ref/{dir}/{name}", "ref/a/out.exr", None),
        ("{dir}/ref/{dir}/{name}", "ref/ref/ref/out.exr", {"dir": "ref", "name": "out.exr"}),
    ],
)
def test_templates_parse_and_form_names(template, name, values):
    assert name_patterns.parsed(template, name) == values
    if values is not None:
        assert name_patterns.filled(template, values) == name


@pytest.mark.parametrize("template", ["{root}//etc/x.png", "/etc/x.png", "{stem}//x", "../x", "{root}/../x", "", "a/"])
def test_templates_outside_the_folder_are_refused(template):
    with pytest.raises(ValueError, match=r"mask: .*; expected a relative path inside the folder"):
        from_words("", [f"mask={template}"])


def test_templates_give_the_paths_of_masks_and_variants(tmp_path):
    target = tmp_path / "a/ball.exr"
    assert pairing.beside("{stem}_mask.png", target, tmp_path) == tmp_path / "a/ball_mask.png"
    assert pairing.beside("{root}/masks/{dir}/{stem}.png", target, tmp_path) == tmp_path / "masks/a/ball.png"
    how = ComparisonSpec(accept=("{stem}-arm64{suffix}", "{stem}-macos{suffix}", "{stem}-*{suffix}"))
    for name in ("macos", "arm64", "icx", "fix", "stem"):  # the last two are in the names of fields
        assert pairing.variant(target, how, name) == tmp_path / f"a/ball-{name}.exr"
    with pytest.raises(ValueError, match=r"no template in `accept` contains icx or exactly one \*; add .*-icx\{suffix"):
        pairing.variant(target, ComparisonSpec(accept=("{stem}-macos{suffix}",)), "icx")


def test_maps_pair_references_in_subfolders_with_new_images(tmp_path):
    old, new = tmp_path / "old", tmp_path / "new"
    images(old, dict.fromkeys(("a/ref/out.exr", "ref/top.exr", "a/checker.exr", "b/ref/lost.exr"), 1))
    images(new, {"a/out.exr": 1, "top.exr": 1, "c/added.exr": 1})
    results = diff.diff(old, new, OSL)
    expected = {"a/out.exr": ("equal", "unchanged"), "b/lost.exr": ("different", "removed")}
    expected |= {"c/added.exr": ("different", "added"), "top.exr": ("equal", "unchanged")}
    assert outcomes(results) == expected
    (added,) = [result for result in results.results if result.name == "c/added.exr"]
    assert added.target == old / "c/ref/added.exr"
    images(tmp_path / "tree", {"a/ref/out.exr": 1, "a/out.exr": 1.1})  # both in one tree
    results = diff.diff(tmp_path / "tree", tmp_path / "tree", OSL)
    assert outcomes(results) == {"a/out.exr": ("different", "changed")}
    assert results.reproduce(results.results[0]) == f"mi-refract diff {tmp_path}/tree {tmp_path}/tree a/out.exr"
    images(tmp_path / "two", {"ref/a.exr": 1, "base/a.exr": 1})  # two references of one image
    maps = (Map("ref/{name}", "{name}"), Map("base/{name}", "{name}"))
    (result, *_) = diff.diff(tmp_path / "two", tmp_path / "tree/a", Settings(maps=maps)).results
    assert result.status == "error" and "a second reference, beside" in result.error


# Variants ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def variants(tmp_path):
    """Folders with an image that is equal to the second of two variants of its reference."""
    images(tmp_path / "old/a", {"ball.exr": 1, "ball-mac.exr": 1.2, "ball-arm.exr": 1.4, "other.exr": 1})
    images(tmp_path / "new/a", {"ball.exr": 1.4, "other.exr": 1})
    return tmp_path / "old", tmp_path / "new"


def test_an_equal_variant_passes_and_is_named(variants):
    old, new = variants
    results = diff.diff(old, new, VARIANTS)
    assert outcomes(results) == {"a/ball.exr": ("equal", "unchanged"), "a/other.exr": ("equal", "unchanged")}
    (ball,) = [result for result in results.results if result.name == "a/ball.exr"]
    assert ball.matched == old / "a/ball-arm.exr"
    assert ball.reason.endswith("; matches ball-arm.exr")
    assert text_reports.sentence(results) == "2 images: 2 equal; 2 further references"
    files = diff.diff(old / "a/ball.exr", new / "a/ball.exr", VARIANTS)
    assert files.results[0].matched == old / "a/ball-arm.exr"
    assert outcomes(diff.diff(old, new))["a/ball-arm.exr"] == ("different", "removed")
    images(old, {"a/mac/ball.exr": 1.4})  # in a subfolder
    for sides in ((old, new), (old / "a/ball.exr", new / "a/ball.exr")):
        results = diff.diff(*sides, Settings.for_all(accept=("mac/{name}",))).results
        assert old / "a/mac/ball.exr" in [result.matched for result in results]


INFIX = [
    ("{stem}.ref{suffix}", "{stem}{suffix}", "{stem}-*.ref{suffix}", "ball.ref.exr", "ball-arm.ref.exr"),
    ("ref-{name}", "{name}", "ref-{stem}-*{suffix}", "ref-ball.exr", "ref-ball-arm.exr"),
    ("ref-{name}", "{name}", "ref-*/{name}", "ref-ball.exr", "ref-arm/ball.exr"),
]


@pytest.mark.parametrize(("reference", "test", "template", "first", "variant"), INFIX)
def test_templates_of_accept_have_the_fields_of_the_map(tmp_path, reference, test, template, first, variant):
    images(tmp_path, {f"old/a/{first}": 1, f"old/a/{variant}": 1.4, "new/a/ball.exr": 1.4})
    rules = Settings.for_all(accept=("{stem}.gone{suffix}", template)).rules
    settings = Settings(rules, (Map("gone/{name}", "{name}"), Map(f"{{dir}}/{reference}", f"{{dir}}/{test}")))
    results = diff.diff(tmp_path / "old", tmp_path / "new", settings)
    (ball,) = results.results
    assert (ball.name, ball.status, ball.matched) == ("a/ball.exr", "equal", tmp_path / "old/a" / variant)
    assert pairing.variant(ball.target, ball.how, "arm") == ball.matched
    assert results.unused == ("accept = '{stem}.gone{suffix}'",)


def test_references_that_are_not_variants_and_unreadable_variants(variants):
    old, new = variants
    results = diff.diff(old, new, Settings.for_all(accept=("{stem}*",)))
    assert {result.status for result in results.results} == {"error"}
    assert "matches the reference" in results.results[0].error
    images(new, {"a/ball-arm.exr": 1.4})  # the variant has a new image with its name
    equal = dict.fromkeys(("a/ball-arm.exr", "a/other.exr"), ("equal", "unchanged"))
    assert outcomes(diff.diff(old, new, VARIANTS)) == {"a/ball.exr": ("different", "changed")} | equal
    (new / "a/ball-arm.exr").unlink()
    image(old / "a/ball.exr", shape=(8, 8, 3))  # the reference cannot be compared, but a variant is equal
    assert outcomes(diff.diff(old, new, VARIANTS))["a/ball.exr"] == ("equal", "unchanged")
    (old / "a/ball-arm.exr").write_bytes(b"no image")
    ball = diff.diff(old, new, VARIANTS).results[0]
    assert ball.status is Status.ERROR and "size 48 × 32; expected 8 × 8" in ball.error  # that of the reference
    images(old, {"a/ball.exr": 1, "a/ball-arm.exr": 1.1})
    (ball,) = diff.diff(old, new, VARIANTS).results[:1]
    assert (ball.status, ball.matched) == ("different", None)
    assert ball.reason.endswith("; its 2 variants differ, too")


def test_the_reference_of_another_new_image_is_no_variant_of_a_file(tmp_path):
    """As for two folders; unless the new image itself has that name."""
    images(tmp_path / "old", {"ball.exr": 1, "ball-red.exr": 1.4, "red/ball.exr": 1.4})
    images(tmp_path / "new", {"ball.exr": 1.4, "ball-red.exr": 1.4, "red/ball.exr": 1.4})
    for template in ("{stem}-*{suffix}", "*/{name}"):
        settings = Settings.for_all(accept=(template,))
        assert outcomes(diff.diff(tmp_path / "old", tmp_path / "new", settings))["ball.exr"][0] == "different"
        (result,) = diff.diff(tmp_path / "old/ball.exr", tmp_path / "new/ball.exr", settings).results
        assert (result.status, result.variants) == ("different", ())
    (result,) = diff.diff(tmp_path / "old/ball.exr", tmp_path / "new/ball-red.exr", VARIANTS).results
    assert (result.status, result.matched) == ("equal", tmp_path / "old/ball-red.exr")


@pytest.mark.parametrize("template", ["{stem}-*{suffix}", "*/{name}"])
def test_the_folder_of_a_first_reference_need_not_exist(template, tmp_path):
    image(tmp_path / "new/ball.exr")
    sides, settings = (tmp_path / "old/ball.exr", tmp_path / "new/ball.exr"), Settings.for_all(accept=(template,))
    (copy,) = accept.changes(diff.diff(*sides, settings, to_accept=True))
    assert copy.reference == tmp_path / "old/ball.exr"


def test_wildcards_of_accept_match_no_slash(tmp_path):
    """A variant is in the folder that its template names, for two folders as for two files."""
    images(tmp_path, {"old/ball.exr": 1, "old/ball-anim/1.exr": 1.4, "old/mac/a/ball.exr": 1.4, "new/ball.exr": 1})
    settings = Settings.for_all(accept=("{stem}-*{suffix}", "m*/{name}"))
    removed = dict.fromkeys(("ball-anim/1.exr", "mac/a/ball.exr"), ("different", "removed"))
    expected = {"ball.exr": ("equal", "unchanged")} | removed
    assert outcomes(diff.diff(tmp_path / "old", tmp_path / "new", settings)) == expected
    image(tmp_path / "new/ball.exr", gain=1.4)
    assert diff.diff(tmp_path / "old/ball.exr", tmp_path / "new/ball.exr", settings).exit_code == 1


def test_an_inconclusive_variant_makes_the_result_inconclusive(tmp_path, monkeypatch):
    """The new image differs from the reference, but may be equal to the variant."""
    images(tmp_path, {"old/a.exr": 1, "old/a-2.exr": 1, "new/a.exr": 2})
    verdicts = {"a.exr": Verdict.DIFFERENT, "a-2.exr": Verdict.INCONCLUSIVE}
    monkeypatch.setattr(methods, "compare", lambda m, one, *_, **__: Comparison(m, verdicts[one[0].path.name], "why"))
    (result,) = diff.diff(tmp_path / "old", tmp_path / "new", VARIANTS).results
    assert result.status is Status.INCONCLUSIVE


def test_a_new_image_is_never_its_own_reference(tmp_path):
    images(tmp_path, {"ball.exr": 1, "ball-new.exr": 1.5})
    settings = Settings.for_all(accept=("{stem}-*{suffix}",), method="exact")
    assert outcomes(diff.diff(tmp_path / "ball.exr", tmp_path / "ball-new.exr", settings))["ball.exr"][0] == "different"
    mapped = replace(settings, maps=(Map("{stem}.exr", "{stem}-new.exr"),))
    assert outcomes(diff.diff(tmp_path, tmp_path, mapped))["ball-new.exr"] == ("different", "changed")
    rules = (Entry("", {"accept": ("*/{name}",), "method": "exact"}),)
    deep = Settings(rules, maps=(Map("{name}", "out/{name}"),))
    image(tmp_path / "out/ball.exr", gain=1.5)
    results = diff.diff(tmp_path, tmp_path, deep, names=["out/ball.exr"]).results
    assert {result.name: result.status for result in results} == {"out/ball.exr": "different"}


# Exit codes and commands ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("statuses", "inconclusive", "code"),
    [
        ([], "", 2),
        (["skipped"], "", 2),
        (["equal", "skipped"], "", 0),
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


@pytest.mark.parametrize(
    ("name", "flags", "files", "expected"),
    [
        ("ball.exr", (), True, ("diff {old}/ball.exr {new}/ball.exr", "accept {old}/ball.exr {new}/ball.exr")),
        ("ball.exr", ("--set", "fail=0.01"), False, ("diff {old} {new} --set fail=0.01 ball.exr",) * 2),
        ("-a b.exr", (), False, ("diff {old} {new} -- '-a b.exr'",) * 2),
        ("a*.exr", (), False, (r"diff {old} {new} 'a\*.exr'",) * 2),  # the name of one image, not a pattern
        (r"\*b.exr", (), False, (r"diff {old} {new} '\\\*b.exr'",) * 2),
    ],
)
def test_reproduce_and_accept_commands_work(tmp_path, run, monkeypatch, name, flags, files, expected):
    old, new = tmp_path / "old", tmp_path / "new"
    for side, gain in ((old, 1.0), (new, 1.2)):
        images(side, {name: gain, "ab.exr": gain})
    settings = Settings.for_all(**{"fail": 0.01} if flags else {})
    sides = (old / name, new / name) if files else (old, new)
    results = diff.diff(*sides, Settings(settings.rules, flags=flags))
    (result,) = [result for result in results.results if result.name == name]
    commands = results.reproduce(result), results.accept(result)
    words = [text.format(old=old, new=new).removeprefix("diff ").removeprefix("accept ") for text in expected]
    assert commands == (f"mi-refract diff {words[0]}", f"mi-refract accept {words[1]}")
    assert run(*shlex.split(commands[0])[1:])[0] == 1
    assert run("accept", "--yes", *shlex.split(commands[1])[2:])[0] == 0
    assert run(*shlex.split(commands[0])[1:])[0] == 0
    assert [result.name for result in diff.diff(old, new).of(Status.DIFFERENT)] == ["ab.exr"]
    monkeypatch.chdir(tmp_path)
    images(Path(), {"-a.exr": 1, "-b.exr": 1.1})
    results = diff.diff("-a.exr", "-b.exr")
    assert results.reproduce(results.results[0]) == "mi-refract diff ./-a.exr ./-b.exr"


# Renders ----------------------------------------------------------------------------------------------------------


def test_renders(tmp_path):
    old = samples(tmp_path / "old")
    for first, gain, status in ((100, 1.0, ("equal", "unchanged")), (200, 1.3, ("different", "changed"))):
        new = samples(tmp_path / str(first), first=first, gain=gain)
        results = diff.diff(old, new, renders=True)
        (result,) = results.results
        assert outcomes(results) == {"old": status}
        assert (result.comparison.method, result.reference, result.test) == ("welch", old, new)
        assert results.reproduce(result) == f"mi-refract diff {old} {new} --renders"
    old, new = samples(tmp_path / "few", 2, noise=1.0), samples(tmp_path / "others", 2, 100, noise=1.0)
    assert diff.diff(old, new, renders=True).exit_code == 3


def test_invalid_renders_are_errors(tmp_path):
    good = samples(tmp_path / "good")
    twice = samples(tmp_path / "twice", first=100)
    (twice / "again.exr").write_bytes((twice / "3.exr").read_bytes())
    (tmp_path / "empty").mkdir()
    for name in ("1.exr", "2.exr"):
        image(tmp_path / "nan" / name, value=np.nan)
    for folder, message in [
        (twice, "expected renders with different seeds"),
        (tmp_path / "nan", "expected renders with different seeds"),
        (samples(tmp_path / "one", 1, 200), "one"),
        (tmp_path / "empty", "empty: contains no image"),
    ]:
        results = diff.diff(good, folder, renders=True)
        assert results.exit_code == 2 and message in results.results[0].error
    sizes = samples(tmp_path / "sizes", first=300)
    image(sizes / "2.exr", shape=(16, 48, 3))  # renders of different sizes have no mean
    results = diff.diff(good, sizes, renders=True, maps=True)
    assert results.exit_code == 2 and results.results[0].error.startswith(f"{sizes / '2.exr'}: size 48 × 16")
    assert results.results[0].images.keys() == {"reference"} and results.results[0].unread
    with pytest.raises(NotADirectoryError, match=r"0\.exr: not a folder; --renders expects folders"):
        diff.diff(good, twice / "0.exr", renders=True)

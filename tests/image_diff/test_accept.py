"""What `mi-refract accept` and its engine take over, and what stays as it is."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
import pytest
import typer
from support.diff_images import BROKEN, found, image, tree

from mi_refract.cli import diff as cli_diff
from mi_refract.image_diff import accept
from mi_refract.image_diff import folders as diff
from mi_refract.image_diff.folders import Category
from mi_refract.image_diff.settings import How, Settings


def test_what_is_accepted(folders):
    old, new = folders
    results = diff.diff(old, new)
    copies = list(accept.changes(results))
    assert copies == [(new / n, old / n) for n in ("added.exr", "inner/changed.exr")]
    before = (old / "inner/changed.exr").read_bytes()
    assert {p.name for p in old.rglob("*.exr")} == {"same.exr", "changed.exr", "removed.exr"}
    assert (old / "inner/changed.exr").read_bytes() == before
    accept.accept(copies, results.began)
    assert found(diff.diff(old, new)) == {
        "removed.exr": ("different", "removed"),
        "added.exr": ("equal", "unchanged"),
        "inner/changed.exr": ("equal", "unchanged"),
        "same.exr": ("equal", "unchanged"),
    }
    assert not list(old.rglob("*.part"))


def test_a_reference_that_is_not_there_yet(folders, tmp_path):
    old, new = folders
    results = diff.diff(tmp_path / "first", new, new=True)
    accept.accept(list(accept.changes(results)), results.began)
    assert diff.diff(tmp_path / "first", new).exit_code == 0
    assert not (tmp_path / "first" / "notes.txt").exists()
    one = tmp_path / "deep" / "one.exr"
    results = diff.diff(one, new / "same.exr", new=True)
    assert results.results[0].category is Category.ADDED
    accept.accept(list(accept.changes(results)), results.began)
    assert one.read_bytes() == (new / "same.exr").read_bytes()
    assert diff.diff(old, new, new=True).exit_code == 1


@pytest.mark.parametrize("name", ["truncated", "empty", "text", "several parts", "deep", "zero size"])
def test_a_bad_image_becomes_no_reference(folders, name):
    old, new = folders
    bad = new / "same.exr"
    bad.unlink()
    BROKEN[name](bad)
    with pytest.raises(ValueError, match=r"same\.exr"):
        list(accept.changes(diff.diff(old, new)))


def test_a_bad_added_image_becomes_no_reference(folders):
    BROKEN["truncated"](folders[1] / "added.exr")
    with pytest.raises(ValueError, match=r"added\.exr"):
        list(accept.changes(diff.diff(*folders)))


@pytest.mark.parametrize("name", ["ref.png", "folder"])
def test_a_reference_is_of_the_format_that_its_name_says(folders, tmp_path, name):
    results = diff.diff(tmp_path / name, folders[1] / "same.exr", new=True)
    with pytest.raises(ValueError, match=r"accepted: a name that ends in \.exr"):
        list(accept.changes(results))


def test_a_bad_reference_can_be_replaced(folders):
    old, new = folders
    BROKEN["truncated"](old / "same.exr")
    copies = list(accept.changes(diff.diff(old, new)))
    assert (new / "same.exr", old / "same.exr") in copies


def test_values_that_are_not_finite_become_no_reference(folders):
    image(folders[1] / "same.exr", value=np.inf)
    with pytest.raises(ValueError, match="not finite; accepted with --allow-nonfinite"):
        list(accept.changes(diff.diff(*folders)))
    named = Settings(allow_nonfinite=("same.exr",))
    assert len(list(accept.changes(diff.diff(*folders, named)))) == 3


def test_a_copy_that_fails_leaves_the_old_reference(folders, monkeypatch):
    old, new = folders
    before = (old / "inner/changed.exr").read_bytes()
    monkeypatch.setattr("pathlib.Path.replace", lambda *a: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        accept.accept([(new / "inner/changed.exr", old / "inner/changed.exr")], time.time_ns())
    assert (old / "inner/changed.exr").read_bytes() == before
    assert not list(old.rglob("*.part"))


def test_a_name_with_a_dash_is_no_option_of_the_command(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    image(Path("-a.exr"))
    image(Path("-b.exr"), gain=1.1)
    results = diff.diff("-a.exr", "-b.exr")
    assert results.reproduce(results.results[0]) == "mi-refract diff ./-a.exr ./-b.exr"
    assert results.accept(results.results[0]) == "mi-refract accept ./-a.exr ./-b.exr"


def test_the_commands_do_what_they_say(folders):
    old, new = folders
    results = diff.diff(old, new, Settings(How("tolerance", {"fail": 0.01})))
    by_name = {result.name: result for result in results.results}
    pair = f"{old}/inner/changed.exr {new}/inner/changed.exr --method tolerance --set fail=0.01"
    assert results.reproduce(by_name["inner/changed.exr"]) == f"mi-refract diff {pair}"
    assert results.accept(by_name["inner/changed.exr"]) == f"mi-refract accept {pair}"
    assert results.reproduce(by_name["added.exr"]) == ""
    assert results.accept(by_name["added.exr"]).startswith(f"mi-refract accept {old}/added.exr {new}/added.exr")
    assert results.accept(by_name["removed.exr"]) == results.accept(by_name["same.exr"]) == ""


# The command ------------------------------------------------------------------------------------------------------


@pytest.fixture
def terminal(monkeypatch):
    """`terminal(True)`: a person at a terminal who says yes."""

    def sit(answer):
        asked = []
        monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
        monkeypatch.setattr(typer, "confirm", lambda text: asked.append(text) or answer)
        return asked

    return sit


def test_accept(run, pair):
    old, new = pair
    image(new / "inner" / "added.exr")
    equal = {"equal.exr": tree(old)["equal.exr"]}  # not copied: another second of writing is no difference
    code, out, err = run("accept", old, new, "--yes")
    assert (code, err) == (0, "")
    assert f"{new}/louder.exr → {old}/louder.exr\n" in out
    assert f"{new}/inner/added.exr → {old}/inner/added.exr (new)\n" in out
    assert out.splitlines()[-1] == "2 accepted"
    assert tree(old) == tree(new) | equal
    assert run("accept", old, new, "--yes")[1].splitlines()[-1] == "nothing to accept"


def test_accept_takes_nothing_that_changed_since(run, pair, monkeypatch):
    before = tree(pair[0])

    def late(count):
        image(pair[1] / "louder.exr", value=0.1)
        return True

    monkeypatch.setattr(cli_diff, "_agreed", late)
    code, out, err = run("accept", *pair)
    assert code == 2
    assert "accepted\n" not in out
    assert "louder.exr: changed since it was compared; accepted: what was shown\n" in err
    assert tree(pair[0]) == before


def test_accept_asks_first(run, pair, terminal):
    old, new = pair
    before = tree(old)
    asked = terminal(False)
    code, out, _ = run("accept", old, new)
    assert (code, out.splitlines()[-1]) == (1, "nothing accepted")
    assert asked == ["Accept 1 as the reference?"]
    assert tree(old) == before
    terminal(True)
    assert run("accept", old, new)[0] == 0
    assert tree(old) == before | {"louder.exr": tree(new)["louder.exr"]}  # an EXR file holds the second it was written


def test_accept_does_not_ask_a_script(run, pair, monkeypatch):
    before = tree(pair[0])
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False, raising=False)
    code, out, err = run("accept", *pair)
    assert (code, err) == (2, "mi-refract: accept asks on a terminal only; accepted elsewhere: --yes\n")
    assert "louder.exr" in out
    assert tree(pair[0]) == before


def test_accept_judges_like_diff(run, pair):
    before = tree(pair[0])
    tolerant = ["--method", "tolerance", "--set", "fail=0.2"]
    assert run("accept", *pair, "--yes", *tolerant)[1].splitlines()[-1] == "nothing to accept"
    assert tree(pair[0]) == before


def test_accept_takes_all_or_nothing(run, pair):
    BROKEN["truncated"](pair[1] / "equal.exr")
    before = tree(pair[0])
    code, _, err = run("accept", *pair, "--yes")
    assert code == 2
    assert "equal.exr" in err
    assert tree(pair[0]) == before


def test_accept_keeps_what_was_removed(run, pair):
    (pair[1] / "equal.exr").unlink()
    assert run("accept", *pair, "--yes")[0] == 0
    assert (pair[0] / "equal.exr").exists()
    assert run("diff", *pair)[0] == 1

"""What `mi-refract accept` and its engine take over, and what stays as it is."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import typer
from support.diff_images import BROKEN, found, image, tree

from mi_refract.cli import accept as cli_accept
from mi_refract.image_diff import accept
from mi_refract.image_diff import folders as diff
from mi_refract.image_diff.results import Category
from mi_refract.image_diff.settings import ComparisonSpec, Settings


def to_accept(old, new, *settings):
    return list(accept.changes(diff.diff(old, new, *settings, to_accept=True)))


def test_what_is_accepted(folders):
    old, new = folders
    copies = to_accept(old, new)
    assert [(c.new, c.reference) for c in copies] == [(new / n, old / n) for n in ("added.exr", "inner/changed.exr")]
    before = (old / "inner/changed.exr").read_bytes()
    assert {p.name for p in old.rglob("*.exr")} == {"same.exr", "changed.exr", "removed.exr"}
    assert (old / "inner/changed.exr").read_bytes() == before
    accept.accept(copies)
    assert found(diff.diff(old, new)) == {
        "removed.exr": ("different", "removed"),
        "added.exr": ("equal", "unchanged"),
        "inner/changed.exr": ("equal", "unchanged"),
        "same.exr": ("equal", "unchanged"),
    }
    assert not list(old.rglob("*.part"))


def test_a_reference_that_is_not_there_yet(folders, tmp_path):
    old, new = folders
    accept.accept(to_accept(tmp_path / "first", new))
    assert diff.diff(tmp_path / "first", new).exit_code == 0
    assert not (tmp_path / "first" / "notes.txt").exists()
    one = tmp_path / "deep" / "one.exr"
    results = diff.diff(one, new / "same.exr", to_accept=True)
    assert results.results[0].category is Category.ADDED
    accept.accept(list(accept.changes(results)))
    assert one.read_bytes() == (new / "same.exr").read_bytes()
    assert diff.diff(old, new, to_accept=True).exit_code == 1


@pytest.mark.parametrize("name", ["truncated", "empty", "text", "deep", "zero size"])
def test_a_bad_image_becomes_no_reference(folders, name):
    old, new = folders
    bad = new / "same.exr"
    bad.unlink()
    BROKEN[name](bad)
    with pytest.raises(ValueError, match=r"same\.exr"):
        to_accept(old, new)


def test_a_bad_added_image_becomes_no_reference(folders):
    BROKEN["truncated"](folders[1] / "added.exr")
    with pytest.raises(ValueError, match=r"added\.exr"):
        to_accept(*folders)


@pytest.mark.parametrize("name", ["ref.png", "folder"])
def test_a_reference_is_of_the_format_that_its_name_says(folders, tmp_path, name):
    with pytest.raises(ValueError, match=r"expected a name that ends in \.exr"):
        to_accept(tmp_path / name, folders[1] / "same.exr")


def test_a_bad_reference_can_be_replaced(folders):
    old, new = folders
    BROKEN["truncated"](old / "same.exr")
    assert (new / "same.exr", old / "same.exr") in [(copy.new, copy.reference) for copy in to_accept(old, new)]


def test_values_that_are_not_finite_become_no_reference(folders):
    image(folders[1] / "same.exr", value=np.inf)
    with pytest.raises(ValueError, match="not finite; accepted with --allow-nonfinite"):
        to_accept(*folders)
    named = Settings(allow_nonfinite=("same.exr",))
    assert len(to_accept(*folders, named)) == 3


def test_a_copy_that_fails_leaves_the_old_reference(folders, monkeypatch):
    old, new = folders
    before = (old / "inner/changed.exr").read_bytes()
    monkeypatch.setattr("pathlib.Path.replace", lambda *a: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        accept.accept(to_accept(old, new))
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
    results = diff.diff(old, new, Settings(ComparisonSpec("tolerance", {"fail": 0.01})))
    by_name = {result.name: result for result in results.results}
    pair = f"{old}/inner/changed.exr {new}/inner/changed.exr --method tolerance --set fail=0.01"
    assert results.reproduce(by_name["inner/changed.exr"]) == f"mi-refract diff {pair}"
    assert results.accept(by_name["inner/changed.exr"]) == f"mi-refract accept {pair}"
    assert results.reproduce(by_name["added.exr"]) == ""
    assert results.accept(by_name["added.exr"]).startswith(f"mi-refract accept {old}/added.exr {new}/added.exr")
    assert results.accept(by_name["removed.exr"]) == results.accept(by_name["same.exr"]) == ""


# What changes meanwhile -------------------------------------------------------------------------------------------


def test_the_clock_of_a_file_does_not_matter(folders):
    old, new = folders
    ahead = time.time() + 3600
    for name in ("added.exr", "inner/changed.exr"):
        os.utime(new / name, (ahead, ahead))
    accept.accept(to_accept(old, new))
    assert (old / "added.exr").read_bytes() == (new / "added.exr").read_bytes()


def rewritten(path):
    """Another image of the same name, with the times of the old one."""
    times = path.stat()
    image(path, gain=3.0)
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))


def renamed(folder):
    """Another folder of the same name: no file in it was written since, nor renamed."""
    folder.rename(folder.with_name("before"))
    folder.with_name("other").rename(folder)


CHANGED = {
    "new image": ("inner/changed.exr", lambda old, new: rewritten(new / "inner/changed.exr")),
    "new folder": ("inner/changed.exr", lambda old, new: renamed(new / "inner")),
    "link": ("linked.exr", lambda old, new: ((new / "linked.exr").unlink(), image(new / "linked.exr", gain=3.0))),
    "gone": ("added.exr", lambda old, new: (new / "added.exr").unlink()),
    "reference": ("inner/changed.exr", lambda old, new: rewritten(old / "inner/changed.exr")),
    "reference gone": ("inner/changed.exr", lambda old, new: (old / "inner/changed.exr").unlink()),
    "reference there": ("added.exr", lambda old, new: image(old / "added.exr")),
    "reference a folder": ("added.exr", lambda old, new: (old / "added.exr").mkdir()),
}


@pytest.mark.parametrize("name, change", CHANGED.values(), ids=CHANGED)
def test_what_changed_since_it_was_compared_is_not_accepted(folders, tmp_path, name, change):
    old, new = folders
    image(new / "other" / "changed.exr", gain=3.0)
    image(tmp_path / "linked.exr", gain=2.0)
    (new / "linked.exr").symlink_to(tmp_path / "linked.exr")
    image(new / "fresh" / "folder" / "added.exr")
    copies = to_accept(old, new)
    assert len(copies) == 5
    change(old, new)
    before, all_before = tree(old), sorted(old.rglob("*"))
    said = "'?$|: changed since it was compared"
    with pytest.raises((OSError, ValueError), match=f"{name}({said})"):
        accept.accept(copies)
    assert tree(old) == before
    assert sorted(old.rglob("*")) == all_before


def test_no_pipe_or_device_is_read(tmp_path):
    os.mkfifo(tmp_path / "a.exr")
    (tmp_path / "b.exr").symlink_to("/dev/null")
    for path in (tmp_path / "a.exr", tmp_path / "b.exr"):
        with pytest.raises(ValueError, match=r"\.exr: expected a regular file"):
            diff.digest(path)


@pytest.mark.parametrize("side", [0, 1])
def test_what_changes_while_it_is_copied_is_not_accepted(folders, monkeypatch, side):
    copies, copied = to_accept(*folders), accept._copied

    def late(source, to):
        digest = copied(source, to)
        rewritten(folders[side] / "inner/changed.exr")
        return digest

    monkeypatch.setattr(accept, "_copied", late)
    before = tree(folders[0]).keys()
    with pytest.raises(OSError, match=r"changed\.exr: changed since it was compared"):
        accept.accept(copies)
    assert tree(folders[0]).keys() == before


def test_only_bytes_that_were_shown_are_copied(folders, monkeypatch):
    """Even where what is read for the copy is not what was there before and after."""
    copies, before = to_accept(*folders), tree(folders[0])
    monkeypatch.setattr(accept, "_require_unchanged", lambda copies: None)
    rewritten(folders[1] / "inner/changed.exr")
    with pytest.raises(OSError, match=r"changed\.exr: changed since it was compared"):
        accept.accept(copies)
    assert tree(folders[0]) == before


def test_of_several_copies_none_is_made_where_one_fails(folders, monkeypatch):
    """As on a full disk, after the first copy."""
    copies, before, copied = to_accept(*folders), tree(folders[0]), accept._copied

    def full(source, to):
        if source == copies[-1].new:
            raise OSError(28, "No space left on device", str(to))
        return copied(source, to)

    monkeypatch.setattr(accept, "_copied", full)
    with pytest.raises(OSError, match="No space"):
        accept.accept(copies)
    assert tree(folders[0]) == before


def test_a_reference_that_cannot_be_read_is_not_replaced(folders, monkeypatch):
    """Nobody could say whether it changed. By a planted error: who runs as root may read everything."""
    digest = diff.digest

    def refuse(path):
        if path == folders[0] / "same.exr":
            raise PermissionError(13, "Permission denied", str(path))
        return digest(path)

    monkeypatch.setattr(diff, "digest", refuse)
    with pytest.raises(ValueError, match=r"same\.exr: Permission denied"):
        to_accept(*folders)


def test_results_without_digests_are_not_accepted(folders):
    with pytest.raises(ValueError, match=r"added\.exr: compared without digests"):
        list(accept.changes(diff.diff(*folders)))


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

    monkeypatch.setattr(cli_accept, "_agreed", late)
    code, out, err = run("accept", *pair)
    assert code == 2
    assert "accepted\n" not in out
    assert "louder.exr: changed since it was compared; expected what was shown\n" in err
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
    assert (code, err) == (2, "mi-refract: accept asks on a terminal only; elsewhere expected --yes\n")
    assert "louder.exr" in out
    assert tree(pair[0]) == before


def test_accept_judges_like_diff(run, pair):
    before = tree(pair[0])
    tolerant = ["--method", "tolerance", "--set", "fail=0.2"]
    assert run("accept", *pair, "--yes", *tolerant)[1].splitlines()[-1] == "nothing to accept"
    assert tree(pair[0]) == before


def test_accept_takes_all_or_nothing(run, pair):
    """And says once why: each image that cannot be compared has a line."""
    for broken in (["equal.exr"], ["equal.exr", "louder.exr"]):
        BROKEN["truncated"](pair[1] / broken[-1])
        before = tree(pair[0])
        code, out, err = run("accept", *pair, "--yes")
        assert code == 2 and "→" not in out
        assert [line.partition(".exr:")[0] for line in err.splitlines()] == [
            f"mi-refract: {pair[1] / name}".removesuffix(".exr") for name in broken
        ]
        assert tree(pair[0]) == before


def test_accept_says_what_diff_does_not_mind(run, pair):
    for side in pair:
        image(side / "louder.exr", value=np.nan)
    code, _, err = run("accept", *pair, "--yes")
    assert code == 2 and len({*err.splitlines()}) == err.count("\n") > 0


def test_accept_keeps_what_was_removed(run, pair):
    (pair[1] / "equal.exr").unlink()
    assert run("accept", *pair, "--yes")[0] == 0
    assert (pair[0] / "equal.exr").exists()
    assert run("diff", *pair)[0] == 1

"""`mi-refract accept`: which images are copied, which bytes are copied, and which images are refused."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import time
from types import SimpleNamespace

import numpy as np
import OpenImageIO
import pytest
import typer
from support.diff_images import BROKEN, image, outcomes, tree
from support.processes import assert_refused, python

from mi_refract.image_diff import accept
from mi_refract.image_diff import folders as diff
from mi_refract.image_diff.results import Status
from mi_refract.image_diff.settings import Entry, Settings
from mi_refract.io import safe_files

SETTINGS = '[defaults]\naccept = ["no-star.exr", "{stem}-?.exr", "{stem}-*.exr", "{stem}_*.exr"]\n'
CHANGED = "changed since it was compared"


def to_accept(old, new, *settings):
    return list(accept.changes(diff.diff(old, new, *settings, to_accept=True)))


@pytest.fixture
def terminal(monkeypatch):
    """`terminal(answer)`: make stdin a terminal and call `answer(question)` to confirm; it may have side effects."""

    def simulate(answer):
        monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
        monkeypatch.setattr(typer, "confirm", answer)

    return simulate


@pytest.fixture
def compared(run, pair, tmp_path):
    """A folder with a pair that differs, an added image and a removed one, and the JSON of its comparison."""
    old, new = pair
    image(new / "inner" / "added.exr")
    image(old / "removed.exr")
    out = tmp_path / "out.json"
    assert run("diff", old, new, "--json", out)[0] == 1
    return old, new, out


# What is copied ---------------------------------------------------------------------------------------------------


def test_accept_copies_images_that_differ_and_keeps_removed_ones(run, folders, monkeypatch):
    old, new = folders
    before, names = tree(old), ("added.exr", "inner/changed.exr")
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False, raising=False)
    code, out, err = run("accept", old, new)  # without a terminal
    refusal = "accept asks for confirmation on a terminal; without a terminal, pass --yes\n"
    assert (code, err.partition(" ")[2]) == (2, refusal)
    assert "changed.exr" in out and tree(old) == before
    code, out, err = run("accept", old, new, "--yes")
    assert (code, err) == (0, "")
    assert f"{new}/inner/changed.exr → {old}/inner/changed.exr\n" in out
    assert f"{new}/added.exr → {old}/added.exr (new)\n" in out and out.splitlines()[-1] == "2 accepted"
    assert tree(old) == before | {name: tree(new)[name] for name in names}
    statuses = outcomes(diff.diff(old, new))
    assert [name for name, status in statuses.items() if status != ("equal", "unchanged")] == ["removed.exr"]
    image(new / "same.exr", gain=1.1)
    for words, last_line in ((["--method", "tolerance", "--set", "fail=0.2"], "nothing to accept"), ([], "1 accepted")):
        assert run("accept", old, new, *words, "--yes")[1].splitlines()[-1] == last_line  # compared as by `diff`


def test_accept_creates_missing_references(folders, tmp_path):
    new = folders[1]
    accept.Acceptance(to_accept(tmp_path / "first", new)).run()
    assert diff.diff(tmp_path / "first", new).exit_code == 0
    assert not (tmp_path / "first" / "notes.txt").exists()
    one = tmp_path / "deep" / "one.exr"
    accept.Acceptance(to_accept(one, new / "same.exr")).run()
    assert one.read_bytes() == (new / "same.exr").read_bytes()
    for name in ("ref.png", "folder"):
        with pytest.raises(ValueError, match=r"expected a name that ends in \.exr"):
            to_accept(tmp_path / name, new / "same.exr")


@pytest.mark.parametrize("name", ["truncated", "empty", "text"])
def test_unreadable_images_are_refused_and_unreadable_references_replaced(folders, name):
    old, new = folders
    for bad in ("same.exr", "added.exr"):
        content = (new / bad).read_bytes()
        (new / bad).unlink()
        BROKEN[name](new / bad)
        with pytest.raises(accept.UnreadableImage, match=bad):
            to_accept(old, new)
        (new / bad).write_bytes(content)
    (old / "same.exr").unlink()
    BROKEN[name](old / "same.exr")
    assert (new / "same.exr", old / "same.exr") in [(copy.new, copy.reference) for copy in to_accept(old, new)]


def test_nonfinite_images_are_refused_unless_allowed(run, folders, tmp_path):
    image(folders[1] / "same.exr", value=np.inf)
    with pytest.raises(ValueError, match="not finite; to accept them, compare with --set allow_nonfinite=true"):
        to_accept(*folders)
    assert len(to_accept(*folders, Settings((Entry("same.exr", {"allow_nonfinite": True}),)))) == 3
    for allowed, code in (([], 2), (["--set", "allow_nonfinite=true"], 0)):
        run("diff", *folders, "--json", tmp_path / "out.json", *allowed)
        assert run("accept", "--from", tmp_path / "out.json", "--yes")[0] == code
    image(folders[1] / "added.exr", gain=2)
    with pytest.raises(ValueError, match=r"added\.exr: compared without digests"):
        list(accept.changes(diff.diff(*folders)))


def test_an_unreadable_image_prevents_all_copies(run, pair, tmp_path):
    """Each image that cannot be compared has one line on stderr, also with the JSON of a comparison."""
    out = tmp_path / "out.json"
    for broken in (["equal.exr"], ["equal.exr", "louder.exr"]):
        BROKEN["truncated"](pair[1] / broken[-1])
        before = tree(pair[0])
        run("diff", *pair, "--json", out)
        for words in (pair, ("--from", out)):
            code, said, err = run("accept", *words, "--yes")
            assert code == 2 and "→" not in said
            lines = [line.partition(".exr:")[0] for line in err.splitlines()]
            assert lines == [f"mi-refract: {pair[1] / name}".removesuffix(".exr") for name in broken]
            assert tree(pair[0]) == before


@pytest.mark.parametrize("gain", [1.0, 1.3])
@pytest.mark.parametrize("by_json", [False, True])
def test_a_reference_of_two_images_is_replaced_only_if_one_is_named(run, tmp_path, gain, by_json):
    """Also if the other one equals the reference, but not if it equals a variant."""
    old, new, out = tmp_path / "old", tmp_path / "new", tmp_path / "out.json"
    for path, value in ((old / "a.exr", 1.0), (new / "cpu/a.exr", gain), (new / "gpu/a.exr", 1.5)):
        image(path, gain=value)
    maps = [f'{{ reference = "{{stem}}.exr", test = "{folder}/{{stem}}.exr" }}' for folder in ("cpu", "gpu")]
    settings = f"[defaults]\nmap = [{', '.join(maps)}]\n"
    (old / "mi-refract.toml").write_text(settings)
    before = tree(old)
    run("diff", old, new, "--json", out)
    words = [old, new, *["--from", out] * by_json, "--yes"]
    code, _, err = run("accept", *words)
    assert code == 2 and err.startswith(f"mi-refract: {old}/a.exr: also the reference of another image; expected ")
    assert tree(old) == before
    assert run("accept", old, new, "gpu/a.exr", *words[2:])[0] == 0
    assert tree(old)["a.exr"] == tree(new)["gpu/a.exr"]
    (old / "mi-refract.toml").write_text(settings + 'accept = ["{stem}-*.exr"]\n')
    shutil.copy(new / "cpu/a.exr", old / "a-cpu.exr")
    image(new / "gpu/a.exr", gain=1.7)
    run("diff", old, new, "--json", out)
    assert run("accept", *words)[0] == 0
    assert tree(old)["a.exr"] == tree(new)["gpu/a.exr"]


SETTINGS_ERRORS = {
    "range": ("fail = -1", "image[0]: auto: fail = -1.0; expected a number of at least 0"),
    "mask": ('mask = "none.png"', "none.png: no such file; expected a mask"),
}


@pytest.mark.parametrize("by_json", [False, True])
@pytest.mark.parametrize(("key", "message"), SETTINGS_ERRORS.values(), ids=SETTINGS_ERRORS)
def test_images_that_the_settings_do_not_let_compare_are_not_accepted(run, pair, tmp_path, key, message, by_json):
    old, new = pair
    (old / "mi-refract.toml").write_text(f'[[image]]\nname = "louder.exr"\nreason = "none"\n{key}\n')
    before, out = tree(old), tmp_path / "out.json"
    assert run("diff", old, new, "--json", out)[0] == 2
    code, said, err = run("accept", *(["--from", out] if by_json else pair), "--yes")
    assert code == 2 and "→" not in said and message in err and err.count("\n") == 1
    assert tree(old) == before


# Files that change after the comparison ---------------------------------------------------------------------------


def rewritten(path):
    """Replace the image by another one with the same name and times."""
    times = path.stat()
    image(path, gain=3.0)
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))


def renamed(folder):
    """Replace the folder by another one with the same name, whose files are unchanged."""
    folder.rename(folder.with_name("before"))
    folder.with_name("other").rename(folder)


CHANGES = {
    "new image": ("inner/changed.exr", lambda old, new: rewritten(new / "inner/changed.exr")),
    "new folder": ("inner/changed.exr", lambda old, new: renamed(new / "inner")),
    "link": ("linked.exr", lambda old, new: ((new / "linked.exr").unlink(), image(new / "linked.exr", gain=3.0))),
    "gone": ("added.exr", lambda old, new: (new / "added.exr").unlink()),
    "reference": ("inner/changed.exr", lambda old, new: rewritten(old / "inner/changed.exr")),
    "reference gone": ("inner/changed.exr", lambda old, new: (old / "inner/changed.exr").unlink()),
    "reference there": ("added.exr", lambda old, new: image(old / "added.exr")),
    "reference a folder": ("added.exr", lambda old, new: (old / "added.exr").mkdir()),
}


@pytest.mark.parametrize(("name", "change"), CHANGES.values(), ids=CHANGES)
def test_files_changed_since_the_comparison_are_refused(folders, tmp_path, name, change):
    old, new = folders
    image(new / "other" / "changed.exr", gain=3.0)
    image(tmp_path / "linked.exr", gain=2.0)
    (new / "linked.exr").symlink_to(tmp_path / "linked.exr")
    image(new / "fresh" / "folder" / "added.exr")
    copies = to_accept(old, new)
    assert len(copies) == 5
    change(old, new)
    before, all_before = tree(old), sorted(old.rglob("*"))
    with pytest.raises((OSError, ValueError), match=f"{name}('?$|: {CHANGED}|: not a regular file)"):
        accept.Acceptance(copies).run()
    assert (tree(old), sorted(old.rglob("*"))) == (before, all_before)


WHILE = {
    "new image": lambda old, new: rewritten(new / "inner/changed.exr"),
    "reference": lambda old, new: rewritten(old / "inner/changed.exr"),
    "disk full": lambda old, new: (_ for _ in ()).throw(OSError(28, "No space left on device")),
}


@pytest.mark.parametrize("change", WHILE.values(), ids=WHILE)
@pytest.mark.parametrize("after", [1, 2])
def test_a_failure_while_copying_replaces_nothing(folders, monkeypatch, change, after):
    """`after`: the number of copies begun, of two."""
    copies, copy, begun = to_accept(*folders), safe_files.copy, []

    def change_and_copy(*paths):
        begun.append(paths)
        if len(begun) == after:
            change(*folders)
        return copy(*paths)

    monkeypatch.setattr(safe_files, "copy", change_and_copy)
    names = tree(folders[0]).keys()
    with pytest.raises(OSError, match=rf"changed\.exr: {CHANGED}|No space"):
        accept.Acceptance(copies).run()
    references = tree(folders[0])
    assert references.keys() == names
    assert references["inner/changed.exr"] != tree(folders[1])["inner/changed.exr"]


def test_only_the_bytes_that_were_compared_are_copied(folders, monkeypatch):
    """Even if the digests before and after the copy are unchanged."""
    copies, before, digest = to_accept(*folders), tree(folders[0]), accept.digest
    compared_digests = {copy.new: copy.compared for copy in copies}
    monkeypatch.setattr(accept, "digest", lambda path: compared_digests.get(path) or digest(path))
    rewritten(folders[1] / "inner/changed.exr")
    with pytest.raises(OSError, match=rf"changed\.exr: {CHANGED}"):
        accept.Acceptance(copies).run()
    assert tree(folders[0]) == before


def test_the_digest_is_that_of_the_decoded_bytes(folders, monkeypatch):
    """Even if the file has another content only while it is decoded."""
    path = folders[1] / "same.exr"
    image(folders[1] / "other.exr", gain=3.0)
    same, other, opened = path.read_bytes(), (folders[1] / "other.exr").read_bytes(), OpenImageIO.ImageInput.open

    def swapped(*words):
        path.write_bytes(other)
        source = opened(*words)
        path.write_bytes(same)
        return source

    monkeypatch.setattr(OpenImageIO, "ImageInput", SimpleNamespace(open=swapped))
    (result,) = diff.diff(*folders, to_accept=True, names=["same.exr"]).results
    assert result.status is Status.EQUAL


def test_no_reference_is_written_through_a_link_to_a_folder(run, folders, tmp_path):
    """Neither for a name, nor for the name of a variant."""
    old, new = folders
    image(new / "deep" / "added.exr")
    (tmp_path / "outside").mkdir()
    (old / "deep").symlink_to(tmp_path / "outside")
    (old / "mi-refract.toml").write_text('[defaults]\naccept = ["deep/{stem}-*.exr"]\n')
    image(new / "same.exr", gain=1.5)
    for words in (["deep/added.exr"], ["same.exr", "--as-variant", "macos"]):
        code, said, err = run("accept", old, new, *words, "--yes")
        assert (code, said.count("→"), err.count("\n")) == (2, 0, 1) and f"outside of {old}, by a link" in err
    assert not tree(tmp_path / "outside")


@pytest.mark.parametrize("count", [2, 12])
@pytest.mark.parametrize("by_json", [False, True])
def test_after_an_error_replaced_files_are_listed_and_another_call_finishes(run, tmp_path, monkeypatch, count, by_json):
    old, new, out = tmp_path / "old", tmp_path / "new", tmp_path / "out.json"
    for i in range(count):
        image(old / f"{i:02}.exr")
        image(new / f"{i:02}.exr", gain=2)
    before, after, rename = tree(old), tree(new), safe_files.move_into_place
    run("diff", old, new, "--json", out)
    words = ["accept", *(["--from", out] if by_json else [old, new]), "--yes"]

    def fail(temporary, path):
        if path.name == "01.exr":
            raise OSError(30, "Read-only file system", str(path))
        rename(temporary, path)

    monkeypatch.setattr(safe_files, "move_into_place", fail)
    code, _, err = run(*words)
    rest = f"{old}/01.exr" if count == 2 else f"{old}/01.exr … {old}/11.exr (11 in the order above)"
    state = f"replaced: {old}/00.exr; not replaced: {rest}; run the same command again to accept these"
    assert (code, err) == (2, f"mi-refract: {old}/01.exr: Read-only file system; {state}\n")
    assert tree(old) == before | {"00.exr": after["00.exr"]}  # and no hidden files
    monkeypatch.undo()
    assert run(*words)[::2] == (0, "") and tree(old) == after


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_after_a_signal_replaced_files_are_listed_and_a_second_call_finishes(run, tmp_path, number):
    old, new, count = tmp_path / "old", tmp_path / "new", 60
    for side, gain in ((old, 1), (new, 2)):
        image(side / "000.exr", gain=gain, shape=(4, 4, 3))
        for i in range(1, count):
            shutil.copy(side / "000.exr", side / f"{i:03}.exr")
    before, after = tree(old), tree(new)
    inode = (old / "000.exr").stat().st_ino
    code = "import sys; from mi_refract.cli import main; sys.exit(main())"
    with python(code, "accept", old, new, "--yes") as process:
        while process.poll() is None and (old / "000.exr").stat().st_ino == inode:
            time.sleep(0.001)
        process.send_signal(number)
        _, err = process.communicate()
    references = tree(old)
    replaced = sum(references[name] == after[name] for name in references)
    assert references.keys() == before.keys()  # no hidden files
    if process.returncode:  # else it ended before the signal
        assert process.returncode == 128 + number
        assert err.startswith("mi-refract: interrupted; ") or (err == "" and replaced == count)  # all was done before
        if err and replaced in (0, count):
            assert err.count("reference") == 1
        elif err:
            assert f"not replaced: {old}/{replaced:03}.exr" in err
    assert run("accept", old, new, "--yes")[0] == 0 and tree(old) == after


def test_unreadable_files_have_no_digest(folders, tmp_path, monkeypatch):
    """A change could not be detected. The error is planted, because root may read all files."""
    os.mkfifo(tmp_path / "a.exr")
    (tmp_path / "b.exr").symlink_to("/dev/null")
    for path in (tmp_path / "a.exr", tmp_path / "b.exr"):
        with pytest.raises(ValueError, match=r"\.exr: not a regular file"):
            diff.digest(path)
    copy = safe_files.copy

    def refuse(path, *rest):
        if path == folders[0] / "same.exr":
            raise PermissionError(13, "Permission denied", str(path))
        return copy(path, *rest)

    monkeypatch.setattr(safe_files, "copy", refuse)
    (refused,) = diff.diff(*folders, to_accept=True, names=["same.exr"]).results
    assert refused.error.endswith("same.exr: Permission denied")


def test_accept_asks_for_confirmation(run, pair, terminal):
    old, new = pair
    before, questions = tree(old), []
    terminal(questions.append)
    code, out, _ = run("accept", old, new)
    assert (code, out.splitlines()[-1], questions) == (1, "nothing accepted", ["Accept 1 as the reference?"])
    assert tree(old) == before
    terminal(lambda question: image(new / "louder.exr", value=0.1) is not None)
    code, out, err = run("accept", old, new)
    assert code == 2 and "accepted\n" not in out and err.endswith(f"louder.exr: {CHANGED}\n")
    assert tree(old) == before
    terminal(lambda question: True)
    assert run("accept", old, new)[0] == 0
    assert tree(old) == before | {"louder.exr": tree(new)["louder.exr"]}


# --from -----------------------------------------------------------------------------------------------------------


def edited(path, change):
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def entry(data, name):
    return next(result for result in data["results"] if result["name"] == name)


def test_from_json_accepts_its_images_in_the_same_or_other_folders(run, compared, tmp_path):
    old, new, out = compared
    data = json.loads(out.read_text())
    assert len(entry(data, "equal.exr")["digests"]["test"]) == 64
    digests = entry(data, "louder.exr")["digests"]
    assert digests["reference"] != digests["test"] and len(digests["test"]) == 64
    assert entry(data, "inner/added.exr")["digests"]["reference"] == ""
    before = tree(old)
    image(new / "later.exr")
    assert run("accept", old, new, "equal.exr", "--from", out)[:2] == (0, "nothing to accept\n")
    assert run("accept", old, new, "inner/*", "--from", out, "--yes")[0] == 0
    assert tree(old) == before | {"inner/added.exr": tree(new)["inner/added.exr"]}
    (old / "inner" / "added.exr").unlink()
    for side in (old, new):
        side.rename(tmp_path / f"moved-{side.name}")
    moved = tmp_path / "moved-old", tmp_path / "moved-new"
    assert run("accept", "--from", out, "--yes")[0] == 2
    code, said, err = run("accept", *moved, "--from", out, "--yes")
    assert (code, err, said.splitlines()[-1]) == (0, "", "2 accepted")
    assert tree(moved[0]) == before | {name: tree(moved[1])[name] for name in ("louder.exr", "inner/added.exr")}
    # An invalid entry of the settings that matches no image does not prevent accepting an image by name.
    (moved[0] / "mi-refract.toml").write_text('[[image]]\nname = "none.exr"\nfale = 1\nreason = "none"\n')
    image(moved[1] / "louder.exr", gain=3)
    assert run("diff", *moved, "--json", out)[0] == 2
    code, said, err = run("accept", "--from", out, "--yes")
    assert (code, said) == (2, "") and "image[0]: unknown key `fale`" in err
    assert run("accept", "--from", out, *moved, "louder.exr", "--yes")[0] == 0
    one, two = tmp_path / "1.exr", tmp_path / "2.exr"
    for path, gain in ((one, 1), (two, 2)):
        image(path, gain=gain)
    run("diff", one, two, "--json", out)
    assert run("accept", "--from", out, "--yes")[0] == 0
    assert one.read_bytes() == two.read_bytes()


@pytest.mark.parametrize(("side", "name"), [(0, "louder.exr"), (1, "louder.exr"), (0, "inner/added.exr")])
def test_from_json_refuses_files_changed_since(run, compared, side, name):
    path = compared[side] / name
    rewritten(path) if path.exists() else image(path, gain=3.0)
    before = tree(compared[0])
    assert run("accept", "--from", compared[2], "--yes")[::2] == (2, f"mi-refract: {path}: {CHANGED}\n")
    assert tree(compared[0]) == before


OURS = "expected a file that mi-refract diff --json wrote"
SPOILED = {
    "no JSON": (b"{", "not JSON ("),
    "too deep": (b"[" * 100_000, OURS),
    "a list": (b"[]", f"schema None; expected 1: {OURS}"),
    "schema": (lambda d: d.update(schema=99), "schema 99; expected 1"),
    "status": (lambda d: d["results"][0].update(status="fine"), "results[0].status: invalid enum value 'fine'"),
    "renders": (lambda d: d.update(renders=True), "written with --renders; expected "),
    "NUL": (lambda d: d["results"][0].update(test="a\0b"), "results[0].test: expected "),
    "outside": (lambda d: entry(d, "louder.exr").update(target="/etc/x.exr"), "expected a path in "),
    "no digests": (lambda d: entry(d, "louder.exr").update(digests=None), "compared without digests"),
    "digest": (lambda d: entry(d, "louder.exr")["digests"].update(test="g" * 64), "digests.test: expected"),
    "variants": (lambda d: entry(d, "louder.exr")["digests"]["variants"].append(""), "digests: 1 of 0 variants"),
}


@pytest.mark.parametrize(("change", "words"), SPOILED.values(), ids=SPOILED)
def test_from_json_reports_invalid_files_in_one_line(run, compared, change, words):
    old, _, out = compared
    out.write_bytes(change) if isinstance(change, bytes) else edited(out, change)
    before = tree(old)
    assert_refused(run("accept", "--from", out, "--yes"), words)
    assert tree(old) == before


@pytest.mark.parametrize("key", ["test", "target", "reference"])
def test_from_json_refuses_paths_outside_the_folder(run, compared, tmp_path, key):
    old, new, out = compared
    image(tmp_path / "elsewhere" / "louder.exr", gain=2.0)
    root = new if key == "test" else old
    (root / "link").symlink_to(tmp_path / "elsewhere")
    before = tree(old) | tree(new) | tree(tmp_path / "elsewhere")
    for path in (root / ".." / "elsewhere" / "louder.exr", root / "link" / "louder.exr"):
        edited(out, lambda data, path=path: entry(data, "louder.exr").update({key: str(path)}))
        code, said, err = run("accept", "--from", out, "--yes")
        assert (code, said) == (2, "") and f"].{key}: {path}; expected a path in {root}\n" in err
    assert tree(old) | tree(new) | tree(tmp_path / "elsewhere") == before


def test_from_json_reports_invalid_arguments(run, compared):
    old, new, out = compared
    for words, message in [
        (["--from", out.with_name("none.json")], "none.json"),
        ([old, "--from", out], "only one path; with --from, give both folders before the names, or none"),
        (["--from", out, "--set", "fail=1"], "--from repeats an earlier comparison"),
        ([old, new, "none*", "--from", out], "none*: matches no image; expected "),
        ([], "two paths are needed"),
    ]:
        assert_refused(run("accept", *words, "--yes"), message)


# --as-variant -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("by_json", [False, True])
def test_a_variant_is_written_beside_the_reference(run, pair, tmp_path, terminal, by_json):
    old, new = pair
    (old / "mi-refract.toml").write_text(SETTINGS)
    before, out = tree(old), tmp_path / "out.json"
    run("diff", old, new, "--json", out)
    words = [*(["--from", out] if by_json else pair), "--as-variant", "macos"]
    code, said, err = run("accept", *words, "--yes")
    assert (code, err) == (0, "")
    assert f"{new}/louder.exr → {old}/louder-macos.exr (new)\n" in said
    assert tree(old) == before | {"louder-macos.exr": tree(new)["louder.exr"]}
    assert run("diff", old, new)[0] == 0
    image(old / "louder-macos.exr", gain=2.0)
    run("diff", old, new, "--json", out)
    content = (old / "louder-macos.exr").read_bytes()
    terminal(lambda question: image(old / "louder-macos.exr", gain=3.0) is not None)
    code, _, err = run("accept", *words)
    assert code == 2 and f"louder-macos.exr: {CHANGED}" in err
    (old / "louder-macos.exr").write_bytes(content)
    assert run("accept", *words, "--yes")[0] == 0
    assert tree(old)["louder-macos.exr"] == tree(new)["louder.exr"]


@pytest.mark.parametrize("by_json", [False, True])
def test_the_name_of_a_variant_follows_from_the_map_and_accept(run, tmp_path, by_json):
    old, new, out = tmp_path / "old", tmp_path / "new", tmp_path / "out.json"
    image(old / "ball.ref.exr")
    image(new / "ball.exr", gain=1.2)
    settings = 'accept = ["{stem}-*.ref.exr"]\nmap = { reference = "{stem}.ref.exr", test = "{stem}.exr" }'
    (old / "mi-refract.toml").write_text(f"[defaults]\n{settings}")
    code, _, err = run("diff", old, new, "--json", out)
    assert (code, err) == (1, "mi-refract: accept = '{stem}-*.ref.exr': matches no image\n")
    words = ["--from", out] if by_json else [old, new]
    assert run("accept", *words, "--as-variant", "macos", "--yes")[::2] == (0, "")
    assert tree(old)["ball-macos.ref.exr"] == tree(new)["ball.exr"]
    assert run("diff", old, new)[::2] == (0, "")


NO_ACCEPT = "no template in `accept` contains macos or exactly one *; add to [defaults] in mi-refract.toml"


@pytest.mark.parametrize(
    ("settings", "name", "message"),
    [
        ("", "macos", NO_ACCEPT),
        ('[defaults]\naccept = ["{stem}-*-*.exr"]', "macos", NO_ACCEPT),
        *((SETTINGS, name, f"--as-variant '{name}'; expected part of a file name") for name in ("a/b", "*", " ", "..")),
        ('[defaults]\naccept = ["equal-*.exr"]', "one", "equal-one.exr: also the reference of another image"),
        ('[defaults]\naccept = ["{stem}-*.png"]', "one", "expected a name that ends in .exr"),
        ("added", "macos", "inner/added.exr: has no reference yet; accept it without --as-variant first"),
    ],
)
def test_invalid_variants_are_refused(run, pair, settings, name, message):
    old, new = pair
    if settings == "added":
        image(new / "inner" / "added.exr")
        settings = SETTINGS
    (old / "mi-refract.toml").write_text(settings)
    for side, gain in ((old, 1.0), (new, 1.2)):
        image(side / "more.exr", gain=gain)
    before = tree(old)
    code, _, err = run("accept", old, new, "--as-variant", name, "--yes")
    assert code == 2 and message in err and err.count("\n") == 1
    assert tree(old) == before

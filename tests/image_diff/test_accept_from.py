"""`mi-refract accept --from OUT.json` and `--as-variant NAME`: what is copied, and what is refused in one line."""

from __future__ import annotations

import json
import os

import pytest
from support.diff_images import image, tree

SETTINGS = '[defaults]\naccept = ["no-star.exr", "{stem}-?.exr", "{stem}-*.exr", "{stem}_*.exr"]\n'


@pytest.fixture
def compared(run, pair, tmp_path):
    """A folder with a pair that differs, an added image and a removed one, and the JSON of its comparison."""
    old, new = pair
    image(new / "inner" / "added.exr")
    image(old / "removed.exr")
    out = tmp_path / "out.json"
    assert run("diff", old, new, "--json", out)[0] == 1
    return old, new, out


def edited(path, change):
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def entry(data, name):
    return next(each for each in data["results"] if each["name"] == name)


# --from -----------------------------------------------------------------------------------------------------------


def test_the_json_holds_digests_of_what_is_not_equal(run, pair, compared, tmp_path):
    by_name = {each["name"]: each for each in json.loads(compared[2].read_text())["results"]}
    assert by_name["equal.exr"]["digests"] is None
    digests = by_name["louder.exr"]["digests"]
    assert digests["reference"] != digests["test"] and len(digests["test"]) == 64
    assert by_name["inner/added.exr"]["digests"]["reference"] == ""
    assert run("diff", *pair, "--renders", "--json", tmp_path / "renders.json")[0] in (0, 1, 2, 3)


def test_exactly_the_images_of_the_json_are_accepted(run, compared):
    old, new, out = compared
    before = tree(old)
    image(new / "later.exr")
    code, said, err = run("accept", "--from", out, "--yes")
    assert (code, err, said.splitlines()[-1]) == (0, "", "2 accepted")
    accepted = {name: tree(new)[name] for name in ("louder.exr", "inner/added.exr")}
    assert tree(old) == before | accepted  # not the one that came later, and the removed one stays


def test_of_the_json_those_that_are_named(run, compared):
    old, new, out = compared
    before = tree(old)
    assert run("accept", old, new, "inner/*", "--from", out, "--yes")[0] == 0
    assert tree(old) == before | {"inner/added.exr": tree(new)["inner/added.exr"]}
    assert run("accept", old, new, "equal.exr", "--from", out)[:2] == (0, "nothing to accept\n")
    code, said, err = run("accept", old, new, "none*", "--from", out)
    assert (code, said) == (2, "") and err.startswith("mi-refract: none*: matches no image; expected ")


def test_the_json_of_another_machine_fits_the_same_bytes_elsewhere(run, compared, tmp_path):
    old, new, out = compared
    for side in (old, new):
        side.rename(tmp_path / f"moved-{side.name}")
    moved = tmp_path / "moved-old", tmp_path / "moved-new"
    assert run("accept", "--from", out, "--yes")[0] == 2
    assert run("accept", *moved, "--from", out, "--yes")[0] == 0
    assert tree(moved[0])["louder.exr"] == tree(moved[1])["louder.exr"]


def test_two_files_by_their_json(run, pair, tmp_path):
    one, two, out = pair[0] / "louder.exr", pair[1] / "louder.exr", tmp_path / "out.json"
    run("diff", one, two, "--json", out)
    assert run("accept", "--from", out, "--yes")[0] == 0
    assert one.read_bytes() == two.read_bytes()


@pytest.mark.parametrize("side", [0, 1])
def test_what_changed_since_the_json_is_refused(run, compared, side):
    path = compared[side] / "louder.exr"
    times = path.stat()
    image(path, gain=3.0)
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    before = tree(compared[0])
    code, _, err = run("accept", "--from", compared[2], "--yes")
    assert code == 2 and err == f"mi-refract: {path}: changed since it was compared; expected what was shown\n"
    assert tree(compared[0]) == before


def test_a_reference_that_came_since_the_json_is_not_replaced(run, compared):
    old, _, out = compared
    image(old / "inner" / "added.exr", gain=2.0)
    before = tree(old)
    assert "inner/added.exr: changed since it was compared" in run("accept", "--from", out, "--yes")[2]
    assert tree(old) == before


def test_nan_is_accepted_where_the_comparison_allowed_it(run, pair, tmp_path):
    old, new = pair
    image(new / "louder.exr", value=float("nan"))
    out = tmp_path / "out.json"
    for allowed, code in (([], 2), (["--allow-nonfinite", "louder.exr"], 0)):
        run("diff", old, new, "--json", out, *allowed)
        assert run("accept", "--from", out, "--yes")[0] == code


OUTSIDE = "expected a path in "
SPOILED = {
    "no JSON": (lambda text: "{", "no JSON (", None),
    "too deep": (lambda text: "[" * 100_000, "expected a file that mi-refract diff --json wrote", None),
    "a list": (lambda text: "[]", "no results; expected a file that mi-refract diff --json wrote", None),
    "no UTF-8": (lambda text: b"\xff\xfe{", "no JSON (", None),
    "another": (lambda text: '{"schema": 1, "results": [3]}', "reference, test; expected a file", None),
    "schema": (None, "schema 99; expected 1", lambda d: d.update(schema=99)),
    "no results": (None, "no results; expected", lambda d: d.update(results={})),
    "result": (None, "results[0]: status; expected", lambda d: d["results"].insert(0, 3)),
    "status": (None, "status; expected", lambda d: entry(d, "louder.exr").update(status="fine")),
    "status of a type": (None, "status; expected", lambda d: entry(d, "louder.exr").update(status=[])),
    "name": (None, "name, error; expected", lambda d: entry(d, "louder.exr").update(name=None)),
    "renders": (None, "of --renders; expected ", lambda d: d.update(renders=True)),
    "path": (None, "test; expected a file", lambda d: entry(d, "louder.exr").update(test=7)),
    "NUL": (None, "test; expected a file", lambda d: entry(d, "louder.exr").update(test="a\0b")),
    "outside": (None, OUTSIDE, lambda d: entry(d, "louder.exr").update(target="/etc/x.exr")),
    "no digests": (None, "compared without digests", lambda d: entry(d, "louder.exr").update(digests=None)),
    "digests": (None, "digests; expected", lambda d: entry(d, "louder.exr").update(digests={"test": "a"})),
    "digest": (None, "digests; expected", lambda d: entry(d, "louder.exr")["digests"].update(test="g" * 64)),
}


@pytest.mark.parametrize("write, words, change", SPOILED.values(), ids=SPOILED)
def test_a_json_that_is_not_ours_is_one_line(run, compared, write, words, change):
    old, _, out = compared
    if write:
        text = write(out.read_text())
        out.write_bytes(text if isinstance(text, bytes) else text.encode())
    else:
        edited(out, change)
    before = tree(old)
    code, said, err = run("accept", "--from", out, "--yes")
    assert (code, said, err.count("\n")) == (2, "", 1)
    assert err.startswith("mi-refract: ") and words in err
    assert tree(old) == before


@pytest.mark.parametrize("key", ["test", "target", "reference"])
def test_no_path_of_the_json_leads_out_of_its_folder(run, compared, tmp_path, key):
    old, new, out = compared
    image(tmp_path / "elsewhere" / "louder.exr", gain=2.0)
    root = new if key == "test" else old
    (root / "link").symlink_to(tmp_path / "elsewhere")
    before = tree(tmp_path)
    for path in (root / ".." / "elsewhere" / "louder.exr", root / "link" / "louder.exr"):
        edited(out, lambda data, path=path: entry(data, "louder.exr").update({key: str(path)}))
        code, said, err = run("accept", "--from", out, "--yes")
        assert (code, said) == (2, "") and f"].{key}: {path}; expected a path in {root}\n" in err
    assert {k: v for k, v in tree(tmp_path).items() if k != "out.json"} == {
        k: v for k, v in before.items() if k != "out.json"
    }


def test_bad_words_with_from(run, compared):
    old, _, out = compared
    for words, message in [
        (["--from", out.with_name("none.json")], "none.json"),
        ([old, "--from", out], "one path; accepted with --from: both folders before any names, or none"),
        (["--from", out, "--set", "fail=1"], "--from takes what was compared"),
        ([], "two paths are needed"),
    ]:
        code, said, err = run("accept", *words, "--yes")
        assert (code, said, err.count("\n")) == (2, "", 1)
        assert message in err


# --as-variant -----------------------------------------------------------------------------------------------------


def test_a_variant_stands_beside_the_reference(run, pair):
    old, new = pair
    (old / "mi-refract.toml").write_text(SETTINGS)
    before = tree(old)
    code, said, err = run("accept", old, new, "--as-variant", "macos", "--yes")
    assert (code, err) == (0, "")
    assert f"{new}/louder.exr → {old}/louder-macos.exr (new)\n" in said
    assert tree(old) == before | {"louder-macos.exr": tree(new)["louder.exr"]}
    assert run("diff", old, new)[0] == 0


def test_a_variant_is_replaced_where_it_is_what_was_compared(run, pair, tmp_path, monkeypatch):
    from mi_refract.cli import accept as cli_accept

    old, new = pair
    (old / "mi-refract.toml").write_text(SETTINGS)
    image(old / "louder-macos.exr", gain=2.0)
    out = tmp_path / "out.json"
    run("diff", old, new, "--json", out)
    monkeypatch.setattr(cli_accept, "_agreed", lambda count: image(old / "louder-macos.exr", gain=3.0) is not None)
    before = tree(new)
    for words in ([old, new], ["--from", out]):
        code, _, err = run("accept", *words, "--as-variant", "macos")
        assert code == 2 and "louder-macos.exr: changed since it was compared" in err
    assert run("accept", old, new, "--as-variant", "macos", "--yes")[0] == 0
    assert tree(old)["louder-macos.exr"] == before["louder.exr"]


def test_a_variant_of_the_json(run, pair, tmp_path):
    old, new = pair
    (old / "mi-refract.toml").write_text(SETTINGS)
    out = tmp_path / "out.json"
    run("diff", old, new, "--json", out)
    assert run("accept", "--from", out, "--as-variant", "macos", "--yes")[0] == 0
    assert tree(old)["louder-macos.exr"] == tree(new)["louder.exr"]


@pytest.mark.parametrize(
    "settings, name, message",
    [
        (
            "",
            "macos",
            "settings have no `accept` with macos or one *; expected in mi-refract.toml, below [defaults]",
        ),
        ('[defaults]\naccept = ["{stem}-*-*.exr"]', "macos", "settings have no `accept` with macos or one *"),
        (SETTINGS, "a/b", "--as-variant 'a/b'; expected a part of a file name"),
        (SETTINGS, "*", "--as-variant '*'; expected"),
        (SETTINGS, " ", "--as-variant ' '; expected"),
        (SETTINGS, "..", "--as-variant '..'; expected"),
        ('[defaults]\naccept = ["equal-*.exr"]', "one", "equal-one.exr: the reference of another image"),
        ('[defaults]\naccept = ["{stem}-*.png"]', "one", "expected a name that ends in .exr"),
    ],
)
def test_no_variant_where_its_name_says_nothing(run, pair, settings, name, message):
    old, new = pair
    (old / "mi-refract.toml").write_text(settings)
    for side, gain in ((old, 1.0), (new, 1.2)):
        image(side / "more.exr", gain=gain)
    before = tree(old)
    code, _, err = run("accept", old, new, "--as-variant", name, "--yes")
    assert code == 2 and message in err and err.count("\n") == 1
    assert tree(old) == before


def test_an_image_without_a_reference_is_no_variant(run, compared):
    old, new, _ = compared
    (old / "mi-refract.toml").write_text(SETTINGS)
    before = tree(old)
    code, _, err = run("accept", old, new, "--as-variant", "macos", "--yes")
    assert code == 2 and "inner/added.exr: has no reference yet; expected without --as-variant" in err
    assert tree(old) == before

"""`mi-refract diff` and `mi-refract accept`: every option, every bad input, what is printed and what is written."""

from __future__ import annotations

import html
import importlib.util
import json
import os
import shlex
import sys
from xml.etree import ElementTree

import numpy as np
import pytest
from support.diff_images import BROKEN, image, samples, tree

from mi_refract.image_diff import methods
from mi_refract.io import exit_code
from mi_refract.io.image_file import read, write_exr

# Verdicts ---------------------------------------------------------------------------------------------------------


def test_equal(run, pair):
    old, new = pair
    code, out, err = run("diff", old / "equal.exr", new / "equal.exr")
    assert (code, err) == (0, "")
    assert out.splitlines()[-1] == "1 image: 1 equal"


def test_different(run, pair):
    code, out, err = run("diff", *pair)
    assert (code, err) == (1, "")
    lines = out.splitlines()
    assert lines[1].split()[:3] == ["different", "louder.exr", "tolerance"]
    assert lines[2].split()[:3] == ["equal", "equal.exr", "tolerance"]
    assert lines[3] == "2 images: 1 different, 1 equal"
    assert len(lines) == 4


def test_inconclusive(run, tmp_path):
    folders = samples(tmp_path / "old", 2, noise=1.0), samples(tmp_path / "new", 2, 100, noise=1.0)
    codes = {"": 3, "pass": 0, "fail": 1}
    for word, expected in codes.items():
        how = ["--inconclusive", word] if word else []
        junit = tmp_path / "out.xml"
        code, out, err = run("diff", *folders, "--renders", "--method", "welch", "--junit", junit, *how)
        assert (code, err) == (expected, "")
        assert out.splitlines()[-1] == "1 image: 1 inconclusive"
        failures = ElementTree.parse(junit).findall(".//failure")
        assert [each.get("type") for each in failures] == ([] if word == "pass" else ["inconclusive"])


def test_samples(run, tmp_path):
    old, new = samples(tmp_path / "old"), samples(tmp_path / "new", first=100, gain=1.3)
    code, out, _ = run("diff", old, new, "--renders")
    assert code == 1
    assert out.splitlines()[1].split()[:3] == ["different", "old", "welch"]
    assert run("diff", old, samples(tmp_path / "same", first=200), "--renders")[0] == 0


def test_renders_that_hold_their_variance_are_compared_by_welch(run, tmp_path):
    """Without any option; the table says why. `tolerance`, asked for, does not compare the variance."""
    rng, header = np.random.default_rng(1), {"mi_refract:spp": 32, "mi_refract:variance_freedom": 7}
    for name, gain in (("old", 1.0), ("new", 1.0), ("off", 1.2)):
        passes = gain + rng.standard_normal((8, 16, 16, 3)) / 40
        pixels = np.concatenate([passes.mean(0), 4 * passes.var(0, ddof=1)], -1)
        write_exr(tmp_path / f"{name}.exr", pixels, (*"RGB", "R.variance", "G.variance", "B.variance"), header)
    old, new, off = (tmp_path / f"{name}.exr" for name in ("old", "new", "off"))
    for test, word, expected in ((new, "equal", 0), (off, "different", 1)):
        code, out, err = run("diff", old, test)
        assert (code, err) == (expected, "")
        assert out.splitlines()[1].startswith(word)
        assert " welch (the variance of both is known) " in out
    assert run("diff", old, new, "--method", "tolerance", "--set", "fail=0.1", "--set", "fail_relative=0.1")[0] == 0
    code, out, err = run("self-test", old)
    assert (code, err) == (0, "")


@pytest.mark.parametrize("method", methods.METHODS)
def test_every_method(run, pair, tmp_path, method):
    old, new = pair
    more = []
    if methods.METHODS[method].takes_renders:
        old, new = samples(tmp_path / "s"), samples(tmp_path / "t", first=100, gain=2.0)
        more = ["--renders"]
    out = tmp_path / "out.json"
    assert run("diff", old, new, "--method", method, "--json", out, *more)[0] == 1
    assert json.loads(out.read_text())["results"][0]["method"] == method


def test_an_option_of_the_method(run, pair):
    assert run("diff", *pair, "--method", "tolerance", "--set", "fail=0.2", "--set", "hard_fail=1")[0] == 0
    assert run("diff", *pair, "--method", "tolerance", "--set", "fail_percent=100", "--set", "hard_fail=0.01")[0] == 1


def test_settings_lie_beside_the_references(run, pair, tmp_path):
    old, new = pair
    rule = '[[image]]\nname = "louder.exr"\nmethod = "tolerance"\nfail = 0.2\nreason = "known to be louder"\n'
    (old / "mi-refract.toml").write_text(rule)
    code, out, err = run("diff", old, new)
    assert (code, err) == (0, "")
    assert "[known to be louder]" in out
    assert run("diff", old / "louder.exr", new / "louder.exr")[0] == 0
    other = tmp_path / "strict.toml"
    other.write_text(rule.replace("0.2", "0.001"))
    assert run("diff", old, new, "--settings", other)[0] == 1
    other.write_text(rule.replace("louder.exr", "lauder.exr"))
    code, _, err = run("diff", old, new, "--settings", other)
    assert (code, err) == (1, "mi-refract: lauder.exr: matches no image\n")


def test_nan_has_to_be_named(run, pair):
    for folder in pair:
        image(folder / "louder.exr", value=np.nan)
    assert run("diff", *pair)[0] == 1
    assert run("diff", *pair, "--allow-nonfinite", "equal.exr")[0] == 1
    assert run("diff", *pair, "--allow-nonfinite", "louder.exr")[0] == 0
    image(pair[1] / "louder.exr", value=np.inf)
    assert run("diff", *pair, "--allow-nonfinite", "louder.exr")[0] == 1


def test_the_methods_are_printed_without_images(run):
    code, out, err = run("diff", "--methods")
    assert (code, err) == (0, "")
    for name, method in methods.METHODS.items():
        assert f"`{name}`: {method.summary}" in out
        assert all(f"| `{option}` |" in out for option in method.options)


def test_on_a_terminal_the_methods_are_tables(run, monkeypatch):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    code, out, err = run("diff", "--methods")
    assert (code, err) == (0, "")
    assert "fail_relative" in out and "|---|" not in out


# Bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", BROKEN)
@pytest.mark.parametrize("side", [0, 1])
def test_bad_images(run, pair, tmp_path, name, side):
    bad = pair[side] / "equal.exr"
    bad.unlink()
    BROKEN[name](bad)
    files = [tmp_path / "out.json", tmp_path / "out.xml"]
    code, out, err = run("diff", *pair, "--json", files[0], "--junit", files[1])
    assert (code, err.count("\n")) == (2, 1)
    assert err.startswith("mi-refract: ")
    assert "equal.exr" in err
    assert out.splitlines()[1].split()[:2] == ["different", "louder.exr"]
    assert out.splitlines()[-1] == "2 images: 1 could not be compared, 1 different"
    assert {r["name"]: r["status"] for r in json.loads(files[0].read_text())["results"]} == {
        "equal.exr": "error",
        "louder.exr": "different",
    }
    assert [each.get("type") for each in ElementTree.parse(files[1]).findall(".//error")] == ["error"]
    alone = run("diff", pair[0] / "equal.exr", pair[1] / "equal.exr")
    assert (alone[0], alone[1], alone[2].count("\n")) == (2, "", 1)


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
def test_an_image_without_permission(run, pair):
    (pair[1] / "equal.exr").chmod(0)
    code, out, err = run("diff", *pair)
    assert (code, err.count("\n")) == (2, 1)
    assert "Permission denied" in err
    assert "louder.exr" in out


def test_whatever_one_image_does_the_report_is_written(run, pair, tmp_path, monkeypatch):
    compare = methods.compare

    def fail(method, one, two, **options):
        if one[0].path.name == "equal.exr":
            raise MemoryError("Unable to allocate 9 GiB")
        return compare(method, one, two, **options)

    monkeypatch.setattr(methods, "compare", fail)
    outputs = {"--report": "out.html", "--junit": "out.xml", "--json": "out.json"}
    words = [word for option, name in outputs.items() for word in (option, tmp_path / name)]
    code, out, err = run("diff", *pair, *words, "--github")
    assert (code, err) == (2, f"mi-refract: {pair[1]}/equal.exr: out of memory: Unable to allocate 9 GiB\n")
    assert "2 images: 1 could not be compared, 1 different" in out.splitlines()
    for name in outputs.values():
        text = (tmp_path / name).read_text()
        assert "out of memory" in text and "louder.exr" in text
    monkeypatch.setenv(exit_code.TRACEBACK, "1")
    assert "Traceback" in run("diff", *pair)[2]


def test_images_larger_than_allowed(run, pair):
    names = [pair[0] / "louder.exr", pair[1] / "louder.exr"]
    for words in (["diff", *names], ["accept", *names, "--yes"], ["self-test", names[0]]):
        code, out, err = run(*words, "--max-values", 100)
        assert (code, out) == (2, "")
        assert err.endswith("louder.exr: 48 × 32 × 3 values; expected up to 100 values (max-values)\n")
    assert run("diff", *names, "--max-values", 2**62)[0] == 1
    assert run("diff", *names, "--max-values", 0)[0] == 2


BAD = {
    "no file": (["{}/old", "{}/none"], "none"),
    "file and folder": (["{}/old", "{}/new/equal.exr"], "cannot compare a folder with a file"),
    "nothing in it": (["{}/old", "{}/empty"], "empty: holds no image"),
    "nothing to refer to": (["{}/empty", "{}/new"], "empty: holds no image"),
    "twice the folder": (["{}/old", "{}/old"], "the same as the reference"),
    "twice the file": (["{}/old/equal.exr", "{}/old/../old/equal.exr"], "the same as the reference"),
    "within": (["{}", "{}/new"], "one path contains the other"),
    "samples of files": (["{}/old/equal.exr", "{}/new/equal.exr", "--renders"], "expected with --renders: a folder"),
    "method": (["{}/old", "{}/new", "--method", "idiff"], "--method idiff; expected auto, exact"),
    "option": (["{}/old", "{}/new", "--method", "exact", "--set", "fail=1"], "--set fail: unknown"),
    "option of neither": (["{}/old", "{}/new", "--set", "threshold=1"], "--set threshold: unknown; expected tile"),
    "inconclusive": (["{}/old", "{}/new", "--inconclusive", "maybe"], "maybe"),
    "no settings": (["{}/old", "{}/new", "--settings", "{}/none.toml"], "none.toml"),
    "bad settings": (["{}/old", "{}/new", "--settings", "{}/bad.toml"], "bad.toml: defaults.fale: unknown"),
    "report's name": (["{}/old", "{}/new", "--report", "{}/out.exr"], "expected a file name that ends in .html"),
    "report's folder": (["{}/old", "{}/new", "--report", "{}/none/out.html"], "is not a folder"),
    "report in nothing": (["{}/old", "{}/new", "--report", "{}/none/report/"], "is not a folder"),
    "report a file": (["{}/old", "{}/new", "--report", "{}/bad.toml/"], "a file name that ends in .html, or a folder"),
    "report among others": (["{}/old", "{}/new", "--report", "{}"], "no report of ours; expected a new or empty"),
    "report among images": (["{}/old", "{}/new", "--report", "{}/new/report/"], "where it would be compared"),
    "report over images": (["{}/old", "{}/new", "--report", "{}/old"], "where it would be compared"),
    "junit's name": (["{}/old", "{}/new", "--junit", "{}/out.json"], "expected a file name that ends in .xml"),
    "json's name": (["{}/old", "{}/new", "--json", "{}/old/equal.exr"], "expected a file name that ends in .json"),
    "one path": (["{}/old"], "TEST"),
    "no path": ([], "REFERENCE"),
    "unknown option": (["{}/old", "{}/new", "--nonesuch"], "--nonesuch"),
}


@pytest.mark.parametrize("words, message", BAD.values(), ids=BAD)
@pytest.mark.parametrize("verb", ["diff", "accept"])
def test_bad_words(run, pair, tmp_path, verb, words, message):
    if verb == "accept" and {"--renders", "--inconclusive", "--report", "--junit", "--json"} & {*words}:
        pytest.skip("not one of its options")
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad.toml").write_text("[defaults]\nfale = 1")
    before = tree(tmp_path)
    code, out, err = run(verb, *(word.format(tmp_path) for word in words))
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("mi-refract: ")
    assert message in err
    assert tree(tmp_path) == before


@pytest.mark.parametrize(
    ("verb", "package"), [("diff", "scipy"), ("accept", "scipy"), ("report", "jinja2"), ("report", "matplotlib")]
)
def test_without_the_extra(run, pair, monkeypatch, tmp_path, verb, package):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == package else find(name))
    words = ["diff", "--report", tmp_path / "out.html"] if verb == "report" else [verb]
    code, out, err = run(*words, *pair)
    assert (code, out) == (2, "")
    assert err == "mi-refract: comparing needs the extra `diff`: pip install 'mi-refract[diff]'\n"


def test_nothing_is_created_or_overwritten(run, pair, tmp_path):
    image(pair[1] / "added.exr")
    image(pair[0] / "removed.exr")
    before = tree(tmp_path)
    run("diff", *pair)
    run("diff", pair[0] / "none.exr", pair[1] / "added.exr")
    run("diff", tmp_path / "none", pair[1])
    assert tree(tmp_path) == before


# Report -------------------------------------------------------------------------------------------------------------


def test_report(run, pair, tmp_path):
    page = tmp_path / "out.html"
    code, _, err = run("diff", *pair, "--report", page, "--method", "tolerance", "--set", "fail=0.01")
    assert (code, err) == (1, "")
    text = html.unescape(page.read_text())
    whole = f"mi-refract diff {pair[0]} {pair[1]} --method tolerance --set fail=0.01"
    one = f"mi-refract accept {pair[0]}/louder.exr {pair[1]}/louder.exr --method tolerance --set fail=0.01"
    assert whole in text
    assert one in text


# Variances and channels -------------------------------------------------------------------------------------------


@pytest.fixture
def noisy(tmp_path):
    """A reference of 1000 samples with its variance, and new images of 200: an equal one, and one 3 % brighter."""
    mean = np.ones((32, 32, 3))
    rng = np.random.default_rng(8)
    for folder, spp, gains in (("old", 1000, (1, 1)), ("new", 200, (1, 1.03))):
        (tmp_path / folder).mkdir()
        for name, gain in zip(("equal", "off"), gains, strict=True):
            write_exr(tmp_path / folder / f"{name}.exr", gain * rng.gamma(spp, mean / spp))
    for name in ("equal", "off"):
        write_exr(tmp_path / f"old/{name}_var.exr", mean)
    return tmp_path / "old", tmp_path / "new"


def test_spp_with_auto(run, noisy):
    words = ("--variance", "{stem}_var.exr", "--set", "spp_reference=1000")
    code, out, err = run("diff", *noisy, *words, "--set", "spp_test=200")
    assert (code, err) == (1, "")
    assert [line.split()[:3] for line in out.splitlines()[1:3]] == [
        ["different", "off.exr", "welch"],
        ["equal", "equal.exr", "welch"],
    ]
    assert run("diff", *noisy, *words, "--set", "spp=200")[0] == 1
    code, _, err = run("diff", *noisy, *words)
    assert (code, len(err.splitlines())) == (2, 2)
    assert "expected `spp` or `spp_test`" in err
    assert run("diff", *noisy, *words, "--set", "spp_test=1")[0] == 2


def test_spp_counts_where_welch_is_chosen(run, pair):
    """And is no mistake where `tolerance` is: one setting serves a folder of both."""
    assert run("diff", *pair, "--set", "spp=16")[0] == run("diff", *pair)[0]


def test_channels(run, noisy):
    old, new = noisy
    words = ("--variance", "{stem}_var.exr", "--set", "spp=200")
    broken = read(new / "equal.exr").pixels.copy()
    broken[..., 2] *= 2
    write_exr(new / "equal.exr", broken)
    assert run("diff", old, new, "equal.exr", *words)[0] == 1
    assert run("diff", old, new, "equal.exr", *words, "--channels", "R,G")[0] == 0
    assert run("diff", old, new, "equal.exr", *words, "--channels", "R=G,G=R")[0] == 0
    assert run("diff", old, new, "equal.exr", *words, "--channels", "Q")[0] == 2
    assert run("diff", old, new, *words, "--channels", "R,R") == (
        2,
        "",
        "mi-refract: --channels R,R; expected distinct names, or REFERENCE=TEST, between commas\n",
    )


def test_the_command_that_compares_again_says_both(run, noisy, tmp_path):
    words = ("--variance", "{stem}_var.exr", "--channels", "R=G,G=R", "--set", "spp=200")
    run("diff", *noisy, *words, "--json", tmp_path / "a.json")
    (again,) = (
        each["reproduce"] for each in json.loads((tmp_path / "a.json").read_text())["results"] if "off" in each["name"]
    )
    code, out, _ = run(*shlex.split(again)[1:])
    assert (code, out.splitlines()[1].split()[:3]) == (1, ["different", "off.exr", "welch"])


@pytest.mark.parametrize(
    "name, index",
    [
        ("out/", "out/index.html"),
        ("out", "out/index.html"),
        ("v1.2/", "v1.2/index.html"),
        ("a.html/", "a.html/index.html"),
        ("a.HTM", "a.HTM"),
    ],
)
def test_a_report_is_a_folder_unless_it_is_named_as_a_page(run, pair, tmp_path, name, index):
    for _ in range(2):
        code, _, err = run("diff", *pair, "--report", f"{tmp_path}/{name}", "--json", tmp_path / "out.json")
        assert (code, err) == (1, "")
        assert f"mi-refract accept {pair[0]} {pair[1]} --from {tmp_path}/out.json" in (tmp_path / index).read_text()
    assert run("diff", *pair, "--report", tmp_path / "v1.2")[0] == (1 if name == "v1.2/" else 2)

"""`mi-refract diff`: options, bad input, printed output, and reports."""

from __future__ import annotations

import html
import importlib.util
import json
import shlex
import subprocess
import sys
from xml.etree import ElementTree

import msgspec
import pytest
from support.diff_images import BROKEN, SINGLE, image, samples, tree
from support.processes import ENVIRONMENT, assert_refused
from support.readme import DOCS

from mi_refract import __version__
from mi_refract.image_diff import methods, results_file, text_reports
from mi_refract.image_diff.results import Result, Results, Status
from mi_refract.io import errors

EVIL = 'a"b<script>alert(1)<∕script>|`*[x](y)*`,:%0A::error::.exr'

# Verdicts and options ---------------------------------------------------------------------------------------------


def test_equal_and_different_images_and_no_files_written(run, pair, tmp_path):
    old, new = pair
    before = tree(tmp_path)
    code, out, err = run("diff", old / "equal.exr", new / "equal.exr")
    assert (code, err, out.splitlines()[-1]) == (0, "", "1 image: 1 equal")
    code, out, err = run("diff", *pair)
    assert (code, err) == (1, "")
    lines = out.splitlines()
    assert lines[1].split()[:3] == ["different", "louder.exr", "tolerance"]
    assert lines[2].split()[:3] == ["equal", "equal.exr", "tolerance"]
    assert lines[3:] == ["2 images: 1 different, 1 equal"]
    assert tree(tmp_path) == before


def test_inconclusive_renders(run, tmp_path):
    folders = samples(tmp_path / "old", 2, noise=1.0), samples(tmp_path / "new", 2, 100, noise=1.0)
    for word, expected in {"": 3, "pass": 0, "fail": 1}.items():
        option, junit = ["--inconclusive", word] if word else [], tmp_path / "out.xml"
        code, out, err = run("diff", *folders, "--renders", "--method", "welch", "--junit", junit, *option)
        assert (code, err, out.splitlines()[-1]) == (expected, "", "1 image: 1 inconclusive")
        failures = ElementTree.parse(junit).findall(".//failure")
        assert [failure.get("type") for failure in failures] == ([] if word == "pass" else ["inconclusive"])
        assert "welch" in out


@pytest.mark.parametrize(
    ("words", "code"),
    [
        *((f"--method {name}", 1) for name in SINGLE),
        ("--method tolerance --set fail=0.2 --set hard_fail=1", 0),
        ("--method tolerance --set fail_percent=100 --set hard_fail=0.01", 1),
        ("--set spp=16", 1),  # only `welch` uses it: one setting is valid for a folder of both kinds of images
        ("--set ignore=[[0,0,48,31]] --set fail=0.01", 1),
    ],
)
def test_methods_and_settings_as_options(run, pair, words, code):
    assert run("diff", *pair, *words.split())[0] == code


def test_methods_are_printed_without_images(run):
    code, out, err = run("diff", "--methods")
    assert (code, err) == (0, "")
    assert out.count("| `mask` |") == 1  # keys that both tables have are listed once
    for name, method in methods.METHODS.items():
        assert f"`{name}`: {method.summary}" in out
        assert all(f"| `{option}` |" in out for option in method.options)


# A settings file --------------------------------------------------------------------------------------------------

GOOD = """
[defaults]
accept = ["{stem}-*{suffix}"]

[[image]]
name = "louder.exr"
method = "tolerance"
fail = 0.15
ignore = [[0, 0, 2, 2]]
reason = "loud"

[[image]]
name = "gone.exr"
skip = true
reason = "gone"
"""


@pytest.fixture
def pair_with_settings(pair):
    (pair[0] / "mi-refract.toml").write_text(GOOD)
    image(pair[0] / "louder-mac.exr", gain=1.1)
    return pair


def test_settings_and_masks_above_a_folder_are_read_within_a_repository(run, folders, tmp_path):
    """Names, `{dir}` and `{root}` are relative to the folder of the settings; nothing above the repository is read."""
    old, new = folders
    rule = '[defaults]\naccept = ["{stem}-other{suffix}"]\n'
    rule += '[[image]]\nname = "inner/*.exr"\nreason = "masked"\nmask = "{root}/masks/{dir}/{stem}.exr"\n'
    rule += '[[image]]\nname = "other/*"\nreason = "of another folder"\n'
    rule += "".join(f'[[image]]\nname = "{name}"\nskip = true\nreason = "all"\n' for name in ("renders", "added/*"))
    (old / "mi-refract.toml").write_text(rule)
    image(old / "masks" / "inner" / "changed.exr")  # black on the left
    image(new / "inner" / "changed.exr", value=9)  # in the fifth column
    calls = [(old / "inner", new / "inner"), (old / "inner/changed.exr", new / "inner/changed.exr")]
    assert run("diff", old, new, "inner/*")[0] == 0
    for repository, code in ((None, 1), (old / "inner", 1), (old, 0), (tmp_path, 0)):
        if repository:
            (repository / ".git").mkdir()
        for sides in calls:
            assert run("diff", *sides)[::2] == (code, ""), repository
        if repository:
            (repository / ".git").rmdir()
    (tmp_path / ".git").mkdir()
    sides = samples(old / "renders", 2), samples(new / "renders", 2, 100)
    assert run("diff", *sides, "--renders")[1].endswith("1 image: 1 skipped\n")
    image(new / "added" / "first.exr")
    assert run("accept", old / "added", new / "added", "--yes")[1].endswith("nothing to accept\n")
    assert "mask {root}/masks/{dir}/{stem}.exr" in run("diff", old / "inner", "--check-settings")[1]
    assert run("diff", *calls[0], "--settings", old / "mi-refract.toml")[0] == 1  # names are relative to `inner`
    (old / "mi-refract.toml").write_text('[defaults]\nmap = { reference = "{name}", test = "{name}" }\n')
    code, _, err = run("diff", *calls[0])
    assert code == 2 and err.endswith("`map` is for whole folders; expected " + f"{old} as REFERENCE, or --settings\n")


@pytest.mark.parametrize("name", ["same.exr", "inner/changed.exr"])
@pytest.mark.parametrize("words", [[], ["--settings", "mi-refract.toml"]])
def test_a_map_is_refused_for_single_files(run, folders, monkeypatch, name, words):
    old, new = folders
    (old / ".git").mkdir()
    rule = '[[image]]\nname = "*.exr"\nskip = true\nreason = "all"\n'
    (old / "mi-refract.toml").write_text(f'[defaults]\nmap = {{ reference = "{{name}}", test = "{{name}}" }}\n{rule}')
    monkeypatch.chdir(old)
    sides = [folder / name for folder in folders]
    for call in (["diff", *sides], ["accept", *sides, "--yes"], ["diff", sides[0], "--check-settings"]):
        code, _, err = run(*call, *words)
        assert code == 2 and "`map` is for whole folders; expected folders" in err and "or --settings" not in err
    assert run("diff", old, new, "same.exr", *words)[1].endswith("1 skipped\n")


def test_a_wrong_entry_of_other_images_is_no_error_of_a_subfolder_or_a_file(run, folders, tmp_path):
    old, new = folders
    (tmp_path / ".git").mkdir()
    (old / "mi-refract.toml").write_text('[[image]]\nname = "same.exr"\nfial = 1\nreason = "of others"\n')
    assert [run("diff", old, new, *words)[0] for words in (["inner/*"], ["same.exr"], [])] == [1, 2, 2]
    for name in ("inner", "inner/changed.exr"):
        assert run("diff", old / name, new / name)[::2] == (1, "")
        assert run("diff", old / name, new / name, "--check-settings")[::2] == (0, "")
    assert run("diff", old / "removed.exr", new / "added.exr")[::2] == (0, "")
    (old / "same.exr").unlink()
    (new / "same.exr").unlink()
    assert "image[0]: unknown key `fial`" in run("diff", old, new)[2]


def test_check_settings(run, pair_with_settings):
    code, out, err = run("diff", *pair_with_settings, "--check-settings")
    assert (code, err) == (0, "mi-refract: gone.exr: matches no image\n")
    lines = [line.split("  ") for line in out.splitlines()]
    rows = {line[0]: [cell.strip() for cell in line[1:] if cell.strip()] for line in lines}
    resolved = "tolerance, fail=0.15, or louder-mac.exr, without [0, 0, 2, 2]"
    assert rows["louder.exr"] == [resolved, "defaults, image[0]", "loud"]
    assert rows["equal.exr"] == ["auto", "defaults"]
    code, out, _ = run("diff", pair_with_settings[0], "--check-settings")
    assert (code, "louder-mac.exr" in out) == (0, True)
    code, out, err = run("diff", *pair_with_settings, "equal.exr", "--check-settings")
    assert (code, "louder" in out, err) == (0, False, "mi-refract: gone.exr: matches no image\n")
    assert run("diff", *(side / "equal.exr" for side in pair_with_settings), "--check-settings")[::2] == (0, "")
    (pair_with_settings[0] / "mi-refract.toml").write_text('[[image]]\nname = "louder.exr"\nfale = 1\nreason = "r"\n')
    for words in ([], ["--check-settings"]):  # the other images are compared in spite of a wrong entry
        code, out, err = run("diff", *pair_with_settings, *words)
        assert (code, err.count("\n")) == (2, 1)
        assert "image[0]: unknown key `fale`; expected method" in err and "equal.exr" in out


def test_every_report_contains_skipped_images(run, pair, tmp_path):
    (pair[0] / "mi-refract.toml").write_text('[[image]]\nname = "louder.exr"\nskip = true\nreason = "loud"')
    files = ["--report", tmp_path / "out.html", "--junit", tmp_path / "out.xml", "--json", tmp_path / "out.json"]
    code, out, _ = run("diff", *pair, *files, "--github")
    assert code == 0 and "1 equal, 1 skipped" in out and "::" not in out
    assert '<skipped message="skipped by the settings [loud]"' in (tmp_path / "out.xml").read_text()
    assert '"skipped": 1' in (tmp_path / "out.json").read_text()
    code, out, err = run("diff", *pair, "louder.exr", *files, "--github")
    reason = "all images are skipped; expected at least one to compare"
    assert (code, err) == (2, f"mi-refract: {reason}\n") and f"::error title=mi-refract diff::{reason}\n" in out
    assert f'<error message="{reason}" />' in (tmp_path / "out.xml").read_text()


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
    assert err.startswith("mi-refract: ") and "equal.exr" in err
    assert out.splitlines()[-1] == "2 images: 1 could not be compared, 1 different"
    statuses = {r["name"]: r["status"] for r in json.loads(files[0].read_text())["results"]}
    assert statuses == {"equal.exr": "error", "louder.exr": "different"}
    assert [error.get("type") for error in ElementTree.parse(files[1]).findall(".//error")] == ["error"]
    assert_refused(run("diff", pair[0] / "equal.exr", pair[1] / "equal.exr"))


def test_reports_are_written_if_one_image_fails(run, pair, tmp_path, monkeypatch):
    compare = methods.compare

    def fail(method, one, two, **options):
        if one[0].path.name == "equal.exr":
            raise MemoryError("Unable to allocate 9 GiB")
        return compare(method, one, two, **options)

    monkeypatch.setattr(methods, "compare", fail)
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(tmp_path / "none" / "summary.md"))  # cannot be written
    files = [tmp_path / name for name in ("out.html", "out.xml", "out.json")]
    words = [word for pair in zip(("--report", "--junit", "--json"), files, strict=True) for word in pair]
    code, out, err = run("diff", *pair, *words, "--github")
    message = f"mi-refract: {pair[1]}/equal.exr: out of memory: Unable to allocate 9 GiB\n"
    assert (code, err) == (2, f"{message}mi-refract: {tmp_path}/none/summary.md: No such file or directory\n")
    assert "2 images: 1 could not be compared, 1 different" in out.splitlines()
    for text in (file.read_text() for file in files):
        assert "out of memory" in text and "louder.exr" in text
    monkeypatch.setenv(errors.TRACEBACK, "1")
    assert "Traceback" in run("diff", *pair)[2]


def test_images_above_max_values(run, pair):
    names = [pair[0] / "louder.exr", pair[1] / "louder.exr"]
    for words in (["diff", *names], ["accept", *names, "--yes"], ["self-test", names[0]]):
        code, out, err = run(*words, "--max-values", 100)
        assert (code, out) == (2, "")
        assert err.endswith("louder.exr: 48 × 32 × 3 values; expected up to 100 values (max-values)\n")
    assert run("diff", *names, "--max-values", 2**62)[0] == 1
    assert run("diff", *names, "--max-values", 0)[0] == 2


BOTH = "{}/old {}/new "
BAD = {
    "no file": ("{}/old {}/none", "none: no such test file"),
    "no reference": ("{}/none {}/new --inconclusive fail", "none: no such reference file"),
    "file and folder": ("{}/old {}/new/equal.exr", "cannot compare a folder with a file"),
    "nothing in it": ("{}/old {}/empty", "empty: contains no image"),
    "nothing to refer to": ("{}/empty {}/new", "empty: contains no image"),
    "twice the folder": ("{}/old {}/old", "the same path as the reference"),
    "twice the file": ("{}/old/equal.exr {}/old/../old/equal.exr", "the same path as the reference"),
    "twice the folder by a link": ("{}/old {}/link", "the same path as the reference"),
    "within": ("{} {}/new", "one path contains the other"),
    "within the other": ("{}/old {}/old/inner", "one path contains the other"),
    "map": (BOTH + "--settings {}/map.toml", "defaults.map fits no image in"),
    "samples of files": ("{}/old/equal.exr {}/new/equal.exr --renders", "not a folder; --renders expects folders"),
    "option": (BOTH + "--method exact --set fail=1", "--set: unknown key `fail`"),
    "option of neither": (BOTH + "--set threshold=1", "command line: threshold: not an option of auto; expected"),
    "inconclusive": (BOTH + "--inconclusive maybe", "maybe"),
    "no settings": (BOTH + "--settings {}/none.toml", "none.toml"),
    "bad settings": (BOTH + "--settings {}/bad.toml", "bad.toml: defaults: unknown key `fale`"),
    "report's name": (BOTH + "--report {}/report/", "expected a file name that ends in .html"),
    "report's folder": (BOTH + "--report {}/none/out.html", "is not a folder"),
    "junit's name": (BOTH + "--junit {}/out.json", "expected a file name that ends in .xml"),
    "json's name": (BOTH + "--json {}/old/equal.exr", "expected a file name that ends in .json"),
    "one path": ("{}/old", "TEST"),
    "no path": ("", "REFERENCE"),
    "unknown option": (BOTH + "--nonesuch", "--nonesuch"),
}


@pytest.mark.parametrize("words, message", BAD.values(), ids=BAD)
@pytest.mark.parametrize("verb", ["diff", "accept"])
def test_bad_arguments(run, pair, tmp_path, verb, words, message):
    if verb == "accept" and {"--renders", "--inconclusive", "--report", "--junit", "--json"} & {*words.split()}:
        pytest.skip("not one of its options")
    (tmp_path / "empty").mkdir()
    (tmp_path / "old" / "inner").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "old")
    (tmp_path / "bad.toml").write_text("[defaults]\nfale = 1")
    (tmp_path / "map.toml").write_text('[defaults]\nmap = { reference = "no/{name}", test = "{name}/no" }')
    before = tree(tmp_path)
    assert_refused(run(verb, *(word.format(tmp_path) for word in words.split())), message)
    assert tree(tmp_path) == before


@pytest.mark.parametrize(("verb", "package"), [("diff", "scipy"), ("accept", "scipy"), ("report", "jinja2")])
def test_missing_extra_diff(run, pair, monkeypatch, tmp_path, verb, package):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == package else find(name))
    words = ["diff", "--report", tmp_path / "out.html"] if verb == "report" else [verb]
    code, out, err = run(*words, *pair)
    assert (code, out) == (2, "")
    assert err == "mi-refract: comparing needs the extra `diff`: pip install 'mi-refract[diff]'\n"


# Reports ----------------------------------------------------------------------------------------------------------


def test_report(run, pair, tmp_path):
    page, out, rules = tmp_path / "out.HTM", tmp_path / "out.json", tmp_path / "a.toml"
    rules.write_text("")
    flags = f"--method tolerance --set fail=0.01 --max-values 9999 --settings {rules}"
    assert run("diff", *pair, "--report", page, "--json", out, *flags.split())[::2] == (1, "")
    text = html.unescape(page.read_text())
    for words in (f"diff {pair[0]} {pair[1]} {flags}", f"accept {pair[0]} {pair[1]} {flags} louder.exr"):
        assert f"mi-refract {words}" in text
    assert f"mi-refract accept {pair[0]} {pair[1]} --from {out}" in text


@pytest.fixture
def pair_with_evil_name(pair):
    """`pair` with an added third image whose name is hostile to every report."""
    image(pair[1] / "inner.exr")
    (pair[1] / "inner.exr").rename(pair[1] / EVIL)
    return pair


PUBLISHED = DOCS / "_static" / f"diff-report-{results_file.SCHEMA}.schema.json"


def read_json(path):
    """Return the report of `--json`, after checking that it is strict JSON with exactly the keys of the schema."""
    data = json.loads(path.read_text(), parse_constant=pytest.fail)
    msgspec.convert(data, results_file.Document)
    kinds = json.loads(PUBLISHED.read_text())["$defs"]
    digests = [entry["digests"] for entry in data["results"] if entry["digests"]]
    numbers = [number for entry in data["results"] for number in entry["metrics"]]
    objects = {"Document": [data], "Entry": data["results"], "Digests": digests, "MeasuredNumber": numbers}
    for name, items in objects.items():
        assert all(list(x) == list(kinds[name]["properties"]) == kinds[name]["required"] for x in items)
    return data


def test_published_schema_equals_json_schema(run):
    """If this fails: a removed or changed key needs a new schema number; a new key only needs a new file."""
    assert run("diff", "--json-schema") == (0, PUBLISHED.read_text("utf-8"), "")
    document = json.loads(PUBLISHED.read_text())["$defs"]["Document"]
    assert document["properties"]["schema"] == {"enum": [results_file.SCHEMA]}


def test_every_report_follows_the_schema(run, folders, tmp_path):
    old, new = folders
    (old / "mi-refract.toml").write_text(GOOD.replace("gone.exr", "same.exr") + 'hard_fail = inf\nmethod = "tolerance"')
    image(old / "inner" / "changed-mac.exr", gain=2)
    image(new / "nan.exr", value=float("nan"))
    image(old / "nan.exr")
    for side in folders:
        BROKEN["empty"](side / "empty.exr")
    out = tmp_path / "out.json"
    assert run("diff", old, new, "--json", out)[0] == 2
    entries = read_json(out)["results"]
    assert {entry["status"] for entry in entries} == {"error", "different", "skipped"}
    assert {entry["category"] for entry in entries} == {"unknown", "changed", "added", "removed"}
    renders = samples(tmp_path / "a", 2), samples(tmp_path / "b", 2, 100)
    assert run("diff", *renders, "--renders", "--json", out)[0] == 3
    assert read_json(out)["results"][0]["minimum_detectable_difference"] > 0


@pytest.mark.parametrize(("connected", "code"), [("| sleep 0", 1), (">/dev/full", 2)])
def test_json_is_written_if_stdout_fails(pair, tmp_path, connected, code):
    words = [sys.executable, "-u", "-m", "mi_refract.cli", "diff", *pair, "--json", tmp_path / "out.json"]
    command = ["bash", "-c", f'set -o pipefail; "$@" {connected}', "bash", *map(str, words)]
    assert subprocess.run(command, env=ENVIRONMENT, capture_output=True, timeout=60).returncode == code
    assert read_json(tmp_path / "out.json")["exit_code"] == 1


def test_json(run, pair_with_evil_name, tmp_path):
    old, new = pair_with_evil_name
    out = tmp_path / "out.json"
    assert run("diff", old, new, "--json", out)[0] == 1
    data = read_json(out)
    assert data["exit_code"] == 1
    command = shlex.join(["mi-refract", "diff", str(old), str(new), "--json", str(out)])
    assert [data[key] for key in ("version", "command", "pack")] == [__version__, command, None]
    assert data["counts"] == {"error": 0, "different": 2, "inconclusive": 0, "equal": 1, "skipped": 0}
    by_name = {result["name"]: result for result in data["results"]}
    assert by_name[EVIL]["category"] == "added"
    assert by_name[EVIL]["reference"] is None
    changed = by_name["louder.exr"]
    assert (changed["status"], changed["category"]) == ("different", "changed")
    assert changed["test"] == str(new / "louder.exr")
    assert any(metric["bound"] is not None and metric["value"] > metric["bound"] for metric in changed["metrics"])
    assert changed["reproduce"] == shlex.join(["mi-refract", "diff", str(old), str(new), "louder.exr"])
    assert run(*shlex.split(changed["reproduce"])[1:])[0] == 1


def test_junit(run, pair_with_evil_name, tmp_path):
    old, new = pair_with_evil_name
    (new / "equal.exr").unlink()
    out = tmp_path / "out.xml"
    assert run("diff", old, new, "--junit", out)[0] == 1
    root = ElementTree.parse(out).getroot()
    assert [root.get(key) for key in ("tests", "failures", "errors", "skipped")] == ["3", "3", "0", "0"]
    failures = {case.get("name"): case.find("failure") for case in root.iter("testcase")}
    kinds = {name: failure.get("type") for name, failure in failures.items()}
    assert kinds == {EVIL: "added", "equal.exr": "removed", "louder.exr": "different"}
    assert "reproduce: mi-refract diff " in failures["louder.exr"].text


def test_github(run, pair_with_evil_name, tmp_path, monkeypatch):
    old, new = pair_with_evil_name
    BROKEN["empty"](new / "equal.exr")
    summary = tmp_path / "summary.md"
    summary.write_text("before\n")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(summary))
    code, out, _ = run("diff", old, new, "--github")
    assert code == 2
    commands = [line for line in out.splitlines() if line.startswith("::")]
    assert len(commands) == 3
    assert all(line.startswith(f"::error file={new}/") for line in commands)
    assert sum("title=louder.exr%3A different::" in line for line in commands) == 1
    (evil,) = [line for line in commands if "script" in line]
    file, _, rest = evil.removeprefix("::error ").partition("::")
    assert rest == "only among the new images"
    assert file.count(",") == 1 and ":" not in file and "%250A" in file
    text = summary.read_text()
    assert text.startswith("before\n### mi-refract diff: 3 images: 1 could not be compared, 1 different, 1 added\n")
    assert "<script>" not in text and "`" not in text
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert len(rows) == 4
    assert all(row.count("|") == 5 for row in rows)
    monkeypatch.delenv("GITHUB_STEP_SUMMARY")
    (new / EVIL).unlink()
    image(new / "equal.exr")
    code, out, err = run("diff", old, new, "--github")
    assert (code, err) == (1, "")
    assert sum(line.startswith("::error ") for line in out.splitlines()) == 1


@pytest.mark.parametrize(
    "url, run_id, words",
    [
        ("", "", "Report: out.html\n"),
        ("", "7", "Report: out.html, where it is uploaded among the [artefacts of this run](https://g/a/b/actions/"),
        ("https://x.io/r (1)/a.html", "7", "Report: [out.html](https://x.io/r%20%281%29/a.html)\n"),
    ],
)
def test_summary_names_the_report_and_links_to_its_address(tmp_path, monkeypatch, url, run_id, words):
    for name, value in {"SERVER_URL": "https://g", "REPOSITORY": "a/b", "RUN_ID": run_id}.items():
        monkeypatch.setenv(f"GITHUB_{name}", value)
    assert words in text_reports.markdown(Results(tmp_path, tmp_path, ()), "out.html", url)


WARNED = "fail=.05 fail_percent=99 warn=1e-6 warn_relative=0"


def test_every_report_contains_a_warning_without_a_failure(run, pair, tmp_path, monkeypatch):
    out, data, summary, page = (tmp_path / f"out.{ending}" for ending in ("xml", "json", "md", "html"))
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(summary))
    monkeypatch.setenv("MI_REFRACT_REPORT_URL", "https://x.io/")
    for i in range(30):  # many equal images do not hide the warning
        for side in pair:
            image(side / f"{i:02}.exr", shape=(4, 4, 3))
    words = [word for setting in WARNED.split() for word in ("--set", setting)]
    files = ["--junit", out, "--json", data, "--github", "--report", page]
    code, text, _ = run("diff", *pair, "--method", "tolerance", *words, *files)
    lines = text.splitlines()
    assert code == 0
    assert lines[1].split()[:2] == ["equal", "louder.exr"]
    warning = "warning: 100 % of the pixels (1536 of 1536) differ by more than warn = 1e-06 (> warn_percent = 0)"
    assert warning in lines[1] and html.escape(warning) in out.read_text() and "warn_percent" in page.read_text()
    rest = [f"… and {31 - text_reports.FEW} more that are equal", "32 images: 32 equal, 1 with a warning"]
    assert lines[text_reports.FEW + 2 : -1] == rest
    assert lines[-1].startswith("::warning ") and warning.replace("%", "%25") in lines[-1]
    assert not ElementTree.parse(out).findall(".//failure")
    assert [entry["name"] for entry in json.loads(data.read_text())["results"] if entry["warning"]] == ["louder.exr"]
    assert summary.read_text().count("\n| equal |") == 1 and "](https://x.io/)\n" in summary.read_text()
    words[1] = "fail=.01"
    code, text, _ = run("diff", *pair, "--method", "tolerance", *words[:2], "--set", "fail_relative=0", *files)
    assert code == 1
    bound = "100 % of the pixels (1536 of 1536) differ by more than fail = 0.01 (> fail_percent = 0.02)"
    (command,) = [line for line in text.splitlines() if line.startswith("::")]
    assert command.startswith("::error ") and bound.replace("%", "%25") in command
    (failure,) = ElementTree.parse(out).findall(".//failure")
    assert bound in failure.get("message") and bound in text


def test_aligned_columns_and_coloured_verdicts(run, pair, monkeypatch, capfd):
    text_reports.print_table([("verdict", "image", "why"), ("ガラス", "球.exr", "x" * 300), ("e\u0301", "[b].exr", "")])
    lines = [line.rstrip() for line in capfd.readouterr().out.splitlines()]
    assert lines == ["verdict  image    why", f"ガラス   球.exr   {'x' * 300}", "e\u0301        [b].exr"]
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    assert "\x1b[1;31mdifferent" in run("diff", *pair)[1]


def test_a_long_summary_is_cut(tmp_path):
    number = text_reports.SUMMARY_ROWS + 7
    results = tuple(Result(f"{i}.exr", Status.ERROR, tmp_path, tmp_path, error="bad") for i in range(number))
    text = text_reports.markdown(Results(tmp_path, tmp_path, results))
    assert text.count("| error |") == text_reports.SUMMARY_ROWS
    assert text.endswith("\n\n… and 7 more\n\n")

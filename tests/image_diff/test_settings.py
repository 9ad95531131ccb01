"""Settings: layers of defaults, command line and entries; platforms; the keys of the file; the command line."""

from __future__ import annotations

import os
import re
import tomllib

import numpy as np
import pytest
from support.diff_images import image, outcomes
from support.processes import assert_refused
from support.readme import DOCS, blocks

from mi_refract.image_diff import folders as diff
from mi_refract.image_diff import methods, settings
from mi_refract.image_diff.results import Status
from mi_refract.image_diff.settings import ComparisonSpec, Entry, Settings, from_words
from mi_refract.io import image_file

A = '[[image]]\nname = "a"\nreason = "r"\n'
PAGES = [DOCS / "how-to" / f"{name}.md" for name in ("set-thresholds-for-single-images", "compare-noisy-renders")]
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
def load(tmp_path):
    """`load(text, *words, method=…)`: the settings of a file with this text, and of words of the command line."""

    def read(text, *words, method=""):
        path = tmp_path / "rules.toml"
        path.write_text(text)
        return settings.load(path, from_words(method, words))

    return read


# Layers -----------------------------------------------------------------------------------------------------------


def test_later_entries_replace_the_keys_that_they_set(load):
    chosen = load(RULES)
    options = {"fail": 0.2, "fail_relative": 0.0}
    both = ComparisonSpec("tolerance", options, "glass; more glass", entries=("image[0]", "image[1]"))
    assert chosen.of("inner/changed.exr") == both
    first = ComparisonSpec("tolerance", {"fail": 1.0}, "glass", entries=("image[0]",))
    assert chosen.of("inner/deep/other.exr") == first
    assert chosen.of("changed.exr") == load("").of("changed.exr") == ComparisonSpec()


DEFAULTS = '[defaults]\nmethod = "tolerance"\nfail = 0.1\nfail_percent = 1\nvariance = "d.exr"\nchannels = ["R"]\n'
LAYERS = [
    (DEFAULTS, [], "", {"method": "tolerance", "options": {"fail": 0.1, "fail_percent": 1.0}, "variance": "d.exr"}),
    (DEFAULTS, ["fail=0.2"], "", {"options": {"fail": 0.2, "fail_percent": 1.0}}),
    (DEFAULTS, ["variance=c.exr", "channels=G=B"], "", {"variance": "c.exr", "channels": (("G", "B"),)}),
    (DEFAULTS + A + "fail = 0.3", ["fail=0.2"], "tolerance", {"options": {"fail": 0.3, "fail_percent": 1.0}}),
    (DEFAULTS + A + 'variance = "{stem}.exr"', ["variance=c.exr"], "", {"variance": "{stem}.exr"}),
    (DEFAULTS, [], "auto", {"method": "auto"}),
    ('[defaults]\nmethod = "flip"', ["ppd=60"], "", {"method": "flip", "options": {"ppd": 60.0}}),
    (DEFAULTS, [], "exact", {"method": "exact", "options": {}}),  # options of another method are dropped
    (DEFAULTS + A + 'method = "paired"\nlargest = 3', [], "", {"method": "paired", "options": {"largest": 3.0}}),
    (A + 'method = "exact"', ["fail=0.2"], "", {"method": "exact", "options": {}}),
    (A + "allow_nonfinite = true", [], "exact", {"method": "exact", "options": {"allow_nonfinite": True}}),
    (A + "allow_nonfinite = false", ["allow_nonfinite=true"], "", {"options": {"allow_nonfinite": False}}),
]


@pytest.mark.parametrize(("text", "words", "method", "expected"), LAYERS)
def test_entries_override_the_command_line_which_overrides_defaults(load, text, words, method, expected):
    spec = load(text, *words, method=method).of("a")
    assert spec.error == ""
    assert {key: getattr(spec, key) for key in expected} == expected


def test_options_without_a_method_are_those_of_the_methods_of_auto(load):
    chosen = load(A + "fail = 0.3\nspp = 4").of("a")
    assert (chosen.method, chosen.options) == ("auto", {"fail": 0.3, "spp": 4})
    one = image_file.named("one", np.ones((4, 4, 3)))
    other = image_file.named("other", np.full((4, 4, 3), 1.2))
    assert methods.compare("auto", one, other, **chosen.options).verdict == "equal"
    assert methods.compare("auto", one, other, spp=4).verdict == "different"


@pytest.mark.parametrize(
    ("when", "here"),
    [("linux", True), ("macos", False), ("linux x86_64", True), ("linux arm64", False), (["macos", "linux"], True)],
)
def test_entries_apply_to_their_platforms_only(load, monkeypatch, when, here):
    assert settings.this_platform() & set(settings.WORDS)
    monkeypatch.setattr(settings, "this_platform", lambda: frozenset({"linux", "x86_64"}))
    chosen = load(f"{A}when = {when!r}\nfail = 1".replace("'", '"'))
    assert bool(chosen.of("a").options) == here
    assert chosen.unused(["b"]) == (["a"] if here else [])


# Comparisons with settings ----------------------------------------------------------------------------------------


def test_comparisons_use_the_settings(folders, load):
    for side in folders:
        image(side / "nan.exr", value=np.nan)
        image(side / "nan2.exr", value=np.nan)
    rules = RULES + '[[image]]\nname = "nan.exr"\nallow_nonfinite = true\nreason = "r"\n'
    by_name = {result.name: result for result in diff.diff(*folders, load(rules)).results}
    assert (by_name["nan.exr"].status, by_name["nan2.exr"].status) == ("equal", "different")
    assert by_name["inner/changed.exr"].status is Status.EQUAL
    assert by_name["inner/changed.exr"].how.reason == "glass; more glass"
    stale = load(RULES.replace("fail = 0.2", "fail = 0.05") + '[[image]]\nname = "gone.exr"\nreason = "was noisy"\n')
    results = diff.diff(*folders, stale)
    assert outcomes(results)["inner/changed.exr"][0] == "different" and results.unused == ("gone.exr",)
    results = diff.diff(*folders, Settings.for_all(method="tolerance", fail=-1.0))  # out of its range
    assert outcomes(results)["same.exr"][0] == outcomes(results)["inner/changed.exr"][0] == "error"


def test_skipped_images_and_invalid_entries_without_images_are_reported(folders):
    rules = tuple(Entry(name, {"skip": True, "reason": "moved"}) for name in ("added.exr", "removed.exr", "inner/*"))
    results = diff.diff(*folders, Settings(rules))
    assert outcomes(results)["added.exr"] == ("skipped", "unknown")
    assert (results.exit_code, len(results.of(Status.SKIPPED))) == (0, 3)
    assert diff.diff(*folders, Settings((Entry("", {"skip": True}),))).exit_code == 2
    results = diff.diff(*folders, Settings((Entry("gone", {}, error="rules.toml: image[0]: unknown key"),)))
    (wrong,) = results.of(Status.ERROR)
    assert (wrong.name, wrong.error) == ("the settings, image[0]", "rules.toml: image[0]: unknown key")
    assert (results.exit_code, len(results.results)) == (2, 5)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"fale": 1}, "settings: unknown key `fale`; expected method"),
        ({"method": "idiff"}, "settings: method: 'idiff'; expected auto"),
        ({"mask": "../a.exr"}, "settings: mask: '../a.exr'; expected a relative path"),
        ({"accept": "{stem}-*"}, "settings: accept: text; expected a list"),
        ({"channels": ["R", "R"]}, "settings: channels: "),
    ],
)
def test_values_for_all_images_are_checked(folders, values, message):
    chosen = Settings.for_all(channels=["R", "B"], fail=np.float64(0.2), method="tolerance")
    assert chosen.of("a") == ComparisonSpec("tolerance", {"fail": 0.2}, channels=(("R", "R"), ("B", "B")))
    assert outcomes(diff.diff(*folders, chosen))["inner/changed.exr"] == ("equal", "unchanged")
    with pytest.raises(ValueError) as error:
        Settings.for_all(**values)
    assert str(error.value).startswith(message)


# The file ---------------------------------------------------------------------------------------------------------


def test_the_documentation_lists_all_methods_and_its_settings_are_valid(load):
    text = (DOCS / "how-to/compare-images.md").read_text("utf-8")
    assert all(f"| `{name}` |" in text for name in methods.METHODS)
    text = (DOCS / "how-to/coming-from-other-image-diffs.md").read_text("utf-8")
    flags = dict(re.findall(r"^\| `-(\w+)` \| `(\w+)` \|", text, re.MULTILINE))  # of idiff
    assert {flag: name.replace("_", "") for flag, name in flags.items()} == {flag: flag for flag in flags}
    assert set(flags.values()) == methods.METHODS["tolerance"].options.keys()
    examples = [load(text) for page in PAGES for text in blocks(page, "toml")]
    assert [rule.error for chosen in examples for rule in chosen.rules if rule.error] == []
    assert examples[0].of("glass/caustic1.exr").method == "tolerance"


def test_all_options_can_be_set_in_the_file_and_on_the_command_line(load):
    for name, method in methods.METHODS.items():
        table = {option: value.default for option, value in method.options.items()}
        lines = "".join(f"{key} = {value!r}\n".replace("'", '"') for key, value in table.items())
        assert load(f'{A}method = "{name}"\n{lines}').of("a").options == tomllib.loads(lines)
        words = [f"{key}={value}" for key, value in table.items()]
        assert Settings((from_words(name, words),)).of("a") == ComparisonSpec(name, table)


BAD = {
    "no name": ('[[image]]\nreason = "r"', "image[0]: object missing required field `name`"),
    "name": ('[[image]]\nname = ""', "image[0]: name: expected"),
    "table": ('[default]\nmethod = "exact"', "unknown key `default`; expected defaults, image"),
    "defaults": ("[defaults]\nfale = 1", "defaults: unknown key `fale`; expected method"),
    "map": ('[defaults]\nmap = {reference = "{dir}/{name}", test = "{name}"}', "map: expected the same fields"),
    "half a map": ('[defaults]\nmap = {reference = "{dir}/ref/{name}"}', "map: object missing required field `test`"),
    "map of no field": ('[defaults]\nmap = {reference = "a", test = "b"}', "map: expected the same fields"),
    "accept of any folder": ('[defaults]\naccept = ["../*.exr"]', "accept: '../*.exr'; expected a relative path"),
    "no accept": ("[defaults]\naccept = []", "accept: expected a list [ … ] of length >= 1"),
    "no ignore": ("[defaults]\nignore = []", "ignore: expected a list [ … ] of length >= 1"),
    "absolute": ('[defaults]\nmask = "/a.exr"', "mask: '/a.exr'; expected a relative path"),
    "field": ('[defaults]\nvariance = "{stm}.exr"', "variance: '{stm}.exr'; expected a relative path"),
    "skip everything": ("[defaults]\nskip = true", "defaults: unknown key `skip`"),
    "nan": ("[defaults]\nfail = nan", "defaults.fail: nan; expected a number"),
    "no text": (b"\xff\xfe", "expected TOML"),
    "nested": ("a = " + "[" * 5000, "expected TOML"),
    **{
        f"channels {value}": (f"[defaults]\nchannels = {value}\n", "channels")
        for value in ('""', "[]", '["X", "X"]', "{}", '{ a = "X", b = "X" }', "[1]", "{ a = 1 }", "3", '[""]')
    },
}


@pytest.mark.parametrize(("text", "message"), BAD.values(), ids=BAD)
def test_invalid_settings_are_errors_with_the_file_and_key(tmp_path, text, message):
    path = tmp_path / "rules.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ValueError, match=r"^[^\n]*rules\.toml: ") as error:
        settings.load(path)
    assert message in str(error.value)


NO_FILES = {
    "link to nothing": (lambda path: path.symlink_to("nothing"), "No such file or directory"),
    "pipe": (os.mkfifo, "not a regular file"),
    "device": (lambda path: path.symlink_to("/dev/zero"), "not a regular file"),
    "too large": (lambda path: (path.touch(), os.truncate(path, 2**29)), "bytes; expected up to"),
}


@pytest.mark.parametrize(("make", "message"), NO_FILES.values(), ids=NO_FILES)
def test_unreadable_settings_are_errors_in_one_line(run, pair, make, message):
    make(pair[0] / "mi-refract.toml")
    assert_refused(run("diff", *pair), message, "mi-refract.toml: ")


B = '[[image]]\nname = "b"\nreason = "r"\nmethod = "exact"'
BAD_ENTRIES = {
    "no reason": ('[[image]]\nname = "a"', "image[0]: object missing required field `reason`"),
    "empty reason": ('[[image]]\nname = "a"\nreason = " "', "image[0]: reason: ' '"),
    "unknown key": (f"{A}fale = 1", "image[0]: unknown key `fale`; expected method"),
    "option of another": (f'{A}method = "exact"\nfail = 1', "image[0]: unknown key `fail`"),
    "method": (f'{A}method = "idiff"', "image[0]: method: 'idiff'; expected auto, "),
    "type of method": (f"{A}method = 3", "image[0]: method: a whole number; expected text"),
    "type": (f'{A}fail = "0.2"', "image[0]: fail: text; expected a number"),
    "flag": (f"{A}allow_nonfinite = 1", "image[0]: allow_nonfinite: a whole number; expected true or false"),
    "platform": (f'{A}when = "mcos"', "image[0]: when: 'mcos'; expected one or two of linux, macos, windows"),
    "no system": (f'{A}when = ""', "image[0]: when: ''; expected"),
    "two systems": (f'{A}when = "linux macos"', "image[0]: when: 'linux macos'; expected"),
    "rectangle": (f"{A}ignore = [[0, 0, 3]]", "image[0]: ignore[...]: expected a list [ … ] of length 4"),
    "flat rectangle": (f"{A}ignore = [[3, 0, 5, 0]]", "expected a whole number >= 1"),
    "option of neither": (f"{A}changed = 1", "image[0]: changed: not an option of auto; expected "),
    "conflict": (f"{A}fail = 1\n{A}fail = 2", "image[1]: fail: 2.0, but 1.0 in image[0] for the same name 'a'"),
}


@pytest.mark.parametrize(("text", "message"), BAD_ENTRIES.values(), ids=BAD_ENTRIES)
def test_an_invalid_entry_is_an_error_of_its_images_only(load, text, message):
    chosen = load(text + "\n" + B)
    assert message in re.sub(r"ignore\[\d\]", "ignore[...]", chosen.of("a").error)
    assert "\n" not in chosen.of("a").error
    assert chosen.of("b").error == "" and chosen.of("b").method == "exact"


# The command line -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("method", "words", "values"),
    [
        ("", [], {}),
        ("welch", ["tile=8", "equivalence_margin=1", "pixels=no"], {"tile": 8, "pixels": "no"}),
        ("tolerance", ["fail=inf"], {"method": "tolerance", "fail": np.inf}),
        ("", ["channels=X, nested.Y=Y"], {"channels": (("X", "X"), ("nested.Y", "Y"))}),
        ("", ['channels=["X"]'], {"channels": (("X", "X"),)}),
        ("", ["variance={stem}_var.exr"], {"variance": "{stem}_var.exr"}),
        ("", ["allow_nonfinite=true", "ignore=[[0, 0, 2, 2]]"], {"allow_nonfinite": True}),
    ],
)
def test_settings_on_the_command_line(method, words, values):
    layer = from_words(method, words)
    assert {key: layer.values[key] for key in values} == values


@pytest.mark.parametrize(
    ("method", "words", "message"),
    [
        ("idiff", [], "--method idiff; expected auto, exact"),
        ("auto", ["threshold=1"], "--set: unknown key `threshold`; expected method"),
        ("tolerance", ["fail"], "--set fail; expected KEY=VALUE"),
        ("tolerance", ["fail=1", "fail=2"], "--set fail=2; expected KEY=VALUE, each key once"),
        ("tolerance", ["fale=1"], "--set: unknown key `fale`; expected method"),
        ("tolerance", ["fail=much"], "--set: fail: text; expected a number"),
        ("tolerance", ["fail=nan"], "--set: fail: nan; expected a number"),
        ("", ["accept=x"], "--set: accept: text; expected a list [ … ]"),
        ("welch", ["tile=1.5"], "--set: tile: a number; expected a whole number"),
        ("", ["variance=../a.exr"], "--set: variance: '../a.exr'; expected a relative path"),
        *(("", [f"channels={text}"], "--set: channels") for text in ("", "X,", "X,X", "a=X,b=X", "=X", "X=")),
        ("flip", ["method=exact"], "--set method=exact with --method; expected one of them"),
    ],
)
def test_invalid_settings_on_the_command_line_are_errors(method, words, message):
    with pytest.raises(ValueError) as error:
        from_words(method, words)
    assert str(error.value).startswith(message)

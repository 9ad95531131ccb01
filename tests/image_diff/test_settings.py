"""Settings: layers of defaults, command line and entries; platforms; the file, its keys, and options in words."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from support.diff_images import found, image

from mi_refract.image_diff import folders as diff
from mi_refract.image_diff import methods, settings, settings_file
from mi_refract.image_diff.results import Status
from mi_refract.image_diff.settings import ComparisonSpec, Entry, Settings
from mi_refract.io import image_file

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
        return settings_file.load(path).rules

    return write


def test_later_entries_replace_what_they_give(rules):
    chosen = Settings(rules=rules(RULES))
    both, first = ("image[0]", "image[1]"), ("image[0]",)
    options = {"fail": 0.2, "fail_relative": 0.0}
    assert chosen.of("inner/changed.exr") == ComparisonSpec("tolerance", options, "glass; more glass", entries=both)
    assert chosen.of("inner/deep/other.exr") == ComparisonSpec("tolerance", {"fail": 1.0}, "glass", entries=first)
    assert chosen.of("changed.exr") == ComparisonSpec()
    assert Settings(rules=rules("")).of("changed.exr") == ComparisonSpec()


def test_a_rule_goes_before_the_command_line(rules):
    chosen = Settings(ComparisonSpec("tolerance", {"fail": 0.5, "hard_fail": 0.6}), rules(RULES))
    assert chosen.of("inner/changed.exr").options == {"fail": 0.2, "fail_relative": 0.0, "hard_fail": 0.6}
    assert chosen.of("other.exr").options == {"fail": 0.5, "hard_fail": 0.6}
    exact = Settings(ComparisonSpec("exact"), rules(RULES))
    assert exact.of("inner/changed.exr").method == "tolerance"
    assert exact.of("other.exr") == ComparisonSpec("exact")
    silent = Settings(ComparisonSpec("exact"), rules('[[image]]\nname = "a"\nreason = "NaN"\nallow_nonfinite = true'))
    assert silent.of("a") == ComparisonSpec("exact", {"allow_nonfinite": True}, "NaN", entries=("image[0]",))


def test_a_rule_that_allows_no_nan_holds_and_its_command_says_the_same(rules):
    chosen = Settings(
        rules=rules('[[image]]\nname = "a"\nreason = "never"\nallow_nonfinite = false'), allow_nonfinite=("*",)
    )
    assert chosen.of("a").options == {"allow_nonfinite": False}
    assert chosen.of("a").flags == []
    assert chosen.of("b").flags == ["--allow-nonfinite", "*"]


def test_what_is_set_is_what_is_compared_by(folders, rules):
    chosen = Settings(rules=rules(RULES))
    by_name = {result.name: result for result in diff.diff(*folders, chosen).results}
    assert by_name["inner/changed.exr"].status is Status.EQUAL
    assert by_name["inner/changed.exr"].how.reason == "glass; more glass"
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
    chosen = Settings(allow_nonfinite=("a.exr",))
    statuses = found(diff.diff(tmp_path / "old", tmp_path / "new", chosen))
    assert statuses == {"a.exr": ("equal", "unchanged"), "b.exr": ("different", "changed")}


def test_the_readme_names_every_method_and_its_settings_are_accepted(rules):
    text = (Path(diff.__file__).parent / "README.md").read_text("utf-8")
    assert all(f"| `{name}` |" in text for name in methods.METHODS)
    example, *others = re.findall("```toml\n(.*?)```", text, re.DOTALL)
    assert rules(example)[0].values["method"] == "tolerance"
    for each in others:
        rules(each)


BAD_RULES = {
    "no name": ('[[image]]\nreason = "r"', "image[0].name: missing"),
    "name": ('[[image]]\nname = ""', "image[0].name: ''; expected a text"),
    "defaults": ("[defaults]\nfale = 1", "defaults.fale: unknown; expected method"),
    "map": ('[defaults]\nmap = {reference = "{dir}/{name}", test = "{name}"}', "defaults.map; expected the same"),
    "half a map": ('[defaults]\nmap = {reference = "{dir}/ref/{name}"}', "defaults.map.test: missing"),
    "map of no field": ('[defaults]\nmap = {reference = "a", test = "b"}', "defaults.map; expected the same fields"),
    "accept of any folder": ('[defaults]\naccept = ["../*.exr"]', "defaults.accept: ['../*.exr']; expected a list"),
    "field": ('[defaults]\naccept = ["{stm}.exr"]', "defaults.accept: ['{stm}.exr']; expected a list"),
    "skip everything": ("[defaults]\nskip = true", "defaults.skip: unknown"),
    "table": ("[images]", "images: unknown; expected defaults, image"),
    "top": ('method = "exact"', "method: unknown; expected defaults, image"),
    "no list": ('[image]\nname = "a"', "image: "),
    "no TOML": ("[[", "rules.toml: "),
    "nested": ("a = " + "[" * 5000, "rules.toml: "),
}


A = '[[image]]\nname = "a"\nreason = "r"\n'
B = '[[image]]\nname = "b"\nreason = "r"\nmethod = "exact"'
BAD_ENTRIES = {
    "no reason": ('[[image]]\nname = "a"', "image[0].reason: missing; expected a text"),
    "empty reason": ('[[image]]\nname = "a"\nreason = " "', "image[0].reason: ' '"),
    "unknown key": (f"{A}fale = 1", "image[0].fale: unknown; expected name"),
    "option of another": (f'{A}method = "exact"\nfail = 1', "image[0].fail: unknown"),
    "method": (f'{A}method = "idiff"', "image[0].method: 'idiff'; expected auto, "),
    "type of method": (f"{A}method = 3", "image[0].method: 3; expected auto, "),
    "type": (f'{A}fail = "0.2"', "image[0].fail: '0.2'; expected a number"),
    "bool for number": (f"{A}fail = true", "image[0].fail: true"),
    "nan": (f"{A}fail = nan", "image[0].fail: nan"),
    "flag": (f"{A}allow_nonfinite = 1", "image[0].allow_nonfinite: 1"),
    "platform": (f'{A}when = "mcos"', "image[0].when: 'mcos'; expected of linux, macos, windows"),
    "two systems": (f'{A}when = "linux macos"', "image[0].when: 'linux macos'; expected of linux"),
    "rectangle": (f"{A}ignore = [[0, 0, 3]]", "image[0].ignore: [[0, 0, 3]]; expected a list of [x, y, width"),
    "empty rectangle": (f"{A}ignore = [[0, 0, 0, 3]]", "image[0].ignore: [[0, 0, 0, 3]]; expected a list of [x,"),
    "option of neither": (f"{A}changed = 1", "image[0].changed: not an option of auto; expected "),
    "fight": (f"{A}fail = 1\n{A}fail = 2", "image[1].fail: 2.0, but 1.0 in image[0] for the same name 'a'"),
}


@pytest.mark.parametrize("text, message", BAD_ENTRIES.values(), ids=BAD_ENTRIES)
def test_an_entry_that_is_wrong_is_the_error_of_its_images(rules, text, message):
    chosen = Settings(rules=rules(text + "\n" + B))
    assert message in chosen.of("a").error
    assert "\n" not in chosen.of("a").error
    assert chosen.of("b").error == "" and chosen.of("b").method == "exact"


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
        settings_file.load(path)


def test_options_in_words():
    assert settings_file.from_words("auto", []) == ComparisonSpec()
    how = settings_file.from_words("welch", ["tile=8", "equivalence_margin=1", "correction=holm"])
    assert how == ComparisonSpec("welch", {"tile": 8, "equivalence_margin": 1.0, "correction": "holm"})
    assert type(how.options["equivalence_margin"]) is float
    assert settings_file.from_words("tolerance", ["fail=inf"]).options == {"fail": np.inf}


@pytest.mark.parametrize("method", methods.METHODS)
def test_every_option_of_every_method_in_words_and_back(method):
    defaults = {name: option.default for name, option in methods.METHODS[method].options.items()}
    flags = ComparisonSpec(method, defaults).flags
    assert flags[:2] == ["--method", method]
    assert settings_file.from_words(method, flags[3::2]).options == defaults


@pytest.mark.parametrize(
    "method, words, message",
    [
        ("idiff", [], "--method idiff; expected auto, exact"),
        ("auto", ["threshold=1"], "--set threshold: unknown; expected tile"),
        ("tolerance", ["fail"], "--set fail; expected NAME=VALUE"),
        ("tolerance", ["fail=1", "fail=2"], "--set fail=2; expected NAME=VALUE, each name once"),
        ("tolerance", ["fale=1"], "--set fale: unknown; expected fail"),
        ("tolerance", ["fail=much"], "--set fail: 'much'; expected a number"),
        ("tolerance", ["fail=nan"], "--set fail: nan"),
        ("welch", ["tile=1.5"], "--set tile: 1.5; expected a whole number"),
        ("welch", ["correction="], "--set correction: ''"),
    ],
)
def test_bad_options_in_words(method, words, message):
    with pytest.raises(ValueError) as error:
        settings_file.from_words(method, words)
    assert str(error.value).startswith(message)


def test_an_option_out_of_its_range_is_no_verdict(folders):
    results = diff.diff(*folders, Settings(ComparisonSpec("tolerance", {"fail": -1.0})))
    assert {result.status for result in results.results if None not in (result.reference, result.test)} == {"error"}


# Layers -----------------------------------------------------------------------------------------------------------


def load(tmp_path, text, default=None):
    path = tmp_path / "rules.toml"
    path.write_text(text)
    return settings_file.load(path, default or ComparisonSpec())


def test_defaults_come_before_the_command_line_and_that_before_entries(tmp_path):
    text = '[defaults]\nmethod = "tolerance"\nfail = 0.1\nfail_percent = 1\n' + A + "fail = 0.3"
    assert load(tmp_path, text).of("b").options == {"fail": 0.1, "fail_percent": 1.0}
    assert load(tmp_path, text).of("a").options == {"fail": 0.3, "fail_percent": 1.0}
    asked = load(tmp_path, text, ComparisonSpec("tolerance", {"fail": 0.2}))
    assert asked.of("b").options == {"fail": 0.2, "fail_percent": 1.0}
    assert asked.of("a").options == {"fail": 0.3, "fail_percent": 1.0}


def test_another_method_drops_the_options_of_the_one_before(tmp_path):
    text = '[defaults]\nmethod = "tolerance"\nfail = 0.1\n' + A + 'method = "paired"\nlargest = 3'
    assert load(tmp_path, text).of("a").options == {"largest": 3.0}
    assert load(tmp_path, text, ComparisonSpec("exact")).of("b") == ComparisonSpec("exact", entries=("defaults",))


def test_options_without_a_method_are_those_that_auto_may_use(tmp_path):
    chosen = load(tmp_path, A + "fail = 0.3\nspp = 4").of("a")
    assert (chosen.method, chosen.options) == ("auto", {"fail": 0.3, "spp": 4})
    one = image_file.named("one", np.ones((4, 4, 3)))
    other = image_file.named("other", np.full((4, 4, 3), 1.2))
    assert methods.compare("auto", one, other, **chosen.options).verdict == "equal"
    assert methods.compare("auto", one, other, spp=4).verdict == "different"
    with pytest.raises(ValueError, match="tolerance has no option 'threshold'"):
        methods.compare("auto", one, other, threshold=1.0)


@pytest.mark.parametrize(
    ("when", "here"),
    [("linux", True), ("macos", False), ("linux x86_64", True), ("linux arm64", False), (["macos", "linux"], True)],
)
def test_entries_for_platforms(tmp_path, monkeypatch, when, here):
    monkeypatch.setattr(settings, "this_platform", lambda: frozenset({"linux", "x86_64"}))
    chosen = load(tmp_path, f"{A}when = {when!r}\nfail = 1".replace("'", '"'))
    assert bool(chosen.of("a").options) == here
    assert chosen.unused(["b"]) == (["a"] if here else [])


def test_this_platform_has_a_name():
    assert settings.this_platform() & set(settings_file.WORDS)


def test_skipped_images_are_said_and_count_as_nothing(folders):
    rules = tuple(Entry(name, {"skip": True, "reason": "moved"}) for name in ("added.exr", "removed.exr", "inner/*"))
    results = diff.diff(*folders, Settings(rules=rules))
    assert found(results)["added.exr"] == ("skipped", "unknown")
    assert (results.exit_code, len(results.of(Status.SKIPPED))) == (0, 3)
    nothing = Settings(rules=(Entry("*", {"skip": True}),))
    assert diff.diff(*folders, nothing).exit_code == 2


def test_a_wrong_entry_that_matches_nothing_is_told(folders):
    results = diff.diff(*folders, Settings(rules=(Entry("gone", {}, error="rules.toml: image[0].fale: unknown"),)))
    (wrong,) = results.of(Status.ERROR)
    assert (wrong.name, wrong.error) == ("the settings, image[0]", "rules.toml: image[0].fale: unknown")
    assert results.exit_code == 2
    assert len(results.results) == 5


def test_a_rectangle_may_begin_at_zero_but_not_be_empty():
    assert settings_file._rectangles([[3, 0, 5, 5], [0, 3, 1, 1]]) == ((3, 0, 5, 5), (0, 3, 1, 1))
    assert settings_file._rectangles([[3, 0, 0, 5]]) is settings_file._rectangles([[3, 0, 5, 0]]) is None

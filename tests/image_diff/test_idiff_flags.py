"""The flags of `idiff`: what they become, what is refused, in the settings and on the command line."""

from __future__ import annotations

import json
import math
import shlex
from xml.etree import ElementTree

import pytest
from support.diff_images import image

from mi_refract.image_diff import folders
from mi_refract.image_diff import settings_file as diff_settings
from mi_refract.image_diff.idiff_flags import THRESHOLDS, parse
from mi_refract.image_diff.methods import METHODS
from mi_refract.image_diff.settings import ComparisonSpec, Settings

OSL = "-a -fail 0.004 -failpercent 0.02 -hardfail 0.01 -warn 0.008 -warnpercent 0.02 -failrelative 0.001"


def test_every_threshold_is_an_option_of_tolerance():
    options = METHODS["tolerance"].options
    assert {name for name, _ in THRESHOLDS.values()} == options.keys()
    for name, value in parse("").options.items():
        assert METHODS["tolerance"].checked("tolerance", name, value) == value


@pytest.mark.parametrize(
    "text, changed",
    [
        ("", {}),
        (OSL, {"fail": 0.004, "fail_percent": 0.02, "hard_fail": 0.01, "warn": 0.008, "warn_percent": 0.02}),
        ("-fail .01 -failpercent 1", {"fail": 0.01, "fail_percent": 1.0}),
        ("-allowfailures 5", {"allow_failures": 5}),
        ("-allowfailures 5.0", {"allow_failures": 5}),
        ("--fail 1 --warnrelative 1e-3 --hardwarn 2", {"fail": 1.0, "warn_relative": 1e-3, "hard_warn": 2.0}),
        ("-fail 1 -fail 2", {"fail": 2.0}),
        ("-fail inf\n-hardfail '0.5'", {"fail": math.inf, "hard_fail": 0.5}),
    ],
)
def test_flags(text, changed):
    found = parse(text)
    defaults = {"fail": 1e-6, "warn": 1e-6, "hard_fail": math.inf, "hard_warn": math.inf, "allow_failures": 0}
    defaults |= dict.fromkeys(("fail_relative", "fail_percent", "warn_relative", "warn_percent"), 0.0)
    expected = defaults | changed | ({"fail_relative": 0.001} if text == OSL else {})
    assert found.options == expected
    assert found.every is ("-a" in text.split())
    assert type(found.options["allow_failures"]) is int


def test_what_is_printed_or_drawn_is_taken_and_said():
    assert parse("-q -v").ignored == ()
    found = parse("-o 'a b.tif' -od -abs -scale 10 -fail 0.5")
    assert found.ignored == ("-o a b.tif", "-od", "-abs", "-scale 10")
    assert found.options["fail"] == 0.5


BAD = {
    "unknown": ("-fale 1", "-fale: no flag of idiff; expected -fail, "),
    "perceptual": ("-fail 1 -p", "-p: idiff's perceptual test; expected --method flip"),
    "no value": ("-fail", "-fail: nothing follows; expected -fail VALUE"),
    "no number": ("-fail many", "-fail many; expected a number of at least 0"),
    "comma": ("-fail 0,5", "-fail 0,5; expected a number"),
    "negative": ("-fail -1", "-fail -1; expected a number"),
    "nan": ("-hardfail nan", "-hardfail nan; expected a number"),
    "underscore": ("-fail 1_0", "-fail 1_0; expected a number"),
    "share of a pixel": ("-allowfailures 0.5", "-allowfailures 0.5; expected a whole number"),
    "infinite": ("-allowfailures inf", "-allowfailures inf; expected a whole number"),
    "program": ("idiff -fail 1", "idiff: no flag; expected the flags alone"),
    "file": ("-fail 1 a.exr", "a.exr: no flag; expected"),
    "quote": ("-o 'a", '"-o \'a": No closing quotation; expected flags of idiff'),
}


@pytest.mark.parametrize("text, message", BAD.values(), ids=BAD)
def test_bad_flags_are_one_line(text, message):
    with pytest.raises(ValueError) as error:
        parse(text)
    assert str(error.value).startswith(message)
    assert "\n" not in str(error.value)


# Settings ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def rules(tmp_path):
    def write(text, name="*"):
        path = tmp_path / "rules.toml"
        path.write_text(f'[[image]]\nname = "{name}"\nreason = "r"\n{text}\n')
        return diff_settings.load(path).rules

    return write


def test_a_rule_with_flags(rules):
    how = Settings(rules=rules('idiff = "-a -fail .01 -allowfailures 2"')).of("x")
    assert (how.method, how.options["fail"], how.options["allow_failures"]) == ("tolerance", 0.01, 2)
    assert how.options["warn"] == 1e-6
    assert how.flags == ["--idiff", "-a -fail .01 -allowfailures 2"]
    more = Settings(rules=rules('method = "tolerance"\nidiff = ""\nhard_fail = 0.5')).of("x")
    assert more.options == {**parse("").options, "hard_fail": 0.5}
    assert more.flags == ["--idiff", "", "--set", "hard_fail=0.5"]
    assert "image[0].idiff: unknown" in rules('method = "flip"\nidiff = ""')[0].error
    assert "image[0].idiff: 3; expected a text" in rules("idiff = 3")[0].error


def test_a_rule_without_flags_inherits_those_of_the_command_line(rules):
    default = diff_settings.from_words("auto", [], "-a -fail .5")
    how = Settings(default, rules('method = "tolerance"\nfail_percent = 3')).of("x")
    assert (how.options["fail"], how.options["fail_percent"], how.idiff) == (0.5, 3.0, "-a -fail .5")
    assert diff_settings.from_words("auto", ["fail_percent=3"], "-a -fail .5").options == how.options
    assert Settings(default, rules('method = "exact"')).of("x") == ComparisonSpec(
        "exact", {}, "r", entries=("image[0]",)
    )
    own = Settings(default, rules('idiff = "-fail .25"')).of("x")
    assert (own.options["fail"], own.idiff) == (0.25, "-fail .25")


def test_the_command_line_goes_before_the_flags_of_all(tmp_path):
    path = tmp_path / "rules.toml"
    path.write_text('[defaults]\nidiff = "-fail .01"')
    own = diff_settings.load(path, diff_settings.from_words("auto", [], "-a -fail .5")).of("x")
    assert (own.idiff, own.options["fail"]) == ("-a -fail .5", 0.5)
    assert diff_settings.load(path).of("x").idiff == "-fail .01"


def test_a_rule_with_bad_flags_is_an_error_of_its_images_alone(pair, rules, run, tmp_path):
    rules('idiff = "-fale 1"', "louder.exr")
    code, out, err = run("diff", *pair, "--settings", tmp_path / "rules.toml")
    assert code == 2
    assert err.startswith(
        f"mi-refract: {tmp_path}/rules.toml: image[0].idiff: -fale: no flag of idiff; expected -fail,"
    )
    assert err.count("\n") == 1
    assert out.splitlines()[-1] == "2 images: 1 could not be compared, 1 equal"


# On the command line ----------------------------------------------------------------------------------------------


def test_flags_on_the_command_line(run, pair):
    assert run("diff", *pair, "--idiff", "-fail .2")[0] == 0
    assert run("diff", *pair, "--idiff", "-fail .2 -hardfail .001")[0] == 0
    assert run("diff", *pair, "--idiff", "")[0] == 1
    assert run("diff", *pair, "--idiff", "-fail .2", "--set", "fail=0")[0] == 1
    assert run("diff", *pair, "--idiff", "-fail .2", "--method", "tolerance")[0] == 0


@pytest.mark.parametrize(
    "words, message",
    [
        (["--idiff", "-fale 1"], "--idiff: -fale: no flag of idiff; expected -fail, "),
        (["--idiff", "-p"], "--idiff: -p: idiff's perceptual test; expected --method flip"),
        (["--idiff", "", "--method", "exact"], "--idiff with --method exact; accepted with --method tolerance"),
        (["--idiff", "", "--set", "fale=1"], "--set fale: unknown; expected "),
    ],
)
def test_bad_flags_on_the_command_line(run, pair, words, message):
    code, out, err = run("diff", *pair, *words)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"mi-refract: {message}")


def test_flags_of_the_image_of_the_difference_are_said_to_do_nothing(run, pair):
    code, _, err = run("diff", *pair, "--idiff", "-fail .2 -o diff.tif -abs")
    assert (code, err) == (0, "mi-refract: idiff -o diff.tif -abs: no effect; --report OUT.html shows the difference\n")


def test_the_command_that_repeats_it_has_the_same_verdict(run, pair, tmp_path):
    out = tmp_path / "out.json"
    assert run("diff", *pair, "--idiff", "-a -fail .01", "--set", "warn=3", "--json", out)[0] == 1
    (found,) = [each for each in json.loads(out.read_text())["results"] if each["status"] == "different"]
    assert "--idiff '-a -fail .01' --set warn=3" in found["reproduce"]
    assert run(*shlex.split(found["reproduce"])[1:])[0] == 1


# What is said -----------------------------------------------------------------------------------------------------

BOUND = "100 % of the pixels (1536 of 1536) differ by more than fail = 0.01 (> fail_percent = 0)"


def test_the_bound_that_failed_is_in_every_report(run, pair, tmp_path):
    out = tmp_path / "out.xml"
    code, text, _ = run("diff", *pair, "--idiff", "-fail .01", "--junit", out, "--github")
    assert code == 1
    assert BOUND in text
    (command,) = [line for line in text.splitlines() if line.startswith("::")]
    assert command.startswith("::error ") and BOUND.replace("%", "%25") in command
    (failure,) = ElementTree.parse(out).findall(".//failure")
    assert BOUND in failure.get("message")


def test_a_warning_is_in_every_report_and_no_failure(run, pair, tmp_path, monkeypatch):
    out, data, summary = tmp_path / "out.xml", tmp_path / "out.json", tmp_path / "summary.md"
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(summary))
    words = ["--idiff", "-fail .05 -failpercent 99", "--junit", out, "--json", data, "--github"]
    code, text, _ = run("diff", *pair, *words)
    lines = text.splitlines()
    assert code == 0
    assert lines[1].split()[:2] == ["equal", "louder.exr"]
    warning = "warning: 100 % of the pixels (1536 of 1536) differ by more than warn = 1e-06 (> warn_percent = 0)"
    assert warning in lines[1]
    assert lines[3] == "2 images: 2 equal, 1 with a warning"
    assert lines[4].startswith("::warning ") and warning.replace("%", "%25") in lines[4]
    assert len(lines) == 5
    assert not ElementTree.parse(out).findall(".//failure")
    assert [bool(each["warning"]) for each in json.loads(data.read_text())["results"]] == [False, True]
    assert summary.read_text().count("\n| equal |") == 1


def test_many_equal_images_hide_no_warning(tmp_path, run):
    for i in range(30):
        for side, gain in (("old", 1), ("new", 1.1 if i == 29 else 1)):
            image(tmp_path / side / f"{i:02}.exr", gain=gain, shape=(4, 4, 3))
    _, text, _ = run("diff", tmp_path / "old", tmp_path / "new", "--idiff", "-fail .05 -failpercent 99")
    assert "29.exr" in text.splitlines()[1]
    results = folders.diff(tmp_path / "old", tmp_path / "new", Settings(diff_settings.from_words("exact", [])))
    assert [bool(result.warning) for result in results.results] == [False] * 30

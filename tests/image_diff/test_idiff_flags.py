"""The flags of `idiff`: what they become, what is refused, in the settings and on the command line."""

from __future__ import annotations

import json
import math
import shlex
from xml.etree import ElementTree

import pytest
from support.diff_images import image

from mi_refract.image_diff.idiff_flags import THRESHOLDS, parse
from mi_refract.image_diff.methods import METHODS

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
    "unknown": ("-fale 1", "-fale: not a flag of idiff; expected -fail, "),
    "perceptual": ("-fail 1 -p", "-p: idiff's perceptual test; expected --method flip"),
    "no value": ("-fail", "-fail: no value follows; expected -fail VALUE"),
    "no number": ("-fail many", "-fail many; expected a number of at least 0"),
    "comma": ("-fail 0,5", "-fail 0,5; expected a number"),
    "negative": ("-fail -1", "-fail -1; expected a number"),
    "nan": ("-hardfail nan", "-hardfail nan; expected a number"),
    "underscore": ("-fail 1_0", "-fail 1_0; expected a number"),
    "share of a pixel": ("-allowfailures 0.5", "-allowfailures 0.5; expected a whole number"),
    "infinite": ("-allowfailures inf", "-allowfailures inf; expected a whole number"),
    "program": ("idiff -fail 1", "idiff: not a flag; expected only flags"),
    "file": ("-fail 1 a.exr", "a.exr: not a flag; expected"),
    "quote": ("-o 'a", '"-o \'a": No closing quotation; expected flags of idiff'),
}


@pytest.mark.parametrize("text, message", BAD.values(), ids=BAD)
def test_bad_flags_are_one_line(text, message):
    with pytest.raises(ValueError) as error:
        parse(text)
    assert str(error.value).startswith(message)
    assert "\n" not in str(error.value)


# On the command line ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["-fail .2"], 0),
        (["-fail .2 -hardfail .001"], 0),
        ([""], 1),
        (["-fail .2", "--set", "fail=0"], 1),
        (["-fail .2", "--method", "tolerance"], 0),
        (["-a -fail .01", "--set", "warn=3"], 1),
    ],
)
def test_flags_on_the_command_line_and_the_command_that_repeats_it(run, pair, tmp_path, words, code):
    out = tmp_path / "out.json"
    assert run("diff", *pair, "--idiff", *words, "--json", out)[0] == code
    (louder,) = [each for each in json.loads(out.read_text())["results"] if each["name"] == "louder.exr"]
    assert run(*shlex.split(louder["reproduce"])[1:])[0] == code


def test_flags_of_the_image_of_the_difference_have_no_effect_with_a_warning(run, pair):
    code, _, err = run("diff", *pair, "--idiff", "-fail .2 -o diff.tif -abs")
    assert (code, err) == (0, "mi-refract: idiff -o diff.tif -abs: no effect; --report OUT.html shows the difference\n")


# Reports ----------------------------------------------------------------------------------------------------------

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

"""`mi-refract diff` with a settings file: names, `--check-settings`, and errors that stop no other image."""

from __future__ import annotations

import pytest
from support.diff_images import image

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
BAD = '[[image]]\nname = "louder.exr"\nfale = 1\nreason = "loud"\n'


@pytest.fixture
def settled(pair):
    (pair[0] / "mi-refract.toml").write_text(GOOD)
    image(pair[0] / "louder-mac.exr", gain=1.1)
    return pair


def test_check_settings(run, settled):
    code, out, err = run("diff", *settled, "--check-settings")
    assert (code, err) == (0, "mi-refract: gone.exr: matches no image\n")
    lines = [line.split("  ") for line in out.splitlines()]
    rows = {line[0]: [cell.strip() for cell in line[1:] if cell.strip()] for line in lines}
    assert rows["louder.exr"] == [
        "tolerance, fail=0.15, or louder-mac.exr, without [0, 0, 2, 2]",
        "defaults, image[0]",
        "loud",
    ]
    assert rows["equal.exr"] == ["auto", "defaults"]


def test_check_settings_of_one_folder_and_one_image(run, settled):
    code, out, _ = run("diff", settled[0], "--check-settings")
    assert (code, "louder-mac.exr" in out) == (0, True)
    code, out, _ = run("diff", *settled, "equal.exr", "--check-settings")
    assert (code, "louder" in out) == (0, False)


def test_an_entry_that_is_wrong_stops_no_other_image(run, pair):
    (pair[0] / "mi-refract.toml").write_text(BAD)
    for words in ([], ["--check-settings"]):
        code, out, err = run("diff", *pair, *words)
        assert (code, err.count("\n")) == (2, 1)
        assert "image[0].fale: unknown; expected name" in err
        assert "equal.exr" in out


def test_the_variant_is_named(run, settled):
    code, out, _ = run("diff", *settled, "louder.exr", "--set", "fail=0")
    assert code == 0
    assert "; matches louder-mac.exr" not in out  # its own entry already accepts it
    (settled[0] / "mi-refract.toml").write_text(GOOD.replace("fail = 0.15", "fail = 0.001"))
    code, out, _ = run("diff", *settled, "louder.exr")
    assert (code, "; matches louder-mac.exr" in out) == (0, True)


def test_skipped_is_said_everywhere(run, pair, tmp_path):
    (pair[0] / "mi-refract.toml").write_text('[[image]]\nname = "louder.exr"\nskip = true\nreason = "loud"')
    files = ["--report", tmp_path / "out.html", "--junit", tmp_path / "out.xml", "--json", tmp_path / "out.json"]
    code, out, _ = run("diff", *pair, *files, "--github")
    assert code == 0
    assert "1 equal, 1 skipped" in out and "::" not in out
    assert '<skipped message="skipped by the settings [loud]"' in (tmp_path / "out.xml").read_text()
    assert '"skipped": 1' in (tmp_path / "out.json").read_text()

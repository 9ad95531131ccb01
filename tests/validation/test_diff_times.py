"""The study of what a verdict costs: what it measures, not how long it takes."""

from __future__ import annotations

import pytest

from mi_refract.image_diff import folders
from mi_refract.image_diff.settings import Settings
from validation import limits
from validation.diff import times

SMALL = times.Size(48, 64, 2, 1)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    times.write(folder, SMALL)
    return folder


def test_what_is_timed_is_told_apart(root):
    """An image that differs is what the page shows; the folder's images are equal for all that `auto` asks."""
    one, other = root / "a" / "0.exr", root / "b" / "0.exr"
    assert folders.diff(one, other, Settings.for_all(method="tolerance")).exit_code == 1
    assert folders.diff(root / "a", root / "b", renders=True).exit_code == 1
    folder = folders.diff(root / "many_a", root / "many_b")
    assert (folder.exit_code, len(folder.results)) == (0, SMALL.pairs)
    assert folders.diff(root / "many_a", root / "many_b", Settings.for_all(method="exact")).exit_code == 1


def test_rows():
    rows = {row.subject: row for row in times.measure(SMALL, "any")}
    assert rows.keys() >= {"welch", "tolerance", "auto", "page", "memory", "size of the page"}
    assert {name for name, row in rows.items() if "time / reading" in row.values} == {*times.METHODS, "auto"}
    assert 1 < rows["from the shell"].values["time / libraries"] < 10
    assert not [row for row in rows.values() if row.goals]  # they are those of another size
    assert rows["memory"].values["MB of memory"] > 10
    assert 0.02 < rows["size of the page"].values["MB of page"] < limits.PAGE_MEGABYTES


def test_a_process_that_fails_is_no_measurement(root, monkeypatch):
    with pytest.raises(OSError, match=r"none\.exr"):
        times._process("-m", "mi_refract.cli", "diff", str(root / "none.exr"), str(root / "a" / "0.exr"))
    monkeypatch.setattr(times, "PROCESS", "raise SystemExit('no memory')")
    with pytest.raises(OSError, match="no memory"):
        times._memory_row(root, SMALL, "any")

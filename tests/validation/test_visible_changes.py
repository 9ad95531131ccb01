"""The study of visible changes: its images are what they say, and it fails where the bounds do not separate them."""

import numpy as np
import pytest

from mi_refract.image_diff import flip
from mi_refract.image_diff.comparison import Metric
from validation import readme_tables
from validation.diff import visible_changes as study

COUNT = 4


@pytest.fixture(scope="module")
def rows():
    return {name: study.kind_row(name, COUNT) for name in study.KINDS}


def test_what_nobody_sees_is_equal_and_what_a_person_sees_is_different(rows):
    assert {row.verdict for row in rows.values()} == {"pass", "info"}
    dues = [kind.due for kind in study.KINDS.values()]
    assert dues.count(False) >= 3 and dues.count(True) >= 3
    for name, row in rows.items():
        if study.KINDS[name].due is None:  # seen by some, in some images: nothing is demanded
            continue
        assert (row.values[study.ERROR] > 1) == (study.KINDS[name].due is True)


def test_every_kind_changes_something_and_the_same_seed_gives_the_same(rows):
    for name, kind in study.KINDS.items():
        one, two = kind.make(np.random.default_rng(5))
        assert one.pixels.shape == two.pixels.shape == (study.SIZE, study.SIZE, 3)
        assert not np.array_equal(one.pixels, two.pixels), name
    assert study.kind_row("highlight", COUNT) == rows["highlight"]


@pytest.mark.parametrize(
    "local, patch, failed",
    [
        (0.1, 0.12, {"one code", "a quarter pixel"}),
        (0.5, 0.03, {"one code"}),
        (1.0, 1.0, {"line", "moved object", "brighter surface", "light on a surface"}),
        (9.0, 0.12, {"line", "moved object", "colour of an object"}),
        (0.5, 1.0, {"brighter surface", "light on a surface"}),
    ],
)
def test_bounds_elsewhere_fail(monkeypatch, local, patch, failed):
    real = flip.flip

    class Found:
        def __init__(self, *pair):
            one, two = real(*pair).metrics[:2]
            self.metrics = (Metric(one.name, one.value, local), Metric(two.name, two.value, patch))

    monkeypatch.setattr(flip, "flip", Found)
    assert {study.kind_row(name, COUNT).verdict for name in failed} == {"fail"}


def test_the_record_of_what_is_not_seen():
    rows = study.limit_rows()
    codes = [row.values[study.CODES] for row in rows if study.CODES in row.values]
    assert np.isnan(codes[0]) and codes[-1] < 12
    assert np.all(np.diff(codes)[~np.isnan(np.diff(codes))] <= 0)  # the wider, the fainter
    assert 1 < rows[-1].values[study.PIXELS] <= 2


def test_the_table_is_made_of_the_rows(rows):
    text = readme_tables.visible([*rows.values(), *study.limit_rows()])
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
    assert [line[0] for line in lines[2 : 2 + len(study.KINDS)]] == list(study.KINDS)
    assert lines[2][2] == "not seen" and lines[2][-1] == "0.0%"
    assert lines[0][3].endswith("(bound 0.5)") and lines[0][4].endswith("(bound 0.12)")
    assert lines[-1][:2] == ["codes of 255", "never"]

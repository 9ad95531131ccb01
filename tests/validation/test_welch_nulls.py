"""The study of equal pairs sees a test that takes each side's noise at its word, as `welch` once did."""

from dataclasses import replace

import pytest

from mi_refract.image_diff import tile_statistics
from validation.diff import welch_nulls


@pytest.mark.parametrize("defect", [False, True])
def test_a_side_that_does_not_know_its_noise_is_seen(defect, monkeypatch):
    compare = tile_statistics.compare_tiles

    def by_its_own_word(one, two, *more):
        return compare(replace(one, count=1.0), replace(two, count=1.0), *more)

    if defect:
        monkeypatch.setattr(tile_statistics, "compare_tiles", by_its_own_word)
    rows = welch_nulls.null_rows("fireflies 0.001", quick=True, pairs=8)
    assert any(row.broken for row in rows) is defect

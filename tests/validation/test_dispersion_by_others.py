"""What dispersion changes in an image, by two renderers: the figures, apart from the renderers."""

from __future__ import annotations

import numpy as np
import pytest

from validation.suite import dispersion


def changes(signal, noise, seed, scale=1.0):
    rng = np.random.default_rng(seed)
    return scale * signal + noise * rng.standard_normal((4, *signal.shape))


SIGNAL = np.random.default_rng(1).standard_normal((96, 96, 3))


def test_noise_is_not_in_the_correlation():
    """With noise as large as the change; the deviation of each figure is below 0.02."""
    found = dispersion.compared(changes(SIGNAL, 1.0, 2), changes(SIGNAL, 1.0, 3, 1.5))
    for channel in dispersion.CHANNELS:
        assert found[f"correlation, {channel}"] == pytest.approx(1, abs=0.08)
        assert found[f"size, {channel}"] == pytest.approx(1.5, abs=0.1)


def test_another_change_is_not_correlated():
    found = dispersion.compared(changes(SIGNAL, 0.1, 2), changes(SIGNAL[::-1], 0.1, 3))
    assert all(abs(found[f"correlation, {channel}"]) < 0.08 for channel in dispersion.CHANNELS)


def test_a_tint_of_the_whole_is_left_out():
    found = dispersion.compared(changes(SIGNAL, 0.1, 2), changes(SIGNAL - 5, 0.1, 3))
    assert found["correlation, blue"] == pytest.approx(1, abs=0.02)


def test_where_nothing_changes_there_is_no_figure():
    values = dispersion.compared(changes(SIGNAL, 0.1, 2), np.zeros((4, *SIGNAL.shape)))
    assert all(np.isnan(x) for x in values.values())


def test_what_is_replaced_is_there_once():
    assert dispersion._once("a", "b", "cac") == "cbc"
    for text in ("cc", "aa"):
        with pytest.raises(ValueError, match="expected once"):
            dispersion._once("a", "b", text)

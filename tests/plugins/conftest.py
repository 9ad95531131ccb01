"""Fixtures of tests of the plugins."""

import mitsuba as mi
import pytest

from mi_refract.plugins import index_parameter


@pytest.fixture
def llvm_spectral(needs_variant):
    """Run the test in `llvm_ad_spectral`, which the fixture `variant` selects; skip it if that cannot run."""
    needs_variant("llvm_ad_spectral")


@pytest.fixture
def logged(monkeypatch):
    """The texts that the test logs to Mitsuba's log; no warning was logged before."""
    texts = []
    monkeypatch.setattr(index_parameter, "warned", set())
    monkeypatch.setattr(mi, "Log", lambda level, text: texts.append(text))
    return texts

"""Fixtures of tests of the plugins."""

import mitsuba as mi
import pytest

from mi_refract.plugins import index_parameter


@pytest.fixture
def llvm_spectral(needs_variant):
    """`llvm_ad_spectral` for the test, which `variant` sets; skipped where it cannot run."""
    needs_variant("llvm_ad_spectral")


@pytest.fixture
def logged(monkeypatch):
    """The texts of Mitsuba's log; no warning has been said before."""
    texts = []
    monkeypatch.setattr(index_parameter, "warned", set())
    monkeypatch.setattr(mi, "Log", lambda level, text: texts.append(text))
    return texts

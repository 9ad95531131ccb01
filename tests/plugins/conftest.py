"""Fixtures of tests of the plugins."""

import gc

import mitsuba as mi
import pytest

from mi_refract.plugins import index_parameter


@pytest.fixture
def logged(monkeypatch):
    """The texts that the test logs to Mitsuba's log; no warning was logged before."""
    texts = []
    monkeypatch.setattr(index_parameter, "warned", set())
    monkeypatch.setattr(mi, "Log", lambda level, text: texts.append(text))
    return texts


@pytest.fixture
def no_collection():
    """Switch off garbage collection: if it frees any scene while Dr.Jit records, the process crashes."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()

"""What every test of a command needs."""

from __future__ import annotations

import os

import mitsuba as mi
import pytest


@pytest.fixture(autouse=True)
def same_process(monkeypatch):
    """The variant is as before, and no command replaces the process of the tests."""

    def execv(*arguments):
        raise AssertionError(f"restarted: {arguments}")

    monkeypatch.setattr(os, "execv", execv)
    variant = mi.variant()
    yield
    mi.set_variant(variant)

"""What every test of a command needs."""

from __future__ import annotations

import os

import mitsuba as mi
import pytest


@pytest.fixture(autouse=True)
def same_process(monkeypatch):
    """The variant is as before, and no command replaces the process of the tests."""
    monkeypatch.setattr(os, "execv", lambda *arguments: pytest.fail(f"restarted: {arguments}"))
    variant = mi.variant()
    yield
    mi.set_variant(variant)

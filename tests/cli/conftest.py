"""A fixture for all tests of commands."""

from __future__ import annotations

import os

import pytest


@pytest.fixture(autouse=True)
def same_process(monkeypatch):
    """Fail if a command restarts the process of the tests."""
    monkeypatch.setattr(os, "execv", lambda *arguments: pytest.fail(f"restarted: {arguments}"))

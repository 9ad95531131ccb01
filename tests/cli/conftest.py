"""What every test of a command needs."""

from __future__ import annotations

import os

import pytest


@pytest.fixture(autouse=True)
def same_process(monkeypatch):
    """No command replaces the process of the tests."""
    monkeypatch.setattr(os, "execv", lambda *arguments: pytest.fail(f"restarted: {arguments}"))

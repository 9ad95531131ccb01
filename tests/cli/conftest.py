"""What every test of a command needs."""

from __future__ import annotations

import os

import pytest


@pytest.fixture(autouse=True)
def same_process(monkeypatch):
    """No command replaces the process of the tests."""

    def execv(*arguments):
        raise AssertionError(f"restarted: {arguments}")

    monkeypatch.setattr(os, "execv", execv)

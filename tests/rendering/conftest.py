"""Fixtures for tests of rendering."""

from __future__ import annotations

from collections.abc import Callable

import pytest


@pytest.fixture
def llvm(needs_variant: Callable[[str], None]) -> None:
    """Use `llvm_ad_rgb` for the test, also in a file that uses `scalar_variant`."""
    needs_variant("llvm_ad_rgb")

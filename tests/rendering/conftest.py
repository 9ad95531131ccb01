"""What every test of rendering needs."""

from __future__ import annotations

from collections.abc import Callable

import pytest


@pytest.fixture
def llvm(needs_variant: Callable[[str], None]) -> None:
    """`llvm_ad_rgb` for the test, also in a file of `scalar_variant`."""
    needs_variant("llvm_ad_rgb")

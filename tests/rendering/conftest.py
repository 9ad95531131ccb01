"""What every test of rendering needs."""

from __future__ import annotations

import mitsuba as mi
import pytest


@pytest.fixture
def llvm(needs_variant):
    """In the variant llvm_ad_rgb."""
    needs_variant("llvm_ad_rgb")
    mi.set_variant("llvm_ad_rgb")

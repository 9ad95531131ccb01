"""Fixtures of tests of the plugins."""

import pytest
from support.variants import switch


@pytest.fixture
def llvm_spectral(needs_variant):
    """`llvm_ad_spectral` for the test; skipped where it cannot run."""
    needs_variant("llvm_ad_spectral")
    switch("llvm_ad_spectral")

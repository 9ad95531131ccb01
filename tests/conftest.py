"""Chooses the libLLVM before anything imports Dr.Jit, once for all tests, and says which variants run here."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest


def _alone(name: str) -> ModuleType:
    """A module of mi_refract without the package around it, which would import Dr.Jit."""
    spec = importlib.util.spec_from_file_location(name, Path(__file__).parents[1] / f"{name.replace('.', '/')}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


backend = _alone("mi_refract.backend")
VARIANT = backend.activate()
sys.modules["mi_refract"].backend = backend
USABLE: dict[str, str | None] = backend.usable_variants()


def pytest_report_header() -> str:
    return f"mi_refract: {VARIANT}; {backend.summary()}"


@pytest.fixture(scope="session")
def usable_variants() -> list[str]:
    """The variants of Mitsuba that run here."""
    return [variant for variant, reason in USABLE.items() if reason is None]


@pytest.fixture(scope="session")
def needs_variant() -> Callable[[str], None]:
    """`needs_variant("llvm_ad_rgb")` skips the test, with the reason, where that variant cannot run."""

    def check(variant: str) -> None:
        if reason := USABLE[variant]:
            pytest.skip(f"{variant}: {reason}")

    return check

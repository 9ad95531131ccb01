"""Chooses a backend that works before anything initialises LLVM, and says visibly what is skipped and why."""

from dataclasses import dataclass

import drjit as dr
import numpy as np
import pytest

from mi_refract import backend

backend.activate()


@dataclass(frozen=True)
class Setting:
    """A Dr.Jit backend in a precision; `vector` is its 3-vector type."""

    backend: str
    precision: type
    roundoff: float

    @property
    def vector(self):
        name = "Array3f" if self.precision is np.float32 else "Array3f64"
        return getattr(getattr(dr, self.backend), name)


# Scalar arrays compute in double whatever they store: float32 is judged on the vectorised backends.
SETTINGS = [("scalar", np.float64)] + [(b, p) for b in ("llvm", "cuda") for p in (np.float32, np.float64)]


def _setting(request):
    name, precision = request.param
    entry = backend.detect()[name]
    if not entry.usable:
        pytest.skip(f"{name}: {entry.reason}")
    return Setting(name, precision, float(np.finfo(precision).eps) / 2)


def _label(param):
    return f"{param[0]}-{np.dtype(param[1]).name}"


@pytest.fixture(params=SETTINGS, ids=_label, scope="module")
def setting(request):
    """Every backend and precision."""
    return _setting(request)


@pytest.fixture(params=SETTINGS[1:], ids=_label, scope="module")
def vectorised(request):
    """Those that carry derivatives."""
    return _setting(request)


def pytest_generate_tests(metafunc):
    """`variant`: every variant of the wheel, skipped with the reason where it cannot run."""
    if "variant" in metafunc.fixturenames:
        marks = {
            name: [] if reason is None else [pytest.mark.skip(reason=f"{name}: {reason}")]
            for name, reason in backend.usable_variants().items()
        }
        metafunc.parametrize("variant", [pytest.param(name, marks=m) for name, m in marks.items()], indirect=True)


@pytest.fixture
def variant(request):
    import mitsuba as mi

    before = mi.variant()
    mi.set_variant(request.param)
    yield request.param
    mi.set_variant(before)

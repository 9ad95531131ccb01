"""Chooses the libLLVM before anything imports Dr.Jit, once for all tests, and says which variants run here."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from dataclasses import dataclass
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


@pytest.fixture
def each_variant(request: pytest.FixtureRequest):
    """Every variant of the wheel, skipped with the reason where it cannot run; see `pytest_generate_tests`."""
    import mitsuba as mi

    before = mi.variant()
    mi.set_variant(request.param)
    yield request.param
    mi.set_variant(before)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "each_variant" in metafunc.fixturenames:
        marks = {name: pytest.mark.skip(reason=f"{name}: {why}") if why else () for name, why in USABLE.items()}
        parameters = [pytest.param(name, marks=mark) for name, mark in marks.items()]
        metafunc.parametrize("each_variant", parameters, indirect=True)


@dataclass(frozen=True)
class Setting:
    """A Dr.Jit backend in a precision, "float32" or "float64"."""

    backend: str
    name: str

    @property
    def precision(self):
        import numpy as np

        return getattr(np, self.name)

    @property
    def roundoff(self) -> float:
        return {"float32": 2.0**-24, "float64": 2.0**-53}[self.name]

    @property
    def vector(self):
        import drjit as dr

        return getattr(getattr(dr, self.backend), {"float32": "Array3f", "float64": "Array3f64"}[self.name])


# Scalar arrays compute in double whatever they store: float32 is judged on the vectorised backends.
SETTINGS = [("scalar", "float64")] + [(b, p) for b in ("llvm", "cuda") for p in ("float32", "float64")]


def _setting(request: pytest.FixtureRequest) -> Setting:
    entry = backend.detect()[request.param[0]]
    if not entry.usable:
        pytest.skip(f"{entry.name}: {entry.reason}")
    return Setting(*request.param)


@pytest.fixture(params=SETTINGS, ids="-".join, scope="module")
def setting(request: pytest.FixtureRequest) -> Setting:
    """Every backend and precision."""
    return _setting(request)


@pytest.fixture(params=SETTINGS[1:], ids="-".join, scope="module")
def vectorised(request: pytest.FixtureRequest) -> Setting:
    """Those that carry derivatives."""
    return _setting(request)


@pytest.fixture
def scalar_context(tmp_path):
    """`scalar_context(rays=800, ...)`: a run of the validation on scalar_rgb, standard but for what is given."""
    import dataclasses

    import mitsuba as mi

    from validation.run.context import SCALAR_PROFILES, Context

    before = mi.variant()
    mi.set_variant("scalar_rgb")
    standard = SCALAR_PROFILES["standard"]
    yield lambda **given: Context(
        dataclasses.replace(standard, **given), tmp_path, "scalar_rgb", backend.detect(), USABLE
    )
    mi.set_variant(before)


@pytest.fixture
def follow(setting):
    """`trace` in the setting; paths as lists, without what follows their ends."""
    import numpy as np

    from mi_refract.planar.tracer import trace

    def run(segments, origins, directions, max_depth=16, **options):
        options = {"precision": setting.name, "backend": setting.backend, "weights": True} | options
        return trace(segments, np.atleast_2d(origins), np.atleast_2d(directions), max_depth, **options)

    return run


@pytest.fixture
def pair(tmp_path):
    """A folder with a pair that is equal and a pair that differs by 10 %."""
    from support.diff_images import image

    for name, gain in (("equal.exr", 1.0), ("louder.exr", 1.1)):
        image(tmp_path / "old" / name)
        image(tmp_path / "new" / name, gain=gain)
    return tmp_path / "old", tmp_path / "new"


@pytest.fixture
def folders(tmp_path):
    """Same, changed, removed and added images, one of them in a folder inside; and files that are none."""
    from support.diff_images import image

    old, new = tmp_path / "old", tmp_path / "new"
    for folder in (old, new):
        image(folder / "same.exr")
        image(folder / "inner" / "changed.exr", gain=1.0 if folder is old else 1.1)
        (folder / "notes.txt").write_text(folder.name)
    image(old / "removed.exr")
    image(new / "added.exr")
    image(new / ".hidden.exr")
    return old, new


@pytest.fixture
def run(capfd):
    """`run("diff", old, new, "--samples")`: exit code, stdout, stderr."""
    from mi_refract.cli import app

    def call(*words):
        capfd.readouterr()
        code = app.main([*map(str, words)])
        return code, *capfd.readouterr()

    return call

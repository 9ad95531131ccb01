"""Fixtures for all tests. The libLLVM is chosen once, before anything imports Dr.Jit."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import hypothesis
import pytest

from mi_refract import backend

os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # otherwise each process compiles the package: a quarter of its start
VARIANT = backend.activate()
USABLE: dict[str, str | None] = backend.usable_variants()
# `--hypothesis-profile=long` draws more examples, and others in each run.
CHECKS = {"deadline": None, "suppress_health_check": list(hypothesis.HealthCheck)}
hypothesis.settings.register_profile("short", max_examples=50, derandomize=True, database=None, **CHECKS)
hypothesis.settings.register_profile("long", max_examples=1000, **CHECKS)
hypothesis.settings.load_profile("short")


def pytest_report_header() -> str:
    return f"mi_refract: {VARIANT}; {backend.summary()}"


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Start each process with a contiguous part of the tests, so that module fixtures are rarely made twice."""
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log) if config.option.dist == "load" else None


@pytest.fixture(scope="session")
def usable_variants() -> list[str]:
    """The Mitsuba variants that run here."""
    return [variant for variant, reason in USABLE.items() if reason is None]


@pytest.fixture(scope="session")
def needs_variant() -> Callable[[str], None]:
    """`needs_variant("llvm_ad_rgb")` skips the test, with the reason, if that variant cannot run."""

    def check(variant: str) -> None:
        if reason := USABLE[variant]:
            pytest.skip(f"{variant}: {reason}")

    return check


# The variant of a test by the fixture that the test requests; of several fixtures the first one here counts.
FIXED = {"llvm_variant": "llvm_ad_rgb", "llvm_spectral": "llvm_ad_spectral"}
FIXED |= {"scalar_variant": "scalar_rgb", "scalar_context": "scalar_rgb"}


@pytest.fixture(autouse=True)
def variant(request: pytest.FixtureRequest) -> str:
    """The variant of the test: its parameter, otherwise the best that runs here; it is set before the test.

    If it cannot run, the test is skipped.
    """
    parameters = request.node.callspec.params if hasattr(request.node, "callspec") else {}
    fixed = [name for fixture, name in FIXED.items() if fixture in request.fixturenames]
    name: str = getattr(request, "param", parameters.get("each_variant", [*fixed, VARIANT][0]))
    if reason := USABLE[name]:
        pytest.skip(f"{name}: {reason}")
    from support.variants import switch  # imports Mitsuba, before which `activate` must choose a libLLVM

    switch(name)
    return name


@pytest.fixture
def scalar_variant() -> None:
    """Run the test in `scalar_rgb`, which `variant` sets."""


@pytest.fixture
def llvm_variant() -> None:
    """Run the test in `llvm_ad_rgb`, which `variant` sets, also in a file that uses `scalar_variant`."""


@pytest.fixture
def llvm_spectral() -> None:
    """Run the test in `llvm_ad_spectral`, which `variant` sets."""


# Subsets of the variants, by fixture.
SUBSETS = {
    # Per family, the simplest variant and the one that differs most from it: for code without a branch on variants.
    "typical_variant": [name for name in USABLE if name.endswith(("_ad_rgb", "scalar_rgb", "_ad_spectral_polarized"))],
    # One variant per family: for code that does not depend on polarisation.
    "rgb_variant": [name for name in USABLE if name.endswith(("_ad_rgb", "scalar_rgb"))],
    "spectral_variant": [name for name in USABLE if "_spectral" in name],  # light has wavelengths
    "polarized_variant": [name for name in USABLE if name.endswith("_polarized")],  # Mueller matrices
}
# Scalar arrays compute in double even if they store float32: float32 is judged on the vectorised backends.
SETTINGS = [("scalar", "float64")] + [(b, p) for b in ("llvm", "cuda") for p in ("float32", "float64")]
CASES: dict[str, Any] = {
    "each_variant": list(USABLE),
    "setting": SETTINGS,  # every backend and precision
    "float32": [case for case in SETTINGS if case[1] == "float32"],  # for slow tests
    "vectorised": SETTINGS[1:],  # settings with derivatives
}


@pytest.fixture(scope="module")
def each_variant(request: pytest.FixtureRequest) -> str:
    """Every variant of the wheel. Tests are sorted by variant, because a switch takes a tenth of a second."""
    return request.param


@pytest.fixture(scope="module")
def typical_variant(each_variant: str) -> str:
    """The variants of `SUBSETS` that have this fixture's name."""
    return each_variant


@pytest.fixture(scope="module")
def setting(request: pytest.FixtureRequest) -> Any:
    """The `Setting` of each backend and precision in `CASES` that runs here. This imports Dr.Jit."""
    from validation.run.array_settings import Setting

    return Setting.of(*request.param)


rgb_variant = spectral_variant = polarized_variant = typical_variant
float32 = vectorised = setting


def _case(case: str | tuple[str, str]) -> tuple[str, str, str | None]:
    """Return the id, the backend and the reason why it cannot run, of a variant or a (backend, precision)."""
    if isinstance(case, str):
        return case, case.partition("_")[0], USABLE[case]
    entry = backend.detect()[case[0]]
    return "-".join(case), case[0], None if entry.usable else entry.reason


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Make one test per variant or setting that runs here, and one skipped test per backend that does not."""
    for fixture in CASES.keys() & set(metafunc.fixturenames):
        parameters: dict[str, Any] = {}
        subsets = [cases for name, cases in SUBSETS.items() if name in metafunc.fixturenames]
        for case in subsets[0] if fixture == "each_variant" and subsets else CASES[fixture]:
            name, family, reason = _case(case)
            marks = pytest.mark.absent(f"all {family} tests of this file: {reason}") if reason else ()
            parameters[family if reason else name] = pytest.param(case, id=family if reason else name, marks=marks)
        metafunc.parametrize(fixture, list(parameters.values()), indirect=True, scope="module")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Reduce the tests whose backend does not run here to one skipped test per file, with the reason for all."""
    reported, remaining = set(), []
    for item in items:
        absent = item.get_closest_marker("absent")
        if absent:
            if (item.path, *absent.args) in reported:
                continue
            reported.add((item.path, *absent.args))
            item.add_marker(pytest.mark.skip(reason=absent.args[0]))
        remaining.append(item)
    items[:] = remaining


@pytest.fixture
def scalar_context(tmp_path, scalar_variant):
    """`scalar_context(rays=800, ...)`: a standard run of the validation on scalar_rgb with a changed profile."""
    from dataclasses import replace

    from validation.run.context import here

    context = here("standard", tmp_path, "scalar_rgb")
    return lambda **changes: replace(context, profile=replace(context.profile, **changes))


@pytest.fixture
def follow(setting):
    """`planar.trace` in the setting, with weights."""
    import numpy as np

    from mi_refract.planar import trace

    def run(segments, origins, directions, max_depth=16, **options):
        options = {"precision": setting.name, "backend": setting.backend, "weights": True} | options
        return trace(segments, np.atleast_2d(origins), np.atleast_2d(directions), max_depth, **options)

    return run


@pytest.fixture
def pair(tmp_path):
    """Two folders of images: one image is equal in both, one differs by 10 %."""
    from support.diff_images import image

    for name, gain in (("equal.exr", 1.0), ("louder.exr", 1.1)):
        image(tmp_path / "old" / name)
        image(tmp_path / "new" / name, gain=gain)
    return tmp_path / "old", tmp_path / "new"


@pytest.fixture
def folders(tmp_path):
    """Two folders with same, changed, removed and added images, one in a subfolder, and with other files."""
    from support.diff_images import image

    old, new = tmp_path / "old", tmp_path / "new"
    for folder in (old, new):
        image(folder / "same.exr")
        image(folder / "inner" / "changed.exr", gain=1.0 if folder is old else 1.1)
        (folder / "notes.txt").write_text(folder.name)
    image(old / "removed.exr")
    image(new / "added.exr")
    return old, new


@pytest.fixture
def run(capfd):
    """`run("diff", old, new, "--renders")`: exit code, stdout and stderr of the command."""
    from mi_refract.cli import app

    def call(*words):
        capfd.readouterr()
        code = app.main([*map(str, words)])
        return code, *capfd.readouterr()

    return call

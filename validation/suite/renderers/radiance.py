"""Radiance, by the programs in pyradiance's wheel."""

from .system import Pip, RefractFunction, System, recorded_error

SYSTEM = System(
    "radiance",
    "Radiance",
    "BSD (pyradiance), Radiance Software License",
    Pip(("pyradiance==1.3.1", "numpy")),
    megabytes=120,
    small=True,
    draws=True,
    calls=(
        RefractFunction(
            "Radiance, rtrace",
            "f64",
            "radiance_rays.py",
            recorded_error(5e-15, 4e-13, 1e-16, 3e-16),
            "reflected",
            gives_up=1e-6,
            remark="takes cos²θ_t below 1e-6 for total reflection, and misses a surface met at less than 1e-6 rad",
        ),
    ),
)

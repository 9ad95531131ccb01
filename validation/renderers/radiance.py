"""Radiance, by the programs in pyradiance's wheel."""

from .system import Call, Pip, System, noted

SYSTEM = System(
    "radiance",
    "Radiance",
    "BSD (pyradiance), Radiance Software License",
    Pip(("pyradiance==1.3.1", "numpy")),
    megabytes=120,
    small=True,
    draws=True,
    calls=(
        # FTINY: a smaller cos²θ_t is no refraction to it.
        Call("Radiance, rtrace", "f64", "radiance_rays.py", noted(5e-15, 4e-13, 1e-16, 3e-16), "reflected",
             gives_up=1e-6),
    ),
)  # fmt: skip

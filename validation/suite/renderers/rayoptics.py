"""rayoptics: a lens designer's ray tracer. The function that bends a ray needs none of its windows and plots."""

from .system import Pip, RefractFunction, System, recorded_error

SYSTEM = System(
    "rayoptics",
    "rayoptics",
    "BSD-3-Clause",
    Pip(("rayoptics==0.9.8", "numpy"), bare=True),
    megabytes=140,
    small=True,
    calls=(
        RefractFunction(
            "rayoptics, bend", "f64", "rayoptics_rays.py", recorded_error(7e-15, 1.9e-12, 2e-16, 1e-15), "nan"
        ),
    ),
)

"""optiland: a lens designer's ray tracer."""

from .system import Pip, RefractFunction, System, recorded_error

SYSTEM = System(
    "optiland",
    "optiland",
    "MIT",
    Pip(("optiland==0.6.3",)),
    megabytes=1300,
    calls=(
        RefractFunction(
            "optiland, RealRays.refract", "f64", "optiland_rays.py", recorded_error(9e-15, 1.9e-12, 3e-16, 1e-15), "nan"
        ),
    ),
)

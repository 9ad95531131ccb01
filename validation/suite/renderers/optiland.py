"""optiland: a lens designer's ray tracer."""

from .system import Call, Pip, System, noted

SYSTEM = System(
    "optiland",
    "optiland",
    "MIT",
    Pip(("optiland==0.6.3",)),
    megabytes=1300,
    calls=(Call("optiland, RealRays.refract", "f64", "optiland_rays.py", noted(9e-15, 1.9e-12, 3e-16, 1e-15), "nan"),),
)

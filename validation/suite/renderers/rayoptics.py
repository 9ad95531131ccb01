"""rayoptics: a lens designer's ray tracer. The function that bends a ray needs none of its windows and plots."""

from .system import Call, Pip, System, noted

SYSTEM = System(
    "rayoptics",
    "rayoptics",
    "BSD-3-Clause",
    Pip(("rayoptics==0.9.8", "numpy"), bare=True),
    megabytes=140,
    small=True,
    calls=(Call("rayoptics, bend", "f64", "rayoptics_rays.py", noted(7e-15, 1.9e-12, 2e-16, 1e-15), "nan"),),
)

"""Mitsuba's own refraction: its functions, and its `dielectric`."""

from .system import RefractFunction, System, recorded_error

FUNCTIONS = recorded_error(1.4e-6, 4.3e-4, 2e-7, 1.2e-6)  # `dielectric` has the rounding of its frame, too
SYSTEM = System(
    "mitsuba",
    "Mitsuba",
    "BSD-3-Clause",
    None,
    megabytes=0,
    small=True,
    draws=True,
    calls=(
        RefractFunction(
            "Mitsuba, mi.fresnel + mi.refract", "f32", "mitsuba_rays.py", FUNCTIONS, "flag", ("functions",)
        ),
        RefractFunction("Mitsuba, dielectric", "f32", "mitsuba_rays.py", {}, "flag", ("dielectric",)),
    ),
)

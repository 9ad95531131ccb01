"""Blender's Cycles, by its Python module, which needs Python 3.11. Under the GPL: run, never imported here."""

from .system import RECORDED_F32, Pip, RefractFunction, System

SYSTEM = System(
    "cycles",
    "Cycles",
    "GPL-3.0-or-later (Blender); Cycles itself Apache-2.0",
    Pip(("bpy==5.0.1", "numpy<2"), python="3.11"),
    megabytes=970,
    draws=True,
    calls=(RefractFunction("Cycles, refraction closure", "f32", "cycles_rays.py", RECORDED_F32, "zero"),),
)

"""LuxCore, by its Python module."""

from .system import Pip, System

SYSTEM = System("luxcore", "LuxCore", "Apache-2.0", Pip(("pyluxcore==2.11.2", "numpy")), megabytes=390, draws=True)

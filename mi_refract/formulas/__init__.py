"""The formulas of refraction and their error bounds."""

from .documented import FORMULAS, Formula, automatic, reflect, reflect_sandwich, refract_2d, resolve

__all__ = ["FORMULAS", "Formula", "automatic", "reflect", "reflect_sandwich", "refract_2d", "resolve"]

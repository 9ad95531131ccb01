"""Refractive indices of materials by wavelength. Wavelengths are in nanometres, in air or in vacuum as the source says.

In: what a scene says of a material, a number or a string (see `parse`), and wavelengths as floats, numpy arrays or
Dr.Jit arrays. Out: indices in double precision; Dr.Jit differentiates those of its arrays. Nothing here refracts.
"""

from . import glass_catalogs
from .dispersion import LINES, TABLE_VALUES, Medium, Table
from .materials import LABORATORY_AIR, file_in, index, parse, relative_index

__all__ = [
    "LABORATORY_AIR",
    "LINES",
    "TABLE_VALUES",
    "Medium",
    "Table",
    "file_in",
    "glass_catalogs",
    "index",
    "parse",
    "relative_index",
]

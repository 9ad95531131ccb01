"""Refractive indices of materials by wavelength, in nanometres, in air or vacuum as in the material's source.

Input: the specification of a material in a scene, a number or a string (see `parse`), and wavelengths as floats, numpy
arrays or Dr.Jit arrays. Output: indices in double precision; Dr.Jit can differentiate those of its arrays.
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

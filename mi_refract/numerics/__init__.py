"""The arithmetic of the formulas of refraction. No optics.

Input: floats, numpy arrays or Dr.Jit arrays. Output: sums and products with their exact rounding errors, numbers of two
or three words, and operations that give the same results with Dr.Jit's arrays on every backend.

`error_free` and `float_expansions` both have `dot`, `cross` and `two_prod`: the first for the formulas, in the
precision of the arrays, the second for the code that checks them, in float64. `mitsuba_mesh` reads and creates
Mitsuba's meshes; no other file depends on their layout.
"""

from . import error_free, float_expansions, mitsuba_mesh
from .drjit_arrays import (
    BSDF,
    ArrayType,
    BSDFSample,
    Count,
    Emitter,
    Interaction,
    Mask,
    MediumPlugin,
    Number,
    Point2,
    Properties,
    Ray,
    Sampler,
    Scene,
    Sensor,
    Shape,
    Spectrum,
    Texture,
    Values,
    Variant,
    Vector3,
    aligned,
    as_component,
    computed_in_float64,
    differentiated,
    from_numpy,
    ieee_divide,
    ieee_quotients,
    replace_grad,
    rounded_product,
    scale_to_unit,
)
from .error_free import DoubleWord, TripleWord, two_prod, two_sum
from .float_expansions import FloatExpansion

__all__ = [
    "BSDF",
    "ArrayType",
    "BSDFSample",
    "Count",
    "DoubleWord",
    "Emitter",
    "FloatExpansion",
    "Interaction",
    "Mask",
    "MediumPlugin",
    "Number",
    "Point2",
    "Properties",
    "Ray",
    "Sampler",
    "Scene",
    "Sensor",
    "Shape",
    "Spectrum",
    "Texture",
    "TripleWord",
    "Values",
    "Variant",
    "Vector3",
    "aligned",
    "as_component",
    "computed_in_float64",
    "differentiated",
    "error_free",
    "float_expansions",
    "from_numpy",
    "ieee_divide",
    "ieee_quotients",
    "mitsuba_mesh",
    "replace_grad",
    "rounded_product",
    "scale_to_unit",
    "two_prod",
    "two_sum",
]

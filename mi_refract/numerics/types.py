"""Names for the types of Dr.Jit and Mitsuba in signatures.

Both packages are untyped to mypy, so each name stands for `Any`: it tells a reader what to pass, and checks nothing.
"""

from __future__ import annotations

from typing import Any, TypeAlias

# A Python float, or a Dr.Jit float array of N entries (scalar, LLVM, CUDA; float32 or float64; with or without AD).
Number: TypeAlias = Any
# A number, or a numpy array with an entry for each ray.
Values: TypeAlias = Any
# Three `Number`s of one type, as `mi.Vector3f` or `drjit.llvm.Array3f` holds them; v.x, v.y, v.z or v[0], v[1], v[2].
Vector3: TypeAlias = Any
# A Python bool, or a Dr.Jit array of N of them.
Mask: TypeAlias = Any
# A class of Dr.Jit arrays: `type(x)` of a `Number` or a `Vector3`.
ArrayType: TypeAlias = Any
# One variant of Mitsuba as a module, as `import mitsuba` gives it after `set_variant`, or `mitsuba.llvm_ad_rgb`.
Variant: TypeAlias = Any

# Objects of a variant of Mitsuba, of the classes of the same name.
Scene: TypeAlias = Any
Shape: TypeAlias = Any
Emitter: TypeAlias = Any
Sensor: TypeAlias = Any
Sampler: TypeAlias = Any
BSDF: TypeAlias = Any
Properties: TypeAlias = Any
# Arrays of a variant: `mi.Ray3f`, `mi.SurfaceInteraction3f`, `mi.BSDFSample3f`, and `mi.Spectrum` or, in polarised
# variants, a Mueller matrix of it.
Ray: TypeAlias = Any
Interaction: TypeAlias = Any
BSDFSample: TypeAlias = Any
Spectrum: TypeAlias = Any
# An unsigned integer: a Python int or `mi.UInt32`.
Count: TypeAlias = Any
# `mi.Point2f`.
Point2: TypeAlias = Any
# Mitsuba's medium of a shape or a sensor, and its texture.
MediumPlugin: TypeAlias = Any
Texture: TypeAlias = Any

"""Small helpers around Dr.Jit arrays: precision, rounding, division by 0, derivatives, scaling. No optics.

Each works on scalar, LLVM and CUDA arrays of either precision. Before them, names for the types of Dr.Jit and Mitsuba
in signatures. Both packages are untyped to mypy, so each name stands for `Any`: it tells a reader what to pass, and
checks nothing.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import drjit as dr

if TYPE_CHECKING:  # the plugin needs no numpy
    import numpy as np
    from numpy.typing import NDArray

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

Result = TypeVar("Result")

# Dr.Jit's type stubs say that the first returns an object, and nothing of what the second returns.
_reinterpret: Any = dr.reinterpret_array
replace_grad: Any = dr.replace_grad  # Dr.Jit's own, with a type

ALIGNMENT = 64  # bytes, of what Dr.Jit reads in one go


def as_component(a: Vector3, k: Number) -> Number:
    """The number `k` in the precision and backend of the components of the vector `a`, rounded once."""
    component = dr.value_t(type(a))
    if not dr.is_array_v(k):
        k = float(k)
    if component is float and dr.type_v(a) == dr.VarType.Float32:
        return dr.scalar.Array1f(k)[0]
    return component(k)


def from_numpy(kind: ArrayType, values: NDArray[Any]) -> Any:
    """The Dr.Jit array of a numpy array: numbers of (N,), a vector of (N, 3), in the precision of `kind`.

    Dr.Jit's own conversion lets a kernel know the size and the place of the memory, so that others need another kernel.
    """
    import numpy as np

    number = dr.value_t(kind) if values.ndim > 1 else kind
    dtype = np.dtype(np.float64 if dr.type_v(kind) == dr.VarType.Float64 else np.float32)
    parts = [number(aligned(part, dtype)) for part in np.atleast_2d(values.T)]
    return kind(*parts) if values.ndim > 1 else parts[0]


def aligned(values: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """A copy (N,) at an address that is a multiple of ALIGNMENT.

    Dr.Jit uses numpy's memory as it lies, and reads it number by number where that is not aligned: another kernel, and
    a slower one, by chance.
    """
    import numpy as np

    room = np.empty(values.size * dtype.itemsize + ALIGNMENT, np.uint8)
    skipped = -room.ctypes.data % ALIGNMENT
    copy: NDArray[Any] = room[skipped : skipped + values.size * dtype.itemsize].view(dtype)
    copy[:] = values
    return copy


def ieee_divide(x: Number, y: Number) -> Number:
    """x / y by the rules of IEEE 754 on every backend; a Python float would raise where y is 0."""
    if isinstance(y, float) and y == 0:
        return x * dr.rcp(y)
    return x / y


def rounded_product(x: Number, y: Number) -> Number:
    """fl(x y), also where it is added to something: for an x y whose rounding error is known, or is to be found.

    CUDA's compiler may turn a product and a sum into one operation, which does not round the product. It leaves
    `dr.fma` alone, here with a −0 that it cannot know, because it is NaN where a factor is.
    """
    if dr.JitBackend.CUDA not in (dr.backend_v(x), dr.backend_v(y)):
        return x * y
    unknown = y if not dr.is_jit_v(x) or x.state == dr.VarState.Literal else x
    return dr.fma(x, y, -dr.minimum(dr.abs(dr.detach(unknown)), 0))


def ieee_quotients(kind: ArrayType) -> contextlib.AbstractContextManager[None]:
    """A context in which reciprocals, roots and derivatives of arrays like `kind` have the digits of float64 on CUDA.

    There Dr.Jit's `rcp`, and with it `rsqrt` and the derivatives of quotients and roots, otherwise has the 20 bits of
    one instruction.
    """
    few = dr.type_v(kind) == dr.VarType.Float64 and dr.backend_v(kind) == dr.JitBackend.CUDA
    return dr.scoped_set_flag(dr.JitFlag.FastMath, False) if few else contextlib.nullcontext()


def computed_in_float64(function: Callable[..., Result]) -> Callable[..., Result]:
    """`function` of a number or vector first, within `ieee_quotients` of float64 whatever that argument's precision."""

    @functools.wraps(function)
    def with_ieee_quotients(x: Any, *args: Any, **kwargs: Any) -> Result:
        with ieee_quotients(dr.float64_array_t(type(x))):
            return function(x, *args, **kwargs)

    return with_ieee_quotients


def differentiated(x: Number | Vector3) -> bool:
    """Whether `x` carries a derivative. The type is checked first, as asking Dr.Jit takes ten times as long."""
    return dr.is_diff_v(x) and dr.grad_enabled(x)


def scale_to_unit(v: Vector3) -> tuple[Vector3, Number]:
    """(v / p, p), p the power of two for which the largest component of v / p is in [1, 2). Exact.

    Where squares could over- or underflow, which is in float32 on Dr.Jit's arrays; every other type has the range
    for lengths of 1e-18 to 1e18 as it is, and p is the literal 1.
    """
    if dr.type_v(v) != dr.VarType.Float32 or not dr.is_jit_v(v):
        return v, 1
    number: Any = dr.value_t(type(v))
    bits, reinterpret = dr.uint32_array_t(number), _reinterpret
    x, y, z = (reinterpret(bits, dr.detach(v_i)) & 0x7FFFFFFF for v_i in v)  # ordered as |v_i| are
    exponent = dr.maximum(dr.maximum(x, y), z) & 0x7F800000
    # 127 is the bias: of 1 / p and of p one each.
    return v * reinterpret(number, (2 * 127 << 23) - exponent), reinterpret(number, exponent)

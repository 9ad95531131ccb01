"""Small helpers around Dr.Jit arrays: precision, rounding, division by 0, derivatives, scaling. No optics.

Each works on scalar, LLVM and CUDA arrays of either precision. The names for types of Dr.Jit and Mitsuba come first.
Both packages are untyped to mypy, so each name stands for `Any`: it tells readers what to pass, but checks nothing.
"""

from __future__ import annotations

import contextlib
import functools
import math
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
# Three `Number`s of one type, such as `mi.Vector3f` or `drjit.llvm.Array3f`; v.x, v.y, v.z or v[0], v[1], v[2].
Vector3: TypeAlias = Any
# A Python bool, or a Dr.Jit array of N of them.
Mask: TypeAlias = Any
# A class of Dr.Jit arrays: `type(x)` of a `Number` or a `Vector3`.
ArrayType: TypeAlias = Any
# One variant of Mitsuba as a module: `mitsuba` after `set_variant`, or `mitsuba.llvm_ad_rgb`.
Variant: TypeAlias = Any

# Objects of a variant of Mitsuba, instances of the classes of the same name.
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

# In Dr.Jit's type stubs the first returns `object`, and the second has no return type.
_reinterpret: Any = dr.reinterpret_array
replace_grad: Any = dr.replace_grad  # Dr.Jit's own, with a type

ALIGNMENT = 64  # bytes that Dr.Jit reads at once


def as_component(a: Vector3, k: Number) -> Number:
    """The number `k` in the precision and backend of the components of the vector `a`, rounded once."""
    component = dr.value_t(type(a))
    if not dr.is_array_v(k):
        k = float(k)
    if component is float and dr.type_v(a) == dr.VarType.Float32:
        return dr.scalar.Array1f(k)[0]
    return component(k)


def from_numpy(kind: ArrayType, values: NDArray[Any]) -> Any:
    """A numpy array (N,) or (N, 3) as a Dr.Jit number or vector of type `kind`.

    With Dr.Jit's own conversion, a kernel would depend on the size and address of the memory, so that other arrays
    would need another kernel.
    """
    import numpy as np

    number = dr.value_t(kind) if values.ndim > 1 else kind
    dtype = np.dtype(np.float64 if dr.type_v(kind) == dr.VarType.Float64 else np.float32)
    parts = [number(aligned(part, dtype)) for part in np.atleast_2d(values.T)]
    return kind(*parts) if values.ndim > 1 else parts[0]


def aligned(values: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """A copy (N,) at an address that is a multiple of ALIGNMENT.

    Dr.Jit uses numpy's memory in place. If that happens not to be aligned, it reads number by number, with another and
    slower kernel.
    """
    import numpy as np

    room = np.empty(values.size * dtype.itemsize + ALIGNMENT, np.uint8)
    skipped = -room.ctypes.data % ALIGNMENT
    copy: NDArray[Any] = room[skipped : skipped + values.size * dtype.itemsize].view(dtype)
    copy[:] = values
    return copy


def ieee_divide(x: Number, y: Number) -> Number:
    """x / y by the rules of IEEE 754 on every backend; Python floats would raise an exception for y = 0."""
    if isinstance(y, float) and y == 0:
        return x * dr.rcp(y)
    return x / y


def rounded_product(x: Number, y: Number) -> Number:
    """fl(x y), rounded even if it is then added to something; for code that relies on the product's rounding error.

    CUDA's compiler may fuse a product and a sum into one operation, which does not round the product. It does not
    change `dr.fma`, here with a −0 that it cannot predict, as it is NaN if a factor is NaN.
    """
    if dr.JitBackend.CUDA not in (dr.backend_v(x), dr.backend_v(y)):
        return x * y
    unknown = y if not dr.is_jit_v(x) or x.state == dr.VarState.Literal else x
    return dr.fma(x, y, -dr.minimum(dr.abs(dr.detach(unknown)), 0))


def ieee_quotients(kind: ArrayType) -> contextlib.AbstractContextManager[None]:
    """A context in which reciprocals, roots and derivatives of arrays like `kind` are accurate in float64 on CUDA too.

    Without it, Dr.Jit's `rcp` on CUDA, and so `rsqrt` and the derivatives of quotients and roots, has only the 20 bits
    of one instruction.
    """
    few = dr.type_v(kind) == dr.VarType.Float64 and dr.backend_v(kind) == dr.JitBackend.CUDA
    return dr.scoped_set_flag(dr.JitFlag.FastMath, False) if few else contextlib.nullcontext()


def computed_in_float64(function: Callable[..., Result]) -> Callable[..., Result]:
    """`function` called within `ieee_quotients` of float64; its first argument: a number or vector of any precision.

    Integers become float64, as results have the type of that argument.
    """

    @functools.wraps(function)
    def with_ieee_quotients(x: Any, *args: Any, **kwargs: Any) -> Result:
        wide: Any = dr.float64_array_t(type(x))
        with ieee_quotients(wide):
            return function(wide(x) if dr.is_integral_v(x) else x, *args, **kwargs)

    return with_ieee_quotients


def differentiated(x: Number | Vector3) -> bool:
    """Whether `x` has a derivative. The type is checked first, as the query of Dr.Jit takes ten times as long."""
    return dr.is_diff_v(x) and dr.grad_enabled(x)


def scale_to_unit(v: Vector3) -> tuple[Vector3, Number]:
    """(v / p, p) with the power of two p for which the largest component of v / p is in [1, 2). Exact.

    Only for vectors of float32, whose squares could over- or underflow. The range of float64 suffices for lengths of
    1e-18 to 1e18, and p is the literal 1.
    """
    if dr.type_v(v) != dr.VarType.Float32:
        return v, 1
    if not dr.is_jit_v(v):
        largest = max(map(abs, v))
        power = math.ldexp(1, math.frexp(largest)[1] - 1) if 0 < largest < math.inf else 1.0
        return v / power, power
    number: Any = dr.value_t(type(v))
    bits, reinterpret = dr.uint32_array_t(number), _reinterpret
    x, y, z = (reinterpret(bits, dr.detach(v_i)) & 0x7FFFFFFF for v_i in v)  # ordered as |v_i| are
    exponent = dr.maximum(dr.maximum(x, y), z) & 0x7F800000
    # 127 is the bias of the exponent, once for 1 / p and once for p.
    return v * reinterpret(number, (2 * 127 << 23) - exponent), reinterpret(number, exponent)

"""Exact answers for refraction, each with a bound of its error. Needs python-flint.

Input: numpy arrays `a`, `n`, `k`, taken as exact numbers. Output: `Certified` directions, cosines, powers and
amplitudes to 106 bits; `derivatives` along a line of inputs. The oracle judges the formulas of this package, so it
shares no code with them.
"""

try:
    import flint as _flint  # noqa: F401
except ImportError as error:
    raise ImportError("oracle needs python-flint: pip install 'mi-refract[validation]'") from error

from . import derivatives
from .ball_arithmetic import Certified, fresnel, refract, relative_radicand

__all__ = ["Certified", "derivatives", "fresnel", "refract", "relative_radicand"]

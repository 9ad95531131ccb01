"""The reference for refraction in rendering.

`import mi_refract` makes the BSDF `refract` and the integrator `refract_path` known to Mitsuba, in the present variant
and in every later one.

Conventions, everywhere in this package:

- `a` is the incident direction, pointing toward the surface; `n` the surface normal, on either side, unit;
  `k = n_from / n_to`, the index of the medium the ray leaves over the one it enters; `b` the direction after.
- A formula is `f(a, n, k) -> (b, transmitted)`. Where `transmitted` is False `b` is the mirror direction.
  `b` keeps the length of `a`.
- Exactly at the critical angle the ray is transmitted, along the surface. A tangential ray (n·a = 0) neither
  enters nor leaves: `transmitted` is False and b = a.
- NaN in gives NaN out and `transmitted = False`; so does a zero vector, or a k outside 1e-9 … 1e9.
- `contrast` is κ = k² − 1, for those who know it better than float32 `k` does.
"""

import mitsuba as _mi

from mi_refract.formulas import FORMULAS, reflect, reflect_sandwich, refract_2d

from .plugins import refract as _bsdf
from .plugins import refract_path as _integrator

__all__ = ["FORMULAS", "reflect", "reflect_sandwich", "refract_2d"]
__version__ = "0.1.0"


def _register(old: str | None, new: str | None) -> None:
    """After every `set_variant`. Registration is per variant and does not outlive a switch."""
    if new:
        for plugin in (_bsdf, _integrator):
            plugin.register(getattr(_mi, new))


# `scalar_rgb` always: Mitsuba's parser asks only that variant what kind of plugin a name is.
_register(None, "scalar_rgb")
_register(None, _mi.variant())
_mi.detail.add_variant_callback(_register)

"""How a BSDF knows that `refract_path` samples it: by a bit of the context.

A BSDF's arguments are a wavelength and a direction; of the path it knows nothing. Light of several wavelengths leaves a
dispersive boundary in several directions, and glass absorbs along the way to the next boundary: both need the
integrator. The bit says that the integrator does both. (State beside the arguments would not do: Dr.Jit samples a BSDF
again for derivatives, after the integrator has returned.)
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi

# A bit of `type_mask` in the context: the integrator follows wavelengths and media. The same bit of `sampled_type` in a
# sample: the lobe is that of the first wavelength only.
DISPERSED = _FOLLOWED = 1 << 30
if any(int(flag) & DISPERSED for flag in mi.BSDFFlags):
    raise ImportError("bit 30 of mitsuba.BSDFFlags is in use; expected a version of Mitsuba that leaves it free")
warned: set[str] = set()  # what `warn_once` has logged


def context() -> Any:
    """A context for sampling BSDFs, of an integrator that follows wavelengths and media along a path.

    Every render of `refract_path` has it: Dr.Jit traces the BSDFs of other scenes that are in memory as well.
    """
    asked = mi.BSDFContext()
    asked.type_mask |= _FOLLOWED
    return asked


def is_followed(asked: Any) -> bool:
    """Whether a context is of an integrator that follows wavelengths and media."""
    return bool(asked.type_mask & _FOLLOWED)


def warn_once(text: str) -> None:
    """A warning in Mitsuba's log, once a process."""
    if text not in warned:
        warned.add(text)
        mi.Log(mi.LogLevel.Warn, text)  # type: ignore[operator]

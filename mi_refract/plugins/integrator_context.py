"""Whether a BSDF is sampled for `refract_path`, which alone follows one wavelength and knows where a path is.

A BSDF is told a wavelength and a direction, and nothing of the path. Light of several wavelengths leaves a dispersive
boundary in several directions, and glass absorbs along the way to the next boundary: both are the integrator's to do.
A bit of the context says that it does. (No state beside the arguments would: Dr.Jit samples a BSDF again for
derivatives, after the integrator has returned.)
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi

# Of a lobe that is for the first wavelength only. Mitsuba's own flags of BSDFs end at 1 << 16.
DISPERSED = 1 << 30
# In the mask of the types of lobes that a context asks for.
_FOLLOWED = 1 << 30
_said: set[str] = set()


def context() -> Any:
    """A context for sampling BSDFs, of an integrator that follows wavelengths and media along a path.

    It is that of every render of `refract_path`: Dr.Jit traces the BSDFs of other scenes that are in memory as well.
    """
    made = mi.BSDFContext()
    made.type_mask |= _FOLLOWED
    return made


def is_followed(asked: Any) -> bool:
    """Whether a context is of an integrator that follows wavelengths and media."""
    return bool(asked.type_mask & _FOLLOWED)


def warn_once(text: str) -> None:
    """A warning in Mitsuba's log, once a process."""
    if text not in _said:
        _said.add(text)
        mi.Log(mi.LogLevel.Warn, text)  # type: ignore[operator]

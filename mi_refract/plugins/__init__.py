"""Mitsuba's plugins: the BSDF `refract` and the integrator `refract_path`.

In: a Mitsuba variant's module (`mitsuba.llvm_ad_rgb`, say) for `register`, a loaded scene for `inspect`. Out: plugins
known to that variant by the names `PLUGIN`, `PLUGIN_<formula>` and `INTEGRATOR`; what a scene needs of an integrator.
`import mi_refract` registers them in every variant. Importing this room imports Mitsuba.
"""

from typing import Any

from . import refract, refract_path
from .refract import PLUGIN, read_ior
from .refract_path import INTEGRATOR
from .scene_features import SceneFeatures, inspect

__all__ = ["INTEGRATOR", "PLUGIN", "SceneFeatures", "inspect", "read_ior", "register"]


def register(variant: Any) -> None:
    """Make `refract`, `refract_<formula>` and `refract_path` known to one variant, given its module.

    Registering again is harmless. Registration is lost when the variant is switched: `mi_refract` repeats it then.
    """
    refract.register(variant)
    refract_path.register(variant)

"""Mitsuba's plugins: the BSDF `refract` and the integrator `refract_path`.

Input: a Mitsuba variant's module, such as `mitsuba.llvm_ad_rgb`, for `register`; a loaded scene for `inspect`. Output:
plugins registered in that variant with the names `PLUGIN`, `PLUGIN_<formula>` and `INTEGRATOR`; the features that a
scene needs of an integrator, and the light that its integrator misses. `import mi_refract` registers the plugins in
every variant. Importing this package imports Mitsuba.
"""

from mi_refract.numerics import Variant


def register(variant: Variant) -> None:
    """Register `refract`, `refract_<formula>` and `refract_path` in one variant, given its module.

    Registering again is harmless. Registration is lost when the variant is switched; then `mi_refract` repeats it.
    """
    from . import refract, refract_path

    refract.register(variant)
    refract_path.register(variant)


# Importing Mitsuba calls `register`, so it is defined first; the modules below need Mitsuba.
import mitsuba  # noqa: E402, F401

from .index_parameter import PLUGIN, read_ior, read_medium  # noqa: E402
from .medium_tracking import check_integrator, defects, follows_media, sees_light  # noqa: E402
from .refract_path import INTEGRATOR  # noqa: E402
from .scene_features import SceneFeatures, all_shapes, inspect, missing_light  # noqa: E402

__all__ = [
    "INTEGRATOR",
    "PLUGIN",
    "SceneFeatures",
    "all_shapes",
    "check_integrator",
    "defects",
    "film",
    "follows_media",
    "inspect",
    "missing_light",
    "read_ior",
    "read_medium",
    "register",
    "scene_parser",
    "sees_light",
]

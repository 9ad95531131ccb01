"""The reference for refraction in rendering.

`import mi_refract` makes the BSDF `refract` and the integrator `refract_path` known to Mitsuba, in the present variant
and in every later one. It does not import Mitsuba itself: where Mitsuba is not imported yet, the plugins are registered
as soon as it is. So `mi-refract --help` need not wait for it, and `backend.activate` can still choose the libLLVM.

Conventions, everywhere in this package:

- `a` is the incident direction, pointing toward the surface; `n` the surface normal, on either side, unit;
  `k = n_from / n_to`, the index of the medium the ray leaves over the one it enters; `b` the direction after.
- A formula is `f(a, n, k) -> (b, transmitted)`. Where `transmitted` is False `b` is the mirror direction.
  `b` keeps the length of `a`.
- Exactly at the critical angle the ray is transmitted, along the surface. A tangential ray (n·a = 0) neither
  enters nor leaves: `transmitted` is False and b = a.
- NaN in gives NaN out and `transmitted = False`; so does a zero vector, or a k outside 2⁻²⁰ … 2²⁰.
- `contrast` is κ = k² − 1, for those who know it better than float32 `k` does.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from importlib.machinery import ModuleSpec

    from .formulas import FORMULAS, reflect, reflect_sandwich, refract_2d

__all__ = ["FORMULAS", "SCENES", "reflect", "reflect_sandwich", "refract_2d"]
__version__ = "0.1.0"

# The scenes of the package: `scenes` in it where it is installed, beside it in a checkout.
SCENES = next((x for x in (Path(__file__).parents[i] / "scenes" for i in (0, 1)) if x.is_dir()), Path("scenes"))


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module("mi_refract.formulas"), name)


def _register_plugins() -> None:
    """Register the plugins in the present variant, and by a callback of Mitsuba's in every later one."""
    import mitsuba as mi

    from . import plugins

    def register(old: str | None, new: str | None) -> None:
        """Registration is per variant and does not outlive a switch."""
        if new:
            plugins.register(getattr(mi, new))

    # `scalar_rgb` always: Mitsuba's parser asks only that variant what kind of plugin a name is.
    register(None, "scalar_rgb")
    register(None, mi.variant())
    mi.detail.add_variant_callback(register)


class _RegisterWithMitsuba:
    """A finder of modules that leaves all to the others, but registers the plugins at the end of `import mitsuba`."""

    def __init__(self) -> None:
        self.asks_others = False

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        if name != "mitsuba" or self.asks_others:
            return None
        import importlib.util

        self.asks_others = True
        try:
            spec = importlib.util.find_spec(name)
        finally:
            self.asks_others = False
        if spec is None or spec.loader is None:
            return None
        run = spec.loader.exec_module

        def exec_module(module: Any) -> None:
            run(module)
            _register_plugins()

        spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec


if "mitsuba" in sys.modules:
    _register_plugins()
else:
    sys.meta_path.insert(0, _RegisterWithMitsuba())

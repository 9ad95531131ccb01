"""What a loaded Mitsuba scene needs of an integrator, and what an integrator can leave out. For every variant.

A black surface needs nothing: that is a `diffuse` whose reflectance is the number 0, as an area light without a BSDF
has it. In spectral variants `<rgb value="0"/>` is a spectrum of about 3e-8, which is not black. A plugin that is not
known here, and an instance, whose shapes Mitsuba does not show, count as needing everything.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr

WRAPPERS = {"BlendBSDF", "BumpMap", "MaskBSDF", "NormalMap", "TwoSidedBRDF"}
DEPOLARISING = {
    "Hair",
    "Measured",
    "Null",
    "Principled",
    "PrincipledThin",
    "RoughDielectric",
    "RoughPlastic",
    "SmoothDiffuse",
    "SmoothPlastic",
    "ThinDielectric",
}
POLARISING = {
    "CircularPolarizer",
    "LinearPolarizer",
    "LinearRetarder",
    "MeasuredPolarized",
    "PolarizedPlastic",
    "Refract",
    "RoughConductor",
    "SmoothConductor",
    "SmoothDielectric",
}
KNOWN = WRAPPERS | DEPOLARISING | POLARISING
# Plugins that sample with `sample1` or with `sample2`, and never with both.
EITHER = {
    "Null",
    "Refract",
    "RoughConductor",
    "SmoothConductor",
    "SmoothDielectric",
    "SmoothDiffuse",
    "ThinDielectric",
    "TwoSidedBRDF",
}


@dataclass(frozen=True)
class SceneFeatures:
    """Facts about a scene. `unknown`: the plugins that are not known, and so count as needing everything."""

    smooth: bool  # some BSDF has a lobe that is not a delta: then sampling emitters is worth while
    sampleable: bool  # some emitter can be sampled
    lamps: bool  # some emitter other than the environment can be
    area: bool  # some shape emits
    environment: bool
    plain_environment: bool  # it has the same radiance in all directions
    delta_emitters: bool  # some emitter can be found only by sampling it
    both_numbers: bool  # some BSDF samples with `sample1` and with `sample2`, too
    only_glass: bool  # every BSDF has delta lobes only
    textured: bool  # something of a BSDF or of a light varies over its surface
    null: bool  # some BSDF has a null lobe
    polarising: bool  # some BSDF acts on the state of polarisation
    dispersive: bool  # some BSDF bends light by its wavelength
    absorbing: bool  # some BSDF has an absorbing medium on one side
    media: bool
    unknown: tuple[str, ...] = ()

    @property
    def left_out(self) -> dict[str, str]:
        """What an integrator can leave out: feature → the reason, in words."""
        reasons = {
            "emitter sampling": "every BSDF has delta lobes only"
            if not self.smooth
            else ""
            if self.sampleable
            else "no emitter can be sampled",
            "a random number": "" if self.both_numbers else "no BSDF samples with one number and with two as well",
            "area lights": "" if self.area else "no shape emits",
            "environment": "" if self.environment else "no environment emitter",
            "sampling the environment": "what is the same everywhere is met by the BSDFs' own samples"
            if self.plain_environment and self.smooth
            else "",
            "media": "" if self.media else "neither a shape, a sensor nor an emitter has a medium",
            "null lobes": "" if self.null else "no BSDF has one",
            "textures": "" if self.textured else "no BSDF and no area light varies over its surface",
            "polarisation": "" if self.polarising else "no BSDF acts on it",
            "dispersion": "" if self.dispersive else "no BSDF bends light by its wavelength",
            "absorption": "" if self.absorbing else "no BSDF has an absorbing medium on a side",
        }
        return {feature: reason for feature, reason in reasons.items() if reason}


def inspect(scene: Any) -> SceneFeatures:
    """What a Mitsuba scene needs as it is now; an edit of its parameters can change that."""
    import mitsuba as mi

    shapes, emitters, sky = scene.shapes(), scene.emitters(), scene.environment()
    opaque = [shape.class_name() for shape in shapes if shape.class_name() == "Instance"]
    bsdfs = [bsdf for shape in shapes if not _black(outer := shape.bsdf()) for bsdf in nested(outer)]
    names = [_name(bsdf) for bsdf in bsdfs]
    unknown = tuple(sorted({name for name in names if name not in KNOWN} | set(opaque)))
    everything = bool(unknown)
    flags = 0
    for bsdf in bsdfs:
        flags |= bsdf.flags()
    lobes, sampled = mi.BSDFFlags, [emitter.flags() for emitter in emitters]
    lamps = [shape.emitter() for shape in shapes if shape.is_emitter()]
    media = [medium for shape in shapes for medium in (shape.interior_medium(), shape.exterior_medium())]
    media += [end.get_medium() for end in (*emitters, *scene.sensors())]
    return SceneFeatures(
        smooth=everything or bool(flags & +lobes.Smooth),
        sampleable=bool(emitters),  # Mitsuba refuses a scene all of whose emitters have the weight 0
        lamps=any(not emitter.is_environment() and emitter.sampling_weight() > 0 for emitter in emitters),
        area=bool(opaque) or any(shape.is_emitter() for shape in shapes),
        environment=sky is not None,
        plain_environment=sky is not None and sky.class_name() == "ConstantBackgroundEmitter",
        both_numbers=bool(set(names) - EITHER) or everything,
        # An emitter that declares nothing may be anything.
        delta_emitters=any(not flag or flag & +mi.EmitterFlags.Delta for flag in sampled),
        only_glass=not (everything or flags & +(lobes.Smooth | lobes.Delta1D)),
        textured=everything or any(_textured(node) for node in (*bsdfs, *lamps)),
        null=everything or bool(flags & +lobes.Null),
        polarising=any(name not in WRAPPERS | DEPOLARISING for name in names) or everything,
        dispersive=everything or any(getattr(bsdf, "dispersive", False) for bsdf in bsdfs),  # no plugin of Mitsuba's is
        absorbing=everything or any(getattr(bsdf, "absorbing", False) for bsdf in bsdfs),
        media=bool(opaque) or any(medium is not None for medium in media),
        unknown=unknown,
    )


def _name(bsdf: Any) -> str:
    """The C++ class; of a Python plugin, which Mitsuba calls "BSDF", its own, with its module unless it is ours."""
    name, kind = bsdf.class_name(), type(bsdf)
    if name != "BSDF" and kind.__module__.startswith("mitsuba"):
        return str(name)
    return kind.__name__ if kind.__module__.startswith("mi_refract.") else f"{kind.__module__}.{kind.__name__}"


def nested(bsdf: Any) -> Iterator[Any]:
    """A BSDF, and those that it shows within it."""
    yield bsdf
    for child in _children(bsdf):
        if hasattr(child, "eval_null_transmission"):
            yield from nested(child)


def _textured(node: Any) -> bool:
    return any(hasattr(child, "is_spatially_varying") and child.is_spatially_varying() for child in _children(node))


def _black(bsdf: Any) -> bool:
    # A frozen function is recorded for every value that will come.
    if _name(bsdf) != "SmoothDiffuse" or dr.flag(dr.JitFlag.FreezingScope):
        return False
    (reflectance,) = _children(bsdf)
    exact = reflectance.class_name() == "UniformSpectrum" or "spectral" not in bsdf.variant_name()
    return bool(exact and not reflectance.is_spatially_varying() and reflectance.max() == 0)


def _children(node: Any) -> list[Any]:
    """The Mitsuba objects that a plugin shows of itself."""
    import mitsuba as mi

    class Children(mi.TraversalCallback):
        def __init__(self) -> None:
            super().__init__()
            self.found: list[Any] = []

        def put(self, name: str, value: Any, flags: Any, cpptype: Any = None) -> None:
            if isinstance(value, mi.Object):
                self.found.append(value)

    callback = Children()
    node.traverse(callback)
    return callback.found

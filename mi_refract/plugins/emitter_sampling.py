"""Which emitters are sampled: all of them, as Mitsuba does, or all but a constant environment.

Light that is the same from all directions adds little noise where only the BSDF is sampled; the noise comes from what
occludes it. Sampling it as an emitter would leave fewer samples for the other emitters.
"""

from __future__ import annotations

from typing import Any

import drjit as dr


class SceneEmitters:
    """All emitters, chosen by Mitsuba."""

    def __init__(self, v: Any, scene: Any) -> None:
        """`v`: the variant's module."""
        self.scene = scene

    def sample(self, si: Any, number: Any, active: Any) -> tuple[Any, Any]:
        """A direction toward an emitter, and its radiance over the density; shadows are not looked at."""
        return self.scene.sample_emitter_direction(si, number, False, active)

    def pdf(self, reference: Any, ds: Any, active: Any) -> Any:
        """The density per solid angle, seen from `reference`, with which `sample` picks `ds`."""
        return self.scene.pdf_emitter_direction(reference, ds, active)


class NonConstantEmitters:
    """All emitters but the environment, chosen by their sampling weights."""

    def __init__(self, v: Any, scene: Any) -> None:
        """`v`: the variant's module."""
        self.v, emitters = v, scene.emitters()
        kept = [i for i, emitter in enumerate(emitters) if not emitter.is_environment()]
        weights = [float(emitters[i].sampling_weight()) for i in kept]
        self.total, self.vectorised = sum(weights), dr.is_jit_v(v.Float)
        if not self.total:  # nothing is asked
            return
        if self.vectorised:
            self.pointers = dr.gather(v.EmitterPtr, scene.emitters_dr(), v.UInt32(kept))
        else:
            self.pointers = [emitters[i] for i in kept]
        self.choice = v.DiscreteDistribution(weights) if len(kept) > 1 else None

    def sample(self, si: Any, number: Any, active: Any) -> tuple[Any, Any]:
        """As `SceneEmitters.sample`."""
        v, index, probability = self.v, self.v.UInt32(0), 1.0
        if self.choice:
            index, x, probability = self.choice.sample_reuse_pmf(number.x, active)
            number = v.Point2f(x, number.y)
        emitter = dr.gather(v.EmitterPtr, self.pointers, index, active) if self.vectorised else self.pointers[index]
        ds, radiance = emitter.sample_direction(si, number, active)
        ds.pdf *= probability
        return ds, radiance / probability

    def pdf(self, reference: Any, ds: Any, active: Any) -> Any:
        """As `SceneEmitters.pdf`; 0 for the environment."""
        if not self.vectorised and (ds.emitter is None or ds.emitter.is_environment() or not active):
            return 0.0
        lamp = active & (ds.emitter.is_environment() ^ True)
        pdf = ds.emitter.pdf_direction(reference, ds, lamp) * ds.emitter.sampling_weight() / self.total
        return dr.select(lamp, pdf, 0)

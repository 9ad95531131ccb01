"""Which emitter to sample: all of them as Mitsuba does, or all but a constant environment.

What shines the same from everywhere a BSDF's own samples meet without noise but for what is in the way, so a sample of
its own would take the others' place.
"""

from __future__ import annotations

from typing import Any

import drjit as dr


class SceneEmitters:
    """Mitsuba's own choice."""

    def __init__(self, v: Any, scene: Any) -> None:
        self.scene = scene

    def sample(self, si: Any, number: Any, active: Any) -> tuple[Any, Any]:
        """A direction toward an emitter, and its radiance over the density, whatever is in the way."""
        return self.scene.sample_emitter_direction(si, number, False, active)

    def pdf(self, reference: Any, ds: Any, active: Any) -> Any:
        return self.scene.pdf_emitter_direction(reference, ds, active)


class NonConstantEmitters:
    """All emitters but the environment, by their sampling weights."""

    def __init__(self, v: Any, scene: Any) -> None:
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
        v, index, probability = self.v, self.v.UInt32(0), 1.0
        if self.choice:
            index, x, probability = self.choice.sample_reuse_pmf(number.x, active)
            number = v.Point2f(x, number.y)
        emitter = dr.gather(v.EmitterPtr, self.pointers, index, active) if self.vectorised else self.pointers[index]
        ds, radiance = emitter.sample_direction(si, number, active)
        ds.pdf *= probability
        return ds, radiance / probability

    def pdf(self, reference: Any, ds: Any, active: Any) -> Any:
        if not self.vectorised and (ds.emitter is None or ds.emitter.is_environment() or not active):
            return 0.0
        lamp = active & (ds.emitter.is_environment() ^ True)
        pdf = ds.emitter.pdf_direction(reference, ds, lamp) * ds.emitter.sampling_weight() / self.total
        return dr.select(lamp, pdf, 0)

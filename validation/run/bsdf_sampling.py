"""`bsdf.sample` for many rays at once, in any variant of Mitsuba; and rays that continue from an interaction."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np


def sample_all(bsdf: Any, context: Any, wi: np.ndarray, sample1: np.ndarray) -> dict[str, np.ndarray]:
    """Call `bsdf.sample` for every ray; return arrays (N, entries) of wo, pdf, eta, weight, and (N,) of the type."""
    import mitsuba as mi

    def sample(w: Any, s: Any, count: int) -> dict[str, np.ndarray]:
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = mi.Vector3f(w)
        bs, weight = bsdf.sample(context, si, s, [0, 0])
        entries = {"wo": bs.wo, "pdf": bs.pdf, "eta": bs.eta, "weight": weight, "type": bs.sampled_type}
        return {name: _lanes(np.array(x, dtype=float), count) for name, x in entries.items()}

    if dr.is_jit_v(mi.Float):
        arrays = sample(wi.T, mi.Float(sample1), len(wi))
    else:
        parts = [sample(w, float(s), 1) for w, s in zip(wi, sample1, strict=True)]
        arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return arrays | {"type": arrays["type"][:, 0]}


OFFSET = 1500 * 2.0**-24  # Mitsuba's RayEpsilon in float32


def along_the_ray(si: Any, d: Any) -> Any:
    """Return a ray from the interaction along `d`, moved along itself by the distance of `spawn_ray`'s offset."""
    import mitsuba as mi

    ray: Any = mi.Ray3f(si.p, d)
    ray.o = dr.fma(d, OFFSET * (1 + dr.max(dr.abs(si.p))), ray.o)
    return ray


def _lanes(x: np.ndarray, count: int) -> np.ndarray:
    """Return (count, entries) from an array with the lanes last (or none, in scalar variants)."""
    lanes = x if x.ndim and x.shape[-1] in (1, count) and count > 1 else x[..., None]
    return np.broadcast_to(lanes, (*lanes.shape[:-1], count)).reshape(-1, count).T

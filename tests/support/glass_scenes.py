"""Small scenes of glass, their renders, and what tests say of these."""

import mitsuba as mi
import numpy as np
import pytest
from scipy.stats import t

GLASS = {"type": "refract", "int_ior": 1.5, "ext_ior": 1.0}
BLACK = {"type": "diffuse", "reflectance": 0.0}
AROUND, DOWN = 0.6 + 0.4 * np.sin(np.arange(64) * 2 * np.pi / 64 + 0.3), np.linspace(0, 0.7, 32)
SKY = (AROUND[None, :, None] + DOWN[:, None, None]).astype(np.float32) * np.ones(3, np.float32)


def sky():
    """Smooth light that is different in every direction."""
    return {"type": "envmap", "bitmap": mi.Bitmap(SKY)}


def camera(size=24, fov=30, origin=(0, 0, 5), target=(0, 0, 0), kind="perspective", **film):
    """Independent pixels."""
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb", "rfilter": {"type": "box"}} | film
    place = mi.ScalarTransform4f().look_at([*origin], [*target], [0, 1, 0])
    lens = {"fov": fov} if kind == "perspective" else {}
    return {"type": kind, "to_world": place, "film": film, "sampler": {"type": "independent"}} | lens


def glass_ball(size=24, **parts):
    """A glass ball at the origin, seen from 5 radii away, and other parts."""
    ball = {"type": "sphere", "bsdf": GLASS}
    return mi.load_dict({"type": "scene", "sensor": camera(size), "ball": ball} | parts)


def render(scene, spp=16, seed=0, **parameters):
    """By `refract_path` with these parameters, or by another `type`."""
    method = mi.load_dict({"type": "refract_path", "max_depth": 16} | parameters)
    return np.array(mi.render(scene, integrator=method, spp=spp, seed=seed), dtype=float)


def equal_means(theirs, ours, alpha=1e-4):
    """Whether means of independent renders are within chance; `alpha` is the rate of false alarms."""
    theirs, ours = (np.array(x).reshape(len(x), -1).mean(axis=1) for x in (theirs, ours))
    deviation = np.sqrt(theirs.var(ddof=1) / len(theirs) + ours.var(ddof=1) / len(ours))
    return abs(theirs.mean() - ours.mean()) <= t.ppf(1 - alpha / 2, len(ours) - 1) * deviation + 1e-6 * theirs.mean()


def refusal(call, *arguments, **parameters):
    """The text of the error that a call raises; Dr.Jit and Mitsuba wrap those of plugins."""
    with pytest.raises((ValueError, RuntimeError)) as caught:
        call(*arguments, **parameters)
    error = caught.value
    while error.__cause__ is not None:
        error = error.__cause__
    return str(error)


def parameter(params, name):
    """The key that ends so."""
    (key,) = [key for key in [*params.keys()] if key.endswith(name)]
    return key

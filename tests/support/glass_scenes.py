"""Small scenes of glass, their renders, samples of a boundary, and comparisons of them."""

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.stats import t

GLASS = {"type": "refract", "int_ior": 1.5, "ext_ior": 1.0}
BLACK = {"type": "diffuse", "reflectance": 0.0}
AROUND, DOWN = 0.6 + 0.4 * np.sin(np.arange(64) * 2 * np.pi / 64 + 0.3), np.linspace(0, 0.7, 32)
SKY = (AROUND[None, :, None] + DOWN[:, None, None]).astype(np.float32) * np.ones(3, np.float32)
PLACE = mi.ScalarTransform4f


def rgb(*value):
    """Return a colour or spectrum by its red, green and blue."""
    return {"type": "rgb", "value": [*value]}


def sky():
    """Return a smooth environment that differs in every direction."""
    return {"type": "envmap", "bitmap": mi.Bitmap(SKY)}


def camera(size=24, fov=30, origin=(0, 0, 5), target=(0, 0, 0), kind="perspective", **film):
    """Return a camera with a box filter, so that pixels are independent."""
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb", "rfilter": {"type": "box"}} | film
    place = PLACE().look_at([*origin], [*target], [0, 1, 0])
    lens = {"fov": fov} if kind == "perspective" else {}
    return {"type": kind, "to_world": place, "film": film, "sampler": {"type": "independent"}} | lens


def glass_ball(size=24, **parts):
    """Load a glass ball at the origin, seen from 5 radii away, with other `parts`."""
    ball = {"type": "sphere", "bsdf": GLASS}
    return mi.load_dict({"type": "scene", "sensor": camera(size), "ball": ball} | parts)


def render(scene, spp=16, seed=0, **parameters):
    """Render with `refract_path` and these parameters, or with another `type` of integrator."""
    integrator = mi.load_dict({"type": "refract_path", "max_depth": 16} | parameters)
    return np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed), dtype=float)


def equal_means(theirs, ours, alpha=1e-4):
    """Test whether independent renders have equal means; `alpha` is the rate of false alarms."""
    theirs, ours = (np.array(x).reshape(len(x), -1).mean(axis=1) for x in (theirs, ours))
    deviation = np.sqrt(theirs.var(ddof=1) / len(theirs) + ours.var(ddof=1) / len(ours))
    return abs(theirs.mean() - ours.mean()) <= t.ppf(1 - alpha / 2, len(ours) - 1) * deviation + 1e-6 * theirs.mean()


def refusal(call, *arguments, **parameters):
    """Return the text of the error that a call raises, unwrapped from the errors of Dr.Jit and Mitsuba."""
    with pytest.raises((ValueError, RuntimeError)) as caught:
        call(*arguments, **parameters)
    error = caught.value
    while error.__cause__ is not None:
        error = error.__cause__
    return str(error)


def parameter(params, name):
    """Return the only key that contains a name."""
    (key,) = [key for key in [*params.keys()] if name in key]
    return key


def attached(node, *names):
    """Enable gradients of the parameters with these names; return all parameters of a scene or plugin, and the keys."""
    params = mi.traverse(node)
    keys = [parameter(params, name) for name in names]
    for key in keys:
        dr.enable_grad(params[key])
    params.update()
    return params, keys


# A boundary as a BSDF -------------------------------------------------------------------------------------------------


def vector(x):
    """Return a number or a Dr.Jit array as a flat numpy array."""
    return np.array(x, dtype=float).ravel()


def surface(wi=(0, 0, 1), wavelengths=(450.0, 700.0, 550.0, 600.0), u=0.5):
    """Return a surface interaction. `wi` is opaque to Dr.Jit, so that one kernel serves every direction."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi, si.uv = mi.Vector3f(*map(float, wi)), mi.Point2f(u, 0.5)
    dr.make_opaque(si.wi)
    if mi.is_spectral:
        si.wavelengths = type(si.wavelengths)(*wavelengths)
    return si


def sampled(bsdf, wi, sample1, context=None, sample2=(0.5, 0.5), **options):
    """Sample a BSDF and return the sample in numpy: `weight` without polarisation, `mueller` with it.

    `options`: those of `surface`.
    """
    number = dr.opaque(mi.Float, sample1)
    bs, weight = bsdf.sample(context or mi.BSDFContext(), surface(wi, **options), number, [*sample2])
    arrays = {"wo": vector(bs.wo), "weight": vector(mi.unpolarized_spectrum(weight)), "mueller": np.array(weight)}
    scalars = {"pdf": bs.pdf, "eta": bs.eta, "component": bs.sampled_component, "type": bs.sampled_type}
    return SimpleNamespace(**arrays, **{name: vector(x)[0] for name, x in scalars.items()})

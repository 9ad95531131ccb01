"""Mitsuba's code in float32: `mi.fresnel` with `mi.refract`; with the argument `dielectric`, this BSDF."""

import sys

import mitsuba as mi
import numpy as np
import table

mi.set_variant("scalar_rgb")


def functions(a, n, n_from, n_to):
    wi, m = mi.Vector3f(-a), mi.Normal3f(n)
    reflectance, cos_t, _, eta_ti = mi.fresnel(mi.Float(float(wi @ mi.Vector3f(n))), n_to / n_from)
    return mi.refract(wi, m, cos_t, eta_ti), reflectance < 1


def dielectric(a, n, n_from, n_to):
    """Sample the transmitted lobe in the frame that Mitsuba builds around the normal."""
    bsdf = mi.load_dict({"type": "dielectric", "int_ior": float(n_to), "ext_ior": float(n_from)})
    si, context = mi.SurfaceInteraction3f(), mi.BSDFContext()
    si.sh_frame = mi.Frame3f(mi.Vector3f(n))
    si.wi = si.to_local(mi.Vector3f(-a))
    context.component = 1
    sample, weight = bsdf.sample(context, si, 0.5, mi.Point2f(0.5, 0.5), True)
    return si.to_world(sample.wo), max(weight) > 0


rays = table.Rays("float32")
subject = dielectric if sys.argv[1:] == ["dielectric"] else functions
b, transmitted = zip(*(subject(a.astype(float), n.tolist(), *pair) for a, n, *pair in rays.each()), strict=True)
table.write(rays, np.array(b), f"Mitsuba {mi.__version__}, {mi.variant()}", transmitted)

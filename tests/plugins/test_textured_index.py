"""An index that is a texture: a number in each point of the surface."""

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

INDICES = 1.2, 1.8  # on the left half of the texture and on the right


def texture(values=INDICES):
    pixels = np.array(values, np.float32).reshape(1, -1, 1)
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, "filter_type": "nearest"}


def load(**parameters):
    return mi.load_dict({"type": "refract", "int_ior": texture(), "ext_ior": 1.0} | parameters)


def refracted(bsdf, u, sample1=0.999999):
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi, si.uv = mi.Vector3f(0.6, 0, 0.8), mi.Point2f(u, 0.5)
    if mi.is_spectral:
        si.wavelengths = type(si.wavelengths)(500)
    bs, weight = bsdf.sample(mi.BSDFContext(), si, sample1, [0.5, 0.5])
    return np.array(bs.wo, dtype=float).ravel(), np.array(mi.unpolarized_spectrum(weight), dtype=float).ravel()


def test_each_point_has_its_own_index(each_variant):
    bsdf = load()
    for u, eta in zip((0.25, 0.75), INDICES, strict=True):
        wo, weight = refracted(bsdf, u)
        assert wo == pytest.approx([-0.6 / eta, 0, -math.sqrt(1 - (0.6 / eta) ** 2)], rel=1e-6)
        assert weight == pytest.approx(eta**-2, rel=1e-6)


def test_both_sides_may_be_textures(typical_variant):
    wo, _ = refracted(load(ext_ior=texture((1.1, 1.1))), 0.75)
    assert wo[0] == pytest.approx(-0.6 * 1.1 / 1.8, rel=1e-6)


@pytest.mark.parametrize("index", [0.0, -1.5, math.nan, math.inf, 1e10, 1e-10])
def test_where_the_texture_holds_no_index_light_is_lost(typical_variant, index):
    bsdf = load(int_ior=texture((1.5, index)))
    assert (refracted(bsdf, 0.25)[1] > 0).all()
    for number in (0.0, 0.999999):
        assert (refracted(bsdf, 0.75, number)[1] == 0).all()


def test_the_texture_is_a_parameter(typical_variant):
    bsdf = load()
    parameters = mi.traverse(bsdf)
    parameters["int_ior.data"][:] = 1.6
    parameters.update()
    assert refracted(bsdf, 0.25)[0][0] == pytest.approx(-0.6 / 1.6, rel=1e-6)


def test_beside_a_texture_an_index_is_the_same_for_all_wavelengths(typical_variant):
    with pytest.raises(
        RuntimeError, match=r"refract: ext_ior is dispersive, but the other index is a texture; expected one index"
    ):
        load(ext_ior="cauchy(1.5, 4000)")

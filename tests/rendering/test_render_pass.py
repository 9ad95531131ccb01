"""One pass: Mitsuba's image, with the same bits on any number of threads, and the second moments of its samples."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refract.rendering.pass_plan import FEW, scalar_seed_of, seed_of
from mi_refract.rendering.render_pass import pass_renderer
from mi_refract.rendering.scene_files import load_scene

SCENES = Path(__file__).parents[2] / "scenes"
# The sums of Mitsuba are in float32, under a wide filter of 25 pixels' samples.
CLOSE = {"rtol": 2e-5, "atol": 2e-6}


def scene_of(tmp_path, rfilter="box", pixel_format="rgb", name="sphere", **defines):
    text = (SCENES / f"{name}.xml").read_text()
    for old, new in (
        ('"box"', f'"{rfilter}"'),
        ('"pixel_format" value="rgb"', f'"pixel_format" value="{pixel_format}"'),
    ):
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "scene.xml"
    path.write_text(text)
    return load_scene(path, {"res": "16"} | defines)


def by_mitsuba(scene, number, spp, seed=3):
    return np.array(mi.render(scene, spp=spp, seed=seed_of(seed, number)))


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral", "llvm_ad_spectral_polarized"])
@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_a_pass_is_mitsubas_image(tmp_path, needs_variant, variant, rfilter):
    needs_variant(variant)
    mi.set_variant(variant)
    scene = scene_of(tmp_path, rfilter, "luminance" if "mono" in variant else "rgb")
    renderer = pass_renderer(scene, 3)
    assert renderer.moments
    np.testing.assert_allclose(renderer.render(5, 8).mean, by_mitsuba(scene, 5, 8), **CLOSE)


@pytest.mark.parametrize("rfilter, pixel_format", [("mitchell", "xyz"), ("tent", "rgba"), ("lanczos", "luminance")])
def test_so_it_is_for_other_filters_and_films(tmp_path, llvm, rfilter, pixel_format):
    scene = scene_of(tmp_path, rfilter, pixel_format)
    np.testing.assert_allclose(pass_renderer(scene, 3).render(0, 13).mean, by_mitsuba(scene, 0, 13), **CLOSE)


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"])
@pytest.mark.parametrize(
    ("rfilter", "radius", "area"),
    [({"type": "box"}, 0.5, 1.0), ({"type": "tent", "radius": 3.0}, 3.0, (3 * 1.5) ** 2)]
    + [({"type": "gaussian", "stddev": x}, 4 * x, 4 * np.pi * x**2) for x in (1.0, 3.0)],
)
def test_the_file_says_how_wide_the_filter_is(llvm, rfilter, radius, area):
    """(∫∫w)²/∫∫w²; of a Gaussian that ends nowhere, and Mitsuba's ends at four standard deviations."""
    film = {"type": "hdrfilm", "width": 4, "height": 4, "filter": rfilter}
    scene = mi.load_dict(
        {"type": "scene", "integrator": {"type": "path"}, "sensor": {"type": "perspective", "film": film}}
    )
    found = pass_renderer(scene, 0).filter_header
    assert found["mi_refract:filter_radius"] == radius
    assert found["mi_refract:filter_area"] == pytest.approx(area, rel=0.01)


@pytest.mark.parametrize("rfilter", ["gaussian", "lanczos"])
def test_a_wide_filters_sums_are_those_of_mitsubas_film(tmp_path, needs_variant, variant, rfilter):
    """Totals and weights apart: a mean over passes of their quotients would be biased."""
    needs_variant(variant)
    mi.set_variant(variant)
    scene = scene_of(tmp_path, rfilter)
    renderer = pass_renderer(scene, 3)
    sums = renderer.render(0, 2)
    mi.render(scene, spp=2, seed=seed_of(3, 0) if renderer.moments else scalar_seed_of(3, 0, 256))
    raw = np.array(scene.sensors()[0].film().bitmap(raw=True))
    assert raw.shape == (16, 16, 4) and np.ptp(raw[..., 3]) > 1
    np.testing.assert_allclose(sums.total * renderer.expected, raw[..., :3], **CLOSE)
    np.testing.assert_allclose(sums.weights * renderer.expected, raw[..., 3:], **CLOSE)


@pytest.mark.parametrize("rfilter", ["gaussian", "lanczos", "tent"])
def test_the_weights_of_a_wide_filter_are_those_expected(tmp_path, llvm, rfilter):
    """On average they are spp in every pixel, also at the border, which fewer samples reach."""
    renderer = pass_renderer(scene_of(tmp_path, rfilter), 3)
    found = np.array([renderer.render(number, 4).weights for number in range(64)])
    error = found.std(0, ddof=1) / 8
    # Of 256 means, with the standard error from 64 values: beyond 6 of them less than once in 1e4 runs.
    assert np.all(np.abs(found.mean(0) - 4) < 6 * error) and error.max() < 0.2
    assert np.ptp(renderer.expected) > 0.1


def test_so_it_is_for_outputs_beside_colours_and_a_cropped_film(tmp_path, llvm):
    text = (SCENES / "sphere.xml").read_text()
    crop = '<integer name="crop_width" value="7"/><integer name="crop_height" value="5"/>'
    crop += '<integer name="crop_offset_x" value="3"/><integer name="crop_offset_y" value="6"/>'
    aov = '<integrator type="aov"><string name="aovs" value="n:sh_normal,d:depth"/>'
    for old, new in (
        ('<film type="hdrfilm">', f'<film type="hdrfilm">{crop}'),
        ('<integrator type="$integrator">', f'{aov}<integrator type="$integrator">'),
        ("</integrator>", "</integrator></integrator>"),
    ):
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "scene.xml").write_text(text)
    scene = load_scene(tmp_path / "scene.xml", {"res": "16"})
    renderer = pass_renderer(scene, 3)
    found = renderer.render(2, 4).mean
    by_mitsuba(scene, 2, 4)
    expected = np.array(scene.sensors()[0].film().bitmap())
    assert renderer.moments and renderer.colours == 3
    assert expected.shape == (5, 7, len(renderer.channels)) and expected.shape[2] > 6
    np.testing.assert_allclose(found, expected, **CLOSE)


def test_splitting_paths_have_the_pass_s_own_numbers(tmp_path, llvm):
    """`refract_path` seeds its splits: two passes with the same numbers would not be independent."""
    scene = scene_of(tmp_path, integrator="refract_path")
    scene.integrator().split_depth = 3
    renderer = pass_renderer(scene, 3)
    for number in (0, 1):
        np.testing.assert_allclose(renderer.render(number, 8).mean, by_mitsuba(scene, number, 8), **CLOSE)


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
@pytest.mark.parametrize("spp", [7, 8])
def test_the_number_of_threads_does_not_show(tmp_path, llvm, rfilter, spp):
    scene = scene_of(tmp_path, rfilter, res="64")
    renderer, threads = pass_renderer(scene, 3), dr.thread_count()
    try:
        found = []
        for count in (1, 2, 3, 3):
            dr.set_thread_count(count)
            found.append(renderer.render(0, spp))
    finally:
        dr.set_thread_count(threads)
    for sums in found[1:]:
        np.testing.assert_array_equal(sums.total, found[0].total)
        np.testing.assert_array_equal(sums.within, found[0].within)


def test_an_integrator_with_a_render_of_its_own_runs_in_one_thread(tmp_path, llvm, monkeypatch):
    scene = scene_of(tmp_path, "gaussian", integrator="ptracer")
    renderer, threads = pass_renderer(scene, 3), dr.thread_count()
    assert not renderer.moments
    counts, render = [], mi.render
    monkeypatch.setattr(mi, "render", lambda *a, **k: (counts.append(dr.thread_count()), render(*a, **k))[1])
    one, two = (renderer.render(0, 4).total for _ in range(2))
    np.testing.assert_array_equal(one, two)
    assert counts == [1, 1] and dr.thread_count() == threads


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_the_spread_of_samples_is_that_of_passes(tmp_path, llvm, rfilter):
    """The variance from within passes, averaged over pixels, against that between 64 of them."""
    scene = scene_of(tmp_path, rfilter)
    renderer = pass_renderer(scene, 3)
    passes = [renderer.render(number, 16) for number in range(64)]
    assert all((sums.within is not None) == (number < FEW - 1) for number, sums in enumerate(passes))
    between = 16 * np.var([sums.mean for sums in passes], 0, ddof=1)
    within = np.mean([sums.within / 15 for sums in passes[: FEW - 1]], 0)
    # Of 63 and of 105 degrees of freedom in each of 256 pixels, that share samples under the wide filter: a standard
    # error of √(2/63 · 9/256) = 3.3 % at most. Without strata the wide filter's is 13 % too large here.
    np.testing.assert_allclose(within.mean(), between.mean(), rtol=0.1)


@pytest.mark.parametrize("spp", [7, 8])
@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_equal_samples_have_no_second_moment(tmp_path, llvm, rfilter, spp):
    (tmp_path / "sky.xml").write_text(
        '<scene version="3.0.0"><integrator type="path"/><sensor type="perspective"><film type="hdrfilm">'
        '<integer name="width" value="8"/><integer name="height" value="8"/><rfilter type="RFILTER"/></film></sensor>'
        '<emitter type="constant"><rgb name="radiance" value="0.1, 0.7, 0.3"/></emitter></scene>'.replace(
            "RFILTER", rfilter
        )
    )
    sums = pass_renderer(load_scene(tmp_path / "sky.xml"), 0).render(0, spp)
    assert not sums.within.any()
    np.testing.assert_array_equal(sums.mean[0, 0].astype(np.float32), np.float32([0.1, 0.7, 0.3]))


def test_scalar_variants_render_by_mitsuba(tmp_path):
    mi.set_variant("scalar_rgb")
    renderer = pass_renderer(scene_of(tmp_path, "gaussian"), 3)
    one, two = (renderer.render(2, 4) for _ in range(2))
    np.testing.assert_array_equal(one.total, two.total)
    assert not renderer.moments and renderer.colours == 3
    expected = np.array(mi.render(renderer.scene, spp=4, seed=scalar_seed_of(3, 2, 256)))
    np.testing.assert_allclose(one.mean, expected, **CLOSE)


def test_passes_of_scalar_variants_share_no_random_numbers(tmp_path):
    """Mitsuba's sequence of pixel k of N is seed · N + k, modulo 2³²: by `seed_of` these two would be the same."""
    mi.set_variant("scalar_rgb")
    renderer = pass_renderer(scene_of(tmp_path, res="64"), 0)
    same = by_mitsuba(renderer.scene, 1105, 1, 0), by_mitsuba(renderer.scene, 2867, 1, 0)
    np.testing.assert_array_equal(*same)
    assert not np.array_equal(renderer.render(1105, 1).total, renderer.render(2867, 1).total)
    with pytest.raises(ValueError, match="pass 1048576 of 4096 pixels; scalar variants support up to 1048576"):
        renderer.render(2**20, 1)

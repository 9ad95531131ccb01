"""One pass: its image is Mitsuba's, with the same bits for any number of threads, and with second moments."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.processes import python
from support.renders import SCENES

from mi_refract.rendering.end_conditions import relative_error
from mi_refract.rendering.pass_plan import FEW, scalar_seed_of, seed_of
from mi_refract.rendering.render_pass import pass_renderer
from mi_refract.rendering.sample_sums import Film, image_sums
from mi_refract.rendering.scene_files import load_scene

# Mitsuba sums in float32, with a wide filter over the samples of 25 pixels.
CLOSE = {"rtol": 2e-5, "atol": 2e-6}
WIDTH, HEIGHT = 5, 3


def scene_of(tmp_path, rfilter="box", pixel_format="rgb", more=(), **defines):
    text = (SCENES / "sphere.xml").read_text()
    pixels = ('"pixel_format" value="rgb"', f'"pixel_format" value="{pixel_format}"')
    for old, new in (('"box"', f'"{rfilter}"'), pixels, *more):
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "scene.xml").write_text(text)
    return load_scene(tmp_path / "scene.xml", {"res": "16"} | defines)


def mitsuba_image(scene, number, spp, seed=3):
    """Return all channels of a pass as rendered by `mi.render`."""
    pass_seed = seed_of(seed, number) if dr.is_jit_v(mi.Float) else scalar_seed_of(seed, number, 16, 16)
    threads = dr.thread_count()
    dr.set_thread_count(threads if dr.is_jit_v(mi.Float) else 1)
    mi.render(scene, spp=spp, seed=pass_seed)
    dr.set_thread_count(threads)
    image = np.array(scene.sensors()[0].film().bitmap())
    return image.reshape(*image.shape[:2], -1)


# Against Mitsuba ------------------------------------------------------------------------------------------------------

CROPPED = {"width": 7, "height": 5, "offset_x": 3, "offset_y": 6}
CROP = "".join(f'<integer name="crop_{name}" value="{value}"/>' for name, value in CROPPED.items())
OUTPUTS = (
    ('<film type="hdrfilm">', f'<film type="hdrfilm">{CROP}'),
    (
        '<integrator type="$integrator">',
        '<integrator type="aov"><string name="aovs" value="n:sh_normal,d:depth"/><integrator type="$integrator">',
    ),
    ("</integrator>", "</integrator></integrator>"),
)
IMAGES = [  # every kind of variant, filter and format
    *(("llvm_ad_rgb", *film, {}) for film in (("box", "rgb"), ("gaussian", "rgb"), ("lanczos", "luminance"))),
    ("llvm_ad_mono", "gaussian", "luminance", {}),
    ("llvm_ad_spectral", "mitchell", "xyz", {}),
    ("llvm_ad_spectral_polarized", "tent", "rgba", {}),
    ("llvm_ad_rgb", "box", "rgb", {"more": OUTPUTS}),
    ("llvm_ad_rgb", "box", "rgb", {"integrator": "refract_path"}),
    ("scalar_rgb", "gaussian", "rgb", {}),
]


@pytest.mark.parametrize(("variant", "rfilter", "pixel_format", "options"), IMAGES, indirect=["variant"])
def test_a_pass_is_mitsubas_image(tmp_path, variant, rfilter, pixel_format, options):
    """Also with `refract_path`, which seeds its splits, or passes would not be independent."""
    scene = scene_of(tmp_path, rfilter, pixel_format, **options)
    if "integrator" in options:
        scene.integrator().split_depth = 3
    renderer = pass_renderer(scene, 3)
    assert renderer.moments == variant.startswith("llvm")
    for number, spp in ((0, 13), (5, 13)):
        image = renderer.render(number, spp).mean
        expected = mitsuba_image(scene, number, spp)
        assert image.shape == expected.shape == (*renderer.size[::-1], len(renderer.channels))
        np.testing.assert_allclose(image, expected, **CLOSE)
    assert renderer.colours == (1 if pixel_format == "luminance" else 3)
    np.testing.assert_array_equal(renderer.render(0, 13).total, renderer.render(0, 13).total)
    if options.get("more") == OUTPUTS:
        assert expected.shape[:2] == (5, 7) and expected.shape[2] > 6


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"], indirect=True)
@pytest.mark.parametrize("rfilter", ["gaussian", "lanczos"])
def test_a_wide_filters_sums_are_those_of_mitsubas_film(tmp_path, variant, rfilter):
    """Totals and weights are separate, because a mean of their quotients over passes would be biased."""
    scene = scene_of(tmp_path, rfilter)
    renderer = pass_renderer(scene, 3)
    sums = renderer.render(0, 2)
    mitsuba_image(scene, 0, 2)
    raw = np.array(scene.sensors()[0].film().bitmap(raw=True))
    assert raw.shape == (16, 16, 4) and np.ptp(raw[..., 3]) > 1
    np.testing.assert_allclose(sums.total * renderer.expected, raw[..., :3], **CLOSE)
    np.testing.assert_allclose(sums.weights * renderer.expected, raw[..., 3:], **CLOSE)


@pytest.mark.parametrize("rfilter", ["gaussian", "lanczos", "tent"])
def test_the_mean_weight_of_a_wide_filter_is_spp_in_every_pixel(tmp_path, llvm_variant, rfilter):
    """Also at the border, which fewer samples reach."""
    renderer = pass_renderer(scene_of(tmp_path, rfilter), 3)
    weights = np.array([renderer.render(number, 4).weights for number in range(64)])
    error = weights.std(0, ddof=1) / 8
    # One of 256 means is beyond 6 standard errors, estimated from 64 values, less than once in 1e4 runs.
    assert np.all(np.abs(weights.mean(0) - 4) < 6 * error) and error.max() < 0.2
    assert np.ptp(renderer.expected) > 0.1


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"], indirect=True)
@pytest.mark.parametrize(
    ("rfilter", "radius", "area"),
    [({"type": "box"}, 0.5, 1.0), ({"type": "tent", "radius": 3.0}, 3.0, (3 * 1.5) ** 2)]
    + [({"type": "gaussian", "stddev": x}, 4 * x, 4 * np.pi * x**2) for x in (1.0, 3.0)],
)
def test_the_header_contains_radius_and_area_of_the_filter(variant, rfilter, radius, area):
    """The area is (∫∫w)²/∫∫w². Of a Gaussian it is that of an infinite one; Mitsuba's ends at 4 standard deviations."""
    film = {"type": "hdrfilm", "width": 4, "height": 4, "filter": rfilter}
    view = {"type": "perspective", "film": film}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "sensor": view})
    header = pass_renderer(scene, 0).filter_header
    assert header["mi_refract:filter_radius"] == radius
    assert header["mi_refract:filter_area"] == pytest.approx(area, rel=0.01)


BANDS = {  # of a specfilm, one of them with the name of a colour
    name: {"type": "spectrum", "value": [(low, 0), (low + 100, 1), (low + 200, 0)]}
    for name, low in (("green", 430), ("R", 530))
}


@pytest.mark.parametrize(
    ("film", "colours"),
    [({"type": "specfilm"} | BANDS, 2)]
    + [({"type": "hdrfilm", "pixel_format": x}, n) for x, n in (("rgba", 3), ("xyz", 3), ("luminance_alpha", 1))],
)
def test_aovs_and_opacity_do_not_count_in_the_error_of_an_image(needs_variant, film, colours):
    """The depth of a wall far away has a large mean and little noise."""
    needs_variant("scalar_spectral")
    mi.set_variant("scalar_spectral")
    path = {"type": "path", "max_depth": 3}

    def error(integrator):
        small = film | {"width": 4, "height": 4, "filter": {"type": "box"}}
        sensor = {"type": "perspective", "fov": 0.1, "film": small}
        wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 1000]).rotate([0, 1, 0], 180)}
        scene = {"type": "scene", "integrator": integrator, "sensor": sensor, "sky": {"type": "constant"}, "wall": wall}
        renderer = pass_renderer(mi.load_dict(scene, parallel=False, optimize=False), 3)
        sums = renderer.render(0, 2)
        sums.add(renderer.render(1, 2))
        assert renderer.colours == colours
        return relative_error(sums).value

    expected = error(path)
    assert expected > 0.01
    assert error({"type": "aov", "aovs": "d:depth", "nested": path}) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
@pytest.mark.parametrize("spp", [7, 8])
def test_the_bits_do_not_depend_on_the_number_of_threads(tmp_path, llvm_variant, rfilter, spp):
    renderer, threads = pass_renderer(scene_of(tmp_path, rfilter, res="64"), 3), dr.thread_count()
    try:
        renders = []
        for count in (1, 2, 3, 3):
            dr.set_thread_count(count)
            renders.append(renderer.render(0, spp))
    finally:
        dr.set_thread_count(threads)
    for sums in renders[1:]:
        np.testing.assert_array_equal(sums.total, renders[0].total)
        np.testing.assert_array_equal(sums.within, renders[0].within)


DIM = """
import sys
import drjit as dr, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
dr.set_thread_count(int(sys.argv[1]))
from mi_refract.rendering.render_pass import pass_renderer
dim = {"type": "rgb", "value": 1e-20}
film = {"type": "hdrfilm", "width": 8, "height": 8, "filter": {"type": "box"}}
wall = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": dim}}
wall["to_world"] = mi.ScalarTransform4f().translate([0, 0, 5]).scale(9).rotate([0, 1, 0], 180)
sensor, sky = {"type": "perspective", "film": film}, {"type": "constant", "radiance": dim}
scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "sensor": sensor, "sky": sky, "wall": wall})
print(pass_renderer(scene, 0).render(0, 4).total.sum())
"""


def test_a_render_in_one_thread_flushes_denormals_as_in_several(llvm_variant):
    """The caller's own thread keeps denormals in a process that has rendered nothing before."""
    totals = []
    for count in (1, 3):
        with python(DIM, count) as process:
            totals.append(process.communicate(timeout=120)[0].splitlines()[-1])
    assert totals[0] == totals[1]


def test_an_integrator_with_its_own_render_method_runs_in_one_thread(tmp_path, llvm_variant, monkeypatch):
    scene = scene_of(tmp_path, "gaussian", integrator="ptracer")
    renderer, threads = pass_renderer(scene, 3), dr.thread_count()
    assert not renderer.moments
    counts, render = [], mi.render

    def counting_render(*arguments, **options):
        counts.append(dr.thread_count())
        return render(*arguments, **options)

    monkeypatch.setattr(mi, "render", counting_render)
    one, two = (renderer.render(0, 4).total for _ in range(2))
    np.testing.assert_array_equal(one, two)
    assert counts == [1, 1] and dr.thread_count() == threads


def test_passes_of_scalar_variants_share_no_random_numbers(tmp_path):
    """Pixel k of N has Mitsuba's sequence seed · N + k, modulo 2³². With `seed_of` these two passes would be equal."""
    mi.set_variant("scalar_rgb")
    renderer = pass_renderer(scene_of(tmp_path, res="64"), 0)
    same = (np.array(mi.render(renderer.scene, spp=1, seed=seed_of(0, number))) for number in (1105, 2867))
    np.testing.assert_array_equal(*same)
    assert not np.array_equal(renderer.render(1105, 1).total, renderer.render(2867, 1).total)
    with pytest.raises(ValueError, match="pass 1048576 of 4096 pixels; scalar variants support up to 1048576"):
        renderer.render(2**20, 1)


@pytest.mark.parametrize("res", ["24", "40", "64"])
def test_the_bits_of_scalar_variants_do_not_depend_on_the_number_of_threads(tmp_path, scalar_variant, res):
    renderer, threads = pass_renderer(scene_of(tmp_path, res=res), 3), dr.thread_count()
    images = []
    for count in (1, 2, 9):
        dr.set_thread_count(count)
        images.append(renderer.render(0, 1).total)
        assert dr.thread_count() == count
    dr.set_thread_count(threads)
    np.testing.assert_array_equal(images[1:], images[:1] * 2)


@pytest.mark.parametrize(("width", "height"), [(64, 48), (33, 33), (9, 5)])
def test_passes_of_scalar_variants_share_no_random_numbers_in_blocks_beyond_the_film(width, height, scalar_variant):
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    place = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    sensor = {"type": "orthographic", "to_world": place, "film": film, "sampler": {"type": "independent"}}
    integrator = {"type": "aov", "aovs": "place:uv"}  # the place of a sample in its pixel: two random numbers
    scene = mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, "wall": {"type": "rectangle"}})
    renderer = pass_renderer(scene, 0)
    one, other = (renderer.render(i, 1).total[..., -2:].reshape(-1, 2) * width % 1 for i in (0, 1))
    assert (np.abs(one[:, None] - other).max(-1) > 1e-5).all()


# The samples of a pass ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_the_variance_within_passes_is_that_between_passes(tmp_path, llvm_variant, rfilter):
    """Averaged over pixels, and compared with the variance between 64 passes."""
    renderer = pass_renderer(scene_of(tmp_path, rfilter), 3)
    passes = [renderer.render(number, 16) for number in range(64)]
    assert all((sums.within is not None) == (number < FEW - 1) for number, sums in enumerate(passes))
    between = 16 * np.var([sums.mean for sums in passes], 0, ddof=1)
    within = np.mean([sums.within / 15 for sums in passes[: FEW - 1]], 0)
    # Both have 63 and 105 degrees of freedom in each of 256 pixels, which share samples with the wide filter. So the
    # standard error is √(2/63 · 9/256) = 3.3 % at most. Without strata, `within` of the wide filter is 13 % too large.
    np.testing.assert_allclose(within.mean(), between.mean(), rtol=0.1)


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_lamps_that_are_traced_are_in_the_image_and_the_variance_of_passes(llvm_variant, rfilter):
    """The camera sees only floor that a point lamp lights through a ball."""
    view, place = mi.ScalarTransform4f().look_at([0, -6, 3], [0, 0, 0], [0, 0, 1]), mi.ScalarTransform4f().scale(4)
    film = {"type": "hdrfilm", "width": 16, "height": 16, "pixel_format": "rgb", "filter": {"type": rfilter}}
    parts = {"sensor": {"type": "perspective", "fov": 16, "to_world": view, "film": film}}
    parts["ball"] = {"type": "sphere", "center": [0, 0, 3], "radius": 0.8, "bsdf": {"type": "refract"}}
    parts |= {"lamp": {"type": "point", "position": [0, 0, 5]}, "floor": {"type": "rectangle", "to_world": place}}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "refract_path", "light_paths": 0.02}} | parts)
    renderers = [pass_renderer(scene, seed) for seed in range(3, 9)]
    for number in (0, 5):
        image = renderers[0].render(number, 16).mean
        assert image.any()
        np.testing.assert_allclose(image, mitsuba_image(scene, number, 16), **CLOSE)
    passes = [renderer.render(number, 16) for renderer in renderers for number in range(4)]
    between = 16 * np.var([sums.mean for sums in passes], 0, ddof=1).mean()
    # Stratified light paths have less noise than independent ones, of which `within` is the variance: 1.4, 1.7 times.
    assert 0.9 * between < np.mean([sums.within / 15 for sums in passes]) < 2.5 * between


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_equal_samples_have_no_second_moment(llvm_variant, rfilter):
    film = {"type": "hdrfilm", "width": 8, "height": 8, "filter": {"type": rfilter}}
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.1, 0.7, 0.3]}}
    sensor = {"type": "perspective", "film": film}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "sensor": sensor, "sky": sky})
    for spp in (7, 8):
        sums = pass_renderer(scene, 0).render(0, spp)
        assert not sums.within.any()
        np.testing.assert_array_equal(sums.mean[0, 0].astype(np.float32), np.float32([0.1, 0.7, 0.3]))


def sums_of(samples, *, squares=True):
    """Return the sums with a box filter; `samples`: H × W × spp × C."""
    values = [mi.Float(samples[..., c].ravel()) for c in range(samples.shape[3])]
    return image_sums(values, None, Film(WIDTH, HEIGHT, samples.shape[2], None), squares=squares)


@pytest.mark.parametrize("spp", [1, 2, 3, 4, 6, 7, 8, 12, 16])
@pytest.mark.parametrize("channels", [1, 3, 5])
def test_sums_and_squares_are_accurate(llvm_variant, spp, channels):
    """They are within n roundings of their terms, also if the first sample, from which all are subtracted, is far off.

    Samples are read 1, 2, 4 or 8 at a time.
    """
    for first in (0.5, 1e4):
        samples = np.random.default_rng(spp).random((HEIGHT, WIDTH, spp, channels), np.float32)
        samples[:, :, 0] = first
        total, weights, within = sums_of(samples)
        total_only, _, no_squares = sums_of(samples, squares=False)
        assert no_squares is None and np.array_equal(total_only, total)
        samples = samples.astype(np.float64)
        np.testing.assert_allclose(total, samples.sum(2), rtol=spp * 2**-52)
        mean = samples.mean(2, keepdims=True)
        bound = 4 * (spp + 2) * 2**-52 * ((samples - samples[:, :, :1]) ** 2).sum(2)
        assert np.all(np.abs(within - ((samples - mean) ** 2).sum(2)) <= bound)
        assert weights is None and total.shape == within.shape == (HEIGHT, WIDTH, channels)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("number", [0, 3])
def test_a_non_finite_sample_affects_only_its_pixel_and_channel(llvm_variant, value, number):
    samples = np.ones((HEIGHT, WIDTH, 8, 3), np.float32)
    samples[1, 2, number, 1] = value
    total, _, within = sums_of(samples)
    assert np.argwhere(~np.isfinite(total)).tolist() == [[1, 2, 1]]
    assert not within[np.isfinite(total)].any()

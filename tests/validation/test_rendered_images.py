"""The study of images: what it says of a renderer that agrees, of one that does not, and of one that is not there."""

import dataclasses
import functools
import importlib.util

import mitsuba as mi
import numpy as np
import pytest

from mi_refract.io import image_file
from mi_refract.rendering import scene_files
from mi_refract.scene_export import write_files
from mi_refract.scene_export.plain_scene import Glass
from mi_refract.scene_export.targets import shared_files
from validation import readme_tables
from validation.run.context import PROFILES, Context
from validation.run.render_methods import Camera
from validation.suite import matrix, rendered_images
from validation.suite.renderers import environments, image_renderers
from validation.suite.renderers.image_renderers import ImageRenderer

SMALL = rendered_images.Size(48, 32, 1, 0.2)
pytestmark = pytest.mark.usefixtures("llvm_variant")


@pytest.fixture
def judged(tmp_path, monkeypatch):
    """The row of a painter that draws the prism."""
    context = Context(PROFILES["full"], tmp_path, "llvm_ad_rgb", {}, {})
    monkeypatch.setitem(rendered_images.SIZES, "full", SMALL)

    def judge(draw, title="Radiance", missing=""):
        monkeypatch.setattr(environments, "absent", lambda system: missing)
        monkeypatch.setitem(rendered_images.IMAGE_RENDERERS, title, ImageRenderer("radiance", draw, {"prism": 32}, ()))
        [row] = rendered_images.pair_rows(context, title, "prism")
        assert all((tmp_path / name).is_file() for name in row.images.values())
        return row

    return judge


def by_the_builtin(change, plain, folder, spp, seeds):
    """Mitsuba's own glass in a scene that is a little different."""
    write_files.write(change(plain), "mitsuba", folder / "scene")
    camera = Camera(scene_files.load_scene(folder / "scene" / "scene.xml", {"bsdf": "dielectric"}))
    return [image_file.named(f"seed {seed}", camera(spp, seed)[0].astype(np.float32)) for seed in seeds]


def denser(plain, index=2.0):
    def glass(mesh):
        changed = isinstance(mesh.material, Glass)
        return dataclasses.replace(mesh, material=Glass(index, mesh.material.ext_ior)) if changed else mesh

    return dataclasses.replace(plain, meshes=tuple(map(glass, plain.meshes)))


def matched(plain):
    """As if no glass were there."""
    [outside] = {mesh.material.ext_ior for mesh in plain.meshes if isinstance(mesh.material, Glass)}
    return denser(plain, outside)


def wider(plain):
    return dataclasses.replace(plain, camera=dataclasses.replace(plain.camera, fov_x_degrees=34.0))


def test_another_renderer_of_the_same_scene_is_equal(judged):
    row = judged(functools.partial(by_the_builtin, lambda plain: plain))
    assert row.verdict == "pass" and row.replay["verdict"] == "equal" and not row.missed
    assert row.values["RMSE / noise"] == pytest.approx(1, abs=0.1)
    assert list(row.images) == ["reference", "test", "difference"]


@pytest.mark.parametrize("change", [denser, wider])
def test_another_image_fails(judged, change):
    row = judged(functools.partial(by_the_builtin, change))
    assert row.verdict == "fail" and row.replay["verdict"] == "different"
    assert row.values["tests that differ"] > 0


def test_a_pair_whose_noise_hides_what_is_wanted_is_no_pass(judged, monkeypatch):
    """In the row, in the matrix, and in the table of the README; whatever its mean says."""
    monkeypatch.setitem(rendered_images.SIZES, "full", dataclasses.replace(SMALL, wanted=1e-3))
    row = judged(functools.partial(by_the_builtin, lambda plain: plain))
    assert row.replay["verdict"] == "inconclusive" and row.missed[rendered_images.INCONCLUSIVE] == 0
    [cell] = matrix.summary([row])
    assert rendered_images.INCONCLUSIVE in cell.missed and "inconclusive" in cell.reason
    assert "**inconclusive**" in readme_tables.suite([cell])
    clear = judged(functools.partial(by_the_builtin, denser))
    assert rendered_images.INCONCLUSIVE not in clear.missed


def test_mitsubas_own_integrators_agree_where_they_can(judged):
    for title in ("Mitsuba, volpath", "Mitsuba, prb"):
        row = judged(rendered_images.IMAGE_RENDERERS[title].draw, title)
        assert row.verdict == "pass" and row.replay["verdict"] == "equal"
    blind = judged(rendered_images.IMAGE_RENDERERS[rendered_images.PTRACER].draw)
    assert blind.verdict == "fail", "light tracing sees nothing through the prism"


def test_the_caustic_is_seen_without_glass(tmp_path):
    """Every ray of the camera meets the floor; and without the ball the image is another one."""
    given = rendered_images.SCENES["caustic"].load(16)
    write_files.write(given, "mitsuba", tmp_path / "scene")
    scene = scene_files.load_scene(tmp_path / "scene" / "scene.xml", {"bsdf": "dielectric"})
    x, y = np.meshgrid(*[np.linspace(0, 1, 65)] * 2)
    rays, _ = scene.sensors()[0].sample_ray(0, 0.5, mi.Point2f(x.ravel(), y.ravel()), mi.Point2f(0.5))
    found = scene.ray_intersect(rays)
    assert np.array(found.is_valid()).all() and np.abs(np.array(found.p)[1]).max() < 1e-2
    size = rendered_images.Size(16, 32, 1, 0.3)
    bright = np.mean([image.pixels for image in rendered_images.reference("caustic", size)], axis=0)
    (tmp_path / "bare").mkdir()
    [dark] = by_the_builtin(matched, given, tmp_path / "bare", 256, [1])
    assert bright.max() > 1.2 * dark.pixels.max()


def test_who_is_known_to_differ_must_be_seen_to(judged):
    """The same pair is a failure of the suite where it should have shown a difference, and none where it did."""
    blind = judged(functools.partial(by_the_builtin, lambda plain: plain), rendered_images.THREE)
    assert blind.verdict == "fail" and blind.broken == {"not seen to differ": 0.0}
    seen = judged(functools.partial(by_the_builtin, denser), rendered_images.THREE)
    assert seen.verdict == "pass" and rendered_images.WHY[rendered_images.THREE] in seen.reason


def test_what_does_not_render_is_never_a_pass(judged):
    def raising(error):
        def draw(*_):
            raise error

        return draw

    absent = judged(raising(AssertionError("asked all the same")), missing="the command that brings it")
    assert absent.verdict == "not run" and absent.reason == "the command that brings it"
    assert judged(raising(ValueError("a diffuse surface"))).verdict == "not run"
    assert judged(raising(environments.Unable("no browser"))).reason == "no browser"
    broken = judged(raising(environments.Broken("exit code 1: segmentation fault")))
    assert broken.verdict == "fail" and "segmentation fault" in broken.reason


def test_values_that_are_not_finite_fail(judged):
    def spoilt(plain, folder, spp, seeds):
        drawn = by_the_builtin(lambda same: same, plain, folder, spp, seeds)
        drawn[0].pixels[3, 4] = np.nan
        return drawn

    row = judged(spoilt)
    assert row.verdict == "fail" and "1 NaN" not in row.reason and "NaN" in row.reason


def test_every_scene_of_a_painter_is_one_of_the_study():
    assert {
        scene for painter in image_renderers.IMAGE_RENDERERS.values() for scene in painter.spp
    } == rendered_images.SCENES.keys()
    assert set(rendered_images.WHY) <= set(image_renderers.IMAGE_RENDERERS)


# Environments and cameras: what the tests of exports do not show ---------------------------------------------------


def test_three_finds_the_sky_where_it_looks(monkeypatch):
    monkeypatch.setattr(shared_files, "FINER", 8)
    sky, directions = rendered_images.askew(), np.random.default_rng(3).normal(size=(4000, 3))
    x, y, z = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).T
    image = shared_files.longitude_latitude(sky, image_renderers.equirectangular)
    u, v = 0.5 + np.arctan2(z, x) / (2 * np.pi), np.arccos(y) / np.pi
    rows, columns = image.shape[:2]
    texel = image[np.minimum((v * rows).astype(int), rows - 1), np.minimum((u * columns).astype(int), columns - 1)]
    # Half a texel is 0.003 rad, the sky's slope below 2.
    assert np.abs(texel - shared_files.radiance(sky, directions)).max() < 0.01
    assert np.abs(texel - shared_files.radiance(sky, directions * [1, 1, -1])).max() > 0.1


def test_radiance_is_given_mitsubas_rays(tmp_path):
    path = environments.SCRIPTS / "radiance_images.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    given = rendered_images.SCENES["prism"].load(16)
    within = np.random.default_rng(1).random((16, 16, 2))
    view = write_files.TARGETS["radiance"](given)["camera.vf"].decode()
    bundle = script.rays(view, within).reshape(-1, 6)

    write_files.write(given, "mitsuba", tmp_path / "scene")
    [sensor] = scene_files.load_scene(tmp_path / "scene" / "scene.xml").sensors()
    place = (np.stack(np.meshgrid(np.arange(16), np.arange(16)), -1) + within).reshape(-1, 2) / 16
    ray, _ = sensor.sample_ray(0, 0.5, mi.Point2f(place.T), mi.Point2f(0.5))
    directions = bundle[:, 3:] / np.linalg.norm(bundle[:, 3:], axis=1, keepdims=True)
    assert np.abs(np.array(ray.d).T - directions).max() < 1e-6
    assert np.abs(np.array(ray.d).T - directions[::-1]).max() > 0.1  # rows from the bottom would be seen
    assert np.abs(np.array(ray.o).T - bundle[:, :3]).max() < 0.1  # Mitsuba's begin at its near plane

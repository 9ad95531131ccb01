"""Caustics: the quadrature of their energy, their scenes, and defects that the study must detect."""

import dataclasses
import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refract import backend, planar
from mi_refract.io import image_file
from mi_refract.rendering import scene_files
from mi_refract.scene_export import targets
from validation import limits
from validation.efficiency import caustic_scenes, caustics
from validation.efficiency.caustics import BY_CLASS, Extent
from validation.reference import caustic_energy
from validation.reference.caustic_energy import LENS_APERTURE, LENS_HEIGHT, LENS_RADIUS, ON_AXIS, PARALLEL, POINT, SPOT
from validation.run.context import PROFILES, Context
from validation.run.metrics import DETECTABLE, WELCH_ALARMS
from validation.run.render_methods import BUILTIN, FROM_LAMPS, Camera
from validation.suite import caustic_energies

SMALL = Extent(24, 16, 64, 16, (caustics.SQUARE,), renders=4)


@pytest.fixture
def context(tmp_path, llvm_variant, monkeypatch):
    monkeypatch.setitem(caustics.EXTENTS, "standard", SMALL)
    return Context(PROFILES["standard"], tmp_path, "llvm_ad_rgb", backend.detect(), backend.usable_variants())


# The quadrature ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ON_AXIS, ids=str)
def test_the_quadrature_follows_rays_as_the_planar_tracer_does(key):
    """Where light meets the floor after 1 to 5 boundaries, and the shares of both polarisations."""
    setup, _ = ON_AXIS[key]
    curves = {
        "ball": planar.shapes.circle(1.0).mapped(np.eye(2), (0, caustic_energy.BALL_HEIGHT)),
        "lens": planar.shapes.polygon(
            [[-LENS_APERTURE, LENS_HEIGHT], [LENS_APERTURE, LENS_HEIGHT]],
            [0, 2 * math.degrees(math.asin(LENS_APERTURE / LENS_RADIUS))],
        ),
    }
    at = setup.widest * (np.arange(20) + 0.5) / 20
    origins, directions = np.zeros((20, 2)), np.stack([np.sin(at), -np.cos(at)], 1)
    origins[:, 1] = setup.lamp or 9.0
    if setup.lamp is None:
        origins[:, 0], directions = at, np.tile([0.0, -1.0], (20, 1))
    tracer, checked = planar.Tracer(curves[key[0]].between(setup.eta, 1.0)), 0
    for met, part in enumerate(caustic_energy.parts(setup, at, 5, polarised=True), 1):
        reflect = 1 if met == 1 else 2 ** (met - 1) - 2  # at the first boundary, or at all but the first and the last
        paths = tracer(origins, directions, met, reflect=reflect, weights=True)
        last = planar.Event.REFLECTED if met == 1 else planar.Event.REFRACTED
        left = paths.events[:, met - 1] == last
        assert (part.shares[:, ~left] == 0).all()
        np.testing.assert_allclose(part.shares[:, left].T, paths.polarised[left, met], rtol=1e-9, atol=1e-12)
        down = left & (paths.directions[:, 1] < 0)
        assert np.isinf(part.x[left & ~down]).all()
        slope = paths.directions[down, 0] / paths.directions[down, 1]
        x = paths.points[down, met, 0] - slope * paths.points[down, met, 1]
        np.testing.assert_allclose(part.x[down], x, rtol=1e-9, atol=1e-9)
        checked += down.sum()
    assert checked >= 30


def test_the_quadrature_conserves_energy_and_its_error_bound_holds():
    for setup, radius in ON_AXIS.values():
        at = setup.widest * np.array([0.1, 0.5, 0.8])
        np.testing.assert_allclose(sum(part.shares for part in caustic_energy.parts(setup, at, 60)), 1, rtol=1e-12)
        (power, error), (better, _) = (caustic_energy.flux(setup, radius, steps=n) for n in (20_000, 70_000))
        assert abs(power - better) <= error < 1e-3 * power


# Scenes --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("body", [*caustic_scenes.BODIES][2:])
def test_scenes_show_a_caustic_and_glass(body, llvm_variant):
    truth = caustics.reference(body, POINT, dataclasses.replace(SMALL, renders=2))
    assert truth.caustic.sum() >= 8 and (truth.caustic <= truth.without_glass).all()
    assert (~truth.without_glass).any() or body == "pool"  # below its surface


def test_lamps_have_the_same_irradiance_below_the_body(scalar_variant):
    """On a surface that faces them. A square lamp of side 0.7 has less, since its corners are farther away."""
    points, place = (np.arange(8) + 0.5) / 8, dr.zeros(mi.SurfaceInteraction3f)
    for lamp in caustic_scenes.LAMPS:
        scene = mi.load_dict({"type": "scene", "lamp": caustic_scenes.lamp_of(lamp)})
        samples = [scene.emitters()[0].sample_direction(place, [x, y]) for x in points for y in points]
        irradiance = np.mean([weight[0] * np.dot(ds.d, caustic_scenes.TOWARDS) for ds, weight in samples])
        assert irradiance == pytest.approx(1, rel=0.25 if lamp == "square 0.7" else 0.02)


def test_above_a_black_floor_the_noise_comes_from_the_lamp_seen_in_glass(context, monkeypatch):
    monkeypatch.setattr(caustic_scenes, "FLOOR", caustics.NEARLY_BLACK)
    monkeypatch.setattr(caustics, "NOISE_RENDERS", 1)
    monkeypatch.setitem(caustics.EXTENTS, "standard", dataclasses.replace(SMALL, spp=256))
    scene = caustic_scenes.scene("ball", POINT, "dielectric", SMALL.resolution)
    pixels = Camera(scene, caustics.seen_in_glass())(64, 0)[0].max(-1) == 0
    noise = caustics.noise_row(context, "ball", caustics.SQUARE, pixels).values
    assert sum(noise.values()) == pytest.approx(1) and noise[caustics.MIRRORED] > 0.9


LAMPS = {
    POINT: '<emitter type="point"><point name="position" value="0, 4.5, 0"/></emitter>',
    PARALLEL: '<emitter type="directional"><vector name="direction" value="0, -1, 0"/></emitter>',
}


@pytest.mark.parametrize(("body", "factor"), [("ball", 1), ("lens", 1.1)])
def test_the_study_of_other_renderers_measures_the_power_of_our_own(context, monkeypatch, body, factor):
    def draw(plain, lamp, folder):
        targets.write(plain, "mitsuba", folder / "scene")
        path = folder / "scene" / "scene.xml"
        path.write_text(path.read_text().replace("</scene>", f"{LAMPS[lamp]}</scene>"))
        method = mi.load_dict(FROM_LAMPS.plugin(plain.max_depth))
        image, _ = Camera(scene_files.load_scene(path), method)(64, seed=0)
        return [image_file.named("image", np.float32(image * (factor if len(plain.meshes) > 1 else 1)))]

    monkeypatch.setitem(caustic_energies.RENDERERS, "ours", caustic_energies.Renderer("mitsuba", draw))
    (row,) = caustic_energies.rows(context, "ours", body)
    assert row.verdict == ("pass" if factor == 1 else "fail")
    assert row.values[caustic_energies.OFF] == pytest.approx(factor - 1, abs=0.02)


def test_black_images_of_other_renderers_fail(context, monkeypatch):
    draw = lambda *_: [image_file.named("black", np.zeros((64, 64, 3), np.float32))] * 2  # noqa: E731
    monkeypatch.setitem(caustic_energies.RENDERERS, "black", caustic_energies.Renderer("mitsuba", draw))
    (row,) = caustic_energies.rows(context, "black", "ball")
    assert row.broken.keys() == {caustic_energies.OFF}


def test_a_reference_without_a_caustic_fails_and_one_without_expected_light_elsewhere():
    rng = np.random.default_rng(3)
    references, images = 1 + 0.01 * rng.normal(size=(2, 4, 16, 16, 3))
    some, none = rng.random((16, 16)) < 0.3, np.zeros((16, 16), bool)
    cases = (some, True, True), (none, True, False), (none, False, False), (~none, True, False), (~none, False, True)
    for pixels, rest_is_lit, passes in cases:
        detectable = caustics._tested(references, images, pixels, rest_is_lit)[DETECTABLE]
        assert (detectable <= limits.CAUSTIC_DETECTABLE) == passes


@pytest.mark.parametrize(("gap", "direct"), [(2e-5, False), (0.006, True)])
def test_light_through_the_gaps_of_a_surface_is_no_direct_light(monkeypatch, llvm_variant, gap, direct):
    """Water with a gap that some 1e-5 of the light passes, or 300 times as much."""

    def halves(bsdf):
        place = mi.ScalarTransform4f
        return {
            name: {
                "type": "rectangle",
                "to_world": place().translate([side * (5 + gap / 2), 2.6, 0]).rotate([1, 0, 0], -90).scale([5, 10, 1]),
                "bsdf": caustic_scenes.glass(bsdf, 1.333),
            }
            for name, side in (("left", -1), ("right", 1))
        }

    monkeypatch.setitem(caustic_scenes.BODIES, "pool", halves)
    extent = dataclasses.replace(SMALL, renders=2, checked_spp=1024)
    black = caustic_scenes.scene("pool", caustics.SQUARE, caustic_scenes.BLACK, 24)
    assert Camera(black, mi.load_dict({"type": "path"}))(1024, seed=0)[0].any()
    assert caustics.reference("pool", caustics.SQUARE, extent).direct == direct


# Defects -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("index", "verdict"), [(1.5, "pass"), (1.56, "fail")])
def test_the_energy_with_another_index_fails(context, monkeypatch, index, verdict):
    glass = caustic_scenes.glass
    monkeypatch.setattr(caustic_scenes, "glass", lambda bsdf: glass(bsdf, index))
    monkeypatch.setitem(caustics.EXTENTS, "standard", dataclasses.replace(SMALL, energy_spp=128))
    (row,) = caustics.energy_rows(context, "ball", SPOT, (BY_CLASS,))
    assert row.verdict == verdict and row.broken.keys() <= {"energy off"}
    (unaimed,) = caustics.energy_rows(context, "ball", POINT, (BY_CLASS,))
    assert unaimed.verdict == "not run" and "does not aim" in unaimed.reason


@pytest.mark.parametrize(("tested", "missing"), [(BUILTIN, 0.5), (BY_CLASS, 0), (FROM_LAMPS, 0)])
def test_missing_light_raises_an_alarm_and_noise_does_not_pass(context, tested, missing):
    """`path` finds no caustic of a point lamp; the sum of classes has other seeds than the reference."""
    *_, row = caustics.image_rows(context, "lens", POINT, (BUILTIN, tested), tested)
    assert row.broken.get(WELCH_ALARMS, -1) == (0 if missing else -1)
    assert row.values["light missing"] > missing if missing else abs(row.values["light missing"]) < 0.1
    assert DETECTABLE in row.broken
    assert row.images.keys() == {"reference", "test"}


def test_scalar_variants_are_not_run(scalar_context):
    (task,) = caustics.tasks(scalar_context())
    (row,) = task.run()
    assert row.verdict == "not run" and row.reason == caustics.SCALAR

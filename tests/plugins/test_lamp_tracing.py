"""`caustics` = `lamp` of `refract_path`: the image of path tracing, where that has one, and the light that it lacks.

Images of path tracing and of both parts together are compared by the differences of the means of 16 tiles over seeds,
with a false alarm in 10,000 runs of a test.
"""

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.glass_scenes import attached, parameter, refusal
from support.variants import switch

import mi_refract  # noqa: F401
from mi_refract.numerics import mitsuba_mesh
from mi_refract.plugins import lamp_tracing
from mi_refract.plugins.film import Splats
from mi_refract.plugins.lamp_tracing import is_one_way

FALSE_ALARM = 1e-4
SIZE = 16


def camera(kind="perspective", film=(), **parameters):
    at = mi.ScalarTransform4f().look_at([0, -6, 3], [-0.3, 0, 0], [0, 0, 1])  # the caustic of a ball
    narrow = at @ mi.ScalarTransform4f().scale(0.8)
    view = {"to_world": narrow} if kind == "orthographic" else {"to_world": at, "fov": 16}
    size = {"width": SIZE, "height": SIZE, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    return {"type": kind, "film": {"type": "hdrfilm"} | size | dict(film)} | view | parameters


def ball(bsdf=None, center=(0, 0, 1.2), radius=0.8):
    return {"type": "sphere", "radius": radius, "center": list(center), "bsdf": bsdf or {"type": "refract"}}


def lamp(place=(1, 0, 5), size=0.9, radiance=8.0):
    to_world = mi.ScalarTransform4f().translate(list(place)).rotate([1, 0, 0], 180).scale(size)
    return {"type": "rectangle", "to_world": to_world, "emitter": {"type": "area", "radiance": radiance}}


def glow(center, radius=0.2, radiance=8.0):
    emitter = {"type": "area", "radiance": radiance}
    return {"type": "sphere", "radius": radius, "center": list(center), "emitter": emitter}


def floor(bsdf=None):
    bsdf = bsdf or {"type": "diffuse", "reflectance": 0.5}
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(4), "bsdf": bsdf}


def texture(pixels, **parameters):
    return {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(np.asarray(pixels, np.float32))} | parameters


def noise(*shape):
    return texture(np.random.default_rng(0).random(shape))


def bumps(bsdf):
    return {"type": "bumpmap", "arbitrary": noise(8, 8, 1), "scale": 1.0, "bsdf": bsdf}


def polyhedron(tmp_path):
    """Few faces with the normals of a sphere."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32) / 3**0.5
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5]]
    faces += [[0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    mesh = mi.Mesh("cube", len(corners), len(faces), has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = (0.8 * corners + np.float32([0, 0, 1.2])).ravel()
    parameters["vertex_normals"], parameters["faces"] = corners.ravel(), np.array(faces, np.uint32).ravel()
    parameters.update()
    mesh.write_ply(str(tmp_path / "cube.ply"))
    return {"type": "ply", "filename": str(tmp_path / "cube.ply")}


def scene(parts, **integrator):
    every = {"type": "scene", "sensor": camera(), "floor": floor(), "ball": ball(), "lamp": lamp()} | parts
    return mi.load_dict(every | {"integrator": {"type": "refract_path", "max_depth": 6} | integrator})


def tiles(loaded, spp, seeds):
    """The means of 4 × 4 tiles, and of all, in an image of each seed."""
    images = np.array([np.array(mi.render(loaded, spp=spp, seed=seed))[..., :3].mean(2) for seed in seeds])
    height, width = images.shape[1:]
    each = images.reshape(len(images), 4, height // 4, 4, width // 4).mean((2, 4)).reshape(len(images), 16)
    return np.c_[each, each.mean(1)]


def both_ways(parts, spp, **integrator):
    """The tiles by path tracing and by lamp tracing, of 16 seeds each."""
    ways = ("path", 0), ("lamp", 100)
    return [tiles(scene(parts, caustics=x, **integrator), spp, range(first, first + 16)) for x, first in ways]


def difference(a, b):
    """The largest |t| of the tiles over its quantile where both have the same means."""
    from scipy import stats

    n = len(a)
    t = (a.mean(0) - b.mean(0)) / np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)) / n + 1e-30)
    least = stats.t.ppf(1 - FALSE_ALARM / 2 / t.size, n - 1)  # Bonferroni; Welch's freedom is n − 1 or more
    return np.abs(t).max() / least


PARTS = {"group", "glass", "sensor", "floor", "ball", "lamp", "more", "sky", "bsdf"} | {f"b{i}" for i in range(40)}
ROW = {f"b{i}": ball(center=(-2 + 0.5 * (i % 8), -1.2 + 0.5 * (i // 8), 0.5), radius=0.24) for i in range(40)}
IN_GLASS = {"lamp": glow((0, 0, 1.2), 0.5)}  # all light passes glass
WHITE = {"type": "diffuse", "reflectance": 0.9}
LEAF = {"type": "mask", "opacity": 0.6, "bsdf": {"type": "principledthin", "spec_trans": 0.3, "diff_trans": 1.0}}
BESIDE = mi.ScalarTransform4f().translate([-1.6, 0, 1]).rotate([0, 1, 0], 90).scale(2)
WALL = {"type": "rectangle", "to_world": BESIDE, "bsdf": WHITE}
BLOCKER = {"type": "disk", "to_world": mi.ScalarTransform4f().look_at([0, -5, 2.5], [-0.3, 0, 0], [0, 0, 1]).scale(0.1)}
TEXTURED = {"emitter": {"type": "area", "radiance": noise(4, 4, 3)}}
GROUP = {"type": "shapegroup", "ball": ball(center=(0, 0, 0), radius=1.0)}
INSTANCE = {"type": "instance", "group": {"type": "ref", "id": "group"}} | {
    "to_world": mi.ScalarTransform4f().translate([0, 0, 1.2]).scale([0.8, 0.6, 1.0])
}
TUBE = {"type": "cylinder", "p0": [-1, 0, 4], "p1": [1, 0, 4], "radius": 0.2}
SHEET = mi.ScalarTransform4f().translate([0, 0, 0.3]).scale(1.5)
TURNED = mi.ScalarTransform4f().translate([1, 0, 4]).rotate([0, 1, 0], 130).scale(0.5)
BALL_LAMP = {"type": "sphere", "to_world": TURNED}
HALF = texture([[[1], [0]]], filter_type="nearest", to_uv=mi.ScalarTransform3f().translate([0.5, 0]))
GLASS = {"type": "ref", "id": "glass"}
CROP = {"width": 40, "height": 30, "crop_width": 16, "crop_height": 16, "crop_offset_x": 14, "crop_offset_y": 9}


# Rays at 45° to the film, with the caustic in the middle of the image as before.
SHEAR = mi.ScalarTransform4f([[1, 0, 1, -8.39], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
SHEARED = camera("orthographic")["to_world"] @ SHEAR
AFAR = mi.ScalarTransform4f().look_at([0, -20, 10], [-0.3, 0, 0], [0, 0, 1])
WINDOW = mi.ScalarTransform4f().translate([0, 0, 0.02]).scale([1, 1, 0.002])
AT_100 = mi.ScalarTransform4f().translate([100, 0, 0])


def pane(height):
    """4 mm thick, at x = 100. A ray starts 9 mm from a surface there, by Mitsuba's rule."""
    to_world = AT_100.translate([0, 0, height]).scale([0.6, 0.6, 0.002])
    return {"type": "cube", "bsdf": {"type": "refract"}, "to_world": to_world}


def agree(**parts):
    """Parts of a scene, and parameters of the integrator."""
    integrator = {name: parts.pop(name) for name in [*parts] if name not in PARTS}
    return parts, integrator


AGREE = {
    "glass ball": agree(),
    "the last depth": agree(max_depth=3),
    "roulette": agree(rr_depth=2),
    "splitting": agree(split_depth=2),
    "thin lens": agree(sensor=camera("thinlens", aperture_radius=0.3, focus_distance=6.0)),
    "thin lens, focused behind far_clip": agree(
        sensor=camera("thinlens", aperture_radius=0.1, focus_distance=30.0, far_clip=20.0)
    ),
    "orthographic": agree(sensor=camera("orthographic")),
    "oblique": agree(sensor=camera("orthographic", to_world=SHEARED)),
    "crop window": agree(sensor=camera(film=CROP)),
    "wide filter": agree(sensor=camera(film={"rfilter": {"type": "gaussian"}, "width": 24})),
    "clipped": agree(sensor=camera(near_clip=3.0, far_clip=6.4), more=BLOCKER),
    "off the axis": agree(sensor=camera(film=CROP, principal_point_offset_x=0.1, principal_point_offset_y=-0.2)),
    "hidden lamp": agree(more=lamp((0, -4, 2), 0.8, 0.1), hide_emitters=True),
    "mirror": agree(ball=ball({"type": "conductor", "material": "Au"})),
    "mask": agree(
        ball=ball({"type": "mask", "opacity": 0.5, "bsdf": WHITE}),
        lamp=glow((1.8, -0.5, 0.8), 0.3),
        sensor=camera(fov=40),
    ),
    "plastic": agree(ball=ball({"type": "plastic", "diffuse_reflectance": 0.95}, (0, 0, 1), 1.0), more=WALL),
    "lamp in glass that absorbs": agree(ball=ball({"type": "refract", "int_absorption": 0.7}), **IN_GLASS),
    "mirror in air that absorbs": agree(
        ball=ball({"type": "conductor"}),
        more=ball({"type": "refract", "ext_absorption": 0.3}, (2, 0, 0.6), 0.4),
        camera_absorption=0.3,
    ),
    "far lamp in air that absorbs": agree(
        ball=ball({"type": "refract", "ext_absorption": 0.04}), lamp=lamp((6, 0, 28), 5.0, 30.0), camera_absorption=0.04
    ),
    "lamps and a sky": agree(more=glow((-2, 0, 2), 0.3, 3.0), sky={"type": "constant", "radiance": 0.1}),
    "bumps": agree(floor=floor(bumps(WHITE)), more=WALL | {"bsdf": bumps(WHITE)}, **IN_GLASS),
    "smooth normals, mirror": agree(ball="polyhedron", bsdf={"type": "conductor"}),
    "smooth normals, glass": agree(ball="polyhedron", bsdf={"type": "refract"}),
    "a bubble in glass": agree(more=ball({"type": "refract", "int_ior": 1.0, "ext_ior": 1.5}, radius=0.4)),
    "more spheres than targets": agree(ball=floor(), **ROW),
    "textured lamp": agree(lamp=lamp() | TEXTURED),
    "textured lamp, turned": agree(lamp=TUBE | TEXTURED),
    "textured ball, turned": agree(lamp=BALL_LAMP | TEXTURED),
    "texture that is moved": agree(lamp=lamp() | {"emitter": {"type": "area", "radiance": HALF}}),
    "ball lamp, turned": agree(lamp=BALL_LAMP | {"emitter": {"type": "area", "radiance": 8.0}}),
    "pane that is merged with a cube": agree(
        glass={"type": "dielectric"},
        ball={"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 1.2]).scale(1.7), "bsdf": GLASS},
        more={"type": "cube", "to_world": mi.ScalarTransform4f().translate([-6, -5, 0.6]).scale(0.4), "bsdf": GLASS},
    ),
    "bumps behind a mask": agree(
        more=floor({"type": "mask", "opacity": 0.6, "bsdf": bumps(WHITE)}) | {"to_world": SHEET}, **IN_GLASS
    ),
    "window before the camera": agree(
        sensor=camera(to_world=AFAR, fov=5, near_clip=0.01),
        more={"type": "cube", "bsdf": {"type": "refract"}, "to_world": AFAR @ WINDOW},
    ),
    "cover glass of a lamp, far from the origin": agree(
        sensor=camera(to_world=AT_100.look_at([1.2, -1.2, 0.6], [0, 0, 0], [0, 0, 1]), fov=10),
        floor=floor() | {"to_world": AT_100.scale(0.5)},
        lamp=lamp((100, 0, 1), 0.4),
        ball=pane(0.996),
    ),
    "leaves over a floor": agree(more=floor(LEAF) | {"to_world": SHEET}, **IN_GLASS),
    "instance": agree(group=GROUP, ball=INSTANCE),
}


@pytest.mark.parametrize("name", AGREE)
def test_lamp_tracing_has_the_image_of_path_tracing(name, llvm_variant, tmp_path):
    parts, integrator = AGREE[name]
    if "bsdf" in parts:
        parts = {"ball": polyhedron(tmp_path) | {"bsdf": parts["bsdf"]}}
    assert difference(*both_ways(parts, 144, **integrator)) < 1


def test_a_lamp_with_a_moved_texture_within_d65_has_the_image_of_path_tracing(llvm_spectral):
    moved = lamp() | {"emitter": {"type": "area", "radiance": {"type": "d65", "nested": HALF}}}
    images = [
        tiles(scene({"lamp": moved}, caustics=caustics), 144, range(first, first + 16))
        for caustics, first in (("path", 0), ("lamp", 100))
    ]
    assert difference(*images) < 1


def test_air_around_camera_and_lamp_absorbs_each_wavelength_by_its_own(llvm_spectral):
    from scipy import stats

    air = {"type": "irregular", "wavelengths": "360, 540, 560, 830", "values": "0, 0, 0.6, 0.6"}
    tinted = ball({"type": "refract", "ext_absorption": air}, (2, 0, 0.6), 0.4)
    parts, images = {"ball": ball({"type": "conductor"}), "more": tinted}, []
    for caustics, first in (("path", 0), ("lamp", 100)):
        loaded = scene(parts, caustics=caustics, camera_absorption=air, max_depth=4)
        images.append([np.array(mi.render(loaded, spp=64, seed=first + i)).mean((0, 1)) for i in range(16)])
    assert (stats.ttest_ind(*images).pvalue > FALSE_ALARM / 3).all()


@pytest.mark.parametrize("variant", ["llvm_ad_mono_polarized"], indirect=True)
def test_polarised_light_that_glass_reflects_has_the_image_of_path_tracing(variant):
    """Polariser, pane near Brewster's angle, plastic near its own, all turned: every matrix and its place counts."""
    pane, to_lamp, to_floor = map(np.array, ([0.5, 4, 2], [-0.63, 0.68, -0.37], [-0.11, -0.89, -0.44]))

    def facing(place, direction, size):
        target = mi.ScalarPoint3f(*(place + direction))
        return mi.ScalarTransform4f().look_at(mi.ScalarPoint3f(*place), target, [0, 0, 1]).scale(size)

    plastic = floor({"type": "pplastic", "diffuse_reflectance": 0.1, "alpha": 0.3})
    parts = {
        "floor": plastic | {"to_world": mi.ScalarTransform4f().rotate([0, 0, 1], 35).scale(4)},
        "ball": floor({"type": "refract"}) | {"to_world": facing(pane, to_lamp + to_floor, 1.0)},
        "lamp": lamp() | {"to_world": facing(pane + 2 * to_lamp, -to_lamp, 0.5)},
        "more": floor({"type": "polarizer", "theta": {"type": "spectrum", "value": 90.0}})
        | {"to_world": facing(pane + 1.5 * to_lamp, -to_lamp, 0.8)},
    }
    images = both_ways(parts, 64, light_paths=2.0)
    assert images[0].all() and difference(*images) < 1


def point(height=5.0, **parameters):
    return {"type": "point", "position": [0, 0, height], "intensity": height**2} | parameters


SUN = {"type": "directional", "direction": [0, 0, -1], "irradiance": 1.0}
OBLIQUE = SUN | {"direction": [-0.3, 0.2, -1.0]}
FAR_AWAY = mi.ScalarTransform4f().look_at([3e6, -2e6, 1e7], [0, 0, 0], [0, 1, 0])
PLAIN = floor({"type": "diffuse", "reflectance": 0.0})
PLAIN |= {"to_world": mi.ScalarTransform4f().translate([0, 0, -1]).scale(1e7)}
ALIKE = {
    "a far point": (SUN, {"lamp": point(4e3)}),
    "a farther spot": (OBLIQUE, {"lamp": {"type": "spot", "to_world": FAR_AWAY, "intensity": 1.13e14}}),
    "a large plain": (OBLIQUE, {"lamp": OBLIQUE, "more": PLAIN}),
}


@pytest.mark.parametrize("name", ALIKE)
def test_a_far_lamp_is_directional_and_other_shapes_may_be_far(name, llvm_variant):
    sun, other = ALIKE[name]
    every = [({"lamp": sun}, range(8)), (other, range(100, 108))]
    images = [tiles(scene(parts, caustics="lamp", max_depth=4), 64, seeds) for parts, seeds in every]
    assert difference(*images) < 1


@pytest.mark.parametrize("lamp", [SUN, point(4e3)])
def test_a_roof_takes_the_light_of_a_far_lamp_away(lamp, llvm_variant):
    roof = {"type": "disk", "to_world": mi.ScalarTransform4f().translate([0, 0, 100]).scale(40)}
    assert not tiles(scene({"lamp": lamp, "more": roof}, caustics="lamp", max_depth=3), 16, [0]).any()


def test_a_small_glass_is_not_missed_beside_a_large_one(llvm_variant):
    sea = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([2e3, 0, -1]).scale(1e3)}
    parts = ({"lamp": SUN, "more": sea | {"bsdf": {"type": "dielectric"}}}, {"lamp": SUN})
    images = [tiles(scene(each, caustics="lamp"), 64, range(first, first + 8)) for first, each in enumerate(parts)]
    assert difference(*images) < 1


def test_lamps_aim_at_an_instance_also_after_an_edit_of_its_group(llvm_variant):
    """The group's ball moves to where it is in the other scenes; the instance is turned, and 9 units away."""

    def instances(x):
        group = {"type": "shapegroup", "id": "group", "inner": ball(center=(0, x, 0), radius=0.4)}
        place = mi.ScalarTransform4f().translate([-9, 0, 1.2]).rotate([0, 0, 1], -90).scale(2)
        instance = {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": place}
        return scene({"lamp": SUN, "ball": group, "more": instance}, caustics="lamp")

    edited = instances(0.5)
    params = mi.traverse(edited)
    params[parameter(params, "inner.to_world")] = mi.ScalarTransform4f().translate([0, 4.5, 0]).scale(0.4)
    params.update()
    images = [tiles(each, 64, range(first, first + 16)) for each, first in ((edited, 0), (instances(4.5), 100))]
    assert difference(*images) < 1


@pytest.mark.parametrize("caustics", ["path", "lamp"])
@pytest.mark.parametrize("bulb", [{"type": "point", "position": [100, 0, 1]}, SUN], ids=["point", "directional"])
def test_no_light_passes_by_a_pane_just_above_the_floor(bulb, caustics, llvm_variant):
    """A lamp of no size: its light on the floor comes and is seen through the pane, so it is in no image."""
    view = camera(to_world=AT_100.look_at([1.2, -1.2, 1], [0, 0, 0], [0, 0, 1]), fov=10)
    parts = {"sensor": view, "lamp": bulb, "ball": pane(0.004), "floor": floor() | {"to_world": AT_100.scale(0.5)}}
    assert dr.all(mi.render(scene(parts, caustics=caustics), spp=16) == 0, axis=None)


def test_a_point_lamp_of_weight_0_is_off(llvm_variant):
    off, on = point(sampling_weight=0.0), point(4.0)
    images = [tiles(scene(parts, caustics="lamp"), 4, [0]) for parts in ({"lamp": on, "more": off}, {"lamp": on})]
    np.testing.assert_allclose(*images, rtol=1e-5)


@pytest.mark.parametrize("lamp", [point(), SUN])
def test_glass_of_no_size_casts_no_light(lamp, llvm_variant):
    parts = {"lamp": lamp, "ball": ball(radius=1e-30)}
    images = [tiles(scene(parts, caustics=caustics), 4, [0]) for caustics in ("lamp", "path")]
    np.testing.assert_array_equal(*images)


@pytest.mark.parametrize("lamp", [point(), SUN])
def test_a_group_that_no_instance_shows_casts_no_light(lamp, rgb_variant):
    spp = 4 if dr.is_jit_v(mi.Float) else 1
    parts = {"lamp": lamp, "ball": GROUP}
    images = [tiles(scene(parts, caustics=caustics), spp, [0]) for caustics in ("auto", "path")]
    assert images[0].all()
    np.testing.assert_array_equal(*images)


@pytest.mark.parametrize("rfilter", ["box", "gaussian", "lanczos"])
def test_of_one_splat_the_sum_of_squares_is_the_square_of_the_sum(rfilter, typical_variant):
    sensor = mi.load_dict(camera(film={"rfilter": {"type": rfilter}}))
    images = []
    for squares in (False, True):
        splats = Splats(getattr(mi, mi.variant()), sensor, 2, squares=squares)
        splats.add(mi.Point2f(7.2, 9.9), [mi.Float(3.0), mi.Float(-0.5)], mi.Bool(True))
        images.append(splats.image())
    assert images[0].any()
    np.testing.assert_allclose(images[1], images[0] ** 2, rtol=1e-6)


@pytest.mark.parametrize("factor", [2.0**-90, 2.0**90])
def test_an_image_scales_with_its_lamps(factor, llvm_variant):
    one, other = (tiles(scene({"lamp": lamp(radiance=8 * x)}, caustics="lamp"), 4, [0]) for x in (1, factor))
    np.testing.assert_allclose(other / factor, one, rtol=1e-5)


def caustic(seed=0, paths=0, own=0, **integrator):
    """The lamps' part of an image of 16 spp; `paths`: number of light paths, by default that of the integrator.

    `own`: seed of the scene's sampler.
    """
    view = camera() | {"sampler": {"type": "independent", "seed": own}}
    loaded = scene({"sensor": view}, caustics="lamp", **integrator)
    method, sensor = loaded.integrator(), loaded.sensors()[0]
    method.begin_render(sensor)
    method.path_loop(loaded, sensor.sampler())
    image = method.caustic_image(loaded, sensor, seed, 16, ("R", "G", "B"), paths=paths)[0]
    method.end_render()
    assert image.any()
    return image


def test_every_seed_has_light_paths_of_its_own_also_that_of_the_sampler(variant):
    images = [caustic(seed, 64, own) for seed, own in ((0, 0), (1, 0), (0, 1))]
    assert all((a != b).any() for a, b in itertools.combinations(images, 2))


def test_roulette_ends_light_paths(llvm_variant):
    """With the same random numbers: if no path ended early, both images would have the same bits."""
    assert (caustic(rr_depth=1) != caustic()).any()


def test_light_paths_are_so_many_for_each_sample(llvm_variant):
    np.testing.assert_array_equal(caustic(light_paths=0.5), caustic(paths=8 * SIZE**2))


def test_seeds_and_chunks_have_different_light_paths(rgb_variant, monkeypatch):
    """The second half of the light paths is not the first one again."""
    half = 4 * SIZE**2 if dr.is_jit_v(mi.Float) else 100
    first = caustic(paths=half)
    assert (caustic(1, paths=half) != first).any()
    monkeypatch.setattr(lamp_tracing, "LANES", half)
    assert not np.allclose(caustic(paths=2 * half), first)


AIR = {"type": "refract", "int_ior": 1.0, "ext_ior": 1.0}
TINTED_AIR = AIR | {"int_absorption": 0.3, "ext_absorption": 0.3}
STRAIGHT = {  # the variant, the ball, parameters of camera and integrator, light paths at a time
    "scalar": ("scalar_rgb", AIR, {}, {"light_paths": 0.5}, 2**24),
    "in chunks": ("llvm_ad_rgb", AIR, {}, {}, 512),
    "absorption before the near plane": (
        "llvm_ad_rgb", TINTED_AIR, {"near_clip": 3.0}, {"camera_absorption": 0.3}, 2**24,
    ),
    "dispersive": ("llvm_ad_spectral", AIR | {"int_ior": "table(360: 1, 830: 1)"}, {}, {}, 2**24),
}  # fmt: skip


@pytest.mark.parametrize(
    ("variant", "bsdf", "view", "parameters", "lanes"), STRAIGHT.values(), ids=STRAIGHT, indirect=["variant"]
)
def test_a_ball_of_the_index_of_air_changes_nothing(variant, bsdf, view, parameters, lanes, monkeypatch):
    """The camera sees only floor behind the ball from the lamp; the reference, with the ball away, has little noise."""
    monkeypatch.setattr(lamp_tracing, "LANES", lanes)
    spp = 1 if variant.startswith("scalar") else 16
    made, reference = (
        scene({"lamp": point(), "sensor": camera(**view), "ball": ball(bsdf, center, 0.4)}, **parameters)
        for center in ((0, 0, 3), (0, 0, -9))
    )
    expected = tiles(reference, 4 * spp, [100])
    assert expected.all() and difference(tiles(made, spp, range(8)), np.repeat(expected, 8, 0)) < 1


def test_light_from_infinity_does_not_pass_air_that_absorbs(llvm_variant):
    parts = {"lamp": SUN, "ball": ball({"type": "refract", "ext_absorption": 1e-3})}
    assert tiles(scene(parts, caustics="lamp", camera_absorption=1e-3), 4, [0]).max() == 0


# Refused --------------------------------------------------------------------------------------------------------------


def tilted_lamp():
    corners = np.array([[-1, -1, 3], [1, -1, 3], [1, 1, 3], [-1, 1, 3]], np.float32)
    normals, faces = np.tile(np.float32([0.6, 0, -0.8]), (4, 1)), np.uint32([[0, 2, 1], [0, 3, 2]])
    properties = mi.Properties()
    properties["emitter"] = mi.load_dict({"type": "area"})
    return mitsuba_mesh.make(mi, corners, faces, normals, properties=properties)


def distance_grid():
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, 8)] * 3, indexing="ij")
    to_world = mi.ScalarTransform4f().translate([-0.4, -0.4, 4]).scale(0.8)
    grid = mi.TensorXf((np.hypot(np.hypot(x, y), z) - 0.7)[..., None].astype(np.float32))
    return {"type": "sdfgrid", "grid": grid, "to_world": to_world, "emitter": {"type": "area", "radiance": 8.0}}


def coloured_lamp(**parameters):
    corners, faces = np.array([[-1, -1, 3], [1, -1, 3], [1, 1, 3], [-1, 1, 3]], np.float32), [[0, 2, 1], [0, 3, 2]]
    radiance = {"type": "mesh_attribute", "name": "face_colour"}
    channels = 1 if mi.is_spectral else 3
    if mi.is_spectral:
        radiance = {"type": "d65", "nested": radiance}
    properties = mi.Properties()
    properties["emitter"] = mi.load_dict({"type": "area", "radiance": radiance} | parameters)
    mesh = mitsuba_mesh.make(mi, corners, np.uint32(faces), properties=properties)
    mesh.add_attribute("face_colour", channels, [0] * channels + [8] * channels)
    return mesh


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_spectral"], indirect=True)
def test_a_lamp_that_emits_an_attribute_cannot_be_sampled(variant):
    loaded = scene({"lamp": coloured_lamp()})
    with pytest.raises(ValueError, match=r"emits the attribute 'face_colour' of its mesh.*; expected a bitmap, or"):
        loaded.integrator().render(loaded, spp=1)


MEDIUM = {"type": "homogeneous", "albedo": 0.0, "sigma_t": 0.1}
REFUSED = {
    "a lamp of another kind": (lambda: {"lamp": {"type": "projector", "irradiance": noise(2, 2, 3)}}, "Projector"),
    "a lamp with normals of its own": (lambda: {"lamp": tilted_lamp()}, "normals of an area lamp"),
    "a camera of another kind": (lambda: {"sensor": {"type": "irradiancemeter", "film": FILM}}, "Irradiance"),
    "a border": (lambda: {"sensor": camera(film={"sample_border": True})}, "sample_border"),
    "a medium": (lambda: {"ball": ball() | {"interior": MEDIUM}}, "media"),
    "a mirrored cylinder": (
        lambda: {"lamp": TUBE | {"to_world": mi.ScalarTransform4f().scale([-1, 1, 1]), "emitter": {"type": "area"}}},
        "mirrored Cylinder",
    ),
    "a lamp without samples": (lambda: {"lamp": distance_grid()}, "SDFGrid"),
    "an attribute": (lambda: {"lamp": coloured_lamp(sampling_weight=0.0), "more": lamp()}, "attribute of its mesh"),
    "glass with bumps": (lambda: {"ball": ball(bumps({"type": "refract"}))}, "BumpMap"),
}
FILM = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}}


@pytest.mark.parametrize(("parts", "message"), REFUSED.values(), ids=REFUSED)
def test_what_lamps_cannot_be_traced_in_is_an_error_and_auto_is_path_tracing(parts, message, llvm_variant):
    parts, name = parts(), "refract_path: caustics = lamp: "
    if parts.get("sensor", {}).get("type") == "irradiancemeter":
        parts = {"meter": ball({"type": "diffuse"}, (0, 0, 3), 0.1) | {"sensor": parts["sensor"]}, "sensor": FILM}
    one, other = (scene(parts, caustics=caustics) for caustics in ("path", "auto"))
    np.testing.assert_array_equal(*(np.array(mi.render(loaded, spp=1)) for loaded in (one, other)))
    refused = scene(parts, caustics="lamp")
    with pytest.raises(ValueError, match=f"^{name}.*{message}.*; expected caustics = path$"):
        refused.integrator().render(refused, spp=1)


@pytest.mark.parametrize(
    "reason", ["a lamp with normals of its own", "a mirrored cylinder", "a lamp without samples", "an attribute"]
)
def test_auto_traces_lamps_of_zero_size_beside_area_lamps_that_cannot_be_traced(reason, llvm_variant):
    parts, message = REFUSED[reason]
    parts = parts() | {"bulb": point(2.5)}  # below the area lamps
    by_path, default = (tiles(scene(parts, **more), 4, [0]) for more in ({"caustics": "path"}, {}))
    assert (default >= 0.999 * by_path).all() and (default > 1.01 * by_path).any()
    assert message in refusal(mi.render, scene(parts, caustics="lamp"), spp=4)


def test_another_integrator_cannot_have_lamps_traced_nor_a_derivative(llvm_variant):
    loaded = scene({}, caustics="lamp")
    around = mi.load_dict({"type": "aov", "aovs": "d:depth", "image": {"type": "refract_path", "caustics": "lamp"}})
    assert "another integrator calls it" in refusal(around.render, loaded, spp=1)
    params, _ = attached(loaded, "bsdf.eta")
    assert "the render is differentiated" in refusal(mi.render, loaded, params, spp=1)


def test_no_lamps_are_traced_where_a_sensor_outside_the_scene_is_differentiated(llvm_variant):
    view, loaded = mi.load_dict(camera()), scene({})
    params, _ = attached(view, "x_fov")
    method = mi.load_dict({"type": "refract_path", "caustics": "lamp"})
    text = refusal(mi.render, loaded, params, sensor=view, integrator=method, spp=1)
    assert "the render is differentiated" in text


@pytest.mark.parametrize(
    ("lamp", "differentiated", "max_depth", "means"),
    [
        ("point", None, 16, "lamp"),
        ("point", None, 2, "path"),  # no caustic is so short
        ("point", "bsdf.eta", 16, "path"),
        ("point", "reflectance.value", 16, "path"),
        ("point", "ball.to_world", 16, "path"),
        ("area", None, 16, "path"),
    ],
)
def test_by_default_lamps_are_traced_that_paths_cannot_find(lamp, differentiated, max_depth, means, llvm_variant):
    parts = {"lamp": point()} if lamp == "point" else {}
    images = []
    for parameters in ({}, {"caustics": means}):
        loaded = scene(parts, max_depth=max_depth, **parameters)
        params = mi.traverse(loaded)
        if differentiated and not parameters:
            dr.enable_grad(params[parameter(params, differentiated)])
            params.update()
        images.append(np.array(mi.render(loaded, params, spp=4)))
    np.testing.assert_array_equal(*images)


def test_by_default_only_lamps_of_zero_size_are_traced(llvm_variant):
    dark = {"glow": glow((-1, 0, 3)), "point": point() | {"intensity": 1e-12}}
    by_path, default = (np.array(mi.render(scene(dark, **x), spp=4)) for x in ({"caustics": "path"}, {}))
    np.testing.assert_allclose(default, by_path, rtol=1e-6, atol=1e-10)  # the same samples, and as little noise
    both = {"glow": glow((-1, 0, 3)), "point": point()}
    every, zero_size = (tiles(scene(both, **x), 64, range(a, a + 8)) for a, x in ((0, {"caustics": "lamp"}), (8, {})))
    assert difference(every, zero_size) < 1


def test_a_retarder_turns_light_another_way_from_the_lamp(needs_variant):
    needs_variant("llvm_ad_mono_polarized")
    switch("llvm_ad_mono_polarized")
    parts = {"ball": ball({"type": "retarder", "delta": 90.0}), "lamp": {"type": "point", "position": [1, 0, 4]}}
    loaded = scene(parts, caustics="lamp")
    with pytest.raises(ValueError, match="a retarder"):
        loaded.integrator().render(loaded, spp=1)


ROUGH = {"roughness": 0.4, "spec_trans": 0.5, "anisotropic": 0.5}
RECIPROCAL = {
    "diffuse": {},
    "roughconductor": {"alpha_u": 0.1, "alpha_v": 0.5},
    "roughdielectric": {"alpha": 0.4},
    "plastic": {"nonlinear": True},
    "roughplastic": {"nonlinear": True, "alpha": 0.3},
    "pplastic": {"alpha": 0.3},
    "principled": ROUGH | {"clearcoat": 1.0, "spec_tint": 0.5},
    "principledthin": ROUGH | {"diff_trans": 1.0, "flatness": 0.5},
    "hair": {},
}


@pytest.mark.parametrize("name", RECIPROCAL)
def test_a_bsdf_has_the_same_value_both_ways_or_is_known_not_to(name, llvm_variant):
    bsdf = mi.load_dict({"type": name} | RECIPROCAL[name])
    wi, wo = (mi.warp.square_to_uniform_sphere(mi.Point2f(np.random.default_rng(i).random((2, 4096)))) for i in (0, 1))
    values = []
    for mode, arrives, leaves in ((mi.TransportMode.Importance, wi, wo), (mi.TransportMode.Radiance, wo, wi)):
        context, si = mi.BSDFContext(mode), dr.zeros(mi.SurfaceInteraction3f, 4096)
        si.wi, si.n, si.sh_frame = arrives, mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
        values.append(np.array(bsdf.eval(context, si, leaves) / dr.abs(leaves.z)))
    # Directions whose half vector is along the surface are known badly.
    alike = np.isclose(*values, rtol=0.01, atol=1e-5).mean() > 0.99
    assert alike == (not is_one_way(bsdf))

"""`caustics` = `lamp` of `refract_path`: the same image as path tracing, where that has one, and the light that it lacks.

Images of path tracing and of both parts together are compared by the differences of the means of 16 tiles over seeds,
with a false alarm in 10,000 runs of a test.
"""

import numpy as np
import pytest

import mi_refract  # noqa: F401
import mitsuba as mi

FALSE_ALARM = 1e-4
SIZE = 16


def camera(kind="perspective", film=(), **parameters):
    at = mi.ScalarTransform4f().look_at([0, -6, 3], [0, 0, 0], [0, 0, 1])
    view = {"to_world": at @ mi.ScalarTransform4f().scale(2)} if kind == "orthographic" else {"to_world": at, "fov": 40}
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


def noise(*shape):
    bitmap = mi.Bitmap(np.random.default_rng(0).random(shape).astype(np.float32))
    return {"type": "bitmap", "raw": True, "bitmap": bitmap}


def bumps(bsdf):
    return {"type": "bumpmap", "arbitrary": noise(8, 8, 1), "scale": 0.3, "bsdf": bsdf}


def polyhedron(tmp_path):
    """Few faces with the normals of a sphere."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32) / 3**0.5
    faces = [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
    ]
    faces += [[1, 5, 7], [1, 7, 3]]
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
    """The means of 4 × 4 tiles in an image of each seed."""
    images = np.array([np.array(mi.render(loaded, spp=spp, seed=seed))[..., :3].mean(2) for seed in seeds])
    height, width = images.shape[1:]
    return images.reshape(len(images), 4, height // 4, 4, width // 4).mean((2, 4)).reshape(len(images), 16)


def difference(a, b):
    """The largest |t| of the tiles over its quantile where both have the same means."""
    from scipy import stats

    n = len(a)
    t = (a.mean(0) - b.mean(0)) / np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)) / n + 1e-30)
    least = stats.t.ppf(
        1 - FALSE_ALARM / 2 / t.size, n - 1
    )  # Bonferroni over the tiles; Welch's freedom is n − 1 or more
    return np.abs(t).max() / least


SPHERES = {f"b{i}": ((-2 + 0.2 * i, 0.5 * (i % 5) - 1, 0.3 + 0.1 * (i % 3)), 0.12) for i in range(25)}
AGREE = {
    "glass ball": (lambda _: {}, {}),
    "the last depth": (lambda _: {}, {"max_depth": 3}),
    "roulette": (lambda _: {}, {"rr_depth": 2}),
    "splitting": (lambda _: {}, {"split_depth": 2}),
    "thin lens": (lambda _: {"sensor": camera("thinlens", aperture_radius=0.3, focus_distance=6.0)}, {}),
    "orthographic": (lambda _: {"sensor": camera("orthographic")}, {}),
    "crop window": (
        lambda _: {"sensor": camera(film={"width": 40, "height": 30, "crop_width": 16, "crop_height": 16,
                                          "crop_offset_x": 14, "crop_offset_y": 9})}, {},
    ),
    "wide filter": (lambda _: {"sensor": camera(film={"rfilter": {"type": "gaussian"}, "width": 24})}, {}),
    "clipped": (lambda _: {"sensor": camera(near_clip=5.5, far_clip=7.0)}, {}),
    "off the axis": (lambda _: {"sensor": camera(principal_point_offset_x=0.2)}, {}),
    "hidden lamp": (lambda _: {"lamp": lamp((0, -2, 2.2), 0.3, 20.0)}, {"hide_emitters": True}),
    "mirror": (lambda _: {"ball": ball({"type": "conductor", "material": "Au"})}, {}),
    "mask": (lambda _: {"ball": ball({"type": "mask", "opacity": 0.4, "bsdf": {"type": "diffuse"}})}, {}),
    "plastic": (lambda _: {"ball": ball({"type": "plastic", "diffuse_reflectance": 0.3})}, {}),
    "lamp in glass that absorbs": (
        lambda _: {"ball": ball({"type": "refract", "int_absorption": 0.7}), "lamp": glow((0.1, 0, 1.3))}, {},
    ),
    "all absorbs": (
        lambda _: {"ball": ball({"type": "refract", "int_absorption": 0.2, "ext_absorption": 0.1})},
        {"camera_absorption": 0.1},
    ),
    "lamps and a sky": (
        lambda _: {"more": glow((-2, 0, 2), 0.3, 3.0), "sky": {"type": "constant", "radiance": 0.1}}, {},
    ),
    "bumps on the floor": (lambda _: {"floor": floor(bumps({"type": "diffuse", "reflectance": 0.7}))}, {}),
    "smooth normals": (lambda path: {"ball": polyhedron(path) | {"bsdf": {"type": "refract"}}}, {}),
    "matt, smooth normals": (
        lambda path: {"matt": polyhedron(path) | {"to_world": mi.ScalarTransform4f().translate([1.3, -1.2, -0.5])}}, {},
    ),
    "more spheres than targets": (lambda _: {name: ball(None, *place) for name, place in SPHERES.items()}, {}),
    "textured lamp": (
        lambda _: {"lamp": lamp() | {"emitter": {"type": "area", "radiance": noise(4, 4, 3)}}}, {},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", AGREE)
def test_lamp_tracing_has_the_image_of_path_tracing(name, llvm_variant, tmp_path):
    parts, integrator = AGREE[name]
    parts = parts(tmp_path)
    images = [
        tiles(scene(parts, caustics=caustics, **integrator), 256, range(first, first + 8))
        for caustics, first in (("path", 0), ("lamp", 100))
    ]
    assert difference(*images) < 1

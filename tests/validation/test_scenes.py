"""The scenes in `scenes/` show what their comments say.

All in `scalar_rgb` with the built-in `dielectric` as `$bsdf`: the tests judge scenes, not a BSDF. Scenes with
dispersion or absorption, which `dielectric` lacks, are loaded with `refract` and rendered by `refract_path`; their
colours are tested in `llvm_ad_spectral`. Seeds are fixed, so a test that passes once passes until the scene, Mitsuba or
the test changes.
"""

import re
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from validation.run.context import SCENES, beyond_builtin

NAMES = ["balls", "diamond", "fibre", "furnace", "glasses64", "lightpipe", "matched"]
NAMES += ["mirage", "nested", "prism", "slab", "sphere"]
DISPERSIVE = ["diamond_fire", "dispersive_prism", "rainbow_drop", "spectrum_on_screen"]
BEYOND = [*DISPERSIVE, "green_bottle"]  # scenes that `dielectric` cannot render
EVERY = sorted(NAMES + BEYOND)
DEFAULTS = {"bsdf": "refract", "sampler": "independent", "spp": "64", "res": "128"}
each_scene = pytest.mark.parametrize("name", EVERY)
pytestmark = pytest.mark.usefixtures("scalar_variant")


def load(scene, **parameters):
    """Load a scene by its name or its path."""
    path = scene if isinstance(scene, Path) else SCENES / f"{scene}.xml"
    # optimize=False: Mitsuba would merge meshes of equal BSDFs, and lose their ids.
    bsdf = "refract" if path.stem in BEYOND else "dielectric"
    return mi.load_file(str(path), optimize=False, **{"bsdf": bsdf, "res": 16, "spp": 4} | parameters)


def rendered(scene, **parameters):
    return np.array(mi.render(load(scene, **parameters), seed=1))


def edited(tmp_path, name, old, new, count=-1):
    """Write a copy of scene `name` with `old` replaced, to plant a defect."""
    text = (SCENES / f"{name}.xml").read_text()
    assert old in text
    (tmp_path / "meshes").symlink_to(SCENES / "meshes")
    (tmp_path / f"{name}.xml").write_text(text.replace(old, new, count))
    return tmp_path / f"{name}.xml"


# --- the files -------------------------------------------------------------------------------------------


@each_scene
def test_scene_files_have_the_common_form(name):
    """A comment on the purpose of the scene, the common parameters, and every `$bsdf` with both of its media."""
    paths = list(SCENES.glob("*.xml"))
    assert sorted(p.stem for p in paths) == EVERY
    assert sorted(p.stem for p in paths if beyond_builtin(p)) == sorted(BEYOND)
    text = (SCENES / f"{name}.xml").read_text()
    root = ET.fromstring(text)
    comment = re.match(r"<!--(.*?)-->", text, re.S)
    assert comment and len(comment[1].split()) >= 20
    defaults = {d.get("name"): d.get("value") for d in root.iter("default")}
    integrator = "refract_path" if name in BEYOND else "path"
    common = {key: value for key, value in defaults.items() if key not in ("fov", "glass", "max_depth")}
    assert common == DEFAULTS | {"integrator": integrator} and "max_depth" in defaults
    assert "dielectric" not in text and root.findall(".//bsdf[@type='$bsdf']")
    for bsdf in root.iter("bsdf"):
        iors = [p.tag for p in bsdf if p.get("name") in ("int_ior", "ext_ior")]
        assert len(iors) == (2 if bsdf.get("type") == "$bsdf" else 0) and set(iors) <= {"float", "string"}


def iors(path):
    """Return (int_ior, ext_ior) of a scene's `$bsdf`s by id, and of each glass shape by id.

    An index is a number, or the text of a dispersive material.
    """

    root = ET.parse(path).getroot()
    defaults = {f"${d.get('name')}": d.get("value") for d in root.iter("default")}

    def value(p):
        text = defaults.get(p.get("value"), p.get("value"))
        if re.search("[(:]", text):
            return text
        props = mi.Properties()
        props["ior"] = text if p.tag == "string" else float(text)
        return mi.lookup_ior(props, "ior", 1.0)

    glasses = root.findall(".//bsdf[@type='$bsdf']")
    media = {b.get("id"): tuple(value(b.find(f"*[@name='{n}']")) for n in ("int_ior", "ext_ior")) for b in glasses}
    shapes = ((s.get("id"), r.get("id")) for s in root.iter("shape") for r in s.findall("ref"))
    return media, {shape: media[bsdf] for shape, bsdf in shapes if bsdf in media}


# --- loading and rendering -------------------------------------------------------------------------------


@each_scene
def test_scenes_load_render_and_have_nested_media(name):
    """The size matters: the ray offset is absolute, so a scene a hundred times smaller leaks at its edges."""
    scene = load(name, spp=16)
    box = scene.bbox()
    assert 30 < np.linalg.norm(box.max - box.min) < 3000
    film = scene.sensors()[0].film()
    assert film.rfilter().radius() == 0.5 and "float32" in str(film)
    image = np.array(mi.render(scene, seed=1))
    assert image.shape == (16, 16, 3) and np.isfinite(image).all()
    assert (image > 1e-3).all()  # light reaches every point of every scene
    assert name == "furnace" or image.std() > 0.05
    assert medium_faults(SCENES / f"{name}.xml") == 0


def test_parameters_reach_the_scene():
    scene = load("sphere", res=8, spp=9, max_depth=3, integrator="volpath")
    sensor, integrator = scene.sensors()[0], str(scene.integrator())
    assert tuple(sensor.film().size()) == (8, 8) and sensor.sampler().sample_count() == 9
    assert "max_depth = 3" in integrator and "Volumetric" in integrator


def test_furnace_is_white_and_shows_a_loss(tmp_path):
    """Each path has the weight 1, up to the rounding of η² in and 1/η² out, so the image has no noise.

    Only a path longer than max_depth = 128 makes it fail. Of 8.4e6 paths none was longer than 32 (95 %: fewer than
    3.6e-7), so 1024 paths with another seed raise a false alarm with probability below 4e-4.
    """
    loss = '<bsdf type="$bsdf" id="core"><float name="specular_transmittance" value="0.999"/>'
    lossy = edited(tmp_path, "furnace", '<bsdf type="$bsdf" id="core">', loss)
    white, grey = (np.abs(rendered(scene) - 1).max() for scene in ("furnace", lossy))
    assert white < 1e-5 and grey > 1e-4


# --- media: a straight line must leave each medium that it enters -----------------------------------------


def medium_faults(path, lines=200):
    """Count crossings at which the index on the near side is not that of the medium that the line is in.

    Straight lines suffice: whether surfaces nest does not depend on refraction. Opaque shapes are ignored.
    """
    scene, (_, media) = load(path), iors(path)
    glass = [s for s in scene.shapes() if s.id() in media]
    assert len(glass) == len(media)
    boxes = [s.bbox() for s in glass]
    lo, hi = np.min([b.min for b in boxes], 0), np.max([b.max for b in boxes], 0)
    radius, centre = np.linalg.norm(hi - lo), (lo + hi) / 2
    _, outside = media[max(glass, key=lambda s: np.linalg.norm(s.bbox().max - s.bbox().min)).id()]
    rng, crossings, faults = np.random.default_rng(7), 0, 0
    for _ in range(lines):
        d = rng.normal(size=3)
        d /= np.linalg.norm(d)
        ray = mi.Ray3f(mi.Point3f(rng.uniform(lo, hi) - radius * d), mi.Vector3f(d))
        medium = outside
        while (si := scene.ray_intersect(ray)).is_valid() and np.linalg.norm(si.p - centre) <= 2 * radius:
            if si.shape.id() in media:
                inside, beyond = media[si.shape.id()]
                near, far = (beyond, inside) if np.dot(d, si.n) < 0 else (inside, beyond)
                crossings, faults, medium = crossings + 1, faults + (near != medium), far
            ray = si.spawn_ray(mi.Vector3f(d))
        faults += medium != outside
    assert crossings > lines / 4
    return faults


@pytest.mark.parametrize(
    "name, old, new",
    [
        ("nested", '<string name="ext_ior" value="water"/>', '<string name="ext_ior" value="air"/>'),
        ("nested", "tumbler_wet.ply", "tumbler_air.ply"),
        ("matched", '<float name="ext_ior" value="1.501"/>', '<float name="ext_ior" value="1.0"/>'),
        ("furnace", '<float name="radius" value="17"/>', '<float name="radius" value="29"/>'),
        ("mirage", '<float name="ext_ior" value="1.0002769"/>', '<float name="ext_ior" value="1.000277"/>'),
        ("fibre", '<translate z="41.573"/>', '<translate z="41.613"/>'),
    ],
)
def test_wrong_boundaries_are_detected(tmp_path, name, old, new):
    assert medium_faults(edited(tmp_path, name, old, new)) > 0


def test_the_indices_of_glasses64_and_matched():
    media, shapes = iors(SCENES / "glasses64.xml")
    assert sorted(i for i, _ in media.values()) == pytest.approx([1.30 + 0.02 * k for k in range(64)], abs=1e-6)
    assert len(shapes) == 64
    media, _ = iors(SCENES / "matched.xml")
    assert media["same"][0] == media["same"][1] == media["liquid"][0]
    assert media["near"][0] - media["near"][1] == pytest.approx(1e-3, rel=1e-3)


# --- meshes ----------------------------------------------------------------------------------------------

# A solid is a list of meshes; "-" turns one inside out.
SOLIDS = {
    "bottle": ["bottle_outer.ply"],
    "hollow": ["bottle_inner.ply"],
    "diamond": ["diamond.ply"],
    "prism": ["prism.ply"],
    "tumbler": ["tumbler_air.ply", "tumbler_wet.ply"],
    "water": ["-tumbler_wet.ply", "water_top.ply"],
}


def read_ply(path):
    header, body = path.read_text().split("end_header\n")
    count = int(re.search(r"element vertex (\d+)", header)[1])
    rows = body.splitlines()
    vertices = np.array([r.split() for r in rows[:count]], np.float32).astype(float)
    return vertices, np.array([r.split()[1:] for r in rows[count:]], int)


def solid(name):
    """Return vertices and triangles of a solid; vertices with bitwise equal coordinates are merged."""
    parts = [(m[0] == "-", *read_ply(SCENES / "meshes" / m.lstrip("-"))) for m in SOLIDS[name]]
    points = np.concatenate([v for _, v, _ in parts])
    starts = np.cumsum([0] + [len(v) for _, v, _ in parts[:-1]])
    faces = [start + (f[:, ::-1] if turn else f) for start, (turn, _, f) in zip(starts, parts, strict=True)]
    vertices, index = np.unique(points, axis=0, return_inverse=True)
    return vertices, index.reshape(-1)[np.concatenate(faces)]


@pytest.mark.parametrize("name", SOLIDS)
def test_solids_are_closed(name):
    v, f = solid(name)
    edges = Counter((int(a), int(b)) for t in f for a, b in zip(t, np.roll(t, -1), strict=True))
    assert set(edges.values()) == {1} and all((b, a) in edges for a, b in edges)  # each edge has its opposite
    assert len(v) - len(edges) // 2 + len(f) == 2  # Euler's formula
    assert np.einsum("ij,ij->i", v[f[:, 0]], np.cross(v[f[:, 1]], v[f[:, 2]])).sum() > 0  # the volume


# --- light pipe ------------------------------------------------------------------------------------------


def internal_reflections(path, rays=40):
    """Count the total internal reflections of camera rays that enter a pipe's end, until they leave the pipes."""
    scene, counts = load(path), []
    rng = np.random.default_rng(5)
    eta = iors(path)[0]["glass"]
    for u in rng.random((40 * rays, 2)):
        if len(counts) == rays:
            break
        ray, _ = scene.sensors()[0].sample_ray(0, 0.5, mi.Point2f(u), mi.Point2f(0.5))
        si = scene.ray_intersect(ray)
        if not (si.is_valid() and si.shape.id().startswith("pipe") and si.n.z > 0.5):
            continue
        count = 0
        while si.is_valid() and si.shape.id().startswith("pipe") and count < 500:
            reflectance, cos_t, _, eta_ti = mi.fresnel(si.wi.z, eta[0] / eta[1])
            total = reflectance == 1
            count += total
            wo = mi.reflect(si.wi) if total else mi.refract(si.wi, cos_t, eta_ti)
            si = scene.ray_intersect(si.spawn_ray(si.to_world(wo)))
        counts.append(count)
    assert len(counts) == rays
    return np.array(counts)


def test_light_pipe_reflects_fifty_times(tmp_path):
    counts = internal_reflections(SCENES / "lightpipe.xml")
    assert counts.min() >= 50
    assert counts.max() < 160 / 2  # what the far end reflects returns within max_depth
    assert internal_reflections(edited(tmp_path, "lightpipe", 'z="70"/>', 'z="62"/>')).min() < 50


# --- dispersion and absorption ---------------------------------------------------------------------------


@pytest.fixture(params=["llvm_ad_spectral", "llvm_ad_rgb"])
def colours(request, needs_variant):
    """Set a spectral or an RGB variant; return whether it shows dispersion."""
    needs_variant(request.param)
    mi.set_variant(request.param)
    return request.param.endswith("spectral")


def test_prism_and_screen_show_the_colours_in_order(colours):
    """On the prism, from the left (largest deviation): blue, green, red. In RGB they are at one position.

    On the screen red minus green is −3.5 ± 0.35 columns, blue minus green 5.9 ± 0.4: bounds are four deviations away.
    """
    # The spectrum only: the lamp that is seen directly is to the left, the table below.
    columns = rendered("dispersive_prism", res=64, spp=64)[14:36, 14:40].clip(0, None).mean(0)
    strong = columns * (columns > 0.5 * columns.max(0))
    red, green, blue = np.average(np.mgrid[0:26, 0:3][0] / 26, axis=0, weights=strong)
    in_order = blue + 0.1 < green < red - 0.05
    together = max(abs(red - green), abs(blue - green)) < 0.02
    assert in_order if colours else together
    scene = load("spectrum_on_screen", res=64, spp=2048 if colours else 64)
    params = mi.traverse(scene.sensors()[0])
    params["film.crop_size"], params["film.crop_offset"] = (48, 22), (8, 12)
    params.update()
    band = np.array(mi.render(scene, seed=1)).sum(0)
    red, green, blue = np.average(np.mgrid[8:56, 0:3][0], axis=0, weights=np.clip(band - np.median(band, 0), 0, None))
    assert red + 2 < green < blue - 2 if colours else max(abs(red - green), abs(blue - green)) < 0.5


@pytest.mark.parametrize("name", DISPERSIVE)
def test_spectral_variants_show_colours_and_rgb_does_not(name, colours):
    image = rendered(name, res=64, spp=64)
    bright = image[image.max(2) > 0.3]  # leaves out the dark sky; lamps are white
    colourful = (bright.max(-1) - bright.min(-1)).sum() / bright.sum()
    assert colourful > 0.3 if colours else colourful < 0.15


def test_the_rainbow_is_red_at_its_borders_and_blue_between(llvm_spectral):
    image = rendered("rainbow_drop", res=96, spp=256)
    y, x = np.mgrid[:96, :96] + 0.5 - 48
    ring = (np.hypot(x, y) / 1.5).astype(int)
    red, blue = (np.bincount(ring.ravel(), image[..., c].ravel()) / np.bincount(ring.ravel()) for c in (0, 2))
    middle = int(blue[12:28].argmax()) + 12
    assert red[middle - 3 : middle + 4].argmax() != 3
    assert blue[middle] > 2 * red[middle]
    assert (red > blue)[middle + 1 : middle + 4].any() and (red > blue)[middle - 4 : middle].any()


def test_thick_glass_is_darker(llvm_variant):
    """The stopper is solid, the wall of the neck below it is thin; both are in front of the sky."""
    image = rendered("green_bottle", res=64, spp=16)
    stopper, neck = image[3:7, 29:36].mean((0, 1)), image[10:15, 29:36].mean((0, 1))
    assert (stopper < neck).all() and stopper[0] < 0.5 * neck[0]
    assert stopper[1] > 2 * stopper[0] and stopper[1] > 1.5 * stopper[2]

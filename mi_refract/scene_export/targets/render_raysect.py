"""Render `scene.json` with raysect: `python render.py --spp 256 --seeds 1 2 3 4 --out .`

It writes one `seedN.pfm` per seed. Run this script with a Python that has raysect; mi_refract never imports it. A ray
of raysect carries a spectrum, here of three bins: red, green and blue. Glass has the same index in all three, so they
share a path. With `--band FROM TO` (nm) a ray has one bin, which the image repeats in its three channels, and a glass
with an entry "schott" in `scene.json` is that of raysect's library, with its index in the band.
"""

import argparse
import json
import math
import multiprocessing
import os
import re
from pathlib import Path

import numpy as np
from raysect.core import Vector3D, rotate_basis, translate
from raysect.core.math import random
from raysect.core.workflow import SerialEngine
from raysect.optical import ConstantSF, InterpolatedSF, World
from raysect.optical.library import schott
from raysect.optical.material import Dielectric, Lambert, UniformSurfaceEmitter
from raysect.optical.observer import FullFrameSampler2D, PinholeCamera, SpectralRadiancePipeline2D
from raysect.primitive import Mesh, Sphere

# raysect intersects triangles in float32 and offsets the next ray by 1e-6: a scene must not be much larger than 1.
SIZE, FAR = 0.5, 10.0  # the largest coordinate after scaling, and the radius of the sky
# Borders in nm of the bins for red, green and blue, which stand for no colours; half the width of a step between bins.
BINS, STEP = (400.0, 500.0, 600.0, 700.0), 1e-6


def main():
    """Render once per seed, in parallel processes."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--spp", type=int, default=256)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--threads", type=int, default=0, help="processes; 0 for all")
    parser.add_argument("--band", type=float, nargs=2, help="wavelengths in nm")
    parser.add_argument("--out", type=Path, default=Path())
    options = parser.parse_args()
    tasks = [(options, seed) for seed in options.seeds]
    with multiprocessing.get_context("fork").Pool(options.threads or os.cpu_count()) as pool:
        for path in pool.imap(image, tasks, chunksize=1):
            print(path, flush=True)


def image(task):
    """Render one image and return its path."""
    options, seed = task
    folder = Path(__file__).resolve().parent
    plain = json.loads((folder / "scene.json").read_text())
    world = build(plain, folder)
    random.seed(seed)
    pipeline = SpectralRadiancePipeline2D()
    camera(world, plain, options, pipeline).observe()
    mean = np.asarray(pipeline.frame.mean).transpose(1, 0, 2)  # rows from the top
    path = options.out.resolve() / f"seed{seed}.pfm"
    path.write_bytes(pfm(np.broadcast_to(mean, (*mean.shape[:2], 3))))
    return path


def pfm(pixels):
    """Return the bytes of a portable float map, whose first row is the lowest."""
    height, width, _ = pixels.shape
    return f"PF\n{width} {height}\n-1.0\n".encode() + pixels[::-1].astype("<f4").tobytes()


def build(plain, folder):
    """Create the world from `scene.json` and the files in its folder."""
    world, unit = World(), scale(plain, folder)
    materials = {name: MATERIALS[entry["type"]](entry) for name, entry in plain["materials"].items()}
    for name, entry in plain["meshes"].items():
        vertices, faces = triangles(folder / entry["file"])
        # closed=False is enough: raysect needs to know what is inside a mesh only for absorption.
        mesh = Mesh(vertices * unit, faces, smoothing=False, closed=False, parent=world, name=name)
        mesh.material = materials[entry["material"]]
    sky = plain["sky"]
    material = Map(sky, folder) if "environment" in sky else UniformSurfaceEmitter(per_bin(sky["radiance"]))
    Sphere(FAR, parent=world, material=material)
    return world


def scale(plain, folder):
    """Return the factor that scales the largest coordinate of the scene, 1 if all are 0, to SIZE."""
    parts = [triangles(folder / entry["file"])[0] for entry in plain["meshes"].values()]
    return SIZE / (np.abs(np.concatenate([[plain["camera"]["origin"]], *parts])).max() or 1.0)


def triangles(path):
    """Return the vertices and faces of a binary PLY file of float32 positions and triangles."""
    header, _, data = path.read_bytes().partition(b"end_header\n")
    vertices, faces = (int(count) for count in re.findall(rb"element \w+ (\d+)", header))
    corners = np.frombuffer(data, [("count", "u1"), ("index", "<i4", 3)], faces, vertices * 12)
    return np.frombuffer(data, "<f4", vertices * 3).reshape(-1, 3).astype(float), corners["index"].copy()


def per_bin(colour):
    """Return a spectrum that is constant within each bin."""
    wavelengths = [BINS[0], *(edge + side for edge in BINS[1:-1] for side in (-STEP, STEP)), BINS[-1]]
    return InterpolatedSF(wavelengths, np.repeat(colour, 2))


class Light(UniformSurfaceEmitter):
    """A surface that emits on the side of its normals and is black from behind."""

    def evaluate_surface(self, world, ray, primitive, hit_point, exiting, *others):
        """Override the base class."""
        if exiting:
            return ray.new_spectrum()
        return super().evaluate_surface(world, ray, primitive, hit_point, exiting, *others)


class Map(UniformSurfaceEmitter):
    """A sky from a map of directions, linear between the map's pixels."""

    def __init__(self, sky, folder):
        """`sky`: the entry of `scene.json`."""
        super().__init__(ConstantSF(1))
        self.pixels = np.load(folder / sky["environment"]).astype(float)

    def evaluate_surface(self, world, ray, *others):
        """Override the base class."""
        d, spectrum = ray.direction.normalise(), ray.new_spectrum()
        rows, columns = self.pixels.shape[:2]
        row = max(0.0, min(rows - 1.0, math.acos(max(-1.0, min(1.0, d.y))) / math.pi * rows - 0.5))
        column = math.atan2(d.x, -d.z) / (2 * math.pi) * columns - 0.5
        top, left = int(row), math.floor(column)
        a, b, sides = row - top, column - left, (left % columns, (left + 1) % columns)
        upper, lower = self.pixels[top], self.pixels[min(top + 1, rows - 1)]
        for weight, line in ((1 - a, upper), (a, lower)):
            spectrum.samples[:] += weight * ((1 - b) * line[sides[0]] + b * line[sides[1]])
        return spectrum


def glass(entry):
    """Return a smooth boundary without absorption."""
    index = schott(entry["schott"]).index if "schott" in entry else ConstantSF(entry["int_ior"])
    return Dielectric(index, ConstantSF(1), ConstantSF(entry["ext_ior"]))


MATERIALS = {
    "glass": glass,
    "diffuse": lambda entry: Lambert(per_bin(entry["reflectance"])),
    "light": lambda entry: Light(per_bin(entry["radiance"])),
}


class Camera(PinholeCamera):
    """A pinhole camera with equal weights; raysect's own weighs a ray by its cosine to the viewing direction."""

    def _generate_rays(self, *place):
        return [(ray, 1.0) for ray, _ in super()._generate_rays(*place)]


def camera(world, plain, options, pipeline):
    """Return the pinhole camera; without roulette and importance sampling, raysect is a plain path tracer."""
    entry = plain["camera"]
    width, height = entry["width"], entry["height"]
    half_width = math.tan(math.radians(entry["fov_x_degrees"]) / 2)
    result = Camera((width, height), parent=world, pipelines=[pipeline], frame_sampler=FullFrameSampler2D())
    result.fov = math.degrees(2 * math.atan(half_width * max(1, height / width)))  # of the longer side
    origin, target = (np.array(entry[key]) for key in ("origin", "target"))
    place = origin * scale(plain, Path(__file__).resolve().parent)
    result.transform = translate(*place) * rotate_basis(Vector3D(*(target - origin)), Vector3D(*entry["up"]))
    result.pixel_samples, result.quiet, result.render_engine = options.spp, True, SerialEngine()
    band = options.band or (BINS[0], BINS[-1])
    result.min_wavelength, result.max_wavelength = 1.0, band[1]
    result.min_wavelength = band[0]
    result.spectral_rays, result.spectral_bins = 1, 1 if options.band else len(BINS) - 1
    result.ray_extinction_prob, result.ray_importance_sampling = 0.0, False
    result.ray_extinction_min_depth, result.ray_max_depth = 1, plain["max_depth"]
    return result


if __name__ == "__main__":
    main()

"""Render `scene.rad` by Radiance's rtrace: `python radiance_images.py FOLDER OUT WIDTH HEIGHT SPP SEED…`

Needs pyradiance. Takes the options of rtrace, and of mkpmap if it is there, from README.txt. The rays of a pixel are
random within it. Writes one `seedN.f32` per seed: rows from the top, three float32 per pixel.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np

# In addition to the exported options: without ambient values and caches, Radiance is a path tracer.
RTRACE = "-ov -av 0 0 0 -dj 0 -st 0 -ss 1"
BATCH = 2**20  # rays per process; a process has its own random numbers, seeded by the second in which it starts


def main():
    import pyradiance

    home = Path(pyradiance.__file__).parent
    folder, out, width, height, spp, *seeds = sys.argv[1:]
    os.chdir(folder)
    os.environ["RAYPATH"] = f".:{home / 'lib'}"
    octree = Path(out, "scene.oct")
    octree.write_bytes(subprocess.run([home / "bin/oconv", "-w", "scene.rad"], check=True, stdout=-1).stdout)
    options = dict(re.findall(r"(rtrace|mkpmap) (.*?)scene\.oct", Path("README.txt").read_text(), re.DOTALL))
    if "mkpmap" in options:  # a photon map that is older than the octree is an error
        subprocess.run([home / "bin/mkpmap", *options["mkpmap"].split(), octree], check=True)
    rtrace = [home / "bin/rtrace", *options["rtrace"].replace("\\", " ").split(), *RTRACE.split(), octree]
    view = Path("camera.vf").read_text()
    size = int(height), int(width)
    samples = [(seed, rng) for seed in seeds for rng in [np.random.default_rng(int(seed))] * int(spp)]
    images = {seed: np.zeros((*size, 3)) for seed in seeds}
    step = max(BATCH // (size[0] * size[1]), 1)
    for batch in (samples[start : start + step] for start in range(0, len(samples), step)):
        bundle = np.stack([rays(view, rng.random((*size, 2))) for _, rng in batch])
        for (seed, _), image in zip(batch, traced(rtrace, bundle), strict=True):
            images[seed] += image / int(spp)
    for seed, image in images.items():
        path = Path(out, f"seed{seed}.f32")
        path.write_bytes(image.astype("<f4").tobytes())
        print(path, flush=True)


def rays(view, within):
    """Return origin and direction of one ray per pixel, H × W × 6, rows from the top; `within`: (x, y) in [0, 1]²."""
    words = view.split()
    origin, ahead, up = (np.array(words[words.index(key) + 1 :][:3], float) for key in ("-vp", "-vd", "-vu"))
    wide, tall = (np.tan(np.radians(float(words[words.index(key) + 1])) / 2) for key in ("-vh", "-vv"))
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    height, width = within.shape[:2]
    y, x = np.mgrid[:height, :width] + np.moveaxis(within[..., ::-1], -1, 0)
    x, y = wide * (2 * x / width - 1), tall * (1 - 2 * y / height)
    directions = ahead + x[..., None] * right + y[..., None] * np.cross(right, ahead)
    return np.concatenate([np.broadcast_to(origin, directions.shape), directions], -1)


def traced(rtrace, bundle):
    """Return the radiance of each ray, float64."""
    done = subprocess.run(rtrace, input=bundle.astype("<f8").tobytes(), stdout=-1, check=True)
    return np.frombuffer(done.stdout, "<f4").reshape(*bundle.shape[:-1], 3).astype(float)


if __name__ == "__main__":
    main()

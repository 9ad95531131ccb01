"""Render `scene.rad` by Radiance's rtrace: `python radiance_pictures.py FOLDER OUT WIDTH SPP DEPTH SEED…`

Run by the Python that has pyradiance. The rays of every pixel are random within it; one `seedN.f32` per seed: rows
from the top, three float32 a pixel.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyradiance

HOME = Path(pyradiance.__file__).parent
# Every diffuse reflection sends one random ray, and nothing is remembered or sampled besides: a path tracer.
RTRACE = "-h -w -u+ -fdf -ov -aa 0 -ad 1 -as 0 -av 0 0 0 -dj 0 -st 0 -ss 1 -lw 1e-7"


def main():
    folder, out, width, spp, depth, *seeds = sys.argv[1:]
    os.chdir(folder)
    os.environ["RAYPATH"] = f".:{HOME / 'lib'}"
    octree = subprocess.run([HOME / "bin/oconv", "-w", "scene.rad"], check=True, capture_output=True).stdout
    Path(out, "scene.oct").write_bytes(octree)
    for seed in seeds:
        picture = np.zeros((int(width), int(width), 3))
        rng = np.random.default_rng(int(seed))
        for _ in range(int(spp)):
            picture += traced(Path(out, "scene.oct"), rays(int(width), rng), depth).reshape(picture.shape)
        path = Path(out, f"seed{seed}.f32")
        path.write_bytes((picture / int(spp)).astype("<f4").tobytes())
        print(path, flush=True)


def rays(width, rng):
    """Origin and direction of one ray a pixel, uniform in it; rows from the top."""
    view = Path("camera.vf").read_text().split()
    origin, ahead, up = (np.array(view[view.index(key) + 1 :][:3], float) for key in ("-vp", "-vd", "-vu"))
    wide = np.tan(np.radians(float(view[view.index("-vh") + 1])) / 2)
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    x, y = np.moveaxis((np.indices((width, width))[::-1].T.swapaxes(0, 1) + rng.random((width, width, 2))), -1, 0)
    x, y = (wide * (2 * each / width - 1) for each in (x, y))
    directions = ahead + x[..., None] * right - y[..., None] * np.cross(right, ahead)
    return np.concatenate([np.broadcast_to(origin, directions.shape), directions], -1)


def traced(octree, bundle, depth):
    command = [HOME / "bin/rtrace", *RTRACE.split(), "-ab", depth, "-lr", depth, octree]
    done = subprocess.run(command, input=bundle.astype("<f8").tobytes(), stdout=subprocess.PIPE, check=True)
    return np.frombuffer(done.stdout, "<f4")


if __name__ == "__main__":
    main()

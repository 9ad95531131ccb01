"""Radiance's `rtrace`: every ray meets its own ring between the two media, and `-otdW` prints the rays that follow.

With `fresnel` the answer is the weight of the reflected ray.

A ring has a given normal; a polygon would compute one from its corners. The rings are far apart and so small that no
ray meets another ray's ring.
"""

import os
import subprocess
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pyradiance
import table

RADIUS, START = 1e-5, 1e-2
OPTIONS = ["-w", "-h", "-fdd", "-lr", "1", "-lw", "0", "-otdW"]  # only direct children of the rays, however weak
RECORD = 48  # bytes: a direction and a weight, three numbers each
FOLDER = Path(pyradiance.__file__).parent
# An interface: colour and index of its inside, then of its outside, where the ring's normal points. Rays come from the
# inside, for which rtrace divides n_from by n_to; from the outside it would take the reciprocal of the other ratio.
RING = """void interface m{i}\n0\n0\n8 1 1 1 {n_from!r} 1 1 1 {n_to!r}
m{i} ring r{i}\n0\n0\n8 {x!r} {y!r} {z!r} {nx!r} {ny!r} {nz!r} 0 {radius}\n"""


def run(command, *arguments, stdin=None):
    program = [str(FOLDER / "bin" / command), *arguments]
    return subprocess.run(program, input=stdin, stdout=subprocess.PIPE, check=True).stdout


def scene(rays, centres):
    rows = zip((-rays.n).tolist(), rays.n_from.tolist(), rays.n_to.tolist(), centres.tolist(), strict=True)
    return "".join(
        RING.format(i=i, n_from=n_from, n_to=n_to, nx=n[0], ny=n[1], nz=n[2], x=c[0], y=c[1], z=c[2], radius=RADIUS)
        for i, (n, n_from, n_to, c) in enumerate(rows)
    )


def answers(out, rays):
    """Return each ray's child behind its ring, or the reflected child if its weight is 1, or NaN; and the weight of the
    reflected child, or NaN.

    `-t` prints children before their parent, each after a tab, in binary output too. A ray's own record has its
    direction and weight 1.
    """
    b, weights, position = np.full((len(rays), 3), np.nan), np.full(len(rays), np.nan), 0
    for i, (a, n) in enumerate(zip(rays.a, rays.n, strict=True)):
        while not _is(_record(out, position), a):
            if out[position : position + 1] != b"\t":
                raise SystemExit(f"rtrace: ray {i} of {len(rays)} did not come back")
            child = _record(out, position + 1)
            if child[:3] @ n < 0 or child[3] == 1:
                b[i] = child[:3]
            if child[:3] @ n > 0:
                weights[i] = child[3]
            position += 1 + RECORD
        position += RECORD
    return b, weights


def _record(out, position):
    return np.frombuffer(out[position : position + RECORD].ljust(RECORD, b"\0"))


def _is(record, a):
    return record[3] == 1 and np.abs(record[:3] - a / np.linalg.norm(a)).max() < 1e-9


os.environ["RAYPATH"] = str(FOLDER / "lib")
rays = table.Rays("float64")
centres = table.apart(rays)
with tempfile.TemporaryDirectory() as folder:
    (Path(folder) / "scene.rad").write_text(scene(rays, centres))
    (Path(folder) / "scene.oct").write_bytes(run("oconv", f"{folder}/scene.rad"))
    starts = np.concatenate([centres - START * rays.a, rays.a], axis=1)
    out = run("rtrace", *OPTIONS, f"{folder}/scene.oct", stdin=starts.tobytes())
system, (b, weights) = f"Radiance, pyradiance {version('pyradiance')}", answers(out, rays)
if sys.argv[1:] == ["fresnel"]:
    table.write_fresnel(system, mean=weights)
else:
    table.write(rays, b, system)

"""Rays in and answers out, as CSV: what all scripts of this folder share. Needs numpy, and nothing of mi_refract.

In: `#` lines, then `id,ax,ay,az,nx,ny,nz,n_from,n_to` and a ray per line: the direction toward the surface, a normal on
either side of it, the indices of the medium that the ray leaves and of the one it enters. Out: `id,bx,by,bz`, and
`transmitted` where the program gives it.
"""

import sys

import numpy as np


class Rays:
    """`a` and `n` (N, 3) with the normal turned against the ray, `n_from` and `n_to` (N,), `k` = n_from/n_to."""

    def __init__(self, precision, stream=None):
        lines = [line for line in stream or sys.stdin if line.strip() and not line.startswith("#")]
        names = [name.strip() for name in lines[0].split(",")]
        columns = dict(zip(names, zip(*(line.split(",") for line in lines[1:]), strict=True), strict=True))
        self.ids = columns["id"]
        wide = {name: np.array(x, np.float64) for name, x in columns.items() if name != "id"}
        a, n = (np.stack([wide[v + axis] for axis in "xyz"], axis=1) for v in "an")
        # In double precision, where products of float32 are exact: which side a ray is on is not what is judged.
        n = np.where((a * n).sum(1, keepdims=True) > 0, -n, n)
        self.a, self.n, self.n_from, self.n_to = (x.astype(precision) for x in (a, n, wide["n_from"], wide["n_to"]))
        self.k = self.n_from / self.n_to

    def __len__(self):
        return len(self.ids)


def apart(rays):
    """(N, 3) places for as many small things: about 1 from each other, and in no row that a ray could run along."""
    side = int(np.ceil(len(rays) ** (1 / 3)))
    grid = np.stack(np.unravel_index(np.arange(len(rays)), (side,) * 3), axis=1)
    return grid + np.random.default_rng(0).uniform(-0.25, 0.25, grid.shape)


def frames(n):
    """(N, 3, 3): rotations that take (0, 0, 1) to n, to rounding; by Duff et al. 2017, as in Mitsuba."""
    x, y, z = n.T
    sign = np.copysign(1.0, z)
    over = -1 / (sign + z)
    first = np.stack([1 + sign * x * x * over, sign * x * y * over, -sign * x], axis=1)
    second = np.stack([x * y * over, sign + y * y * over, -y], axis=1)
    return np.stack([first, second, n], axis=2)


def write(rays, b, system, transmitted=None):
    """Answers to stdout, to the last bit. `system`: the name and version of what computed them.

    `transmitted` (N,): whether, where the direction does not tell.
    """
    print(f"# system: {' '.join(system.split())}")
    print("id,bx,by,bz" + ("" if transmitted is None else ",transmitted"))
    flags = [""] * len(rays) if transmitted is None else [f",{int(flag)}" for flag in transmitted]
    for name, (x, y, z), flag in zip(rays.ids, np.asarray(b, np.float64).tolist(), flags, strict=True):
        print(f"{name},{x!r},{y!r},{z!r}{flag}")

"""Reads rays and writes answers as CSV, for all scripts of this folder. Needs numpy, and nothing of mi_refract.

In: `#` lines, then `id,ax,ay,az,nx,ny,nz,n_from,n_to` and one ray per line: the direction toward the surface, a normal
on either side, the indices of the medium that the ray leaves and of the one it enters. Out: `id,bx,by,bz`, and
`transmitted` if the program returns it.

Rays between glasses have a line `# media: [[from, to], …]` as JSON, and the columns `wavelength`, in nm, and `medium`,
the number of the pair. A medium is CATALOGUE:NAME, or air. The program looks up its own indices; n_from and n_to of the
file are ignored. Out: `id,bx,by,bz,n_ratio`.
"""

import json
import sys

import numpy as np


class Rays:
    """Rays: `a` and `n` (N, 3), with normals that face the rays, `n_from` and `n_to` (N,), `k` = n_from/n_to.

    With `index(catalogue, name, wavelength)`: rays between glasses, whose indices it returns; air has the index 1. They
    also have `wavelength` (N,) in nm, and the names of the media, `left` and `entered`.
    """

    def __init__(self, precision, index=None):
        text = sys.stdin.read().splitlines()
        names, *rows = (line.split(",") for line in text if line.strip() and not line.startswith("#"))
        columns = dict(zip(map(str.strip, names), zip(*rows, strict=True), strict=True))
        self.ids = columns["id"]
        wide = {name: np.array(x, np.float64) for name, x in columns.items() if name != "id"}
        a, n = (np.stack([wide[v + axis] for axis in "xyz"], axis=1) for v in "an")
        # In double precision, where products of float32 are exact: the side of a ray is not what is judged.
        n = np.where((a * n).sum(1, keepdims=True) > 0, -n, n)
        if index:
            media = json.loads(next(line for line in text if line.startswith("# media:")).partition(":")[2])
            self.wavelength = wide["wavelength"]
            self.left, self.entered = zip(*(media[int(pair)] for pair in wide["medium"]), strict=True)
            wide["n_from"], wide["n_to"] = (self._indices(index, names) for names in (self.left, self.entered))
        self.a, self.n, self.n_from, self.n_to = (x.astype(precision) for x in (a, n, wide["n_from"], wide["n_to"]))
        self.k = self.n_from / self.n_to
        self.between_glasses = bool(index)

    def __len__(self):
        return len(self.ids)

    def _indices(self, index, names):
        pairs = list(zip(names, self.wavelength.tolist(), strict=True))
        known = {(name, w): 1.0 if name == "air" else float(index(*name.split(":"), w)) for name, w in set(pairs)}
        return np.array([known[pair] for pair in pairs])

    def each(self):
        """Return (a, n, n_from, n_to) of every ray: two arrays and two Python floats."""
        return zip(self.a, self.n, self.n_from.tolist(), self.n_to.tolist(), strict=True)


def apart(rays):
    """Return (N, 3) positions for N small objects: about 1 apart, and not in rows that a ray could follow."""
    side = int(np.ceil(len(rays) ** (1 / 3)))
    grid = np.stack(np.unravel_index(np.arange(len(rays)), (side,) * 3), axis=1)
    return grid + np.random.default_rng(0).uniform(-0.25, 0.25, grid.shape)


def frames(n):
    """Return rotations (N, 3, 3) that map (0, 0, 1) to n, up to rounding; by Duff et al. 2017, as in Mitsuba."""
    x, y, z = n.T
    sign = np.copysign(1.0, z)
    over = -1 / (sign + z)
    first = np.stack([1 + sign * x * x * over, sign * x * y * over, -sign * x], axis=1)
    second = np.stack([x * y * over, sign + y * y * over, -y], axis=1)
    return np.stack([first, second, n], axis=2)


def write(rays, b, system, transmitted=None):
    """Print answers on stdout, exact to the last bit. `system`: name and version of the program that computed them.

    `transmitted` (N,): given if the direction does not show it.
    """
    print(f"# system: {' '.join(system.split())}")
    columns = [("id", rays.ids)]
    columns += zip(("bx", "by", "bz"), (map(repr, x) for x in np.asarray(b, np.float64).T.tolist()), strict=True)
    if transmitted is not None:
        columns.append(("transmitted", [str(int(flag)) for flag in transmitted]))
    if rays.between_glasses:
        columns.append(("n_ratio", map(repr, rays.k.tolist())))
    names, values = zip(*columns, strict=True)
    print("\n".join(map(",".join, [names, *zip(*values, strict=True)])))


def write_fresnel(system, **answers):
    """Print, as JSON on stdout, what a boundary reflects of each ray, by name, in the order of the rays.

    `s`, `p`: reflectance of each polarisation. `mean`: of unpolarised light, if these are unknown. `phase`: of the p
    over the s wave, in radians, with p = −s at normal incidence.
    """
    print(json.dumps({"system": system, **{name: np.asarray(x, float).tolist() for name, x in answers.items()}}))

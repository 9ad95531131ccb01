"""Rays in and answers out, as CSV: what all scripts of this folder share. Needs numpy, and nothing of mi_refract.

In: `#` lines, then `id,ax,ay,az,nx,ny,nz,n_from,n_to` and a ray per line: the direction toward the surface, a normal on
either side of it, the indices of the medium that the ray leaves and of the one it enters. Out: `id,bx,by,bz`, and
`transmitted` where the program gives it.

Rays between glasses have a line `# media: [[from, to], …]` as JSON, and the columns `wavelength`, in nm, and `medium`,
the number of the pair. A medium is CATALOGUE:NAME, or air. The program looks up its own indices; n_from and n_to of the
file are not read. Out: `id,bx,by,bz,n_ratio`.
"""

import json
import sys

import numpy as np


class Rays:
    """`a` and `n` (N, 3) with the normal turned against the ray, `n_from` and `n_to` (N,), `k` = n_from/n_to.

    With `index(catalogue, name, wavelength)`: rays between glasses, whose indices are those that it returns; air has
    the index 1. They also have `wavelength` (N,) in nm, and `left` and `entered`: the names of the media.
    """

    def __init__(self, precision, index=None):
        text = sys.stdin.read().splitlines()
        names, *rows = (line.split(",") for line in text if line.strip() and not line.startswith("#"))
        columns = dict(zip(map(str.strip, names), zip(*rows, strict=True), strict=True))
        self.ids = columns["id"]
        wide = {name: np.array(x, np.float64) for name, x in columns.items() if name != "id"}
        a, n = (np.stack([wide[v + axis] for axis in "xyz"], axis=1) for v in "an")
        # In double precision, where products of float32 are exact: which side a ray is on is not what is judged.
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
        """(a, n, n_from, n_to) of every ray: two arrays and two Python floats."""
        return zip(self.a, self.n, self.n_from.tolist(), self.n_to.tolist(), strict=True)


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
    columns = [("id", rays.ids)]
    columns += zip(("bx", "by", "bz"), (map(repr, x) for x in np.asarray(b, np.float64).T.tolist()), strict=True)
    if transmitted is not None:
        columns.append(("transmitted", [str(int(flag)) for flag in transmitted]))
    if rays.between_glasses:
        columns.append(("n_ratio", map(repr, rays.k.tolist())))
    names, values = zip(*columns, strict=True)
    print("\n".join(map(",".join, [names, *zip(*values, strict=True)])))


def write_fresnel(system, **found):
    """To stdout, as JSON: what a boundary reflects of each ray, by name, in the order of the rays.

    `s`, `p`: shares of the power of each polarisation. `mean`: of unpolarised light, where these are not known.
    `phase`: of the p over the s wave, in radians, where p is −s at normal incidence.
    """
    print(json.dumps({"system": system, **{name: np.asarray(x, float).tolist() for name, x in found.items()}}))

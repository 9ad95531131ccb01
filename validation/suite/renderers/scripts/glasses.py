"""Rays with glasses and wavelengths in, answers with the ratio of indices out: what the scripts of catalogues share.

In: as of `table`, with a line `# media: [[from, to], …]` as JSON and the columns `wavelength`, in nm, and `medium`, the
number of the pair. A medium is CATALOGUE:NAME, or air. The program looks up its own indices; n_from and n_to of the
file are not read. Out: `id,bx,by,bz,n_ratio`.
"""

import io
import json
import sys

import numpy as np
import table


class Rays(table.Rays):
    """As of `table`, with `n_from`, `n_to` and `k` by `index(catalogue, name, wavelength)`; air has the index 1.

    `wavelength` (N,) in nm; `left` and `entered`: the names of the media.
    """

    def __init__(self, index):
        text = sys.stdin.read()
        super().__init__("float64", io.StringIO(text))
        lines = text.splitlines()
        media = json.loads(next(line for line in lines if line.startswith("# media:")).partition(":")[2])
        names, *rows = (line.split(",") for line in lines if line.strip() and not line.startswith("#"))
        at, medium = names.index("wavelength"), names.index("medium")
        asked = [(float(row[at]), *media[int(row[medium])]) for row in rows]
        known = {(w, name): _index(index, name, w) for w, *pair in asked for name in pair}
        wavelength, self.left, self.entered = zip(*asked, strict=True)
        self.wavelength = np.array(wavelength)
        self.n_from = np.array([known[w, left] for w, left, _ in asked])
        self.n_to = np.array([known[w, entered] for w, _, entered in asked])
        self.k = self.n_from / self.n_to


def _index(index, name, wavelength):
    return 1.0 if name == "air" else float(index(*name.split(":"), wavelength))


def write(rays, b, system):
    """Answers to stdout, to the last bit. `system`: the name and version of what computed them."""
    print(f"# system: {' '.join(system.split())}")
    print("id,bx,by,bz,n_ratio")
    for name, (x, y, z), k in zip(rays.ids, np.asarray(b, np.float64).tolist(), rays.k.tolist(), strict=True):
        print(f"{name},{x!r},{y!r},{z!r},{k!r}")

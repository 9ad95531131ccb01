"""batoid's `Plane.refract` in double precision: each ray meets its own plane, rotated to have the ray's normal.

batoid transforms the ray to the frame of that plane, where the normal is (0, 0, 1), and answers in this frame; this
script transforms it back. Its rays have a velocity of 1/index. With `glasses` the media are its only named glasses:
`apochromats/donsoptikz1.yaml`, a telescope, has lenses of Schott's glasses. batoid reads them as `SellmeierMedium` and
looks up the index by each ray's wavelength.
"""

import sys
from importlib.metadata import version
from pathlib import Path

import batoid
import numpy as np
import table

LENSES = {"SCHOTT:N-LAK10": "L1", "SCHOTT:N-BK7": "L3"}


def refract(a, frame, n_from, n_to, left, entered, wavelength):
    """Return the direction behind a plane through the origin; NaN if batoid marks the ray as failed."""
    ray = batoid.RayVector(*-a, *(a / n_from), wavelength=wavelength)
    batoid.Plane().refract(ray, left, entered, coordSys=batoid.CoordSys(rot=frame))
    return np.full(3, np.nan) if ray.failed[0] else frame @ ray.v[0] * n_to


if sys.argv[1:] == ["glasses"]:
    telescope = batoid.Optic.fromYaml(str(Path(batoid.datadir) / "apochromats" / "donsoptikz1.yaml"))
    glasses = {name: telescope[lens].medium for name, lens in LENSES.items()} | {"air": batoid.ConstMedium(1.0)}
    rays = table.Rays("float64", lambda maker, name, wavelength: glasses[f"{maker}:{name}"].getN(wavelength * 1e-9))
    media = [[glasses[name] for name in names] for names in (rays.left, rays.entered)]
    wavelengths = (rays.wavelength * 1e-9).tolist()
else:
    rays = table.Rays("float64")
    media = [[batoid.ConstMedium(n) for n in indices] for indices in (rays.n_from.tolist(), rays.n_to.tolist())]
    wavelengths = [0.0] * len(rays)
columns = rays.a, table.frames(-rays.n), rays.n_from.tolist(), rays.n_to.tolist(), *media, wavelengths
table.write(rays, [refract(*ray) for ray in zip(*columns, strict=True)], f"batoid {version('batoid')}")

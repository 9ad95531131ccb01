"""batoid's `Plane.refract` between glasses and air, with the only glasses by name that it has: those of one telescope.

`apochromats/donsoptikz1.yaml` calls the media of its lenses by Schott's names; batoid reads them as `SellmeierMedium`.
Rays are turned as in `batoid_rays.py`, and the media look up the index by each ray's wavelength.
"""

from importlib.metadata import version
from pathlib import Path

import batoid
import glasses
import numpy as np
import table

FILE = Path(batoid.datadir) / "apochromats" / "donsoptikz1.yaml"
LENSES = {"SCHOTT:N-LAK10": "L1", "SCHOTT:N-BK7": "L3"}
TELESCOPE = batoid.Optic.fromYaml(str(FILE))
MEDIA = {name: TELESCOPE[lens].medium for name, lens in LENSES.items()} | {"air": batoid.ConstMedium(1.0)}


def index(maker, name, wavelength):
    return MEDIA[f"{maker}:{name}"].getN(wavelength * 1e-9)


def refract(a, frame, wavelength, left, entered, n_from, n_to):
    """The direction behind a plane through the origin; of NaN where batoid says that the ray failed."""
    ray = batoid.RayVector(*-a, *(a / n_from), wavelength=wavelength * 1e-9)
    batoid.Plane().refract(ray, MEDIA[left], MEDIA[entered], coordSys=batoid.CoordSys(rot=frame))
    return np.full(3, np.nan) if ray.failed[0] else frame @ ray.v[0] * n_to


rays = glasses.Rays(index)
columns = zip(rays.wavelength.tolist(), rays.left, rays.entered, rays.n_from.tolist(), rays.n_to.tolist(), strict=True)
rows = zip(rays.a, table.frames(-rays.n), columns, strict=True)
glasses.write(rays, [refract(a, frame, *rest) for a, frame, rest in rows], f"batoid {version('batoid')}")

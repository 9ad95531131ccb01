"""Enough of raysect to run the script of an export, and to see what it would have rendered."""

import runpy
import sys
import types
from types import SimpleNamespace
from unittest import mock

import numpy as np


class Affine(np.ndarray):
    """AffineMatrix3D, and vectors and points: `*` is the product of matrices."""

    def __mul__(self, other):
        return (np.asarray(self) @ np.asarray(other)).view(Affine)


def translate(x, y, z):
    """raysect.core.translate."""
    made = np.eye(4)
    made[:3, 3] = x, y, z
    return made.view(Affine)


def rotate_basis(forward, up):
    """raysect.core.rotate_basis: +z becomes forward, +y the part of up at right angles to it."""
    forward = np.array(forward) / np.linalg.norm(forward)
    side = np.cross(up, forward)
    made, side = np.eye(4), side / np.linalg.norm(side)
    made[:3, :3] = np.transpose([side, np.cross(forward, side), forward])
    return made.view(Affine)


class Emitter:
    """UniformSurfaceEmitter."""

    def __init__(self, spectrum):
        self.spectrum = spectrum

    def evaluate_surface(self, *where):
        """What it emits, everywhere and on both sides."""
        return self.spectrum


class Pinhole:
    """PinholeCamera: what it was given."""

    def __init__(self, pixels, **given):
        self.pixels, self.given = pixels, given

    def _generate_rays(self, *place):
        return [("ray", 0.5)]


def run(folder, monkeypatch):
    """The script's names, with raysect's as far as it uses them; `made`: meshes and the sky."""
    made = SimpleNamespace(meshes={}, sky=None, seeds=[])

    def mesh(vertices, faces, smoothing, closed, parent, name):
        assert not smoothing and not closed
        made.meshes[name] = SimpleNamespace(triangles=np.asarray(vertices)[faces])
        return made.meshes[name]

    parts = {
        "": {},
        ".core": {"Vector3D": lambda *v: np.array(v), "rotate_basis": rotate_basis, "translate": translate},
        ".core.math": {"random": SimpleNamespace(seed=made.seeds.append)},
        ".core.workflow": {"SerialEngine": mock.Mock()},
        ".optical": {
            "ConstantSF": float,
            "InterpolatedSF": lambda x, y: dict(zip(x, y, strict=True)),
            "World": mock.Mock(),
        },
        ".optical.library": {"schott": lambda name: SimpleNamespace(index=f"of {name}")},
        ".optical.material": {
            "Dielectric": lambda index, transmission, outside: ("glass", index, transmission, outside),
            "Lambert": lambda colour: ("diffuse", colour),
            "UniformSurfaceEmitter": Emitter,
        },
        ".optical.observer": {"PinholeCamera": Pinhole}
        | dict.fromkeys(("FullFrameSampler2D", "SpectralRadiancePipeline2D"), mock.Mock()),
        ".primitive": {"Mesh": mesh, "Sphere": lambda radius, parent, material: setattr(made, "sky", material)},
    }
    for name, content in parts.items():
        module = types.ModuleType(f"raysect{name}")
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, module.__name__, module)
    return made, runpy.run_path(str(folder / "render.py"))

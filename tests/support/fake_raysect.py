"""A fake of raysect that runs the script of an export and records what it would render."""

import runpy
import sys
import types
from types import SimpleNamespace
from unittest import mock

import numpy as np


class Affine(np.ndarray):
    """`AffineMatrix3D`, vectors and points: `*` is the matrix product."""

    def __mul__(self, other):
        return (np.asarray(self) @ np.asarray(other)).view(Affine)


def translate(x, y, z):
    """`raysect.core.translate`."""
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix.view(Affine)


def rotate_basis(forward, up):
    """`raysect.core.rotate_basis`: +z becomes forward, +y the part of up perpendicular to it."""
    forward = np.array(forward) / np.linalg.norm(forward)
    side = np.cross(up, forward)
    matrix, side = np.eye(4), side / np.linalg.norm(side)
    matrix[:3, :3] = np.transpose([side, np.cross(forward, side), forward])
    return matrix.view(Affine)


class Emitter:
    """`UniformSurfaceEmitter`: the same spectrum everywhere and on both sides."""

    def __init__(self, spectrum):
        self.spectrum = spectrum

    def evaluate_surface(self, *arguments):
        return self.spectrum


class Pinhole:
    """`PinholeCamera`."""

    def __init__(self, pixels, **options):
        self.pixels = pixels

    def _generate_rays(self, *pixel):
        return [("ray", 0.5)]


def run(folder, monkeypatch):
    """Load the script of an export with a fake raysect; return recorded meshes, sky and seeds, and its names."""
    recorded = SimpleNamespace(meshes={}, sky=None, seeds=[])

    def mesh(vertices, faces, smoothing, closed, parent, name):
        assert not smoothing and not closed
        recorded.meshes[name] = SimpleNamespace(triangles=np.asarray(vertices)[faces])
        return recorded.meshes[name]

    modules = {
        "": {},
        ".core": {"Vector3D": lambda *v: np.array(v), "rotate_basis": rotate_basis, "translate": translate},
        ".core.math": {"random": SimpleNamespace(seed=recorded.seeds.append)},
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
        ".primitive": {"Mesh": mesh, "Sphere": lambda radius, parent, material: setattr(recorded, "sky", material)},
    }
    for name, content in modules.items():
        module = types.ModuleType(f"raysect{name}")
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, module.__name__, module)
    return recorded, runpy.run_path(str(folder / "render.py"))

"""Enough of raysect to run the script of an export, and to see what it would have rendered."""

import runpy
import sys
import types
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
    side /= np.linalg.norm(side)
    made = np.eye(4)
    made[:3, :3] = np.transpose([side, np.cross(forward, side), forward])
    return made.view(Affine)


class Emitter:
    """UniformSurfaceEmitter."""

    def __init__(self, spectrum):
        self.spectrum = spectrum

    def evaluate_surface(self, world, ray, primitive, hit_point, exiting, *others):
        """What it emits, everywhere and on both sides."""
        return self.spectrum


class Pinhole:
    """PinholeCamera: what it was given."""

    def __init__(self, pixels, **given):
        self.pixels, self.given = pixels, given

    def _generate_rays(self, *place):
        return [("ray", 0.5)]


def run(folder, monkeypatch, *words):
    """The script's names, with raysect's as far as it uses them; `made`: meshes and the sky."""
    made = types.SimpleNamespace(meshes={}, sky=None, seeds=[])

    def mesh(vertices, faces, smoothing, closed, parent, name):
        assert not smoothing and not closed
        made.meshes[name] = types.SimpleNamespace(triangles=np.asarray(vertices)[faces])
        return made.meshes[name]

    def sphere(radius, parent, material):
        made.sky = material

    parts = {
        "core": {"Vector3D": lambda *v: np.array(v), "rotate_basis": rotate_basis, "translate": translate},
        "core.math": {"random": types.SimpleNamespace(seed=made.seeds.append)},
        "core.workflow": {"SerialEngine": mock.Mock()},
        "optical": {
            "ConstantSF": float,
            "InterpolatedSF": lambda x, y: dict(zip(x, y, strict=True)),
            "World": mock.Mock(),
        },
        "optical.library": {"schott": lambda name: types.SimpleNamespace(index=f"of {name}")},
        "optical.material": {
            "Dielectric": lambda index, transmission, outside: ("glass", index, transmission, outside),
            "Lambert": lambda colour: ("diffuse", colour),
            "UniformSurfaceEmitter": Emitter,
        },
        "optical.observer": {
            "FullFrameSampler2D": mock.Mock(),
            "PinholeCamera": Pinhole,
            "SpectralRadiancePipeline2D": mock.Mock(),
        },
        "primitive": {"Mesh": mesh, "Sphere": sphere},
    }
    for name, content in ({"": {}} | parts).items():
        module = types.ModuleType(f"raysect.{name}".rstrip("."))
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, module.__name__, module)
    return made, runpy.run_path(str(folder / "render.py"))

"""A fake of Blender's Python that runs the script of a Cycles export and records what it would render."""

import runpy
import sys
from types import SimpleNamespace
from unittest import mock

import numpy as np


class Vector(np.ndarray):
    """`mathutils.Vector`, and `mathutils.Matrix` of rows."""

    def __new__(cls, values):
        return np.array(values, float).view(cls)

    def normalized(self):
        return self / np.linalg.norm(self)

    def cross(self, other):
        return Vector(np.cross(self, other))

    def to_track_quat(self, track, up):
        """Return a rotation from −z to this direction."""
        assert (track, up) == ("-Z", "Y")
        back = -self.normalized()
        right = Vector(np.cross(np.eye(3)[np.argmin(np.abs(back))], back)).normalized()
        return SimpleNamespace(to_matrix=lambda: Vector(np.stack([right, np.cross(back, right), back], axis=1)))

    def transposed(self):
        return self.T

    def to_4x4(self):
        return np.block([[np.asarray(self), np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])

    @staticmethod
    def Translation(offset):
        matrix = np.eye(4)
        matrix[:3, 3] = offset
        return matrix


class Sockets(dict):
    """Inputs or outputs of a node by name or number, created on first access."""

    def __init__(self, node):
        super().__init__()
        self.node = node

    def __missing__(self, key):
        self[key] = SimpleNamespace(node=self.node, key=key, default_value=None)
        return self[key]


class Tree:
    """A tree of shader nodes."""

    def __init__(self):
        self.made, self.sources = [], {}
        self.nodes = SimpleNamespace(new=self._new, clear=self.made.clear)
        self.links = SimpleNamespace(new=lambda source, to: self.sources.update({(id(to.node), to.key): source}))

    def _new(self, kind):
        node = SimpleNamespace(kind=kind)
        node.inputs, node.outputs = Sockets(node), Sockets(node)
        self.made.append(node)
        return node

    def source(self, node, key):
        """Return the node and the output that are linked to an input."""
        socket = self.sources[id(node), key]
        return socket.node, socket.key

    def only(self, kind):
        """Return the only node of a kind."""
        (node,) = (node for node in self.made if node.kind == kind)
        return node


def collection(**attributes):
    """Return a collection as Blender has: `new(name, …)` creates an item and stores it in `made`."""
    made = {}

    def new(name, *arguments):
        made[name] = SimpleNamespace(**{key: make(*arguments) for key, make in attributes.items()})
        return made[name]

    return SimpleNamespace(new=new, made=made)


def installed(monkeypatch):
    """Install a fake `bpy` for scripts to import, and return it; `bpy.rendered`: seeds and files."""
    bpy = mock.MagicMock(rendered=[])
    scene = bpy.context.scene
    bpy.ops.render.render = lambda write_still: bpy.rendered.append((scene.cycles.seed, scene.render.filepath))
    bpy.data.materials, bpy.data.worlds = collection(node_tree=Tree), collection(node_tree=Tree)
    bpy.data.meshes, bpy.data.cameras = collection(materials=list, from_pydata=mock.Mock), collection()
    bpy.data.lights = collection(kind=lambda kind: kind)
    bpy.data.objects = collection(data=lambda data: data)
    monkeypatch.setitem(sys.modules, "bpy", bpy)
    monkeypatch.setitem(sys.modules, "mathutils", SimpleNamespace(Vector=Vector, Matrix=Vector))
    return bpy


def run(folder, monkeypatch, *words):
    """Run the script of an export with these options and return `bpy`."""
    bpy = installed(monkeypatch)
    monkeypatch.setattr(sys, "argv", ["render.py", "--spp", "3", "--out", str(folder), *words])
    runpy.run_path(str(folder / "render.py"))["main"]()
    return bpy

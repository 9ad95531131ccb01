"""Small renders in passes, for tests."""

from __future__ import annotations

import numpy as np
import pytest

from mi_refract import SCENES
from mi_refract.io.image_file import read_exr
from mi_refract.rendering.end_conditions import Limits
from mi_refract.rendering.long_render import Job, resume
from mi_refract.rendering.pass_sums import PassSums, PassTree

# 8 × 6 pixels of a sphere of glass and a cube.
GLASS = """<scene version="3.0.0">
  <default name="bsdf" value="refract"/>
  <integrator type="path"><integer name="max_depth" value="5"/></integrator>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0,1,-4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/></film>
    <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
  </sensor>
  <emitter type="constant"/>
  <shape type="sphere"><bsdf type="$bsdf"/></shape>
  <shape type="cube"><transform name="to_world"><translate x="1" y="1.5"/></transform></shape>
</scene>"""
BALL, SMALL = SCENES / "sphere.xml", {"res": "8"}


def rendering(output, seed=0, scene=BALL, defines=SMALL, restart=False, **limits):
    """Return a new or resumed render of 8 × 8 pixels."""
    return resume(Job(scene, defines, seed), output, Limits(**limits), restart=restart)


def pixels(path):
    """Return the pixels of an EXR file."""
    return read_exr(path)[0]


class Stop(Exception):
    """Raised to end a render."""


def stopped_after(render, passes):
    """Run a render, and end it after so many passes."""

    def watch(render):
        if render.progress.passes == passes:
            raise Stop

    with pytest.raises(Stop):
        render.run(watch)


def leaf(image, spp=4, within=None):
    """Return the sums of one pass with this image."""
    image = np.asarray(image, np.float32).astype(np.float64)
    return PassSums(spp, 1, image * spp, np.zeros_like(image), within, colours=min(3, image.shape[-1]))


def tree_of(images):
    tree = PassTree()
    for image in images:
        tree.add(leaf(image))
    return tree

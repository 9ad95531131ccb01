"""Small renders in passes, for tests."""

from __future__ import annotations

from pathlib import Path

from mi_refract.io.image_file import read_exr
from mi_refract.rendering.end_conditions import Limits
from mi_refract.rendering.long_render import Job, resume

SCENES = Path(__file__).parents[2] / "scenes"
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

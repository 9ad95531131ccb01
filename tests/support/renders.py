"""Small renders in passes, for tests."""

from __future__ import annotations

from pathlib import Path

from mi_refract.io.image_file import read_exr
from mi_refract.rendering.end_conditions import Limits
from mi_refract.rendering.long_render import Job, resume

SCENES = Path(__file__).parents[2] / "scenes"
BALL, SMALL = SCENES / "sphere.xml", {"res": "8"}


def rendering(output, seed=0, scene=BALL, defines=SMALL, restart=False, **limits):
    """A render of 8 × 8 pixels."""
    return resume(Job(scene, defines, seed), output, Limits(**limits), restart=restart)


def pixels(path):
    """Of an EXR file."""
    return read_exr(path)[0]

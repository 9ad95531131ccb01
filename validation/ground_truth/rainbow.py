"""The rainbow of one drop, rendered: sunlight traced onto a screen, and the angle of its bright edge.

A disk of parallel light illuminates a drop; a camera beside the drop looks back at a screen ten million radii away, on
which particle tracing collects the light that left the drop. At this distance a position in the image is an angle, up
to 3e-7. Near the minimum deflection D₀ a ray is deflected by D = D₀ + a δ² + …, where δ is the distance of its entry
from that of the stationary ray. The light C(D) that is deflected by less than D comes from two intervals of δ, in which
the odd powers of δ cancel. Hence

    C² = s (D − D₀) + q (D − D₀)² + …

and a parabola fitted to D as a function of C² gives the rainbow angle at C = 0. Light of other paths is smooth there;
its density is measured in the dark band before the edge and subtracted.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from validation.reference import closed_forms
from validation.reference.optical_systems import Array

INDEX = np.longdouble(1.333)
SIZE = 1536  # width of the image in pixels, for 90 degrees: 0.041 degrees per pixel at the edge
SCREEN = 1e7  # distance of the screen in radii of the drop
DARK, LIT = (136.5, 137.7), 140.0  # degrees: a part of the dark band, and the end of the measured part
STEP = 0.01  # degrees
# The fitted interval in degrees behind the edge. Nearer, pixels blur the edge: with σ² = 0.041²/12, C² is smaller by
# s σ²/4(D − D₀). Farther, the cubic term matters.
WINDOW = 0.1, 1.0


def angle(index: Any = INDEX) -> float:
    """Return D₀ in degrees."""
    return float(np.rad2deg(closed_forms.deflection(closed_forms.rainbow_incidence(index, 1), index, 1)))


def images(glass: dict[str, Any], seeds: int) -> list[Array]:
    """Render images of SIZE × SIZE pixels, with one light path per pixel and seed, of a drop of this glass."""
    import mitsuba as mi

    move = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "pixel_format": "luminance"}
    film |= {"component_format": "float32", "rfilter": {"type": "box"}}
    view = move().look_at(origin=[0, 0, 2], target=[0, 0, -1], up=[0, 1, 0])
    sun = {"type": "disk", "to_world": move().translate([0, 0, -2]), "light": {"type": "directionalarea"}}
    far = move().translate([0, 0, -SCREEN]).scale(2 * SCREEN)
    camera = {"type": "perspective", "fov": 90, "near_clip": 1, "far_clip": 10 * SCREEN, "to_world": view, "film": film}
    scene: Any = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "ptracer", "max_depth": 5, "rr_depth": 5},  # in, inside, out, and the screen
            "drop": {"type": "sphere", "bsdf": glass},
            "sun": sun | {"bsdf": {"type": "diffuse", "reflectance": 0.0}},
            "screen": {"type": "rectangle", "to_world": far, "bsdf": {"type": "diffuse"}},
            "camera": camera,
        }
    )
    return [np.array(mi.render(scene, spp=1, seed=seed), float)[..., 0] for seed in range(seeds)]


@functools.cache
def _bins() -> tuple[Array, Array, Array]:
    """Return the upper ends of the bins of deflection, which pixels are in a bin, and the bins of these pixels."""
    ends = np.arange(DARK[0], LIT, STEP) + STEP
    x = (np.arange(SIZE) + 0.5) / (SIZE / 2) - 1
    deflection = 180 - np.rad2deg(np.arctan(np.hypot(x[:, None], x)))
    at = np.floor((deflection - DARK[0]) / STEP).astype(int)
    inside = (at >= 0) & (at < len(ends))
    return ends, inside, at[inside]


def edge(image: Array) -> float:
    """Return the angle of the rainbow's edge in degrees; NaN without an edge."""
    ends, inside, at = _bins()
    light = np.bincount(at, image[inside], len(ends))
    gathered = np.cumsum(light - light[ends <= DARK[1]].mean())
    estimate = float(ends[light.argmax()])
    for _ in range(3):
        window = (ends > estimate + WINDOW[0]) & (ends < estimate + WINDOW[1])
        square = np.maximum(gathered[window], 0) ** 2
        if len(square) < 3 or not square.all():
            return float("nan")
        square /= square.max()
        # The variance of a count is the count: that of C² is proportional to C³, and that of D accordingly.
        estimate = float(np.polyfit(square, ends[window], 2, w=square**-0.75)[-1])
    return estimate

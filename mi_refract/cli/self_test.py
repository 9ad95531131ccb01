"""The command `mi-refract self-test`: which defects does a comparison of images detect?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from mi_refract.image_diff.text_reports import print_table
from mi_refract.io.image_file import MAX_VALUES

from .diff import MaxValues, require_extra
from .doctor import activate

RENDERS, SPP = 16, 16
RESOLUTION = 64
SCENE = ".xml"

Images = Annotated[
    Path | None,
    typer.Argument(
        metavar="REFERENCE", help="An image, a folder of renders of one image, or a scene. Default: a glass ball."
    ),
]
AllowPlugins = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME", help="Also allow this plugin, which ships with the scene; may be repeated."),
]


def self_test(reference: Images = None, max_values: MaxValues = MAX_VALUES, allow_plugins: AllowPlugins = None) -> None:
    """Inject synthetic defects into REFERENCE and report which methods detect them.

    Exit code 0: every defect that had to be detected was detected, 1: one was missed, or equal images were reported as
    different, 2: REFERENCE cannot be read.
    """
    from mi_refract.image_diff import self_test as self_tests

    require_extra("scipy")
    is_scene = reference is not None and reference.suffix == SCENE
    if allow_plugins and not is_scene:
        raise ValueError("--allow-plugins applies to scenes only; expected a scene SCENE.xml as REFERENCE")
    if reference is not None and not is_scene:
        renders = self_tests.read_images(reference, max_values)
    else:
        from mi_refract.rendering.scene_files import load_scene

        activate()
        import mitsuba as mi

        scene = load_scene(reference, allow_plugins=allow_plugins or ()) if reference else mi.load_dict(_glass_ball())
        renders = np.stack([np.array(mi.render(scene, spp=SPP, seed=seed)) for seed in range(RENDERS)])
    rows = self_tests.examine(renders, str(reference or "a glass ball"))
    print_table(self_tests.table(rows))
    print("\n".join(self_tests.summary(rows)))
    raise typer.Exit(int(any(row.verdict == "fail" for row in rows)))


def _glass_ball() -> dict[str, Any]:
    """A scene: a glass ball on a floor under a sky and a lamp."""
    import mitsuba as mi

    look_at = mi.ScalarTransform4f().look_at
    film = {"width": RESOLUTION, "height": RESOLUTION, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    camera = look_at([0, -5, 2.5], [0, 0, 0.8], [0, 0, 1])
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 16, "rr_depth": 16},
        "sensor": {"type": "perspective", "fov": 40, "to_world": camera, "film": {"type": "hdrfilm", **film}},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.6, 0.8, 1.0]}},
        "lamp": {
            "type": "rectangle",
            "to_world": look_at([3, -2, 5], [0, 0, 0], [0, 0, 1]),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [3.0, 2.5, 2.0]}},
        },
        "floor": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().scale(8),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "checkerboard"}},
        },
        "ball": {"type": "sphere", "center": [0, 0, 1], "bsdf": {"type": "refract"}},
    }

"""The command `mi-refract self-test`: which defects does a comparison of images detect?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from mi_refract.image_diff.text_reports import print_table
from mi_refract.io.image_file import MAX_VALUES

from .diff import MaxValues, require_extra
from .doctor import activate

RENDERS, SPP = 16, 16
SCENE = ".xml"

Images = Annotated[
    Path, typer.Argument(metavar="REFERENCE", help="An image, a folder of renders of one image, or a scene.")
]
AllowPlugins = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME", help="Also allow this plugin, which ships with the scene; may be repeated."),
]


def self_test(reference: Images, max_values: MaxValues = MAX_VALUES, allow_plugins: AllowPlugins = None) -> None:
    """Inject synthetic defects into REFERENCE and report which methods detect them.

    Exit code 0: every defect that had to be detected was detected, 1: one was missed, or equal images were reported as
    different, 2: REFERENCE cannot be read.
    """
    require_extra("scipy")
    from mi_refract.image_diff import self_test as self_tests

    if reference.suffix == SCENE:
        from mi_refract.rendering.scene_files import load_scene

        activate()
        import mitsuba as mi

        scene = load_scene(reference, allow_plugins=allow_plugins or ())
        renders = np.stack([np.array(mi.render(scene, spp=SPP, seed=seed)) for seed in range(RENDERS)])
    elif allow_plugins:
        raise ValueError("--allow-plugins applies to scenes only; expected a scene SCENE.xml as REFERENCE")
    else:
        renders = self_tests.read_images(reference, max_values)
    rows = self_tests.examine(renders, str(reference))
    print_table(self_tests.table(rows))
    print("\n".join(self_tests.summary(rows)))
    raise typer.Exit(int(any(row.verdict == "fail" for row in rows)))

"""Rendering a scene file into an EXR file that says how it was made."""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract.io.atomic import writable
from mi_refract.io.image_file import SUFFIXES, Metadata, one_line, write_exr
from mi_refract.io.provenance import provenance

TAKEN = ("config", "filename")  # names that mi.parser.parse_file would take for its own
REPRODUCIBLE: Any = {"parallel": False, "optimize": False}  # for mi.load_file, as scene_parser.load does
PIXELS = 2**26  # of an image; four channels of them are 1 GiB


def parse_defines(items: Sequence[str]) -> dict[str, str]:
    """`["bsdf=dielectric"]` → `{"bsdf": "dielectric"}`. ValueError for another syntax, or a name given twice."""
    defines: dict[str, str] = {}
    for item in items:
        name, equals, value = item.partition("=")
        if not equals or not re.fullmatch(r"[A-Za-z_]\w*", name):
            raise ValueError(f"-D {item}: accepted: NAME=VALUE")
        if name in defines:
            raise ValueError(f"-D {item}: {name} is given twice; accepted: once")
        defines[name] = value
    return defines


def load_scene(
    path: str | os.PathLike[str], defines: Mapping[str, str] | None = None, allow_plugins: Collection[str] = ()
) -> Any:
    """Load the Mitsuba scene in an XML file, in the present variant; `defines` replace values of its `<default>`s.

    A scene may bring plugins, which are code: none is loaded but those in `allow_plugins`, Mitsuba's own and ours.
    FileNotFoundError for a missing file; ValueError, in one line, for other plugins, a file beyond the limits of
    `mi_refract.plugins.scene_limits`, what Mitsuba does not accept, and a scene without a sensor.
    """
    import mitsuba as mi

    from mi_refract.plugins import scene_parser

    path, defines = Path(path), dict(defines or {})
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such scene file")
    if taken := [name for name in TAKEN if name in defines]:
        raise ValueError(f"define {taken[0]!r}: taken by Mitsuba's parser; accepted: any name but {TAKEN}")
    try:
        scene = scene_parser.load(path, defines, allow_plugins)
    except OSError:
        raise
    except Exception as error:  # RuntimeError from the parser; whatever a Python plugin raises
        raise ValueError(_naming(path, error)) from None
    if not isinstance(scene, mi.Scene):
        raise ValueError(f"{path}: holds a {type(scene).__name__}; accepted: a <scene>")
    if not scene.sensors():
        raise ValueError(f"{path}: a scene without a sensor; accepted: at least one")
    width, height = scene.sensors()[0].film().crop_size()
    if width * height > PIXELS:
        raise ValueError(f"{path}: a film of {width} × {height} pixels; accepted: up to {PIXELS}")
    return scene


def render_to_exr(
    scene: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    defines: Mapping[str, str] | None = None,
    spp: int | None = None,
    seed: int = 0,
    allow_plugins: Collection[str] = (),
) -> Metadata:
    """Render a scene file by one `mi.render(scene, spp=spp, seed=seed)`, and return the header of the EXR file.

    `defines`: values for the scene's `<default>`s. `spp`: samples per pixel; None: what the scene says.
    `allow_plugins`: names of plugins that the scene may bring, which are code. ValueError or OSError in one line,
    before the rendering where possible; InterruptedError for a rendering that was cut short. No file is written then.
    """
    import mitsuba as mi

    if spp is not None and not 1 <= spp < 2**32:
        raise ValueError(f"spp = {spp}: accepted: a whole number from 1 to 2³² − 1")
    if not 0 <= seed < 2**32:
        raise ValueError(f"seed = {seed}: accepted: a whole number from 0 to 2³² − 1")
    output = writable(output, SUFFIXES)
    loaded = load_scene(scene, defines, allow_plugins)
    pixels, seconds = _rendered(scene, loaded, spp or 0, seed)
    sensor = loaded.sensors()[0]
    channels = [str(field.name) for field in sensor.film().bitmap().struct_()]
    metadata: Metadata = provenance() | {
        "mi_refract:variant": mi.variant(),
        "mi_refract:spp": spp or sensor.sampler().sample_count(),
        "mi_refract:seed": seed,
        "mi_refract:scene": str(scene),
        "mi_refract:defines": json.dumps(dict(defines or {}), sort_keys=True),
        "mi_refract:formulas": ", ".join(formulas_in(loaded)) or "none",
        "mi_refract:render_seconds": seconds,
    }
    write_exr(output, pixels, channels, metadata)
    return metadata


def _rendered(path: str | os.PathLike[str], scene: Any, spp: int, seed: int) -> tuple[np.ndarray, float]:
    """The image of a scene read from `path`, and the seconds it took."""
    import mitsuba as mi

    start = time.perf_counter()
    try:
        pixels = np.array(mi.render(scene, spp=spp, seed=seed))
    except Exception as error:
        raise ValueError(_naming(path, error)) from None
    seconds = time.perf_counter() - start
    # On Ctrl-C the C++ integrators return what they have, and so they do after their `timeout`.
    if scene.integrator().should_stop():
        raise InterruptedError(f"{path}: the rendering was stopped before its last sample; nothing is written")
    return pixels, seconds


def formulas_in(scene: Any) -> list[str]:
    """The formulas of the `refract` BSDFs in a scene, sorted; "promoted (auto)" where the plugin chose it."""
    texts = (str(shape.bsdf()) for shape in scene.shapes())
    return sorted({name for text in texts for name in re.findall(r"Refract\[.*?formula = (.+?),\n", text, re.DOTALL)})


def _naming(path: str | os.PathLike[str], error: Exception) -> str:
    """The error as one line that names the file, without the line numbers of Mitsuba's source."""
    text = re.sub(r"\[\w+\.(cpp|h):\d+\] ", "", one_line(str(error)))
    text = re.sub(r"Traceback \(most recent call last\):.* (\w+Error: )", "", text)
    return text if str(path) in text else f"{path}: {text}"

"""Images in OpenEXR files, through OpenImageIO: writing, reading, and rendering into one.

A pixel array is H × W × C float32, row 0 at the top. A file appears complete or not at all.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import os
import re
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from .files import writable

Metadata = dict[str, Any]
SUFFIXES = (".exr",)
LOADER_OPTIONS = ("path", "parallel", "optimize")  # mi.load_file would take these names for its own
# Merged meshes come in the order of their addresses, and parallel loading in that of its threads. Then so do emitters,
# and a seed no longer means a picture.
REPRODUCIBLE: Any = {"parallel": False, "optimize": False}


def write_exr(
    path: str | os.PathLike[str],
    pixels: NDArray[np.floating[Any]],
    channels: Sequence[str] = ("R", "G", "B"),
    metadata: Mapping[str, str | int | float] | None = None,
) -> None:
    """Write H × W × C pixels as float32. One header attribute for each entry of `metadata`.

    Attributes keep str, int of 32 bits and float (to 24 bits); any other int becomes text. Replaces an existing file.
    ValueError for a shape that does not fit `channels`, a name that is not .exr, or an attribute of another type;
    OSError for a folder that cannot be written or a full disk. Nothing is left behind then.
    """
    path = writable(path, SUFFIXES)
    pixels = np.ascontiguousarray(pixels, dtype=np.float32)
    if pixels.ndim != 3 or pixels.size == 0 or pixels.shape[2] != len(channels):
        raise ValueError(f"{path}: pixels of shape {pixels.shape}; accepted: H × W × {len(channels)} {tuple(channels)}")
    if len(set(channels)) != len(channels):
        raise ValueError(f"{path}: channels {tuple(channels)}: accepted: distinct names")
    temporary = temporary_name(path)
    try:
        _write(temporary, pixels, channels, _attributes(path, metadata or {}))
        temporary.replace(path)
    except OSError as error:
        raise OSError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        temporary.unlink(missing_ok=True)


def temporary_name(path: str | os.PathLike[str]) -> Path:
    """Where this process writes before the rename: in the same folder, and .exr, by which OpenImageIO goes."""
    path = Path(path)
    return path.with_name(f".{path.stem}.{os.getpid()}.exr")


def _write(path: Path, pixels: NDArray[np.float32], channels: Sequence[str], attributes: Metadata) -> None:
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], "float")
    spec.channelnames = tuple(channels)
    for name, value in attributes.items():
        spec.attribute(name, value)
    output = oiio.ImageOutput.create(str(path))
    if output is None:
        raise OSError(_one_line(oiio.geterror()))
    done = output.open(str(path), spec) and output.write_image(pixels)
    message = output.geterror()
    if not (output.close() and done):
        raise OSError(_one_line(message or output.geterror()) or "OpenImageIO gives no reason")
    # On a full disk `close` is True all the same when the image was small enough for a buffer.
    try:
        complete = read_exr(path)[0].shape == pixels.shape
    except ValueError:
        complete = False
    if not complete:
        raise OSError("what was written cannot be read; is the disk full?")


def _attributes(path: Path, metadata: Mapping[str, str | int | float]) -> Metadata:
    for name, value in metadata.items():
        if not isinstance(value, (str, int, float)):
            raise ValueError(f"{path}: attribute {name} = {value!r}: accepted: str, int, float")
    return {n: str(v) if isinstance(v, int) and not -(2**31) <= v < 2**31 else v for n, v in metadata.items()}


def read_exr(path: str | os.PathLike[str]) -> tuple[NDArray[np.float32], Metadata]:
    """(pixels, metadata): H × W × C float32, and the header attributes with the channels' names under "channels".

    The order of channels is the file's as OpenImageIO gives it: R, G, B, A first, then by name.
    FileNotFoundError or OSError for a file that cannot be read, ValueError for one that is not a complete EXR image.
    """
    import OpenImageIO as oiio

    path = Path(path)
    with path.open("rb") as file:  # the operating system's own words for what is missing or forbidden
        if file.read(4) != b"\x76\x2f\x31\x01":
            raise ValueError(f"{path}: not an EXR file")
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise ValueError(f"{path}: corrupt EXR file: {_one_line(oiio.geterror())}")
    try:
        spec = source.spec()
        if spec.deep:
            raise ValueError(f"{path}: accepted: an EXR image without deep samples")
        pixels = source.read_image("float")
        message = source.geterror()
    finally:
        source.close()
    if pixels is None or message:
        raise ValueError(f"{path}: corrupt EXR file: {_one_line(message)}")
    metadata = {attribute.name: attribute.value for attribute in spec.extra_attribs}
    pixels = np.asarray(pixels, dtype=np.float32).reshape(spec.height, spec.width, spec.nchannels)
    return pixels, metadata | {"channels": tuple(spec.channelnames)}


# Rendering -----------------------------------------------------------------------------------------------------


def load_scene(path: str | os.PathLike[str], defines: Mapping[str, str] | None = None) -> Any:
    """The Mitsuba scene in an XML file, under the present variant; `defines` replace its `<default>`s.

    FileNotFoundError for a missing file; ValueError, in one line, for anything Mitsuba does not accept in it.
    """
    import mitsuba as mi

    defines = dict(defines or {})
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such scene file")
    if taken := [name for name in LOADER_OPTIONS if name in defines]:
        raise ValueError(f"define {taken[0]!r}: taken by Mitsuba's loader; accepted: any name but {LOADER_OPTIONS}")
    try:
        scene = mi.load_file(str(path), **REPRODUCIBLE, **cast(Any, defines))
    except Exception as error:  # RuntimeError from the parser; whatever a Python plugin raises
        raise ValueError(_naming(path, error)) from None
    if not isinstance(scene, mi.Scene):
        raise ValueError(f"{path}: holds a {type(scene).__name__}; accepted: a <scene>")
    if not scene.sensors():
        raise ValueError(f"{path}: a scene without a sensor; accepted: at least one")
    return scene


def render_to_exr(
    scene: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    defines: Mapping[str, str] | None = None,
    spp: int | None = None,
    seed: int = 0,
) -> Metadata:
    """Render a scene file by one `mi.render(scene, spp=spp, seed=seed)` in the present variant; the metadata written.

    `spp`: samples per pixel, the scene's own where None. ValueError or OSError in one line, before the rendering
    wherever possible, InterruptedError for a rendering that was cut short; then no file is written.
    """
    import mitsuba as mi

    if spp is not None and spp < 1:
        raise ValueError(f"spp = {spp}: accepted: a positive whole number")
    if not 0 <= seed < 2**32:
        raise ValueError(f"seed = {seed}: accepted: a whole number from 0 to 2³² − 1")
    output = writable(output, SUFFIXES)
    loaded = load_scene(scene, defines)
    start = time.perf_counter()
    try:
        pixels = np.array(mi.render(loaded, spp=spp or 0, seed=seed))
    except Exception as error:
        raise ValueError(_naming(scene, error)) from None
    seconds = time.perf_counter() - start
    # On Ctrl-C the C++ integrators return what they have, and so they do after their `timeout`.
    if loaded.integrator().should_stop():
        raise InterruptedError(f"{scene}: the rendering was stopped before its last sample; nothing is written")
    sensor = loaded.sensors()[0]
    channels = [str(field.name) for field in sensor.film().bitmap().struct_()]
    metadata = provenance() | {
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


def formulas_in(scene: Any) -> list[str]:
    """The formulas that the `refract` BSDFs of a scene use, sorted; "promoted (auto)" where it was not asked for."""
    texts = (str(shape.bsdf()) for shape in scene.shapes())
    return sorted({name for text in texts for name in re.findall(r"Refract\[.*?formula = (.+?),\n", text, re.DOTALL)})


def provenance() -> Metadata:
    """Header attributes that say which software made an image."""
    from . import __version__

    versions = {"mi_refract": __version__, "mitsuba": version("mitsuba"), "drjit": version("drjit")}
    return {"Software": f"mi_refract {__version__}"} | {f"mi_refract:version:{n}": v for n, v in versions.items()}


def version(distribution: str) -> str:
    """The installed version; "unknown" where it runs without being installed."""
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version(distribution)
    return "unknown"


def _naming(path: str | os.PathLike[str], error: Exception) -> str:
    """One line that names the file; without the place in Mitsuba's source."""
    text = re.sub(r"\[\w+\.(cpp|h):\d+\] ", "", _one_line(str(error)))
    text = re.sub(r"Traceback \(most recent call last\):.* (\w+Error: )", "", text)
    return text if str(path) in text else f"{path}: {text}"


def _one_line(text: str) -> str:
    return " ".join(text.split())

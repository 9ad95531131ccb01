"""The image of a render as an EXR file: means, the variance of a sample beside each, and how it was made."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract.io import image_file
from mi_refract.io.image_file import Metadata, write_exr

from .checkpoint import Progress, apart_from_passes, changed
from .pass_plan import FEW
from .pass_sums import PassSums

VARIANCE = "{}.variance"


def write(output: Path, channels: tuple[str, ...], progress: Progress, metadata: Metadata) -> Metadata:
    """Write what a render has. The header, with what is known of the passes. Errors: those of `write_exr`."""
    sums = progress.sums()
    assert sums is not None
    pixels, names = [sums.mean], list(channels)
    if (variance := sums.variance) is not None:
        pixels.append(variance)
        names += [VARIANCE.format(name) for name in channels]
    header = metadata | {
        "mi_refract:spp": sums.spp,
        "mi_refract:passes": sums.passes,
        "mi_refract:variance_freedom": sums.freedom,
        "mi_refract:variance_from": _source(sums),
        "mi_refract:nonfinite_pixels": nonfinite_pixels(sums),
        "mi_refract:identity": json.dumps(progress.identity, sort_keys=True),
        "mi_refract:render_seconds": progress.seconds,
        "mi_refract:machines": ", ".join(sorted(set(progress.machines))),
    }
    with np.errstate(over="ignore"):
        write_exr(output, np.concatenate(pixels, -1, dtype=np.float32, casting="same_kind"), names, header)
    return header


def _source(sums: PassSums) -> str:
    """What the variance was estimated from."""
    return "nothing" if not sums.freedom else "passes" if sums.within is None else "samples"


def nonfinite_pixels(sums: PassSums) -> int:
    """Pixels with a value that is not finite."""
    return int((~np.isfinite(sums.total).all(-1)).sum())


def read(output: Path, channels: tuple[str, ...], identity: dict[str, Any]) -> Progress | None:
    """The finished render that a file holds, to go on from; None where there is none of this scene, seed and version.

    Its sums are those of the file's float32.
    """
    try:
        image = image_file.read(output, image_file.MAX_VALUES * 4)
        before = json.loads(str(image.metadata["mi_refract:identity"]))
        spp, passes = (int(image.metadata[f"mi_refract:{name}"]) for name in ("spp", "passes"))
        if changed(apart_from_passes(before), identity) or not 1 <= passes <= spp:
            return None
        mean = image.select(channels).astype(np.float64)
        variance = image.select([VARIANCE.format(name) for name in channels]) if spp > 1 else np.zeros(())
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    variance = np.broadcast_to(variance.astype(np.float64), mean.shape)
    colours = int(identity["colours"])
    within = (
        variance * (spp - 1) if passes < FEW and image.metadata.get("mi_refract:variance_from") == "samples" else None
    )
    sums = PassSums(spp, passes, mean * spp, variance * (passes - 1), within, colours=colours)
    machines = [name for name in str(image.metadata.get("mi_refract:machines", "")).split(", ") if name]
    seconds = float(image.metadata.get("mi_refract:render_seconds", 0.0))
    return Progress(identity, base=sums, seconds=seconds, machines=machines)

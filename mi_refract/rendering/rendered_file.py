"""The image of a render as an EXR file: means, the variance of one sample beside each, and how it was made."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from mi_refract.io import image_file
from mi_refract.io.image_file import Metadata, write_exr

from .checkpoint import Identity, Progress, changes
from .pass_plan import FEW
from .pass_sums import PassSums

VARIANCE = "{}.variance"
SAMPLES = "samples: an upper bound where the sampler stratifies them"


def header(progress: Progress, sums: PassSums, metadata: Metadata, ended_by: str) -> Metadata:
    """`metadata`, and what is known of the passes, whose sums are `sums`."""
    source = "nothing" if not sums.freedom else "passes" if sums.within is None else SAMPLES
    return metadata | {
        "mi_refract:spp": sums.spp,
        "mi_refract:passes": sums.passes,
        "mi_refract:variance_freedom": sums.freedom,
        "mi_refract:variance_from": source,
        "mi_refract:nonfinite_pixels": nonfinite_pixels(sums),
        "mi_refract:identity": json.dumps(progress.identity, sort_keys=True),
        "mi_refract:contrasts": json.dumps([float(f"{contrast:.9g}") for contrast in sums.contrasts]),
        "mi_refract:ended_by": ended_by,
        "mi_refract:render_seconds": progress.seconds,
        "mi_refract:machines": ", ".join(sorted(progress.machines)),
    }


def write(output: Path, channels: tuple[str, ...], sums: PassSums, header: Metadata) -> None:
    """Write the image and its variance. Errors: those of `write_exr`."""
    pixels, names = [sums.mean], list(channels)
    if (variance := sums.variance) is not None:
        pixels.append(variance)
        names += [VARIANCE.format(name) for name in channels]
    with np.errstate(over="ignore"):
        write_exr(output, np.concatenate(pixels, -1, dtype=np.float32, casting="same_kind"), names, header)


def nonfinite_pixels(sums: PassSums) -> int:
    """Pixels with a value that is not finite."""
    return int((~np.isfinite(sums.total).all(-1)).sum())


def read(output: Path, channels: tuple[str, ...], identity: Identity) -> Progress | None:
    """The finished render that a file holds, to be refined; None where there is none of this identity.

    Its sums are those of the file's float32.
    """
    try:
        image = image_file.read(output, image_file.MAX_VALUES * 4)
        said = {name.removeprefix("mi_refract:"): value for name, value in image.metadata.items()}
        spp, passes = int(said["spp"]), int(said["passes"])
        contrasts = [float(contrast) for contrast in json.loads(said["contrasts"])]
        machines = {name for name in str(said["machines"]).split(", ") if name}
        kept = json.loads(said["identity"])
        progress = Progress(kept, seconds=float(said["render_seconds"]), machines=machines)
        variance_from = said["variance_from"]
        if changes(kept, identity) or not 1 <= passes <= spp or len(contrasts) != passes - 1:
            return None
        mean = image.select(channels).astype(np.float64)
        variance = image.select([VARIANCE.format(name) for name in channels]) if spp > 1 else np.zeros(())
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    variance = np.broadcast_to(variance.astype(np.float64), mean.shape)
    # Their sum over freedom is the variance that the file holds; under a wide filter a pixel has the expected weight.
    within = variance * (spp - passes) if variance_from == SAMPLES and passes < FEW else None
    progress.base = PassSums(
        spp, passes, mean * spp, variance * (passes - 1), within, contrasts=contrasts, colours=int(identity["colours"])
    )
    return progress

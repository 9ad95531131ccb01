"""The image of a render as an EXR file with the mean and the variance of one sample per channel, and provenance."""

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
NOTHING = "nothing"  # a single sample, or a single pass whose samples are not kept
SAMPLES = "samples: an upper bound where the sampler stratifies them"


def header(progress: Progress, sums: PassSums, metadata: Metadata, ended_by: str) -> Metadata:
    """Return `metadata` and the entries on the passes. `sums`: of all passes of `progress`."""
    source = NOTHING if not sums.freedom else "passes" if sums.within is None else SAMPLES
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
    """Return the number of pixels with a non-finite value."""
    return int((~np.isfinite(sums.total).all(-1)).sum())


def read(output: Path, channels: tuple[str, ...], size: tuple[int, int], identity: Identity) -> Progress | None:
    """Return the progress of a finished image, for refining it; None if there is no image of this size and identity.

    `size`: width and height. The sums have the precision of the file, float32. An image that was edited in place, with
    its metadata kept, is taken for the written one.
    """
    try:
        image = image_file.read(output, image_file.MAX_VALUES * 4)
        header = {name.removeprefix("mi_refract:"): value for name, value in image.metadata.items()}
        spp, passes = int(header["spp"]), int(header["passes"])
        contrasts = [float(contrast) for contrast in json.loads(header["contrasts"])]
        machines = {name for name in str(header["machines"]).split(", ") if name}
        image_identity = json.loads(header["identity"])
        progress = Progress(image_identity, seconds=float(header["render_seconds"]), machines=machines)
        variance_from = header["variance_from"]
        if changes(image_identity, identity) or not 1 <= passes <= spp or len(contrasts) != passes - 1:
            return None
        mean = image.select(channels).astype(np.float64)
        if mean.shape[1::-1] != size:
            return None
        names = [VARIANCE.format(name) for name in channels]
        variance = np.zeros_like(mean) if variance_from == NOTHING else image.select(names).astype(np.float64)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    # `within` and `between` give the variance in the file. From samples it may be a bound; contrasts are not, and give
    # the mean of `between`. With a wide filter every pixel gets the expected weight.
    within, of_between, colours = None, passes - 1.0, int(identity["colours"])
    if variance_from == SAMPLES and passes < FEW:
        of_colours = variance[..., :colours]
        finite = of_colours[np.isfinite(of_colours)]
        if finite.any() and (of_samples := float(finite.mean())) > 0:
            of_between = float(np.clip(np.nansum(contrasts) / of_samples, 0, spp - 1))
        within = variance * (spp - 1 - of_between)
    between = variance * of_between
    progress.base = PassSums(spp, passes, mean * spp, between, within, contrasts=contrasts, colours=colours)
    return progress

"""Accepting: new images become the references. The only part of the comparison that writes images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from mi_refract.io import image_file
from mi_refract.io.atomic import write_atomically

from .folders import Results, Status


def changes(results: Results) -> Iterator[tuple[Path, Path]]:
    """(new, reference) for each image that is not equal to its reference, or has none.

    ValueError or OSError for a new image that can be no reference: unreadable, with values that are not finite, or of
    another format than the reference's name says.
    """
    for result in results.of(Status.ERROR, Status.DIFFERENT, Status.INCONCLUSIVE):
        if result.test is None:
            if result.error:
                raise ValueError(result.error)
            continue
        image = image_file.read(result.test)
        if not result.how.options.get("allow_nonfinite") and not np.isfinite(image.pixels).all():
            raise ValueError(f"{result.test}: values that are not finite; accepted with --allow-nonfinite")
        target = results.target(result)
        if target.suffix.lower() != result.test.suffix.lower():
            raise ValueError(f"{target}: accepted: a name that ends in {result.test.suffix}, as {result.test} does")
        yield result.test, target


def accept(copies: Sequence[tuple[Path, Path]], shown: int) -> None:
    """Copy each first file over the second; every one is replaced as a whole or stays. OSError ends it.

    `shown`: the time in ns since the epoch when they were compared; OSError, before any copy, for a file changed since.
    """
    for new, _ in copies:
        if max(new.stat().st_mtime_ns, new.stat().st_ctime_ns) > shown:
            raise OSError(f"{new}: changed since it was compared; accepted: what was shown")
    for new, reference in copies:
        reference.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(reference, new.read_bytes())

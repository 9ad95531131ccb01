"""Which software made a file: versions for the header of an image, and for reports."""

from __future__ import annotations

import contextlib
import importlib.metadata


def provenance() -> dict[str, str]:
    """Header attributes: `Software`, and `mi_refract:version:NAME` for mi_refract, mitsuba and drjit."""
    from mi_refract import __version__

    versions = {"mi_refract": __version__} | {name: installed_version(name) for name in ("mitsuba", "drjit")}
    return {"Software": f"mi_refract {__version__}"} | {f"mi_refract:version:{n}": v for n, v in versions.items()}


def installed_version(distribution: str) -> str:
    """The installed version of a distribution; "unknown" where it runs without being installed."""
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version(distribution)
    return "unknown"

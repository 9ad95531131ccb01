"""three-gpu-pathtracer in a headless Chromium, whose WebGL2 runs on the processor."""

import shutil

from .system import Npm, System

SYSTEM = System(
    "three",
    "three-gpu-pathtracer",
    "MIT (three, three-gpu-pathtracer, three-mesh-bvh), Apache-2.0 (puppeteer-core)",
    Npm(("three@0.187.0", "three-gpu-pathtracer@0.0.26", "three-mesh-bvh@0.9.17", "puppeteer-core@24.43.1")),
    megabytes=90,
    draws=True,
)
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def browser() -> str | None:
    """The path of a Chromium."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)

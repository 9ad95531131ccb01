"""What the bits of a render depend on, and how two renders differ in it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from mi_refract import backend
from mi_refract.cluster import worker_facts
from mi_refract.io.provenance import installed_version
from mi_refract.plugins import scene_parser

from .render_pass import PassRenderer

PASS = "samples of a pass"  # a render may go on with passes of another size


def identity_of(
    scene: Path, defines: Mapping[str, str], seed: int, renderer: PassRenderer, allow_plugins: Collection[str] = ()
) -> dict[str, Any]:
    """All that the bits of a render depend on, by names for messages; but for PASS, which its plan says.

    `renderer`: of the scene in this file, loaded in the present variant. `allow_plugins`: as in `load_scene`.
    """
    import mitsuba as mi

    parsed = scene_parser.parse(scene, defines)
    digest = hashlib.sha256()
    for name, path in [*(("", xml) for xml in parsed.xml), *parsed.files(allow_plugins).items()]:
        digest.update(json.dumps([name, hashlib.sha256(path.read_bytes()).hexdigest()]).encode())
    width, height = renderer.size
    llvm = "llvm" in str(mi.variant())
    return {
        "scene": digest.hexdigest(),
        "defines": dict(defines),
        "seed": seed,
        "variant": str(mi.variant()),
        "film": f"{width} × {height} {', '.join(renderer.channels)}",
        "colours": renderer.colours,
        "version of mi_refract": worker_facts.our_version(),
        **{f"version of {name}": installed_version(name) for name in ("mitsuba", "drjit")},
        "libLLVM": backend.llvm().library if llvm else "none",
        "vector width": worker_facts.vector_width() if llvm else "none",
    }


def apart_from_passes(identity: dict[str, Any]) -> dict[str, Any]:
    """What must be the same in a render that goes on."""
    return {name: value for name, value in identity.items() if name != PASS}


def changed(before: dict[str, Any], now: dict[str, Any]) -> str:
    """What is different, by name; "" where nothing is."""
    found = []
    for name in {**before, **now}:
        if before.get(name) != now.get(name):
            long = name == "scene"
            found.append(f"the {name} has changed" if long else f"{name} was {before.get(name)}, is {now.get(name)}")
    return ", ".join(found)

"""Every parser of ours, a good input for each, and what it must not make of a bad one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from mi_refract.image_diff import folders, settings_file
from mi_refract.image_diff.results import Status
from mi_refract.io import image_file
from mi_refract.planar import scene_file
from mi_refract.ray_sets import check_answers, files, ray_set
from mi_refract.regimes import Rays
from mi_refract.report import run_report
from mi_refract.report.row import Row

from . import scene_inputs
from .parser import Parser

SCENES = Path(__file__).parents[2] / "scenes" / "planar"
HEADER = 700  # bytes of an EXR file in front of its pixels
FAR = 1e-3  # radians: no bound of a generic ray in float32 excuses as much

SETTINGS = b"""[[image]]
name = "glass/caustic*.exr"
method = "tolerance"
fail = 0.02
reason = "single-precision caustic: last bits differ"

[[image]]
name = "noise.exr"
method = "welch"
family_error = 0.01
allow_nonfinite = true
reason = "an estimate"
"""


def parsers(folder: Path) -> dict[str, Parser]:
    """All of them by name; good inputs that need a file are written into `folder`."""
    rays = ray_set.make(("generic",), 6)
    answers = _right_answers(rays)
    for name in ("rays.csv", "rays.npz", "rays.exr"):
        files.write(folder / name, rays)
    table = folder / "answers.csv"
    rows = [f"{i},{b[0]!r},{b[1]!r},{b[2]!r}" for i, b in zip(answers.ids.tolist(), answers.b.tolist(), strict=True)]
    header = "".join(f"# {key}: {json.dumps(value)}\n" for key, value in rays.header.items())
    table.write_text(header + "\n".join(["id,bx,by,bz", *rows, ""]))
    packed = folder / "answers.npz"
    np.savez(packed, id=answers.ids, b=answers.b)
    image = folder / "image.exr"
    image_file.write_exr(image, np.linspace(0.1, 1, 12 * 8 * 3).reshape(8, 12, 3), metadata={"mi_refract:spp": 16})
    run_report.write_json(folder / "rows.json", [_ROW], {"title": "x"})

    def same_rays(path: Path) -> str:
        found = files.read(path)
        same = found.header == rays.header and np.array_equal(found.numbers, rays.numbers)
        return "" if same else "other rays than those that were exported"

    def right(path: Path) -> str:
        return _wrongly_accepted(rays, answers, files.read_answers(path))

    def equal(path: Path) -> str:
        (result,) = folders.diff(image, path).results
        if result.error:
            raise ValueError(result.error)
        if result.status is not Status.EQUAL:
            return ""
        pixels = image_file.read(path).pixels
        return "" if np.allclose(pixels, reference.pixels, rtol=0.05, atol=0.05) else "equal to other pixels"

    reference, rows_json = image_file.read(image), (folder / "rows.json").read_bytes()
    scenes = tuple((SCENES / f"{name}.toml").read_bytes() for name in ("lens", "nested", "prism", "doublet"))
    return scene_inputs.parsers(folder) | {
        "planar scene, TOML": Parser(".toml", scenes, lambda path: str(scene_file.load(path))[:0]),
        "diff settings, TOML": Parser(".toml", (SETTINGS,), lambda path: str(settings_file.load(path))[:0]),
        "rows, JSON": Parser(".json", (rows_json,), lambda path: str(run_report.read_json(path))[:0]),
        "rays, CSV": Parser(".csv", ((folder / "rays.csv").read_bytes(),), same_rays),
        "rays, NPZ": Parser(".npz", ((folder / "rays.npz").read_bytes(),), same_rays),
        "rays, EXR": Parser(".exr", ((folder / "rays.exr").read_bytes(),), same_rays, HEADER),
        "answers, CSV": Parser(".csv", (table.read_bytes(),), right),
        "answers, NPZ": Parser(".npz", (packed.read_bytes(),), right),
        "image, EXR": Parser(".exr", (image.read_bytes(),), equal, HEADER),
    }


_ROW = Row("directions", "promoted", "generic", "scalar", {"worst": 0.5}, budgets={"worst": 1.0}, replay={"seed": 1})


def _right_answers(rays: ray_set.RaySet) -> ray_set.Answers:
    from mi_refract import oracle

    given: Rays = rays.rays
    exact = oracle.refract(given.a, given.n, given.k, fresnel=False, progress=False)
    return ray_set.Answers(rays.ids, exact.direction.astype(np.float32).astype(np.float64))


def _wrongly_accepted(rays: ray_set.RaySet, right: ray_set.Answers, found: ray_set.Answers) -> str:
    """Why answers that `rays check` calls right are not: another id, or a direction that is far away."""
    if len(found.ids) == len(right.ids) and np.array_equal(found.b, right.b) and np.array_equal(found.ids, right.ids):
        return ""
    if check_answers.check(rays, found).exit_code:
        return ""
    if sorted(found.ids.tolist()) != right.ids.tolist():
        return "exit code 0 for other ids"
    away = np.linalg.norm(found.b[np.argsort(found.ids)] - right.b, axis=1)
    return "" if (away < FAR).all() else f"exit code 0 for a direction that is {away.max():g} away"

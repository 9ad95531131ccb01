"""What importing a part of `planar` loads: geometry no ray tracing; the tracer where it is used."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

import mi_refract
from mi_refract import planar

TRACING = ("array_backend", "intersect_segments", "intersect_arcs", "mesh_acceleration", "path_loop", "tracer")
NAMES = ("Event", "Paths", "Segments", "Tracer", "trace")
ROOT = Path(mi_refract.__file__).parents[1]


def loaded(code):
    """Modules of `mi_refract` in a fresh process after `code`."""
    code += "\nimport sys; print(*(m for m in sys.modules if m.startswith('mi_refract')))"
    path = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, sys.path)])}
    return set(
        subprocess.run(
            [sys.executable, "-c", code], env=path, capture_output=True, text=True, check=True
        ).stdout.split()
    )


@pytest.mark.parametrize(
    "code",
    [
        "from mi_refract.planar import curves, shapes\nshapes.circle(1.0).between(1.5, 1.0)",
        "from mi_refract.planar import Event, Paths, Segments, scene_file, scene_schema\nSegments",
    ],
)
def test_geometry_and_scene_files_do_not_load_the_ray_tracing(code):
    assert not loaded(code) & {f"mi_refract.planar.{name}" for name in TRACING}


def test_the_tracer_is_loaded_when_it_is_used():
    assert "mi_refract.planar.tracer" in loaded("from mi_refract import planar\nplanar.trace")


def test_settings_of_the_image_diff_load_nothing_of_planar():
    assert not any(name.startswith("mi_refract.planar") for name in loaded("import mi_refract.image_diff.settings"))


def test_public_names_are_there():
    for name in NAMES:
        assert getattr(planar, name).__name__ == name
    for name in {*planar.__all__} - {*NAMES}:
        assert importlib.import_module(f"mi_refract.planar.{name}").__doc__
    assert {*planar.__all__} <= {*dir(planar)}
    with pytest.raises(AttributeError, match=r"module 'mi_refract.planar' has no attribute 'follow'"):
        planar.follow  # noqa: B018

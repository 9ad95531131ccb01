"""The room's README: its Python runs, its scene is one, and its options are those of the command."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import pytest

pytest.importorskip("typer")

from mi_refract import planar
from mi_refract.cli import app
from mi_refract.planar import scene_file

TEXT = Path(planar.__file__).with_name("README.md").read_text()
ROOT = Path(__file__).parents[2]


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


def test_the_python_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    for code in blocks("python"):
        exec(code, {})
    assert "escaped" in capsys.readouterr().out
    assert (tmp_path / "doublet.svg").stat().st_size > 1000


def test_the_scene_is_one(tmp_path):
    (scene,) = blocks("toml")
    path = tmp_path / "scene.toml"
    path.write_text(scene)
    assert len(scene_file.load(path).origins) == 15


def test_every_option_kind_and_event_is_there(capfd):
    with pytest.raises(SystemExit):
        app.app(["trace", "--help"], prog_name="mi-refract")
    options = set(re.findall(r"(--[a-z][a-z-]+)", capfd.readouterr().out)) - {"--help"}
    assert all(f"| `{option}" in TEXT or f"`{option}`" in TEXT for option in options - {"--output"})
    kinds = [
        kind.__struct_config__.tag for union in (scene_file.AnyShape, scene_file.AnyBeam) for kind in get_args(union)
    ]
    kinds += [event.name for event in planar.Event]
    assert all(f"`{name}`" in TEXT for name in kinds)

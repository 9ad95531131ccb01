"""What a scene file asks for is counted before memory is allocated for it."""

import os
from pathlib import Path

import pytest

from mi_refract.planar import scene_file, scene_schema
from mi_refract.planar.scene_file import load

DISC = '[[shape]]\nkind = "circle"\nradius = 1\nn = 1.5\n'
BEAM = '[[beam]]\nkind = "fan"\nat = [0, 0]\nangles = [0, 90]\ncount = 4\n'
BEAMS = f'{DISC}{BEAM}{BEAM.replace("4", "3")}[[beam]]\nkind = "rays"\norigins = [[0, 3]]\ndirections = [0]\n'


def written(tmp_path, text):
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return path


MANY = [
    ('kind = "circle"\nradius = 1\nn = 1.5\nfacets = 1000000', 5, r"shape\[4\]: 5000000 pieces and more; expected ")
]
MANY += [('kind = "luneburg"\nradius = 1\nlayers = 10000\nfacets = 1000000', 1, r"shape\[0\]: 10000000000 pieces")]


@pytest.mark.parametrize("shape, count, message", MANY)
def test_pieces_are_counted_before_they_are_made(tmp_path, monkeypatch, shape, count, message):
    monkeypatch.setattr(scene_file, "_placed", lambda parts, values: [])
    for kind in ("circle", "luneburg"):
        build = scene_schema.Kind("", scene_schema.SHAPES[kind].keys, lambda values: [])
        monkeypatch.setitem(scene_schema.SHAPES, kind, build)
    beam = '[[beam]]\nkind = "rays"\norigins = [[0, 3]]\ndirections = [0]\n'
    with pytest.raises(ValueError, match=message):
        load(written(tmp_path, f"[[shape]]\n{shape}\n" * count + beam))


def test_rays_are_counted_before_they_are_made(tmp_path, monkeypatch):
    monkeypatch.setattr(scene_file, "RAYS", 7)
    with pytest.raises(ValueError, match=r"beam\[2\]\.count: 8 rays with the beams before; expected up to 7"):
        load(written(tmp_path, BEAMS))


def test_a_file_that_is_none_or_too_large(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "pipe.toml")
    for path in (tmp_path / "pipe.toml", Path("/dev/zero")):
        with pytest.raises(ValueError, match=f"^{path}: not a regular file$"):
            load(path)
    monkeypatch.setattr(scene_file, "SIZE", 1000)
    with pytest.raises(ValueError, match=r"scene\.toml: 1001 bytes; expected up to 1000"):
        load(written(tmp_path, " " * 1001))

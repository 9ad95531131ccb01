"""Sources of the documentation site, without Sphinx: generated tables, listing, and code on the pages."""

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest
from support.readme import DOCS, ROOT, python_blocks
from support.readme import PAGES as PATHS

from mi_refract import media, oracle
from mi_refract.io import image_file
from mi_refract.planar import path_tree, scene_file
from mi_refract.rendering.long_render import render_to_exr

PAGES = {path.relative_to(DOCS).as_posix(): path for path in PATHS}
SPEC = importlib.util.spec_from_file_location("generated", DOCS / "generated.py")
generated = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(generated)
# Pages whose Python another test runs, with smaller images, or with a program or a cluster.
ELSEWHERE = {
    "how-to/check-a-shaders-rays.md": "cli/test_rays.py",
    "how-to/coming-from-other-image-diffs.md": "image_diff/test_other_image_diffs.py",
    "how-to/compare-images-in-pytest.md": "test_pytest_plugin.py",
    "how-to/dispersion-and-coloured-glass.md": "media/test_media.py",
    "how-to/recover-an-index-from-an-image.md": "plugins/test_registration.py",
    "how-to/render-for-hours.md": "rendering/test_long_render.py",
    "how-to/render-on-a-cluster.md": "docs/test_pages.py",
    "how-to/render-with-the-plugin.md": "plugins/test_registration.py",
    "how-to/trace-rays-in-two-dimensions.md": "planar/test_scene_file.py",
}
CALLS = {
    (name, *words.split())
    for path in PAGES.values()
    for name, words in re.findall(r"^```\{generated\} (\S+)(.*)$", path.read_text("utf-8"), re.MULTILINE)
}


@pytest.mark.parametrize("call", sorted(CALLS), ids=" ".join)
def test_generated_parts_of_pages_are_written(call):
    name, *arguments = call
    assert len(generated.WRITERS[name](*arguments).splitlines()) > 3


def test_every_generated_table_and_module_page_is_used():
    assert {name for name, *_ in CALLS} == generated.WRITERS.keys() - {"room"}  # the build writes pages of "room"
    listed = re.findall("^(python/.+)$", PAGES["reference/python.md"].read_text("utf-8"), re.MULTILINE)
    assert {f"reference/{page}.md" for page in listed} == generated.pages().keys()


def test_every_page_is_in_one_table_of_contents():
    listed = []
    for path in PATHS:
        for block in re.findall(r"^```\{toctree\}\n(.*?)^```", path.read_text("utf-8"), re.MULTILINE | re.DOTALL):
            lines = (line for line in block.splitlines() if not line.startswith(":"))
            listed += [(path.parent / line).relative_to(DOCS).as_posix() for line in lines]
    sources = {path.relative_to(DOCS).with_suffix("").as_posix() for path in (*PATHS, *DOCS.glob("tutorials/*.ipynb"))}
    assert sorted(x for x in listed if "/python/" not in x) == sorted(sources - {"index"})


def test_the_error_of_mitsubas_bk7_is_listed():
    names = generated.mitsuba_names()
    assert len(names) > 20 and generated.KNOWN.keys() <= set(names)
    assert "| `bk7` | 1.5046 | 1.51680 | `SCHOTT:N-BK7` | **−0.0122** |" in generated.materials()
    assert media.index("SCHOTT:N-BK7", 1200.0) == pytest.approx(1.5046, abs=5e-4)


def test_other_tests_name_the_pages_in_elsewhere():
    assert all(Path(page).name in (ROOT / "tests" / test).read_text("utf-8") for page, test in ELSEWHERE.items())


@pytest.mark.parametrize("name", [x for x, path in PAGES.items() if python_blocks(path) and x not in ELSEWHERE])
def test_python_on_a_page_runs(name, tmp_path, monkeypatch, llvm_variant):
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    monkeypatch.chdir(tmp_path)
    names = {}
    for code in python_blocks(PAGES[name]):
        exec(code, names)


def test_checking_rays_from_python_as_on_the_page(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before, after = python_blocks(PAGES["how-to/check-a-shaders-rays.md"])[1].split("\n...\n")
    exec(before, names := {})
    rays = names["rays"]
    answers = oracle.refract(rays.rays.a, rays.rays.n, rays.rays.k, fresnel=False, progress=False)
    np.savez("answers.npz", id=rays.ids, b=answers.direction)
    exec(after, names)
    assert names["findings"].exit_code == 0


def names_in_table(number):
    """Return the names in backticks in the first column of a table on the page on file formats."""
    text = PAGES["reference/file-formats.md"].read_text("utf-8")
    rows = re.split(r"^\|---.*$", text, flags=re.MULTILINE)[number + 1].strip().split("\n\n")[0]
    return {name for row in rows.splitlines() for name in re.findall("`(.+?)`", row.split("|")[1])}


def test_attributes_of_an_image_are_on_the_page(tmp_path, llvm_variant):
    render_to_exr(ROOT / "scenes/sphere.xml", tmp_path / "a.exr", defines={"res": "8"}, spp=2)
    metadata = image_file.read(tmp_path / "a.exr").metadata
    assert {name for name in metadata if name.startswith(("mi_refract:", "Software"))} == names_in_table(0)


def test_keys_of_traced_paths_are_on_the_page():
    scene = path_tree.with_rays(scene_file.load(ROOT / "scenes/planar/lens.toml"), 2)
    data = path_tree.as_data(scene, path_tree.follow_scene(scene))
    assert data.keys() | {"foci"} == names_in_table(1)
    assert data["colours"][0]["paths"][0].keys() == names_in_table(2)

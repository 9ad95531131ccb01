"""The sources of the site without Sphinx: what the program writes into it, and the code on its pages, which runs."""

import importlib.util
import re
from pathlib import Path

import pytest
from support.readme import DOCS, ROOT, python_blocks
from support.readme import PAGES as PATHS

from mi_refract import media
from mi_refract.io import image_file
from mi_refract.planar import path_tree, scene_file
from mi_refract.rendering.long_render import render_to_exr

PAGES = {path.relative_to(DOCS).as_posix(): path for path in PATHS}
SPEC = importlib.util.spec_from_file_location("generated", DOCS / "generated.py")
generated = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(generated)
OTHER_TESTS = "".join(path.read_text("utf-8") for path in ROOT.glob("tests/**/test_*.py") if path != Path(__file__))
CALLS = {
    (name, *words.split())
    for path in PAGES.values()
    for name, words in re.findall(r"^```\{generated\} (\S+)(.*)$", path.read_text("utf-8"), re.MULTILINE)
}


@pytest.mark.parametrize("call", sorted(CALLS), ids=" ".join)
def test_what_a_page_asks_for_is_written(call):
    name, *arguments = call
    assert len(generated.WRITERS[name](*arguments).splitlines()) > 3


def test_every_table_and_every_room_has_a_place():
    assert {name for name, *_ in CALLS} == generated.WRITERS.keys() - {"room"}  # whose pages are written by the build
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


def test_bk7_of_mitsuba_is_shown_to_be_off():
    names = generated.mitsuba_names()
    assert len(names) > 20 and generated.KNOWN.keys() <= set(names)
    assert "| `bk7` | 1.5046 | 1.51680 | `SCHOTT:N-BK7` | **−0.0122** |" in generated.materials()
    assert media.index("SCHOTT:N-BK7", 1200.0) == pytest.approx(1.5046, abs=5e-4)


@pytest.mark.parametrize("name", [name for name, path in PAGES.items() if python_blocks(path)])
def test_the_python_of_a_page_runs(name, tmp_path, monkeypatch, llvm_variant):
    if f'"{Path(name).name}"' in OTHER_TESTS or f"/{Path(name).name}" in OTHER_TESTS:
        pytest.skip("another test runs it")
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    monkeypatch.chdir(tmp_path)
    names = {}
    for code in python_blocks(PAGES[name]):
        exec(code, names)


def named(table):
    """What stands in backticks in the first column of a table of the page on file formats, by number."""
    text = PAGES["reference/file-formats.md"].read_text("utf-8")
    rows = re.split(r"^\|---.*$", text, flags=re.MULTILINE)[table + 1].strip().split("\n\n")[0]
    return {name for row in rows.splitlines() for name in re.findall("`(.+?)`", row.split("|")[1])}


def test_the_attributes_of_an_image_are_those_of_the_page(tmp_path, llvm_variant):
    render_to_exr(ROOT / "scenes/sphere.xml", tmp_path / "a.exr", defines={"res": "8"}, spp=2)
    found = image_file.read(tmp_path / "a.exr").metadata
    assert {name for name in found if name.startswith(("mi_refract:", "Software"))} == named(0)


def test_the_keys_of_traced_paths_are_those_of_the_page():
    scene = path_tree.with_rays(scene_file.load(ROOT / "scenes/planar/lens.toml"), 2)
    data = path_tree.as_data(scene, path_tree.follow_scene(scene))
    assert data.keys() | {"foci"} == named(1)
    assert data["colours"][0]["paths"][0].keys() == named(2)

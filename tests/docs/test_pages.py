"""READMEs and pages of the documentation: their length, their links, and their examples."""

import re

import mitsuba as mi
import pytest
from support.readme import DOCS, PAGES, READMES, ROOT, blocks, python_blocks
from support.variants import switch

ALL = [*READMES, *PAGES]


def name(path):
    return str(path.relative_to(DOCS if path.is_relative_to(DOCS) else ROOT))


def anchors(path):
    """Return the anchors of a Markdown file's headings, as GitHub and MyST make them."""
    text = re.sub(r"^```.*?^```", "", path.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    texts = [re.sub(r"\[(.*?)\]\(.*?\)", r"\1", heading).lower() for heading in headings]
    return {re.sub(r"[^\w\- ]", "", text).replace(" ", "-") for text in texts}


@pytest.mark.parametrize("path", READMES, ids=name)
def test_a_readme_is_short(path):
    assert len(path.read_text("utf-8").splitlines()) <= (120 if path.parent == ROOT else 60)


@pytest.mark.parametrize("path", [path for path in READMES if path.parent.parent.name == "mi_refract"], ids=name)
def test_the_map_of_a_room_names_its_modules(path):
    cells = re.findall(r"^\|(.*?)\|", path.read_text("utf-8"), re.MULTILINE)
    modules = {module.stem for module in path.parent.glob("*.py")} - {"__init__"}
    assert modules == set(re.findall(r"`(\w+)`", "".join(cells)))


@pytest.mark.parametrize("path", ALL, ids=name)
def test_links_lead_to_files_and_headings(path):
    text = re.sub(r"^```.*?^```|`[^`\n]*`", "", path.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if "://" not in link:
            file, _, anchor = link.partition("#")
            target = path.parent / file if file else path
            if target.parent.name == "python":
                continue  # written by the site's build, which checks links itself
            assert target.exists(), link
            if anchor and "```{generated}" not in target.read_text("utf-8"):
                assert anchor in anchors(target), link


@pytest.mark.parametrize("path", [p for p in READMES[1:] if python_blocks(p)], ids=name)
def test_python_in_a_readme_runs(path, llvm_variant):
    exec("\n".join(python_blocks(path)), {})


def test_python_for_a_cluster_compiles():
    codes = python_blocks(DOCS / "how-to/render-on-a-cluster.md")
    assert all(compile(code, "", "exec") for code in codes) and len(codes) == 3


@pytest.mark.parametrize("path", [p for p in PAGES if blocks(p, "xml")], ids=name)
def test_xml_on_a_page_loads_in_a_scene(path, tmp_path):
    switch("scalar_spectral")
    (tmp_path / "glass.csv").write_text("Wavelength (nm),n\n400,1.5\n700,1.5\n")
    table = "DATA:\n  - type: tabulated nk\n    data: |\n        0.3 1.5 1e-7\n        0.9 1.5 1e-7\n"
    (tmp_path / "glass.yml").write_text(table)
    for text in blocks(path, "xml"):
        (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0">{text}</scene>')
        assert mi.load_file(str(tmp_path / "scene.xml"))

"""The pages of the plugins: their tables say what the plugins accept and expose; their examples are the same twice."""

import re
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from support.readme import blocks
from support.variants import switch

from mi_refract.plugins import refract, refract_path

PAGES = Path(__file__).parents[2] / ".github/docs/reference"
TABLES = {
    module.__name__.rpartition(".")[2]: [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in module.__doc__.splitlines()
        if line.startswith("| ") and "parameter" not in line
    ]
    for module in (refract, refract_path)
}
VALUES = {  # of a row of a table, by its type
    "number": 0.5,
    "integer": 4,
    "boolean": True,
    "string": "wedge",
    "word": "lamp",
    "name": "water",
    "dispersive material": "SCHOTT:N-BK7",
    "spectrum": {"type": "irregular", "wavelengths": "360, 830", "values": "0.5, 0.6"},
    "texture": {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(np.full((2, 2, 1), 0.5, np.float32))},
}
CASES = []  # plugin, parameter, type, exposed, differentiable
for plugin, rows in TABLES.items():
    names = []
    for first, kinds, _, *flags in rows:
        names = re.findall("`(.+?)`", first) or names
        CASES += [(plugin, name, kind, *(flags or ("no", "no"))) for name in names for kind in kinds.split(", ")]


@pytest.fixture
def queried(monkeypatch):
    """The names of the properties that plugins ask for."""
    names = set()
    for method in ("get", "get_texture", "get_unbounded_texture", "__contains__", "__getitem__"):
        ask = getattr(mi.Properties, method)
        monkeypatch.setattr(
            mi.Properties, method, lambda props, name, *more, ask=ask: (names.add(name), ask(props, name, *more))[1]
        )
    return names


def shown(plugin, name, kind, exposed, folder):
    """What `mi.traverse` shows of a parameter: whether it is differentiable, by key."""
    glass, base = f"file:{folder}/glass.csv", name.removesuffix("_unit").removesuffix("_distance")
    scene = {"type": plugin, name: VALUES.get(kind, glass)}
    if name.endswith("_unit") or kind == "`file:…`":
        scene |= {base: glass, f"{base}_unit": 0.001}
    if "colour" in name:
        scene = {base: 0.5, f"{base}_distance": 2.0} | scene
    if name == "eta":
        with pytest.raises(RuntimeError, match="unreferenced"):
            mi.load_dict(scene)
        del scene[name]
    parameters = mi.traverse(mi.load_dict(scene))
    begins = re.sub("`|, …", "", exposed).replace("int_ior", name) if "`" in exposed else name
    keys = [key for key in parameters.keys() if key == begins or key.startswith(f"{begins}.")]  # noqa: SIM118
    return [not parameters.flags(key) & mi.ParamFlags.NonDifferentiable for key in keys]


@pytest.mark.parametrize("plugin", TABLES)
def test_a_table_says_what_the_plugin_accepts_and_exposes(plugin, queried, tmp_path):
    switch("scalar_spectral")
    (tmp_path / "glass.csv").write_text("Wavelength (nm),n,k\n300,1.5,1e-7\n900,1.5,1e-7\n")
    wrong = []
    for _, name, kind, *flags in [case for case in CASES if case[0] == plugin]:
        found = shown(plugin, name, kind, flags[0], tmp_path)
        if [x != "no" for x in flags] != [bool(found), any(found)]:
            wrong.append((name, kind, found))
    assert not wrong
    # No parameter is missing in the table. `color` is asked for to say how it is written.
    named = {x for each, x, *_ in CASES if each == plugin}
    assert {x for x in queried if "color" not in x} - {"raw", *VALUES["spectrum"]} <= named


def test_the_defaults_are_those_of_the_tables(scalar_variant):
    assert "`bk7`, which is 1.5046" in refract.__doc__ and str(mi.load_dict({"type": "refract"})) == str(
        mi.load_dict({"type": "refract", "int_ior": 1.5046, "ext_ior": "air", "formula": "auto"})
    )
    said = {"max_depth": -1, "rr_depth": 5, "hide_emitters": False, "split_depth": 0, "split_weight": 0.01}
    said |= {"type": "refract_path", "deterministic": False}
    assert str(mi.load_dict({"type": "refract_path"})) == str(mi.load_dict(said))
    cells = {name: row[2] for row in TABLES["refract_path"] for name in re.findall("`(.+?)`", row[0])}
    for name, value in said.items():
        assert name == "type" or f"({str(value).lower()}" in cells[name]


@pytest.mark.parametrize("plugin", TABLES)
def test_the_examples_in_xml_and_as_dict_are_the_same(plugin):
    switch("scalar_spectral")
    page = PAGES / f"{plugin}.md"
    pairs = [*zip(blocks(page, "xml"), blocks(page, "python"), strict=True)]
    assert len(pairs) >= 2
    for xml, code in pairs:
        assert str(mi.load_string(xml.replace(">", ' version="3.0.0">', 1))) == str(mi.load_dict(eval(code)))

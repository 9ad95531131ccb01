"""Pages of the plugins: their tables of parameters, and the equality of their examples in XML and Python."""

import re

import mitsuba as mi
import numpy as np
import pytest
from support.readme import DOCS, blocks
from support.variants import switch

from mi_refract.plugins import refract, refract_path

PAGES = DOCS / "reference"
TABLES = {
    module.__name__.rpartition(".")[2]: [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in module.__doc__.splitlines()
        if line.startswith("| ") and "parameter" not in line
    ]
    for module in (refract, refract_path)
}
VALUES = {  # a parameter's value by the type in its table
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
    """The names of the properties that plugins read."""
    names = set()

    def record(method):
        original = getattr(mi.Properties, method)

        def recording(props, name, *arguments):
            names.add(name)
            return original(props, name, *arguments)

        monkeypatch.setattr(mi.Properties, method, recording)

    for method in ("get", "get_texture", "get_unbounded_texture", "__contains__", "__getitem__"):
        record(method)
    return names


def differentiable_keys(plugin, name, kind, exposed, folder):
    """Return for each key of `mi.traverse` that a parameter has whether it is differentiable."""
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
    stem = re.sub("`|, …", "", exposed).replace("int_ior", name) if "`" in exposed else name
    keys = [key for key in parameters.keys() if key == stem or key.startswith(f"{stem}.")]  # noqa: SIM118
    return [not parameters.flags(key) & mi.ParamFlags.NonDifferentiable for key in keys]


@pytest.mark.parametrize("plugin", TABLES)
def test_a_table_lists_what_the_plugin_accepts_and_exposes(plugin, queried, tmp_path):
    switch("scalar_spectral")
    (tmp_path / "glass.csv").write_text("Wavelength (nm),n,k\n300,1.5,1e-7\n900,1.5,1e-7\n")
    wrong = []
    for _, name, kind, *flags in [case for case in CASES if case[0] == plugin]:
        keys = differentiable_keys(plugin, name, kind, flags[0], tmp_path)
        if [x != "no" for x in flags] != [bool(keys), any(keys)]:
            wrong.append((name, kind, keys))
    assert not wrong
    # No parameter is missing in the table. The plugin only reads `color` to report the spelling `colour`.
    listed = {name for other, name, *_ in CASES if other == plugin}
    assert {x for x in queried if "color" not in x} - {"raw", *VALUES["spectrum"]} <= listed


def test_defaults_equal_those_in_the_tables(scalar_variant):
    assert "`bk7`, which is 1.5046" in refract.__doc__ and str(mi.load_dict({"type": "refract"})) == str(
        mi.load_dict({"type": "refract", "int_ior": 1.5046, "ext_ior": "air", "formula": "auto"})
    )
    defaults = {"max_depth": -1, "rr_depth": 5, "hide_emitters": False, "split_depth": 0, "split_weight": 0.01}
    defaults |= {"type": "refract_path", "deterministic": False}
    assert str(mi.load_dict({"type": "refract_path"})) == str(mi.load_dict(defaults))
    cells = {name: row[2] for row in TABLES["refract_path"] for name in re.findall("`(.+?)`", row[0])}
    for name, value in defaults.items():
        assert name == "type" or f"({str(value).lower()}" in cells[name]


@pytest.mark.parametrize("plugin", TABLES)
def test_examples_in_xml_and_as_dict_are_equal(plugin):
    switch("scalar_spectral")
    page = PAGES / f"{plugin}.md"
    pairs = [*zip(blocks(page, "xml"), blocks(page, "python"), strict=True)]
    assert len(pairs) >= 2
    for xml, code in pairs:
        assert str(mi.load_string(xml.replace(">", ' version="3.0.0">', 1))) == str(mi.load_dict(eval(code)))

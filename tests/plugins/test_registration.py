"""`import mi_refract` in any order with `set_variant`, and what it costs. Each case is a fresh interpreter."""

import os
import subprocess
import sys

import pytest

from mi_refract import backend

LOAD = "mi.load_dict({'type': 'refract'})"
XML = '<scene version="3.0.0"><shape type="sphere"><bsdf type="refract"/></shape></scene>'
CASES = {
    "before any variant": f"import mitsuba as mi; import mi_refract; mi.set_variant('scalar_rgb'); {LOAD}",
    "before mitsuba": f"import mi_refract; import mitsuba as mi; mi.set_variant('scalar_rgb'); {LOAD}",
    "after a search for mitsuba": (
        "import mi_refract, importlib.util as u; assert u.find_spec('mitsuba') and u.find_spec('mitsuba.detail');"
        f"import mitsuba as mi; mi.set_variant('scalar_rgb'); {LOAD}"
    ),
    "from a part of mitsuba": f"import mi_refract, mitsuba.detail; mi = mitsuba; mi.set_variant('scalar_rgb'); {LOAD}",
    "after a variant, between variants and twice": (
        f"import mitsuba as mi; mi.set_variant('scalar_rgb'); import mi_refract, importlib; {LOAD};"
        f"mi.set_variant('scalar_spectral'); {LOAD}; mi.set_variant('scalar_rgb'); {LOAD};"
        f"importlib.reload(mi_refract); {LOAD}"
    ),
    "parsed from XML, where Mitsuba asks scalar_rgb": (
        "import mitsuba as mi; mi.set_variant('scalar_spectral'); import mi_refract;"
        f"config, xml = mi.parser.ParserConfig('scalar_spectral'), {XML!r};"
        "mi.parser.write_string(mi.parser.parse_string(config, xml)); mi.load_string(xml)"
    ),
}


def run(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=os.environ, timeout=120)


@pytest.mark.parametrize("case", CASES)
def test_the_plugin_is_known(case):
    outcome = run(CASES[case])
    assert outcome.returncode == 0, outcome.stderr


def test_without_the_import_the_plugin_is_unknown():
    outcome = run(f"import mitsuba as mi; mi.set_variant('scalar_rgb'); {LOAD}")
    assert outcome.returncode == 1


def test_switching_to_a_vectorised_variant_and_back():
    usable = [name for name, why in backend.usable_variants().items() if why is None and not name.startswith("scalar")]
    if not usable:
        pytest.skip("no LLVM or CUDA variant runs here")
    steps = [usable[0], "scalar_rgb", usable[-1], usable[0]]
    code = "import mitsuba as mi, mi_refract;" + "".join(f"mi.set_variant('{name}'); {LOAD};" for name in steps)
    outcome = run(code)
    assert outcome.returncode == 0, outcome.stderr


def test_the_import_brings_no_heavy_package():
    heavy = ("numpy", "OpenImageIO", "flint", "matplotlib", "scipy", "rich", "typer", "jinja2")
    outcome = run(f"import mitsuba, mi_refract, sys; print([m for m in {heavy!r} if m in sys.modules])")
    assert outcome.stdout.strip() == "[]", outcome.stderr


def test_the_import_waits_for_mitsuba_and_its_formulas_for_dr_jit():
    loaded = "[name in sys.modules for name in ('drjit', 'mitsuba')]"
    outcome = run(f"import mi_refract, sys; print({loaded}, mi_refract.reflect.__name__, {loaded})")
    assert outcome.stdout.strip() == "[False, False] reflect [True, False]", outcome.stderr


def test_an_attribute_that_is_not_there():
    outcome = run("import mi_refract; mi_refract.refelct")
    assert "module 'mi_refract' has no attribute 'refelct'" in outcome.stderr

"""`import mi_refract` before and after `set_variant`, the modules that it loads, and examples of the documentation.

Each case of the import runs in a new interpreter.
"""

import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest
from support.readme import DOCS, ROOT, python_blocks

from mi_refract import backend

LOAD = "mi.load_dict({'type': 'refract'})"
SET = "mi.set_variant('scalar_rgb')"
XML = '<scene version="3.0.0"><shape type="sphere"><bsdf type="refract"/></shape></scene>'
HEAVY = ("numpy", "OpenImageIO", "flint", "matplotlib", "scipy", "rich", "typer", "jinja2")
LOADED = "[name in sys.modules for name in ('drjit', 'mitsuba')]"
CASES = {  # code, and what it prints; for cases that fail, a part of the error
    "before any variant": (f"import mitsuba as mi; import mi_refract; {SET}; {LOAD}", ""),
    "before mitsuba": (f"import mi_refract; import mitsuba as mi; {SET}; {LOAD}", ""),
    "after a search for mitsuba": (
        "import mi_refract, importlib.util as u; assert u.find_spec('mitsuba') and u.find_spec('mitsuba.detail');"
        f"import mitsuba as mi; {SET}; {LOAD}",
        "",
    ),
    "from a part of mitsuba": (f"import mi_refract, mitsuba.detail; mi = mitsuba; {SET}; {LOAD}", ""),
    "after a variant, between variants and twice": (
        f"import mitsuba as mi; {SET}; import mi_refract, importlib; {LOAD};"
        f"mi.set_variant('scalar_spectral'); {LOAD}; {SET}; {LOAD}; importlib.reload(mi_refract); {LOAD}",
        "",
    ),
    "parsed from XML, for which Mitsuba uses scalar_rgb": (
        "import mitsuba as mi; mi.set_variant('scalar_spectral'); import mi_refract;"
        f"config, xml = mi.parser.ParserConfig('scalar_spectral'), {XML!r};"
        "mi.parser.write_string(mi.parser.parse_string(config, xml)); mi.load_string(xml)",
        "",
    ),
    "not imported": (f"import mitsuba as mi; {SET}; {LOAD}", "Error"),
    "a missing name": ("import mi_refract; mi_refract.refelct", "'mi_refract' has no attribute 'refelct'"),
    "no heavy package": (f"import mitsuba, mi_refract, sys; print([m for m in {HEAVY!r} if m in sys.modules])", "[]"),
    "mitsuba and Dr.Jit only when needed": (
        f"import mi_refract, sys; print({LOADED}, mi_refract.reflect.__name__, {LOADED})",
        "[False, False] reflect [True, False]",
    ),
}


def run(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize("case", CASES)
def test_the_plugin_is_registered_by_the_import(case):
    code, text = CASES[case]
    process = run(code)
    if case in ("not imported", "a missing name"):
        assert process.returncode != 0 and text in process.stderr
    else:
        assert process.returncode == 0, process.stderr
        assert process.stdout.strip() == text


def test_switching_to_a_vectorised_variant_and_back():
    usable = [name for name, why in backend.usable_variants().items() if why is None and not name.startswith("scalar")]
    if not usable:
        pytest.skip("no LLVM or CUDA variant runs here")
    steps = [usable[0], "scalar_rgb", usable[-1], usable[0]]
    process = run("import mitsuba as mi, mi_refract;" + "".join(f"mi.set_variant('{x}'); {LOAD};" for x in steps))
    assert process.returncode == 0, process.stderr


def example(path, **changes):
    code = "".join(python_blocks(path))
    for old, new in changes.values():
        assert old in code
        code = code.replace(old, new)
    names = {}
    exec(code, names)
    return names


def test_the_example_of_the_plugin_in_a_scene(tmp_path, monkeypatch, llvm_variant):
    monkeypatch.chdir(ROOT)
    example(
        DOCS / "how-to/render-with-the-plugin.md",
        output=('"diamond.png"', f'r"{tmp_path}/diamond.png"'),
        outputs=('f"diamond-', f'rf"{tmp_path}/diamond-'),
        size=('bsdf="refract"', 'bsdf="refract", res=8, spp=1'),
        wait=("mi.render(scene)", "mi.render(scene), write_async=False"),
    )
    assert (tmp_path / "diamond.png").stat().st_size > 0
    frozen = [np.array(mi.Bitmap(str(path))) for path in sorted(tmp_path.glob("diamond-*.exr"))]
    assert len(frozen) == 3 and not np.array_equal(frozen[0], frozen[2])  # of different indices


def test_the_example_of_the_first_page(tmp_path, monkeypatch, llvm_variant):
    monkeypatch.chdir(tmp_path)
    size = ('"width": 400, "height": 300', '"width": 8, "height": 6')
    example(ROOT / "README.md", size=size, wait=("spp=64)", "spp=4), write_async=False"))
    image = np.array(mi.Bitmap(str(tmp_path / "ball.png")))
    assert image.shape == (6, 8, 3) and image[0, 0].min() == 255 > image[3, 0].max()  # the sky, and the floor


def test_the_example_that_recovers_an_index_from_an_image(capsys, llvm_variant):
    page = DOCS / "how-to/recover-an-index-from-an-image.md"
    names = example(page, pixels=('"width": 64, "height": 64', '"width": 24, "height": 24'), steps=("60", "50"))
    (eta,) = names["adam"]["ball.bsdf.eta"]
    assert eta == pytest.approx(1.6, abs=0.05)
    assert capsys.readouterr().out.startswith("[1.")

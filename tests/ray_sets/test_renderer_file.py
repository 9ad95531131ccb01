"""Renderers described by `mi-refract-renderer.toml`."""

import json
import re
import shutil
import sys
from xml.etree import ElementTree

import pytest
from support.readme import DOCS, blocks, python_blocks

from mi_refract.ray_sets import renderer_file

RAYS = '[[rays]]\ntitle = "r"\nprecision = "f32"\ncommand = ["./r"]\n'
TITLED = f'title = "T"\n{RAYS}'


@pytest.fixture
def folder(tmp_path):
    """`folder(toml)`: a folder with a renderer file of this text."""

    def make(text):
        (tmp_path / "mine").mkdir(exist_ok=True)
        (tmp_path / "mine" / renderer_file.NAME).write_text(text)
        return tmp_path / "mine"

    return make


def test_the_program_of_the_page_compiles_and_is_right(folder, run):
    (program,), (text,) = (blocks(DOCS / "how-to/describe-a-renderer.md", language) for language in ("c", "toml"))
    assert len(program.splitlines()) <= 20
    if not shutil.which("cc"):
        pytest.skip("no C compiler in PATH")
    where = folder(text)
    (where / "tracer.c").write_text(program)
    status, out, err = run("rays", "run", "--renderer", where, "--regime", "generic", "--regime", "critical")
    assert (status, err) == (0, "")
    assert "My tracer, in C: 2000 rays, 2 regimes, f64" in out and "2000 answers, all right" in out
    (where / "tracer.c").write_text(program.replace("from / to", "to / from"))
    status, out, _ = run("rays", "run", "--renderer", where, "--regime", "generic")
    assert status == 1 and "eta inverted" in out


def test_the_content_of_a_file(folder):
    text = f"""title = "T"
licence = "L"
{RAYS}total_internal_reflection = "nan"
gives_up = 1e-6
recorded = {{ random = 1e-6, near-critical = [1e-4, 2e-4] }}
[[rays.deviation]]
regime = "random"
reason = "rounds η"
[images]
export = "json"
command = ["{{python}}", "{{scene}}", "{{spp}}", "{{seed}}", "{{image}}"]
spp = {{ sphere = 64 }}
deviation = {{ prism = "no dispersion" }}
"""
    renderer = renderer_file.load(folder(text))
    (function,) = renderer.rays
    assert (renderer.title, renderer.licence, function.tir, function.gives_up) == ("T", "L", "nan", 1e-6)
    assert [function.recorded_range(x) for x in ("random", "near-critical", "x")] == [(1e-6, 1e-6), (1e-4, 2e-4), None]
    assert function.deviations == {"random": "rounds η"}
    assert renderer.images.spp == {"sphere": 64} and renderer.images.deviations == {"prism": "no dispersion"}
    words = renderer_file.filled(renderer.images.command, scene="/s", spp=4, seed=1, image="i.exr")
    assert words == [sys.executable, "/s", "4", "1", "i.exr"]


REFUSED = {
    "object missing required field `title`": "",
    "no [[rays]] and no [images]; expected one of them": 'title = "T"\n',
    "rays[0]: unknown key `speed`; expected title, precision": f"{TITLED}speed = 3\n",
    "rays[0].precision: invalid enum value 'f16'; expected f32, f64": TITLED.replace("f32", "f16"),
    "rays: two functions have the title 'r, f32'": TITLED + RAYS,
    "rays[0]: command: {rays}: 'rays'; expected {python}": TITLED.replace("./r", "{rays}"),
    "command: {python:>3000000000}: 'python'; expected {python}": TITLED.replace("./r", "{python:>3000000000}"),
    "command: {python!r}: 'python'; expected {python}": TITLED.replace("./r", "{python!r}"),
    "command: {python.x}: 'python.x'; expected {python}": TITLED.replace("./r", "{python.x}"),
    "command: {: Single '{' encountered in format string; expected {python}": TITLED.replace("./r", "{"),
    "rays[0].gives_up: expected a number >= 0": f"{TITLED}gives_up = -1\n",
    "rays[0].recorded.random: nan; expected a finite number": f"{TITLED}recorded = {{ random = nan }}\n",
    "deviation[0]: object missing required field `reason`": f'{TITLED}[[rays.deviation]]\nregime = "x"\n',
    "images.spp[...]: expected a whole number >= 1": (
        'title = "T"\n[images]\nexport = "json"\ncommand = ["x"]\nspp = { a = 0 }\n'
    ),
    "Invalid value": "title = ",
    "brackets nested too deeply": "x = " + "[" * 100_000,
} | {
    f"random: {x}; expected a number above 0": f"{TITLED}recorded = {{ random = {x} }}\n"
    for x in ("[2.0, 1.0]", "[1.0]", "-1.0", "0.0")
}


@pytest.mark.parametrize("message", REFUSED)
def test_errors_of_invalid_files_are_one_line(folder, message):
    where = folder(REFUSED[message])
    with pytest.raises(ValueError) as caught:
        renderer_file.load(where)
    text = str(caught.value)
    assert text.startswith(f"{where / renderer_file.NAME}: ") and message in text and "\n" not in text


PROGRAM = python_blocks(DOCS / "how-to/check-a-shaders-rays.md")[0]
INVERTED = PROGRAM.replace("rows[:, 7:8] / rows[:, 8:9]", "rows[:, 8:9] / rows[:, 7:8]")


@pytest.mark.parametrize(
    ("programs", "signal", "option", "expected"),
    [
        (("right", "right"), "auto", (), 0),
        (("wrong", "right"), "auto", (), 1),
        (("right", "wrong"), "zero", (), 1),
        (("right",), "nan", (), 1),
        (("right",), "nan", ("--tir", "zero"), 0),  # the option overrides the file
        (("none", "right"), "auto", (), 2),
        (("right",), "auto", ("--precision", "f64"), 2),
        (("right",), "auto", ("--", "true"), 2),
    ],
)
def test_every_function_is_checked_and_known_deviations_fail(folder, run, tmp_path, programs, signal, option, expected):
    """The functions signal total internal reflection by zeros."""
    text = "title = 'T'\n"
    for i, name in enumerate(programs):
        text += f"[[rays]]\ntitle = 'function {i}'\nprecision = 'f32'\ncommand = ['{{python}}', '{name}.py']\n"
        text += f"total_internal_reflection = '{signal}'\n"
        text += "[[rays.deviation]]\nregime = 'critical'\nreason = 'inverts k'\n" * (name == "wrong")
    where = folder(text)
    (where / "right.py").write_text(PROGRAM)
    (where / "wrong.py").write_text(INVERTED)
    page, suites, data = (tmp_path / f"out.{ending}" for ending in ("html", "xml", "json"))
    reports = ("--report", page, "--junit", suites, "--json", data)
    words = ("--renderer", where, "--regime", "critical", "--count", 20, *reports, *option)
    status, out, err = run("rays", "run", *words)
    assert status == expected, out + err
    assert ("known deviation of function" in out and ": critical: inverts k" in out) == ("wrong" in programs)
    assert ("zero vector, which is not the signal" in out) == (signal == "nan" and not option)
    if option and expected:
        errors = {"--precision": "no function in f64", "--": "expected one of them"}
        assert errors[option[0]] in err and err.count("\n") == 1
    assert data.exists() == (expected < 2)
    if data.exists():
        document, html = json.loads(data.read_text()), page.read_text()
        titles = [f"function {i}, f32" for i in range(len(programs))]
        codes = [int(name == "wrong" or (signal == "nan" and not option)) for name in programs]
        functions = [(function["title"], function["exit_code"]) for function in document["functions"]]
        assert (document["exit_code"], functions) == (expected, [*zip(titles, codes, strict=True)])
        assert [suite.get("name") for suite in ElementTree.parse(suites).getroot()] == titles
        assert all(f"<h1>{function['sentence']}</h1>" in html for function in document["functions"])
        links = re.findall('href="#([^"]+)"', html)
        assert ("check-2" in links) == (len(titles) == 2)
        assert [html.count(f'id="{link}"') for link in links] == [1] * len(links)


@pytest.mark.parametrize(
    ("precision", "option", "titles"),
    [("f32", (), ["single, f32"]), ("f64", (), ["double, f64"]), ("f64", ("--precision", "f32"), None)],
)
def test_a_file_of_rays_is_for_the_functions_of_its_precision(folder, run, tmp_path, precision, option, titles):
    """The program rounds to float32: that is right for the first function, and wrong for the second."""
    functions = {"single": "f32", "double": "f64"}
    entry = "[[rays]]\ntitle = '{}'\nprecision = '{}'\ncommand = ['{{python}}', 'right.py']\n"
    text = "".join(entry.format(*function) for function in functions.items())
    where, rays, data = folder(f"title = 'T'\n{text}"), tmp_path / "rays.csv", tmp_path / "out.json"
    (where / "right.py").write_text(PROGRAM)
    run("rays", "export", "--precision", precision, "--regime", "generic", "--count", 20, "-o", rays)
    status, out, err = run("rays", "run", "--renderer", where, "--rays", rays, "--json", data, *option)
    if titles is None:
        assert status == 2 and "no function in f32 and f64" in err and err.count("\n") == 1
    else:
        assert status == (precision == "f64"), out + err
        assert [x["title"] for x in json.loads(data.read_text())["functions"]] == titles


def test_rays_run_uses_only_the_keys_that_the_page_names(folder, run):
    unused = """gives_up = 0.5
lengths = "refused"
remark = "R"
recorded = { generic = 1e-3 }
[images]
export = "mitsuba"
command = ["none"]
spp = { sphere = 64 }
"""
    outputs = []
    for text in ("", unused):
        where = folder(TITLED.replace("./r", "{python}").replace('"]', '", "right.py"]') + text)
        (where / "right.py").write_text(f"print('# system: S 1')\n{PROGRAM}")
        outputs.append(run("rays", "run", "--renderer", where, "--regime", "generic", "--count", 20))
    assert outputs[0] == outputs[1] and outputs[0][0] == 0 and "S 1" not in outputs[0][1]

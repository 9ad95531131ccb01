"""A folder with `mi-refract-renderer.toml` is a renderer."""

import shutil
import sys
from pathlib import Path

import pytest
from support.readme import python_blocks

from mi_refract.ray_sets import ray_set, renderer_file

README = Path(ray_set.__file__).with_name("README.md")
RAYS = '[[rays]]\ntitle = "r"\nprecision = "f32"\ncommand = ["./r"]\n'


def code(language):
    """The first block of that language after the heading of this section."""
    section = README.read_text().split("## A renderer in a folder")[1]
    return section.split(f"```{language}\n")[1].split("```")[0]


@pytest.fixture
def folder(tmp_path):
    """`folder(toml)`: a folder with such a file."""

    def made(text, name="mine"):
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / renderer_file.NAME).write_text(text)
        return tmp_path / name

    return made


def test_the_readme_s_program_is_compiled_and_right(folder, run):
    if not shutil.which("cc"):
        pytest.skip("no C compiler in PATH")
    where = folder(code("toml"))
    (where / "tracer.c").write_text(code("c"))
    assert len(code("c").splitlines()) <= 20
    status, out, err = run("rays", "run", "--renderer", where, "--regime", "generic", "--regime", "critical")
    assert (status, err) == (0, "")
    assert "My tracer, in C: 2000 rays, 2 regimes, f64" in out and "2000 answers, all right" in out
    (where / "tracer.c").write_text(code("c").replace("from / to", "to / from"))
    status, out, _ = run("rays", "run", "--renderer", where, "--regime", "generic")
    assert status == 1 and "eta inverted" in out


def test_the_keys_in_the_readme_are_those_of_the_file():
    assert renderer_file.reference() in README.read_text()


def test_what_a_file_says(folder):
    text = f"""title = "T"
licence = "L"
{RAYS}total_internal_reflection = "nan"
gives_up = 1e-6
lengths = "as they are"
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
    found = renderer_file.load(folder(text))
    (call,) = found.rays
    assert (found.title, found.licence, call.tir, call.gives_up) == ("T", "L", "nan", 1e-6)
    assert [call.recorded_range(x) for x in ("random", "near-critical", "x")] == [(1e-6, 1e-6), (1e-4, 2e-4), None]
    assert call.deviations == {"random": "rounds η"}
    assert found.images.spp == {"sphere": 64} and found.images.deviations == {"prism": "no dispersion"}
    words = renderer_file.filled(found.images.command, scene="/s", spp=4, seed=1, image="i.exr")
    assert words == [sys.executable, "/s", "4", "1", "i.exr"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "object missing required field `title`"),
        ('title = "T"\n', "no [[rays]] and no [images]; expected one of them"),
        (f'title = "T"\n{RAYS}speed = 3\n', "rays[0]: unknown key `speed`; expected title, precision"),
        (
            f'title = "T"\n{RAYS.replace("f32", "f16")}',
            "rays[0].precision: invalid enum value 'f16'; expected f32, f64",
        ),
        (f'title = "T"\n{RAYS}{RAYS}', "rays: two functions have the title 'r, f32'"),
        (f'title = "T"\n{RAYS.replace("./r", "{rays}")}', "rays[0]: command: {rays}: 'rays'; expected {python}"),
        (f'title = "T"\n{RAYS}gives_up = -1\n', "rays[0].gives_up: expected `float` >= 0"),
        *(
            (f'title = "T"\n{RAYS}recorded = {{ random = {x} }}\n', f"random: {x}; expected a number above 0")
            for x in ("[2.0, 1.0]", "[1.0]", "-1.0", "0.0")
        ),
        (f'title = "T"\n{RAYS}recorded = {{ random = nan }}\n', "rays[0].recorded.random: expected a finite number"),
        (
            f'title = "T"\n{RAYS}[[rays.deviation]]\nregime = "x"\n',
            "deviation[0]: object missing required field `reason`",
        ),
        (
            'title = "T"\n[images]\nexport = "json"\ncommand = ["x"]\nspp = { a = 0 }\n',
            "images.spp[...]: expected `int` >= 1",
        ),
        ("title = ", "Invalid value"),
        ("x = " + "[" * 100_000, "brackets nested too deeply"),
    ],
)
def test_a_file_that_is_none_is_refused_in_a_line(folder, text, said):
    where = folder(text)
    with pytest.raises(ValueError) as caught:
        renderer_file.load(where)
    assert str(caught.value).startswith(f"{where / renderer_file.NAME}: ") and said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--precision", "f64"), "no function in f64; expected [[rays]]"),
        (("--", "true"), "expected one of them"),
    ],
)
def test_options_that_contradict_a_renderer(folder, run, options, said):
    status, _, err = run("rays", "run", "--renderer", folder(f'title = "T"\n{RAYS}'), *options)
    assert status == 2 and said in err and err.count("\n") == 1


PROGRAM = python_blocks(README)[0]
INVERTED = PROGRAM.replace("rows[:, 7:8] / rows[:, 8:9]", "rows[:, 8:9] / rows[:, 7:8]")


@pytest.fixture
def renderer(folder):
    """`renderer("right", "wrong")`: a folder with these functions; `signal` is what each declares."""

    def made(*programs, signal="auto"):
        text = "title = 'T'\n"
        for i, name in enumerate(programs):
            text += f"[[rays]]\ntitle = 'function {i}'\nprecision = 'f32'\ncommand = ['{{python}}', '{name}.py']\n"
            text += f"total_internal_reflection = '{signal}'\n"
            text += "[[rays.deviation]]\nregime = 'critical'\nreason = 'inverts k'\n" * (name == "wrong")
        where = folder(text)
        (where / "right.py").write_text(PROGRAM)
        (where / "wrong.py").write_text(INVERTED)
        return "rays", "run", "--renderer", where, "--regime", "critical", "--count", 20

    return made


@pytest.mark.parametrize("programs", [("right", "right"), ("wrong", "right"), ("right", "wrong")])
def test_one_wrong_function_of_a_renderer_is_enough_and_a_known_deviation_excuses_nothing(renderer, run, programs):
    status, out, _ = run(*renderer(*programs))
    assert status == programs.count("wrong") == out.count("answers are wrong"), out
    assert ("known deviation of function" in out and ": critical: inverts k" in out) == bool(status)


@pytest.mark.parametrize(
    ("signal", "option", "expected"), [("zero", (), 0), ("auto", (), 0), ("nan", (), 1), ("nan", ("--tir", "zero"), 0)]
)
def test_the_declared_signal_of_total_internal_reflection_is_that_of_the_check(renderer, run, signal, option, expected):
    """The function answers zeros. An option goes before the declaration."""
    status, out, _ = run(*renderer("right", signal=signal), *option)
    assert status == expected, out
    assert ("zero vector, which is not the signal" in out) == bool(expected)


def test_a_function_that_fails_is_an_error(folder, run):
    assert (
        run("rays", "run", "--renderer", folder(f'title = "T"\n{RAYS.replace("./r", "false")}'), "--count", 5)[0] == 2
    )

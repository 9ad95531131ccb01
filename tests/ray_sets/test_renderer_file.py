"""A folder with `mi-refract-renderer.toml` is a renderer."""

import shutil
import sys
from pathlib import Path

import pytest

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
    assert (found.name, found.title, found.licence, call.tir, call.gives_up) == ("mine", "T", "L", "nan", 1e-6)
    assert call.recorded == {"random": (1e-6, 1e-6), "near-critical": (1e-4, 2e-4)}
    assert call.deviations == {"random": "rounds η"}
    assert found.images.spp == {"sphere": 64} and found.images.deviations == {"prism": "no dispersion"}
    words = renderer_file.filled(found.images.command, scene="/s", spp=4, seed=1, image="i.exr")
    assert words == [sys.executable, "/s", "4", "1", "i.exr"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "title: missing"),
        ('title = "T"\n', "rays: missing; expected [[rays]], [images] or both"),
        (f'title = "T"\n{RAYS}speed = 3\n', "rays[0].speed: unknown"),
        (f'title = "T"\n{RAYS.replace("f32", "f16")}', "rays[0].precision: 'f16'"),
        (f'title = "T"\n{RAYS}{RAYS}', "rays: 'r, f32' is there twice"),
        (f'title = "T"\n{RAYS.replace("./r", "{rays}")}', "command: {rays}: 'rays'; expected {python}"),
        (f'title = "T"\n{RAYS}gives_up = -1\n', "rays[0].gives_up: -1"),
        (
            f'title = "T"\n{RAYS}recorded = {{ random = [2, 1] }}\n',
            "rays[0].recorded.random: [2, 1]; expected a number",
        ),
        (f'title = "T"\n{RAYS}[[rays.deviation]]\nregime = "x"\n', "rays[0].deviation[0].reason: missing"),
        ('title = "T"\n[images]\nexport = "json"\ncommand = ["x"]\nspp = { a = 0 }\n', "images.spp.a: 0; expected"),
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


def test_a_known_deviation_is_named_and_excuses_nothing(folder, run):
    call = RAYS.replace('["./r"]', '["cat", "/dev/null"]')
    where = folder(f'title = "T"\n{RAYS.replace("./r", "false")}')
    assert run("rays", "run", "--renderer", where, "--count", 5)[0] == 2
    program = (
        "import sys; print('id,bx,by,bz'); [print(f'{r.split(\",\")[0]},0,0,1') for r in sys.stdin if r[0].isdigit()]"
    )
    call = RAYS.replace('["./r"]', f"['{{python}}', '-c', '''{program.replace('{', '{{').replace('}', '}}')}''']")
    where = folder(f'title = "T"\n{call}[[rays.deviation]]\nregime = "generic"\nreason = "always along z"\n')
    status, out, _ = run("rays", "run", "--renderer", where, "--regime", "generic", "--count", 20)
    assert status == 1 and "known of r: generic: always along z" in out

"""`mi-refract rays`: its output, reports and errors, with programs that answer rays."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from support.media_rays import CROWN, FLINT
from support.ray_programs import glsl
from support.readme import DOCS, blocks, python_blocks

from mi_refract.ray_sets import files, ray_set

# A renderer's program, without this package. Its line on stderr must be passed on.
PROGRAM = """
import sys, numpy as np
rows = [line for line in sys.stdin if not line.startswith("#")][1:]
x = np.array([row.split(",") for row in rows]).astype(np.float32)
a, n, k = x[:, 1:4], x[:, 4:7], x[:, 7:8] / x[:, 8:9]
if "inverted" in sys.argv:
    k = 1 / k
c = (n * a).sum(1, keepdims=True)
radicand = 1 - k * k * (1 - c * c)
b = np.where(radicand < 0, 0, k * a - (k * c + np.sqrt(np.maximum(radicand, 0))) * n)
print("traced", len(b), file=sys.stderr)
print("id,bx,by,bz")
for i, row in zip(x[:, 0], b):
    print("%d,%r,%r,%r" % (i, *map(float, row)))
"""
FEW = ("--regime", "generic", "--regime", "critical", "--count", "60")


@pytest.fixture
def program(tmp_path):
    path = tmp_path / "refract.py"
    path.write_text(PROGRAM)
    return [sys.executable, str(path)]


@pytest.fixture
def call(tmp_path, monkeypatch, run):
    """`call("check", …)`: exit code, stdout and stderr of `mi-refract rays …`, run in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: run("rays", *arguments)


def one_line(out):
    """Return the output as one line, after checking that its lines fit on a terminal."""
    assert max(map(len, out.splitlines()[1:])) <= 80  # the first line begins with the name of the program
    return " ".join(out.split())


def write_answers(rays, header=()):
    b = glsl(rays.rays.a, rays.rays.n, rays.rays.k).astype(float)
    rows = [f"{i},{x!r},{y!r},{z!r}" for i, (x, y, z) in zip(rays.ids, b.tolist(), strict=True)]
    Path("answers.csv").write_text("\n".join([*header, "id,bx,by,bz", *rows, ""]))


# export and check


def test_export_and_check(call):
    code, out, err = call("export", *FEW, "--precision", "f64", "--seed", 3, "-o", "rays.csv")
    assert (code, out, err) == (0, "rays.csv: 120 rays, 2 regimes, f64, seed 3\n", "")
    write_answers(files.read("rays.csv"))
    code, out, err = call("check", "answers.csv", "--rays", "rays.csv")
    assert (code, err) == (0, "")
    assert "120 answers, all right; the largest error is" in out
    assert "(direction and length are exact for inputs perturbed by at most 8 roundings)" in one_line(out)
    assert "signalled by the zero vector (detected)" in out
    code, out, _ = call("check", "answers.csv", "--rays", "rays.csv", "--error-bound", "promoted")
    assert code == 1 and ("none of the common mistakes explains" in out or "nearest of the common" in out)
    code, out, err = call("export", "--regimes")
    assert (code, err, len(out.splitlines()), "only with --regime" in out) == (0, "", 19, True)
    assert call("export", "--regime", "k >> 1", "--count", 60, "-o", "rays.csv")[0] == 0
    write_answers(files.read("rays.csv"))
    check = "check", "answers.csv", "--rays", "rays.csv"
    assert call(*check)[0] == 0
    code, out, _ = call(*check, "--backward-error", "8", "--report", "out.html")
    assert code == 1 and out.splitlines()[-1].endswith("of 60 answers are wrong")
    assert "--backward-error 8" in Path("out.html").read_text()
    Path("answers.csv").write_text("id,bx,by,bz\n0,0,1,0\n1,0,1")
    code, out, err = call(*check)
    assert (code, out, err) == (2, "", "mi-refract: answers.csv: line 3 is '1,0,1'; expected 4 numbers\n")


def test_answers_do_not_select_the_rays(call):
    """Right answers to one easy ray, with the header of that ray, are refused for other rays."""
    rays = ray_set.make(["near-normal"], 1)
    header = [line for line in files.as_csv(rays).splitlines() if line.startswith("#")]
    files.write("one.csv", rays)
    files.write("others.csv", ray_set.make())
    write_answers(rays, header)
    assert call("check", "answers.csv", "--rays", "one.csv")[0] == 0
    code, _, err = call("check", "answers.csv", "--rays", "others.csv")
    assert (code, "the answers belong to rays with the checksum 'sha256:" in err) == (2, True)
    write_answers(rays, [line for line in header if "checksum" not in line])
    code, out, _ = call("check", "answers.csv", "--rays", "others.csv")
    assert (code, "12999 without an answer" in out) == (2, True)
    write_answers(ray_set.make())
    code, out, _ = call("check", "answers.csv")
    assert (code, out.splitlines()[0]) == (0, "answers.csv: 13000 rays, 13 regimes, f32, seed 0")


CHECK = ("check", "a.csv", "--rays", "r.csv")
OF_MEDIA = ("--medium", CROWN, "--medium", FLINT, "--wavelengths", "486.1327,587.5618")
BAD_OPTIONS = {
    "--count": ("export", "--count", "0", "-o", "r.csv"),
    "expected a file name that ends in .csv or .npz": ("export", "-o", "r.txt"),
    "is not a folder": ("export", "-o", "none/r.csv"),
    "--output": ("export",),
    "TIR signal 'zeros': unknown; expected auto, zero": (*CHECK, "--tir", "zeros"),
    "r.pdf: expected": (*CHECK, "--report", "r.pdf"),
    "No such file": CHECK,
    "COMMAND": ("run",),
    "--rays r.csv and --count: both choose the rays": ("run", "--rays", "r.csv", "--count", "5", "--", "true"),
    "--rays r.csv and --medium: both choose the rays": ("run", *OF_MEDIA, "--rays", "r.csv", "--", "true"),
    "Invalid value for '--timeout'": ("run", "--timeout", "nan", "--", "true"),
    "--timeout inf; expected": ("run", "--timeout", "inf", "--", "true"),
    "./no-such-program x: cannot be started: No such file": ("run", *FEW, "--", "./no-such-program", "x"),
    "--wavelengths F,d; expected numbers in nm": ("run", "--medium", CROWN, "--wavelengths", "F,d", "--", "true"),
    "--wavelengths ; expected numbers in nm": ("run", "--medium", CROWN, "--wavelengths", "", "--", "true"),
    "--wavelengths 5_00; expected numbers in nm": ("run", "--medium", CROWN, "--wavelengths", "5_00", "--", "true"),
    "Missing command": (),
}


@pytest.mark.parametrize("message", BAD_OPTIONS)
def test_invalid_options(call, message):
    code, out, err = call(*BAD_OPTIONS[message])
    assert code == 2 and err.startswith("mi-refract: ") and message in err
    assert (out, err.count("\n")) == ("", 1) or not BAD_OPTIONS[message]
    assert not list(Path.cwd().iterdir())


def test_missing_packages_and_pipes_are_refused_before_rays_are_made(call, monkeypatch):
    find = importlib.util.find_spec
    for package, words in (("flint", ()), ("jinja2", ("--report", "out.html"))):
        with monkeypatch.context() as patch:
            patch.setattr(importlib.util, "find_spec", lambda name, gone=package: None if name == gone else find(name))
            code, _, err = call(*CHECK, *words)
        assert (code, "pip install 'mi-refract[validation]'" in err) == (2, True)
    os.mkfifo("rays.csv")
    monkeypatch.setattr(ray_set, "make", lambda *names, **options: pytest.fail("made"))
    code, out, err = call("export", "-o", "rays.csv")
    assert (code, out, err) == (2, "", "mi-refract: rays.csv: is a pipe; expected the name of a file\n")


# run


def test_right_and_wrong_programs_in_every_report(call, program):
    code, out, err = call("run", *FEW, "--json", "out.json", "--", *program)
    assert (code, err) == (0, "traced 120\n") and "120 rays, 2 regimes, f32, seed 0" in out
    assert json.loads(Path("out.json").read_text())["exit_code"] == 0
    reports = ("--report", "out.html", "--junit", "out.xml", "--json", "out.json")
    code, out, _ = call("run", *FEW, *reports, "--", *program, "inverted")
    assert code == 1 and "eta inverted" in out
    page = Path("out.html").read_text()
    assert "mi-refract rays run --regime generic --regime critical --count 60 --report out.html " in page
    assert "mi_refract:version" not in page  # a key of EXR files
    assert ElementTree.parse("out.xml").getroot().get("failures") == "3"
    (function,) = json.loads(Path("out.json").read_text())["functions"]
    assert function["diagnosis"] == "eta inverted"
    files.write("rays.npz", ray_set.make(["generic"], 50, "f32", 3))
    code, out, _ = call("run", "--rays", "rays.npz", "--", *program, "inverted")
    assert (code, out.splitlines()[-1]) == (1, "50 of 50 answers are wrong: eta inverted")
    code, out, _ = call("run", *FEW, "--", sys.executable, "-c", "print('id,bx,by,bz')")
    assert (code, out.splitlines()[-1]) == (2, "no ray was answered") and "" not in out.splitlines()


def test_output_equals_the_how_to_page_with_and_without_table(call, program):
    """Numbers are masked: their last digits depend on NumPy."""
    page = DOCS / "how-to/check-a-shaders-rays.md"
    Path("my_tracer.py").write_text(python_blocks(page)[0])
    code, out, _ = call("run", "--", sys.executable, "my_tracer.py")
    shown, wrong = (re.sub("[0-9.]+", "#", " ".join(text.split())) for text in blocks(page, "text"))
    assert code == 0 and len(out.splitlines()) < 12
    assert re.sub("[0-9.]+", "#", one_line(out.replace(sys.executable, "python"))) == shown
    code, out, _ = call("run", *FEW, "--table", "--", *program, "inverted")
    assert code == 1 and re.sub("[0-9.]+", "#", " ".join(out.split())).endswith(wrong)
    (head,) = (line for line in out.splitlines() if "p99 / ulp" in line)
    assert len(head.split("  ")) > 17 and "wrong  every regime" in out


@pytest.mark.parametrize("command", ["export", "check", "run"])
def test_help_names_only_options_of_the_command(call, command):
    code, out, _ = call(command, "--help")
    options = set(re.findall("^  (?:-o, )?(--[a-z-]+)", out, re.MULTILINE))
    assert (code, set(re.findall("--[a-z][a-z-]+", out)) - options) == (0, set())


BAD_PROGRAMS = {
    "ended with status 3; expected": "import sys; sys.stdin.read(); print('id,bx,by,bz'); sys.exit(3)",
    "was killed by SIGSEGV; expected": "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)",
    "the table is empty": "pass",
    "bytes of output; expected one answer per ray": "while True: print('id,bx,by,bz' * 1000)",
    "the first row is 'hello'": "print('hello'); print('id,bx,by,bz')",
    "not text": "import os; os.write(1, bytes(range(256)))",
}


@pytest.mark.parametrize("message", BAD_PROGRAMS)
def test_programs_that_fail(call, message):
    code, out, err = call("run", *FEW, "--", sys.executable, "-c", BAD_PROGRAMS[message])
    assert (code, out) == (2, "") and err.startswith(f"mi-refract: {sys.executable} -c ") and message in err


def test_a_program_that_does_not_end_in_time(call):
    code, _, err = call("run", *FEW, "--timeout", 0.2, "--", "sleep", "600")
    assert (code, "did not finish within 0.2 s; set a longer --timeout" in err) == (2, True)


def test_answers_beyond_a_pipe_buffer_and_environment_and_folder(tmp_path):
    """A program that answers before it has read all rays; and one that reads none."""
    echo = "import sys; print('id,bx,by,bz')\nfor i in range(3000): print(f'{i},0,0,{i}' + ' ' * 50)\n"
    for rest in ("sys.stdin.read()", ""):
        answers = files.answers_of([sys.executable, "-u", "-c", echo + rest], ray_set.make(["generic"], 3000))
        np.testing.assert_array_equal(answers.b[:, 2], np.arange(3000))
    code = "import os; print('id,bx,by,bz'); print('0,0,0,' + os.environ['Z']); open('here', 'w')"
    env = {**os.environ, "Z": "7"}
    answers = files.answers_of([sys.executable, "-c", code], ray_set.make(["generic"], 1), cwd=tmp_path, env=env)
    assert answers.b[0, 2] == 7 and (tmp_path / "here").exists()


# Media

GLASSES = ("--regime", "generic", "--count", 20, "--precision", "f64", "--seed", 4, *OF_MEDIA)
# A program that computes its own indices, from the names of the media.
TRACER = """
import sys, json, numpy as np
lines = sys.stdin.read().splitlines()
media = next(json.loads(line[9:]) for line in lines if line.startswith("# media: "))
rows = [line.split(",") for line in lines if not line.startswith("#")]
assert rows[0][9:] == ["wavelength", "medium"], rows[0]
x = np.array(rows[1:], float)
def index(name, w):
    if name == "air":
        return 1.0
    return 1.5046 + 4200 / w**2 if "cauchy" in name else np.interp(w, [400, 500, 700], [1.85, 1.80, 1.76])
k = np.array([[index(media[int(i)][0], w) / index(media[int(i)][1], w)] for w, i in x[:, 9:]])
a, n = x[:, 1:4], x[:, 4:7]
c = (n * a).sum(1, keepdims=True)
radicand = 1 - k * k * (1 - c * c)
b = np.where(radicand < 0, 0, k * a - (k * c + np.sqrt(np.maximum(radicand, 0))) * n)
print("id,bx,by,bz,n_ratio")
for i, row, r in zip(x[:, 0], b.tolist(), k[:, 0].tolist()):
    print("%d,%r,%r,%r,%r" % (i, *row, r))
"""


def test_a_lens_tracer_with_its_own_indices(call, tmp_path):
    summary = "rays.csv: 20 rays, 1 regime, f64, seed 4, 2 media at 2 wavelengths\n"
    assert call("export", *GLASSES, "-o", "rays.csv")[:2] == (0, summary)
    (tmp_path / "tracer.py").write_text(TRACER)
    for rays in (("--rays", "rays.csv"), GLASSES):
        words = ("run", *rays, "--json", "out.json", "--report", "out.html", "--", sys.executable, "tracer.py")
        assert call(*words)[::2] == (0, "")
        assert json.loads(Path("out.json").read_text())["functions"][0]["n_ratio"]["largest"] < 1e-15
    assert "--wavelengths 486.1327,587.5618" in Path("out.html").read_text()
    (tmp_path / "tracer.py").write_text(TRACER.replace("1.5046", "1.506"))
    code, out, _ = call("run", *GLASSES, "--", sys.executable, "tracer.py")
    assert code == 1 and "10 answers used a different ratio of indices (n_ratio): ids 0, 2, 4, 6, 8, …" in out
    assert one_line(out).endswith("; 10 answers are for a different ratio of indices")


@pytest.mark.filterwarnings("default")
def test_an_extrapolated_index_is_a_warning_in_one_line(call):
    code, _, err = call("export", "--medium", "CDGM:D-ZF93", "--wavelengths", "2325", "-o", "r.csv")
    assert (code, err.count("\n")) == (0, 1)
    assert err.startswith("mi-refract: CDGM:D-ZF93: the index at 2325 nm is an extrapolation; ")

"""`mi-refract rays` with media and wavelengths."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from support.media_rays import CROWN, FLINT, MEDIA, answered

from mi_refract.ray_sets import files, media_rays, ray_set

OPTIONS = ("--medium", CROWN, "--medium", FLINT, "--wavelengths", "486.1327,587.5618")
FEW = ("--regime", "generic", "--count", 20, "--precision", "f64", "--seed", 4, *OPTIONS)
PROGRAM = """
import sys, json
sys.path[:0] = {path!r}
import numpy as np
from support.media_rays import textbook
lines = sys.stdin.read().splitlines()
media = next(json.loads(line[9:]) for line in lines if line.startswith("# media: "))
rows = [line.split(",") for line in lines if not line.startswith("#")]
assert rows[0][9:] == ["wavelength", "medium"], rows[0]
x = np.array(rows[1:], float)
CROWN = {crown!r}
def index(name, w):
    if name == "air":
        return 1.0
    return 1.5046 + 4200 / w**2 if name == CROWN else np.interp(w, [400, 500, 700], [1.85, 1.80, 1.76])
k = np.array([index(media[int(i)][0], w) / index(media[int(i)][1], w) for w, i in x[:, 9:]])
b = textbook(x[:, 1:4], x[:, 4:7], k)
print("id,bx,by,bz,n_ratio")
for i, row, r in zip(x[:, 0], b.tolist(), k.tolist()):
    print("%d,%r,%r,%r,%r" % (i, *row, r))
"""


@pytest.fixture
def call(tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: run("rays", *arguments)


@pytest.fixture
def tracer(tmp_path):
    """A program that looks up its own index, by the names of the media."""
    path = tmp_path / "tracer.py"
    tests, package = Path(__file__).parents[1], Path(__file__).parents[2]
    path.write_text(PROGRAM.format(path=[str(tests), str(package)], crown=CROWN))
    return [sys.executable, str(path)]


def save(path, answers):
    numbers = np.column_stack([answers.ids, answers.b, answers.n_ratio])
    Path(path).write_text(files.with_header({}, (*files.ANSWER_COLUMNS, "n_ratio"), numbers))


def test_export_and_check(call):
    code, out, err = call("export", *FEW, "-o", "rays.csv")
    assert (code, err) == (0, "")
    assert out == "rays.csv: 20 rays, 1 regime, f64, seed 4, 2 media at 2 wavelengths\n"
    rays = files.read("rays.csv")
    assert rays.header["wavelengths"] == [486.1327, 587.5618]
    save("answers.csv", answered(rays))
    named, remade = call("check", "answers.csv", "--rays", "rays.csv"), call("check", "answers.csv", *FEW)
    assert named == remade
    assert (named[0], named[2]) == (0, "")
    assert "n_ratio: the largest relative difference to n_from / n_to is 0 " in named[1]
    assert call("check", "answers.csv", *FEW[:-1], "486.1327,656.2725")[0] == 1


@pytest.mark.parametrize("ending", ["csv", "npz", "exr"])
def test_every_format_is_the_same_set(call, ending):
    assert call("export", *OPTIONS, "--count", 8, "-o", f"rays.{ending}")[0] == 0
    made = ray_set.make(count=8, media=MEDIA[:2], wavelengths=(486.1327, 587.5618))
    assert files.read(f"rays.{ending}").header == made.header


def test_answers_with_the_header_of_other_media_are_refused(call):
    rays = ray_set.make(["generic"], 20, media=(CROWN,), wavelengths=(500.0,))
    top = [line for line in files.as_csv(rays).splitlines() if line.startswith("#")]
    save("answers.csv", answered(rays))
    Path("answers.csv").write_text("\n".join([*top, Path("answers.csv").read_text()]))
    words = ("--regime", "generic", "--count", 20, "--medium", CROWN, "--wavelengths")
    assert call("check", "answers.csv", *words, "500")[0] == 0
    code, _, err = call("check", "answers.csv", *words, "501")
    assert (code, "the answers are to rays with the checksum" in err, err.count("\n")) == (2, True, 1)


def test_a_lens_tracer_with_its_own_indices(call, tracer):
    code, _, err = call("run", *FEW, "--json", "out.json", "--report", "out.html", "--", *tracer)
    assert (code, err) == (0, "")
    data = json.loads(Path("out.json").read_text())
    assert data["n_ratio"]["largest"] < 1e-15
    assert "--wavelengths 486.1327,587.5618 --medium" in Path("out.html").read_text()


def test_an_index_that_is_another(call):
    rays = ray_set.make(["generic"], 20, media=(CROWN,), wavelengths=(500.0,))
    files.write("rays.csv", rays)
    save("answers.csv", answered(rays, rays.rays.k * np.float32(1.001)))
    code, out, _ = call("check", "answers.csv", "--rays", "rays.csv")
    assert code == 1
    assert "20 answers used another ratio of indices, n_ratio: ids 0, 1, 2, 3, 4, …" in out
    assert out.splitlines()[-1].endswith("; 20 answers are for another ratio of indices")


BAD = {
    "no wavelengths": (("--medium", CROWN), "1 media and 0 wavelengths; expected neither, or at least one of each"),
    "no medium": (("--wavelengths", "500"), "0 media and 1 wavelengths; expected neither, or at least one of each"),
    "a word": (("--medium", CROWN, "--wavelengths", "F,d"), "--wavelengths F,d; expected numbers in nm"),
    "nothing": (("--medium", CROWN, "--wavelengths", ""), "--wavelengths ; expected numbers in nm"),
    "out of range": (
        ("--medium", FLINT, "--wavelengths", "900"),
        "no index at 900 nm",
    ),
    "a regime": ((*OPTIONS, "--regime", "k >> 1"), "regime 'k ≫ 1' has ratios of indices of its own; expected with"),
    "a material": (("--medium", "MATERIAL:ice", "--wavelengths", "500"), "unknown material; nearest"),
    "a name": (("--medium", "bk7", "--wavelengths", "500"), "medium 'bk7'; expected a number, cauchy(A, B, …)"),
    "few rays": ((*OPTIONS, "--count", "7"), "7 rays of each regime; expected 8 or more"),
}


@pytest.mark.parametrize("words, message", BAD.values(), ids=BAD)
@pytest.mark.parametrize("command", [("export", "-o", "r.csv"), ("check", "answers.csv"), ("run",)], ids=lambda x: x[0])
def test_invalid_options(call, command, words, message):
    last = ("--", "true") if command[0] == "run" else ()
    code, out, err = call(*command, *words, *last)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("mi-refract: ") and message in err
    assert not list(Path.cwd().iterdir())


@pytest.mark.skipif(
    not all(importlib.util.find_spec(name) for name in ("opticalglass", "pandas")),
    reason="opticalglass is not installed: pip install 'mi-refract[glass]'",
)
def test_an_unknown_glass_has_nearest_names(call):
    code, _, err = call("export", "--medium", "SCHOTT:N-BK8", "--wavelengths", "500", "-o", "r.csv")
    assert (code, err.count("\n")) == (2, 1)
    assert "unknown glass" in err and "nearest: SCHOTT:N-BK7, " in err


@pytest.mark.filterwarnings("default")
def test_an_index_beyond_the_makers_fit_is_a_warning_in_one_line(call):
    pytest.importorskip("opticalglass")
    code, _, err = call("export", "--medium", "CDGM:D-ZF93", "--wavelengths", "2325", "-o", "r.csv")
    assert (code, err.count("\n")) == (0, 1)
    assert err.startswith("mi-refract: CDGM:D-ZF93: the index at 2325 nm is an extrapolation; ")


def test_rays_and_media_do_not_choose_the_rays_both(call):
    code, _, err = call("check", "answers.csv", "--rays", "rays.csv", *OPTIONS)
    assert (code, "--rays rays.csv and --wavelengths: both choose the rays" in err) == (2, True)
    code, _, err = call("check", "answers.csv", "--rays", "rays.csv", *OPTIONS[:2])
    assert (code, "--rays rays.csv and --medium: both choose the rays" in err) == (2, True)


def test_the_regimes_that_take_media(call):
    assert call("export", *[word for name in media_rays.NAMES for word in ("--regime", name)], *OPTIONS, "--count", 8,
                "-o", "rays.csv")[0] == 0  # fmt: skip
    assert set(files.read("rays.csv").regime) == set(media_rays.NAMES)

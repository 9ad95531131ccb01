"""The reference pack: reproducible, complete, usable without our package; and results from answers to it."""

import hashlib
import json
import re
import shutil
import signal
import subprocess
import sys
import zipfile
from pathlib import Path

import msgspec
import numpy as np
import pytest
from support.processes import ENVIRONMENT, ROOT
from support.readme import DOCS, blocks

from mi_refract import backend
from mi_refract.image_diff import results_file
from mi_refract.io import image_file
from mi_refract.io.reference_pack import INDEX, SUMS
from validation import __main__ as validation
from validation.pack import structs

QUICK = ("pack", "--quick", "-o")
SINGLE = ("-DREAL=float", "-DU=0x1p-24")


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """An archive, written by another process."""
    pytest.importorskip("trimesh", reason="glTF needs trimesh")
    if reason := backend.usable_variants()["llvm_ad_rgb"]:
        pytest.skip(f"a pack is rendered in llvm_ad_rgb: {reason}")
    folder = tmp_path_factory.mktemp("packs")
    words = [sys.executable, "-m", "validation", *QUICK, folder]
    done = subprocess.run(words, cwd=ROOT, env=ENVIRONMENT, capture_output=True, timeout=300)
    assert done.returncode == 0, done.stderr
    (path,) = folder.iterdir()
    return path


@pytest.fixture(scope="module")
def unpacked(archive, tmp_path_factory):
    """The unpacked archive, which tests must not change."""
    folder = tmp_path_factory.mktemp("unpacked")
    zipfile.ZipFile(archive).extractall(folder)
    return next(folder.iterdir())


@pytest.fixture
def pack(unpacked, tmp_path, monkeypatch):
    """A copy of the unpacked archive, as working folder."""
    shutil.copytree(unpacked, tmp_path / "pack")
    monkeypatch.chdir(tmp_path / "pack")
    return tmp_path / "pack"


def compiled(source, *options):
    """Compile a C program and return its path."""
    if not shutil.which("gcc"):
        pytest.skip("no gcc in PATH")
    words = ["gcc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-O2", *options, "-o", "program", source, "-lm"]
    assert subprocess.run(words, capture_output=True, timeout=60).stderr == b""
    return "./program"


def test_packs_are_reproducible_and_writing_reports_progress(archive, tmp_path, capfd, llvm_variant):
    assert validation.main([*QUICK, str(tmp_path)]) == 0
    (path,) = tmp_path.iterdir()
    assert path.name == archive.name and path.read_bytes() == archive.read_bytes()
    out, err = capfd.readouterr()
    assert f"{path}: " in out and re.findall(r"(\d+) of (\d+): scene", err) == [("4", "6"), ("5", "6"), ("6", "6")]
    entries = zipfile.ZipFile(path).infolist()
    assert {x.date_time for x in entries} == {(1980, 1, 1, 0, 0, 0)}
    assert entries == sorted(entries, key=lambda x: x.filename)


def test_every_file_has_a_digest_and_every_json_a_schema(unpacked):
    names = {path.relative_to(unpacked).as_posix() for path in unpacked.rglob("*") if path.is_file()}
    digests = dict(reversed(line.split("  ")) for line in (unpacked / SUMS).read_text().splitlines())
    assert digests.keys() == names - {SUMS}
    assert all(hashlib.sha256((unpacked / name).read_bytes()).hexdigest() == x for name, x in digests.items())
    files = json.loads((unpacked / INDEX).read_text())["files"]
    assert {name: entry["sha256"] for name, entry in files.items()} | {INDEX: digests[INDEX]} == digests
    assert all(entry["schema"].startswith("https:") for name, entry in files.items() if name.endswith(".gltf"))
    own = [name for name in names if name.endswith(".json") and not name.startswith("schemas/")]
    assert len(own) == 4 + 3
    for name in own:
        schema = json.loads((unpacked / structs.schema_path(name)).read_text())
        assert schema["$schema"] == structs.DRAFT and (name == INDEX or files[name]["schema"] in files)
        data = json.loads((unpacked / name).read_text())
        structs.check(name, json.dumps(data).encode())
        (data[0] if isinstance(data, list) else data)["other"] = {}
        with pytest.raises(msgspec.ValidationError):
            structs.check(name, json.dumps(data).encode())
    with pytest.raises(ValueError, match=r"numbers/new\.json: no schema; expected one of"):
        structs.schema_path("numbers/new.json")


def test_images_have_variances_and_looks_have_16_bits(unpacked):
    facts = json.loads((unpacked / "images/images.json").read_text())
    for name, fact in facts.items():
        image, look = image_file.read(unpacked / f"images/{name}.exr"), image_file.read(unpacked / f"looks/{name}.png")
        assert {"R", "G", "B", "R.variance", "G.variance", "B.variance"} == set(image.channels)
        assert image.metadata["mi_refract:spp"] == fact["spp"] and image.metadata["mi_refract:scene"] == fact["scene"]
        assert look.stored == "uint16" and look.pixels.shape[:2] == image.pixels.shape[:2] and look.pixels.max() > 0.1
        scene = (unpacked / fact["scene"]).read_text()
        assert '<default name="bsdf" value="dielectric"/>' in scene
    assert {path.parents[1].name for path in unpacked.rglob("scene.glb")} == facts.keys() - {"nested"}


@pytest.mark.parametrize("precision", ["f32", "f64"])
@pytest.mark.parametrize(
    "mistake",
    [
        ("", ""),
        ("ray.n_from / (REAL)ray.n_to", "ray.n_to / (REAL)ray.n_from"),
        ("k * a[i] - f * n[i]", "(k * a[i] - f * n[i]) / k"),  # of the length 1/k
    ],
)
def test_the_c_program_judges_as_rays_check_does(pack, run, precision, mistake):
    source = pack / "programs" / "check_rays.c"
    text = source.read_text()
    code = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    assert len([line for line in code.splitlines() if line.strip()]) <= 40
    source.write_text(text.replace(*mistake))
    program = compiled(source, *(SINGLE if precision == "f32" else ()))
    done = subprocess.run([program, f"rays/{precision}.csv", f"rays/certified-{precision}.csv"], capture_output=True)
    source.write_text(text)
    (pack.parent / "answers.csv").write_bytes(done.stdout)
    out = pack.parent / "out.json"
    status = run("rays", "check", pack.parent / "answers.csv", "--rays", f"rays/{precision}.csv", "--json", out)[0]
    (ours,) = json.loads(out.read_text())["functions"]
    wrong, within, right = map(int, re.findall(r"\d+", done.stderr.decode()))
    assert (status, done.returncode) == (1, 1) if mistake[0] else (0, 0)
    assert (wrong, within, right) == (ours["wrong"], 104 - ours["wrong"] - ours["right"], ours["right"])
    # Rays and certified answers of different sets or numbers fail.
    Path("few.csv").write_text("".join(Path(f"rays/{precision}.csv").read_text().splitlines(keepends=True)[:40]))
    readme, certified = "README.md", f"rays/certified-{precision}.csv"
    for names in (("rays/f32.csv", readme), (readme, readme), ("few.csv", certified)):
        assert subprocess.run([program, *names], capture_output=True).returncode == 1


def test_the_program_of_the_readme_reads_the_rays(pack):
    (text,) = blocks(pack / "README.md", "c")
    Path("read.c").write_text(text)
    with Path("rays/f64.csv").open() as rays:
        out = subprocess.run([compiled("read.c")], stdin=rays, capture_output=True, text=True, timeout=60).stdout
    assert len(out.splitlines()) == 104 and out.startswith("ray 0: k = ")


def test_the_javascript_of_the_readme_is_right(pack, run):
    if not shutil.which("node"):
        pytest.skip("no node in PATH")
    (text,) = blocks(pack / "README.md", "js")
    out = subprocess.run(["node", "-e", text], capture_output=True, timeout=60).stdout
    (pack.parent / "answers.csv").write_bytes(out)
    assert run("rays", "check", pack.parent / "answers.csv", "--rays", "rays/f32.csv")[0] == 0


def test_the_glsl_of_the_readme_compiles(pack):
    if not shutil.which("glslangValidator"):
        pytest.skip("no glslangValidator in PATH; Debian: glslang-tools")
    Path("read.comp").write_text(*blocks(pack / "README.md", "glsl"))
    assert subprocess.run(["glslangValidator", "read.comp"], timeout=60).returncode == 0


# Results from answers -------------------------------------------------------------------------------------------------


@pytest.fixture
def answers(pack):
    """A folder with right answers to the f64 rays, and copies of the pack's images."""
    folder = pack.parent / "mine"
    shutil.copytree(pack / "images", folder / "my_images")
    with np.load("rays/certified-f64.npz") as exact:
        rows = np.column_stack([exact["id"], exact["b"], exact["transmitted"]]).tolist()
    lines = [f"{i:.0f},{x!r},{y!r},{z!r},{t:.0f}" for i, x, y, z, t in rows]
    (folder / "answers.csv").write_text("\n".join(["id,bx,by,bz,transmitted", *lines, ""]))
    return folder


def test_results_name_pack_and_answers_and_are_reproducible(pack, answers, run):
    page, texts = DOCS / "how-to/use-the-reference-pack.md", []
    commands = [line for block in blocks(page, "bash") for line in block.splitlines() if line.startswith("mi-refract ")]
    shutil.copytree(answers, ".", dirs_exist_ok=True)
    for line in commands:
        for _ in range(2):
            assert run(*line.split()[1:])[0] == 0
            texts.append(Path(line.split()[-1]).read_text())
    assert len(commands) == 2 and texts[0] == texts[1] and texts[2] == texts[3]
    index = hashlib.sha256(Path(INDEX).read_bytes()).hexdigest()
    rays, images = json.loads(texts[0]), json.loads(texts[2])
    assert rays["pack"] == {"version": rays["version"], "sha256": index, "path": "rays/f64.csv"}
    assert [rays["command"], images["command"]] == commands
    assert (images["version"], images["pack"]) == (rays["version"], rays["pack"] | {"path": "images"})
    digest = hashlib.sha256(Path("answers.csv").read_bytes()).hexdigest()
    assert rays["functions"][0]["answers_sha256"] == digest
    for entry in msgspec.convert(images, results_file.Document).results:
        assert entry.digests.test == hashlib.sha256(Path(entry.test).read_bytes()).hexdigest()
    # `rays run` judges the same bytes; outside of a pack, results name no pack.
    command = (sys.executable, "-c", "print(open('answers.csv').read(), end='')")
    assert run("rays", "run", "--rays", "rays/f64.csv", "--json", "r.json", "--", *command)[0] == 0
    again = json.loads(Path("r.json").read_text())
    assert (again["functions"][0]["answers_sha256"], again["pack"]) == (digest, rays["pack"])
    shutil.copy("rays/f64.csv", pack.parent)
    inside = "images/../rays/f64.csv", rays["pack"]
    for path, expected in ((pack.parent / "f64.csv", None), ("../f64.csv", None), inside):
        assert run("rays", "check", "answers.csv", "--rays", path, "--json", "r.json")[0] == 0
        assert json.loads(Path("r.json").read_text())["pack"] == expected


def edited(name, change=lambda text: text + b" "):
    """Return a function that changes a file of the pack."""

    def edit(pack, answers):
        (pack / name).write_bytes(change((pack / name).read_bytes()))

    return edit


def of_another_pack(pack, answers):
    (answers / INDEX).write_bytes((pack / INDEX).read_bytes().replace(b'"quick": true', b'"quick": false'))


BAD = {  # error message → the defect
    "numbers/standard_numbers.csv: damaged or edited: its SHA-256": edited("numbers/standard_numbers.csv"),
    "looks/prism.png: damaged or edited": edited("looks/prism.png", lambda text: text[:-9]),
    "scene.xml: missing, or not a file": lambda pack, _: (pack / "scenes/prism/mitsuba/scene.xml").unlink(),
    f"{INDEX}: missing, or not a file": lambda pack, _: (pack / INDEX).unlink(),
    f"{INDEX}: damaged: not JSON": edited(INDEX, lambda text: text[:-9]),
    f"{INDEX}: a pack of another version: format 'mi_refract pack 2'": edited(
        INDEX, lambda text: text.replace(b"mi_refract pack 1", b"mi_refract pack 2")
    ),
    f"{INDEX}: files[...]: ": edited(INDEX, lambda text: text.replace(b'"sha256"', b'"sha1"', 1)),
    f"{SUMS}: not the digests of {INDEX}": edited(INDEX, lambda x: x.replace(b'"quick": true', b'"quick": false')),
    "answers to another pack: ": of_another_pack,
}


@pytest.mark.parametrize("message", BAD)
def test_changed_packs_are_rejected(message, pack, answers, run):
    BAD[message](pack, answers)
    out = pack.parent / "out.json"
    for words in (
        ("rays", "check", answers / "answers.csv", "--rays", "rays/f64.csv"),
        ("diff", "images", answers / "my_images"),
        ("diff", "images/prism.exr", answers / "my_images/prism.exr"),
    ):
        code, printed, error = run(*words, "--json", out)
        assert (code, printed, error.count("\n")) == (2, "", 1) and message in error
        assert not out.exists()


def test_references_added_to_a_pack_are_rejected(pack, answers, run):
    shutil.copy("images/prism.exr", "images/added.exr")
    code, _, error = run("diff", "images", answers / "my_images")
    assert (code, "images/added.exr: not a file of the pack" in error) == (2, True)


def test_no_image_is_accepted_into_a_pack(pack, answers, run):
    shutil.copy("images/prism.exr", answers / "my_images/sphere.exr")
    code, _, error = run("accept", "images", answers / "my_images", "--yes")
    assert (code, "images: in a reference pack" in error) == (2, True)
    assert run("diff", "images", answers / "my_images")[0] == 1  # the pack is unchanged


def test_a_copy_of_the_index_beside_answers_names_their_pack_but_is_no_pack(pack, answers, run):
    shutil.copy(INDEX, answers)
    assert run("diff", "images", answers / "my_images", "--json", "to_the_pack.json")[0] == 0
    assert run("diff", answers / "my_images", "images", "--json", "to_mine.json")[0] == 0
    packs = [json.loads(Path(f"{name}.json").read_text())["pack"] for name in ("to_the_pack", "to_mine")]
    assert packs[0]["path"] == "images" and packs[1] is None


def test_answers_to_the_rays_of_another_pack_are_rejected(pack, answers, run):
    text = (answers / "answers.csv").read_text()
    (answers / "answers.csv").write_text(f"# checksum: sha256:{'0' * 64}\n{text}")
    code, _, error = run("rays", "check", answers / "answers.csv", "--rays", "rays/f64.csv", "--json", "r.json")
    assert (code, "the answers belong to rays with the checksum" in error) == (2, True) and not Path("r.json").exists()


# The command ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "Missing option '-o'"),
        (("-o", "none/packs"), "none is not a folder"),
        (("-o", "file"), "file is not a folder"),
        (("-o", ".", "--quik"), "No such option: --quik"),
    ],
)
def test_misuse_is_one_line_and_exit_code_2(words, message, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("")
    assert validation.main(["pack", *words]) == 2
    out, err = capfd.readouterr()
    assert (out, err.count("\n")) == ("", 1) and err.startswith("validation pack: ") and message in err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_ctrl_c_leaves_no_files(tmp_path, needs_variant):
    needs_variant("llvm_ad_rgb")
    pytest.importorskip("trimesh", reason="glTF needs trimesh")
    module = "runpy.run_module('validation', run_name='__main__', alter_sys=True)"
    # The background jobs of a shell ignore SIGINT.
    code = f"import runpy, signal; signal.signal(signal.SIGINT, signal.default_int_handler); {module}"
    words = [sys.executable, "-c", code, "pack", "-o", tmp_path]
    with subprocess.Popen(words, cwd=ROOT, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True) as started:
        assert "1 of 12: rays in f32" in started.stderr.readline()
        started.send_signal(signal.SIGINT)
        assert started.wait(60) == 130 and not list(tmp_path.iterdir())

"""Other systems: wrong answers never pass, and absent systems report the command that installs them."""

import ast
import dataclasses
import json
import re
import runpy
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support import fake_bpy
from support.processes import executable

from mi_refract import oracle, regimes
from mi_refract.io import image_file
from mi_refract.ray_sets import renderer_file
from mi_refract.ray_sets.files import parse_answers
from mi_refract.ray_sets.header import PRECISIONS
from mi_refract.ray_sets.renderer_file import RaysCommand
from mi_refract.report.row import Row
from validation import __main__ as command
from validation import limits
from validation.run import headline
from validation.run.context import PROFILES, Context
from validation.suite import exports, matrix, per_ray, rendered_images, standard_numbers
from validation.suite.per_ray import LARGE, TOTAL
from validation.suite.renderers import SYSTEMS, System, environments
from validation.suite.renderers.image_renderers import IMAGE_RENDERERS
from validation.suite.renderers.system import SCRIPTS, SYSTEMS_FOLDER, Install, join

QUICK, FULL = (Context(PROFILES[name], Path(), "llvm_ad_rgb", {}, {}) for name in ("quick", "full"))
# The recorded errors of GLSL's formula.
PYGLM = next(call for call in SYSTEMS["pyglm"].calls if call.precision == "f64")
RECORDED = {name: list(PYGLM.recorded_range(name)) for name in PYGLM.recorded}
# A correct program, unless `before` or `after` plant a defect.
PROGRAM = f"""
import os, sys, time
sys.path.insert(0, {str(SCRIPTS)!r})
import numpy as np
import table
rays = table.Rays("float64")
k, a, n = rays.k[:, None], rays.a, rays.n
{{before}}
c = (a * n).sum(1, keepdims=True)
d = 1 - k * k * (1 - c * c)
b = np.where(d < 0, 0, k * a - (k * c + np.sqrt(np.abs(d))) * n)
{{after}}
table.write(rays, b, "a program 1.0")
"""
STRAIGHT = "print('id,bx,by,bz,n_ratio'); [print(i, *v, 1, sep=',') for i, v in zip(rays.ids, a.tolist())]; sys.exit(0)"
DEFECTS = {
    "index inverted": ("k = 1 / k", "", "wrong", ""),
    "no direction": ("", "b[7] = np.nan", "wrong", ""),
    "a set left out": ("", "rays.ids, b = rays.ids[:40], b[:40]", "unfit", ""),
    "an id missing": ("", "rays.ids, b = rays.ids[1:], b[1:]", "unfit", "id 0"),
    "no refraction, by its own ratio": ("", STRAIGHT, "unfit", "index id"),
    "signalled by NaN": ("", "b = np.where(d < 0, np.nan, b)", "other TIR signal", ""),
    "exception": ("raise RuntimeError('out of glass')", "", "unanswered", "ended with status 1: RuntimeError: out of"),
    "killed": ("os.kill(os.getpid(), 9)", "", "unanswered", "was killed by SIGKILL"),
    "hangs": ("time.sleep(1000)", "", "unanswered", "did not end within 2 s"),
    "bytes": ("os.write(1, bytes([0xff, 0xfe, 0])); os._exit(0)", "", "unanswered", "bytes that are not text"),
    "cut short": ("", "print('id,bx,by,bz'); print('0,0.5,0.'); sys.exit(0)", "unanswered", "expected 4 numbers"),
}


@pytest.fixture
def few(monkeypatch):
    """Sets of forty rays each."""
    smaller = {name: dataclasses.replace(kind, count=40) for name, kind in per_ray.SETS.items()}
    monkeypatch.setattr(per_ray, "SETS", smaller)
    per_ray.all_rays.cache_clear()
    yield
    per_ray.all_rays.cache_clear()


@pytest.fixture
def rows_of(few, tmp_path):
    """`rows_of(before, after)`: the rows of such a program."""

    def run(before="", after="", recorded=RECORDED, gives_up=0.0, tir="zero"):
        path = tmp_path / "program.py"
        path.write_text(PROGRAM.format(before=before, after=after))
        call = RaysCommand("a program", "f64", ("{python}", str(path)), tir, gives_up, recorded=recorded)
        return per_ray.call_rows(System("a", "A"), call, QUICK)

    return run


# The study -----------------------------------------------------------------------------------------------------


def test_right_answers_pass_and_a_small_error_of_the_normal_fails(rows_of):
    rows = rows_of()
    assert [(row.case, row.verdict) for row in rows] == [(name, "pass") for name in per_ray.SETS]
    assert all(row.reason == "a program 1.0; total internal reflection: zero" for row in rows)
    assert all("worst rad" in row.values for row in rows if row.case != TOTAL)
    assert {row.verdict for row in rows_of(tir="auto")} == {"pass"}
    rays = per_ray.all_rays("f64")
    exact = oracle.refract(rays.rays.a, rays.rays.n, rays.rays.k, fresnel=False, progress=False)
    through = {name: exact.transmitted[rays.regime == name].mean() for name in per_ray.SETS}
    assert (through["grazing"], through[TOTAL]) == (1, 0) and through["near-critical"] > 0.9
    assert {row.case for row in rows if per_ray.BACKWARD in row.missed} == {LARGE}
    off = rows_of("n = n + 2e-15 * np.cross(n, a)")  # within the bound, but out of the plane of incidence
    assert {row.case for row in off if row.verdict == "fail"} >= {"random", "grazing"}


def test_errors_of_length_count_as_backward_errors(rows_of):
    """Right directions, with lengths that the bound of the textbook formula allows for large k."""
    wide = "k, a, n = (x.astype(np.longdouble) for x in (k, a, n))"
    unit = "a, n = (x / np.sqrt((x * x).sum(1, keepdims=True)) for x in (a, n))"
    for factor, missed in ((0, set()), (1e-10, {LARGE})):
        rows = rows_of(f"{wide}; {unit}", f"b = b * (1 + (k > 1000) * {factor})")
        assert {row.verdict for row in rows} == {"pass"}
        assert {row.case for row in rows if per_ray.BACKWARD in row.missed} == missed


@pytest.mark.parametrize("precision", PRECISIONS)
def test_the_random_rays_never_changed(precision):
    """No ray is left out, not even near the critical angle."""
    count, dtype = 10_000, PRECISIONS[precision]
    rng = np.random.default_rng([2040, 0])
    n = regimes.normalised(rng.normal(size=(count, 3))).astype(dtype)
    cosine, k = rng.uniform(0, 1, count), 1.5 ** rng.choice([-1.0, 1.0], count)
    across = np.cross(n.astype(float), rng.normal(size=n.shape))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    rays = per_ray.all_rays(precision)
    rays = rays.rays[rays.regime == per_ray.RANDOM]
    behind = (rays.a * n).sum(1, keepdims=True) > 0  # these normals are reversed to face the ray
    np.testing.assert_array_equal(rays.n, np.where(behind, -n, n))
    np.testing.assert_array_equal(rays.k, k.astype(dtype))
    tolerance, sine = 8 * np.finfo(dtype).eps, np.sqrt(1 - cosine**2)
    np.testing.assert_allclose(np.abs((rays.a * n).sum(1)), cosine, atol=tolerance)
    np.testing.assert_allclose((rays.a * across).sum(1), sine, atol=tolerance)
    assert (np.abs(1 - k**2 * sine**2) < per_ray.LEFT_OUT).any()


def test_frames_are_rotations_onto_the_normal(monkeypatch):
    monkeypatch.syspath_prepend(str(SCRIPTS))
    import table

    axes = np.vstack([np.eye(3), -np.eye(3)])
    n = np.vstack([np.random.default_rng(3).normal(size=(1000, 3)), axes, axes - 1e-9])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    frames = table.frames(n)
    np.testing.assert_array_equal(frames[:, :, 2], n)
    np.testing.assert_allclose(np.swapaxes(frames, 1, 2) @ frames, np.broadcast_to(np.eye(3), frames.shape), atol=1e-15)
    np.testing.assert_allclose(np.linalg.det(frames), 1, atol=1e-15)


@pytest.mark.parametrize("name", DEFECTS)
def test_broken_programs_fail_with_the_reason(name, rows_of, monkeypatch):
    before, after, metric, reason = DEFECTS[name]
    if name == "hangs":
        monkeypatch.setattr(environments, "TIMEOUT", 2.0)
    rows = rows_of(before, after)
    assert any(metric in row.broken for row in rows) and reason in rows[0].reason and "\n" not in rows[0].reason
    if metric in ("unanswered", "unfit"):  # unfit answers fail every set
        assert {row.verdict for row in rows} == {"fail"} and (len(rows) == 1) == (metric == "unanswered")


def test_given_up_rays_are_counted_and_recorded_errors_are_two_sided_goals(rows_of):
    early = "", "b[np.abs(d[:, 0]) < 1e-4] = 0"
    assert any(row.verdict == "fail" for row in rows_of(*early, gives_up=1e-5))
    rows = rows_of(*early, gives_up=1.01e-4)
    assert {row.verdict for row in rows} == {"pass"} and sum(row.values["given up"] for row in rows) > 0
    for value in (1e-2, 1e-30):
        rows = [row for row in rows_of(recorded=dict.fromkeys(RECORDED, value)) if row.case in RECORDED]
        assert all(row.missed == {per_ray.OFF_RECORDED: limits.RECORDED} and row.verdict == "pass" for row in rows)
    assert [per_ray.off_recorded(x, 2, 4) for x in (1, 2, 3, 4, 8)] == [2, 1, 1, 1, 2]
    assert per_ray.off_recorded(0, 2, 4) == np.inf and np.isnan(per_ray.off_recorded(np.nan, 2, 4))


def test_all_errors_of_mitsuba_are_recorded():
    """A missed goal cannot be removed unnoticed."""
    for call in SYSTEMS["mitsuba"].calls:
        assert set(call.recorded) == set(per_ray.SETS) - {TOTAL, LARGE}, call.title


def test_programs_run_without_our_environment(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(SCRIPTS))
    program = "import os, sys; print(os.environ.get('PYTHONPATH'), sys.stdin.read())"
    assert environments.run([sys.executable, "-c", program], stdin="rays") == "None rays\n"
    with pytest.raises(environments.Unable, match="no no-such-program in PATH"):
        environments.ask(System("a", "A"), ("no-such-program",))


def test_absent_large_and_unable_systems_are_not_run(rows_of, tmp_path, monkeypatch):
    (row,) = rows_of("print('no driver', file=sys.stderr); sys.exit(77)")
    assert (row.verdict, row.reason) == ("not run", "cannot run here: no driver")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (row,) = per_ray.call_rows(SYSTEMS["pyglm"], PYGLM, FULL)
    assert (row.verdict, row.reason) == ("not run", "python -m validation renderers --install pyglm")
    monkeypatch.setattr(environments, "absent", lambda system: "")
    (row,) = per_ray.call_rows(SYSTEMS["optiland"], SYSTEMS["optiland"].calls[0], QUICK)
    assert row.verdict == "not run" and "full profile" in row.reason


@pytest.mark.parametrize(
    "name", [name for name, x in SYSTEMS.items() if x.calls and (not x.install or x.install.small)]
)
def test_installed_small_systems_pass(name, few, needs_variant):
    """Systems that need a graphics driver may not find one."""
    if reason := environments.absent(SYSTEMS[name]):
        pytest.skip(reason)
    if name == "mi_refract":
        needs_variant("llvm_ad_rgb")
    rows = [row for call in SYSTEMS[name].calls for row in per_ray.call_rows(SYSTEMS[name], call, QUICK)]
    assert {row.verdict for row in rows} - ({"not run"} if name in ("glsl", "materialx", "wgsl") else set()) == {"pass"}
    if name == "mi_refract":
        assert max(row.values[per_ray.BACKWARD] for row in rows) < 1 and not any(row.missed for row in rows)


def unscaled(a, n, k):
    """Return k a − (k c + √(1 − k²(1 − c²))) n without normalisation."""
    k, c = k[:, None], (a * n).sum(1, keepdims=True)
    return k * a - (k * c + np.sqrt(1 - k * k * (1 - c * c))) * n


# Text in the table → the answers to a ray `a` of the length l, and to a normal of that length.
LENGTHS = {
    "uses vectors of any length without normalising them": (
        lambda a, n, k, length: unscaled(length * a, n, k),
        lambda a, n, k, length: unscaled(a, length * n, k),
    ),
    "derives the index of the medium that a ray leaves from its speed 1/n": (
        lambda a, n, k, length: unscaled(a, n, k / length),
    ),
}


@pytest.mark.parametrize("name", [name for name, system in SYSTEMS.items() if any(x.lengths for x in system.calls)])
def test_systems_treat_vectors_of_other_lengths_as_stated(name):
    assert all(call.lengths in LENGTHS for call in SYSTEMS[name].calls if call.lengths)
    if reason := environments.absent(SYSTEMS[name]):
        pytest.skip(reason)
    a, n = (regimes.normalised(v).astype(float) for v in np.random.default_rng(7).normal(size=(2, 40, 3)))
    n = np.where((a * n).sum(1, keepdims=True) > 0, -n, n)
    k, length = np.full(40, 1 / 1.5), 1.1
    for call in (call for call in SYSTEMS[name].calls if call.lengths):
        for i, expected in enumerate(LENGTHS[call.lengths]):
            vectors = (length * a, n) if i == 0 else (a, length * n)
            rows = np.c_[np.arange(40), *vectors, np.ones(40), np.full(40, 1.5)].tolist()
            text = "\n".join(["id,ax,ay,az,nx,ny,nz,n_from,n_to", *(f"{id_:.0f},{str(x)[1:-1]}" for id_, *x in rows)])
            try:
                b = parse_answers(environments.ask(SYSTEMS[name], call.command, text), call.title).b
            except environments.Unable as error:
                pytest.skip(f"cannot run here: {error}")
            np.testing.assert_allclose(b, expected(a, n, k, length), atol=1e-5 if call.precision == "f32" else 1e-12)


# The table of systems ------------------------------------------------------------------------------------------


def test_every_system_has_a_use_a_licence_scripts_and_packages_pinned_by_hashes():
    image_systems = {renderer.system for renderer in IMAGE_RENDERERS.values()}
    for name, system in SYSTEMS.items():
        assert name == system.name and name.isidentifier() and system.licence and system.title
        assert system.calls or name in image_systems or name == exports.VALIDATOR
        for words in (*(call.command for call in system.calls), system.lens):
            assert all((system.folder / word).resolve().is_file() for word in words[1:2])
        install = system.install
        if install and install.pip:
            lines = environments.locked(system).read_text().replace("\\\n", "").splitlines()
            lines = [line for line in lines if line and not line.startswith("#")]
            assert all(re.match(r"[\w.-]+==[\w.]+( ; [^#]+?)?( +--hash=sha256:[0-9a-f]{64})+$", line) for line in lines)
            pinned = {line.split()[0].lower() for line in lines}
            assert "==" in install.pip[0] and {word.lower() for word in install.pip if "==" in word} <= pinned
        if install and install.npm:
            dependencies = json.loads((environments.locked(system) / "package.json").read_text())["dependencies"]
            assert {f"{name}@{version}" for name, version in dependencies.items()} == {*install.npm}
            packages = json.loads((environments.locked(system) / "package-lock.json").read_text())["packages"]
            assert packages.pop("")["dependencies"] == dependencies
            assert all(package["integrity"].startswith("sha512-") for package in packages.values())


def test_scripts_and_this_project_do_not_import_each_other():
    def imported(path):
        nodes = list(ast.walk(ast.parse(path.read_text())))
        names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
        names += [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom) and not node.level]
        return {name.partition(".")[0] for name in names}

    root = SCRIPTS.parents[3]
    theirs = {"bpy", "glm", "moderngl", "optiland", "pyluxcore", "pyradiance", "rayoptics", "raysect"}
    theirs |= {"MaterialX", "batoid", "slangpy", "wgpu"}
    scripts = {*SCRIPTS.glob("*.py"), *(root / "mi_refract" / "scene_export" / "targets").glob("render_*.py")}
    assert len(scripts) > 9
    for path in scripts - {SCRIPTS / "own_rays.py"}:  # it runs this package
        assert not imported(path) & {"mi_refract", "validation"}, path.name
    ours = {*(root / "mi_refract").rglob("*.py"), *(root / "validation").rglob("*.py")}
    for path in ours - scripts:
        assert not imported(path) & (theirs | {path.stem for path in scripts}), path.name


def test_cycles_renders_a_gltf_export_with_the_settings_of_its_own_export(tmp_path, monkeypatch):
    pytest.importorskip("trimesh")
    bpy, camera = fake_bpy.installed(monkeypatch), SimpleNamespace(type="CAMERA", data=SimpleNamespace(clip_end=100))
    bpy.data.objects = [SimpleNamespace(type="MESH"), camera]

    def run(words, timeout):
        monkeypatch.setattr(sys, "argv", words[1:])
        runpy.run_path(words[1])
        for seed, file in bpy.rendered:
            image_file.write_exr(file, np.full((9, 16, 3), seed, np.float32))
        return ""

    monkeypatch.setattr(environments, "run", run)
    plain = exports.scene()
    images = IMAGE_RENDERERS["Cycles, glTF"].draw(plain, tmp_path, 3, [1, 2])
    assert [image.pixels[0, 0, 0] for image in images] == [1, 2]
    file = str(tmp_path / "scene" / "scene.glb")
    bpy.ops.import_scene.gltf.assert_called_with(filepath=file, export_import_convert_lighting_mode="COMPAT")
    bpy.data.images.load.assert_called_with(str(tmp_path / "scene" / "sky.exr"))
    scene = bpy.context.scene
    assert scene.camera is camera and camera.data.clip_end >= 1e6
    assert (scene.cycles.samples, scene.cycles.max_bounces) == (3, plain.max_depth - 2)
    assert not bpy.data.meshes.made  # the importer makes the meshes


# Installing ----------------------------------------------------------------------------------------------------


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    """A temporary cache and temporary locks, also of the system `thing`."""
    locks = tmp_path / "locks"
    (locks / "thing").mkdir(parents=True)
    for name in ("thing.txt", "thing/package.json", "thing/package-lock.json"):
        (locks / name).write_text("{}" if "json" in name else f"mi-refract-no-such-thing==1 --hash=sha256:{'0' * 64}")
    for lock in environments.LOCKS.glob("*.txt"):
        (locks / lock.name).write_bytes(lock.read_bytes())
    monkeypatch.setattr(environments, "LOCKS", locks)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("PIP_NO_INDEX", "1")


def thing(**needs):
    return System("thing", "Thing", install=Install(1, **needs))


@pytest.mark.parametrize(
    ("needs", "message"),
    [
        ({"pip": ("mi-refract-no-such-thing==1",)}, "mi-refract-no-such-thing==1"),
        ({"pip": ("numpy",), "python": "2.7"}, "needs Python 2.7; expected a python2.7 in PATH"),
        ({"npm": ("mi-refract-no-such-thing@1",)}, "npm"),
        ({"apt": ("mi-refract-no-such-thing",), "program": "no-such-program"}, "apt-get"),
    ],
)
def test_a_failed_installation_leaves_the_system_absent(needs, message, own_cache, monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(SYSTEMS, "thing", thing(**needs))
    for name in ("npm", "apt-get", "sudo"):
        executable(tmp_path / name, "#!/bin/sh\necho working\necho nothing of that name >&2\nexit 1\n")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert command.main(["renderers"]) == 0
    lines = [line.split()[:2] for line in capsys.readouterr().out.splitlines()]
    assert lines == [[name, "absent" if system.install else "installed"] for name, system in SYSTEMS.items()]
    assert command.main(["renderers", "--install", "thing"]) == 1
    first, second = capsys.readouterr().err.strip().splitlines()
    assert first.startswith("thing: ") and second.startswith("validation renderers: thing: ") and message in second
    row = Row("rays", "thing", "all", "", reason=environments.why_not(SYSTEMS["thing"], "quick"))
    assert headline.remedies([row, row]) == {"other renderers, by `python -m validation renderers --install thing`": 2}


def test_another_version_of_a_distribution_is_absent_and_not_installed(own_cache, monkeypatch, capsys, tmp_path):
    def program(name, text):
        executable(tmp_path / name, f"#!/bin/sh\n{text}\n")

    monkeypatch.setenv("PATH", f"{tmp_path}:/bin")
    install = SYSTEMS["povray"].install
    assert install.apt == (f"povray=1:{install.version}-*",)
    for version, present in (("3.7.0.10.unofficial", True), ("3.7.0.8", False)):
        program("povray", f"echo POV-Ray {version} >&2")
        assert bool(environments.absent(SYSTEMS["povray"])) != present
    program("apt-get", "echo \"E: Version '1:3.7.0.10-*' for 'povray' was not found\" >&2; exit 100")
    program("sudo", 'shift; exec "$@"')
    program("apt-cache", "echo 'povray | 1:3.7.0.8-5 | http://deb.debian.org/debian bullseye/main amd64 Packages'")
    assert command.main(["renderers", "--install", "povray"]) == 1
    _, line = capsys.readouterr().err.strip().splitlines()
    assert "'1:3.7.0.10-*' for 'povray' was not found; this distribution has povray 1:3.7.0.8-5" in line


def test_a_system_is_installed_once_and_again_for_another_version(own_cache, monkeypatch):
    commands = []
    monkeypatch.setattr(environments, "run", lambda command, **options: commands.append(command) or "")
    first, second = (thing(pip=(f"a=={i}",)) for i in (1, 2))
    for system, count in ((first, 2), (first, 2), (second, 4)):
        environments.install(system)
        assert len(commands) == count and not environments.absent(system)
    assert environments.absent(first)
    assert all({"--require-hashes", "--only-binary", "--no-deps"} < {*words} for words in commands[1::2])
    assert all(words[-2:] == ("--requirement", str(environments.locked(first))) for words in commands[1::2])
    marker = environments.folder(second) / "installed.json"
    complete = marker.read_text()
    for text in ('["no such"]', "{", ""):
        marker.write_text(text)
        assert environments.absent(second)
    marker.write_text(complete)
    environments.locked(first).write_text("another lock")
    assert environments.absent(second)
    environments.install(thing(npm=("a@1",)))
    assert commands[-1][:2] == ("npm", "ci") and "--ignore-scripts" in commands[-1]


def test_an_answer_to_an_unknown_ray_is_no_measured_number(tmp_path):
    path = tmp_path / "program.py"
    path.write_text(PROGRAM.format(before="", after="rays.ids = (*rays.ids[1:], '99999')"))
    call = RaysCommand("a program", "f64", ("{python}", str(path)), "zero")
    (row,) = standard_numbers.ray_rows(System("a", "A"), call, QUICK)
    assert row.verdict == "fail" and "an answer to the ray" in row.reason


# `--renderer FOLDER` ----------------------------------------------------------------------------------------------

TOML = """title = "Mine"
[[rays]]
title = "Mine, refract"
precision = "f64"
command = ["{python}", "program.py"]
total_internal_reflection = "zero"
"""
IMAGES = """[images]
export = "mitsuba"
command = ["{python}", "render.py", "{scene}", "{spp}", "{seed}", "{image}"]
spp = { sphere = 64 }
"""
RENDER = """import sys
scene, spp, seed, image = sys.argv[1:]
import mitsuba as mi
mi.set_variant("scalar_rgb")
mi.Bitmap(mi.render(mi.load_file(f"{scene}/scene.xml", bsdf="dielectric"), spp=int(spp), seed=int(seed))).write(image)
"""


@pytest.fixture
def renderer(tmp_path):
    """`renderer(toml, after)`: the folder of a renderer. After the test, the tables are restored."""
    tables = SYSTEMS, IMAGE_RENDERERS
    saved = [dict(table) for table in tables]

    def write(toml=TOML, after=""):
        folder = tmp_path / "mine"
        folder.mkdir(exist_ok=True)
        (folder / renderer_file.NAME).write_text(toml)
        (folder / "program.py").write_text(PROGRAM.format(before="", after=after))
        (folder / "render.py").write_text(RENDER)
        return folder

    yield write
    for table, copy in zip(tables, saved, strict=True):
        table.clear()
        table.update(copy)


def test_a_users_renderer_is_judged_by_rays_and_images(renderer, few, monkeypatch, needs_variant, tmp_path):
    """A known deviation is reported and must be detected."""
    needs_variant("llvm_ad_rgb")
    deviation = '[[rays.deviation]]\nregime = "grazing"\nreason = "lies flat"\n'
    rendered_images.join(join(renderer(TOML + deviation + IMAGES)))
    context = Context(PROFILES["quick"], tmp_path, "llvm_ad_rgb", {}, {})
    (task,) = (task for task in per_ray.tasks(context) if "Mine" in task.name)
    rows = {row.case: row for row in task.run()}
    flat = rows.pop("grazing")
    assert {row.verdict for row in rows.values()} == {"pass"} and flat.replay["version"] == "a program 1.0"
    assert flat.broken == {"not seen to deviate": 0.0} and "known to deviate: lies flat" in flat.reason
    renderer(TOML + deviation + IMAGES, "b[np.abs(c[:, 0]) < 0.02] = a[np.abs(c[:, 0]) < 0.02]")
    flat = {row.case: row for row in task.run()}["grazing"]
    assert flat.verdict == "pass" and flat.values["wrong"] > 0
    monkeypatch.setitem(rendered_images.SIZES, "quick", rendered_images.Size(16, 64, 1, 0.5))
    (row,) = rendered_images.pair_rows(context, "Mine", "sphere")
    assert row.verdict == "pass" and row.replay["verdict"] in ("equal", "inconclusive") and row.replay["spp"] == 64


def test_a_users_renderer_is_first_in_the_report(renderer, few, monkeypatch, tmp_path, capsys):
    """What was not measured is listed once."""
    folder, out = renderer(), tmp_path / "out"
    SYSTEMS.clear()
    SYSTEMS["other"] = System("other", "Other", calls=(RaysCommand("another program", "f64", ("false",), "zero"),))
    monkeypatch.setitem(command.ROOMS, "suite", ("matrix", "per_ray"))
    assert command.main(["suite", "--renderer", str(folder), "--out", str(out)]) == 1
    document = json.loads((out / "rows.json").read_text())
    subjects = dict.fromkeys(row["subject"] for row in document["rows"] if row["study"] == "matrix")
    assert [*subjects] == ["Mine, refract, f64", "another program, f64"]
    first, *others = document["context"]["first_page"]["answers"]
    assert (first["question"], first["state"]) == ("Your renderer: Mine, refract, f64", "yes")
    assert first["text"].startswith("exact only for inputs more than 8 roundings off: k ≫ 1 (")
    assert ["Not measured" in answer["question"] + answer["text"] for answer in others] == [False, True]
    printed = capsys.readouterr().out
    assert printed.startswith("Your renderer: Mine") and printed.count("Not measured") == 1
    systems = matrix.of_rows(row for row in document["rows"] if row["study"] == "per_ray")["rays"]
    assert systems[-1]["sentence"].startswith("no answers: ended with status 1")


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        (TOML + IMAGES.replace("mitsuba", "vray"), "images.export: 'vray'; expected "),
        (TOML + IMAGES.replace("sphere", "teapot"), "images.spp, images.deviation: 'teapot'; expected sphere"),
        (TOML + "[install]\nmegabytes = 1\n", "install: expected one of pip, npm and apt"),
        (None, "'pyglm' is already the name of a renderer"),
    ],
)
def test_an_invalid_renderer_is_an_error_in_one_line(toml, message, renderer, tmp_path, capsys):
    shutil.copytree(SYSTEMS_FOLDER / "pyglm", tmp_path / "pyglm")
    folder = renderer(toml) if toml else tmp_path / "pyglm"
    assert command.main(["suite", "--renderer", str(folder), "--out", str(tmp_path / "out")]) == 2
    err = capsys.readouterr().err
    assert message in err and err.count("\n") == 1

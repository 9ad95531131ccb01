"""Other systems: what is wrong with one of them never passes, and what is absent says what would bring it."""

import ast
import hashlib
import json
import re
import sys
import time
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mi_refract import oracle
from mi_refract.ray_sets import ray_set
from mi_refract.ray_sets.renderer_file import RaysCommand
from validation import __main__ as command
from validation import limits
from validation.suite import per_ray
from validation.suite.renderers import SYSTEMS, environments
from validation.suite.renderers import table as TABLE
from validation.suite.renderers.image_renderers import IMAGE_RENDERERS
from validation.suite.renderers.system import (
    LARGE,
    SCRIPTS,
    TOTAL,
    Apt,
    Npm,
    Pip,
    System,
)

# The figures of those who write down GLSL's formula.
PYGLM = next(call for call in SYSTEMS["pyglm"].calls if call.precision == "f64")
RECORDED_F64 = {name: list(PYGLM.recorded_range(name)) for name in PYGLM.recorded}
STANDARD, FULL = (SimpleNamespace(profile=SimpleNamespace(name=name)) for name in ("standard", "full"))
# What every program below does right unless `{defect}` says otherwise.
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
DEFECTS = {
    "index inverted": ("k = 1 / k", "", "wrong"),
    "normal flipped": ("n = -n", "", "wrong"),
    "precision lost": ("", "b = b.astype(np.float32)", "wrong"),
    "no direction": ("", "b[7] = np.nan", "wrong"),
    "nothing but zeros": ("", "b[:] = 0", "wrong"),
    "a set left out": ("", "rays.ids, b = rays.ids[:40], b[:40]", "unfit"),
    "an id missing": ("", "rays.ids, b = rays.ids[1:], b[1:]", "unfit"),
    "an id twice": ("", "rays.ids, b = rays.ids[:1] + rays.ids, np.vstack([b[:1], b])", "unfit"),
    "an id of nobody": ("", "rays.ids, b = rays.ids + ('9999',), np.vstack([b, b[:1]])", "unfit"),
    "told by NaN": ("", "b = np.where(d < 0, np.nan, b)", "other TIR signal"),
    "exception": ("raise RuntimeError('out of glass')", "", "unanswered"),
    "killed": ("os.kill(os.getpid(), 9)", "", "unanswered"),
    "hangs": ("time.sleep(1000)", "", "unanswered"),
    "no output": ("sys.exit(0)", "", "unanswered"),
    "words": ("print('refracting …')", "", "unanswered"),
    "bytes": ("os.write(1, bytes([0xff, 0xfe, 0x00])); os._exit(0)", "", "unanswered"),
    "cut short": ("", "print('id,bx,by,bz'); print('0,0.5,0.'); sys.exit(0)", "unanswered"),
}
BY_A_DRIVER = ("glsl", "materialx", "wgsl")
REASONS = {
    "exception": "ended with status 1: RuntimeError: out of glass",
    "killed": "was killed by SIGKILL",
    "bytes": "bytes that are not text",
    "an id missing": "id 0",
    "hangs": "did not end within 2 s",
}


@pytest.fixture
def rows_of(few, tmp_path):
    """`rows_of(before, after)`: what the study makes of such a program."""

    def run(before="", after="", recorded_error=RECORDED_F64, gives_up=0.0):
        path = tmp_path / "program.py"
        path.write_text(PROGRAM.format(before=before, after=after))
        call = RaysCommand("a program", "f64", ("{python}", str(path)), "zero", gives_up, recorded=recorded_error)
        return per_ray.call_rows(System("a", "A", "none", None, 0, small=True), call, STANDARD)

    return run


# The study -----------------------------------------------------------------------------------------------------


def test_right_answers_pass_and_say_who_gave_them(rows_of):
    rows = rows_of()
    assert [(row.case, row.verdict) for row in rows] == [(name, "pass") for name in per_ray.SETS]
    assert all(row.reason == "a program 1.0; total internal reflection: zero" for row in rows)
    assert all("worst rad" in row.values for row in rows if row.case != TOTAL)


@pytest.mark.parametrize("name", DEFECTS)
def test_a_broken_program_fails_for_its_reason(name, rows_of, monkeypatch):
    before, after, metric = DEFECTS[name]
    if name == "hangs":
        monkeypatch.setattr(environments, "TIMEOUT", 2.0)
    rows = rows_of(before, after)
    failing = [row for row in rows if row.verdict == "fail"]
    assert failing and any(metric in row.broken for row in failing)
    if metric == "unanswered":
        assert len(rows) == 1 and rows[0].reason and "\n" not in rows[0].reason
    if metric == "unfit":
        assert all(row.verdict == "fail" for row in rows), "answers to other rays say nothing of any set"
    assert REASONS.get(name, "") in rows[0].reason


def test_what_cannot_run_here_is_not_run(rows_of):
    (row,) = rows_of("print('no driver', file=sys.stderr); sys.exit(77)")
    assert (row.verdict, row.reason) == ("not run", "cannot run here: no driver")


def test_a_recorded_error_is_a_goal_on_both_sides(rows_of):
    much, little = (dict.fromkeys(RECORDED_F64, x) for x in (1e-2, 1e-30))
    for recorded_error in (much, little):
        rows = [row for row in rows_of(recorded_error=recorded_error) if row.case in RECORDED_F64]
        assert all(row.missed == {per_ray.OFF_RECORDED: limits.RECORDED} and row.verdict == "pass" for row in rows)
    assert [per_ray.off(x, 2, 4) for x in (1, 2, 3, 4, 8)] == [2, 1, 1, 1, 2]
    assert per_ray.off(0, 2, 4) == np.inf and np.isnan(per_ray.off(np.nan, 2, 4))


def test_the_textbook_is_right_but_where_k_is_large(rows_of):
    missed = {row.case for row in rows_of() if per_ray.BACKWARD in row.missed}
    assert missed == {LARGE}
    off = rows_of("n = n + 2e-15 * np.cross(n, a)")  # within the bound all the same
    assert {row.verdict for row in off} == {"pass"}
    assert {row.case for row in off if per_ray.BACKWARD in row.missed} >= {"random", "near-critical", LARGE}


def test_what_a_system_gives_up_is_counted_and_no_more_than_that(rows_of):
    early = "", "b[np.abs(d[:, 0]) < 1e-4] = 0"
    assert any(row.verdict == "fail" for row in rows_of(*early))
    rows = rows_of(*early, gives_up=1.01e-4)
    assert {row.verdict for row in rows} == {"pass"}
    assert sum(row.values["given up"] for row in rows) > 0
    assert any(row.verdict == "fail" for row in rows_of(*early, gives_up=1e-5))


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_the_sets_are_what_they_say(precision, few):
    rays = per_ray.given(precision)
    exact = oracle.refract(rays.rays.a, rays.rays.n, rays.rays.k, fresnel=False, progress=False)
    through = {name: exact.transmitted[rays.regime == name].mean() for name in per_ray.SETS}
    assert (through["grazing"], through[TOTAL]) == (1, 0)
    assert through["near-critical"] > 0.9, "rounding may put a ray on the other side"
    assert ray_set.with_checksum(rays).header == rays.header


def test_the_built_in_runs_and_is_right(few):
    for call in SYSTEMS["mitsuba"].calls:
        rows = per_ray.call_rows(SYSTEMS["mitsuba"], call, STANDARD)
        assert [row.verdict for row in rows] == ["pass"] * len(per_ray.SETS), call.title


def test_this_package_is_right_in_every_set(few, needs_variant):
    needs_variant("llvm_ad_rgb")
    for call in SYSTEMS["mi_refract"].calls:
        rows = per_ray.call_rows(SYSTEMS["mi_refract"], call, STANDARD)
        assert [(row.case, row.verdict, row.missed) for row in rows] == [(name, "pass", {}) for name in per_ray.SETS]
        assert max(row.values[per_ray.BACKWARD] for row in rows) < 1


@pytest.mark.parametrize("name", [name for name, system in SYSTEMS.items() if system.small and system.needs])
def test_small_systems_that_are_installed_are_right(name, few):
    if reason := environments.absent(SYSTEMS[name]):
        pytest.skip(reason)
    rows = [row for call in SYSTEMS[name].calls for row in per_ray.call_rows(SYSTEMS[name], call, STANDARD)]
    assert {row.verdict for row in rows} <= ({"pass", "not run"} if name in BY_A_DRIVER else {"pass"})


# Environments --------------------------------------------------------------------------------------------------


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    locks = tmp_path / "locks"
    (locks / "thing").mkdir(parents=True)
    for name in ("thing.txt", "pinned.txt", "thing/package.json", "thing/package-lock.json"):
        (locks / name).write_text("{}" if "json" in name else f"mi-refract-no-such-thing==1 --hash=sha256:{'0' * 64}")
    for lock in environments.LOCKS.glob("*.txt"):
        (locks / lock.name).write_bytes(lock.read_bytes())
    monkeypatch.setattr(environments, "LOCKS", locks)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "mi_refract" / "renderers"


def test_an_absent_system_is_not_run_and_says_what_brings_it(elsewhere):
    system = SYSTEMS["pyglm"]
    assert environments.folder(system) == elsewhere / "pyglm"
    (row,) = per_ray.call_rows(system, system.calls[0], FULL)
    assert (row.verdict, row.reason) == ("not run", "python -m validation renderers --install pyglm")


def test_large_systems_wait_for_the_full_profile(monkeypatch):
    monkeypatch.setattr(environments, "absent", lambda system: "")
    large = [system for system in SYSTEMS.values() if not system.small and system.calls]
    for system in large:
        (row,) = per_ray.call_rows(system, system.calls[0], STANDARD)
        assert row.verdict == "not run" and "full profile" in row.reason


def test_every_system_has_a_place_a_licence_and_scripts():
    assert all(name == system.name and name.isidentifier() for name, system in SYSTEMS.items())
    drawing = {renderer.system for renderer in IMAGE_RENDERERS.values()}
    assert all(system.calls or name in drawing for name, system in SYSTEMS.items())
    assert all(system.licence and system.title for system in SYSTEMS.values())
    commands = [command for system in SYSTEMS.values() for command in (*(c.command for c in system.calls), system.lens)]
    assert all((TABLE.SYSTEMS_FOLDER / "any" / word).resolve().is_file() for c in commands for word in c[1:2])
    needs = [system.needs for system in SYSTEMS.values() if isinstance(system.needs, Pip)]
    assert all(re.match(f"{each.built or '.+'}==", each.requirements[0]) for each in needs)


def test_every_package_is_pinned_by_hashes_and_no_script_of_one_runs():
    for system in SYSTEMS.values():
        if isinstance(system.needs, Pip):
            locks = [environments.locked(system), *([environments.locked_source(system)] if system.needs.built else [])]
            text = "".join(lock.read_text() for lock in locks).replace("\\\n", "")
            lines = [line for line in text.splitlines() if line and not line.startswith("#")]
            assert all(re.match(r"[\w.-]+==[\w.]+( ; [^#]+?)?( +--hash=sha256:[0-9a-f]{64})+$", line) for line in lines)
            pinned = {line.split()[0].lower() for line in lines}
            assert {each.lower() for each in system.needs.requirements if "==" in each} <= pinned, system.name
            bare = {re.split("[=<]", each)[0].lower() for each in system.needs.requirements}
            assert bare <= {each.partition("==")[0] for each in pinned}
        if isinstance(system.needs, Npm):
            folder = environments.locked(system)
            asked = json.loads((folder / "package.json").read_text())["dependencies"]
            assert {f"{name}@{version}" for name, version in asked.items()} == {*system.needs.packages}
            packages = json.loads((folder / "package-lock.json").read_text())["packages"]
            assert packages.pop("")["dependencies"] == asked
            assert all(each["integrity"].startswith("sha512-") for each in packages.values())


def test_scripts_import_nothing_of_ours_and_we_nothing_of_theirs():
    def imported(path):
        nodes = list(ast.walk(ast.parse(path.read_text())))
        names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
        names += [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom) and not node.level]
        return {name.partition(".")[0] for name in names}

    root = SCRIPTS.parents[3]
    theirs = {"bpy", "glm", "moderngl", "optiland", "pyluxcore", "pyradiance", "rayoptics", "raysect"}
    theirs |= {"MaterialX", "batoid", "prysm", "pyoptools", "raylib", "skia", "slangpy", "taichi", "wgpu"}
    scripts = {*SCRIPTS.glob("*.py"), *(root / "mi_refract" / "scene_export" / "targets").glob("render_*.py")}
    assert len(scripts) > 9
    for path in scripts - {SCRIPTS / "own_rays.py"}:  # this package is what it runs
        assert not imported(path) & {"mi_refract", "validation"}, path.name
    ours = {*(root / "mi_refract").rglob("*.py"), *(root / "validation").rglob("*.py")}
    for path in ours - scripts:
        assert not imported(path) & (theirs | {path.stem for path in scripts}), path.name


# The command ---------------------------------------------------------------------------------------------------


def one_line(captured):
    (line,) = captured.err.strip().splitlines()
    assert not captured.out
    return line


@pytest.mark.parametrize("arguments", [["--install", "blendr"], ["--instal"], ["--list", "--install", "pyglm"]])
def test_misuse_is_one_line(arguments, capsys):
    try:
        code = command.main(["renderers", *arguments])
    except SystemExit as end:
        code = end.code
    assert code == 2 and one_line(capsys.readouterr()).startswith("validation renderers: ")


def test_the_list_says_what_is_there(elsewhere, capsys, monkeypatch):
    monkeypatch.setattr("shutil.which", lambda program: None)
    assert command.main(["renderers"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(SYSTEMS)
    assert [line.split()[1] for line in lines] == [
        "installed" if s.needs is None else "absent" for s in SYSTEMS.values()
    ]


@pytest.mark.parametrize(
    ("needs", "said"),
    [
        (Pip(("mi-refract-no-such-thing==1",)), "mi-refract-no-such-thing==1"),
        (Pip(("numpy",), python="2.7"), "needs Python 2.7; expected a python2.7 in PATH"),
        (Npm(("mi-refract-no-such-thing@1",)), "npm"),
        (Apt("no-such-program", ("mi-refract-no-such-thing",)), "apt-get"),
    ],
)
def test_an_installation_that_fails_is_one_line_and_leaves_the_system_absent(
    needs, said, elsewhere, monkeypatch, capsys, tmp_path
):
    monkeypatch.setitem(SYSTEMS, "thing", System("thing", "Thing", "none", needs, 0))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    programs = tmp_path / "bin"
    programs.mkdir()
    for name in ("npm", "apt-get", "sudo"):
        (programs / name).write_text("#!/bin/sh\necho working\necho nothing of that name >&2\nexit 1\n")
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(programs))
    assert command.main(["renderers", "--install", "thing"]) == 1
    first, *rest = capsys.readouterr().err.strip().splitlines()
    assert first.startswith("thing: ") and len(rest) == 1
    assert rest[0].startswith("validation renderers: thing: ") and said in rest[0]
    assert environments.absent(SYSTEMS["thing"])


def test_another_version_of_a_distribution_is_absent_and_not_installed(elsewhere, monkeypatch, capsys, tmp_path):
    def program(name, text):
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
        environments._said_version.cache_clear()

    monkeypatch.setenv("PATH", f"{tmp_path}:/bin")
    assert SYSTEMS["povray"].needs.packages == (f"povray=1:{SYSTEMS['povray'].needs.version}-*",)
    for version, here in (("3.7.0.10.unofficial", True), ("3.7.0.8", False)):
        program("povray", f"echo POV-Ray {version} >&2")
        assert bool(environments.absent(SYSTEMS["povray"])) != here
    program("apt-get", "echo \"E: Version '1:3.7.0.10-*' for 'povray' was not found\" >&2; exit 100")
    program("sudo", 'shift; exec "$@"')
    program("apt-cache", "echo 'povray | 1:3.7.0.8-5 | http://deb.debian.org/debian bullseye/main amd64 Packages'")
    assert command.main(["renderers", "--install", "povray"]) == 1
    _, line = capsys.readouterr().err.strip().splitlines()
    assert "'1:3.7.0.10-*' for 'povray' was not found" in line
    assert line.endswith("; this distribution has povray 1:3.7.0.8-5")


def test_an_installation_is_made_once_and_anew_for_another_version(elsewhere, monkeypatch):
    done = []
    monkeypatch.setattr(environments, "run", lambda command, **options: done.append(command) or "")
    first, second = (System("thing", "Thing", "none", Pip((f"a=={i}",)), 0) for i in (1, 2))
    for system, commands in ((first, 2), (first, 2), (second, 4)):
        environments.install(system)
        assert len(done) == commands and not environments.absent(system)
    assert environments.absent(first)
    assert all({"--require-hashes", "--only-binary", "--no-deps"} < {*given} for given in done[1::2])
    assert all(given[-2:] == ["--requirement", str(environments.locked(first))] for given in done[1::2])
    marker = environments.folder(second) / "installed.json"
    for text in ('["no such"]', "{", ""):
        whole = marker.read_text()
        marker.write_text(text)
        assert environments.absent(second)
        marker.write_text(whole)
    environments.locked(first).write_text("another lock")
    assert environments.absent(second)
    environments.install(System("thing", "Thing", "none", Npm(("a@1",)), 0))
    assert done[-1][:2] == ["npm", "ci"] and "--ignore-scripts" in done[-1]


def test_pip_refuses_a_package_without_or_with_another_hash(elsewhere, tmp_path, monkeypatch):
    """A wheel of the right name that is not the locked one is not installed."""
    wheel = tmp_path / "thing-1-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as file:
        file.writestr("thing.py", "")
        file.writestr("thing-1.dist-info/METADATA", "Metadata-Version: 2.1\nName: thing\nVersion: 1\n")
        file.writestr("thing-1.dist-info/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        file.writestr("thing-1.dist-info/RECORD", "")
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    system = System("thing", "Thing", "none", Pip(("thing==1",)), 0)
    right = hashlib.sha256(wheel.read_bytes()).hexdigest()
    for line in (f"thing==1 --hash=sha256:{'0' * 64}", "thing==1"):
        environments.locked(system).write_text(line)
        with pytest.raises(OSError, match="thing: "):
            environments.install(system)
        assert environments.absent(system)
    environments.locked(system).write_text(f"thing==1 --hash=sha256:{right}")
    environments.install(system)
    assert not environments.absent(system)


# Programs ------------------------------------------------------------------------------------------------------


def test_a_program_that_hangs_takes_its_children_with_it(tmp_path):
    where = tmp_path / "child"
    child = f"p = subprocess.Popen(['sleep', '1000']); open({str(where)!r}, 'w').write(str(p.pid))"
    hangs = [sys.executable, "-c", f"import subprocess, time; {child}; time.sleep(1000)"]
    for timeout in (3, 60):  # a busy machine may not even have started it in the shorter time
        with pytest.raises(environments.Broken, match=f"did not end within {timeout} s"):
            environments.run(hangs, "", timeout)
        if where.exists():
            break
    status = Path(f"/proc/{where.read_text()}/status")
    until = time.monotonic() + 60
    while status.exists() and "zombie" not in status.read_text() and time.monotonic() < until:
        time.sleep(0.05)
    assert not status.exists() or "zombie" in status.read_text()


def test_programs_run_without_our_environment(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(SCRIPTS))
    asked = "import os, sys; print(os.environ.get('PYTHONPATH'), sys.stdin.read())"
    assert environments.run([sys.executable, "-c", asked], given="rays") == "None rays\n"


def test_a_program_that_is_not_there_is_broken():
    with pytest.raises(environments.Broken, match="no-such-program: No such file"):
        environments.run(["no-such-program"])

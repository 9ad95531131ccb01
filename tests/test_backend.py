"""Which variants run here: libraries that abort, refuse, hang, lie; the memory of it; the choice of the user."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import drjit
import pytest

from mi_refract import backend

ROOT = Path(backend.__file__).parents[1]
NANOTHREAD = Path(drjit.__file__).parent / "libnanothread.so"  # a shared library, but not LLVM
PYTHON = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, sys.path)])}


@pytest.fixture(autouse=True)
def apart(tmp_path, monkeypatch):
    """A memory of its own for every test, and no answer from before."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    cached = (backend.llvm, backend.cuda, backend._circumstances)
    for function in cached:
        function.cache_clear()
    yield
    for function in cached:
        function.cache_clear()


def run(code, **environment):
    done = subprocess.run(
        [sys.executable, "-c", code], env=PYTHON | environment, capture_output=True, text=True, timeout=120
    )
    assert done.returncode >= 0, f"died by signal {-done.returncode}: {done.stderr[-500:]}"
    return done


def one_line(text):
    return text and "\n" not in text


@pytest.mark.parametrize(
    "name, version",
    [
        ("libLLVM.so.19.1", (19, 1)),
        ("libLLVM-15.so.1", (15,)),
        ("libLLVM-14.0.6.so.1", (14, 0, 6)),
        ("libLLVM-19.so", (19,)),
        ("libLLVM.so", ()),
        ("libLLVM.dylib", ()),
        ("libLLVMSupport.so.19", None),
        ("libLLVM-C.so", None),
        ("libLLVMCore.a", None),
    ],
)
def test_version_from_the_name(name, version):
    assert backend._version(f"/usr/lib/{name}") == version


def test_highest_version_first(tmp_path, monkeypatch):
    for name in ("libLLVM-9.so.1", "libLLVM.so.21.1", "libLLVM.so.100"):
        (tmp_path / name).touch()
    monkeypatch.setenv("LD_LIBRARY_PATH", str(tmp_path))
    monkeypatch.setattr(backend, "_loaded", set)
    names = [Path(path).name for path in backend.candidates() if path.startswith(str(tmp_path))]
    assert names == ["libLLVM.so.100", "libLLVM.so.21.1", "libLLVM-9.so.1"]


# What a library can do to a process


@pytest.mark.parametrize(
    "content, defect",
    [(b"no library at all", "file too short"), (b"\x7fELF" + bytes(4096), "refused"), (None, "refused by Dr.Jit")],
    ids=["text", "broken ELF", "another library"],
)
def test_a_file_that_is_not_llvm(tmp_path, content, defect):
    path = tmp_path / "libLLVM.so.19.1"
    path.write_bytes(NANOTHREAD.read_bytes() if content is None else content)
    library = backend._try(str(path))
    assert not library.works
    assert defect in library.defect
    assert one_line(library.defect)


@pytest.mark.parametrize(
    "code, defect, lasting",
    [
        ("import os; os.abort()", "SIGABRT", True),
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "SIGSEGV", True),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "SIGKILL", False),
        ("import time; print('works', flush=True); time.sleep(60)", "longer than", False),
        ("raise RuntimeError('first\\nsecond')", "second", True),
        ("pass", "no answer", True),
    ],
    ids=["abort", "segmentation fault", "killed", "hangs", "raises", "silent"],
)
def test_a_probe_that_ends_badly(monkeypatch, code, defect, lasting):
    monkeypatch.setattr(backend, "_PROBE", code)
    monkeypatch.setattr(backend, "TIMEOUT", 1.0 if "sleep" in code else 60.0)
    found, kept = backend._probe("llvm", {})
    assert defect in found
    assert one_line(found)
    assert kept is lasting


# The verdict of the tiny kernel is compared with what matters: does an image come out, or does the process die?
IMAGE = """
import mitsuba as mi, numpy as np
mi.set_variant("llvm_ad_rgb")
scene = mi.cornell_box()
scene["sensor"]["film"] |= {"width": 4, "height": 4}
print(np.isfinite(np.array(mi.render(mi.load_dict(scene), spp=1))).all())
"""


@pytest.mark.parametrize("path", backend.candidates() or [None])
def test_the_verdict_is_the_fate_of_an_image(path, tmp_path):
    if path is None:
        pytest.skip("no libLLVM on this machine")
    environment = PYTHON | {backend.CHOICE: path, "DRJIT_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", IMAGE], env=environment, capture_output=True, text=True)
    drawn = done.returncode == 0 and done.stdout == "True\n"
    assert backend._try(path).works == drawn, done.stderr[-500:]


def test_llvm_15_does_not_end_this_process(monkeypatch):
    path = "/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1"
    if not Path(path).exists():
        pytest.skip(f"no {path}")
    monkeypatch.setenv(backend.CHOICE, path)
    here = backend.llvm()
    if here.usable:
        pytest.skip("LLVM 15 works on this CPU")
    assert "SIGABRT" in here.reason
    assert path in here.reason
    code = "from mi_refract import backend; print(backend.activate(may_restart=True))"
    assert run(code, **{backend.CHOICE: path}).stdout == "scalar_rgb\n"


# Memory


@pytest.fixture
def counted(monkeypatch, tmp_path):
    """A library, and the list of the probes it has seen."""
    probes = []

    def probe(name, environment):
        probes.append(environment[backend.CHOICE])
        return "is made up", True

    monkeypatch.setattr(backend, "_probe", probe)
    library = tmp_path / "libLLVM.so.19.1"
    library.write_text("one")
    return str(library), probes


def test_an_answer_is_remembered(counted):
    library, probes = counted
    assert backend._try(library) == backend._try(library) == backend.Library(library, "is made up")
    assert len(probes) == 1
    memory = backend._cache_file()
    assert list(json.loads(memory.read_text()).values()) == ["is made up"]
    assert list(memory.parent.iterdir()) == [memory]


def test_a_good_answer_is_remembered_too(counted, monkeypatch):
    library, _ = counted
    monkeypatch.setattr(backend, "_probe", lambda name, environment: ("", True))
    assert backend._try(library).works
    monkeypatch.setattr(backend, "_probe", lambda name, environment: ("asked again", True))
    assert backend._try(library).works


@pytest.mark.parametrize("change", ["content", "time", "drjit", "probe"])
def test_a_change_asks_again(counted, monkeypatch, change):
    library, probes = counted
    backend._try(library)
    if change == "content":
        state = Path(library).stat()
        Path(library).write_text("another")
        os.utime(library, ns=(state.st_atime_ns, state.st_mtime_ns))
    elif change == "time":
        os.utime(library, (1, 1))
    elif change == "drjit":
        monkeypatch.setattr(backend.importlib.metadata, "version", lambda name: "99")
    else:
        monkeypatch.setattr(backend, "_PROBE", "pass")
    backend._circumstances.cache_clear()
    backend._try(library)
    assert len(probes) == 2


def test_what_may_pass_is_not_remembered(counted, monkeypatch):
    library, _ = counted
    monkeypatch.setattr(backend, "_probe", lambda name, environment: ("took too long", False))
    assert backend._try(library).defect == "took too long"
    assert not backend._cache_file().exists()


@pytest.mark.parametrize("content", ["", "{", "[1]", '{"key": 1}', "null", "\x00"])
def test_a_spoilt_memory_is_an_empty_one(counted, content):
    library, probes = counted
    backend._cache_file().parent.mkdir(parents=True)
    backend._cache_file().write_text(content)
    assert backend._try(library) == backend._try(library)
    assert len(probes) == 1


def test_a_memory_that_cannot_be_written(counted, monkeypatch, tmp_path):
    library, probes = counted
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert backend._try(library) == backend._try(library)
    assert len(probes) == 2


# Choice


def test_the_users_choice_is_the_only_candidate(counted, monkeypatch):
    library, probes = counted
    monkeypatch.setenv(backend.CHOICE, library)
    here = backend.llvm()
    assert probes == [library]
    assert not here.usable
    assert here.reason.startswith(f"{backend.CHOICE}={library}: is made up; expected ")
    assert [entry.path for entry in backend.libraries()] == [library]


def test_our_own_choice_is_not_the_users(counted, monkeypatch):
    library, _ = counted
    monkeypatch.setenv(backend.CHOICE, library)
    monkeypatch.setenv(backend.OWN_CHOICE, library)
    monkeypatch.setattr(backend, "candidates", lambda: ["/lib/libLLVM.so.18", "/lib/libLLVM.so.17"])
    assert "no libLLVM" not in backend.llvm().reason
    assert [entry.path for entry in backend.libraries()] == ["/lib/libLLVM.so.18", "/lib/libLLVM.so.17"]


def test_no_library_at_all(monkeypatch):
    monkeypatch.delenv(backend.CHOICE, raising=False)
    monkeypatch.setattr(backend, "candidates", list)
    here = backend.llvm()
    assert not here.usable
    assert here.library is None
    assert here.reason.startswith("no libLLVM found; ")
    assert "LLVM 17" in here.reason or "libllvm19" in here.reason


def test_the_next_best_library_is_taken(tmp_path, monkeypatch):
    monkeypatch.delenv(backend.CHOICE, raising=False)
    monkeypatch.setattr(backend, "candidates", lambda: ["a", "b", "c"])
    monkeypatch.setattr(backend, "_try", lambda path: backend.Library(path, "bad" if path == "a" else ""))
    monkeypatch.setattr(backend, "_loaded", lambda: {"/x/b"})
    assert backend.llvm() == backend.Backend("llvm", True, "b", "b")


def test_every_variant_has_an_answer(usable_variants, monkeypatch):
    import mitsuba as mi

    answers = backend.usable_variants()
    assert list(answers) == mi.variants()
    assert [variant for variant, reason in answers.items() if reason is None] == usable_variants
    assert {"scalar_rgb", "scalar_spectral", "scalar_spectral_polarized"} <= set(usable_variants)
    assert all(reason is None or one_line(reason) for reason in answers.values())


def test_activate_a_variant_that_is_unknown_or_cannot_run(monkeypatch):
    for variant in ("llvm_ad_rbg", "", "scalar_rgb_double"):
        with pytest.raises(ValueError, match=r"unknown; expected scalar_rgb, ") as error:
            backend.activate(variant)
        assert one_line(str(error.value))
    monkeypatch.setattr(backend, "cuda", lambda: backend.Backend("cuda", False, "no GPU"))
    with pytest.raises(ValueError, match=r"'cuda_ad_rgb' cannot run here: no GPU; expected scalar_rgb, .*\w$"):
        backend.activate("cuda_ad_rgb")


def test_without_llvm_commands_run_in_scalar():
    code = "from mi_refract import backend; print(backend.activate(may_restart=True)); print(backend.summary())"
    chosen, summary = run(code, **{backend.CHOICE: "/nonexistent.so"}).stdout.splitlines()
    assert chosen == "scalar_rgb"
    assert summary.startswith(f"only scalar_* variants run: {backend.CHOICE}=/nonexistent.so: no such file")


def test_a_command_restarts_with_the_library_that_works(tmp_path, monkeypatch):
    """Dr.Jit takes the first file named libLLVM.so; here that is none of LLVM's."""
    monkeypatch.delenv(backend.CHOICE, raising=False)
    works = [library.path for library in backend.libraries() if library.works]
    if not works:
        pytest.skip(backend.llvm().reason)
    (tmp_path / "libLLVM.so").symlink_to(NANOTHREAD)
    plain = {"LD_LIBRARY_PATH": str(tmp_path), backend.CHOICE: "", backend.OWN_CHOICE: ""}
    environment = {key: value for key, value in (PYTHON | plain).items() if value}
    code = "from mi_refract import backend; print(backend.activate(may_restart={})); print(backend.llvm().reason)"

    def stdout(may_restart, before="import drjit"):
        command = [sys.executable, "-c", f"{before}; {code.format(may_restart)}"]
        return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120).stdout

    assert stdout(True).startswith("llvm_ad_rgb\nlibLLVM ")
    assert stdout(False).startswith("scalar_rgb\nDr.Jit was imported with no libLLVM; start Python with DRJIT_LIBLLVM")
    # The package imports Dr.Jit no sooner than it must: then there is nothing to restart.
    assert stdout(False, before="import mi_refract").startswith("llvm_ad_rgb\nlibLLVM ")

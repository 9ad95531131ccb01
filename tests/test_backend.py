"""The variants that run here: libraries that abort, fail, hang or compute wrongly; the cache; the user's choice."""

from __future__ import annotations

import json
import mmap
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import drjit
import pytest
from support.processes import ENVIRONMENT

from mi_refract import backend

NANOTHREAD = Path(drjit.__file__).parent / "libnanothread.so"  # a shared library, but not LLVM


@pytest.fixture(autouse=True)
def empty_cache(tmp_path, monkeypatch):
    """An empty cache for every test, on disk and in cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    cached = backend.llvm, backend.cuda
    for function in cached:
        function.cache_clear()
    yield
    for function in cached:
        function.cache_clear()


def run(code, **environment):
    options = {"capture_output": True, "text": True, "timeout": 120}
    done = subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT | environment, **options)
    assert done.returncode >= 0, f"died by signal {-done.returncode}: {done.stderr[-500:]}"
    return done


def one_line(text):
    return text and "\n" not in text


def test_candidates_are_sorted_by_version_and_have_llvms_c_interface(tmp_path, monkeypatch):
    versions = ["libLLVM.so.100", "libLLVM.so.21.1", "libLLVM-15.so.1", "libLLVM-14.0.6.so.1", "libLLVM-9.so"]
    versions.append("libLLVM.so")
    for name in [*sorted(versions), "libLLVMSupport.so.19", "libLLVM-C.so", "libLLVMCore.a"]:
        (tmp_path / name).touch()
    monkeypatch.setenv("LD_LIBRARY_PATH", str(tmp_path))
    assert [Path(path).name for path in backend.candidates() if path.startswith(str(tmp_path))] == versions


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="the system does not list loaded files")
@pytest.mark.parametrize("folder", ["lib", "Jane Doe"])
def test_a_library_that_is_loaded_is_the_first_candidate(folder, tmp_path, monkeypatch):
    place = tmp_path / folder
    place.mkdir()
    for version in ("99", "100"):
        (place / f"libLLVM.so.{version}").write_text("mapped")
    monkeypatch.setenv("LD_LIBRARY_PATH", str(place))
    with (place / "libLLVM.so.99").open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ):
        found = [Path(path).name for path in backend.candidates() if path.startswith(str(place))]
    assert found == ["libLLVM.so.99", "libLLVM.so.100"]


def test_candidates_on_windows_come_from_path(tmp_path, monkeypatch):
    monkeypatch.setattr(backend, "WINDOWS", "LLVM-C.dll")
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{tmp_path / 'none'}")
    (tmp_path / "LLVM-C.dll").touch()
    assert str(tmp_path / "LLVM-C.dll") in backend.candidates()


# Probes of libraries


@pytest.fixture
def probed(tmp_path, monkeypatch):
    """`probed(code)`: the defect of a library for which `import drjit` runs this code, and the number of probes."""
    modules, log, library = tmp_path / "modules", tmp_path / "log", tmp_path / "libLLVM.so.19.1"
    modules.mkdir()
    library.write_text("one")
    monkeypatch.syspath_prepend(modules)
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    monkeypatch.setenv(backend.CHOICE, str(library))
    monkeypatch.delenv(backend.OWN_CHOICE, raising=False)

    def probe(code="import os; os.abort()"):
        (modules / "drjit.py").write_text(f"open({str(log)!r}, 'a').write('1')\n{code}")
        (entry,) = backend.libraries()
        assert entry.path == str(library) and entry.works == (not entry.defect)
        return entry.defect, len(log.read_text())

    return probe


WORKS = "print('works'); import os, sys; sys.stdout.flush(); os._exit(0)"
CRASH = "ends the process in Dr.Jit's kernels (SIGABRT)"


@pytest.mark.parametrize(
    "content, defect",
    [(b"no library at all", "file too short"), (b"\x7fELF" + bytes(4096), "refused"), (None, "refused by Dr.Jit")],
    ids=["text", "broken ELF", "another library"],
)
def test_files_that_are_not_llvm_are_defective(tmp_path, content, defect, monkeypatch):
    path = tmp_path / "libLLVM.so.19.1"
    path.write_bytes(NANOTHREAD.read_bytes() if content is None else content)
    monkeypatch.setenv(backend.CHOICE, str(path))
    (library,) = backend.libraries()
    assert not library.works and defect in library.defect and one_line(library.defect)


@pytest.mark.parametrize(
    "code, defect, lasting",
    [
        ("import os; os.abort()", "SIGABRT", True),
        ("import os; os.write(2, b'LLVM ERROR: out of memory'); os.abort()", "SIGABRT", False),
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "SIGSEGV", True),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "SIGKILL", False),
        ("import time; print('works', flush=True); time.sleep(60)", "longer than", False),
        ("raise RuntimeError('first\\nsecond')", "second", False),
        ("import sys; sys.exit('refused')", "refused by Dr.Jit: no message", False),
        ("import sys; sys.exit('jit_llvm_init(): LLVM is too old.\\nrefused')", "LLVM is too old", True),
        ("import os; os._exit(0)", "no answer", False),
        (WORKS, "", True),
    ],
    ids=["abort", "out of memory", "segfault", "killed", "hangs", "raises", "refused", "too old", "silent", "works"],
)
def test_lasting_results_of_a_probe_are_stored(probed, monkeypatch, code, defect, lasting):
    monkeypatch.setattr(backend, "TIMEOUT", 3.0 if "sleep" in code else 60.0)
    reported, count = probed(code)
    assert defect in reported if defect else reported == ""
    assert count == 1 and "\n" not in reported
    assert probed(code) == (reported, 1 if lasting else 2)


# Cache


@pytest.mark.parametrize("change", ["content", "time", "drjit"])
def test_changes_cause_a_new_probe(probed, monkeypatch, change):
    assert probed() == probed() == (CRASH, 1)
    library = Path(os.environ[backend.CHOICE])
    if change == "content":
        state = library.stat()
        library.write_text("another")
        os.utime(library, ns=(state.st_atime_ns, state.st_mtime_ns))
    elif change == "time":
        os.utime(library, (1, 1))
    else:
        monkeypatch.setattr(backend.importlib.metadata, "version", lambda name: "99")
    assert probed(WORKS) == ("", 2)


@pytest.mark.parametrize("content", ["", "{", "[1]", '{"key": 1}', "null", "\x00"])
def test_a_damaged_cache_counts_as_empty(probed, content, tmp_path):
    cache = tmp_path / "cache" / "mi_refract" / "backend.json"
    cache.parent.mkdir(parents=True)
    cache.write_text(content)
    assert probed() == probed() == (CRASH, 1)
    assert list(json.loads(cache.read_text()).values()) == [CRASH] and list(cache.parent.iterdir()) == [cache]


def test_a_cache_that_cannot_be_written(probed, monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert [probed(), probed()] == [(CRASH, 1), (CRASH, 2)]


# Choice


def test_the_users_choice_is_the_only_candidate(probed):
    probed()
    here = backend.llvm()
    assert not here.usable
    assert here.reason.startswith(f"{backend.CHOICE}={os.environ[backend.CHOICE]}: {CRASH}; expected ")


def test_the_packages_own_choice_and_no_library(probed, monkeypatch):
    library = os.environ[backend.CHOICE]
    probed()
    monkeypatch.setenv(backend.OWN_CHOICE, library)
    monkeypatch.setattr(backend, "candidates", lambda: [library, library])
    assert [entry.path for entry in backend.libraries()] == [library, library]
    assert backend.llvm().reason.startswith(f"libLLVM 19.1: {CRASH}; libLLVM 19.1: ")
    backend.llvm.cache_clear()
    monkeypatch.setattr(backend, "candidates", list)
    here = backend.llvm()
    assert not here.usable and here.library is None and here.reason.startswith("no libLLVM found; ")
    assert "LLVM 17" in here.reason or "libllvm19" in here.reason


# The verdict of the probe is compared with a real render, which succeeds or aborts the process.
IMAGE = """
import mitsuba as mi, numpy as np
mi.set_variant("llvm_ad_rgb")
scene = mi.cornell_box()
scene["sensor"]["film"] |= {"width": 4, "height": 4}
print(np.isfinite(np.array(mi.render(mi.load_dict(scene), spp=1))).all())
"""


@pytest.mark.parametrize("path", backend.candidates() or [None])
def test_the_verdict_agrees_with_rendering_an_image(path, tmp_path, monkeypatch):
    if path is None:
        pytest.skip("no libLLVM on this machine")
    environment = ENVIRONMENT | {backend.CHOICE: path, "DRJIT_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", IMAGE], env=environment, capture_output=True, text=True)
    drawn = done.returncode == 0 and done.stdout == "True\n"
    monkeypatch.setenv(backend.CHOICE, path)
    monkeypatch.delenv(backend.OWN_CHOICE, raising=False)
    (library,) = backend.libraries()
    assert library.works == drawn, done.stderr[-500:]


def test_every_variant_is_usable_or_has_a_reason(usable_variants, monkeypatch):
    import mitsuba as mi

    answers = backend.usable_variants()
    assert list(answers) == mi.variants()
    assert [variant for variant, reason in answers.items() if reason is None] == usable_variants
    assert {"scalar_rgb", "scalar_spectral", "scalar_spectral_polarized"} <= set(usable_variants)
    assert all(reason is None or one_line(reason) for reason in answers.values())


def test_without_a_temporary_folder_no_compiled_backend_is_usable(monkeypatch, tmp_path):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    detected = backend.detect()
    assert [name for name, entry in detected.items() if entry.usable] == ["scalar"]
    assert detected["cuda"].reason == "no process could be started: No such file or directory"


def test_activating_an_unknown_variant_or_one_that_cannot_run_is_an_error(monkeypatch):
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


def test_commands_restart_with_the_library_that_works(tmp_path, monkeypatch):
    """Dr.Jit loads the first file named libLLVM.so, which here is another library."""
    monkeypatch.delenv(backend.CHOICE, raising=False)
    works = [library.path for library in backend.libraries() if library.works]
    if not works:
        pytest.skip(backend.llvm().reason)
    (tmp_path / "libLLVM.so").symlink_to(NANOTHREAD)
    plain = {"LD_LIBRARY_PATH": str(tmp_path), backend.CHOICE: "", backend.OWN_CHOICE: ""}
    environment = {key: value for key, value in (ENVIRONMENT | plain).items() if value}
    code = "from mi_refract import backend; print(backend.activate(may_restart={})); print(backend.llvm().reason)"

    def stdout(may_restart, before="import drjit"):
        command = [sys.executable, "-c", f"{before}; {code.format(may_restart)}"]
        return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120).stdout

    assert stdout(True).startswith("llvm_ad_rgb\nlibLLVM ")
    assert stdout(False).startswith("scalar_rgb\nDr.Jit was imported with no libLLVM; start Python with DRJIT_LIBLLVM")
    # Importing the package does not import Dr.Jit, so no restart is needed.
    assert stdout(False, before="import mi_refract").startswith("llvm_ad_rgb\nlibLLVM ")

"""Which Mitsuba variants really run here, and with which libLLVM.

Mitsuba's wheel brings no libLLVM, and not every libLLVM works: Dr.Jit refuses LLVM 14, and LLVM 15 and 16 end the
process (no exception) in the first kernel with a minimum in it. So each library is first tried in a process of its own,
and the answer is remembered in `$XDG_CACHE_HOME/mi_refract/backend.json`.

Dr.Jit loads a libLLVM when it is imported, and no other one later. So call `activate` before Dr.Jit is imported; this
module needs only the standard library. After that another library needs a new process:
`activate(may_restart=True)`, which is for commands.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import zlib
from dataclasses import dataclass
from pathlib import Path

from .io.safe_files import temporary_folder

CHOICE = "DRJIT_LIBLLVM_PATH"  # where Dr.Jit looks first
OWN_CHOICE = "MI_REFRACT_LIBLLVM"  # set to the same value where the choice was ours, not the user's
WINDOWS = "LLVM-C.dll" if sys.platform == "win32" else ""  # what a libLLVM is called there
TIMEOUT = 120.0  # seconds; a probe takes 0.4 s of one idle core

# Last line of the output: "works", or the reason why not. 67 numbers: full vectors and a remainder.
_PROBE = """
import ctypes, importlib, math, sys
try:
    import resource
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
except ImportError:
    pass
import drjit as dr

name = sys.argv[1]
if not dr.has_backend(getattr(dr.JitBackend, name.upper())):
    if name == "cuda":
        ctypes.CDLL("libcuda.so.1")
    sys.exit("refused")
arrays = importlib.import_module("drjit." + name)
for number in (arrays.Float32, arrays.Float64):
    x = dr.arange(number, 67) / 16
    y = dr.sqrt(dr.fma(dr.minimum(dr.maximum(x, 0.5), 3), x, 1))
    for i, y_i in enumerate(y):
        if not abs(y_i - math.sqrt(min(max(i / 16, 0.5), 3) * i / 16 + 1)) < 1e-5:
            sys.exit("a kernel computes wrong numbers")
if name == "cuda":
    import mitsuba as mi
    mi.set_variant("cuda_ad_rgb")
    scene = mi.load_dict({"type": "scene", "sphere": {"type": "sphere"}})
    if not abs(scene.ray_intersect(mi.Ray3f([0, 0, -3], [0, 0, 1])).t[0] - 2) < 1e-5:
        sys.exit("OptiX traces rays wrongly")
print("works")
"""


@dataclass(frozen=True)
class Backend:
    """One way to run Dr.Jit. `reason` is why it is not usable, or what it runs on; one line."""

    name: str  # "scalar", "llvm", "cuda"
    usable: bool
    reason: str
    library: str | None = None


@dataclass(frozen=True)
class Library:
    """A libLLVM and what is wrong with it; "" where it works."""

    path: str
    defect: str

    @property
    def works(self) -> bool:
        """Whether nothing is wrong with it."""
        return not self.defect


def detect() -> dict[str, Backend]:
    """The backends scalar, llvm, cuda, and whether they run in this process. Never raises; asks once a process."""
    return {"scalar": Backend("scalar", True, "always there"), "llvm": llvm(), "cuda": cuda()}


def usable_variants() -> dict[str, str | None]:
    """Each variant of the installed Mitsuba: None if it runs here, else the reason in one line. Imports Mitsuba."""
    backends = detect()
    _announce(backends["llvm"])
    import mitsuba as mi

    needed = {variant: backends[variant.partition("_")[0]] for variant in mi.variants()}
    return {variant: None if backend.usable else backend.reason for variant, backend in needed.items()}


def activate(preferred: str | None = None, *, may_restart: bool = False) -> str:
    """Set a Mitsuba variant that runs here, register our plugins in it, and return its name.

    That is `preferred`, or without it llvm_ad_rgb where that runs, else scalar_rgb. ValueError, in one line, for a
    variant that Mitsuba does not have or that cannot run here. `may_restart`: call `restart_if_needed` first.
    """
    if may_restart:
        restart_if_needed()
    here = llvm()
    _announce(here)
    import mitsuba as mi

    import mi_refract  # noqa: F401  its plugins join every variant set from here on

    if preferred is None:
        preferred = "llvm_ad_rgb" if here.usable else "scalar_rgb"
    elif preferred not in mi.variants():
        raise ValueError(f"variant {preferred!r}: unknown; expected {', '.join(_running())}")
    elif not preferred.startswith("scalar_") and (reason := usable_variants()[preferred]):
        raise ValueError(f"variant {preferred!r} cannot run here: {reason}; expected {', '.join(_running())}")
    # Mitsuba looks for plugins in its own folder first; else it would run `plugins/sphere.so` of the working folder.
    own, resolver = str(Path(mi.__file__).parent), mi.file_resolver()  # type: ignore[operator]  # a class to its stubs
    if str(next(iter(resolver))) != own:
        resolver.prepend(own)
    mi.set_variant(preferred)
    return preferred


def _running() -> list[str]:
    return [variant for variant, reason in usable_variants().items() if reason is None]


def advice() -> str:
    """What to install to get more variants; one line."""
    missing = [f"the {b.name}_* variants are missing: {b.reason}" for b in detect().values() if not b.usable]
    return missing[0] if missing else "nothing is missing"


def summary() -> str:
    """The library that the CPU's variants run on; one line."""
    here = llvm()
    return f"llvm_* variants run on {here.reason}" if here.usable else f"only scalar_* variants run: {here.reason}"


# libLLVM -------------------------------------------------------------------------------------------------------


def libraries() -> list[Library]:
    """Every libLLVM found here, tried, the highest version first; only the user's, if DRJIT_LIBLLVM_PATH is set."""
    chosen = _users_choice()
    return [_try(path) for path in ([chosen] if chosen else candidates())]


def candidates() -> list[str]:
    """Every libLLVM on this machine, the highest version first; before all others the one that is loaded, if any."""
    names: list[str] = []
    ldconfig = shutil.which("ldconfig", path=os.pathsep.join([os.environ.get("PATH", ""), "/sbin", "/usr/sbin"]))
    if ldconfig:
        listing = subprocess.run([ldconfig, "-p"], capture_output=True, text=True, check=False).stdout
        names += re.findall(r"=> (\S*/libLLVM\S*)$", listing, re.MULTILINE)
    folders = [*os.environ.get("LD_LIBRARY_PATH", "").split(":"), f"{sys.prefix}/lib", "/usr/lib", "/usr/lib64"]
    folders += ["/usr/lib/*-linux-gnu", "/usr/lib/llvm*/lib*", "/usr/lib/llvm/*/lib*", "/usr/local/lib*"]
    folders += ["/usr/local/llvm*/lib*", "/opt/homebrew/opt/llvm*/lib", "/usr/local/opt/llvm*/lib"]
    for folder in folders:
        if folder.startswith("/"):
            names += map(str, Path("/").glob(f"{folder[1:]}/libLLVM*"))
    if WINDOWS:  # where Dr.Jit looks itself
        names += [str(x) for folder in os.environ["PATH"].split(os.pathsep) if (x := Path(folder, WINDOWS)).is_file()]
    loaded, paths = _loaded() or set(), set(map(os.path.realpath, names))
    versioned = [(path in loaded, version, path) for path in paths if (version := _version(path)) is not None]
    return [path for _, _, path in sorted(versioned, reverse=True)]


def _version(path: str) -> tuple[int, ...] | None:
    """The version in a file's name: (19, 1) of libLLVM.so.19.1, (15,) of libLLVM-15.so.1; None for another file."""
    name = re.fullmatch(r"libLLVM(?:-(\d[\d.]*))?\.(?:so|dylib)(?:\.(\d[\d.]*))?", Path(path).name)
    if name is None:
        return () if Path(path).name == WINDOWS else None
    return tuple(int(part) for part in re.findall(r"\d+", name[1] or name[2] or ""))


def _title(path: str) -> str:
    version = _version(os.path.realpath(path))
    return f"libLLVM {'.'.join(map(str, version))}" if version else path


def _users_choice() -> str | None:
    chosen = os.environ.get(CHOICE)
    return chosen if chosen and chosen != os.environ.get(OWN_CHOICE) else None


@functools.cache
def llvm() -> Backend:
    """Dr.Jit on the CPU, compiled: the best libLLVM that works. `library` without `usable`: it needs a new process."""
    chosen = _users_choice()
    defects = []
    for path in [chosen] if chosen else candidates():
        library = _try(path)
        if library.works:
            loaded = _loaded() if "drjit" in sys.modules else None
            # A path without a folder is looked up by the dynamic linker, so only its name can be compared.
            same = [os.path.realpath(path) == x if "/" in path else Path(x).name.startswith(path) for x in loaded or ()]
            if loaded is None or any(same):
                return Backend("llvm", True, _title(path), path)
            holds = ", ".join(sorted(map(_title, loaded))) or "no libLLVM"
            reason = f"Dr.Jit was imported with {holds}; start Python with {CHOICE}={path}"
            return Backend("llvm", False, reason, path)
        defects.append(f"{CHOICE}={path}: {library.defect}" if chosen else f"{_title(path)}: {library.defect}")
    install = "apt-get install libllvm19" if shutil.which("apt-get") else "install LLVM 17 or newer"
    remedy = f"expected the file of a libLLVM 17 or newer ({install})" if chosen else install
    return Backend("llvm", False, f"{'; '.join(defects) or 'no libLLVM found'}; {remedy}")


def _loaded() -> set[str] | None:
    """The libLLVM files mapped into this process; None where the system does not tell."""
    try:
        maps = Path("/proc/self/maps").read_text()
    except OSError:
        return None
    return {os.path.realpath(path) for path in re.findall(r"(/\S*)$", maps, re.MULTILINE) if _version(path) is not None}


def _announce(backend: Backend) -> None:
    """Tell Dr.Jit, if it is not imported yet, which library to load."""
    if backend.usable and backend.library and "drjit" not in sys.modules and not _users_choice():
        os.environ[CHOICE] = os.environ[OWN_CHOICE] = backend.library


def restart_if_needed() -> None:
    """Make Dr.Jit use the libLLVM that works; for commands.

    Where Dr.Jit was imported with another one already, start this process's command line again, and do not return.
    """
    here = llvm()
    _announce(here)
    # Where it was set already and did not help, go on without.
    if here.usable or here.library is None or os.environ.get(CHOICE) == here.library:
        return
    os.environ[CHOICE] = os.environ[OWN_CHOICE] = here.library
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


# Trying --------------------------------------------------------------------------------------------------------


@functools.cache
def cuda() -> Backend:
    """Dr.Jit on an NVIDIA GPU, and Mitsuba's ray tracing on it. Not remembered: drivers come and go."""
    defect, _ = _probe("cuda", {})
    return Backend("cuda", not defect, defect or "NVIDIA driver and OptiX")


def _try(path: str) -> Library:
    """Try one libLLVM, or remember how it went: the answer for an unchanged file, Dr.Jit and CPU does not change."""
    try:
        state = Path(path).stat()
    except OSError as error:
        if "/" in path:
            return Library(path, (error.strerror or "cannot be read").lower())
        state = None
    # The remembered defects by key; a file that is missing or not ours is an empty memory.
    try:
        known = json.loads(_cache_file().read_text())
    except (OSError, ValueError, RuntimeError):
        known = None
    known = {key: x for key, x in known.items() if isinstance(x, str)} if isinstance(known, dict) else {}
    # What decides, besides the library: Dr.Jit, the CPU's instruction sets, and the probe itself.
    try:
        drjit = importlib.metadata.version("drjit")
    except importlib.metadata.PackageNotFoundError:
        drjit = "unknown"
    try:
        flags = re.search(r"^(?:flags|Features)\s*:.*$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        flags = None
    machine = f"drjit {drjit}, {zlib.crc32((_PROBE + (flags[0] if flags else '')).encode()):08x}"
    key = state and f"{os.path.realpath(path)}, {state.st_mtime_ns}, {state.st_size}, {machine}"
    if key in known:
        return Library(path, known[key])
    defect, lasting = _probe("llvm", {CHOICE: path})
    if key and lasting:
        known[key] = defect
        # Replaced in one step. Where it cannot be written, the next process tries again.
        with contextlib.suppress(OSError, RuntimeError):
            _cache_file().parent.mkdir(parents=True, exist_ok=True)
            temporary = _cache_file().with_name(f"backend.json.{os.getpid()}")
            try:
                temporary.write_text(json.dumps(dict(list(known.items())[-50:]), indent=1))
                temporary.replace(_cache_file())
            finally:
                temporary.unlink(missing_ok=True)
    return Library(path, defect)


def _probe(name: str, environment: dict[str, str]) -> tuple[str, bool]:
    """(defect, lasting) of a backend, tried in a process of its own. A lasting defect would be found again."""
    with temporary_folder() as folder:
        # An empty kernel cache: a kernel on disk would not be compiled.
        own = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "DRJIT_CACHE_DIR": str(folder)}
        command = [sys.executable, "-c", _PROBE, name]
        try:
            done = subprocess.run(
                command,
                env=os.environ | own | environment,
                cwd=folder,
                timeout=TIMEOUT,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
                check=False,
            )
        except subprocess.TimeoutExpired:
            return f"a tiny kernel took longer than {TIMEOUT:.0f} s", False
        except OSError as error:
            return f"no process could be started: {error.strerror}", False
    if done.returncode < 0:
        lasting = done.returncode not in (-signal.SIGKILL, -signal.SIGTERM, -signal.SIGINT)
        name = {s.value: s.name for s in signal.Signals}.get(-done.returncode, f"signal {-done.returncode}")
        return f"ends the process in Dr.Jit's kernels ({name})", lasting
    if done.returncode == 0 and done.stdout.endswith("works\n"):
        return "", True
    # The line that says most: Dr.Jit's own if it refused the library, else the last.
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()] or ["no answer"]
    if "libcuda.so.1: cannot open" in lines[-1]:
        return "no NVIDIA driver: libcuda.so.1 not found", True
    if lines[-1] != "refused":
        return lines[-1][:200], True
    # "jit_find_library(): Unable to load "x": x: invalid ELF header!", "jit_llvm_init(): ... too old. The Dr.Jit ..."
    said = next((line for line in lines[:-1] if name in line or name == "llvm"), "no message")
    said = re.sub(r'^(\w+\(\): )?(Unable to load "[^"]*": [^:]*: )?', "", said)
    return f"refused by Dr.Jit: {said.split('. ')[0].rstrip('.! ')[:200]}", True


# Remembering ---------------------------------------------------------------------------------------------------


def _cache_file() -> Path:
    """RuntimeError where the user has no home directory."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "mi_refract" / "backend.json"
